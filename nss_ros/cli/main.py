"""The command line: `nss COMMAND`."""

from __future__ import annotations

import sys

import typer
from rich.console import Console
from rich.markup import escape

from nss_ros import __version__
from nss_ros.cli.align import align
from nss_ros.cli.benchmark import benchmark
from nss_ros.cli.compare import compare_logs
from nss_ros.cli.demo import demo
from nss_ros.cli.export import export
from nss_ros.cli.graphs import graphs
from nss_ros.cli.import_ import import_folder
from nss_ros.cli.map import map_
from nss_ros.cli.pairs import pairs
from nss_ros.cli.picture import picture
from nss_ros.cli.propose import propose
from nss_ros.cli.refine import refine
from nss_ros.cli.report import report
from nss_ros.cli.score import score
from nss_ros.cli.settings import config, methods
from nss_ros.cli.simulate import simulate
from nss_ros.cli.stats import stats
from nss_ros.cli.train import train
from nss_ros.cli.view import view
from nss_ros.errors import NssError

app = typer.Typer(
    name="nss",
    help="One map of a building that changes: register multi-stage fragments in a ROS 2 graph, "
    "and score the result.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.command("demo")(demo)
app.command("map")(map_)
app.command("benchmark")(benchmark)
app.command("score")(score)
app.command("report")(report)
app.command("compare")(compare_logs)
app.command("view")(view)
app.command("import")(import_folder)
app.command("export")(export)
app.command("propose")(propose)
app.command("simulate")(simulate)
app.command("pairs")(pairs)
app.command("graphs")(graphs)
app.command("stats")(stats)
app.command("train")(train)
app.command("picture")(picture)
app.command("refine")(refine)
app.command("align")(align)
app.command("methods")(methods)
app.command("config")(config)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"nss_ros {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


def main() -> None:
    """Entry point: an error that the user can mend is one sentence and status 1."""
    try:
        app()
    except NssError as error:
        _report(str(error))
    except OSError as error:
        _report(f"{error.strerror}: {error.filename}" if error.filename else str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def _report(sentence: str) -> None:
    console = Console(stderr=True)
    console.print(f"[red]error:[/red] {escape(sentence)}", soft_wrap=True, highlight=False)
    sys.exit(1)


if __name__ == "__main__":
    main()

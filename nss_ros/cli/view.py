"""`nss view`: a run in the Rerun viewer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nss_ros.bag import read_log, with_source_points
from nss_ros.errors import InputError
from nss_ros.viewing.log_view import draw_log
from nss_ros.viewing.scene import Scene
from nss_ros.viewing.sink import recording, rerun


def view(
    log: Annotated[
        Path | None,
        typer.Argument(metavar="[LOG]", help="Log folder, as written by 'nss map'."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="View a running graph instead of a LOG, until Ctrl-C.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a file for 'rerun FILE.rrd', show nothing."),
    ] = None,
    connect: Annotated[
        str,
        typer.Option(
            metavar="URL", help="Show it in a viewer elsewhere: rerun+http://HOST:9876/proxy."
        ),
    ] = "",
    voxel_size: Annotated[
        float, typer.Option(min=0.01, help="Voxel size of the points that are shown, metres.")
    ] = 0.1,
    namespace: Annotated[str, typer.Option(help="With --live: namespace of the graph.")] = "",
    duration: Annotated[
        float, typer.Option(min=0, help="With --live: end after this many seconds; 0: never.")
    ] = 0.0,
) -> None:
    """Show a run in Rerun: the map by stage, fragments, the graph with rejected edges, plots.

    Without --save or --connect a viewer is started on this machine.
    """
    if (log is None) != live:
        raise InputError("Give either a LOG to view, or --live for a running graph.")
    rerun()
    if log is None:
        _view_live(save, connect, voxel_size, namespace, duration)
    else:
        content = with_source_points(read_log(log))
        with recording(log.resolve().name, save, connect) as stream:
            draw_log(Scene(stream, voxel_size), content)
    if save is not None:
        Console().print(f"View: {save}; open it with 'rerun {save}'.", soft_wrap=True)


def _view_live(
    save: Path | None, connect: str, voxel_size: float, namespace: str, duration: float
) -> None:
    view_live = _import_live()
    console = Console(stderr=True)
    with (
        recording("live", save, connect) as stream,
        console.status("listening") as status,
    ):

        def report(fragments: int, answers: int, placed: int) -> None:
            status.update(f"{fragments} fragments, {answers} answers, {placed} placed")

        try:
            view_live(Scene(stream, voxel_size, changing=True), namespace, duration, report)
        except KeyboardInterrupt:
            return  # the usual end: what came is kept


def _import_live() -> Callable[..., None]:
    try:
        from nss_ros.nodes.viewer import view_live
    except ImportError as error:
        raise InputError(
            f"'nss view --live' needs ROS 2 Jazzy and the package nss_msgs ({error}): run it as "
            "'./nss', or source the workspace that you built with colcon."
        ) from error
    return view_live

import json

import pytest
import typer
from typer.testing import CliRunner

from nss_ros.bag import read_log
from nss_ros.cli.simulate import simulate
from nss_ros.errors import BagError, ConfigError

SMALL = ["--spots-per-stage", "2", "--stages", "2", "--seed", "3", "-s", "simulation.area=X1"]
SMALL += ["-s", "simulation.rig.image_width=40", "-s", "simulation.rig.image_height=30"]


@pytest.fixture(scope="module")
def app():
    app = typer.Typer()
    app.command()(simulate)
    return app


def test_the_bag_holds_what_the_summary_says(app, tmp_path):
    result = CliRunner().invoke(app, ["-o", str(tmp_path / "bag"), "--json", *SMALL])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    log = read_log(tmp_path / "bag")
    assert [str(fragment) for fragment in log.fragments] == [
        f"BldgX1_Stage{stage}_Spot{spot}" for stage in (1, 2) for spot in (1, 2)
    ]
    assert summary["fragments_per_stage"] == {"1": 2, "2": 2}
    assert summary["points"] == sum(len(f.points) for f in log.fragments.values())
    (graph,) = log.ground_truth
    assert graph.name == "BldgX1_Graph1"
    assert tuple(edge.pair for edge in graph.edges) == tuple(
        sorted(log.pairs, key=lambda pair: (pair.source, pair.target))
    )
    same = sum(pair.same_stage for pair in log.pairs)
    assert summary["same_stage"]["pairs"] == same
    assert summary["different_stage"]["pairs"] == len(log.pairs) - same
    assert log.metadata["simulation.seed"] == "3"


def test_an_existing_folder_is_not_touched(app, tmp_path):
    result = CliRunner().invoke(app, ["-o", str(tmp_path), *SMALL])
    assert isinstance(result.exception, BagError)
    assert list(tmp_path.iterdir()) == []


def test_settings_out_of_limits_are_named(app, tmp_path):
    arguments = ["-o", str(tmp_path / "bag"), "-s", "simulation.rig.tilt=-1"]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, ConfigError)
    assert "simulation.rig.tilt" in str(result.exception)

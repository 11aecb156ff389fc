import re
from pathlib import Path

import pytest

from nss_ros.config import NssConfig, load_config, write_config
from nss_ros.errors import ConfigError


def test_what_is_written_is_read(tmp_path: Path):
    config = load_config(None, ["registration.icp.iterations=7", "player.bags=[a, b]"])
    write_config(config, tmp_path / "c.yaml")
    assert load_config(tmp_path / "c.yaml") == config
    assert config.registration.icp.iterations == 7
    assert config.player.bags == ["a", "b"]


def test_overrides_win_over_the_file_and_the_file_over_defaults(tmp_path: Path):
    file = tmp_path / "c.yaml"
    file.write_text("player: {rate: 3.0}\n")
    defaults = ["player.rate=0", "player.loop=true"]
    config = load_config(file, defaults=defaults)
    assert (config.player.rate, config.player.loop) == (3.0, True)
    assert load_config(file, ["player.rate=5"], defaults).player.rate == 5


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("registration.voxel_size=-1", "registration.voxel_size"),
        ("registration.voxel_size=thin", "registration.voxel_size"),
        ("registration.voxle_size=1", "registration.voxle_size"),
        ("pose_graph.start=luck", "pose_graph.start"),
        ("registration.icp.iterations=.nan", "registration.icp.iterations"),
        ("player", "needs the form"),
        ("player.rate=[", "quote it"),
        ("player.rate=2024-99-99", "quote it"),
        ("registration.method=*x", "quote it"),
        ("simulation.rig.min_tripod_height=2", "max_tripod_height"),
    ],
)
def test_a_wrong_override_is_named(override: str, message: str):
    with pytest.raises(ConfigError, match=message):
        load_config(None, [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("registration.voxle_size=1", "did you mean 'registration.voxel_size'?"),
        ("registration.icp.iteration=1", "did you mean 'registration.icp.iterations'?"),
        ("registraton.seed=1", "did you mean 'registration'?"),
        (
            "nodes=3",
            "there are player, registration, pose_graph, recorder, simulation, dataset, training.",
        ),
    ],
)
def test_of_a_name_that_is_no_setting_the_right_one_is_told(override: str, message: str):
    with pytest.raises(ConfigError, match=re.escape(message)):
        load_config(None, [override])


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "\x00", "player: 3", "a: 2024-99-99"])
def test_a_wrong_file_is_named(tmp_path: Path, text: str):
    file = tmp_path / "settings.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"settings\.yaml"):
        load_config(file)


def test_a_missing_file_is_named():
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_config(Path("nowhere.yaml"))


def test_every_setting_says_what_it_means():
    def check(model) -> None:
        for name, field in model.model_fields.items():
            if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
                check(field.annotation)
            else:
                assert field.description, name

    check(NssConfig)

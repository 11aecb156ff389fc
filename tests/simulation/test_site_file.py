import numpy as np
import pytest
import trimesh

from nss_ros.config import load_config
from nss_ros.errors import ConfigError, InputError
from nss_ros.simulation.site_file import areas, built_in_sites, settings_for, site_file_of


def test_built_in_sites_can_all_be_read():
    assert {"demo", "one_floor", "six_areas"} <= set(built_in_sites())
    for name in built_in_sites():
        site_file, _ = site_file_of([name])
        assert site_file.areas
    six, _ = site_file_of(["six_areas"])
    assert list(six.areas) == ["1", "2", "3", "4", "5", "6"]


def test_areas_are_drawn_apart_and_the_same_again(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text("areas: {a: {procedural: {stages: 1}}, b: {procedural: {stages: 1}}}")
    site_file, folder = site_file_of([str(path)])

    def vertices(seed):
        return [build().stage_mesh(1).mesh.vertices for _, build in areas(site_file, folder, seed)]

    (first, second), again, other = vertices(3), vertices(3), vertices(4)
    assert [name for name, _ in areas(site_file, folder, 3)] == ["a", "b"]
    assert np.array_equal(first, again[0])
    assert first.shape != second.shape or not np.allclose(first, second)
    assert first.shape != other[0].shape or not np.allclose(first, other[0])


def test_meshes_and_their_paths_are_relative_to_the_site_file(tmp_path, monkeypatch):
    (tmp_path / "models").mkdir()
    trimesh.creation.box((9, 9, 0.2)).export(tmp_path / "models" / "slab.stl")
    (tmp_path / "site.yml").write_text("areas: {Z: {meshes: {stages: [models/slab.stl]}}}")
    monkeypatch.chdir("/")
    site_file, folder = site_file_of([str(tmp_path / "site.yml")])
    ((name, build),) = areas(site_file, folder, 0)
    assert name == "Z"
    assert len(build().elements) == 1
    site_file, folder = site_file_of([str(tmp_path / "models" / "slab.stl")] * 2)
    ((name, build),) = areas(site_file, folder, 0)
    assert (name, build().stages) == ("1", 2)


def test_settings_of_a_site_file_hold_where_a_run_sets_nothing(tmp_path):
    path = tmp_path / "site.yaml"
    path.write_text("{areas: {a: {procedural: {}}}, viewpoints: {min_region: 0.2, max_spacing: 3}}")
    site_file, _ = site_file_of([str(path)])
    config = load_config(None, ["simulation.seed=7", "simulation.viewpoints.max_spacing=2"])
    used = settings_for(site_file, config.simulation)
    assert (used.seed, used.viewpoints.min_region, used.viewpoints.max_spacing) == (7, 0.2, 2.0)
    assert used.viewpoints.min_spacing == config.simulation.viewpoints.min_spacing
    config = load_config(None, ["simulation.viewpoints.min_spacing=3.5"])
    with pytest.raises(ConfigError, match="max_spacing"):
        settings_for(site_file, config.simulation)
    demo, _ = site_file_of(["demo"])
    assert settings_for(demo, config.simulation) is config.simulation


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("areas: {}", "areas"),
        ("areas: {a: {}}", "exactly one of"),
        ("areas: {a: {procedural: {}, meshes: {stages: [a.ply]}}}", "exactly one of"),
        ("areas: {'a b': {procedural: {}}}", "a b"),
        ("areas: {a: {procedural: {width: 5}}}", "width"),
        ("- 1", "site.yaml"),
    ],
)
def test_what_is_wrong_in_a_site_file_is_named(tmp_path, text, message):
    path = tmp_path / "site.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        site_file_of([str(path)])


def test_arguments_that_mean_nothing_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"no site 'nowhere'.*one_floor"):
        site_file_of(["nowhere"])
    with pytest.raises(InputError, match="six_areas"):
        site_file_of([])
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(InputError, match="Cannot tell what"):
        site_file_of([str(tmp_path / "a.txt")])
    (tmp_path / "a.yaml").write_text("areas: {")
    with pytest.raises(InputError, match="not valid YAML"):
        site_file_of([str(tmp_path / "a.yaml")])

from pathlib import Path

import numpy as np
import pytest
import yaml

import nss_ros.simulation
from nss_ros.config import SiteConfig, ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.simulation.element import Material
from nss_ros.simulation.occupancy import door_triangles, occupancy_map
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.procedural.temporary import TEMPORARIES
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import changed_since

OVERHEAD = {
    *("ceiling_slab", "beam", "duct", "pipe", "sprinkler", "cable_tray"),
    *("ceiling_grid", "ceiling_tiles"),
}
TEMPORARY = {thing.kind for thing in TEMPORARIES}
SHELL = {"floor_slab", "ceiling_slab", "column", "core_wall", "stairs"}
SITES = sorted((Path(nss_ros.simulation.__file__).parent / "sites").glob("*.yaml"))
CONFIGS = {
    "office": SiteConfig(width=30, depth=14),
    "flats": SiteConfig(
        width=24, depth=13, stages=4, use="residential", wings=[{"length": 16, "turn": 50}]
    ),
    "hospital": SiteConfig(
        width=14, depth=14, stages=5, use="hospital", wings=[{"length": 30, "arc": -45}]
    ),
    "renovation": SiteConfig(
        width=28, depth=20, stages=6, use="laboratory", height=3.6, renovation=True
    ),
}


@pytest.fixture(scope="module", params=CONFIGS)
def site(request):
    return build_floor("1", CONFIGS[request.param], 0)


def kinds(site, stage):
    return {element.kind for element in site.elements if stage in element.stages}


def test_every_element_is_there_at_some_stage_and_has_a_name(site):
    stages = set(range(1, site.stages + 1))
    for element in site.elements:
        assert element.stages
        assert element.stages <= stages
        assert element.name
        assert len(element.mesh.triangles)
        assert np.isfinite(element.mesh.vertices).all()
    assert len(site.stage_names) == site.stages


def test_the_shell_stays(site):
    for element in site.elements:
        if element.kind in SHELL:
            assert len(element.stages) == site.stages


def test_much_changes_from_each_stage_to_the_next(site):
    for stage in range(1, site.stages):
        now = site.stage_mesh(stage)
        changed = changed_since(site, now.elements, stage + 1)
        assert 0.02 < changed.mean() < 0.98
        assert set(now.elements.tolist()) != set(site.stage_mesh(stage + 1).elements.tolist())


@pytest.mark.parametrize("name", ["office", "flats", "hospital"])
def test_a_new_building_grows_from_open_slab_to_furniture(name):
    site = build_floor("1", CONFIGS[name], 0)
    first, last = kinds(site, 1), kinds(site, site.stages)
    assert {"edge_protection", "net", "facade_scaffold"} <= first
    assert not {"board", "ceiling_tiles", "door", "desk", "bed"} & first
    assert {"stud", "board", "door", "duct", "sprinkler", "ceiling_tiles"} <= last
    assert {"desk", "bed", "cabinet"} & last
    assert not {"edge_protection", "prop", "facade_scaffold"} & last


def test_a_renovation_is_stripped_out_and_built_anew():
    site = build_floor("1", CONFIGS["renovation"], 0)
    walls = [
        {e.name for e in site.elements if e.kind == "board" and stage in e.stages}
        for stage in range(1, 7)
    ]
    assert len(walls[0]) > 20
    assert min(len(at_stage) for at_stage in walls[1:4]) < len(walls[0]) / 2
    assert len(walls[5]) > 20
    leaving = [e for e in site.elements if e.kind == "board" and 1 in e.stages]
    assert not any(6 in e.stages for e in leaving)
    assert "furniture" not in kinds(site, 3)
    assert "prop" not in kinds(site, 1)
    assert {"facade", "mullions"} & kinds(site, 1)
    assert {"ceiling_tiles", "bench", "door"} & kinds(site, 1)


def test_walls_are_built_in_order(site):
    """Where a wall's second side is closed its studs stand, at all stages of the layout."""
    by_wall = {}
    for element in site.elements:
        if element.name.startswith("stud wall"):
            wall, part = element.name.split(", ")
            by_wall.setdefault(wall, {}).setdefault(part, set()).update(element.stages)
    assert len(by_wall) > 5
    for parts in by_wall.values():
        for part, stages in parts.items():
            if part.startswith(("first", "second")):
                assert stages <= parts["studs"] <= parts["bottom track"]


def test_zones_are_out_of_step():
    """At one stage some walls are closed where others are at their studs or not begun."""
    site = build_floor("1", SiteConfig(width=60, depth=15, stages=3), 1)
    walls = {e.name.split(",")[0] for e in site.elements if e.name.startswith("stud wall")}
    states = set()
    for wall in walls:
        parts = {
            e.name.split(", ")[1].split(" boards")[0]
            for e in site.elements
            if e.name.startswith(f"{wall}, ") and 2 in e.stages
        }
        states.add("closed" if "second side" in parts else "open" if "studs" in parts else "none")
    assert states >= {"closed", "open"}


def test_nothing_hangs_in_the_air(site):
    """What is put down stands on the slab or, in raised rooms, on the raised floor."""
    things = {"pallet", "bin", "desk", "bed", "cabinet", "board_stack", "ladder", "track", "stud"}
    for element in site.elements:
        if element.kind in things:
            lowest = element.mesh.vertices[:, 2].min()
            assert min(abs(lowest), abs(lowest - 0.15)) < 0.02, element.name


def test_nothing_is_below_the_floor_but_slabs_stairs_and_scaffolds(site):
    for element in site.elements:
        if element.kind not in {"floor_slab", "stairs", "facade_scaffold"}:
            assert element.mesh.vertices[:, 2].min() > -0.05, element.name


def test_the_floor_ends_at_the_building(site):
    """Beside the building nothing lies at the height of the floor; the slab ends in the extent."""
    floor = [e for e in site.elements if e.kind == "floor_slab"]
    area = site.extent
    outside = np.array(
        [
            (area.x0 - 1.0, area.y0 - 1.0, 0.4),
            (area.x1 + 1.0, area.y1 + 1.0, 0.4),
            (area.x0 - 0.5, (area.y0 + area.y1) / 2, 0.4),
        ]
    )
    for stage in (1, site.stages):
        scene = Scene(site.stage_mesh(stage).mesh)
        drop = scene.cast(outside, np.tile([0.0, 0.0, -1.0], (3, 1))).distances
        assert (np.abs(drop - 0.4) > 0.3).all()
    corners = np.concatenate([e.mesh.vertices for e in floor])
    assert corners[:, 2].max() == site.floor_height == 0.0
    assert corners[:, 0].min() >= area.x0 - 1e-6
    assert corners[:, 0].max() <= area.x1 + 1e-6
    assert corners[:, 1].min() >= area.y0 - 1e-6
    assert corners[:, 1].max() <= area.y1 + 1e-6


def test_shafts_have_no_floor():
    """Down a lift shaft one sees neither the floor nor anything near it."""
    config = CONFIGS["office"]
    site = build_floor("1", config, 0)
    scene = Scene(site.stage_mesh(3).mesh)
    doors = next(e for e in site.elements if e.kind == "lift_door").mesh.vertices
    beyond = doors.mean(axis=0) * (1, 1, 0) + (0.0, 1.0, 0.4)
    assert np.isinf(scene.cast(beyond[None], np.array([[0.0, 0.0, -1.0]])).distances[0])


def test_glass_and_metal_are_what_they_should_be(site):
    materials = {}
    for element in site.elements:
        materials.setdefault(element.kind, set()).add(element.material)
    for kind, found in materials.items():
        if kind in {"window_glass", "curtain_glass", "glass_pane"}:
            assert found == {Material.GLASS}
        if kind in {"stud", "track", "duct", "sprinkler", "cable_tray", "mullions"}:
            assert found == {Material.METAL}
        if kind in {"board", "floor_slab", "column", "facade"}:
            assert found == {Material.MATT}
    assert {"window_glass", "curtain_glass"} & set(materials)


def test_doors_of_finished_rooms_can_be_passed(site):
    """Around the middle of every door opening nothing stands, from knee to head."""
    scene = Scene(site.stage_mesh(site.stages).mesh)
    frames = [e for e in site.elements if e.kind == "door_frame" and site.stages in e.stages]
    bounds = [(e.mesh.vertices.min(axis=0), e.mesh.vertices.max(axis=0)) for e in frames]
    middles = np.array([(low + high) / 2 for low, high in bounds])
    assert len(middles) > 5
    for angle in np.arange(8) * np.pi / 4:
        knees = middles * (1, 1, 0) + (0.25 * np.cos(angle), 0.25 * np.sin(angle), 0.45)
        rise = scene.cast(knees, np.tile([0.0, 0.0, 1.0], (len(knees), 1))).distances
        assert (rise > 1.6).all()


def test_overhead_services_leave_room_to_walk(site):
    for element in site.elements:
        if element.kind in OVERHEAD - {"pipe"}:
            assert element.mesh.vertices[:, 2].min() > 2.0, element.name


def test_same_seed_same_site_and_other_seed_or_area_another():
    config = SiteConfig(width=20, depth=12)

    def points(area, seed):
        return build_floor(area, config, seed).stage_mesh(2).mesh.vertices

    one = points("1", 4)
    assert np.array_equal(one, points("1", 4))
    assert one.shape != points("1", 5).shape
    assert one.shape != points("2", 4).shape


def test_clutter_can_be_left_out():
    without = build_floor("1", SiteConfig(clutter=0), 3)
    usual = build_floor("1", SiteConfig(), 3)
    assert {"pallet", "bin", "scaffold", "rubble"} & {e.kind for e in usual.elements}
    assert not {"pallet", "bin", "scaffold", "rubble"} & {e.kind for e in without.elements}
    built = {"column", "stud", "board", "duct"}
    kept = [[e.name for e in s.elements if e.kind in built] for s in (without, usual)]
    assert kept[0] == kept[1]


def test_temporary_things_come_and_go_and_nothing_else_changes():
    config = SiteConfig(stages=4)
    without = build_floor("1", config, 3)
    site = build_floor("1", config.model_copy(update={"temporary": 2.0}), 3)
    things = [e for e in site.elements if e.kind in TEMPORARY]
    assert {e.kind for e in things} == TEMPORARY
    once = [e for e in things if len(e.stages) == 1]
    assert sum(len(e.mesh.triangles) for e in once) > 0.7 * sum(
        len(e.mesh.triangles) for e in things
    )
    rest = [e for e in site.elements if e.kind not in TEMPORARY]
    assert [e.name for e in rest] == [e.name for e in without.elements]
    for one, other in zip(rest, without.elements, strict=True):
        assert np.array_equal(one.mesh.vertices, other.mesh.vertices)


def test_temporary_things_leave_room_to_walk():
    """What hangs ends above the heads, and what lies about one can step over."""
    site = build_floor("1", SiteConfig(stages=4, temporary=2.0), 3)
    heights = {each.kind: [] for each in TEMPORARIES}
    for element in site.elements:
        if element.kind in heights:
            heights[element.kind] += element.mesh.vertices[:, 2].tolist()
    for thing in TEMPORARIES:
        assert min(heights[thing.kind]) > (1.95 if thing.hangs else -0.01)
        if not thing.hangs and not thing.wide:
            assert max(heights[thing.kind]) < 0.65


def test_temporary_things_hardly_cut_off_any_floor():
    site = build_floor("1", SiteConfig(stages=2, temporary=2.0), 1)
    stage, config = site.stage_mesh(1), ViewpointConfig()
    scene, doors = Scene(stage.mesh), door_triangles(site, stage)
    mapped = occupancy_map(scene, doors, site.extent, site.floor_height, config)
    free = sum(np.count_nonzero(region) for region in mapped.regions(config.passage))
    reached = sum(np.count_nonzero(region) for region in mapped.reachable(config.passage, 1.0))
    assert reached > 0.85 * free


@pytest.mark.parametrize("renovation", [False, True])
def test_parts_can_be_left_out_and_the_others_stay_as_they_are(renovation):
    config = SiteConfig(stages=4, renovation=renovation)
    whole = build_floor("1", config, 0)
    parts = ("ceiling_slab", "beam", "prop", "facade", "services", "ceilings", "contents")
    bare = build_floor("1", config.model_copy(update={"without": parts}), 0)
    kept = {element.kind for element in bare.elements}
    assert kept >= {"floor_slab", "column", "core_wall", "stud", "board", "door"}
    assert not kept & {"ceiling_slab", "beam", "prop", "duct", "pipe", "ceiling_tiles", "desk"}
    meshes = {element.mesh.vertices.tobytes() for element in whole.elements}
    assert all(element.mesh.vertices.tobytes() in meshes for element in bare.elements)
    assert len(bare.elements) < len(whole.elements) / 2


def test_without_deviation_columns_stand_in_line():
    exact, usual = (
        build_floor("1", SiteConfig(width=30, deviation=d), 0).elements for d in (0.0, 1.0)
    )
    middles = [
        np.array([e.mesh.vertices[:, 0].mean() for e in elements if e.kind == "column"])
        for elements in (exact, usual)
    ]
    assert len(np.unique(np.round(middles[0], 6))) < len(np.unique(np.round(middles[1], 6)))
    assert 0 < np.abs(middles[0] - middles[1]).max() < 0.05


@pytest.mark.parametrize("stages", range(1, 7))
def test_any_number_of_stages_can_be_had(stages):
    site = build_floor("1", SiteConfig(stages=stages), 0)
    assert {stage for e in site.elements for stage in e.stages} == set(range(1, stages + 1))
    with pytest.raises(InputError, match=f"1 to {stages}"):
        site.stage_mesh(stages + 1)


def test_the_smallest_floor_and_one_of_5000_square_metres_can_be_built():
    smallest = build_floor("1", SiteConfig(width=14, depth=11), 1)
    largest = build_floor("1", SiteConfig(width=120, depth=40, stages=2), 1)
    assert len(smallest.stage_mesh(3).mesh.triangles) > 1000
    assert smallest.extent.area < 180
    assert largest.extent.area > 4800
    assert len(largest.stage_mesh(2).mesh.triangles) < 1_500_000


def test_wings_that_run_into_one_another_are_refused():
    with pytest.raises(InputError, match="run into one another"):
        build_floor(
            "1",
            SiteConfig(wings=[{"length": 12, "turn": 120}, {"length": 40, "turn": 120}]),
            0,
        )


def test_the_source_says_how_it_was_made():
    config = CONFIGS["flats"]
    source = build_floor("1", config, 7).source
    assert source["seed"] == 7
    assert SiteConfig.model_validate(source["procedural"]) == config


@pytest.mark.parametrize("path", SITES, ids=lambda path: path.stem)
def test_the_sites_that_come_along_are_valid(path):
    areas = yaml.safe_load(path.read_text())["areas"]
    assert areas
    for area in areas.values():
        assert 2 <= SiteConfig.model_validate(area["procedural"]).stages <= 6

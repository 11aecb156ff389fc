import numpy as np
import pytest

from nss_ros.config import SiteConfig
from nss_ros.errors import InputError
from nss_ros.simulation.procedural.floor import build_floor

SEEDS = range(4)


@pytest.fixture(scope="module", params=SEEDS)
def site(request):
    return build_floor("1", SiteConfig(), request.param)


def test_every_triangle_belongs_to_an_element_of_its_stage(site):
    for stage in (1, 2, 3):
        stage_mesh = site.stage_mesh(stage)
        assert len(stage_mesh.elements) == len(stage_mesh.mesh.triangles)
        present = {i for i, element in enumerate(site.elements) if stage in element.stages}
        assert set(stage_mesh.elements.tolist()) == present
        index = stage_mesh.elements[0]
        own = stage_mesh.mesh.vertices[stage_mesh.mesh.triangles[stage_mesh.elements == index]]
        element = site.elements[index].mesh
        assert np.array_equal(own, element.vertices[element.triangles])


def test_the_shell_stays_and_the_rest_changes(site):
    def kinds(stage):
        return {e.kind for e in site.elements if stage in e.stages}

    assert {"floor_slab", "ceiling_slab", "column", "beam", "core_wall"} <= kinds(1) & kinds(3)
    assert {"duct", "pipe", "dropped_ceiling", "board"} <= kinds(3)
    assert "prop" in kinds(1)
    assert not {"duct", "prop", "dropped_ceiling"} & (kinds(1) & kinds(3))
    stages = [{i for i, e in enumerate(site.elements) if s in e.stages} for s in (1, 2, 3)]
    assert stages[0] - stages[1]
    assert stages[1] - stages[0]
    assert stages[2] - stages[1]


def test_partitions_only_grow(site):
    for partition in site.plan.partitions:
        assert list(partition.progress) == sorted(partition.progress)


def test_nothing_is_left_in_the_air_or_outside(site):
    hanging = {"ceiling_slab", "beam", "duct", "pipe", "cable_tray", "dropped_ceiling"}
    in_walls = {"window_frame", "board", "door_frame", "door"}
    for element in site.elements:
        lower, upper = element.mesh.vertices.min(axis=0), element.mesh.vertices.max(axis=0)
        assert (lower[:2] > -0.5).all(), element.kind
        assert upper[0] < site.plan.width + 0.5, element.kind
        assert upper[1] < site.plan.depth + 0.5, element.kind
        if element.kind not in hanging | in_walls | {"floor_slab"}:
            assert -0.03 < lower[2] < 0.001, element.kind  # the feet of tilted legs dip in


def test_clutter_stays_clear_of_doors(site):
    fixed = {"floor_slab", "ceiling_slab", "column", "beam", "core_wall", "stairs", "facade"}
    built = {"window_frame", "track", "stud", "board", "door_frame", "door", "prop"}
    overhead = {"duct", "pipe", "cable_tray", "dropped_ceiling"}
    for partition in site.plan.partitions:
        for door in partition.doors:
            middle = partition.pose @ [(door.start + door.end) / 2, 0.0, 0.0, 1.0]
            for element in site.elements:
                if element.kind not in fixed | built | overhead:
                    distance = np.linalg.norm(element.mesh.vertices[:, :2] - middle[:2], axis=1)
                    assert distance.min() > 0.8, element.kind


def test_same_seed_same_site_and_other_seed_other_site():
    one, same, other = (build_floor("1", SiteConfig(), seed).stage_mesh(2) for seed in (4, 4, 5))
    assert np.array_equal(one.mesh.vertices, same.mesh.vertices)
    assert np.array_equal(one.elements, same.elements)
    assert one.mesh.vertices.shape != other.mesh.vertices.shape


@pytest.mark.parametrize("stages", [1, 2])
def test_fewer_stages_have_only_their_elements(stages):
    site = build_floor("1", SiteConfig(stages=stages), 0)
    assert {stage for e in site.elements for stage in e.stages} == set(range(1, stages + 1))
    with pytest.raises(InputError, match=f"1 to {stages}"):
        site.stage_mesh(stages + 1)


@pytest.mark.parametrize(("width", "depth"), [(14, 11), (26, 20)])
def test_small_and_large_floors_can_be_built(width, depth):
    site = build_floor("1", SiteConfig(width=width, depth=depth), 1)
    assert len(site.stage_mesh(3).mesh.triangles) > 1000

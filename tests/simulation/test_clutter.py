import numpy as np
import pytest

from nss_ros.config import ViewpointConfig
from nss_ros.simulation.clutter import clutter
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import box, boxes, merge
from nss_ros.simulation.occupancy import occupancy_map
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle, Site

ALWAYS = frozenset({1, 2, 3})
WALLS = boxes(
    [(0, 0, 0), (0, 13.8, 0), (0, 0, 0), (19.8, 0, 0), (9.9, 0, 0), (9.9, 7.5, 0)],
    [(20, 0.2, 3), (20, 14, 3), (0.2, 14, 3), (20, 14, 3), (10.1, 6.5, 3), (10.1, 14, 3)],
)


def make_site(area="1"):
    """Two rooms with a door between them, and a partition that comes at stage 2."""
    return Site(
        area,
        3,
        (
            Element("slab", ALWAYS, box((0, 0, -0.2), (20, 14, 0))),
            Element("slab", ALWAYS, box((0, 0, 2.8), (20, 14, 3))),
            Element("wall", ALWAYS, WALLS),
            Element("partition", frozenset({2, 3}), box((4, 3, 0), (4.1, 11, 2.6))),
            Element("IfcDoor", frozenset({3}), box((9.95, 6.5, 0), (10, 7.5, 2.1))),
        ),
        Rectangle(0, 0, 20, 14),
    )


def bounds(element):
    return element.mesh.vertices.min(axis=0), element.mesh.vertices.max(axis=0)


@pytest.fixture(scope="module")
def things():
    return clutter(make_site(), 2.0, 5)


def test_things_come_and_go(things):
    assert len(things) > 30
    assert len({thing.kind for thing in things}) > 8
    stages = {tuple(sorted(thing.stages)) for thing in things}
    assert {(1,), (2,), (3,)} <= stages
    assert any(len(each) == 2 for each in stages)  # some stay for the next stage
    for thing in things:
        low, high = bounds(thing)
        assert low[2] == pytest.approx(0.0, abs=0.05)
        assert high[2] < 2.8


def test_nothing_stands_in_a_wall_or_in_another_thing(things):
    """Rays along the edges of the things' triangles meet no other element."""
    site = make_site()
    whole = [*site.elements, *things]
    for stage in (1, 2, 3):
        here = [thing for thing in things if stage in thing.stages]
        for thing in here:
            others = [e.mesh for e in whole if e is not thing and stage in e.stages]
            corners = thing.mesh.vertices[thing.mesh.triangles]
            lifted = corners + np.array([0, 0, 0.01])
            starts = lifted.reshape(-1, 3)
            spans = (np.roll(lifted, -1, axis=1) - lifted).reshape(-1, 3)
            long = np.linalg.norm(spans, axis=1) > 1e-6
            hits = Scene(merge(others)).cast(starts[long], spans[long])
            assert (hits.distances > 1.0).all(), (stage, thing.name)


def test_doors_and_ways_stay_free(things):
    site = make_site()
    for thing in things:
        low, high = bounds(thing)
        beyond = np.maximum(np.maximum(low[:2] - (10, 7.5), (9.95, 6.5) - high[:2]), 0)
        if 3 in thing.stages:
            assert np.linalg.norm(beyond) > 0.7, thing.name
    config = ViewpointConfig()
    for stage in (1, 2, 3):
        present = [e.mesh for e in (*site.elements, *things) if stage in e.stages]
        scene = Scene(merge(present))
        doors = np.zeros(len(scene.mesh.triangles), dtype=bool)
        if stage == 3:  # the door is open
            scene = Scene(merge([mesh for mesh in present if mesh is not site.elements[4].mesh]))
            doors = doors[: len(scene.mesh.triangles)]
        mapped = occupancy_map(scene, doors, site.extent, 0.0, config)
        sizes = [np.count_nonzero(region) * 0.01 for region in mapped.regions(config.passage)]
        assert sizes[0] > 100
        assert sum(sizes[1:]) < 8


def test_same_seed_same_things():
    one, again, other = (clutter(make_site(), 1.0, seed) for seed in (1, 1, 2))
    assert [thing.name for thing in one] == [thing.name for thing in again]
    for a, b in zip(one, again, strict=True):
        assert np.array_equal(a.mesh.vertices, b.mesh.vertices)
        assert a.stages == b.stages
    assert [thing.name for thing in one] != [thing.name for thing in other]
    elsewhere = clutter(make_site("2"), 1.0, 1)
    assert [thing.name for thing in one] != [thing.name for thing in elsewhere]


def test_the_amount_counts_and_a_site_without_floor_gets_none(things):
    assert len(clutter(make_site(), 0.5, 5)) < 0.5 * len(things)
    wall = Site("1", 1, (Element("wall", frozenset({1}), WALLS),), Rectangle(0, 0, 20, 14))
    assert clutter(wall, 3.0, 0) == []

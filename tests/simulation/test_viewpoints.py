import numpy as np
import pytest

from nss_ros.config import ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.simulation.mesh import box, merge
from nss_ros.simulation.occupancy import occupancy_map
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle
from nss_ros.simulation.viewpoints import choose_viewpoints, unreached_floor

AREA = Rectangle(0.0, 0.0, 8.0, 6.0)
FLOOR = box((-1, -1, -0.2), (9, 7, 0.0))
CONFIG = ViewpointConfig(spots_per_stage=6, min_spacing=1.5, least_gain=0.1)


def occupancy(*meshes, area=AREA, config=CONFIG):
    scene = Scene(merge([FLOOR, *meshes]))
    of_door = np.zeros(len(scene.mesh.triangles), dtype=bool)
    return occupancy_map(scene, of_door, area, 0.0, config)


def at(array, x, y):
    return array[int(x / 0.1), int(y / 0.1)]


def test_only_what_stands_between_the_heights_is_occupied():
    mapped = occupancy(
        box((1.0, 1.0, 0.0), (2.0, 2.0, 1.2)),  # a stack
        box((3.0, 1.0, 2.3), (4.0, 2.0, 2.6)),  # a duct overhead
        box((5.0, 1.0, 0.0), (6.0, 2.0, 0.3)),  # a pallet
    )
    assert mapped.occupied.shape == (80, 60)
    assert at(mapped.occupied, 1.05, 1.5)
    assert not at(mapped.occupied, 3.5, 1.5)
    assert not at(mapped.occupied, 5.5, 1.5)
    assert at(mapped.surface, 3.5, 1.5) == pytest.approx(0.0, abs=1e-5)
    assert at(mapped.surface, 5.5, 1.5) == pytest.approx(0.3, abs=1e-5)
    assert at(mapped.standable(), 3.5, 1.5)
    assert not at(mapped.standable(), 1.5, 1.5)
    assert not at(mapped.standable(), 5.05, 1.5)  # the edge of the pallet


def test_a_thin_post_is_not_missed():
    mapped = occupancy(box((4.02, 3.02, 0.0), (4.04, 3.04, 3.0)))
    assert at(mapped.occupied, 4.03, 3.03)


def test_a_hole_in_the_floor_is_not_floor():
    area = Rectangle(7.0, 0.0, 11.0, 6.0)
    mapped = occupancy(area=area)
    assert np.isfinite(mapped.surface[10, 10])
    assert np.isnan(mapped.surface[30, 10])


def test_spots_keep_their_distances():
    mapped = occupancy(box((3.9, 0.0, 0.0), (4.0, 4.0, 3.0)))
    for seed in range(4):
        spots = choose_viewpoints(mapped, CONFIG, 4.5, np.random.default_rng(seed))
        assert 3 <= len(spots) <= 6
        assert np.allclose(spots[:, 2], 0, atol=1e-5)
        clearance = mapped.clearance()[tuple(mapped.cells_at(spots[:, :2]).T)]
        assert clearance.min() >= CONFIG.min_clearance
        for index in range(1, len(spots)):
            distances = np.linalg.norm(spots[:index, :2] - spots[index, :2], axis=1)
            assert distances.min() >= CONFIG.min_spacing
            assert distances.min() <= CONFIG.max_spacing


def test_the_first_spot_is_near_the_start_also_in_a_smaller_region():
    wall = box((5.0, -1.0, 0.0), (5.1, 7.0, 3.0))
    config = CONFIG.model_copy(update={"min_region": 0.1, "max_spacing": 1.2, "min_spacing": 0.8})
    mapped = occupancy(wall, config=config)
    for seed in range(4):
        for start in ((7.5, 1.0), (0.5, 5.5), (6.0, -40.0)):
            rng = np.random.default_rng(seed)
            spots = choose_viewpoints(mapped, config, 4.5, rng, start)
            assert (spots[0, 0] > 5) == (start[0] > 5)
            nearest = np.hypot(*(np.clip(start, 0.6, (7.4, 5.4)) - spots[0, :2]))
            assert nearest < 3 * config.max_spacing + 0.5


def test_spots_are_added_until_all_is_seen():
    area = Rectangle(0.0, 0.0, 30.0, 6.0)
    floor = box((-1, -1, -0.2), (31, 7, 0.0))
    scene = Scene(floor)
    of_door = np.zeros(len(floor.triangles), dtype=bool)
    config = ViewpointConfig()
    mapped = occupancy_map(scene, of_door, area, 0.0, config)
    spots = choose_viewpoints(mapped, config, 4.5, np.random.default_rng(0))
    cells = mapped.centres(np.argwhere(mapped.standable()))
    nearest = np.linalg.norm(cells[:, None] - spots[None, :, :2], axis=2).min(axis=1)
    assert (nearest <= 4.5).mean() > 0.99
    assert 4 <= len(spots) <= 30


def test_a_door_is_an_obstacle_that_one_can_pass():
    wall = [
        box((3.9, -1.0, 0.0), (4.0, 2.5, 3.0)),
        box((3.9, 3.5, 0.0), (4.0, 7.0, 3.0)),
    ]
    door = box((3.92, 2.5, 0.0), (3.96, 3.5, 2.1))
    scene = Scene(merge([FLOOR, *wall, door]))
    of_door = np.zeros(len(scene.mesh.triangles), dtype=bool)
    config = ViewpointConfig(least_gain=0.1)
    closed = occupancy_map(scene, of_door, AREA, 0.0, config)
    of_door[-len(door.triangles) :] = True
    opening = occupancy_map(scene, of_door, AREA, 0.0, config)
    assert len(opening.reachable(config.passage, 1.0)[0].nonzero()[0]) > 1.5 * len(
        closed.reachable(config.passage, 1.0)[0].nonzero()[0]
    )
    assert np.array_equal(opening.occupied, closed.occupied)


def test_a_closed_room_holds_no_spots_of_another():
    wall = box((2.9, -1.0, 0.0), (3.0, 7.0, 3.0))
    mapped = occupancy(wall)
    config = CONFIG.model_copy(update={"spots_per_stage": 0})
    spots = choose_viewpoints(mapped, config, 4.5, np.random.default_rng(0))
    assert (spots[:, 0] > 3.0).all()
    assert len(spots) >= 2


def test_floor_that_is_cut_off_is_told():
    wall = box((2.9, -1.0, 0.0), (3.0, 7.0, 3.0))
    cut = occupancy(wall)
    (size,) = unreached_floor(cut, CONFIG)
    assert 12.0 < size < 2.9 * 6.0  # less what is too near the wall
    assert unreached_floor(cut, CONFIG.model_copy(update={"min_region": 0.3})) == []
    assert unreached_floor(occupancy(), CONFIG) == []
    closet = [box((0, 1.5, 0), (1.6, 1.6, 3)), box((1.5, 0, 0), (1.6, 1.6, 3))]
    assert unreached_floor(occupancy(*closet), CONFIG) == []  # too small to be told


def test_a_floor_without_room_to_stand_is_refused():
    full = occupancy(box((0.0, 0.0, 0.0), (8.0, 6.0, 1.0)))
    with pytest.raises(InputError, match="min_clearance"):
        choose_viewpoints(full, CONFIG, 4.5, np.random.default_rng(0))

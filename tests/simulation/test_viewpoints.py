import numpy as np
import pytest

from nss_ros.config import ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.simulation.mesh import box, merge
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Rectangle
from nss_ros.simulation.viewpoints import choose_viewpoints, in_sight, occupancy_map

AREA = Rectangle(0.0, 0.0, 8.0, 6.0)
FLOOR = box((-1, -1, -0.2), (9, 7, 0.0))
CONFIG = ViewpointConfig(spots_per_stage=6)


def occupancy(*meshes, area=AREA, config=CONFIG):
    return occupancy_map(Scene(merge([FLOOR, *meshes])), area, config)


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
    assert at(mapped.floor, 3.5, 1.5)
    assert not at(mapped.floor, 5.5, 1.5)


def test_a_thin_post_is_not_missed():
    mapped = occupancy(box((4.02, 3.02, 0.0), (4.04, 3.04, 3.0)))
    assert at(mapped.occupied, 4.03, 3.03)


def test_a_hole_in_the_floor_is_not_floor():
    area = Rectangle(7.0, 0.0, 11.0, 6.0)
    mapped = occupancy(area=area)
    assert mapped.floor[10, 10]
    assert not mapped.floor[30, 10]


def test_spots_keep_their_distances_and_see_an_earlier_one():
    wall = box((3.9, 0.0, 0.0), (4.0, 4.0, 3.0))
    mapped = occupancy(wall)
    for seed in range(4):
        spots = choose_viewpoints(mapped, CONFIG, 4.5, np.random.default_rng(seed))
        assert len(spots) == 6
        clearance = mapped.clearance()[tuple(mapped.cells_at(spots).T)]
        assert clearance.min() >= CONFIG.min_clearance
        for index in range(1, len(spots)):
            distances = np.linalg.norm(spots[:index] - spots[index], axis=1)
            assert distances.min() >= CONFIG.min_spacing
            assert any(
                distance <= CONFIG.max_spacing and in_sight(mapped, spots[index], earlier)
                for distance, earlier in zip(distances, spots[:index], strict=True)
            )


def test_a_closed_room_holds_no_spots_of_another():
    wall = box((2.9, -1.0, 0.0), (3.0, 7.0, 3.0))
    mapped = occupancy(wall)
    config = CONFIG.model_copy(update={"spots_per_stage": 30})
    spots = choose_viewpoints(mapped, config, 4.5, np.random.default_rng(0))
    assert (spots[:, 0] > 3.0).all()
    assert 3 <= len(spots) < 30


def test_walls_block_sight():
    mapped = occupancy(box((3.9, 0.0, 0.0), (4.0, 4.0, 3.0)))
    assert not in_sight(mapped, np.array([3.0, 2.0]), np.array([5.0, 2.0]))
    assert in_sight(mapped, np.array([3.0, 5.0]), np.array([5.0, 5.0]))


def test_a_floor_without_room_to_stand_is_refused():
    full = occupancy(box((0.0, 0.0, 0.0), (8.0, 6.0, 1.0)))
    with pytest.raises(InputError, match="min_clearance"):
        choose_viewpoints(full, CONFIG, 4.5, np.random.default_rng(0))

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from nss_ros.config import SiteConfig
from nss_ros.errors import InputError
from nss_ros.simulation.mesh import box
from nss_ros.simulation.procedural.grid import draw_grid


def grid(**settings):
    return draw_grid(SiteConfig(**settings), np.random.default_rng(0))


def test_a_straight_wing_is_mapped_as_it_is():
    straight = grid(width=30, depth=15)
    xy = np.random.default_rng(1).uniform((-1, -1), (31, 16), (50, 2))
    assert np.allclose(straight.places(xy), xy)
    assert straight.length == pytest.approx(30)
    assert np.allclose(straight.frame(4.0, 3.0)[:3, 3], (4, 3, 0))
    assert np.allclose(straight.frame(4.0, 3.0)[:3, :3], np.eye(3))


@given(st.floats(14, 120))
def test_bays_of_a_wing_are_alike_and_five_to_nine_metres(width):
    lengths = np.diff(grid(width=width, depth=14).stations)
    assert np.allclose(lengths, lengths[0])
    assert lengths.sum() == pytest.approx(width)
    assert 5 <= lengths[0] <= 9


@given(st.floats(-90, 90).filter(lambda a: abs(a) > 1), st.floats(12, 20))
def test_a_corner_turns_by_its_angle_and_keeps_the_wings_rigid(turn, depth):
    angled = grid(width=30, depth=depth, wings=[{"length": 25, "turn": turn}])
    assert angled.corners
    bays = set(range(angled.bays)) - angled.corners
    for bay in bays:
        assert angled.length_at(bay, 0.0) == pytest.approx(angled.length_at(bay, depth))
    for bay in angled.corners:  # left turns meet at the far end, right turns at the near one
        inner = depth if turn > 0 else 0.0
        assert angled.length_at(bay, inner) == pytest.approx(0.0, abs=1e-9)
        assert 0 < angled.length_at(bay, depth - inner) <= 12
    last = angled.near[-1] - angled.near[-2]
    assert math.degrees(math.atan2(last[1], last[0])) == pytest.approx(turn)
    assert np.allclose(np.linalg.norm(angled.far - angled.near, axis=1), depth)
    assert next(iter(angled.runs()))[0] == 0
    assert len(list(angled.runs())) == 2


def test_a_curved_wing_is_wider_outside_and_has_its_length_in_the_middle():
    curved = grid(width=14, depth=14, wings=[{"length": 60, "arc": 90}])
    assert not curved.corners
    bent = [b for b in range(curved.bays) if curved.length_at(b, 0) > curved.length_at(b, 14) + 0.1]
    assert len(bent) == curved.bays - 2  # all but the two of the straight wing
    assert sum(curved.length_at(b, 7.0) for b in bent) == pytest.approx(60)
    radius = 60 / math.radians(90)
    ratio = curved.length_at(bent[0], 0.0) / curved.length_at(bent[0], 14.0)
    assert ratio == pytest.approx((radius + 7) / (radius - 7), rel=0.01)


def test_lines_stay_straight_and_neighbouring_bays_meet():
    curved = grid(width=14, depth=14, wings=[{"length": 40, "arc": -40}])
    for station in curved.stations[1:-1]:
        y = np.linspace(0.0, 14.0, 7)
        before, after = (
            curved.places(np.column_stack((np.full(7, station + step), y))) for step in (-1e-9, 0)
        )
        assert np.allclose(before, after, atol=1e-6)
    ends = curved.stations[3:5]
    line = curved.places(np.column_stack((np.linspace(*ends, 9), np.full(9, 5.0))))
    steps = np.diff(line, axis=0)
    assert np.allclose(steps, steps[0])


def test_a_thing_keeps_its_shape_and_what_is_built_does_not():
    curved = grid(width=14, depth=14, wings=[{"length": 40, "arc": 60}])
    pose = curved.frame(30.0, 3.0)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.allclose(pose[:2, 3], curved.places(np.array([[30.0, 3.0]]))[0])
    wall = box((28.0, 0.0, 0.0), (32.0, 0.2, 3.0))
    built = curved.built(wall)
    assert np.array_equal(built.vertices[:, 2], wall.vertices[:, 2])
    assert np.linalg.norm(built.vertices[1] - built.vertices[0]) > 4.2


def test_wings_that_run_into_one_another_are_refused():
    with pytest.raises(InputError, match="run into one another"):
        grid(width=30, depth=12, wings=[{"length": 14, "turn": 120}, {"length": 60, "turn": 120}])


def test_a_wing_bent_too_much_is_refused():
    with pytest.raises(ValidationError, match="cannot bend by an arc of 90"):
        SiteConfig(depth=20, wings=[{"length": 20, "arc": 90}])

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import SiteConfig
from nss_ros.simulation.procedural.programme import (
    CLOSED,
    FURNITURE,
    STUDS,
    Programme,
    draw_programme,
    stage_names,
)

ZONES = np.linspace(-1, 1, 9)


def draw(seed=0, **settings):
    return draw_programme(SiteConfig(**settings), ZONES, np.random.default_rng(seed))


@given(st.integers(1, 6), st.booleans(), st.floats(0, 3), st.floats(0.1, 2), st.integers(0, 99))
def test_works_never_go_back(stages, renovation, stagger, pace, seed):
    programme = draw(seed, stages=stages, renovation=renovation, stagger=stagger, pace=pace)
    assert programme.times.shape == (9, stages)
    assert (np.diff(programme.times, axis=1) >= 0).all()
    for zone in range(9):
        studs, closed = programme.during(zone, STUDS), programme.during(zone, CLOSED)
        assert closed <= studs <= programme.always
        assert studs == frozenset(range(stages + 1 - len(studs), stages + 1))


def test_three_stages_go_from_the_shell_to_the_fit_out():
    assert stage_names(SiteConfig()) == ("shell", "boarding", "fit-out")
    assert stage_names(SiteConfig(stages=6, renovation=True))[:2] == ("in use", "strip-out")


def test_stagger_is_how_far_zones_are_out_of_step():
    assert np.ptp(draw(stagger=0).times, axis=0) == pytest.approx(0)
    assert np.ptp(draw(stagger=1).times, axis=0).min() > 0.5


def test_pace_is_the_work_between_stages():
    slow, usual = (np.diff(draw(stagger=0, pace=pace).times[0]) for pace in (0.5, 1.0))
    assert (slow < usual).all()


def test_the_former_layout_goes_in_reverse():
    programme = Programme(np.array([[-3.0, -2.0, -1.0, 1.0, 9.0]]), former=True)
    assert programme.during(0, FURNITURE) == {1}
    assert programme.during(0, CLOSED) == {1, 2}
    assert programme.during(0, STUDS) == {1, 2, 3}


def test_what_is_taken_away_is_there_only_until_then():
    programme = Programme(np.array([[0.5, 2.0, 5.0]]))
    assert programme.during(0, 1.0, 4.0) == {2}
    assert programme.during(0, -np.inf, 1.0) == {1}
    assert programme.during(0, 6.0) == frozenset()

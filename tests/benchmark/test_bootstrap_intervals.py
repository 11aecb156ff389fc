import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.benchmark.bootstrap import Bootstrap, interval, p_value, resamplings


def drawn(count, bootstrap, members=None):
    return np.concatenate(list(resamplings(count, bootstrap, members)))


@given(st.integers(1, 40), st.integers(1, 60), st.integers(0, 99))
def test_every_resampling_draws_as_many_units_as_there_are(count, number, seed):
    weights = drawn(count, Bootstrap(number, seed))
    assert weights.shape == (number, count)
    assert (weights.sum(axis=1) == count).all()
    assert (weights == drawn(count, Bootstrap(number, seed))).all()


def test_blocks_do_not_change_the_draws(monkeypatch):
    whole = drawn(7, Bootstrap(20))
    monkeypatch.setattr("nss_ros.benchmark.bootstrap._BLOCK", 21)
    assert (drawn(7, Bootstrap(20)) == whole).all()


def test_by_fragment_a_pair_needs_both_of_its_fragments():
    members = np.array([[0, 1], [1, 2], [0, 2]])
    weights = drawn(3, Bootstrap(200, by_fragment=True), members)
    # Times (a, b, c) that three fragments are drawn give a b, b c and a c.
    possible = {(a * b, b * c, a * c) for a in range(4) for b in range(4 - a) for c in [3 - a - b]}
    assert {tuple(row) for row in weights.astype(int)} == possible
    assert (drawn(3, Bootstrap(200), members).sum(axis=1) == 3).all()


def test_intervals_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    covered = 0
    for seed in range(200):
        sample = rng.normal(size=60)
        means = drawn(60, Bootstrap(300, seed)) @ sample / 60
        low, high = interval(means, 0.9, 60)
        covered += low <= 0 <= high
    assert 0.82 <= covered / 200 <= 0.97


def test_pairs_that_share_fragments_make_wider_intervals_by_fragment():
    rng = np.random.default_rng(1)
    first, second = np.triu_indices(12, 1)
    effect = rng.normal(size=12)
    values = effect[first] + effect[second]
    members = np.column_stack((first, second))
    widths = []
    for by_fragment in (False, True):
        weights = drawn(len(values), Bootstrap(500, by_fragment=by_fragment), members)
        low, high = interval(weights @ values / weights.sum(axis=1), 0.95, len(values))
        widths.append(high - low)
    assert widths[1] > 1.5 * widths[0]


def test_what_tells_nothing_has_no_interval():
    assert np.isnan(interval(np.ones(9), 0.95, 1)).all()
    assert np.isnan(interval(np.full(9, np.nan), 0.95, 9)).all()
    assert interval(np.array([1, np.nan, 1]), 0.95, 9) == (1, 1)
    assert np.isnan(p_value(np.array([np.nan])))


@given(st.lists(st.floats(-9, 9), min_size=1, max_size=50))
def test_p_values_are_two_sided(differences):
    values = np.array(differences)
    assert 0 < p_value(values) <= 1
    assert p_value(values) == p_value(-values)


def test_known_p_values():
    assert p_value(np.zeros(99)) == 1
    assert p_value(np.ones(99)) == pytest.approx(2 / 100)
    assert p_value(np.array([-1.0] * 4 + [1.0] * 95)) == pytest.approx(10 / 100)

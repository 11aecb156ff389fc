import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.registration.matching import mutual_matches


def brute_force(source, target):
    distances = ((source[:, None].astype(int) - target[None].astype(int)) ** 2).sum(axis=2)
    forward, backward = distances.argmin(axis=1), distances.argmin(axis=0)
    kept = [i for i in range(len(source)) if backward[forward[i]] == i]
    return kept, forward[kept].tolist()


@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 10_000))
def test_matches_are_those_of_an_exhaustive_search_with_ties(n, m, seed):
    random = np.random.default_rng(seed)
    source = random.integers(0, 4, (n, 5)).astype(np.float32)
    target = random.integers(0, 4, (m, 5)).astype(np.float32)
    first, second = mutual_matches(source, target)
    assert (first.tolist(), second.tolist()) == brute_force(source, target)


def test_chunks_make_no_difference():
    random = np.random.default_rng(0)
    source = random.integers(0, 1600, (3000, 33)).astype(np.float32)
    shuffled = random.permutation(3000)
    first, second = mutual_matches(source, source[shuffled])
    assert np.array_equal(first, np.arange(3000))
    assert np.array_equal(shuffled[second], first)


def test_nothing_matches_nothing():
    empty, some = np.zeros((0, 33), np.float32), np.ones((3, 33), np.float32)
    for source, target in ((empty, some), (some, empty), (empty, empty)):
        first, second = mutual_matches(source, target)
        assert len(first) == len(second) == 0

"""Ambiguous pairs: which hypothesis the rest of the graph supports."""

from itertools import pairwise

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative, rotation_angle
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.hypotheses import chosen_hypotheses
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.multiway.spanning_tree import Closeness

CLOSE = Closeness(0.4, np.radians(6))
INFORMATION = np.diag([1 / 0.02**2] * 3 + [1 / 0.01**2] * 3)


@pytest.fixture
def poses():
    random = np.random.default_rng(4)
    return {
        FragmentId("1", number % 2 + 1, number): from_yaw(
            random.uniform(-3, 3), (*random.uniform(-8, 8, 2), 0)
        )
        for number in range(14)
    }


def random_pose(random):
    return from_yaw(random.uniform(-3, 3), (*random.uniform(-4, 4, 2), 0))


def ambiguous(poses, wrong, seed):
    """Measurements to the next five fragments; most probable first, and most of these wrong."""
    random = np.random.default_rng(seed)
    ids = sorted(poses)
    result = []
    for first, source in enumerate(ids):
        for target in ids[first + 1 : first + 6]:
            truth = relative(poses[source], poses[target])
            hypotheses = [random_pose(random) for _ in range(3)]
            hypotheses.insert(1 + int(random.integers(3)) if random.random() < wrong else 0, truth)
            probabilities = np.sort(random.dirichlet(np.ones(4)))[::-1]
            best, *others = zip(hypotheses, probabilities, strict=True)
            result.append(
                Measurement(
                    FragmentPair(source, target),
                    best[0],
                    INFORMATION,
                    confidence=float(best[1]),
                    inliers=1000,
                    level=True,
                    alternatives=tuple(
                        Alternative(pose, INFORMATION, float(p)) for pose, p in others
                    ),
                )
            )
    return result


def is_true(m, poses):
    truth = relative(poses[m.pair.source], poses[m.pair.target])
    return np.allclose(m.T_target_source, truth, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_hypotheses_on_which_the_graph_agrees_are_chosen(poses, seed):
    measurements = ambiguous(poses, 0.6, seed)
    assert np.mean([is_true(m, poses) for m in measurements]) < 0.6
    chosen = chosen_hypotheses(measurements, CLOSE)
    assert [m.pair for m in chosen] == [m.pair for m in measurements]
    assert np.mean([is_true(m, poses) for m in chosen]) > 0.95
    assert not any(m.alternatives for m in chosen)


@pytest.mark.parametrize("seed", range(5))
def test_a_map_of_ambiguous_pairs_is_right(poses, seed):
    measurements = ambiguous(poses, 0.6, seed)
    graph = Choi(MultiwayConfig()).synchronize(sorted(poses), measurements)
    placed = graph.poses()
    assert len(placed) == len(poses)
    ids = sorted(poses)
    for one, other in pairwise(ids):
        estimate = relative(placed[one].T_map_fragment, placed[other].T_map_fragment)
        error = relative(estimate, relative(poses[one], poses[other]))
        assert np.linalg.norm(error[:3, 3]) < 0.05
        assert rotation_angle(error) < 0.02
    assert len(graph.edges) == len(measurements)


def test_pairs_that_nothing_confirms_keep_the_most_probable(poses):
    measurements = ambiguous(poses, 1.0, 0)[:1]
    (chosen,) = chosen_hypotheses(measurements, CLOSE)
    assert np.array_equal(chosen.T_target_source, measurements[0].T_target_source)
    assert chosen.confidence == measurements[0].confidence


def test_measurements_without_alternatives_stay_as_they_are(poses):
    measurements = chosen_hypotheses(ambiguous(poses, 0.5, 1), CLOSE)
    assert chosen_hypotheses(measurements, CLOSE) == measurements


def test_the_order_of_measurements_does_not_matter(poses):
    measurements = ambiguous(poses, 0.6, 2)
    forth = chosen_hypotheses(measurements, CLOSE)
    back = chosen_hypotheses(measurements[::-1], CLOSE)[::-1]
    for one, other in zip(forth, back, strict=True):
        assert np.array_equal(one.T_target_source, other.T_target_source)

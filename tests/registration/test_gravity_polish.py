"""Hypotheses moved nearby, to where walls lie on each other best."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import read_log
from nss_ros.config import RegistrationConfig
from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw, relative, rotation_angle
from nss_ros.icp import Refined
from nss_ros.registration.gravity.polish import polished
from nss_ros.registration.gravity.refinement import Shape, finely
from nss_ros.registration.gravity.scan import scan_of
from nss_ros.registration.method import load_method

CONFIG = RegistrationConfig(method="gravity")
BAG = Path(__file__).parents[2] / "bags" / "three_stages"


@pytest.fixture(scope="module")
def shapes(scans):
    return [Shape.of(scan_of(each, CONFIG), CONFIG) for each in scans]


def at(transform):
    """A hypothesis at a transform."""
    return Refined(transform, np.eye(6), 1, 0.1, converged=False)


def distance(one, other):
    difference = relative(one, other)
    return np.linalg.norm(difference[:3, 3]), np.degrees(rotation_angle(difference))


def nothing_learned(transforms):
    return np.zeros(len(transforms))


@pytest.mark.parametrize(("yaw", "x", "y"), [(4, 0.25, 0), (-3, 0, -0.3), (0, 0.2, 0.2)])
def test_what_is_beside_the_truth_is_put_right(shapes, yaw, x, y):
    beside = at(from_yaw(np.radians(yaw), (x, y, 0.0)))
    found = polished(*shapes, beside, nothing_learned, CONFIG)
    metres, degrees = distance(found.T_target_source, np.eye(4))
    assert metres < 0.03
    assert degrees < 0.5


def test_what_is_right_stays(shapes):
    right = finely(shapes[0].moderate, shapes[1].surface, np.eye(4), CONFIG)
    found = polished(*shapes, right, nothing_learned, CONFIG)
    metres, degrees = distance(found.T_target_source, right.T_target_source)
    assert metres < 0.02
    assert degrees < 0.3


def test_what_was_learned_has_a_say(shapes):
    beside = at(from_yaw(0.0, (0.25, 0.0, 0.0)))

    def sure(transforms):
        return 1000.0 * (np.abs(transforms[:, 0, 3] - 0.25) < 1e-9)

    assert polished(*shapes, beside, sure, CONFIG) is beside


def test_of_the_bundled_bag_pairs_that_were_beside_the_truth_are_right(monkeypatch):
    log = read_log(BAG)
    poses = {node.id: node.T_map_fragment for node in log.ground_truth[0].nodes}
    method = load_method(CONFIG)
    for first, second in (((1, 1), (1, 8)), ((1, 6), (2, 7))):
        source, target = (FragmentId("1", *each) for each in (first, second))
        features = [method.prepare(log.fragments[each]) for each in (source, target)]
        truth = relative(poses[source], poses[target])
        errors = []
        for likely in (1.0, 0.1):
            monkeypatch.setattr("nss_ros.registration.gravity.method._LIKELY", likely)
            answer = method.register(*features, 0)
            errors.append(distance(answer.T_target_source, truth)[0])
        assert errors[0] > 0.2 > errors[1]
        # What ends in one place is one hypothesis.
        listed = [answer.T_target_source, *(each.T_target_source for each in answer.alternatives)]
        for one, other in combinations(listed, 2):
            metres, degrees = distance(one, other)
            assert metres > 0.1 or degrees > 3
        total = answer.confidence + sum(each.probability for each in answer.alternatives)
        assert total <= 1 + 1e-6
        probabilities = [answer.confidence, *(each.probability for each in answer.alternatives)]
        assert probabilities == sorted(probabilities, reverse=True)

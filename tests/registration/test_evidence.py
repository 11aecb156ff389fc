"""How much speaks for pairs overlapping, on a part of the bundled bag."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch

from nss_ros.bag import read_log
from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, transform_points
from nss_ros.registration.gravity.coarse import coarse_scores
from nss_ros.registration.gravity.evidence import pair_evidence, sketch
from nss_ros.registration.gravity.scan import WIDE_SIZE

CONFIG = RegistrationConfig()
BAG = Path(__file__).parents[2] / "bags" / "three_stages"


def evidence(source, target):
    return pair_evidence([(source, target)])[FragmentPair(source.id, target.id)]


@pytest.fixture(scope="module")
def fragments():
    return [each for each in read_log(BAG).fragments.values() if each.id.spot <= 4][:6]


@pytest.fixture(scope="module")
def sketches(fragments):
    return [sketch(each, CONFIG) for each in fragments]


def turned(fragment, spot=50):
    """The same scan from the same place, by a tripod that looked elsewhere."""
    points = transform_points(from_yaw(1.1, (0, 0, 0)), fragment.points).astype(np.float32)
    id_ = FragmentId(fragment.id.area, fragment.id.stage, spot)
    return Fragment(id_, points, True)


def test_the_same_place_has_more_evidence_than_any_other(fragments, sketches):
    for fragment, own in zip(fragments, sketches, strict=True):
        again = sketch(turned(fragment), CONFIG)
        others = [
            evidence(each, again)
            for each in sketches
            if each.id.stage == own.id.stage and each is not own
        ]
        assert evidence(own, again) > max(others)


def test_the_evidence_of_pairs_is_that_of_each(sketches):
    every = list(combinations(sorted(sketches, key=lambda each: each.id), 2))
    found = pair_evidence(every)
    assert found == {FragmentPair(a.id, b.id): evidence(a, b) for a, b in every}


def test_the_evidence_is_the_sum_of_the_scores_of_all_poses(sketches):
    for source, target in [(sketches[0], sketches[1]), (sketches[0], sketches[-1])]:
        kind = int(source.id.stage == target.id.stage)
        scores = coarse_scores(
            *(torch.from_numpy(each.maps[kind].astype(np.float32)) for each in (source, target))
        ).flatten()
        expected = float(scores.logsumexp(dim=0)) - np.log(len(scores))
        assert evidence(source, target) == pytest.approx(expected, abs=1e-3)


def test_a_sketch_is_seen_from_the_standpoint_or_from_the_origin(fragments, sketches):
    lifted = Fragment(fragments[0].id, fragments[0].points + np.float32([0, 0, 1.6]), True)
    trusting = RegistrationConfig(find_standpoints=False)
    sensor, foot, origin = (
        each.maps.astype(np.float32)
        for each in (sketches[0], sketch(lifted, CONFIG), sketch(lifted, trusting))
    )
    assert np.abs(foot - sensor).mean() < 0.5 * np.abs(origin - sensor).mean()


@pytest.mark.parametrize(
    "change",
    [
        lambda f: Fragment(f.id, f.points, False),
        lambda f: Fragment(f.id, f.points[:20], True),
        lambda f: Fragment(f.id, f.points[:0], True),
    ],
    ids=["not levelled", "few points", "no points"],
)
def test_what_cannot_be_looked_at_has_no_sketch(fragments, change):
    assert sketch(change(fragments[0]), CONFIG) is None


def test_scans_that_reach_far_are_looked_at_on_wide_maps(fragments):
    rng = np.random.default_rng(0)
    far = Fragment(
        FragmentId("1", 1, 60), (fragments[0].points * np.float32((3, 3, 1))).repeat(2, 0), True
    )
    far.points[1::2] += rng.normal(0, 0.05, far.points[1::2].shape).astype(np.float32)
    own, again = sketch(far, CONFIG), sketch(turned(far, 61), CONFIG)
    assert own.maps.shape[-1] == WIDE_SIZE // 4
    others = [evidence(sketch(each, CONFIG), again) for each in fragments[1:]]
    assert evidence(own, again) > max(others)

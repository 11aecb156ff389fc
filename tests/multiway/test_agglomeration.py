"""Ambiguous pairs: which hypothesis the rest of the graph supports."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative, rotation_angle
from nss_ros.multiway.agglomeration import Ambiguous, Votes, joined_parts
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.hypotheses import fitting_hypothesis
from nss_ros.multiway.pose_graph import Alternative, EdgeStatus, Measurement
from nss_ros.multiway.spanning_tree import Closeness

CLOSE = Closeness(0.4, np.radians(6))
INFORMATION = np.diag([1 / 0.02**2] * 3 + [1 / 0.01**2] * 3)


@pytest.fixture(scope="module")
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


def ambiguous(poses, seed):
    """Measurements to the next five fragments with four hypotheses each, one of them right.

    The probabilities are what they say: a hypothesis is the right one as often as they tell.
    """
    random = np.random.default_rng(seed)
    ids = sorted(poses)
    result = []
    for first, source in enumerate(ids):
        for target in ids[first + 1 : first + 6]:
            probabilities = np.sort(random.dirichlet(np.ones(4)))[::-1]
            hypotheses = [random_pose(random) for _ in probabilities]
            right = int(random.choice(4, p=probabilities))
            hypotheses[right] = relative(poses[source], poses[target])
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


def measured(poses, pair, confidence):
    truth = relative(poses[pair[0]], poses[pair[1]])
    return Measurement(FragmentPair(*pair), truth, INFORMATION, confidence, 1000, level=True)


def is_true(m, poses):
    truth = relative(poses[m.pair.source], poses[m.pair.target])
    return np.allclose(m.T_target_source, truth, atol=1e-6)


def errors(poses, estimates):
    for one, other in pairwise(sorted(poses)):
        estimate = relative(estimates[one], estimates[other])
        error = relative(estimate, relative(poses[one], poses[other]))
        yield np.linalg.norm(error[:3, 3]), rotation_angle(error)


@pytest.mark.parametrize("seed", range(5))
def test_ambiguous_pairs_are_joined_to_one_part_that_is_right(poses, seed):
    measurements = ambiguous(poses, seed)
    most_probable = [is_true(m, poses) for m in measurements]
    assert np.mean(most_probable) < 0.7
    (part,) = joined_parts(poses, measurements, CLOSE)
    assert max(distance for distance, _ in errors(poses, part)) < 0.05
    assert max(angle for _, angle in errors(poses, part)) < 0.02


@pytest.mark.parametrize("seed", range(5))
def test_a_map_of_ambiguous_pairs_is_right(poses, seed):
    measurements = ambiguous(poses, seed)
    graph = Choi(MultiwayConfig()).synchronize(sorted(poses), measurements)
    placed = {id_: node.T_map_fragment for id_, node in graph.poses().items()}
    assert len(placed) == len(poses)
    assert max(distance for distance, _ in errors(poses, placed)) < 0.05
    assert len(graph.edges) == len(measurements)
    right = [is_true(edge, poses) for edge in graph.edges if edge.status is EdgeStatus.ACCEPTED]
    assert len(right) > 50
    assert all(right)


def test_parts_that_little_links_stay_apart(poses):
    doubtful = [replace(m, confidence=0.2, alternatives=()) for m in ambiguous(poses, 0)[:1]]
    settings = MultiwayConfig(bridge_confidence=0.5)
    for change, placed in (({}, 0), ({"confidence": 0.9}, 2), ({"manual": True}, 2)):
        changed = [replace(m, **change) for m in doubtful]
        graph = Choi(settings).synchronize(sorted(poses), changed)
        assert len(graph.poses()) == placed


def test_what_several_pairs_say_counts_for_more_than_one_that_is_sure(poses):
    source, target, *thirds = sorted(poses)[:6]
    links = [pair for third in thirds for pair in ((source, third), (third, target))]
    agreeing = [measured(poses, pair, 0.4) for pair in (*links, *pairwise(thirds))]
    lone = replace(measured(poses, (source, target), 0.9), T_target_source=from_yaw(1, (3, 1, 0)))
    (part, *_) = joined_parts(poses, [*agreeing, lone], CLOSE)
    assert len(part) == 6
    assert np.allclose(
        relative(part[source], part[target]), relative(poses[source], poses[target]), atol=1e-6
    )


def test_parts_that_are_known_stay_as_they_are(poses):
    ids = sorted(poses)
    elsewhere = from_yaw(0.7, (5, 2, 0))
    known = {id_: elsewhere @ poses[id_] for id_ in ids[:6]}
    # Within the part something else would be likelier.
    within = replace(measured(poses, ids[:2], 0.97), T_target_source=from_yaw(1, (3, 1, 0)))
    links = [measured(poses, pair, 0.6) for pair in pairwise(ids[5:])]
    (part,) = joined_parts(ids, [within, *links], CLOSE, known=[known])
    assert part.keys() == poses.keys()
    assert max(distance for distance, _ in errors(poses, part)) < 1e-6
    apart = joined_parts(ids, [within], CLOSE, known=[known])
    assert [len(each) for each in apart] == [6] + [1] * (len(ids) - 6)
    assert len(known) == 6


def test_parts_that_are_known_are_joined_by_several_pairs(poses):
    ids = sorted(poses)
    frames = [from_yaw(0.7, (5, 2, 0)), from_yaw(-1, (0, 9, 0))]
    known = [
        {id_: frame @ poses[id_] for id_ in half}
        for frame, half in zip(frames, (ids[:7], ids[7:]), strict=True)
    ]
    links = [measured(poses, pair, 0.5) for pair in ((ids[0], ids[8]), (ids[9], ids[3]))]
    wrong = replace(measured(poses, (ids[1], ids[7]), 0.7), T_target_source=np.eye(4))
    (part,) = joined_parts(ids, [wrong, *links], CLOSE, known=known)
    assert max(distance for distance, _ in errors(poses, part)) < 1e-6


def test_the_hypothesis_that_fits_is_taken(poses):
    m = next(m for m in ambiguous(poses, 0) if not is_true(m, poses))
    truth = relative(poses[m.pair.source], poses[m.pair.target])
    fitting = fitting_hypothesis(m, truth @ from_yaw(0.02, (0.05, 0, 0)), CLOSE)
    assert is_true(fitting, poses)
    assert fitting_hypothesis(m, from_yaw(0.3, (50, 0, 0)), CLOSE) is None


def test_the_order_of_measurements_does_not_matter(poses):
    measurements = ambiguous(poses, 2)
    forth = Choi(MultiwayConfig()).synchronize(sorted(poses), measurements)
    back = Choi(MultiwayConfig()).synchronize(sorted(poses)[::-1], measurements[::-1])
    for one, other in zip(forth.nodes, back.nodes, strict=True):
        assert np.array_equal(one.T_map_fragment, other.T_map_fragment)


def votes_of(poses, measurements):
    """The votes between the fragments of the first stage and those of the second."""
    one = {id_: pose for id_, pose in poses.items() if id_.stage == 1}
    other = {id_: pose for id_, pose in poses.items() if id_.stage == 2}
    between = [Ambiguous.of(m) for m in measurements if not m.pair.same_stage]
    return Votes.of(one, other, between), between


@given(st.integers(0, 1000))
def test_votes_put_every_hypothesis_into_the_frames_of_the_parts(poses, seed):
    measurements = ambiguous(poses, seed)
    votes, between = votes_of(poses, measurements)
    counts = [len(pair.probabilities) for pair in between]
    assert votes.starts.tolist() == np.cumsum([0, *counts[:-1]]).tolist()
    assert len(votes.transforms) == len(votes.weights) == sum(counts)
    assert np.allclose(votes.transforms @ votes.own, votes.poses)
    # The parts are in one frame, so a hypothesis that is right is the identity.
    right = [is_true_between(pair, number, poses) for pair in between for number in range(4)]
    assert np.allclose(votes.transforms[right], np.eye(4), atol=1e-6)


def is_true_between(pair, number, poses):
    truth = relative(poses[pair.source], poses[pair.target])
    return np.allclose(pair.transforms[number], truth, atol=1e-6)


@given(st.integers(0, 1000))
def test_the_truth_gets_the_most_votes(poses, seed):
    votes, between = votes_of(poses, ambiguous(poses, seed))
    agree = votes.agreement(np.array([np.eye(4), *votes.transforms]), CLOSE)
    scores = votes.scores(agree)
    assert scores[0] == pytest.approx(scores.max())
    # Each pair has one vote, or a doubt.
    assert agree[0].reshape(len(between), 4).any(axis=1).all()
    far = votes.agreement(from_yaw(0.0, (500, 0, 0))[None], CLOSE)
    assert not far.any()
    assert votes.scores(far)[0] == pytest.approx(votes.doubts.sum())


@given(st.integers(0, 1000))
def test_each_hypothesis_votes_for_itself(poses, seed):
    votes, _ = votes_of(poses, ambiguous(poses, seed))
    assert votes.agreement(votes.transforms, CLOSE).diagonal().all()
    likeliest = votes.likeliest(5)
    assert len(likeliest) == 5
    assert np.sort(votes.weights)[-5:].min() == votes.weights[likeliest].min()


def test_votes_do_not_depend_on_which_fragment_is_the_source(poses):
    measurements = ambiguous(poses, 3)
    votes, between = votes_of(poses, measurements)
    turned = [
        replace(
            pair,
            source=pair.target,
            target=pair.source,
            transforms=pair.inverses,
            inverses=pair.transforms,
        )
        for pair in between
    ]
    one = {id_: pose for id_, pose in poses.items() if id_.stage == 1}
    other = {id_: pose for id_, pose in poses.items() if id_.stage == 2}
    assert np.allclose(Votes.of(one, other, turned).transforms, votes.transforms)


def test_votes_tell_how_many_constraints_of_a_person_are_obeyed(poses):
    measurements = [m for m in ambiguous(poses, 1) if not m.pair.same_stage][:4]
    votes, _ = votes_of(poses, measurements)
    assert votes.obeyed(votes.agreement(np.eye(4)[None], CLOSE)).tolist() == [0]
    manual = [replace(m, manual=True, alternatives=()) for m in measurements[:2]]
    truth = relative(poses[manual[0].pair.source], poses[manual[0].pair.target])
    manual[0] = replace(manual[0], T_target_source=truth)
    manual[1] = replace(manual[1], T_target_source=from_yaw(2, (50, 0, 0)))
    votes, _ = votes_of(poses, [*manual, *measurements[2:]])
    candidates = np.array([np.eye(4), from_yaw(1, (90, 0, 0)), votes.transforms[1]])
    assert votes.obeyed(votes.agreement(candidates, CLOSE)).tolist() == [1, 0, 1]


def test_links_that_are_not_sure_enough_are_not_followed(poses):
    source, target = sorted(poses)[:2]
    link = [measured(poses, (source, target), 0.9)]
    sizes = [
        len(joined_parts([source, target], link, CLOSE, least_odds)[0])
        for least_odds in (-4.0, 2.0, 3.0)
    ]
    assert sizes == [2, 2, 1]


def test_a_link_is_looked_at_once_before_it_is_followed(poses):
    """What is seen there is taken from its odds; with what is left it waits for its turn."""
    first, second, third = sorted(poses)[:3]
    sure, less = (
        measured(poses, pair, p) for pair, p in (((first, second), 0.9), ((second, third), 0.5))
    )
    order = []

    def loss(one, other, transform):
        assert np.allclose(transform[3], (0, 0, 0, 1))
        order.append({*one, *other})
        return 3.0 if order[-1] == {first, second} else 0.0

    (part, *alone) = joined_parts([first, second, third], [sure, less], CLOSE, -4.0, loss=loss)
    assert part.keys() == {first, second, third}
    assert not alone
    # The surest is looked at first, then the other, which is now the surest; then what they make.
    assert order == [{first, second}, {second, third}, {first, second, third}]
    parts = joined_parts([first, second], [sure], CLOSE, 0.0, loss=loss)
    assert [len(part) for part in parts] == [1, 1]


def test_what_pairs_of_large_parts_say_together_has_a_limit(poses):
    """Where rooms are alike, they are wrong alike; the word of a person has none."""
    ids = sorted(poses)[:6]
    halves = [{id_: poses[id_] for id_ in some} for some in (ids[:3], ids[3:])]
    between = [measured(poses, (one, other), 0.9) for one in ids[:3] for other in ids[3:]]

    def sizes(measurements, known, loss):
        found = joined_parts(ids, measurements, CLOSE, 3.0, known, lambda *_: loss)
        return [len(part) for part in found]

    assert sizes(between, halves, 4.0) == [6]
    assert sizes(between, halves, 6.0) == [3, 3]
    constraint = replace(between[0], manual=True)
    assert sizes([constraint, *between[1:]], halves, 6.0) == [6]
    # One more fragment has nothing that could be wrong alike.
    alone = [m for m in between if m.pair.target == ids[3]]
    assert sizes(alone, [halves[0]], 6.0) == [4, 1, 1]

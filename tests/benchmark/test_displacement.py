import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nss_ros.benchmark.displacement import alignment, stage_displacements
from nss_ros.benchmark.evaluation import Placements
from nss_ros.fragment import FragmentId
from nss_ros.geometry import exponential, from_yaw

twists = arrays(np.float64, 6, elements=st.floats(-3, 3))


def placements(ids, poses, true_poses, graph=None, placed=None):
    count = len(ids)
    return Placements(
        ids=tuple(FragmentId("1", *each) for each in ids),
        graph=np.zeros(count, dtype=np.intp) if graph is None else np.array(graph),
        outlier=np.zeros(count, dtype=bool),
        placed=np.ones(count, dtype=bool) if placed is None else np.array(placed),
        T_true=np.stack(true_poses),
        T_map_fragment=np.stack(poses),
        points=np.ones(count),
        squares=np.zeros(count),
        official_squares=np.zeros(count),
    )


@given(twists, st.lists(twists, min_size=1, max_size=4))
def test_a_motion_of_all_is_found(motion, poses):
    true_poses = np.stack([exponential(each) for each in poses])
    moved = exponential(motion) @ true_poses
    assert alignment(moved, true_poses) @ moved == pytest.approx(true_poses, abs=1e-6)


@given(twists, st.floats(0, 2))
def test_a_shifted_stage_is_displaced_by_its_shift(motion, shift):
    ids = [(1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    truth = [from_yaw(i, (i, i % 2, 1.6)) for i in range(5)]
    step = np.eye(4)
    step[2, 3] = shift
    estimate = [step @ T if id_[0] == 2 else T for id_, T in zip(ids, truth, strict=True)]
    estimate = [exponential(motion) @ T for T in estimate]
    (result,) = stage_displacements(placements(ids, estimate, truth))
    assert (result.area, result.stage, result.other, result.fragments) == ("1", 1, 2, 3)
    assert result.median == pytest.approx(shift, abs=1e-6)
    assert result.largest == pytest.approx(shift, abs=1e-6)


def test_only_what_is_placed_in_one_graph_counts():
    ids = [(1, 0), (2, 0), (2, 1), (3, 0)]
    poses = [np.eye(4)] * 4
    known = placements(ids, poses, poses, graph=[0, 0, 0, 1], placed=[True, True, False, True])
    (result,) = stage_displacements(known)
    assert (result.stage, result.other, result.fragments) == (1, 2, 1)
    assert stage_displacements(placements(ids[:1], poses[:1], poses[:1])) == ()
    poses[0] = np.full((4, 4), np.nan)  # hidden
    assert stage_displacements(placements(ids[:2], [np.eye(4)] * 2, poses[:2])) == ()

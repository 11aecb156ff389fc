import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.errors import BagError, FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.multiway.map_file import load_map, save_map
from nss_ros.multiway.multi_stage_map import EXCLUDED, MultiStageMap, map_points
from nss_ros.multiway.pose_graph import EdgeKind, EdgeStatus
from nss_ros.multiway.solver import Problem, solve
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed


@pytest.fixture
def content(room) -> MultiStageMap:
    """The room's fragments with the true transform of every pair but one, which failed."""
    content = MultiStageMap(voxel_size=0.1)
    for fragment in room.fragments:
        content.add_fragment(fragment)
    for edge in room.ground_truth.edges[1:]:
        content.add_result(
            RelativeTransform(
                edge.pair, "m", edge.T_target_source, np.eye(6) * 1e-4, confidence=0.9, inliers=900
            )
        )
    content.add_result(failed(room.pairs[0], "m", Reason.TOO_FEW_INLIERS, "nothing fits"))
    return content


def solved(content: MultiStageMap):
    return solve(
        Problem(
            MultiwayConfig(),
            sorted(content.fragments),
            content.measurements(),
            content.unused_edges(),
        )
    )


def test_every_answer_becomes_an_edge(content, room):
    graph = solved(content)
    assert [edge.pair for edge in graph.edges] == sorted(room.pairs)
    lost = next(edge for edge in graph.edges if edge.pair == room.pairs[0])
    assert (lost.status, lost.reason) == (EdgeStatus.FAILED, "nothing fits")
    assert len(graph.poses()) == len(room.fragments)


def test_the_first_answer_and_the_first_fragment_count(content, room):
    version = content.version
    assert not content.add_fragment(room.fragments[0])
    assert not content.add_result(failed(room.pairs[1], "m", Reason.METHOD_ERROR, "late"))
    assert content.version == version
    assert content.results[room.pairs[1]].ok


def test_a_map_is_complete_when_every_pair_is_answered(room):
    content = MultiStageMap(voxel_size=0.1)
    assert content.complete
    version = content.version
    for pair in room.pairs[:3]:
        content.add_pair(pair)
        content.add_pair(pair)
    assert content.version == version
    for pair in room.pairs[:3]:
        assert not content.complete
        content.add_result(failed(pair, "m", Reason.TOO_FEW_INLIERS, "nothing fits"))
    assert content.complete
    # Answers nobody asked for do not stand for those that are missing.
    content.add_result(failed(room.pairs[4], "m", Reason.TOO_FEW_INLIERS, "nothing fits"))
    assert content.complete
    content.add_pair(room.pairs[5])
    assert not content.complete


def test_the_map_keeps_stages_apart(content):
    points, stages = map_points(content.fragments, solved(content), 0.2)
    assert len(points) == len(stages)
    assert set(stages) == {1.0, 2.0}


@pytest.mark.parametrize("covariance", [-np.eye(6), np.diag([1.0, 1, 1, 1, 1, 0])])
def test_a_constraint_needs_a_covariance(content, room, covariance):
    with pytest.raises(InputError, match="positive definite"):
        content.add_constraint(room.pairs[0], np.eye(4), covariance)


def test_a_constraint_needs_known_fragments(content, room):
    stranger = FragmentPair(room.fragments[0].id, FragmentId("9", 9, 9))
    with pytest.raises(InputError, match="Bldg9_Stage9_Spot9"):
        content.add_constraint(stranger, np.eye(4))


def test_a_saved_map_keeps_what_a_person_decided(content, room, tmp_path):
    truth, doubted = room.ground_truth.edges[0], room.pairs[3]
    covariance = np.diag([0.02, 0.03, 0.04, 0.001, 0.002, 0.003])
    content.add_constraint(truth.pair, truth.T_target_source, covariance)
    assert content.remove_constraint(doubted)
    graph = solved(content)
    assert any(edge.reason == EXCLUDED for edge in graph.edges if edge.pair == doubted)
    save_map(tmp_path / "map", content.fragments, content.results, graph)

    saved = load_map(tmp_path / "map")
    assert saved.excluded == (doubted,)
    (constraint,) = saved.constraints
    assert (constraint.pair, constraint.kind) == (truth.pair, EdgeKind.MANUAL)
    np.testing.assert_allclose(constraint.covariance, covariance, atol=1e-12)
    assert saved.fragments.keys() == content.fragments.keys()
    assert saved.relative_transforms.keys() == content.results.keys()


def test_a_constraint_without_its_fragment_is_refused(content, room, tmp_path):
    truth = room.ground_truth.edges[0]
    content.add_constraint(truth.pair, truth.T_target_source)
    save_map(tmp_path / "map", {}, content.results, solved(content))
    with pytest.raises(FormatError, match="has a constraint on Bldg1_Stage1"):
        load_map(tmp_path / "map")


def test_a_saved_map_is_never_overwritten(content, tmp_path):
    graph = solved(content)
    for name in ("map", "map.ply"):
        save_map(tmp_path / name, content.fragments, content.results, graph)
        with pytest.raises(BagError, match="exists already"):
            save_map(tmp_path / name, content.fragments, content.results, graph)


def test_an_unknown_ending_is_named(content, tmp_path):
    with pytest.raises(FormatError, match=r"map\.doc must end in"):
        save_map(tmp_path / "map.doc", content.fragments, content.results, solved(content))

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.bag_reader import RawMessage, decode, encode
from nss_ros.errors import InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import exponential
from nss_ros.messages import (
    GraphProgress,
    cloud_message,
    fragment_from,
    fragment_message,
    pair_from,
    pair_message,
    points_from,
    pose_graph_from,
    pose_graph_message,
    relative_transform_from,
    relative_transform_message,
    rosbags_family,
    rosidl_family,
    time_message,
)
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, Node, NodeStatus, PoseGraph
from nss_ros.registration.relative_transform import Hypothesis, Reason, RelativeTransform

A, B = FragmentId("1", 1, 0), FragmentId("1", 2, 7)


@pytest.fixture(params=["rosbags", "rosidl"])
def family(request):
    if request.param == "rosidl":
        pytest.importorskip("nss_msgs")
        return rosidl_family()
    return rosbags_family()


def test_fragment_round_trip(family):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    again = fragment_from(fragment_message(Fragment(A, points, True), 12, family))
    assert again.id == A
    assert again.gravity_aligned
    np.testing.assert_array_equal(again.points, points)


def test_pair_round_trip(family):
    assert pair_from(pair_message(FragmentPair(A, B), 5, family)) == FragmentPair(A, B)


def test_relative_transform_round_trip(family):
    result = RelativeTransform(
        FragmentPair(A, B),
        "fpfh_ransac",
        exponential([1, 2, 3, 0.1, 0.2, 0.3]),
        np.arange(36.0).reshape(6, 6),
        overlap_probability=0.4,
        confidence=0.7,
        inliers=812,
        inlier_ratio=0.33,
        rmse=0.05,
        compute_time=1.5,
        alternatives=(Hypothesis(exponential([0, 0, 1, 0, 0, 3]), 0.2),),
    )
    again = relative_transform_from(relative_transform_message(result, 9, family))
    np.testing.assert_allclose(again.T_target_source, result.T_target_source, atol=1e-12)
    np.testing.assert_array_equal(again.covariance, result.covariance)
    np.testing.assert_allclose(
        again.alternatives[0].T_target_source, result.alternatives[0].T_target_source, atol=1e-12
    )
    for name in ("pair", "method", "reason", "confidence", "inliers", "inlier_ratio", "rmse"):
        assert getattr(again, name) == getattr(result, name)


def test_failure_round_trip(family):
    result = RelativeTransform(FragmentPair(A, B), "m", reason=Reason.TOO_FEW_POINTS, message="!")
    message = relative_transform_message(result, 9, family)
    assert message.status == 1
    again = relative_transform_from(message)
    assert (again.ok, again.reason, again.message) == (False, Reason.TOO_FEW_POINTS, "!")


def test_pose_graph_round_trip(family):
    graph = PoseGraph(
        (Node(A, exponential([1, 0, 0, 0, 0, 1]), NodeStatus.PLACED, 2), Node(B)),
        (
            Edge(
                FragmentPair(B, A),
                np.eye(4),
                EdgeKind.DIFFERENT_STAGE,
                EdgeStatus.REJECTED,
                "why",
                weight=0.5,
                overlap_ratio=0.3,
            ),
        ),
        name="g",
        synchronizer="choi",
    )
    message = pose_graph_message(graph, "map", 3, family, GraphProgress(4, 3, False))
    assert (message.pairs_requested, message.pairs_answered, message.settled) == (4, 3, False)
    again = pose_graph_from(message)
    assert (again.name, again.synchronizer) == ("g", "choi")
    assert [node.status for node in again.nodes] == [NodeStatus.PLACED, NodeStatus.UNPLACED]
    assert (again.edges[0].status, again.edges[0].reason) == (EdgeStatus.REJECTED, "why")
    assert np.isnan(again.edges[0].temporal_change)
    assert again.nodes[0].component == 2


def test_a_doubtful_place_is_a_status_of_its_own(family):
    graph = PoseGraph((
        Node(A, exponential([1, 0, 0, 0, 0, 1]), NodeStatus.PLACED, doubtful=True),
        Node(B, status=NodeStatus.UNPLACED, doubtful=True),
    ))  # fmt: skip
    message = pose_graph_message(graph, "map", 3, family)
    assert [node.status for node in message.nodes] == [message.nodes[0].STATUS_DOUBTFUL, 0]
    again = pose_graph_from(message)
    assert again.nodes[0].status is NodeStatus.PLACED
    assert again.doubtful() == [A]
    np.testing.assert_allclose(again.nodes[0].T_map_fragment, graph.nodes[0].T_map_fragment)


@pytest.mark.parametrize("kind", EdgeKind)
def test_every_kind_of_edge_survives_and_has_the_number_of_the_message(family, kind):
    graph = PoseGraph((Node(A), Node(B)), (Edge(FragmentPair(B, A), np.eye(4), kind),))
    message = pose_graph_message(graph, "map", 3, family, GraphProgress(1, 1, True))
    assert pose_graph_from(message).edges[0].kind is kind
    edge = message.edges[0]
    assert edge.kind == getattr(type(edge), f"KIND_{kind.name}")


def test_each_family_reads_the_bytes_of_the_other():
    # Not compared as bytes: Fast CDR leaves its padding uninitialised.
    rclpy_serialization = pytest.importorskip("rclpy.serialization")
    nss_msgs = pytest.importorskip("nss_msgs.msg")
    fragment = Fragment(A, np.arange(9, dtype=np.float32).reshape(3, 3), True)
    ours = encode(fragment_message(fragment, 10**9 + 5, rosbags_family()))
    theirs = rclpy_serialization.serialize_message(
        fragment_message(fragment, 10**9 + 5, rosidl_family())
    )
    read_by_ros = rclpy_serialization.deserialize_message(ours, nss_msgs.Fragment)
    read_by_us = decode(RawMessage("/fragments", "nss_msgs/msg/Fragment", 0, theirs))
    for message in (read_by_ros, read_by_us):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 5)
        np.testing.assert_array_equal(fragment_from(message).points, fragment.points)


@given(st.integers(0, 2**31 - 1), st.integers(0, 10**9 - 1))
def test_stamps_keep_their_nanoseconds(seconds, nanoseconds):
    time = time_message(seconds * 10**9 + nanoseconds, rosbags_family())
    assert (time.sec, time.nanosec) == (seconds, nanoseconds)


def _cloud(**changes):
    columns = {name: np.arange(4, dtype=np.float32) for name in ("x", "y", "z")}
    message = cloud_message(columns, "f", 0, rosbags_family())
    for name, value in changes.items():
        object.__setattr__(message, name, value)
    return message


def test_nan_points_are_dropped():
    columns = {"x": np.array([1, np.nan], np.float32), "y": np.zeros(2), "z": np.zeros(2)}
    assert points_from(cloud_message(columns, "f", 0, rosbags_family())).tolist() == [[1, 0, 0]]


def test_an_organised_double_big_endian_cloud_is_understood():
    family = rosbags_family()
    fields = [
        family.make("sensor_msgs/msg/PointField", name=name, offset=4 + 8 * i, datatype=8, count=1)
        for i, name in enumerate(("y", "x", "z"))
    ]
    data = np.zeros((2, 100), np.uint8)
    for row in range(2):
        for column in range(3):
            values = np.array([row, column, 5], ">f8")
            data[row, 32 * column + 4 : 32 * column + 28] = values.view(np.uint8)
    cloud = _cloud(
        fields=fields,
        height=2,
        width=3,
        point_step=32,
        row_step=100,
        is_bigendian=True,
        data=data.reshape(-1),
    )
    assert points_from(cloud).tolist() == [[c, r, 5] for r in range(2) for c in range(3)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 5}, "holds 48 bytes"),
        ({"fields": []}, "no field 'x'"),
        ({"point_step": 8}, "holds 48 bytes"),
        ({"data": np.zeros(0, np.uint8)}, "holds 0 bytes"),
    ],
)
def test_a_cloud_that_contradicts_itself_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        points_from(_cloud(**changes))


def test_an_integer_coordinate_is_refused():
    cloud = _cloud()
    object.__setattr__(cloud.fields[1], "datatype", 5)
    with pytest.raises(InputError, match="'y'"):
        points_from(cloud)


def test_an_empty_cloud_is_no_points():
    empty = {name: np.zeros(0, np.float32) for name in ("x", "y", "z")}
    assert points_from(cloud_message(empty, "f", 0, rosbags_family())).shape == (0, 3)


def test_a_pair_of_one_fragment_is_refused(family):
    with pytest.raises(InputError, match="two different"):
        pair_from(pair_message(FragmentPair(A, A), 0, family))

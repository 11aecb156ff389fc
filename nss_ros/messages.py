"""Conversion between core types and ROS messages.

The same functions serve nodes (rosidl's classes) and files (rosbags' classes): both have the
same fields, so reading needs no distinction, and writing takes the `MessageFamily` to create.
"""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, Points, clean_points
from nss_ros.geometry import Matrix, Transform, from_quaternion, to_quaternion
from nss_ros.multiway.pose_graph import (
    Edge,
    EdgeKind,
    EdgeStatus,
    Node,
    NodeStatus,
    PoseGraph,
)
from nss_ros.registration.relative_transform import Hypothesis, Reason, RelativeTransform
from nss_ros.typestore import jazzy_typestore

Message = Any

_FLOAT_TYPES = {7: "f4", 8: "f8"}
_XYZ = ("x", "y", "z")

#: Of nss_msgs/FragmentPose: placed, and doubtful; the other statuses are those of `NodeStatus`.
STATUS_DOUBTFUL = 3


@dataclass(frozen=True, slots=True)
class MessageFamily:
    """One implementation of the message classes.

    Attributes:
        make: creates a message from its type name (`pkg/msg/Name`) and all its fields.
        octets: makes a `uint8[]` field from bytes.
    """

    make: Callable[..., Message]
    octets: Callable[[bytes], Any]


@cache
def rosidl_family() -> MessageFamily:
    """The classes that rclpy publishes."""

    def make(type_name: str, **fields: Any) -> Message:
        package, _, name = type_name.split("/")
        return getattr(import_module(f"{package}.msg"), name)(**fields)

    # rosidl copies an array.array at once, but a list or ndarray element by element.
    return MessageFamily(make, lambda data: array.array("B", data))


@cache
def rosbags_family() -> MessageFamily:
    """The classes that rosbags serialises, without ROS."""
    types = jazzy_typestore().types

    def make(type_name: str, **fields: Any) -> Message:
        return types[type_name](**fields)

    return MessageFamily(make, lambda data: np.frombuffer(data, dtype=np.uint8))


def time_message(stamp: int, family: MessageFamily) -> Message:
    """builtin_interfaces/Time of nanoseconds."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return family.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def header_message(stamp: int, frame_id: str, family: MessageFamily) -> Message:
    """std_msgs/Header; `stamp` in nanoseconds."""
    stamp_message = time_message(stamp, family)
    return family.make("std_msgs/msg/Header", stamp=stamp_message, frame_id=frame_id)


def cloud_message(
    columns: dict[str, NDArray[np.float32]], frame_id: str, stamp: int, family: MessageFamily
) -> Message:
    """sensor_msgs/PointCloud2 of float32 columns of equal length, in the order given."""
    table = np.column_stack(list(columns.values())).astype("<f4", copy=False)
    fields = [
        family.make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(columns)
    ]
    return family.make(
        "sensor_msgs/msg/PointCloud2",
        header=header_message(stamp, frame_id, family),
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=4 * len(columns),
        row_step=4 * len(columns) * len(table),
        data=family.octets(table.tobytes()),
        is_dense=True,
    )


def points_from(cloud: Message) -> Points:
    """The finite points of a sensor_msgs/PointCloud2, (n, 3) float32.

    Raises:
        InputError: x, y or z is missing or not a float, or the sizes contradict each other.
    """
    offsets = {field.name: field for field in cloud.fields}
    missing = [name for name in _XYZ if name not in offsets]
    if missing:
        raise InputError(f"The PointCloud2 has no field '{missing[0]}': x, y and z are needed.")
    order = ">" if cloud.is_bigendian else "<"
    formats = []
    for name in _XYZ:
        if offsets[name].datatype not in _FLOAT_TYPES:
            raise InputError(f"Field '{name}' of the PointCloud2 must be FLOAT32 or FLOAT64.")
        formats.append(order + _FLOAT_TYPES[offsets[name].datatype])
    data = np.frombuffer(cloud.data, dtype=np.uint8)
    rows, columns, step = int(cloud.height), int(cloud.width), int(cloud.point_step)
    row_step = int(cloud.row_step) or columns * step
    ends = [
        offsets[name].offset + np.dtype(f).itemsize for name, f in zip(_XYZ, formats, strict=True)
    ]
    if rows * columns and (
        max(ends) > step or columns * step > row_step or rows * row_step > len(data)
    ):
        raise InputError(
            f"The PointCloud2 says {rows} x {columns} points of {step} bytes, "
            f"but holds {len(data)} bytes."
        )
    if rows * columns == 0:
        return np.zeros((0, 3), dtype=np.float32)
    dtype = np.dtype(
        {
            "names": list(_XYZ),
            "formats": formats,
            "offsets": [offsets[name].offset for name in _XYZ],
            "itemsize": step,
        }
    )
    table = np.ndarray((rows, columns), dtype, data.data, strides=(row_step, step)).reshape(-1)
    return clean_points(np.column_stack([table[name] for name in _XYZ]))


def pose_message(transform: Transform, covariance: Matrix, family: MessageFamily) -> Message:
    """geometry_msgs/PoseWithCovariance of a transform."""
    x, y, z = (float(value) for value in transform[:3, 3])
    qx, qy, qz, qw = (float(value) for value in to_quaternion(transform))
    pose = family.make(
        "geometry_msgs/msg/Pose",
        position=family.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=family.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    flat = np.asarray(covariance, dtype=np.float64).reshape(36)
    return family.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=flat)


def pose_from(message: Message) -> tuple[Transform, Matrix]:
    """Transform and 6x6 covariance of a geometry_msgs/PoseWithCovariance.

    Raises:
        InputError: the pose is not finite, or its orientation has no length.
    """
    position, orientation = message.pose.position, message.pose.orientation
    translation = (position.x, position.y, position.z)
    if not all(map(math.isfinite, translation)):
        raise InputError("A pose needs a finite position.")
    quaternion = (orientation.x, orientation.y, orientation.z, orientation.w)
    covariance = np.asarray(message.covariance, dtype=np.float64).reshape(6, 6)
    return from_quaternion(quaternion, translation), covariance


def fragment_message(fragment: Fragment, stamp: int, family: MessageFamily) -> Message:
    """nss_msgs/Fragment; `stamp` in nanoseconds."""
    name = str(fragment.id)
    columns = {axis: fragment.points[:, i] for i, axis in enumerate(_XYZ)}
    return family.make(
        "nss_msgs/msg/Fragment",
        header=header_message(stamp, name, family),
        id=name,
        area=fragment.id.area,
        stage=fragment.id.stage,
        spot=fragment.id.spot,
        gravity_aligned=fragment.gravity_aligned,
        points=cloud_message(columns, name, stamp, family),
    )


def fragment_from(message: Message) -> Fragment:
    """The fragment of an nss_msgs/Fragment.

    Raises:
        InputError: the id or the cloud is not valid.
    """
    return Fragment(
        FragmentId.parse(message.id), points_from(message.points), bool(message.gravity_aligned)
    )


def pair_message(pair: FragmentPair, stamp: int, family: MessageFamily) -> Message:
    """nss_msgs/FragmentPair; `stamp` in nanoseconds."""
    return family.make(
        "nss_msgs/msg/FragmentPair",
        header=header_message(stamp, "", family),
        source_id=str(pair.source),
        target_id=str(pair.target),
    )


def pair_from(message: Message) -> FragmentPair:
    """The pair of a message that names `source_id` and `target_id`.

    Raises:
        InputError: an id is not valid, or both are the same.
    """
    pair = FragmentPair(FragmentId.parse(message.source_id), FragmentId.parse(message.target_id))
    if pair.source == pair.target:
        raise InputError(f"A pair needs two different fragments, not {pair.source} twice.")
    return pair


def relative_transform_message(
    result: RelativeTransform, stamp: int, family: MessageFamily
) -> Message:
    """nss_msgs/RelativeTransform; `stamp` in nanoseconds."""
    alternatives = [
        family.make(
            "nss_msgs/msg/TransformHypothesis",
            pose=pose_message(hypothesis.T_target_source, hypothesis.covariance, family),
            probability=float(hypothesis.probability),
        )
        for hypothesis in result.alternatives
    ]
    return family.make(
        "nss_msgs/msg/RelativeTransform",
        header=header_message(stamp, str(result.pair.target), family),
        source_id=str(result.pair.source),
        target_id=str(result.pair.target),
        status=0 if result.ok else 1,
        reason=int(result.reason),
        message=result.message,
        pose=pose_message(result.T_target_source, result.covariance, family),
        overlap_probability=float(result.overlap_probability),
        confidence=float(result.confidence),
        inliers=int(result.inliers),
        inlier_ratio=float(result.inlier_ratio),
        rmse=float(result.rmse),
        method=result.method,
        compute_time=float(result.compute_time),
        alternatives=alternatives,
    )


def relative_transform_from(message: Message) -> RelativeTransform:
    """The answer in an nss_msgs/RelativeTransform.

    Raises:
        InputError: an id, a pose or the reason is not valid.
    """
    transform, covariance = pose_from(message.pose)
    hypotheses = []
    for alternative in message.alternatives:
        candidate, candidate_covariance = pose_from(alternative.pose)
        hypotheses.append(
            Hypothesis(candidate, float(alternative.probability), candidate_covariance)
        )
    return RelativeTransform(
        pair=pair_from(message),
        method=message.method,
        T_target_source=transform,
        covariance=covariance,
        reason=_enum(Reason, message.reason),
        message=message.message,
        overlap_probability=float(message.overlap_probability),
        confidence=float(message.confidence),
        inliers=int(message.inliers),
        inlier_ratio=float(message.inlier_ratio),
        rmse=float(message.rmse),
        compute_time=float(message.compute_time),
        alternatives=tuple(hypotheses),
    )


def fragment_pose_message(node: Node, family: MessageFamily) -> Message:
    """nss_msgs/FragmentPose."""
    return family.make(
        "nss_msgs/msg/FragmentPose",
        id=str(node.id),
        area=node.id.area,
        stage=node.id.stage,
        spot=node.id.spot,
        status=_status(node),
        component=node.component,
        pose=pose_message(node.T_map_fragment, node.covariance, family),
    )


def _status(node: Node) -> int:
    doubtful = node.doubtful and node.status is NodeStatus.PLACED
    return STATUS_DOUBTFUL if doubtful else int(node.status)


def fragment_poses_message(
    nodes: Sequence[Node], frame_id: str, stamp: int, family: MessageFamily
) -> Message:
    """nss_msgs/FragmentPoses; `stamp` in nanoseconds."""
    return family.make(
        "nss_msgs/msg/FragmentPoses",
        header=header_message(stamp, frame_id, family),
        poses=[fragment_pose_message(node, family) for node in nodes],
    )


@dataclass(frozen=True, slots=True)
class GraphProgress:
    """How complete a published pose graph is.

    Attributes:
        pairs_requested: fragment pairs asked for so far.
        pairs_answered: of these, pairs answered.
        settled: everything received so far is in the graph.
    """

    pairs_requested: int = 0
    pairs_answered: int = 0
    settled: bool = True


def pose_graph_message(
    graph: PoseGraph,
    frame_id: str,
    stamp: int,
    family: MessageFamily,
    progress: GraphProgress | None = None,
) -> Message:
    """nss_msgs/PoseGraph; `stamp` in nanoseconds."""
    progress = progress or GraphProgress()
    return family.make(
        "nss_msgs/msg/PoseGraph",
        header=header_message(stamp, frame_id, family),
        name=graph.name,
        nodes=[fragment_pose_message(node, family) for node in graph.nodes],
        edges=[_edge_message(edge, family) for edge in graph.edges],
        pairs_requested=progress.pairs_requested,
        pairs_answered=progress.pairs_answered,
        rms_residual=graph.rms_residual(),
        settled=progress.settled,
        synchronizer=graph.synchronizer,
    )


def pose_graph_from(message: Message) -> PoseGraph:
    """The pose graph of an nss_msgs/PoseGraph.

    Raises:
        InputError: an id, a pose or a constant is not valid.
    """
    return PoseGraph(
        nodes=tuple(_node_from(node) for node in message.nodes),
        edges=tuple(_edge_from(edge) for edge in message.edges),
        name=message.name,
        synchronizer=message.synchronizer,
    )


def _edge_message(edge: Edge, family: MessageFamily) -> Message:
    return family.make(
        "nss_msgs/msg/PoseGraphEdge",
        source_id=str(edge.pair.source),
        target_id=str(edge.pair.target),
        kind=int(edge.kind),
        status=int(edge.status),
        reason=edge.reason,
        pose=pose_message(edge.T_target_source, edge.covariance, family),
        residual_translation=float(edge.residual_translation),
        residual_rotation=float(edge.residual_rotation),
        weight=float(edge.weight),
        overlap_ratio=float(edge.overlap_ratio),
        temporal_change=float(edge.temporal_change),
    )


def _node_from(message: Message) -> Node:
    transform, covariance = pose_from(message.pose)
    doubtful = message.status == STATUS_DOUBTFUL
    return Node(
        id=FragmentId.parse(message.id),
        T_map_fragment=transform,
        status=NodeStatus.PLACED if doubtful else _enum(NodeStatus, message.status),
        component=int(message.component),
        covariance=covariance,
        doubtful=doubtful,
    )


def _edge_from(message: Message) -> Edge:
    transform, covariance = pose_from(message.pose)
    return Edge(
        pair=pair_from(message),
        T_target_source=transform,
        kind=_enum(EdgeKind, message.kind),
        status=_enum(EdgeStatus, message.status),
        reason=message.reason,
        residual_translation=float(message.residual_translation),
        residual_rotation=float(message.residual_rotation),
        weight=float(message.weight),
        overlap_ratio=float(message.overlap_ratio),
        temporal_change=float(message.temporal_change),
        covariance=covariance,
    )


def _enum(kind: Any, value: int) -> Any:
    try:
        return kind(int(value))
    except ValueError as error:
        raise InputError(f"{value} is not a {kind.__name__} of nss_msgs.") from error

"""Maps in the formats of other tools: g2o pose graphs, TUM trajectories and PLY clouds.

Each fragment's number is its place in the canonical order of the map's fragments.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nss_ros.bag import Log
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Matrix, Transform, adjoint, inverse, to_quaternion, transform_points
from nss_ros.multiway.pose_graph import EdgeStatus, Node, NodeStatus, PoseGraph

# g2o measures a rotation by the vector of its quaternion, which is half the angle.
_HALF_ANGLES = np.diag((1.0, 1.0, 1.0, 2.0, 2.0, 2.0))


def write_g2o(log: Log, path: Path) -> int:
    """Write the placed fragments and accepted edges as g2o SE3:QUAT; return the fragments written.

    Edges carry the inverse covariance of their relative transform, the identity where it has
    none. The first fragment of each component is fixed.

    Raises:
        InputError: the log holds no map.
        FormatError: the file cannot be written.
    """
    numbers = _numbers(log)
    lines, fixed = [], set()
    for node in _placed(log):
        lines.append(f"VERTEX_SE3:QUAT {numbers[node.id]} {_pose_text(node.T_map_fragment)}")
        if node.component not in fixed:
            lines.append(f"FIX {numbers[node.id]}")
            fixed.add(node.component)
    for edge in _pose_graph(log).edges:
        pair = edge.pair
        if edge.status is EdgeStatus.ACCEPTED and {pair.source, pair.target} <= numbers.keys():
            information = _local_information(log, pair, edge.T_target_source)
            upper = " ".join(f"{value:.9g}" for value in information[np.triu_indices(6)])
            lines.append(
                f"EDGE_SE3:QUAT {numbers[pair.target]} {numbers[pair.source]} "
                f"{_pose_text(edge.T_target_source)} {upper}"
            )
    _write_lines(path, lines)
    return len(numbers)


def write_tum(log: Log, path: Path) -> int:
    """Write the main component's poses as a TUM trajectory; return the fragments written.

    A row is `number x y z qx qy qz qw`; the number stands in place of a time stamp.

    Raises:
        InputError: the log holds no map.
        FormatError: the file cannot be written.
    """
    numbers = _numbers(log)
    main = [node for node in _placed(log) if node.component == 0]
    _write_lines(path, [f"{numbers[node.id]} {_pose_text(node.T_map_fragment)}" for node in main])
    return len(main)


def write_map(log: Log, path: Path) -> int:
    """Write the main component's points with their stage as PLY; return the fragments written.

    Raises:
        InputError: the log holds no map, or lacks the points of a placed fragment.
        FormatError: the file cannot be written.
    """
    main = [node for node in _placed(log) if node.component == 0]
    missing = [str(node.id) for node in main if node.id not in log.fragments]
    if missing:
        raise InputError(
            f"{log.path} lacks the points of {missing[0]}: record with recorder.record_fragments."
        )
    clouds = [transform_points(n.T_map_fragment, log.fragments[n.id].points) for n in main]
    points = np.concatenate(clouds or [np.zeros((0, 3))]).astype(np.float32)
    stages = np.repeat([node.id.stage for node in main], [len(cloud) for cloud in clouds])
    columns = {axis: points[:, i] for i, axis in enumerate("xyz")}
    write_ply(path, {**columns, "stage": stages.astype(np.int32)})
    return len(main)


def _pose_graph(log: Log) -> PoseGraph:
    if log.pose_graph is None:
        raise InputError(f"{log.path} holds no map to export: make one with 'nss map'.")
    return log.pose_graph


def _placed(log: Log) -> list[Node]:
    return [node for node in _pose_graph(log).nodes if node.status is NodeStatus.PLACED]


def _numbers(log: Log) -> dict[FragmentId, int]:
    nodes = enumerate(_pose_graph(log).nodes)
    return {node.id: i for i, node in nodes if node.status is NodeStatus.PLACED}


def _pose_text(transform: Transform) -> str:
    return " ".join(f"{value:.12g}" for value in (*transform[:3, 3], *to_quaternion(transform)))


def _local_information(log: Log, pair: FragmentPair, T_target_source: Transform) -> Matrix:
    """Information in g2o's terms: perturbed in the source frame, rotation as half angles."""
    answer = log.relative_transforms.get(pair)
    covariance = np.zeros((6, 6)) if answer is None else answer.covariance
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.eye(6)
    to_source = adjoint(inverse(T_target_source))
    local = np.linalg.inv(to_source @ covariance @ to_source.T)
    return np.asarray(_HALF_ANGLES @ local @ _HALF_ANGLES)


def _write_lines(path: Path, lines: list[str]) -> None:
    write_file(path, "".join(f"{line}\n" for line in lines).encode())


# By file ending; each returns the number of fragments written.
WRITERS: dict[str, Callable[[Log, Path], int]] = {
    ".g2o": write_g2o,
    ".tum": write_tum,
    ".ply": write_map,
}

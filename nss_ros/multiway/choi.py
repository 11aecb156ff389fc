"""Robust pose-graph optimisation with line processes (Choi, Zhou, Koltun: CVPR 2015).

The optimiser is Open3D's. Two things are ours, because without them it fails on graphs of
aliased buildings (METHODS): the start, from parts of the map that are joined by the evidence of
all hypotheses, since the line process judges the edges on the initial poses; and the check of
every residual afterwards, since Open3D's rotation residual is the sine of the angle, which is
zero for a flip by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Matrix, Transform, adjoint, inverse
from nss_ros.multiway.agglomeration import joined_parts
from nss_ros.multiway.hypotheses import fitting_hypothesis
from nss_ros.multiway.judged_edge import (
    JudgedEdge,
    contradiction,
    judged_edges,
    judged_graph,
    relative_of,
)
from nss_ros.multiway.pose_graph import Measurement, PoseGraph
from nss_ros.multiway.spanning_tree import (
    Closeness,
    Poses,
    anchored,
    components,
    spanning_tree_poses,
)
from nss_ros.multiway.triangles import triangle_support

# Open3D orders rotation before translation.
_OPEN3D_ORDER = np.array([3, 4, 5, 0, 1, 2])
_MOST_ROUNDS = 4


class Choi:
    """Line-process optimisation of each connected component.

    Args:
        config: settings.
    """

    name = "choi"

    def __init__(self, config: MultiwayConfig) -> None:
        self._config = config

    @property
    def close(self) -> Closeness:
        """When a loop of edges closes."""
        return Closeness(self._config.loop_translation, np.deg2rad(self._config.loop_rotation))

    def straightened(self, part: Poses, measurements: Sequence[Measurement]) -> Poses:
        """The poses of a part of the map after an optimisation over the pairs that agree with them.

        Joined by one pair after the other, a part of many fragments is bent.

        Args:
            part: poses of its fragments.
            measurements: with their alternatives, not of this part only.

        Returns:
            Poses in the frame of the first fragment; the same as before where the optimisation
            would not keep the part together.
        """
        inside = [m for m in measurements if m.pair.source in part and m.pair.target in part]
        agreeing = [fitting_hypothesis(m, relative_of(m, part), self.close) for m in inside]
        graph = self.synchronize(sorted(part), [m for m in agreeing if m is not None], part)
        placed = graph.poses()
        if len(placed) < len(part) or any(node.component for node in placed.values()):
            return part
        return {id_: node.T_map_fragment for id_, node in placed.items()}

    def synchronize(
        self,
        fragments: Sequence[FragmentId],
        measurements: Sequence[Measurement],
        start: Poses | None = None,
        rejected: Sequence[tuple[Measurement, str]] = (),
        parts: Sequence[Poses] = (),
    ) -> PoseGraph:
        """Poses of all fragments; see `Synchronizer.synchronize`.

        Args:
            fragments: all of them.
            measurements: between them.
            start: initial poses of all fragments, if they are known.
            rejected: measurements that only become rejected edges, and why.
            parts: initial poses of some fragments, which the others are joined to; each part has
                a frame of its own.
        """
        ids = sorted(set(fragments))
        edges = judged_edges(ids, measurements, self._config)
        known = start or {}
        if start is None and (parts or self._config.start == "evidence"):
            known = self._join(ids, edges, parts)
        self._count_support(edges)
        poses = known
        for _ in range(_MOST_ROUNDS):
            poses = self._optimise(ids, edges, poses if known else {})
            if not self._judge(edges, poses):
                break
        self._reject_bridges(ids, edges)
        edges += [JudgedEdge(m, False, reason, weight=0.0) for m, reason in rejected]
        return judged_graph(ids, edges, poses, self.name)

    def _join(
        self, ids: list[FragmentId], edges: list[JudgedEdge], known: Sequence[Poses]
    ) -> Poses:
        """Poses by which the pairs agree; their edges get the hypothesis that fits them."""
        close = self.close
        measurements = [edge.measurement for edge in edges if edge.accepted]
        parts = joined_parts(ids, measurements, close, known=known)
        part = {id_: number for number, members in enumerate(parts) for id_ in members}
        poses = {id_: pose for members in parts for id_, pose in members.items()}
        for edge in edges:
            m = edge.measurement
            if not edge.accepted or m.manual:
                continue
            if part[m.pair.source] != part[m.pair.target]:
                edge.reject("too little speaks for joining the parts of the map that it links")
                continue
            fitting = fitting_hypothesis(m, relative_of(m, poses), close)
            if fitting is None:
                edge.reject("none of its hypotheses agrees with the others")
            else:
                edge.measurement = fitting
        return poses

    def _count_support(self, edges: list[JudgedEdge]) -> None:
        accepted = [edge for edge in edges if edge.accepted]
        close = self.close
        support = triangle_support(
            [edge.measurement for edge in accepted], close.translation, close.rotation
        )
        for edge, count in zip(accepted, support, strict=True):
            edge.support = int(count)

    def _optimise(self, ids: list[FragmentId], edges: list[JudgedEdge], known: Poses) -> Poses:
        """Poses of every fragment, each component in the frame of its first one.

        Args:
            ids: all fragments.
            edges: those accepted count.
            known: poses to start from; empty: those of a spanning tree.
        """
        active = [edge for edge in edges if edge.accepted]
        poses: Poses = {}
        for members in components(ids, [edge.measurement for edge in active]):
            inside = set(members)
            own = [edge for edge in active if edge.measurement.pair.source in inside]
            if not own:
                poses[members[0]] = np.eye(4)
                continue
            start = {id_: known[id_] for id_ in members} if known else self._tree(members, own)
            poses |= self._line_process(members, own, start)
        return poses

    def _tree(self, members: list[FragmentId], edges: list[JudgedEdge]) -> Poses:
        ranks = np.array([self._rank(edge) for edge in edges])
        votes = self.close if self._config.start == "triangles" else None
        return spanning_tree_poses(members, [edge.measurement for edge in edges], ranks, votes)

    def _rank(self, edge: JudgedEdge) -> tuple[float, ...]:
        m = edge.measurement
        if self._config.start == "confidence":
            return (float(m.manual), m.confidence, float(m.inliers))
        return (float(m.manual), float(edge.support), m.confidence)

    def _line_process(
        self, members: list[FragmentId], edges: list[JudgedEdge], start: Poses
    ) -> Poses:
        import open3d as o3d

        registration = o3d.pipelines.registration
        index = {id_: i for i, id_ in enumerate(members)}
        graph = registration.PoseGraph()
        for id_ in members:
            graph.nodes.append(registration.PoseGraphNode(start[id_]))
        information = _correspondence_information([edge.measurement for edge in edges])
        for edge, matrix in zip(edges, information, strict=True):
            m = edge.measurement
            graph.edges.append(
                registration.PoseGraphEdge(
                    index[m.pair.source],
                    index[m.pair.target],
                    m.T_target_source,
                    matrix[np.ix_(_OPEN3D_ORDER, _OPEN3D_ORDER)],
                    uncertain=not m.manual,
                )
            )
        option = registration.GlobalOptimizationOption(
            max_correspondence_distance=self._config.max_distance,
            edge_prune_threshold=self._config.prune_threshold,
            preference_loop_closure=self._config.preference,
            reference_node=0,
        )
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            registration.global_optimization(
                graph,
                registration.GlobalOptimizationLevenbergMarquardt(),
                registration.GlobalOptimizationConvergenceCriteria(),
                option,
            )
        poses = {id_: np.array(graph.nodes[i].pose) for id_, i in index.items()}
        if not all(np.isfinite(pose).all() for pose in poses.values()):
            poses = start
        self._weigh(edges, information, poses)
        return anchored(poses, members[0])

    def _weigh(self, edges: list[JudgedEdge], information: list[Matrix], poses: Poses) -> None:
        """Line-process weights at the optimum (Choi et al., section 5)."""
        scale = (
            self._config.preference
            * self._config.max_distance**2
            * float(np.mean([matrix[2, 2] for matrix in information]))
        )
        for edge, matrix in zip(edges, information, strict=True):
            m = edge.measurement
            error = inverse(m.T_target_source) @ relative_of(m, poses)
            twist = np.concatenate((error[:3, 3], _linearised_rotation(error)))
            edge.weight = (
                1.0 if m.manual else float((scale / (scale + twist @ matrix @ twist)) ** 2)
            )

    def _judge(self, edges: list[JudgedEdge], poses: Poses) -> bool:
        """Reject the edges that the poses contradict; whether there were any."""
        rejected = False
        for edge in edges:
            m = edge.measurement
            if not edge.accepted or m.manual:
                continue
            if reason := contradiction(m, poses, self.close):
                edge.reject(reason)
            elif edge.weight < self._config.prune_threshold:
                edge.reject(f"line process {edge.weight:.2f} is below prune_threshold")
            else:
                continue
            rejected = True
        return rejected

    def _reject_bridges(self, ids: list[FragmentId], edges: list[JudgedEdge]) -> None:
        """Reject edges that link two parts of the map with nothing to confirm them."""
        doubtful = [
            edge
            for edge in edges
            if edge.accepted
            and edge.support == 0
            and not edge.measurement.manual
            and edge.measurement.confidence < self._config.bridge_confidence
        ]
        for edge in sorted(doubtful, key=lambda e: (e.measurement.confidence, e.measurement.pair)):
            rest = [e.measurement for e in edges if e.accepted and e is not edge]
            pair = edge.measurement.pair
            if not any(pair.source in c and pair.target in c for c in components(ids, rest)):
                edge.reject("no loop confirms it, and its confidence is below bridge_confidence")


def _correspondence_information(measurements: Iterable[Measurement]) -> list[Matrix]:
    """Information of source-frame errors, in units of correspondences as Choi et al. use them.

    The covariance gives the shape (how well each direction is observed), the number of inliers
    the size; the line process is scaled by a distance, so sizes must be counts.
    """
    listed = list(measurements)
    counts = [m.inliers for m in listed if not m.manual and m.inliers > 0]
    usual = float(np.mean(counts)) if counts else 1.0
    matrices = []
    for m in listed:
        moved = adjoint(m.T_target_source)
        matrix = moved.T @ m.information @ moved
        count = usual * 10 if m.manual else max(float(m.inliers), 1.0)
        matrices.append(matrix * count / float(np.mean(np.diag(matrix)[:3])))
    return matrices


def _linearised_rotation(error: Transform) -> NDArray[np.float64]:
    return (
        np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]])
        / 2
    )

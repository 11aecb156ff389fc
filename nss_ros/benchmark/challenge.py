"""Scores of challenge files by the definitions of the official evaluator, quirks included.

- Scenes are matched by position, and so are the nodes of a scene when those that are outliers in
  the target are left out; node ids only look up transforms afterwards.
- Predicted relative transforms are the predicted edges' if all of these have one, and then an
  edge that was not predicted counts as the identity; else they are computed from the predicted
  poses as inv(T_target) T_source, and a node that was not predicted counts as the identity.
  This is decided anew for the edges of each subset.
- Subsets (same stage, cross stage) only filter edges.
- Averages of errors are over successes, infinite without any; averages of RMSE are over edges,
  infinite if one edge has no correspondences.

Where the official evaluator fails with a traceback, ours says what is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nss_ros.benchmark.clouds import Clouds
from nss_ros.benchmark.metrics import (
    MAX_RRE,
    MAX_RTE_CHALLENGE,
    Floats,
    f1_score,
    pairwise_rmse,
    rotation_error,
    squared_displacement,
    successes,
    translation_error,
)
from nss_ros.dataset.challenge import ChallengeEdge, ChallengeGraph, ChallengeNode, NodeId
from nss_ros.errors import InputError
from nss_ros.geometry import Transform

SUBSETS = {"All": None, "Same-Stage": True, "Cross-Stage": False}


@dataclass(frozen=True, slots=True)
class ChallengeMetrics:
    """The official metrics of one subset of one scene.

    Attributes:
        recall: registration recall, percent of the target's edges.
        translation_error: mean over successes, metres; infinite without any.
        rotation_error: mean over successes, degrees; infinite without any.
        outlier_f1: F1 of outlier nodes, percent; 100 where the target has none.
        pairwise_rmse: mean over edges, metres; None without point clouds.
        global_rmse: over all points of nodes that are no outliers in the target, metres; None
            without point clouds.
    """

    recall: float
    translation_error: float
    rotation_error: float
    outlier_f1: float
    pairwise_rmse: float | None = None
    global_rmse: float | None = None


@dataclass(frozen=True, slots=True)
class ChallengeScore:
    """The official metrics of a prediction.

    Attributes:
        scenes: per scene and subset.
        overall: per subset, the mean over the scenes, NaN left out.
        notes: what a reader should know, for example scenes whose names differ.
    """

    scenes: dict[str, dict[str, ChallengeMetrics]]
    overall: dict[str, ChallengeMetrics]
    notes: tuple[str, ...] = ()


def score_challenge(
    target: Sequence[ChallengeGraph],
    prediction: Sequence[ChallengeGraph],
    clouds: Clouds | None = None,
    max_rte: float = MAX_RTE_CHALLENGE,
    max_rre: float = MAX_RRE,
) -> ChallengeScore:
    """Score predicted graphs against target graphs.

    Args:
        target: ground truth, one graph per scene.
        prediction: one graph per scene, in the same order.
        clouds: the nodes' point clouds; None: no RMSE.
        max_rte: largest translation error of a success, metres.
        max_rre: largest rotation error of a success, degrees.

    Raises:
        InputError: the graphs do not allow the comparison.
        FormatError: a point cloud is missing or not valid.
    """
    if len(target) != len(prediction):
        raise InputError(
            f"The target has {len(target)} scenes, but the prediction has {len(prediction)}: give "
            "one predicted graph per target graph, in the same order."
        )
    if not target:
        raise InputError("The target holds no pose graph.")
    scenes = {}
    notes = []
    for truth, estimate in zip(target, prediction, strict=True):
        if truth.name in scenes:
            notes.append(f"The target has two scenes named {truth.name}: only the last counts.")
        if truth.name != estimate.name:
            notes.append(
                f"The target scene {truth.name} is compared with the predicted scene "
                f"{estimate.name}: scenes are matched by position."
            )
        scenes[truth.name] = score_scene(truth, estimate, clouds, max_rte, max_rre)
    return ChallengeScore(scenes, _overall(scenes), tuple(notes))


def score_scene(
    target: ChallengeGraph,
    prediction: ChallengeGraph,
    clouds: Clouds | None = None,
    max_rte: float = MAX_RTE_CHALLENGE,
    max_rre: float = MAX_RRE,
) -> dict[str, ChallengeMetrics]:
    """The official metrics of one scene for all, same-stage and cross-stage edges.

    Raises:
        InputError: the graphs do not allow the comparison.
        FormatError: a point cloud is missing or not valid.
    """
    if target.edges is None:
        raise InputError(
            f"The target {target} has no edges: only graphs with ground-truth edges can be scored."
        )
    f1 = outlier_f1(target, prediction)
    rmse = None if clouds is None else global_rmse(target, prediction, clouds)
    edge_rmse = _EdgeRmse(target, clouds) if clouds is not None else None
    result = {}
    for subset, same_stage in SUBSETS.items():
        edges = _filtered(target.edges, same_stage, target)
        truth = [_transform(edge, target) for edge in edges]
        estimates = relative_transforms(target, prediction, same_stage)
        recall, te, re = _edge_errors(truth, estimates, max_rte, max_rre)
        mean_rmse = None
        if edge_rmse is not None:
            values = [edge_rmse(e, t) for e, t in zip(edges, estimates, strict=True)]
            mean_rmse = float(np.mean(values)) if values else float("nan")
        result[subset] = ChallengeMetrics(recall, te, re, f1, mean_rmse, rmse)
    return result


def relative_transforms(
    target: ChallengeGraph, prediction: ChallengeGraph, same_stage: bool | None = None
) -> list[Transform]:
    """The predicted `T_target_source` of the target's edges, as the official evaluator has them.

    Raises:
        InputError: a needed pose is missing or cannot be inverted.
    """
    edges = _filtered(target.edges or (), same_stage, target)
    predicted = prediction.edges
    if predicted is not None:
        predicted = tuple(_filtered(predicted, same_stage, prediction))
    if predicted is not None and all(edge.transform is not None for edge in predicted):
        given = {(edge.source, edge.target): edge.transform for edge in predicted}
        return [_or_identity(given.get((edge.source, edge.target))) for edge in edges]
    poses = _poses(_inlier_nodes(target, prediction))
    relatives = []
    for edge in edges:
        source = _pose(edge.source, poses, prediction)
        inverse = _inverse(_pose(edge.target, poses, prediction), edge.target, prediction)
        relatives.append(inverse @ source)
    return relatives


def global_rmse(target: ChallengeGraph, prediction: ChallengeGraph, clouds: Clouds) -> float:
    """Official global RMSE, metres: the root of all squares by all points of `displacements`.

    Raises:
        InputError: as `displacements`.
        FormatError: a point cloud is missing or not valid.
    """
    squares, points = displacements(target, prediction, clouds)
    return float(np.sqrt(squares.sum() / points.sum()))


def displacements(
    target: ChallengeGraph, prediction: ChallengeGraph, clouds: Clouds
) -> tuple[Floats, Floats]:
    """Of each node that is no outlier in the target: `squared_displacement`, and its points.

    The anchor is the first predicted node that is flagged so, else the first at all, among those
    that are no outliers in the target. A node that was not predicted has the identity as pose,
    one predicted as outlier the zero matrix.

    Raises:
        InputError: there is no anchor, its pose cannot be inverted, or a pose is missing.
        FormatError: a point cloud is missing or not valid.
    """
    inliers = [node for node in target.nodes if not node.outlier]
    predicted = _inlier_nodes(target, prediction)
    if not predicted:
        raise InputError(
            f"The global RMSE of {target} is not defined: no predicted node is an inlier in the "
            "target."
        )
    anchor = next((node.id for node in predicted if node.anchor), predicted[0].id)
    poses, true_poses = _poses(predicted), _poses(inliers)
    to_anchor = _inverse(_pose(anchor, poses, prediction), anchor, prediction, anchor=True)
    to_true_anchor = _inverse(_pose(anchor, true_poses, target), anchor, target, anchor=True)
    squares, counts = np.zeros(len(inliers)), np.zeros(len(inliers))
    for i, node in enumerate(inliers):
        points = clouds.points(_name(node, target))
        pose = to_anchor @ _pose(node.id, poses, prediction)
        true_pose = to_true_anchor @ _pose(node.id, {node.id: node.transform}, target)
        squares[i] = squared_displacement(points, true_pose, pose)
        counts[i] = len(points)
    return squares, counts


def outlier_f1(target: ChallengeGraph, prediction: ChallengeGraph) -> float:
    """F1 of the nodes with the zero matrix, by position, percent; 100 if the target has none.

    Raises:
        InputError: the graphs differ in their number of nodes.
    """
    truth = np.array([node.outlier for node in target.nodes], dtype=bool)
    if not truth.any():
        return 100.0
    estimate = np.array([node.outlier for node in prediction.nodes], dtype=bool)
    if len(truth) != len(estimate):
        raise InputError(
            f"The target {target} has {len(truth)} nodes, but the prediction {prediction} has "
            f"{len(estimate)}: list every node, outliers with the zero matrix."
        )
    return f1_score(truth, estimate)


class _EdgeRmse:
    """RMSE of an edge under an estimate; a repeated question is answered from memory."""

    def __init__(self, target: ChallengeGraph, clouds: Clouds) -> None:
        self._target = target
        self._clouds = clouds
        # Of equal ids the first counts, as in the official evaluator.
        self._nodes = {node.id: node for node in reversed(target.nodes)}
        self._known: dict[tuple[int, bytes], float] = {}

    def __call__(self, edge: ChallengeEdge, estimate: Transform) -> float:
        key = (id(edge), estimate.tobytes())
        if key not in self._known:
            self._known[key] = self._compute(edge, estimate)
        return self._known[key]

    def _compute(self, edge: ChallengeEdge, estimate: Transform) -> float:
        names = []
        for node_id in (edge.source, edge.target):
            if node_id not in self._nodes:
                raise InputError(
                    f"Edge {edge.source!r} -> {edge.target!r} of the target {self._target} names "
                    f"the node {node_id!r}, which the graph does not have."
                )
            names.append(_name(self._nodes[node_id], self._target))
        source, target = names
        pairs = self._clouds.correspondences(source, target, _transform(edge, self._target))
        return pairwise_rmse(
            self._clouds.points(source), self._clouds.points(target), pairs, estimate
        )


def _edge_errors(
    truth: Sequence[Transform], estimates: Sequence[Transform], max_rte: float, max_rre: float
) -> tuple[float, float, float]:
    if not truth:
        return 0.0, float("inf"), float("inf")
    true, estimated = np.stack(truth), np.stack(estimates)
    rre, rte = rotation_error(true, estimated), translation_error(true, estimated)
    success = successes(rre, rte, max_rre, max_rte)
    if not success.any():
        return 0.0, float("inf"), float("inf")
    recall = float(np.count_nonzero(success) / len(success) * 100)
    return recall, float(rte[success].mean()), float(rre[success].mean())


def _filtered(
    edges: Sequence[ChallengeEdge], same_stage: bool | None, graph: ChallengeGraph
) -> list[ChallengeEdge]:
    if same_stage is None:
        return list(edges)
    for edge in edges:
        if edge.same_stage is None:
            raise InputError(
                f"Edge {edge.source!r} -> {edge.target!r} of {graph} lacks 'same_stage': every "
                "edge needs it, true or false."
            )
    return [edge for edge in edges if edge.same_stage == same_stage]


def _inlier_nodes(target: ChallengeGraph, prediction: ChallengeGraph) -> list[ChallengeNode]:
    pairs = zip(target.nodes, prediction.nodes, strict=False)
    return [predicted for truth, predicted in pairs if not truth.outlier]


def _poses(nodes: Sequence[ChallengeNode]) -> dict[NodeId, Transform | None]:
    return {node.id: node.transform for node in nodes}


def _pose(
    node_id: NodeId, poses: Mapping[NodeId, Transform | None], graph: ChallengeGraph
) -> Transform:
    pose = poses.get(node_id, np.eye(4))
    if pose is None:
        raise InputError(f"Node {node_id!r} of {graph} has no 'global_transform', but needs one.")
    return pose


def _inverse(
    pose: Transform, node_id: NodeId, graph: ChallengeGraph, anchor: bool = False
) -> Transform:
    try:
        return np.asarray(np.linalg.inv(pose))
    except np.linalg.LinAlgError as error:
        what = "is the anchor" if anchor else "is the target of an edge"
        mend = "flag a placed node as 'anchor'" if anchor else "give the edges their transforms"
        raise InputError(
            f"Node {node_id!r} of {graph} {what}, but its pose cannot be inverted (the zero "
            f"matrix?): {mend}, or place the node."
        ) from error


def _transform(edge: ChallengeEdge, graph: ChallengeGraph) -> Transform:
    if edge.transform is None:
        raise InputError(
            f"Edge {edge.source!r} -> {edge.target!r} of the target {graph} has no "
            "'relative_transform'."
        )
    return edge.transform


def _name(node: ChallengeNode, graph: ChallengeGraph) -> str:
    if node.name is None:
        raise InputError(f"Node {node.id!r} of the target {graph} does not name a point cloud.")
    return node.name


def _or_identity(transform: Transform | None) -> Transform:
    return np.eye(4) if transform is None else transform


def _overall(scenes: Mapping[str, Mapping[str, ChallengeMetrics]]) -> dict[str, ChallengeMetrics]:
    return {
        subset: _mean_metrics([scene[subset] for scene in scenes.values()]) for subset in SUBSETS
    }


def _mean_metrics(scenes: Sequence[ChallengeMetrics]) -> ChallengeMetrics:
    means: dict[str, Any] = {}
    for field in fields(ChallengeMetrics):
        values = [getattr(scene, field.name) for scene in scenes]
        means[field.name] = None if None in values else _mean(values)
    return ChallengeMetrics(**means)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")

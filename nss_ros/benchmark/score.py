"""The score of a log: what a run estimated against the ground truth that was recorded beside it.

Pairwise figures judge the relative transforms, multi-way figures the poses of the final map.
Both are over the ground-truth edges of a graph: an edge without an answer, or whose fragments
are not both in the graph's main component, counts as a miss. "All", "same-stage" and
"different-stage" are by the kind of the ground-truth edge. Overall figures are micro averages:
over all edges, fragments and points of all graphs together.

A graph's main component is the largest that accepted edges form among its own fragments; the
other fragments count as outliers. The global RMSE is over the points of placed fragments of the
main component that are no outliers in the ground truth, in the frame of the first of them, and
is to be read with its coverage; the official definition instead takes unplaced fragments as
collapsed into the anchor's origin (the zero matrix of a submission), and stands beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nss_ros.bag import Log
from nss_ros.benchmark import challenge
from nss_ros.benchmark.clouds import Clouds
from nss_ros.benchmark.metrics import (
    MAX_RRE,
    MAX_RTE,
    MAX_RTE_CHALLENGE,
    Floats,
    f1_score,
    pairwise_rmse,
    recall,
    rotation_error,
    squared_displacement,
    successes,
    translation_error,
)
from nss_ros.dataset.challenge import ChallengeGraph, ChallengeNode
from nss_ros.dataset.submission import accepted_components, placed_graph, template_of
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, inverse, relative
from nss_ros.multiway.pose_graph import EdgeKind, NodeStatus, PoseGraph

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class EdgeScore:
    """Errors over a set of ground-truth edges.

    Attributes:
        edges: ground-truth edges.
        answered: of these, edges with an estimate.
        recall: percent of the edges with RRE <= 10 deg and RTE <= 0.2 m.
        recall_challenge: percent of the edges with RRE <= 10 deg and RTE <= 0.1 m.
        rte: mean RTE over successes (10 deg, 0.2 m), metres; NaN without any.
        rre: mean RRE over successes (10 deg, 0.2 m), degrees; NaN without any.
        rte_answered: mean RTE over all answered edges, metres.
        rre_answered: mean RRE over all answered edges, degrees.
        rmse: mean pairwise RMSE over answered edges with correspondences, metres; NaN without.
    """

    edges: int
    answered: int
    recall: float
    recall_challenge: float
    rte: float
    rre: float
    rte_answered: float
    rre_answered: float
    rmse: float


@dataclass(frozen=True, slots=True)
class Subsets:
    """Edge scores by kind of edge."""

    all: EdgeScore
    same_stage: EdgeScore
    different_stage: EdgeScore


@dataclass(frozen=True, slots=True)
class MapScore:
    """The poses of a graph's fragments.

    Attributes:
        fragments: in the graph.
        placed: of these, fragments in the main component.
        components: components of two or more fragments.
        outlier_f1: F1 of unplaced fragments as outliers, percent; 100 where the ground truth has
            none, as in the challenge.
        global_rmse: over placed fragments, metres; NaN without point clouds or placed fragments.
        coverage: percent of the ground truth's points whose fragment is placed; of fragments
            without point clouds.
        official_global_rmse: by the challenge's definition, on what 'nss export' would write,
            metres, overall the mean over graphs; NaN without point clouds, or where that
            definition does not apply (nothing placed).
    """

    fragments: int
    placed: int
    components: int
    outlier_f1: float
    global_rmse: float
    coverage: float
    official_global_rmse: float


@dataclass(frozen=True, slots=True)
class GraphScore:
    """The score of one graph of the dataset, or of all together.

    Attributes:
        name: of the graph.
        pairwise: relative transforms against the ground truth.
        multiway: relative transforms of the map's poses; None if the log holds no map.
        map: the map's poses; None if the log holds no map.
    """

    name: str
    pairwise: Subsets
    multiway: Subsets | None
    map: MapScore | None


@dataclass(frozen=True, slots=True)
class LogScore:
    """The score of a log.

    Attributes:
        log: path of the log.
        partial: the log is truncated or was never closed, or pairs are unanswered: later answers
            and the final map may be missing.
        truncated: the log is truncated or was never closed.
        pairs: pairs that were asked for.
        answered: of these, pairs with an answer, failures included.
        failed: of these, answers without a transform.
        has_points: point clouds were there, so RMSE is given.
        graphs: one score per graph with ground truth, in the order of the log.
        overall: micro average.
    """

    log: str
    partial: bool
    truncated: bool
    pairs: int
    answered: int
    failed: int
    has_points: bool
    graphs: tuple[GraphScore, ...]
    overall: GraphScore


def score_log(log: Log) -> LogScore:
    """Score a log against its own ground truth.

    Raises:
        InputError: the log holds no ground truth, or nothing that could be scored.
    """
    graphs = [graph for graph in log.ground_truth if graph.edges or graph.poses()]
    if not graphs:
        raise InputError(
            f"{log.path} holds no ground truth, so it cannot be scored: map a bag with known "
            "poses, or export the log with 'nss export' for the challenge's server."
        )
    if not log.relative_transforms and log.pose_graph is None:
        raise InputError(
            f"{log.path} holds no answers, so there is nothing to score: map it with 'nss map' "
            "and score the log that this writes."
        )
    clouds = _clouds(log, graphs)
    tallies = [_tally(graph, log, clouds) for graph in graphs]
    answers = [log.relative_transforms.get(pair) for pair in log.pairs]
    answered = sum(answer is not None for answer in answers)
    return LogScore(
        log=str(log.path),
        partial=log.partial or answered < len(answers),
        truncated=log.partial,
        pairs=len(answers),
        answered=answered,
        failed=sum(answer is not None and not answer.ok for answer in answers),
        has_points=clouds is not None,
        graphs=tuple(_graph_score([tally], tally.name) for tally in tallies),
        overall=_graph_score(tallies, "overall"),
    )


@dataclass(frozen=True, slots=True)
class _EdgeErrors:
    """Errors of each ground-truth edge, NaN where there is no estimate or no RMSE."""

    same_stage: NDArray[np.bool_]
    rre: Floats
    rte: Floats
    rmse: Floats


@dataclass(frozen=True, slots=True)
class _MapTally:
    """What the map score of one graph or of several is computed from."""

    fragments: int
    placed: int
    components: int
    true_outliers: NDArray[np.bool_]
    unplaced: NDArray[np.bool_]
    squares: float
    placed_points: int
    points: int
    official: float


@dataclass(frozen=True, slots=True)
class _Tally:
    name: str
    pairwise: _EdgeErrors
    multiway: _EdgeErrors | None
    map: _MapTally | None


def _clouds(log: Log, graphs: Sequence[PoseGraph]) -> Clouds | None:
    needed = {node.id for graph in graphs for node in graph.nodes if _inlier(node.status)}
    if not needed <= log.fragments.keys():
        return None
    clouds = {str(id_): fragment.points for id_, fragment in log.fragments.items()}
    return Clouds(lambda name: np.asarray(clouds[name], dtype=np.float64))


def _inlier(status: NodeStatus) -> bool:
    return status is not NodeStatus.OUTLIER


def _tally(graph: PoseGraph, log: Log, clouds: Clouds | None) -> _Tally:
    measured = [_measured(edge.pair, log) for edge in graph.edges]
    if log.pose_graph is None:
        (pairwise,) = _edge_errors(graph, [measured], clouds)
        return _Tally(graph.name, pairwise, None, None)
    components = accepted_components(log.pose_graph, [node.id for node in graph.nodes])
    main = components[0] if components else []
    placed = log.pose_graph.poses()
    poses = {id_: placed[id_].T_map_fragment for id_ in main}
    estimated = [
        relative(poses[edge.pair.source], poses[edge.pair.target])
        if edge.pair.source in poses and edge.pair.target in poses
        else None
        for edge in graph.edges
    ]
    pairwise, multiway = _edge_errors(graph, [measured, estimated], clouds)
    map_tally = _map_tally(graph, log.pose_graph, poses, len(components), clouds)
    return _Tally(graph.name, pairwise, multiway, map_tally)


def _measured(pair: FragmentPair, log: Log) -> Transform | None:
    answer = log.relative_transforms.get(pair)
    if answer is not None:
        return answer.T_target_source if answer.ok else None
    # Graphs that share an edge may have it in either direction; it is registered once.
    reverse = log.relative_transforms.get(FragmentPair(pair.target, pair.source))
    return inverse(reverse.T_target_source) if reverse is not None and reverse.ok else None


def _edge_errors(
    graph: PoseGraph, estimates: Sequence[Sequence[Transform | None]], clouds: Clouds | None
) -> list[_EdgeErrors]:
    """Errors of several estimates of a graph's edges; correspondences are searched once."""
    same_stage = np.array([edge.kind is EdgeKind.SAME_STAGE for edge in graph.edges], dtype=bool)
    errors = [
        _EdgeErrors(same_stage, *(np.full(len(graph.edges), NAN) for _ in range(3)))
        for _ in estimates
    ]
    for i, edge in enumerate(graph.edges):
        truth = edge.T_target_source
        source, target = str(edge.pair.source), str(edge.pair.target)
        pairs = clouds.correspondences(source, target, truth) if clouds else np.zeros((0, 2), int)
        for error, estimate in zip(errors, estimates, strict=True):
            transform = estimate[i]
            if transform is None:
                continue
            error.rre[i] = rotation_error(truth, transform)
            error.rte[i] = translation_error(truth, transform)
            if clouds and len(pairs):
                error.rmse[i] = pairwise_rmse(
                    clouds.points(source), clouds.points(target), pairs, transform
                )
    return errors


def _map_tally(
    graph: PoseGraph,
    pose_graph: PoseGraph,
    poses: dict[FragmentId, Transform],
    components: int,
    clouds: Clouds | None,
) -> _MapTally:
    truth = graph.poses()
    anchor = next((id_ for id_ in truth if id_ in poses), None)
    squares, placed_points, points = 0.0, 0, 0
    for id_, node in truth.items():
        cloud = clouds.points(str(id_)) if clouds else np.zeros((1, 3))
        points += len(cloud)
        if anchor is None or id_ not in poses:
            continue
        placed_points += len(cloud)
        squares += squared_displacement(
            cloud,
            relative(node.T_map_fragment, truth[anchor].T_map_fragment),
            relative(poses[id_], poses[anchor]),
        )
    return _MapTally(
        fragments=len(graph.nodes),
        placed=len(poses),
        components=components,
        true_outliers=np.array([not _inlier(node.status) for node in graph.nodes], dtype=bool),
        unplaced=np.array([node.id not in poses for node in graph.nodes], dtype=bool),
        squares=squares if clouds else NAN,
        placed_points=placed_points,
        points=points,
        official=_official_global_rmse(graph, pose_graph, clouds) if clouds else NAN,
    )


def _official_global_rmse(graph: PoseGraph, pose_graph: PoseGraph, clouds: Clouds) -> float:
    template = template_of(graph)
    nodes = tuple(
        ChallengeNode(node.id, str(truth.id), _matrix(truth.status, truth.T_map_fragment))
        for node, truth in zip(template.nodes, graph.nodes, strict=True)
    )
    target = ChallengeGraph(graph.name, nodes)
    try:
        return challenge.global_rmse(target, placed_graph(template, pose_graph), clouds)
    except InputError:
        return NAN


def _matrix(status: NodeStatus, pose: Transform) -> Transform | None:
    if status is NodeStatus.PLACED:
        return pose
    return np.zeros((4, 4)) if status is NodeStatus.OUTLIER else None


def _graph_score(tallies: Sequence[_Tally], name: str) -> GraphScore:
    multiway = [tally.multiway for tally in tallies if tally.multiway is not None]
    maps = [tally.map for tally in tallies if tally.map is not None]
    return GraphScore(
        name,
        _subsets([tally.pairwise for tally in tallies]),
        _subsets(multiway) if multiway else None,
        _map_score(maps) if maps else None,
    )


def _subsets(errors: Sequence[_EdgeErrors]) -> Subsets:
    same = np.concatenate([error.same_stage for error in errors])
    columns = [
        np.concatenate([getattr(error, name) for error in errors])
        for name in ("rre", "rte", "rmse")
    ]
    masks = (np.ones(len(same), dtype=bool), same, ~same)
    return Subsets(*(_edge_score(*(column[mask] for column in columns)) for mask in masks))


def _edge_score(rre: Floats, rte: Floats, rmse: Floats) -> EdgeScore:
    success = successes(rre, rte, MAX_RRE, MAX_RTE)
    answered = np.isfinite(rte)
    return EdgeScore(
        edges=len(rre),
        answered=int(answered.sum()),
        recall=recall(success),
        recall_challenge=recall(successes(rre, rte, MAX_RRE, MAX_RTE_CHALLENGE)),
        rte=_mean(rte[success]),
        rre=_mean(rre[success]),
        rte_answered=_mean(rte[answered]),
        rre_answered=_mean(rre[answered]),
        rmse=_mean(rmse[np.isfinite(rmse)]),
    )


def _map_score(tallies: Sequence[_MapTally]) -> MapScore:
    placed_points = sum(tally.placed_points for tally in tallies)
    points = sum(tally.points for tally in tallies)
    squares = sum(tally.squares for tally in tallies)
    true_outliers = np.concatenate([tally.true_outliers for tally in tallies])
    unplaced = np.concatenate([tally.unplaced for tally in tallies])
    return MapScore(
        fragments=sum(tally.fragments for tally in tallies),
        placed=sum(tally.placed for tally in tallies),
        components=sum(tally.components for tally in tallies),
        outlier_f1=f1_score(true_outliers, unplaced) if true_outliers.any() else 100.0,
        global_rmse=float(np.sqrt(squares / placed_points)) if placed_points else NAN,
        coverage=placed_points / points * 100 if points else NAN,
        official_global_rmse=_mean(np.array([tally.official for tally in tallies])),
    )


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else NAN

"""What a log holds against its ground truth, as columns: one row per edge, fragment and answer.

Scores, tables, comparisons and figures are all computed from this, so that each error is
measured once. Rows of several logs can be joined into one result set.

- Edges are those of the ground-truth graphs. An edge without an answer has no pairwise estimate;
  one whose fragments are not in one component of the map has none of the map, because poses mean
  something only relative to others of their component.
- A graph's components are those that accepted edges form among its own fragments, as in the
  challenge, to which each graph is submitted by itself; the largest is its main component. What
  takes one frame for the whole graph (placements, global RMSE, outliers) is of that.
- The components of the map are those of all fragments, so fragments of a graph may hang together
  by some that are not in it.
- Answers are relative transforms, also of pairs that are no edge of the ground truth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nss_ros.bag import Log
from nss_ros.benchmark import challenge
from nss_ros.benchmark.clouds import Clouds
from nss_ros.benchmark.metrics import (
    Floats,
    pairwise_rmse,
    rotation_error,
    squared_displacement,
    successes,
    translation_error,
)
from nss_ros.benchmark.overlap_truth import OverlapClouds, OverlapTruth
from nss_ros.dataset.challenge import ChallengeGraph, ChallengeNode
from nss_ros.dataset.submission import accepted_components, placed_graph, template_of
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, inverse, relative
from nss_ros.multiway.pose_graph import EdgeKind, NodeStatus, PoseGraph

NAN = float("nan")
SPLIT_KEY = "benchmark.split"
"""Metadata of a log: the split its pairs belong to, for example `cross_area`."""
TRAINING_KEY = "benchmark.training"
"""Metadata of a log: what its method was trained on; `same_stage` for same-stage pairs only."""

Booleans = NDArray[np.bool_]
Numbers = NDArray[np.intp]
Poses = Mapping[FragmentId, Transform]
Columns = TypeVar("Columns", "Estimates", "Edges", "Placements", "Answers")


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Estimates of edges, NaN where there is none.

    Attributes:
        T_target_source: (n, 4, 4).
        rre: (n,) degrees.
        rte: (n,) metres.
        rmse: (n,) pairwise RMSE, metres; NaN also without point clouds or correspondences.
    """

    T_target_source: Floats
    rre: Floats
    rte: Floats
    rmse: Floats

    @property
    def answered(self) -> Booleans:
        """Whether there is an estimate, (n,)."""
        return np.isfinite(self.rte)


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Ground-truth edges with what became of them, in the order of graphs and their edges.

    Attributes:
        pairs: (n,) of the ground truth; the same pair may be an edge of several graphs.
        graph: (n,) number of the graph.
        area: (n,) area of the source.
        same_stage: (n,) as the ground truth has it.
        asked: (n,) the pair was asked for, in either direction.
        overlap_ratio: (n,) 0..1; NaN where the ground truth does not say.
        temporal_change: (n,) 0..1; NaN where the ground truth does not say.
        T_target_source: (n, 4, 4) ground truth.
        pairwise: the relative transforms that were measured.
        in_main: (n,) both fragments are in the graph's main component; without a map, none.
        multiway: the relative transforms of the map's poses; None if the log holds no map.
    """

    pairs: tuple[FragmentPair, ...]
    graph: Numbers
    area: NDArray[np.str_]
    same_stage: Booleans
    asked: Booleans
    overlap_ratio: Floats
    temporal_change: Floats
    T_target_source: Floats
    in_main: Booleans
    pairwise: Estimates
    multiway: Estimates | None


@dataclass(frozen=True, slots=True, eq=False)
class Placements:
    """Fragments of ground-truth graphs in the map, in the order of graphs and their nodes.

    Attributes:
        ids: (n,) the same fragment may be a node of several graphs.
        graph: (n,) number of the graph.
        outlier: (n,) the ground truth has it as an outlier.
        placed: (n,) it is in its graph's main component.
        T_true: (n, 4, 4) pose in the ground truth; NaN where it has none.
        T_map_fragment: (n, 4, 4) pose in the map; NaN where it is not placed.
        points: (n,) its points where the ground truth has its pose, else 0; 1 without clouds.
        squares: (n,) `squared_displacement` in the frame of the graph's first placed fragment
            with a true pose, square metres; 0 where not placed, NaN without point clouds.
        official_squares: (n,) the same by the challenge's definition on what 'nss export' would
            write; 0 for outliers, NaN without point clouds or where it does not apply.
    """

    ids: tuple[FragmentId, ...]
    graph: Numbers
    outlier: Booleans
    placed: Booleans
    T_true: Floats
    T_map_fragment: Floats
    points: Floats
    squares: Floats
    official_squares: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Relative transforms as they were reported, in the order of the log.

    Attributes:
        pairs: (n,) as asked for.
        same_stage: (n,) both fragments are of one area and stage.
        ok: (n,) there is an estimate.
        overlap: (n,) 1 or 0, whether the fragments overlap; NaN where that is not known (see
            `OverlapTruth`) or no probability is given.
        overlap_probability: (n,) as reported; NaN where the method gave none.
        map_overlap: (n,) overlap ratio at the map's poses, 0..1; 0 of fragments that are not in one
            component of it; NaN where `overlap` is, without a map or without point clouds.
        confidence: (n,) as reported; NaN without an estimate.
        rre: (n,) degrees; NaN without an estimate, or where the true transform is not known: it
            is that of an edge of the ground truth, else of the poses of both in one graph.
        rte: (n,) metres; NaN as `rre`.
    """

    pairs: tuple[FragmentPair, ...]
    same_stage: Booleans
    ok: Booleans
    overlap: Floats
    overlap_probability: Floats
    map_overlap: Floats
    confidence: Floats
    rre: Floats
    rte: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A log, or several as one result set, against the ground truth.

    Attributes:
        log: path of the log; of several, joined by commas.
        method: registration method of most answers; empty without answers.
        synchronizer: multi-way method of the map; empty without.
        split: the dataset's split, of the metadata `benchmark.split`; empty if not recorded.
        training: of the metadata `benchmark.training`; empty if not recorded.
        truncated: a log is truncated or was never closed.
        pairs: pairs that were asked for.
        answered: of these, pairs with an answer, failures included.
        failed: of these, answers without a transform.
        has_points: point clouds were there.
        graphs: names of the ground-truth graphs.
        components: of each graph, the fragments in each of its components of two or more, the
            main one first.
        edges: ground-truth edges.
        placements: fragments in the map; None if a log holds no map.
        answers: what was reported.
        doubtful: fragments of which the map says that their place is doubtful.
    """

    log: str
    method: str
    synchronizer: str
    split: str
    training: str
    truncated: bool
    pairs: int
    answered: int
    failed: int
    has_points: bool
    graphs: tuple[str, ...]
    components: tuple[tuple[int, ...], ...]
    edges: Edges
    placements: Placements | None
    answers: Answers
    doubtful: tuple[FragmentId, ...]


def evaluate(log: Log) -> Evaluation:
    """Measure a log against its own ground truth.

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
    components = [_components(graph, log) for graph in graphs]
    mains = [_main_poses(each, log) for each in components]
    answers = [log.relative_transforms.get(pair) for pair in log.pairs]
    methods = Counter(answer.method for answer in log.relative_transforms.values())
    return Evaluation(
        log=str(log.path),
        method=methods.most_common(1)[0][0] if methods else "",
        synchronizer=log.pose_graph.synchronizer if log.pose_graph else "",
        split=log.metadata.get(SPLIT_KEY, ""),
        training=log.metadata.get(TRAINING_KEY, ""),
        truncated=log.partial,
        pairs=len(answers),
        answered=sum(answer is not None for answer in answers),
        failed=sum(answer is not None and not answer.ok for answer in answers),
        has_points=clouds is not None,
        graphs=tuple(graph.name for graph in graphs),
        components=tuple(tuple(map(len, each)) for each in components),
        edges=_edges(log, graphs, mains, clouds),
        placements=_placements(log.pose_graph, graphs, mains, clouds) if log.pose_graph else None,
        answers=_answers(log, graphs),
        doubtful=tuple(log.pose_graph.doubtful()) if log.pose_graph else (),
    )


def joined(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Several logs as one result set, for example one per area of a split.

    Without a map in one of them there is none in the whole. Names that differ are joined.

    Args:
        evaluations: one or more.
    """
    offsets = np.cumsum([0, *(len(each.graphs) for each in evaluations)]).tolist()[:-1]
    placements = [each.placements for each in evaluations if each.placements is not None]
    return Evaluation(
        log=", ".join(each.log for each in evaluations),
        **{
            name: " + ".join(dict.fromkeys(getattr(each, name) for each in evaluations))
            for name in ("method", "synchronizer", "split", "training")
        },
        truncated=any(each.truncated for each in evaluations),
        pairs=sum(each.pairs for each in evaluations),
        answered=sum(each.answered for each in evaluations),
        failed=sum(each.failed for each in evaluations),
        has_points=all(each.has_points for each in evaluations),
        graphs=tuple(name for each in evaluations for name in each.graphs),
        components=tuple(sizes for each in evaluations for sizes in each.components),
        edges=_stacked([each.edges for each in evaluations], offsets),
        placements=_stacked(placements, offsets) if len(placements) == len(evaluations) else None,
        answers=_stacked([each.answers for each in evaluations], offsets),
        doubtful=tuple(id_ for each in evaluations for id_ in each.doubtful),
    )


def in_main_successes(edges: Edges) -> Booleans:
    """Which edges the map has right (10 deg, 0.2 m) within its graph's main component, (n,)."""
    if edges.multiway is None:
        return np.zeros(len(edges.pairs), dtype=bool)
    return edges.in_main & successes(edges.multiway.rre, edges.multiway.rte)


def rows(columns: Columns, chosen: Numbers | Booleans) -> Columns:
    """Some rows, in the order of `chosen`: numbers of rows, or a mask of all."""
    numbers = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
    values: dict[str, Any] = {}
    for field in fields(columns):
        value = getattr(columns, field.name)
        if isinstance(value, np.ndarray):
            values[field.name] = value[numbers]
        elif isinstance(value, tuple):
            values[field.name] = tuple(value[i] for i in numbers)
        else:
            values[field.name] = None if value is None else rows(value, numbers)
    return type(columns)(**values)


def _stacked(parts: Sequence[Columns], offsets: Sequence[int]) -> Columns:
    """All rows of several; graphs are numbered on."""
    values: dict[str, Any] = {}
    for field in fields(parts[0]):
        columns = [getattr(part, field.name) for part in parts]
        if field.name == "graph":
            columns = [column + offset for column, offset in zip(columns, offsets, strict=True)]
        if any(column is None for column in columns):
            values[field.name] = None
        elif isinstance(columns[0], np.ndarray):
            values[field.name] = np.concatenate(columns)
        elif isinstance(columns[0], tuple):
            values[field.name] = tuple(item for column in columns for item in column)
        else:
            values[field.name] = _stacked(columns, offsets)
    return type(parts[0])(**values)


def _clouds(log: Log, graphs: Sequence[PoseGraph]) -> Clouds | None:
    needed = {node.id for graph in graphs for node in graph.nodes if _inlier(node.status)}
    if not needed <= log.fragments.keys():
        return None
    clouds = {str(id_): fragment.points for id_, fragment in log.fragments.items()}
    return Clouds(lambda name: np.asarray(clouds[name], dtype=np.float64))


def _inlier(status: NodeStatus) -> bool:
    return status is not NodeStatus.OUTLIER


def _components(graph: PoseGraph, log: Log) -> list[list[FragmentId]]:
    if log.pose_graph is None:
        return []
    return accepted_components(log.pose_graph, [node.id for node in graph.nodes])


def _main_poses(components: list[list[FragmentId]], log: Log) -> Poses:
    if log.pose_graph is None or not components:
        return {}
    placed = log.pose_graph.poses()
    return {id_: placed[id_].T_map_fragment for id_ in components[0]}


def _edges(
    log: Log, graphs: Sequence[PoseGraph], mains: Sequence[Poses], clouds: Clouds | None
) -> Edges:
    edges = [edge for graph in graphs for edge in graph.edges]
    graph = np.repeat(np.arange(len(graphs)), [len(graph.edges) for graph in graphs])
    truth = _transforms([edge.T_target_source for edge in edges])
    pairs = tuple(edge.pair for edge in edges)
    asked = {*log.pairs, *log.relative_transforms}
    transforms = [_transforms([_measured(pair, log) for pair in pairs])]
    if log.pose_graph is not None:
        transforms.append(_map_transforms(pairs, log.pose_graph))
    rmse = _rmse(pairs, truth, transforms, clouds)
    estimates = [
        Estimates(each, rotation_error(truth, each), translation_error(truth, each), column)
        for each, column in zip(transforms, rmse, strict=True)
    ]
    return Edges(
        pairs=pairs,
        graph=graph,
        area=np.array([pair.source.area for pair in pairs], dtype=np.str_),
        same_stage=np.array([edge.kind is EdgeKind.SAME_STAGE for edge in edges], dtype=bool),
        asked=np.array([p in asked or _turned(p) in asked for p in pairs], dtype=bool),
        overlap_ratio=np.array([edge.overlap_ratio for edge in edges], dtype=np.float64),
        temporal_change=np.array([edge.temporal_change for edge in edges], dtype=np.float64),
        T_target_source=truth,
        in_main=np.array(
            [
                pair.source in mains[g] and pair.target in mains[g]
                for g, pair in zip(graph.tolist(), pairs, strict=True)
            ],
            dtype=bool,
        ),
        pairwise=estimates[0],
        multiway=estimates[1] if len(estimates) > 1 else None,
    )


def _transforms(transforms: Sequence[Transform | None]) -> Floats:
    """Stacked, (n, 4, 4), NaN for None."""
    result = np.full((len(transforms), 4, 4), NAN)
    for row, transform in zip(result, transforms, strict=True):
        if transform is not None:
            row[:] = transform
    return result


def _turned(pair: FragmentPair) -> FragmentPair:
    return FragmentPair(pair.target, pair.source)


def _measured(pair: FragmentPair, log: Log) -> Transform | None:
    answer = log.relative_transforms.get(pair)
    if answer is not None:
        return answer.T_target_source if answer.ok else None
    # Graphs that share an edge may have it in either direction; it is registered once.
    reverse = log.relative_transforms.get(_turned(pair))
    return inverse(reverse.T_target_source) if reverse is not None and reverse.ok else None


def _map_transforms(pairs: Sequence[FragmentPair], pose_graph: PoseGraph) -> Floats:
    """Of the poses, (n, 4, 4); NaN for a pair whose fragments are not in one component."""
    components = accepted_components(pose_graph, [node.id for node in pose_graph.nodes])
    number = {id_: i for i, members in enumerate(components) for id_ in members}
    poses = {id_: node.T_map_fragment for id_, node in pose_graph.poses().items()}
    together = [
        pair if pair.source in number and number[pair.source] == number.get(pair.target) else None
        for pair in pairs
    ]
    sources = _transforms([None if pair is None else poses[pair.source] for pair in together])
    targets = _transforms([None if pair is None else poses[pair.target] for pair in together])
    return relatives(sources, targets)


def relatives(T_map_source: Floats, T_map_target: Floats) -> Floats:
    """`T_target_source` of stacked poses, (n, 4, 4); NaN where one of both is."""
    rotation = np.swapaxes(T_map_target[:, :3, :3], 1, 2)
    result = np.tile(np.eye(4), (len(T_map_source), 1, 1))
    result[:, :3, :3] = rotation @ T_map_source[:, :3, :3]
    result[:, :3, 3:] = rotation @ (T_map_source[:, :3, 3:] - T_map_target[:, :3, 3:])
    return result


def _rmse(
    pairs: Sequence[FragmentPair],
    truth: Floats,
    estimates: Sequence[Floats],
    clouds: Clouds | None,
) -> list[Floats]:
    """Pairwise RMSE of several estimates; correspondences are searched once."""
    result = [np.full(len(pairs), NAN) for _ in estimates]
    for i, pair in enumerate(pairs if clouds else ()):
        known = [k for k, each in enumerate(estimates) if not np.isnan(each[i, 0, 0])]
        source, target = str(pair.source), str(pair.target)
        if clouds is None or not known:
            continue
        corresponding = clouds.correspondences(source, target, truth[i])
        for k in known if len(corresponding) else ():
            result[k][i] = pairwise_rmse(
                clouds.points(source), clouds.points(target), corresponding, estimates[k][i]
            )
    return result


def _placements(
    pose_graph: PoseGraph,
    graphs: Sequence[PoseGraph],
    mains: Sequence[Poses],
    clouds: Clouds | None,
) -> Placements:
    nodes = [node for graph in graphs for node in graph.nodes]
    poses = [main.get(node.id) for graph, main in zip(graphs, mains, strict=True)
             for node in graph.nodes]  # fmt: skip
    true_poses = [
        node.T_map_fragment if node.status is NodeStatus.PLACED else None for node in nodes
    ]
    points = [
        0.0 if pose is None else float(len(clouds.points(str(node.id)))) if clouds else 1.0
        for node, pose in zip(nodes, true_poses, strict=True)
    ]
    return Placements(
        ids=tuple(node.id for node in nodes),
        graph=np.repeat(np.arange(len(graphs)), [len(graph.nodes) for graph in graphs]),
        outlier=np.array([not _inlier(node.status) for node in nodes], dtype=bool),
        placed=np.array([pose is not None for pose in poses], dtype=bool),
        T_true=_transforms(true_poses),
        T_map_fragment=_transforms(poses),
        points=np.array(points),
        squares=_joined_columns([
            _squares(graph, main, clouds) for graph, main in zip(graphs, mains, strict=True)
        ]),
        official_squares=_joined_columns([
            _official_squares(graph, pose_graph, clouds) for graph in graphs
        ]),
    )  # fmt: skip


def _joined_columns(columns: Sequence[Floats]) -> Floats:
    return np.concatenate([np.zeros(0), *columns])


def _squares(graph: PoseGraph, poses: Poses, clouds: Clouds | None) -> Floats:
    truth = graph.poses()
    result = np.zeros(len(graph.nodes))
    anchor = next((id_ for id_ in truth if id_ in poses), None)
    if clouds is None:
        return result + NAN
    for i, node in enumerate(graph.nodes):
        if anchor is not None and node.id in truth and node.id in poses:
            result[i] = squared_displacement(
                clouds.points(str(node.id)),
                relative(node.T_map_fragment, truth[anchor].T_map_fragment),
                relative(poses[node.id], poses[anchor]),
            )
    return result


def _official_squares(graph: PoseGraph, pose_graph: PoseGraph, clouds: Clouds | None) -> Floats:
    if clouds is None:
        return np.full(len(graph.nodes), NAN)
    template = template_of(graph)
    nodes = tuple(
        ChallengeNode(node.id, str(truth.id), _matrix(truth.status, truth.T_map_fragment))
        for node, truth in zip(template.nodes, graph.nodes, strict=True)
    )
    target = ChallengeGraph(graph.name, nodes)
    result = np.zeros(len(nodes))
    try:
        squares, _ = challenge.displacements(target, placed_graph(template, pose_graph), clouds)
    except InputError:
        return result + NAN
    result[[not node.outlier for node in nodes]] = squares
    return result


def _matrix(status: NodeStatus, pose: Transform) -> Transform | None:
    if status is NodeStatus.PLACED:
        return pose
    return np.zeros((4, 4)) if status is NodeStatus.OUTLIER else None


def _answers(log: Log, graphs: Sequence[PoseGraph]) -> Answers:
    answers = list(log.relative_transforms.values())
    pairs = tuple(answer.pair for answer in answers)
    estimates = _transforms([answer.T_target_source if answer.ok else None for answer in answers])
    truth = _true_transforms(pairs, graphs)
    probability = np.array([answer.overlap_probability for answer in answers], dtype=np.float64)
    given = np.flatnonzero(np.isfinite(probability))
    overlap = np.full(len(pairs), NAN)
    clouds = OverlapClouds(log.fragments)
    overlap[given] = OverlapTruth(log, graphs, clouds).overlaps([pairs[i] for i in given])
    confidence = [answer.confidence if answer.ok else NAN for answer in answers]
    return Answers(
        pairs=pairs,
        same_stage=np.array([pair.same_stage for pair in pairs], dtype=bool),
        ok=np.array([answer.ok for answer in answers], dtype=bool),
        overlap=overlap,
        overlap_probability=probability,
        map_overlap=_map_overlaps(pairs, overlap, log, clouds),
        confidence=np.array(confidence, dtype=np.float64),
        rre=rotation_error(truth, estimates),
        rte=translation_error(truth, estimates),
    )


def _map_overlaps(
    pairs: Sequence[FragmentPair], overlap: Floats, log: Log, clouds: OverlapClouds
) -> Floats:
    """Overlap ratios at the map's poses, where both kinds of pairs were asked for."""
    ratios = np.full(len(pairs), NAN)
    if log.pose_graph is None or len(np.unique(overlap[np.isfinite(overlap)])) < 2:
        return ratios
    known = np.isfinite(overlap) & np.array([clouds.has(pair) for pair in pairs], dtype=bool)
    ratios[known] = 0.0
    transforms = _map_transforms(pairs, log.pose_graph)
    for i in np.flatnonzero(known & np.isfinite(transforms[:, 0, 0])).tolist():
        ratios[i] = clouds.ratio(pairs[i], transforms[i])
    return ratios


def _true_transforms(pairs: Sequence[FragmentPair], graphs: Sequence[PoseGraph]) -> Floats:
    edges: dict[FragmentPair, Transform] = {}
    for graph in graphs:
        for edge in graph.edges:
            edges.setdefault(edge.pair, edge.T_target_source)
    poses = [{id_: node.T_map_fragment for id_, node in graph.poses().items()} for graph in graphs]

    def truth(pair: FragmentPair) -> Transform | None:
        if pair in edges:
            return edges[pair]
        if _turned(pair) in edges:
            return inverse(edges[_turned(pair)])
        of = next((each for each in poses if pair.source in each and pair.target in each), None)
        return None if of is None else relative(of[pair.source], of[pair.target])

    return _transforms([truth(pair) for pair in pairs])

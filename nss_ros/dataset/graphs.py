"""Pose graphs of a dataset with their ground truth, as the NSS paper and its challenge make them.

- Multi-way graphs (paper): all fragments of an area over all stages, an edge where the overlap
  ratio reaches 0.1, one graph per connected component of at least 50 nodes.
- Challenge graphs (README of the challenge of 2025): 20, 40, 80 or 160 nodes, up to a tenth of
  them outliers that overlap with no other node and have the zero matrix as their pose; the others
  are connected, each by two edges or more; overlap ratios above 0.1, above 0.3 in the mean.

Graphs are made per set of a split, from that set's pairs only, and are numbered per area over the
sets, so that their names are unique within a split.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nss_ros.config import GraphConfig
from nss_ros.dataset.challenge import ChallengeEdge, ChallengeGraph, ChallengeNode, write_graph
from nss_ros.dataset.pairs import PairTable
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, relative

_OUTLIER_POSE = np.zeros((4, 4))


@dataclass(frozen=True, slots=True)
class GraphSets:
    """Graphs by set of a split, and why some that were asked for are missing.

    Attributes:
        graphs: graphs of "train", "val", "test".
        skipped: one sentence for each area and set that gave fewer graphs than asked for.
    """

    graphs: dict[str, list[ChallengeGraph]]
    skipped: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Fragments:
    """What a graph tells of its fragments."""

    poses: Mapping[FragmentId, Transform]
    point_counts: Mapping[FragmentId, int]
    refined: Mapping[FragmentPair, Transform]

    def relative(self, pair: FragmentPair) -> Transform:
        """`T_target_source`: refined, or else of the poses."""
        if pair in self.refined:
            return self.refined[pair]
        return relative(_pose(pair.source, self), _pose(pair.target, self))


def multiway_graphs(
    sets: Mapping[str, PairTable],
    poses: Mapping[FragmentId, Transform],
    config: GraphConfig,
    point_counts: Mapping[FragmentId, int] | None = None,
    label: str = "Graph",
    refined: Mapping[FragmentPair, Transform] | None = None,
) -> GraphSets:
    """One graph for each large connected component of each area and set.

    Args:
        sets: all pairs of each set, selected or not, as `splits.split_pairs` gives them; one set
            of all pairs gives the graphs of the whole dataset.
        poses: `T_map_fragment` of every fragment.
        config: least overlap of an edge and fewest nodes of a graph.
        point_counts: points of each fragment, for the files; None: not told.
        label: graphs are named Bldg<area>_<label><number>.
        refined: `T_target_source` of pairs that are known better than by their poses.

    Raises:
        InputError: a fragment has no pose.
    """
    fragments = _Fragments(poses, point_counts or {}, refined or {})
    graphs: dict[str, list[ChallengeGraph]] = {}
    skipped = []
    numbers: dict[str, Iterable[int]] = {}
    for set_name, pairs in sets.items():
        graphs[set_name] = []
        for area, rows in _by_area(pairs).items():
            network = _Network.of(rows.take(rows.overlap_ratio >= config.min_overlap))
            components = [
                nodes for nodes in network.components() if len(nodes) >= config.min_component
            ]
            number = numbers.setdefault(area, count(1))
            for nodes, i in zip(components, number, strict=False):
                drawn = _Drawn(nodes, [], network.edges_among(nodes))
                graphs[set_name].append(_graph(f"Bldg{area}_{label}{i}", network, drawn, fragments))
            if not components:
                largest = max(map(len, network.components()), default=0)
                skipped.append(
                    f"Area {area} has no multi-way graph in the set '{set_name}': the largest "
                    f"connected component has {largest} fragments, and min_component is "
                    f"{config.min_component}."
                )
    return GraphSets(graphs, tuple(skipped))


def challenge_graphs(
    sets: Mapping[str, PairTable],
    poses: Mapping[FragmentId, Transform],
    config: GraphConfig,
    seed: int,
    point_counts: Mapping[FragmentId, int] | None = None,
    label: str = "Graph",
    refined: Mapping[FragmentPair, Transform] | None = None,
) -> GraphSets:
    """Many small graphs with outlier nodes for each area and set.

    The size of each graph is drawn from those that its area has enough fragments for.

    Args:
        sets: all pairs of each set, selected or not, as `splits.split_pairs` gives them; pairs of
            any set count when it comes to what an outlier must not overlap.
        poses: `T_map_fragment` of every fragment.
        config: number, sizes and limits of the graphs.
        seed: of all that is drawn; a graph does not depend on those of other areas or sets.
        point_counts: points of each fragment, for the files; None: not told.
        label: graphs are named Bldg<area>_<label><number>.
        refined: `T_target_source` of pairs that are known better than by their poses.

    Raises:
        InputError: a fragment has no pose.
    """
    fragments = _Fragments(poses, point_counts or {}, refined or {})
    overlapping = _overlapping(sets.values(), config.min_overlap)
    graphs: dict[str, list[ChallengeGraph]] = {}
    skipped = []
    numbers: dict[str, int] = {}
    for set_index, (set_name, pairs) in enumerate(sets.items()):
        graphs[set_name] = []
        members = sorted({*pairs.source, *pairs.target})
        for area, rows in _by_area(pairs).items():
            network = _Network.of(rows.take(rows.overlap_ratio > config.min_overlap))
            grower = _Grower(network.core(config.min_degree), members, area, overlapping, config)
            made = 0
            for index in range(config.graphs_per_area):
                rng = np.random.default_rng((seed, set_index, index, *area.encode()))
                drawn = grower.draw(rng)
                if drawn is None:
                    continue
                made += 1
                number = numbers[area] = numbers.get(area, 0) + 1
                name = f"Bldg{area}_{label}{number}"
                graphs[set_name].append(_graph(name, grower.network, drawn, fragments))
            if made < config.graphs_per_area:
                skipped.append(
                    f"Area {area} gave {made} of {config.graphs_per_area} challenge graphs in the "
                    f"set '{set_name}': {grower.reason()}."
                )
    return GraphSets(graphs, tuple(skipped))


def write_graph_sets(folder: Path, sets: Mapping[str, Sequence[ChallengeGraph]]) -> None:
    """Write each graph as `<folder>/<set>/<name>.json`, as the challenge's release does.

    Raises:
        FormatError: a folder or file cannot be written.
    """
    for name, graphs in sets.items():
        try:
            (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FormatError(
                f"Cannot make the folder {folder / name}: {error.strerror}."
            ) from error
        for graph in graphs:
            write_graph(folder / name / f"{graph.name}.json", graph)


@dataclass(frozen=True, slots=True)
class _Network:
    """Fragments of one area and the pairs that link them.

    Attributes:
        ids: in canonical order.
        pairs: rows of the edges.
        ends: (m, 2) indices of each edge's source and target.
        neighbours: of each fragment.
    """

    ids: list[FragmentId]
    pairs: PairTable
    ends: NDArray[np.int64]
    neighbours: list[set[int]]

    @classmethod
    def of(cls, pairs: PairTable) -> _Network:
        names = pairs.pairs
        pairs = pairs.take(
            np.array(sorted(range(len(names)), key=names.__getitem__), dtype=np.int64)
        )
        ids = sorted({*pairs.source, *pairs.target})
        index = {id_: i for i, id_ in enumerate(ids)}
        ends = np.array(
            [(index[pair.source], index[pair.target]) for pair in pairs.pairs], dtype=np.int64
        ).reshape(-1, 2)
        neighbours: list[set[int]] = [set() for _ in ids]
        for i, j in ends.tolist():
            neighbours[i].add(j)
            neighbours[j].add(i)
        return cls(ids, pairs, ends, neighbours)

    def components(self) -> list[list[int]]:
        """Connected components, the largest first."""
        if not self.ids:
            return []
        links = coo_array((np.ones(len(self.ends)), self.ends.T), shape=(len(self.ids),) * 2)
        number, labels = connected_components(links, directed=False)
        parts = [np.flatnonzero(labels == i).tolist() for i in range(number)]
        return sorted(parts, key=lambda nodes: (-len(nodes), nodes))

    def core(self, degree: int) -> _Network:
        """What is left when fragments with fewer links are taken out again and again."""
        network = self
        while True:
            keep = np.array([len(near) >= degree for near in network.neighbours], dtype=bool)
            if keep.all():
                return network
            linked = np.flatnonzero(keep[network.ends].all(axis=1))
            network = _Network.of(network.pairs.take(linked))

    def edges_among(self, nodes: Collection[int]) -> NDArray[np.int64]:
        """The edges that link two of the nodes."""
        inside = np.zeros(len(self.ids), dtype=bool)
        inside[list(nodes)] = True
        return np.flatnonzero(inside[self.ends].all(axis=1))


@dataclass(frozen=True, slots=True)
class _Drawn:
    inliers: list[int]
    outliers: list[FragmentId]
    edges: NDArray[np.int64]


class _Grower:
    """Draws challenge graphs of one area and set."""

    def __init__(
        self,
        network: _Network,
        members: Sequence[FragmentId],
        area: str,
        overlapping: Mapping[FragmentId, set[FragmentId]],
        config: GraphConfig,
    ) -> None:
        self.network = network
        self._own = [id_ for id_ in members if id_.area == area]
        self._others = [id_ for id_ in members if id_.area != area] if config.other_areas else []
        self._overlapping = overlapping
        self._config = config
        self._parts = network.components()
        available = max(map(len, self._parts), default=0)
        self._sizes = [size for size in sorted(set(config.sizes)) if size <= available]

    def reason(self) -> str:
        """Why graphs are missing."""
        if not self._sizes:
            largest = max(map(len, self._parts), default=0)
            return (
                f"its largest connected part has {largest} fragments of degree "
                f"{self._config.min_degree} or more, and the smallest size is "
                f"{min(self._config.sizes)}"
            )
        return (
            f"no other could be grown in {self._config.attempts} attempts with a mean overlap "
            f"ratio above {self._config.min_mean_overlap}"
        )

    def draw(self, rng: np.random.Generator) -> _Drawn | None:
        """A graph; None if no attempt succeeds."""
        if not self._sizes:
            return None
        size = int(rng.choice(self._sizes))
        outliers = int(rng.integers(0, int(self._config.outlier_share * size + 1e-9) + 1))
        for _ in range(self._config.attempts):
            inliers = self._grow(size - outliers, rng)
            edges = None if inliers is None else self._edges(inliers)
            if inliers is None or edges is None:
                continue
            found = self._outliers(inliers, outliers, rng)
            if len(found) == outliers:
                return _Drawn(inliers, found, edges)
            outliers = len(found)  # as many as there are, the rest are inliers
        return None

    def _grow(self, size: int, rng: np.random.Generator) -> list[int] | None:
        """Nodes of a connected part in which each has enough links, sorted."""
        parts = [part for part in self._parts if len(part) >= size]
        weights = np.array([len(part) for part in parts], dtype=np.float64)
        part = parts[int(rng.choice(len(parts), p=weights / weights.sum()))]
        start = int(rng.choice(part))
        links = {start: 0}
        frontier = dict.fromkeys(sorted(self.network.neighbours[start]), 1)
        degree = self._config.min_degree
        while len(links) < size:
            if not frontier:
                return None
            # Nodes that fulfil the degree at once go first.
            most = min(degree, max(frontier.values()))
            node = int(rng.choice([each for each, count in frontier.items() if count >= most]))
            links[node] = frontier.pop(node)
            for near in sorted(self.network.neighbours[node]):
                if near in links:
                    links[near] += 1
                else:
                    frontier[near] = frontier.get(near, 0) + 1
        return sorted(links) if min(links.values()) >= degree else None

    def _edges(self, nodes: list[int]) -> NDArray[np.int64] | None:
        """All edges among the nodes, without the weakest if their mean is too low."""
        edges = self.network.edges_among(nodes)
        ratios = self.network.pairs.overlap_ratio[edges]
        ends = self.network.ends[edges].tolist()
        near = {node: self.network.neighbours[node].intersection(nodes) for node in nodes}
        kept = np.ones(len(edges), dtype=bool)
        total, number = float(ratios.sum()), len(edges)
        for edge in np.argsort(ratios, kind="stable").tolist():
            if total > self._config.min_mean_overlap * number:
                break
            i, j = ends[edge]
            if min(len(near[i]), len(near[j])) > self._config.min_degree and _cycle(near, i, j):
                near[i].remove(j)
                near[j].remove(i)
                kept[edge] = False
                total, number = total - ratios[edge], number - 1
        return edges[kept] if ratios[kept].mean() > self._config.min_mean_overlap else None

    def _outliers(
        self, inliers: list[int], number: int, rng: np.random.Generator
    ) -> list[FragmentId]:
        """Up to `number` fragments that overlap neither the inliers nor each other."""
        taken = [self.network.ids[node] for node in inliers]
        used = set(taken)
        blocked = set(taken).union(*(self._overlapping.get(id_, set()) for id_ in used))
        found: list[FragmentId] = []
        for candidates in (self._own, self._others):
            for i in rng.permutation(len(candidates)).tolist():
                if len(found) == number:
                    return found
                if candidates[i] not in blocked:
                    found.append(candidates[i])
                    blocked |= {candidates[i]} | self._overlapping.get(candidates[i], set())
        return found


def _cycle(near: Mapping[int, set[int]], start: int, goal: int) -> bool:
    """Whether two linked nodes stay connected without their link."""
    reached, waiting = {start}, [*(near[start] - {goal})]
    while waiting:
        node = waiting.pop(0)
        if goal in near[node]:
            return True
        new = near[node] - reached
        reached |= new
        waiting += new
    return False


def _overlapping(
    tables: Iterable[PairTable], min_overlap: float
) -> dict[FragmentId, set[FragmentId]]:
    """What each fragment overlaps with, in any direction."""
    result: dict[FragmentId, set[FragmentId]] = {}
    for pairs in tables:
        most = np.fmax(pairs.overlap_ratio, pairs.reverse_overlap_ratio)
        for pair in pairs.take(most >= min_overlap).pairs:
            result.setdefault(pair.source, set()).add(pair.target)
            result.setdefault(pair.target, set()).add(pair.source)
    return result


def _by_area(pairs: PairTable) -> dict[str, PairTable]:
    areas = np.array([id_.area for id_ in pairs.source], dtype=object)
    return {area: pairs.take(areas == area) for area in sorted(set(areas))}


def _graph(name: str, network: _Network, drawn: _Drawn, fragments: _Fragments) -> ChallengeGraph:
    ids = sorted([network.ids[node] for node in drawn.inliers] + drawn.outliers)
    numbers = {id_: number for number, id_ in enumerate(ids)}
    rows = network.pairs.take(drawn.edges)
    return ChallengeGraph(
        name,
        tuple(_node(numbers[id_], id_, id_ in drawn.outliers, fragments) for id_ in ids),
        tuple(
            ChallengeEdge(
                numbers[pair.source],
                numbers[pair.target],
                fragments.relative(pair),
                pair.same_stage,
                float(overlap),
                float(change),
            )
            for pair, overlap, change in zip(
                rows.pairs, rows.overlap_ratio, rows.temporal_change, strict=True
            )
        ),
    )


def _node(number: int, id_: FragmentId, outlier: bool, fragments: _Fragments) -> ChallengeNode:
    return ChallengeNode(
        number,
        f"{id_}.ply",
        _OUTLIER_POSE if outlier else _pose(id_, fragments),
        labels=(("building", id_.area), ("stage", str(id_.stage)), ("spot", str(id_.spot))),
        points=fragments.point_counts.get(id_),
    )


def _pose(id_: FragmentId, fragments: _Fragments) -> Transform:
    if id_ not in fragments.poses:
        raise InputError(f"Fragment {id_} has no pose: a graph needs the pose of every fragment.")
    return fragments.poses[id_]

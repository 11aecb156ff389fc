"""What a benchmark runs over: a dataset folder with splits, or a bag with its ground truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from nss_ros.bag import Log, read_log, with_source_points, write_bag
from nss_ros.bag_reader import bag_digest
from nss_ros.dataset.annotate import pair_sets, sets_digest
from nss_ros.dataset.bag_export import dataset_metadata, export_fragments, ground_truth_graph
from nss_ros.dataset.folder import PAIRS_NAME, POSES_NAME, DatasetFolder
from nss_ros.dataset.manifest import MANIFEST_NAME
from nss_ros.dataset.pairs import PairTable
from nss_ros.dataset.splits import Split
from nss_ros.errors import FormatError, InputError
from nss_ros.files import file_digest
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.multiway.pose_graph import PoseGraph


class BatchSplit(StrEnum):
    """Whose pairs are registered: the test pairs of a split, or all."""

    ORIGINAL = "original"
    CROSS_AREA = "cross_area"
    CROSS_STAGE = "cross_stage"
    ALL = "all"


class PairChoice(StrEnum):
    """Which pairs of a split are registered."""

    SELECTED = "selected"
    """The balanced choice of 'nss pairs', as in the pairwise table of the NSS paper; of a bag the
    pairs that it asks for."""
    OVERLAPPING = "overlapping"
    """All that overlap enough, as in its multi-way graphs."""


@dataclass(frozen=True, slots=True)
class Part:
    """Fragments that become one map.

    Attributes:
        fragments: in canonical order.
        pairs: whose answers the map is made of.
    """

    fragments: tuple[FragmentId, ...]
    pairs: tuple[FragmentPair, ...]


class Source(ABC):
    """Fragments, pairs and ground truth.

    Attributes:
        path: of the dataset or bag.
    """

    path: Path

    @abstractmethod
    def fragment_ids(self) -> list[FragmentId]:
        """All fragments."""

    @abstractmethod
    def fragment(self, fragment: FragmentId) -> Fragment:
        """A fragment's points."""

    @abstractmethod
    def table(self, split: BatchSplit, choice: PairChoice, min_overlap: float) -> PairTable:
        """The pairs that are registered; may be none.

        Raises:
            InputError: there is no such split, or overlap ratios are not known.
            FormatError: the pairs cannot be read.
        """

    @abstractmethod
    def parts(self, table: PairTable) -> list[Part]:
        """The maps that are made of the answers to some pairs."""

    @abstractmethod
    def ground_truth(self, table: PairTable) -> list[PoseGraph]:
        """What the answers to some pairs are scored against."""

    @abstractmethod
    def metadata(self) -> dict[str, str]:
        """How it was made, for the logs."""

    @abstractmethod
    def write_fragments(self, path: Path) -> None:
        """Write all fragments as a bag without pairs and ground truth.

        Raises:
            BagError: the folder exists or cannot be written.
        """

    @abstractmethod
    def fingerprint(self) -> dict[str, str]:
        """What tells whether it is the same as before."""

    @abstractmethod
    def sets(self) -> str:
        """What tells whether its pairs are in the same sets of each split as before."""


class DatasetSource(Source):
    """A dataset folder.

    Args:
        dataset: with `pairs.csv`.
    """

    def __init__(self, dataset: DatasetFolder) -> None:
        self.path = dataset.path
        self.dataset = dataset

    def fragment_ids(self) -> list[FragmentId]:
        """All fragments, in canonical order."""
        return self.dataset.fragment_ids()

    def fragment(self, fragment: FragmentId) -> Fragment:
        """A fragment's points."""
        return self.dataset.fragment(fragment)

    def table(self, split: BatchSplit, choice: PairChoice, min_overlap: float) -> PairTable:
        """The test pairs of a split, in the order of the dataset."""
        if not self.dataset.manifest.complete:
            raise InputError(
                f"{self.path} is not complete: finish it with the 'nss simulate' that began it."
            )
        whole = split is BatchSplit.ALL
        sets = pair_sets(self.dataset, None if whole else Split(split))
        table = sets["all" if whole else "test"]
        unknown = {*table.source.tolist(), *table.target.tolist()} - set(self.fragment_ids())
        if unknown:
            raise FormatError(
                f"{self.path / PAIRS_NAME} names {unknown.pop()}, which the dataset does not "
                f"have: run 'nss pairs {self.path}' again."
            )
        if choice is PairChoice.SELECTED:
            return table.take(table.selected)
        return table.take(table.overlap_ratio >= min_overlap)

    def parts(self, table: PairTable) -> list[Part]:
        """One for each area, of the fragments that are in a pair."""
        return [Part(tuple(_fragments_of(t)), tuple(t.pairs)) for t in _by_area(table).values()]

    def ground_truth(self, table: PairTable) -> list[PoseGraph]:
        """One graph for each area, of the pairs and their fragments."""
        return [
            _only_of(ground_truth_graph(self.dataset, area, part), part)
            for area, part in _by_area(table).items()
        ]

    def metadata(self) -> dict[str, str]:
        """Every setting of the dataset."""
        return dataset_metadata(self.dataset)

    def write_fragments(self, path: Path) -> None:
        """Write all fragments as a bag."""
        export_fragments(path, self.dataset)

    def fingerprint(self) -> dict[str, str]:
        """Of its pairs and poses."""
        names = (PAIRS_NAME, POSES_NAME)
        files = {name: file_digest(self.path / name) for name in names}
        return files | {"seed": str(self.dataset.manifest.seed)}

    def sets(self) -> str:
        """Of seed and settings of the splits."""
        return sets_digest(self.dataset)


class BagSource(Source):
    """A bag, or a log that is to be registered again; all of it is one split, and one map.

    Args:
        path: folder of a rosbag2 MCAP bag, or one `.mcap` file.

    Raises:
        BagError: there is no bag, or it cannot be read.
        InputError: it lacks point clouds, pairs or ground truth.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log: Log = with_source_points(read_log(path))
        for lacks, what in (
            (not self._log.fragments, "point clouds"),
            (not any(graph.edges for graph in self._log.ground_truth), "ground-truth edges"),
        ):
            if lacks:
                raise InputError(
                    f"The bag {path} holds no {what}, so methods cannot be compared on it: import "
                    "a folder with true poses and edges, or map it with 'nss map'."
                )
        for pair in self._pairs():
            unknown = {pair.source, pair.target} - self._log.fragments.keys()
            if unknown:
                raise InputError(
                    f"The bag {path} asks for {pair}, but {unknown.pop()} is not in it."
                )

    def _pairs(self) -> list[FragmentPair]:
        """Those that are asked for; without any, the edges of the ground truth."""
        edges = (edge.pair for graph in self._log.ground_truth for edge in graph.edges)
        chosen: dict[frozenset[FragmentId], FragmentPair] = {}
        for pair in self._log.pairs or edges:
            chosen.setdefault(frozenset((pair.source, pair.target)), pair)
        return list(chosen.values())

    def fragment_ids(self) -> list[FragmentId]:
        """All fragments, in the order of the bag."""
        return list(self._log.fragments)

    def fragment(self, fragment: FragmentId) -> Fragment:
        """A fragment's points."""
        return self._log.fragments[fragment]

    def table(self, split: BatchSplit, choice: PairChoice, min_overlap: float) -> PairTable:
        """The pairs that the bag asks for, in its order; ratios are those of the ground truth."""
        if split is not BatchSplit.ALL:
            raise InputError(
                f"The bag {self.path} has no split '{split}': splits are those of a dataset, whose "
                "test pairs 'nss import DATASET --split' makes a bag of; leave --split out."
            )
        pairs = self._pairs()
        known = {
            frozenset((edge.pair.source, edge.pair.target)): edge
            for graph in reversed(self._log.ground_truth)
            for edge in graph.edges
        }
        edges = [known.get(frozenset((pair.source, pair.target))) for pair in pairs]
        nothing = np.full(len(pairs), np.nan)
        ratios = np.array([np.nan if edge is None else edge.overlap_ratio for edge in edges])
        changes = np.array([np.nan if edge is None else edge.temporal_change for edge in edges])
        ids = np.array([(pair.source, pair.target) for pair in pairs], dtype=object).reshape(-1, 2)
        chosen = np.ones(len(pairs), dtype=bool)
        table = PairTable(
            ids[:, 0], ids[:, 1], ratios, nothing, changes, nothing, nothing, chosen
        )  # fmt: skip
        if choice is PairChoice.SELECTED:
            return table
        if np.isnan(ratios).all():
            raise InputError(
                f"The bag {self.path} tells no overlap ratios, so its overlapping pairs are not "
                "known: leave --pairs out, and all that it asks for are taken."
            )
        return table.take(ratios >= min_overlap)

    def parts(self, table: PairTable) -> list[Part]:
        """All fragments, as the pose-graph node has them."""
        return [Part(tuple(sorted(self._log.fragments)), tuple(table.pairs))]

    def ground_truth(self, table: PairTable) -> list[PoseGraph]:
        """The graphs of the bag; without the edges of pairs that were left out."""
        left_out = {frozenset((pair.source, pair.target)) for pair in self._pairs()}
        left_out -= {frozenset((pair.source, pair.target)) for pair in table.pairs}
        return [
            replace(
                graph,
                edges=tuple(
                    edge
                    for edge in graph.edges
                    if frozenset((edge.pair.source, edge.pair.target)) not in left_out
                ),
            )
            for graph in self._log.ground_truth
        ]

    def metadata(self) -> dict[str, str]:
        """That of the bag; of a log without what it tells of its run."""
        own = ("bag_", "benchmark.")
        return {k: v for k, v in self._log.metadata.items() if not k.startswith(own)}

    def write_fragments(self, path: Path) -> None:
        """Write all fragments as a bag."""
        write_bag(path, self._log.fragments.values(), (), (), self.metadata())

    def fingerprint(self) -> dict[str, str]:
        """Of all its bytes."""
        return {"bag": bag_digest(self.path)[:16]}

    def sets(self) -> str:
        """Nothing: a bag has no splits."""
        return ""


def open_source(path: Path) -> Source:
    """The dataset or bag at a path.

    Raises:
        FormatError: it is neither, or a dataset that cannot be read.
        BagError: it is a bag that cannot be read.
        InputError: it is a bag that lacks what a benchmark needs.
    """
    if (path / MANIFEST_NAME).exists():
        return DatasetSource(DatasetFolder(path))
    if path.is_file() or any(path.glob("*.mcap")):
        return BagSource(path)
    raise FormatError(
        f"{path} is neither a dataset, which has a {MANIFEST_NAME}, nor a bag, which has .mcap "
        "files: make a dataset with 'nss simulate', or a bag with 'nss import'."
    )


def _fragments_of(pairs: PairTable) -> list[FragmentId]:
    """The fragments of some pairs, in canonical order."""
    return sorted({*pairs.source.tolist(), *pairs.target.tolist()})


def _by_area(table: PairTable) -> dict[str, PairTable]:
    areas = np.array([id_.area for id_ in table.source], dtype=object)
    return {area: table.take(areas == area) for area in dict.fromkeys(areas.tolist())}


def _only_of(graph: PoseGraph, pairs: PairTable) -> PoseGraph:
    """A graph without the fragments that are in none of the pairs."""
    wanted = set(_fragments_of(pairs))
    nodes = tuple(node for node in graph.nodes if node.id in wanted)
    return PoseGraph(nodes, graph.edges, graph.name)

import numpy as np
import pytest

from nss_ros.config import SplitConfig
from nss_ros.dataset.annotate import divided
from nss_ros.dataset.challenge import ChallengeEdge, ChallengeGraph, ChallengeNode
from nss_ros.dataset.folder import GRAPH_FOLDER, SPLIT_FOLDER, DatasetFolder, FragmentColumns
from nss_ros.dataset.graphs import write_graph_sets
from nss_ros.dataset.manifest import Manifest
from nss_ros.dataset.pairs import PairTable, write_pairs
from nss_ros.dataset.site_record import SiteRecord
from nss_ros.dataset.splits import write_split
from nss_ros.dataset.statistics import (
    area_table,
    dataset_tables,
    graph_table,
    pair_table,
    split_table,
)
from nss_ros.dataset.writer import DatasetWriter
from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw


def ids(area):
    return [FragmentId(area, stage, spot) for stage in (1, 2) for spot in (1, 2, 3)[:stage]]


def ring(count):
    """A wall of 2 m radius around the scanner."""
    angles = np.arange(count) * (2 * np.pi / count)
    return np.column_stack((2 * np.cos(angles), 2 * np.sin(angles), np.zeros(count)))


def place(fragment):
    """Spots of a stage are far apart, those of different stages at the same places."""
    return from_yaw(0.5, (10.0 * fragment.spot, 0.0, 1.6))


@pytest.fixture
def dataset(tmp_path):
    writer = DatasetWriter(tmp_path / "set", Manifest(seed=0, simulation={}, labels=False))
    for area in ("A", "B"):
        site = SiteRecord(
            area=area, stages=2, stage_names=[], extent=(0, 0, 40, 10), floor_height=0, elements=[]
        )
        writer.begin_area(site, {})
        for fragment in ids(area):
            points = ring(400 if area == "A" else 800).astype(np.float32)
            normals = np.full_like(points, 0.5)
            writer.append(fragment, place(fragment), FragmentColumns(points, normals))
        writer.finish_area(area)
    writer.finish()
    return DatasetFolder(tmp_path / "set")


def pairs_of(areas):
    rows = [
        (source, target)
        for area in areas
        for i, source in enumerate(ids(area))
        for target in ids(area)[i + 1 :]
    ]
    columns = [np.empty(len(rows), dtype=object) for _ in range(2)]
    for column, end in zip(columns, zip(*rows, strict=True), strict=True):
        column[:] = end
    overlap = np.tile([0.05, 0.1, 0.5], len(areas))
    values = [overlap, overlap, overlap, np.full(len(rows), 0.04), np.full(len(rows), 0.04)]
    return PairTable(*columns, *values, selected=overlap > 0.3)


def test_areas_have_their_stages_floor_fragments_and_points(dataset):
    first, second, total = area_table(dataset).rows
    disc = np.pi * 2**2
    assert first == ("A", 2, pytest.approx(2 * disc, rel=0.05), 3, "1 + 2", 400.0)
    assert second == ("B", 2, pytest.approx(2 * disc, rel=0.05), 3, "1 + 2", 800.0)
    assert total == ("total", 4, pytest.approx(first[2] + second[2]), 6, None, 600.0)


def test_every_fragment_is_reported_once(dataset):
    seen = []
    area_table(dataset, seen.append)
    assert seen == dataset.fragment_ids()


def test_pairs_are_counted_by_area_kind_and_overlap():
    # Of each area: 1-1 to 2-1 (0.05), 1-1 to 2-2 (0.1), 2-1 to 2-2 (0.5, selected).
    assert pair_table(pairs_of("AB")).rows == (
        ("A", 1, 2, 1, 1, 1, 0),
        ("B", 1, 2, 1, 1, 1, 0),
        ("total", 2, 4, 2, 2, 2, 0),
    )
    assert pair_table(pairs_of("A")).rows == (("A", 1, 2, 1, 1, 1, 0),)


def test_a_table_of_no_pairs_has_no_rows():
    assert pair_table(pairs_of("A").take(np.zeros(3, dtype=bool))).rows == ()


def test_splits_have_their_sets_in_order(dataset):
    pairs = pairs_of("AB")
    pairs = pairs.select(np.ones(len(pairs), dtype=bool))
    config = SplitConfig(validation_share=0, train_areas=("A",), test_areas=("B",))
    for split, sets in divided(pairs, config, 0).splits.items():
        write_split(dataset.path / SPLIT_FOLDER / split, sets)
    rows = split_table(dataset).rows
    assert [row[:2] for row in rows] == [
        (split, name)
        for split in ("original", "cross_area", "cross_stage")
        for name in ("train", "val", "test")
    ]
    assert sum(row[5] for row in rows[:3]) == len(pairs)
    assert rows[3:6] == (
        ("cross_area", "train", 3, 1, 2, 3),
        ("cross_area", "val", 0, 0, 0, 0),
        ("cross_area", "test", 3, 1, 2, 3),
    )
    assert rows[8] == ("cross_stage", "test", 4, 2, 0, 2)


def graph(name, outliers):
    nodes = [ChallengeNode(i, f"{id_}.ply", place(id_)) for i, id_ in enumerate(ids("A"))]
    nodes += [
        ChallengeNode(10 + i, f"{FragmentId('B', 1, i + 1)}.ply", np.zeros((4, 4)))
        for i in range(outliers)
    ]
    edges = (
        ChallengeEdge(0, 1, None, same_stage=False, overlap_ratio=0.2),
        ChallengeEdge(1, 2, None, same_stage=True, overlap_ratio=0.6),
    )
    return ChallengeGraph(name, tuple(nodes), edges)


def test_graphs_are_summed_by_set(dataset):
    sets = {"test": [graph("one", 0), graph("two", 2)], "train": [graph("three", 1)], "val": []}
    write_graph_sets(dataset.path / GRAPH_FOLDER, sets)
    mean = pytest.approx(0.4)
    assert graph_table(dataset).rows == (
        ("challenge", "train", 1, 4, "4", 1, 1, mean, 1),
        ("challenge", "test", 2, 8, "3-5", 2, 2, mean, 2),
    )


def test_only_tables_with_data_are_given(dataset):
    assert list(dataset_tables(dataset)) == ["areas"]
    write_pairs(dataset.path / "pairs.csv", pairs_of("AB"))
    write_graph_sets(dataset.path / GRAPH_FOLDER, {"all": [graph("one", 0)]})
    assert list(dataset_tables(dataset)) == ["areas", "pairs", "graphs"]

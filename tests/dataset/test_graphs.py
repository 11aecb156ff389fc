from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from nss_ros.config import GraphConfig, SplitConfig
from nss_ros.dataset.challenge import fragment_ids, ground_truth, read_graphs
from nss_ros.dataset.graphs import challenge_graphs, multiway_graphs, write_graph_sets
from nss_ros.dataset.splits import Split, split_pairs
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import relative
from nss_ros.multiway.pose_graph import NodeStatus

CONFIG = GraphConfig(sizes=(12, 20, 40), graphs_per_area=6)


def links(graph):
    """Neighbours of each node of a graph."""
    near = {node.id: set() for node in graph.nodes}
    for edge in graph.edges:
        near[edge.source].add(edge.target)
        near[edge.target].add(edge.source)
    return near


def connected(nodes, near):
    reached, waiting = set(), [next(iter(nodes))]
    while waiting:
        node = waiting.pop()
        if node not in reached:
            reached.add(node)
            waiting += near[node]
    return reached == set(nodes)


def overlaps(pairs):
    """The larger overlap ratio of every two fragments that overlap at all."""
    most = np.maximum(pairs.overlap_ratio, pairs.reverse_overlap_ratio)
    return {frozenset((p.source, p.target)): o for p, o in zip(pairs.pairs, most, strict=True)}


@pytest.fixture(scope="module", params=list(Split))
def drawn(request, building):
    config = SplitConfig(validation_areas=("2",), train_areas=("1",), test_areas=("3",))
    sets = split_pairs(building.pairs, request.param, config, 0)
    return sets, challenge_graphs(sets, building.poses, CONFIG, seed=5)


def test_graphs_fulfil_the_rules_of_the_challenge(drawn, building):
    _, result = drawn
    overlap = overlaps(building.pairs)
    graphs = [graph for found in result.graphs.values() for graph in found]
    assert len(graphs) > 10
    for graph in graphs:
        assert len(graph.nodes) in CONFIG.sizes
        outliers = {node.id for node in graph.nodes if node.outlier}
        inliers = {node.id for node in graph.nodes} - outliers
        near = links(graph)
        assert len(outliers) <= 0.1 * len(graph.nodes)
        assert connected(inliers, near)
        assert all(len(near[node]) >= 2 for node in inliers)
        assert not any(near[node] for node in outliers)
        ratios = [edge.overlap_ratio for edge in graph.edges]
        assert min(ratios) > 0.1
        assert np.mean(ratios) > 0.3
        ids = fragment_ids(graph)
        for outlier in outliers:
            for other in set(ids) - {outlier}:
                assert overlap.get(frozenset((ids[outlier], ids[other])), 0) < 0.1
    assert any(node.outlier for graph in graphs for node in graph.nodes)


def test_graphs_are_made_of_the_pairs_of_their_set(drawn, building):
    sets, result = drawn
    for name, graphs in result.graphs.items():
        members = {*sets[name].source, *sets[name].target}
        rows = {pair: i for i, pair in enumerate(sets[name].pairs)}
        for graph in graphs:
            assert set(fragment_ids(graph).values()) <= members
            for edge in ground_truth(graph).edges:
                row = rows[edge.pair]
                assert edge.overlap_ratio == sets[name].overlap_ratio[row]
                assert edge.temporal_change == sets[name].temporal_change[row]
                np.testing.assert_allclose(
                    edge.T_target_source,
                    relative(building.poses[edge.pair.source], building.poses[edge.pair.target]),
                    atol=1e-12,
                )
    names = Counter(graph.name for graphs in result.graphs.values() for graph in graphs)
    assert max(names.values()) == 1


def test_missing_graphs_are_explained(drawn, building):
    sets, result = drawn
    asked = sum(len({id_.area for id_ in pairs.source}) for pairs in sets.values()) * 6
    made = sum(map(len, result.graphs.values()))
    assert (made < asked) == bool(result.skipped)
    large = GraphConfig(sizes=(500,), graphs_per_area=2)
    result = challenge_graphs({"test": building.pairs}, building.poses, large, 0)
    assert result.graphs == {"test": []}
    assert len(result.skipped) == 3
    assert "gave 0 of 2 challenge graphs" in result.skipped[0]
    assert "72 fragments" in result.skipped[0]
    strict = GraphConfig(sizes=(20,), graphs_per_area=1, min_mean_overlap=0.84)
    result = challenge_graphs({"test": building.pairs}, building.poses, strict, 0)
    assert "mean overlap ratio above 0.84" in result.skipped[0]


def test_the_same_seed_gives_the_same_graphs_whatever_the_order(building, tmp_path):
    order = np.random.default_rng(0).permutation(len(building.pairs))
    made = {}
    for name, pairs, seed in (
        ("a", building.pairs, 1),
        ("b", building.pairs.take(order), 1),
        ("c", building.pairs, 2),
    ):
        graphs = challenge_graphs({"test": pairs}, building.poses, CONFIG, seed).graphs
        write_graph_sets(tmp_path / name, graphs)
        made[name] = [file.read_bytes() for file in sorted((tmp_path / name).rglob("*.json"))]
    assert made["a"] == made["b"]
    assert made["a"] != made["c"]


def test_outliers_of_a_crowded_area_come_from_other_areas(make_building):
    crowded = make_building(areas=("1", "2"), stages=1, spots=24, size=3.0)
    config = GraphConfig(sizes=(20,), graphs_per_area=8)
    found = challenge_graphs({"test": crowded.pairs}, crowded.poses, config, 0).graphs["test"]
    areas = {
        (graph.name[:5], fragment_ids(graph)[node.id].area)
        for graph in found
        for node in graph.nodes
        if node.outlier
    }
    assert areas == {("Bldg1", "2"), ("Bldg2", "1")}
    alone = GraphConfig(sizes=(20,), graphs_per_area=8, other_areas=False)
    found = challenge_graphs({"test": crowded.pairs}, crowded.poses, alone, 0).graphs["test"]
    assert len(found) == 16
    assert not any(node.outlier for graph in found for node in graph.nodes)


def test_multiway_graphs_hold_whole_components(building):
    result = multiway_graphs({"test": building.pairs}, building.poses, GraphConfig())
    graphs = result.graphs["test"]
    assert [graph.name for graph in graphs] == ["Bldg1_Graph1", "Bldg2_Graph1", "Bldg3_Graph1"]
    for graph in graphs:
        truth = ground_truth(graph)
        area = graph.name[4]
        assert connected({node.id for node in graph.nodes}, links(graph))
        assert {node.status for node in truth.nodes} == {NodeStatus.PLACED}
        assert len({node.id.stage for node in truth.nodes}) == 3
        enough = building.pairs.take(building.pairs.overlap_ratio >= 0.1)
        assert {edge.pair for edge in truth.edges} == {
            pair for pair in enough.pairs if pair.source.area == area
        }


def test_small_components_are_left_out(make_table, building):
    def chain(area, spots):
        ids = [FragmentId(area, 1, spot) for spot in spots]
        return [(a, b, 0.5, 0.5, 0.1, 0.05, 0.05) for a, b in pairwise(ids)]

    rows = chain("1", range(1, 6)) + chain("1", range(10, 17)) + chain("2", range(1, 3))
    rows.append((FragmentId("1", 1, 5), FragmentId("1", 1, 10), 0.09, 0.5, 0.1, 0.05, 0.05))
    config = GraphConfig(min_component=5)
    result = multiway_graphs(
        {"train": make_table(rows), "test": make_table([])}, building.poses, config, label="Whole"
    )
    sizes = [(graph.name, len(graph.nodes)) for graph in result.graphs["train"]]
    assert sizes == [("Bldg1_Whole1", 7), ("Bldg1_Whole2", 5)]
    assert result.graphs["test"] == []
    assert len(result.skipped) == 1
    assert "Area 2 has no multi-way graph in the set 'train'" in result.skipped[0]
    assert "has 2 fragments, and min_component is 5" in result.skipped[0]


def test_files_are_those_of_the_release_and_read_back(building, tmp_path):
    counts = {id_: 1000 + id_.spot for id_ in building.poses}
    graphs = challenge_graphs({"val": building.pairs}, building.poses, CONFIG, 0, counts).graphs
    write_graph_sets(tmp_path, graphs)
    for graph in graphs["val"]:
        (read,) = read_graphs(tmp_path / "val" / f"{graph.name}.json")
        assert read.name == graph.name
        assert read.edges is not None
        for node, same in zip(graph.nodes, read.nodes, strict=True):
            assert (node.id, node.name, node.labels) == (same.id, same.name, same.labels)
            assert same.points == counts[FragmentId.parse(node.name)]
            np.testing.assert_array_equal(node.transform, same.transform)
        for edge, same in zip(graph.edges, read.edges, strict=True):
            assert (edge.source, edge.target, edge.same_stage) == (
                same.source, same.target, same.same_stage
            )  # fmt: skip
            assert edge.overlap_ratio == same.overlap_ratio
            assert edge.temporal_change == same.temporal_change
    (tmp_path / "file").touch()
    with pytest.raises(FormatError, match="Cannot make the folder"):
        write_graph_sets(tmp_path / "file", graphs)


def test_a_fragment_without_pose_is_named(building):
    poses = dict(building.poses)
    del poses[FragmentId("2", 1, 1)]
    with pytest.raises(InputError, match="Bldg2_Stage1_Spot1 has no pose"):
        multiway_graphs({"test": building.pairs}, poses, GraphConfig())


def test_sizes_must_allow_the_degree():
    with pytest.raises(ValidationError, match="every size must be more than min_degree"):
        GraphConfig(sizes=(20, 2))

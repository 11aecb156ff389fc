import io

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection, QuadMesh
from PIL import Image

from nss_ros.dataset.figures import (
    pair_figure,
    plan_figure,
    spatiotemporal_figure,
    write_figure,
)
from nss_ros.dataset.pairs import PairTable
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, relative
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph


def graph_of(stages, spots=4):
    """Spots two metres apart in a row, every neighbour and every two stages linked, one outlier."""
    nodes = [
        Node(
            FragmentId("A", stage, spot), from_yaw(0.1, (2.0 * spot, stage, 1.6)), NodeStatus.PLACED
        )
        for stage in range(1, stages + 1)
        for spot in range(1, spots + 1)
    ]
    edges = []
    for i, one in enumerate(nodes):
        for other in nodes[i + 1 :]:
            pair = FragmentPair(one.id, other.id)
            if abs(one.id.spot - other.id.spot) == (1 if pair.same_stage else 0):
                kind = EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE
                transform = relative(one.T_map_fragment, other.T_map_fragment)
                edges.append(Edge(pair, transform, kind, overlap_ratio=0.4))
    outlier = FragmentId("A", 1, 99)
    nodes.append(Node(outlier, status=NodeStatus.OUTLIER))
    edges.append(Edge(FragmentPair(nodes[0].id, outlier), np.eye(4), EdgeKind.SAME_STAGE))
    return PoseGraph(tuple(nodes), tuple(edges), "BldgA_Graph1")


def panels(figure):
    return [axes for axes in figure.axes if axes.get_title()]


def dots(axes):
    """Places of all spots drawn, (n, 2)."""
    spots = [c for c in axes.collections if isinstance(c, PathCollection)]
    return np.concatenate([np.asarray(collection.get_offsets()) for collection in spots])


def lines(axes):
    drawn = [c for c in axes.collections if isinstance(c, LineCollection)]
    return [line for collection in drawn for line in collection.get_segments()]


def pairs_of(count, seed=0):
    """Pairs of one area with two stages, one in ten without complexity and change."""
    rng = np.random.default_rng(seed)
    ids = [FragmentId("A", stage, spot) for stage in (1, 2) for spot in range(1, 60)]
    every = [(a, b) for i, a in enumerate(ids) for b in ids[i + 1 :]]
    rows = [every[i] for i in rng.choice(len(every), count, replace=False)]
    source, target = (np.empty(count, dtype=object) for _ in range(2))
    for i, (a, b) in enumerate(rows):
        source[i], target[i] = a, b
    numbers = rng.random((3, count))
    unknown = np.arange(count) % 10 == 0
    return PairTable(
        source,
        target,
        numbers[0],
        numbers[0],
        np.where(unknown, np.nan, numbers[1]),
        np.where(unknown, np.nan, 0.1 * numbers[2]),
        np.full(count, 0.03),
        selected=numbers[0] > 0.5,
    )


def joints(figure):
    """The joint distributions: shares in percent of the panels' cells, from left to right."""
    meshes = [c for axes in figure.axes for c in axes.collections if isinstance(c, QuadMesh)]
    return [
        np.ma.filled(mesh.get_array(), 0.0).reshape(20, 20)
        for mesh in meshes
        if mesh.axes.get_ylabel()
    ]


@pytest.mark.parametrize("selected", [False, True])
def test_the_joint_distributions_are_those_of_the_pairs(selected):
    pairs = pairs_of(900)
    figure = pair_figure(pairs, selected)
    drawn = joints(figure)
    assert len(drawn) == 4
    for number, side in enumerate((pairs.same_stage, ~pairs.same_stage)):
        mask = side & (pairs.selected | (not selected))
        for values, end, mesh in (
            (pairs.temporal_change, 1.0, drawn[2 * number]),
            (pairs.complexity, 0.08, drawn[2 * number + 1]),
        ):
            here = mask & np.isfinite(values)
            expected = np.zeros((20, 20))
            for x, y in zip(pairs.overlap_ratio[here], values[here], strict=True):
                expected[int(y / end * 20), int(x * 20)] += 100 / mask.sum()
            assert np.allclose(mesh, expected)
    titles = [half.get_suptitle() for half in figure.subfigs]
    same = (pairs.same_stage & (pairs.selected | (not selected))).sum()
    assert titles[0] == f"Same stage ({same})"


def test_figures_of_all_and_of_selected_pairs_have_the_same_scales():
    pairs = pairs_of(300)
    figures = [pair_figure(pairs, selected) for selected in (False, True)]
    limits = [[(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes] for figure in figures]
    assert limits[0] == limits[1]


def test_a_dataset_without_pairs_can_be_drawn(tmp_path):
    write_figure(tmp_path / "none.png", pair_figure(pairs_of(0), selected=True))


@pytest.mark.parametrize("stages", [1, 2, 3, 4, 5])
def test_a_plan_has_a_panel_per_stage_with_its_spots_and_edges(stages):
    graph = graph_of(stages)
    drawn = panels(plan_figure(graph))
    assert [axes.get_title() for axes in drawn] == [
        f"Stage {stage}: 4 spots, 3 edges" for stage in range(1, stages + 1)
    ]
    for stage, axes in enumerate(drawn, start=1):
        assert np.allclose(dots(axes), [(2.0 * spot, stage) for spot in (1, 2, 3, 4)])
        assert np.allclose(lines(axes)[0], [(2.0, stage), (4.0, stage)])
    limits = {(axes.get_xlim(), axes.get_ylim(), axes.get_aspect()) for axes in drawn}
    assert len(limits) == 1


def test_a_spatiotemporal_graph_shows_all_edges_between_placed_nodes():
    figure = spatiotemporal_figure(graph_of(3))
    (axes,) = figure.axes
    assert len(dots(axes)) == 12
    assert len(lines(axes)) == 3 * 3 + 4 * 3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:3] == ["stage 3", "stage 2", "stage 1"]
    assert labels[3:] == ["edge within a stage (9)", "edge between stages (12)"]
    assert axes.get_title() == "BldgA_Graph1: 13 nodes, 22 edges, 1 not placed"
    levels = dots(axes).reshape(3, 4, 2)[:, 0, 1] - 0.45 * np.arange(1, 4)  # less what y adds
    assert levels[0] < levels[1] < levels[2]


def test_a_graph_without_poses_is_refused():
    graph = PoseGraph((Node(FragmentId("A", 1, 1)),), (), "empty")
    for draw in (plan_figure, spatiotemporal_figure):
        with pytest.raises(InputError, match="'empty' has no node with a pose"):
            draw(graph)


@pytest.mark.parametrize(
    ("ending", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("PDF", b"%PDF")]
)
def test_files_are_of_their_ending_and_the_same_every_time(tmp_path, ending, start):
    for name in ("one", "two"):
        write_figure(tmp_path / f"{name}.{ending}", plan_figure(graph_of(2)))
    data = (tmp_path / f"one.{ending}").read_bytes()
    assert data.startswith(start)
    assert data == (tmp_path / f"two.{ending}").read_bytes()


def test_a_png_has_ink(tmp_path):
    write_figure(tmp_path / "plan.png", spatiotemporal_figure(graph_of(2)))
    pixels = np.asarray(Image.open(io.BytesIO((tmp_path / "plan.png").read_bytes())).convert("L"))
    assert 0.01 < (pixels < 250).mean() < 0.6


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"must end with \.png, \.svg or \.pdf"):
        write_figure(tmp_path / "plan.jpg", plan_figure(graph_of(1)))


def test_drawing_leaves_the_settings_of_matplotlib_alone():
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    plan_figure(graph_of(1))
    assert dict(mpl.rcParams) == before

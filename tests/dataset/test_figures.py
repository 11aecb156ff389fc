import io

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from PIL import Image

from nss_ros.dataset.figures import plan_figure, spatiotemporal_figure, write_figure
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

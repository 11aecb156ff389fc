"""Logs in Rerun: written to a file, and read back with Rerun's own reader."""

import socket
import sys
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from nss_ros.bag import read_log, write_bag
from nss_ros.cli.main import app
from nss_ros.colors import REJECTED, stage_color
from nss_ros.errors import BagError, FormatError, InputError
from nss_ros.fragment import FragmentPair
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, Node
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed
from nss_ros.viewing.scene import Scene, _layout
from nss_ros.viewing.sink import recording

pytest.importorskip("rerun")


def run(*arguments):
    return CliRunner().invoke(app, ["view", *map(str, arguments)])


def read(path):
    """Columns of all chunks by entity path: lists of what each row holds."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    assert reader.blueprints()
    content = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            if "timestamp" in str(values.type):
                continue
            rows = content.setdefault(str(chunk.entity_path), {}).setdefault(name, [])
            rows += values.to_pylist()
    return content


def column(content, path, name):
    (values,) = [v for key, v in content[path].items() if key.endswith(name)]
    return values


@pytest.fixture
def log(room, tmp_path, record):
    fragments = [replace(f, points=f.points[::10]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    return record(tmp_path / "bag", unanswered=2)


def test_a_log_is_written_as_a_file_that_rerun_reads(log, room, tmp_path):
    file = tmp_path / "run.rrd"
    result = run(log, "--save", file)
    assert result.exit_code == 0, result.output
    assert str(file) in result.stdout.replace("\n", "")
    content = read(file)
    stages = sorted({fragment.id.stage for fragment in room.fragments})
    for stage in stages:
        points = column(content, f"/map/stage_{stage}", "positions")[-1]
        assert len(points) > 100
        assert column(content, f"/map/stage_{stage}", "colors")[-1] == [packed(stage_color(stage))]
        labels = column(content, f"/graph/stage_{stage}", "Points3D:labels")[-1]
        assert labels == [str(f.id) for f in room.fragments if f.id.stage == stage]
    positions = [
        column(content, f"/fragments/stage_{f.id.stage}/{f.id}", "translation")[-1][0]
        for f in room.fragments
    ]
    truth = [node.T_map_fragment[:3, 3] for node in read_log(log).pose_graph.nodes]
    assert np.allclose(positions, truth, atol=1e-5)
    answers = list(read_log(log).relative_transforms.values())
    values = column(content, "/answers/confidence", "scalars")
    assert [value for (value,) in values] == [each.confidence for each in answers]
    assert column(content, "/answers/seconds", "answer") == list(range(len(answers)))
    assert len(column(content, "/graph/confidence", "strips")[-1]) == len(answers)
    assert len(column(content, "/graph/accepted", "strips")[-1]) == len(room.pairs)
    assert column(content, "/graph/rejected", "strips")[-1] == []


def packed(color):
    red, green, blue = (round(255 * value) for value in color)
    return (red << 24) + (green << 16) + (blue << 8) + 255


def test_what_changes_is_drawn_again(room, tmp_path):
    """A node goes, a stage with it; a rejected edge is red and tells why."""
    graph = room.ground_truth
    pair = FragmentPair(graph.nodes[0].id, graph.nodes[1].id)
    bad = Edge(pair, np.eye(4), EdgeKind.SAME_STAGE, EdgeStatus.REJECTED, "it is wrong")
    first = replace(graph, edges=(*graph.edges, bad))
    kept = [n if n.id.stage == 1 else Node(n.id) for n in graph.nodes]
    fragments = {fragment.id: fragment for fragment in room.fragments}
    answers = [
        RelativeTransform(pair, "test", confidence=1.0),
        failed(room.pairs[1], "test", Reason.TOO_FEW_INLIERS, "no"),
    ]
    with recording("test", tmp_path / "run.rrd") as stream:
        scene = Scene(stream, changing=True)
        scene.draw_graph(first, {each.pair: each for each in answers})
        scene.draw_map(first, fragments)
        scene.add_answers(answers)
        scene.add_answers([replace(answers[0], compute_time=2.0)])
        scene.draw_map(replace(first, nodes=tuple(kept)), fragments)
    content = read(tmp_path / "run.rrd")
    assert column(content, "/graph/rejected", "colors") == [[packed(REJECTED)]]
    assert len(column(content, "/graph/rejected", "strips")[0]) == 1
    assert "it is wrong" in column(content, "/rejected", "text")[0][0]
    assert len(column(content, "/graph/confidence", "strips")[0]) == 1
    clouds = column(content, "/map/stage_2", "positions")
    assert len(clouds[0]) > 0
    assert clouds[1] == []
    gone = next(node.id for node in kept if node.id.stage == 2)
    assert any("Clear" in name for name in content[f"/fragments/stage_2/{gone}"])
    assert column(content, "/answers/seconds", "answer") == [0, 1, 2]
    assert column(content, "/answers/rmse", "answer") == [0, 2]


def test_doubtful_places_are_marked(room, tmp_path):
    first, *others = room.ground_truth.nodes
    doubted = replace(room.ground_truth, nodes=(replace(first, doubtful=True), *others))
    file = tmp_path / "run.rrd"
    with recording("test", file) as stream:
        scene = Scene(stream, changing=True)
        for graph in (doubted, room.ground_truth):
            scene.draw_graph(graph, {})
    content = read(file)
    labels = column(content, "/graph/doubtful", "Points3D:labels")
    assert list(labels[0]) == [f"{first.id}: doubtful"]
    around = column(content, "/graph/doubtful", "positions")
    assert [len(each) for each in around] == [1, 0]


def test_components_that_nothing_links_have_a_view_each(room, tmp_path):
    """Two components, then the third fragment goes over to the other; then all are one."""
    graph = room.ground_truth
    fragments = {fragment.id: fragment for fragment in room.fragments}

    def split(at):
        nodes = [replace(n, component=int(i >= at)) for i, n in enumerate(graph.nodes)]
        of = {node.id: node.component for node in nodes}
        edges = [e for e in graph.edges if of[e.pair.source] == of[e.pair.target]]
        return replace(graph, nodes=tuple(nodes), edges=tuple(edges))

    file = tmp_path / "run.rrd"
    with recording("test", file) as stream:
        scene = Scene(stream, changing=True)
        for at in (4, 3, 6):
            scene.draw_graph(split(at), {})
            scene.draw_map(split(at), fragments)
    content = read(file)
    main = column(content, "/graph/accepted", "strips")
    other = column(content, "/component_1/graph/accepted", "strips")
    assert [len(strips) for strips in main] == [6, 3, 15]
    assert [len(strips) for strips in other] == [1, 3]
    assert [
        len(labels) for labels in column(content, "/component_1/graph/stage_2", "Points3D:labels")
    ] == [2, 3]
    clouds = column(content, "/component_1/map/stage_2", "positions")
    assert [len(cloud) > 0 for cloud in clouds] == [True, True, False]
    moved = graph.nodes[3].id
    path = f"/fragments/stage_2/{moved}"
    assert any("Clear" in name for name in content[path])
    assert any("Clear" in name for name in content[f"/component_1{path}"])
    assert any("Clear" in name for name in content["/component_1/graph"])
    assert "/component_1/fragments/stage_1" not in {each.rsplit("/", 1)[0] for each in content}


def test_every_component_has_a_view_of_its_map_its_answers_and_its_fragments():
    names = ("Map by stage", "Confidence", "Fragments")
    for components in (1, 3):
        tabs = _layout(components).root_container.contents[0]
        assert tuple(each.name for each in tabs.contents) == names
        for tab in tabs.contents:
            shown = [tab] if components == 1 else tab.contents
            assert len(shown) == components
            for number, view in enumerate(shown):
                name = f"Component {number}" if number else "Largest"
                assert components == 1 or view.name == name
                roots = {path.split("/")[1] for path in view.contents}
                assert all(root.startswith("component_") == (number > 0) for root in roots)
                assert number == 0 or roots == {f"component_{number}"}


def test_bad_inputs_are_named(log, tmp_path, monkeypatch):
    def error(*arguments):
        result = run(*arguments)
        assert result.exit_code != 0
        return result.exception

    file = tmp_path / "run.rrd"
    assert isinstance(error(tmp_path / "nothing", "--save", file), BagError)
    assert "holds neither answers nor a map" in str(error(tmp_path / "bag", "--save", file))
    assert not list(tmp_path.glob("*.rrd*"))
    assert not list(tmp_path.glob(".*"))
    assert "either a LOG" in str(error())
    assert "either a LOG" in str(error(log, "--live"))
    assert "either --save or --connect" in str(error(log, "--save", file, "--connect", "x"))
    assert isinstance(error(log, "--save", tmp_path / "no" / "run.rrd"), FormatError)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"rerun+http://127.0.0.1:{closed.getsockname()[1]}/proxy"
    found = error(log, "--connect", url)
    assert isinstance(found, InputError)
    assert f"No Rerun viewer listens at {url}" in str(found)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'rerun-sdk'" in str(error(log, "--save", file))


def test_a_viewer_elsewhere_gets_it(log):
    import rerun

    server = rerun.RecordingStream("test_server")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = server.serve_grpc(grpc_port=port)
    result = run(log, "--connect", url)
    server.disconnect()
    assert result.exit_code == 0, result.output

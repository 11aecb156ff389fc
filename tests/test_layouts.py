"""The layouts for Foxglove and RViz name topics, fields and markers that there are."""

import json
import re
from pathlib import Path

import pytest
import yaml

from nss_ros import topics
from nss_ros.colors import stage_color
from nss_ros.topics import Topic, component_map, component_markers, part_of_map, stage_map
from nss_ros.typestore import jazzy_typestore

_CONFIG = Path(__file__).parents[1] / "config"
_FOXGLOVE = json.loads((_CONFIG / "nss.foxglove.json").read_text())["configById"]
_RVIZ = yaml.safe_load((_CONFIG / "nss.rviz").read_text())["Visualization Manager"]
_STAGES = range(1, 7)
_COMPONENTS = range(1, 3)
_TOPICS = {
    f"/{topic.name.lstrip('/')}": topic
    for topic in (
        *(value for value in vars(topics).values() if isinstance(value, Topic)),
        *map(stage_map, _STAGES),
        *map(component_map, _COMPONENTS),
        *map(component_markers, _COMPONENTS),
    )
}
_CLASSES = {
    "rviz_default_plugins/PointCloud2": "sensor_msgs/msg/PointCloud2",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
}
_MARKERS = {
    *(f"stage_{stage}" for stage in _STAGES),
    "accepted_edges",
    "rejected_edges",
    "doubtful",
}


def panels(kind):
    found = [panel for name, panel in _FOXGLOVE.items() if name.split("!")[0] == kind]
    assert found
    return found


def check_path(path):
    """A Foxglove message path: /topic.field[:]{field==1}.field."""
    name, *parts = re.split(r"\.(?![^{]*\})", path)
    assert name in _TOPICS, path
    fields = jazzy_typestore().fielddefs
    kind = _TOPICS[name].type
    for part in parts:
        field, filters = re.fullmatch(r"(\w+)(?:\[:\])?((?:\{.*\})?)", part).groups()
        kind = nested(dict(fields[kind][1])[field])
        for wanted in re.findall(r"\{(\w+)==", filters):
            assert wanted in dict(fields[kind][1]), path


def nested(definition):
    """The type of a field, of its elements if it is a sequence."""
    kind, value = definition
    if kind.name in ("ARRAY", "SEQUENCE"):
        return nested(value[0])
    return value if kind.name == "NAME" else value[0]


def test_foxglove_shows_topics_that_there_are():
    shown = panels("3D")[0]["topics"]
    kinds = {"sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"}
    for name in shown:
        assert _TOPICS[name].type in kinds
    assert {"/map", "/markers", "/map/stage_1"} <= shown.keys()
    assert set(shown["/markers"]["namespaces"]) == _MARKERS
    assert all(each["visible"] for each in shown["/markers"]["namespaces"].values())
    (diagnostics,) = panels("DiagnosticSummary")
    assert _TOPICS[diagnostics["topicToRender"]].type == "diagnostic_msgs/msg/DiagnosticArray"
    for panel in panels("Plot"):
        for path in panel["paths"]:
            check_path(path["value"])
    for panel in (*panels("Table"), *panels("RawMessages")):
        check_path(panel["topicPath"])
    with pytest.raises(KeyError):
        check_path("/pose_graph.colour")


def test_foxglove_shows_components_in_their_frames():
    main, *others = panels("3D")
    assert main["followTf"] == "map"
    for number, panel in zip(_COMPONENTS, others, strict=True):
        assert panel["followTf"] == f"map_{number}"
        assert panel["topics"] == {
            f"/map/component_{number}": main["topics"]["/map"],
            f"/markers/component_{number}": main["topics"]["/markers"],
        }
        assert panel["topics"].keys() <= _TOPICS.keys()


def test_parts_of_the_map_are_known_by_their_names():
    for topic in (stage_map(0), stage_map(12), component_map(1), component_markers(30)):
        assert part_of_map(topic.name) == topic
    strangers = ("map", "map/component_0", "map/component_01", "map/stage_x", "markers/stage_1")
    assert [part_of_map(name) for name in (*strangers, "amap/stage_1", "")] == [None] * 7


def test_foxglove_lays_out_every_panel_once():
    layout = json.loads((_CONFIG / "nss.foxglove.json").read_text())
    tabs = [tab["layout"] for panel in panels("Tab") for tab in panel["tabs"]]
    names = re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])) + tabs
    assert sorted(names) == sorted(_FOXGLOVE)


def test_rviz_shows_topics_that_there_are():
    named = {}
    for display in _RVIZ["Displays"]:
        if "Topic" in display:
            topic = _TOPICS[display["Topic"]["Value"]]
            assert topic.type == _CLASSES[display["Class"]]
            durability = "Transient Local" if topic.latched else "Volatile"
            assert display["Topic"]["Durability Policy"] == durability
            assert display["Topic"]["Reliability Policy"] == "Reliable"
            named[display["Topic"]["Value"]] = display
    of_components = {f"/{of}/component_{n}" for of in ("map", "markers") for n in _COMPONENTS}
    stages = {f"/map/stage_{stage}" for stage in _STAGES}
    assert {"/map", "/markers"} | stages | of_components == named.keys()
    assert set(named["/markers"]["Namespaces"]) == _MARKERS
    # What is in another frame is an error until the fixed frame is set to that.
    for name in of_components:
        assert not named[name]["Enabled"]
        assert f"(fixed frame map_{name[-1]})" in named[name]["Name"]
        if name.startswith("/markers"):
            assert set(named[name]["Namespaces"]) == _MARKERS
    assert _RVIZ["Global Options"]["Fixed Frame"] == "map"


def test_stages_have_the_same_colours_everywhere():
    for stage in _STAGES:
        octets = [round(255 * value) for value in stage_color(stage)]
        name = f"/map/stage_{stage}"
        assert panels("3D")[0]["topics"][name]["flatColor"] == "#" + bytes(octets).hex()
        (display,) = (d for d in _RVIZ["Displays"] if d.get("Topic", {}).get("Value") == name)
        assert display["Color"] == "; ".join(map(str, octets))


def test_markers_have_these_names(room):
    pytest.importorskip("rclpy")
    from nss_ros.nodes.markers import graph_markers

    names = {marker.ns for marker in graph_markers(room.ground_truth, "map").markers if marker.ns}
    assert names <= _MARKERS
    assert {"accepted_edges", "rejected_edges", "stage_1"} <= names

"""A running graph in Rerun: what nodes publish is in the file."""

import json
import time

import pytest
from typer.testing import CliRunner

from nss_msgs.msg import Fragment, PoseGraph, RelativeTransform
from nss_ros import topics
from nss_ros.messages import (
    fragment_message,
    pose_graph_message,
    relative_transform_message,
    rosidl_family,
)
from nss_ros.nodes.viewer import LiveView
from nss_ros.registration import relative_transform
from nss_ros.viewing.scene import Scene
from nss_ros.viewing.sink import recording

pytest.importorskip("rerun")


@pytest.mark.ros
def test_a_late_viewer_draws_what_was_published_before(graph, room, tmp_path):
    from rerun.chunk import RrdReader

    publishers = graph.publishers(
        {
            topics.FRAGMENTS: Fragment,
            topics.RELATIVE_TRANSFORMS: RelativeTransform,
            topics.POSE_GRAPH: PoseGraph,
        }
    )
    family = rosidl_family()
    for fragment in room.fragments:
        publishers[topics.FRAGMENTS].publish(fragment_message(fragment, 1, family))
    for pair in room.pairs:
        answer = relative_transform.RelativeTransform(pair, "test", confidence=0.5)
        publishers[topics.RELATIVE_TRANSFORMS].publish(
            relative_transform_message(answer, 1, family)
        )
    publishers[topics.POSE_GRAPH].publish(pose_graph_message(room.ground_truth, "map", 1, family))
    expected = (len(room.fragments), len(room.pairs), len(room.fragments))
    file = tmp_path / "live.rrd"
    with recording("live", file) as stream:
        view = LiveView(Scene(stream, changing=True))
        try:
            end = time.monotonic() + 60
            while view.counts != expected:
                assert time.monotonic() < end, json.dumps(view.counts)
                view.spin(0.2)
            view.spin(0.2)
        finally:
            view.close()
    paths = {str(chunk.entity_path) for chunk in RrdReader(str(file)).stream()}
    for fragment in room.fragments:
        assert f"/fragments/stage_{fragment.id.stage}/{fragment.id}" in paths
    assert {"/map/stage_1", "/graph/accepted", "/graph/confidence", "/answers/confidence"} <= paths


@pytest.mark.ros
def test_the_command_ends_by_itself_after_its_duration(tmp_path):
    from nss_ros.cli.main import app

    file = tmp_path / "live.rrd"
    result = CliRunner().invoke(app, ["view", "--live", "--duration", "1", "--save", str(file)])
    assert result.exit_code == 0, result.output
    assert file.exists()

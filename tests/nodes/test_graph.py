"""Nodes one by one: late joiners, restarts, slow consumers, services, parameters."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("nss_msgs.msg")

from geometry_msgs.msg import PoseWithCovariance
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from nss_msgs.msg import Fragment, FragmentPair, PlaybackStatus, PoseGraph, RelativeTransform
from nss_msgs.srv import AddConstraint, MapFile, RemoveConstraint
from nss_ros import topics
from nss_ros.bag import read_log
from nss_ros.bag_writer import BagWriter
from nss_ros.messages import pose_message, rosidl_family

pytestmark = pytest.mark.ros


def set_parameter(graph, node: str, name: str, value):
    request = Parameter(name, value=value).to_parameter_msg()
    return graph.call(SetParameters, f"/{node}/set_parameters", parameters=[request]).results[0]


def test_no_node_waits_for_torch():
    """Its worker processes need it; it takes seconds to import."""
    names = ("fragment_player", "registration", "pose_graph", "recorder")
    modules = ", ".join(f"nss_ros.nodes.{name}" for name in names)
    code = f"import sys, {modules}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_late_joiners_get_everything(graph, room_bag, room):
    statuses = graph.listen(topics.PLAYBACK_STATUS, PlaybackStatus)
    graph.start("fragment_player", bags=[str(room_bag)], wait_for_subscribers=0.5)
    graph.wait(lambda: statuses and statuses[-1].state == PlaybackStatus.STATE_FINISHED)
    graph.start("registration")
    answers = graph.listen(topics.RELATIVE_TRANSFORMS, RelativeTransform)
    graph.wait(lambda: len(answers) == len(room.pairs))
    graph.start("pose_graph")
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    graph.wait_until_settled(graphs, len(room.pairs), len(room.fragments))
    clouds = graph.listen(topics.MAP, PointCloud2)
    stage = graph.listen(topics.stage_map(2), PointCloud2)
    graph.wait(lambda: clouds and stage)
    assert [field.name for field in clouds[0].fields] == ["x", "y", "z", "stage"]
    assert clouds[0].width > stage[0].width > 0


def test_no_node_that_estimates_sees_ground_truth(graph, room_bag):
    for executable in ("pose_graph", "registration"):
        graph.start(executable)
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait(lambda: graph.node.count_publishers("/ground_truth") == 1)
    graph.wait(lambda: graph.node.count_subscribers("/fragments") == 2)
    assert graph.node.count_subscribers("/ground_truth") == 0


def test_a_restarted_worker_answers_only_what_is_open(graph, room_bag, room):
    answers = graph.listen(topics.RELATIVE_TRANSFORMS, RelativeTransform)
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    graph.start("pose_graph")
    first = graph.start("registration")
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait(lambda: len(answers) >= 4)
    graph.wait(lambda: graphs and len(graphs[-1].edges) >= 3)
    first.kill()
    graph.start("registration", "registration_again")
    graph.wait_until_settled(graphs, len(room.pairs), len(room.fragments))
    # What was on its way to the pose graph at the kill is answered again, with the same result.
    poses: dict = {}
    for answer in answers:
        pose = poses.setdefault((answer.source_id, answer.target_id), answer.pose)
        assert answer.pose == pose
    assert len(poses) == len(room.pairs)
    assert len(answers) < len(room.pairs) + 3


def test_a_dead_worker_process_costs_nothing(graph, room_bag, room):
    answers = graph.listen(topics.RELATIVE_TRANSFORMS, RelativeTransform)
    node = graph.start("registration")
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait(lambda: len(answers) >= 2)
    children = [
        int(line)
        for line in open(f"/proc/{node.pid}/task/{node.pid}/children").read().split()  # noqa: PTH123, SIM115
    ] or _descendants(node.pid)
    os.kill(children[-1], signal.SIGKILL)
    graph.wait(lambda: len(answers) == len(room.pairs))
    assert all(answer.status == RelativeTransform.STATUS_OK for answer in answers)


def _descendants(pid: int) -> list[int]:
    found = []
    for task in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208
        with open(f"/proc/{pid}/task/{task}/children") as children:  # noqa: PTH123
            found += [int(child) for child in children.read().split()]
    return found


def test_a_slow_consumer_loses_nothing(graph, room_bag, room):
    received = []

    def take_time(message: Fragment) -> None:
        time.sleep(0.3)
        received.append(message.id)

    from nss_ros.nodes.qos import subscription_qos

    graph.node.create_subscription(
        Fragment, "fragments", take_time, subscription_qos(topics.FRAGMENTS)
    )
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait(lambda: len(received) == len(room.fragments))
    assert received == [str(fragment.id) for fragment in room.fragments]


def test_pause_holds_and_resume_goes_on(graph, room_bag, room):
    statuses = graph.listen(topics.PLAYBACK_STATUS, PlaybackStatus)
    fragments = graph.listen(topics.FRAGMENTS, Fragment)
    graph.start("fragment_player", bags=[str(room_bag)], start_paused=True)
    graph.wait(lambda: statuses and statuses[-1].state == PlaybackStatus.STATE_PAUSED)
    assert graph.call(Trigger, "/fragment_player/pause").success
    assert not fragments
    assert graph.call(Trigger, "/fragment_player/resume").success
    graph.wait(lambda: statuses[-1].state == PlaybackStatus.STATE_FINISHED)
    graph.wait(lambda: len(fragments) == len(room.fragments))


def test_the_clock_comes_first_and_runs_between_the_messages(graph, room_bag):
    clocks = graph.listen(topics.CLOCK, Clock)
    fragments = graph.listen(topics.FRAGMENTS, Fragment)
    statuses = graph.listen(topics.PLAYBACK_STATUS, PlaybackStatus)
    graph.start(
        "fragment_player", bags=[str(room_bag)], rate=0.5, start_offset=1.0, start_paused=True
    )
    graph.wait(lambda: clocks)
    assert not fragments
    assert graph.call(Trigger, "/fragment_player/resume").success
    graph.wait(lambda: statuses and statuses[-1].state == PlaybackStatus.STATE_FINISHED)
    stamps = [clock.clock.sec + clock.clock.nanosec * 1e-9 for clock in clocks]
    assert stamps == sorted(stamps)
    assert stamps[0] > 1e9
    # Fragments lie 0.5 s apart in the bag: any other stamp was interpolated.
    assert any(stamp % 0.5 > 0 for stamp in stamps)


def test_services_of_the_pose_graph(graph, room_bag, room, tmp_path):
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    graph.start("pose_graph")
    saved = graph.call(MapFile, "/pose_graph/save_map", path=str(tmp_path / "early"))
    assert saved.code == MapFile.Response.EMPTY_MAP

    graph.start("registration")
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait_until_settled(graphs, len(room.pairs), len(room.fragments))

    saved = graph.call(MapFile, "/pose_graph/save_map", path=str(tmp_path / "map"))
    assert saved.code == MapFile.Response.OK, saved.message
    again = graph.call(MapFile, "/pose_graph/save_map", path=str(tmp_path / "map"))
    assert again.code == MapFile.Response.FILE_ERROR
    assert "exists already" in again.message
    missing = graph.call(MapFile, "/pose_graph/load_map", path=str(tmp_path / "nowhere"))
    assert missing.code == MapFile.Response.FILE_ERROR

    for ending in ("g2o", "tum", "ply"):
        path = str(tmp_path / f"map.{ending}")
        assert graph.call(MapFile, "/pose_graph/save_map", path=path).code == MapFile.Response.OK
    odd = graph.call(MapFile, "/pose_graph/save_map", path=str(tmp_path / "map.doc"))
    assert odd.code == MapFile.Response.FORMAT_ERROR

    pair = room.pairs[0]
    removed = graph.call(
        RemoveConstraint,
        "/pose_graph/remove_constraint",
        source_id=str(pair.source),
        target_id=str(pair.target),
    )
    assert removed.code == RemoveConstraint.Response.OK
    wrong = np.eye(4)
    wrong[:3, 3] = (30, 0, 0)
    added = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        source_id=str(pair.source),
        target_id=str(pair.target),
        pose=pose_message(wrong, np.zeros((6, 6)), rosidl_family()),
    )
    assert added.code == AddConstraint.Response.OK, added.message
    assert graph.call(Trigger, "/pose_graph/optimize").success
    edges = [
        e
        for e in graphs[-1].edges
        if (e.source_id, e.target_id) == tuple(map(str, (pair.source, pair.target)))
    ]
    assert {edge.kind for edge in edges} >= {2}
    assert any("excluded" in edge.reason for edge in edges)

    unknown = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        source_id="Bldg7_Stage1_Spot1",
        target_id=str(pair.target),
        pose=pose_message(np.eye(4), np.zeros((6, 6)), rosidl_family()),
    )
    assert unknown.code == AddConstraint.Response.UNKNOWN_FRAGMENT
    nonsense = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        source_id=str(pair.source),
        target_id=str(pair.target),
        pose=PoseWithCovariance(),
    )
    # ROS messages start with the identity, so nonsense needs a broken quaternion.
    assert nonsense.code == AddConstraint.Response.OK
    broken = PoseWithCovariance()
    broken.pose.orientation.w = 0.0
    nonsense = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        source_id=str(pair.source),
        target_id=str(pair.target),
        pose=broken,
    )
    assert nonsense.code == AddConstraint.Response.INVALID_POSE

    assert graph.call(Trigger, "/pose_graph/reset").success
    graph.wait(lambda: len(graphs[-1].nodes) == 0)
    loaded = graph.call(MapFile, "/pose_graph/load_map", path=str(tmp_path / "map"))
    assert loaded.code == MapFile.Response.OK, loaded.message
    graph.wait_until_settled(graphs, len(room.pairs), len(room.fragments))
    placed = [node for node in graphs[-1].nodes if node.status == 1 and node.component == 0]
    assert len(placed) == len(room.fragments)
    assert read_log(tmp_path / "map").pose_graph.poses().keys() == {
        fragment.id for fragment in room.fragments
    }


def test_a_pair_of_unknown_fragments_is_answered(graph):
    answers = graph.listen(topics.RELATIVE_TRANSFORMS, RelativeTransform)
    (pairs,) = graph.publishers({topics.FRAGMENT_PAIRS: FragmentPair}).values()
    graph.start("registration", fragment_timeout=1.0)
    pairs.publish(FragmentPair(source_id="Bldg1_Stage1_Spot1", target_id="Bldg1_Stage1_Spot2"))
    pairs.publish(FragmentPair(source_id="what", target_id="ever"))
    graph.wait(lambda: answers)
    assert answers[0].reason == RelativeTransform.REASON_UNKNOWN_FRAGMENT
    assert "Bldg1_Stage1_Spot1" in answers[0].message
    graph.wait(lambda: "'what' is not a fragment id" in graph.output("registration"))


def test_parameters_are_checked_live(graph, room_bag, room):
    graph.start("registration")
    answers = graph.listen(topics.RELATIVE_TRANSFORMS, RelativeTransform)
    refused = set_parameter(graph, "registration", "fpfh.voxel_size", -0.1)
    assert not refused.successful
    assert "fpfh.voxel_size" in refused.reason
    assert not set_parameter(graph, "registration", "seed", "many").successful
    assert set_parameter(graph, "registration", "method", "fpfh_fgr").successful
    graph.start("fragment_player", bags=[str(room_bag)])
    graph.wait(lambda: len(answers) == len(room.pairs))
    assert {answer.method for answer in answers} == {"fpfh_fgr"}


def test_an_unknown_method_is_refused_live(graph):
    graph.start("registration")
    assert set_parameter(graph, "registration", "method", "magic").successful is False


@pytest.mark.parametrize(
    ("executable", "changes", "sentence"),
    [
        ("registration", {"voxel_size": -1.0}, "voxel_size"),
        ("registration", {"method": "magic"}, "no registration method 'magic'"),
        ("registration", {"shard_index": 3}, "shard_index 3 must be less than shard_count 1"),
        ("registration", {"seed": "zero"}, "seed"),
        ("pose_graph", {"synchronizer": "magic"}, "no synchronizer 'magic'"),
        ("pose_graph", {"start": "luck"}, "start"),
        ("fragment_player", {}, "has no bag"),
        ("fragment_player", {"bags": ["/nowhere"]}, "no bag at /nowhere"),
        ("recorder", {}, "has no output"),
        ("recorder", {"output": "/proc/log"}, "/proc/log"),
        ("recorder", {"output": "x", "metadata_file": "/nowhere.json"}, "/nowhere.json"),
    ],
)
def test_a_wrong_parameter_ends_the_node_with_a_sentence(graph, executable, changes, sentence):
    process = graph.start(executable, **changes)
    graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    output = graph.output(executable)
    assert sentence in output
    assert "Traceback" not in output


def test_a_foreign_bag_is_refused_by_the_player(graph, tmp_path):
    with BagWriter(tmp_path / "foreign") as writer:
        writer.add_topic("/clock", topics.CLOCK)
    process = graph.start("fragment_player", bags=[str(tmp_path / "foreign")])
    graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    assert "holds no fragment" in graph.output("fragment_player")

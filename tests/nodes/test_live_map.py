"""The node pose_graph while fragments and answers come in, of the bundled bag."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nss_msgs.msg")

from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from nss_msgs.msg import Fragment as FragmentMessage
from nss_msgs.msg import FragmentPair as PairMessage
from nss_msgs.msg import PoseGraph, RelativeTransform
from nss_msgs.srv import AddConstraint, RemoveConstraint
from nss_ros import topics
from nss_ros.bag import read_log
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.geometry import from_yaw, relative
from nss_ros.messages import (
    fragment_message,
    pair_message,
    points_from,
    pose_from,
    pose_graph_from,
    pose_message,
    relative_transform_message,
    rosidl_family,
)
from nss_ros.multiway.multi_stage_map import map_points
from nss_ros.multiway.pose_graph import PoseGraph as PoseGraphOfCore
from nss_ros.registration import relative_transform

pytestmark = pytest.mark.ros

_BAG = Path(__file__).parents[2] / "bags" / "three_stages"
_SUBMAP = 3


class Feed:
    """Publishes fragments of the bag, pairs, and answers of its own making to a graph."""

    def __init__(self, graph):
        log = read_log(_BAG)
        (truth,) = log.ground_truth
        self.fragments, self.pairs = log.fragments, log.pairs
        self.poses = {id_: node.T_map_fragment for id_, node in truth.poses().items()}
        self._publishers = graph.publishers(
            {
                topics.FRAGMENTS: FragmentMessage,
                topics.FRAGMENT_PAIRS: PairMessage,
                topics.RELATIVE_TRANSFORMS: RelativeTransform,
            }
        )
        self._family = rosidl_family()

    def ids(self, stage, *spots):
        return [FragmentId("1", stage, spot) for spot in spots]

    def asked(self, ids):
        return [pair for pair in self.pairs if {pair.source, pair.target} <= set(ids)]

    def truth(self, pair):
        return relative(self.poses[pair.source], self.poses[pair.target])

    def give(self, ids):
        for id_ in ids:
            message = fragment_message(self.fragments[id_], 1, self._family)
            self._publishers[topics.FRAGMENTS].publish(message)

    def ask(self, pairs):
        for pair in pairs:
            self._publishers[topics.FRAGMENT_PAIRS].publish(pair_message(pair, 1, self._family))

    def answer(self, pair, right=True):
        transform = self.truth(pair)
        if not right:
            transform = transform @ from_yaw(2.0, (3.0, -1.0, 0.0))
        answer = relative_transform.RelativeTransform(
            pair, "test", transform, np.eye(6) * 1e-4, confidence=0.7, inliers=1000
        )
        message = relative_transform_message(answer, 1, self._family)
        self._publishers[topics.RELATIVE_TRANSFORMS].publish(message)


def names(pair):
    return str(pair.source), str(pair.target)


def submap_edges(message):
    return {(e.source_id, e.target_id) for e in message.edges if e.kind == _SUBMAP}


def status(message, pair):
    """Of its answer."""
    (edge,) = (
        e for e in message.edges if (e.source_id, e.target_id) == names(pair) and e.kind in (0, 1)
    )
    return edge.status


def places(message):
    poses = {n.id: pose_from(n.pose)[0] for n in message.nodes if n.status == 1}
    first = poses[min(poses)]
    return {id_: relative(pose, first) for id_, pose in poses.items()}


@pytest.fixture
def live(graph):
    """A settled map of two stages, in which one answer is wrong; its feed, answers and graphs."""
    feed = Feed(graph)
    old = [*feed.ids(1, 1, 2, 4, 6), *feed.ids(2, 4, 5, 6)]
    pairs = feed.asked(old)[::2]
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    graph.start("pose_graph")
    feed.give(old)
    feed.ask(pairs)
    for number, pair in enumerate(pairs):
        feed.answer(pair, right=number > 0)
    graph.wait_until_settled(graphs, len(pairs), len(old))
    assert submap_edges(graphs[-1])
    assert [status(graphs[-1], pair) for pair in pairs] == [1] + [0] * (len(pairs) - 1)
    return feed, old, pairs, graphs


def test_a_settled_map_stays_while_a_stage_comes_in(graph, live):
    feed, old, pairs, graphs = live
    settled = graphs[-1]
    new = feed.ids(3, 3, 4)
    fresh = [pair for pair in feed.asked([*old, *new]) if {pair.source, pair.target} & {*new}]
    # One is never answered, so that the map does not settle.
    feed.ask(fresh)
    feed.give(new)
    for pair in fresh[1:]:
        feed.answer(pair)
    graph.wait(lambda: graphs[-1].pairs_answered == len(pairs) + len(fresh) - 1)
    graph.wait(lambda: {str(id_) for id_ in new} <= places(graphs[-1]).keys())
    for message in graphs[graphs.index(settled) :]:
        assert submap_edges(message) == submap_edges(settled)
        assert status(message, pairs[0]) == 1
        now, before = places(message), places(settled)
        moved = [np.linalg.norm((now[id_] - before[id_])[:3, 3]) for id_ in before]
        assert max(moved) < 0.05

    # A person has the last word, here and now.
    excluded, given = pairs[1], pairs[2]
    removed = graph.call(
        RemoveConstraint,
        "/pose_graph/remove_constraint",
        **dict(zip(("source_id", "target_id"), names(excluded), strict=True)),
    )
    assert removed.code == RemoveConstraint.Response.OK
    graph.wait(lambda: status(graphs[-1], excluded) == 1)
    assert submap_edges(graphs[-1])
    elsewhere = feed.truth(given) @ from_yaw(0.8, (3.0, 2.0, 0.0))
    added = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        **dict(zip(("source_id", "target_id"), names(given), strict=True)),
        pose=pose_message(elsewhere, np.eye(6) * 1e-4, rosidl_family()),
    )
    assert added.code == AddConstraint.Response.OK
    graph.wait(lambda: any(edge.kind == 2 for edge in graphs[-1].edges))
    now = places(graphs[-1])
    found = relative(now[names(given)[0]], now[names(given)[1]])
    assert np.linalg.norm((found - elsewhere)[:3, 3]) < 0.1


def test_clouds_come_seldom_but_the_settled_map_does(graph):
    feed = Feed(graph)
    ids = feed.ids(1, 1, 2, 4, 6)
    pairs = feed.asked(ids)
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    clouds = graph.listen(topics.MAP, PointCloud2)
    stage = graph.listen(topics.stage_map(1), PointCloud2)
    graph.start("pose_graph", map_rate=1e-9, synchronizer="choi")
    feed.ask(pairs)
    feed.give(ids)
    graph.wait(lambda: graphs and len(graphs[-1].nodes) == len(ids))
    for pair in pairs[:-1]:
        count = len(graphs)
        feed.answer(pair)
        graph.wait(lambda count=count: len(graphs) > count)
    feed.answer(pairs[-1])
    graph.wait_until_settled(graphs, len(pairs), len(ids))

    def expected():
        fragments = {id_: Fragment(id_, voxelize(feed.fragments[id_].points, 0.05)) for id_ in ids}
        return map_points(fragments, pose_graph_from(graphs[-1]), 0.1)[0]

    graph.wait(lambda: clouds and stage and clouds[-1].width == len(expected()))
    # Poses in messages are rounded, so that a point may fall into the next voxel.
    distances, _ = cKDTree(points_from(clouds[-1])).query(expected())
    assert np.quantile(distances, 0.99) < 1e-3
    # Messages of two topics come in any order.
    graph.wait(lambda: stage[-1].data == clouds[-1].data)
    # One when there was none yet; then that of the settled map.
    assert len(clouds) <= 2
    assert len(graphs) > len(pairs)

    # Settled again as it was before, there is nothing to publish.
    count = len(clouds)
    settled = len(graphs)
    assert graph.call(Trigger, "/pose_graph/optimize").success
    graph.wait(lambda: any(message.settled for message in graphs[settled:]))
    assert len(clouds) == count


def test_clouds_come_late_but_they_come(graph):
    """Also when an answer is never given."""
    feed = Feed(graph)
    ids = feed.ids(1, 1, 2, 4, 6)
    pairs = feed.asked(ids)
    clouds = graph.listen(topics.MAP, PointCloud2)
    # Some seconds between two.
    graph.start("pose_graph", map_rate=0.2, synchronizer="choi")
    feed.ask(pairs)
    feed.give(ids)
    feed.answer(pairs[0])
    graph.wait(lambda: clouds and clouds[-1].width > 0)
    first = clouds[-1].width
    for pair in pairs[1:-1]:
        feed.answer(pair)
    graph.wait(lambda: clouds[-1].width > 1.2 * first)


def test_components_are_shown_in_frames_of_their_own(graph):
    """Until somebody says how they lie to each other."""
    feed = Feed(graph)
    large, small = feed.ids(1, 1, 2, 4, 6), feed.ids(2, 4, 5, 6)
    graphs = graph.listen(topics.POSE_GRAPH, PoseGraph)
    clouds = graph.listen(topics.component_map(1), PointCloud2)
    whole = graph.listen(topics.MAP, PointCloud2)
    markers = graph.listen(topics.component_markers(1), MarkerArray)
    transforms = graph.listen(topics.TF, TFMessage)
    graph.start("pose_graph", synchronizer="choi")
    pairs = [*feed.asked(large), *feed.asked(small)]
    feed.ask(pairs)
    feed.give([*large, *small])
    for pair in pairs:
        feed.answer(pair)
    graph.wait_until_settled(graphs, len(pairs), len(large) + len(small))
    poses = pose_graph_from(graphs[-1]).poses()
    assert {id_: node.component for id_, node in poses.items()} == dict.fromkeys(
        large, 0
    ) | dict.fromkeys(small, 1)
    fragments = {id_: Fragment(id_, voxelize(feed.fragments[id_].points, 0.05)) for id_ in small}
    nodes = tuple(replace(poses[id_], component=0) for id_ in small)
    expected, _ = map_points(fragments, PoseGraphOfCore(nodes), 0.1)
    graph.wait(lambda: clouds and clouds[-1].width == len(expected))
    assert clouds[-1].header.frame_id == "map_1"
    distances, _ = cKDTree(points_from(clouds[-1])).query(expected)
    assert np.quantile(distances, 0.99) < 1e-3
    graph.wait(lambda: whole)
    assert whole[-1].header.frame_id == "map"

    def spots():
        return sum(
            len(each.points)
            for each in markers[-1].markers
            if each.ns.startswith("stage_") and each.header.frame_id == "map_1"
        )

    graph.wait(lambda: markers and spots() == len(small))
    graph.wait(
        lambda: (
            transforms
            and {
                each.child_frame_id
                for each in transforms[-1].transforms
                if each.header.frame_id == "map_1"
            }
            == {str(id_) for id_ in small}
        )
    )

    link = FragmentPair(small[0], large[0])
    added = graph.call(
        AddConstraint,
        "/pose_graph/add_constraint",
        source_id=str(link.source),
        target_id=str(link.target),
        pose=pose_message(feed.truth(link), np.eye(6) * 1e-4, rosidl_family()),
    )
    assert added.code == AddConstraint.Response.OK
    graph.wait(lambda: clouds[-1].width == 0 and spots() == 0)
    stages = graph.listen(topics.stage_map(2), PointCloud2)
    graph.wait(lambda: stages and stages[-1].width > 0)


def test_nothing_stays_after_a_reset(graph, live):
    feed, old, pairs, graphs = live
    assert graph.call(Trigger, "/pose_graph/reset").success
    graph.wait(lambda: not graphs[-1].nodes)
    # Never answered, so that the map is not solved thoroughly again.
    feed.ask([feed.pairs[-1]])
    graph.wait(lambda: graphs[-1].pairs_requested == 1)
    feed.give(old)
    for pair in pairs:
        feed.answer(pair)
    graph.wait(lambda: len(graphs[-1].edges) >= len(pairs) and graphs[-1].settled)
    assert [status(graphs[-1], pair) for pair in pairs] == [0] * len(pairs)
    assert not submap_edges(graphs[-1])

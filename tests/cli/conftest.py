"""A recorded log without running the graph."""

from dataclasses import replace

import numpy as np
import pytest

from nss_ros import topics
from nss_ros.bag import read_log
from nss_ros.bag_reader import BagReader, encode
from nss_ros.bag_writer import BagWriter
from nss_ros.geometry import exponential
from nss_ros.messages import pose_graph_message, relative_transform_message, rosbags_family
from nss_ros.registration.relative_transform import RelativeTransform


@pytest.fixture
def record(tmp_path):
    """Record a run over a bag: the truth moved by noise, one answer per pair but the last few."""

    def make(bag, noise=0.01, unanswered=0):
        source = read_log(bag)
        truth = source.ground_truth[0]
        rng = np.random.default_rng(5)

        def moved(transform):
            return transform @ exponential(rng.normal(scale=noise, size=6))

        nodes = tuple(replace(n, T_map_fragment=moved(n.T_map_fragment)) for n in truth.nodes)
        estimate = replace(truth, nodes=nodes, name="map", synchronizer="test")
        reader = BagReader(bag)
        raw = list(reader.messages())
        stamp = raw[-1].stamp
        family = rosbags_family()
        with BagWriter(tmp_path / "log") as writer:
            writer.add_metadata(reader.metadata)
            for topic in (
                topics.GROUND_TRUTH,
                topics.FRAGMENTS,
                topics.FRAGMENT_PAIRS,
                topics.RELATIVE_TRANSFORMS,
                topics.POSE_GRAPH,
            ):
                writer.add_topic(f"/{topic.name}", topic)
            for message in raw:
                writer.write(message.topic, message.stamp, message.data)
            for edge in truth.edges[: len(truth.edges) - unanswered]:
                answer = RelativeTransform(
                    edge.pair, "test", moved(edge.T_target_source), np.eye(6) * 1e-4
                )
                data = encode(relative_transform_message(answer, stamp, family))
                writer.write("/relative_transforms", stamp, data)
            data = encode(pose_graph_message(estimate, "map", stamp, family))
            writer.write("/pose_graph", stamp, data)
        return tmp_path / "log"

    return make

"""The recorder's file is written by one thread."""

import threading
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2

from nss_ros import topics
from nss_ros.bag_reader import BagReader
from nss_ros.bag_writer import BagWriter
from nss_ros.nodes.qos import publisher_qos
from nss_ros.nodes.recorder import Recorder


@pytest.mark.ros
def test_topics_that_are_found_on_the_way_are_announced_by_the_thread_that_writes(
    tmp_path, monkeypatch
):
    threads = []
    for name in ("add_topic", "write", "flush"):
        original = getattr(BagWriter, name)

        def noted(self, *arguments, original=original):
            threads.append(threading.get_ident())
            return original(self, *arguments)

        monkeypatch.setattr(BagWriter, name, noted)
    output = tmp_path / "log"
    rclpy.init(args=["--ros-args", "-p", f"output:={output}", "-p", "flush_period:=0.05"])
    try:
        recorder = Recorder()
        threads.clear()
        node = rclpy.create_node("stage_mapper")
        found = (topics.stage_map(1), topics.component_map(1))
        publishers = [
            node.create_publisher(PointCloud2, topic.name, publisher_qos(topic)) for topic in found
        ]
        for publisher in publishers:
            publisher.publish(PointCloud2())
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        executor.add_node(node)
        end = time.monotonic() + 30
        while not all(publisher.get_subscription_count() for publisher in publishers):
            assert time.monotonic() < end, "the recorder does not find the topics"
            executor.spin_once(timeout_sec=0.05)
        for _ in range(20):
            executor.spin_once(timeout_sec=0.05)
        writing = set(threads)
        recorder.close()
        executor.shutdown()
    finally:
        rclpy.try_shutdown()
    assert len(writing) == 1
    assert threading.get_ident() not in writing
    recorded = {message.topic for message in BagReader(output).messages({topics.MAP.type})}
    assert recorded == {f"/{topic.name}" for topic in found}

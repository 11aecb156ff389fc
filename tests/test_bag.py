import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from nss_ros import topics
from nss_ros.bag import read_log, with_source_points, write_bag
from nss_ros.bag_reader import BagReader, bag_digest
from nss_ros.bag_writer import BagWriter
from nss_ros.errors import BagError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair


@pytest.fixture(scope="module")
def bag(tmp_path_factory, room) -> Path:
    path = tmp_path_factory.mktemp("bags") / "room"
    write_bag(path, room.fragments, room.pairs, [room.ground_truth], {"made": "here"})
    return path


def test_what_is_written_is_read(bag, room):
    log = read_log(bag)
    assert not log.partial
    assert log.metadata == {"made": "here"}
    assert list(log.fragments) == [fragment.id for fragment in room.fragments]
    assert set(log.pairs) == set(room.pairs)
    for fragment in room.fragments:
        np.testing.assert_array_equal(log.fragments[fragment.id].points, fragment.points)
    for node, truth in zip(log.ground_truth[0].nodes, room.ground_truth.nodes, strict=True):
        np.testing.assert_allclose(node.T_map_fragment, truth.T_map_fragment, atol=1e-12)


def test_points_can_be_left_out(bag):
    log = read_log(bag, points=False)
    assert not log.fragments
    assert log.pairs


def test_rosbags_reads_it_without_our_definitions(bag, room):
    with AnyReader([bag]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts["/fragments"] == len(room.fragments)
        connection, _, data = next(
            reader.messages([c for c in reader.connections if c.topic == "/fragments"])
        )
        assert reader.deserialize(data, connection.msgtype).id == str(room.fragments[0].id)


def test_any_mcap_tool_reads_it(bag, room):
    reader = pytest.importorskip("mcap_ros2.reader")
    ids = [
        message.ros_msg.id
        for message in reader.read_ros2_messages(str(bag / "room.mcap"), topics=["/fragments"])
    ]
    assert ids == [str(fragment.id) for fragment in room.fragments]


def test_pairs_come_after_their_fragments(bag):
    seen: set[str] = set()
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/fragments":
                seen.add(message.id)
            elif connection.topic == "/fragment_pairs":
                assert {message.source_id, message.target_id} <= seen


def test_the_same_content_gives_the_same_bytes(tmp_path, room, bag):
    write_bag(tmp_path / "room", room.fragments, room.pairs, [room.ground_truth], {"made": "here"})
    assert (tmp_path / "room/room.mcap").read_bytes() == (bag / "room.mcap").read_bytes()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(share=st.floats(0.0, 0.999))
@example(share=0.6730921885457519)  # in the middle of a number
def test_a_truncated_bag_gives_what_it_holds(bag, tmp_path, share):
    data = (bag / "room.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(len(data) * share)])
    assume(len(data) * share > 300)  # past the header and the metadata
    log = read_log(cut)
    assert log.partial
    for id_, fragment in log.fragments.items():
        np.testing.assert_array_equal(fragment.points, read_log(bag).fragments[id_].points)


def test_damage_in_the_middle_is_noticed(bag, tmp_path):
    data = bytearray((bag / "room.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    assert read_log(tmp_path / "bad.mcap").partial


def test_a_writer_that_never_closes_leaves_what_it_flushed(tmp_path, room):
    writer = BagWriter(tmp_path / "log")
    writer.add_metadata({"a": "b"})
    writer.add_topic("/fragment_pairs", topics.FRAGMENT_PAIRS)
    from nss_ros.bag_reader import encode
    from nss_ros.messages import pair_message, rosbags_family

    for pair in room.pairs[:3]:
        writer.write("/fragment_pairs", 1, encode(pair_message(pair, 1, rosbags_family())))
    writer.flush()
    log = read_log(tmp_path / "log")
    writer.abort()
    assert log.partial
    assert log.pairs == tuple(room.pairs[:3])
    assert log.metadata == {"a": "b"}


def test_an_existing_folder_is_never_touched(tmp_path, room):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("precious")
    with pytest.raises(BagError, match="exists already"):
        write_bag(tmp_path / "mine", room.fragments, room.pairs)
    assert (tmp_path / "mine/thesis.txt").read_text() == "precious"


def test_a_failed_bag_leaves_nothing(tmp_path, room):
    stranger = FragmentPair(room.fragments[0].id, FragmentId("9", 9, 9))
    with pytest.raises(BagError, match="Bldg9_Stage9_Spot9"):
        write_bag(tmp_path / "bag", room.fragments, [stranger])
    assert not (tmp_path / "bag").exists()


def test_duplicate_ids_are_refused(tmp_path, room):
    with pytest.raises(BagError, match="occurs twice"):
        write_bag(tmp_path / "bag", [room.fragments[0]] * 2, [])


def test_a_missing_bag_is_named(tmp_path):
    with pytest.raises(BagError, match=r"no bag at .*nowhere"):
        read_log(tmp_path / "nowhere")


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(BagError, match=r"holds no \.mcap"):
        read_log(tmp_path)


@pytest.mark.parametrize("content", [b"", b"#!/bin/sh\n", b"\x89MCAP1\r\n", b"\x89MCAP0\r\n"])
def test_a_file_that_is_no_mcap_is_named(tmp_path, content):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(BagError, match=r"x\.mcap"):
        read_log(tmp_path / "x.mcap")


def test_a_foreign_bag_says_what_it_lacks(tmp_path):
    with BagWriter(tmp_path / "foreign") as writer:
        writer.add_topic("/clock", topics.CLOCK)
        writer.write("/clock", 1, b"\x00\x01\x00\x00" + bytes(8))
    with pytest.raises(BagError, match="no message of nss_msgs"):
        read_log(tmp_path / "foreign")


def test_an_sqlite_bag_says_how_to_convert_it(tmp_path):
    bag = tmp_path / "old"
    bag.mkdir()
    sqlite3.connect(bag / "old_0.db3").execute("create table t (x)").connection.close()
    (bag / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {relative_file_paths: [old_0.db3]}"
    )
    with pytest.raises(BagError, match="ros2 bag convert"):
        read_log(bag)


def test_garbled_bytes_name_the_topic(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/fragments", topics.FRAGMENTS)
        writer.write("/fragments", 1, b"\x00\x01\x00\x00garbage")
    with pytest.raises(BagError, match="/fragments"):
        read_log(tmp_path / "bag")


def test_an_empty_cloud_survives(tmp_path):
    empty = Fragment(FragmentId("1", 1, 1), np.zeros((0, 3), np.float32))
    write_bag(tmp_path / "bag", [empty], [])
    assert read_log(tmp_path / "bag").fragments[empty.id].points.shape == (0, 3)


def test_a_log_without_points_gets_those_of_its_bag_if_unchanged(tmp_path, room):
    write_bag(tmp_path / "bag", room.fragments[:1], [])
    metadata = {"bag_0": str(tmp_path / "bag"), "bag_0_sha256": bag_digest(tmp_path / "bag")}
    write_bag(tmp_path / "log", [], [], [room.ground_truth], metadata)
    log = read_log(tmp_path / "log")
    assert not log.fragments
    assert list(with_source_points(log).fragments) == [room.fragments[0].id]
    with (tmp_path / "bag/bag.mcap").open("ab") as file:
        file.write(b"more")
    assert not with_source_points(log).fragments


def test_messages_of_a_topic_that_was_never_announced_are_left_out(tmp_path):
    path = tmp_path / "damaged.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        known = writer.register_channel("/known", "cdr", schema)
        writer.add_message(known, 1, b"first", 1)
        writer.add_message(known + 1, 2, b"lost", 2)
        writer.add_message(known, 3, b"last", 3)
        writer.finish()
    reader = BagReader(path)
    assert [message.data for message in reader.messages()] == [b"first", b"last"]
    assert reader.partial

"""Augmented copies of ROS 2 bags."""

from __future__ import annotations

import struct
from functools import partial
from types import SimpleNamespace

import mcap.reader
import mcap.writer
import mcap_ros2.decoder
import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from tests.fake_augmenters import (
    changed,
    content,
    finish,
    identity,
    rewrite,
    two_boxes,
    write_sweep,
)

from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.ros.messages import message_store
from lidarfiles.recordings.opening import open_recording, open_ref
from lidarreal.augmentation.rewriting import bag_rewriter
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarsim import LidarError
from lidarsim.columns.bags import POINT_CLOUD, point_columns

TOPIC = "/front/points"


def opened(path, sensor=TOPIC):
    ref = RecordingRef(path, sensor, keep_noise=True)
    return open_rewriter(ref, open_ref(ref))


def messages(path, skipped=()):
    """Return all messages, and the descriptions of their topics."""
    with AnyReader([path], default_typestore=message_store()) as bag:
        found = [
            (connection.topic, time_ns, bytes(data))
            for connection, time_ns, data in bag.messages()
            if connection.topic not in skipped
        ]
        topics = {
            connection.topic: (
                connection.msgtype,
                connection.msgdef,
                connection.ext,
                connection.msgcount,
            )
            for connection in bag.connections
        }
    return found, topics


@pytest.mark.parametrize("name", ["mcap", "rosbag2"])
def test_identity_keeps_all_messages(written, tmp_path, name):
    path = written(name)
    new = tmp_path / path.name
    before = content(path) if path.is_dir() else path.read_bytes()
    notes = rewrite(opened(path), new, tmp_path / "work", identity)
    assert messages(new) == messages(path)
    assert notes == [
        f"Only the sweeps of {TOPIC} were augmented. /rear_left/points in {path} is unchanged."
    ]
    assert open_recording(new, TOPIC).info.compensated is False  # custom data of the bag
    assert before == (content(path) if path.is_dir() else path.read_bytes())


@pytest.mark.parametrize("layout", ["velodyne", "autoware", "ouster", "hesai", "robosense"])
def test_changed_sweeps_in_each_layout(written, tmp_path, layout):
    path = written("mcap", layout=layout)
    new = tmp_path / "new.mcap"
    rewriter = opened(path)
    rewrite(rewriter, new, tmp_path / "work", changed)
    old_messages, old_topics = messages(path, {TOPIC})
    new_messages, new_topics = messages(new, {TOPIC})
    assert new_messages == old_messages and new_topics == old_topics
    recording = open_recording(new, TOPIC, keep_noise=True)
    with new.open("rb") as file:
        read = mcap.reader.make_reader(file, decoder_factories=[mcap_ros2.decoder.DecoderFactory()])
        clouds = [message for *_, message in read.iter_decoded_messages([TOPIC])]
    for number, cloud in enumerate(clouds):
        expected = changed(rewriter.recording, number)
        sweep = expected.sweep
        np.testing.assert_allclose(recording[number].points, sweep.points, rtol=1e-6)
        assert recording[number].time_ns == rewriter.recording[number].time_ns
        assert (cloud.height, cloud.width) == (1, len(sweep))
        assert len(cloud.data) == cloud.row_step == cloud.width * cloud.point_step
        for name, values in recording[number].columns.items():
            if name == "intensity":
                wanted = sweep.columns[name]
                assert np.abs(values - wanted).max(initial=0) <= (values.dtype.kind != "f") / 2
            elif name not in ("range", "distance", "reflectivity", "ambient", "signal"):
                np.testing.assert_array_equal(values, sweep.columns[name])


def test_boxes_are_markers(written, tmp_path):
    path = written("rosbag2")
    rewriter = opened(path)

    def augment(recording, number):
        return changed(recording, number, two_boxes() if number else None)

    new = tmp_path / "rosbag2"
    notes = rewrite(rewriter, new, tmp_path / "work", augment)
    assert notes[1] == (
        "The boxes of inserted objects are published on /augmented_objects as a MarkerArray in the "
        "sensor frame."
    )
    assert messages(new, {TOPIC, "/augmented_objects"})[0] == messages(path, {TOPIC})[0]
    with AnyReader([new], default_typestore=message_store()) as bag:
        chosen = [c for c in bag.connections if c.topic in (TOPIC, "/augmented_objects")]
        found = [
            (connection.topic, time_ns, bag.deserialize(data, connection.msgtype))
            for connection, time_ns, data in bag.messages(chosen)
        ]
    clouds, markers = found[::2], found[1::2]
    for (_, cloud_ns, cloud), (topic, time_ns, message) in zip(clouds, markers, strict=True):
        assert topic == "/augmented_objects" and time_ns == cloud_ns
        first, *boxes = message.markers
        assert first.action == first.DELETEALL
        assert first.header.frame_id == cloud.header.frame_id
        assert [box.text for box in boxes] == (
            [] if cloud is clouds[0][2] else ["Inserted car 1", "walker 2"]
        )
        if boxes:
            center = boxes[0].pose.position
            assert (center.x, center.y, center.z) == (10, 2, -1)
            turns = [box.pose.orientation for box in boxes]
            found = [(turn.x, turn.y, turn.z, turn.w) for turn in turns]
            np.testing.assert_allclose(found, two_boxes().quaternions)
            assert (boxes[0].scale.x, boxes[0].scale.y, boxes[0].scale.z) == (4, 2, 1.5)
    # A bag that was augmented before has another topic for the new boxes.
    again = tmp_path / "again"
    rewrite(opened(new), again, tmp_path / "work2", augment)
    assert "/augmented_objects_2" in messages(again)[1]


def test_livox_messages(written, tmp_path):
    path = written("mcap", layout="livox")
    rewriter = opened(path, "/front/livox")
    rewrite(rewriter, tmp_path / "same.mcap", tmp_path / "w", identity)
    assert messages(tmp_path / "same.mcap") == messages(path)
    notes = rewrite(rewriter, tmp_path / "new.mcap", tmp_path / "w2", changed)
    assert "/front/points, /rear_left/livox, /rear_left/points in" in notes[0]
    recording = open_recording(tmp_path / "new.mcap", "/front/livox", keep_noise=True)
    store = message_store()
    with AnyReader([tmp_path / "new.mcap"], default_typestore=store) as bag:
        (chosen,) = [c for c in bag.connections if c.topic == "/front/livox"]
        numbers = [bag.deserialize(data, chosen.msgtype) for _, _, data in bag.messages([chosen])]
    for number, message in enumerate(numbers):
        expected = changed(rewriter.recording, number).sweep
        assert message.point_num == len(message.points) == len(expected)
        np.testing.assert_allclose(recording[number].points, expected.points, rtol=1e-6)
        strengths = [point.reflectivity for point in message.points]
        np.testing.assert_array_equal(strengths, np.rint(expected.columns["reflectivity"]))


def heights(path):
    with AnyReader([path]) as bag:
        chosen = [c for c in bag.connections if c.topic == TOPIC]
        return {bag.deserialize(data, POINT_CLOUD).height for _, _, data in bag.messages(chosen)}


def test_organized_clouds(written, tmp_path):
    path = written("mcap", organized=True, layout="velodyne")
    rewriter = opened(path)
    rewrite(rewriter, tmp_path / "same.mcap", tmp_path / "w", identity)
    assert messages(tmp_path / "same.mcap") == messages(path)

    def lose(recording, number):
        augmented = identity(recording, number)
        keep = np.flatnonzero(augmented.sweep.has_return)[::2]
        return type(augmented)(augmented.sweep.select(keep), keep, np.ones(len(keep), bool))

    assert len(rewrite(rewriter, tmp_path / "less.mcap", tmp_path / "w2", lose)) == 1
    recording = open_recording(tmp_path / "less.mcap", TOPIC, keep_noise=True)
    for number in range(3):
        old, new = rewriter.recording[number], recording[number]
        assert len(new) == len(old)
        kept = np.flatnonzero(old.has_return)[::2]
        np.testing.assert_array_equal(np.flatnonzero(new.has_return), kept)
        np.testing.assert_array_equal(new.points[kept], old.points[kept])
    assert heights(tmp_path / "less.mcap") == heights(path) != {1}
    more = partial(changed, returns_only=True)
    notes = rewrite(rewriter, tmp_path / "more.mcap", tmp_path / "w3", more)
    assert notes[1].startswith("2 sweeps cannot stay organized")  # the second sweep is empty
    with AnyReader([tmp_path / "more.mcap"]) as bag:
        chosen = [c for c in bag.connections if c.topic == TOPIC]
        (_, _, data) = next(bag.messages(chosen))
        cloud = bag.deserialize(data, POINT_CLOUD)
    assert (cloud.height, cloud.is_dense) == (1, True)
    assert len(point_columns(data)["x"]) == len(more(rewriter.recording, 0).sweep)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
    ],
)
def test_kinds_of_bags(written, tmp_path, plugin, mode):
    path = tmp_path / "source"
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    store = message_store()
    with AnyReader([written("rosbag2")], default_typestore=store) as bag, writer:
        connections = {
            c.id: writer.add_connection(
                c.topic, c.msgtype, typestore=store, offered_qos_profiles=c.ext.offered_qos_profiles
            )
            for c in bag.connections
        }
        for connection, time_ns, data in bag.messages():
            writer.write(connections[connection.id], time_ns, data)
    (path / "notes.txt").write_text("rain")
    new = tmp_path / "new"
    rewriter = opened(path)
    rewrite(rewriter, new, tmp_path / "work", identity)
    assert messages(new) == messages(path)
    assert {file.suffix for file in new.iterdir()} - {""} == {f.suffix for f in path.iterdir()}
    assert (new / "notes.txt").read_text() == "rain"
    stated = [
        yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        for folder in (path, new)
    ]
    for key in ("version", "compression_mode", "compression_format", "storage_identifier"):
        assert stated[0][key] == stated[1][key]
    rewrite(rewriter, tmp_path / "changed", tmp_path / "work2", partial(changed, boxes=two_boxes()))
    recording = open_recording(tmp_path / "changed", TOPIC, keep_noise=True)
    expected = changed(rewriter.recording, 2).sweep.points
    np.testing.assert_allclose(recording[2].points, expected, rtol=1e-6)
    for topics in zip(*(one["topics_with_message_count"] for one in stated), strict=True):
        assert topics[0] == topics[1]


def test_order_of_sweeps_and_several_readers(written, tmp_path):
    path = written("mcap")
    first, second = opened(path), opened(path)
    for number in (2, 0, 1):
        write_sweep(first, tmp_path / "a", number, changed(first.recording, number))
    for number in range(3):
        write_sweep(second, tmp_path / "b", number, changed(second.recording, number))
    assert content(tmp_path / "a") == content(tmp_path / "b")
    finish(first, tmp_path / "a.mcap", tmp_path / "a")
    finish(second, tmp_path / "b.mcap", tmp_path / "b")
    found = [messages(tmp_path / f"{name}.mcap") for name in "ab"]
    assert found[0] == found[1]
    assert not [*tmp_path.glob(".lidarpool*")]


@pytest.mark.parametrize("name", ["mcap", "rosbag2"])
def test_several_topics(written, tmp_path, name):
    path = written(name)
    topics = (TOPIC, "/rear_left/points")
    rewriters = [opened(path, topic) for topic in topics]
    works = [tmp_path / "w0", tmp_path / "w1"]
    for rewriter, work in zip(rewriters, works, strict=True):
        for number in range(3):
            write_sweep(rewriter, work, number, changed(rewriter.recording, number, two_boxes()))
    new = tmp_path / path.name
    notes = finish(rewriters[0], new, works[0], others=[(rewriters[1], works[1])])
    assert [note for note in notes if "Only the sweeps" in note] == []
    assert {file.name for file in tmp_path.iterdir()} == {"w0", "w1", new.name}
    for topic, rewriter in zip(topics, rewriters, strict=True):
        recording = open_recording(new, topic, keep_noise=True)
        for number in range(3):
            expected = changed(rewriter.recording, number).sweep.points
            np.testing.assert_allclose(recording[number].points, expected, rtol=1e-6)
    assert (
        messages(new, {*topics, "/augmented_objects", "/augmented_objects_2"})[0]
        == (messages(path, topics)[0])
    )
    assert not [*tmp_path.glob(".lidarpool*")] and not [*tmp_path.glob("previous*")]


def test_files_need_the_extension(written, tmp_path):
    with pytest.raises(LidarError, match=r"Specify a path that ends in \.mcap"):
        opened(written("mcap")).check_target(tmp_path / "new.bag")


def plain_copy(source, target, *, publish_offset=0, **options):
    """Write the messages of a bag with the library of MCAP's authors, and with an attachment.

    `/tf` has two publishers.
    """
    with source.open("rb") as file, target.open("wb") as output:
        reader = mcap.reader.make_reader(file)
        writer = mcap.writer.Writer(output, **options)
        writer.start("ros2", "test")
        ids = {}
        for number, (schema, channel, message) in enumerate(reader.iter_messages()):
            if channel.topic not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = [
                    writer.register_channel(channel.topic, "cdr", schema_id, channel.metadata)
                    for _ in range(1 + (channel.topic == "/tf"))
                ]
            writer.add_message(
                ids[channel.topic][number % 2 if channel.topic == "/tf" else 0],
                message.log_time,
                message.data,
                message.publish_time + publish_offset,
                sequence=number,
            )
        writer.add_attachment(3, 4, "map.png", "image/png", b"png")
        writer.add_metadata("car", {"color": "red"})
        writer.finish()
    return target


def records(path, skipped=()):
    """Return all messages, attachments and metadata that MCAP's authors read."""
    with path.open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        messages = [
            (channel.topic, channel.id, schema.name, message)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
            if channel.topic not in skipped
        ]
        summary = reader.get_summary()
        return messages, [*reader.iter_attachments()], [*reader.iter_metadata()], summary


KINDS = [
    {"compression": mcap.writer.CompressionType.ZSTD, "chunk_size": 5000},
    {"compression": mcap.writer.CompressionType.LZ4, "chunk_size": 100},
    {"compression": mcap.writer.CompressionType.NONE},
    {"use_chunking": False},
    {"use_statistics": False, "use_summary_offsets": False},
    {"index_types": mcap.writer.IndexType.ATTACHMENT | mcap.writer.IndexType.METADATA},
]


@pytest.mark.parametrize("kind", KINDS)
def test_all_other_records_keep_their_bytes(written, tmp_path, kind):
    path = plain_copy(written("mcap"), tmp_path / "source.mcap", publish_offset=-7, **kind)
    before = path.read_bytes()
    rewriter = opened(path)
    rewrite(rewriter, tmp_path / "same.mcap", tmp_path / "work", identity)
    assert records(tmp_path / "same.mcap")[:3] == records(path)[:3]
    boxed = partial(changed, boxes=two_boxes())
    rewrite(rewriter, tmp_path / "new.mcap", tmp_path / "work2", boxed)
    topics = (TOPIC, "/augmented_objects")
    found, *others, summary = records(tmp_path / "new.mcap", topics)
    expected, *expected_others, _ = records(path, topics)
    assert found == expected and others == expected_others
    everything, *_ = records(tmp_path / "new.mcap")
    assert summary.statistics.message_count == len(everything) == len(records(path)[0]) + 3
    counts = {}
    for _, channel, *_ in everything:
        counts[channel] = counts.get(channel, 0) + 1
    assert summary.statistics.channel_message_counts == counts
    assert summary.statistics.attachment_count == summary.statistics.metadata_count == 1
    stamps = [message.log_time for *_, message in everything]
    statistics = summary.statistics
    assert (statistics.message_start_time, statistics.message_end_time) == (
        min(stamps),
        max(stamps),
    )
    clouds = [entry for entry in everything if entry[0] in topics]
    assert [topic for topic, *_ in clouds] == [*topics] * 3
    for (*_, cloud), (*_, boxes) in zip(clouds[::2], clouds[1::2], strict=True):
        assert (cloud.log_time, cloud.publish_time) == (boxes.log_time, boxes.publish_time)
        assert cloud.publish_time == cloud.log_time - 7
    recording = open_recording(tmp_path / "new.mcap", TOPIC, keep_noise=True)
    for number in (2, 0):
        expected = boxed(rewriter.recording, number).sweep.points
        np.testing.assert_allclose(recording[number].points, expected, rtol=1e-6)
    assert path.read_bytes() == before


def with_channel_zero(path):
    """Subtract 1 from the channel IDs of a file without chunks. Only schema IDs must not be 0."""
    data = bytearray(path.read_bytes())
    position = len(mcap.writer.MCAP0_MAGIC)
    while position < len(data) - len(mcap.writer.MCAP0_MAGIC):
        kind, length = struct.unpack_from("<BQ", data, position)
        if kind in (0x04, 0x05):  # channels and messages
            (number,) = struct.unpack_from("<H", data, position + 9)
            struct.pack_into("<H", data, position + 9, number - 1)
        position += 9 + length
    path.write_bytes(data)


@pytest.mark.parametrize("has_summary", [True, False])
def test_channel_zero(written, tmp_path, has_summary):
    path = plain_copy(
        written("mcap"),
        tmp_path / "source.mcap",
        use_chunking=False,
        use_statistics=False,
        enable_crcs=False,
        index_types=mcap.writer.IndexType.NONE,
        use_summary_offsets=False,
        repeat_channels=has_summary,
        repeat_schemas=has_summary,
    )
    with_channel_zero(path)
    before, _, _, summary = records(path)
    assert 0 in {channel for _, channel, *_ in before}
    assert bool(summary and summary.channels) == has_summary
    rewriter = opened(path)
    rewrite(rewriter, tmp_path / "same.mcap", tmp_path / "work", identity)
    assert records(tmp_path / "same.mcap")[0] == before
    boxed = partial(changed, boxes=two_boxes())
    rewrite(rewriter, tmp_path / "new.mcap", tmp_path / "work2", boxed)
    topics = (TOPIC, "/augmented_objects")
    found, *_, summary = records(tmp_path / "new.mcap", topics)
    assert found == records(path, topics)[0]
    assert 0 not in summary.schemas and 0 in summary.channels
    recording = open_recording(tmp_path / "new.mcap", TOPIC, keep_noise=True)
    for number in range(3):
        expected = boxed(rewriter.recording, number).sweep.points
        np.testing.assert_allclose(recording[number].points, expected, rtol=1e-6)


def test_bags_of_several_files(written, tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    (whole,) = written("rosbag2").glob("*.mcap")
    with whole.open("rb") as file:
        everything = [*mcap.reader.make_reader(file).iter_messages()]
    half = len(everything) // 2
    names = ["bag_0.mcap", "bag_1.mcap"]
    for name, part in zip(names, (everything[:half], everything[half:]), strict=True):
        with (folder / name).open("wb") as output:
            writer = mcap.writer.Writer(output)
            writer.start("ros2", "test")
            for schema, channel, message in part:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channel_id = writer.register_channel(
                    channel.topic, "cdr", schema_id, channel.metadata
                )
                writer.add_message(channel_id, message.log_time, message.data, message.publish_time)
            writer.finish()
    content = yaml.safe_load((written("rosbag2") / "metadata.yaml").read_text())
    stated = content["rosbag2_bagfile_information"]
    stated["relative_file_paths"] = names
    (entry,) = stated["files"]
    counts = [half, len(everything) - half]
    stated["files"] = [
        entry | {"path": name, "message_count": count}
        for name, count in zip(names, counts, strict=True)
    ]
    (folder / "metadata.yaml").write_text(yaml.safe_dump(content))
    rewriter = opened(folder)
    rewrite(rewriter, tmp_path / "same", tmp_path / "w", identity)
    assert messages(tmp_path / "same") == messages(folder)
    metadata = "metadata.yaml"
    assert (tmp_path / "same" / metadata).read_bytes() == (folder / metadata).read_bytes()
    boxed = partial(changed, boxes=two_boxes())
    rewrite(rewriter, tmp_path / "new", tmp_path / "w2", boxed)
    skipped = (TOPIC, "/augmented_objects")
    assert messages(tmp_path / "new", skipped)[0] == messages(folder, skipped)[0]
    new = yaml.safe_load((tmp_path / "new" / metadata).read_text())["rosbag2_bagfile_information"]
    assert new["relative_file_paths"] == names
    assert new["message_count"] == len(everything) + 3 == len(messages(tmp_path / "new")[0])
    assert sum(file["message_count"] for file in new["files"]) == len(everything) + 3
    recording = open_recording(tmp_path / "new", TOPIC, keep_noise=True)
    for number in range(3):
        expected = boxed(rewriter.recording, number).sweep.points
        np.testing.assert_allclose(recording[number].points, expected, rtol=1e-6)


def test_damaged_chunks(written, tmp_path):
    path = plain_copy(
        written("mcap"), tmp_path / "source.mcap", compression=mcap.writer.CompressionType.NONE
    )
    rewriter = opened(path)
    rewrite(rewriter, tmp_path / "new.mcap", tmp_path / "work", changed)
    data = path.read_bytes()
    position = data.index(rewriter._messages().read(2)[2][-40:])
    path.write_bytes(data[:position] + b"damaged!" + data[position + 8 :])
    with pytest.raises(LidarError, match=r"source\.mcap"):
        finish(rewriter, tmp_path / "other.mcap", tmp_path / "work")
    assert not (tmp_path / "other.mcap").exists()
    assert not [*tmp_path.glob(".lidarpool*")]


MESSAGE = "string data\n"
IDL = """
module std_msgs { module msg { struct String { string data; }; }; };
"""
# From the package std_msgs of ROS 2 Jazzy.
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


@pytest.mark.parametrize(
    ("kind", "definition", "expected"),
    [
        ("MSG", MESSAGE, STRING),
        ("IDL", IDL, STRING),
        ("MSG", "unknown/Type data\n", f"RIHS01_{'0' * 64}"),
        ("IDL", MESSAGE, f"RIHS01_{'0' * 64}"),
    ],
)
def test_types_have_the_hash_of_their_definition(kind, definition, expected):
    from rosbags.interfaces import MessageDefinitionFormat

    text = SimpleNamespace(data=definition, format=MessageDefinitionFormat[kind])
    connection = SimpleNamespace(msgtype="std_msgs/msg/String", msgdef=text)
    assert bag_rewriter._type_hash(connection) == expected

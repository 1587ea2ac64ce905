"""Augmented copies of ROS 2 bags."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from dataclasses import replace as replace_fields
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from threading import RLock
from typing import Any, Literal
from zlib import crc32

import numpy as np
import yaml

from lidarfiles.clouds.recording import Recording, sweep_from_columns
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.ros.bags import header_of, point_connection
from lidarfiles.processes.per_process import PerProcess
from lidarsim.columns.bags import (
    LIVOX_CLOUDS,
    POINT_CLOUD,
    livox_message,
    livox_rows,
    message_types,
    open_bag,
    opened_bag,
    point_rows,
)
from lidarsim.errors import CutShortError
from lidarsim.io.input_files import read_input_text
from lidarsim.io.storage import Storage
from lidarsim.words import plural

from ..augmented_sweep import AugmentedSweep
from .data_set_copy import copy_data_set
from .mcap_copy import AddedTopic, NewContent, copy_mcap
from .rewriter import EncodedSweeps, Rewriter, organization_notes
from .stored_records import StoredRecords, unchanged

_BOX_NAMESPACE = "augmented_objects"  # the topic has the same name
_BAG_SUFFIXES = (".mcap", ".db3", ".zstd")
_METADATA_FILE = "metadata.yaml"
_SCAN = "sensor_msgs/msg/LaserScan"
_MARKERS = "visualization_msgs/msg/MarkerArray"
_POINT_TYPES = (POINT_CLOUD, _SCAN, *LIVOX_CLOUDS)
_UNKNOWN_HASH = f"RIHS01_{'0' * 64}"  # hash of a message type whose definition is unknown
# ROS 2 Humble cannot read later versions, because QoS profiles are lists from version 9 on.
_OLDEST_VERSION: Literal[8] = 8
_NEWEST_VERSION: Literal[9] = 9


class BagRewriter(Rewriter):
    """Writer of an augmented ROS 2 bag, which is a folder or a single .mcap file.

    The messages of one topic with points are encoded anew, with the same fields and the same size
    of a point. All other messages are copied. Boxes of inserted objects are published as markers.
    """

    title = "ROS 2"

    def __init__(self, ref: RecordingRef, recording: Recording) -> None:
        super().__init__(ref, recording)
        self._messages = PerProcess(partial(_TopicMessages, ref))

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the message of a sweep, and a message with the boxes of inserted objects."""
        from lidarfiles.clouds.ros.messages import box_markers

        kind, time_ns, data = self._messages().read(number)
        details: dict[str, Any] = {"boxes": len(augmented.boxes)}
        if kind in LIVOX_CLOUDS:
            content = self._livox_message(number, data, augmented)
        else:
            content, is_unorganized = self._point_cloud(number, data, augmented)
            details["unorganized"] = is_unorganized
        header = header_of(data)
        stamp_ns = header.stamp_ns or time_ns
        markers = box_markers(augmented.boxes, _BOX_NAMESPACE, header.frame, stamp_ns)
        files = {_message_file(number): content, _marker_file(number): bytes(markers.cdr)}
        return files, details

    def _point_cloud(
        self, number: int, data: bytes, augmented: AugmentedSweep
    ) -> tuple[bytes, bool]:
        """Encode a PointCloud2, and return whether the cloud is not organized any more."""
        message: Any = message_types().deserialize_cdr(data, POINT_CLOUD)
        records = point_rows(message)
        stored = self._stored(number, records)
        rows = stored.augment(augmented)
        template = np.asarray(augmented.template, np.intp)
        height = 1
        is_unorganized = False
        if message.height > 1:
            organized = stored.organize(rows, augmented)
            if organized is None:
                rows = rows[np.isfinite(augmented.sweep.points).all(axis=1)]
                is_unorganized = True
            else:
                rows, template = organized, np.arange(len(organized))
                height = message.height
        if unchanged(rows, records, template):
            return data, False
        width = len(rows) // height
        points = np.stack([rows[stored.axes[axis]] for axis in "xyz"])
        encoded = replace_fields(
            message,
            height=height,
            width=width,
            row_step=width * message.point_step,
            data=np.ascontiguousarray(rows).view(np.uint8).reshape(-1),
            is_dense=bool(np.isfinite(points).all()),
        )
        return bytes(message_types().serialize_cdr(encoded, POINT_CLOUD)), is_unorganized

    def _livox_message(self, number: int, data: bytes, augmented: AugmentedSweep) -> bytes:
        """Encode a Livox CustomMsg."""
        records, _ = livox_rows(data)
        rows = self._stored(number, records).augment(augmented)
        same = unchanged(rows, records, np.asarray(augmented.template, np.intp))
        return data if same else livox_message(data, rows)

    def _stored(self, number: int, records: Any) -> StoredRecords:
        """Combine the records of a message with its points, without reading the bag again."""
        columns = {name: records[name] for name in records.dtype.names or ()}
        sweep = self.recording.standardize(number, sweep_from_columns(columns))
        info = self.recording.info
        return StoredRecords(records, sweep, info.meters, info.intensity_column)

    def sensors(self) -> list[str]:
        """Return the topics with points."""
        with opened_bag(self.path, self.ref.name) as bag:
            topics = {c.topic for c in bag.connections if c.msgtype in _POINT_TYPES}
        return sorted(topics)

    @cached_property
    def sensor(self) -> str:
        """Topic with the sweeps."""
        with opened_bag(self.path, self.ref.name) as bag:
            return str(point_connection(self.ref, bag).topic)

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the bag, message by message."""
        notes = organization_notes(encoded.details())
        is_again = base == target
        if is_again:
            base = target.with_name(f"previous-{target.name}")
            target.rename(base)
        has_boxes = any(sweep["boxes"] for sweep in encoded.details())
        with opened_bag(base, self.ref.name) as bag:
            bag_copy = _BagCopy(bag, base, target, point_connection(self.ref, bag), encoded)
            topic = bag_copy.write(has_boxes=has_boxes)
            if self.path.is_dir():
                notes += copy_data_set(base, target, bag_copy.files())
        if is_again:
            Storage.at(base.parent).discard(base.name)
        if topic is not None:
            notes.append(
                f"The boxes of inserted objects are published on {topic} as a MarkerArray in the "
                "sensor frame."
            )
        return notes


def _message_file(number: int) -> str:
    return f"messages/{number:08}.cdr"


def _marker_file(number: int) -> str:
    return f"markers/{number:08}.cdr"


@dataclass
class _TopicMessages:
    """Messages with the sweeps of a recording.

    A bag can only be read from its start, so reading messages in ascending order is fastest.
    """

    ref: RecordingRef
    _next: int = field(default=0, init=False)
    _remaining: Iterator[Any] = field(default_factory=lambda: iter(()), init=False)
    _bag: Any = field(default=None, init=False)
    _lock: RLock = field(default_factory=RLock, init=False)

    def read(self, number: int) -> tuple[str, int, bytes]:
        """Return the type, the recording time in nanoseconds, and the content of a message.

        Raises CutShortError if the bag has fewer messages.
        """
        with self._lock:
            if not 0 < self._next <= number:
                self._bag = self._bag or open_bag(self.ref.path, self.ref.name)
                connection = point_connection(self.ref, self._bag)
                self._remaining = self._bag.messages([connection])
                self._next = 0
            skipped = number - self._next
            self._next = 0  # so that the next call starts again after an error
            message = next(islice(self._remaining, skipped, None), None)
            if message is None:
                raise CutShortError(f"it has no sweep {number:,}")
            self._next = number + 1
            connection, time_ns, data = message
            return connection.msgtype, time_ns, bytes(data)


class _BagCopy:
    """A copy of a bag with augmented messages."""

    def __init__(
        self, bag: Any, path: Path, target: Path, chosen: Any, encoded: EncodedSweeps
    ) -> None:
        self._bag = bag
        self._path = path
        self._target = target
        self._chosen = chosen
        self._encoded = encoded
        self._replaced = 0  # number of replaced messages
        text = ""
        if path.is_dir():
            text = read_input_text(path / _METADATA_FILE, errors="replace")
        self._metadata = _mapping(_mapping(text).get("rosbag2_bagfile_information"))

    def write(self, *, has_boxes: bool) -> str | None:
        """Write the bag, and return the topic of the boxes, if there are boxes."""
        topic = self._box_topic() if has_boxes else None
        names = [Path(name).name for name in self._metadata.get("relative_file_paths", ())]
        if not self._path.is_dir():
            self._copy_mcap(self._path, self._target, topic)
        elif names and all(name.endswith(".mcap") for name in names) and not self._compression:
            self._target.mkdir()
            counts = {
                name: self._copy_mcap(self._path / name, self._target / name, topic)
                for name in names
            }
            self._write_metadata(topic, counts)
        else:
            self._write_with_rosbags(topic)
        self._check_count(self._replaced)
        return topic

    @property
    def _compression(self) -> str:
        """Compression mode of a folder, which is FILE, MESSAGE or empty.

        Compressed chunks do not count.
        """
        mode = str(self._metadata.get("compression_mode") or "").upper()
        return "" if mode == "NONE" else mode

    def files(self) -> set[str]:
        """Return the names of the files that belong to the bag in its folder."""
        inside = self._path.iterdir()
        names = {file.name for file in inside if file.suffix.lower() in _BAG_SUFFIXES}
        return names | {_METADATA_FILE}

    def _box_topic(self) -> str:
        """Return the name of a topic for boxes that does not occur in the bag."""
        topics = {connection.topic for connection in self._bag.connections}
        topic = f"/{_BOX_NAMESPACE}"
        number = 1
        while topic in topics:
            number += 1
            topic = f"/{_BOX_NAMESPACE}_{number}"
        return topic

    def _contents(self, number: int, topic: str | None) -> NewContent:
        """Return the new content of a message, and the boxes that follow it."""
        data = self._encoded.path(number, _message_file(number)).read_bytes()
        boxes = None
        if topic is not None:
            boxes = self._encoded.path(number, _marker_file(number)).read_bytes()
        return NewContent(data, boxes)

    @cached_property
    def _numbers(self) -> dict[tuple[int, int], int]:
        """Numbers of the sweeps, by the log times and checksums of their messages."""
        messages = self._bag.messages([self._chosen])
        return {
            (time_ns, crc32(data)): number for number, (_, time_ns, data) in enumerate(messages)
        }

    def _check_count(self, count: int) -> None:
        if count != self._encoded.count:
            raise CutShortError(
                f"{plural(self._encoded.count, 'sweep')} were expected, but it has {count:,}"
            )

    def _copy_mcap(self, source: Path, target: Path, topic: str | None) -> int:
        """Copy an MCAP file, and return the number of messages on the topic of the boxes."""
        count = 0

        def replacement(_: str, kind: str, time_ns: int, data: bytes) -> NewContent | None:
            nonlocal count
            number = self._numbers.get((time_ns, crc32(data)))
            if number is None or kind != self._chosen.msgtype:
                return None
            count += topic is not None
            self._replaced += 1
            return self._contents(number, topic)

        added = None
        if topic is not None:
            added = AddedTopic(topic, _MARKERS, _marker_definition())
        copy_mcap(source, target, self._chosen.topic, replacement, added)
        return count

    def _write_metadata(self, topic: str | None, counts: Mapping[str, int]) -> None:
        """Write the metadata of a folder, with the topic of the boxes."""
        if topic is None:
            shutil.copyfile(self._path / _METADATA_FILE, self._target / _METADATA_FILE)
            return
        text = read_input_text(self._path / _METADATA_FILE, errors="replace")
        content = _mapping(text)
        metadata = content["rosbag2_bagfile_information"]
        is_new = metadata.get("version", 0) >= _NEWEST_VERSION
        topic_metadata = {
            "name": topic,
            "type": _MARKERS,
            "serialization_format": "cdr",
            "offered_qos_profiles": [] if is_new else "",
            "type_description_hash": _marker_hash(),
        }
        total = sum(counts.values())
        entry = {"topic_metadata": topic_metadata, "message_count": total}
        metadata["topics_with_message_count"].append(entry)
        metadata["message_count"] += total
        for file in metadata.get("files") or ():
            file["message_count"] += counts.get(Path(file["path"]).name, 0)
        (self._target / _METADATA_FILE).write_text(yaml.safe_dump(content, sort_keys=False))

    def _write_with_rosbags(self, topic: str | None) -> None:
        """Write a bag folder with SQLite files, or with compressed files."""
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

        metadata = self._metadata
        is_mcap = metadata.get("storage_identifier") == "mcap"
        version = metadata.get("version")
        is_new = isinstance(version, int) and version >= _NEWEST_VERSION
        writer = Writer(
            self._target,
            version=_NEWEST_VERSION if is_new else _OLDEST_VERSION,
            storage_plugin=StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3,
        )
        compression = CompressionMode.__members__.get(self._compression, CompressionMode.NONE)
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer as target:
            for key, value in _mapping(metadata.get("custom_data")).items():
                target.set_custom_data(str(key), str(value))
            connections = _copy_connections(self._bag, target)
            boxes = None if topic is None else _add_box_topic(topic, target)
            for connection, time_ns, data in self._bag.messages():
                if connection.id != self._chosen.id:
                    target.write(connections[connection.id], time_ns, data)
                    continue
                new = self._contents(self._replaced, topic)
                self._replaced += 1
                target.write(connections[connection.id], time_ns, new.data)
                if boxes is not None and new.added is not None:
                    target.write(boxes, time_ns, new.added)


def _mapping(content: Any) -> dict[str, Any]:
    """Return a mapping from YAML text, or an empty mapping if the content is not a mapping."""
    if isinstance(content, str):
        try:
            content = yaml.safe_load(content)
        except yaml.YAMLError:
            content = None
    return content if isinstance(content, dict) else {}


def _copy_connections(bag: Any, target: Any) -> dict[int, Any]:
    """Add the connections of a bag to its copy, and return them by the ID in the bag."""
    copies: dict[int, Any] = {}
    added: list[tuple[Any, Any]] = []
    for connection in bag.connections:
        known = [
            copy
            for original, copy in added
            if (original.topic, original.msgtype, original.ext)
            == (connection.topic, connection.msgtype, connection.ext)
        ]
        if not known:  # several publishers of a topic share a connection
            known = [
                target.add_connection(
                    connection.topic,
                    connection.msgtype,
                    msgdef=connection.msgdef.data,
                    rihs01=connection.digest or _type_hash(connection),
                    serialization_format=connection.ext.serialization_format,
                    offered_qos_profiles=connection.ext.offered_qos_profiles,
                )
            ]
            added.append((connection, known[0]))
        copies[connection.id] = known[0]
    return copies


def _type_hash(connection: Any) -> str:
    """Return the hash of a message type, which single .mcap files do not contain."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    definition = connection.msgdef.data
    with suppress(Exception):  # the definition may be incomplete
        if connection.msgdef.format is MessageDefinitionFormat.IDL:
            store.register(get_types_from_idl(definition))
        else:
            store.register(get_types_from_msg(definition, connection.msgtype))
        return str(store.hash_rihs01(connection.msgtype))
    return _UNKNOWN_HASH


def _add_box_topic(topic: str, target: Any) -> Any:
    from lidarfiles.clouds.ros.messages import message_store

    return target.add_connection(topic, _MARKERS, typestore=message_store())


def _marker_definition() -> str:
    from lidarfiles.clouds.ros.messages import message_store

    definition, _ = message_store().generate_msgdef(_MARKERS, ros_version=2)
    return str(definition)


def _marker_hash() -> str:
    from lidarfiles.clouds.ros.messages import message_store

    return str(message_store().hash_rihs01(_MARKERS))

"""Augmented copies of ROS 2 bags."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from dataclasses import replace as replace_fields
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
import yaml

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
from lidarsim.columns.mcap_chunks import has_attachments, has_compressed_chunks, read_metadata
from lidarsim.errors import CutShortError
from lidarsim.io.input_files import read_input_text

from ...clouds.recording import Recording, RecordingSource, sweep_from_columns
from ...clouds.ros.bags import header_of, point_connection
from ...processes.per_process import PerProcess
from ..augmented_sweep import AugmentedSweep
from .data_set_copy import copy_data_set
from .rewriter import EncodedSweeps, Rewriter, organization_notes
from .stored_records import StoredRecords, unchanged

_BOX_NAMESPACE = "augmented_objects"  # the topic has the same name
_BAG_SUFFIXES = (".mcap", ".db3", ".zstd")
_METADATA_FILE = "metadata.yaml"
_SCAN = "sensor_msgs/msg/LaserScan"
_POINT_TYPES = (POINT_CLOUD, _SCAN, *LIVOX_CLOUDS)
_UNKNOWN_HASH = f"RIHS01_{'0' * 64}"  # hash of a message type whose definition is unknown
# ROS 2 Humble cannot read later versions, because QoS profiles are lists from version 9 on.
_OLDEST_VERSION = 8
_NEWEST_VERSION = 9


class BagRewriter(Rewriter):
    """Writer of an augmented ROS 2 bag, which is a folder or a single .mcap file.

    The messages of one topic with points are encoded anew, with the same fields and the same size
    of a point. All other messages are copied. Boxes of inserted objects are published as markers.
    """

    title = "ROS 2"

    def __init__(self, source: RecordingSource, recording: Recording) -> None:
        super().__init__(source, recording)
        self._messages = PerProcess(partial(_TopicMessages, source))

    def encode(
        self, number: int, augmented: AugmentedSweep
    ) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Return the message of a sweep, and a message with the boxes of inserted objects."""
        from ...clouds.ros.messages import box_markers

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
        sweep = sweep_from_columns(columns)
        recording = replace_fields(self.recording, read=lambda _: sweep, read_poses=None)
        return StoredRecords(
            records, recording[number], recording.meters, recording.intensity_column
        )

    def sensors(self) -> list[str]:
        """Return the topics with points."""
        with opened_bag(self.path, self.source.name) as bag:
            topics = {c.topic for c in bag.connections if c.msgtype in _POINT_TYPES}
        return sorted(topics)

    @cached_property
    def sensor(self) -> str:
        """Topic with the sweeps."""
        with opened_bag(self.path, self.source.name) as bag:
            return str(point_connection(self.source, bag).topic)

    def assemble(self, target: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write the bag, message by message."""
        notes = organization_notes(encoded.details())
        folder = target if self.path.is_dir() else target.with_name(f"{target.name}.bag")
        if base == target:
            base = target.with_name(f"previous-{target.name}")
            target.rename(base)
        try:
            notes += self._write_folder(folder, encoded, base)
            if self.path.is_dir():
                notes += copy_data_set(base, target, self._bag_files(base))
            else:
                (written,) = folder.glob("*.mcap")
                written.replace(target)
        finally:
            if folder != target:
                shutil.rmtree(folder, ignore_errors=True)
        return notes

    def _bag_files(self, folder: Path) -> set[str]:
        """Return the names of the files that belong to the bag in a folder."""
        files = {file.name for file in folder.iterdir() if file.suffix.lower() in _BAG_SUFFIXES}
        return files | {_METADATA_FILE}

    def _write_folder(self, folder: Path, encoded: EncodedSweeps, base: Path) -> list[str]:
        """Write a bag folder, and return notes for the user."""
        from rosbags.rosbag2 import Writer

        notes = []
        layout = _BagLayout.from_path(base)
        writer = Writer(folder, version=layout.version, storage_plugin=layout.plugin)
        writer.set_compression(layout.compression, _zstd())
        has_boxes = any(sweep["boxes"] for sweep in encoded.details())
        with opened_bag(base, self.source.name) as bag, writer as target:
            for key, value in layout.custom_data.items():
                target.set_custom_data(key, value)
            chosen = point_connection(self.source, bag)
            connections = _copy_connections(bag, target)
            boxes = _add_box_topic(bag, target) if has_boxes else None
            number = 0
            for connection, time_ns, data in bag.messages():
                if connection.id != chosen.id:
                    target.write(connections[connection.id], time_ns, data)
                    continue
                content = (encoded.folder / _message_file(number)).read_bytes()
                target.write(connections[connection.id], time_ns, content)
                if boxes is not None:
                    markers = (encoded.folder / _marker_file(number)).read_bytes()
                    target.write(boxes, time_ns, markers)
                number += 1
            if number != encoded.count:
                raise CutShortError(
                    f"{encoded.count:,} sweeps were expected, but it has {number:,}"
                )
            if boxes is not None:
                notes.append(
                    f"The boxes of inserted objects are published on {boxes.topic} as a "
                    "MarkerArray in the sensor frame."
                )
        if layout.has_attachments:
            notes.append(f"The attachments of {self.source.name} are not copied.")
        return notes


def _message_file(number: int) -> str:
    return f"messages/{number:08}.cdr"


def _marker_file(number: int) -> str:
    return f"markers/{number:08}.cdr"


def _zstd() -> Any:
    from rosbags.rosbag2.enums import CompressionFormat

    return CompressionFormat.ZSTD


@dataclass
class _TopicMessages:
    """Messages with the sweeps of a recording.

    A bag can only be read from its start, so reading messages in ascending order is fastest.
    """

    source: RecordingSource
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
                self._bag = self._bag or open_bag(self.source.path, self.source.name)
                connection = point_connection(self.source, self._bag)
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


class _BagLayout(NamedTuple):
    """Options with which a bag is written like the original."""

    version: Any
    plugin: Any
    compression: Any
    custom_data: dict[str, str]
    has_attachments: bool

    @classmethod
    def from_path(cls, path: Path) -> _BagLayout:
        """Determine the options from the metadata of a bag, which is a folder or an .mcap file."""
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2.enums import CompressionMode

        if path.is_dir():
            text = read_input_text(path / _METADATA_FILE, errors="replace")
            metadata = _mapping(_mapping(text).get("rosbag2_bagfile_information"))
            files = sorted(path.glob("*.mcap"))
        else:
            stated = read_metadata(path).get("rosbag2", {}).get("serialized_metadata", "")
            metadata = _mapping(stated)
            files = [path] if path.suffix.lower() == ".mcap" else []
        is_mcap = bool(files) or metadata.get("storage_identifier") == "mcap"
        mode = str(metadata.get("compression_mode") or "").upper()
        compression = CompressionMode.__members__.get(mode, CompressionMode.NONE)
        if compression is CompressionMode.NONE and files and has_compressed_chunks(files[0]):
            compression = CompressionMode.STORAGE
        version = metadata.get("version")
        is_new = isinstance(version, int) and version >= _NEWEST_VERSION
        custom = _mapping(metadata.get("custom_data"))
        return cls(
            _NEWEST_VERSION if is_new else _OLDEST_VERSION,
            StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3,
            compression,
            {str(key): str(value) for key, value in custom.items()},
            any(has_attachments(file) for file in files),
        )


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


def _add_box_topic(bag: Any, target: Any) -> Any:
    """Add a topic for boxes, whose name does not occur in the bag."""
    from ...clouds.ros.messages import message_store

    topics = {connection.topic for connection in bag.connections}
    topic = f"/{_BOX_NAMESPACE}"
    number = 1
    while topic in topics:
        number += 1
        topic = f"/{_BOX_NAMESPACE}_{number}"
    return target.add_connection(
        topic, "visualization_msgs/msg/MarkerArray", typestore=message_store()
    )

"""Functions that read ROS 2 bags and the point columns of their messages with rosbags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ..environment.extras import reading, require_package
from ..errors import CutShortError, LidarError
from ..io.input_files import input_size
from ..numerics.arrays import AnyArray, Records
from ..words import make_distinct, plural, printable
from .mcap_chunks import check_chunks, check_packed

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys.store import Typestore

BAG_FILES = (".mcap", ".db3")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # first bytes of data that is compressed with Zstandard
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
# Point cloud messages of the Livox drivers: livox_ros_driver2 and its predecessors.
LIVOX_CLOUDS = tuple(
    f"{package}/msg/CustomMsg"
    for package in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")
)
LIVOX_POINT = np.dtype(
    {
        "names": ["offset_time", "x", "y", "z", "reflectivity", "tag", "line"],
        "formats": ["<u4", "<f4", "<f4", "<f4", "u1", "u1", "u1"],
        "offsets": [0, 4, 8, 12, 16, 17, 18],
        "itemsize": 20,
    }
)
LIVOX_PADDING = 1  # bytes between points; the last point in a message has no padding
# {NumPy type of a point field: number of the type in PointField}
POINT_FIELDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class BagMessage(NamedTuple):
    """A deserialized message from a bag."""

    topic: str
    time_ns: int  # time at which the message was recorded
    content: Any  # the deserialized message


def is_bag(path: Path) -> bool:
    """Return whether a path is an .mcap file, a .db3 file or a bag folder."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix.lower() in BAG_FILES


def open_bag(path: Path, name: str) -> Reader:
    """Open a bag that closes itself when it is no longer used.

    Raises
    ------
    LidarError
        If the bag cannot be opened. The message starts with `name`.
    """
    require_package("rosbags", "ros", f"Reading {name}")
    from rosbags.rosbag2 import ReaderError

    from .closing_bag import ClosingBag

    with reading(name):
        for file in path.iterdir() if path.is_dir() else [path]:
            if not file.is_dir():
                input_size(file)
                if file.suffix.lower() == ".mcap":
                    check_chunks(file)
                elif file.suffix.lower() == ".zstd":
                    check_packed(file)
        try:
            bag = ClosingBag(path)
            bag.open()
        except ReaderError as error:
            if "magic is invalid" in str(error):
                raise LidarError(
                    "it is not a complete MCAP file. If the recording was interrupted, repair the "
                    "file with `mcap recover`."
                ) from error
            if "Profile is not ros2" not in str(error):
                raise
            raise LidarError(
                "it has no ROS 2 messages. Record PointCloud2, or set an OSI trace as the traffic "
                "of a scenario."
            ) from error
        _check_messages(bag, path)
    return bag


def _check_messages(bag: Reader, path: Path) -> None:
    """Raise LidarError if the messages in a single file are compressed one by one."""
    if path.is_dir():  # metadata.yaml states the compression
        return
    first = next(bag.messages(), None)
    if first is not None and bytes(first[2][:4]) == _ZSTD_MAGIC:
        raise LidarError(
            "its messages are compressed one by one, which only the file metadata.yaml of the bag "
            "states. Specify the folder that contains both files."
        )


@contextmanager
def opened_bag(path: Path, name: str) -> Iterator[Reader]:
    """Open a bag and close it when the context exits.

    Errors that occur while the bag is read are converted into a LidarError.
    """
    with closing(open_bag(path, name)) as bag, reading(name):
        yield bag


def read_messages(bag: Reader, topics: Sequence[str]) -> Iterator[BagMessage]:
    """Yield the messages on the given topics in the order of the bag."""
    connections = [entry for entry in bag.connections if entry.topic in topics]
    if connections:  # given no connections, rosbags would yield the messages on all topics
        for connection, time_ns, data in bag.messages(connections):
            content = message_types().deserialize_cdr(data, connection.msgtype)
            yield BagMessage(connection.topic, time_ns, content)


@cache
def message_types() -> Typestore:
    """Return the type store for ROS 2 messages."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def point_columns(data: bytes) -> dict[str, AnyArray]:
    """Return the fields of a serialized PointCloud2 message as columns.

    A field with several numbers per point becomes the columns `name_0`, `name_1`, and so on. If two
    fields have the same name, the second is renamed to `name_2`.

    Returns
    -------
    dict
        Mapping from column names to arrays of shape (n,).

    Raises
    ------
    ValueError
        If the lengths in the message are inconsistent, or if a field has an invalid type or count.
    """
    rows = point_rows(message_types().deserialize_cdr(data, POINT_CLOUD))
    return {name: rows[name] for name in rows.dtype.names or ()}


def point_rows(message: Any) -> Records:
    """Return the points of a PointCloud2 message as a structured array of shape (n,).

    Its fields are named like the columns that `point_columns` returns. Unused bytes of a point are
    part of its row. Raises ValueError like `point_columns`.
    """
    kinds = {number: kind for kind, number in POINT_FIELDS.items()}
    order = ">" if message.is_bigendian else "<"
    for field in message.fields:
        if field.datatype not in kinds or not field.count:
            raise ValueError(
                f"its field {printable(field.name)!r} has datatype {field.datatype} and count "
                f"{field.count}, but a PointField has datatypes 1 to {len(kinds)} and a count of "
                "at least 1. Record it again with a driver that sets both"
            )
        size = np.dtype(kinds[field.datatype]).itemsize
        if field.offset + field.count * size > message.point_step:
            raise ValueError(
                f"its field {printable(field.name)!r} has {plural(field.count, 'number')} of "
                f"{plural(size, 'byte')} starting at byte {field.offset:,}, but a point has only "
                f"{message.point_step:,} bytes. Record it again with a driver that sets point_step "
                "to the size of a point"
            )
    numbers = [
        (field.name if field.count == 1 else f"{field.name}_{index}", field, index)
        for field in message.fields
        for index in range(field.count)
    ]
    if not numbers:
        return np.zeros(0, [])
    formats = [order + kinds[field.datatype] for _, field, _ in numbers]
    row = np.dtype(
        {
            "names": make_distinct(name for name, _, _ in numbers),
            "formats": formats,
            "offsets": [
                field.offset + index * np.dtype(kind).itemsize
                for (_, field, index), kind in zip(numbers, formats, strict=True)
            ],
            "itemsize": message.point_step,
        }
    )
    if message.data.size != message.height * message.row_step:
        raise ValueError(
            f"its data have {message.data.size:,} bytes, but {message.height:,} rows of "
            f"{message.row_step:,} bytes are stated"
        )
    if message.width * message.point_step > message.row_step:
        raise ValueError(
            f"a row of {message.width:,} points of {message.point_step:,} bytes is stated, but a "
            f"row has only {message.row_step:,} bytes"
        )
    lines = message.data.reshape(message.height, message.row_step)
    used = np.ascontiguousarray(lines[:, : message.width * message.point_step])
    return used.reshape(-1).view(row)


def livox_columns(data: bytes) -> dict[str, AnyArray]:
    """Return the points in a serialized Livox CustomMsg as columns.

    Returns
    -------
    dict
        Mapping from column names to arrays of shape (n,).

    Raises
    ------
    ValueError
        If the message is truncated.
    """
    rows, _ = livox_rows(data)
    return {name: rows[name] for name in rows.dtype.names or ()}


def livox_rows(data: bytes) -> tuple[Records, int]:
    """Return the points of a serialized Livox CustomMsg, and the position of the first point.

    The points are a structured array of shape (n,). Raises ValueError if the message is truncated.
    """
    order: Literal["<", ">"] = "<" if data[1] & 1 else ">"

    def number(offset: int) -> int:
        return int(np.frombuffer(data, f"{order}u4", 1, offset)[0])

    name_start = 16  # after the encapsulation header, the stamp, and the length of the frame name
    # The time of the first point is aligned to 8 bytes, not counting the encapsulation header.
    header_size = -(-(name_start - 4 + number(name_start - 4)) // 8) * 8
    start = 4 + header_size + 20  # after time, point count, lidar identifier, and array length
    count = number(start - 4)
    row = LIVOX_POINT.newbyteorder(order)
    if len(data) < start + count * row.itemsize - LIVOX_PADDING * bool(count):
        raise CutShortError(f"{count:,} points were expected, but there are fewer")
    content = data[start : start + count * row.itemsize].ljust(count * row.itemsize, b"\0")
    return np.frombuffer(content, row), start


def livox_message(data: bytes, rows: Records) -> bytes:
    """Return a serialized Livox CustomMsg in which the points are replaced."""
    _, start = livox_rows(data)
    count = np.array(len(rows), "<u4" if data[1] & 1 else ">u4").tobytes()
    head = bytearray(data[:start])
    for position in (start - 12, start - 4):  # point_num, and the length of the array
        head[position : position + 4] = count
    content = rows.tobytes()
    return bytes(head) + content[: len(content) - LIVOX_PADDING]

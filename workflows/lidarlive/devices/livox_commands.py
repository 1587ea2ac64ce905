"""Livox SDK2 commands, which are frames with checksums and key-value parameters.

Sources: Livox communication protocol of the Mid-360 (1.4.11); sdk_protocol.cpp, build_request.cpp
and livox_lidar_def.h in Livox-SDK2 1.4.3. All numbers are little-endian.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from struct import Struct
from typing import NamedTuple
from zlib import crc32

MAX_FRAME_BYTES = 1400
_HEAD = Struct("<BBHIHBB6s")  # start, version, length, number, command, frame type, sender
_CHECKSUMS = Struct("<HI")  # checksums of the head and of the data
_HEAD_BYTES = _HEAD.size + _CHECKSUMS.size
_START = 0xAA
_VERSION = 0
_REQUEST = 0  # frame types
_ANSWER = 1
_HOST = 0  # senders
_LIDAR = 1
_COUNT = Struct("<HH")  # number of keys, reserved
_KEY = Struct("<H")
_ENTRY = Struct("<HH")  # key, length


class Command(IntEnum):
    """Commands that a sensor answers."""

    SEARCH = 0x0000
    SET = 0x0100
    GET = 0x0101
    PUSH = 0x0102  # sent by the sensor to the host
    REBOOT = 0x0200
    RESET = 0x0201
    SET_GPS_TIME = 0x0202


class Code(IntEnum):
    """Result codes in responses."""

    SUCCESS = 0x00
    FAILURE = 0x01
    OUT_OF_RANGE = 0x03
    NOT_SUPPORTED = 0x20
    READ_ONLY = 0x22
    INVALID_LENGTH = 0x23
    WRONG_KEY_NUMBER = 0x24


class Key(IntEnum):
    """Keys of the parameters that the code refers to by name."""

    DATA_TYPE = 0x0000
    PATTERN = 0x0001
    LIDAR_ADDRESS = 0x0004
    STATE_HOST = 0x0005
    POINTS_HOST = 0x0006
    IMU_HOST = 0x0007
    WORK_MODE = 0x001A
    IMU_ENABLED = 0x001C
    SERIAL_NUMBER = 0x8000
    PRODUCT = 0x8001
    FIRMWARE = 0x8002
    LOADER = 0x8003
    HARDWARE = 0x8004
    MAC = 0x8005
    WORK_STATE = 0x8006
    CORE_TEMPERATURE = 0x8007
    POWER_UPS = 0x8008
    LOCAL_TIME = 0x8009
    LAST_SYNCHRONIZED = 0x800A
    TIME_OFFSET = 0x800B
    TIME_SOURCE = 0x800C
    DIAGNOSIS = 0x800E
    FIRMWARE_TYPE = 0x8010
    HEALTH_CODES = 0x8011


class CommandFrame(NamedTuple):
    """A parsed command request."""

    command: int
    number: int
    data: bytes


@dataclass
class CommandRefusedError(Exception):
    """A refused request, with the error code and the key of the invalid parameter."""

    code: Code
    key: int = 0


def parse_request(content: bytes) -> CommandFrame | None:
    """Parse the request in a datagram. Return None if the frame or its checksums are invalid."""
    if len(content) < _HEAD_BYTES:
        return None
    start, version, length, number, command, kind, _, _ = _HEAD.unpack_from(content)
    head_checksum, data_checksum = _CHECKSUMS.unpack_from(content, _HEAD.size)
    data = content[_HEAD_BYTES:length]
    is_frame = (start, version, kind) == (_START, _VERSION, _REQUEST)
    if not is_frame or not _HEAD_BYTES <= length <= min(len(content), MAX_FRAME_BYTES):
        return None
    if head_checksum != crc_hqx(content[: _HEAD.size], 0xFFFF) or data_checksum != _checksum(data):
        return None
    return CommandFrame(command, number, data)


def answer_frame(command: int, number: int, data: bytes) -> bytes:
    """Return the response frame for a request."""
    return _frame(command, number, data, _ANSWER)


def push_frame(number: int, data: bytes) -> bytes:
    """Return a frame of parameters that the sensor sends without being asked."""
    return _frame(Command.PUSH, number, data, _REQUEST)


def _frame(command: int, number: int, data: bytes, kind: int) -> bytes:
    length = _HEAD_BYTES + len(data)
    head = _HEAD.pack(_START, _VERSION, length, number, command, kind, _LIDAR, b"")
    return head + _CHECKSUMS.pack(crc_hqx(head, 0xFFFF), _checksum(data)) + data


def _checksum(data: bytes) -> int:
    return crc32(data) if data else 0


def parse_values(data: bytes) -> dict[int, bytes]:
    """Parse the parameters in a set request.

    The result maps keys to values. Raises CommandRefusedError if the parameters are truncated.
    """
    values = {}
    offset = _COUNT.size
    for _ in range(_key_count(data)):
        if offset + _ENTRY.size > len(data):
            raise CommandRefusedError(Code.WRONG_KEY_NUMBER)
        key, length = _ENTRY.unpack_from(data, offset)
        offset += _ENTRY.size + length
        if offset > len(data):
            raise CommandRefusedError(Code.INVALID_LENGTH, key)
        values[key] = data[offset - length : offset]
    return values


def parse_keys(data: bytes) -> Sequence[int]:
    """Parse the keys in a get request.

    Raises CommandRefusedError if they are truncated.
    """
    count = _key_count(data)
    if _COUNT.size + count * _KEY.size > len(data):
        raise CommandRefusedError(Code.WRONG_KEY_NUMBER)
    return [_KEY.unpack_from(data, _COUNT.size + n * _KEY.size)[0] for n in range(count)]


def _key_count(data: bytes) -> int:
    if len(data) < _COUNT.size:
        raise CommandRefusedError(Code.WRONG_KEY_NUMBER)
    count: int = _COUNT.unpack_from(data)[0]
    return count


def packed_values(values: Mapping[int, bytes]) -> bytes:
    """Encode parameters for a response."""
    return b"".join(_ENTRY.pack(key, len(value)) + value for key, value in values.items())


def packed_count(values: Mapping[int, bytes]) -> bytes:
    """Return the header of parameters that a sensor sends without being asked."""
    return _COUNT.pack(len(values), 0)

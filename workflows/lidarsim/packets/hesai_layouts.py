"""Layouts of Hesai packets, with the fields, return modes and times of each model.

Sources: user manuals of PandarXT-32, PandarXT-16, Pandar40P, Pandar64, PandarQT, Pandar128 and
Pandar128E3X; UdpProtocol and UdpParser in HesaiLidar_SDK_2.0; the Hesai decoders of tier4/nebula
with recordings of PandarXT-32, Pandar40P, Pandar64 and PandarQT.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..numerics.arrays import Ints

_STRONGEST_OR_LAST = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_FIRST = {"first": 0x33}
_SOP = (0xEE, 0xFF)  # start of packet
UNIT_MM = 4
_SEQUENCE_FLAG = 1  # header flags that state what follows the blocks
_IMU_FLAG = 2
_SAFETY_FLAG = 4
_OT128_STATUS = 128  # status version, by which readers distinguish OT128 from Pandar128

_RETURN = [("distance", "<u2"), ("reflectivity", "u1")]
_RETURN_WITH_BYTE = [*_RETURN, ("reserved", "u1")]
_SEQUENCE = ("sequence", "<u4")


@dataclass(frozen=True, eq=False)
class HesaiPacketLayout:
    """Packet layout of a sensor model.

    The reference of a block is the time at which the block's azimuth is the azimuth of the head.
    """

    channels: int
    blocks: int
    firing_us: float
    packet: np.dtype[np.void]
    modes: Mapping[str, int]  # {return mode: number in the packet}
    first_laser_us: float  # time from the reference of a block to the first laser that fires
    reference_us: float  # time from the timestamp of a packet to the reference of the stamped block
    epoch: int  # year 0 of dates
    model_code: int  # code in the device information (hesai_ptc.py)
    header: tuple[int, ...] = ()  # header bytes, some of which `dual_header` replaces
    dual_header: Mapping[int, int] | None = None  # {position: byte in dual mode}
    block_start: int | None = None  # first bytes of each block
    return_byte: int = 0  # fourth byte of a return
    stamps_first_block: bool = False  # whether timestamps belong to the first block or to the last
    has_checksums: bool = False  # whether body, functional safety and tail have checksums
    has_epoch_seconds: bool = True  # whether dates may be seconds since 1970 from a PTP clock
    listed_states: tuple[int, ...] = ()  # operational state of each column of firing times
    lists_distances: bool = False  # whether each state has columns for far and for near targets

    def header_bytes(self, dual: bool) -> Ints:
        """Return the header bytes for single or dual return mode."""
        header = np.array(self.header, np.int64)
        if dual and self.dual_header is not None:
            for position, byte in self.dual_header.items():
                header[position] = byte
        return header

    def dates(self, seconds: Ints) -> NDArray[np.uint8]:
        """Convert seconds since 1970 to UTC dates, from year to second."""
        times = seconds.astype("datetime64[s]")
        months = times.astype("datetime64[M]")
        days = times.astype("datetime64[D]")
        second_of_day = (times - days).astype(np.int64)
        columns = (
            times.astype("datetime64[Y]").astype(np.int64) + 1970 - self.epoch,
            months.astype(np.int64) % 12 + 1,
            (days - months).astype(np.int64) + 1,
            second_of_day // 3600,
            second_of_day // 60 % 60,
            second_of_day % 60,
        )
        return np.stack(columns, axis=1).astype(np.uint8)


def _numbered(
    version: tuple[int, int], status: int, lasers: int, blocks: int, flags: int
) -> tuple[int, ...]:
    """Return the 12-byte header for single return mode in a versioned protocol."""
    return (*_SOP, *version, status, 0, lasers, blocks, 0, UNIT_MM, 1, flags)


# {header position: byte in dual mode}, with the last return first and two returns per block.
_DUAL_NUMBERED = {8: 1, 10: 2}


def _blocks(
    count: int, lasers: int, returned: list[tuple[str, str]], starts: bool = False
) -> tuple[str, np.dtype[np.void], tuple[int]]:
    """Return the packet field that contains the blocks."""
    start = [("start", "<u2")] if starts else []
    block = np.dtype([*start, ("azimuth", "<u2"), ("returns", np.dtype(returned), (lasers,))])
    return "blocks", block, (count,)


_PANDAR_TAIL = [
    ("status", "u1", (5,)),
    ("shutdown", "u1"),
    ("error", "<u2"),
    ("motor_rpm", "<u2"),
    ("stamp_us", "<u4"),
    ("mode", "u1"),
    ("factory", "u1"),
    ("date", "u1", (6,)),
    _SEQUENCE,
]
_QT_TAIL = [
    ("status", "u1", (10,)),
    ("motor_rpm", "<u2"),
    ("stamp_us", "<u4"),
    ("mode", "u1"),
    ("factory", "u1"),
    ("date", "u1", (6,)),
    _SEQUENCE,
]
_DATED_TAIL = [
    ("mode", "u1"),
    ("motor_rpm", "<u2"),
    ("date", "u1", (6,)),
    ("stamp_us", "<u4"),
    ("factory", "u1"),
    _SEQUENCE,
]
_IMU = [
    ("imu_temperature", "<i2"),
    ("imu_acceleration_unit", "<u2"),
    ("imu_rate_unit", "<u2"),
    ("imu_stamp", "<u4"),
    ("imu_acceleration", "<i2", (3,)),
    ("imu_rate", "<i2", (3,)),
]
_SAFETY = np.dtype(
    [
        ("version", "u1"),
        ("state", "u1"),
        ("fault_info", "u1"),
        ("fault_code", "<u2"),
        ("reserved", "u1", (8,)),
        ("checksum", "<u4"),
    ]
)
_PACKET_128 = np.dtype(
    [
        ("header", "u1", (12,)),
        _blocks(2, 128, _RETURN),
        ("checksum", "<u4"),
        ("safety", _SAFETY),
        ("status", "u1", (9,)),
        ("azimuth_states", "<u2"),
        ("operational_state", "u1"),
        *_DATED_TAIL,
        *_IMU,
        ("tail_checksum", "<u4"),
    ]
)
STANDARD_STATE = 2  # operational state in which all lasers fire in each block
_FLAGS_128 = _SEQUENCE_FLAG | _IMU_FLAG | _SAFETY_FLAG

LAYOUTS = {
    "PandarXT-32": HesaiPacketLayout(
        channels=32,
        blocks=8,
        firing_us=50.0,
        packet=np.dtype(
            [
                ("header", "u1", (12,)),
                _blocks(8, 32, _RETURN_WITH_BYTE),
                ("status", "u1", (9,)),
                ("shutdown", "u1"),
                *_DATED_TAIL,
            ]
        ),
        modes=_STRONGEST_OR_LAST | _FIRST,
        first_laser_us=6.0,
        reference_us=0.0,
        epoch=1900,
        model_code=25,
        header=_numbered((6, 1), 0, 32, 8, _SEQUENCE_FLAG),
        dual_header=_DUAL_NUMBERED,
        return_byte=0xFF,
    ),
    "Pandar40P": HesaiPacketLayout(
        channels=40,
        blocks=10,
        firing_us=500 / 9,
        packet=np.dtype([_blocks(10, 40, _RETURN, starts=True), *_PANDAR_TAIL]),
        modes=_STRONGEST_OR_LAST,
        first_laser_us=-54.67,
        reference_us=-28.58,
        epoch=2000,
        model_code=0,
        block_start=0xEEFF,
        has_epoch_seconds=False,
    ),
    "Pandar64": HesaiPacketLayout(
        channels=64,
        blocks=6,
        firing_us=500 / 9,
        packet=np.dtype([("header", "u1", (8,)), _blocks(6, 64, _RETURN), *_PANDAR_TAIL]),
        modes=_STRONGEST_OR_LAST,
        first_laser_us=-54.668,
        reference_us=-42.58,
        epoch=2000,
        model_code=2,
        header=(*_SOP, 64, 6, 0, UNIT_MM, 0, 0),
        has_epoch_seconds=False,
    ),
    "PandarQT": HesaiPacketLayout(
        channels=64,
        blocks=4,
        firing_us=500 / 3,
        packet=np.dtype([("header", "u1", (12,)), _blocks(4, 64, _RETURN_WITH_BYTE), *_QT_TAIL]),
        # In dual mode, it sends the last and the first return.
        modes={"last": 0x38} | _FIRST,
        first_laser_us=2.31,
        reference_us=25.71,
        epoch=1900,
        model_code=15,
        header=_numbered((3, 1), 0, 64, 4, _SEQUENCE_FLAG),
        stamps_first_block=True,
    ),
    "Pandar128": HesaiPacketLayout(
        channels=128,
        blocks=2,
        firing_us=500 / 9,
        packet=_PACKET_128,
        modes=_STRONGEST_OR_LAST | _FIRST,
        first_laser_us=0.776,
        reference_us=3.148,
        epoch=1900,
        model_code=3,
        header=_numbered((1, 4), 0, 128, 2, _FLAGS_128),
        dual_header=_DUAL_NUMBERED,
        has_checksums=True,
        listed_states=(0, 0, 0, 0, 2, 2, 3, 3),
        lists_distances=True,
    ),
    "OT128": HesaiPacketLayout(
        channels=128,
        blocks=2,
        firing_us=500 / 9,
        packet=_PACKET_128,
        modes=_STRONGEST_OR_LAST | _FIRST,
        first_laser_us=0.0,
        reference_us=0.0,
        epoch=1900,
        model_code=42,
        header=_numbered((1, 4), _OT128_STATUS, 128, 2, _FLAGS_128),
        dual_header=_DUAL_NUMBERED,
        has_checksums=True,
        listed_states=(0, 0, 0, 0, 2, 2),
    ),
}

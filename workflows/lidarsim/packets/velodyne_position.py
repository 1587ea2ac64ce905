"""Velodyne position packets, which transmit an NMEA 0183 GPRMC sentence with the time.

There is a new sentence every second.

Sources: user manual of the VLP-16 (63-9243), section 9.3.3, with the ratio of data to position
packets; telemetry_packet.cpp in valgur/velodyne_decoder.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bytes, Floats, Ints, Records
from ..numerics.elementary import arctan2, cos
from ..numerics.vectors import hypot
from ..sweeps.instruments import GNSS_FILE
from .encoders import Datagrams, PacketSource

POSITION_PORT = 8308
_DATA_PACKETS = 14  # number of data packets per position packet
_HOUR_US = 3_600_000_000
_SECOND_NS = 1_000_000_000
_SENTENCE_BYTES = 306
_POSITION = np.dtype({
    "names": ["stamp_us", "pps", "sentence"],
    "formats": ["<u4", "u1", f"S{_SENTENCE_BYTES}"],
    "offsets": [198, 202, 206],
    "itemsize": 512,
})  # fmt: skip
_LOCKED = 2  # state of the pulse per second
_DEGREE_M = 111_195.0  # length of one degree of a great circle
_KNOT_M_S = 1852 / 3600


class Fix(NamedTuple):
    """Position and motion reported by a GNSS receiver."""

    latitude_deg: float
    longitude_deg: float
    speed_m_s: float
    course_deg: float  # clockwise from north


class PositionPackets:
    """Position packets that a sensor sends between its data packets.

    There is one position packet for every 14 data packets.

    Each sentence belongs to the last full second. It contains the fix of the platform's GNSS
    receiver if latitudes are known, otherwise no fix. If the survey has no start time, the clock is
    not synchronized, and the sentence and the state of the pulse per second are empty.
    """

    def __init__(self, source: PacketSource, port: int) -> None:
        self._source = source
        self._port = port
        self._count = 0  # number of data packets so far
        self._fixes = _Fixes.from_source(source)
        self._sentences: dict[int, bytes] = {}  # {second since 1970: sentence}

    def following(self, due_ns: Ints, stamps_ns: Ints) -> Datagrams:
        """Return the position packets that follow data packets sent at `due_ns`.

        `stamps_ns` (n,) are the same times on the sensor's clock.
        """
        numbers = self._count + np.arange(1, len(due_ns) + 1)
        self._count += len(due_ns)
        follows = numbers % _DATA_PACKETS == 0
        clock_ns = self._source.start_ns + stamps_ns[follows]
        packets = np.zeros(len(clock_ns), _POSITION)
        packets["stamp_us"] = clock_ns // 1000 % _HOUR_US
        if self._source.dated:
            packets["pps"] = _LOCKED
            seconds = (clock_ns // _SECOND_NS).tolist()
            packets["sentence"] = [self._sentence(second) for second in seconds]
        return Datagrams(_as_bytes(packets), due_ns[follows], self._port)

    def _sentence(self, second: int) -> bytes:
        if second not in self._sentences:
            since_start_ns = second * _SECOND_NS - self._source.start_ns
            fix = None if self._fixes is None else self._fixes.at(since_start_ns)
            self._sentences = {second: gprmc(second, fix)}
        return self._sentences[second]


class _Fixes(NamedTuple):
    """Chronological fixes of a GNSS receiver."""

    times_ns: Ints  # (n,): since the start of the survey
    latitudes_deg: Floats  # (n,)
    longitudes_deg: Floats  # (n,)

    @classmethod
    def from_source(cls, source: PacketSource) -> _Fixes | None:
        """Return the fixes of the platform, or None if they are missing or lack latitudes."""
        instruments = source.instruments
        rows = [] if instruments is None else list(instruments.rows(GNSS_FILE))
        if not rows or len(rows[0]) < 6:
            return None
        times_ns = np.array([int(row[0]) for row in rows])
        latitudes, longitudes = np.array([row[4:6] for row in rows], np.float64).T
        return cls(times_ns, latitudes, longitudes)

    def at(self, time_ns: int) -> Fix | None:
        """Return the last fix at or before a given time, or None before the first fix."""
        row = int(np.searchsorted(self.times_ns, time_ns, "right")) - 1
        if row < 0:
            return None
        first, second = (row - 1, row) if row else (0, min(1, len(self.times_ns) - 1))
        seconds = float(self.times_ns[second] - self.times_ns[first]) / _SECOND_NS or 1.0
        latitude = float(self.latitudes_deg[row])
        longitude = float(self.longitudes_deg[row])
        north_m = _DEGREE_M * float(np.diff(self.latitudes_deg[[first, second]])[0])
        parallel_m = _DEGREE_M * float(cos(np.radians(latitude)))
        east_m = parallel_m * float(np.diff(self.longitudes_deg[[first, second]])[0])
        course_deg = float(np.degrees(arctan2(east_m, north_m))) % 360
        speed_m_s = float(hypot(east_m, north_m)) / seconds
        return Fix(latitude, longitude, speed_m_s, course_deg)


def gprmc(second: int, fix: Fix | None) -> bytes:
    r"""Format a GPRMC sentence for a second since 1970 (UTC).

    Without a fix, the status in the sentence is V.

    Examples
    --------
    >>> gprmc(1_000_000_000, Fix(-48.5, 11.25, 10.0, 90.0))
    b'$GPRMC,014640,A,4830.00000,S,01115.00000,E,019.4,090.0,090901,,,A*65\r\n'
    """
    time = datetime.fromtimestamp(second, UTC)
    status = "V" if fix is None else "A"
    mode = "N" if fix is None else "A"
    latitude, longitude, speed_m_s, course_deg = fix or Fix(0.0, 0.0, 0.0, 0.0)
    body = (
        f"GPRMC,{time:%H%M%S},{status},{_angle(latitude, 2)},{'S' if latitude < 0 else 'N'},"
        f"{_angle(longitude, 3)},{'W' if longitude < 0 else 'E'},{speed_m_s / _KNOT_M_S:05.1f},"
        f"{course_deg:05.1f},{time:%d%m%y},,,{mode}"
    )
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode()


def _angle(angle_deg: float, digits: int) -> str:
    """Format an angle in the NMEA notation, with `digits` digits of degrees before the minutes."""
    whole, rest = divmod(round(abs(angle_deg) * 60 * 100_000), 60 * 100_000)
    return f"{whole:0{digits}d}{rest / 100_000:08.5f}"


def _as_bytes(packets: Records) -> Bytes:
    return packets.view(np.uint8).reshape(len(packets), packets.dtype.itemsize)

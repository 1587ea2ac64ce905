"""Livox SDK2 packets with the points and IMU samples of Mid-360 and HAP sensors.

Sources: Livox communication protocols of the Mid-360 (1.4.11) and the HAP (1.4.8); HAP user manual,
page 15 (tags); livox_lidar_def.h and define.h in Livox-SDK2 1.4.3; pub_handler.cpp in
livox_ros_driver2. All numbers are little-endian.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from ..motion.rotations import matrices
from ..numerics.arrays import AnyArray, Bytes, Floats, Ints, Records
from ..numerics.vectors import inverse, matmul, matvec
from .encoders import Datagrams, PacketDecoder, PacketEncoder, PacketSource
from .imu_samples import ImuBatch, PacketImuSamples
from .shots import CarryOver, Shots

DOTS = 96  # points per packet
IMU_DATA = 0  # data type of IMU samples
_CHECKED_FROM = 28  # first byte covered by the checksum of a packet
_MODES = ("strongest", "first", "last")
_STANDARD_GRAVITY = 9.80665  # m/s², the unit of accelerations
_UNSYNCHRONIZED = 0  # time source
_PTP = 1


@dataclass(frozen=True)
class Ports:
    """UDP ports of a device type: ports on the sensor, and default ports on the host."""

    points: int
    imu: int
    host_points: int
    host_imu: int
    command: int
    state: int  # port of state messages; 0 if none are sent
    host_state: int


_MID360 = 9  # device types
_HAP = 10
PORTS = {
    _MID360: Ports(
        points=56_300,
        imu=56_400,
        host_points=56_301,
        host_imu=56_401,
        command=56_100,
        state=56_200,
        host_state=56_201,
    ),
    _HAP: Ports(
        points=57_000,
        imu=58_000,
        host_points=57_000,
        host_imu=58_000,
        command=56_000,
        state=0,
        host_state=0,
    ),
}
# Tag of the HAP for the first return. Return 0 is light reflected by the sensor itself, and returns
# closer than 1.5 m are merged with it. All other tag bits, which describe noise, are 0 for high
# confidence.
_HAP_FIRST_RETURN = 0x10
_HAP_MERGED_M = 1.5
_POSITION = "position_m"  # name of the position column of shots


@dataclass(frozen=True)
class Cartesian:
    """Data type of packets with Cartesian coordinates."""

    number: str  # dtype of a coordinate
    unit_m: float

    @property
    def dots(self) -> np.dtype[np.void]:
        """Dtype of a single point."""
        return np.dtype([("position", self.number, (3,)), ("reflectivity", "u1"), ("tag", "u1")])


# {pcl_data_type in the sensor's parameters: point format}
CARTESIAN = {1: Cartesian("<i4", 0.001), 2: Cartesian("<i2", 0.01)}

_IMU_SAMPLE = np.dtype([("rate", "<f4", (3,)), ("acceleration", "<f4", (3,))])  # rad/s, g


def packet_type(data: np.dtype[np.void], count: int) -> np.dtype[np.void]:
    """Return the dtype of a packet with `count` points or samples."""
    return np.dtype(
        [
            ("version", "u1"),
            ("length", "<u2"),
            ("interval", "<u2"),  # time from the first to the last point, in 0.1 µs
            ("count", "<u2"),
            ("number", "<u2"),  # number of the packet in its frame
            ("frame", "u1"),
            ("data_type", "u1"),
            ("time_type", "u1"),
            ("reserved", "u1", (12,)),
            ("checksum", "<u4"),
            ("stamp_ns", "<u8"),
            ("data", data, (count,)),
        ]
    )


class LivoxEncoder(PacketEncoder):
    """Encoder of packets of 96 points, and of IMU packets if the platform has an IMU.

    Points are positions in the sensor frame at their firing time, so the motion of the platform is
    not removed. A pulse without a return is a point with all coordinates 0. Lines alternate: point
    n belongs to line n modulo the number of lines. The identifier `data_type` selects 32-bit
    coordinates with a resolution of 1 mm (1, the default) or 16-bit coordinates with a resolution
    of 10 mm (2). IMU samples are rotated to the sensor's axes, because a real sensor's IMU is
    aligned with them.
    """

    identifiers = ("device_type",)
    optional_identifiers = ("data_type",)
    address = "192.168.1.100"
    destination = "192.168.1.5"
    distinguished_by_receivers = True
    has_own_address = True

    def __init__(self, source: PacketSource) -> None:
        super().__init__(source)
        self.device_type = self.number("device_type")
        if self.device_type not in PORTS:
            types = ", ".join(map(str, PORTS))
            raise self.unusable(f"support the device types {types}, not {self.device_type}")
        self.data_type = source.settings.identifiers.get("data_type", 1)
        if self.data_type not in CARTESIAN:
            types = ", ".join(map(str, CARTESIAN))
            raise self.unusable(f"support the data types {types}, not {self.data_type}")
        if source.mode not in _MODES:
            modes = ", ".join(_MODES)
            raise self.unusable(f"support the returns {modes}, not {source.mode}. Set returns.mode")
        lines = source.sensor.channels
        if DOTS % lines:
            raise self.unusable(
                f"require a number of lines that divides {DOTS}, but the sensor has {lines}"
            )
        self._firings = DOTS // lines
        # Time from the first to the last line of a firing, because readers space points evenly.
        self._lines_ns = self.firing_interval_ns * (lines - 1) / lines
        self._carry = CarryOver(self._firings)
        self._frame = 0
        self._packets_of_frame = 0
        self._samples = PacketImuSamples(source)
        self._to_sensor = _imu_axes(source)

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Encode the shots of a sweep. Return the full point packets, and the IMU packets."""
        if not len(shots):
            return []
        imu = self._imu(self._samples.during(shots))
        # Convert whole sweeps, because the sensor has cached their directions since casting.
        positions = {_POSITION: self._positions_m(shots)[None]}
        shots = replace(shots, columns={**shots.columns, **positions})
        filling = self._carry.whole_packets(shots)
        if not len(filling):
            return imu
        dropped = np.all(filling.dropped.reshape(-1, self._firings), axis=1)
        return [self._points(filling).drop(np.asarray(dropped)), *imu]

    def finish(self) -> list[Datagrams]:
        """Return the last IMU packets.

        Points that do not fill a packet are not sent.
        """
        return self._imu(self._samples.remaining())

    @property
    def ports(self) -> Mapping[str, int]:
        """Ports of the host, keyed by kind of packets."""
        ports = PORTS[self.device_type]
        defaults = {"points": ports.host_points, "imu": ports.host_imu}
        return {**defaults, **self.source.settings.ports}

    def set_data_type(self, data_type: int) -> None:
        """Set the data type of all further packets to a key of `CARTESIAN`."""
        self.data_type = data_type

    def _points(self, shots: Shots) -> Datagrams:
        """Encode shots as point packets, which the shots must fill completely."""
        data_type = int(self.data_type)  # a service thread may change it meanwhile
        kind = CARTESIAN[data_type]
        firings = np.arange(len(shots)).reshape(-1, self._firings)
        packets = np.zeros(len(firings), packet_type(kind.dots, DOTS))
        first_ns = shots.starts_ns[firings[:, 0]]
        last_ns = shots.starts_ns[firings[:, -1]]
        packets["interval"] = np.rint((last_ns - first_ns + self._lines_ns) / 100)
        packets["number"], packets["frame"] = self._numbers(first_ns)
        packets["data_type"] = data_type
        self._write_header(packets, shots.stamps_ns[firings[:, 0]])
        self._fill_points(packets["data"], shots, kind)
        due_ns = last_ns + self.firing_interval_ns
        source_port = PORTS[self.device_type].points
        return Datagrams(_with_checksums(packets), due_ns, self.ports["points"], source_port)

    def _positions_m(self, shots: Shots) -> Floats:
        """Return positions in the sensor frame in meters, or NaN for shots without a return."""
        sensor = self.source.sensor
        channels = self.source.settings.channels
        positions = sensor.directions(shots.firings)[:, channels]
        positions *= shots.range_m[0][:, :, None]
        origins = sensor.origins(shots.firings)
        if origins is not None:
            positions += origins[:, channels]
        return positions

    def _fill_points(self, points: AnyArray, shots: Shots, kind: Cartesian) -> None:
        """Write the positions and reflectivities of shots to `points`."""
        units = shots.columns[_POSITION][0] / kind.unit_m
        np.rint(units, out=units)
        limit = np.iinfo(np.dtype(kind.number)).max
        fits = (np.abs(units) <= limit).all(axis=2)  # False without a return, where units are NaN
        units[~fits] = 0
        points["position"] = units.reshape(points["position"].shape)
        reflectivities = shots.columns["reflectivity"][0] * fits
        points["reflectivity"] = reflectivities.reshape(points.shape)
        if self.device_type == _HAP:
            is_first = fits & (shots.range_m[0] > _HAP_MERGED_M)
            points["tag"] = _HAP_FIRST_RETURN * is_first.reshape(points.shape)

    def _numbers(self, first_ns: Ints) -> tuple[Ints, Ints]:
        """Return the frame of each packet, and the packet's number within the frame.

        `first_ns` (n,) are the start times of the packets. A frame lasts as long as a frame of the
        sensor, and numbers continue from call to call.
        """
        frame_ns = 1e9 / self.source.sensor.head.rate_hz  # type: ignore[attr-defined]
        frames = np.floor(first_ns / frame_ns + 1e-6).astype(np.int64)
        count = np.arange(len(frames))
        is_first = np.diff(frames, prepend=frames[0] - 1) != 0
        numbers = count - np.maximum.accumulate(np.where(is_first, count, 0))
        if frames[0] == self._frame:
            numbers[frames == frames[0]] += self._packets_of_frame
        self._frame = int(frames[-1])
        self._packets_of_frame = int(numbers[-1]) + 1
        return numbers, frames % 256

    def _imu(self, batch: ImuBatch | None) -> list[Datagrams]:
        """Return a packet for each IMU sample, or no packets if `batch` is None."""
        if batch is None:
            return []
        packets = np.zeros(len(batch.times_ns), packet_type(_IMU_SAMPLE, 1))
        packets["data_type"] = IMU_DATA
        self._write_header(packets, batch.stamps_ns)
        samples = packets["data"]
        samples["rate"] = matvec(self._to_sensor, batch.rates)[:, None]
        samples["acceleration"] = (matvec(self._to_sensor, batch.forces) / _STANDARD_GRAVITY)[
            :, None
        ]
        payloads = _with_checksums(packets)
        source_port = PORTS[self.device_type].imu
        return [Datagrams(payloads, batch.times_ns, self.ports["imu"], source_port)]

    def _write_header(self, packets: Records, stamps_ns: Ints) -> None:
        """Write the common header fields of packets.

        `stamps_ns` (n,) are the send times since the start of the survey. The clock of a sensor
        that is not synchronized starts at 0.
        """
        packets["length"] = packets.dtype.itemsize
        packets["count"] = packets["data"].shape[1]
        packets["time_type"] = _PTP if self.source.dated else _UNSYNCHRONIZED
        start_ns = self.source.start_ns if self.source.dated else 0
        packets["stamp_ns"] = np.maximum(stamps_ns + start_ns, 0)


def _imu_axes(source: PacketSource) -> Floats:
    """Return the rotation from the axes of the platform's IMU to those of the sensor."""
    if source.instruments is None or source.instruments.imu is None:
        return np.eye(3)
    on_platform = matrices(np.array([source.instruments.imu.quaternion]))[0]
    return matmul(inverse(source.mount[:3, :3]), on_platform)


def _with_checksums(packets: Records) -> Bytes:
    """Compute the CRC-32 checksums of packets, and return the packets as bytes."""
    payloads = packets.view(np.uint8).reshape(len(packets), packets.dtype.itemsize)
    packets["checksum"] = [crc32(row) for row in payloads[:, _CHECKED_FROM:]]
    return payloads


class LivoxDecoder(PacketDecoder):
    """Decoder that rejects Livox packets, because no package on PyPI reads them as sweeps."""

    refusal = "Livox packets, which are not supported. Record a ROS 2 bag with livox_ros_driver2"

    @staticmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a datagram's version and length are those of a point or IMU packet."""
        size = int.from_bytes(payload[1:3], "little")
        return len(payload) > _CHECKED_FROM and payload[0] == 0 and size == len(payload)

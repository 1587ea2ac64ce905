"""Lidar and IMU packets of Ouster sensors, and the metadata that readers need.

Sources: firmware user manual, sections "Lidar Packet Format" and "IMU Data Format"; parsing.cpp,
packet.cpp, xyzlut.cpp and metadata.cpp in ouster-sdk 1.0.1; sample recordings of ouster-sdk.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..environment.extras import reading
from ..errors import LidarError
from ..io.input_files import input_size
from ..motion.rotations import matrices
from ..numerics.arrays import AnyArray, AnyFloats, Bools, Bytes, Floats, Ints
from ..numerics.elementary import sin_cos
from ..numerics.vectors import inverse, matmul, matvec
from ..scene.transform import affine
from ..sensor.beams import Mirror, Spin
from .capture import ENDINGS, Capture
from .encoders import Datagrams, PacketDecoder, PacketEncoder, PacketSource
from .imu_samples import ImuBatch, PacketImuSamples
from .ouster_loops import DUAL, LOW_RATE, SINGLE
from .pcap import write_datagrams
from .shots import Shots

LIDAR_PORT = 7502
IMU_PORT = 7503
COLUMNS_PER_PACKET = 16
_COLUMNS = (512, 1024, 2048, 4096)  # columns per revolution
_ENCODER_TICKS = 90_112  # ticks per revolution
_LIDAR_PACKET = 1  # packet type
_INITIALIZATION_ID = 1  # number of the sensor's start, which is the same in packets and metadata
_STANDARD_GRAVITY = 9.80665  # m/s², the unit of accelerations
# Factory settings of the sensor that do not affect its packets.
_UNUSED_CONFIGURATION = {
    "azimuth_window": [0, 360_000],
    "multipurpose_io_mode": "OFF",
    "nmea_baud_rate": "BAUD_9600",
    "nmea_ignore_valid_char": 0,
    "nmea_in_polarity": "ACTIVE_HIGH",
    "nmea_leap_seconds": 0,
    "operating_mode": "NORMAL",
    "phase_lock_enable": False,
    "phase_lock_offset": 0,
    "signal_multiplier": 1,
    "sync_pulse_in_polarity": "ACTIVE_HIGH",
    "sync_pulse_out_angle": 360,
    "sync_pulse_out_frequency": 1,
    "sync_pulse_out_polarity": "ACTIVE_HIGH",
    "sync_pulse_out_pulse_width": 10,
}
# {whether the survey has a start time: timestamp_mode in the metadata}
_CLOCKS = {True: "TIME_FROM_PTP_1588", False: "TIME_FROM_INTERNAL_OSC"}
# {return mode: return_order in the metadata}
_RETURN_ORDERS = {
    "strongest": "STRONGEST_TO_WEAKEST",
    "first": "NEAREST_TO_FARTHEST",
    "last": "FARTHEST_TO_NEAREST",
    "two_strongest": "STRONGEST_TO_WEAKEST",
}


@dataclass(frozen=True)
class Profile:
    """Layout of lidar packets, whose name is `udp_profile_lidar` in the metadata."""

    name: str
    layout: int  # pixel layout (`ouster_loops`)
    pixel_words: int  # number of 32-bit words
    range_bits: int
    unit_mm: int = 1

    @property
    def is_legacy(self) -> bool:
        """Whether packets have the original layout, without header and checksum."""
        return self.name == "LEGACY"


PROFILES = {
    profile.name: profile
    for profile in (
        Profile("LEGACY", SINGLE, 3, 20),
        Profile("RNG19_RFL8_SIG16_NIR16", SINGLE, 3, 19),
        Profile("RNG19_RFL8_SIG16_NIR16_DUAL", DUAL, 4, 19),
        Profile("RNG15_RFL8_NIR8", LOW_RATE, 1, 15, unit_mm=8),
    )
}


class RangeUnits(NamedTuple):
    """Units and offset of the ranges in packets, which are measured from the sensor's axis."""

    offset_mm: float  # distance from the axis to the origin of the beams
    unit_mm: float
    max_number: float  # largest range, in units


class ReturnImages(NamedTuple):
    """One image for each of up to r returns per beam. The first has the nearest returns.

    All arrays have shape (r, n, c) for n columns of c beams.
    """

    range_m: AnyFloats  # range from the beam origin; 0 or NaN without a return
    reflectivity: Bytes
    signal: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class MeasurementBlocks:
    """Columns in chronological order. Their number fills whole packets.

    The highest beam comes first in each column.
    """

    frames: Ints  # (n,): number of the revolution
    measurement_ids: Ints  # (n,): column in the revolution
    times_ns: Ints  # (n,): on the sensor's clock, since 1970
    valid: Bools  # (n,): whether the column was fired and reaches the receiver
    returns: ReturnImages


@cache
def lidar_packet(profile: Profile, beams: int) -> np.dtype[np.void]:
    """Return the dtype of a lidar packet."""
    pixels = ("pixels", "<u4", (beams, profile.pixel_words))
    if profile.is_legacy:
        column = np.dtype(
            [
                ("time_ns", "<u8"),
                ("measurement_id", "<u2"),
                ("frame_id", "<u2"),
                ("encoder_count", "<u4"),
                pixels,
                ("status", "<u4"),
            ]
        )
        return np.dtype([("columns", column, (COLUMNS_PER_PACKET,))])
    column = np.dtype([("time_ns", "<u8"), ("measurement_id", "<u2"), ("status", "<u2"), pixels])
    return np.dtype(
        [
            ("type", "<u2"),
            ("frame_id", "<u2"),
            ("initialization_id", "u1", (3,)),
            ("serial_number", "u1", (5,)),
            ("alert_flags", "u1"),  # 0: no alert
            ("reserved", "u1", (3,)),
            ("countdowns", "u1", (2,)),  # seconds to thermal shutdown and shot limiting; 0: none
            ("states", "u1", (2,)),  # states of thermal shutdown and shot limiting; 0: normal
            ("reserved_of_header", "u1", (12,)),
            ("columns", column, (COLUMNS_PER_PACKET,)),
            ("reserved_of_footer", "u1", (24,)),
            ("checksum", "<u8"),
        ]
    )


_LEGACY_BYTES = tuple(
    lidar_packet(PROFILES["LEGACY"], beams).itemsize for beams in (16, 32, 64, 128)
)
_HEADER_AND_FOOTER_BYTES = 64
_SDK_LINKS = (0, 1, 101, 113)  # link types that ouster-sdk 1.0 reads
_MIN_COLUMNS_BYTES = 16 * (12 + 16 * 4)  # for 16 beams with one word each


def lidar_packets(
    blocks: MeasurementBlocks, profile: Profile, offset_mm: float, columns: int, serial_number: int
) -> Bytes:
    """Encode measurement blocks as lidar packets with 16 blocks each.

    Blocks that are not valid contain zeros, except for their numbers. `offset_mm` is the distance
    from the sensor's axis to the origin of its beams, and `columns` the number of columns per
    revolution.
    """
    from . import ouster_loops  # imported here because numba takes half a second to import

    channels = blocks.returns.range_m.shape[2]
    packets = np.zeros(len(blocks.frames) // COLUMNS_PER_PACKET, lidar_packet(profile, channels))
    rows = packets["columns"]
    times_ns = np.where(blocks.valid, np.maximum(blocks.times_ns, 0), 0)
    rows["time_ns"] = times_ns.reshape(rows.shape)
    rows["measurement_id"] = blocks.measurement_ids.reshape(rows.shape)
    frame_ids = (blocks.frames % 2**16).reshape(rows.shape)
    valid = blocks.valid.reshape(rows.shape)
    if profile.is_legacy:
        rows["frame_id"] = frame_ids
        rows["encoder_count"] = rows["measurement_id"] * np.uint32(_ENCODER_TICKS // columns)
        rows["status"] = np.where(valid, 0xFFFF_FFFF, 0)
    else:
        packets["type"] = _LIDAR_PACKET
        packets["frame_id"] = frame_ids[:, 0]
        packets["initialization_id"] = _little_endian(_INITIALIZATION_ID, 3)
        packets["serial_number"] = _little_endian(serial_number, 5)
        rows["status"] = valid
    units = RangeUnits(offset_mm, float(profile.unit_mm), 2.0**profile.range_bits - 1)
    ouster_loops.write_pixels(blocks.returns, valid, profile.layout, units, rows["pixels"])
    payloads = packets.view(np.uint8).reshape(len(packets), packets.itemsize)
    if not profile.is_legacy:
        words = payloads.view("<u8")
        checksums = np.zeros(len(words), np.uint64)
        ouster_loops.checksums(words[:, :-1], ouster_loops.remainders(), checksums)
        words[:, -1] = checksums
    return payloads


def _little_endian(number: int, size: int) -> Bytes:
    """Encode a number as bytes, least significant byte first."""
    return np.frombuffer(number.to_bytes(size, "little"), np.uint8)


_IMU_PACKET = np.dtype(
    [
        ("system_ns", "<u8"),
        ("accelerometer_ns", "<u8"),
        ("gyroscope_ns", "<u8"),
        ("acceleration", "<f4", (3,)),  # in units of standard gravity
        ("angular_velocity", "<f4", (3,)),  # degrees per second
    ]
)


def imu_packets(times_ns: Ints, rates: Floats, forces: Floats) -> Bytes:
    """Encode each IMU sample as a 48-byte packet.

    Parameters
    ----------
    times_ns
        (n,): times on the sensor's clock, in nanoseconds since 1970.
    rates
        (n, 3): angular velocities in rad/s.
    forces
        (n, 3): specific forces in m/s².
    """
    packets = np.zeros(len(times_ns), _IMU_PACKET)
    for name in ("system_ns", "accelerometer_ns", "gyroscope_ns"):
        packets[name] = np.maximum(times_ns, 0)
    packets["acceleration"] = forces / _STANDARD_GRAVITY
    packets["angular_velocity"] = np.degrees(rates)
    return packets.view(np.uint8).reshape(len(packets), packets.itemsize)


class OusterEncoder(PacketEncoder):
    """Encoder of lidar packets with 16 columns, and of IMU packets if the platform has an IMU.

    The identifier `profile` selects the layout of lidar packets. The default is
    RNG19_RFL8_SIG16_NIR16, with the suffix `_DUAL` for the mode two_strongest. Reflectivity and
    signal come from cloud columns. Near infrared is 0, because the simulator does not compute it.
    All values are 0 for a ray without a return, or beyond the maximum range of the profile. A
    packet is not sent if none of its columns reaches the receiver.
    """

    columns = ("reflectivity", "signal")
    identifiers = ("product_line",)
    optional_identifiers = ("profile",)
    address = "192.168.1.200"
    destination = "192.168.1.100"
    default_ports: ClassVar[Mapping[str, int]] = {"lidar": LIDAR_PORT, "imu": IMU_PORT}
    distinguished_by_receivers = True

    def __init__(self, source: PacketSource) -> None:
        super().__init__(source)
        self._profile = self._profile_of_mode()
        self._check_sensor()
        sensor = source.sensor
        channels = source.settings.channels
        self._elevation_deg = np.degrees(sensor.beams.elevation[channels])
        self._azimuth_deg = np.degrees(sensor.beams.azimuth[channels])
        self._origin_mm = 1000 * sensor.beams.origin[0]
        self._columns = int(sensor.head.firings_per_turn)  # type: ignore[attr-defined]
        self._serial_number = 122_000_000_000 + crc32(source.name.encode()) % 1_000_000_000
        self._rest: Shots | None = None  # shots that do not fill a packet yet
        self._next_firing = 0
        self._frame_offset = 0  # number of a frame minus the number of its revolution
        self._samples = PacketImuSamples(source)

    def _profile_of_mode(self) -> Profile:
        """Return the profile that the identifiers or the return mode select.

        Raises LidarError if they are inconsistent.
        """
        mode = self.source.mode
        if mode not in _RETURN_ORDERS:
            modes = ", ".join(_RETURN_ORDERS)
            raise self.unusable(f"support the returns {modes}, not {mode}. Set returns.mode")
        two = mode == "two_strongest"
        default = "RNG19_RFL8_SIG16_NIR16_DUAL" if two else "RNG19_RFL8_SIG16_NIR16"
        name = self.source.settings.identifiers.get("profile", default)
        if name not in PROFILES:
            raise self.unusable(f"support the profiles {', '.join(PROFILES)}, not {name}")
        profile = PROFILES[str(name)]
        if (profile.layout == DUAL) != two:
            needed = "two_strongest" if profile.layout == DUAL else "strongest, first or last"
            raise self.unusable(
                f"with the profile {name} require the returns {needed}, not {mode}. Set "
                "returns.mode"
            )
        return profile

    def _check_sensor(self) -> None:
        """Raise LidarError if Ouster packets cannot represent the sensor."""
        sensor = self.source.sensor
        head = sensor.head
        if isinstance(head, Mirror):
            raise self.unusable(
                "require a head that fires in all directions. Remove azimuth_window and "
                "column_window from its metadata"
            )
        if not isinstance(head, Spin) or not head.clockwise:
            raise self.unusable("require a head that rotates clockwise")
        if head.firings_per_turn not in _COLUMNS or head.rate_hz != int(head.rate_hz):
            raise self.unusable(
                f"support {', '.join(map(str, _COLUMNS))} columns per turn at a whole number of "
                f"turns per second, not {head.firings_per_turn:g} at {head.rate_hz:g}. Set columns "
                "and rate_hz"
            )
        origin = sensor.beams.origin
        if sensor.beams.time_ns.any() or (origin != origin[0]).any() or origin[0, 1]:
            raise self.unusable(
                "require beams that fire simultaneously from one point in front of the axis"
            )

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Encode the shots of a sweep. Return the full lidar packets, and the IMU packets."""
        if not len(shots):
            return []
        groups = []
        first = int(shots.firings[0])
        if first != self._next_firing:  # a station begins, or a frozen sweep is sent again
            groups += self._rest_of_packets()
            next_frame = -(-self._next_firing // self._columns) + self._frame_offset
            self._frame_offset = next_frame - first // self._columns
        self._next_firing = int(shots.firings[-1]) + 1
        joined = shots if self._rest is None else Shots.concatenate([self._rest, shots])
        count = self._next_firing // COLUMNS_PER_PACKET * COLUMNS_PER_PACKET
        count = max(count - int(joined.firings[0]), 0)
        self._rest = joined[count:] if count < len(joined) else None
        groups += self._lidar(joined[:count])
        return [*groups, *self._imu(self._samples.during(shots))]

    def finish(self) -> list[Datagrams]:
        """Return the packet with the last columns, and the remaining IMU packets."""
        return [*self._rest_of_packets(), *self._imu(self._samples.remaining())]

    def files(self) -> Mapping[str, bytes]:
        """Return the metadata of the sensor as JSON, in the format of its HTTP API."""
        return {".json": (json.dumps(self.metadata(), indent=1) + "\n").encode()}

    def _rest_of_packets(self) -> list[Datagrams]:
        """Encode the remaining columns as a packet, and discard them."""
        rest = self._rest
        self._rest = None
        return [] if rest is None else self._lidar(rest)

    def _lidar(self, shots: Shots) -> list[Datagrams]:
        """Encode shots as lidar packets.

        The first and the last packet may lack columns.
        """
        if not len(shots):
            return []
        blocks = self._blocks(shots)
        payloads = lidar_packets(
            blocks, self._profile, float(self._origin_mm[0]), self._columns, self._serial_number
        )
        packets = shots.firings // COLUMNS_PER_PACKET
        last_shots = np.flatnonzero(np.diff(packets, append=-1))
        due_ns = shots.starts_ns[last_shots] + self.firing_interval_ns
        datagrams = Datagrams(payloads, due_ns, self.port("lidar", LIDAR_PORT))
        lost = ~blocks.valid.reshape(-1, COLUMNS_PER_PACKET)
        return [datagrams.drop(np.asarray(lost.all(axis=1)))]

    def _blocks(self, shots: Shots) -> MeasurementBlocks:
        """Return the measurement blocks of shots, padded to whole packets with invalid blocks."""
        first = int(shots.firings[0]) // COLUMNS_PER_PACKET * COLUMNS_PER_PACKET
        packets = -(-(int(shots.firings[-1]) + 1 - first) // COLUMNS_PER_PACKET)
        firings = first + np.arange(packets * COLUMNS_PER_PACKET)
        before = int(shots.firings[0]) - first
        after = len(firings) - len(shots) - before
        images = [shots.range_m, *(shots.columns[name] for name in self.columns)]
        valid = ~shots.dropped
        times_ns = shots.stamps_ns + self.source.start_ns
        if before or after:
            images = [np.pad(image, ((0, 0), (before, after), (0, 0))) for image in images]
            valid = np.pad(valid, (before, after))
            times_ns = np.pad(times_ns, (before, after))
        revolutions, measurement_ids = np.divmod(firings, self._columns)
        return MeasurementBlocks(
            revolutions + self._frame_offset,
            measurement_ids,
            times_ns,
            valid,
            ReturnImages(*images),
        )

    def _imu(self, batch: ImuBatch | None) -> list[Datagrams]:
        """Return a packet for each IMU sample, or no packets if `batch` is None."""
        if batch is None:
            return []
        payloads = imu_packets(batch.stamps_ns + self.source.start_ns, batch.rates, batch.forces)
        return [Datagrams(payloads, batch.times_ns, self.port("imu", IMU_PORT))]

    def metadata(self) -> dict[str, Any]:
        """Return the metadata of the sensor in the format of firmware 3.1."""
        profile = self._profile.name
        rate_hz = int(self.source.sensor.head.rate_hz)  # type: ignore[attr-defined]
        # Azimuths are clockwise here, and rows are shifted by whole columns to face forward.
        azimuth_deg = -self._azimuth_deg
        shifts = np.rint(azimuth_deg * self._columns / 360).astype(int).tolist()
        beam_pose = np.eye(4)
        beam_pose[0, 3] = self._origin_mm[0]
        return {
            "sensor_info": {
                "build_date": "2024-03-01T00:00:00Z",
                "build_rev": "v3.1.0",
                "image_rev": "lidarpool-simulated-v3.1.0",  # clients read the version
                "initialization_id": _INITIALIZATION_ID,
                "prod_line": self.text("product_line"),
                "prod_pn": "lidarpool",
                "prod_sn": str(self._serial_number),
                "status": "RUNNING",
            },
            "config_params": {
                **_UNUSED_CONFIGURATION,
                "columns_per_packet": COLUMNS_PER_PACKET,
                "lidar_mode": f"{self._columns}x{rate_hz}",
                "return_order": _RETURN_ORDERS[self.source.mode],
                "timestamp_mode": _CLOCKS[self.source.dated],
                "udp_dest": self.destination,
                "udp_port_imu": self.port("imu", IMU_PORT),
                "udp_port_lidar": self.port("lidar", LIDAR_PORT),
                "udp_profile_imu": "LEGACY",
                "udp_profile_lidar": profile,
            },
            "lidar_data_format": {
                "column_window": [0, self._columns - 1],
                "columns_per_frame": self._columns,
                "columns_per_packet": COLUMNS_PER_PACKET,
                "fps": rate_hz,
                "pixel_shift_by_row": shifts,
                "pixels_per_column": len(shifts),
                "udp_profile_imu": "LEGACY",
                "udp_profile_lidar": profile,
            },
            "beam_intrinsics": {
                "beam_altitude_angles": _rounded(self._elevation_deg),
                "beam_azimuth_angles": _rounded(azimuth_deg),
                "beam_to_lidar_transform": _rounded(beam_pose),
                "lidar_origin_to_beam_origin_mm": round(float(self._origin_mm[0]), 9),
            },
            "lidar_intrinsics": {"lidar_to_sensor_transform": _rounded(self._lidar_pose())},
            "imu_intrinsics": {"imu_to_sensor_transform": _rounded(self._imu_pose())},
            "calibration_status": {
                "reflectivity": {"timestamp": "2024-03-01T00:00:00", "valid": True}
            },
        }

    def _lidar_pose(self) -> Floats:
        """Return the pose of the head in the sensor frame, in millimeters."""
        sin, cos = sin_cos(np.radians(self.source.sensor.head.zero_deg))  # type: ignore[attr-defined]
        pose = np.eye(4)
        pose[:2, :2] = [[cos, -sin], [sin, cos]]
        pose[2, 3] = self._origin_mm[2]
        return pose

    def _imu_pose(self) -> Floats:
        """Return the pose of the IMU in the sensor frame in mm, or the identity without an IMU."""
        instruments = self.source.instruments
        if instruments is None or instruments.imu is None:
            return np.eye(4)
        imu = instruments.imu
        on_platform = affine(matrices(np.array([imu.quaternion]))[0], np.array(imu.position))
        mount = self.source.mount
        to_sensor = inverse(mount[:3, :3])
        pose = matmul(affine(to_sensor, -matvec(to_sensor, mount[:3, 3])), on_platform)
        pose[:3, 3] *= 1000
        return pose


def _rounded(values: Floats) -> list[float]:
    """Return rounded values as a list, without digits that the conversion from radians adds."""
    return [float(value) for value in np.round(values, 9).ravel() + 0.0]


class OusterDecoder(PacketDecoder):
    """Decoder that reads scans with ouster-sdk. The metadata is in a .json file beside the capture.

    ouster-sdk reads pcap files with common link types. Other captures would appear empty or be
    rejected, so they are rewritten to a temporary folder.
    """

    intensity = "reflectivity"

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, name)
        with reading(name):
            input_size(path)
        if find_spec("ouster") is None:
            # ouster-sdk pins old versions of packages that are not needed here.
            raise LidarError(
                f"{name} requires ouster-sdk, which is not installed. Run pip install --no-deps "
                "ouster-sdk."
            )
        with reading(name):
            if (metadata := path.with_suffix(".json")).exists():
                input_size(metadata)
            self._file = self._readable_file(path, metadata)
            self._infos = self._open().sensor_info
            self._tables: dict[int, Any] = {}
            self.sensors = [f"{info.prod_line} {info.sn}".strip() for info in self._infos]

    @staticmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a datagram has the size and the type of a lidar packet.

        Packets of the profile LEGACY have no type, so only their size is checked. All profiles are
        recognized, including profiles that cannot be encoded here.
        """
        size = len(payload)
        if size in _LEGACY_BYTES:
            return True
        columns_bytes = size - _HEADER_AND_FOOTER_BYTES
        is_lidar = payload[:2] == _LIDAR_PACKET.to_bytes(2, "little")
        return is_lidar and columns_bytes >= _MIN_COLUMNS_BYTES and columns_bytes % 4 == 0

    def sweeps(self, sensor: int) -> Iterable[Any]:
        """Return the scans of a sensor."""
        return (scans[sensor] for scans in self._open() if scans[sensor] is not None)

    def columns(self, sensor: int, sweep: Any) -> dict[str, AnyArray]:
        """Return the position, ring, reflectivity, signal and near infrared of each point."""
        ring, column = np.nonzero(sweep.field("RANGE"))
        x, y, z = self._positions(sensor)(sweep)[ring, column].T
        columns = {"x": x, "y": y, "z": z, "ring": ring}
        for field_name in {"REFLECTIVITY", "SIGNAL", "NEAR_IR"}.intersection(sweep.fields):
            columns[field_name.lower()] = sweep.field(field_name)[ring, column]
        return columns

    def time_ns(self, sweep: Any) -> int:
        """Return the time of the first column."""
        stamps = sweep.timestamp[sweep.timestamp > 0]
        return int(stamps.min()) if len(stamps) else 0

    def _readable_file(self, path: Path, metadata: Path) -> Path:
        """Return the file itself, or a temporary copy in a format that ouster-sdk reads."""
        capture = Capture(path, self.name)
        if path.suffix.lower() not in ENDINGS or capture.is_classic(_SDK_LINKS):
            return path
        self._folder = TemporaryDirectory(prefix="lidarpool-")
        copy = Path(self._folder.name) / f"{path.stem}.pcap"
        with copy.open("wb") as file:
            write_datagrams(file, capture.datagrams())
        if metadata.exists():
            copyfile(metadata, copy.with_suffix(".json"))
        self.notes = capture.notes
        return copy

    def _open(self) -> Any:
        return import_module("ouster.sdk").open_source(str(self._file))

    def _positions(self, sensor: int) -> Any:
        """Return a function that converts a scan to positions in meters."""
        if sensor not in self._tables:
            core = import_module("ouster.sdk.core")
            self._tables[sensor] = core.XYZLut(self._infos[sensor], False)
        return self._tables[sensor]

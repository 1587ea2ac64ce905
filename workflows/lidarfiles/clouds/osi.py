"""Write traces of the Open Simulation Interface (ASAM OSI), with one SensorData per sweep.

Messages are created with betterosi, except for detections, because creating and encoding a million
detection objects takes 17 s. Detections are encoded here, in the wire format of Protocol Buffers.
All detections in a sweep have the same fields, so their bytes only differ in the values.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.numerics.elementary import arctan2
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers

from .boxes import Boxes, SweepBoxes
from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .gps_time import GPS_NS
from .point_field import NONE, OMITTED, PointField

GROUND_TRUTH_TOPIC = "/ground_truth"
# Field numbers in osi_sensordata.proto and osi_featuredata.proto of OSI 3.
_FEATURE_DATA = 26
_LIDAR_SENSOR = 3
_HEADER = 1
_DETECTION = 2
_DOUBLES = {"intensity": 7, "reflectivity": 10, "radial_velocity": 12}
_VARINT, _FIXED64, _LENGTH = range(3)  # wire types
# OSI types of actors, by lowercase words in their names.
_PERSONS = {"pedestrian", "person", "walker", "child"}
_VEHICLES = {
    **dict.fromkeys(("delivery_van", "van"), "DELIVERY_VAN"),
    **dict.fromkeys(("car", "taxi"), "CAR"),
    **dict.fromkeys(("heavy_truck", "truck", "lorry"), "HEAVY_TRUCK"),
    **dict.fromkeys(("motorbike", "motorcycle"), "MOTORBIKE"),
    **dict.fromkeys(("bicycle", "cyclist"), "BICYCLE"),
    **dict.fromkeys(("standup_scooter", "scooter"), "STANDUP_SCOOTER"),
    **{
        name: name.upper()
        for name in (
            "small_car", "compact_car", "luxury_car", "semitractor", "semitrailer", "trailer",
            "bus", "tram", "train", "wheelchair",
        )
    },
}  # fmt: skip


class OSI(CloudFormat):
    """An .osi trace with one message per sweep, sorted by the start of the sweep."""

    title = "OSI"
    by_sweep = True
    frame = "sweep"
    fields = (
        PointField("object_id", ("object",)),
        PointField("beam_id", ("channel",)),
        PointField("intensity", ("intensity",)),
        PointField("reflectivity", ("reflectance",), OMITTED),
        # Most sensors do not measure velocities.
        PointField("radial_velocity", ("radial_velocity",), OMITTED, on_request=True),
        PointField("sensor_id", ("sensor",), OMITTED, on_request=True),
        PointField("existence_probability, position_rmse", (), OMITTED, NONE),
        PointField("free_space_probability, classification", (), OMITTED, NONE),
        PointField("echo_pulse_width", (), OMITTED, NONE),
    )
    other_columns = False
    actor_boxes = True
    suffix: ClassVar[str] = ".osi"  # extension by which betterosi selects the type of trace

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the trace."""
        osi: Any = import_module("betterosi")  # optional dependency
        messages = _OSIMessages(osi, self.sweeps)
        options: dict[str, Any] = {}
        if self.suffix == ".mcap":
            stamp = datetime.fromtimestamp(messages.start_ns / 1e9, UTC)
            options["metadata"] = {"creation_time": stamp.strftime("%Y-%m-%dT%H:%M:%SZ")}
        suffixed = path.with_name(path.name + self.suffix)
        writer = osi.Writer(str(suffixed), **options)
        try:
            with writer:
                self._write_messages(writer, messages)
        finally:
            writer.file.close()  # betterosi does not close the file after an error
        suffixed.replace(path)

    def _write_messages(self, writer: Any, messages: _OSIMessages) -> None:
        sweeps = self.sweeps
        topics = [f"/{name}/sensor_data" if name else "/sensor_data" for name in _names(sweeps)]
        for sweep in np.argsort(sweeps.begins_ns, kind="stable").tolist():
            (points,) = sweeps.points(self.cloud, sweep, sweep + 1)
            boxes = Boxes.from_points(sweeps, sweep, points)
            truth = messages.ground_truth(sweep, boxes)
            time_ns = messages.time_ns(sweep)
            if writer.write_mcap:
                writer.add(truth, topic=GROUND_TRUTH_TOPIC, log_time=time_ns)
            data = messages.sensor_data(sweep, points, boxes, truth)
            writer.add(data, topic=topics[sweeps.sensor[sweep]], log_time=time_ns)


class OSIInMCAP(OSI):
    """An MCAP file with the messages of an .osi trace.

    Each sensor has its own topic. The ground truth is also available on `GROUND_TRUTH_TOPIC`.
    """

    title = "OSI in MCAP"
    suffix = ".mcap"


def _names(sweeps: Sweeps) -> list[str]:
    """Return unique names of the sensors for topics, or empty strings if no sensor has a name."""
    return make_identifiers(sweeps.sensors) if any(sweeps.sensors) else ["" for _ in sweeps.sensors]


@dataclass(frozen=True)
class _EncodedMessage:
    """A betterosi message with additional fields that are already encoded.

    It has the attributes of a message that the betterosi writer uses.
    """

    message: Any
    encoded_fields: bytes

    @property
    def timestamp(self) -> Any:
        return self.message.timestamp

    @property
    def version(self) -> Any:
        return self.message.version

    def has_field(self, name: str) -> bool:
        return bool(self.message.has_field(name))

    def desc(self) -> Any:
        return self.message.desc()

    def to_binary(self) -> bytes:
        """Encode all fields.

        Their order does not matter in the wire format.
        """
        data: bytes = self.message.to_binary()
        return data + self.encoded_fields


class _OSIMessages:
    """Conversion of sweeps to OSI messages.

    Object identifiers are the numbers in the column `object`. The host vehicle is the vehicle that
    carries the sensors. Its identifier is the next number.
    """

    def __init__(self, osi: Any, sweeps: Sweeps) -> None:
        self._osi = osi
        self._sweeps = sweeps
        self.start_ns = GPS_NS if sweeps.start_ns is None else sweeps.start_ns
        self._host = osi.Identifier(value=len(sweeps.object_names))
        major, minor, patch = map(int, osi.__version_osi__.split("."))
        self._version = osi.InterfaceVersion(
            version_major=major, version_minor=minor, version_patch=patch
        )
        self._types = [_type_fields(osi, name) for name in sweeps.actor_types]

    def time_ns(self, sweep: int) -> int:
        """Return the start of a sweep in nanoseconds, according to the clock of the sensor.

        Times are relative to 1970, or to the start of a survey without a date.
        """
        return max(0, (self._sweeps.start_ns or 0) + self._sweeps.stamp_ns(sweep))

    def _timestamp(self, sweep: int) -> Any:
        seconds, nanos = divmod(self.time_ns(sweep), 10**9)
        return self._osi.Timestamp(seconds=seconds, nanos=nanos)

    def _base(self, position: Floats, quaternion: Floats, size: Floats | None = None) -> Any:
        """Return a BaseMoving message with a position, an orientation and optionally a size."""
        osi = self._osi
        base = osi.BaseMoving(
            position=_vector(osi, position), orientation=_orientation(osi, quaternion)
        )
        if size is not None:
            length, width, height = size.tolist()
            base.dimension = osi.Dimension3d(length=length, width=width, height=height)
        return base

    def ground_truth(self, sweep: int, boxes: Boxes) -> Any:
        """Return the host vehicle and the actors in world coordinates at the start of a sweep."""
        osi = self._osi
        sweeps = self._sweeps
        carrier = sweeps.platform
        zero = np.zeros(3)
        attributes = osi.MovingObject.VehicleAttributes(bbcenter_to_rear=_vector(osi, zero))
        host = osi.MovingObject(
            id=self._host,
            base=self._base(carrier.positions[sweep], carrier.quaternions[sweep]),
            type=osi.MovingObject.Type.VEHICLE,
            vehicle_attributes=attributes,
        )
        actors = []
        for actor in np.flatnonzero(boxes.present).tolist():
            base = self._base(boxes.centers[actor], boxes.quaternions[actor], boxes.sizes[actor])
            base.velocity = _vector(osi, sweeps.actor_velocities[actor, sweep])
            actors.append(
                osi.MovingObject(
                    id=osi.Identifier(value=len(sweeps.objects) + actor),
                    base=base,
                    model_reference=sweeps.actors[actor],
                    **self._types[actor],
                )
            )
        return osi.GroundTruth(
            version=self._version,
            timestamp=self._timestamp(sweep),
            host_vehicle_id=self._host,
            moving_object=[host, *actors],
        )

    def sensor_data(self, sweep: int, points: Cloud, boxes: Boxes, truth: Any) -> _EncodedMessage:
        """Return the detections, the detected actors and the ground truth of a sweep."""
        osi = self._osi
        sweeps = self._sweeps
        number = int(sweeps.sensor[sweep])
        sensor = osi.Identifier(value=number)
        timestamp = self._timestamp(sweep)
        mount = osi.MountingPosition(
            position=_vector(osi, sweeps.mounts.positions[number]),
            orientation=_orientation(osi, sweeps.mounts.quaternions[number]),
        )
        common = {"version": self._version, "timestamp": timestamp, "sensor_id": sensor}
        view = osi.SensorView(**common, host_vehicle_id=self._host, global_ground_truth=truth)
        message = osi.SensorData(
            **common,
            mounting_position=mount,
            last_measurement_time=timestamp,
            sensor_view=[view],
            moving_object=self._detected(sweep, boxes),
        )
        header = osi.SensorDetectionHeader(
            measurement_time=timestamp,
            cycle_counter=int(sweeps.numbers[sweep]),
            mounting_position=mount,
            data_qualifier=osi.SensorDetectionHeader.DataQualifier.AVAILABLE,
            number_of_valid_detections=len(points),
            sensor_id=sensor,
        )
        positions = sweeps.compensate_motion(sweep, points)
        detections = _field(_HEADER, header.to_binary()) + encode_detections(positions, points)
        return _EncodedMessage(message, _field(_FEATURE_DATA, _field(_LIDAR_SENSOR, detections)))

    def _detected(self, sweep: int, boxes: Boxes) -> list[Any]:
        """Return the actors that have points in a sweep, in sensor coordinates."""
        osi = self._osi
        sweeps = self._sweeps
        in_sensor = SweepBoxes.select(sweeps, boxes.to_sensor_frame(sweeps.pose, sweep))
        detected = []
        for row in np.flatnonzero(in_sensor.points).tolist():
            number = osi.Identifier(value=int(in_sensor.objects[row]))
            header = osi.DetectedItemHeader(
                tracking_id=number,
                ground_truth_id=[number],
                existence_probability=1.0,
                measurement_state=osi.DetectedItemHeader.MeasurementState.MEASURED,
            )
            type_fields = self._types[int(in_sensor.objects[row]) - len(sweeps.objects)]
            candidate = osi.DetectedMovingObject.CandidateMovingObject(
                probability=1.0, **type_fields
            )
            base = self._base(
                in_sensor.centers[row], in_sensor.quaternions[row], in_sensor.sizes[row]
            )
            detected.append(
                osi.DetectedMovingObject(header=header, base=base, candidate=[candidate])
            )
        return detected


def _type_fields(osi: Any, name: str) -> Mapping[str, Any]:
    """Return the type fields of a moving object, derived from an actor's name."""
    kind = osi.MovingObject.Type
    words = [name.lower(), *re.findall("[a-z]+", name.lower())]
    if not _PERSONS.isdisjoint(words):
        return {"type": kind.PEDESTRIAN}
    vehicle = next((_VEHICLES[word] for word in words if word in _VEHICLES), None)
    if vehicle is None:
        return {"type": kind.OTHER}
    classification = osi.MovingObject.VehicleClassification
    value = getattr(classification.Type, vehicle)
    return {"type": kind.VEHICLE, "vehicle_classification": classification(type=value)}


def _vector(osi: Any, vector: Floats) -> Any:
    x, y, z = vector.tolist()
    return osi.Vector3d(x=x, y=y, z=z)


def _orientation(osi: Any, quaternion: Floats) -> Any:
    """Convert a quaternion (x, y, z, w) to a message with roll, pitch and yaw in radians."""
    rotation = matrices(quaternion[None])[0]
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    roll, pitch, yaw = arctan2(
        np.array([rotation[2, 1], -rotation[2, 0], rotation[1, 0]]),
        np.array([rotation[2, 2], level, rotation[0, 0]]),
    ).tolist()
    return osi.Orientation3d(roll=roll, pitch=pitch, yaw=yaw)


def encode_detections(positions: Floats, points: Cloud) -> bytes:
    """Encode points as fields of LidarDetectionData.

    As defined by Spherical3d in OSI, azimuth and elevation are right-handed rotations about the z
    axis and the rotated y axis. Points above the sensor therefore have a negative elevation.

    Parameters
    ----------
    positions
        Positions in the sensor frame in meters, as float64 with shape (n, 3).
    points
        Points with the columns `object` and `channel`, and optionally `intensity`, `reflectance`
        and `radial_velocity`.
    """
    x, y, z = positions.T
    across = np.sqrt(x * x + y * y)
    columns = points.columns
    values = {}
    if "intensity" in columns:
        values["intensity"] = 100 * np.clip(columns["intensity"].astype(np.float64), 0, 1)
    if "reflectance" in columns:
        values["reflectivity"] = columns["reflectance"].astype(np.float64)
    if "radial_velocity" in columns:  # OSI's velocity is towards the sensor
        values["radial_velocity"] = -columns["radial_velocity"].astype(np.float64)
    position = _Record()
    position.add_double(1, np.sqrt(across * across + z * z))
    position.add_double(2, arctan2(y, x))
    position.add_double(3, arctan2(-z, across))
    detection = _Record()
    detection.add_record(2, _identifiers(columns["object"].astype(np.int64)))
    detection.add_record(3, position)
    for name, column in values.items():
        detection.add_double(_DOUBLES[name], column)
    detection.add_record(13, _identifiers(columns["channel"].astype(np.int64)))
    detections = _Record()
    detections.add_record(_DETECTION, detection)
    return detections.rows().tobytes()


class _Record:
    """Encoder for many messages with the same fields and lengths.

    Each field is encoded for all messages at once.
    """

    def __init__(self) -> None:
        # Bytes that differ between messages, as uint8 with shape (n, k), or common bytes.
        self._parts: list[AnyArray | bytes] = []

    def add_double(self, number: int, values: Floats) -> None:
        self._parts.append(_key(number, _FIXED64))
        self._parts.append(np.ascontiguousarray(values, "<f8").view(np.uint8).reshape(-1, 8))

    def add_varint(self, number: int, values: Ints) -> None:
        """Add a field with one non-negative integer per message.

        All values are encoded with the number of bytes that the largest value requires. The wire
        format allows leading zeros.
        """
        largest = int(values.max()) if len(values) else 0
        size = max(1, -(-largest.bit_length() // 7))
        groups = values[:, None] >> (7 * np.arange(size)) & 127
        groups[:, :-1] |= 128
        self._parts.append(_key(number, _VARINT))
        self._parts.append(groups.astype(np.uint8))

    def add_record(self, number: int, record: _Record) -> None:
        rows = record.rows()
        self._parts.append(_key(number, _LENGTH) + _varint(rows.shape[1]))
        self._parts.append(rows)

    def rows(self) -> AnyArray:
        """Return the encoded messages as uint8, with one row per message."""
        count = next(len(part) for part in self._parts if not isinstance(part, bytes))
        columns = [
            np.tile(np.frombuffer(part, np.uint8), (count, 1)) if isinstance(part, bytes) else part
            for part in self._parts
        ]
        return np.concatenate(columns, axis=1)


def _identifiers(values: Ints) -> _Record:
    """Encode numbers as Identifier messages."""
    record = _Record()
    record.add_varint(1, values)
    return record


def _key(number: int, wire_type: int) -> bytes:
    """Encode the tag with which a field starts."""
    return _varint(number << 3 | wire_type)


def _field(number: int, content: bytes) -> bytes:
    return _key(number, _LENGTH) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    """Encode an integer in groups of seven bits, starting with the lowest."""
    groups = bytearray()
    while value > 127:
        groups.append(value & 127 | 128)
        value >>= 7
    return bytes([*groups, value])

"""Bags of ROS 2, as MCAP, through rosbags: PointCloud2, frames, /actors and /clock."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader as Bag
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidarsim.base.arrays import AnyArray, Floats32, Records
from lidarsim.columns.bags import POINT_FIELDS, message_types
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.table import COLOURS, SURFACE_COLUMNS, VELOCITY
from lidarsim.scene.colours import as_float
from lidarsim.sensor.optics import TWO_RETURNS
from lidarsim.sensor.reflectivity import COUNTS
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, Instruments
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.ray_image import Image
from lidarsim.sweeps.sweeps import AS_FIRED, COMPENSATED, SweepPoses, Sweeps

from . import reading
from .boxes import Boxes
from .frames import CARRIER, INSTRUMENTS, WORLD, frame_names, points_topic, survey_start_ns
from .laser_scan import ScanRays

Sent = tuple[str, Any, int]  # topic, message, time in nanoseconds

# Types of returns of Autoware's sensor drivers.
UNKNOWN, LAST, FIRST, STRONGEST, FIRST_WEAK, LAST_WEAK = range(6)
IDENTICAL, SECOND, _, FIRST_STRONGEST, LAST_STRONGEST = range(6, 11)
_SINGLE_RETURN_TYPES = {"strongest": STRONGEST, "first": FIRST, "last": LAST}

# Profile that `ros2 bag play` must offer, so that late listeners get the frames, too.
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
    QosTime(0, 0), QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False,
)  # fmt: skip
_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
_LAYOUTS = {
    "velodyne": np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]),
    "autoware": np.dtype([
        *_XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "<u2"), ("azimuth", "<f4"),
        ("elevation", "<f4"), ("distance", "<f4"), ("time_stamp", "<u4"),
    ]),
    "ouster": np.dtype({
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }),
}  # fmt: skip
_LAYOUTS["images"] = _LAYOUTS["velodyne"]
_ONCE = ("/tf_static", "/label_info", "/material_info")  # topics of one message, kept for readers
# Points that are compensated for motion have no times; in Autoware's layout, PointXYZIRC.
_TIMES = ("time", "t", "time_stamp")
_COMPENSATED = {
    "velodyne": _LAYOUTS["velodyne"].descr[:-1],
    "images": _LAYOUTS["images"].descr[:-1],
    "autoware": _LAYOUTS["autoware"].descr[:6],
}
# Additional fields after the layout: {name: (type, columns that the field needs)}.
_EXTRA = {
    "rgb": ("<f4", {*COLOURS}),
    VELOCITY: ("<f4", {VELOCITY}),
    "label": ("<u4", {"class"}),
    **{name: ("<f4", {name}) for name in SURFACE_COLUMNS},
    "material": ("<i4", {"material"}),
}
# Messages of vision_msgs, which rosbags lacks.
_LABEL_INFO = "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n"
_LABEL_INFO += f"{80 * '='}\nMSG: vision_msgs/VisionClass\nuint16 class_id\nstring class_name\n"


def write_rosbag2(
    path: Path, cloud: CloudLike, sweeps: Sweeps, layout: str, compensated: bool = False
) -> None:
    """Write a bag, a folder for `ros2 bag play`; see `write_mcap`."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_LABEL_INFO, "vision_msgs/msg/LabelInfo"))
    # Readers of Humble accept no later version: from 9 on, profiles are lists.
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        bag.set_custom_data("lidarpool", COMPENSATED if compensated else AS_FIRED)
        topics: dict[str, Any] = {}
        layout_of_points = PointLayout(layout, compensated)
        for topic, message, time_ns in _messages(cloud, sweeps, layout_of_points, store.types):
            kind = message.__msgtype__
            if topic not in topics:
                latched = (_LATCHED,) if topic in _ONCE else ()
                topics[topic] = bag.add_connection(
                    topic, kind, typestore=store, offered_qos_profiles=latched
                )
            bag.write(topics[topic], time_ns, store.serialize_cdr(message, kind))


def write_mcap(
    path: Path, cloud: CloudLike, sweeps: Sweeps, layout: str, compensated: bool = False
) -> None:
    """Write an MCAP file.

    Each sweep is a PointCloud2 on `/NAME/points`, NAME from its sensor, or on `/points`. Points are
    in the sensor frame at their own firing, as drivers publish them, and have times; or
    compensated, in the sensor frame at the start of the sweep, without times. `/tf` has the frames
    of the carrier (`base_link`) and of actors in `map`, and `/clock` the time, both at each sweep;
    `/tf_static` has the sensors on the carrier, `/label_info` names of classes and `/material_info`
    names of materials (LabelInfo of vision_msgs). The survey begins at its start, or at `START_NS`
    without one. `/actors` has a MarkerArray of the boxes of actors where their points of the sweep
    are.

    Of a 2D scanner (one beam in the plane of its x and y axes) `/NAME/scan`, or `/scan`, also has a
    LaserScan of each sweep, where the survey keeps every return and has the columns ray and range.

    Instruments of the carrier are frames `imu` and `gnss` on it. `/imu/data_raw` has Imu, without
    orientations, and `/gnss/fix` NavSatFix or, where latitudes are not known, `/gnss/position`
    PointStamped in `map`.

    Layouts of a point: `velodyne` (22 bytes; its time in seconds since the sweep began), `autoware`
    (PointXYZIRCAEDT, 32 bytes; angles in radians, azimuth clockwise from the start of the head,
    time_stamp in ns since the sweep began; compensated: PointXYZIRC, 16 bytes) and `ouster` (48
    bytes; ring 0 is the highest beam, range in mm, t in ns since the sweep began, intensity:
    signal). Whole numbers of intensity are 255 at 1 and above. Where the cloud has red, green and
    blue, a field `rgb` follows, where it has radial velocities, `radial_velocity`, where its
    classes have names, `label`, and then any columns of normals, `incidence_deg` and origins of
    rays, and `material`; each makes points of `velodyne` and `autoware` 4 bytes longer.
    """
    folder = path.with_name(f"{path.name}.bag")
    try:
        write_rosbag2(folder, cloud, sweeps, layout, compensated)
        (written,) = folder.glob("*.mcap")
        written.replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True)
class PointLayout:
    """Layout of the points of a PointCloud2."""

    name: str
    compensated: bool  # points in the sensor's axes at the start of the sweep, without times

    @property
    def fields(self) -> np.dtype[np.void]:
        """Type of a point, without additional fields."""
        row = _LAYOUTS[self.name]
        if not self.compensated:
            return row
        if self.name in _COMPENSATED:
            return np.dtype(_COMPENSATED[self.name])
        kinds = {name: kind for name, kind in (row.fields or {}).items() if name not in _TIMES}
        return np.dtype(
            {
                "names": [*kinds],
                "formats": [kind for kind, *_ in kinds.values()],
                "offsets": [offset for _, offset, *_ in kinds.values()],
                "itemsize": row.itemsize,
            }
        )

    def row(self, extra: Sequence[str]) -> np.dtype[np.void]:
        """Return the type of a point in the layout, followed by additional fields."""
        row = self.fields
        if not extra:
            return row
        kinds = {name: (kind, offset) for name, (kind, offset, *_) in (row.fields or {}).items()}
        end = max(offset + kind.itemsize for kind, offset in kinds.values())
        for name in extra:
            kinds[name] = kind, _ = np.dtype(_EXTRA[name][0]), end
            end += kind.itemsize
        formats, offsets = map(list, zip(*kinds.values(), strict=True))
        size = max(row.itemsize, end)
        return np.dtype(
            {"names": [*kinds], "formats": formats, "offsets": offsets, "itemsize": size}
        )


def _messages(cloud: CloudLike, sweeps: Sweeps, layout: PointLayout, types: Any) -> Iterator[Sent]:
    """Yield the messages of a cloud, sweep by sweep."""
    columns = {column.name for column in cloud.table if column.name != "class" or sweeps.classes}
    row = layout.row([name for name, (_, needs) in _EXTRA.items() if needs <= columns])
    sweep_messages = _SweepMessages(_Messages(types), sweeps, layout, row)
    start_ns = survey_start_ns(sweeps)
    measured = sweep_messages.make.instrument_messages(sweeps, start_ns)
    waiting = next(measured, None)
    yield from sweep_messages.static_messages(columns)
    for sweep, points in enumerate(sweeps.points(cloud)):
        time_ns = start_ns + round(sweeps.begins_ns[sweep])
        while waiting is not None and waiting[2] <= time_ns:
            yield waiting
            waiting = next(measured, None)
        yield from sweep_messages.messages(sweep, points, time_ns)
    while waiting is not None:
        yield waiting
        waiting = next(measured, None)


class _SweepMessages:
    """Makes the messages of a survey, and of its single sweeps."""

    def __init__(
        self, make: _Messages, sweeps: Sweeps, layout: PointLayout, row: np.dtype[np.void]
    ) -> None:
        self.make = make
        self._sweeps = sweeps
        self._layout = layout
        self._row = row  # of a point
        (field,) = make.types_of("sensor_msgs", "PointField")
        self._fields = [
            field(name, offset, POINT_FIELDS[kind.str[1:]], 1)
            for name, (kind, offset, *_) in (row.fields or {}).items()
        ]
        self._frames = _frames(sweeps)
        self._actors = self._frames[len(sweeps.sensors) : -len(INSTRUMENTS)]
        poses = map(SweepPoses, sweeps.actor_poses.positions, sweeps.actor_poses.quaternions)
        # Carrier and actors: frame and poses.
        self._moving = [(CARRIER, sweeps.carrier), *zip(self._actors, poses, strict=True)]
        self._start_ns = survey_start_ns(sweeps)

    def static_messages(self, columns: set[str]) -> Iterator[Sent]:
        """Yield the messages that are sent once; `columns` are the names of the cloud's columns."""
        sweeps = self._sweeps
        start_ns = self._start_ns
        on_carrier = [
            (CARRIER, frame, sweeps.mounts, number)
            for number, frame in enumerate(self._frames[: len(sweeps.sensors)])
        ]
        on_carrier += _instruments(sweeps)
        yield "/tf_static", self.make.transforms(on_carrier, start_ns), start_ns
        info, named = self.make.types_of("vision_msgs", "LabelInfo", "VisionClass")
        header = self.make.header("", start_ns)
        if sweeps.classes:
            classes = [named(number, name) for number, name in sweeps.classes.items()]
            yield "/label_info", info(header, classes, 0.0), start_ns
        if "material" in columns and sweeps.materials:
            materials = [named(number, name) for number, name in enumerate(sweeps.materials)]
            yield "/material_info", info(header, materials, 0.0), start_ns

    def messages(self, sweep: int, points: Cloud, time_ns: int) -> Iterator[Sent]:
        """Yield the messages of a sweep, which are sent at a time."""
        sweeps = self._sweeps
        stamp_ns = self._start_ns + sweeps.stamp_ns(sweep)
        frame = self._frames[sweeps.sensor[sweep]]
        topic = _topic(sweeps, self._frames, sweep)
        (clock,) = self.make.types_of("rosgraph_msgs", "Clock")
        yield "/clock", clock(self.make.stamp(time_ns)), time_ns
        yield "/tf", self.make.transforms(self._frames_in_world(sweep), time_ns), time_ns
        yield topic, self._point_cloud(sweep, points, self.make.header(frame, stamp_ns)), time_ns
        if (rays := ScanRays.from_points(sweeps, sweep, points)) is not None:
            name = f"{topic.removesuffix('points')}scan"
            yield name, self.make.laser_scan(rays, frame, stamp_ns), time_ns
        if self._layout.name == "images":
            ranges = Image.from_points(sweeps, sweep, points).filled(points["range"])
            ranges[np.isnan(ranges)] = np.inf  # REP 117: no detection
            for plane, image in enumerate(ranges, 1):
                name = f"{topic.removesuffix('points')}range_image{plane if plane > 1 else ''}"
                yield name, self.make.image(image[::-1], frame, stamp_ns), time_ns
        if self._actors:
            boxes = Boxes.from_points(sweeps, sweep, points)
            yield "/actors", self.make.markers(boxes, self._actors, time_ns), time_ns

    def _frames_in_world(self, sweep: int) -> list[tuple[str, str, SweepPoses, int]]:
        """Return the frames of the carrier and of the actors that are present during a sweep."""
        present = [True, *self._sweeps.actor_there[:, sweep]]
        return [
            (WORLD, name, poses, sweep)
            for (name, poses), is_present in zip(self._moving, present, strict=True)
            if is_present
        ]

    def _point_cloud(self, sweep: int, points: Cloud, header: Any) -> Any:
        """Return the PointCloud2 of a sweep."""
        rows = _rows(self._layout, self._row, points, self._sweeps, sweep)
        (message,) = self.make.types_of("sensor_msgs", "PointCloud2")
        return message(
            header,
            1,
            len(rows),
            self._fields,
            False,
            self._row.itemsize,
            rows.nbytes,
            rows.view(np.uint8).ravel(),
            True,
        )


def _instruments(sweeps: Sweeps) -> list[tuple[str, str, SweepPoses, int]]:
    """Return the frames of the instruments on the carrier."""
    instruments = sweeps.instruments
    if instruments is None or instruments.folder is None:
        return []
    frames = zip(_frames(sweeps)[-2:], (instruments.imu, instruments.gnss), strict=True)
    return [
        (
            CARRIER,
            frame,
            SweepPoses(np.array([instrument.position]), np.array([instrument.quaternion])),
            0,
        )
        for frame, instrument in frames
        if instrument is not None
    ]


_FULL_INTENSITY = {"autoware": 255, "ouster": COUNTS}  # values of an intensity of 1


class Reader(reading.Reader):
    """Reads sweeps of a data set: intensity, limited by the layout, channel and named class."""

    def files(self, sweep: int) -> list[str]:
        """Return the name of the job's bag."""
        return [self.entry.path_of("mcap")]

    @cached_property
    def _bag(self) -> Bag:
        # AnyReader would parse the definitions of messages, which takes longer than a sweep.
        bag = Bag(self.local(self.files(0)[0]))
        bag.open()
        return bag

    def read(self, sweep: int) -> reading.PointColumns:
        """Return the points of a sweep."""
        message = self._point_cloud(sweep)
        names = {field.name for field in message.fields}
        compensated = not names & {*_TIMES}
        row = PointLayout(self.layout, compensated).row([name for name in _EXTRA if name in names])
        rows = message.data.view(row)
        intensity = rows["intensity"].astype(np.float32) / _FULL_INTENSITY.get(self.layout, 1)
        channel = rows["channel" if self.layout == "autoware" else "ring"].astype(np.uint16)
        if self.layout == "ouster":
            channel = np.uint16(_traits(self.sweeps, sweep).channels - 1) - channel
        columns = {"intensity": intensity, "channel": channel}
        if "label" in names:
            columns["class"] = rows["label"].astype(np.uint16)
        points = np.stack([rows[axis] for axis in "xyz"], axis=1)
        if not compensated and self.sweeps.coordinates == "world":
            points = self._at_start(sweep, points, rows)
        return points, columns

    def _point_cloud(self, sweep: int) -> Any:
        """Return the PointCloud2 of a sweep; ValueError if the bag lacks the message."""
        topic = _topic(self.sweeps, _frames(self.sweeps), sweep)
        connections = [opened for opened in self._bag.connections if opened.topic == topic]
        time_ns = survey_start_ns(self.sweeps) + round(self.sweeps.begins_ns[sweep])
        record = next(self._bag.messages(connections, time_ns, time_ns + 1), None)
        if record is None:  # rosbags 0.11.2 misses some messages by their time
            records = self._bag.messages(connections)
            record = next((candidate for candidate in records if candidate[1] == time_ns), None)
        if record is None:
            raise ValueError(f"it has no message on {topic} at {time_ns} ns")
        connection, _, data = record
        return message_types().deserialize_cdr(data, connection.msgtype)

    def _at_start(self, sweep: int, points: Floats32, rows: Records) -> Floats32:
        """Return points (n, 3) as fired in the sensor frame at the start of the sweep."""
        (field,) = (name for name in rows.dtype.names or () if name in _TIMES)
        since_ns = rows[field].astype(np.float64) * (1e9 if field == "time" else 1)
        stamps = np.rint(since_ns + self.sweeps.stamp_ns(sweep)).astype(np.int64)
        scans = np.full(len(points), self.sweeps.scans[sweep])
        sensor_cloud = Cloud(points, {"scan": scans, "time": stamps})
        fired_in_sensor = replace(self.sweeps, coordinates="sensor")
        return fired_in_sensor.compensated(sweep, sensor_cloud).astype(np.float32)

    def close(self) -> None:
        """Close the bag."""
        if "_bag" in self.__dict__:
            self._bag.close()
        super().close()


def _frames(sweeps: Sweeps) -> list[str]:
    """Return the frames of the sensors, then of the actors, the IMU and the GNSS receiver."""
    return frame_names(sweeps.sensors, sweeps.actors)


def _topic(sweeps: Sweeps, frames: list[str], sweep: int) -> str:
    """Return the topic of the points of a sweep."""
    sensor = sweeps.sensor[sweep]
    return points_topic(sweeps.sensors[sensor], frames[sensor])


def _rows(
    layout: PointLayout, row: np.dtype[np.void], points: Cloud, sweeps: Sweeps, sweep: int
) -> Records:
    """Return the points of a sweep in a layout, of the type of its `row`."""
    if layout.compensated:
        positions = sweeps.compensated(sweep, points).astype(np.float32)
        columns = sweeps.columns_compensated(sweep, points)
    else:
        positions = sweeps.as_fired(sweep, points).astype(np.float32)
        columns = sweeps.columns_as_fired(sweep, points)
    values: dict[str, AnyArray] = dict(zip("xyz", positions.T, strict=True))
    if layout.name in ("velodyne", "images"):
        values |= {"intensity": columns["intensity"], "ring": columns["channel"]}
    elif layout.name == "autoware":
        values |= {
            "intensity": np.round(np.clip(columns["intensity"], 0, 1) * 255),
            "return_type": _return_types(points, _traits(sweeps, sweep).mode),
            "channel": columns["channel"],
        }
    else:
        traits = _traits(sweeps, sweep)
        values |= {
            "intensity": columns["signal"],
            "reflectivity": columns["reflectivity"],
            "ring": np.maximum(traits.channels - 1 - columns["channel"].astype(np.int64), 0),
            "range": np.round((columns["range"].astype(np.float64) + traits.range_offset_m) * 1000),
        }
    if not layout.compensated:
        begin_ns = sweeps.begins_ns[sweep] + sweeps.stamp_ns(sweep) - round(sweeps.begins_ns[sweep])
        values |= _timed(layout.name, positions, columns["time"] - begin_ns, sweeps, sweep)
    if "rgb" in (row.names or ()):
        values["rgb"] = as_float(*(columns[name] for name in COLOURS))
    same_names = ((name, name) for name in (VELOCITY, *SURFACE_COLUMNS, "material"))
    for name, column in (*same_names, ("label", "class")):
        if name in (row.names or ()):
            values[name] = columns[column]
    rows = np.zeros(len(points), row)
    for name, values_of_field in values.items():
        rows[name] = values_of_field
    return rows


def _timed(
    layout: str, positions: Floats32, since_ns: AnyArray, sweeps: Sweeps, sweep: int
) -> dict[str, AnyArray]:
    """Return fields of points in the sensor frame at their firings, `since_ns` the stamp."""
    if layout in ("velodyne", "images"):
        return {"time": since_ns / 1e9}
    stamps = np.clip(since_ns, 0, 2**32 - 1)
    if layout == "ouster":
        return {"t": stamps}
    x, y, z = positions.astype(np.float64).T
    level = np.hypot(x, y)
    zero = np.radians(_traits(sweeps, sweep).zero_deg)
    return {
        "azimuth": (zero - np.arctan2(y, x)) % (2 * np.pi),
        "elevation": np.arctan2(z, level),
        "distance": np.hypot(level, z),
        "time_stamp": stamps,
    }


def _return_types(points: Cloud, mode: str) -> AnyArray:
    """Return Autoware's types of the returns of a sweep, (n,); returns follow their pulses.

    Of two returns of a pulse the nearer is first, and the brighter is strong; of two equally bright
    returns, the farther. A single return of a pulse is all of these.
    """
    count = len(points)
    if mode in _SINGLE_RETURN_TYPES:
        return np.full(count, _SINGLE_RETURN_TYPES[mode])
    number = points["return_number"]
    returns = points["returns"]
    types = np.full(count, UNKNOWN)
    types[number == 2] = SECOND
    types[number == 1] = FIRST
    types[number == returns] = LAST
    types[returns == 1] = IDENTICAL
    if mode not in TWO_RETURNS or count < 2:
        return types
    pairs = (number[:-1] == 1) & (returns[:-1] == 2) & (number[1:] == 2) & (returns[1:] == 2)
    first = np.flatnonzero(pairs)
    intensity = points["intensity"]
    brighter = intensity[first] > intensity[first + 1]
    types[first] = np.where(brighter, FIRST_STRONGEST, FIRST_WEAK)
    types[first + 1] = np.where(brighter, LAST_WEAK, LAST_STRONGEST)
    return types


def _traits(sweeps: Sweeps, sweep: int) -> LidarTraits:
    """Return the traits of the sensor of a sweep."""
    return sweeps.lidars[sweeps.sensor[sweep]]


class _Messages:
    """Makes messages and their common parts."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def types_of(self, package: str, *names: str) -> list[Any]:
        """Return types of messages of a package."""
        return [self._types[f"{package}/msg/{name}"] for name in names]

    def stamp(self, time_ns: int) -> Any:
        """Return the time of a message."""
        return self._types["builtin_interfaces/msg/Time"](*divmod(time_ns, 1_000_000_000))

    def header(self, frame: str, time_ns: int) -> Any:
        """Return the header of a message."""
        return self._types["std_msgs/msg/Header"](self.stamp(time_ns), frame)

    def transforms(self, frames: list[tuple[str, str, SweepPoses, int]], time_ns: int) -> Any:
        """Return frames in their parents: (parent, name, poses, index of the pose)."""
        vector, quaternion = self.types_of("geometry_msgs", "Vector3", "Quaternion")
        transform, stamped = self.types_of("geometry_msgs", "Transform", "TransformStamped")
        return self._types["tf2_msgs/msg/TFMessage"](
            [
                stamped(
                    self.header(parent, time_ns),
                    name,
                    transform(
                        vector(*placed.positions[index].tolist()),
                        quaternion(*placed.quaternions[index].tolist()),
                    ),
                )
                for parent, name, placed, index in frames
            ]
        )

    def instrument_messages(self, sweeps: Sweeps, start_ns: int) -> Iterator[Sent]:
        """Return the messages of IMU and GNSS receiver, in order of time."""
        instruments = sweeps.instruments
        if instruments is None:
            return iter(())
        *_, imu, gnss = _frames(sweeps)
        streams = self._imu(instruments, imu, start_ns), self._gnss(instruments, gnss, start_ns)
        return merge(*streams, key=lambda sent: sent[2])

    def _imu(self, instruments: Instruments, frame: str, start_ns: int) -> Iterator[Sent]:
        vector, quaternion = self.types_of("geometry_msgs", "Vector3", "Quaternion")
        (imu,) = self.types_of("sensor_msgs", "Imu")
        unknown = np.zeros(9)
        unknown[0] = -1  # there is no orientation
        rate, force = (
            np.zeros((2, 9))
            if instruments.imu is None
            else [np.eye(3).ravel() * variance for variance in instruments.imu.variances]
        )
        for time, *numbers in instruments.rows(IMU_FILE):
            time_ns = start_ns + int(time)
            values = [*map(float, numbers)]
            message = imu(
                self.header(frame, time_ns),
                quaternion(0.0, 0.0, 0.0, 1.0),
                unknown,
                vector(*values[:3]),
                rate,
                vector(*values[3:]),
                force,
            )
            yield "/imu/data_raw", message, time_ns

    def _gnss(self, instruments: Instruments, frame: str, start_ns: int) -> Iterator[Sent]:
        point, stamped = self.types_of("geometry_msgs", "Point", "PointStamped")
        fix, status = self.types_of("sensor_msgs", "NavSatFix", "NavSatStatus")
        variances = (
            np.zeros(3) if instruments.gnss is None else np.array(instruments.gnss.variances)
        )
        covariance_type = fix.COVARIANCE_TYPE_DIAGONAL_KNOWN if variances.any() else 0
        for time, x, y, z, *geodetic in instruments.rows(GNSS_FILE):
            time_ns = start_ns + int(time)
            if geodetic:
                message = fix(
                    self.header(frame, time_ns),
                    status(status.STATUS_FIX, status.SERVICE_GPS),
                    *map(float, geodetic),
                    np.diag(variances).ravel(),
                    covariance_type,
                )
                yield "/gnss/fix", message, time_ns
            else:
                message = stamped(self.header(WORLD, time_ns), point(float(x), float(y), float(z)))
                yield "/gnss/position", message, time_ns

    def laser_scan(self, rays: ScanRays, frame: str, time_ns: int) -> Any:
        """Return the LaserScan of a sweep of a 2D scanner."""
        first = float(rays.angles[0])
        last = float(rays.angles[-1])
        (scan,) = self.types_of("sensor_msgs", "LaserScan")
        return scan(
            self.header(frame, time_ns),
            first,
            last,
            (last - first) / (len(rays.angles) - 1),
            rays.time_increment_s,
            rays.scan_time_s,
            *rays.range_limits_m,
            rays.ranges,
            rays.intensities,
        )

    def image(self, values: Floats32, frame: str, time_ns: int) -> Any:
        """Return an image of numbers (height, width)."""
        height, width = values.shape
        data = np.ascontiguousarray(values, "<f4").view(np.uint8).ravel()
        header = self.header(frame, time_ns)
        image = self._types["sensor_msgs/msg/Image"]
        return image(header, height, width, "32FC1", 0, 4 * width, data)

    def markers(self, boxes: Boxes, actors: list[str], time_ns: int) -> Any:
        """Return the boxes of actors in a sweep as markers, which replace earlier markers."""
        types = self._types
        names = ("Point", "Quaternion", "Pose", "Vector3")
        point, quaternion, pose, vector = self.types_of("geometry_msgs", *names)
        marker, mesh = self.types_of("visualization_msgs", "Marker", "MeshFile")
        image = types["sensor_msgs/msg/CompressedImage"]
        header = self.header(WORLD, time_ns)
        none = np.empty(0, np.uint8)
        orange = types["std_msgs/msg/ColorRGBA"](1, 0.6, 0, 0.4)
        always = types["builtin_interfaces/msg/Duration"](0, 0)
        return types["visualization_msgs/msg/MarkerArray"](
            [
                marker(
                    header,
                    "actors",
                    number,
                    marker.CUBE,
                    marker.ADD if boxes.present[number] else marker.DELETE,
                    pose(
                        point(*boxes.centres[number].tolist()),
                        quaternion(*boxes.quaternions[number].tolist()),
                    ),
                    vector(*boxes.sizes[number].tolist()),
                    orange,
                    always,
                    False,
                    [],
                    [],
                    "",
                    image(header, "", none),
                    [],
                    name,
                    "",
                    mesh("", none),
                    False,
                )
                for number, name in enumerate(actors)
            ]
        )

"""Bags of ROS 2, as MCAP, through rosbags: PointCloud2, frames, /actors and /clock."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
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

from lidarsim.base.arrays import Floats32, Records
from lidarsim.columns.bags import POINT_FIELDS, message_types
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, Instruments
from lidarsim.sweeps.ray_image import Image
from lidarsim.sweeps.sweeps import AS_FIRED, COMPENSATED, SweepPoses, Sweeps, plain_names

from .. import reading
from ..boxes import Boxes
from ..laser_scan import ScanRays
from .layouts import (
    EXTRA_FIELDS,
    FULL_INTENSITY,
    TIME_FIELDS,
    PointLayout,
    point_rows,
    sensor_traits,
)

Sent = tuple[str, Any, int]  # topic, message, time in nanoseconds

# frames
WORLD = "map"
CARRIER = "base_link"
_INSTRUMENTS = "imu", "gnss"
# Start of a survey without a date: at time 0, tf2 would take the newest frames for all times.
START_NS = 1_000_000_000_000_000_000
# Profile that `ros2 bag play` must offer, so that late listeners get the frames, too.
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
    QosTime(0, 0), QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False,
)  # fmt: skip
_ONCE = ("/tf_static", "/label_info", "/material_info")  # topics of one message, kept for readers
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


def _messages(cloud: CloudLike, sweeps: Sweeps, layout: PointLayout, types: Any) -> Iterator[Sent]:
    """Yield the messages of a cloud, sweep by sweep."""
    columns = {column.name for column in cloud.table if column.name != "class" or sweeps.classes}
    row = layout.row([name for name, (_, needs) in EXTRA_FIELDS.items() if needs <= columns])
    sweep_messages = _SweepMessages(_Messages(types), sweeps, layout, row)
    start_ns = _start_ns(sweeps)
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
        self._actors = self._frames[len(sweeps.sensors) : -len(_INSTRUMENTS)]
        poses = map(SweepPoses, sweeps.actor_poses.positions, sweeps.actor_poses.quaternions)
        # Carrier and actors: frame and poses.
        self._moving = [(CARRIER, sweeps.carrier), *zip(self._actors, poses, strict=True)]
        self._start_ns = _start_ns(sweeps)

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
        rows = point_rows(self._layout, self._row, points, self._sweeps, sweep)
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
        compensated = not names & {*TIME_FIELDS}
        row = PointLayout(self.layout, compensated).row(
            [name for name in EXTRA_FIELDS if name in names]
        )
        rows = message.data.view(row)
        intensity = rows["intensity"].astype(np.float32) / FULL_INTENSITY.get(self.layout, 1)
        channel = rows["channel" if self.layout == "autoware" else "ring"].astype(np.uint16)
        if self.layout == "ouster":
            channel = np.uint16(sensor_traits(self.sweeps, sweep).channels - 1) - channel
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
        time_ns = _start_ns(self.sweeps) + round(self.sweeps.begins_ns[sweep])
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
        (field,) = (name for name in rows.dtype.names or () if name in TIME_FIELDS)
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
    named = (*(name or "lidar" for name in sweeps.sensors), *sweeps.actors)
    return plain_names((WORLD, CARRIER, *named, *_INSTRUMENTS))[2:]


def _topic(sweeps: Sweeps, frames: list[str], sweep: int) -> str:
    """Return the topic of the points of a sweep."""
    sensor = sweeps.sensor[sweep]
    return f"/{frames[sensor]}/points" if sweeps.sensors[sensor] else "/points"


def _start_ns(sweeps: Sweeps) -> int:
    return START_NS if sweeps.start_ns is None else sweeps.start_ns


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

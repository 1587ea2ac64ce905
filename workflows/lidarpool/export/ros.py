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
from lidarsim.sensor.reflectivity import COUNTS
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, Instruments
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.sweeps import AS_FIRED, COMPENSATED, SweepPoses, Sweeps, plain_names

from . import reading
from .boxes import Boxes
from .images import Image
from .laser_scan import ScanRays

Sent = tuple[str, Any, int]  # topic, message, time in nanoseconds

# Types of returns of Autoware's sensor drivers.
UNKNOWN, LAST, FIRST, STRONGEST, FIRST_WEAK, LAST_WEAK = range(6)
IDENTICAL, SECOND, _, FIRST_STRONGEST, LAST_STRONGEST = range(6, 11)
_OF_ONE_RETURN = {"strongest": STRONGEST, "first": FIRST, "last": LAST}

# frames
WORLD = "map"
CARRIER = "base_link"
_INSTRUMENTS = "imu", "gnss"
# Of a survey without a date: at time 0, tf2 would take the newest frames for all times.
START_NS = 1_000_000_000_000_000_000
# As `ros2 bag play` must offer it, so that late listeners get the frames, too.
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
# Points that are compensated for motion have no times; Autoware's are then PointXYZIRC.
_TIMES = ("time", "t", "time_stamp")
_COMPENSATED = {
    "velodyne": _LAYOUTS["velodyne"].descr[:-1],
    "images": _LAYOUTS["images"].descr[:-1],
    "autoware": _LAYOUTS["autoware"].descr[:6],
}
# Fields behind those of a layout: {name: type, columns that it needs}.
_EXTRA = {
    "rgb": ("<f4", {*COLOURS}),
    VELOCITY: ("<f4", {VELOCITY}),
    "label": ("<u4", {"class"}),
    **{name: ("<f4", {name}) for name in SURFACE_COLUMNS},
    "material": ("<i4", {"material"}),
}
# Of vision_msgs, which rosbags lacks.
_LABEL_INFO = "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n"
_LABEL_INFO += f"{80 * '='}\nMSG: vision_msgs/VisionClass\nuint16 class_id\nstring class_name\n"


def write_rosbag2(
    path: Path, cloud: CloudLike, sweeps: Sweeps, layout: str, compensated: bool = False
) -> None:
    """Write a bag, a folder for `ros2 bag play`; see `write_mcap`."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_LABEL_INFO, "vision_msgs/msg/LabelInfo"))
    # Readers of Humble take no later version: from 9 on, its profiles are lists.
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

    Each sweep is a PointCloud2 on `/NAME/points`, NAME that of its sensor, or on `/points`. Points
    are in the sensor's axes at their own firing, as drivers publish them, and have times; or
    compensated, in the sensor's axes at the start of the sweep, without times. `/tf` has the frames
    of the carrier (`base_link`) and of actors in `map`, and `/clock` the time, both at each sweep;
    `/tf_static` has the sensors on the carrier, `/label_info` names of classes and `/material_info`
    those of materials (LabelInfo of vision_msgs). The survey begins at its start, or at `START_NS`
    without one. `/actors` has a MarkerArray of the boxes of actors where their points of the sweep
    are.

    Of a 2D scanner (one beam in the plane of its x and y axes) `/NAME/scan`, or `/scan`, also has a
    LaserScan of each sweep, where the survey keeps every return and has the columns ray and range.

    Instruments of the carrier are frames `imu` and `gnss` on it. `/imu/data_raw` has Imu, without
    orientations, and `/gnss/fix` NavSatFix or, where latitudes are not known, `/gnss/position`
    PointStamped in `map`.

    Layouts of a point: `velodyne` (22 bytes; its time in seconds since the sweep began),
    `autoware` (PointXYZIRCAEDT, 32 bytes; angles in radians, azimuth clockwise from where the head
    starts, time_stamp in ns since the sweep began; compensated: PointXYZIRC, 16 bytes) and `ouster`
    (48 bytes; ring 0 is the highest beam, range in mm, t in ns since the sweep began, intensity:
    signal).
    Whole numbers of intensity are 255 at 1 and above. Where the cloud has red, green and
    blue, a field `rgb` follows, where it has radial velocities, `radial_velocity`, where its
    classes have names, `label`, and then normals, `incidence_deg` and origins of rays, of which the
    cloud has some, and `material`; each makes points of `velodyne` and `autoware` 4 bytes longer.
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
        """Type of a point, without columns that may follow."""
        row = _LAYOUTS[self.name]
        if not self.compensated:
            return row
        if self.name in _COMPENSATED:
            return np.dtype(_COMPENSATED[self.name])
        kinds = {name: kind for name, kind in (row.fields or {}).items() if name not in _TIMES}
        return np.dtype({
            "names": [*kinds],
            "formats": [kind for kind, *_ in kinds.values()],
            "offsets": [offset for _, offset, *_ in kinds.values()],
            "itemsize": row.itemsize,
        })  # fmt: skip

    def row(self, extra: Sequence[str]) -> np.dtype[np.void]:
        """Type of a point in the layout, with fields behind it."""
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
    """Messages of a cloud, sweep by sweep."""
    held = {column.name for column in cloud.table if column.name != "class" or sweeps.classes}
    row = layout.row([name for name, (_, needs) in _EXTRA.items() if needs <= held])
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name, offset, POINT_FIELDS[kind.str[1:]], 1)
        for name, (kind, offset, *_) in (row.fields or {}).items()
    ]
    make = _Messages(types)
    frames = _frames(sweeps)
    actors = frames[len(sweeps.sensors) : -len(_INSTRUMENTS)]
    poses = map(SweepPoses, sweeps.actor_poses.positions, sweeps.actor_poses.quaternions)
    moving = [(CARRIER, sweeps.carrier), *zip(actors, poses, strict=True)]
    start_ns = _start_ns(sweeps)
    measured = make.measured(sweeps, start_ns)
    waiting = next(measured, None)
    on_carrier = [
        (CARRIER, frame, sweeps.mounts, number)
        for number, frame in enumerate(frames[: len(sweeps.sensors)])
    ]
    on_carrier += _instruments(sweeps)
    yield "/tf_static", make.transforms(on_carrier, start_ns), start_ns
    if sweeps.classes:
        info, named = make.kinds("vision_msgs", "LabelInfo", "VisionClass")
        told = [named(number, name) for number, name in sweeps.classes.items()]
        yield "/label_info", info(make.header("", start_ns), told, 0.0), start_ns
    if "material" in held and sweeps.materials:
        info, named = make.kinds("vision_msgs", "LabelInfo", "VisionClass")
        listed = [named(number, name) for number, name in enumerate(sweeps.materials)]
        yield "/material_info", info(make.header("", start_ns), listed, 0.0), start_ns
    for sweep, points in enumerate(sweeps.points(cloud)):
        time_ns = start_ns + round(sweeps.begins_ns[sweep])
        stamp_ns = start_ns + sweeps.stamp_ns(sweep)
        while waiting is not None and waiting[2] <= time_ns:
            yield waiting
            waiting = next(measured, None)
        frame = frames[sweeps.sensor[sweep]]
        topic = _topic(sweeps, frames, sweep)
        rows = _rows(layout, row, points, sweeps, sweep)
        in_world = [
            (WORLD, name, placed, sweep)
            for (name, placed), there in zip(
                moving, [True, *sweeps.actor_there[:, sweep]], strict=True
            )
            if there
        ]
        yield "/clock", types["rosgraph_msgs/msg/Clock"](make.stamp(time_ns)), time_ns
        yield "/tf", make.transforms(in_world, time_ns), time_ns
        message = types["sensor_msgs/msg/PointCloud2"](
            make.header(frame, stamp_ns), 1, len(rows), fields, False, row.itemsize,
            rows.nbytes, rows.view(np.uint8).ravel(), True,
        )  # fmt: skip
        yield topic, message, time_ns
        if (rays := ScanRays.of(sweeps, sweep, points)) is not None:
            name = f"{topic.removesuffix('points')}scan"
            yield name, make.laser_scan(rays, frame, stamp_ns), time_ns
        if layout.name == "images":
            ranges = Image.of(sweeps, sweep, points).filled(points["range"])
            ranges[np.isnan(ranges)] = np.inf  # REP 117: nothing was detected
            for plane, image in enumerate(ranges, 1):
                name = f"{topic.removesuffix('points')}range_image{plane if plane > 1 else ''}"
                yield name, make.image(image[::-1], frame, stamp_ns), time_ns
        if actors:
            boxes = Boxes.of(sweeps, sweep, points)
            yield "/actors", make.markers(boxes, actors, time_ns), time_ns
    while waiting is not None:
        yield waiting
        waiting = next(measured, None)


def _instruments(sweeps: Sweeps) -> list[tuple[str, str, SweepPoses, int]]:
    """Frames of the instruments on the carrier."""
    there = sweeps.instruments
    if there is None or there.folder is None:
        return []
    found = zip(_frames(sweeps)[-2:], (there.imu, there.gnss), strict=True)
    return [
        (CARRIER, frame, SweepPoses(np.array([one.position]), np.array([one.quaternion])), 0)
        for frame, one in found
        if one is not None
    ]


_FULL = {"autoware": 255, "ouster": COUNTS}  # of an intensity of 1


class Reader(reading.Reader):
    """Reads sweeps of a data set: intensity, as far as it is kept, channel and named class."""

    def files(self, sweep: int) -> list[str]:
        """Return the name of the job's bag."""
        return [self.entry.place("mcap")]

    @cached_property
    def _bag(self) -> Bag:
        # AnyReader would parse the definitions of messages, which takes longer than a sweep.
        bag = Bag(self.local(self.files(0)[0]))
        bag.open()
        return bag

    def read(self, sweep: int) -> reading.PointColumns:
        """Return the points of a sweep."""
        topic = _topic(self.sweeps, _frames(self.sweeps), sweep)
        connections = [one for one in self._bag.connections if one.topic == topic]
        time_ns = _start_ns(self.sweeps) + round(self.sweeps.begins_ns[sweep])
        found = next(self._bag.messages(connections, time_ns, time_ns + 1), None)
        if found is None:  # rosbags 0.11.2 misses some by their time
            every = self._bag.messages(connections)
            found = next((message for message in every if message[1] == time_ns), None)
        if found is None:
            raise ValueError(f"it has no message on {topic} at {time_ns} ns")
        connection, _, data = found
        message: Any = message_types().deserialize_cdr(data, connection.msgtype)
        held = {field.name for field in message.fields}
        extra = [name for name in _EXTRA if name in held]
        compensated = not held & {*_TIMES}
        rows = message.data.view(PointLayout(self.layout, compensated).row(extra))
        light = rows["intensity"].astype(np.float32) / _FULL.get(self.layout, 1)
        channel = rows["channel" if self.layout == "autoware" else "ring"].astype(np.uint16)
        if self.layout == "ouster":
            channel = np.uint16(_traits(self.sweeps, sweep).channels - 1) - channel
        columns = {"intensity": light, "channel": channel}
        if "label" in held:
            columns["class"] = rows["label"].astype(np.uint16)
        points = np.stack([rows[axis] for axis in "xyz"], axis=1)
        if not compensated and self.sweeps.coordinates == "world":
            points = self._at_start(sweep, points, rows)
        return points, columns

    def _at_start(self, sweep: int, points: Floats32, rows: Records) -> Floats32:
        """Return points (n, 3) as fired in the sensor's axes at the start of the sweep."""
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
    """Frames of the sensors, then of the actors, the IMU and the GNSS receiver."""
    named = (*(name or "lidar" for name in sweeps.sensors), *sweeps.actors)
    return plain_names((WORLD, CARRIER, *named, *_INSTRUMENTS))[2:]


def _topic(sweeps: Sweeps, frames: list[str], sweep: int) -> str:
    """Topic of the points of a sweep."""
    sensor = sweeps.sensor[sweep]
    return f"/{frames[sensor]}/points" if sweeps.sensors[sensor] else "/points"


def _start_ns(sweeps: Sweeps) -> int:
    return START_NS if sweeps.start_ns is None else sweeps.start_ns


def _rows(
    layout: PointLayout, row: np.dtype[np.void], points: Cloud, sweeps: Sweeps, sweep: int
) -> Records:
    """Points of a sweep in a layout, of the type of its `row`."""
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
    """Return the fields of points in the sensor's axes at their firings, `since_ns` the stamp."""
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
    """Return Autoware's types of the returns of a sweep, whose returns follow their pulses: (n,).

    Of two returns of a pulse the nearer is first, and the brighter is strong, the farther of two
    that are alike. A return that is all of its pulse is each at once.
    """
    count = len(points)
    if mode in _OF_ONE_RETURN:
        return np.full(count, _OF_ONE_RETURN[mode])
    number = points["return_number"]
    returns = points["returns"]
    types = np.full(count, UNKNOWN)
    types[number == 2] = SECOND
    types[number == 1] = FIRST
    types[number == returns] = LAST
    types[returns == 1] = IDENTICAL
    if mode != "dual" or count < 2:
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
    """Common parts of messages."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def kinds(self, package: str, *names: str) -> list[Any]:
        """Types of messages of a package."""
        return [self._types[f"{package}/msg/{name}"] for name in names]

    def stamp(self, time_ns: int) -> Any:
        """Time of a message."""
        return self._types["builtin_interfaces/msg/Time"](*divmod(time_ns, 1_000_000_000))

    def header(self, frame: str, time_ns: int) -> Any:
        """Header of a message."""
        return self._types["std_msgs/msg/Header"](self.stamp(time_ns), frame)

    def transforms(self, frames: list[tuple[str, str, SweepPoses, int]], time_ns: int) -> Any:
        """Frames in others: parent, name, poses, and which of them."""
        vector, turn = self.kinds("geometry_msgs", "Vector3", "Quaternion")
        transform, stamped = self.kinds("geometry_msgs", "Transform", "TransformStamped")
        return self._types["tf2_msgs/msg/TFMessage"]([
            stamped(
                self.header(parent, time_ns), name,
                transform(
                    vector(*placed.positions[which].tolist()),
                    turn(*placed.quaternions[which].tolist()),
                ),
            )
            for parent, name, placed, which in frames
        ])  # fmt: skip

    def measured(self, sweeps: Sweeps, start_ns: int) -> Iterator[Sent]:
        """Messages of what instruments measured, in the order of time."""
        there = sweeps.instruments
        if there is None:
            return iter(())
        *_, imu, gnss = _frames(sweeps)
        both = self._imu(there, imu, start_ns), self._gnss(there, gnss, start_ns)
        return merge(*both, key=lambda one: one[2])

    def _imu(self, there: Instruments, frame: str, start_ns: int) -> Iterator[Sent]:
        vector, turn = self.kinds("geometry_msgs", "Vector3", "Quaternion")
        (imu,) = self.kinds("sensor_msgs", "Imu")
        unknown = np.zeros(9)
        unknown[0] = -1  # there is no orientation
        rate, force = (
            np.zeros((2, 9))
            if there.imu is None
            else [np.eye(3).ravel() * variance for variance in there.imu.variances]
        )
        for time, *numbers in there.rows(IMU_FILE):
            time_ns = start_ns + int(time)
            values = [*map(float, numbers)]
            message = imu(
                self.header(frame, time_ns), turn(0.0, 0.0, 0.0, 1.0), unknown,
                vector(*values[:3]), rate, vector(*values[3:]), force,
            )  # fmt: skip
            yield "/imu/data_raw", message, time_ns

    def _gnss(self, there: Instruments, frame: str, start_ns: int) -> Iterator[Sent]:
        point, stamped = self.kinds("geometry_msgs", "Point", "PointStamped")
        fix, status = self.kinds("sensor_msgs", "NavSatFix", "NavSatStatus")
        variances = np.zeros(3) if there.gnss is None else np.array(there.gnss.variances)
        known = fix.COVARIANCE_TYPE_DIAGONAL_KNOWN if variances.any() else 0
        for time, x, y, z, *place in there.rows(GNSS_FILE):
            time_ns = start_ns + int(time)
            if place:
                message = fix(
                    self.header(frame, time_ns),
                    status(status.STATUS_FIX, status.SERVICE_GPS),
                    *map(float, place), np.diag(variances).ravel(), known,
                )  # fmt: skip
                yield "/gnss/fix", message, time_ns
            else:
                message = stamped(self.header(WORLD, time_ns), point(float(x), float(y), float(z)))
                yield "/gnss/position", message, time_ns

    def laser_scan(self, rays: ScanRays, frame: str, time_ns: int) -> Any:
        """LaserScan of a sweep of a 2D scanner."""
        first = float(rays.angles[0])
        last = float(rays.angles[-1])
        (scan,) = self.kinds("sensor_msgs", "LaserScan")
        return scan(
            self.header(frame, time_ns), first, last, (last - first) / (len(rays.angles) - 1),
            rays.time_increment_s, rays.scan_time_s, *rays.range_limits_m, rays.ranges,
            rays.intensities,
        )  # fmt: skip

    def image(self, values: Floats32, frame: str, time_ns: int) -> Any:
        """Image of numbers (height, width)."""
        height, width = values.shape
        data = np.ascontiguousarray(values, "<f4").view(np.uint8).ravel()
        header = self.header(frame, time_ns)
        image = self._types["sensor_msgs/msg/Image"]
        return image(header, height, width, "32FC1", 0, 4 * width, data)

    def markers(self, boxes: Boxes, actors: list[str], time_ns: int) -> Any:
        """Boxes of actors as a sensor saw them, in place of those that another saw before."""
        types = self._types
        names = ("Point", "Quaternion", "Pose", "Vector3")
        point, turn, pose, vector = self.kinds("geometry_msgs", *names)
        marker, mesh = self.kinds("visualization_msgs", "Marker", "MeshFile")
        image = types["sensor_msgs/msg/CompressedImage"]
        header = self.header(WORLD, time_ns)
        none = np.empty(0, np.uint8)
        orange = types["std_msgs/msg/ColorRGBA"](1, 0.6, 0, 0.4)
        always = types["builtin_interfaces/msg/Duration"](0, 0)
        return types["visualization_msgs/msg/MarkerArray"]([
            marker(
                header, "actors", number, marker.CUBE,
                marker.ADD if boxes.there[number] else marker.DELETE,
                pose(point(*boxes.centres[number].tolist()),
                     turn(*boxes.quaternions[number].tolist())),
                vector(*boxes.sizes[number].tolist()), orange, always, False, [], [], "",
                image(header, "", none), [], name, "", mesh("", none), False,
            )
            for number, name in enumerate(actors)
        ])  # fmt: skip

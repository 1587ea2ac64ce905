"""Serialized ROS 2 messages of a survey, sorted by time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cache
from heapq import merge
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lidarsim.columns.bags import POINT_FIELDS
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.numerics.arrays import Floats, Floats32, Ints, Records
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, Instruments
from lidarsim.sweeps.ray_image import RayImage
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps

from ..boxes import Boxes, SweepBoxes
from ..frame_names import INSTRUMENTS, VEHICLE, WORLD, frame_names, points_topic, survey_start_ns
from ..laser_scan import ScanRays
from .layouts import MessageLayout, encode_points, message_stamp_ns, sensor_traits, since_stamp_ns
from .livox import CUSTOM_DEFINITION, CUSTOM_MSG, check_lines, custom_message
from .organized import organized_rows


class RosMessage(NamedTuple):
    """A serialized message on a topic."""

    topic: str
    kind: str  # type of the message, for example "sensor_msgs/msg/PointCloud2"
    time_ns: int  # time at which the message is sent
    cdr: bytes | memoryview  # serialized message with its encapsulation header


class Serialized(NamedTuple):
    """A message that is already serialized."""

    kind: str
    cdr: bytes


# Time between the last point and the last frame, because some layouts round up times.
_ROUNDING_NS = 1000
CLOCK_TOPIC = "/clock"
LATCHED_TOPICS = ("/tf_static", "/label_info", "/material_info")  # also sent to late subscribers
# Messages of vision_msgs, which rosbags does not provide.
_LABEL_INFO = "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n"
_LABEL_INFO += f"{80 * '='}\nMSG: vision_msgs/VisionClass\nuint16 class_id\nstring class_name\n"


@cache
def message_store() -> Typestore:
    """Return the types of the messages that a survey can contain."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_LABEL_INFO, "vision_msgs/msg/LabelInfo"))
    store.register(get_types_from_msg(CUSTOM_DEFINITION, CUSTOM_MSG))
    return store


def survey_messages(
    cloud: CloudLike,
    sweeps: Sweeps,
    message_layout: MessageLayout,
    pose_rate_hz: float | None = None,
) -> Iterator[RosMessage]:
    """Yield the messages of a cloud, sorted by time."""
    columns = {column.name for column in cloud.table}
    messages = SurveyMessages(sweeps, message_layout, columns, pose_rate_hz)
    measured = messages.instrument_messages()
    waiting = next(measured, None)
    yield from messages.static_messages()
    for sweep, points in enumerate(sweeps.points(cloud)):
        while waiting is not None and waiting.time_ns <= messages.sweep_start_ns(sweep):
            yield waiting
            waiting = next(measured, None)
        yield messages.clock_message(messages.sweep_start_ns(sweep))
        yield from messages.sweep_messages(sweep, points)
    while waiting is not None:
        yield waiting
        waiting = next(measured, None)


class SurveyMessages:
    """Conversion of a survey to ROS messages.

    Parameters
    ----------
    sweeps
        Sweeps of the survey.
    message_layout
        Layout of points in messages.
    columns
        Names of the columns in the cloud.
    pose_rate_hz
        Rate of frames on `/tf` during the sweeps of the first sensor. By default, there are only
        frames at the start of each sweep and at the end of the last sweep.
    """

    def __init__(
        self,
        sweeps: Sweeps,
        message_layout: MessageLayout,
        columns: Collection[str],
        pose_rate_hz: float | None = None,
    ) -> None:
        self._make = _Messages(message_store().types)
        self._sweeps = sweeps
        self._message_layout = message_layout
        self._columns = {name for name in columns if name != "class" or sweeps.classes}
        self._row = message_layout.row(self._columns)
        (field,) = self._make.types_of("sensor_msgs", "PointField")
        self._fields = [
            field(name, offset, POINT_FIELDS[kind.str[1:]], 1)
            for name, (kind, offset, *_) in (self._row.fields or {}).items()
        ]
        self._frames = frame_names(sweeps.sensors, sweeps.actors)
        self._actors = self._frames[len(sweeps.sensors) : -len(INSTRUMENTS)]
        poses = map(SweepPoses, sweeps.actor_poses.positions, sweeps.actor_poses.quaternions)
        # Frames of the vehicle and the actors, with their poses.
        self._moving = [(VEHICLE, sweeps.platform), *zip(self._actors, poses, strict=True)]
        self._start_ns = survey_start_ns(sweeps)
        self._pose_rate_hz = pose_rate_hz
        sweeps_per_sensor = np.bincount(sweeps.sensor, minlength=1)[sweeps.sensor]
        # Number of sweeps per station for the sensor of each sweep.
        self._sweeps_per_station = sweeps_per_sensor // sweeps.stations

    def sweep_start_ns(self, sweep: int) -> int:
        """Return the start of a sweep in nanoseconds since 1970."""
        return self._start_ns + round(self._sweeps.begins_ns[sweep])

    def static_messages(self) -> Iterator[RosMessage]:
        """Yield the messages that are only sent once, at the start of the survey."""
        sweeps = self._sweeps
        start_ns = self._start_ns
        on_carrier = [
            (VEHICLE, frame, sweeps.mounts, number)
            for number, frame in enumerate(self._frames[: len(sweeps.sensors)])
        ]
        on_carrier += _instruments(sweeps)
        yield _sent("/tf_static", self._make.transforms(on_carrier, start_ns), start_ns)
        info, named = self._make.types_of("vision_msgs", "LabelInfo", "VisionClass")
        header = self._make.header("", start_ns)
        if sweeps.classes:
            classes = [named(number, name) for number, name in sweeps.classes.items()]
            yield _sent("/label_info", info(header, classes, 0.0), start_ns)
        if "material" in self._columns and sweeps.materials:
            materials = [named(number, name) for number, name in enumerate(sweeps.materials)]
            yield _sent("/material_info", info(header, materials, 0.0), start_ns)

    def instrument_messages(self) -> Iterator[RosMessage]:
        """Yield the messages of the IMU and the GNSS receiver, sorted by time."""
        return self._make.instrument_messages(self._sweeps, self._start_ns)

    def clock_message(self, time_ns: int) -> RosMessage:
        """Return the clock message for a time in nanoseconds since 1970."""
        (clock,) = self._make.types_of("rosgraph_msgs", "Clock")
        return _sent("/clock", clock(self._make.stamp(time_ns)), time_ns)

    def sweep_messages(self, sweep: int, points: Cloud) -> Iterator[RosMessage]:
        """Yield all messages of a sweep, ending with the frames that follow its start."""
        sweeps = self._sweeps
        time_ns = self.sweep_start_ns(sweep)
        yield _sent("/tf", self._make.transforms(self._frames_in_world(sweep), time_ns), time_ns)
        yield from self.sensor_messages(sweep, points)
        if self._actors:
            boxes = Boxes.from_points(sweeps, sweep, points)
            yield _sent("/actors", self._make.markers(boxes, self._actors, time_ns), time_ns)
            if boxes.visibility is not None:
                topic = f"{sweep_topic(sweeps, sweep).removesuffix('points')}actor_visibility"
                yield _sent(topic, self._make.visibility(boxes, self._actors, time_ns), time_ns)
        yield from self._frames_within(sweep)

    def sensor_messages(self, sweep: int, points: Cloud) -> Iterator[RosMessage]:
        """Yield the messages of a sweep that contain measurements."""
        time_ns = self.sweep_start_ns(sweep)
        topic = sweep_topic(self._sweeps, sweep)
        for name, content in self._measured(sweep, points).items():
            yield _sent(f"{topic.removesuffix('points')}{name}", content, time_ns)

    def _measured(self, sweep: int, points: Cloud) -> dict[str, Any]:
        """Return the sensor messages of a sweep, keyed by the last part of their topics."""
        sweeps = self._sweeps
        stamp_ns = message_stamp_ns(sweeps, sweep)
        header = self._make.header(self._frames[sweeps.sensor[sweep]], stamp_ns)
        rows = encode_points(self._message_layout, self._row, points, sweeps, sweep)
        if self._message_layout.organized:
            clouds = organized_rows(self._message_layout, rows, points, sweeps, sweep)
        else:
            clouds = [rows[np.newaxis]]
        contents = {
            _numbered("points", plane): self._point_cloud(cloud, header)
            for plane, cloud in enumerate(clouds)
        }
        if (rays := ScanRays.from_points(sweeps, sweep, points)) is not None:
            contents["scan"] = self._make.laser_scan(rays, header)
        if self._message_layout.name == "images":
            ranges = RayImage.from_points(sweeps, sweep, points).to_images(points["range"])
            ranges[np.isnan(ranges)] = np.inf  # REP 117: no detection
            for plane, image in enumerate(ranges):
                contents[_numbered("range_image", plane)] = self._make.image(image[::-1], header)
        if self._message_layout.name == "livox":
            check_lines(sensor_traits(sweeps, sweep).channels)
            since_ns = np.zeros(len(points))
            if not self._message_layout.compensated:
                since_ns = since_stamp_ns(points, sweeps, sweep)
            data = custom_message(message_store(), header, stamp_ns, since_ns, rows)
            contents["livox"] = Serialized(CUSTOM_MSG, data)
        return contents

    def _frames_in_world(self, sweep: int) -> list[tuple[str, str, SweepPoses, int]]:
        """Return the frames of the vehicle and of the actors that are present in a sweep."""
        present = [True, *self._sweeps.actor_there[:, sweep]]
        return [
            (WORLD, name, poses, sweep)
            for (name, poses), is_present in zip(self._moving, present, strict=True)
            if is_present
        ]

    def _frames_within(self, sweep: int) -> Iterator[RosMessage]:
        """Yield the frames of the vehicle and the actors after the start of a sweep."""
        sweeps = self._sweeps
        since_ns = self._pose_times(sweep)
        if not len(since_ns):
            return
        fractions = since_ns / sweeps.span_ns(sweep)
        frames = [(VEHICLE, sweeps.platform_poses_at(sweep, fractions))]
        stays = sweeps.actor_there[:, sweep] & ~sweeps.actor_leaves[:, sweep]
        frames += [
            (self._actors[actor], sweeps.actor_poses_at(actor, sweep, fractions))
            for actor in np.flatnonzero(stays).tolist()
        ]
        for index, time_ns in enumerate((self.sweep_start_ns(sweep) + since_ns).tolist()):
            in_world = [(WORLD, name, poses, index) for name, poses in frames]
            yield _sent("/tf", self._make.transforms(in_world, time_ns), time_ns)

    def _pose_times(self, sweep: int) -> Ints:
        """Return the times of frames during a sweep, in nanoseconds since its start."""
        sweeps = self._sweeps
        span_ns = sweeps.span_ns(sweep)
        times_ns = np.empty(0, np.int64)
        if span_ns and self._pose_rate_hz and sweeps.sensor[sweep] == 0:
            interval_ns = 1e9 / self._pose_rate_hz
            count = int(np.ceil(span_ns / interval_ns)) - 1
            times_ns = np.rint(interval_ns * np.arange(1, count + 1)).astype(np.int64)
        if span_ns and (sweeps.numbers[sweep] + 1) % self._sweeps_per_station[sweep] == 0:
            end_ns = int(span_ns) + _ROUNDING_NS
            if sweep + 1 < len(sweeps) and sweeps.sensor[sweep + 1] == sweeps.sensor[sweep]:
                next_ns = round(sweeps.begins_ns[sweep + 1] - sweeps.begins_ns[sweep])
                end_ns = min(end_ns, next_ns - 1)  # before the vehicle is at the next station
            times_ns = np.append(times_ns, end_ns)
        return times_ns

    def _point_cloud(self, rows: Records, header: Any) -> Any:
        """Return a PointCloud2 with points in an array of shape (height, width)."""
        height, width = rows.shape
        (message,) = self._make.types_of("sensor_msgs", "PointCloud2")
        return message(
            header=header,
            height=height,
            width=width,
            fields=self._fields,
            is_bigendian=False,
            point_step=self._row.itemsize,
            row_step=width * self._row.itemsize,
            data=rows.reshape(-1).view(np.uint8),
            is_dense=not self._message_layout.organized,
        )


def _numbered(name: str, plane: int) -> str:
    """Return the name of the topic for a return, where 0 is the first return of a pulse."""
    return f"{name}{plane + 1 if plane else ''}"


def _instruments(sweeps: Sweeps) -> list[tuple[str, str, SweepPoses, int]]:
    """Return the frames of the IMU and the GNSS receiver, relative to the vehicle.

    They are passed to `_Messages.transforms`.
    """
    instruments = sweeps.instruments
    if instruments is None or instruments.folder is None:
        return []
    frames = zip(
        frame_names(sweeps.sensors, sweeps.actors)[-2:],
        (instruments.imu, instruments.gnss),
        strict=True,
    )
    return [
        (
            VEHICLE,
            frame,
            SweepPoses(np.array([instrument.position]), np.array([instrument.quaternion])),
            0,
        )
        for frame, instrument in frames
        if instrument is not None
    ]


def static_frame(parent: str, frame: str, pose: SweepPoses, time_ns: int) -> RosMessage:
    """Return a message that states the constant pose of a frame in its parent frame."""
    make = _Messages(message_store().types)
    return _sent("/tf_static", make.transforms([(parent, frame, pose, 0)], time_ns), time_ns)


def sweep_topic(sweeps: Sweeps, sweep: int) -> str:
    """Return the topic for the points of a sweep."""
    sensor = sweeps.sensor[sweep]
    frames = frame_names(sweeps.sensors, sweeps.actors)
    return points_topic(sweeps.sensors[sensor], frames[sensor])


def _sent(topic: str, content: Any, time_ns: int) -> RosMessage:
    """Serialize a message that is sent on a topic at a given time."""
    if isinstance(content, Serialized):
        return RosMessage(topic, content.kind, time_ns, content.cdr)
    kind = content.__msgtype__
    return RosMessage(topic, kind, time_ns, message_store().serialize_cdr(content, kind))


class _NamedBox(NamedTuple):
    """Box that a marker shows."""

    name: str
    center: Floats  # (3,), meters
    quaternion: Floats  # (4,), x, y, z, w
    size: Floats  # (3,), meters


class _Messages:
    """Factory for messages and their common parts."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def types_of(self, package: str, *names: str) -> list[Any]:
        return [self._types[f"{package}/msg/{name}"] for name in names]

    def stamp(self, time_ns: int) -> Any:
        return self._types["builtin_interfaces/msg/Time"](*divmod(time_ns, 1_000_000_000))

    def header(self, frame: str, time_ns: int) -> Any:
        return self._types["std_msgs/msg/Header"](self.stamp(time_ns), frame)

    def transforms(self, frames: list[tuple[str, str, SweepPoses, int]], time_ns: int) -> Any:
        """Return a TFMessage.

        Each frame is given by its parent, its name, and an array of poses relative to the parent
        with the index of the pose to use.
        """
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

    def instrument_messages(self, sweeps: Sweeps, start_ns: int) -> Iterator[RosMessage]:
        """Yield the messages of the IMU and the GNSS receiver, sorted by time."""
        instruments = sweeps.instruments
        if instruments is None:
            return iter(())
        *_, imu, gnss = frame_names(sweeps.sensors, sweeps.actors)
        streams = self._imu(instruments, imu, start_ns), self._gnss(instruments, gnss, start_ns)
        return merge(*streams, key=lambda message: message.time_ns)

    def _imu(self, instruments: Instruments, frame: str, start_ns: int) -> Iterator[RosMessage]:
        vector, quaternion = self.types_of("geometry_msgs", "Vector3", "Quaternion")
        (imu,) = self.types_of("sensor_msgs", "Imu")
        unknown = np.zeros(9)
        unknown[0] = -1  # the orientation is unknown
        rate, force = (
            np.zeros((2, 9))
            if instruments.imu is None
            else [np.eye(3).ravel() * variance for variance in instruments.imu.variances]
        )
        for time, *numbers in instruments.rows(IMU_FILE):
            time_ns = start_ns + int(time)
            values = [*map(float, numbers)]
            message = imu(
                header=self.header(frame, time_ns),
                orientation=quaternion(0.0, 0.0, 0.0, 1.0),
                orientation_covariance=unknown,
                angular_velocity=vector(*values[:3]),
                angular_velocity_covariance=rate,
                linear_acceleration=vector(*values[3:]),
                linear_acceleration_covariance=force,
            )
            yield _sent("/imu/data_raw", message, time_ns)

    def _gnss(self, instruments: Instruments, frame: str, start_ns: int) -> Iterator[RosMessage]:
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
                yield _sent("/gnss/fix", message, time_ns)
            else:
                message = stamped(self.header(WORLD, time_ns), point(float(x), float(y), float(z)))
                yield _sent("/gnss/position", message, time_ns)

    def laser_scan(self, rays: ScanRays, header: Any) -> Any:
        first = float(rays.angles[0])
        last = float(rays.angles[-1])
        (scan,) = self.types_of("sensor_msgs", "LaserScan")
        min_range_m, max_range_m = rays.range_limits_m
        return scan(
            header=header,
            angle_min=first,
            angle_max=last,
            angle_increment=(last - first) / (len(rays.angles) - 1),
            time_increment=rays.time_increment_s,
            scan_time=rays.scan_time_s,
            range_min=min_range_m,
            range_max=max_range_m,
            ranges=rays.ranges,
            intensities=rays.intensities,
        )

    def image(self, values: Floats32, header: Any) -> Any:
        height, width = values.shape
        data = np.ascontiguousarray(values, "<f4").view(np.uint8).ravel()
        image = self._types["sensor_msgs/msg/Image"]
        return image(
            header=header,
            height=height,
            width=width,
            encoding="32FC1",
            is_bigendian=0,
            step=4 * width,
            data=data,
        )

    def markers(self, boxes: Boxes, actors: list[str], time_ns: int) -> Any:
        """Return a MarkerArray with the actors' boxes.

        It replaces earlier markers.
        """
        (marker,) = self.types_of("visualization_msgs", "Marker")
        actions = [marker.ADD if present else marker.DELETE for present in boxes.present]
        header = self.header(WORLD, time_ns)
        cubes = [
            self._cube(header, "actors", number, action, _NamedBox(*box))
            for number, (action, *box) in enumerate(
                zip(actions, actors, boxes.centers, boxes.quaternions, boxes.sizes, strict=True)
            )
        ]
        return self._types["visualization_msgs/msg/MarkerArray"](cubes)

    def visibility(self, boxes: Boxes, actors: list[str], time_ns: int) -> Any:
        """Return a DiagnosticArray with the visibility of the actors that are present."""
        array, status, pair = self.types_of(
            "diagnostic_msgs", "DiagnosticArray", "DiagnosticStatus", "KeyValue"
        )
        assert boxes.visibility is not None
        items = []
        for actor in np.flatnonzero(boxes.present).tolist():
            values = {"points": str(boxes.points[actor])} | {
                name: f"{value:.6g}" for name, value in boxes.visibility[actor].arrays.items()
            }
            pairs = [pair(name, value) for name, value in values.items()]
            items.append(status(status.OK, actors[actor], "", "lidar", pairs))
        return array(self.header(WORLD, time_ns), items)

    def sweep_markers(self, boxes: SweepBoxes, namespace: str, header: Any) -> Any:
        """Return a MarkerArray with boxes in the frame of a header. It removes earlier markers."""
        (marker,) = self.types_of("visualization_msgs", "Marker")
        nowhere = _NamedBox("", np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(3))
        cubes = [self._cube(header, namespace, 0, marker.DELETEALL, nowhere)]
        cubes += [
            self._cube(header, namespace, number, marker.ADD, _NamedBox(*box))
            for number, *box in zip(
                boxes.objects.tolist(),
                boxes.names,
                boxes.centers,
                boxes.quaternions,
                boxes.sizes,
                strict=True,
            )
        ]
        return self._types["visualization_msgs/msg/MarkerArray"](cubes)

    def _cube(self, header: Any, namespace: str, number: int, action: int, box: _NamedBox) -> Any:
        """Return a Marker with a box."""
        types = self._types
        names = ("Point", "Quaternion", "Pose", "Vector3")
        point, rotation, pose, vector = self.types_of("geometry_msgs", *names)
        marker, mesh = self.types_of("visualization_msgs", "Marker", "MeshFile")
        image = types["sensor_msgs/msg/CompressedImage"]
        none = np.empty(0, np.uint8)
        return marker(
            header=header,
            ns=namespace,
            id=number,
            type=marker.CUBE,
            action=action,
            pose=pose(point(*box.center.tolist()), rotation(*box.quaternion.tolist())),
            scale=vector(*box.size.tolist()),
            color=types["std_msgs/msg/ColorRGBA"](1, 0.6, 0, 0.4),  # orange
            lifetime=types["builtin_interfaces/msg/Duration"](0, 0),
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=image(header, "", none),
            uv_coordinates=[],
            text=box.name,
            mesh_resource="",
            mesh_file=mesh("", none),
            mesh_use_embedded_materials=False,
        )


def box_markers(boxes: SweepBoxes, namespace: str, frame: str, time_ns: int) -> RosMessage:
    """Return a MarkerArray with boxes in a frame, which removes the earlier markers of its topic.

    The topic is `/` and the namespace.
    """
    make = _Messages(message_store().types)
    content = make.sweep_markers(boxes, namespace, make.header(frame, time_ns))
    return _sent(f"/{namespace}", content, time_ns)

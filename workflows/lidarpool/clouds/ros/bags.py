"""Bags of ROS 2, as MCAP, through rosbags: PointCloud2, frames, /actors and /clock."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Floats32
from lidarsim.base.errors import LidarError
from lidarsim.base.extras import reading
from lidarsim.base.input_files import read_input_text
from lidarsim.base.words import joined
from lidarsim.columns.bags import (
    LIVOX_CLOUDS,
    POINT_CLOUD,
    livox_columns,
    message_types,
    open_bag,
    point_columns,
)
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.mcap_chunks import read_metadata
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, SURFACE_COLUMNS
from lidarsim.motion.bag_trajectories import read_bag
from lidarsim.motion.trajectory import Track
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps, states_compensation

from ...base.per_process import PerProcess
from .. import laser_scan
from ..cloud_format import CloudFormat, PointColumns
from ..frame_names import survey_start_ns
from ..job_reader import JobReader
from ..recording import Recording, RecordingSource, sweep_from_columns
from ..writing import ExportSpec
from .layouts import EXTRA_FIELDS, LAYOUTS, LaidOut, message_stamp_ns, sensor_traits

_UNSTAMPED = "has no timestamps, so the recording times are used instead"
_MAX_DISTANCE_NS = 2e8  # limit between a sweep and the first or last pose


class Rosbag2(CloudFormat):
    """A folder for `ros2 bag play`.

    Each sweep is a PointCloud2 on `/NAME/points`, NAME from its sensor, or on `/points`. Points are
    in the sensor frame at their own firing, as drivers publish them, and have times; or
    compensated, in the sensor frame at the start of the sweep, without times. `/tf` has the frames
    of the carrier (`base_link`) and of actors in `map`, and `/clock` the time, both at each sweep.
    `/tf` also has the frames at the end of the last sweep of each station, so that this sweep can
    be deskewed, and with `pose_rate_hz` frames while the sweeps of the first sensor last.
    `/tf_static` has the sensors on the carrier, `/label_info` names of classes and `/material_info`
    names of materials (LabelInfo of vision_msgs). The survey begins at its start, or at `START_NS`
    without one. `/actors` has a MarkerArray of the boxes of actors at the start of each sweep.

    Of a 2D scanner (one beam in the plane of its x and y axes) `/NAME/scan`, or `/scan`, also has a
    LaserScan of each sweep, where the survey keeps every return and has the columns ray and range.

    Instruments of the carrier are frames `imu` and `gnss` on it. `/imu/data_raw` has Imu, without
    orientations, and `/gnss/fix` NavSatFix or, where latitudes are not known, `/gnss/position`
    PointStamped in `map`.

    Layouts of a point: `velodyne` (22 bytes; its time in seconds since the sweep began), `autoware`
    (PointXYZIRCAEDT, 32 bytes; angles in radians, azimuth clockwise from the start of the head,
    time_stamp in ns since the sweep began; compensated: PointXYZIRC, 16 bytes), `ouster` (48
    bytes; ring 0 is the highest beam, range in mm, t in ns since the sweep began, intensity:
    signal), `hesai` and `robosense` (26 bytes; intensity: reflectivity, timestamp in seconds since
    1970; rings are the maker's) and `livox` (26 bytes; timestamp in ns since 1970; `/NAME/livox`,
    or `/livox`, has the same points as a CustomMsg). Whole numbers of intensity are 255 at 1 and
    above. Where the cloud has red, green and blue, a field `rgb` follows, where it has radial
    velocities, `radial_velocity`, where its classes have names, `label`, and then any columns of
    normals, `incidence_deg` and origins of rays, and `material`; each makes points 4 bytes longer,
    up to the 48 bytes of `ouster`.

    Organized clouds have a point for each ray, NaN without a return (`organized_rows`). Second
    returns of `ouster` are then on `/NAME/points2`.
    """

    title = "rosbag2"
    by_sweep = True
    frame = "firing"
    required = ("object", "channel")
    stored = ("channel", *COLORS, "radial_velocity", *SURFACE_COLUMNS, "material")
    named = ("class",)
    options = ("layout", "compensated", "pose_rate_hz", "organized")
    actor_boxes = True
    file_pattern = r"metadata\.yaml|rosbag2\w*\.mcap"

    def write(self, path: Path, spec: ExportSpec) -> None:
        """Write the folder."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        from .messages import LATCHED_TOPICS, message_store, survey_messages

        laid_out = LaidOut(spec.layout, spec.compensated, spec.organized)
        # Readers of Humble accept no later version: from 9 on, profiles are lists.
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
            bag.set_custom_data("lidarpool", self.sweeps.frame_text(compensated=spec.compensated))
            topics: dict[str, Any] = {}
            for message in survey_messages(self.cloud, self.sweeps, laid_out, spec.pose_rate_hz):
                if message.topic not in topics:
                    latched = (_latched_profile(),) if message.topic in LATCHED_TOPICS else ()
                    topics[message.topic] = bag.add_connection(
                        message.topic,
                        message.kind,
                        typestore=message_store(),
                        offered_qos_profiles=latched,
                    )
                bag.write(topics[message.topic], message.time_ns, message.cdr)

    @classmethod
    def check_options(cls, spec: ExportSpec) -> None:
        """Raise LidarError if clouds of the layout cannot be organized."""
        if spec.organized and not LAYOUTS[spec.layout].lines:
            organized = [name for name, layout in LAYOUTS.items() if layout.lines]
            raise LidarError(
                f"The layout {spec.layout} does not support `organized`, because its driver does "
                "not publish organized clouds. Remove `organized`, or use one of the layouts "
                f"{joined(organized)}."
            )

    @classmethod
    def option_columns(cls, spec: ExportSpec) -> tuple[str, ...]:
        """Return the names of the columns that the layout requires."""
        columns = LAYOUTS[spec.layout].columns
        if spec.organized and "ray" not in columns:
            columns = (*columns, "ray")
        return tuple(name for name in columns if name != "time" or not spec.compensated)

    @classmethod
    def optional_columns(cls, spec: ExportSpec, sweeps: Sweeps) -> tuple[str, ...]:
        """Return the names of further columns, with those of the messages of 2D scanners."""
        columns = super().optional_columns(spec, sweeps)
        return columns + (laser_scan.COLUMNS if laser_scan.has_laser_scans(sweeps) else ())

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the columns of LaserScan messages, which surveys that keep every return have."""
        has_scans = survey.keep_every == 1 and laser_scan.has_planar_sensors(survey)
        return laser_scan.COLUMNS if has_scans else ()

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return a note if 2D scanners have no LaserScan messages."""
        note = "bags contain LaserScan messages of 2D scanners only if every return is kept. Set "
        note += "`cloud.keep_every: 1`"
        return [note] if survey.keep_every > 1 and laser_scan.has_planar_sensors(survey) else []

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open a topic of PointCloud2, or CustomMsg of Livox, in a bag."""
        return _open_bag(source)


class MCAP(Rosbag2):
    """The messages of a bag as an MCAP file."""

    title = "MCAP"
    file_pattern = ""
    job_path = "bags/{name}.mcap"

    def write(self, path: Path, spec: ExportSpec) -> None:
        """Write the file."""
        folder = path.with_name(f"{path.name}.bag")
        try:
            super().write(folder, spec)
            (written,) = folder.glob("*.mcap")
            written.replace(path)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Return points with intensity, limited by the layout, channel and named class."""
        layout = LAYOUTS[job.layout]
        message = _point_cloud(job, sweep, cls.path_of_job(job.entry))
        names = {field.name for field in message.fields}
        compensated = layout.time_field not in names
        extra = [name for name in EXTRA_FIELDS if name in names]
        rows = message.data.view(layout.row(extra, compensated=compensated))
        intensity = rows["intensity"].astype(np.float32) / layout.full_intensity
        rings = rows[layout.ring_field].astype(np.int64)
        channels = layout.channels(rings, sensor_traits(job.sweeps, sweep)).astype(np.uint16)
        columns = {"intensity": intensity, "channel": channels}
        if "label" in names:
            columns["class"] = rows["label"].astype(np.uint16)
        points = np.stack([rows[axis] for axis in "xyz"], axis=1)
        if not compensated and job.sweeps.coordinates == "world":
            points = _at_start(job, sweep, points, rows[layout.time_field])
        return points, columns


def _latched_profile() -> Any:
    """Return the profile that `ros2 bag play` must offer, so that late listeners get the frames."""
    from rosbags import interfaces as ros

    return ros.Qos(
        history=ros.QosHistory.KEEP_LAST,
        depth=1,
        reliability=ros.QosReliability.RELIABLE,
        durability=ros.QosDurability.TRANSIENT_LOCAL,
        deadline=ros.QosTime(0, 0),
        lifespan=ros.QosTime(0, 0),
        liveliness=ros.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=ros.QosTime(0, 0),
        avoid_ros_namespace_conventions=False,
    )


def _open_job(job: JobReader, file: str) -> Any:
    """Open the bag of a job in a data set."""
    from lidarsim.columns.closing_bag import ClosingBag

    # AnyReader would parse the definitions of messages, which takes longer than a sweep.
    bag = ClosingBag(job.local(file))
    bag.open()
    job.opened.callback(bag.close)
    return bag


def _point_cloud(job: JobReader, sweep: int, file: str) -> Any:
    """Return the PointCloud2 of a sweep.

    Raises ValueError if the bag lacks the message.
    """
    from .messages import sweep_topic

    bag = job.cached("bag", lambda: _open_job(job, file))
    topic = sweep_topic(job.sweeps, sweep)
    connections = [opened for opened in bag.connections if opened.topic == topic]
    time_ns = survey_start_ns(job.sweeps) + round(job.sweeps.begins_ns[sweep])
    record = next(bag.messages(connections, time_ns, time_ns + 1), None)
    if record is None:  # rosbags 0.11.2 misses some messages by their time
        records = bag.messages(connections)
        record = next((candidate for candidate in records if candidate[1] == time_ns), None)
    if record is None:
        raise ValueError(f"it contains no message on {topic} at {time_ns} ns")
    connection, _, data = record
    return message_types().deserialize_cdr(data, connection.msgtype)


def _at_start(job: JobReader, sweep: int, points: Floats32, times: AnyArray) -> Floats32:
    """Return points (n, 3) as fired in the sensor frame at the start of the sweep.

    `times` (n,) are the times of the layout.
    """
    sweeps = job.sweeps
    since_ns = LAYOUTS[job.layout].since_ns(times, message_stamp_ns(sweeps, sweep))
    stamps = np.rint(since_ns + sweeps.stamp_ns(sweep)).astype(np.int64)
    scans = np.full(len(points), sweeps.scans[sweep])
    sensor_cloud = Cloud(points, {"scan": scans, "time": stamps})
    fired_in_sensor = replace(sweeps, coordinates="sensor")
    return fired_in_sensor.compensated(sweep, sensor_cloud).astype(np.float32)


def _open_bag(source: RecordingSource) -> Recording:
    """Open a topic of PointCloud2: each message is a sweep in the frame of the message.

    CustomMsg of Livox is read where a bag has no PointCloud2, or its topic is chosen.
    """
    bags = PerProcess(partial(open_bag, source.path, source.name))
    bag = bags()
    clouds = {
        connection.topic: connection
        for connection in bag.connections
        if connection.msgtype == POINT_CLOUD
    }
    livox_clouds = {
        connection.topic: connection
        for connection in bag.connections
        if connection.msgtype in LIVOX_CLOUDS
    }
    topics = livox_clouds if source.sensor in livox_clouds else clouds or livox_clouds
    connection = topics[source.choose("PointCloud2 topics", topics)]
    columns_of = livox_columns if topics is livox_clouds else point_columns

    def messages() -> Iterator[Any]:
        return bags().messages([connection])

    def convert(message: Any) -> Sweep:
        _, recorded_ns, data = message
        stamp_ns = _header_of(data).stamp_ns if is_stamped else recorded_ns
        return sweep_from_columns(columns_of(data), time_ns=float(stamp_ns))

    with reading(source.name):
        # Programs that set no stamps leave zeros.
        is_stamped = any(_header_of(data).stamp_ns for _, _, data in islice(messages(), 2))

    def headers() -> Iterator[_Header]:
        for _, recorded_ns, data in messages():
            header = _header_of(data)
            yield header if is_stamped else header._replace(stamp_ns=recorded_ns)

    def read_stamps() -> Iterator[float]:
        return (float(header.stamp_ns) for header in headers())

    def read_poses() -> Floats | None:
        return _sweep_poses(source.path, [*headers()])

    unstamped = () if is_stamped or not connection.msgcount else (_UNSTAMPED,)
    return source.stream(
        messages,
        convert,
        connection.msgcount,
        read_stamps=read_stamps,
        read_poses=read_poses,
        notes=source.named(unstamped),
        compensated=_stated_compensation(source.path),
    )


def _stated_compensation(path: Path) -> bool | None:
    """Return what the custom data of a bag of `Rosbag2` state, or None for other bags.

    rosbags reads custom data from folders only.
    """
    if path.is_dir():
        text = read_input_text(path / "metadata.yaml", errors="replace")
    else:
        text = read_metadata(path).get("rosbag2", {}).get("serialized_metadata", "")
    return states_compensation(re.sub(r"[\s\\]+", " ", text))  # YAML breaks long lines


class _Header(NamedTuple):
    """Header of a message."""

    stamp_ns: int  # when the data was measured, which may be long before it was recorded
    frame: str


def _header_of(data: bytes) -> _Header:
    """Return the header of a message of ROS 2 that begins with one."""
    order = "<u4" if data[1] & 1 else ">u4"
    seconds, nanoseconds, length = np.frombuffer(data, order, 3, 4).tolist()
    frame = bytes(data[16 : 15 + length]).decode(errors="replace")
    return _Header(seconds * 10**9 + nanoseconds, frame)


def _sweep_poses(path: Path, headers: Sequence[_Header]) -> Floats | None:
    """Return the poses (n, 4, 4) of the frame of sweeps in the root of its tree of frames.

    `headers` are those of the sweeps of a sensor. None if the bag has no poses of the frame at the
    times of all sweeps.
    """
    frames = {header.frame.lstrip("/") for header in headers}
    if len(frames) != 1:
        return None
    try:
        seconds, positions, quaternions = read_bag(path, f"/tf:{frames.pop()}", None)
    except LidarError:  # no frame of this name, or a frame that stands still
        return None
    times_ns = 1e9 * (seconds - seconds[0])
    stamps_ns = np.array([header.stamp_ns for header in headers]) - 1e9 * seconds[0]
    within_ns = stamps_ns.clip(times_ns[0], times_ns[-1])
    if np.abs(stamps_ns - within_ns).max() > _MAX_DISTANCE_NS:
        return None
    track = Track(seconds - seconds[0], positions, quaternions)
    poses = np.tile(np.eye(4), (len(headers), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = track.poses(0, within_ns)
    return poses

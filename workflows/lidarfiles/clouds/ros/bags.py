"""Read and write ROS 2 bags in MCAP format with rosbags."""

from __future__ import annotations

import re
import shutil
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

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
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input_text
from lidarsim.motion.bag_trajectories import read_frame
from lidarsim.motion.rotations import recorded_rotation
from lidarsim.motion.trajectory import Track
from lidarsim.numerics.arrays import AnyArray, Floats, Floats32
from lidarsim.scene.transform import affine
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import Sweeps, actor_type, states_compensation
from lidarsim.words import join_names

from ...processes.per_process import PerProcess
from .. import laser_scan
from ..cloud_format import CloudFormat
from ..format_options import FormatOptions
from ..frame_names import WORLD, survey_start_ns
from ..job_reader import JobReader, PointColumns
from ..point_field import OMITTED, PointField
from ..recorded_boxes import RecordedBoxes
from ..recording import Recording, sweep_from_columns
from ..recording_ref import RecordingRef
from ..sequential_recording import SequentialRecording
from .layouts import EXTRA_FIELDS, LAYOUTS, MessageLayout, message_stamp_ns, sensor_traits

_LAYOUT_KEY = "lidarpool_layout"  # custom data of simulated bags
_UNSTAMPED = "has no timestamps, so the recording times are used instead"
_LABEL_TOPIC = "/label_info"
_LABELS = "vision_msgs/msg/LabelInfo"
_BOX_TOPIC = "/actors"
_BOXES = "visualization_msgs/msg/MarkerArray"
_SAME_NS = 1_000_000  # maximum time between a sweep and the markers of its boxes
_ADD = 0  # action of a marker that shows a box
_MAX_DISTANCE_NS = 2e8  # maximum time between a sweep and the first or last pose


class Rosbag2(CloudFormat):
    """A folder with a ROS 2 bag in MCAP format, for `ros2 bag play`.

    A bag contains these topics:

    - `/NAME/points`, or `/points` for an unnamed sensor: a PointCloud2 for each sweep. By default,
      each point is in the sensor frame at the time of its firing, and has a time, as published by
      drivers. With the option `compensated`, all points are in the sensor frame at the start of the
      sweep, and have no times.
    - `/NAME/scan` or `/scan`: a LaserScan for each sweep of a 2D scanner, whose only beam rotates
      in its x-y plane. This requires that the survey keeps all returns, and the columns `ray` and
      `range`.
    - `/tf`: frames of the vehicle (`base_link`) and of actors in the frame `map`, at the start of
      each sweep. The frames at the end of the last sweep at each station are included, so that this
      sweep can be deskewed. The option `pose_rate_hz` adds frames during the sweeps of the first
      sensor.
    - `/tf_static`: frames of the sensors, and of the instruments `imu` and `gnss`, on the vehicle.
    - `/clock`: the time at each sweep. It begins at the start of the survey, or at `START_NS` if
      the start is unknown.
    - `/actors`: a MarkerArray with the boxes of actors at the start of each sweep.
    - `/label_info` and `/material_info`: names of classes and materials (LabelInfo in vision_msgs).
    - `/imu/data_raw`: Imu messages without orientations.
    - `/gnss/fix`: NavSatFix messages. If the latitude is unknown, `/gnss/position` contains
      PointStamped messages in the frame `map` instead.

    A point has one of these layouts:

    - `velodyne`: 22 bytes, with the time in seconds since the start of the sweep.
    - `autoware`: PointXYZIRCAEDT with 32 bytes. Angles are in radians, with clockwise azimuths from
      the zero direction of the head, and time_stamp is in ns since the start of the sweep.
      Compensated points are PointXYZIRC with 16 bytes.
    - `ouster`: 48 bytes. Ring 0 is the highest beam, the range is in mm, t is in ns since the start
      of the sweep, and the intensity is the signal.
    - `hesai` and `robosense`: 26 bytes. The intensity is the reflectivity, timestamp is in seconds
      since 1970, and rings have the manufacturer's numbers.
    - `livox`: 26 bytes, with timestamp in ns since 1970. `/NAME/livox` or `/livox` contains the
      same points as CustomMsg messages.

    Integer intensities are 255 for intensities of 1 and above. Depending on the columns of the
    cloud, a layout is followed by the fields `rgb`, `radial_velocity`, `label` (if classes have
    names), normals, `incidence_deg`, ray origins and `material`. Each of these fields adds 4 bytes.
    The first fields fit into the padding of the layout `ouster`.

    Organized clouds contain one point per ray, which is NaN if there is no return (see
    `organized_rows`). The layout `ouster` then uses `/NAME/points2` for second returns.
    """

    title = "rosbag2"
    by_sweep = True
    frame = "firing"
    fields = (
        PointField("rgb", COLORS, OMITTED, on_request=True),
        PointField("radial_velocity", ("radial_velocity",), OMITTED, on_request=True),
        PointField("label", ("class",), OMITTED, on_request=True, if_named=True),
        PointField("fields of the surface", SURFACE_COLUMNS, OMITTED, on_request=True),
        PointField("material", ("material",), OMITTED, on_request=True),
    )
    other_columns = False
    required = ("object",)
    options = ("layout", "compensated", "pose_rate_hz", "organized")
    actor_boxes = True
    file_pattern = r"metadata\.yaml|rosbag2\w*\.mcap"

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the folder."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        from .messages import LATCHED_TOPICS, message_store, survey_messages

        message_layout = MessageLayout(spec.layout, spec.compensated, spec.organized)
        # ROS 2 Humble cannot read later versions, because QoS profiles are lists from version 9 on.
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
            bag.set_custom_data("lidarpool", self.sweeps.frame_text(compensated=spec.compensated))
            # Intensities of converted recordings, whose return mode is unknown, are not energies.
            if self.sweeps.lidars and all(traits.mode for traits in self.sweeps.lidars):
                bag.set_custom_data(_LAYOUT_KEY, spec.layout)
            topics: dict[str, Any] = {}
            for message in survey_messages(
                self.cloud, self.sweeps, message_layout, spec.pose_rate_hz
            ):
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
    def check_options(cls, spec: FormatOptions) -> None:
        """Raise LidarError if the layout does not support organized clouds."""
        if spec.organized and not LAYOUTS[spec.layout].lines:
            organized = [name for name, layout in LAYOUTS.items() if layout.lines]
            raise LidarError(
                f"The layout {spec.layout} does not support `organized`, because its driver does "
                "not publish organized clouds. Remove `organized`, or use one of the layouts "
                f"{join_names(organized)}."
            )

    @classmethod
    def fields_for(cls, spec: FormatOptions) -> tuple[PointField, ...]:
        """Return the fields of the layout, followed by those that depend on the cloud."""
        layout = LAYOUTS[spec.layout]
        fields = layout.point_fields
        if spec.compensated:
            fields = tuple(f for f in fields if f.name != layout.time_field)
        organized = (PointField("row and column", ("ray",)),) if spec.organized else ()
        return (*fields, *organized, *cls.fields)

    @classmethod
    def stored_columns(cls, spec: FormatOptions, sweeps: Sweeps) -> set[str] | None:
        """Return the columns that can be stored, including the columns of LaserScan messages."""
        columns = super().stored_columns(spec, sweeps) or set()
        return columns | {*(laser_scan.COLUMNS if laser_scan.has_laser_scans(sweeps) else ())}

    @classmethod
    def survey_columns(cls, survey: Survey) -> tuple[str, ...]:
        """Return the columns that LaserScan messages require.

        Returns no columns unless the survey has 2D scanners and keeps all returns.
        """
        has_scans = survey.keep_every == 1 and laser_scan.has_planar_sensors(survey)
        return laser_scan.COLUMNS if has_scans else ()

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return a note if there are 2D scanners without LaserScan messages."""
        note = "bags contain LaserScan messages of 2D scanners only if every return is kept. Set "
        note += "`cloud.keep_every: 1`"
        return [note] if survey.keep_every > 1 and laser_scan.has_planar_sensors(survey) else []

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open a topic with PointCloud2 or Livox CustomMsg messages in a bag."""
        return _BagRecording(ref)


class MCAP(Rosbag2):
    """A single MCAP file with the messages of a bag."""

    title = "MCAP"
    file_pattern = ""
    job_path = "bags/{name}.mcap"

    def write(self, path: Path, spec: FormatOptions) -> None:
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
        """Read points with channel, intensity and, if classes have names, class.

        The range and resolution of intensities depend on the layout.
        """
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
    """Return the QoS profile that delivers one-time messages to late subscribers."""
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
    from lidarsim.columns.closing_bag import ClosingBag

    # AnyReader would parse the message definitions, which takes longer than reading a sweep.
    bag = ClosingBag(job.local(file))
    bag.open()
    job.opened.callback(bag.close)
    return bag


def _point_cloud(job: JobReader, sweep: int, file: str) -> Any:
    """Return the PointCloud2 of a sweep, or raise ValueError if the bag does not contain it."""
    from .messages import sweep_topic

    bag = job.get_or_compute("bag", lambda: _open_job(job, file))
    topic = sweep_topic(job.sweeps, sweep)
    connections = [opened for opened in bag.connections if opened.topic == topic]
    time_ns = survey_start_ns(job.sweeps) + round(job.sweeps.begins_ns[sweep])
    record = next(bag.messages(connections, time_ns, time_ns + 1), None)
    if record is None:  # rosbags 0.11.2 does not find some messages by time
        records = bag.messages(connections)
        record = next((candidate for candidate in records if candidate[1] == time_ns), None)
    if record is None:
        raise ValueError(f"it contains no message on {topic} at {time_ns} ns")
    connection, _, data = record
    return message_types().deserialize_cdr(data, connection.msgtype)


def _at_start(job: JobReader, sweep: int, points: Floats32, times: AnyArray) -> Floats32:
    """Transform points from their firing times to the sensor frame at the start of the sweep.

    `times` contains the times of the points in the layout of the job.
    """
    sweeps = job.sweeps
    since_ns = LAYOUTS[job.layout].since_ns(times, message_stamp_ns(sweeps, sweep))
    stamps = np.rint(since_ns + sweeps.stamp_ns(sweep)).astype(np.int64)
    scans = np.full(len(points), sweeps.scans[sweep])
    sensor_cloud = Cloud(points, {"scan": scans, "time": stamps})
    fired_in_sensor = replace(sweeps, coordinates="sensor")
    return fired_in_sensor.compensate_motion(sweep, sensor_cloud).astype(np.float32)


def point_connection(ref: RecordingRef, bag: Any) -> Any:
    """Return the connection of a bag whose messages are the sweeps of a recording.

    A topic with Livox CustomMsg messages is selected if the user chose it, or if the bag has no
    PointCloud2 messages. Raises LidarError if the user must choose a topic.
    """
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
    topics = livox_clouds if ref.sensor in livox_clouds else clouds or livox_clouds
    chosen = topics[ref.choose("PointCloud2 topics", topics)]
    return chosen._replace(owner=None)  # the bag that contains the connection cannot be pickled


class _BagRecording(SequentialRecording):
    """A topic of a bag. Each message is a sweep in the frame of its header."""

    def __init__(self, ref: RecordingRef) -> None:
        self._path = ref.path
        self._bags = PerProcess(partial(open_bag, ref.path, ref.name))
        self._connection = connection = point_connection(ref, self._bags())
        with reading(ref.name):
            # The timestamp is zero if the recording program did not set it.
            first = islice(self.stored_sweeps(), 2)
            self._is_stamped = any(header_of(data).stamp_ns for _, _, data in first)
        custom_data = _custom_data(ref.path)
        unstamped = () if self._is_stamped or not connection.msgcount else (_UNSTAMPED,)
        info = ref.info(
            sensor=connection.topic,
            compensated=states_compensation(custom_data),
            energy_unit=_energy_unit(custom_data, connection, ref.intensity),
            notes=ref.prefix_notes((*unstamped, *_split_notes(ref.path))),
        )
        super().__init__(info, connection.msgcount)
        self._pose_notes: tuple[str, ...] = ()  # found while the poses were read

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.info.notes, *self._pose_notes)

    def stored_sweeps(self) -> Iterator[Any]:
        return self._bags().messages([self._connection])

    def convert(self, stored: Any) -> Sweep:
        _, recorded_ns, data = stored
        stamp_ns = header_of(data).stamp_ns if self._is_stamped else recorded_ns
        is_livox = self._connection.msgtype in LIVOX_CLOUDS
        columns = livox_columns(data) if is_livox else point_columns(data)
        return sweep_from_columns(columns, time_ns=stamp_ns)

    def _headers(self) -> list[MessageHeader]:
        with self.lock:
            headers = []
            for _, recorded_ns, data in self.stored_sweeps():
                header = header_of(data)
                headers.append(
                    header if self._is_stamped else header._replace(stamp_ns=recorded_ns)
                )
            return headers

    def load_stamps(self) -> list[int]:
        return [header.stamp_ns for header in self._headers()]

    def load_poses(self) -> Floats | None:
        poses, clauses = _sweep_poses(self._path, self._headers())
        self._pose_notes = tuple(f"{self.info.name} {clause}" for clause in clauses)
        return poses

    def load_classes(self) -> dict[int, str]:
        with self.lock:
            return _class_names(self._bags())

    def load_boxes(self) -> RecordedBoxes | None:
        with self.lock:
            return _boxes(self._bags(), self._headers(), self._stored_poses)


def _split_notes(path: Path) -> tuple[str, ...]:
    """Return a note, without the name of the bag, if a path is one of several files of a bag."""
    if path.is_dir():
        return ()
    stated = read_metadata(path).get("rosbag2", {}).get("serialized_metadata", "")
    beside = path.with_name("metadata.yaml")
    texts = [stated, read_input_text(beside, errors="replace") if beside.exists() else ""]
    for text in texts:
        try:
            found = yaml.safe_load(text)
        except yaml.YAMLError:
            continue
        found = found if isinstance(found, dict) else {}
        metadata = found.get("rosbag2_bagfile_information", found)
        listed = metadata.get("relative_file_paths") if isinstance(metadata, dict) else None
        names = {Path(str(file)).name for file in listed} if isinstance(listed, list) else set()
        if len(names) > 1 and path.name in names:
            return (
                f"is one of {len(names)} files of a bag, so further sweeps, and possibly poses and "
                "class names, are missing. Specify the folder of the bag to read all files",
            )
    return ()


def _class_names(bag: Any) -> dict[int, str]:
    """Return the names of classes from the first message on `/label_info`, if there is one."""
    from .messages import message_store

    connections = [c for c in bag.connections if c.topic == _LABEL_TOPIC and c.msgtype == _LABELS]
    record = next(bag.messages(connections), None) if connections else None
    if record is None:
        return {}
    message: Any = message_store().deserialize_cdr(record[2], _LABELS)
    return {int(entry.class_id): str(entry.class_name) for entry in message.class_map}


def _boxes(
    bag: Any, headers: Sequence[MessageHeader], poses: Floats | None
) -> RecordedBoxes | None:
    """Return the boxes on the topic `/actors` at the timestamps of sweeps, or None without them.

    `poses` are the poses of the sweeps in the frame `map`.
    """
    from .messages import message_store

    connections = [c for c in bag.connections if c.topic == _BOX_TOPIC and c.msgtype == _BOXES]
    if not connections or poses is None:
        return None
    stamps_ns = np.array([header.stamp_ns for header in headers])
    rows = {}  # Bags of several sensors contain the boxes once for each of them.
    for _, _, data in bag.messages(connections):
        message: Any = message_store().deserialize_cdr(data, _BOXES)
        for marker in message.markers:
            stamp = marker.header.stamp
            differences_ns = np.abs(stamps_ns - (stamp.sec * 10**9 + stamp.nanosec))
            sweep = int(differences_ns.argmin())
            is_box = marker.action == _ADD and marker.header.frame_id == WORLD
            if not is_box or differences_ns[sweep] > _SAME_NS:
                continue
            place, turn = marker.pose.position, marker.pose.orientation
            rotation = recorded_rotation(
                (turn.x, turn.y, turn.z, turn.w), f"box {marker.id} on {_BOX_TOPIC}"
            )
            world = affine(rotation, np.array([place.x, place.y, place.z]))
            pose = np.linalg.inv(poses[sweep]) @ world
            size = marker.scale.x, marker.scale.y, marker.scale.z
            row = sweep, int(marker.id), actor_type(marker.text), pose, size
            rows[row[:2]] = row
    return RecordedBoxes.from_rows(rows.values()) if rows else None


def _custom_data(path: Path) -> str:
    """Return the text with the custom data of a bag.

    This does not use rosbags, which only reads custom data from folders.
    """
    if path.is_dir():
        text = read_input_text(path / "metadata.yaml", errors="replace")
    else:
        text = read_metadata(path).get("rosbag2", {}).get("serialized_metadata", "")
    return re.sub(r"[\s\\]+", " ", text)  # YAML breaks long lines


def _energy_unit(custom_data: str, connection: Any, intensity: str | None) -> float | None:
    """Return the intensity of a white surface at 10 m in a bag that lidarpool has simulated.

    Returns None for other bags and for messages whose intensities are not energies. `intensity` is
    the column that the user chose.
    """
    stated = re.search(rf"{_LAYOUT_KEY}: (\w+)", custom_data)
    layout = LAYOUTS.get(stated[1]) if stated else None
    is_described = connection.msgtype == POINT_CLOUD and intensity in (None, "intensity")
    if layout is None or not is_described or not layout.has_energies():
        return None
    return layout.full_intensity


class MessageHeader(NamedTuple):
    """Header of a ROS message."""

    stamp_ns: int  # time of the measurement, which can be long before the recording time
    frame: str


def header_of(data: bytes) -> MessageHeader:
    """Decode the header with which a serialized ROS 2 message starts."""
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
    frame = bytes(data[16 : 15 + length]).decode(errors="replace")
    return MessageHeader(seconds * 10**9 + nanoseconds, frame)


def _sweep_poses(
    path: Path, headers: Sequence[MessageHeader]
) -> tuple[Floats | None, tuple[str, ...]]:
    """Return the poses of sweeps relative to the root of the frame tree, and notes about them.

    Parameters
    ----------
    path
        Path of the bag.
    headers
        Message headers of the sweeps of one sensor.

    Returns
    -------
    Matrices of shape (n, 4, 4), or None if the bag does not contain poses for the times of all
    sweeps. The notes are clauses that follow the name of the bag.
    """
    frames = {header.frame.lstrip("/") for header in headers}
    if len(frames) != 1:
        return None, ()
    try:
        found = read_frame(path, frames.pop())
    except LidarError as error:
        return None, (f"has no usable poses: {str(error).removesuffix('.')}",)
    if found is None:
        return None, ()
    seconds, positions, quaternions, skipped = found
    clauses = (f"{skipped}. They are skipped",) if skipped else ()
    times_ns = 1e9 * (seconds - seconds[0])
    stamps_ns = np.array([header.stamp_ns for header in headers]) - 1e9 * seconds[0]
    within_ns = stamps_ns.clip(times_ns[0], times_ns[-1])
    beyond = np.flatnonzero(np.abs(stamps_ns - within_ns) > _MAX_DISTANCE_NS)
    if len(beyond):
        limit_s = _MAX_DISTANCE_NS / 1e9
        clause = f"has no pose within {limit_s:g} s of sweep {beyond[0]}, so its poses are not used"
        return None, (*clauses, clause)
    track = Track(seconds - seconds[0], positions, quaternions)
    poses = np.tile(np.eye(4), (len(headers), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = track.poses(0, within_ns)
    return poses, clauses

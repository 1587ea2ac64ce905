"""Views of recordings and of clouds from other programs. Their points are kept in memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.column_names import COLORS, with_standard_names
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import TABLE, Column, Kind, Scale
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import quaternions_of
from lidarsim.numerics.arrays import AnyArray, Floats
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps
from lidarsim.words import plural
from lidarview.viewer.point_selection import STATION, InMemoryPoints, Points, ScanOrderedPoints
from lidarview.viewer.view import DownloadFormats, LabeledObject, ProgressiveView, View

MAX_POINTS = 20_000_000  # maximum number of points of a recording in memory
LARGE_POINTS = 2_000_000  # A sample of a larger cloud is shown while the cloud is read.
_SAMPLE_POINTS = 200_000
# points that are shown while a cloud is read, in addition to the sample
_GROWING_POINTS = 1_000_000
# Callback for a part of a cloud and the fraction of the cloud that has been read.
OnPart = Callable[[Sweep, float], None]
_SWEEP_NS = 100_000_000  # assumed time between sweeps if the recording has no times
_GRAY = 188  # byte of an unknown color, which is 50 % of the light
# Class names of ASPRS LAS 1.4, indexed by class number.
ASPRS_CLASSES = (
    "never classified", "unassigned", "ground", "low vegetation", "medium vegetation",
    "high vegetation", "building", "low point", "", "water", "rail", "road surface", "",
    "wire guard", "wire conductor", "transmission tower", "wire connector", "bridge deck",
    "high noise",
)  # fmt: skip


def finite_points(sweep: Sweep) -> Sweep:
    """Return the points with finite coordinates and all columns with one number per point."""
    arrays = {name: np.asarray(values) for name, values in sweep.columns.items()}
    columns = {
        name: values
        for name, values in arrays.items()
        if values.shape == (len(sweep),) and values.dtype.kind in "biuf"
    }
    numbers = sweep.with_columns(**columns)
    finite = np.asarray(np.isfinite(sweep.points).all(axis=1))
    return numbers if finite.all() else numbers.select(finite)


def merge_sweeps(sweeps: Sequence[Sweep], **further: AnyArray) -> Cloud:
    """Merge sweeps into a cloud with the columns that all of them have.

    Columns that only contain zeros are omitted. Sweeps without points may lack columns. `further`
    are additional columns of all points.
    """
    if not sweeps:
        return Cloud(np.zeros((0, 3)), further)
    filled = [sweep for sweep in sweeps if len(sweep)] or sweeps
    shared = set.intersection(*({*sweep.columns} for sweep in filled))
    columns: dict[str, AnyArray] = {}
    for name in filled[0].columns:
        parts = [sweep.columns[name] for sweep in filled if name in shared]
        identifier = re.sub(r"\W", "_", name)
        identifier = identifier if identifier.isidentifier() else f"_{identifier}"
        is_new = identifier == name or identifier not in shared
        if is_new and identifier.lower() not in "xyz" and any(part.any() for part in parts):
            columns[identifier] = _native(name, np.concatenate(parts))
    # If the column with a standard name is omitted, the next column with an alias gets the name.
    columns = with_standard_names(columns) | further
    custom = tuple(_describe_column(name, array) for name, array in columns.items())
    return Cloud(np.concatenate([sweep.points for sweep in sweeps]), columns, custom)


def _native(name: str, values: AnyArray) -> AnyArray:
    """Convert values to native byte order, and colors and booleans to bytes."""
    if name in COLORS and values.dtype.kind == "f" and np.isnan(values).any():
        return np.nan_to_num(values, nan=_GRAY).astype(np.uint8)
    kind = np.dtype(np.uint8) if values.dtype == np.bool_ else values.dtype
    return values.astype(kind.newbyteorder("="), copy=False)


def _describe_column(name: str, values: AnyArray) -> Column:
    """Describe a column. The standard description is used if its type matches."""
    known = TABLE.get(name)
    if known is not None and np.dtype(known.dtype) == values.dtype:
        return known
    is_label = known is not None and known.kind == "label" and values.dtype.kind in "iu"
    scale: Scale = "linear" if known is None else known.scale
    kind: Kind = "label" if is_label else "number"
    return Column(name, values.dtype.name, "", "", kind=kind, scale=scale)


def recorded_view(
    sensors: Mapping[str, Recording | PointCloud],
    title: str,
    downloads: DownloadFormats | None,
    on_part: OnPart = lambda *_: None,
) -> View:
    """Return a view that plays back the sweeps of a recording's sensors.

    Parameters
    ----------
    sensors
        Recordings by sensor name.
    title
        Title of the view.
    downloads
        Formats for downloading points, or None.
    on_part
        Function that is called with each part of a cloud that was read.

    Raises
    ------
    LidarError
        If a recording is damaged or has no points.
    """
    first = next(iter(sensors.values()))
    further_notes: list[str] = []
    labeled: list[LabeledObject] = []
    if isinstance(first, PointCloud):
        cloud = _read_cloud(first, on_part)
        sweeps = None
    else:
        recordings = {k: one for k, one in sensors.items() if isinstance(one, Recording)}
        cloud, sweeps, further_notes = _read_sweeps(recordings)
        try:
            labeled = _labeled_objects([*recordings.values()], sweeps)
        except LidarError as error:
            further_notes.append(f"Labeled boxes are not shown. {error}")
    notes = [*dict.fromkeys(note for recording in sensors.values() for note in recording.notes)]
    notes += further_notes
    notes += [note for recording in sensors.values() for note in recording.omission_notes]
    if not len(cloud):
        left_out = "".join(f" {note}." for note in first.omission_notes)
        raise LidarError(f"{first.info.name} contains no points.{left_out}")
    names: dict[str, Sequence[str]] = {}
    if first.info.name.lower().endswith((".las", ".laz")):
        names["class"] = ASPRS_CLASSES
    if sweeps is not None and sweeps.station_numbers.any():
        names[STATION.name] = _station_names(first.info.stations, sweeps)
    return View(
        ScanOrderedPoints(cloud),
        None,
        sweeps,
        " ".join(notes),
        title,
        downloads=downloads,
        names=names,
        stated_epsg=first.info.epsg,
        labeled_objects=labeled,
    )


def _labeled_objects(sensors: Sequence[Recording], sweeps: Sweeps) -> list[LabeledObject]:
    """Return the labeled objects in the sweeps of sensors.

    An object that several sensors of a sequence observe is only returned once. Its name contains
    its number if it has boxes in several sweeps.
    """
    objects: dict[tuple[str, int], LabeledObject] = {}
    for sensor, recording in enumerate(sensors):
        boxes = recording.boxes
        if boxes is None:
            continue
        of_sensor = np.flatnonzero(sweeps.sensor == sensor)
        ends_ns = np.append(np.nextafter(sweeps.begins_ns[of_sensor[1:]], 0), np.inf)
        is_read = boxes.sweep < len(of_sensor)
        for number in np.unique(boxes.object[is_read]).tolist():
            rows = np.flatnonzero(is_read & (boxes.object == number))
            rows = rows[np.unique(boxes.sweep[rows], return_index=True)[1]]  # sorted by sweep
            shown = of_sensor[boxes.sweep[rows]]
            poses = boxes.poses[rows]
            if sweeps.coordinates == "world":
                poses = np.stack([sweeps.pose.matrix(index) for index in shown.tolist()]) @ poses
            times_ns = sweeps.begins_ns[shown]
            kind = boxes.kinds[int(rows[0])] or "object"
            labeled = LabeledObject(
                f"{kind} {number}" if len(rows) > 1 else kind,
                np.median(boxes.sizes[rows], axis=0),
                times_ns,
                poses[:, :3, 3],
                quaternions_of(poses[:, :3, :3]),
                (float(times_ns[0]), float(ends_ns[boxes.sweep[rows[-1]]])),
            )
            objects.setdefault((recording.info.sequence, number), labeled)
    return [*objects.values()]


def _station_names(stations: Sequence[str], sweeps: Sweeps) -> list[str]:
    """Return the station names, indexed by station number.

    Number 0 means that there is no station. Unnamed stations have empty names.
    """
    numbers = sweeps.station_numbers.tolist()
    names = [""] * (max(numbers) + 1)
    # Some stations may not have been read.
    for number, name in zip(numbers, stations, strict=False):
        names[number] = names[number] or name
    return names


def sampled_view(cloud: PointCloud, sample: Sweep, title: str) -> View:
    """Return a view of a sample of a cloud."""
    return View(
        InMemoryPoints(merge_sweeps([sample])),
        note=" ".join(cloud.notes),
        title=title,
        names={"class": ASPRS_CLASSES},
        stated_epsg=cloud.info.epsg,
    )


def growing_view(
    cloud: PointCloud, title: str, read: Callable[[OnPart], View]
) -> ProgressiveView | None:
    """Return a view that first shows a sample of a cloud. `read` adds further points.

    The sample consists of runs of consecutive points, which are read within a second. Returns None
    if the format of the cloud has no samples.
    """
    sampled = cloud.sample(_SAMPLE_POINTS)
    if sampled is None:
        return None
    sample = finite_points(sampled)
    total = cloud.info.point_count or 0
    parts = [sample]
    step = -(-total // _GROWING_POINTS)

    def grow(show: Callable[[Points, float], None]) -> View:
        def on_part(part: Sweep, share: float) -> None:
            parts.append(part.select(slice(None, None, step)))
            show(InMemoryPoints(merge_sweeps(parts)), share)

        return read(on_part)

    return ProgressiveView(sampled_view(cloud, sample, title), total, grow)


def _read_cloud(recording: PointCloud, on_part: OnPart) -> Cloud:
    """Read a cloud, or evenly spaced points of it if it is large."""
    total = recording.info.point_count or 0
    step = max(1, -(-total // MAX_POINTS))
    parts: list[Sweep] = []
    for number in range(len(recording)):
        part = finite_points(recording[number].select(slice(None, None, step)))
        parts.append(part.replace(points=np.asarray(part.points, np.float64)))
        on_part(parts[-1], (number + 1) / len(recording))
    return merge_sweeps(parts)


@dataclass(frozen=True, eq=False)
class _TimedSweep:
    """Time, sensor and number of a sweep that has not been read yet."""

    begins_ns: int
    sensor: int
    number: int


def _sort_sweeps(sensors: Sequence[Recording]) -> tuple[list[_TimedSweep], bool]:
    """Return the sweeps of all sensors, sorted by time, and whether their times are known."""
    sweeps: list[_TimedSweep] = []
    is_timed = True
    for sensor, recording in enumerate(sensors):
        stamps_ns = recording.stamps_ns
        times = _SWEEP_NS * np.arange(len(recording), dtype=np.int64)
        if stamps_ns is None or len(stamps_ns) < len(recording):
            is_timed = False
        else:
            times = stamps_ns
        sweeps += [
            _TimedSweep(int(times[number]), sensor, number) for number in range(len(recording))
        ]
    start_ns = min((sweep.begins_ns for sweep in sweeps), default=0)
    ordered = sorted(sweeps, key=lambda sweep: (sweep.begins_ns, sweep.sensor))
    return [
        _TimedSweep(sweep.begins_ns - start_ns, sweep.sensor, sweep.number) for sweep in ordered
    ], is_timed


def _read_sweeps(sensors: Mapping[str, Recording]) -> tuple[Cloud, Sweeps, list[str]]:
    """Read sweeps up to the point limit, and return the points, the sweeps and notes."""
    recordings = [*sensors.values()]
    ordered, is_timed = _sort_sweeps(recordings)
    posed = [PosedSweeps(recording) for recording in recordings]
    # Poses cannot be combined if a sensor has none.
    are_combined = all(sweeps.recorded_poses is not None for sweeps in posed)
    read: list[Sweep] = []
    poses: list[Floats | None] = []
    count = 0
    for timed in ordered:
        recording = recordings[timed.sensor]
        if are_combined or not recording.has_stored_poses:
            sweep = posed[timed.sensor].read(timed.number)
        else:
            sweep = recording[timed.number].returns()
        poses.append(sweep.pose)
        read.append(
            finite_points(sweep if sweep.pose is None else sweep.replace(points=sweep.in_world()))
        )
        count += len(read[-1])
        if count > MAX_POINTS:
            break
    notes = [f"{note}." for sweeps in posed for note in sweeps.notes]
    if len(poses) < len(ordered):
        notes.append(f"Only the first {len(poses):,} of {plural(len(ordered), 'sweep')} are shown.")
    are_stations = all(recording.info.stations for recording in recordings)
    if not is_timed and len(ordered) > 1 and not are_stations:
        notes.append("The recording contains no times. A rate of 10 sweeps per second is assumed.")
    counts = [len(sweep) for sweep in read]
    cloud = merge_sweeps(read, scan=np.repeat(np.arange(len(counts), dtype=np.int32), counts))
    sweeps = recorded_sweeps(ordered[: len(poses)], poses, [*sensors])
    return cloud, replace(sweeps, stations=len(sweeps) if are_stations else 1), notes


def recorded_sweeps(
    ordered: Sequence[_TimedSweep], poses: Sequence[Floats | None], names: Sequence[str]
) -> Sweeps:
    """Return sweeps without actors, each of which consists of a single scan.

    `names` are the names of the sensors.
    """
    known = [np.eye(4) if pose is None else pose for pose in poses]
    matrices = np.array(known, np.float64).reshape(-1, 4, 4)
    count = len(ordered)
    begins_ns = np.array([sweep.begins_ns for sweep in ordered], np.float64)
    still = SweepPoses(np.zeros((len(names), 3)), np.tile([0.0, 0, 0, 1], (len(names), 1)))
    return Sweeps(
        scans=np.arange(count + 1),
        begins_ns=begins_ns,
        ends_ns=begins_ns,
        sensor=np.array([sweep.sensor for sweep in ordered], np.uint8),
        pose=SweepPoses(matrices[:, :3, 3], quaternions_of(matrices[:, :3, :3])),
        mounts=still,
        sensors=tuple(names),
        objects=(),
        actors=(),
        actor_poses=SweepPoses(np.zeros((0, count, 3)), np.zeros((0, count, 4))),
        actor_velocities=np.zeros((0, count, 3)),
        actor_bounds=np.zeros((0, 2, 3)),
        actor_there=np.zeros((0, count), np.bool_),
        actor_comes=np.zeros((0, count), np.bool_),
        actor_leaves=np.zeros((0, count), np.bool_),
        coordinates="sensor" if any(pose is None for pose in poses) else "world",
        precision_m=0.001,
    )

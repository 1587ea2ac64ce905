"""Survey clouds in world coordinates, with the coordinate system and the unit that they state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.clouds.recording_ref import SeveralSensorsError
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.recordings.opening import open_recording
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.schema.vocabulary import UNITS_M

from ..compared_sweep import bounds_of, check_reach, origin_to_add, separation_m
from ..stated_frames import StatedFrame, check_same_systems

CloudSource = str | Path | Cloud | StoredCloud
UNKNOWN = -1  # index of an unknown scanner
SENSOR = "sensor_number"  # column that contains the index of the sensor
_MILLIONTH = 1e-6


@dataclass(frozen=True, eq=False)
class SurveyPoints:
    """Points in world coordinates, with the positions from which they were measured."""

    positions: Floats  # (n, 3), meters
    scanners: Floats  # (k, 3): positions of scan stations, or of the sensor at the start of sweeps
    scanner: Ints  # (n,): index of the scanner that measured each point, or `UNKNOWN`

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def has_scanners(self) -> bool:
        """Whether the scanner position of at least one point is known."""
        return bool(len(self.scanners))

    def relative_to(self, origin: Floats) -> SurveyPoints:
        """Return the points in coordinates relative to an origin, of shape (3,)."""
        return SurveyPoints(self.positions - origin, self.scanners - origin, self.scanner)

    def scanner_positions(self, rows: Ints | slice = slice(None)) -> Floats | None:
        """Return the scanner positions of some points, of shape (n, 3).

        Unknown positions are NaN. Returns None if all of them are unknown.
        """
        if not self.has_scanners:
            return None
        scanner = self.scanner[rows]
        return np.where((scanner == UNKNOWN)[:, None], np.nan, self.scanners[scanner])


@dataclass(frozen=True, eq=False)
class SurveyCloud:
    """A cloud in world coordinates, or the sweeps of all sensors of a survey."""

    name: str
    recordings: tuple[Recording | PointCloud, ...]  # one per sensor
    unit: str | None  # unit that the user chose
    show: WritingProgress = lambda *_: None  # called when a part has been read
    shift_m: Floats | None = None  # (3,): world origin that is added to all points, if any

    @classmethod
    def open(
        cls,
        source: CloudSource,
        name: str,
        *,
        sensor: str | None = None,
        unit: str | None = None,
        keep_noise: bool = False,
        show: WritingProgress = lambda *_: None,
    ) -> SurveyCloud:
        """Open a cloud, with all of its sensors unless one is chosen.

        `name` is used in messages if the source is a cloud in memory.

        Raises LidarError if the cloud cannot be read, or if its sensors have different world frames
        and none is chosen.
        """

        def opened(chosen: str | None) -> Recording | PointCloud:
            return open_recording(source, chosen, name=name, unit=unit, keep_noise=keep_noise)

        try:
            recordings = [opened(sensor)]
        except SeveralSensorsError as error:
            recordings = [opened(chosen) for chosen in error.names]
            if len({recording.info.sequence for recording in recordings}) > 1:
                raise
        return cls(recordings[0].info.name, tuple(recordings), unit, show)

    @property
    def notes(self) -> list[str]:
        """Notes of the recordings, including those about points that were omitted."""
        notes = [note for one in self.recordings for note in (*one.notes, *one.omission_notes)]
        notes += [note for sweeps in self._sweeps for note in sweeps.notes]
        return list(dict.fromkeys(notes))

    @cached_property
    def _sweeps(self) -> tuple[PosedSweeps, ...]:
        return tuple(PosedSweeps(recording) for recording in self.recordings)

    @property
    def point_count(self) -> int | None:
        """Number of points, or None if it is not known before the points are read."""
        counts = [recording.info.point_count for recording in self.recordings]
        return None if None in counts else sum(filter(None, counts))

    @cached_property
    def frame(self) -> StatedFrame:
        """Coordinate system and vertical datum that the file states."""
        return StatedFrame.from_recording(self.recordings[0], self.name)

    @property
    def world_origin(self) -> tuple[float, float, float] | None:
        """World origin in meters that is contained in the points, or None."""
        return self.recordings[0].info.world_origin

    @property
    def unit_name(self) -> str:
        """Name of the length unit of the file."""
        meters = self.recordings[0].info.meters[0]
        names = (name for name, unit_m in UNITS_M.items() if abs(unit_m / meters - 1) < _MILLIONTH)
        return next(names, f"units of {meters:.10g} m")

    def parts(self, *, with_ranges: bool = False) -> Iterator[Sweep]:
        """Yield all points in world coordinates, in parts of limited size.

        The column `SENSOR` contains the index of the sensor. If `with_ranges` is true and the
        distances from the sensor are known, the column `range` contains them.

        Raises LidarError if the cloud cannot be read, or if a pose is unknown.
        """
        total = sum(len(recording) for recording in self.recordings)
        unit = "parts" if isinstance(self.recordings[0], PointCloud) else "sweeps"
        done = 0
        for number, sweeps in enumerate(self._sweeps):
            for index in range(len(sweeps.recording)):
                done += 1
                self.show(f"reading {self.name}", done, total, unit)
                part = _world_points(sweeps, index, with_ranges=with_ranges)
                if len(part):
                    sensor = np.full(len(part), number, np.int64)
                    part = part.replace(columns={**part.columns, SENSOR: sensor})
                    yield part if self.shift_m is None else _shifted(part, self.shift_m)

    def sample(self, max_points: int) -> tuple[SurveyPoints, list[str]]:
        """Read points, sampled evenly if there are more than about `max_points`.

        Returns
        -------
        The points in world coordinates, and notes for the user.
        """
        count = self.point_count
        share = 1.0 if count is None else min(1.0, max_points / max(count, 1))
        chosen: list[Floats] = []
        scanners: list[Floats | None] = []
        kept = 0
        for part in self.parts():
            rows = even_indices(len(part), round(share * len(part)))
            chosen.append(part.points if share == 1 else part.points[rows])
            scanners.append(part.scanner)
            kept += len(chosen[-1])
            if kept > 1.5 * max_points:  # the number of points was unknown
                chosen = [points[::2] for points in chosen]
                share /= 2
                kept = sum(map(len, chosen))
        if not kept:
            omitted = "".join(f" {note}." for note in self.notes)
            raise LidarError(
                f"{self.name} contains no points, so there is nothing to compare.{omitted}"
            )
        note = f"{100 * share:.3g} % of the points in {self.name} are used, sampled evenly"
        known = np.array([scanner is not None for scanner in scanners])
        index = np.where(known, np.cumsum(known) - 1, UNKNOWN).astype(np.int32)
        points = SurveyPoints(
            np.concatenate(chosen),
            np.array([scanner for scanner in scanners if scanner is not None]).reshape(-1, 3),
            np.repeat(index, [len(points) for points in chosen]),
        )
        return points, [] if share == 1 else [note]


def _world_points(sweeps: PosedSweeps, number: int, *, with_ranges: bool) -> Sweep:
    """Return the returns of a sweep in world coordinates, with the position of its scanner."""
    recording = sweeps.recording
    info = recording.info
    # Points as fired are at their ranges from the sensor. They are read only if required, because
    # they are transformed with a pose each.
    sweep = sweeps.read(number, as_fired=with_ranges)
    check_reach(recording, sweep)
    scanner = sweep.scanner
    if scanner is not None:
        scanner = np.asarray(scanner, np.float64) * info.meters
    if isinstance(recording, PointCloud):
        return sweep.replace(scanner=scanner)
    if sweep.pose is None:
        raise LidarError(
            f"{info.name} is in sensor coordinates and does not contain the pose of the sensor, so "
            "its points cannot be compared in world coordinates."
        )
    # Files of scans without a pose are read with an identity matrix.
    is_known = recording.has_stored_poses or not np.array_equal(sweep.pose, np.eye(4))
    if scanner is None and is_known:
        scanner = sweep.pose[:3, 3]
    columns = sweep.columns
    if with_ranges and "range" not in columns:
        columns = {**columns, "range": np.linalg.norm(sweep.points, axis=1)}
    return sweep.replace(points=sweep.in_world(), columns=columns, scanner=scanner)


def _shifted(part: Sweep, shift_m: Floats) -> Sweep:
    scanner = None if part.scanner is None else part.scanner + shift_m
    return part.replace(points=part.points + shift_m, scanner=scanner)


def add_world_origin(clouds: Sequence[SurveyCloud]) -> tuple[list[SurveyCloud], list[str]]:
    """Transform clouds in the local coordinates of a scene, if another one is in world coordinates.

    Returns the clouds, and notes that name the origin.
    """
    placed = next((cloud for cloud in clouds if cloud.world_origin is not None), None)
    found, notes = [], []
    for cloud in clouds:
        moved = cloud
        if placed is not None and cloud.world_origin is None:
            first_parts = [next(one.parts(), None) for one in (placed, cloud)]
            bounds = [bounds_of(part.points) for part in first_parts if part is not None]
            shift = origin_to_add((placed.world_origin, None), bounds) if len(bounds) > 1 else None
            if shift is not None:
                moved = replace(cloud, shift_m=shift.origin)
                notes.append(shift.note((placed.name, cloud.name)))
        found.append(moved)
    return found, notes


def check_same_frame(clouds: Sequence[SurveyCloud]) -> list[str]:
    """Raise LidarError if clouds state different coordinate systems or units.

    Returns notes about clouds that do not specify a coordinate system although others do.
    """
    notes = check_same_systems([cloud.frame for cloud in clouds])
    first, *others = clouds
    for other in others:
        if first.unit_name != other.unit_name and not (first.unit or other.unit):
            raise LidarError(
                f"{first.name} has the unit {first.unit_name}, but {other.name} has "
                f"{other.unit_name}. Convert one of them first, or state the units with "
                "`--unit-a` and `--unit-b` if their origins and axes are the same."
            )
    return notes


def check_overlap(a: Floats, b: Floats, names: tuple[str, str], margin_m: float) -> None:
    """Raise LidarError if the extents of two clouds are farther apart than a margin in meters."""
    gap = separation_m(bounds_of(a), bounds_of(b))
    if gap > margin_m:
        raise LidarError(
            f"The extents of {names[0]} and {names[1]} are {gap:,.3f} m apart, so there is nothing "
            "to compare. Check their coordinate systems, or increase the maximum distance."
        )

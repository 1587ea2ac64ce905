"""Sweeps of a recording, with the columns that are required for a reconstruction.

Worker processes read them, too. `RecordedSweeps.read` describes the columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.point_times import PointTimes
from lidarfiles.clouds.recording import Recording, RecordingSection
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.rings import MIN_RINGS, Rings, elevations, summarize_rings
from lidarfiles.recordings.opening import open_recording, with_sweeps
from lidarsim.columns.column_names import STRENGTHS, TIMES
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Bools, Floats
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import plural

from ..comparing.lidar4d import WINDOWS, Window
from ..scan_patterns.lasers import RingLasers
from .isolated_returns import NO_RANGES, IsolatedRanges
from .labels import labels_of
from .vehicle_returns import VehicleReturns

_COLUMNS = {"channel", "class", "object", *STRENGTHS, *TIMES}  # columns that are used
_GAP_RAD = np.radians(0.5)  # angle between rays over many sweeps, for sensors without rings
_REFERENCE_SWEEPS = 5  # sweeps from which the rotation is determined
_ISOLATED_SWEEPS = 12  # sweeps in which isolated returns are counted
_MAX_START_RAD = np.radians(12)  # maximum angle between the first pulses of rings
_MIN_AGREEMENT = 0.9  # minimum resultant length of azimuths minus a uniform rotation


def _select_window(recording: Recording, window: Window) -> Recording:
    """Return the sweeps of a window.

    Raise LidarError if the recording has neither all frames up to the last one of the window, nor
    only those of the window.
    """
    if len(recording) == window.count:
        return recording
    if len(recording) <= window.last:
        raise LidarError(
            f"{recording.info.name} has {plural(len(recording), 'sweep')}, but the window consists "
            f"of the frames {window.first:,} to {window.last:,}. Use the folder with all frames, "
            "or one with only the frames of the window."
        )
    return RecordingSection(recording, window.first, window.count)


class Rotation(NamedTuple):
    """Direction and start azimuth of a sensor's rotation."""

    is_clockwise: bool
    start_deg: float  # azimuth at the start of a sweep, 0 to 360


@dataclass(frozen=True, eq=False)
class RecordedSweeps:
    """Sweeps of a recording. Only one sweep is read at a time.

    Rings, times and timestamps are stored here, so that other processes do not have to determine
    them again.

    Attributes
    ----------
    recording
        The recording. If it was opened from a file, each process opens the file once.
    rings
        Rings of the sensor, which are empty for a sensor without rings.
    point_times
        Unit and clock of the point times, or None if the points have no times.
    stamps_s
        Timestamps of the sweeps in seconds, float64 of shape (s,), or None if there are none.
    lasers
        Positions and directions of the lasers of the rings.
    vehicle
        Returns from the vehicle that carries the sensor, which are omitted. None if they have not
        been determined.
    isolated
        Range interval in which isolated returns probably come from the air.
    ref
        Reference to the file of the recording, or None for a recording in memory.
    window
        First frame of the window of LiDAR4D that was selected, or None.
    """

    recording: Recording
    rings: Rings
    point_times: PointTimes | None
    stamps_s: Floats | None
    lasers: RingLasers
    vehicle: VehicleReturns | None = None
    isolated: IsolatedRanges = NO_RANGES
    ref: RecordingRef | None = None
    window: int | None = None
    _kept: dict[int, Sweep] = field(default_factory=dict)
    _air: Mapping[int, Bools] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        path: Path,
        sensor: str | None = None,
        intensity: str | None = None,
        window: int | None = None,
    ) -> RecordedSweeps:
        """Open a recording, or only the frames of a window of LiDAR4D.

        Raises
        ------
        LidarError
            If the recording cannot be read, or if it does not contain the window.
        """
        recording = with_sweeps(open_recording(path, sensor, intensity))
        if window is not None:
            recording = _select_window(recording, WINDOWS[window])
        ref = RecordingRef(path, sensor, intensity)
        return replace(cls.from_recording(recording), ref=ref, window=window)

    @classmethod
    def from_recording(cls, recording: Recording) -> RecordedSweeps:
        """Determine the rings and times of a recording.

        Raises
        ------
        LidarError
            If the recording has no sweeps or no points.
        """
        rings = with_sweeps(recording).rings
        if not len(rings) and not rings.note and not _has_points(recording):
            raise LidarError(
                f"{recording.info.name} contains no points, so there is nothing to reconstruct."
            )
        lasers = _lasers(recording, rings)
        return cls(recording, rings, recording.point_times, _stamps_s(recording), lasers)

    @property
    def notes(self) -> list[str]:
        """Notes for the user about information that is missing from the recording."""
        notes = [self.rings.note]
        if self.point_times is not None and self.stamps_s is not None and not self.is_compensated:
            notes.append(self.point_times.clock_note(self.recording.info.name))
        return [note for note in notes if note]

    @property
    def count(self) -> int:
        """Number of sweeps."""
        return len(self.recording)

    @property
    def elevation_rad(self) -> Floats:
        """Elevation of the beam of each ring in radians, from the highest ring to the lowest.

        The array has shape (r,).
        """
        return self.lasers.elevation_rad

    @property
    def ring_count(self) -> int:
        """Number of rings, or 1 for a sensor without rings."""
        return max(len(self.rings), 1)

    @property
    def gap_rad(self) -> float:
        """Median angle between neighboring rings, in radians."""
        if len(self.rings) < MIN_RINGS:
            return _GAP_RAD
        return float(np.median(-np.diff(self.elevation_rad)))

    @property
    def is_compensated(self) -> bool | None:
        """Whether the points are motion-compensated. None if the recording does not state it.

        Results of stationary sensors count as compensated.
        """
        info = self.recording.info
        if info.has_firing_poses and info.compensated is None:
            return True
        return info.compensated

    def with_cached(self, numbers: Iterable[int]) -> RecordedSweeps:
        """Return a copy that keeps some sweeps in memory.

        `numbers` are in ascending order, because bags can only be read from their start.
        """
        return replace(self, _kept={number: _compact(self.read_all(number)) for number in numbers})

    def with_isolated_ranges(self) -> RecordedSweeps:
        """Return a copy with the range interval in which most returns are isolated.

        Nothing is found if the sensor has no rings.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        if len(self.rings) < MIN_RINGS:
            return self
        numbers = even_indices(self.count, _ISOLATED_SWEEPS).tolist()
        sweeps = (self.read(number) for number in numbers)
        return replace(self, isolated=IsolatedRanges.from_sweeps(sweeps))

    def without_air(self, air: Mapping[int, Bools]) -> RecordedSweeps:
        """Return a copy in which `read` omits returns from the air.

        `air` has masks of these returns by sweep number. The masks have shape (n,).
        """
        return replace(self, _air=air)

    def read_surfaces(self, number: int) -> Sweep:
        """Read the returns that are used to estimate poses, as `read` does.

        Returns that probably come from the air are omitted, since they move with the sensor.
        """
        return self.isolated.without_isolated(self.read(number))

    def read(self, number: int) -> Sweep:
        """Read the returns of a sweep that come from surfaces, with the columns of `read_all`.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        sweep = self.read_all(number)
        air = self._air.get(number)
        return sweep if air is None else sweep.select(~air)

    def read_all(self, number: int) -> Sweep:
        """Read the returns of a sweep whose rings can be determined, except those of the vehicle.

        The sweep has the following columns. All except `row` are omitted if they are unknown, and
        `time_s` and `start_rad` are also omitted if the points are stated to be
        motion-compensated.

        - `row`: index of the ring in `rings`, or 0 for a sensor without rings.
        - `intensity`: on the scale of the recording.
        - `label`: see `labels_of`.
        - `time_s`: time relative to the timestamp of the sweep, which may be that of its last
          point.
        - `fired_s`: the same time, only if the points are stated to be motion-compensated.
        - `start_rad`: azimuth at which the ring of the point starts.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        sweep = _wide(self._kept[number]) if number in self._kept else self._read(number)
        if not len(self.rings) or self.is_compensated:
            return sweep
        starts_rad = ring_starts(sweep, self.ring_count)
        return sweep.with_columns(**sweep.columns, start_rad=starts_rad[sweep.columns["row"]])

    def _read(self, number: int) -> Sweep:
        returns = self._returns(number)
        row = self.rings.ring_indices(returns)
        intensity = returns.intensity
        times_s = self._times_s(number, returns)
        sweep = Sweep(returns.points).with_columns(
            row=row.clip(min=0),
            intensity=None if intensity is None else np.asarray(intensity, np.float64),
            label=labels_of(returns),
            time_s=None if self.is_compensated else times_s,
            fired_s=times_s if self.is_compensated else None,
        )
        known = row >= 0 if len(self.rings) else np.ones(len(row), bool)
        if self.vehicle is not None and self.vehicle.are_found:
            known &= ~self.vehicle.contain(sweep)
        return sweep if known.all() else sweep.select(known)

    def _returns(self, number: int) -> Sweep:
        sweep = self.recording[number]
        used = {name: values for name, values in sweep.columns.items() if name in _COLUMNS}
        return sweep.with_columns(**used).returns()

    def _times_s(self, number: int, returns: Sweep) -> Floats | None:
        """Return the time of each point relative to its sweep's timestamp, or None if unknown."""
        if self.point_times is None:
            return None
        stamp_s = None if self.stamps_s is None else float(self.stamps_s[number])
        if len(returns) and not returns.columns:
            return None  # `of_points` cannot count the points
        return self.point_times.relative_times(returns.columns, stamp_s)

    def rotation(self, period_s: float, first_s: float) -> Rotation | None:
        """Determine the sensor's rotation from the times and azimuths of points, if possible.

        A revolution takes `period_s` and starts at `first_s` relative to the timestamp. The start
        azimuth is a mean over rings and sweeps. Motion compensation hardly affects it, because it
        shifts azimuths to the left and to the right.
        """
        sums = np.zeros(2, complex)
        count = 0
        for number in even_indices(self.count, _REFERENCE_SWEEPS).tolist():
            returns = self._returns(number)
            times_s = self._times_s(number, returns)
            if times_s is None or not len(returns):
                continue
            azimuth = np.arctan2(returns.points[:, 1], returns.points[:, 0])
            rotation_rad = 2 * np.pi * (times_s - first_s) / period_s
            sums += [np.exp(1j * (azimuth - sign * rotation_rad)).sum() for sign in (1, -1)]
            count += len(returns)
        best = int(np.abs(sums).argmax())
        if np.abs(sums[best]) <= _MIN_AGREEMENT * count:
            return None
        return Rotation(best == 1, float(np.degrees(np.angle(sums[best])) % 360))

    def starts(self, *, is_clockwise: bool) -> Rotation:
        """Determine the sensor's rotation from its direction and the azimuths where rings start."""
        numbers = even_indices(self.count, _REFERENCE_SWEEPS).tolist()
        starts_rad = [ring_starts(self.read(number), self.ring_count) for number in numbers]
        mean = float(np.angle(np.exp(1j * np.stack(starts_rad)).sum()))
        return Rotation(is_clockwise, float(np.degrees(mean) % 360))

    def cone_spread_rad(self, number: int) -> float:
        """Return the deviation of the rings from cones in radians, or inf for an empty sweep."""
        sweep = self.read(number)
        if not len(sweep):
            return float("inf")
        return summarize_rings(sweep.columns["row"], elevations(sweep.points))[2]


def ring_starts(sweep: Sweep, ring_count: int) -> Floats:
    """Return the azimuth at which each ring of a sweep starts, in radians.

    The points are in the order of the recording, so a ring starts at its first point. In some
    sensors, the azimuths of the lasers differ by several degrees. If the first pulses of a ring
    have no return, for example in the sky, the start of most rings is used.
    """
    if not len(sweep):
        return np.zeros(ring_count)
    row = sweep.columns["row"]
    firsts = np.full(ring_count, -1)
    firsts[row[::-1]] = np.arange(len(row))[::-1]  # the last assignment remains
    present = np.flatnonzero(firsts >= 0)
    points = sweep.points[firsts[present]]
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    apart = np.abs((azimuth[:, None] - azimuth + np.pi) % (2 * np.pi) - np.pi)
    together = apart < _MAX_START_RAD
    common = int(together.sum(axis=1).argmax())
    starts = np.full(ring_count, azimuth[common])
    starts[present[together[common]]] = azimuth[together[common]]
    return starts


def _compact(sweep: Sweep) -> Sweep:
    """Convert a sweep to a form that requires half as much memory."""
    columns = {name: values for name, values in sweep.columns.items() if name != "start_rad"}
    columns["row"] = columns["row"].astype(np.int16)
    if "intensity" in columns:
        columns["intensity"] = _exact32(columns["intensity"])
    return Sweep(_exact32(sweep.points), columns)


def _wide(sweep: Sweep) -> Sweep:
    columns = {**sweep.columns, "row": sweep.columns["row"].astype(np.int64)}
    if "intensity" in columns:
        columns["intensity"] = columns["intensity"].astype(np.float64)
    return Sweep(sweep.points.astype(np.float64), columns)


def _exact32(values: AnyArray) -> AnyArray:
    single = values.astype(np.float32)
    return single if np.array_equal(single, values, equal_nan=True) else values


def _lasers(recording: Recording, rings: Rings) -> RingLasers:
    """Determine the lasers of the rings from a few sweeps, without motion compensation."""
    if not len(rings):
        return RingLasers.at_origin(rings.elevation_rad)
    numbers = even_indices(len(recording), _REFERENCE_SWEEPS).tolist()
    sweeps = [recording.fired(number) for number in numbers]
    used = [(sweep.points, rings.ring_indices(sweep)) for sweep in sweeps if len(sweep)]
    lasers = RingLasers.from_sweeps(used, rings.elevation_rad)
    if not recording.info.has_firing_poses or recording.info.compensated is False:
        return lasers
    # The sweeps to reconstruct are motion-compensated, unlike the ones that were used.
    return replace(lasers, spread_rad=float("inf"))


def _has_points(recording: Recording) -> bool:
    numbers = even_indices(len(recording), _REFERENCE_SWEEPS).tolist()
    return any(len(recording.fired(number)) for number in numbers)


def _stamps_s(recording: Recording) -> Floats | None:
    """Return the timestamps of all sweeps in seconds, or None if the recording has none."""
    if recording.stamps_ns is None:
        return None
    stamps_s = np.asarray(1e-9 * recording.stamps_ns, np.float64)
    if len(stamps_s) != len(recording):
        raise LidarError(
            f"{recording.info.name} has {plural(len(recording), 'sweep')}, but only "
            f"{len(stamps_s):,} can be read. Repair the file, or record it again."
        )
    backward = np.flatnonzero(np.diff(stamps_s) <= 0)
    if len(backward):
        number = int(backward[0])
        raise LidarError(
            f"The timestamps of {recording.info.name} do not increase: sweep {number:,} is at "
            f"{stamps_s[number]:.6f} s, and sweep {number + 1:,} is at "
            f"{stamps_s[number + 1]:.6f} s. Remove repeated sweeps, and sort the others by "
            "timestamp."
        )
    return stamps_s

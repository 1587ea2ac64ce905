"""Scan angles, scan lines and flight lines of airborne surveys, as defined by LAS 1.4 (R15)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.motion.straight_lines import StraightLines
from lidarsim.numerics.arrays import Bools, Bytes, Floats, Indices, Ints
from lidarsim.sensor.sensor import LineSensor, Sensor
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import MIXED_UP, Sweeps

_MAX_SOURCE = 65_535  # largest point source ID in the format
_MAX_SCANNERS = 4  # number of scanner channels in the format
_MIN_STEP_M = 1e-6  # distance in 2 ms, or in a sweep, above which a platform is moving
_SAMPLE_S = 0.05  # interval at which trajectories are sampled to find flight lines
_MAX_SAMPLES = 200_000
_LINES = 1 << 40  # number of line numbers that are reserved for each station


def flight_lines(survey: Survey) -> StraightLines | None:
    """Return the flight lines of an airborne survey, or None if there are none."""
    airborne = any(isinstance(mounted.sensor, LineSensor) for mounted in survey.mounted_sensors)
    if not (airborne and survey.path.moves):
        return None
    count = int(min(survey.duration_ns / 1e9 / _SAMPLE_S, _MAX_SAMPLES)) + 2
    times_ns = np.linspace(0.0, survey.duration_ns, count)
    positions, _ = survey.path.poses(0, times_ns)
    lines = StraightLines.from_trajectory(times_ns / 1e9, positions)
    return lines if len(lines.starts_s) else None


def summarize_flight_lines(survey: Survey) -> dict[str, float] | None:
    """Summarize the flight lines on which at least one scanner fires.

    Returns
    -------
    ``count`` is the number of lines. ``seconds`` and ``length_m`` are the total duration and length
    of the parts of these lines on which a scanner fires.
    """
    lines = flight_lines(survey)
    if lines is None:
        return None
    spans = [
        firing_span_s(mounted.sensor, steps)
        for mounted, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True)
        if isinstance(mounted.sensor, LineSensor)
    ]
    scanned = lines.seconds_within(spans)
    if not scanned.any():
        return None
    return {
        "count": int(np.count_nonzero(scanned)),
        "seconds": float(scanned.sum()),
        "length_m": float((lines.lengths_m * scanned / (lines.stops_s - lines.starts_s)).sum()),
    }


def firing_span_s(sensor: Sensor, steps: int) -> tuple[float, float]:
    """Return the times in seconds at which a sensor starts and stops firing in a survey.

    `steps` is the number of steps in the survey.
    """
    _, firings = sensor.firings(steps - 1)
    return sensor.start_ns / 1e9, sensor.begins_ns(np.array([firings])).item() / 1e9


@dataclass(frozen=True, eq=False)
class LineFields:
    """LAS fields of k points that describe their scan lines and flight lines."""

    # (k,): degrees from straight down, about the direction of flight, negative to the left.
    scan_angle_deg: Floats
    direction: Bytes  # (k,): 1 while the mirror moves from left to right, otherwise 0
    edge: Bools  # (k,): True if the pulse is the last pulse in its scan line that has a return
    # (k,): number of the flight line or station and of the sensor, from 1. 0 if it is too large.
    source: Ints
    line: Ints  # (k,): scan line number, unique in the survey, or -1 if there is no mirror
    scanner: Bytes  # (k,): number of the scanner on the platform, from 0. 0 if it is too large.

    @classmethod
    def empty(cls, count: int) -> LineFields:
        """Create default values for points from an unknown survey."""
        return cls(
            np.zeros(count),
            np.zeros(count, np.uint8),
            np.zeros(count, np.bool_),
            np.zeros(count, np.int64),
            np.full(count, -1, np.int64),
            np.zeros(count, np.uint8),
        )


class FlightLines:
    """Calculation of the `LineFields` of a survey's points.

    The direction of flight is the direction in which the sensor moves, or the x axis of a static
    sensor. Point sources are numbered by flight line or station. If there are several sensors, they
    are also numbered by sensor.
    """

    def __init__(self, sweeps: Sweeps) -> None:
        self.sweeps = sweeps

    def with_fields(self, chunks: Iterable[Cloud]) -> Iterator[tuple[Cloud, LineFields]]:
        """Yield each chunk of points with its fields.

        In points that are not sorted by scan, no point is marked as the edge of a scan line.

        Raises
        ------
        LidarError
            If the points do not belong to the survey.
        """
        held: tuple[Cloud, LineFields] | None = None
        for chunk in chunks:
            if not len(chunk):
                continue
            fields = self._fields(chunk)
            if held is not None:
                _, held_fields = held
                if held_fields.line[-1] == fields.line[0]:  # the line continues in this chunk
                    held_fields.edge[held_fields.line == held_fields.line[-1]] = False
                yield held
            held = chunk, fields
        if held is not None:
            yield held

    def _fields(self, chunk: Cloud) -> LineFields:
        """Return the fields of a chunk whose last scan line is complete."""
        fields = LineFields.empty(len(chunk))
        if not len(self.sweeps) or "scan" not in chunk.columns:
            return fields
        sweep = np.searchsorted(self.sweeps.scans, chunk["scan"], "right") - 1
        if sweep.max() >= len(self.sweeps):
            raise LidarError(MIXED_UP)
        order = np.argsort(sweep, kind="stable")
        for rows in np.split(order, 1 + np.flatnonzero(np.diff(sweep[order]))):
            self._fill(fields, rows, int(sweep[rows[0]]), chunk[rows])
        line = fields.line
        if (np.diff(sweep) < 0).any():
            return fields
        # Find the last point in each line. Points with the same time, or without times, with the
        # same ray, belong to the same pulse.
        last_rows = np.append(np.flatnonzero(np.diff(line)), len(line) - 1)
        last = last_rows[np.searchsorted(last_rows, np.arange(len(line)))]
        pulse = next((chunk[name] for name in ("time", "ray") if name in chunk.columns), None)
        same_pulse = np.arange(len(line)) == last if pulse is None else pulse == pulse[last]
        fields.edge[:] = (line >= 0) & same_pulse
        return fields

    def _fill(self, fields: LineFields, row_indices: Indices, sweep: int, points: Cloud) -> None:
        """Set all fields except `edge` for the points of a sweep."""
        sweeps = self.sweeps
        poses = sweeps.firing_poses(sweep, points)
        # Positions are rounded as in files, because those in parts and in cloud.ply differ in the
        # digits beyond the precision.
        exact = np.rint(points.positions.astype(np.float64) / sweeps.precision_m)
        exact *= sweeps.precision_m
        in_world = poses.to_world(exact) if sweeps.coordinates == "sensor" else exact
        steps = np.zeros((3, 1)) if poses.steps is None else poses.steps
        ahead = _level(steps.T, sweeps.pose.rotations[sweep][:, 0])
        rays = in_world - poses.positions
        to_right = rays[:, 0] * ahead[:, 1] - rays[:, 1] * ahead[:, 0]
        fields.scan_angle_deg[row_indices] = np.degrees(np.arctan2(to_right, -rays[:, 2]))
        source = self._sources[sweep]
        fields.source[row_indices] = source if source <= _MAX_SOURCE else 0
        sensor = int(sweeps.sensor[sweep])
        fields.scanner[row_indices] = self._scanners[sensor]
        mirror = sweeps.lidars[sensor].lines if sweeps.lidars else None
        if mirror is None:
            return
        station = int(self._stations[sweep])
        begin_ns = sweeps.begins_ns[sweep] - station * sweeps.station_ns
        line = mirror.numbers(begin_ns + sweeps.since_ns(sweep, points))
        # A sensor that points backward sees the mirror move in the opposite direction.
        against = sweeps.pose.rotations[sweep][:, 0] @ self._directions[sweep] < 0
        fields.direction[row_indices] = mirror.runs_leftward(line) == int(against)
        fields.line[row_indices] = (sensor * sweeps.stations + station) * _LINES + line

    @cached_property
    def _scanners(self) -> Bytes:
        """Scanner of each sensor, starting at 0.

        Sensors with the same mount are the same scanner, for example if each flight line has its
        own entry. If there are more scanners than the format supports, all are 0.
        """
        mounts = self.sweeps.mounts
        rows = np.concatenate([mounts.positions, mounts.quaternions], axis=1).round(6) + 0.0
        numbers: dict[bytes, int] = {}
        scanners = [numbers.setdefault(row.tobytes(), len(numbers)) for row in rows]
        return np.array(scanners if len(numbers) <= _MAX_SCANNERS else [0] * len(rows), np.uint8)

    @cached_property
    def _directions(self) -> Floats:
        """Direction of flight in each sweep, as horizontal unit vectors.

        The shape is (n, 3).
        """
        axes = self.sweeps.pose.rotations[:, :, 0]
        knots = self.sweeps.knots
        moved = knots[:, -1, :3].astype(np.float64) if len(knots) else np.zeros_like(axes)
        return _level(moved, axes)

    @cached_property
    def _stations(self) -> Ints:
        """Station of each sweep.

        The shape is (n,).
        """
        sweeps = self.sweeps
        per_station = np.bincount(sweeps.sensor) // sweeps.stations
        return sweeps.numbers // np.maximum(per_station[sweeps.sensor], 1)

    @cached_property
    def _sources(self) -> Ints:
        """Point source ID of each sweep, starting at 1.

        The shape is (n,).
        """
        sweeps = self.sweeps
        source = self._stations.copy()
        for sensor, lidar in enumerate(sweeps.lidars):
            rows = np.flatnonzero(sweeps.sensor == sensor)
            if lidar.lines is not None and len(sweeps.knots) and sweeps.stations == 1:
                begins_s = sweeps.begins_ns[rows] / 1e9
                lines = StraightLines.from_trajectory(begins_s, sweeps.pose.positions[rows])
                # Sweeps in a turn belong to the previous line.
                line = np.searchsorted(lines.starts_s, begins_s, "right") - 1
                source[rows] = np.maximum(line, 0)
        return source * max(len(sweeps.sensors), 1) + sweeps.sensor + 1


def _level(moves: Floats, axes: Floats) -> Floats:
    """Return horizontal unit vectors in the direction of movement.

    Parameters
    ----------
    moves
        Movements, with shape (k, 3).
    axes
        Directions to use for rows without a movement, with shape (k, 3) or (3,). Vertical axes are
        replaced by the x axis.
    """
    is_stationary = np.hypot(moves[:, 0], moves[:, 1]) < _MIN_STEP_M
    ahead = np.where(is_stationary[:, None], axes, moves) * (1.0, 1.0, 0.0)
    lengths = np.linalg.norm(ahead, axis=1)
    ahead[lengths < 1e-9] = (1.0, 0.0, 0.0)
    return np.asarray(ahead / np.where(lengths < 1e-9, 1.0, lengths)[:, None])

"""Simulate effects on the sweeps of a recording."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.recordings.opening import with_sweeps
from lidarsim.columns.column_names import TIMES
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Integers, Ints, to_writable
from lidarsim.pulses.returns import PulseReturns
from lidarsim.pulses.steps.step import RecordedPulses
from lidarsim.sensor import Noise, Returns, Sensor
from lidarsim.simulator.recorded_sweeps import FiredPulses, PulseAugmenter, RecordedSensor

from .augmented_sweep import AugmentedSweep
from .effects import Effects
from .inserted_objects import InsertedObjects
from .intensity_scale import check_column
from .recorded_weather import weather_note
from .scan_pattern import PulseGrid, ScanPattern
from .sensor_motion import SensorMotion
from .strength_columns import StrengthColumns

_DIVERGENCE_MRAD = 3.0  # beam divergence of a sensor whose divergence is unknown
_SUBRAYS = 7  # sub-rays per beam if objects are inserted
_RECEIVER = ("detection_range_m", "overlap_m", "saturation", "seed")  # properties of the receiver
# Minimum energy of recorded returns relative to the detection threshold. With this energy, 2.3 % of
# the pulses are detected.
_WEAKEST = 0.6
_RANGES = ("range", "distance", "depth")  # columns that contain ranges
_ROUNDING = 1e-9  # relative differences below this are rounding errors of the simulation


class Augmenter:
    """Simulates effects on the sweeps of a recording.

    Parameters
    ----------
    recording
        The recording, opened with all points of its file (`keep_noise`).
    effects
        Effects to simulate.
    model
        Model of the recording's sensor, or None if it is unknown. It defines the intensity scale,
        the optics and the sensitivity.
    reflectance
        Reflectance of all recorded surfaces if the recording has no intensities.

    Raises
    ------
    LidarError
        If the recording has no sweeps, its intensities are unknown, or the effects cannot be
        simulated on it.
    """

    def __init__(
        self,
        recording: Recording,
        effects: Effects,
        model: Sensor | None = None,
        reflectance: float | None = None,
    ) -> None:
        self.recording = with_sweeps(recording)
        self.effects = effects
        self.motion = SensorMotion.from_recording(
            recording, has_objects=bool(effects.actors or effects.insertions)
        )
        self.pattern = ScanPattern.from_recording(recording, model, self.motion)
        self.strengths = StrengthColumns.for_recording(recording, model, reflectance)
        self._notes: list[str] = [self.pattern.note, self.strengths.scale.note]
        if effects.weather.attenuates:
            self._notes.append(weather_note(recording, self.pattern, self.motion))
        self.objects = InsertedObjects.from_effects(recording, effects, self.motion)
        self._notes += self.objects.notes
        self._simulation = self._build(model)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user about properties of the recording that had to be assumed."""
        return tuple(dict.fromkeys(note for note in self._notes if note))

    def __len__(self) -> int:
        return len(self.recording)

    def _build(self, model: Sensor | None) -> PulseAugmenter:
        """Create the simulation of the effects."""
        effects = self.effects
        pattern = self.pattern
        sensor = model
        if sensor is None:
            sensor = Sensor.grid(
                layers=1, vertical_fov_deg=0, max_range_m=1.1 * pattern.max_range_m
            )
        if sensor.optics.divergence_mrad is None:
            sensor = replace(
                sensor, optics=replace(sensor.optics, divergence_mrad=_DIVERGENCE_MRAD)
            )
            if effects.weather.particles:
                self._notes.append(
                    "The beam divergence of the sensor is unknown and was assumed to be "
                    f"{_DIVERGENCE_MRAD:g} mrad. Pass `--model` to use that of a sensor."
                )
        recorded = RecordedSensor.create(
            pattern.channel_count, pattern.firings, sensor, pattern.max_range_m
        )
        noise, recorded_noise = self._noises(sensor)
        mode = effects.mode or ("two_strongest" if pattern.has_several else "strongest")
        pulse = sensor.returns if sensor.returns is not None else Returns()
        returns = replace(
            pulse,
            mode=mode,
            subrays=_SUBRAYS if self.objects.scene.actors or self.objects.has_objects else 1,
            waveform="none",
        )
        options = {
            field.name: getattr(effects.weather, field.name) for field in fields(effects.weather)
        }
        return PulseAugmenter(
            recorded,
            self.objects.scene,
            noise,
            recorded_noise,
            returns,
            len(self.recording),
            faults=effects.faults,
            materials=self.objects.surface_materials,
            **options,
        )

    def _noises(self, sensor: Sensor) -> tuple[Noise, Noise]:
        """Return the noise of added returns, and the noise that is added to recorded returns."""
        changes = {**self.effects.noise}
        receiver = {name: changes[name] for name in _RECEIVER if name in changes}
        base = sensor.noise or Noise()
        if "detection_range_m" not in receiver and base.detection_range_m is None:
            threshold = self.strengths.threshold
            receiver["detection_range_m"] = threshold.range_m
            self._notes.append(threshold.note)
        base = replace(base, **receiver, seed=self.effects.seed)
        recorded = Noise(
            detection_range_m=base.detection_range_m,
            overlap_m=base.overlap_m,
            seed=base.seed,
        )
        # Errors of directions, and false and stray returns, are part of the recording.
        added = replace(
            base,
            angle_deg=0.0,
            ripple_deg=0.0,
            false_alarm_hz=0.0,
            stray_light=0.0,
            crosstalk=False,
        )
        if "saturation" not in receiver:
            added = replace(added, saturation=None)
        if not isinstance(added.channel_bias_m, float) and len(
            np.atleast_1d(added.channel_bias_m)
        ) not in (1, self.pattern.channel_count):
            added = replace(added, channel_bias_m=0.0)
        others = {name: value for name, value in changes.items() if name not in _RECEIVER}
        return replace(added, **others), replace(recorded, **others)

    def sweep(self, number: int) -> AugmentedSweep:
        """Augment a sweep.

        Parameters
        ----------
        number
            Number of the sweep. All random numbers depend on it.

        Returns
        -------
        AugmentedSweep

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        return self.augment(self.recording[number], number)

    def augment(self, sweep: Sweep, number: int) -> AugmentedSweep:
        """Augment a sweep that has been read.

        `number` selects the random numbers, the time of the sweep and the poses of actors.
        """
        grid = self.pattern.grid(self.motion.as_fired(sweep, number))
        if not len(grid.row):
            return self._without_returns(sweep)
        motion = self.motion.of_sweep(sweep, number, grid.times_s)
        if motion.origins is not None and motion.rotations is not None:
            grid = grid.transform(motion.origins, motion.rotations)
        names = self.strengths.names[:1]  # the column that defines the energies
        for name in names:
            check_column(self.recording, sweep, number, name)
        recorded = {name: np.asarray(sweep.columns[name])[grid.row] for name in names}
        # What was detected had an energy of about the threshold or more.
        weakest = _WEAKEST * self._simulation.threshold
        energy = np.maximum(self.strengths.energies(recorded, grid.range_m), weakest)
        firing_ns = self._start_ns(number) + 1e9 * (grid.times_s - self._first_s)
        pulses = FiredPulses(
            lambda: grid.directions,
            firing_ns,
            RecordedPulses(grid.cell, grid.range_m, energy, grid.fired.reshape(-1)),
            grid.origins,
        )
        returns = self._simulation.apply(number, pulses, motion.poses)
        points = _AugmentedPoints.from_returns(sweep, grid, returns)
        columns = self._columns(sweep, points, grid, pulses.recorded, returns)
        augmented = Sweep(
            points.positions,
            columns,
            pose=sweep._pose,
            time_ns=sweep.time_ns,
            compensated=sweep.compensated,
            sensor=sweep.sensor,
            number=sweep.number,
            object_names=(*sweep.object_names, *self.objects.names) if sweep.object_names else (),
        )
        boxes, visibility = self.objects.boxes(self._simulation, pulses, motion, returns, number)
        return AugmentedSweep(augmented, points.template, points.is_recorded, boxes, visibility)

    def _set_strengths(
        self,
        columns: dict[str, AnyArray],
        points: _AugmentedPoints,
        grid: PulseGrid,
        recorded: RecordedPulses,
        returns: PulseReturns,
    ) -> None:
        """Set the strength columns of points whose energy or range has changed."""
        assert returns.energy is not None
        energy = returns.energy[points.order]
        old_energy = recorded.energy[points.nearest]
        full = self._simulation.saturation
        changed = points.is_moved | (np.abs(energy - old_energy) > _ROUNDING * energy)
        changed |= energy > full
        added = points.added
        changed[added] = False
        kept = np.flatnonzero(changed)
        old_m = grid.range_m[points.nearest[kept]]
        new_values = self.strengths.intensities(energy[added], points.range_m[added], full)
        scaled = self.strengths.scale_intensities(
            {name: columns[name][kept] for name in self.strengths.names if name in columns},
            old_energy[kept],
            energy[kept],
            old_m,
            np.where(points.is_moved[kept], points.range_m[kept], old_m),
            full,
        )
        for name, values in scaled.items():
            columns[name][kept] = values
            columns[name][added] = new_values[name]

    def _without_returns(self, sweep: Sweep) -> AugmentedSweep:
        """Return a sweep that has no returns, whose pulses are therefore unknown."""
        empty = sweep.returns()
        columns = {**empty.columns, "cause": np.zeros(0, np.uint8)}
        empty = empty.replace(columns=columns)
        return AugmentedSweep(empty, np.zeros(0, np.int64), np.zeros(0, np.bool_))

    def _start_ns(self, number: int) -> float:
        """Return the timestamp of a sweep in nanoseconds since the first sweep."""
        stamps_ns = self.recording.stamps_ns
        if stamps_ns is not None and len(stamps_ns) > number:
            return float(stamps_ns[number] - stamps_ns[0])
        return 1e9 * self.pattern.period_s * number

    @cached_property
    def _first_s(self) -> float:
        """Time of the first point of a sweep relative to its timestamp, which may be later."""
        times = self.recording.point_times
        return 0.0 if times is None else min(times.first_s, 0.0)

    def _columns(
        self,
        sweep: Sweep,
        points: _AugmentedPoints,
        grid: PulseGrid,
        recorded: RecordedPulses,
        returns: PulseReturns,
    ) -> dict[str, AnyArray]:
        """Return the columns of the augmented points."""
        columns = {name: np.asarray(v)[points.template] for name, v in sweep.columns.items()}
        self._set_strengths(columns, points, grid, recorded, returns)
        added = points.added
        for name in columns.keys() & {*_RANGES}:
            stored = np.asarray(sweep.columns[name], np.float64)[grid.row]
            valid = np.isfinite(stored) & (stored > 0)
            if not valid.any():
                continue
            unit = float(np.median(stored[valid] / grid.range_m[valid]))
            changed = np.flatnonzero(points.is_moved)
            values = unit * points.range_m[changed]
            columns[name][changed] = _as_type(values, columns[name].dtype)
        times = self.recording.point_times
        if times is not None and len(added):
            channels = grid.fired.shape[1]
            template_firing = grid.cell[points.nearest[added]] // channels
            late_s = grid.times_s[points.ray[added] // channels] - grid.times_s[template_firing]
            for name in TIMES:
                if name in columns:
                    values = columns[name][added] + late_s / times.unit_s
                    columns[name][added] = _as_type(values, columns[name].dtype)
                    break
        order = points.order
        if "return_number" in columns and returns.number is not None:
            columns["return_number"] = returns.number[order].astype(columns["return_number"].dtype)
        if "returns" in columns and returns.return_counts is not None:
            columns["returns"] = returns.return_counts[order].astype(columns["returns"].dtype)
        cause = np.zeros(len(order), np.uint8) if returns.cause is None else returns.cause[order]
        columns["cause"] = cause
        if self.objects.has_objects or columns.keys() & {"class", "object"}:
            numbers = self._simulation.objects(returns.take(order[added]))
            self.objects.label(columns, added, numbers, len(sweep.object_names))
        return columns


@dataclass(frozen=True, eq=False)
class _AugmentedPoints:
    """Points of an augmented sweep, sorted by template.

    All arrays have n rows, except `order`, which sorts the returns.
    """

    order: Ints
    positions: Floats  # (n, 3): meters
    range_m: Floats
    template: Ints
    is_moved: Bools  # whether a point is new or has another range
    ray: Integers
    nearest: Ints  # row of the template among the recorded returns
    added: Ints  # rows of the points that are not recorded returns

    @classmethod
    def from_returns(cls, sweep: Sweep, grid: PulseGrid, returns: PulseReturns) -> _AugmentedPoints:
        """Compute the points of reported returns."""
        from . import grid_loops  # imported here because numba takes half a second to import

        assert returns.reported is not None
        assert returns.source is not None
        order, nearest = np.empty((2, len(returns.ray)), np.int64)
        grid_loops.sort_points(
            to_writable(returns.ray, np.int64),
            returns.source,
            grid.cell,
            grid.row,
            grid.fired.shape,
            nearest,
            order,
        )
        template = grid.row[nearest]
        added = np.flatnonzero(returns.source[order] < 0)
        ray = returns.ray[order]
        range_m = returns.reported[order]
        old_m = grid.range_m[nearest]
        is_moved = np.abs(range_m - old_m) > _ROUNDING * old_m
        is_moved[added] = True
        positions = np.asarray(sweep.points.take(template, axis=0), np.float64)
        rows = np.flatnonzero(is_moved)
        positions[rows] = grid.ends(ray[rows], range_m[rows])
        return cls(order, positions, range_m, template, is_moved, ray, nearest, added)

    @property
    def is_recorded(self) -> Bools:
        """Whether each point is a recorded return."""
        mask = np.ones(len(self.order), np.bool_)
        mask[self.added] = False
        return mask


def _as_type(values: Floats, dtype: np.dtype[Any]) -> AnyArray:
    """Convert values to the type of a column, rounding to integers if necessary."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        return np.rint(values).clip(limits.min, limits.max).astype(dtype)
    return values.astype(dtype)

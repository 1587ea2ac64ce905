"""Pulses of recorded sweeps, including those without a return.

A recording usually contains only returns. In fog, however, a pulse into the sky returns light, too.
The grid of channels and firings of a spinning sensor is therefore recovered from the azimuths at
which each ring returns, and cells of the grid without a return are pulses without a return.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.clouds.rings import Rings, elevations, form_cones, summarize_rings
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Integers, Ints, to_writable
from lidarsim.numerics.elementary import arctan2, sin_cos
from lidarsim.numerics.even_samples import even_indices
from lidarsim.numerics.vectors import hypot
from lidarsim.sensor import Sensor
from lidarsim.words import plural

from ..scan_patterns.phases import MIN_STEP_RAD, RingSeries, stride
from .sensor_motion import SensorMotion

if TYPE_CHECKING:
    from .grid_loops import ChannelTables, SweepReturns, SweepRotation

_REFERENCE_SWEEPS = 5  # number of sweeps from which the pattern is determined
_SAME_PULSE_RAD = 1e-4  # maximum angle between the returns of a pulse
_MIN_SEVERAL = 0.005  # minimum fraction of returns that are further returns of a pulse
_MIN_STEPS = 8  # minimum number of steps of a ring from which its step is determined
_MAX_STEPS = 3  # maximum number of steps in a gap from which the step is determined
_MAX_OFF_STEP = 0.3  # maximum deviation of such a gap from whole steps
_MAX_STEP_CHANGE = 0.1  # maximum relative deviation of the step of a sweep
_PHASE_SAMPLE = 8  # one in this many returns determines the phase of a sweep
_MIN_RESULTANT = 0.5  # minimum resultant length of azimuths minus the rotation
_MIN_RINGS = 0.05  # minimum fraction of rings that return in a sector that was recorded
# Maximum change of the median elevation of a ring between the sweeps of a sensor. Motion
# compensation and surfaces at different ranges change it by less.
_MAX_ELEVATION_CHANGE = np.radians(3)
_LOW_RAD = np.radians(-3)  # rings below this elevation return from the ground
_SWEEP_S = 0.1  # assumed duration of a sweep without timestamps
_DIGITS = 9  # decimals of fitted angles, so that rounding errors do not affect results
_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class PulseGrid:
    """Pulses of a sweep in a grid of f firings and c channels, and the returns of the pulses.

    Attributes
    ----------
    aim
        Function that returns the unit directions (k, 3) of the pulses in k cells, in the frame of
        the sweep.
    times_s
        (f,): firing times in seconds relative to the timestamp of the sweep.
    fired
        (f, c): whether there is a pulse in the cell.
    cell
        (n,): cells of the returns in ascending order, as ``firing * c + channel``.
    range_m
        (n,): ranges of the returns in meters.
    row
        (n,): rows of the returns in the sweep.
    origins
        (f, c, 3): origins of the pulses in meters, or None if all pulses start at the origin.
    """

    aim: Callable[[Integers], Floats]
    times_s: Floats
    fired: Bools
    cell: Ints
    range_m: Floats
    row: Ints
    origins: Floats | None = None

    @cached_property
    def directions(self) -> Floats:
        """Unit directions of all pulses in the frame of the sweep, of shape (f, c, 3)."""
        return self.aim(np.arange(self.fired.size)).reshape(*self.fired.shape, 3)

    def ends(self, ray: Integers, range_m: Floats) -> Floats:
        """Return the points at the given ranges along pulses, of shape (k, 3)."""
        points = self.aim(ray) * range_m[:, None]
        if self.origins is not None:
            points += self.origins.reshape(-1, 3)[ray]
        return points

    def with_origins(self, origins: Floats) -> PulseGrid:
        """Return a grid whose pulses start at other origins but end at the same returns.

        `origins` (f, c, 3) are the new origins in meters.
        """
        path = self.ends(self.cell, self.range_m) - origins.reshape(-1, 3)[self.cell]
        range_m = _ranges(path)
        towards = path / range_m[:, None]

        def aim(ray: Integers) -> Floats:
            directions = self.aim(ray)
            last = np.searchsorted(self.cell, ray, side="right") - 1  # farthest return of a pulse
            returned = np.flatnonzero(self.cell[last] == ray)
            directions[returned] = towards[last[returned]]
            return directions

        return replace(self, aim=aim, range_m=range_m, origins=origins)

    def transform(self, positions: Floats, rotations: Floats) -> PulseGrid:
        """Transform the pulses of each firing to the frame of the sweep.

        Parameters
        ----------
        positions
            (f, 3): positions of the sensor at the firings in meters.
        rotations
            (f, 3, 3): rotations from the sensor frame at the firings to the frame of the sweep.
        """
        channels = self.fired.shape[1]
        origins = np.repeat(positions[:, None], channels, axis=1)
        if self.origins is not None:
            origins += np.einsum("fij,fcj->fci", rotations, self.origins)

        def aim(ray: Integers) -> Floats:
            return np.asarray(np.einsum("kij,kj->ki", rotations[ray // channels], self.aim(ray)))

        return replace(self, aim=aim, origins=origins)


@dataclass(frozen=True, eq=False)
class Channels:
    """Channels of a spinning sensor, from the lowest to the highest.

    Attributes
    ----------
    rings
        Rings of the recording.
    elevation_rad
        (c,): elevations in radians.
    of_ring
        (r,): channel of each ring.
    offset_rad
        (c,): azimuths relative to the firing according to the sensor model, or None.
    origin
        (c, 3): origins of the beams at azimuth 0 in meters, or None if they are unknown or 0.
    """

    rings: Rings
    elevation_rad: Floats
    of_ring: Ints
    offset_rad: Floats | None = None
    origin: Floats | None = None

    @classmethod
    def from_rings(cls, rings: Rings, model: Sensor | None, sweeps: Sequence[Sweep]) -> Channels:
        """Match the rings of a recording with the channels of a sensor model, if possible.

        A recording has no ring for a channel that never returns. Elevations are compared as seen
        from the origins of the beams. Seen from the sensor origin, returns at close range may be
        closer to the elevation of the next channel.
        """
        from scipy.optimize import linear_sum_assignment

        recorded = cls(rings, rings.elevation_rad[::-1], np.arange(len(rings))[::-1])
        if model is None or not 0 < len(rings) <= model.channels:
            return recorded
        order = np.argsort(model.beams.elevation, kind="stable")
        elevation = model.beams.elevation[order]
        seen = _elevations_from(model.beams.origin.mean(axis=0), rings, sweeps)
        apart = np.abs(seen[:, None] - elevation)
        _, channel = linear_sum_assignment(apart)
        gap_rad = float(np.median(np.diff(elevation))) if len(elevation) > 1 else np.inf
        if (apart[np.arange(len(rings)), channel] > gap_rad).any():
            return recorded
        origin = model.beams.origin[order] if model.beams.origin.any() else None
        return cls(rings, elevation, channel, model.beams.azimuth[order], origin)

    def __len__(self) -> int:
        return len(self.elevation_rad)

    def numbers(self, sweep: Sweep) -> Ints:
        """Return the channel of each return, or -1 if it is unknown."""
        row = self.rings.ring_indices(sweep)
        return np.append(self.of_ring, -1)[row]  # the last entry is that of row -1


@dataclass(frozen=True, eq=False)
class ChannelPattern:
    """Azimuths and elevations at which the channels of a spinning sensor fire.

    Attributes
    ----------
    channels
        The c channels.
    offset_rad
        (c,): azimuth of each channel relative to the mean of all channels in the same firing.
    stride
        (c,): number of firings from one pulse of a channel to the next.
    step_rad
        Azimuth between firings in radians.
    clockwise
        Whether the sensor rotates clockwise.
    in_view
        (c, SECTORS): sectors of azimuth from which each channel can receive returns. Others are
        outside the field of view or blocked by the vehicle.
    has_several
        Whether a pulse can have several returns.
    """

    channels: Channels
    offset_rad: Floats
    stride: Ints
    step_rad: float
    clockwise: bool
    in_view: Bools
    has_several: bool

    @classmethod
    def from_sweeps(
        cls, channels: Channels, sweeps: Sequence[Sweep], period_s: float
    ) -> ChannelPattern | None:
        """Determine the pattern of several sweeps, or return None if there is none."""
        from .grid_loops import SECTORS

        count = len(channels)
        if not count:
            return None
        numbers = [channels.numbers(sweep) for sweep in sweeps]
        azimuths = [_azimuths(sweep.points) for sweep in sweeps]
        found = map(_RingSteps.from_returns, azimuths, numbers, [count] * len(sweeps))
        steps = [step for step in found if step is not None]
        if not steps:
            return None
        step_rad = round(float(np.median([step.smallest_rad for step in steps])), _DIGITS)
        stride = np.min([step.stride for step in steps], axis=0)
        offset_rad, clockwise = _offsets(sweeps, azimuths, numbers, count, period_s)
        if channels.offset_rad is not None:
            offset_rad = channels.offset_rad
        in_view = np.zeros((count, SECTORS), np.bool_)
        for azimuth, number in zip(azimuths, numbers, strict=True):
            sector = np.floor(azimuth / _TURN * SECTORS).astype(np.int64) % SECTORS
            in_view[number[number >= 0], sector[number >= 0]] = True
        # The vehicle blocks pulses from below, so rings above a ring that returns are in view, too.
        # They may observe nothing but the sky, or ground that is too far away.
        in_view = np.logical_or.accumulate(in_view, axis=0)
        in_view[channels.elevation_rad >= _LOW_RAD] = in_view.any(axis=0)
        several = sum(step.several for step in steps)
        return cls(
            channels,
            offset_rad,
            stride,
            step_rad,
            clockwise,
            in_view,
            several > _MIN_SEVERAL * sum(map(len, sweeps)),
        )

    def grid(
        self, sweep: Sweep, points: Floats, rows: Ints, times_s: Floats | None, period_s: float
    ) -> PulseGrid:
        """Return the pulses of a sweep.

        Parameters
        ----------
        sweep
            Returns of the sweep.
        points
            (n, 3): positions of the returns in meters.
        rows
            (n,): rows of the returns in the recorded sweep.
        times_s
            (n,): times of the returns relative to the timestamp of the sweep, or None.
        period_s
            Duration of a sweep.
        """
        from . import grid_loops  # imported here because numba takes half a second to import

        returns = grid_loops.SweepReturns(
            points, _azimuths(points), _ranges(points), self.channels.numbers(sweep)
        )
        rotation = self._rotation(returns)
        located = grid_loops.GridReturns(*np.empty((3, len(points)), np.int64))
        tables = self._tables(returns, rotation)
        extra = grid_loops.locate_returns(returns, tables, rotation, self.has_several, located)
        shape = rotation.firings + extra, len(self.channels)
        turns = np.arange(shape[0]) * rotation.step_rad + rotation.phase_rad
        sines = np.stack(sin_cos(rotation.sign * turns))
        fired = np.empty(shape, np.bool_)
        min_rings = max(_MIN_RINGS * len(self.channels.rings), 1)
        grid_loops.mark_fired(returns, tables, rotation, min_rings, located, fired)

        def aim(ray: Integers) -> Floats:
            directions = np.empty((len(ray), 3))
            grid_loops.aim_pulses(
                to_writable(ray, np.int64), returns, tables, located, sines, directions
            )
            return directions

        if times_s is None:
            times = period_s * (np.arange(shape[0]) % rotation.firings) / rotation.firings
        else:
            times = _firing_times(located.firing, times_s, shape[0])
        range_m = returns.range_m[located.order]
        grid = PulseGrid(aim, times, fired, located.cell, range_m, rows[located.order])
        return self._from_beam_origins(grid, sines)

    def _from_beam_origins(self, grid: PulseGrid, sines: Floats) -> PulseGrid:
        """Return a grid whose pulses start at the origins of the beams, if they are known.

        `sines` (2, f) are the sines and cosines of the azimuths of the firings.
        """
        if self.channels.origin is None:
            return grid
        x, y, z = self.channels.origin.T
        sine, cosine = sines[:, :, None]
        origins = np.empty((*grid.fired.shape, 3))
        origins[..., 0] = cosine * x - sine * y
        origins[..., 1] = sine * x + cosine * y
        origins[..., 2] = z
        return grid.with_origins(origins)

    def _rotation(self, returns: SweepReturns) -> SweepRotation:
        """Determine the rotation of a sweep, whose rate may differ from the median rate."""
        from .grid_loops import SweepRotation

        sign = -1.0 if self.clockwise else 1.0
        step_rad = _sweep_step(returns.azimuth, returns.channel, self.step_rad)
        rows = np.flatnonzero(returns.channel[::_PHASE_SAMPLE] >= 0) * _PHASE_SAMPLE
        turn = sign * (returns.azimuth[rows] - self.offset_rad[returns.channel[rows]])
        sine, cosine = (values.sum() for values in sin_cos(turn * (_TURN / step_rad)))
        phase_rad = round(float(np.arctan2(sine, cosine)) * step_rad / _TURN, _DIGITS)
        return SweepRotation(sign, step_rad, phase_rad, max(round(_TURN / step_rad), 1))

    def _tables(self, returns: SweepReturns, rotation: SweepRotation) -> ChannelTables:
        """Return tables of the channels for compiled loops."""
        from .grid_loops import ChannelTables

        residue = np.zeros(len(self.stride), np.int64)
        for ring in np.flatnonzero(self.stride > 1).tolist():
            azimuth = returns.azimuth[returns.channel == ring] - self.offset_rad[ring]
            turn = rotation.sign * azimuth - rotation.phase_rad
            firing = np.rint(turn / rotation.step_rad).astype(np.int64) % rotation.firings
            if len(firing):
                residue[ring] = np.bincount(firing % self.stride[ring]).argmax()
        sine, cosine = sin_cos(self.channels.elevation_rad)
        return ChannelTables(sine, cosine, self.offset_rad, self.stride, residue, self.in_view)


@dataclass(frozen=True, eq=False)
class ScanPattern:
    """Scan pattern of a recording.

    Attributes
    ----------
    channels
        Pattern of a spinning sensor, or None if the rings are unknown. Each return then has its own
        pulse, and pulses without a return are unknown.
    max_range_m
        Maximum range of the returns in meters.
    period_s
        Duration of a sweep in seconds.
    note
        Sentence for the user if pulses without a return are unknown, otherwise empty.
    """

    channels: ChannelPattern | None
    max_range_m: float
    period_s: float
    note: str = ""

    @classmethod
    def from_recording(
        cls,
        recording: Recording,
        model: Sensor | None = None,
        motion: SensorMotion | None = None,
    ) -> ScanPattern:
        """Determine the scan pattern from a few sweeps.

        The sensor model, if it is known, adds channels that never return, and the origins of the
        beams. The motion of the sensor, if it is known, reverses the compensation of sweeps.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        numbers = even_indices(len(recording), _REFERENCE_SWEEPS).tolist()
        stored = {number: recording[number].returns() for number in numbers}
        sweeps = [
            sweep if motion is None else motion.as_fired(sweep, number)
            for number, sweep in stored.items()
            if len(sweep)
        ]
        max_range_m = max((float(_ranges(sweep.points).max()) for sweep in sweeps), default=1.0)
        period_s = _period_s(recording)
        _check_model(recording, model)
        _check_single_sensor(recording, sweeps)
        pattern = None
        if sweeps:
            channels = Channels.from_rings(recording.rings, model, sweeps)
            pattern = ChannelPattern.from_sweeps(channels, sweeps, period_s)
        note = ""
        if pattern is None:
            note = (
                f"The rings of {recording.info.name} are unknown, so pulses without a return are "
                "unknown, too. Rain, snow, fog and dust only return light in front of recorded "
                "points."
            )
        return cls(pattern, max_range_m, period_s, note)

    @property
    def channel_count(self) -> int:
        """Number of channels, which is 1 if the rings are unknown."""
        return 1 if self.channels is None else len(self.channels.channels)

    @property
    def firings(self) -> int:
        """Number of firings in a revolution, or 1 if the rings are unknown."""
        return 1 if self.channels is None else round(_TURN / self.channels.step_rad)

    @property
    def has_several(self) -> bool:
        """Whether a pulse can have several returns."""
        return self.channels is not None and self.channels.has_several

    def grid(self, sweep: Sweep) -> PulseGrid:
        """Return the pulses of a sweep of the recording."""
        mask = sweep.has_return
        rows = np.flatnonzero(mask)
        returns = sweep if len(rows) == len(mask) else sweep.select(rows)
        points = to_writable(returns.points, np.float64)
        times_s = returns.times_s
        if self.channels is not None and len(rows):
            return self.channels.grid(returns, points, rows, times_s, self.period_s)
        count = len(rows)
        if times_s is None:
            times_s = self.period_s * np.arange(count) / max(count, 1)
        range_m = _ranges(points)
        channels = self.channel_count
        directions = points / range_m[:, None]
        fired = np.zeros((count, channels), np.bool_)
        fired[:, 0] = True
        cell = np.arange(count) * channels
        return PulseGrid(
            lambda ray: directions[ray // channels], times_s, fired, cell, range_m, rows
        )


def _check_model(recording: Recording, model: Sensor | None) -> None:
    """Raise LidarError if a recording has more rings than its sensor model has channels."""
    rings = len(recording.rings)
    if model is None or not rings or rings <= model.channels:
        return
    raise LidarError(
        f"{recording.info.name} has {rings} rings, but {model.model} has "
        f"{plural(model.channels, 'channel')}. Pass the model of the sensor that was used."
    )


def _check_single_sensor(recording: Recording, sweeps: Sequence[Sweep]) -> None:
    """Raise LidarError if rings with the same number have different elevations in some sweeps.

    Sweeps whose rings do not form cones are not compared, because the median elevation of a line
    depends on the surfaces that it hits.
    """
    medians: dict[int, list[float]] = {}
    for sweep in sweeps:
        if "channel" not in sweep.columns:
            return
        channel = np.asarray(sweep.columns["channel"]).astype(np.int64)
        numbers, elevation, spread_rad = summarize_rings(channel, elevations(sweep.points))
        if not form_cones(elevation, spread_rad):
            continue
        for number, median in zip(numbers.tolist(), elevation.tolist(), strict=True):
            medians.setdefault(number, []).append(median)
    spreads = [max(values) - min(values) for values in medians.values() if len(values) > 1]
    if spreads and np.median(spreads) > _MAX_ELEVATION_CHANGE:
        raise LidarError(
            f"Rings with the same number have different elevations in different sweeps of "
            f"{recording.info.name}, so the sweeps come from different sensors. Augment the sweeps "
            "of each sensor separately."
        )


def _elevations_from(origin: Floats, rings: Rings, sweeps: Sequence[Sweep]) -> Floats:
    """Return the median elevation of each ring, as seen from the origin of the beams.

    `origin` (3,) is the origin of a beam at azimuth 0, in meters.
    """
    numbers = np.concatenate([rings.ring_indices(sweep) for sweep in sweeps])
    x, y, z = np.concatenate([np.asarray(sweep.points, np.float64) for sweep in sweeps]).T
    elevation = arctan2(z - origin[2], hypot(x, y) - origin[0])
    medians = rings.elevation_rad.copy()
    for ring in np.unique(numbers[numbers >= 0]).tolist():
        medians[ring] = np.median(elevation[numbers == ring])
    return medians


class _RingSteps(NamedTuple):
    """Azimuth steps of the rings in a sweep."""

    smallest_rad: float  # typical step of the rings with the smallest steps
    stride: Ints  # (c,): ratio of the step of each ring to the smallest step; 1 if it is unknown
    several: int  # number of returns that share their pulse with another return

    @classmethod
    def from_returns(cls, azimuth: Floats, channel: Ints, count: int) -> _RingSteps | None:
        """Determine the steps of rings, or return None if no ring has enough returns."""
        series = RingSeries.from_values(azimuth, channel, np.zeros(len(channel), np.int64))
        gaps, ring = series.gaps(MIN_STEP_RAD)
        counts = np.bincount(ring, minlength=count)
        if counts.max(initial=0) < _MIN_STEPS:
            return None
        # Motion within a sweep changes the steps, so the smallest gaps are not used.
        parts = [gaps[ring == row] for row in range(count)]
        ring_rad = [
            _refined_step(part, float(np.median(part))) for part in parts if len(part) >= _MIN_STEPS
        ]
        several = int((series.is_same & (np.diff(series.values) < _SAME_PULSE_RAD)).sum())
        smallest_rad = float(np.quantile(ring_rad, 0.2))
        strides = [stride(part, smallest_rad) for part in parts]
        return cls(smallest_rad, np.array(strides), several)


def _refined_step(gaps: Floats, step_rad: float) -> float:
    """Refine a step with the gaps that span a few steps."""
    steps = np.rint(gaps / step_rad)
    usable = (steps >= 1) & (steps <= _MAX_STEPS)
    usable &= np.abs(gaps / step_rad - steps) < _MAX_OFF_STEP
    return float(gaps[usable].sum() / steps[usable].sum()) if usable.any() else step_rad


def _sweep_step(azimuth: Floats, channel: Ints, step_rad: float) -> float:
    """Return the step of one sweep, from the ring with the most returns."""
    counts = np.bincount(channel[channel >= 0], minlength=1)
    gaps = np.diff(np.sort(azimuth[channel == counts.argmax()]))
    gaps = gaps[gaps > MIN_STEP_RAD]
    refined = _refined_step(gaps, step_rad) if len(gaps) else step_rad
    return round(refined if abs(refined / step_rad - 1) < _MAX_STEP_CHANGE else step_rad, _DIGITS)


def _offsets(
    sweeps: Sequence[Sweep],
    azimuths: Sequence[Floats],
    channels: Sequence[Ints],
    count: int,
    period_s: float,
) -> tuple[Floats, bool]:
    """Return the azimuth offsets of channels in radians, and whether the sensor turns clockwise.

    They are determined from point times. Without times, offsets are 0.
    """
    sums = np.zeros((2, count), complex)  # for counterclockwise and clockwise rotation
    for sweep, azimuth, channel in zip(sweeps, azimuths, channels, strict=True):
        if sweep.times_s is None:
            return np.zeros(count), False
        known = channel >= 0
        turn = _TURN * sweep.times_s[known] / period_s
        for index, sign in enumerate((1, -1)):
            phases = np.exp(1j * (azimuth[known] - sign * turn))
            start = phases.sum()
            phases *= np.conj(start) / max(abs(start), 1e-300)
            sums[index] += np.bincount(channel[known], phases.real, count)
            sums[index] += 1j * np.bincount(channel[known], phases.imag, count)
    lengths = np.abs(sums).sum(axis=1)
    if lengths.max() < _MIN_RESULTANT * sum(map(len, sweeps)):
        return np.zeros(count), False
    clockwise = bool(lengths[1] > lengths[0])
    return np.round(np.angle(sums[int(clockwise)]), _DIGITS), clockwise


def _period_s(recording: Recording) -> float:
    """Return the duration of a revolution in seconds."""
    stamps_ns = recording.stamps_ns
    if stamps_ns is not None and len(stamps_ns) > 1:
        period_s = 1e-9 * float(np.median(np.diff(stamps_ns)))
        if 0.01 <= period_s <= 2:
            return period_s
    return _SWEEP_S


def _firing_times(firing: Ints, times_s: Floats, firings: int) -> Floats:
    """Return the mean time of the returns of each firing, interpolated for firings without one."""
    counts = np.bincount(firing, minlength=firings)
    sums = np.bincount(firing, times_s, minlength=firings)
    known = np.flatnonzero(counts)
    return np.interp(np.arange(firings), known, sums[known] / counts[known])


def _azimuths(points: Floats) -> Floats:
    return arctan2(points[:, 1], points[:, 0])


def _ranges(points: Floats) -> Floats:
    x, y, z = np.asarray(points, np.float64).T
    return np.asarray(np.sqrt(x * x + y * y + z * z))

"""List of the rays of any sensor, measured from the returns of a stationary recording.

If the pattern repeats, the returns of all repetitions are combined, so that pulses that were lost
once are known, and their directions are averaged. Otherwise, the list is as long as the recording,
and pulses without a return are missing from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.sensor_files.fired_rays import RayList
from lidarsim.words import plural

from .lasers import RingLasers, unit_vectors
from .pattern_returns import PatternReturns
from .phases import RingSeries, ring_steps

_SAME_PULSE_S = 1e-8  # returns of a channel that are closer in time belong to the same pulse
_MIN_DISTINCT = 0.6  # minimum share of the returns of a channel with times of their own
_MAX_OFF_GRID = 0.2  # maximum typical deviation of firing times from an even grid, in steps
_MAX_TYPICAL_GAP = 10  # maximum typical gap between returns, in steps
_PROBES = 400  # rays whose repetitions are searched
_MAX_PROBES_RETURNS = 1_500_000
_SAME_DIRECTION_RAD = np.radians(0.03)  # maximum angle between repetitions of a ray
_MIN_LAG = 100  # minimum number of firings after which a pattern repeats
_MIN_REPEATED = 0.5  # minimum share of probes that repeat after the same time
_MAX_NEAR = 4000  # maximum number of returns that are compared with a probe
_MAX_FILLED = 3  # maximum number of consecutive rays that are interpolated
_MAX_FILLED_RAD = np.radians(2)  # maximum angle across them
_CUBIC = np.array([-1, 4, 4, -1]) / 6  # weights of the four neighbors of a ray on a smooth curve
_MIN_CURVE = 50  # minimum number of rays of a channel to measure deviations from curves
_COMPLETE_CURVES = 0.02  # share of neighboring rays between which no pulse was lost
_MAX_CURVE = 1.2  # maximum duration of such rays relative to the shortest
_MEDIAN_ANGLE = 1.1774  # median angle of directions with a standard deviation of 1 in two axes
_CUBIC_NOISE = np.sqrt(1 + np.square(_CUBIC).sum())


class FiringGrid(NamedTuple):
    """Evenly spaced firing times of a channel."""

    step_s: float  # between firings, NaN if the times are not evenly spaced
    number: Ints  # (n,): numbers of the firings of the returns


@dataclass(frozen=True, eq=False)
class ListedRays:
    """List of the rays of a sensor.

    Attributes
    ----------
    rays
        The rays in firing order.
    spread_rad
        Standard deviation of the directions: of repetitions of the same ray if the pattern repeats,
        otherwise from smooth curves through the neighboring rays.
    repetitions
        Number of repetitions that were combined, or 0 if the pattern does not repeat.
    missing
        Number of pulses without a return that are missing from the list, or None if it is unknown.
    filled
        Number of pulses whose directions were interpolated.
    notes
        Notes for the user.
    """

    rays: RayList
    spread_rad: float
    repetitions: int
    missing: int | None
    filled: int
    notes: tuple[str, ...]

    @classmethod
    def from_returns(cls, returns: PatternReturns) -> ListedRays:
        """Determine the rays from the returns of a recording."""
        pulses = _Pulses.from_returns(returns)
        grids = {} if pulses.time_s is None or pulses.is_coarse else _firing_grids(pulses)
        are_even = bool(grids) and all(np.isfinite(grid.step_s) for grid in grids.values())
        period_s = _repeat_time(pulses) if are_even else None
        if period_s is not None:
            combined = _combined(returns, pulses, grids, period_s)
            if not combined.spread_rad > _SAME_DIRECTION_RAD:
                return combined
        return _as_recorded(returns, pulses, grids if are_even else {})


class _Pulses(NamedTuple):
    """Pulses with at least one return, in firing order."""

    direction: Floats  # (n, 3)
    origin: Floats | None  # (n, 3), meters, or None if all pulses start at the sensor origin
    channel: Ints  # (n,)
    time_s: Floats | None  # (n,): since the first pulse
    is_coarse: bool = False  # whether times were spread, because many pulses had the same time

    @classmethod
    def from_returns(cls, returns: PatternReturns) -> _Pulses:
        is_coarse = False
        if returns.time_s is not None:
            spread_s = _spread_times(returns)
            is_coarse = spread_s is not None
            returns = returns if spread_s is None else replace(returns, time_s=spread_s)
            assert returns.time_s is not None
            order = np.lexsort((returns.channel, returns.time_s))
            returns = returns.select(order)
        direction, origin = _directions(returns)
        time_s = returns.time_s
        if time_s is None:
            return cls(direction, origin, returns.channel, None)
        # The returns of a pulse are adjacent, and the first of them represents the pulse.
        if is_coarse:
            return cls(direction, origin, returns.channel, time_s - time_s[0], is_coarse=True)
        is_first = np.diff(time_s, prepend=-np.inf) > _SAME_PULSE_S
        is_first |= np.diff(returns.channel, prepend=-1) != 0
        is_first[1:] |= _angles(direction[1:], direction[:-1]) > 10 * _SAME_DIRECTION_RAD
        first = np.flatnonzero(is_first)
        origin = None if origin is None else origin[first]
        return cls(direction[first], origin, returns.channel[first], (time_s - time_s[0])[first])


def _spread_times(returns: PatternReturns) -> Floats | None:
    """Return times that are spread evenly where many returns of a channel have the same time.

    Some drivers store the time of a packet for all its points. Returns None if this is not the
    case.
    """
    assert returns.time_s is not None
    order = np.lexsort((returns.time_s, returns.channel))
    time_s, channel = returns.time_s[order], returns.channel[order]
    is_new = (np.diff(time_s, prepend=-np.inf) > _SAME_PULSE_S) | (
        np.diff(channel, prepend=-1) != 0
    )
    starts = np.flatnonzero(is_new)
    if len(starts) > _MIN_DISTINCT * len(order):
        return None
    length_s = np.diff(time_s[starts], append=time_s[-1])
    typical_s = float(np.median(length_s[length_s > 0])) if (length_s > 0).any() else 0.0
    length_s = np.where((length_s > 0) & (length_s < 2 * typical_s), length_s, typical_s)
    counts = np.diff(starts, append=len(order))
    rank = np.arange(len(order)) - starts.repeat(counts)
    spread_s = np.empty(len(order))
    spread_s[order] = time_s + length_s.repeat(counts) * rank / counts.repeat(counts)
    return spread_s


def _directions(returns: PatternReturns) -> tuple[Floats, Floats | None]:
    """Return the unit directions of the returns and their origins."""
    points = returns.points
    if len(returns.elevation_rad) and (returns.ring >= 0).all():
        sweeps = [
            (points[returns.sweep == number], returns.ring[returns.sweep == number])
            for number in range(returns.sweep_count)
        ]
        lasers = RingLasers.from_sweeps(sweeps, returns.elevation_rad)
        if not lasers.is_at_origin:
            direction = unit_vectors(*lasers.angles(points, returns.ring))
            return direction, lasers.origins(points, returns.ring)
    return points / np.linalg.norm(points, axis=1)[:, None], None


def _firing_grids(pulses: _Pulses) -> dict[int, FiringGrid]:
    """Return the firing grid of each channel, by channel number."""
    assert pulses.time_s is not None
    grids = {}
    for channel in np.unique(pulses.channel).tolist():
        time_s = pulses.time_s[pulses.channel == channel]
        zeros = np.zeros(len(time_s), np.int64)
        series = RingSeries.from_values(time_s, zeros, zeros)
        step_s = float(ring_steps(*series.gaps(_SAME_PULSE_S), 1)[0])
        if not step_s > 0:
            grids[channel] = FiringGrid(float("nan"), zeros)
            continue
        step_s = series.refine_step(step_s, _SAME_PULSE_S)
        gaps = np.diff(time_s) / step_s
        even = float(np.median(np.abs(gaps - np.rint(gaps)))) < _MAX_OFF_GRID
        even &= 0.5 < float(np.median(gaps)) < _MAX_TYPICAL_GAP
        number = np.append(0, np.cumsum(np.rint(gaps).astype(np.int64)))
        grids[channel] = FiringGrid(step_s if even else float("nan"), number)
    return grids


def _as_recorded(
    returns: PatternReturns, pulses: _Pulses, grids: dict[int, FiringGrid]
) -> ListedRays:
    """Return the pulses of a pattern that does not repeat.

    `grids` are the firing grids of all channels, or empty if the times are not evenly spaced.
    """
    notes = []
    count = len(pulses.direction)
    duration_s = returns.sweep_count * returns.sweep_times.period_s
    missing = None
    if pulses.time_s is None:
        time_s = duration_s * np.arange(count) / count
        notes.append(
            "the points have no times. The order of the points is assumed to be the firing order, "
            f"and the rays are spread evenly over {duration_s:.4g} s. Pulses without a return are "
            "unknown"
        )
    else:
        time_s = pulses.time_s
        duration_s = max(duration_s, float(time_s[-1]) * (1 + 1 / max(count - 1, 1)))
        if grids:
            missing = sum(int(grid.number[-1]) + 1 - len(grid.number) for grid in grids.values())
            share = missing / (missing + count)
            notes.append(
                f"the pattern does not repeat within {duration_s:.4g} s. {missing:,} pulses "
                f"without a return ({100 * share:.2g} %) are missing from the list"
            )
        elif pulses.is_coarse:
            notes.append(
                "many points have the same time, such as that of their packet. Their rays are "
                "spread evenly until the next time, and pulses without a return are unknown"
            )
        else:
            notes.append(
                "the firing times are not evenly spaced, so the number of pulses without a return "
                "is unknown. They are missing from the list"
            )
    rays = _ray_list(returns, pulses._replace(time_s=time_s), duration_s, repeats=False)
    return ListedRays(rays, _curve_spread(pulses), 0, missing, 0, tuple(notes))


def _ray_list(
    returns: PatternReturns, pulses: _Pulses, cycle_s: float, *, repeats: bool
) -> RayList:
    assert pulses.time_s is not None
    return RayList(
        directions=pulses.direction,
        times_ns=np.rint(1e9 * pulses.time_s).astype(np.int64),
        channels=pulses.channel - pulses.channel.min(),
        origins=pulses.origin,
        cycle_ns=float(round(1e9 * cycle_s)),
        rate_hz=round(1 / returns.sweep_times.period_s, 6),
        range_m=(0.0, returns.max_range_m),
        name="Recorded sensor",
        repeats=repeats,
    )


def _curve_spread(pulses: _Pulses) -> float:
    """Return the standard deviation of directions from curves through the neighboring rays.

    Consecutive rays of a channel lie on a smooth curve unless pulses in between were lost.
    """
    spreads = []
    for channel in np.unique(pulses.channel).tolist():
        rows = np.flatnonzero(pulses.channel == channel)
        if len(rows) < _MIN_CURVE:
            continue
        direction = pulses.direction[rows]
        center = direction[2:-2]
        smooth = sum(
            weight * direction[start : len(direction) - 4 + start]
            for weight, start in zip(_CUBIC, (0, 1, 3, 4), strict=True)
        )
        deviation = np.linalg.norm(center - smooth, axis=1)
        if pulses.time_s is not None:
            time_s = pulses.time_s[rows]
            length_s = time_s[4:] - time_s[:-4]  # of five rays, between which pulses may be lost
            shortest_s = np.quantile(length_s, _COMPLETE_CURVES)
            deviation = deviation[length_s < _MAX_CURVE * shortest_s]
        spreads.append(float(np.median(deviation)) / (_CUBIC_NOISE * _MEDIAN_ANGLE))
    return float(np.median(spreads)) if spreads else float("nan")


def _repeat_time(pulses: _Pulses) -> float | None:
    """Return the time after which the pattern repeats, or None if it does not.

    Some rays are compared with all later rays of the same channel. The times between rays with the
    same direction are then counted.
    """
    from scipy.spatial import cKDTree

    assert pulses.time_s is not None
    channels, counts = np.unique(pulses.channel, return_counts=True)
    rows = np.flatnonzero(pulses.channel == channels[counts.argmax()])[:_MAX_PROBES_RETURNS]
    time_s, direction = pulses.time_s[rows], pulses.direction[rows]
    early = np.flatnonzero(time_s < 0.4 * time_s[-1])
    grid = _firing_grids(_Pulses(direction, None, np.zeros(len(rows), np.int64), time_s))[0]
    if not np.isfinite(grid.step_s) or len(early) < _PROBES:
        return None
    probes = early[even_indices(len(early), _PROBES)]
    near = cKDTree(direction).query_ball_point(direction[probes], _SAME_DIRECTION_RAD)
    lags = []
    for probe, others in zip(probes.tolist(), near, strict=True):
        later = np.array(others)
        # Rays that are fired one after another are closer to each other than repetitions are.
        lag = np.rint((time_s[later] - time_s[probe]) / grid.step_s).astype(np.int64)
        lags.append(np.unique(lag[lag > _MIN_LAG])[:_MAX_NEAR])
    found, votes = np.unique(np.concatenate(lags), return_counts=True)
    if not len(found) or votes.max() < _MIN_REPEATED * len(probes):
        return None
    # Multiples of the period have as many votes as the period, except for lost pulses.
    first = int(found[np.flatnonzero(votes > _MIN_REPEATED * votes.max())[0]])
    return _refined_period(first, direction, time_s, grid)


def _refined_period(lag: int, direction: Floats, time_s: Floats, grid: FiringGrid) -> float | None:
    """Return the time between rays that are `lag` firings apart, if their directions agree."""
    place = np.searchsorted(grid.number, grid.number + lag)
    place = np.minimum(place, len(grid.number) - 1)
    rows = np.flatnonzero(grid.number[place] == grid.number + lag)
    if not len(rows):
        return None
    angle = _angles(direction[rows], direction[place[rows]])
    if np.median(angle) > _SAME_DIRECTION_RAD:
        return None
    return float(np.mean(time_s[place[rows]] - time_s[rows]))


def _combined(
    returns: PatternReturns, pulses: _Pulses, grids: dict[int, FiringGrid], period_s: float
) -> ListedRays:
    """Return one repetition of a pattern, in which the returns of all repetitions are combined."""
    assert pulses.time_s is not None
    folded = {}
    for channel, grid in grids.items():
        rows = np.flatnonzero(pulses.channel == channel)
        folded[channel] = _FoldedRays.fold(pulses, rows, grid, period_s)
    complete = {channel: rays.fill() for channel, rays in folded.items()}
    filled = sum(complete[channel].count - rays.count for channel, rays in folded.items())
    missing = sum(rays.firings - rays.count for rays in complete.values())
    repetitions = max(round(float(pulses.time_s[-1]) / period_s), 1)
    # The numbers of the firings of a channel start at its first return.
    early_s = 0.25 * min(grid.step_s for grid in grids.values())
    listed = _merged(complete, float(pulses.time_s[0]) - early_s, period_s)
    notes = [
        f"the pattern repeats every {period_s:.6g} s. {repetitions:,} repetitions are combined"
    ]
    if filled:
        notes.append(f"{plural(filled, 'ray')} without a return are interpolated")
    if missing:
        notes.append(f"{plural(missing, 'ray')} without a return are missing from the list")
    spread_rad = float(np.nanmedian([rays.spread_rad for rays in folded.values()]))
    listed_rays = _ray_list(returns, listed, period_s, repeats=True)
    return ListedRays(listed_rays, spread_rad, repetitions, missing, filled, tuple(notes))


def _merged(folded: Mapping[int, _FoldedRays], start_s: float, period_s: float) -> _Pulses:
    """Return the rays of all channels whose directions are known, sorted by time.

    A repetition of the pattern starts at `start_s`.
    """
    rows = {channel: np.flatnonzero(rays.known) for channel, rays in folded.items()}
    time_s = np.concatenate([rays.time_s[rows[channel]] for channel, rays in folded.items()])
    time_s = (time_s - start_s) % period_s
    order = np.argsort(time_s, kind="stable")
    origins = [
        rays.origin[rows[channel]] for channel, rays in folded.items() if rays.origin is not None
    ]
    return _Pulses(
        np.concatenate([rays.direction[rows[channel]] for channel, rays in folded.items()])[order],
        np.concatenate(origins)[order] if origins else None,
        np.repeat([*rows], [len(part) for part in rows.values()])[order],
        time_s[order] - time_s.min(),
    )


@dataclass(frozen=True, eq=False)
class _FoldedRays:
    """Rays of a channel in one repetition of the pattern.

    `known` (f,) marks the firings whose directions are known.
    """

    direction: Floats  # (f, 3)
    origin: Floats | None  # (f, 3), meters
    known: Bools  # (f,)
    time_s: Floats  # (f,)
    spread_rad: float

    @classmethod
    def fold(cls, pulses: _Pulses, rows: Ints, grid: FiringGrid, period_s: float) -> _FoldedRays:
        """Average the directions of all repetitions of each ray."""
        assert pulses.time_s is not None
        count = max(round(period_s / grid.step_s), 1)
        cell = grid.number % count
        sums = np.zeros((count, 3))
        np.add.at(sums, cell, pulses.direction[rows])
        known = np.bincount(cell, minlength=count) > 0
        length = np.linalg.norm(sums, axis=1)
        direction = sums / np.where(known, length, 1)[:, None]
        origin = None
        if pulses.origin is not None:
            origin = np.zeros((count, 3))
            origin[cell] = pulses.origin[rows]
        angle = _angles(pulses.direction[rows], direction[cell])
        several = np.bincount(cell, minlength=count)[cell]
        angle = angle[several > 1] * np.sqrt(several / np.maximum(several - 1, 1))[several > 1]
        spread_rad = float(np.median(angle)) / _MEDIAN_ANGLE if len(angle) else float("nan")
        start_s = float(np.median(pulses.time_s[rows] - grid.step_s * grid.number))
        time_s = np.asarray(start_s + grid.step_s * np.arange(count), np.float64)
        return cls(direction, origin, known, time_s, spread_rad)

    @property
    def firings(self) -> int:
        """Number of firings."""
        return len(self.known)

    @property
    def count(self) -> int:
        """Number of firings whose directions are known."""
        return int(self.known.sum())

    def fill(self) -> _FoldedRays:
        """Interpolate short runs of unknown rays between their neighbors."""
        known = np.flatnonzero(self.known)
        unknown = np.flatnonzero(~self.known)
        if not len(unknown) or len(known) < 2:
            return self
        after = np.searchsorted(known, unknown)
        usable = (after > 0) & (after < len(known))
        unknown, after = unknown[usable], after[usable]
        left, right = known[after - 1], known[after]
        usable = (right - left - 1 <= _MAX_FILLED) & (
            _angles(self.direction[left], self.direction[right]) < _MAX_FILLED_RAD
        )
        unknown, left, right = unknown[usable], left[usable], right[usable]
        share = ((unknown - left) / (right - left))[:, None]
        direction = self.direction.copy()
        middle = (1 - share) * direction[left] + share * direction[right]
        direction[unknown] = middle / np.linalg.norm(middle, axis=1)[:, None]
        filled = self.known.copy()
        filled[unknown] = True
        origin = None if self.origin is None else self.origin.copy()
        if origin is not None:
            origin[unknown] = (1 - share) * origin[left] + share * origin[right]
        return replace(self, direction=direction, known=filled, origin=origin)


def _angles(first: Floats, second: Floats) -> Floats:
    """Return the angles between unit vectors of shape (n, 3), in radians."""
    chord = np.linalg.norm(np.asarray(first) - second, axis=-1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1)))

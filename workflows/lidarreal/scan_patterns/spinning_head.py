"""Beams and rotation of a spinning sensor, estimated from the returns of a stationary recording.

The azimuth of a pulse is a linear function of its time, with an offset for each ring, and the
firing times of a ring are evenly spaced. Recordings without times contain the offsets only as far
as the azimuths of different rings can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.sensor.models import SensorModel
from lidarsim.words import plural

from .lasers import RingLasers
from .pattern_returns import PatternReturns
from .phases import MIN_STEP_RAD, RingPhases, RingSeries, ring_steps

_TURN = 2 * np.pi
_SAME_PULSE_S = 1e-8
_MAX_JOINED_STEPS = 20  # a longer time between returns of a ring may be a sector without returns
_MIN_RETURNS = 50  # minimum number of returns of a ring in a sweep to measure the rotation
_MAX_SPREADS = 10.0  # maximum spread of the elevations of a ring relative to other rings
_MAX_CONE_RAD = np.radians(0.05)  # spread of the elevations of a ring that is always plausible
_MAX_SPREAD_RAD = np.radians(0.5)  # maximum spread of azimuths about an even rotation
_MAX_PHASE_SPREAD = 0.2  # maximum spread of firing phases, in firings
_MAX_FRACTION = 0.02  # maximum deviation from a whole number of firings per revolution
_RATE_DECIMALS = 4
_ANGLE_DECIMALS = 3
_ORIGIN_DECIMALS = 4
_TIME_DECIMALS = 3  # of microseconds
_FIRING_DECIMALS = 6  # of microseconds
_MIN_OFFSET_RAD = np.radians(0.005)  # typical azimuth offset below which offsets are 0
_MIN_TIME = 0.002  # typical time within a firing below which all beams fire at once, in firings
_MAX_EARLY = 0.1  # firings by which a sweep may start after its first firing
_MAX_GAP_RAD = np.radians(60)  # a wider sector without returns is outside the field of view
_TYPICAL_OFFSET_M = 0.035  # offset of a laser whose offset cannot be measured
_MIN_ERROR_RAD = np.radians(0.05)  # error of an elevation below which there is no note
_MIN_ORDER = 0.8  # minimum share of steps in one direction within the rings
_START_MARGIN_RAD = np.radians(6)  # azimuth by which the first points of rings differ
_MAX_SAME_RING = 0.5  # share of consecutive returns of the same ring in files sorted by ring
_ORDER_ROUNDS = 4  # iterations to determine offsets from the order of points
_RATE_HZ = 10.0  # assumed rate without times


@dataclass(frozen=True, eq=False)
class SpinningHead:
    """Pattern of a spinning sensor with r rings, from the highest to the lowest.

    Attributes
    ----------
    lasers
        Elevations and positions of the lasers.
    azimuth_rad
        Azimuth of each ring relative to the head, of shape (r,).
    time_s
        Time of each ring within a firing, of shape (r,), or None if it is unknown.
    firings_per_turn
        Number of firings per revolution.
    rate_hz
        Revolutions per second.
    is_clockwise
        Direction of rotation as seen from above.
    zero_rad
        Azimuth of the head at the first firing of the first sweep.
    max_range_m
        Range limit.
    elevation_spread_rad, azimuth_spread_rad
        Standard deviations of the recorded angles from the pattern for each ring, of shape (r,).
    empty_rad
        Start and stop of a sector without returns, counterclockwise, or None.
    notes
        Notes for the user.
    """

    lasers: RingLasers
    azimuth_rad: Floats
    time_s: Floats | None
    firings_per_turn: float
    rate_hz: float
    is_clockwise: bool
    zero_rad: float
    max_range_m: float
    elevation_spread_rad: Floats
    azimuth_spread_rad: Floats
    empty_rad: tuple[float, float] | None
    notes: tuple[str, ...]

    @classmethod
    def from_returns(cls, returns: PatternReturns) -> SpinningHead:
        """Estimate the pattern.

        Raises
        ------
        LidarError
            If the rings are unknown, or if the returns do not come from a spinning sensor.
        """
        if not len(returns.elevation_rad):
            raise LidarError(
                f"The rings of {returns.name} are unknown or are not cones, so it does not come "
                f"from a spinning sensor. {LIST_ADVICE}"
            )
        returns = returns.select(np.flatnonzero(returns.ring >= 0))
        lasers = _lasers(returns)
        azimuth, elevation = lasers.angles(returns.points, returns.ring)
        measure = _measure_firings if returns.time_s is None else _measure_timed_firings
        firings = measure(returns, azimuth)
        spread = [
            1.4826 * np.median(np.abs(elevation[returns.ring == row] - lasers.elevation_rad[row]))
            for row in range(len(lasers))
        ]
        notes = [*_uncertain_notes(returns, lasers, spread), *_one_range_notes(returns, lasers)]
        return cls(
            lasers=lasers,
            max_range_m=returns.max_range_m,
            elevation_spread_rad=np.array(spread),
            empty_rad=_empty_sector(azimuth),
            **firings | {"notes": (*firings["notes"], *notes)},
        )

    def model(self, name: str) -> SensorModel:
        """Return the sensor model. `name` is the name of the recording."""
        known: dict[str, Any] = {}
        whole = round(self.firings_per_turn)
        if abs(self.firings_per_turn - whole) < _MAX_FRACTION:
            known["firings_per_turn"] = whole
        else:
            firing_us = 1e6 / (self.rate_hz * self.firings_per_turn)
            known["firing_us"] = round(firing_us, _FIRING_DECIMALS)
        source = f"estimated from {name}"
        return SensorModel(
            name="Recorded sensor",
            sources={"angles": source, "times": source if self.time_s is not None else "unknown"},
            clockwise=self.is_clockwise,
            zero_deg=_degrees(np.array([self.zero_rad]) % _TURN)[0],
            rate_hz=round(self.rate_hz, _RATE_DECIMALS),
            range_m=(0.0, self.max_range_m),
            beams=self._beam_table(),
            **known,
        )

    def _beam_table(self) -> dict[str, Any]:
        """Return the `beams` of the sensor model, from the lowest ring to the highest."""
        lasers = self.lasers
        order = np.argsort(lasers.elevation_rad, kind="stable")
        table: dict[str, Any] = {"elevation_deg": _degrees(lasers.elevation_rad[order])}
        if self.azimuth_rad.any():
            table["azimuth_deg"] = _degrees(self.azimuth_rad[order])
        if self.time_s is not None and self.time_s.any():
            table["time_us"] = (1e6 * self.time_s[order]).round(_TIME_DECIMALS).tolist()
        if not lasers.is_at_origin:
            forward = np.zeros(len(lasers))
            origins_m = lasers.positions(forward, lasers.elevation_rad[order], order)
            table["origin_m"] = (origins_m.round(_ORIGIN_DECIMALS) + 0.0).tolist()
        if self.empty_rad is not None:
            start, stop = np.degrees(self.empty_rad).round(1).tolist()
            table["blocked_deg"] = [(beam, start, stop) for beam in range(len(lasers))]
        return table


LIST_ADVICE = "To save a list of its rays instead, use an output file such as rays.npz."


def _uncertain_notes(
    returns: PatternReturns, lasers: RingLasers, spread_rad: list[float]
) -> list[str]:
    """Return a note about rings whose angles are uncertain, if there are any."""
    counts = np.bincount(returns.ring, minlength=len(lasers))
    is_uncertain = counts < _MIN_RETURNS
    is_uncertain |= np.array(spread_rad) > max(_MAX_SPREADS * np.median(spread_rad), _MAX_CONE_RAD)
    uncertain = np.degrees(np.sort(lasers.elevation_rad[is_uncertain]))
    if not len(uncertain):
        return []
    listed = ", ".join(f"{value:.1f}°" for value in uncertain[:8])
    more = ", …" if len(uncertain) > 8 else ""
    return [
        f"the angles of {plural(len(uncertain), 'ring')} are uncertain, because they have few "
        f"returns or returns from the cover ({listed}{more})"
    ]


def _one_range_notes(returns: PatternReturns, lasers: RingLasers) -> list[str]:
    """Return a note about rings whose elevation depends on an unknown offset, if there are any.

    The elevation of a laser and its offset cannot be distinguished at a single range.
    """
    if lasers.is_measured is None:
        return []
    offset_m = max(_TYPICAL_OFFSET_M, float(np.abs(lasers.vertical_m).max()))
    range_m = np.linalg.norm(returns.points, axis=1)
    medians_m = _medians_of_rings(range_m, returns.ring, len(lasers))
    counts = np.bincount(returns.ring, minlength=len(lasers))
    is_unknown = ~lasers.is_measured & (counts >= _MIN_RETURNS)
    is_unknown &= medians_m * _MIN_ERROR_RAD < offset_m
    if not is_unknown.any():
        return []
    elevation_deg = np.degrees(lasers.elevation_rad[is_unknown])
    ranges_m = medians_m[is_unknown]
    error_deg = float(np.degrees(offset_m / ranges_m.min()))
    return [
        f"the elevations of {plural(len(ranges_m), 'ring')} are uncertain "
        f"({_interval(elevation_deg)}°), because each of them has almost the same range "
        f"in all directions ({_interval(ranges_m)} m), from which the position of its "
        f"laser cannot be determined. If the laser is {1e3 * offset_m:.0f} mm from the assumed "
        f"position, the elevation is wrong by up to {error_deg:.2f}°. Record in a larger room, or "
        "tilt the sensor so that each ring has different ranges"
    ]


def _interval(values: Floats) -> str:
    """Return the smallest and the largest value as text, or one value if they are the same."""
    first, last = (f"{value:.1f}" for value in (values.min(), values.max()))
    return first if first == last else f"{first} to {last}"


def _degrees(angles: Floats) -> list[float]:
    return (np.degrees(angles).round(_ANGLE_DECIMALS) + 0.0).tolist()


def _lasers(returns: PatternReturns) -> RingLasers:
    """Determine the lasers, whose elevations are medians over all returns of their rings."""
    sweeps = [
        (returns.points[returns.sweep == number], returns.ring[returns.sweep == number])
        for number in range(returns.sweep_count)
    ]
    return RingLasers.from_sweeps(sweeps, returns.elevation_rad)


def _measure_timed_firings(returns: PatternReturns, azimuth: Floats) -> dict[str, Any]:
    """Determine the rotation and the firing times of a recording with times."""
    assert returns.time_s is not None
    ring, sweep = returns.ring, returns.sweep
    starts_s = returns.sweep_times.starts_s
    since_s = returns.time_s - starts_s[sweep]
    rotation = RingPhases.fit(azimuth, since_s, _rough_rotation(returns, azimuth), ring, sweep)
    if rotation.sigma_rad > _MAX_SPREAD_RAD:
        raise LidarError(
            f"The azimuths of {returns.name} do not increase evenly with time, so it does not come "
            f"from a spinning sensor, or its times are wrong. {LIST_ADVICE}"
        )
    step_s, firings = _firing_phases(returns, since_s, _SAME_PULSE_S, "firing times")
    time_s, first = _times_in_firing(firings.ring_rad / _TURN * step_s, step_s)
    start_s = 0.0 if returns.sweep_times.are_stated else float(since_s[sweep == 0].min())
    # The first firing of the first sweep starts at the earliest beam, not before the sweep.
    late = (float(firings.sweep_rad[0]) / _TURN + first - start_s / step_s) % 1
    first_s = start_s + step_s * (late - 1 if late > 1 - _MAX_EARLY else late)
    azimuth_rad, mean_rad = _centered(rotation.ring_rad)
    return {
        "azimuth_rad": azimuth_rad,
        "time_s": time_s,
        "firings_per_turn": _TURN / (abs(rotation.rate) * step_s),
        "rate_hz": abs(rotation.rate) / _TURN,
        "is_clockwise": rotation.rate < 0,
        "zero_rad": float(rotation.sweep_rad[0] + rotation.rate * first_s + mean_rad),
        "azimuth_spread_rad": rotation.ring_spread_rad,
        "notes": (),
    }


def _rough_rotation(returns: PatternReturns, azimuth: Floats) -> float:
    """Return the approximate angular velocity in radians per second.

    Sectors without returns are excluded, because it is unknown in which direction azimuths change
    across a sector of more than 180°.
    """
    assert returns.time_s is not None
    order = np.lexsort((returns.time_s, returns.ring, returns.sweep))
    group = returns.sweep[order] * len(returns.elevation_rad) + returns.ring[order]
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    rates = []
    for rows in np.split(order, starts[1:]):
        steps_s = np.diff(returns.time_s[rows])
        if len(rows) < _MIN_RETURNS or steps_s.max() <= _SAME_PULSE_S:
            continue
        turned = (np.diff(azimuth[rows]) + np.pi) % _TURN - np.pi
        joined = steps_s < _MAX_JOINED_STEPS * np.median(steps_s[steps_s > _SAME_PULSE_S])
        rates.append(float(turned[joined].sum() / steps_s[joined].sum()))
    if not rates:
        raise LidarError(
            f"The rings of {returns.name} have too few returns, or all returns of a sweep have the "
            "same time. Record at least a full revolution."
        )
    return float(np.median(rates))


def _firing_phases(
    returns: PatternReturns, values: Floats, smallest: float, what: str
) -> tuple[float, RingPhases]:
    """Return the step between the firings of a ring, and the phases of its firings.

    `values` are times or azimuths.
    """
    ring, sweep = returns.ring, returns.sweep
    series = RingSeries.from_values(values, ring, sweep)
    steps = ring_steps(*series.gaps(smallest), len(returns.elevation_rad))
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else float("nan")
    if not step > 0:
        raise LidarError(f"{returns.name} has too few returns to determine its {what}.")
    step = series.refine_step(step, smallest)
    slow = [row for row in range(len(steps)) if steps[row] > 1.5 * step]
    if slow:
        raise LidarError(
            f"{len(slow)} of the {len(steps)} rings of {returns.name} fire less often than the "
            f"others, which a sensor file cannot describe. {LIST_ADVICE}"
        )
    phases = RingPhases.fit(np.zeros(len(values)), values, -_TURN / step, ring, sweep)
    step = _TURN / abs(phases.rate)
    if phases.sigma_rad > _MAX_PHASE_SPREAD * _TURN:
        raise LidarError(
            f"The {what} of {returns.name} are not evenly spaced, or their noise is as large as "
            f"the distance between pulses. {LIST_ADVICE}"
        )
    return step, phases


def _times_in_firing(offset_s: Floats, step_s: float) -> tuple[Floats, float]:
    """Return the times of the rings within a firing, and the start of the firing in firings.

    A firing starts after the largest gap between the times of its rings. `offset_s` are the times
    of the rings relative to an arbitrary time.
    """
    offset = np.where(np.isnan(offset_s), np.nanmedian(offset_s), offset_s) / step_s
    ordered = np.sort(offset % 1)
    gaps = np.diff(ordered, append=ordered[0] + 1)
    first = float(ordered[(int(gaps.argmax()) + 1) % len(ordered)])
    times = (offset - first + _MIN_TIME) % 1 - _MIN_TIME
    if np.ptp(times) < _MIN_TIME or np.median(np.abs(times - np.median(times))) < _MIN_TIME:
        return np.zeros(len(times)), first
    return step_s * (times - times.min()), first + float(times.min())


def _centered(ring_rad: Floats) -> tuple[Floats, float]:
    """Return the azimuth offsets of rings, and the mean that was subtracted from them.

    Offsets that are typically insignificant are zeros.
    """
    known = np.where(np.isnan(ring_rad), 0.0, ring_rad)
    typical = float(np.median(np.abs(known - np.median(known))))
    if typical < _MIN_OFFSET_RAD:
        return np.zeros(len(known)), float(np.median(known))
    return known, 0.0


def _empty_sector(azimuth: Floats) -> tuple[float, float] | None:
    """Return the start and stop of a wide sector without returns, or None if there is none."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[0] + _TURN)
    widest = int(gaps.argmax())
    if gaps[widest] < _MAX_GAP_RAD:
        return None
    return float(ordered[widest]), float(ordered[(widest + 1) % len(ordered)])


def _measure_firings(returns: PatternReturns, azimuth: Floats) -> dict[str, Any]:
    """Determine the rotation of a recording without times."""
    ring, sweep = returns.ring, returns.sweep
    notes = ["the firing times within a column are unknown, because the points have no times"]
    is_clockwise = _direction(returns, azimuth)
    if is_clockwise is None:
        notes.append("the direction of rotation is unknown. Counterclockwise is assumed")
    else:
        azimuth = _since_start(returns, azimuth, is_clockwise=is_clockwise)
    step_rad, firings = _firing_phases(returns, azimuth, MIN_STEP_RAD, "azimuth steps")
    ring_rad = firings.ring_rad / _TURN * step_rad
    ordered_rad = _offsets_in_order(returns, azimuth, ring_rad, step_rad)
    if ordered_rad is None:
        notes.append(
            "the azimuth offsets of the rings are known except for whole azimuth steps, because "
            "the points are not in firing order"
        )
    rate_hz = _RATE_HZ
    if returns.sweep_times.are_stated:
        rate_hz = 1 / returns.sweep_times.period_s
    else:
        notes.append(f"the rotation rate is unknown. {_RATE_HZ:g} Hz are assumed")
    azimuth_rad, mean_rad = _centered(ring_rad if ordered_rad is None else ordered_rad)
    first = int(np.flatnonzero(sweep == sweep[0])[0])
    start_rad = azimuth[first] - azimuth_rad[ring[first]] - mean_rad
    zero = np.rint((start_rad * _TURN / step_rad - firings.sweep_rad[0]) / _TURN)
    return {
        "azimuth_rad": azimuth_rad,
        "time_s": None,
        "firings_per_turn": _TURN / step_rad,
        "rate_hz": rate_hz,
        "is_clockwise": bool(is_clockwise),
        "zero_rad": float((zero + firings.sweep_rad[0] / _TURN) * step_rad + mean_rad),
        "azimuth_spread_rad": firings.ring_spread_rad / _TURN * step_rad,
        "notes": tuple(notes),
    }


def _direction(returns: PatternReturns, azimuth: Floats) -> bool | None:
    """Return whether the sensor rotates clockwise, or None if the order of points is arbitrary."""
    order = np.lexsort((returns.ring, returns.sweep))  # stable, so the order in a ring remains
    turned = np.diff(azimuth[order])
    is_same = (np.diff(returns.ring[order]) == 0) & (np.diff(returns.sweep[order]) == 0)
    signs = np.sign((turned[is_same] + np.pi) % _TURN - np.pi)
    mean = float(signs.mean()) if len(signs) else 0.0
    return None if abs(mean) < 2 * _MIN_ORDER - 1 else mean < 0


def _since_start(returns: PatternReturns, azimuth: Floats, *, is_clockwise: bool) -> Floats:
    """Return azimuths that do not jump within a sweep.

    If a revolution is not a whole number of firings, the azimuths of consecutive revolutions
    differ. A sweep therefore starts at the azimuth of its first points, and its azimuths continue
    to increase where it passes this azimuth again. Points are in order within their rings.
    """
    sign = -1.0 if is_clockwise else 1.0
    _, first = np.unique(returns.sweep, return_index=True)
    start_rad = sign * azimuth[first][returns.sweep - returns.sweep[0]] - _START_MARGIN_RAD
    since_rad = (sign * azimuth - start_rad) % _TURN
    order = np.lexsort((returns.ring, returns.sweep))  # stable, so the order in a ring remains
    before, after = since_rad[order[:-1]], since_rad[order[1:]]
    is_passed = (after < before - np.pi).astype(np.int64)
    is_passed -= (before < _START_MARGIN_RAD) & (after > _TURN - _START_MARGIN_RAD)
    group = returns.sweep[order] * (returns.ring.max() + 1) + returns.ring[order]
    is_first = np.diff(group, prepend=-1) != 0
    passed = np.append(0, np.cumsum(np.where(is_first[1:], 0, is_passed)))
    passed -= passed[is_first].repeat(np.diff(np.flatnonzero(np.append(is_first, True))))
    turns = np.empty(len(order))
    turns[order] = passed
    return np.asarray(sign * (start_rad + since_rad + _TURN * turns))


def _offsets_in_order(
    returns: PatternReturns, azimuth: Floats, ring_rad: Floats, step_rad: float
) -> Floats | None:
    """Return the azimuth offsets of rings, including whole steps, if points are in firing order.

    Rings that are fired together are adjacent in the recording, so the azimuth of the head is the
    median azimuth of neighboring points. `ring_rad` are the offsets modulo `step_rad`.
    """
    from scipy.ndimage import median_filter

    rows = np.flatnonzero(returns.sweep == np.bincount(returns.sweep).argmax())
    ring = returns.ring[rows]
    if (np.diff(ring) == 0).mean() > _MAX_SAME_RING:
        return None
    turned = np.unwrap(azimuth[rows])
    width = 4 * len(ring_rad) + 1
    offset_rad = np.zeros(len(ring_rad))
    for _ in range(_ORDER_ROUNDS):
        head = median_filter(turned - offset_rad[ring], width, mode="nearest")
        offset_rad = _medians_of_rings(turned - head, ring, len(ring_rad))
    whole = np.rint((offset_rad - ring_rad) / step_rad)
    found = ring_rad + step_rad * whole
    return found - np.nanmean(found)


def _medians_of_rings(values: Floats, ring: Ints, count: int) -> Floats:
    medians = [np.median(values[ring == row]) if (ring == row).any() else 0 for row in range(count)]
    return np.array(medians)

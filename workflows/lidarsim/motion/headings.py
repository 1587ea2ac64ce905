"""Headings along the direction of travel, for platforms whose poses contain no angles.

The heading is the direction of the horizontal velocity. It is undefined while a platform is
stationary or moves vertically. The platform then keeps its heading, and turns to the next heading
in the last second. At the corners between straight legs, the platform turns at a constant rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats, Indices
from ..numerics.elementary import arctan2, interp, sin_cos
from ..numerics.vectors import hypot
from .spline import evaluate_curve, is_stationary

# A platform turns within this distance before and after a corner. On a leg shorter than twice this
# distance, the turn extends to the center of the leg.
CORNER_M = 1.0
STATIONARY_TURN_S = 1.0  # maximum time in which a stationary platform turns to its next heading

_SAME = 1e-9  # horizontal distances in m and speeds in m/s below this value are considered zero
_ROOM = 1.001  # legs that are hardly longer than two corners are divided at their center
_NEAR_END = 2.0**-10  # fraction of a step near a stop in which rounding errors affect velocities


class _Turns(NamedTuple):
    """Consecutive changes of heading."""

    starts_s: Floats  # (n,), ascending
    stops_s: Floats  # (n,), not after the next start
    yaws: Floats  # (n + 1,), radians, before, between and after the turns


class HeadedPoses(NamedTuple):
    """Poses of a platform on straight legs, including the poses where turns start and end."""

    times_s: Floats  # (n,)
    positions: Floats  # (n, 3), meters
    quaternions: Floats  # (n, 4)


def headed_poses(times_s: Floats, positions: Floats) -> HeadedPoses:
    """Return the poses of a level platform that travels along straight legs.

    Parameters
    ----------
    times_s
        Times in seconds, in ascending order. Shape (k,).
    positions
        Positions in meters. Shape (k, 3).
    """
    turns = _turns_between_legs(times_s, positions)
    times = np.unique(np.concatenate([times_s, turns.starts_s, turns.stops_s]))
    yaws = np.full(len(times), turns.yaws[0])
    if len(turns.starts_s):
        moments = np.stack([turns.starts_s, turns.stops_s], axis=1).reshape(-1)
        yaws = interp(times, moments, turns.yaws.repeat(2)[1:-1])
    columns = [interp(times, times_s, np.ascontiguousarray(column)) for column in positions.T]
    sine, cosine = sin_cos(yaws / 2)
    level = np.zeros_like(sine)
    quaternions = np.stack([level, level, sine, cosine], axis=1)
    return HeadedPoses(times, np.stack(columns, axis=1), quaternions)


def _turns_between_legs(times_s: Floats, positions: Floats) -> _Turns:
    """Return the turns at the corners between straight legs."""
    legs = np.diff(positions[:, :2], axis=0)
    lengths = hypot(*legs.T)
    moving = np.flatnonzero(lengths > _SAME)
    if not len(moving):
        return _Turns(np.zeros(0), np.zeros(0), np.zeros(1))
    before = moving[:-1]
    after = moving[1:]
    arrive = times_s[before + 1]
    leave = times_s[after]
    # Both ends of a leg use the same expressions, so that turns never overlap due to rounding.
    midpoints = (times_s[:-1] + times_s[1:]) / 2
    is_long = lengths > 2 * CORNER_M * _ROOM
    corner_s = CORNER_M * np.diff(times_s) / np.where(is_long, lengths, 1.0)
    starts = np.where(is_long[before], arrive - corner_s[before], midpoints[before])
    stops = np.where(is_long[after], leave + corner_s[after], midpoints[after])
    pauses = after > before + 1
    starts[pauses] = np.where(
        leave - arrive > STATIONARY_TURN_S * _ROOM, leave - STATIONARY_TURN_S, arrive
    )[pauses]
    stops[pauses] = leave[pauses]
    yaws = arctan2(legs[moving, 1], legs[moving, 0])
    return _nonzero_turns(starts, stops, yaws)


def _nonzero_turns(starts: Floats, stops: Floats, yaws: Floats) -> _Turns:
    """Return the turns between headings. Each turn takes the shorter direction."""
    changes = np.diff(yaws)
    changes -= 2 * np.pi * np.round(changes / (2 * np.pi))
    turning = np.abs(changes) > 1e-12
    followed = np.append(yaws[0], yaws[0] + np.cumsum(changes[turning]))
    return _Turns(starts[turning], stops[turning], followed)


class Heading(NamedTuple):
    """Headings at k times, and their rates of change."""

    cosines: Floats  # (k,)
    sines: Floats  # (k,)
    rates: Floats  # (k,), rad/s


class _Stops(NamedTuple):
    """Intervals in which a platform is stationary, with the headings before and after.

    The first interval ends when the platform starts to travel, and the last interval starts when it
    stops for the last time. Both intervals exist even if they have no duration.
    """

    arrivals_s: Floats  # (n,), ascending
    departures_s: Floats  # (n,)
    yaws: Floats  # (n, 2), radians

    @classmethod
    def between(cls, times_s: Floats, travels: Bools, first: Floats, last: Floats) -> _Stops:
        """Create an interval for each stop between segments on which the platform travels.

        Parameters
        ----------
        times_s
            Times of the knots. Shape (n,).
        travels
            Whether the platform travels between each knot and the next. Shape (n - 1,).
        first, last
            First and last horizontal velocity between each knot and the next. Shape (n - 1, 2).
        """
        moving = np.flatnonzero(travels)
        if not len(moving):
            return cls(times_s[:1], times_s[-1:], np.zeros((1, 2)))
        gaps = np.flatnonzero(np.diff(moving) > 1)
        arrived = np.append(moving[gaps], moving[-1])
        left = np.append(moving[0], moving[gaps + 1])
        arrival_yaws = arctan2(last[arrived, 1], last[arrived, 0])
        departure_yaws = arctan2(first[left, 1], first[left, 0])
        return cls(
            arrivals_s=np.append(times_s[0], times_s[arrived + 1]),
            departures_s=np.append(times_s[left], times_s[-1]),
            yaws=np.stack(
                [
                    np.append(departure_yaws[0], arrival_yaws),
                    np.append(departure_yaws, arrival_yaws[-1]),
                ],
                axis=1,
            ),
        )

    def at(self, times_s: Floats) -> Heading:
        """Return the headings at times when the platform is stationary.

        Times and headings have shape (k,).
        """
        row = np.clip(np.searchsorted(self.arrivals_s, times_s, "right") - 1, 0, None)
        stops_s = self.departures_s.take(row)
        duration = np.minimum(stops_s - self.arrivals_s.take(row), STATIONARY_TURN_S)
        duration = np.where(duration > 0, duration, STATIONARY_TURN_S)
        first, last = self.yaws.take(row, axis=0).T
        change = last - first
        change = change - 2 * np.pi * np.round(change / (2 * np.pi))
        fraction = ((times_s - (stops_s - duration)) / duration).clip(0.0, 1.0)
        # A polynomial whose first and second derivatives are 0 at both ends.
        progress = fraction * fraction * fraction * (10 - 15 * fraction + 6 * fraction * fraction)
        sine, cosine = sin_cos(first + change * progress)
        slope = 30 * (fraction * (1 - fraction)) * (fraction * (1 - fraction))
        return Heading(cosine, sine, change * slope / duration)


@dataclass(frozen=True, eq=False)
class CurveHeadings:
    """Headings along the horizontal tangent of a smooth curve.

    Attributes
    ----------
    times_s
        Times of the knots. Shape (n,).
    knots
        Positions and their first two derivatives, from `fit_knots`. Shape (3, 3, n).
    still
        Whether the curve is stationary at each knot. Shape (n,).
    travels
        Whether the platform moves horizontally after each knot, so that the tangent is defined.
        Shape (n - 1,).
    first
        First horizontal velocity above zero after each knot. Shape (n - 1, 2).
    stops
        Intervals in which the platform is stationary or moves vertically.
    """

    times_s: Floats
    knots: Floats
    still: Bools
    travels: Bools
    first: Floats
    stops: _Stops

    @classmethod
    def from_knots(cls, times_s: Floats, knots: Floats) -> CurveHeadings:
        """Create the headings of a curve, given its knots and their times.

        The knots have shape (3, 3, n), and the times have shape (n,).
        """
        steps = np.diff(times_s)
        still: Bools = np.asarray(~knots[1:].any(axis=(0, 1)))
        count = len(steps)
        fractions = np.array([_NEAR_END, 0.5, 1 - _NEAR_END])
        since = (steps[:, None] * fractions).reshape(-1)
        slopes = evaluate_curve(knots, steps, np.arange(count).repeat(3), since, 1)[1]
        velocities = slopes[:2].T.reshape(count, 3, 2)
        moves = hypot(velocities[..., 0], velocities[..., 1]) > _SAME
        # Both ends of a pause are stationary, but so are the ends of a leg between two stops.
        moves[is_stationary(steps, np.diff(knots[0]) / steps)] = False
        travels = moves.any(axis=1)
        rows = np.arange(count)
        first = velocities[rows, moves.argmax(axis=1)]
        last = velocities[rows, 2 - moves[:, ::-1].argmax(axis=1)]
        stops = _Stops.between(times_s, travels, first, last)
        return cls(times_s, knots, still, travels, first, stops)

    def at(self, segment: Indices, since: Floats) -> Heading:
        """Return the headings `since` seconds after the knots with the indices `segment`.

        Both arrays have shape (k,).
        """
        tangent = self._tangent(segment, since)
        if self.travels.all():
            return tangent
        travels = self.travels.take(segment)
        stationary = self.stops.at(self.times_s.take(segment) + since)
        pairs = zip(tangent, stationary, strict=True)
        return Heading(*(np.where(travels, one, other) for one, other in pairs))

    def _tangent(self, segment: Indices, since: Floats) -> Heading:
        """Return the headings on the segments on which the platform travels."""
        steps = np.diff(self.times_s)
        step = steps.take(segment)
        near_start = np.where(self.still.take(segment), _NEAR_END * step, 0.0)
        near_stop = np.where(self.still.take(segment + 1), step - _NEAR_END * step, step)
        inside = since.clip(near_start, near_stop)
        _, velocity, change = evaluate_curve(self.knots[:, :2], steps, segment, inside, 2)
        speed = hypot(*velocity)
        slow = np.flatnonzero(speed <= _SAME)
        velocity[:, slow] = self.first[segment[slow]].T
        speed[slow] = hypot(*velocity[:, slow])
        x, y = velocity / np.where(speed > 0, speed, 1.0)
        rates = (x * change[1] - y * change[0]) / np.where(speed > 0, speed, 1.0)
        rates[inside != since] = 0.0
        rates[slow] = 0.0
        return Heading(x, y, rates)

"""Paths of an aircraft along flight lines, with turns at a constant bank angle between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats

BANK_DEG = 20.0  # bank angle of turns, which determines their radius
LEAD_S = 5.0  # duration of straight flight before and after each flight line
SAMPLE_S = 0.5  # interval between poses
_GRAVITY_M_S2 = 9.80665
_ROLL_SAMPLES = 5  # number of samples over which the aircraft rolls into a turn
_MAX_POSES = 200_000
_ROUNDING = 1e-9  # maximum rounding error of angles and lengths for a turn radius of 1
# Curvature signs of the three segments of a shortest path (Dubins 1957).
_WORDS = {
    "LSL": (1, 0, 1),
    "RSR": (-1, 0, -1),
    "LSR": (1, 0, -1),
    "RSL": (-1, 0, 1),
    "RLR": (-1, 1, -1),
    "LRL": (1, -1, 1),
}


class FlightLeg(NamedTuple):
    """A straight line that an aircraft flies while its scanner is on."""

    start: Floats  # (2,), meters
    stop: Floats  # (2,), meters
    # (k,), heights of the aircraft at evenly spaced positions from the start to the stop, meters
    heights: Floats

    @property
    def length_m(self) -> float:
        """Length in meters."""
        return float(np.hypot(*(self.stop - self.start)))

    @property
    def direction(self) -> float:
        """Direction of flight in radians, counterclockwise from x."""
        return float(np.arctan2(*(self.stop - self.start)[::-1]))


class FlightPath(NamedTuple):
    """Timed poses of an aircraft, and the times at which it starts each flight line.

    The aircraft flies at a constant speed over ground with zero pitch, and banks in turns.
    """

    times_s: Floats  # (k,)
    positions: Floats  # (k, 3), meters
    yaw_deg: Floats  # (k,), counterclockwise from x, continuous
    roll_deg: Floats  # (k,), positive if the right side is down
    starts_s: Floats  # (legs,)
    durations_s: Floats  # (legs,)


class _Section(NamedTuple):
    """Part of a path with a constant curvature."""

    curvature: float  # 1/m, positive to the left
    length_m: float


def turn_radius_m(speed_m_s: float) -> float:
    """Return the radius of a coordinated turn in meters."""
    return speed_m_s**2 / (_GRAVITY_M_S2 * math.tan(math.radians(BANK_DEG)))


def fly(legs: Sequence[FlightLeg], speed_m_s: float) -> FlightPath:
    """Return the path along flight lines, in their order, at a constant speed over ground.

    Before and after each line, the aircraft flies straight for `LEAD_S`. The turns are the shortest
    paths with the radius of a coordinated turn.

    Raises
    ------
    LidarError
        If the flight is too long to be sampled.
    """
    lead_m = LEAD_S * speed_m_s
    sections: list[_Section] = []
    starts_m: list[float] = []
    length_m = 0.0
    for leg, following in [*pairwise(legs), (legs[-1], None)]:
        starts_m.append(length_m + lead_m)
        straight = [_Section(0.0, leg.length_m + 2 * lead_m)]
        turn = [] if following is None else _turn(leg, following, lead_m, turn_radius_m(speed_m_s))
        sections += [*straight, *turn]
        length_m += sum(section.length_m for section in (*straight, *turn))
    count = math.ceil(length_m / (speed_m_s * SAMPLE_S)) + 1
    if count > _MAX_POSES:
        raise LidarError(
            f"The flight would last {length_m / speed_m_s / 3600:.0f} hours. Plan a smaller area, "
            "or increase `--agl` or `--speed`."
        )
    along_m = np.linspace(0.0, length_m, count)
    first = legs[0]
    ahead = np.array([math.cos(first.direction), math.sin(first.direction)])
    plane = _follow(sections, first.start - lead_m * ahead, first.direction, along_m)
    heights = _heights(legs, np.array(starts_m), along_m)
    rolls_deg = -np.degrees(np.arctan(plane.curvatures * speed_m_s**2 / _GRAVITY_M_S2))
    kernel = np.ones(_ROLL_SAMPLES) / _ROLL_SAMPLES
    return FlightPath(
        times_s=along_m / speed_m_s,
        positions=np.column_stack([plane.positions, heights]),
        yaw_deg=np.degrees(plane.directions),
        roll_deg=np.convolve(np.pad(rolls_deg, _ROLL_SAMPLES // 2, "edge"), kernel, "valid"),
        starts_s=np.array(starts_m) / speed_m_s,
        durations_s=np.array([leg.length_m for leg in legs]) / speed_m_s,
    )


def _turn(leg: FlightLeg, following: FlightLeg, lead_m: float, radius_m: float) -> list[_Section]:
    """Return the turn from the end of a line to the start of the next, including their leads."""
    directions = leg.direction, following.direction
    ahead = [np.array([math.cos(angle), math.sin(angle)]) for angle in directions]
    start = leg.stop + lead_m * ahead[0]
    stop = following.start - lead_m * ahead[1]
    return shortest_turn(start, directions[0], stop, directions[1], radius_m)


def shortest_turn(
    start: Floats, start_angle: float, stop: Floats, stop_angle: float, radius_m: float
) -> list[_Section]:
    """Return the shortest path between two directed points with a minimum turn radius.

    The path consists of at most three arcs and straight sections (Dubins 1957).

    Parameters
    ----------
    start, stop
        Points with shape (2,), in meters.
    start_angle, stop_angle
        Directions in radians, counterclockwise from x.
    radius_m
        Radius of the arcs in meters.
    """
    offset = stop - start
    bearing = math.atan2(offset[1], offset[0])
    d = math.hypot(*offset) / radius_m
    paths = []
    for word, parts in _dubins(start_angle - bearing, stop_angle - bearing, d).items():
        sections = [
            _Section(sign / radius_m, part * radius_m)
            for sign, part in zip(_WORDS[word], parts, strict=True)
        ]
        total = sum(section.length_m for section in sections)
        end = _follow(sections, start, start_angle, np.array([total])).positions[0]
        if np.hypot(*(end - stop)) < 1e-6 * max(radius_m, 1.0):
            paths.append((total, word, sections))
    return min(paths, key=lambda path: path[:2])[2]


def _dubins(a: float, b: float, d: float) -> dict[str, tuple[float, float, float]]:
    """Return the segment lengths of candidate paths for a turn radius of 1.

    The start is at the origin in the direction `a`, and the stop is at (d, 0) in the direction `b`.
    """
    sa, sb, ca, cb = math.sin(a), math.sin(b), math.cos(a), math.cos(b)
    cab = math.cos(a - b)
    lengths: dict[str, tuple[float, float, float]] = {}
    # The straight section connects the centers of both arcs. If they coincide, there is one arc.
    east, north = d + sa - sb, cb - ca
    p = math.hypot(east, north)
    angle = math.atan2(north, east) if p > _ROUNDING else b
    lengths["LSL"] = angle - a, p, b - angle
    east, north = d - sa + sb, ca - cb
    p = math.hypot(east, north)
    angle = math.atan2(north, east) if p > _ROUNDING else b
    lengths["RSR"] = a - angle, p, angle - b
    if (square := -2 + d * d + 2 * cab + 2 * d * (sa + sb)) >= 0:
        p = math.sqrt(square)
        angle = math.atan2(-ca - cb, d + sa + sb) - math.atan2(-2.0, p)
        lengths["LSR"] = angle - a, p, angle - b
    if (square := -2 + d * d + 2 * cab - 2 * d * (sa + sb)) >= 0:
        p = math.sqrt(square)
        angle = math.atan2(ca + cb, d - sa - sb) - math.atan2(2.0, p)
        lengths["RSL"] = a - angle, p, b - angle
    cosine = (6 - d * d + 2 * cab + 2 * d * (sa - sb)) / 8
    if abs(cosine) <= 1:
        p = 2 * math.pi - math.acos(cosine)
        t = a - math.atan2(ca - cb, d - sa + sb) + p / 2
        lengths["RLR"] = t, p, a - b - t + p
    cosine = (6 - d * d + 2 * cab + 2 * d * (sb - sa)) / 8
    if abs(cosine) <= 1:
        p = 2 * math.pi - math.acos(cosine)
        t = -a - math.atan2(ca - cb, d + sa - sb) + p / 2
        lengths["LRL"] = t, p, b - a - t + p
    return {
        word: (_arc(t), p if word[1] == "S" else _arc(p), _arc(q))
        for word, (t, p, q) in lengths.items()
    }


def _arc(angle: float) -> float:
    """Return an angle from 0 to 2π, where a rounding error below 0 is no full circle."""
    turn = 2 * math.pi
    reduced = angle % turn
    return 0.0 if turn - reduced < _ROUNDING else reduced


class _Plane(NamedTuple):
    """Positions, directions and curvatures along a path."""

    positions: Floats  # (k, 2)
    directions: Floats  # (k,), radians
    curvatures: Floats  # (k,), 1/m


def _follow(sections: Sequence[_Section], start: Floats, angle: float, along_m: Floats) -> _Plane:
    """Return the states at distances `along_m` (ascending) from the start of a path."""
    positions = np.empty((len(along_m), 2))
    directions = np.empty(len(along_m))
    curvatures = np.zeros(len(along_m))
    begin_m = 0.0
    point = np.asarray(start, np.float64)
    for number, (curvature, length_m) in enumerate(sections):
        is_last = number == len(sections) - 1
        rows = (along_m >= begin_m) & ((along_m < begin_m + length_m) | is_last)
        since_m = np.append(along_m[rows] - begin_m, length_m)
        # The chord of an arc points in its mean direction.
        half = curvature * since_m / 2
        chord = (since_m * np.sinc(half / np.pi))[:, None]
        moved = point + chord * np.column_stack([np.cos(angle + half), np.sin(angle + half)])
        positions[rows] = moved[:-1]
        directions[rows] = angle + 2 * half[:-1]
        curvatures[rows] = curvature
        point = moved[-1]
        angle += curvature * length_m
        begin_m += length_m
    return _Plane(positions, directions, curvatures)


def _heights(legs: Sequence[FlightLeg], starts_m: Floats, along_m: Floats) -> Floats:
    """Return the heights along a path, which change smoothly between the legs."""
    heights = np.empty(len(along_m))
    stops_m = starts_m + [leg.length_m for leg in legs]
    heights[along_m <= starts_m[0]] = legs[0].heights[0]
    heights[along_m >= stops_m[-1]] = legs[-1].heights[-1]
    for leg, start_m, stop_m in zip(legs, starts_m, stops_m, strict=True):
        rows = (along_m >= start_m) & (along_m <= stop_m)
        knots = np.linspace(start_m, stop_m, len(leg.heights))
        heights[rows] = np.interp(along_m[rows], knots, leg.heights)
    for number, (leg, following) in enumerate(pairwise(legs)):
        start_m, stop_m = stops_m[number], starts_m[number + 1]
        rows = (along_m > start_m) & (along_m < stop_m)
        share = (along_m[rows] - start_m) / (stop_m - start_m)
        eased = share * share * (3 - 2 * share)
        heights[rows] = leg.heights[-1] + eased * (following.heights[0] - leg.heights[-1])
    return heights

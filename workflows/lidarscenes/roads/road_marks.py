"""Convert road marks to quadrilaterals slightly above the lane triangles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints

from .cross_sections import GAP_M
from .elements import UnreadElements, read_non_negative, read_number
from .lanes import Lane, SectionSurface

LIFT_M = 0.003  # height above the road, which is the thickness of thermoplastic marks
DASH_M = 3.0  # default length of dashes
SPACE_M = 6.0  # default length of gaps
WIDTH_M = 0.12  # default width of marks
_DOT_M = 0.1  # length of Botts' dots
_DOT_SPACE_M = 1.2
# The lines of a mark from right to left; True for a broken line.
_LINES = {
    "solid": (False,),
    "broken": (True,),
    "solid solid": (False, False),
    "solid broken": (False, True),
    "broken solid": (True, False),
    "broken broken": (True, True),
}
_UNPAINTED = ("none", "curb", "edge", "grass", "custom")
_BYTES_PER_DASH = 600
_KNOWN = ("type", "explicit")


class _Line(NamedTuple):
    """A painted line of a road mark, which consists of dashes along the road."""

    starts: Floats  # (d,) starts of the dashes in meters, ascending
    stops: Floats  # (d,) stops of the dashes in meters
    shift: float  # distance to the left of the border in meters
    width: float  # in meters
    color: str


class PaintedQuads(NamedTuple):
    """The road marks that have a certain color."""

    color: str
    points: Floats  # (v, 3) in meters
    faces: Ints  # (f, 3)


def painted_quads(
    surface: SectionSurface, allowance: Allowance, unread: UnreadElements
) -> list[PaintedQuads]:
    """Return the road marks of a lane section, grouped by color."""
    section = surface.section
    lanes = [*section.all_lanes, *([section.middle] if section.middle else [])]
    knots = [
        _knots_of(line, surface, surface.borders[lane.number])
        for lane in lanes
        for line in _lines_of(lane, section.start, section.stop, allowance, unread)
    ]
    knots = [entry for entry in knots if len(entry.quads)]
    if not knots:
        return []
    points = _points_of(surface, knots)
    quads_of_colors: dict[str, list[Ints]] = {}  # first cross sections of quadrilaterals
    offset = 0
    for entry in knots:
        quads_of_colors.setdefault(entry.color, []).append(offset + entry.quads)
        offset += len(entry.stations)
    return [
        PaintedQuads(color, points, _quads(np.concatenate(quads), offset))
        for color, quads in quads_of_colors.items()
    ]


def _quads(right: Ints, count: int) -> Ints:
    """Return the triangles between each given cross section and the next one.

    `right` contains the indices of the right points. The left points are `count` indices later.
    """
    left = right + count
    return np.concatenate(
        [
            np.stack([right, right + 1, left + 1], axis=1),
            np.stack([right, left + 1, left], axis=1),
        ]
    )


class _Knots(NamedTuple):
    """The cross sections of a painted line."""

    stations: Ints  # (q,) last station before each cross section, ascending
    shares: Floats  # (q,) fraction of the distance to the next station
    first_t: Floats  # (q,) t coordinate of the line's center at `stations`
    second_t: Floats  # (q,) t coordinate at the following stations
    width: float  # in meters
    quads: Ints  # (p,) cross sections at which quadrilaterals start
    color: str


def _knots_of(line: _Line, surface: SectionSurface, border: Floats) -> _Knots:
    """Return a line's cross sections, at the ends of dashes and at the stations within dashes.

    Where the road steps, a line ends before the step and continues after it.
    """
    s = surface.stations.s
    last = len(s) - 1
    if len(line.starts) == 1 and line.starts[0] <= s[0] and line.stops[0] >= s[-1]:
        stations = np.append(np.arange(last), last - 1)
        fractions = np.append(np.zeros(last), 1.0)
        quads = np.delete(np.arange(last), surface.steps)
    else:
        stations, fractions, quads = _dashed_knots(line, s, surface.steps)
    middle = border + line.shift
    return _Knots(
        stations=stations,
        shares=fractions,
        first_t=middle[stations],
        second_t=middle[stations + 1],
        width=line.width,
        quads=quads,
        color=line.color,
    )


def _dashed_knots(line: _Line, s: Floats, steps: Ints) -> tuple[Ints, Floats, Ints]:
    """Return where a dashed line has cross sections, and which quadrilaterals are painted.

    `s` (k,) are the distances of the section's stations in meters, and `steps` (j,) the stations
    before a step, where the next station has the same distance.
    """
    last = len(s) - 1
    # At a step, a dash starts at the station after it, and stops at the station before it.
    starts = _positions(line.starts, s, np.searchsorted(s, line.starts, "right") - 1)
    stops = _positions(line.stops, s, np.searchsorted(s, line.stops, "left") - 1)
    positions = np.sort(np.concatenate([starts, stops, np.arange(last + 1)]))
    positions = positions[np.append(True, np.diff(positions) > 0)]
    midpoints = (positions[1:] + positions[:-1]) / 2
    dash = np.searchsorted(starts, midpoints, "right") - 1
    is_painted = (dash >= 0) & (midpoints < stops[np.maximum(dash, 0)])
    if len(steps):
        is_painted &= ~np.isin(midpoints.astype(np.int64), steps)
    stations = np.minimum(positions.astype(np.int64), last - 1)
    return stations, positions - stations, np.flatnonzero(is_painted)


def _positions(distances: Floats, s: Floats, stations: Ints) -> Floats:
    """Convert distances to fractional station indices."""
    stations = np.minimum(np.maximum(stations, 0), len(s) - 2)
    lengths = np.maximum(s[stations + 1] - s[stations], GAP_M)
    fractions = (distances - s[stations]) / lengths
    return np.asarray(stations + np.minimum(np.maximum(fractions, 0), 1))


def _points_of(surface: SectionSurface, knots: Sequence[_Knots]) -> Floats:
    """Return points on the right edges of all lines, and then on the left edges. Shape (2q, 3)."""
    station_indices = np.concatenate([entry.stations for entry in knots])
    fractions = np.concatenate([entry.shares for entry in knots])
    first_t = np.concatenate([entry.first_t for entry in knots])
    second_t = np.concatenate([entry.second_t for entry in knots])
    half = np.concatenate([np.full(len(entry.stations), entry.width / 2) for entry in knots])
    count = len(station_indices)
    corners = surface.points(
        np.concatenate(
            [station_indices, station_indices, station_indices + 1, station_indices + 1]
        ),
        np.concatenate([first_t - half, first_t + half, second_t - half, second_t + half]),
    )
    both_fractions = np.concatenate([fractions, fractions])[:, None]
    points = corners[: 2 * count] + both_fractions * (corners[2 * count :] - corners[: 2 * count])
    up = surface.frames.up[np.concatenate([station_indices, station_indices])]
    return np.asarray(points + LIFT_M * up)


def _lines_of(
    lane: Lane, start: float, stop: float, allowance: Allowance, unread: UnreadElements
) -> Iterator[_Line]:
    """Yield a lane's painted lines between two distances along the road."""
    marks = lane.element.findall("roadMark")
    if all(mark.get("type", "none") in _UNPAINTED for mark in marks):
        return
    starts = [start + read_number(mark, "sOffset", 0.0) for mark in marks]
    order = sorted(range(len(marks)), key=starts.__getitem__)
    stops = [*(min(starts[k], stop) for k in order), stop][1:]
    for k, mark_stop in zip(order, stops, strict=True):
        mark = marks[k]
        unread.check(mark, _KNOWN)
        if mark_stop > starts[k] and mark.get("type", "none") not in _UNPAINTED:
            lines = _lines_of_mark(mark, starts[k], mark_stop, lane.side, allowance)
            yield from (line for line in lines if len(line.starts) and line.width > 0)


def _lines_of_mark(
    mark: Element, start: float, stop: float, side: int, allowance: Allowance
) -> list[_Line]:
    """Return the lines that form a road mark.

    The lines are defined explicitly, by the type of the mark, or by the name of the mark.
    """
    color = _color(mark, "white")
    width = read_non_negative(mark, "width", 0.0) or WIDTH_M
    explicit = mark.findall("explicit/line")
    if explicit:
        return [_explicit_line(line, start, stop, width, color) for line in explicit]
    typed = mark.find("type")
    if typed is not None and typed.find("line") is not None:
        width = read_non_negative(typed, "width", 0.0) or width
        return [
            _typed_line(line, start, stop, width, color, allowance)
            for line in typed.iterfind("line")
        ]
    name = mark.get("type", "")
    if name == "botts dots":
        dots = _dashes(start, stop, _DOT_M, _DOT_SPACE_M, allowance)
        return [_Line(*dots, 0.0, _DOT_M, color)]
    # The names list lines from the inside out for lanes, and from left to right for the center
    # lane.
    broken = _LINES.get(name, (False,))
    shifts = [2 * width * (k - (len(broken) - 1) / 2) for k in range(len(broken))]
    direction = 1 if side > 0 else -1
    return [
        _Line(
            *_dashes(start, stop, DASH_M, SPACE_M if is_broken else 0.0, allowance),
            direction * shift,
            width,
            color,
        )
        for is_broken, shift in zip(broken, shifts, strict=True)
    ]


def _explicit_line(line: Element, start: float, stop: float, width: float, color: str) -> _Line:
    """Return a line that a road mark defines explicitly."""
    first = start + read_number(line, "sOffset", 0.0)
    last = min(first + read_non_negative(line, "length", 0.0), stop)
    starts = np.array([first] if last > first else [])
    return _Line(
        starts,
        np.array([last] if last > first else []),
        read_number(line, "tOffset", 0.0),
        read_non_negative(line, "width", 0.0) or width,
        color,
    )


def _typed_line(
    line: Element, start: float, stop: float, width: float, color: str, allowance: Allowance
) -> _Line:
    """Return a line from the definition of a road mark type, which repeats a dash and a gap."""
    first = start + max(0.0, read_number(line, "sOffset", 0.0))
    dashes = _dashes(
        first,
        stop,
        read_non_negative(line, "length", 0.0),
        read_non_negative(line, "space", 0.0),
        allowance,
    )
    return _Line(
        *dashes,
        read_number(line, "tOffset", 0.0),
        read_non_negative(line, "width", 0.0) or width,
        _color(line, color),
    )


def _dashes(
    start: float, stop: float, length: float, space: float, allowance: Allowance
) -> tuple[Floats, Floats]:
    """Return the starts and stops of dashes. Without gaps, there is a single dash."""
    if not start < stop:
        return np.zeros(0), np.zeros(0)
    if space <= 0 or length <= 0:
        return np.array([start]), np.array([stop])
    count = (stop - start) / (length + space)
    allowance.reserve(int(min(count, 1e15)) * _BYTES_PER_DASH)
    starts = start + (length + space) * np.arange(int(count) + 1)
    starts = starts[starts < stop]
    return np.asarray(starts, np.float64), np.asarray(np.minimum(starts + length, stop))


def _color(element: Element, default: str) -> str:
    """Return the color of a mark or line. The color "standard" means white."""
    color = element.get("color") or default
    return "white" if color == "standard" else color[:20]

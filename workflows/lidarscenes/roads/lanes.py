"""Lanes of roads as strips of triangles: sections, borders, heights and kerbs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import Floats, Ints
from lidarsim.scene.files.scene_graph import MeshFileError

from .cubics import NOTHING, Cubics
from .elements import MAX_SHOWN, UnreadElements, number
from .road import Frames, Network, Road

HEIGHT_SHARE = 0.1  # tolerance of heights, as a share of the tolerance in plan
STRIP_M = 0.5  # width of strips of lanes whose cross section is curved
_STEP_M = 0.01  # length of a ramp between widths or heights that jump
_LEAST_M = 1e-6  # stations that are nearer to each other are one
_KERB_M = 1e-3  # least height of a kerb
_MIN_COLUMNS = 2  # of points of a section with lanes
_MAX_STEPS = 1e9  # between two breaks; no memory holds as many
_BYTES_PER_POINT = 400  # peak memory of a point of a lane
_KNOWN = (
    "width", "border", "height", "roadMark", "material", "speed", "access", "rule", "visibility",
)  # fmt: skip


class Lane:
    """A lane of a lane section.

    Parameters
    ----------
    element
        The <lane>.
    start
        Start of the lane section on the road, m.
    """

    def __init__(self, element: Element, start: float) -> None:
        self.element = element
        self.number = int(number(element, "id"))
        self.type = (element.get("type") or "none")[:MAX_SHOWN]
        self.level = element.get("level") in ("true", "1")
        self.widths = Cubics.read(element.iterfind("width"), "sOffset", start)
        self.borders = NOTHING
        if not len(self.widths):
            self.borders = Cubics.read(element.iterfind("border"), "sOffset", start)
        heights = element.findall("height")
        self.inner_heights = _steps(heights, start, "inner", "heightInner")
        self.outer_heights = _steps(heights, start, "outer", "heightOuter")

    @property
    def side(self) -> int:
        """1 to the left of the reference line, -1 to the right, 0 for the lane in the middle."""
        return (self.number > 0) - (self.number < 0)

    @property
    def cubics(self) -> tuple[Cubics, ...]:
        """Polynomials of the lane."""
        return self.widths, self.borders, self.inner_heights, self.outer_heights

    def outer_t(self, distances: Floats, inner_t: Floats, middle_t: Floats) -> Floats:
        """Return t (k,) of the outer border, by t of the inner border and of the middle, m."""
        if len(self.borders):
            widths = np.abs(self.borders.values(distances)) - np.abs(inner_t - middle_t)
        else:
            widths = self.widths.values(distances)
        return inner_t + self.side * np.maximum(widths, 0)


def _steps(elements: Sequence[Element], start: float, *names: str) -> Cubics:
    """Return constants, each valid to the start of the next, by the first name that exists."""
    if not elements:
        return NOTHING
    rows = []
    for element in elements:
        name = next((name for name in names if element.get(name)), names[0])
        s = start + number(element, "sOffset", 0.0)
        rows.append((s, number(element, name, 0.0), 0.0, 0.0, 0.0))
    return Cubics(rows)


class LaneSection:
    """A lane section of a road.

    Attributes
    ----------
    lanes
        Lanes of each side, {1: left, -1: right}, from the reference line outwards.
    middle
        The lane in the middle, or None.
    stations
        (k,): distances on the road at which the section has cross sections, m.
    """

    def __init__(self, element: Element, start: float, stop: float, unread: UnreadElements) -> None:
        self.start = start
        self.stop = stop
        lanes = [
            Lane(lane, start)
            for side in ("left", "center", "right")
            for lane in element.iterfind(f"{side}/lane")
        ]
        numbers = [lane.number for lane in lanes]
        if len(set(numbers)) < len(numbers):
            raise MeshFileError("has a <laneSection> with two lanes of the same id: correct it")
        lanes.sort(key=lambda lane: abs(lane.number))
        self.lanes = {side: [lane for lane in lanes if lane.side == side] for side in (1, -1)}
        self.middle = next((lane for lane in lanes if not lane.number), None)
        self.stations = np.zeros(0)
        for lane in lanes:
            unread.check(lane.element, _KNOWN)

    @property
    def all_lanes(self) -> list[Lane]:
        """Lanes of both sides."""
        return [*self.lanes[1], *self.lanes[-1]]

    def borders(self, road: Road, distances: Floats) -> dict[int, Floats]:
        """Return t (k,) of the outer borders of lanes, and of the middle, {number of lane: t}."""
        middle = road.lane_offset.values(distances)
        borders = {0: middle}
        for lanes in self.lanes.values():
            t = middle
            for lane in lanes:
                t = lane.outer_t(distances, t, middle)
                borders[lane.number] = t
        return borders

    def place_stations(
        self, network: Network, road: Road, sag_m: float, allowance: Allowance
    ) -> None:
        """Place the stations so that triangles are within a tolerance of the surface.

        The tolerance is `sag_m` in plan, and a tenth of this in height.
        """
        breaks = self._breaks(road)
        starts = breaks[:-1]
        stops = breaks[1:]
        counts = self._step_counts(network, road, starts, stops, sag_m)
        if not counts.max() < _MAX_STEPS:
            counts = np.minimum(np.nan_to_num(counts, nan=_MAX_STEPS), _MAX_STEPS)
        columns = 2 * len(self.all_lanes) + 2
        allowance.take(int(counts.sum() + len(counts)) * columns * _BYTES_PER_POINT)
        steps = np.maximum(1, np.ceil(counts)).astype(np.int64)
        rows = np.repeat(np.arange(len(steps)), steps)
        within = np.arange(len(rows)) - np.repeat(np.cumsum(steps) - steps, steps)
        stations = starts[rows] + (stops - starts)[rows] * (within / steps[rows])
        self.stations = np.append(stations, self.stop)

    def _step_counts(
        self, network: Network, road: Road, starts: Floats, stops: Floats, sag_m: float
    ) -> Floats:
        """Return the numbers of steps, not rounded, that intervals (k,) between breaks need."""
        curvature = network.max_curvatures(road, starts, stops)
        width_cubics = [
            cubics
            for lane in self.all_lanes
            for cubics in (lane.borders if len(lane.borders) else lane.widths,)
            if cubics.bent
        ]
        profiles = (road.elevation, road.superelevation, road.lane_offset)
        is_plane = not (width_cubics or any(cubics.bent for cubics in profiles))
        if is_plane and not len(road.superelevation) and not curvature.any():
            return np.ones_like(starts)
        borders = np.stack([*self.borders(road, (starts + stops) / 2).values()])
        reach = np.abs(borders).max(axis=0)
        width = np.abs(np.diff(borders, axis=0)).max(initial=1.0)
        bend = curvature * (1 + curvature * reach) + road.lane_offset.max_bends(starts, stops)
        for cubics in width_cubics:
            bend += cubics.max_bends(starts, stops)
        height_bend = road.elevation.max_bends(starts, stops)
        height_bend = height_bend + reach * road.superelevation.max_bends(starts, stops)
        twist = road.superelevation.max_slopes(starts, stops) * width / 4
        spans = stops - starts
        return np.maximum(
            spans * np.sqrt(np.maximum(bend, height_bend / HEIGHT_SHARE) / (8 * sag_m)),
            spans * twist / (HEIGHT_SHARE * sag_m),
        )

    def _breaks(self, road: Road) -> Floats:
        """Return distances (b,) between which all polynomials of the section are single, m."""
        cubics = [cubics for lane in self.all_lanes for cubics in lane.cubics]
        jumps = [c.jumps - _STEP_M for c in (*cubics, road.lane_offset) if len(c) > 1]
        starts = [c.starts for c in cubics if len(c)]
        breaks = np.concatenate([road.breaks, *starts, *jumps])
        inside = (breaks > self.start + _LEAST_M) & (breaks < self.stop - _LEAST_M)
        breaks = np.sort(np.concatenate([[self.start], breaks[inside], [self.stop]]))
        return np.asarray(breaks[np.append(True, np.diff(breaks) > _LEAST_M)])


def lane_sections(road: Road, unread: UnreadElements) -> list[LaneSection]:
    """Return the lane sections of a road that have a length."""
    elements = road.element.findall("lanes/laneSection")
    starts = [number(element, "s", 0.0) for element in elements]
    order = sorted(range(len(starts)), key=starts.__getitem__)
    stops = [*(min(starts[k], road.length) for k in order), road.length][1:]
    return [
        LaneSection(elements[k], max(starts[k], 0.0), stop, unread)
        for k, stop in zip(order, stops, strict=True)
        if stop - max(starts[k], 0.0) > 10 * _LEAST_M
    ]


class Strip(NamedTuple):
    """The surface of a lane at the stations of its section, or a kerb beside it."""

    lane: Lane
    t: Floats  # (c, k): of columns of points, m
    points: Floats  # (c, k, 3), m
    is_kerb: bool = False

    @property
    def faces(self) -> Ints:
        """Triangles (f, 3) of the points in order, with normals up, or off the road of a kerb."""
        faces = grid_faces(*self.t.shape)
        return faces if self.lane.side > 0 else faces[:, ::-1]


@lru_cache(maxsize=256)
def grid_faces(columns: int, stations: int) -> Ints:
    """Return triangles (f, 3) of a grid of points (columns, stations), two for each cell."""
    corners = np.arange(columns * stations).reshape(columns, stations)
    a = corners[:-1, :-1]
    b = corners[:-1, 1:]
    c = corners[1:, 1:]
    d = corners[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return triangles.reshape(-1, 3)


class SectionSurface:
    """The surfaces of a lane section.

    Attributes
    ----------
    strips
        Surfaces of lanes, from right to left.
    kerbs
        Upright surfaces between lanes of different heights.
    """

    def __init__(self, road: Road, section: LaneSection, frames: Frames) -> None:
        self.section = section
        self.frames = frames
        self._road = road
        self.borders = section.borders(road, section.stations)
        sides = {side: [*self._strips(lanes)] for side, lanes in section.lanes.items()}
        self.strips = [*sides[-1][::-1], *sides[1]]
        self.kerbs = [*self._kerbs()]
        ordered = [
            (strip.t, strip.points) if strip.lane.side > 0 else (strip.t[::-1], strip.points[::-1])
            for strip in self.strips
        ]
        stations = len(section.stations)
        self._t = np.concatenate([t for t, _ in ordered] or [np.zeros((0, stations))])
        self._points = np.concatenate([p for _, p in ordered] or [np.zeros((0, stations, 3))])

    def points(self, stations: Ints, t: Floats) -> Floats:
        """Return points (q, 3) on the triangles' edges across the road, at stations and t (q,)."""
        frames = self.frames
        count = len(self._t)
        if count < _MIN_COLUMNS:
            return np.asarray(frames.origins[stations] + t[:, None] * frames.side[stations])
        columns = self._t[:, stations]
        right = np.clip((columns < t).sum(axis=0) - 1, 0, count - 2)
        queries = np.arange(len(t))
        t_right = columns[right, queries]
        gap = columns[right + 1, queries] - t_right
        within = np.clip(t, columns[0], columns[-1])
        share = np.where(gap > 0, (within - t_right) / np.where(gap > 0, gap, 1), 0.0)
        first = self._points[right, stations]
        inside = first + share[:, None] * (self._points[right + 1, stations] - first)
        return np.asarray(inside + (t - within)[:, None] * frames.side[stations])

    def _strips(self, lanes: Sequence[Lane]) -> Iterator[Strip]:
        """Yield the strips of the lanes of a side, from the middle outwards."""
        distances = self.section.stations
        frames = self.frames
        inner_t = self.borders[0]
        level_points: Floats | None = None  # (k, 3): inner border of level lanes
        for lane in lanes:
            outer_t = self.borders[lane.number]
            widest = float(np.abs(outer_t - inner_t).max(initial=0))
            strips = max(1, int(widest / STRIP_M)) if self._road.curved_across else 1
            share = np.linspace(0, 1, strips + 1)[:, None]
            t = inner_t + share * (outer_t - inner_t)
            if lane.level:
                if level_points is None:
                    level_points = self._base(inner_t[None])[0]
                base = level_points + (t - inner_t)[..., None] * frames.level_side
                level_points = base[-1]
            else:
                base = self._base(t)
            inner = lane.inner_heights.values(distances)
            heights = inner + share * (lane.outer_heights.values(distances) - inner)
            yield Strip(lane, t, base + heights[..., None] * frames.up)
            inner_t = outer_t

    def _base(self, t: Floats) -> Floats:
        """Return points (c, k, 3) of the road without heights of lanes, at t (c, k)."""
        frames = self.frames
        base = frames.origins + t[..., None] * frames.side
        if self._road.curved_across:
            base += self._road.heights(self.section.stations, t)[..., None] * frames.up
        return np.asarray(base)

    def _kerbs(self) -> Iterator[Strip]:
        """Yield upright strips between lanes of different heights, as parts of the higher lanes."""
        for right, left in zip(self.strips[:-1], self.strips[1:], strict=True):
            right_row = -1 if right.lane.side > 0 else 0
            left_row = 0 if left.lane.side > 0 else -1
            right_points = right.points[right_row]
            left_points = left.points[left_row]
            steps = ((left_points - right_points) * self.frames.up).sum(axis=1)
            if np.abs(steps).max() < _KERB_M:
                continue
            is_left_higher = steps.sum() > 0
            lane = left.lane if is_left_higher else right.lane
            points = np.stack([right_points, left_points])
            yield Strip(lane, np.zeros(points.shape[:2]), points, is_kerb=True)

"""Convert lanes to strips of triangles with borders, heights, and curbs.

`section_surfaces` measures the surface of each lane section at samples, and then places the
stations of its triangles according to the measured curvatures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.files.scene_graph import MeshFileError

from .cross_sections import (
    GAP_M,
    HEIGHT_SHARE,
    SAMPLES,
    Intervals,
    PlacedStations,
    RoadStations,
    SampledSurface,
    SurfaceSamples,
    has_extent,
    place_stations,
)
from .cubics import NO_CUBICS, Cubics
from .elements import MAX_SHOWN, UnreadElements, read_number
from .road import Road, RoadFrames, RoadNetwork

_ACROSS_SHARE = 0.3  # fraction of the height tolerance that is used for curved cross sections
_CURB_M = 1e-3  # minimum height of a curb
_MIN_COLUMNS = 2  # minimum number of point columns in a section with lanes
_BYTES_PER_POINT = 400  # peak memory per point of a lane
_HALVINGS = 30  # bisection steps for finding where two borders cross
_KNOWN = (
    "width", "border", "height", "roadMark", "material", "speed", "access", "rule", "visibility",
)  # fmt: skip


class Lane:
    """A lane in a lane section.

    Parameters
    ----------
    element
        The <lane> element.
    start
        Start of the lane section on the road in meters.
    """

    def __init__(self, element: Element, start: float) -> None:
        self.element = element
        self.number = int(read_number(element, "id"))
        self.type = (element.get("type") or "none")[:MAX_SHOWN]
        self.level = element.get("level") in ("true", "1")
        self.widths = Cubics.read(element.iterfind("width"), "sOffset", start)
        self.borders = NO_CUBICS
        if not len(self.widths):
            self.borders = Cubics.read(element.iterfind("border"), "sOffset", start)
        heights = element.findall("height")
        self.inner_heights = _steps(heights, start, "inner", "heightInner")
        self.outer_heights = _steps(heights, start, "outer", "heightOuter")

    @property
    def side(self) -> int:
        """1 to the left of the reference line, -1 to the right, and 0 for the center lane."""
        return (self.number > 0) - (self.number < 0)

    @property
    def cubics(self) -> tuple[Cubics, ...]:
        """All polynomials that describe the lane."""
        return self.widths, self.borders, self.inner_heights, self.outer_heights

    @property
    def has_heights(self) -> bool:
        """Whether the lane has heights relative to the road."""
        return len(self.inner_heights) > 0

    def width(self, stations: RoadStations, inner_t: Floats, middle_t: Floats) -> Floats:
        """Return the width in meters. It is negative where the file states a negative width.

        `inner_t` and `middle_t` (k,) are the t coordinates of the inner border and of the center
        lane.
        """
        if len(self.borders):
            return np.asarray(np.abs(self.borders.values(stations)) - np.abs(inner_t - middle_t))
        return self.widths.values(stations)


def _steps(elements: Sequence[Element], start: float, *names: str) -> Cubics:
    """Read a piecewise constant function. Each element has one of the attributes `names`."""
    if not elements:
        return NO_CUBICS
    rows = []
    for element in elements:
        name = next((name for name in names if element.get(name)), names[0])
        s = start + read_number(element, "sOffset", 0.0)
        rows.append((s, read_number(element, name, 0.0), 0.0, 0.0, 0.0))
    return Cubics(rows)


class LaneSection:
    """A lane section of a road.

    Attributes
    ----------
    lanes
        Lanes on the left (1) and on the right (-1), from the reference line outward.
    middle
        The center lane, or None.
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
            raise MeshFileError(
                "contains a <laneSection> in which two lanes have the same id. Correct the ids"
            )
        lanes.sort(key=lambda lane: abs(lane.number))
        self.lanes = {side: [lane for lane in lanes if lane.side == side] for side in (1, -1)}
        self.middle = next((lane for lane in lanes if not lane.number), None)
        for lane in lanes:
            unread.check(lane.element, _KNOWN)

    @property
    def all_lanes(self) -> list[Lane]:
        """Lanes on both sides of the road."""
        return [*self.lanes[1], *self.lanes[-1]]

    def borders(self, road: Road, stations: RoadStations) -> dict[int, Floats]:
        """Return the t coordinate of each lane's outer border, by lane number.

        Number 0 is the center lane.
        """
        return self._borders_and_widths(road, stations)[0]

    def intervals(self, road: Road, start: float, stop: float) -> Intervals:
        """Return the intervals between two distances, in which each polynomial has a single piece.

        Intervals also end where lane borders cross each other or a kink in the road's cross
        section.
        """
        cubics = [cubics for lane in self.all_lanes for cubics in lane.cubics]
        breaks = np.concatenate([road.breaks, *(c.starts for c in cubics if len(c))])
        intervals = Intervals.between(start, stop, breaks)
        crossings = self._crossings(road, intervals)
        if len(crossings):
            intervals = Intervals.between(start, stop, np.concatenate([breaks, crossings]))
        return intervals

    def samples(self, network: RoadNetwork, road: Road) -> SurfaceSamples:
        """Return the stations at which to measure the section's surface."""
        intervals = self.intervals(road, self.start, self.stop).with_lead(road.breaks)
        are_planes = self.is_plain and road.is_plain and network.is_straight(road, intervals)
        return intervals.surface_samples(are_planes=are_planes)

    @cached_property
    def is_plain(self) -> bool:
        """Whether all lanes are planes where the road is straight."""
        return not any(
            cubics.bent or (lane.has_heights and not cubics.is_constant)
            for lane in self.all_lanes
            for cubics in (lane.widths, lane.borders)
        )

    def _borders_and_widths(
        self, road: Road, stations: RoadStations
    ) -> tuple[dict[int, Floats], dict[int, Floats]]:
        """Return the border t coordinates, and the widths that the file states, by lane number.

        All arrays have shape (k,).
        """
        # If the road steps where the section starts, use the lanes of this section.
        stations = RoadStations(stations.s, np.maximum(stations.pieces, self.start))
        middle = road.lane_offset.values(stations)
        borders = {0: middle}
        widths = {}
        for lanes in self.lanes.values():
            t = middle
            for lane in lanes:
                width = lane.width(stations, t, middle)
                t = t + lane.side * np.maximum(width, 0)
                borders[lane.number] = t
                widths[lane.number] = width
        return borders, widths

    def _crossings(self, road: Road, intervals: Intervals) -> Floats:
        """Return the distances at which a width becomes negative or a border crosses a kink."""
        kinks = road.kinks(self.start, self.stop) if road.has_curved_sections else np.zeros(0)
        if not len(kinks) and all(
            lane.widths.is_constant and not len(lane.borders) for lane in self.all_lanes
        ):
            return kinks

        def values(stations: RoadStations) -> Floats:
            """Return all widths, followed by all borders. Shape (v, k)."""
            borders, widths = self._borders_and_widths(road, stations)
            return np.stack([*widths.values(), *borders.values()])

        # Pairs of a width or border and a level that it may cross.
        lanes = len(self.all_lanes)
        levels = np.concatenate([np.zeros(lanes), np.tile(kinks, lanes + 1)])
        crossing = np.concatenate(
            [np.arange(lanes), np.repeat(lanes + np.arange(lanes + 1), len(kinks))]
        )
        samples = intervals.samples(SAMPLES)
        heights = values(samples)[crossing] - levels[:, None]
        heights = heights.reshape(len(levels), len(intervals), SAMPLES)
        is_above = heights > 0
        has_both = (heights.min(axis=-1) < -GAP_M) & (heights.max(axis=-1) > GAP_M)
        is_crossed = (is_above[..., 1:] != is_above[..., :-1]) & has_both[..., None]
        pairs, *cells = np.nonzero(is_crossed)
        if not len(pairs):
            return np.zeros(0)
        s = samples.s.reshape(-1, SAMPLES)

        def is_above_at(distances: Floats) -> Bools:
            """Return whether each width or border is above its level at the given distance."""
            pair_indices = np.arange(len(pairs))
            return values(RoadStations.at(distances))[crossing[pairs], pair_indices] > levels[pairs]

        return _changes(is_above_at, s[:, :-1][tuple(cells)], s[:, 1:][tuple(cells)])


def _changes(is_above: Callable[[Floats], Bools], lower: Floats, upper: Floats) -> Floats:
    """Find the distances between bounds at which a predicate changes, by bisection."""
    is_first = is_above(lower)
    for _ in range(_HALVINGS):
        middle = (lower + upper) / 2
        is_lower = is_above(middle) == is_first
        lower = np.where(is_lower, middle, lower)
        upper = np.where(is_lower, upper, middle)
    return np.asarray(upper)


def lane_sections(road: Road, unread: UnreadElements) -> list[LaneSection]:
    """Return all lane sections of a road except those of zero length."""
    elements = road.element.findall("lanes/laneSection")
    starts = [read_number(element, "s", 0.0) for element in elements]
    order = sorted(range(len(starts)), key=starts.__getitem__)
    stops = [*(min(starts[k], road.length) for k in order), road.length][1:]
    return [
        LaneSection(elements[k], max(starts[k], 0.0), stop, unread)
        for k, stop in zip(order, stops, strict=True)
        if stop - max(starts[k], 0.0) > 10 * GAP_M
    ]


def section_surfaces(
    network: RoadNetwork,
    sections: Sequence[tuple[Road, LaneSection]],
    sag_m: float,
    allowance: Allowance,
) -> list[SectionSurface]:
    """Create surfaces for lane sections, with triangles that are within a tolerance.

    The tolerance is `sag_m` in plan, and a tenth of that in height.
    """

    def surfaces_at(
        section_indices: Sequence[int], placed: Sequence[PlacedStations]
    ) -> list[SectionSurface]:
        """Return the surfaces of the selected sections at the placed stations."""
        pairs = [sections[k] for k in section_indices]
        frames = network.frames([road for road, _ in pairs], [entry.stations for entry in placed])
        stops = np.cumsum([len(entry.stations) for entry in placed]).tolist()
        return [
            SectionSurface(
                *pair,
                entry,
                frames.select(slice(stop - len(entry.stations), stop)),
                sag_m,
                allowance,
            )
            for pair, entry, stop in zip(pairs, placed, stops, strict=True)
        ]

    samples = [section.samples(network, road) for road, section in sections]
    columns = [2 * len(section.all_lanes) + 2 for _, section in sections]
    points = sum(len(s.stations) * c for s, c in zip(samples, columns, strict=True))
    allowance.check(points * _BYTES_PER_POINT)
    no_steps = np.zeros(0, np.int64)
    surfaces = surfaces_at(
        range(len(sections)), [PlacedStations(entry.stations, no_steps) for entry in samples]
    )
    placed = place_stations(
        [
            surface.to_sampled(entry.intervals)
            for surface, entry in zip(surfaces, samples, strict=True)
        ],
        sag_m,
        allowance,
        _BYTES_PER_POINT,
    )
    recomputed_indices = []  # sections with stations that are not among the samples
    for k, (surface, entry) in enumerate(zip(surfaces, placed, strict=True)):
        part = surface.select_stations(entry)
        if part is None:
            recomputed_indices.append(k)
        else:
            surfaces[k] = part
    recomputed = surfaces_at(recomputed_indices, [placed[k] for k in recomputed_indices])
    for k, surface in zip(recomputed_indices, recomputed, strict=True):
        surfaces[k] = surface
    return surfaces


class Strip(NamedTuple):
    """The surface of a lane, or of a curb beside it, at the stations of the lane section."""

    lane: Lane
    t: Floats  # (c, k) t coordinates of the point columns in meters
    points: Floats  # (c, k, 3) in meters
    steps: Ints  # (j,) stations before a step, where the next station has the same distance
    is_curb: bool = False

    @property
    def faces(self) -> Ints:
        """Triangles whose normals point up or, for a curb, away from the road. Shape (f, 3)."""
        faces = grid_faces(*self.t.shape)
        if len(self.steps):
            # There is a wall where heights step, but not where only widths step.
            columns, stations = self.t.shape
            is_step = np.zeros((columns - 1, stations - 1, 2), np.bool_)
            is_step[:, self.steps] = True
            face_indices = np.flatnonzero(is_step)
            thin = face_indices[~has_extent(self.points.reshape(-1, 3), faces[face_indices])]
            faces = np.delete(faces, thin, axis=0)
        return faces if self.lane.side > 0 else faces[:, ::-1]


@lru_cache(maxsize=256)
def grid_faces(columns: int, stations: int) -> Ints:
    """Return two triangles for each cell of a grid with columns * stations points."""
    corners = np.arange(columns * stations).reshape(columns, stations)
    a = corners[:-1, :-1]
    b = corners[:-1, 1:]
    c = corners[1:, 1:]
    d = corners[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return triangles.reshape(-1, 3)


class SectionSurface:
    """The surfaces of a lane section at given stations.

    Parameters
    ----------
    road, section
        The road and the lane section.
    placed
        The stations.
    frames
        Frames of the road at the stations.
    sag_m
        Tolerance in plan in meters. The tolerance in height is a tenth of it.
    allowance
        Memory that additional points across lanes may occupy.

    Attributes
    ----------
    strips
        Surfaces of the lanes, from right to left.
    """

    def __init__(
        self,
        road: Road,
        section: LaneSection,
        placed: PlacedStations,
        frames: RoadFrames,
        sag_m: float,
        allowance: Allowance,
    ) -> None:
        self.section = section
        self.stations, self.steps = placed
        self.frames = frames
        self._road = road
        self._sag_m = sag_m
        self._allowance = allowance
        self.borders = section.borders(road, self.stations)
        self._lines = self._lines_across()
        # Points (c, k, 3) of all borders, from right to left, if cross sections are straight.
        self._border_points: Floats | None = None
        if not road.has_curved_sections:
            right = [self.borders[lane.number] for lane in section.lanes[-1][::-1]]
            left = [self.borders[lane.number] for lane in section.lanes[1]]
            self._border_points = self._base(np.stack([*right, self.borders[0], *left]))
        self.strips = [*[*self._strips(-1)][::-1], *self._strips(1)]

    @cached_property
    def curbs(self) -> list[Strip]:
        """Vertical surfaces between lanes with different heights."""
        return [*self._curbs()]

    def to_sampled(self, intervals: Intervals) -> SampledSurface:
        """Convert this surface to the form that the placement of stations requires.

        The stations of this surface must be the samples of `intervals`.
        """
        height_m = HEIGHT_SHARE * self._sag_m
        if self._road.shapes is not None:
            height_m *= 1 - _ACROSS_SHARE
        points = self._border_points
        if points is not None and not any(
            lane.level or lane.has_heights for lane in self.section.all_lanes
        ):
            return SampledSurface(intervals, points, np.ones(len(points) - 1, np.bool_), height_m)
        ends = np.cumsum([len(strip.t) for strip in self.strips], dtype=np.int64)
        is_cell = np.ones(max(0, len(self._points) - 1), np.bool_)
        is_cell[ends[:-1] - 1] = False
        return SampledSurface(intervals, self._points, is_cell, height_m)

    def select_stations(self, placed: PlacedStations) -> SectionSurface | None:
        """Return the surface at selected stations, or None if one of them is missing."""
        station_indices = np.searchsorted(self.stations.pieces, placed.stations.pieces)
        station_indices = np.minimum(station_indices, len(self.stations) - 1)
        if (self.stations.pieces[station_indices] != placed.stations.pieces).any():
            return None
        surface = copy(self)
        surface.stations, surface.steps = placed
        surface.frames = self.frames.select(station_indices)
        surface.borders = {key: t[station_indices] for key, t in self.borders.items()}
        surface.strips = [
            Strip(
                strip.lane,
                strip.t[:, station_indices],
                strip.points[:, station_indices],
                placed.steps,
            )
            for strip in self.strips
        ]
        surface._border_points = None
        for name in ("_t", "_points"):  # arrays that belong to these stations
            vars(surface).pop(name, None)
        return surface

    def points(self, stations: Ints, t: Floats) -> Floats:
        """Return the points of cross sections at the given stations and t coordinates."""
        frames = self.frames
        count = len(self._points)
        if count < _MIN_COLUMNS:
            return np.asarray(frames.origins[stations] + t[:, None] * frames.side[stations])
        columns = self._t[:, stations]
        right = np.clip((columns < t).sum(axis=0) - 1, 0, count - 2)
        queries = np.arange(len(t))
        t_right = columns[right, queries]
        gap = columns[right + 1, queries] - t_right
        within = np.clip(t, columns[0], columns[-1])
        fraction = np.where(gap > 0, (within - t_right) / np.where(gap > 0, gap, 1), 0.0)
        first = self._points[right, stations]
        inside = first + fraction[:, None] * (self._points[right + 1, stations] - first)
        return np.asarray(inside + (t - within)[:, None] * frames.side[stations])

    @cached_property
    def _t(self) -> Floats:
        """The t coordinates of all strips' points, from right to left."""
        ordered = [strip.t if strip.lane.side > 0 else strip.t[::-1] for strip in self.strips]
        return np.concatenate(ordered or [np.zeros((0, len(self.stations)))])

    @cached_property
    def _points(self) -> Floats:
        """All strips' points, from right to left."""
        ordered = [
            strip.points if strip.lane.side > 0 else strip.points[::-1] for strip in self.strips
        ]
        return np.concatenate(ordered or [np.zeros((0, len(self.stations), 3))])

    def _lines_across(self) -> Floats:
        """Return ascending t coordinates at which the strips need additional points."""
        if not self._road.has_curved_sections:
            return np.zeros(0)
        borders = np.stack([*self.borders.values()])
        lines = self._road.points_across(
            self.section.start,
            self.section.stop,
            np.array([borders.min(), borders.max()]),
            _ACROSS_SHARE * HEIGHT_SHARE * self._sag_m,
        )
        self._allowance.check(len(lines) * len(self.stations) * _BYTES_PER_POINT)
        return lines

    def _strips(self, side: int) -> Iterator[Strip]:
        """Yield the strips of all lanes on one side, from the center outward."""
        frames = self.frames
        inner_t = self.borders[0]
        middle = len(self.section.lanes[-1])
        level_points: Floats | None = None  # (k, 3) inner border of level lanes
        for k, lane in enumerate(self.section.lanes[side]):
            t = np.stack([inner_t, self.borders[lane.number]])
            inner_t = t[1]
            if lane.level:
                if level_points is None:
                    level_points = self._base(t[:1])[0]
                base = level_points + (t - t[0])[..., None] * frames.level_side
                level_points = base[-1]
            elif self._border_points is not None:
                first = middle + side * k
                base = self._border_points[[first, first + side]]
            else:
                t = self._t_across(*t)
                base = self._base(t)
            if lane.has_heights:
                inner = lane.inner_heights.values(self.stations)
                outer = lane.outer_heights.values(self.stations)
                width = t[-1] - t[0]
                fraction = (t - t[0]) / np.where(width == 0, 1, width)
                fraction[-1] = 1
                base = base + (inner + fraction * (outer - inner))[..., None] * frames.up
            yield Strip(lane, t, base, self.steps)

    def _t_across(self, inner_t: Floats, outer_t: Floats) -> Floats:
        """Return the t coordinates of a lane's points, from the inside outward."""
        lower = np.minimum(inner_t, outer_t)
        upper = np.maximum(inner_t, outer_t)
        lines = self._lines
        if len(lines):
            lines = lines[(lines > lower.min() + GAP_M) & (lines < upper.max() - GAP_M)]
            if (outer_t - inner_t).sum() < 0:
                lines = lines[::-1]
        return np.stack([inner_t, *(np.clip(line, lower, upper) for line in lines), outer_t])

    def _base(self, t: Floats) -> Floats:
        """Return the points of a lane at the given t coordinates.

        The heights of the lane itself are not included.
        """
        frames = self.frames
        base = frames.origins + t[..., None] * frames.side
        if self._road.has_curved_sections:
            # If heights step at a border, use those on this lane's side of the border.
            lower = np.minimum(t[0], t[-1])
            upper = np.maximum(t[0], t[-1])
            inside = np.clip(t, np.minimum(lower + GAP_M / 2, upper), upper - GAP_M / 2)
            base += self._road.heights(self.stations, t, inside)[..., None] * frames.up
        return np.asarray(base)

    def _curbs(self) -> Iterator[Strip]:
        """Yield vertical strips between lanes with different heights.

        They are parts of the higher lanes.
        """
        for right, left in pairwise(self.strips):
            right_row = -1 if right.lane.side > 0 else 0
            left_row = 0 if left.lane.side > 0 else -1
            right_points = right.points[right_row]
            left_points = left.points[left_row]
            heights = ((left_points - right_points) * self.frames.up).sum(axis=1)
            if np.abs(heights).max() < _CURB_M:
                continue
            is_left_higher = heights.sum() > 0
            lane = left.lane if is_left_higher else right.lane
            points = np.stack([right_points, left_points])
            yield Strip(lane, np.zeros(points.shape[:2]), points, self.steps, is_curb=True)

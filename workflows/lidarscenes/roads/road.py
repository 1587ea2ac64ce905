"""Evaluate the reference lines and cross sections of OpenDRIVE roads.

Sources: ASAM OpenDRIVE 1.8.1 (2024), sections 7 to 11. Crossfall and poly3 follow VIRES OpenDRIVE
1.4H.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from operator import itemgetter
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.elementary import sin_cos
from lidarsim.numerics.vectors import norm
from lidarsim.scene.files.scene_graph import MeshFileError

from .cross_sections import GAP_M, Intervals, RoadStations
from .cubics import Cubics
from .elements import MAX_SHOWN, UnreadElements, read_non_negative, read_number
from .plan_view import PlanTable

_STEP_M = 1e-4  # smallest step of a lateral shape that gets two points
MAX_ROAD_M = 1e7  # maximum length of a road
MAX_LINES = 1e5  # maximum number of points between two kinks of a cross section
_GAP_M = 1.0  # gap between roads in the table of reference lines
_MAX_MISSING = 0.01  # fraction of a road's length by which its geometry may be too short
_CROSSFALL_SIDES = {"left": (1,), "right": (-1,), "both": (1, -1)}
_KNOWN = (
    "type", "planView", "elevationProfile", "lateralProfile", "lanes", "objects", "signals",
    "surface",
)  # fmt: skip


class RoadFrames(NamedTuple):
    """Coordinate frames of roads at given stations.

    The point at t and h is origin + t * side + h * up.
    """

    origins: Floats  # (k, 3) in meters
    along: Floats  # (k, 3) unit vectors along the reference line
    side: Floats  # (k, 3) unit vectors to the left, in the banked plane
    up: Floats  # (k, 3) unit vectors perpendicular to both
    level_side: Floats  # (k, 3) horizontal unit vectors to the left

    def select(self, station_selection: slice | Ints) -> RoadFrames:
        """Return the frames at the selected stations."""
        return RoadFrames(*(array[station_selection] for array in self))


class Road:
    """A road with its elements, and with profiles along the reference line.

    Parameters
    ----------
    element
        The <road> element.
    unread
        Counts the elements that are not read.
    """

    def __init__(self, element: Element, unread: UnreadElements) -> None:
        self.element = element
        self.name = (element.get("id") or "")[:MAX_SHOWN]
        self.length = read_non_negative(element, "length")
        if self.length > MAX_ROAD_M:
            raise MeshFileError(
                f"contains the road {self.name!r} with a length of {self.length:g} m, which "
                f"exceeds {MAX_ROAD_M:,.0f} m. Correct its length"
            )
        self.in_junction = (element.get("junction") or "-1") != "-1"
        self.offset = 0.0  # offset of the road in the table of reference lines, in meters
        self.geometry_starts = np.zeros(0)  # (g,) starts of the geometry pieces in meters
        self.elevation = Cubics.read(element.iterfind("elevationProfile/elevation"))
        self.superelevation = Cubics.read(element.iterfind("lateralProfile/superelevation"))
        self.lane_offset = Cubics.read(element.iterfind("lanes/laneOffset"))
        self.crossfalls = {
            side: Cubics.read(
                entry
                for entry in element.iterfind("lateralProfile/crossfall")
                if side in _CROSSFALL_SIDES.get(entry.get("side", "both"), ())
            )
            for side in (1, -1)
        }
        unread.check(element, _KNOWN)
        for surface in element.iterfind("surface"):
            unread.check(surface, ())
        for profile in element.iterfind("lateralProfile"):
            unread.check(profile, ("superelevation", "crossfall", "shape"))

    def add_to_table(self, table: PlanTable, offset: float) -> float:
        """Add the reference line to a table at an offset, and return the next road's offset.

        Raises MeshFileError if the geometry is shorter than the road.
        """
        geometries = self.element.findall("planView/geometry")
        if not geometries:
            raise MeshFileError(f"contains the road {self.name!r} without geometry. Add geometry")
        geometries.sort(key=lambda geometry: read_number(geometry, "s"))
        last = geometries[-1]
        end = read_non_negative(last, "s") + read_non_negative(last, "length")
        if self.length - end > _MAX_MISSING * self.length:
            raise MeshFileError(
                f"contains the road {self.name!r} with a length of {self.length:,.9g} m, but its "
                f"geometry ends at {end:,.9g} m. Correct its length or add geometry"
            )
        self.offset = offset
        self.geometry_starts = table.add_road(geometries, offset, self.length)
        if not len(self.geometry_starts) and self.length > 0:
            raise MeshFileError(f"contains the road {self.name!r} without geometry. Add geometry")
        return offset + self.length + _GAP_M

    @cached_property
    def shapes(self) -> LateralShapes | None:
        """Lateral shapes of the road, or None if it has none."""
        elements = self.element.findall("lateralProfile/shape")
        return LateralShapes(elements) if elements else None

    @property
    def has_curved_sections(self) -> bool:
        """Whether cross sections of lanes are curved or have kinks."""
        return self.shapes is not None or any(map(len, self.crossfalls.values()))

    @property
    def is_plain(self) -> bool:
        """Whether the road is a plane wherever its reference line is straight."""
        return not (
            self.has_curved_sections or self.lane_offset.bent or not self.superelevation.is_constant
        )

    @cached_property
    def breaks(self) -> Floats:
        """Distances in meters at which any of the road's polynomials changes."""
        profiles = (
            self.elevation, self.superelevation, self.lane_offset, *self.crossfalls.values()
        )  # fmt: skip
        starts = [self.geometry_starts, *(cubics.starts for cubics in profiles if len(cubics))]
        if self.shapes is not None:
            starts.append(self.shapes.stations)
        return np.concatenate(starts)

    def heights(self, stations: RoadStations, t: Floats, pieces: Floats | None = None) -> Floats:
        """Return the heights that crossfall and shapes add at the given t coordinates.

        The heights are relative to the banked plane. `t` and `pieces` have shape (..., k). `pieces`
        contains the t coordinates that select the pieces of the shapes, which are `t` by default.
        """
        heights = np.zeros_like(t)
        for side, crossfall in self.crossfalls.items():
            if len(crossfall):
                sines, cosines = sin_cos(crossfall.values(stations))
                heights -= np.maximum(side * t, 0) * (sines / cosines)
        if self.shapes is not None:
            heights += self.shapes.heights(stations.s, t, t if pieces is None else pieces)
        return heights

    def kinks(self, start: float, stop: float) -> Floats:
        """Return the t coordinates of kinks in the cross sections between two distances."""
        kinks = [np.zeros(1 if any(map(len, self.crossfalls.values())) else 0)]
        if self.shapes is not None:
            kinks.append(self.shapes.kinks(start, stop))
        return np.unique(np.concatenate(kinks))

    def points_across(self, start: float, stop: float, t: Floats, height_m: float) -> Floats:
        """Return ascending t coordinates at which the cross sections need points.

        `t` (2,) are the lower and the upper limit. Straight lines between the points are within
        `height_m` of the cross sections between the distances `start` and `stop`.
        """
        kinks = self.kinks(start, stop)
        if self.shapes is None:
            return kinks
        knots = np.concatenate([t[:1], kinks[(kinks > t[0]) & (kinks < t[1])], t[1:]])
        bends = self.shapes.max_bends(start, stop, knots)
        gaps = np.diff(knots)
        counts = np.ceil(gaps * np.sqrt(bends / (8 * height_m)))
        counts = np.clip(counts, 1, MAX_LINES).astype(np.int64)
        gap_indices = np.repeat(np.arange(len(gaps)), counts)
        within = np.arange(len(gap_indices)) - np.repeat(np.cumsum(counts) - counts, counts)
        lines = np.append(
            knots[gap_indices] + gaps[gap_indices] * (within / counts[gap_indices]), t[1]
        )
        steps = self.shapes.steps(start, stop)
        return np.unique(np.concatenate([lines, steps - GAP_M, steps + GAP_M]))


class LateralShapes:
    """Heights across a road. They are cubics of t, interpolated linearly between stations."""

    def __init__(self, elements: Sequence[Element]) -> None:
        groups: dict[float, list[list[float]]] = {}
        for element in elements:
            row = [read_number(element, name, 0.0) for name in ("t", *"abcd")]
            groups.setdefault(read_number(element, "s"), []).append(row)
        self.stations: Floats = np.array(sorted(groups))  # (m,)
        # The cubics at each station in ascending order, padded with starts that are never reached.
        count = max(map(len, groups.values()))
        table = np.zeros((len(groups), count, 5))
        table[..., 0] = np.inf
        for profile, s in zip(table, self.stations.tolist(), strict=True):
            profile[: len(groups[s])] = sorted(groups[s], key=itemgetter(0))
        self._starts: Floats = table[..., 0]  # (m, r) in meters
        self._coefficients: Floats = np.moveaxis(table[..., 1:], -1, 0)  # (4, m, r)

    def heights(self, distances: Floats, t: Floats, pieces: Floats) -> Floats:
        """Return the heights at the given distances and t coordinates.

        `pieces` (..., k) are the t coordinates that select the cubics.
        """
        last = len(self.stations) - 1
        station_indices = np.clip(np.searchsorted(self.stations, distances, "right") - 1, 0, last)
        following = np.minimum(station_indices + 1, last)
        gaps = np.maximum(self.stations[following] - self.stations[station_indices], 1e-9)
        fraction = np.clip((distances - self.stations[station_indices]) / gaps, 0, 1)
        lower = self._profiles(station_indices, t, pieces)
        return np.asarray(lower + fraction * (self._profiles(following, t, pieces) - lower))

    def kinks(self, start: float, stop: float) -> Floats:
        """Return the t coordinates at which cubics start.

        Stations that determine the heights between the two distances are considered.
        """
        starts = self._starts[self._row_range(start, stop)]
        return np.unique(starts[np.isfinite(starts)])

    def steps(self, start: float, stop: float) -> Floats:
        """Return the t coordinates at which heights step.

        Stations that determine the heights between the two distances are considered.
        """
        row_range = self._row_range(start, stop)
        starts = self._starts[row_range]
        a, b, c, d = self._coefficients[:, row_range]
        with np.errstate(invalid="ignore"):  # padding has infinite starts
            x = np.diff(starts, axis=1)
            ends = ((d[:, :-1] * x + c[:, :-1]) * x + b[:, :-1]) * x + a[:, :-1]
            is_step = np.abs(ends - a[:, 1:]) > _STEP_M
        return np.unique(starts[:, 1:][is_step & np.isfinite(starts[:, 1:])])

    def max_bends(self, start: float, stop: float, knots: Floats) -> Floats:
        """Return the largest curvature of the heights between successive t coordinates, in 1/m."""
        row_range = self._row_range(start, stop)
        t = (knots[1:] + knots[:-1]) / 2
        pieces = np.maximum((self._starts[row_range, :, None] <= t).sum(axis=1) - 1, 0)  # (m, j)
        indices = np.arange(row_range.start, row_range.stop)[:, None]
        _, _, c, d = self._coefficients[:, indices, pieces]
        origins = self._starts[indices, pieces]
        ends = [np.abs(2 * c + 6 * d * np.maximum(k - origins, 0)) for k in (knots[:-1], knots[1:])]
        is_before = t < origins  # where heights are level
        return np.where(is_before, 0.0, np.maximum(*ends)).max(axis=0)

    def _row_range(self, start: float, stop: float) -> slice:
        """Return the range of stations that determine heights between two distances."""
        first = int(np.searchsorted(self.stations, start, "right")) - 1
        last = int(np.searchsorted(self.stations, stop, "left")) + 1
        count = len(self.stations)
        return slice(min(max(first, 0), count - 1), min(max(last, 1), count))

    def _profiles(self, station_indices: Ints, t: Floats, pieces: Floats) -> Floats:
        """Return the heights at t coordinates (..., k) for the stations with the given indices."""
        cubics = np.maximum(
            (self._starts[station_indices] <= pieces[..., None]).sum(axis=-1) - 1, 0
        )
        a, b, c, d = self._coefficients[:, station_indices, cubics]
        x = np.maximum(t - self._starts[station_indices, cubics], 0)
        return np.asarray(((d * x + c) * x + b) * x + a)


class RoadNetwork:
    """All roads in a file, whose reference lines are in a common table.

    Parameters
    ----------
    elements
        The <road> elements.
    allowance
        Memory that the reference lines may occupy.
    unread
        Counts the elements that are not read.
    """

    def __init__(
        self, elements: Sequence[Element], allowance: Allowance, unread: UnreadElements
    ) -> None:
        self._table = PlanTable(allowance)
        self.roads = [Road(element, unread) for element in elements]
        offset = 0.0
        for road in self.roads:
            offset = road.add_to_table(self._table, offset)
        self._table.finish()

    def is_straight(self, road: Road, intervals: Intervals) -> bool:
        """Return True if a reference line is straight, in plan and in height, in all intervals."""
        if road.elevation.bent or not road.superelevation.is_constant:
            return False
        ends = road.offset + intervals.ends
        return not self._table.max_curvatures(ends[:, 0], ends[:, 1]).any()

    def frames(self, roads: Sequence[Road], stations: Sequence[RoadStations]) -> RoadFrames:
        """Return the coordinate frames at each road's stations, concatenated."""
        pairs = [*zip(roads, stations, strict=True)]
        if not pairs:
            return RoadFrames(*np.zeros((5, 0, 3)))
        points = self._table.points(
            np.concatenate([road.offset + at.s for road, at in pairs]),
            np.concatenate([road.offset + at.pieces for road, at in pairs]),
        )
        heights = np.concatenate([road.elevation.values(at) for road, at in pairs])
        slopes = np.concatenate([road.elevation.slopes(at) for road, at in pairs])
        roll = np.concatenate([road.superelevation.values(at) for road, at in pairs])
        zero = np.zeros_like(heights)
        origins = np.stack([points.x, points.y, heights], axis=1)
        along = np.stack([points.cosines, points.sines, slopes], axis=1)
        along /= norm(along)[:, None]
        level_side = np.stack([-points.sines, points.cosines, zero], axis=1)
        upright = np.cross(along, level_side)
        if not roll.any():
            return RoadFrames(origins, along, level_side, upright, level_side)
        sines, cosines = (values[:, None] for values in sin_cos(roll))
        side = level_side * cosines + upright * sines
        return RoadFrames(origins, along, side, upright * cosines - level_side * sines, level_side)

    def point(self, road: Road, s: float, t: float, h: float = 0.0) -> Floats:
        """Return the point with the road coordinates s, t, and h."""
        frames = self.frames([road], [RoadStations.at(np.array([s]))])
        return np.asarray(frames.origins[0] + t * frames.side[0] + h * frames.up[0])

"""Flight lines over an area, and their heights above the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.survey.survey import MAX_SENSORS
from raybeam import RayCaster

from .flight_path import FlightLeg
from .flight_scanner import AirborneScanner

Kind = Literal["line", "cross"]
_Track = tuple[Floats, Floats]  # start and stop, with shape (2,)

_ACROSS = 9  # number of ground samples across the swath
_ALONG = 400  # maximum number of ground samples along a line
_NEGLIGIBLE = 0.01  # tolerance of the coverage and the overlap, as a share of the swath
_MARGIN_M = 2.0  # distance by which a line extends beyond the area


class Terrain:
    """Ground of a survey. Without a scene, it is level at a height of 0."""

    def __init__(self, scene: Scene | None = None) -> None:
        self._scene = None
        if scene is not None:
            self._scene = replace(SimplifiedScene.from_scene(scene).scene, actors=())
            self._caster = RayCaster(self._scene.vertices, self._scene.faces)

    def heights(self, points: Floats) -> Floats:
        """Return the heights of the highest surfaces at horizontal positions.

        For `points` of shape (n, 2) in world coordinates, the result has shape (n,). It is NaN
        where there is no ground.
        """
        if self._scene is None:
            return np.zeros(len(points))
        top_m = float(self._scene.bounds[1, 2]) + 1
        origins = np.column_stack([points - self._scene.origin[:2], np.full(len(points), top_m)])
        hits = self._caster.cast(origins, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
        heights = np.where(hits.hit, top_m - hits.distance, np.nan)
        return np.asarray(heights + self._scene.origin[2])


class FlightLine(NamedTuple):
    """A flight line that covers a strip of the area."""

    name: str
    kind: Kind
    leg: FlightLeg
    clearance_m: tuple[float, float, float]  # minimum, mean and maximum height above ground
    swath_m: tuple[float, float]  # at the minimum and the maximum height above ground


@dataclass(frozen=True)
class Layout:
    """Requirements for the lines of a survey.

    Attributes
    ----------
    agl_m
        Height above the mean ground below a line, in meters.
    heading
        Direction of the lines in radians, counterclockwise from x.
    overlap
        Overlap of adjacent strips as a fraction of the swath.
    cross
        Number of cross strips.
    follow
        Whether the aircraft follows the ground along each line.
    """

    agl_m: float
    heading: float
    overlap: float
    cross: int
    follow: bool


class Strips(NamedTuple):
    """Flight lines over an area."""

    lines: list[FlightLine]
    clearances_m: Floats  # heights above ground below all strips, without NaN
    spacing_m: float | None  # distance between adjacent lines, or None for a single line
    missing: float  # share of the samples without ground
    has_holes: bool  # whether samples in the area have no ground
    reach_m: float  # maximum distance of a sample from the area


def place_lines(
    area: Any, terrain: Terrain, scanner: AirborneScanner, layout: Layout, share: float
) -> Strips:
    """Place flight lines so that their strips cover an area.

    Parameters
    ----------
    area
        Shapely polygon or multipolygon.
    terrain, scanner, layout
        Ground, scanner and requirements.
    share
        Share of the ground that may be so high that the overlap is smaller than requested.

    Raises
    ------
    LidarError
        If there is no ground below a line, or if there are too many lines.
    """
    agl_m = layout.agl_m
    strips = _place_lines(area, terrain, scanner, layout, agl_m)
    narrow_m = float(np.quantile(strips.clearances_m, share))
    if narrow_m < agl_m:  # the swath is narrower over high ground
        strips = _place_lines(area, terrain, scanner, layout, max(narrow_m, 0.05 * agl_m))
    return strips


def _place_lines(
    area: Any, terrain: Terrain, scanner: AirborneScanner, layout: Layout, narrow_m: float
) -> Strips:
    """Place flight lines.

    `narrow_m` is the height above ground at which strips have the requested overlap.
    """
    import shapely

    swath_m = scanner.swath_m(narrow_m)
    margin_m = _MARGIN_M + scanner.ahead * layout.agl_m
    offsets = _offsets(area, layout.heading, swath_m, layout.overlap)
    crossing = layout.heading + math.pi / 2
    tracks: dict[Kind, list[_Track]] = {
        "line": _tracks(area, layout.heading, offsets, swath_m, margin_m),
        "cross": _tracks(
            area, crossing, _even_offsets(area, crossing, layout.cross), swath_m, margin_m
        ),
    }
    _check_count(sum(map(len, tracks.values())))
    lines = []
    clearances = []
    samples = []
    for kind, ends in tracks.items():
        for number, (start, stop) in enumerate(ends, 1):
            points = _points_below(start, stop, scanner.swath_m(layout.agl_m))
            heights = terrain.heights(points.reshape(-1, 2)).reshape(points.shape[:2])
            samples.append(points.reshape(-1, 2))
            line = _line(f"{kind}-{number}", kind, start, stop, heights, scanner, layout)
            lines.append(line)
            clearances.append((line.leg.heights[:, None] - heights).ravel())
    above_m = np.concatenate(clearances)
    below = np.concatenate(samples)
    is_missing = np.isnan(above_m)
    return Strips(
        lines,
        above_m[~is_missing],
        float(offsets[1] - offsets[0]) if len(offsets) > 1 else None,
        float(is_missing.mean()),
        bool(shapely.contains_xy(area, *below[is_missing].T).any()),
        float(_distances_m(area, below).max()),
    )


def _line(
    name: str,
    kind: Kind,
    start: Floats,
    stop: Floats,
    heights: Floats,
    scanner: AirborneScanner,
    layout: Layout,
) -> FlightLine:
    """Return a flight line above the ground `heights` of shape (along, across)."""
    if np.isnan(heights).all():
        raise LidarError(
            f"There is no ground below {name}. Check that the area and the terrain have the same "
            "coordinate system, and that the terrain covers the area."
        )
    altitudes = _altitudes(heights, float(np.hypot(*(stop - start))), layout)
    above_m = altitudes[:, None] - heights
    low_m, mean_m, high_m = (float(f(above_m)) for f in (np.nanmin, np.nanmean, np.nanmax))
    swaths_m = scanner.swath_m(low_m), scanner.swath_m(high_m)
    return FlightLine(
        name, kind, FlightLeg(start, stop, altitudes), (low_m, mean_m, high_m), swaths_m
    )


def _check_count(count: int) -> None:
    """Raise LidarError if there are too many flight lines."""
    if count > MAX_SENSORS:
        raise LidarError(
            f"The area needs {count:,} flight lines, but the limit is {MAX_SENSORS}. Increase "
            "`--agl` or `--fov`, reduce `--overlap`, or divide the area."
        )


def longest_side(area: Any) -> float:
    """Return the direction of the longest side of an area's minimum rotated rectangle.

    The direction is in radians, counterclockwise from x, in (-π/2, π/2].
    """
    corners = np.array(area.minimum_rotated_rectangle.exterior.coords)[:4]
    sides = np.roll(corners, -1, axis=0) - corners
    # If sides have the same length, the one that is closer to the x axis is used.
    x, y = max(sides.tolist(), key=lambda side: (round(math.hypot(*side), 6), abs(side[0])))
    angle = math.atan2(y, x)
    return angle - math.pi * math.ceil(angle / math.pi - 0.5)


def _limits(area: Any, heading: float) -> tuple[float, float]:
    """Return the extent of an area across a direction, in meters from the world origin."""
    points = np.concatenate([np.array(part.exterior.coords) for part in _parts(area)])[:, :2]
    across = points @ (-math.sin(heading), math.cos(heading))
    return float(across.min()), float(across.max())


def _parts(area: Any) -> list[Any]:
    return list(getattr(area, "geoms", [area]))


def _offsets(area: Any, heading: float, swath_m: float, overlap: float) -> Floats:
    """Return the offsets of lines across their direction, so that their strips cover the area."""
    low, high = _limits(area, heading)
    excess_m = high - low - swath_m
    if excess_m <= _NEGLIGIBLE * swath_m:
        return np.array([(low + high) / 2])
    count = math.ceil(excess_m / ((1 - overlap + _NEGLIGIBLE) * swath_m)) + 1
    _check_count(count)
    return np.linspace(low + swath_m / 2, high - swath_m / 2, count)


def _even_offsets(area: Any, heading: float, count: int) -> Floats:
    """Return the offsets of `count` lines that are evenly distributed over an area."""
    low, high = _limits(area, heading)
    return low + (high - low) * (np.arange(count) + 0.5) / max(count, 1)


def _tracks(
    area: Any, heading: float, offsets: Floats, swath_m: float, margin_m: float
) -> list[_Track]:
    """Return the starts and stops of lines that cover the parts of an area within their swaths.

    Consecutive lines have opposite directions.
    """
    ahead = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    reach_m = float(np.abs(np.array(area.bounds)).max()) * 3 + 1
    tracks: list[_Track] = []
    for offset in offsets.tolist():
        middle = offset * left
        corners = [
            middle + a * reach_m * ahead + b * swath_m / 2 * left
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        band = area.intersection(type(_parts(area)[0])([*map(tuple, corners)]))
        points = [
            np.array(part.exterior.coords)[:, :2]
            for part in _parts(band)
            if hasattr(part, "exterior")
        ]
        if not points:  # a gap between the polygons of a multipolygon
            continue
        along = np.concatenate(points) @ ahead
        ends = middle + (along.min() - margin_m) * ahead, middle + (along.max() + margin_m) * ahead
        tracks.append(ends[::-1] if len(tracks) % 2 else ends)
    return tracks


def _points_below(start: Floats, stop: Floats, swath_m: float) -> Floats:
    """Return horizontal positions below a line and its swath, with shape (along, across, 2)."""
    length_m = float(np.hypot(*(stop - start)))
    ahead = (stop - start) / length_m
    count = int(np.clip(length_m / max(swath_m / 40, 0.5), 2, _ALONG))
    along = np.linspace(0, length_m, count)
    across = np.linspace(-swath_m / 2, swath_m / 2, _ACROSS)
    left = np.array([-ahead[1], ahead[0]])
    return np.asarray(start + along[:, None, None] * ahead + across[None, :, None] * left)


def _distances_m(area: Any, points: Floats) -> Floats:
    """Return the distances of points of shape (n, 2) from the bounding box of an area."""
    lower, upper = np.reshape(area.bounds, (2, 2))
    return np.asarray(np.hypot(*np.maximum(np.maximum(lower - points, points - upper), 0).T))


def _altitudes(heights: Floats, length_m: float, layout: Layout) -> Floats:
    """Return the heights of the aircraft along a line, with shape (along,).

    If the aircraft follows the ground, the ground below the swath is averaged over a distance equal
    to the height above ground.
    """
    without_ground = np.asarray(np.isnan(heights).all(axis=1))
    known = np.where(without_ground[:, None], np.nanmean(heights), heights)
    below = np.nanmean(known, axis=1)
    if not layout.follow:
        return np.full(len(below), below.mean() + layout.agl_m)
    samples = min(int(layout.agl_m / (length_m / len(below))) | 1, 2 * len(below) - 1)
    padded = np.pad(below, samples // 2, "edge")
    return np.asarray(np.convolve(padded, np.ones(samples) / samples, "valid") + layout.agl_m)

"""Maps and histograms of the deviations between surveys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from lidarsim.numerics.arrays import Floats
from lidarview.render import theme
from lidarview.render.picture_page import Page

from .deviations import NORMAL

_WIDTH = 1600
_LEFT = 0.075
_RIGHT = 0.86
_GAP = 0.06  # between maps, as a fraction of the width
_TOP = 150  # pixels
_BOTTOM = 90
_ROW_GAP = 80
_FACADE_GAP = 110
_MAX_HEIGHT = 620  # of a map, in pixels
_COLORS = "RdBu_r"
_MAPPED = ("delta_e", "delta_n", "delta_h", "distance")
_MAX_CELLS = 240  # cells of a map along its longer side
_MIN_CELLS = 12
_POINTS_PER_CELL = 4
_WIDE = 1.6  # aspect ratio of an area above which its maps are drawn one below the other
_OUTLIERS = 3  # cells that need not be in the color scale
_MIN_LIMIT_M = 1e-4  # end of the color scale if there are no deviations
_BINS = 80
_STEEP = 0.5  # vertical component of the normals below which surfaces are facades
_MIN_FACADE_SHARE = 0.05  # minimum share of the points on facades for which they are drawn
_MIN_FACADE_POINTS = 100
_MIN_SIDE_SHARE = 0.05  # minimum share of these points for which a side is drawn
_COMPASS = (
    *("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest"),
)
# Color of histogram bars.
_BAR_COLOR = "#4477aa"


class _MapLayout(NamedTuple):
    """Size of a page with maps of the same area, in pixels."""

    columns: int
    rows: int
    width: float
    height: float

    @classmethod
    def for_area(cls, count: int, aspect: float) -> _MapLayout:
        """Return the layout of `count` maps of an area with the given width-to-height ratio."""
        columns = 1 if aspect > _WIDE else count
        rows = count // columns
        total = (_RIGHT - _LEFT) * _WIDTH
        width = (total - (columns - 1) * _GAP * _WIDTH) / columns
        height = float(np.clip(width / aspect, 130, _MAX_HEIGHT))
        return cls(columns, rows, width, height)

    @property
    def page_height(self) -> int:
        return int(_TOP + self.rows * self.height + (self.rows - 1) * _ROW_GAP + _BOTTOM)

    def frame(self, number: int) -> tuple[float, float, float, float]:
        """Return the frame of a map, numbered from 0, as fractions of the page."""
        row, column = divmod(number, self.columns)
        left = _LEFT + column * (self.width / _WIDTH + _GAP)
        below = (self.rows - 1 - row) * (self.height + _ROW_GAP)
        bottom = (_BOTTOM + below) / self.page_height
        return left, bottom, self.width / _WIDTH, self.height / self.page_height


def draw_maps(
    figures: Mapping[str, Any],
    points: Floats,
    components: Mapping[str, Floats],
    labels: Mapping[str, str],
) -> Page:
    """Draw a map of the mean deviation in each cell, for each component."""
    names = [name for name in _MAPPED if name in components]
    area = _Area.around(points[:, :2], figures.get("cell_m"))
    grids = [area.mean_grid(points[:, :2], components[name]) for name in names]
    layout = _MapLayout.for_area(len(names), area.width / area.height)
    page = Page((_WIDTH, layout.page_height))
    page.title("Map of deviations", f"mean of A − B in cells of {area.side:.3g} m")
    limit = 1000 * _color_limit(grids, [components[name] for name in names])
    norm = Normalize(-limit, limit)
    limits = area.limits(layout.width / layout.height)
    for number, (name, grid) in enumerate(zip(names, grids, strict=True)):
        axes = page.map_chart(
            layout.frame(number), limits, tick_count=8 if layout.columns == 1 else 4
        )
        _name_axes(axes, with_north=number % layout.columns == 0)
        _draw_grid(axes, grid, area, norm)
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1])
        page.heading(axes, labels[name])
    bottom = layout.frame(len(names) - 1)[1]
    _draw_scale(page, norm, bottom, layout.frame(0)[1] + layout.frame(0)[3])
    return page


def _draw_scale(page: Page, norm: Normalize, bottom: float, top: float) -> None:
    """Draw the color scale of maps between two heights, as fractions of the page."""
    ramp = theme.apply_colormap(_COLORS, np.linspace(0, 1, 256))
    page.color_bar(ramp, norm, "A − B, mm", (_RIGHT + 0.025, bottom, 0.014, top - bottom))


def _draw_grid(axes: Axes, grid: Floats, area: _Area, norm: Normalize) -> None:
    rows, columns = grid.shape
    left, bottom = area.lower.tolist()
    image = axes.imshow(
        1000 * np.ma.masked_invalid(grid),
        cmap=_COLORS,
        norm=norm,
        extent=(left, left + columns * area.side, bottom, bottom + rows * area.side),
        origin="lower",
        interpolation="nearest",
    )
    image.set_zorder(2)


class _Area(NamedTuple):
    """Area of a map, which is divided into square cells."""

    lower: Floats  # (2,): southwest corner, in meters
    upper: Floats  # (2,): northeast corner
    side: float  # width of a cell

    @classmethod
    def around(cls, positions: Floats, cell_m: float | None) -> _Area:
        """Return the area that contains positions, of shape (n, 2).

        `cell_m` is the cell width if the positions are cell centers, otherwise None.
        """
        margin = (cell_m or 0.0) / 2
        lower, upper = positions.min(axis=0) - margin, positions.max(axis=0) + margin
        return cls(lower, upper, _cell_side(upper - lower, len(positions), cell_m))

    @property
    def width(self) -> float:
        return max(float(self.upper[0] - self.lower[0]), self.side)

    @property
    def height(self) -> float:
        return max(float(self.upper[1] - self.lower[1]), self.side)

    def mean_grid(self, positions: Floats, values: Floats) -> Floats:
        """Return the mean value in each cell, south first, or NaN in empty cells."""
        columns, rows = (
            int(np.ceil(length / self.side - 1e-6)) for length in (self.width, self.height)
        )
        column, row = np.floor((positions - self.lower) / self.side).astype(np.int64).T
        cell = row.clip(0, rows - 1) * columns + column.clip(0, columns - 1)
        counts = np.bincount(cell, minlength=rows * columns)
        sums = np.bincount(cell, values, rows * columns)
        with np.errstate(invalid="ignore"):
            return np.asarray((sums / counts).reshape(rows, columns))

    def limits(self, aspect: float) -> Floats:
        """Return the limits of a map with the given aspect ratio that contains the area."""
        width, height = 1.06 * self.width, 1.06 * self.height
        height = max(height, width / aspect)
        half = np.array([max(width, height * aspect), height]) / 2
        center = (self.lower + self.upper) / 2
        return np.stack([center - half, center + half])


def _cell_side(extent: Floats, points: int, cell_m: float | None) -> float:
    """Return the cell width of a map with a given extent, of shape (2,).

    It is a multiple of `cell_m`, if given.
    """
    longer_m = max(float(extent.max()), 1e-3)
    if cell_m is not None:
        return cell_m * max(int(np.ceil(longer_m / cell_m / _MAX_CELLS)), 1)
    side_m = np.sqrt(_POINTS_PER_CELL * extent.prod() / points)
    return float(np.clip(side_m, longer_m / _MAX_CELLS, longer_m / _MIN_CELLS))


def _color_limit(grids: Sequence[Floats], deviations: Sequence[Floats]) -> float:
    """Return the end of the color scale in meters.

    It is the largest mean of a cell, so that it includes changes of small areas. If the means of
    the `_OUTLIERS` largest cells exceed almost all deviations, it is the next smaller mean.
    """
    means = np.sort(np.abs(np.concatenate([grid[np.isfinite(grid)] for grid in grids])))
    common = max(float(np.quantile(np.abs(values), 0.999)) for values in deviations)
    next_mean = float(means[max(len(means) - 1 - _OUTLIERS, 0)])
    return max(next_mean, min(float(means[-1]), common), _MIN_LIMIT_M)


def _name_axes(axes: Axes, *, with_north: bool) -> None:
    """Name the axes of a map E and N instead of x and y."""
    axes.set_xlabel(axes.get_xlabel().replace("x", "E", 1))
    axes.set_ylabel(axes.get_ylabel().replace("y", "N", 1) if with_north else "")


class _Facade(NamedTuple):
    """Deviations on surfaces that face the same horizontal direction."""

    name: str  # direction, such as "southwest"
    positions: Floats  # (k, 2): distance from the left end and height, in meters
    deviations: Floats  # (k,)

    @property
    def area(self) -> _Area:
        return _Area.around(self.positions, None)

    @property
    def grid(self) -> Floats:
        """Mean deviation in each cell, bottom first."""
        return self.area.mean_grid(self.positions, self.deviations)

    def height(self, width: float) -> float:
        """Return the height of a chart with the given width, in pixels."""
        return float(np.clip(width * self.area.height / self.area.width, 160, 380))


def _find_facades(points: Floats, normals: Floats, deviations: Floats) -> Iterator[_Facade]:
    """Yield the sides of a building or another object, which are at right angles to each other."""
    rows = np.flatnonzero(np.abs(normals[:, 2]) < _STEEP)
    if len(rows) < max(_MIN_FACADE_SHARE * len(points), _MIN_FACADE_POINTS):
        return
    azimuth = np.arctan2(normals[rows, 1], normals[rows, 0])
    main = np.angle(np.exp(4j * azimuth).mean()) / 4  # directions that differ by 90° are the same
    side = np.rint((azimuth - main) / (np.pi / 2)).astype(np.int64) % 4
    for number in range(4):
        chosen = rows[side == number]
        if len(chosen) < _MIN_SIDE_SHARE * len(rows):
            continue
        x, y = np.cos(main + number * np.pi / 2), np.sin(main + number * np.pi / 2)
        along = points[chosen, :2] @ [-y, x]  # to the right if seen from the front
        positions = np.stack([along - along.min(), points[chosen, 2]], axis=1)
        compass = round(np.degrees(np.arctan2(x, y)) / 45) % 8
        yield _Facade(_COMPASS[compass], positions, deviations[chosen])


def draw_facades(
    points: Floats, components: Mapping[str, Floats], columns: Mapping[str, Floats]
) -> Page | None:
    """Draw the mean deviations of steep surfaces as seen from the front.

    Returns None if there are hardly any steep surfaces, or if their normals are unknown.
    """
    if not {*NORMAL} <= {*columns} or "distance" not in components:
        return None
    normals = np.stack([columns[name] for name in NORMAL], axis=1)
    facades = [*_find_facades(points, normals, components["distance"])]
    if not facades:
        return None
    limit = 1000 * _color_limit(
        [facade.grid for facade in facades], [facade.deviations for facade in facades]
    )
    norm = Normalize(-limit, limit)
    width = (_RIGHT - _LEFT) * _WIDTH
    heights = [facade.height(width) for facade in facades]
    page_height = int(_TOP + sum(heights) + (len(heights) - 1) * _FACADE_GAP + _BOTTOM)
    page = Page((_WIDTH, page_height))
    side = max(facade.area.side for facade in facades)
    page.title("Facades", f"mean of A − B in cells of up to {side:.3g} m, seen from the front")
    top = float(page_height - _TOP)
    for facade, height in zip(facades, heights, strict=True):
        limits = facade.area.limits(width / height)
        frame = (_LEFT, (top - height) / page_height, width / _WIDTH, height / page_height)
        axes = page.map_chart(frame, limits, tick_count=12)
        axes.set_xlabel("distance from the left end, m")
        axes.set_ylabel(axes.get_ylabel().replace("y", "h", 1))
        _draw_grid(axes, facade.grid, facade.area, norm)
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1])
        page.heading(axes, f"facing {facade.name}")
        top -= height + _FACADE_GAP
    bottom = _BOTTOM / page_height
    _draw_scale(page, norm, bottom, 1 - _TOP / page_height)
    return page


def draw_histograms(
    figures: Mapping[str, Any], components: Mapping[str, Floats], labels: Mapping[str, str]
) -> Page:
    """Plot a histogram of each component, with its mean and absolute 95th percentile."""
    names = [name for name in components if name != "horizontal"]
    page = Page((_WIDTH, 620))
    page.title("Distribution of deviations", "A − B; lines show the mean and ± 95 %")
    gap = 0.04
    width = (0.97 - _LEFT - (len(names) - 1) * gap) / len(names)
    for number, name in enumerate(names):
        frame = (_LEFT + number * (width + gap), 0.16, width, 0.56)
        axes = page.chart(frame, xlabel=f"{labels[name]}, mm")
        one = figures["components"][name]
        limit = 1000 * max(1.6 * one["p95_abs_m"], _MIN_LIMIT_M)
        values = np.clip(1000 * components[name], -limit, limit)
        axes.hist(values, bins=np.linspace(-limit, limit, _BINS + 1).tolist(), color=_BAR_COLOR)
        axes.axvline(1000 * one["mean_m"], color=theme.EMPHASIS, lw=1.2 * page.unit)
        for sign in (-1, 1):
            place = sign * 1000 * one["p95_abs_m"]
            axes.axvline(place, color=theme.MUTED, lw=0.9 * page.unit, ls=(0, (4, 3)))
        axes.set_xlim(-limit, limit)
        axes.locator_params(axis="x", nbins=5)
        axes.set_yticklabels([])  # only the shape matters
        page.heading(axes, f"{labels[name]}: RMSE {1000 * one['rmse_m']:.1f} mm")
    return page

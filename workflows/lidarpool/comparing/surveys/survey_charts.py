"""Maps and histograms of the deviations between surveys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from lidarsim.numerics.arrays import Floats
from lidarview.render import theme
from lidarview.render.picture_page import Page

_WIDTH = 1600
_LEFT = 0.075
_RIGHT = 0.86
_GAP = 0.06  # between maps, as a fraction of the width
_TOP = 150  # pixels
_BOTTOM = 90
_ROW_GAP = 80
_MAX_HEIGHT = 620  # of a map, in pixels
_COLORS = "RdBu_r"
_MAPPED = ("delta_e", "delta_n", "delta_h", "distance")
_MAX_CELLS = 240  # cells of a map along its longer side
_MIN_CELLS = 12
_POINTS_PER_CELL = 4
_WIDE = 1.6  # aspect ratio of an area above which its maps are drawn one below the other
_MIN_LIMIT_M = 1e-4  # end of the color scale if there are no deviations
_BINS = 80
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
    limit = 1000 * _color_limit(grids)
    norm = Normalize(-limit, limit)
    limits = area.limits(layout.width / layout.height)
    for number, (name, grid) in enumerate(zip(names, grids, strict=True)):
        axes = page.map_chart(layout.frame(number), limits, tick_count=8 if layout.rows > 1 else 4)
        _name_axes(axes, with_north=number % layout.columns == 0)
        _draw_grid(axes, grid, area, norm)
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1])
        page.heading(axes, labels[name])
    ramp = theme.apply_colormap(_COLORS, np.linspace(0, 1, 256))
    bottom = layout.frame(len(names) - 1)[1]
    top = layout.frame(0)[1] + layout.frame(0)[3]
    page.color_bar(ramp, norm, "A − B, mm", (_RIGHT + 0.025, bottom, 0.014, top - bottom))
    return page


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
        extent_m = max(float((upper - lower).max()), 1e-3)
        return cls(lower, upper, _cell_side(extent_m, len(positions), cell_m))

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


def _cell_side(extent_m: float, points: int, cell_m: float | None) -> float:
    """Return the cell width of a map. It is a multiple of `cell_m`, if given."""
    if cell_m is not None:
        return cell_m * max(int(np.ceil(extent_m / cell_m / _MAX_CELLS)), 1)
    return extent_m / float(np.clip(np.sqrt(points / _POINTS_PER_CELL), _MIN_CELLS, _MAX_CELLS))


def _color_limit(grids: Sequence[Floats]) -> float:
    means = np.abs(np.concatenate([grid[np.isfinite(grid)] for grid in grids]))
    return max(float(np.quantile(means, 0.98)), _MIN_LIMIT_M)


def _name_axes(axes: Axes, *, with_north: bool) -> None:
    """Name the axes of a map E and N instead of x and y."""
    axes.set_xlabel(axes.get_xlabel().replace("x", "E", 1))
    axes.set_ylabel(axes.get_ylabel().replace("y", "N", 1) if with_north else "")


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

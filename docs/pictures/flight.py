"""Draw the strips of docs/how-to/flight.md: `python -m docs.pictures.flight FOLDER`.

The folder contains the results `clean` and `noisy` of the commands on this page.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from docs.pictures.options import IMAGES
from matplotlib.colors import Normalize

from lidarpool import Cloud, read_cloud
from lidarsim.numerics.arrays import Floats, Ints
from lidarview.render import theme
from lidarview.render.picture_page import Page

SIZE = (1600, 760)
CELL_M = 5.0
LIMIT_MM = 200.0
MIN_POINTS = 40  # minimum number of points of a strip in a cell
ROUGH_M = 0.10  # maximum standard deviation of the points from the plane of their cell
_COLORMAP = "RdBu_r"


def strip_differences(cloud: Cloud, low: Floats, high: Floats) -> Floats:
    """Return the height of the first strip minus that of the second in cells, in mm.

    The heights are those of planes at the centers of the cells. Cells without enough points of both
    strips, and cells that are not flat, are NaN.
    """
    shape = np.ceil((high - low) / CELL_M).astype(int)
    heights = [
        _plane_heights(cloud[cloud["sensor"] == sensor].positions, low, shape) for sensor in (0, 1)
    ]
    return 1000 * (heights[0] - heights[1]).reshape(shape[1], shape[0])


def _plane_heights(points: Floats, low: Floats, shape: Ints) -> Floats:
    """Fit a plane to the points in each cell, and return its height at the center."""
    column, row = np.floor((points[:, :2] - low) / CELL_M).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1])
    cell = (row * shape[0] + column)[inside]
    count = int(shape.prod())
    centers = low + (np.column_stack([column, row])[inside] + 0.5) * CELL_M
    x, y = (points[inside, :2] - centers).T
    z = points[inside, 2]
    terms = np.stack([np.ones_like(x), x, y])
    normal = np.array([[np.bincount(cell, a * b, count) for b in terms] for a in terms])
    right = np.array([np.bincount(cell, a * z, count) for a in terms])
    usable = (normal[0, 0] > MIN_POINTS) & (np.linalg.det(normal.T) > 1)
    planes = np.full((count, 3), np.nan)
    planes[usable] = np.linalg.solve(normal.T[usable], right.T[usable][..., None])[..., 0]
    squares = (z - (planes[cell] * terms.T).sum(axis=1)) ** 2
    rough_m = np.sqrt(np.bincount(cell, squares, count) / np.maximum(normal[0, 0], 1))
    return np.where(rough_m < ROUGH_M, planes[:, 0], np.nan)


def draw(folder: Path) -> Page:
    """Draw the height differences of two strips with and without errors."""
    low, high = np.array([-160.0, -130.0]), np.array([160.0, 130.0])
    page = Page(SIZE)
    norm = Normalize(-LIMIT_MM, LIMIT_MM)
    for number, name in enumerate(("clean", "noisy")):
        found = strip_differences(read_cloud(folder / name / "cloud.ply"), low, high)
        frame = (0.085 + 0.40 * number, 0.13, 0.35, 0.65)
        axes = page.map_chart(frame, np.stack([low, high]), tick_count=5)
        extent = (low[0], high[0], low[1], high[1])
        axes.imshow(found, cmap=_COLORMAP, norm=norm, extent=extent, origin="lower")
        axes.set(aspect="equal")
        known = found[np.isfinite(found)]
        page.heading(
            axes,
            f"{name}: mean {known.mean():+.0f} mm, RMSE {np.sqrt((known**2).mean()):.0f} mm",
        )
    page.color_bar(
        theme.apply_colormap(_COLORMAP, np.linspace(0, 1, 256)),
        norm,
        "height of line-1 minus cross-1 (mm)",
        (0.90, 0.16, 0.014, 0.58),
    )
    page.title("Two crossing strips", f"Height differences in cells of {CELL_M:g} m")
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    draw(parser.parse_args(arguments).folder).save(IMAGES / "flight-strips.png")


if __name__ == "__main__":
    main()

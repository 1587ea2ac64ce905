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
from lidarsim.numerics.arrays import Floats
from lidarview.render import theme
from lidarview.render.picture_page import Page

SIZE = (1600, 760)
CELL_M = 4.0
LIMIT_MM = 150.0
LOW, HIGH = np.array([-210.0, -160.0]), np.array([210.0, 160.0])
_COLORMAP = "RdBu_r"


def strip_errors(clean: Cloud, noisy: Cloud, sensor: int) -> Floats:
    """Return the mean height error of a strip in cells in mm, or NaN without points."""
    rows = clean["sensor"] == sensor
    points = clean.positions[rows]
    errors = noisy.positions[rows, 2] - points[:, 2]
    shape = np.ceil((HIGH - LOW) / CELL_M).astype(int)
    column, row = np.floor((points[:, :2] - LOW) / CELL_M).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1])
    cell = (row * shape[0] + column)[inside]
    count = np.bincount(cell, minlength=shape.prod())
    total = np.bincount(cell, errors[inside], minlength=shape.prod())
    return 1000 * np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape[::-1])


def draw(folder: Path) -> Page:
    """Draw the height errors of two strips, which are those of the measured trajectory."""
    clean, noisy = (read_cloud(folder / name / "cloud.ply") for name in ("clean", "noisy"))
    page = Page(SIZE)
    norm = Normalize(-LIMIT_MM, LIMIT_MM)
    for number, name in enumerate(("line-1", "cross-1")):
        found = strip_errors(clean, noisy, number)
        axes = page.map_chart(
            (0.08 + 0.42 * number, 0.13, 0.345, 0.65), np.stack([LOW, HIGH]), tick_count=5
        )
        extent = (LOW[0], HIGH[0], LOW[1], HIGH[1])
        axes.imshow(found, cmap=_COLORMAP, norm=norm, extent=extent, origin="lower", zorder=1)
        axes.set(aspect="equal")
        page.heading(axes, f"{name}: mean error {np.nanmean(found):+.0f} mm")
    page.color_bar(
        theme.apply_colormap(_COLORMAP, np.linspace(0, 1, 256)),
        norm,
        "height error (mm)",
        (0.90, 0.16, 0.014, 0.58),
    )
    page.title(
        "Two crossing strips",
        f"Measured minus true height of the points, mean in cells of {CELL_M:g} m",
    )
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    draw(parser.parse_args(arguments).folder).save(IMAGES / "flight-strips.png")


if __name__ == "__main__":
    main()

"""Draw the strips of docs/how-to/flight.md: `python -m docs.pictures.flight FOLDER`.

The folder contains the results `clean` and `noisy` of the commands on this page.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from docs.pictures.options import IMAGES
from matplotlib.colors import Normalize

from lidarpool import read_cloud
from lidarreal.comparing.surveys.strips import StripSettings, strip_deviations
from lidarreal.comparing.surveys.survey_clouds import SurveyCloud
from lidarsim.numerics.arrays import Floats
from lidarview.render import theme
from lidarview.render.picture_page import Page

SIZE = (1600, 560)
CELL_M = 4.0
LIMIT_MM = 300.0
LOW, HIGH = np.array([-210.0, -160.0]), np.array([210.0, 160.0])
_COLORMAP = "RdBu_r"


class Heights(NamedTuple):
    """Height errors or differences at horizontal positions."""

    title: str
    positions: Floats  # (n, 2), meters
    values_mm: Floats  # (n,)

    def cell_means(self) -> Floats:
        """Return the mean of the values in each cell in mm, or NaN without values."""
        shape = np.ceil((HIGH - LOW) / CELL_M).astype(int)
        column, row = np.floor((self.positions - LOW) / CELL_M).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1])
        cell = (row * shape[0] + column)[inside]
        count = np.bincount(cell, minlength=shape.prod())
        total = np.bincount(cell, self.values_mm[inside], minlength=shape.prod())
        return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape[::-1])


def read_heights(folder: Path) -> Iterator[Heights]:
    """Yield the height errors of the points of each strip, and the differences of the strips."""
    clean, noisy = (read_cloud(folder / name / "cloud.ply") for name in ("clean", "noisy"))
    for number, name in enumerate(("line-1", "cross-1")):
        points = clean.positions[clean["sensor"] == number]
        errors_mm = 1000 * (noisy.positions[noisy["sensor"] == number, 2] - points[:, 2])
        yield Heights(f"Errors of {name}", points[:, :2], errors_mm)
    cloud = SurveyCloud.open(folder / "noisy", "noisy", keep_noise=False)
    # The settings are the defaults of `lidarpool compare --survey strips`.
    strips = strip_deviations([cloud], StripSettings(cell_m=1.0, max_roughness_m=0.1))
    differences_mm = 1000 * strips.components["delta_h"]
    yield Heights("line-1 minus cross-1", strips.points[:, :2], differences_mm)


def draw(folder: Path) -> Page:
    """Draw the height errors of two strips, and the height differences between them."""
    page = Page(SIZE)
    norm = Normalize(-LIMIT_MM, LIMIT_MM)
    for number, heights in enumerate(read_heights(folder)):
        axes = page.map_chart(
            (0.085 + 0.28 * number, 0.14, 0.235, 0.62), np.stack([LOW, HIGH]), tick_count=5
        )
        axes.imshow(
            heights.cell_means(),
            cmap=_COLORMAP,
            norm=norm,
            extent=(LOW[0], HIGH[0], LOW[1], HIGH[1]),
            origin="lower",
            zorder=1,
        )
        axes.set(aspect="equal", ylabel="y (m)" if number == 0 else "")
        page.heading(axes, f"{heights.title}: mean {heights.values_mm.mean():+.0f} mm")
    page.color_bar(
        theme.apply_colormap(_COLORMAP, np.linspace(0, 1, 256)),
        norm,
        "height (mm)",
        (0.92, 0.17, 0.014, 0.56),
    )
    page.title(
        "Two crossing strips",
        "Measured minus true heights of the points, and height differences at the same positions, "
        f"mean in cells of {CELL_M:g} m",
    )
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    draw(parser.parse_args(arguments).folder).save(IMAGES / "flight-strips.png")


if __name__ == "__main__":
    main()

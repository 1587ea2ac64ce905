"""A sweep of a data set from above, for its card."""

from __future__ import annotations

import numpy as np

from ..base.words import counted
from ..export.loader import Sweep
from ..render import theme
from ..render.page import Page, shortened

SIZE = (1600, 1000)
LEFT, TOP, MARGIN, KEY = 90, 190, 60, 240  # pixels; KEY is the width beside the drawing
MOST_DOTS = 150_000
SHARE = 0.97  # of the points that are within the drawing
VALUES = 4  # that are named
CLASSES = 10  # with colours of their own, the most frequent


def draw_sweep(sweep: Sweep) -> Page:
    """Draw the points of a sweep in the sensor's axes, coloured by class, or else by height."""
    page = Page(SIZE)
    width, height = SIZE[0] - LEFT - MARGIN - KEY, SIZE[1] - TOP - MARGIN
    axes = page.chart((LEFT / SIZE[0], MARGIN / SIZE[1], width / SIZE[0], height / SIZE[1]))
    some = slice(None, None, max(1, -(-len(sweep) // MOST_DOTS)))
    points = sweep.points[some]
    classes = None if sweep.classes is None else sweep.classes[some]
    values = [
        f"{name} {f'{value:.4g}' if isinstance(value, float) else shortened(str(value))}"
        for name, value in list(sweep.values.items())[:VALUES]
    ]
    page.title(
        f"A sweep of job {sweep.job}",
        f"{counted(len(sweep), 'point')} from above, metres in the sensor's axes",
        ", ".join(values),
    )
    if classes is not None and len(np.unique(classes)) > 1:
        counts = np.bincount(classes)
        frequent = [one for one in counts.argsort()[::-1][:CLASSES].tolist() if counts[one]]
        colours = theme.object_colours(len(frequent))
        painted = np.full((len(points), 3), 0.6)
        for one, colour in zip(frequent, colours, strict=True):
            painted[classes == one] = colour
        names = [f"class {one}" if one else "none" for one in frequent]
        page.legend([*zip(names, colours, strict=True)], "sensor")
    else:
        z = points[:, 2]
        low, high = np.percentile(z, (2, 98)) if len(z) else (0.0, 1.0)
        painted = theme.mapped("viridis", np.clip((z - low) / max(high - low, 1e-6), 0, 1))
    reach = np.percentile(np.abs(points[:, :2]).max(axis=1), 100 * SHARE) if len(points) else 1.0
    ratio = width / height
    axes.set_xlim(-reach * ratio, reach * ratio)
    axes.set_ylim(-reach, reach)
    axes.scatter(points[:, 0], points[:, 1], s=3 * page.unit**2, c=painted, lw=0, rasterized=True)
    axes.plot(0, 0, marker="o", color=theme.SENSOR, ms=7 * page.unit)
    return page

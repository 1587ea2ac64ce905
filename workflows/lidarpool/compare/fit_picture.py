"""The picture of a fit: noise, returns, and channels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..render import theme
from ..render.picture_page import Page

_SIZE = 1600, 1750
_WIDE, _HIGH = 0.235, 0.205
# (curve, or column of `channels`): (title, label of x, label of y, factor).
_CHARTS = {
    "noise_by_range": ("Noise of ranges", "range, m", "noise, mm", 1000),
    "noise_by_light": ("", "{light}", "noise, mm", 1000),
    "noise_by_tilt": ("", "incidence, °", "noise with that of directions, mm", 1000),
    "returned_by_light": ("Returns", "{light}", "pulses that return, %", 100),
    "lost_by_range": ("", "range of the scene, m", "pulses lost, %", 100),
    "light_by_range": ("", "range, m", "mean intensity", 1),
    "noise_m": ("Rings", "elevation, °", "noise, mm", 1000),
    "bias_m": ("", "elevation, °", "bias, mm", 1000),
    "uneven_deg": ("", "elevation, °", "spread of azimuths, °", 1),
}


def draw_fit(figures: Mapping[str, Any]) -> Page:
    """Draw the curves and channels of a fit, with intervals of 95 %."""
    page = Page(_SIZE)
    page.title(figures["model"], f"fitted to {figures['name']}; bars are intervals of 95 %")
    light = "energy" if figures["by_energy"] else "intensity"
    for number, (name, (title, x, y, unit)) in enumerate(_CHARTS.items()):
        row, column = divmod(number, 3)
        frame = 0.075 + 0.32 * column, 0.67 - 0.305 * row, _WIDE, _HIGH
        axes = page.chart(frame, xlabel=x.format(light=light), ylabel=y)
        page.heading(axes, title, fontweight="bold")
        points = figures["curves"].get(name, [])
        if row == 2:
            rings = (one for one in figures["channels"] if one[name] is not None)
            points = [
                {"x": one["elevation_deg"]}
                | (one[name] if number < 8 else dict.fromkeys(("value", "low", "high"), one[name]))
                for one in rings
            ]
        if not points:
            axes.text(0.5, 0.5, "unknown", transform=axes.transAxes, ha="center", va="center",
                      color=theme.MUTED)  # fmt: skip
            continue
        at, value, low, high = (
            np.array([one[key] for one in points]) for key in ("x", "value", "low", "high")
        )
        axes.vlines(at, unit * low, unit * high, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(at, unit * value, "o", color="#4477aa", ms=3.2 * page.unit, mew=0)
        if x == "{light}" and at.min() > 0:
            axes.set_xscale("log")
        if name.startswith("noise"):
            axes.set_ylim(bottom=0)
    return page

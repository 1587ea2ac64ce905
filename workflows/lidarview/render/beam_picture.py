"""Draw the directions and times of a sensor's first rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.colors import Normalize

from lidarsim.numerics.arrays import Floats
from lidarsim.sensor import LineSensor, Sensor

from .picture_page import Page
from .shot import SIZE
from .theme import apply_colormap

COLORS = "viridis"
MAX_FIRINGS = 8  # number of firings that are drawn for sensors with several channels


class _BeamPlot(NamedTuple):
    """Ray directions and times with axis labels."""

    x_values: Floats  # (n,)
    y_values: Floats  # (n,)
    labels: tuple[str, str]


def beam_page(sensor: Sensor, size: tuple[int, int] = SIZE) -> Page:
    """Draw the directions of a sensor's first rays, colored by time.

    For a sensor with several channels, `MAX_FIRINGS` firings are drawn. For a sensor with a single
    channel, one frame is drawn. For a sensor that looks down, two mirror cycles are drawn. Its rays
    lie in a plane, so their angle is plotted over time.
    """
    page = Page(size)
    firings_per_revolution = round(getattr(sensor.head, "firings_per_turn", 1000))
    looks_down = isinstance(sensor, LineSensor)
    has_channels = sensor.channels > 1
    if has_channels:
        count = MAX_FIRINGS
        words = f"{MAX_FIRINGS} firings"
    elif looks_down:
        count = 2 * firings_per_revolution
        words = "two cycles"
    else:
        count = firings_per_revolution
        words = "one frame"
    firings = np.arange(count)
    times = sensor.times_ns(firings).reshape(-1) / 1e3
    unit = "µs"
    if times.max() > 9999:
        times = times / 1e3
        unit = "ms"
    directions = sensor.directions(firings).reshape(-1, 3)
    plot = _plot_angle(directions, times, unit) if looks_down else _plot_directions(directions)
    axes = page.chart((0.075, 0.12, 0.75, 0.73), xlabel=plot.labels[0], ylabel=plot.labels[1])
    if not (has_channels or looks_down):
        axes.set_aspect("equal")
    norm = Normalize(0, max(float(times.max()), 1e-3))
    area = (10 if has_channels else 2) * page.unit**2
    axes.scatter(
        plot.x_values, plot.y_values, s=area, c=apply_colormap(COLORS, norm(times)), linewidths=0
    )
    page.color_bar(apply_colormap(COLORS, np.linspace(0, 1, 256)), norm, f"time, {unit}")
    page.title(sensor.name, f"{sensor.channels:,} channel{'s' * has_channels} · {words}")
    return page


def _plot_angle(directions: Floats, times: Floats, unit: str) -> _BeamPlot:
    """Plot the angles of directions in a vertical plane over time."""
    _, y, z = directions.T
    return _BeamPlot(times, np.degrees(np.arctan2(y, -z)), (f"time, {unit}", "angle, degrees"))


def _plot_directions(directions: Floats) -> _BeamPlot:
    """Plot the azimuths and elevations of directions."""
    x, y, z = directions.T
    middle = np.degrees(np.arctan2(y[0], x[0]))  # avoids a jump at 180 degrees
    azimuth = np.degrees(np.arctan2(y, x))
    continuous = (azimuth - middle + 180) % 360 - 180 + middle
    labels = ("azimuth, degrees", "elevation, degrees")
    return _BeamPlot(continuous, np.degrees(np.arcsin(z)), labels)

"""The picture of a sensor's beams: directions and times of its first rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize

from lidarsim.sensor import LineSensor, Sensor

from .picture_page import Page
from .shot import SIZE
from .theme import mapped

COLOURS = "viridis"
FIRINGS = 8  # shown, where each is many rays


def draw_beams(path: Path, sensor: Sensor) -> None:
    """Draw the directions of a sensor's first rays, coloured by time.

    These are the rays of some firings; if a firing is one ray, those of a frame, or of two cycles
    of a mirror. For a sensor that looks down, whose rays lie in a plane, the angle over time.
    LidarError if the file, a .png, cannot be written.
    """
    page = Page(SIZE)
    turn = round(getattr(sensor.head, "firings_per_turn", 1000))
    down = isinstance(sensor, LineSensor)
    many = sensor.channels > 1
    firings = np.arange(FIRINGS if many else 2 * turn if down else turn)
    times = sensor.times_ns(firings).reshape(-1) / 1e3
    unit = "µs"
    if times.max() > 9999:
        times = times / 1e3
        unit = "ms"
    x, y, z = sensor.directions(firings).reshape(-1, 3).T
    if down:
        across = times
        up = np.degrees(np.arctan2(y, -z))
        labels = f"time, {unit}", "angle, degrees"
    else:
        middle = np.degrees(np.arctan2(y[0], x[0]))  # no jump where azimuths pass 180 degrees
        azimuth = np.degrees(np.arctan2(y, x))
        across = (azimuth - middle + 180) % 360 - 180 + middle
        up = np.degrees(np.arcsin(z))
        labels = "azimuth, degrees", "elevation, degrees"
    shape = "auto" if many or down else "equal"
    axes = page.chart((0.075, 0.12, 0.75, 0.73), aspect=shape, xlabel=labels[0], ylabel=labels[1])
    norm = Normalize(0, max(float(times.max()), 1e-3))
    size = (10 if many else 2) * page.unit**2
    axes.scatter(across, up, s=size, c=mapped(COLOURS, norm(times)), linewidths=0)
    page.colour_bar(mapped(COLOURS, np.linspace(0, 1, 256)), norm, f"time, {unit}")
    shown = f"{FIRINGS} firings" if many else "two cycles" if down else "one frame"
    page.title(sensor.name, f"{sensor.channels:,} channel{'s' * many} · {shown}")
    page.save(path)

"""The picture of a sensor's beams: where the rays of one turn go, and a closer look."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from ..sensor import LineSensor, Sensor
from . import theme
from .page import FONT, Page
from .shot import SIZE
from .theme import mapped

Floats = NDArray[np.float64]

COLOURS = "viridis"
MOST_RAYS = 60_000  # of a turn; more would cover each other
CLOSE_FIRINGS = 8


def draw_beams(path: Path, sensor: Sensor) -> None:
    """Draw where a sensor's rays go.

    On the left a whole turn; on the right its first firings, coloured by time. Where a firing is
    one ray: ten frames, and the first of them. Of a sensor that looks down, whose rays lie in one
    plane, the angle across over time.

    Parameters
    ----------
    path
        The file to write, .png.
    sensor
        The sensor.

    Raises
    ------
    LidarpoolError
        If the file cannot be written.
    """
    page = Page(SIZE)
    turn = round(getattr(sensor.head, "firings_per_turn", 1000))
    if isinstance(sensor, LineSensor):
        axes = _panel(page, (0.075, 0.12, 0.76, 0.7), "two cycles", "time, ms", "angle, degrees")
        firings = np.arange(2 * turn)
        _, y, z = sensor.directions(firings)[:, 0].T
        times = sensor.times_ns(firings)[:, 0] / 1e6
        across = np.degrees(np.arctan2(y, -z))
        axes.scatter(times, across, s=2 * page.unit**2, c=theme.SENSOR, linewidths=0)
    else:
        many = sensor.channels > 1
        whole = np.arange(0, turn if many else 10 * turn, 1 + turn * sensor.channels // MOST_RAYS)
        close = np.arange(CLOSE_FIRINGS if many else turn)
        left, right = ("one turn", "its first firings") if many else ("ten frames", "the first")
        axes = _panel(page, (0.065, 0.12, 0.345, 0.7), left, *_ANGLES)
        axes.set_aspect("auto" if many else "equal", adjustable="datalim")
        dots = 1.2 * page.unit**2
        axes.scatter(*_angles(sensor, whole), s=dots, c=theme.SENSOR, linewidths=0)
        axes = _panel(page, (0.475, 0.12, 0.345, 0.7), right, *_ANGLES)
        axes.set_aspect("auto" if many else "equal", adjustable="datalim")
        times = sensor.times_ns(close).reshape(-1) / 1e3
        unit = "µs"
        if times.max() > 9999:
            times, unit = times / 1e3, "ms"
        norm = Normalize(0, max(float(times.max()), 1e-3))
        colours = mapped(COLOURS, norm(times))
        axes.scatter(*_angles(sensor, close), s=(8 if many else 1) * dots, c=colours, linewidths=0)
        page.colour_bar(mapped(COLOURS, np.linspace(0, 1, 256)), norm, f"time, {unit}")
    page.title(sensor.name or type(sensor).__name__, _facts(sensor))
    page.save(path)


_ANGLES = ("azimuth, degrees", "elevation, degrees")


def _angles(sensor: Sensor, firings: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Azimuth and elevation of all rays of firings, degrees, in one piece where they are one."""
    x, y, z = sensor.directions(firings).reshape(-1, 3).T
    middle = (
        np.degrees(np.arctan2(y.mean(), x.mean())) if x.mean() ** 2 + y.mean() ** 2 > 0.1 else 0
    )
    azimuth = np.degrees(np.arctan2(y, x))
    return (azimuth - middle + 180) % 360 - 180 + middle, np.degrees(np.arcsin(np.clip(z, -1, 1)))


def _facts(sensor: Sensor) -> str:
    """Channels, elevations and times of a firing."""
    elevation = np.degrees(sensor.beams.elevation)
    each = np.diff(sensor.times_ns(np.arange(2))[:, 0])[0] / 1e3
    words = (
        f"{sensor.channels:,} channel{'s' * (sensor.channels > 1)}, a firing every {each:,.3f} µs"
    )
    if sensor.channels > 1:
        words += f", {elevation[0]:.2f}° to {elevation[-1]:.2f}°"
    return words.replace("-", "−")


def _panel(
    page: Page, place: tuple[float, float, float, float], title: str, across: str, up: str
) -> Axes:
    """Axes at a place of the page: left, bottom, width, height."""
    unit = page.unit
    axes = page.figure.add_axes(place)
    axes.set_facecolor(theme.GROUND)
    axes.grid(color=theme.LINE, lw=0.5 * unit)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set(color=theme.LINE, linewidth=0.6 * unit)
    words: dict[str, Any] = {"fontsize": 7.6 * unit, "color": theme.INK, "family": FONT}
    axes.set_title(title, **words)
    axes.set_xlabel(across, **words)
    axes.set_ylabel(up, **words)
    axes.tick_params(
        labelsize=6.8 * unit, labelcolor=theme.MUTED, color=theme.LINE, length=2.5 * unit,
        width=0.6 * unit, labelfontfamily=FONT,
    )  # fmt: skip
    return axes

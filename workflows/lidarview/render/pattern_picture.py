"""Draw a sensor's scan pattern: one frame, and the field of view's coverage over time."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.sensor import LineSensor, Sensor
from lidarsim.sensor.ray_sensors import PrismSensor
from lidarsim.words import list_names

from . import theme
from .beam_picture import COLORS, beam_page
from .picture_page import Page
from .theme import apply_colormap

TIMES_S = (0.1, 0.5, 2.0)
CELL_DEG = 0.28  # width of a coverage cell, which is the beam width of Livox sensors
FIELD_S = 4.0  # the cells that are hit within this time are the field of view
CONVENTIONS = "azimuth in degrees from x (forward) to y (left); elevation above the xy plane"
_COVERED = to_rgb(theme.OBJECT_COLORS[0])
_FIRST_FIRINGS = 8  # number of firings that are drawn for sensors with several channels
_MAX_FRAME_RAYS = 300_000  # longer frames are thinned out to every n-th firing
_CHUNK_RAYS = 1_000_000
_WIDE = 2.0  # charts are stacked if the field of view has a larger aspect ratio
_WIDE_SIZE = (1600, 1150)
_NARROW_SIZE = (1600, 640)


class _Pattern(NamedTuple):
    """Ray directions in a frame, and the time at which each direction cell is first hit.

    Attributes
    ----------
    azimuths_deg, elevations_deg
        (n,) angles of the rays in a frame.
    times_s
        (n,) times of the rays in seconds.
    met_s
        (rows, columns) time at which each cell is first hit, in seconds, or infinity for cells that
        are never hit.
    every
        The frame contains only one out of this many firings.
    """

    azimuths_deg: Floats
    elevations_deg: Floats
    times_s: Floats
    met_s: Floats
    every: int


class _Window(NamedTuple):
    """The part of the cell grid that contains rays."""

    row_range: slice
    column_range: slice
    extent: tuple[float, float, float, float]  # left, right, bottom, top, degrees


def draw_pattern(path: Path, sensor: Sensor) -> None:
    """Draw a sensor's scan pattern in a .png file.

    The image is that of `pattern_page`. Raises LidarError if the file cannot be written.
    """
    pattern_page(sensor).save(path)


def pattern_page(sensor: Sensor) -> Page:
    """Draw a sensor's frame, colored by time, and the coverage after each of `TIMES_S`.

    For sensors with prisms, whose patterns do not repeat, the covered fraction of the field of view
    is stated. For a sensor that looks down, the angle over time is drawn instead, as in
    `beam_page`.
    """
    if isinstance(sensor, LineSensor):
        page = beam_page(sensor)
        page.draw_note(
            "angle: 0 points down, positive angles point left of the flight direction; rays lie in "
            "the yz plane"
        )
        return page
    pattern = _pattern_of(sensor)
    window = _window(pattern)
    left, right, bottom, top = window.extent
    is_wide = right - left > _WIDE * (top - bottom)
    page = Page(_WIDE_SIZE if is_wide else _NARROW_SIZE)
    has_shares = isinstance(sensor, PrismSensor)
    coverages = _coverages(pattern.met_s, has_shares)
    has_zoom = sensor.channels > 1 and not has_shares
    charts = _charts(page, 1 + has_zoom + len(coverages), is_wide, window)
    _draw_frame(page, charts[0], sensor, pattern)
    if has_zoom:
        _draw_firings(page, charts[1], sensor)
    for axes, (words, covered) in zip(charts[1 + has_zoom :], coverages, strict=True):
        image = np.ones((*covered.shape, 4))
        image[..., :3] = _COVERED
        image[..., 3] = covered
        axes.imshow(
            image[window.row_range, window.column_range],
            origin="lower",
            extent=window.extent,
            aspect="auto" if is_wide else "equal",
        )
        page.heading(axes, words)
    channels = f"{sensor.channels:,} channel{'s' * (sensor.channels > 1)}"
    details = [f"{channels} · {CONVENTIONS}"]
    if has_shares:
        details.append(
            f"percentages of the field of view, that is, of the {CELL_DEG:g}° cells that rays "
            f"reach within {FIELD_S:g} s"
        )
    page.title(sensor.model, *details)
    return page


def _pattern_of(sensor: Sensor) -> _Pattern:
    per_second = _firings_per_second(sensor)
    per_frame = max(round(getattr(sensor.head, "firings_per_turn", per_second / 10)), 1)
    every = -(-per_frame * sensor.channels // _MAX_FRAME_RAYS)
    firings = np.arange(0, per_frame, every)
    azimuths_deg, elevations_deg = _angles_deg(sensor, firings)
    times_s = _times_s(sensor, firings)
    met_s = np.full((round(180 / CELL_DEG) + 1, round(360 / CELL_DEG) + 1), np.inf)
    count = round(FIELD_S * per_second)
    if not isinstance(sensor, PrismSensor):
        count = min(round(max(TIMES_S) * per_second), sensor.period or 2**62)
    chunk = max(_CHUNK_RAYS // sensor.channels, 1)
    for start in range(0, count, chunk):
        part = np.arange(start, min(start + chunk, count))
        np.minimum.at(met_s, _cells(*_angles_deg(sensor, part)), _times_s(sensor, part))
    return _Pattern(azimuths_deg, elevations_deg, times_s, met_s, every)


def _firings_per_second(sensor: Sensor) -> float:
    """Return the firing rate, measured over the first thousand firings."""
    start_ns, stop_ns = sensor.begins_ns(np.array([0, 1000]))
    return float(1000 / (stop_ns - start_ns) * 1e9)


def _angles_deg(sensor: Sensor, firings: Ints) -> tuple[Floats, Floats]:
    """Return the azimuths and elevations of the rays in the given firings."""
    x, y, z = sensor.directions(firings).reshape(-1, 3).T
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z, -1, 1)))


def _times_s(sensor: Sensor, firings: Ints) -> Floats:
    """Return the times of the rays in the given firings, relative to the start of the sensor."""
    times_ns = sensor.times_ns(firings).reshape(-1).astype(np.float64)
    return (times_ns - sensor.start_ns) / 1e9


def _cells(azimuths_deg: Floats, elevations_deg: Floats) -> tuple[Ints, Ints]:
    """Return the rows and columns of the cells that contain the given directions."""
    rows = ((elevations_deg + 90) / CELL_DEG).astype(np.int64)
    return rows, ((azimuths_deg + 180) / CELL_DEG).astype(np.int64)


def _window(pattern: _Pattern) -> _Window:
    """Return the part of the grid that contains rays, with a margin of one cell."""
    met = np.isfinite(pattern.met_s)
    met[_cells(pattern.azimuths_deg, pattern.elevations_deg)] = True
    edges = []
    for axis, count in ((1, met.shape[0]), (0, met.shape[1])):
        used = np.flatnonzero(met.any(axis=axis))
        edges.append((max(int(used[0]) - 1, 0), min(int(used[-1]) + 2, count)))
    (bottom, top), (left, right) = edges
    azimuths = (left * CELL_DEG - 180, right * CELL_DEG - 180)
    elevations = (bottom * CELL_DEG - 90, top * CELL_DEG - 90)
    return _Window(slice(bottom, top), slice(left, right), (*azimuths, *elevations))


def _coverages(met_s: Floats, has_shares: bool) -> list[tuple[str, Bools]]:
    """Return a heading and a mask of covered cells for each of `TIMES_S`.

    Times with identical coverage share an entry.
    """
    field = np.isfinite(met_s).sum()
    covered = {seconds: met_s <= seconds for seconds in TIMES_S}
    groups = groupby(TIMES_S, key=lambda seconds: int(covered[seconds].sum()))
    coverages = []
    for count, members in groups:
        times_s = [*members]
        words = f"after {list_names([f'{seconds:g}' for seconds in times_s])} s"
        if times_s[1:]:
            words += ": identical coverage"
        if has_shares:
            words += f": {100 * count / field:.0f} %"
        coverages.append((words, covered[times_s[0]]))
    return coverages


def _charts(page: Page, count: int, is_wide: bool, window: _Window) -> list[Axes]:
    """Add charts to a page.

    They are stacked if the field of view is wide, and side by side otherwise.
    """
    left, right, bottom, top = window.extent
    limits = {"xlim": (left, right), "ylim": (bottom, top)}
    charts = []
    for number in range(count):
        if is_wide:
            height = 0.84 / count
            frame = (0.06, 0.06 + (count - 1 - number) * height, 0.79, height - 0.07)
            labels = {"ylabel": "elevation"}
            labels |= {"xlabel": "azimuth"} if number == count - 1 else {}
        else:
            width = 0.82 / count
            frame = (0.068 + number * width, 0.12, width - 0.035, 0.62)
            labels = {"xlabel": "azimuth"} | ({} if number else {"ylabel": "elevation"})
        charts.append(page.chart(frame, **limits, **labels))
        if not is_wide:
            charts[-1].set_aspect("equal")
    return charts


class _TimeScale(NamedTuple):
    """The time unit and color scale of a plot."""

    unit: str
    per_s: float
    norm: Normalize


def _draw_frame(page: Page, axes: Axes, sensor: Sensor, pattern: _Pattern) -> None:
    """Draw the rays in a frame, colored by time."""
    last_s = float(pattern.times_s.max())
    unit, per_s = ("s", 1.0) if last_s > 5 else ("ms", 1e3)
    scale = _TimeScale(unit, per_s, Normalize(0, max(per_s * last_s, 1e-3)))
    area = 2.0 if len(pattern.times_s) < 5000 else 0.4
    _draw_rays(
        page, axes, (pattern.azimuths_deg, pattern.elevations_deg), pattern.times_s, scale, area
    )
    colors = apply_colormap(COLORS, np.linspace(0, 1, 256))
    page.color_bar(colors, scale.norm, f"ray time, {unit}")
    words = "one frame" if sensor.cycle == "frame" else "one revolution"
    if pattern.every > 1:
        words += f", 1 of {pattern.every} firings"
    page.heading(axes, words)


def _draw_firings(page: Page, axes: Axes, sensor: Sensor) -> None:
    """Draw the first firings of a sensor with their own color scale."""
    firings = np.arange(_FIRST_FIRINGS)
    angles_deg = _angles_deg(sensor, firings)
    times_s = _times_s(sensor, firings)
    last_s = float(times_s.max())
    unit, per_s = ("µs", 1e6) if last_s < 0.01 else ("ms", 1e3)
    stretched = _TimeScale(unit, per_s, Normalize(0, max(per_s * last_s, 1e-3)))
    middle = angles_deg[0][0]  # avoids a jump at 180 degrees
    azimuths_deg = (angles_deg[0] - middle + 180) % 360 - 180 + middle
    _draw_rays(page, axes, (azimuths_deg, angles_deg[1]), times_s, stretched, 8.0)
    axes.autoscale()
    duration = f"{per_s * last_s:,.0f} {unit}"
    page.heading(axes, f"first {_FIRST_FIRINGS} firings, {duration}, with the full color range")


def _draw_rays(
    page: Page,
    axes: Axes,
    angles_deg: tuple[Floats, Floats],
    times_s: Floats,
    scale: _TimeScale,
    area: float,
) -> None:
    """Draw rays as dots of a given area, colored by time."""
    axes.scatter(
        *angles_deg,
        s=area * page.unit**2,
        c=apply_colormap(COLORS, scale.norm(scale.per_s * times_s)),
        linewidths=0,
    )

"""Range images of single sweeps, as pictures."""

from __future__ import annotations

import math

import numpy as np

from lidarsim.base.arrays import Bytes, Floats, Ints
from lidarsim.scene.colors import as_bytes

from ..render.theme import RANGE_COLORS, mapped

_IMAGE_WIDTH = 1024  # most columns of a range image

_IMAGE_ROWS = 128  # rows of a range image, unless its rows are channels

_COLUMN_SHARE = 0.9  # columns of a range image, as a share of a sensor's steps of azimuth

_MIN_CHANNELS = 4  # least channels of a sensor whose channels are the rows of a range image

_MAX_CHANNELS = 512  # likewise

_MAX_DOWNWARD_SINE = -0.7  # sine of the median elevation; below, the sensor looks down

_MAX_FIELD_RAD = math.radians(300)  # a wider field of view is shown as 360°


def range_image(
    points: Floats, ranges: Floats, channels: Ints | None, limits: tuple[float, float]
) -> Bytes:
    """Return a range image of points, RGBA (rows, columns, 4).

    `points` (n, 3) are in the sensor frame, `ranges` (n,) their distances from the sensor, meters;
    `channels` (n,) are None if unknown; `limits` are the ranges at the ends of the color scale.

    Of several points in a pixel the nearest is shown. Rows are channels, the highest above, or
    steps of elevation if the sensor has few or very many channels. Columns are steps of azimuth
    from left to right. A sensor that looks down has a single row, of angles across its trajectory.
    Empty pixels are transparent.
    """
    looks_down = float(np.median(points[:, 2] / np.maximum(ranges, 1e-9))) < _MAX_DOWNWARD_SINE
    azimuth = np.arctan2(points[:, 1], -points[:, 2] if looks_down else points[:, 0])
    left_rad = float(azimuth.max())
    right_rad = float(azimuth.min())
    if left_rad - right_rad > _MAX_FIELD_RAD:
        left_rad = math.pi
        right_rad = -math.pi
    field_rad = left_rad - right_rad
    if looks_down:
        row_count = 1
        row = np.zeros(len(points), np.int64)
    else:
        row, row_count = _image_rows(points, ranges, channels)
    fullest_row_azimuth = azimuth[row == np.bincount(row).argmax()]
    # Mean step of azimuth in the row with the most points; columns are a little wider.
    spacing_rad = float(np.ptp(fullest_row_azimuth)) / len(fullest_row_azimuth)
    width = int(np.clip(_COLUMN_SHARE * field_rad / max(spacing_rad, 1e-9), 32, _IMAGE_WIDTH))
    column = ((left_rad - azimuth) * (width / max(field_rad, 1e-9))).astype(np.int64)
    image = np.zeros((row_count, width, 4), np.uint8)
    order = np.argsort(-ranges, kind="stable")  # the nearest is written last
    image[row[order], np.minimum(column, width - 1)[order]] = _range_colors(ranges, limits)[order]
    return image


def _image_rows(points: Floats, ranges: Floats, channels: Ints | None) -> tuple[Ints, int]:
    """Return the rows (n,) of points in a range image, 0 at the top, and the number of rows."""
    if channels is not None:
        count = int(channels.max()) + 1
        if _MIN_CHANNELS <= count <= _MAX_CHANNELS:
            return count - 1 - channels, count
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9))
    span = float(np.ptp(elevation)) or 1.0
    row = ((elevation.max() - elevation) * ((_IMAGE_ROWS - 1) / span)).astype(np.int64)
    return row, _IMAGE_ROWS


def _range_colors(ranges: Floats, limits: tuple[float, float]) -> Bytes:
    """Return the colors (n, 4) of ranges (n,) between limits."""
    lower, upper = limits
    shade = np.clip((ranges - lower) / max(upper - lower, 1e-9), 0, 1)
    colors = np.full((len(ranges), 4), 255, np.uint8)
    colors[:, :3] = as_bytes(mapped(RANGE_COLORS, shade))
    return colors


def are_around(sensors: Floats, bounds: Floats) -> bool:
    """Return True if all sensors (n, 3), n > 1, are beside or above an object's bounds (2, 3)."""
    outside = ((sensors < bounds[0]) | (sensors > bounds[1])).any(axis=1)
    return len(sensors) > 1 and bool(outside.all())

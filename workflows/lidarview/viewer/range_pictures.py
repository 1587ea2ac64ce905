"""Draw range images of single sweeps."""

from __future__ import annotations

import math

import numpy as np

from lidarsim.numerics.arrays import Bytes, Floats, Ints
from lidarsim.scene.colors import as_bytes

from ..render.theme import RANGE_COLORS, apply_colormap

_IMAGE_WIDTH = 1024  # maximum number of columns

_IMAGE_ROWS = 128  # number of rows unless rows are channels

_COLUMN_SHARE = 0.9  # number of columns as a fraction of the sensor's azimuth steps

# A sensor with fewer or more channels gets elevation steps as rows.
_MIN_CHANNELS = 4

_MAX_CHANNELS = 512

# A sensor looks down if the sine of its median elevation is below this value.
_MAX_DOWNWARD_SINE = -0.7

_MAX_FIELD_RAD = math.radians(300)  # a wider field of view is shown as 360°


def range_image(
    points: Floats, ranges: Floats, channels: Ints | None, limits: tuple[float, float]
) -> Bytes:
    """Draw a range image of a sweep.

    Rows are channels, the highest at the top. If the sensor has fewer than four or more than 512
    channels, or if the channels are unknown, rows are elevation steps instead. Columns are azimuth
    steps from left to right. For a sensor that looks down, the image has a single row of angles
    across the trajectory. If several points fall into a pixel, the nearest is shown. Empty pixels
    are transparent.

    Parameters
    ----------
    points
        (n, 3) positions in the sensor frame, in meters.
    ranges
        (n,) distances from the sensor, in meters.
    channels
        (n,) channel numbers, or None if unknown.
    limits
        Ranges at the ends of the color scale, in meters.

    Returns
    -------
    RGBA image, uint8, of shape (rows, columns, 4).
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
    # Mean azimuth step in the row with the most points. Columns are a little wider.
    spacing_rad = float(np.ptp(fullest_row_azimuth)) / len(fullest_row_azimuth)
    width = int(np.clip(_COLUMN_SHARE * field_rad / max(spacing_rad, 1e-9), 32, _IMAGE_WIDTH))
    column = ((left_rad - azimuth) * (width / max(field_rad, 1e-9))).astype(np.int64)
    image = np.zeros((row_count, width, 4), np.uint8)
    order = np.argsort(-ranges, kind="stable")  # the nearest point is written last
    image[row[order], np.minimum(column, width - 1)[order]] = _range_colors(ranges, limits)[order]
    return image


def _image_rows(points: Floats, ranges: Floats, channels: Ints | None) -> tuple[Ints, int]:
    """Return each point's row in a range image, counted from the top, and the row count."""
    if channels is not None:
        count = int(channels.max()) + 1
        if _MIN_CHANNELS <= count <= _MAX_CHANNELS:
            return count - 1 - channels, count
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9))
    span = float(np.ptp(elevation)) or 1.0
    row = ((elevation.max() - elevation) * ((_IMAGE_ROWS - 1) / span)).astype(np.int64)
    return row, _IMAGE_ROWS


def _range_colors(ranges: Floats, limits: tuple[float, float]) -> Bytes:
    """Return the RGBA colors of ranges, clipped to the limits."""
    lower, upper = limits
    shade = np.clip((ranges - lower) / max(upper - lower, 1e-9), 0, 1)
    colors = np.full((len(ranges), 4), 255, np.uint8)
    colors[:, :3] = as_bytes(apply_colormap(RANGE_COLORS, shade))
    return colors


def surround_object(sensors: Floats, bounds: Floats) -> bool:
    """Return whether several sensors surround an object.

    All of them must be outside the bounds of the object, either beside or above the object.
    `sensors` has shape (n, 3), and `bounds` has shape (2, 3).
    """
    outside = ((sensors < bounds[0]) | (sensors > bounds[1])).any(axis=1)
    return len(sensors) > 1 and bool(outside.all())

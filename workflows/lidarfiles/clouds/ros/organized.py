"""Organized clouds with one point per ray, which is NaN if the ray has no return."""

from __future__ import annotations

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import Records
from lidarsim.sweeps.ray_image import RayImage
from lidarsim.sweeps.sweeps import Sweeps

from .layouts import MessageLayout, message_stamp_ns, sensor_traits


def organized_rows(
    message_layout: MessageLayout, rows: Records, points: Cloud, sweeps: Sweeps, sweep: int
) -> list[Records]:
    """Arrange the points of a sweep as organized clouds, in the order of the layout's driver.

    If the layout has rows of firings, a single cloud is returned. Its columns are the channels from
    the lowest to the highest. The rows with further returns follow the row of their firing.

    If the layout has rows of channels, there is one cloud per return. Its rows are the channels
    from the highest to the lowest. They are shifted by the azimuths of the beams, so that all
    points in a column have the same direction.

    Parameters
    ----------
    message_layout
        Layout of the points.
    rows
        Points of the sweep in this layout, with shape (n,).
    points
        The same points as a cloud.
    sweeps, sweep
        Sweeps of the survey, and the number of the sweep.

    Returns
    -------
    Clouds with shape (height, width).

    Raises
    ------
    LidarError
        If the points are not in order, or if the rays of the survey are unknown.
    """
    image = RayImage.from_points(sweeps, sweep, points)
    # Points are copied as bytes, because NumPy does not copy the padding between fields.
    point = np.dtype((np.void, rows.dtype.itemsize))
    without_return = _rays(message_layout, image, rows.dtype, sweeps, sweep).view(point)
    planes = np.repeat(without_return[np.newaxis], image.planes, axis=0)
    planes[image.plane, image.row, image.column] = rows.view(point)
    if message_layout.layout.lines == "firings":
        lines = planes.transpose(2, 0, 1)
        organized = [np.ascontiguousarray(lines).reshape(-1, image.sensor.channels)]
    else:
        columns = _looking_ahead(image)
        in_direction = np.take_along_axis(planes, columns[np.newaxis], axis=2)
        organized = [np.ascontiguousarray(plane[::-1]) for plane in in_direction]
    return [cloud.view(rows.dtype) for cloud in organized]


def _rays(
    message_layout: MessageLayout,
    image: RayImage,
    row: np.dtype[np.void],
    sweeps: Sweeps,
    sweep: int,
) -> Records:
    """Return a point for each ray, with the values for a ray without a return.

    The shape is (channels, firings).
    """
    layout = message_layout.layout
    channels = np.arange(image.sensor.channels)
    rays = np.zeros((len(channels), len(image.firings)), row)
    for axis in "xyz":
        rays[axis] = np.nan
    rays["intensity"] = layout.no_intensity
    rays[layout.ring_field] = layout.rings(channels, sensor_traits(sweeps, sweep))[:, np.newaxis]
    if not message_layout.compensated:
        fired_ns = image.begin_ns + image.sensor.times_ns(image.firings).T
        since_ns = fired_ns - sweeps.begins_ns[sweep]
        rays[layout.time_field] = layout.times(since_ns, message_stamp_ns(sweeps, sweep))
    return rays


def _looking_ahead(image: RayImage) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return the firing of each pixel. All pixels in a column have the same direction.

    The shape is (channels, firings).
    """
    sensor = image.sensor
    count = len(image.firings)
    firings_per_turn = float(getattr(sensor.head, "firings_per_turn", count))
    clockwise = -1 if getattr(sensor.head, "clockwise", False) else 1
    azimuth = sensor.beams.azimuth if len(sensor.beams.azimuth) else np.zeros(sensor.channels)
    shifts = np.rint(clockwise * azimuth * firings_per_turn / (2 * np.pi)).astype(np.int64)
    return (np.arange(count) - shifts[:, np.newaxis]) % count

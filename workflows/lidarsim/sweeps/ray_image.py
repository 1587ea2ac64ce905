"""Range images of a sweep, with one row per channel and one column per firing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..numerics.arrays import AnyArray, Ints, Ints32, to_writable
from ..sensor import Sensor
from .sweeps import MIXED_UP, FiredRays, Sweeps


@dataclass(frozen=True, eq=False)
class RayImage:
    """Pixel indices of the points in a sweep.

    An image has one row per channel and one column per firing. Additional returns of a pulse are in
    further planes.
    """

    sensor: Sensor
    firings: Ints  # (w,), all firings in the sweep, counted from the start of the station
    scan: Ints32  # (w,), scan of each firing
    begin_ns: float  # start of the station, relative to the start of the survey
    plane: Ints  # (n,), index of each point among the returns of its pulse, starting at 0
    row: Ints  # (n,), channel
    column: Ints  # (n,), index in `firings`
    planes: int

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> RayImage:
        """Locate the points of a sweep in its image.

        Raises
        ------
        LidarError
            If the points are not sorted by scan and ray, or if the rays of the survey are unknown.
        """
        fired = require_fired_rays(sweeps)
        number = int(sweeps.sensor[sweep])
        sensor = fired.sensors[number]
        first_scan, stop_scan = sweeps.scans[sweep : sweep + 2].tolist()
        first_step = int(fired.steps[sweep])
        steps = range(first_step, first_step + stop_scan - first_scan)
        first_firing = np.array(sensor.firings(first_step)[:1])
        # A sweep begins with the earliest beam of its first firing. Stations begin at whole
        # nanoseconds.
        since_station_ns = float(sensor.begins_ns(first_firing)[0]) + sensor.lead_ns
        begin_ns = round(sweeps.begins_ns[sweep] - since_station_ns)
        return cls.from_steps(
            sensor, steps, first_scan, begin_ns, fired.returns_per_pulse[number], points
        )

    @classmethod
    def from_steps(
        cls,
        sensor: Sensor,
        steps: range,
        first_scan: int,
        begin_ns: float,
        returns_per_pulse: int,
        points: Cloud,
    ) -> RayImage:
        """Locate the points from consecutive time steps of a sensor in an image.

        The points are sorted by scan and ray. Their column `ray` counts from the first ray of each
        scan. `first_scan` is the scan of the first step, `begin_ns` is the start of the station,
        and `returns_per_pulse` is the maximum number of returns of a pulse, or 1 if it is unknown.

        Raises
        ------
        LidarError
            If the points are not sorted or do not belong to these time steps.
        """
        from . import image_loops  # imported late because numba takes half a second to import

        bounds = np.array([sensor.firings(step) for step in steps])
        firings = np.arange(bounds[0, 0], bounds[-1, 1])
        plane, row, column = np.empty((3, len(points)), np.int64)
        max_returns = image_loops.find_pixels(
            to_writable(points["ray"], np.int64),
            to_writable(points["scan"] - first_scan, np.int64),
            first_rays=(bounds[:, 0] - firings[0]) * sensor.channels,
            ray_count=len(firings) * sensor.channels,
            channels=sensor.channels,
            plane=plane,
            row=row,
            column=column,
        )
        if max_returns < 0:
            raise LidarError(MIXED_UP)
        scans = np.arange(first_scan, first_scan + len(steps), dtype=np.int32)
        return cls(
            sensor=sensor,
            firings=firings,
            scan=np.repeat(scans, np.diff(bounds, axis=1)[:, 0]),
            begin_ns=begin_ns,
            plane=plane,
            row=row,
            column=column,
            planes=max(returns_per_pulse, max_returns),
        )

    def to_images(self, values: AnyArray) -> AnyArray:
        """Arrange point values as images.

        Rays without a return have the value NaN, -1 in signed integer images, or 0 in images of
        other types.

        Parameters
        ----------
        values
            Values of the points, with shape (n,).

        Returns
        -------
        ndarray
            Images with shape (planes, channels, firings).
        """
        fill_value = {"f": np.nan, "i": -1}.get(values.dtype.kind, 0)
        result = np.full(
            (self.planes, self.sensor.channels, len(self.firings)), fill_value, values.dtype
        )
        result[self.plane, self.row, self.column] = values
        return result

    def ray_arrays(self) -> dict[str, AnyArray]:
        """Return the times and nominal angles of all rays, and the scan of each firing.

        Times are in nanoseconds since the start of the survey. Angles are in degrees in the sensor
        frame. Ray arrays have shape (channels, firings).
        """
        x, y, z = self.sensor.directions(self.firings).transpose(2, 1, 0)
        return {
            "time": self.begin_ns + self.sensor.times_ns(self.firings).T,
            "azimuth": (np.degrees(np.arctan2(y, x)) % 360).astype(np.float32),
            "elevation": np.degrees(np.arcsin(np.clip(z, -1, 1))).astype(np.float32),
            "scan": self.scan,
        }


def require_fired_rays(sweeps: Sweeps) -> FiredRays:
    """Return the survey's ray description, or raise LidarError if there is none."""
    if sweeps.fired is None:
        raise LidarError(
            "Range images and organized clouds require all returns of a survey. Run it with "
            "keep_every 1 and the column ray. With a custom Sensor class, they can only be "
            "written during the run (output.write, Result.report)."
        )
    return sweeps.fired

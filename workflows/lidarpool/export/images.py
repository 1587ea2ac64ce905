"""Range images: the rays of a sweep as a table of channels and firings, also without a return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from lidarsim.base.archives import open_archive, packed
from lidarsim.base.arrays import AnyArray, Ints, Ints32
from lidarsim.base.errors import LidarError
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sensor import Sensor
from lidarsim.sweeps.sweeps import AS_FIRED, COMPENSATED, MIXED_UP, FiredRays, Sweeps, plain_names

from . import pieces, reading
from .boxes import Boxes
from .pieces import Entry

# Columns of points that images have for every ray, or that its place in them is.
_OF_RAYS = ("scan", "ray", "channel", "sensor", "time", "azimuth", "elevation")


@dataclass(frozen=True, eq=False)
class Image:
    """Where the points of a sweep are in its image: a row for each channel, firings in order."""

    sensor: Sensor
    firings: Ints  # (w,): all of the sweep, from the start of the station
    scan: Ints32  # (w,): of each
    begin_ns: float  # of the station, since the survey's start
    plane: Ints  # (n,): which return of its pulse a point is, from 0
    row: Ints  # (n,): channel
    column: Ints  # (n,): firing
    planes: int

    @classmethod
    def of(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Image:
        """Find the places of the points of a sweep.

        LidarError if they are not in order, or it is unknown which rays there were.
        """
        fired = fired_of(sweeps)
        number = int(sweeps.sensor[sweep])
        sensor = fired.sensors[number]
        scans = np.arange(*sweeps.scans[sweep : sweep + 2])
        steps = range(fired.steps[sweep], fired.steps[sweep] + len(scans))
        bounds = np.array([sensor.firings(step) for step in steps])
        firings = np.arange(bounds[0, 0], bounds[-1, 1])
        since = float(sensor.begins_ns(firings[:1])[0]) + sensor.lead_ns
        ray = points["ray"].astype(np.int64)
        ray += (bounds[points["scan"] - scans[0], 0] - firings[0]) * sensor.channels
        if (np.diff(ray) < 0).any() or (len(ray) and ray[-1] >= len(firings) * sensor.channels):
            raise LidarError(MIXED_UP)
        column, row = np.divmod(ray, sensor.channels)
        begins = np.flatnonzero(np.diff(ray, prepend=-1))  # of the points of each pulse
        plane = np.arange(len(ray)) - np.repeat(begins, np.diff(begins, append=len(ray)))
        planes = max(fired.returns[number], int(plane.max(initial=0)) + 1)
        of_scan = np.repeat(scans.astype(np.int32), np.diff(bounds, axis=1)[:, 0])
        begin_ns = round(sweeps.begins_ns[sweep] - since)
        return cls(sensor, firings, of_scan, begin_ns, plane, row, column, planes)

    def filled(self, values: AnyArray) -> AnyArray:
        """Return values (n,) of the points as images (planes, channels, firings).

        Rays without a return have NaN, whole numbers -1, or 0 if their type has no sign.
        """
        none = {"f": np.nan, "i": -1}.get(values.dtype.kind, 0)
        out = np.full((self.planes, self.sensor.channels, len(self.firings)), none, values.dtype)
        out[self.plane, self.row, self.column] = values
        return out

    def of_rays(self) -> dict[str, AnyArray]:
        """Return times and nominal angles of all rays, and the scan of each firing.

        Arrays of rays are (channels, firings). Times are nanoseconds since the survey's start,
        angles degrees in the sensor's axes.
        """
        x, y, z = self.sensor.directions(self.firings).transpose(2, 1, 0)
        return {
            "time": self.begin_ns + self.sensor.times_ns(self.firings).T,
            "azimuth": (np.degrees(np.arctan2(y, x)) % 360).astype(np.float32),
            "elevation": np.degrees(np.arcsin(np.clip(z, -1, 1))).astype(np.float32),
            "scan": self.scan,
        }


def fired_of(sweeps: Sweeps) -> FiredRays:
    """Return what finds all rays; LidarError if that is unknown."""
    if sweeps.fired is None:
        raise LidarError(
            "Range images need every return of a survey: run it with keep_every 1 and the column "
            "ray. Of a Sensor class of your own they are written with the run only (output.write, "
            "Result.report)."
        )
    return sweeps.fired


class Pieces(pieces.Pieces):
    """A NumPy archive for each sweep: `NAME/000000.npz`, NAME that of the sensor, or `lidar`.

    In a data set, `images/JOB/NAME/000000.npz`. Arrays are images, (channels, firings): `range`
    and all columns of the points of first returns, and with the number of the return behind the
    name (`range2`) of others; of all rays `time`, `azimuth` and `elevation`; `x`, `y` and `z` in
    metres in the sensor's axes when the sweep began. Beside these, `scan` of each firing, `pose`
    (4, 4), from the sensor's axes when the sweep began to the world's, and `frame`, the axes of the
    points in words.
    """

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        fired_of(sweeps)
        self.folders = _folders(sweeps, entry)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], Boxes | None]:
        """Return the file of a sweep, and its boxes where there are actors."""
        sweeps = self.sweeps
        image = Image.of(sweeps, number, points)
        inside = sweeps.in_sensor(number, points.positions).astype(np.float32)
        columns = sweeps.columns_in_sensor(number, points)
        columns = {name: values for name, values in columns.items() if name not in _OF_RAYS}
        columns |= dict(zip("xyz", inside.T, strict=True))
        arrays: dict[str, Any] = image.of_rays()
        arrays["pose"] = sweeps.pose.matrix(number)
        arrays["frame"] = np.array(AS_FIRED if sweeps.coordinates == "sensor" else COMPENSATED)
        for name, values in columns.items():
            for plane, made in enumerate(image.filled(values)):
                if (key := _key(name, plane)) in arrays:
                    raise LidarError(f"Two arrays of an image would be {key!r}: rename one.")
                arrays[key] = made
        boxes = Boxes.of(sweeps, number, points) if sweeps.actors and self.entry else None
        return {_file(sweeps, self.folders, number): packed(arrays)}, boxes


class Reader(reading.Reader):
    """Reads sweeps of a data set: all columns of each point, with time and angles of its ray."""

    def files(self, sweep: int) -> list[str]:
        """Return the name of the file of the images."""
        return [_file(self.sweeps, _folders(self.sweeps, self.entry), sweep)]

    def read(self, sweep: int) -> reading.PointColumns:
        """Return the points of a sweep, in the order of their rays."""
        file = self.files(sweep)[0]
        with open_archive(self.place.path(file), partial(self.place.read, file)) as images:
            del images["pose"], images["scan"], images["frame"]
        planes = next(n for n in count(1) if _key("range", n) not in images)
        further = {_key(name, plane) for name in images for plane in range(1, planes)}
        there = ~np.isnan(np.stack([images[_key("range", plane)] for plane in range(planes)]))

        def of_points(name: str) -> AnyArray:
            made = [images.get(_key(name, plane), images[name]) for plane in range(planes)]
            return np.stack(made).T[there.T]

        columns = {name: of_points(name) for name in images if name not in further}
        images["channel"] = np.indices(there.shape[1:], np.uint16)[0]
        columns["channel"] = of_points("channel")
        return np.stack([columns.pop(axis) for axis in "xyz"], axis=1), columns


def _key(name: str, plane: int) -> str:
    """Name of the array of a column in the image of a return, numbered from 0."""
    return f"{name}{plane + 1}" if plane else name


def _folders(sweeps: Sweeps, entry: Entry | None) -> list[str]:
    """Folders of the sensors."""
    names = plain_names(name or "lidar" for name in sweeps.sensors)
    return names if entry is None else [f"{entry.place('images')}/{name}" for name in names]


def _file(sweeps: Sweeps, folders: Sequence[str], sweep: int) -> str:
    return f"{folders[sweeps.sensor[sweep]]}/{sweeps.numbers[sweep]:06}.npz"

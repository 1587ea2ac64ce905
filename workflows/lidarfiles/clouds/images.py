"""Range images of sweeps, with a row for each channel and a column for each firing.

Rays without a return are included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.archives import open_archive, pack_arrays
from lidarsim.io.input_files import read_input
from lidarsim.io.numbered_files import sort_by_number
from lidarsim.numerics.arrays import AnyArray
from lidarsim.sweeps.ray_image import RayImage, require_fired_rays
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers, states_compensation

from .boxes import Boxes
from .job_reader import Entry, JobReader, PointColumns
from .multi_file_format import MultiFileFormat
from .point_field import PointField
from .recording import FileRecording, Recording
from .recording_ref import RecordingRef

_NO_IMAGES = ("pose", "scan", "frame")  # arrays in a file that are not images

# Columns that are stored for every ray, or that follow from the position in the image.
_RAY_COLUMNS = ("scan", "ray", "channel", "sensor", "time", "azimuth", "elevation")


class ImageFolder(MultiFileFormat):
    """A folder of range images, with one NumPy archive per sweep.

    The archives are `NAME/000000.npz`, or `images/JOB/NAME/000000.npz` in a data set, where NAME is
    the name of the sensor or `lidar`. An archive contains images of shape (channels, firings):

    - `range` and all other columns of the points. Images without a number contain the first
      returns, and images with a number the later returns, for example `range2`.
    - `time`, `azimuth` and `elevation` of all rays, including rays without a return.
    - `x`, `y` and `z` in meters, in the sensor frame at the start of the sweep.

    It also contains `scan` for each firing, `pose` of shape (4, 4), which transforms from the
    sensor frame at the start of the sweep to the world frame, and `frame`, a description of the
    frame of the points.
    """

    title = "range images"
    by_sweep = True
    fields = (
        PointField("row and column of the pixel", ("ray",)),
        PointField("range", ("range",)),
    )
    file_pattern = r"[^/]+/\d+\.npz"
    job_path = "images/{name}"
    separate_sweeps = True

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        require_fired_rays(sweeps)
        self.folders = self._folders_of(sweeps, entry)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], Boxes | None]:
        """Return the file of a sweep, and the sweep's boxes if there are actors."""
        sweeps = self.sweeps
        image = RayImage.from_points(sweeps, number, points)
        positions = sweeps.in_sensor(number, points.positions).astype(np.float32)
        columns = sweeps.columns_in_sensor(number, points)
        columns = {name: values for name, values in columns.items() if name not in _RAY_COLUMNS}
        columns |= dict(zip("xyz", positions.T, strict=True))
        arrays: dict[str, Any] = image.ray_arrays()
        arrays["pose"] = sweeps.pose.matrix(number)
        arrays["frame"] = np.array(sweeps.frame_text(compensated=sweeps.coordinates == "world"))
        for name, values in columns.items():
            for plane, image_of_return in enumerate(image.to_images(values)):
                if (key := _key(name, plane)) in arrays:
                    raise LidarError(
                        f"An image would contain two arrays named {key!r}. Rename one of the "
                        "columns."
                    )
                arrays[key] = image_of_return
        boxes = Boxes.from_points(sweeps, number, points) if sweeps.actors and self.entry else None
        return {_file(sweeps, self.folders, number): pack_arrays(arrays)}, boxes

    @classmethod
    def _folders_of(cls, sweeps: Sweeps, entry: Entry | None) -> list[str]:
        names = make_identifiers(name or "lidar" for name in sweeps.sensors)
        return names if entry is None else [f"{cls.path_of_job(entry)}/{name}" for name in names]

    @classmethod
    def sweep_files(cls, job: JobReader, sweep: int) -> list[str]:
        """Return the name of the archive that contains the images."""
        folders = job.get_or_compute("folders", lambda: cls._folders_of(job.sweeps, job.entry))
        return [_file(job.sweeps, folders, sweep)]

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read points with all columns, including the times and angles of their rays.

        Points are sorted by ray.
        """
        (file,) = cls.sweep_files(job, sweep)
        with open_archive(job.storage.path(file), partial(job.storage.read, file)) as images:
            return points_of_images(images)

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open the range images in a folder with one subfolder per sensor."""
        with reading(ref.name):
            sensors = _files_of_sensors(ref.path)
        name, files = ref.choose_sensor(sensors)
        with reading(ref.name), open_archive(files[0], partial(read_input, files[0])) as images:
            compensated = _stated_compensation(images)
        return _ImageRecording(ref.info(sensor=name, compensated=compensated), files)


def points_of_images(images: dict[str, AnyArray]) -> PointColumns:
    """Convert the images of a sweep to points, sorted by ray."""
    images = {name: image for name, image in images.items() if name not in _NO_IMAGES}
    planes = next(n for n in count(1) if _key("range", n) not in images)
    keys_of_later_returns = {_key(name, plane) for name in images for plane in range(1, planes)}
    returned = ~np.isnan(np.stack([images[_key("range", plane)] for plane in range(planes)]))

    def values_of_points(name: str) -> AnyArray:
        images_of_returns = [images.get(_key(name, plane), images[name]) for plane in range(planes)]
        return np.stack(images_of_returns).T[returned.T]

    columns = {name: values_of_points(name) for name in images if name not in keys_of_later_returns}
    images["channel"] = np.indices(returned.shape[1:], np.uint16)[0]
    columns["channel"] = values_of_points("channel")
    return np.stack([columns.pop(axis) for axis in "xyz"], axis=1), columns


def _key(name: str, plane: int) -> str:
    """Return the name of the image for a column and a return.

    Returns are numbered from 0.
    """
    return f"{name}{plane + 1}" if plane else name


def _file(sweeps: Sweeps, folders: Sequence[str], sweep: int) -> str:
    return f"{folders[sweeps.sensor[sweep]]}/{sweeps.numbers[sweep]:06}.npz"


def _files_of_sensors(folder: Path) -> dict[str, list[Path]]:
    """Return the files of the range images of each sensor, keyed by sensor name."""
    files_of_sensor = {
        inner.name: sort_by_number(inner.glob("*.npz"))
        for inner in sorted(folder.iterdir())
        if inner.is_dir()
    }
    return {sensor: files for sensor, files in files_of_sensor.items() if files}


class _ImageRecording(FileRecording):
    """Range images of one sensor."""

    def load(self, number: int) -> Sweep:
        file = self.paths[number]
        with open_archive(file, partial(read_input, file)) as images:
            pose = images["pose"]
            compensated = _stated_compensation(images)
            points, columns = points_of_images(images)
        return Sweep(points, columns, pose=pose, compensated=compensated)


def _stated_compensation(images: Mapping[str, AnyArray]) -> bool | None:
    """Return whether a sweep is motion-compensated, or None if its file does not state this."""
    return states_compensation(str(images["frame"])) if "frame" in images else None

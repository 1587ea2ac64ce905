"""Results of lidarpool as recordings, read from a file or from memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from lidarsim.columns.cloud import CHUNK_POINTS, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.sweeps.sweeps import Sweeps

from ..identity.fingerprint import fingerprint
from .recorded_boxes import RecordedBoxes
from .recording import PointCloud, RayTimes, Recording, RecordingInfo
from .recording_ref import choose


def open_cloud(
    info: RecordingInfo,
    cloud: CloudLike,
    load_sweeps: Callable[[], Sweeps] | None,
    sensor: str | None,
    *,
    has_measured_poses: bool = False,
) -> Recording | PointCloud:
    """Open a lidarpool cloud as the sweeps of a sensor, or in parts if it has no sweeps.

    Parameters
    ----------
    info
        What is known about the cloud, such as its name and the chosen intensity column.
    cloud
        Cloud to open.
    load_sweeps
        Function that returns the sweeps of the cloud, or None for a cloud without sweeps.
    sensor
        Sensor that the user chose, or None.
    has_measured_poses
        Whether the poses contain the errors of a measured trajectory.

    Raises
    ------
    LidarError
        If there are several sensors and none was chosen, or if the chosen sensor does not exist.
    """
    if sensor and load_sweeps is None:
        raise LidarError(
            f"{info.name} has no sweeps that state their sensor, so no sensor can be selected. "
            f"Remove the sensor {sensor!r}."
        )
    info = replace(info, noise_classes=None)
    if load_sweeps is None:
        return _ResultCloud(info, cloud)
    sweeps = load_sweeps()
    chosen = choose(info.name, "sensors", sweeps.sensors, sensor)
    return _Result(info, cloud, sweeps, chosen, has_measured_poses=has_measured_poses)


class _ResultCloud(PointCloud):
    """A cloud of lidarpool without sweeps."""

    def __init__(self, info: RecordingInfo, cloud: CloudLike) -> None:
        super().__init__(replace(info, point_count=len(cloud)))
        self._cloud = cloud

    def __len__(self) -> int:
        return -(-len(self._cloud) // CHUNK_POINTS)

    def load(self, number: int) -> Sweep:
        chunk = next(self._cloud.chunks(CHUNK_POINTS, number * CHUNK_POINTS))
        return Sweep(chunk.positions, chunk.columns)


class _Result(Recording):
    """The sweeps of one sensor in a cloud of lidarpool."""

    def __init__(
        self,
        info: RecordingInfo,
        cloud: CloudLike,
        sweeps: Sweeps,
        sensor: str,
        *,
        has_measured_poses: bool,
    ) -> None:
        # The column `intensity` of a result contains energies. Another column may be chosen.
        has_energies = info.intensity_column in (None, "intensity")
        super().__init__(
            replace(
                info,
                sensor=sensor,
                epsg=sweeps.epsg,
                energy_unit=1.0 if has_energies else None,
                compensated=sweeps.coordinates == "world" if len(sweeps.knots) else None,
                has_firing_poses=True,
            )
        )
        self._cloud = cloud
        self._saved = sweeps
        self._has_measured_poses = has_measured_poses
        number = sweeps.sensors.index(sensor)
        self._indices = np.flatnonzero(sweeps.sensor == number).tolist()

    def __len__(self) -> int:
        return len(self._indices)

    def load(self, number: int) -> Sweep:
        saved = self._saved
        index = self._indices[number]
        points = next(saved.points(self._cloud, index, index + 1))
        return Sweep(
            saved.in_sensor(index, points.positions),
            points.columns,
            pose=saved.pose.matrix(index),
            time_ns=round(saved.begins_ns[index]),
        )

    def load_fired(self, number: int) -> Sweep:
        saved = self._saved
        index = self._indices[number]
        points = next(saved.points(self._cloud, index, index + 1))
        poses = saved.firing_poses(index, points)
        return Sweep(
            saved.as_fired(index, points, poses),
            points.columns,
            pose=saved.pose.matrix(index),
            time_ns=round(saved.begins_ns[index]),
            compensated=False,
            firing_poses=poses,
        )

    def load_stamps(self) -> Ints:
        begins_ns = np.rint(self._saved.begins_ns[self._indices]).astype(np.int64)
        return begins_ns + (self._saved.start_ns or 0)

    def load_poses(self) -> Floats:
        return np.array([self._saved.pose.matrix(index) for index in self._indices])

    def load_boxes(self) -> RecordedBoxes | None:
        if not self._saved.actors:
            return None
        return RecordedBoxes.from_sweeps(self._saved, self._indices)

    @cached_property
    def ray_times(self) -> RayTimes | None:
        saved = self._saved
        columns = {column.name for column in self._cloud.table}
        ray_columns = columns & {"time", "ray"}
        if not ray_columns:
            return None
        # `compared_sweep` identifies rays by their time if possible, otherwise by their number.
        key = max(ray_columns), "return_number" in columns
        return RayTimes(
            fingerprint(key, saved.scans[self._indices], saved.begins_ns[self._indices]),
            saved.pose.positions[self._indices],
            saved.pose.quaternions[self._indices],
            is_measured=self._has_measured_poses,
        )

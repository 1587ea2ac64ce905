"""Read sweeps of a recording, keeping only the columns required to compare or fit them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.posed_sweeps import PosedSweeps
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene_instances import MAX_COORDINATE_M

RAY_KEY = "ray_key"  # column that identifies the ray and the return


def compared_sweep(recording: Recording, number: int, *, with_rays: bool = False) -> Sweep:
    """Read the returns of a sweep in sensor coordinates.

    The columns are `channel` and `intensity` if the recording has them, and `RAY_KEY` if
    `with_rays` is true.

    Raises LidarError if the recording cannot be read.
    """
    sweep = with_compared_columns(recording[number], with_rays=with_rays).returns()
    check_reach(recording, sweep)
    return sweep


def compared_in_world(sweeps: PosedSweeps, number: int) -> Sweep:
    """Read the returns of a sweep, or of a portion of a cloud, in world coordinates.

    The only column is `intensity`, if the recording has it.

    Raises LidarError if the recording cannot be read, or if the pose of the sweep is unknown.
    """
    recording = sweeps.recording
    sweep = with_compared_columns(sweeps.read(number))
    sweep = sweep.with_columns(intensity=sweep.intensity)
    check_reach(recording, sweep)
    if isinstance(recording, PointCloud):
        return sweep
    if sweep.pose is None:
        raise LidarError(
            f"{recording.info.name} is in sensor coordinates and does not contain the pose of the "
            "sensor. Compare it with a recording that consists of sweeps."
        )
    return sweep.replace(points=sweep.in_world())


def bounds_of(points: Floats) -> Floats:
    """Return the bounding box of points, of shape (2, 3)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def separation_m(a: Floats, b: Floats) -> float:
    """Return the largest distance between two bounding boxes along an axis, in meters.

    It is negative if they overlap. The boxes have shape (2, 3).
    """
    return float(np.maximum(a[0] - b[1], b[0] - a[1]).max())


def origin_to_add(
    origins: Sequence[tuple[float, float, float] | None], bounds: Sequence[Floats]
) -> OriginShift | None:
    """Return the world origin to add to one of two clouds, or None if they are in the same frame.

    Results with a world origin are in world coordinates, but their scene and results without this
    origin are in local coordinates. The origin of one cloud is added to the other one if they are
    apart without it and closer to each other with it.

    Parameters
    ----------
    origins
        World origins of both clouds in meters, or None.
    bounds
        Bounding boxes of both clouds, of shape (2, 3), in meters.
    """
    apart_m = separation_m(*bounds)
    for placed, local in ((0, 1), (1, 0)):
        origin = origins[placed]
        if origin is None or origins[local] is not None or apart_m <= 0:
            continue
        if separation_m(bounds[placed], bounds[local] + origin) < apart_m:
            return OriginShift(local, placed, np.array(origin))
    return None


class OriginShift(NamedTuple):
    """World origin of a cloud that is added to the points of another one."""

    local: int  # index of the cloud in local coordinates
    placed: int  # index of the cloud in world coordinates
    origin: Floats  # (3,), meters

    def note(self, names: Sequence[str]) -> str:
        """Return a note for the user."""
        origin = ", ".join(f"{value:.10g}" for value in self.origin)
        return (
            f"the world origin of {names[self.placed]}, ({origin}) m, is added to the coordinates "
            f"of {names[self.local]}"
        )


def check_reach(recording: Recording | PointCloud, sweep: Sweep) -> None:
    """Raise LidarError if a coordinate is implausibly large."""
    if (reach := float(np.abs(sweep.points).max(initial=0.0))) > MAX_COORDINATE_M:
        raise LidarError(
            f"{recording.info.name} extends {reach:.3g} m from the origin, which is farther than "
            "anything on Earth. The file is probably damaged, or its length unit is wrong."
        )


def with_compared_columns(sweep: Sweep, *, with_rays: bool = False) -> Sweep:
    """Return a sweep with only the columns that a comparison or fit requires.

    If it has no column `channel`, its rings are determined when they are first requested.
    """
    columns = {}
    if "channel" in sweep.columns:
        columns["channel"] = np.asarray(sweep.columns["channel"]).astype(np.int64)
    if sweep.intensity is not None:
        columns["intensity"] = np.asarray(sweep.intensity, np.float64)
    if with_rays:
        columns[RAY_KEY] = _ray_keys(sweep.columns)
    return sweep.replace(columns=columns)


def rings_note(recording: Recording | PointCloud, sweep: Sweep) -> list[str]:
    """Return a note about how the rings of a sweep were determined.

    The list is empty if the rings are stored in a column or are unknown.
    """
    is_stated = "channel" in sweep.columns or sweep.rings is None
    if is_stated or isinstance(recording, PointCloud):
        return []
    return [recording.rings.note.removesuffix(".")]


def _ray_keys(columns: Columns) -> Ints:
    """Return a unique integer for each return, composed of its ray and its return number."""
    if "time" in columns:
        rays = columns["time"].astype(np.int64) << 16 | columns["channel"]
    else:
        rays = columns["scan"].astype(np.int64) << 32 | columns["ray"]
    _, first, ray = np.unique(rays, return_index=True, return_inverse=True)
    order: Ints = np.arange(len(rays)) - first[ray]  # returns of a ray are adjacent
    return rays << 8 | columns.get("return_number", order)

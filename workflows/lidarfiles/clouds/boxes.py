"""Bounding boxes of actors in a sweep, for use in data set labels and markers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import EllipsisType
from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints, Ints32, Records
from lidarsim.numerics.vectors import matvec
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps


@dataclass(frozen=True, eq=False)
class BoxVisibility:
    """How well a sensor sees the actors in a sweep.

    If several sweeps are stored, arrays have a leading axis for the sweep.
    """

    # (a,): number of rays that hit the actor first, divided by the number of rays that would hit it
    # in an empty scene; NaN if no ray would hit it.
    visible_fraction: Floats32
    truncation: Floats32  # (a,): fraction of the box outside the field of view or range
    # (a,): distance in meters between the box and the nearest ray; 0 if a ray would hit the actor.
    nearest_ray_m: Floats32

    @classmethod
    def from_rays(cls, records: Records) -> BoxVisibility:
        """Compute the visibility from records of type `ACTOR_RAYS`."""
        rays = records["rays"]
        fraction = np.full(rays.shape, np.nan, np.float32)
        np.divide(records["visible"], rays, out=fraction, where=rays > 0, casting="same_kind")
        return cls(fraction, records["truncated"], records["nearest_m"])

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Floats32]) -> BoxVisibility | None:
        """Create the visibility from arrays by name, or return None if they are missing."""
        names = [entry.name for entry in fields(cls)]
        return cls(**{name: arrays[name] for name in names}) if names[0] in arrays else None

    def __getitem__(self, index: Any) -> BoxVisibility:
        """Select actors, or sweeps."""
        return BoxVisibility(
            self.visible_fraction[index], self.truncation[index], self.nearest_ray_m[index]
        )

    @property
    def arrays(self) -> dict[str, Floats32]:
        """All fields by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}


@dataclass(frozen=True, eq=False)
class Boxes:
    """Bounding boxes of all actors at the start of a sweep.

    The start is the timestamp of the sweep. Each point is measured at its own time, so points of a
    moving actor can lie outside its box. The size of a box is the same in all sweeps. The box of an
    actor that deforms contains the actor in all its shapes.

    The box of an actor that appears during the sweep is extrapolated back to the start of the
    sweep, using the actor's velocity when it appears. There is no box for an actor that has left
    the scene, even if a frozen sensor still repeats its points.
    """

    centers: Floats  # (a, 3): meters, world coordinates, or the sensor frame (`to_sensor_frame`)
    quaternions: Floats  # (a, 4): x, y, z, w of the rotation from the actor to the same frame
    sizes: Floats  # (a, 3): length, width and height in meters, along the actor's axes
    points: Ints  # (a,): number of points in the sweep that belong to the actor
    # (a,): True if the actor is in the scene at the start, or appears later and has points.
    present: Bools
    visibility: BoxVisibility | None = None  # None unless the survey determines it

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Boxes:
        """Compute the boxes of a sweep, given the points of the sweep."""
        actor = points["object"].astype(np.int64) - len(sweeps.objects)
        counts = np.bincount(actor[actor >= 0], minlength=len(sweeps.actors))
        position = sweeps.actor_poses.positions[:, sweep]
        quaternion = sweeps.actor_poses.quaternions[:, sweep]
        lower, upper = sweeps.actor_bounds.transpose(1, 0, 2)
        middle = matvec(matrices(quaternion), (lower + upper) / 2)
        present = sweeps.actor_there[:, sweep] | (sweeps.actor_comes[:, sweep] & (counts > 0))
        visibility = None
        if sweeps.actor_rays.size:
            visibility = BoxVisibility.from_rays(sweeps.actor_rays[:, sweep])
        return cls(position + middle, quaternion, upper - lower, counts, present, visibility)

    def to_sensor_frame(self, pose: SweepPoses, index: int | slice) -> Boxes:
        """Transform the boxes from world coordinates to the sensor frame at the start of a sweep.

        If `index` is a slice of sweeps, arrays have a leading axis for the sweep.
        """
        quaternions = self.quaternions @ pose.quaternion_matrices[index]
        quaternions *= np.where(quaternions[..., 3:] < 0, -1, 1)  # such that w >= 0
        centers = (self.centers - pose.positions[index][..., None, :]) @ pose.rotations[index]
        return replace(self, centers=centers, quaternions=quaternions)


@dataclass(frozen=True, eq=False)
class SweepBoxes:
    """Bounding boxes of the k actors that are present in a sweep, at the start of the sweep.

    `Boxes` explains how boxes are defined.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]  # names without numbers, for example "Car" for "Car 1"
    objects: Ints32  # (k,): numbers of the actors in the column `object`
    centers: Floats  # (k, 3): meters, sensor frame
    quaternions: Floats  # (k, 4): x, y, z, w of the rotation from the box to the sensor frame
    sizes: Floats  # (k, 3): length, width and height in meters
    points: Ints  # (k,): number of points in the sweep that belong to the actor
    # (k,), as in `BoxVisibility`. None unless the survey determines the visibility of actors.
    visible_fraction: Floats32 | None = None
    truncation: Floats32 | None = None
    nearest_ray_m: Floats32 | None = None

    @classmethod
    def select(
        cls, sweeps: Sweeps, boxes: Boxes | None, index: int | EllipsisType = ...
    ) -> SweepBoxes:
        """Select the boxes of the actors that are present in a sweep.

        Parameters
        ----------
        sweeps
            Sweeps of the survey, which contain the names and types of the actors.
        boxes
            Boxes in the sensor frame, for a single sweep or with a leading axis for the sweep. None
            if there are no boxes.
        index
            Index of the sweep, if `boxes` has an axis for it.
        """
        rows = np.empty(0, np.intp) if boxes is None else boxes.present[index].nonzero()[0]
        if boxes is None or not len(rows):
            vectors = np.empty((0, 3))
            return cls(
                names=(),
                types=(),
                objects=np.empty(0, np.int32),
                centers=vectors,
                quaternions=np.empty((0, 4)),
                sizes=vectors,
                points=np.empty(0, np.int64),
            )
        actors = rows.tolist()
        visibility = {} if boxes.visibility is None else boxes.visibility[index][rows].arrays
        return cls(
            names=tuple(sweeps.actors[actor] for actor in actors),
            types=tuple(sweeps.actor_types[actor] for actor in actors),
            objects=(len(sweeps.objects) + rows).astype(np.int32),
            centers=boxes.centers[index][rows],
            quaternions=boxes.quaternions[index][rows],
            sizes=boxes.sizes[index][rows],
            points=boxes.points[index][rows],
            **visibility,
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def visibility(self) -> dict[str, Floats32]:
        """Arrays of `BoxVisibility` by name, or an empty dictionary if they are unknown."""
        arrays = {
            "visible_fraction": self.visible_fraction,
            "truncation": self.truncation,
            "nearest_ray_m": self.nearest_ray_m,
        }
        return {name: values for name, values in arrays.items() if values is not None}

    @property
    def yaw(self) -> Floats:
        """Yaw angles about the sensor's z axis in radians, from x to y.

        The shape is (k,).
        """
        rotations = matrices(self.quaternions)
        angles: Floats = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        return angles

    @property
    def rows(self) -> Floats32:
        """Center, length, width, height and yaw of each box.

        The shape is (k, 7), and the dtype is float32.
        """
        return np.column_stack([self.centers, self.sizes, self.yaw]).astype(np.float32)


def summarize_boxes(boxes: Sequence[Boxes]) -> dict[str, int | float]:
    """Summarize the visibility of the boxes in several sweeps.

    Returns
    -------
    dict
        The number of boxes and the number of boxes with points; the mean visible fraction of the
        boxes that a ray would hit in an empty scene; the mean truncation; and the mean distance in
        meters between the boxes without points and their nearest rays. Means without values are
        omitted. The dictionary is empty if the visibility was not determined.
    """
    found = [(box, box.visibility) for box in boxes if box.visibility is not None]
    if not found:
        return {}
    points = np.concatenate([box.points[box.present] for box, _ in found])
    arrays = {
        name: np.concatenate([visibility.arrays[name][box.present] for box, visibility in found])
        for name in found[0][1].arrays
    }
    arrays["nearest_ray_m"] = arrays["nearest_ray_m"][points == 0]
    summary: dict[str, int | float] = {
        "boxes": len(points),
        "boxes_with_points": int(np.count_nonzero(points)),
    }
    for name, values in arrays.items():
        known = values[np.isfinite(values)].astype(np.float64)
        if len(known):
            summary[name] = float(f"{math.fsum(known) / len(known):.6g}")
    return summary


def json_number(value: float) -> float | None:
    """Return a number with six significant digits, or None for NaN, which JSON cannot represent."""
    return None if math.isnan(value) else float(f"{value:.6g}")

"""Targets around a vehicle, and their distribution among sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import affine
from lidarsim.sensor import Sensor

AZIMUTH_BINS = 1440  # azimuth bins of a sweep, 0.25° each
_DILATION = 40  # bins by which the field of view is widened, since beams may start off center
_MARGIN_RAD = 0.004  # minimum angle between two targets in a sweep
_NEAR_M = 0.2  # a target that is closer to a sensor is simulated alone


class Target(NamedTuple):
    """A class of targets.

    Attributes
    ----------
    name
        Name of the class.
    points
        Minimum number of points on a detected target.
    reflectance
        Reflectance of the targets.
    weight
        Weight of the class in the detection rate.
    """

    name: str
    points: int
    reflectance: float
    weight: float


@dataclass(frozen=True, eq=False)
class Placements:
    """Targets at p positions, each of which is evaluated alone with the vehicle.

    Attributes
    ----------
    targets
        Classes of targets.
    meshes
        Meshes of the targets, which stand on z = 0 and face x.
    mesh_target
        Index of the class of each mesh. Shape (m,).
    mesh
        Index of the mesh of each placement. Shape (p,).
    positions
        Positions of the mesh origins in the frame of the vehicle, in meters. Shape (p, 3).
    headings_deg
        Headings relative to the vehicle, counterclockwise. Shape (p,).
    """

    targets: tuple[Target, ...]
    meshes: tuple[SceneMesh, ...]
    mesh_target: Ints
    mesh: Ints
    positions: Floats
    headings_deg: Floats

    def __len__(self) -> int:
        return len(self.mesh)

    @property
    def target(self) -> Ints:
        """Index of the class of each placement. Shape (p,)."""
        return self.mesh_target[self.mesh]

    @property
    def distances_m(self) -> Floats:
        """Horizontal distance of each placement from the origin of the vehicle. Shape (p,)."""
        return np.hypot(self.positions[:, 0], self.positions[:, 1])

    @property
    def bearings_deg(self) -> Floats:
        """Bearing of each placement, counterclockwise from the x axis. Shape (p,)."""
        return np.degrees(np.arctan2(self.positions[:, 1], self.positions[:, 0]))

    def matrices(self) -> Floats:
        """Return the transforms from mesh coordinates to the vehicle frame. Shape (p, 4, 4)."""
        angles = np.radians(self.headings_deg)
        rotations = np.zeros((len(self), 3, 3))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angles)
        rotations[:, 1, 0] = np.sin(angles)
        rotations[:, 0, 1] = -rotations[:, 1, 0]
        rotations[:, 2, 2] = 1
        return affine(rotations, self.positions)

    def footprints(self) -> Floats:
        """Return the corners of the targets' footprints, in meters. Shape (p, 4, 2)."""
        bounds = np.array([mesh.bounds[:, :2] for mesh in self.meshes])
        lower, upper = bounds[:, 0], bounds[:, 1]
        sides = np.stack([lower, upper], axis=1)
        corners = np.stack(
            [
                np.stack([sides[:, i, 0], sides[:, j, 1]], axis=1)
                for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
            ],
            axis=1,
        )[self.mesh]
        matrices = self.matrices()
        return np.einsum("pij,pkj->pki", matrices[:, :2, :2], corners) + matrices[:, None, :2, 3]

    def select(self, mask: Bools) -> Placements:
        """Return the placements that a mask selects."""
        return Placements(
            self.targets,
            self.meshes,
            self.mesh_target,
            self.mesh[mask],
            self.positions[mask],
            self.headings_deg[mask],
        )

    def without_collisions(self, body: Floats) -> Placements:
        """Return the placements whose footprints do not overlap an axis-aligned rectangle.

        `body` contains the lower and the upper corner of the rectangle. Shape (2, 2).
        """
        corners = self.footprints()
        rectangle = np.array(
            [[body[i, 0], body[j, 1]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        )
        apart = np.zeros(len(self), np.bool_)
        # Two convex shapes are disjoint if the normal of one of their sides separates them.
        for axis in (0, 1):
            apart |= corners[..., axis].max(axis=1) < body[0, axis]
            apart |= corners[..., axis].min(axis=1) > body[1, axis]
        for side in (0, 1):
            normals = corners[:, side + 1] - corners[:, side]
            own = np.einsum("pj,pkj->pk", normals, corners)
            others = normals @ rectangle.T
            apart |= own.max(axis=1) < others.min(axis=1)
            apart |= own.min(axis=1) > others.max(axis=1)
        return self.select(apart)


def grid_placements(
    targets: Sequence[Target],
    meshes: Sequence[SceneMesh],
    distances_m: Sequence[float],
    bearings: int,
    headings_deg: Sequence[float],
) -> Placements:
    """Return all targets on a polar grid around the vehicle, in all headings.

    `meshes` contains the mesh of each target.
    """
    kinds = np.arange(len(targets))
    bearing = 2 * np.pi * np.arange(bearings) / bearings
    kind, distance, angle, heading = (
        values.ravel()
        for values in np.meshgrid(kinds, distances_m, bearing, headings_deg, indexing="ij")
    )
    positions = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * angle], axis=1)
    return Placements(tuple(targets), tuple(meshes), kinds, kind, positions.round(9), heading)


def azimuths_in_view(directions: Floats) -> Bools:
    """Return which azimuth bins contain a beam, or are close to one.

    `directions` (n, 3) are in the vehicle frame. The first bin starts at -180°, and the result has
    shape (AZIMUTH_BINS,).
    """
    angles = np.arctan2(directions[:, 1], directions[:, 0]) + np.pi
    bins = (angles / (2 * np.pi) * AZIMUTH_BINS).astype(int) % AZIMUTH_BINS
    in_view = np.zeros(AZIMUTH_BINS, np.bool_)
    for shift in range(-_DILATION, _DILATION + 1):
        in_view[(bins + shift) % AZIMUTH_BINS] = True
    return in_view


def pack_sweeps(
    placements: Placements, origin: Floats, sensor: Sensor, in_view: Bools
) -> Iterator[Ints]:
    """Distribute placements among sweeps in which no target can hide another.

    Seen from the sensor, the azimuths of the targets in a sweep do not overlap. Because the azimuth
    of a straight ray is constant, a ray hits at most one of them.

    Parameters
    ----------
    placements
        Targets, all on the ground.
    origin
        Position of the sensor in the vehicle frame, in meters. Shape (3,).
    sensor
        The sensor. Its beams may start at an offset from its origin.
    in_view
        Whether each azimuth bin contains a beam of the sensor. See `azimuths_in_view`.

    Yields
    ------
    Indices of the placements in a sweep. Placements in azimuths without beams are omitted.
    """
    masks, widths = _azimuth_masks(placements.footprints() - origin[:2], _beam_offset_m(sensor))
    beams = sum(1 << index for index in np.flatnonzero(in_view).tolist())
    sweeps: list[list[int]] = []
    occupied: list[int] = []
    for index in np.argsort(-widths, kind="stable").tolist():
        mask = masks[index]
        if not mask & beams:
            continue
        for number, taken in enumerate(occupied):
            if not mask & taken:
                occupied[number] |= mask
                sweeps[number].append(index)
                break
        else:
            occupied.append(mask)
            sweeps.append([index])
    for sweep in sweeps:
        yield np.array(sorted(sweep))


def _beam_offset_m(sensor: Sensor) -> float:
    """Return the largest distance between a beam's start and the sensor's origin in a firing."""
    origins = sensor.origins(np.arange(1))
    return 0.0 if origins is None else float(np.linalg.norm(origins.reshape(-1, 3), axis=1).max())


def _azimuth_masks(corners: Floats, offset_m: float) -> tuple[list[int], Ints]:
    """Return the azimuth bins of each footprint as a bit mask, and the number of bins.

    `corners` (p, 4, 2) are relative to the sensor.
    """
    centers = corners.mean(axis=1)
    middle = np.arctan2(centers[:, 1], centers[:, 0])
    angles = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    angles = (angles + np.pi) % (2 * np.pi) - np.pi
    nearest = _distance_to_origin(corners)
    alone = (nearest < _NEAR_M + 2 * offset_m) | (np.ptp(angles, axis=1) >= np.pi)
    margin = _MARGIN_RAD / 2 + np.arcsin(np.minimum(1, offset_m / np.maximum(nearest, _NEAR_M)))
    per_bin = 2 * np.pi / AZIMUTH_BINS
    first = np.floor((middle + angles.min(axis=1) - margin + np.pi) / per_bin).astype(int)
    last = np.floor((middle + angles.max(axis=1) + margin + np.pi) / per_bin).astype(int)
    counts = np.where(alone, AZIMUTH_BINS, np.minimum(last - first + 1, AZIMUTH_BINS))
    full = (1 << AZIMUTH_BINS) - 1
    masks = []
    for start, count in zip((first % AZIMUTH_BINS).tolist(), counts.tolist(), strict=True):
        bits = ((1 << count) - 1) << start
        masks.append((bits | bits >> AZIMUTH_BINS) & full)
    return masks, counts


def _distance_to_origin(corners: Floats) -> Floats:
    """Return the distance from the origin to each quadrilateral, or 0 if the origin is inside."""
    following = np.roll(corners, -1, axis=1)
    way = following - corners
    share = -(corners * way).sum(axis=2) / np.maximum((way * way).sum(axis=2), 1e-30)
    nearest = corners + share.clip(0, 1)[..., None] * way
    turns = way[..., 0] * -corners[..., 1] - way[..., 1] * -corners[..., 0]
    inside = (turns >= 0).all(axis=1) | (turns <= 0).all(axis=1)
    return np.where(inside, 0.0, np.linalg.norm(nearest, axis=2).min(axis=1))

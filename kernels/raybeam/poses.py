"""Sensor poses, each of which applies to a number of consecutive rays."""

from __future__ import annotations

from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import AnyArray, Floats, Indices, Ints
from .rays import are_finite, as_real_rows, check_rows

_SLACK = 2e-9  # tolerance for the dot products of the rows of a rotation matrix


@dataclass(frozen=True, eq=False)
class PoseMotion:
    """Motion of a lidar while it fires the rays that share a pose.

    Parameters
    ----------
    delays
        float64 (m,): delay of each of the m rays of a pose relative to the time of the pose, in
        seconds.
    velocities
        float64 (k, 3): velocity at each pose in mesh coordinates, in meters per second.
    rates
        float64 (k, 3): angular velocity at each pose in mesh coordinates, in radians per second. A
        vector v is rotated to ``v + delay * cross(rate, v)``, with an error of
        (delay * rate)^2 / 2, which is 2e-9 for 36 us at 100 degrees per second.
    """

    delays: Floats
    velocities: Floats
    rates: Floats


@dataclass(frozen=True, eq=False)
class Poses:
    """Validated poses of a sensor.

    Attributes
    ----------
    positions
        float64 (k, 3), in meters.
    rotations
        float64 (k, 3, 3): rotations from the sensor frame to the mesh frame. None if their axes are
        parallel. Each matrix element is contiguous over the poses, as are the components of
        positions and motion.
    rays_per_pose
        Number of rays per pose, at least 1. Ray i belongs to pose ``i // rays_per_pose``.
    motion
        Motion of the lidar while the rays of a pose are fired. None if the lidar does not move
        during this time.
    """

    positions: Floats
    rotations: Floats | None
    rays_per_pose: int
    motion: PoseMotion | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def per_ray(self, ray: Ints, out: Floats) -> RayPoses:
        """Return the pose index of each ray, using `out` as memory.

        `out` is float64 (18, m).
        """
        pose = ray // self.rays_per_pose
        delay = np.zeros(1)
        rates = None
        velocities = None
        if self.motion is not None:
            delay = self.motion.delays.take(ray - pose * self.rays_per_pose)
            velocities = self._per_ray(self.motion.velocities, pose, out[12:15])
            if self.motion.rates.any():
                rates = self._per_ray(self.motion.rates, pose, out[15:])
        rotations = self.rotations
        if rotations is not None:
            rotations = self._per_ray(rotations, pose, out[:9])
        return RayPoses(
            self._per_ray(self.positions, pose, out[9:12]), rotations, delay, velocities, rates
        )

    def _per_ray(self, table: Floats, pose: Indices, out: Floats) -> Floats:
        columns = np.moveaxis(table, 0, -1).reshape(-1, len(self))
        if len(self) == 1:
            return columns
        for column, row in zip(columns, out, strict=True):
            column.take(pose, out=row, mode="clip")  # other modes use a buffer
        return out


@dataclass(frozen=True, eq=False)
class RayPoses:
    """Poses of m individual rays.

    The arrays have shape (components, m), or (components, 1) if all rays share a pose.

    Attributes
    ----------
    positions
        float64 (3, m), in meters.
    rotations
        float64 (9, m): matrices from the sensor frame to the mesh frame, row by row. None if their
        axes are parallel.
    delay
        float64 (m,) or (1,): delay of each ray relative to the time of its pose, in seconds.
    velocities, rates
        float64 (3, m): as in `PoseMotion`. None if the lidar does not move or does not rotate.
    """

    positions: Floats
    rotations: Floats | None
    delay: Floats
    velocities: Floats | None
    rates: Floats | None

    def rotate(self, vectors: Floats) -> Floats:
        """Rotate vectors from the sensor frame to the mesh frame.

        The order of operations is fixed. The last bit of ``matrices @ vectors`` would depend on the
        BLAS library.
        """
        if self.rotations is not None:
            x, y, z = vectors
            vectors = np.empty_like(vectors)
            product = np.empty_like(x)
            for component, (a, b, c) in zip(vectors, self.rotations.reshape(3, 3, -1), strict=True):
                np.multiply(x, a, out=component)
                component += np.multiply(y, b, out=product)
                component += np.multiply(z, c, out=product)
        if self.rates is None:
            return vectors
        x, y, z = vectors
        a, b, c = self.rates
        crosses = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
        crosses *= self.delay
        crosses += vectors
        return crosses

    def translate(self, positions: Floats) -> Floats:
        """Move positions by the product of velocity and delay of each ray."""
        if self.velocities is None:
            return positions
        pairs = zip(positions, self.velocities, strict=True)
        return np.stack([position + self.delay * velocity for position, velocity in pairs])


def check_poses(
    positions: ArrayLike | Poses,
    rotations: ArrayLike | None,
    rays_per_pose: int | None,
    ray_count: int,
    motion: PoseMotion | None = None,
) -> Poses:
    """Validate the poses of the given number of rays.

    `RayCaster.scan` describes the arguments. If `positions` is a `Poses` object, which has already
    been validated, it is returned unchanged.

    Raises ValueError if a pose is invalid or there are too few poses.
    """
    if isinstance(positions, Poses):
        return positions
    position_rows = as_real_rows("positions", positions)
    check_rows("Position", position_rows, are_finite, "finite")
    matrices = None if rotations is None else _check_rotations(rotations)
    count = max(len(position_rows), 1 if matrices is None else len(matrices))
    for table in (position_rows, matrices):
        if table is not None and len(table) not in (1, count):
            raise ValueError(
                "positions and rotations must have the same length, or one of them must have "
                f"length 1, but their lengths are {len(position_rows)} and "
                f"{0 if matrices is None else len(matrices)}."
            )
    if rays_per_pose is None and count > 1:
        raise ValueError(f"rays_per_pose is required, because there are {count:,} poses.")
    rays_of_pose = max(ray_count, 1) if rays_per_pose is None else index(rays_per_pose)
    if rays_of_pose < 1 or count * rays_of_pose < ray_count:
        raise ValueError(
            f"{count:,} poses with {rays_of_pose:,} rays each do not cover {ray_count:,} rays. "
            "Pass more poses, a larger rays_per_pose, or a smaller window."
        )
    return Poses(
        _broadcast_rows(component_major(position_rows), count),
        None if matrices is None else _broadcast_rows(matrices, count),
        rays_of_pose,
        None if motion is None else _check_motion(motion, count, rays_of_pose),
    )


def _broadcast_rows(table: Floats, count: int) -> Floats:
    """Repeat a single row until the table has `count` rows."""
    return table if len(table) == count else np.broadcast_to(table, (count, *table.shape[1:]))


def _check_motion(motion: PoseMotion, pose_count: int, ray_count: int) -> PoseMotion:
    arrays = []
    for name, shape in (
        ("delays", (ray_count,)),
        ("velocities", (pose_count, 3)),
        ("rates", (pose_count, 3)),
    ):
        array = component_major(np.asarray(getattr(motion, name), dtype=np.float64))
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(
                f"PoseMotion.{name} must be an array of finite numbers with shape {shape} for "
                f"{pose_count:,} poses with {ray_count:,} rays each, but has shape {array.shape}."
            )
        arrays.append(array)
    return PoseMotion(*arrays)


def _check_rotations(rotations: ArrayLike) -> Floats:
    """Validate rotations, and convert them to float64 matrices.

    Raises ValueError if a matrix is not orthonormal or contains a reflection.
    """
    matrices = component_major(as_real_rows("rotations", rotations, (3, 3)))
    rows = matrices.transpose(1, 2, 0)
    x, y, z = rows.transpose(1, 0, 2)
    # Comparisons with NaN are false, so matrices with NaN count as invalid.
    with np.errstate(over="ignore", invalid="ignore"):
        products = (x[:, None] * x + y[:, None] * y) + z[
            :, None
        ] * z  # dot products of two rows each
        deviations = np.abs(products - np.eye(3)[:, :, None])
        orthonormal = (deviations <= _SLACK).all(axis=(0, 1))
        mirrored = orthonormal & ~(determinants(rows) > 0)
    invalid = np.flatnonzero(~orthonormal | mirrored)
    if not len(invalid):
        return matrices
    first = invalid[0]
    if mirrored[first]:
        raise ValueError(
            f"The determinant of rotation {first} must be 1, but {matrices[first].tolist()} "
            f"contains a reflection. {len(invalid)} of {len(matrices)} matrices are invalid."
        )
    raise ValueError(
        f"Rotation {first} must be an orthonormal matrix from the sensor frame to the mesh frame, "
        f"but is {matrices[first].tolist()}. {len(invalid)} of {len(matrices)} matrices are "
        "invalid."
    )


def determinants(matrix_rows: Floats) -> Floats:
    """Compute the determinants of k matrices with shape (3, 3, k)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix_rows
    return np.asarray((a * (e * i - f * h) - b * (d * i - f * g)) + c * (d * h - e * g))


def component_major(table: AnyArray) -> Floats:
    """Copy a table to float64 memory in which each component is contiguous."""
    # `numpy.moveaxis` would take as long as casting 100 rays.
    components_first = table.transpose(*range(1, table.ndim), 0)
    contiguous = np.ascontiguousarray(components_first, dtype=np.float64)
    return contiguous.transpose(-1, *range(table.ndim - 1))

"""Where a sensor is while it fires: positions and rotations, each for a number of rays."""

from __future__ import annotations

from dataclasses import dataclass
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rays import finite_rows, real_rows, refuse_rows

_SLACK = 2e-9  # on products of a rotation's rows


@dataclass(frozen=True, eq=False)
class Motion:
    """How a lidar moves on while the rays of a pose leave, one after the other.

    Parameters
    ----------
    delays
        float64 (m,): how long after its pose's time each of the m rays of a pose leaves, seconds.
    velocities
        float64 (k, 3): of each pose, metres a second along the mesh's axes.
    rates
        float64 (k, 3): of each pose, radians a second about the mesh's axes. A vector v becomes
        ``v + delay * cross(rate, v)``: off by (delay * rate)^2 / 2, which is 2e-9 for 36 us at
        100 degrees a second.
    """

    delays: NDArray[np.float64]
    velocities: NDArray[np.float64]
    rates: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses that have been checked.

    Attributes
    ----------
    positions
        float64 (k, 3), metres.
    rotations
        float64 (k, 3, 3) from the sensor's axes to the mesh's; None when those are the same. In
        memory the poses of each number lie together, as those of positions and motion do.
    rays
        Rays of a pose, at least 1: ray i belongs to pose ``i // rays``.
    motion
        Within each pose; None where the lidar stands for all of its rays.
    """

    positions: NDArray[np.float64]
    rotations: NDArray[np.float64] | None
    rays: int
    motion: Motion | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def turned(
        self, vectors: NDArray[np.float64], pose: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """Turn vectors into the mesh's axes, with one fixed order of rounding.

        ``matrices @ vectors`` would do, but its last bit depends on the machine's BLAS.

        Parameters
        ----------
        vectors
            (3, m), in the sensor's axes, one row an axis.
        pose
            (m,): number of the pose of each vector.

        Returns
        -------
        (m, 3); transposed, it is contiguous.
        """
        if self.rotations is None:
            return vectors.T
        # One matrix for all, or one a vector: the products and sums are the same.
        rows = self.rotations.reshape(-1, 9).T
        rows = rows[:, :1] if len(self) == 1 else np.ascontiguousarray(rows).take(pose, axis=1)
        x, y, z = vectors
        out = np.empty((3, len(pose))).T
        for axis in range(3):
            a, b, c = rows[3 * axis : 3 * axis + 3]
            out[:, axis] = (x * a + y * b) + z * c
        return out

    def drifted(self, vectors: NDArray[np.float64], ray: NDArray[np.int64]) -> NDArray[np.float64]:
        """Turn vectors (m, 3), in the mesh's axes, on by as much as their rays are late."""
        if self.motion is None:
            return vectors
        delay = self.motion.delays.take(ray % self.rays)
        x, y, z = vectors.T
        a, b, c = self.motion.rates.take(ray // self.rays, axis=0).T
        out = np.empty((3, len(ray))).T
        out[:, 0] = x + delay * (b * z - c * y)
        out[:, 1] = y + delay * (c * x - a * z)
        out[:, 2] = z + delay * (a * y - b * x)
        return out

    def moved(self, places: NDArray[np.float64], ray: NDArray[np.int64]) -> NDArray[np.float64]:
        """Move places (m, 3), or (1, 3), on by as much as their rays are late."""
        if self.motion is None:
            return places
        delay = self.motion.delays.take(ray % self.rays)[:, None]
        return places + delay * self.motion.velocities.take(ray // self.rays, axis=0)


def check_poses(
    positions: ArrayLike | Poses,
    rotations: ArrayLike | None,
    rays_per_pose: int | None,
    rays: int,
    motion: Motion | None = None,
) -> Poses:
    """Poses for so many rays; see `RayCaster.scan`, which tells what is what and what is raised.

    `Poses` in place of positions have been checked before.
    """
    if isinstance(positions, Poses):
        return positions
    places = real_rows("positions", positions)
    refuse_rows("Position", places, finite_rows, "finite coordinates")
    turns = None if rotations is None else _check_rotations(rotations)
    count = max(len(places), 1 if turns is None else len(turns))
    for given in (places, turns):
        if given is not None and len(given) not in (1, count):
            raise ValueError(
                f"There are {len(places)} positions and {0 if turns is None else len(turns)} "
                "rotations: give one for all poses, or one for each."
            )
    if rays_per_pose is None and count > 1:
        raise ValueError(
            f"There are {count:,} poses: rays_per_pose must say how many rays each of them has."
        )
    each = max(rays, 1) if rays_per_pose is None else index(rays_per_pose)
    if each < 1 or count * each < rays:
        raise ValueError(
            f"{count:,} poses of {each:,} rays are not enough for {rays:,} rays: "
            "give more poses, more rays_per_pose, or a smaller window."
        )
    return Poses(
        np.broadcast_to(_by_number(places), (count, 3)),
        None if turns is None else np.broadcast_to(turns, (count, 3, 3)),
        each,
        None if motion is None else _check_motion(motion, count, each),
    )


def _check_motion(motion: Motion, poses: int, rays: int) -> Motion:
    arrays = []
    for name, shape in (("delays", (rays,)), ("velocities", (poses, 3)), ("rates", (poses, 3))):
        array = _by_number(np.asarray(getattr(motion, name), dtype=np.float64))
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(
                f"Motion.{name} must be {shape} finite numbers for {poses:,} poses of {rays:,} "
                f"rays; given: {array.shape}."
            )
        arrays.append(array)
    return Motion(*arrays)


def _check_rotations(rotations: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (k, 3, 3) in float64; raises ValueError for one that is not orthonormal."""
    matrices = _by_number(real_rows("rotations", rotations, (3, 3)))
    # Written out for all matrices at once: a product of matrices one by one takes longer than
    # casting their rays. NaN compares as false.
    rows = matrices.transpose(1, 2, 0)
    good = np.ones(len(matrices), np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        for one in range(3):
            for other in range(one, 3):
                (a, b, c), (d, e, f) = rows[one], rows[other]
                product = (a * d + b * e) + c * f
                good &= np.abs(product - (one == other)) <= _SLACK
    bad = np.flatnonzero(~good)
    if len(bad):
        raise ValueError(
            f"Rotation {bad[0]} is {matrices[bad[0]].tolist()}: expected orthonormal rows, which "
            f"turn the sensor's axes to the mesh's ({len(bad)} of {len(matrices)} are like that)."
        )
    return matrices


def _by_number(table: NDArray[Any]) -> NDArray[np.float64]:
    """Table (k, ...) in float64, whose entries for each number lie together in memory."""
    last = np.moveaxis(table, 0, -1)
    return np.moveaxis(np.ascontiguousarray(last, dtype=np.float64), -1, 0)

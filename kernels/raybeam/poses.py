"""Poses of a sensor: positions and rotations, each for a number of rays."""

from __future__ import annotations

from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import AnyArray, Floats, Indices, Ints
from .rays import finite_rows, real_rows, refuse_rows

_SLACK = 2e-9  # on products of a rotation's rows


@dataclass(frozen=True, eq=False)
class PoseMotion:
    """Motion of a lidar while it fires the rays of a pose one after the other.

    Parameters
    ----------
    delays
        float64 (m,): delay of each of the m rays of a pose after the pose's time, seconds.
    velocities
        float64 (k, 3): of each pose, metres a second along the mesh's axes.
    rates
        float64 (k, 3): of each pose, radians a second about the mesh's axes. A vector v becomes
        ``v + delay * cross(rate, v)``: off by (delay * rate)^2 / 2, which is 2e-9 for 36 us at
        100 degrees a second.
    """

    delays: Floats
    velocities: Floats
    rates: Floats


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses that have been checked.

    Attributes
    ----------
    positions
        float64 (k, 3), metres.
    rotations
        float64 (k, 3, 3) from the sensor's axes to the mesh's; None if those are the same. Each
        matrix entry is contiguous over the poses, as are the components of positions and motion.
    rays
        Rays of a pose, at least 1: ray i belongs to pose ``i // rays``.
    motion
        Within each pose; None if the lidar stands still for all of its rays.
    """

    positions: Floats
    rotations: Floats | None
    rays: int
    motion: PoseMotion | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def of(self, ray: Ints, room: Floats) -> RayPoses:
        """Look up the poses of rays (m,), into `room`, (18, m)."""
        pose = ray // self.rays
        delay = np.zeros(1)
        rates = None
        velocities = None
        if self.motion is not None:
            delay = self.motion.delays.take(ray - pose * self.rays)
            velocities = self._each(self.motion.velocities, pose, room[12:15])
            if self.motion.rates.any():
                rates = self._each(self.motion.rates, pose, room[15:])
        rotations = self.rotations
        if rotations is not None:
            rotations = self._each(rotations, pose, room[:9])
        return RayPoses(
            self._each(self.positions, pose, room[9:12]), rotations, delay, velocities, rates
        )

    def _each(self, table: Floats, pose: Indices, room: Floats) -> Floats:
        columns = np.moveaxis(table, 0, -1).reshape(-1, len(self))
        if len(self) == 1:
            return columns
        for column, out in zip(columns, room, strict=True):
            column.take(pose, out=out, mode="clip")  # other modes use a buffer
        return room


@dataclass(frozen=True, eq=False)
class RayPoses:
    """Poses of m rays, see `Poses`: (numbers, m), or (numbers, 1) if all rays share one."""

    positions: Floats
    rotations: Floats | None
    delay: Floats
    velocities: Floats | None
    rates: Floats | None

    def turned(self, vectors: Floats) -> Floats:
        """Rotate vectors (3, m) to the mesh's axes, with a fixed order of rounding.

        ``matrices @ vectors`` would do, but its last bit depends on the machine's BLAS.
        """
        if self.rotations is not None:
            x, y, z = vectors
            vectors = np.empty_like(vectors)
            product = np.empty_like(x)
            for out, (a, b, c) in zip(vectors, self.rotations.reshape(3, 3, -1), strict=True):
                np.multiply(x, a, out=out)
                out += np.multiply(y, b, out=product)
                out += np.multiply(z, c, out=product)
        if self.rates is None:
            return vectors
        (x, y, z), (a, b, c) = vectors, self.rates
        crosses = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
        crosses *= self.delay
        crosses += vectors
        return crosses

    def moved(self, places: Floats) -> Floats:
        """Move positions (3, m), or (3, 1), by the delays of their rays."""
        if self.velocities is None:
            return places
        pairs = zip(places, self.velocities, strict=True)
        return np.stack([place + self.delay * speed for place, speed in pairs])


def check_poses(
    positions: ArrayLike | Poses,
    rotations: ArrayLike | None,
    rays_per_pose: int | None,
    rays: int,
    motion: PoseMotion | None = None,
) -> Poses:
    """Check the poses for so many rays; `RayCaster.scan` describes arguments and errors.

    `Poses` instead of positions have been checked before.
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
        np.broadcast_to(by_number(places), (count, 3)),
        None if turns is None else np.broadcast_to(turns, (count, 3, 3)),
        each,
        None if motion is None else _check_motion(motion, count, each),
    )


def _check_motion(motion: PoseMotion, poses: int, rays: int) -> PoseMotion:
    arrays = []
    for name, shape in (("delays", (rays,)), ("velocities", (poses, 3)), ("rates", (poses, 3))):
        array = by_number(np.asarray(getattr(motion, name), dtype=np.float64))
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(
                f"PoseMotion.{name} must be {shape} finite numbers for {poses:,} poses of {rays:,} "
                f"rays; given: {array.shape}."
            )
        arrays.append(array)
    return PoseMotion(*arrays)


def _check_rotations(rotations: ArrayLike) -> Floats:
    """Rotation matrices (k, 3, 3) in float64; ValueError for one that deforms or mirrors."""
    matrices = by_number(real_rows("rotations", rotations, (3, 3)))
    # Written out for all matrices at once: products one by one take longer than casting their rays.
    # NaN compares as false.
    rows = matrices.transpose(1, 2, 0)
    good = np.ones(len(matrices), np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        for one in range(3):
            for other in range(one, 3):
                (a, b, c), (d, e, f) = rows[one], rows[other]
                product = (a * d + b * e) + c * f
                good &= np.abs(product - (one == other)) <= _SLACK
        (a, b, c), (d, e, f), (g, h, i) = rows
        determinants = (a * (e * i - f * h) - b * (d * i - f * g)) + c * (d * h - e * g)
        mirrored = good & ~(determinants > 0)
        good &= ~mirrored
    bad = np.flatnonzero(~good)
    if len(bad) and mirrored[bad[0]]:
        raise ValueError(
            f"Rotation {bad[0]} is {matrices[bad[0]].tolist()}, which mirrors: expected the "
            f"determinant 1 ({len(bad)} of {len(matrices)} are no rotations)."
        )
    if len(bad):
        raise ValueError(
            f"Rotation {bad[0]} is {matrices[bad[0]].tolist()}: expected orthonormal rows, which "
            f"turn the sensor's axes to the mesh's ({len(bad)} of {len(matrices)} are like that)."
        )
    return matrices


def by_number(table: AnyArray) -> Floats:
    """Table (k, ...) in float64, each number contiguous over the k entries."""
    last = np.moveaxis(table, 0, -1)
    return np.moveaxis(np.ascontiguousarray(last, dtype=np.float64), -1, 0)

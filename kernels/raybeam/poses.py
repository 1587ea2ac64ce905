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
class Poses:
    """Poses that have been checked.

    Attributes
    ----------
    positions
        float64 (k, 3), metres.
    rotations
        float64 (k, 3, 3) from the sensor's axes to the mesh's; None when those are the same.
    rays
        Rays of a pose, at least 1: ray i belongs to pose ``i // rays``.
    """

    positions: NDArray[np.float64]
    rotations: NDArray[np.float64] | None
    rays: int

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
        matrices = self.rotations[0] if len(self) == 1 else self.rotations.take(pose, axis=0)
        x, y, z = vectors
        out = np.empty((3, len(pose))).T
        for axis in range(3):
            a, b, c = (matrices[..., axis, other] for other in range(3))
            out[:, axis] = (x * a + y * b) + z * c
        return out


def check_poses(
    positions: ArrayLike, rotations: ArrayLike | None, rays_per_pose: int | None, rays: int
) -> Poses:
    """Poses for so many rays; see `RayCaster.scan`, which tells what is what and what is raised."""
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
        np.broadcast_to(np.ascontiguousarray(places, dtype=np.float64), (count, 3)),
        None if turns is None else np.broadcast_to(turns, (count, 3, 3)),
        each,
    )


def _check_rotations(rotations: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (k, 3, 3) in float64; raises ValueError for one that is not orthonormal."""
    matrices = np.ascontiguousarray(real_rows("rotations", rotations, (3, 3)), dtype=np.float64)
    # Written out for all matrices at once: a product of matrices one by one takes longer than
    # casting their rays. NaN compares as false.
    rows = np.ascontiguousarray(matrices.reshape(-1, 9).T).reshape(3, 3, -1)
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

"""Where a sensor is while it fires: positions and rotations, each for a number of rays."""

from __future__ import annotations

from dataclasses import dataclass
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .given import as_array
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
        """Turn vectors into the mesh's axes, with the operations of `raybeam.rays.rotated`.

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
    """Poses as float64 arrays, of equal length.

    Parameters
    ----------
    positions
        (3,) or (k, 3), metres.
    rotations
        None, (3, 3) or (k, 3, 3), orthonormal.
    rays_per_pose
        Rays of each pose; None for all, which only a single pose can have.
    rays
        Number of rays that need a pose.

    Raises
    ------
    ValueError
        For numbers that are no poses, and if the poses do not suffice for the rays.
    TypeError
        If `rays_per_pose` is no whole number.
    """
    places = check_positions(positions)
    turns = check_rotations(rotations)
    count = max(len(places), 1 if turns is None else len(turns))
    for given in (places, turns):
        if given is not None and len(given) not in (1, count):
            raise ValueError(
                f"There are {len(places)} positions and {0 if turns is None else len(turns)} "
                "rotations: give one for all poses, or one for each."
            )
    each = _check_rays_per_pose(rays_per_pose, count, rays)
    return Poses(
        np.broadcast_to(places, (count, 3)),
        None if turns is None else np.broadcast_to(turns, (count, 3, 3)),
        each,
    )


def check_positions(positions: ArrayLike) -> NDArray[np.float64]:
    """Positions (k, 3) in float64; raises ValueError unless there is one and all are finite."""
    table = real_rows("positions", positions)
    if not len(table):
        raise ValueError("There are no positions: a scan needs at least one pose.")
    refuse_rows("Position", table, finite_rows, "finite coordinates")
    return np.ascontiguousarray(table, dtype=np.float64)


def check_rotations(rotations: ArrayLike | None) -> NDArray[np.float64] | None:
    """Rotation matrices (k, 3, 3) in float64; raises ValueError for one that is not orthonormal."""
    if rotations is None:
        return None
    given = as_array("rotations", rotations)
    if given.dtype.kind not in "fiu" or given.ndim not in (2, 3) or given.shape[-2:] != (3, 3):
        raise ValueError(
            "rotations must be orthonormal matrices of shape (3, 3) or (k, 3, 3), "
            f"not {given.dtype} {given.shape}."
        )
    matrices = np.array(given, dtype=np.float64).reshape(-1, 3, 3)
    if not len(matrices):
        raise ValueError("There are no rotations: give one for each pose, or None.")
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


def _check_rays_per_pose(rays_per_pose: int | None, poses: int, rays: int) -> int:
    if rays_per_pose is None:
        if poses > 1:
            raise ValueError(
                f"There are {poses:,} poses: rays_per_pose must say how many rays each of them has."
            )
        return max(rays, 1)
    try:
        each = index(rays_per_pose)
    except TypeError as error:
        raise TypeError(
            f"rays_per_pose must be a whole number, or None, not {rays_per_pose!r}."
        ) from error
    if each < 1 or poses * each < rays:
        raise ValueError(
            f"{poses:,} poses of {each:,} rays are not enough for {rays:,} rays: "
            "give more poses, more rays_per_pose, or a smaller window."
        )
    return each

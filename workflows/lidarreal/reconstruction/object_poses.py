"""Determine the poses of moving objects by registration of their points.

The visible part of an object changes, so the center of its points is no fixed point of it. The
points of each sweep are therefore registered to those of the other sweeps, and the poses of all
sweeps are adjusted together. Planes determine the pose in the direction of their normals. In the
other directions, the motion is smooth, and the object faces its direction of travel.

The objects are upright: a pose has a position and a yaw angle. Within a sweep, points are moved
with the velocity of the object to the mean time of the points.

In array shapes, k is the number of sweeps in which an object was observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .moving_rays import MovingRays
from .object_tracks import rotate_z
from .surfels import principal_axes

_VOXEL_M = 0.1  # edge length of the voxels of a shape
_NEIGHBORS = 12  # neighbors that determine a plane
_MIN_NEIGHBORS = 6
_MAX_FLAT = 0.1  # maximum variance along the normal relative to the smaller variance in the plane
_MIN_WIDTH = 0.05  # minimum ratio of the variances within a plane
_SIGMA_M = 0.03  # minimum standard deviation of distances to planes
_TUKEY_SIGMAS = 4.0
_POINT_SIGMA_M = 0.15  # standard deviation of distances to points that are not on planes
_EQUIVALENT_POINTS = 60  # Points of a sweep have correlated errors, and count as this many.
_SWEEP_POINTS = 500  # points per sweep that are registered
_LOCAL_SWEEPS = 8  # preceding sweeps to which a sweep is registered first
_SEARCH_M = (1.0, 0.6, 0.4, 0.3, 0.3)  # search radius in each step of the first registration
_FIRST_SWEEPS = 4  # sweeps until the velocity is known
_ROUNDS = 10  # iterations of adjusting all poses
_SHRINK = 0.8  # factor by which the search radius decreases
_MIN_SEARCH_M = 0.2
# Standard deviations of the acceleration along x, y and z (m/s²), and of the yaw (rad/s²).
_ACCELERATION = np.array([3.0, 3.0, 0.7, 1.0])
_HEADING_RAD = 0.1  # standard deviation of the direction of travel from the x axis
_MIN_HEADING_M_S = 1.0  # minimum speed at which an object faces its direction of travel
_STILL_SHARE = 0.02  # maximum share of points that moved on a stationary object
_STILL_M_S = 0.4  # maximum speed of an object that may be stationary
# Standard deviations of the velocity of a stationary object, m/s and rad/s.
_STANDSTILL = np.array([0.02, 0.02, 0.02, 0.02])
# Standard deviations of labeled poses.
_LABEL_SIGMA = np.array([0.3, 0.3, 0.05, 0.05])
_FLOOR = 1e-3  # weight of the current poses, which makes the equations solvable
_BAND = 8  # lower bandwidth of the equations: two sweeps with four unknowns each


class Sighting(NamedTuple):
    """Points of an object in one sweep, in the world frame."""

    time_s: float  # mean time of the points
    points: Floats  # (n, 3), meters
    times_s: Floats  # (n,), seconds
    moved: float  # share of the points that rays of other sweeps passed through

    @classmethod
    def from_rays(cls, rays: MovingRays, rows: Ints | Bools) -> Sighting:
        """Create a sighting from returns."""
        times_s = rays.time_s[rows]
        return cls(float(times_s.mean()), rays.ends[rows], times_s, float(rays.moved[rows].mean()))

    def local(self, pose: Floats, velocity: Floats) -> Floats:
        """Transform the points to the object frame.

        `pose` is x, y, z and yaw at the mean time, and `velocity` its derivative. Both have shape
        (4,).
        """
        since_s = self.times_s - self.time_s
        moved = self.points - pose[:3] - since_s[:, None] * velocity[:3]
        return rotate_z(moved, -(pose[3] + since_s * velocity[3]))


class NormalEquations(NamedTuple):
    """Linear equations for the change of a pose in the world frame."""

    matrix: Floats  # (4, 4)
    vector: Floats  # (4,)
    matched: float  # share of the points that are close to the shape
    residual_m: float  # median distance from planes, inf without any


@dataclass(frozen=True, eq=False)
class Shape:
    """Mean points of an object in voxels, and the planes that they lie on."""

    means: Floats  # (m, 3)
    centers: Floats  # (m, 3), points of the planes
    normals: Floats  # (m, 3)
    flat: Bools  # (m,), whether the neighbors of a mean are in a plane
    tree: Any  # scipy.spatial.cKDTree of the means

    @classmethod
    def from_points(cls, points: Floats) -> Shape:
        """Create a shape from points in the object frame, of shape (n, 3)."""
        from scipy.spatial import cKDTree

        _, cell, counts = np.unique(_voxel_numbers(points), return_inverse=True, return_counts=True)
        sums = [np.bincount(cell, column) for column in points.T]
        means = np.stack(sums, axis=1) / counts[:, None]
        tree = cKDTree(means)
        count = min(_NEIGHBORS, len(means))
        if count < _MIN_NEIGHBORS:
            return cls(means, means, np.zeros_like(means), np.zeros(len(means), bool), tree)
        around = means[tree.query(means, count)[1]]
        variances, axes = principal_axes(around)
        smallest, middle, largest = variances.T
        flat = (smallest < _MAX_FLAT * middle) & (middle > _MIN_WIDTH * largest)
        return cls(means, around.mean(axis=1), axes[:, 0], flat, tree)

    def equations(self, local: Floats, yaw: float, search_m: float) -> NormalEquations:
        """Return the equations that move points in the object frame to the shape.

        The points have shape (n, 3), and `yaw` is the current angle of the object.
        """
        distance_m, nearest = self.tree.query(local, distance_upper_bound=search_m)
        found = np.isfinite(distance_m)
        points, nearest = local[found], nearest[found]
        flat = self.flat[nearest]
        matrix, vector, residual_m = self._plane_equations(points[flat], nearest[flat])
        others, nearest = points[~flat], nearest[~flat]
        for axis in np.eye(3):
            jacobian = _jacobian(np.broadcast_to(axis, others.shape), others)
            matrix += jacobian.T @ jacobian / _POINT_SIGMA_M**2
            vector -= jacobian.T @ ((others - self.means[nearest]) @ axis) / _POINT_SIGMA_M**2
        scale = min(1.0, _EQUIVALENT_POINTS / max(len(points), 1))
        turn = np.eye(4)  # from the world frame to the object frame
        turn[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
        matched = float(found.mean()) if len(found) else 0.0
        return NormalEquations(
            scale * turn.T @ matrix @ turn, scale * turn.T @ vector, matched, residual_m
        )

    def _plane_equations(self, points: Floats, nearest: Ints) -> tuple[Floats, Floats, float]:
        """Return the equations of points on planes, and the median distance from the planes."""
        normals = self.normals[nearest]
        residual = np.einsum("ij,ij->i", points - self.centers[nearest], normals)
        residual_m = float(np.median(np.abs(residual))) if len(residual) else np.inf
        sigma_m = max(_SIGMA_M, 1.5 * residual_m)
        weight = np.clip(1 - (residual / (_TUKEY_SIGMAS * sigma_m)) ** 2, 0, None) ** 2
        weight /= sigma_m**2
        jacobian = _jacobian(normals, points)
        return (
            jacobian.T @ (weight[:, None] * jacobian),
            -jacobian.T @ (weight * residual),
            residual_m,
        )


def _voxel_numbers(points: Floats) -> Ints:
    """Return a number for the voxel of each point.

    Sorting one integer per point is several times as fast as sorting rows of three.
    """
    cells = np.floor(points / _VOXEL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)))


def _jacobian(normals: Floats, points: Floats) -> Floats:
    """Return the derivatives of distances by x, y, z and yaw of the pose, in the object frame."""
    turning = normals[:, 0] * points[:, 1] - normals[:, 1] * points[:, 0]
    return np.column_stack([-normals, turning])


def _sample(points: Floats) -> Floats:
    return points[:: -(-len(points) // _SWEEP_POINTS)] if len(points) else points


def velocities_of(times_s: Floats, poses: Floats) -> Floats:
    """Return the derivatives of poses, of shape (k, 4). Both arrays have k rows."""
    if len(poses) < 2:
        return np.zeros_like(poses)
    return np.asarray(np.gradient(poses, times_s, axis=0))


def first_poses(sightings: Sequence[Sighting], centers: Floats) -> Floats:
    """Register the sightings of an object one after the other.

    The first one is that with the most points. Each further one is registered to those that
    precede it, in both directions.

    Parameters
    ----------
    sightings
        Points of the object in each sweep.
    centers
        Approximate centers of the visible points, of shape (k, 3), which determine the initial
        velocity.

    Returns
    -------
    Positions and yaw angles of shape (k, 4).
    """
    times_s = np.array([one.time_s for one in sightings])
    seed = int(np.argmax([len(one.points) for one in sightings]))
    first, last = max(seed - 3, 0), min(seed + 3, len(sightings) - 1)
    velocity = np.zeros(4)
    velocity[:2] = (centers[last] - centers[first])[:2] / (times_s[last] - times_s[first])
    poses = np.zeros((len(sightings), 4))
    poses[seed, :3] = centers[seed]
    poses[seed, 3] = np.arctan2(velocity[1], velocity[0])
    for following in (range(seed + 1, len(sightings)), range(seed - 1, -1, -1)):
        _register_in_order(sightings, poses, [seed, *following], velocity)
    return poses


def _register_in_order(
    sightings: Sequence[Sighting], poses: Floats, order: Sequence[int], velocity: Floats
) -> None:
    """Determine the poses of sightings in the given order, of which the first pose is known."""
    times_s = np.array([one.time_s for one in sightings])
    current = velocity.copy()
    parts = [_sample(sightings[order[0]].local(poses[order[0]], current))]
    for count, (last, index) in enumerate(pairwise(order), 1):
        step_s = times_s[index] - times_s[last]
        shape = Shape.from_points(np.concatenate(parts[-_LOCAL_SWEEPS:]))
        is_new = count < _FIRST_SWEEPS
        sigma_m = 3.0 * abs(step_s) if is_new else 0.5 * abs(step_s) + 0.02
        prior = np.array([sigma_m, sigma_m, 0.05, 0.03])
        predicted = poses[last] + current * step_s
        poses[index], _ = register(shape, sightings[index], predicted, current, prior)
        parts.append(_sample(sightings[index].local(poses[index], current)))
        start = order[max(count - _FIRST_SWEEPS, 0)]
        measured = (poses[index] - poses[start]) / (times_s[index] - times_s[start])
        share = 0.5 if is_new else 1.0
        current[:2] += share * (measured - current)[:2]


def register(
    shape: Shape, sighting: Sighting, predicted: Floats, velocity: Floats, sigma: Floats
) -> tuple[Floats, NormalEquations]:
    """Register a sighting to a shape, given a predicted pose with standard deviations.

    Returns the pose and the equations of the last step.
    """
    pose = predicted.copy()
    equations = None
    for search_m in _SEARCH_M:
        local = _sample(sighting.local(pose, velocity))
        equations = shape.equations(local, pose[3], search_m)
        prior = np.diag(1 / sigma**2)
        vector = equations.vector + prior @ (predicted - pose)
        pose = pose + np.linalg.solve(equations.matrix + prior, vector)
    assert equations is not None
    return pose, equations


class _Banded:
    """Symmetric, banded linear equations."""

    def __init__(self, count: int) -> None:
        self.bands = np.zeros((_BAND + 1, count))
        self.bands[0] = _FLOOR
        self.vector = np.zeros(count)

    def add(self, rows: Sequence[int], matrix: Floats, vector: Floats) -> None:
        """Add equations for the unknowns `rows`, which are in ascending order."""
        for column, first in enumerate(rows):
            self.vector[first] += vector[column]
            for row in range(column, len(rows)):
                self.bands[rows[row] - first, first] += matrix[row, column]

    def solve(self) -> Floats:
        """Return the solution."""
        from scipy.linalg import solveh_banded

        return np.asarray(solveh_banded(self.bands, self.vector, lower=True))


def adjust_poses(
    sightings: Sequence[Sighting], poses: Floats, labeled: Floats | None = None
) -> Floats:
    """Adjust the poses of an object in all sweeps together.

    Parameters
    ----------
    sightings
        Points of the object in each sweep.
    poses
        Initial positions and yaw angles, of shape (k, 4).
    labeled
        Poses from labels, which are known approximately, or None.
    """
    times_s = np.array([one.time_s for one in sightings])
    for number in range(_ROUNDS):
        velocities = velocities_of(times_s, poses)
        velocities[:, 2] = 0
        if labeled is None:  # The axes of the shape are arbitrary.
            poses = poses + np.array([0.0, 0.0, 0.0, _median_drift(poses, velocities)])
        points = [
            one.local(pose, velocity)
            for one, pose, velocity in zip(sightings, poses, velocities, strict=True)
        ]
        shape = Shape.from_points(np.concatenate(points))
        search_m = max(0.6 * _SHRINK**number, _MIN_SEARCH_M)
        banded = _Banded(4 * len(poses))
        for index, local in enumerate(points):
            equations = shape.equations(_sample(local), poses[index, 3], search_m)
            banded.add(range(4 * index, 4 * index + 4), equations.matrix, equations.vector)
        if labeled is None:
            _add_headings(banded, poses, velocities)
        else:
            _add_labels(banded, poses, labeled)
        _add_accelerations(banded, times_s, poses)
        moved = np.array([one.moved for one in sightings])
        still = (moved < _STILL_SHARE) & (np.abs(velocities[:, :2]).max(axis=1) < _STILL_M_S)
        _add_standstills(banded, times_s, poses, still)
        poses = poses + banded.solve().reshape(-1, 4)
    return poses


def _drifts(poses: Floats, velocities: Floats) -> tuple[Ints, Floats]:
    """Return the sweeps in which an object moves, and its direction of travel from its x axis."""
    rows = np.flatnonzero(np.hypot(velocities[:, 0], velocities[:, 1]) > _MIN_HEADING_M_S)
    headings = np.arctan2(velocities[rows, 1], velocities[rows, 0])
    return rows, np.angle(np.exp(1j * (headings - poses[rows, 3])))


def _median_drift(poses: Floats, velocities: Floats) -> float:
    rows, drifts = _drifts(poses, velocities)
    if not len(rows):
        return 0.0
    mean = float(np.angle(np.exp(1j * drifts).sum()))
    return mean + float(np.median(np.angle(np.exp(1j * (drifts - mean)))))


def _add_headings(banded: _Banded, poses: Floats, velocities: Floats) -> None:
    """Add that moving objects face their direction of travel."""
    weight = 1 / _HEADING_RAD**2
    for index, drift in zip(*_drifts(poses, velocities), strict=True):
        banded.add([4 * int(index) + 3], np.array([[weight]]), np.array([weight * drift]))


def _add_labels(banded: _Banded, poses: Floats, labeled: Floats) -> None:
    weights = 1 / _LABEL_SIGMA**2
    for index, offset in enumerate(labeled - poses):
        banded.add(range(4 * index, 4 * index + 4), np.diag(weights), weights * offset)


def _add_accelerations(banded: _Banded, times_s: Floats, poses: Floats) -> None:
    """Add that accelerations are small."""
    for index in range(1, len(poses) - 1):
        before_s, after_s = np.diff(times_s[index - 1 : index + 2])
        mean_s = (before_s + after_s) / 2
        factors = np.array([1 / before_s, -1 / before_s - 1 / after_s, 1 / after_s]) / mean_s
        acceleration = factors @ poses[index - 1 : index + 2]
        for axis in range(4):
            rows = [4 * (index + step) + axis for step in (-1, 0, 1)]
            weight = 1 / _ACCELERATION[axis] ** 2
            banded.add(
                rows,
                weight * np.outer(factors, factors),
                -weight * factors * acceleration[axis],
            )


def _add_standstills(banded: _Banded, times_s: Floats, poses: Floats, still: Bools) -> None:
    """Add that an object does not move between two sweeps in which it is stationary."""
    for index in np.flatnonzero(still[1:] & still[:-1]).tolist():
        weights = 1 / (_STANDSTILL * (times_s[index + 1] - times_s[index])) ** 2
        offset = weights * (poses[index + 1] - poses[index])
        rows = range(4 * index, 4 * index + 8)
        diagonal = np.diag(weights)
        matrix = np.block([[diagonal, -diagonal], [-diagonal, diagonal]])
        banded.add(rows, matrix, np.concatenate([offset, -offset]))

"""Estimate a sensor's motion from range changes of smooth surfaces.

If the sensor shifts by s, the range of the plane n · x = c in the direction d decreases by n · s /
(n · d).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from .estimates import MIN_RAYS, sandwich
from .smooth_surfaces import FLAT_TANGENT, MAX_KINK_PER_M, SmoothSurfaces, find_surfaces
from .stack import SweepStack, finite_median
from .visibility import Evidence, RigidMotion, count_objects

SWEEP_PAIRS = 8  # number of pairs of sweeps to compare
ARM_M = 10.0  # distance at which rotations are expressed in meters
# Assumed range noise and motion for the weights of rays, in meters.
_ASSUMED_NOISE_M = 0.02
_ASSUMED_SHIFT_M = 0.5
_MIN_EXPLAINED_SHARE = 0.5  # minimum fraction of affected rays that a motion must explain
_MAX_FACE_M = 0.3  # maximum shift for which rays still hit the same faces of cars
_VEHICLE_M = 4.0  # wider than the front of any vehicle
_CALM_FACTOR = 4.0  # changes above this multiple of the median belong to moving objects
_CALM_SIGMAS = 6.0
# Changes of a range that may be noise: the minimum, and the change per meter of range.
_STAYED_M = 0.05
_STAYED_PER_M = 0.01

# Creep.
_CREEP_SWEEPS = 24  # maximum number of sweeps
_CREEP_RAYS = 20_000  # maximum number of rays
_SECTORS = 36  # number of sectors in a revolution; errors within a sector are correlated
_CREEP_SIGMAS = 5.0  # significance threshold for a motion, in standard deviations
# Minimum fraction of a ray's returns that lie within a number of sigmas of their median.
_MIN_NEAR_SHARE = 0.95
_MAX_CREEP_SIGMAS = 10.0
# Limits in standard deviations beyond which rays are ignored, for each iteration.
_TUKEY_LIMITS = (20.0, 10.0, 4.7, 4.7, 4.7)
_PRIOR_M = 1.0  # standard deviation assumed for motions that no ray constrains
_OFFSET = 6  # column for the common offset of all ranges


@dataclass(frozen=True, eq=False)
class RangeChanges:
    """Range changes of smooth surfaces between two sweeps."""

    surfaces: SmoothSurfaces  # surfaces of the first sweep
    # (r, c): rays that return in both sweeps, and hit smooth surfaces in the first sweep at angles
    # of incidence that are not too large
    chosen: Bools
    change: Floats  # (r, c): second range minus first range in meters, corrected for azimuth shifts
    points: Floats  # (r, c, 3): points of the first sweep, meters
    sigma_m: Floats  # (r, c): rough standard deviation of ranges

    @classmethod
    def between(cls, stack: SweepStack, first: int, second: int) -> RangeChanges:
        """Compare the ranges of two sweeps in cells where the first sweep hits smooth surfaces."""
        distance = stack.ranges[first].astype(np.float64)
        # If the sensor moves, range changes between sweeps are not noise, so noise is assumed.
        surfaces = find_surfaces(stack, distance, np.full_like(distance, _ASSUMED_NOISE_M))
        with np.errstate(invalid="ignore"):
            azimuth_change = stack.azimuth_offsets[second] - stack.azimuth_offsets[first]
            change = stack.ranges[second] - distance - surfaces.azimuth_slope * azimuth_change
            is_flat = surfaces.slope < FLAT_TANGENT * distance
            chosen = surfaces.smooth & np.isfinite(change) & is_flat
        points = distance[..., None] * stack.directions
        return cls(surfaces, chosen, change, points, stack.rough_sigma)

    @cached_property
    def design(self) -> Floats:
        """Derivatives of the selected rays' ranges with respect to the motion.

        The array has shape (k, 4). The columns are the shift along x, y and z, and the yaw at
        `ARM_M`. Yaw is expressed in meters so that all unknowns have a similar magnitude.
        """
        yaw = self.surfaces.azimuth_slope[self.chosen] / ARM_M
        return np.column_stack([-self.surfaces.scaled_normal[self.chosen], yaw])

    @cached_property
    def distance(self) -> Floats:
        """Ranges of the selected rays in the first sweep, in meters.

        The array has shape (k,).
        """
        return np.linalg.norm(self.points[self.chosen], axis=1)

    @cached_property
    def normal_error(self) -> Floats:
        """Errors of the surface normals at the selected rays, in radians.

        The array has shape (k,). Normals are computed from points two columns away on either side,
        because adjacent points would yield inaccurate normals.
        """
        step_rad = 2 * np.pi / self.change.shape[1]
        return np.asarray(_ASSUMED_NOISE_M / (np.sqrt(10) * self.distance * step_rad))

    @cached_property
    def noise(self) -> Floats:
        """Assumed noise of the selected rays' range changes, in meters.

        The array has shape (k,).
        """
        noise = _ASSUMED_NOISE_M + MAX_KINK_PER_M * self.distance
        return np.asarray(np.hypot(noise, _ASSUMED_SHIFT_M * self.normal_error))

    def motion(self) -> RigidMotion | None:
        """Fit the sensor motion that explains the range changes, or return None if there is none.

        Return None if the motion does not explain most of the changes that it predicts.
        """
        change = self.change[self.chosen]
        if len(change) < MIN_RAYS:
            return None
        changed = np.abs(change) > 5 * self.noise  # few rays show the motion in a street
        for rays in (slice(None), changed):
            motion = _rigid_motion(self.design[rays], change[rays], self.noise[rays])
            large = self._large(motion)
            if large.sum() < MIN_RAYS:
                continue
            predicted = (self.design @ motion)[large]
            explained = np.abs(change[large] - predicted) < np.abs(predicted) / 2
            if explained.mean() >= _MIN_EXPLAINED_SHARE:
                return RigidMotion(motion[:3], motion[3] / ARM_M)
        return None

    def _large(self, motion: Floats) -> Bools:
        """Mark the selected rays whose range a motion changes by more than the noise."""
        predicted = self.design @ motion
        residual = np.abs(self.change[self.chosen] - predicted)
        scale = 1.4826 * np.median(residual / self.noise)
        shift_m = np.linalg.norm(motion[:3])
        limit = np.hypot(3 * scale * self.noise, 3 * self.normal_error * shift_m)
        return np.asarray(np.abs(predicted) > limit)

    def evidence(self, motion: RigidMotion) -> Evidence:
        """Count the objects that support or contradict a motion.

        A surface wider than a vehicle counts as several objects.
        """
        if len(self.change[self.chosen]) < MIN_RAYS:
            return Evidence(0, 0, 0)
        values = np.append(motion.shift, motion.yaw_rad * ARM_M)
        large = self._large(values)
        predicted = (self.design @ values)[large]
        change = self.change[self.chosen][large]
        points = self.points[self.chosen][large]
        moved = np.abs(change - predicted) < np.abs(predicted) / 2
        stayed = np.abs(change) < np.abs(predicted) / 2
        kinds = [moved, stayed & ~moved, ~moved & ~stayed]
        evidence = count_objects(points, kinds, _VEHICLE_M)
        if np.linalg.norm(motion.shift) > _MAX_FACE_M:
            return evidence._replace(unexplained=0)
        return evidence

    def axes(self) -> tuple[Floats, Floats]:
        """Return the principal axes of the surface normals, and the fraction of each axis.

        Only surfaces whose range has not changed are used. The fraction of an axis is the mean
        square of the normals' components along it. Fractions are in ascending order. A shift along
        an axis with a small fraction changes few of these ranges.
        """
        ranges = np.linalg.norm(self.points, axis=-1)
        with np.errstate(invalid="ignore"):
            limit = np.maximum(_STAYED_M, _CALM_SIGMAS * self.sigma_m) + _STAYED_PER_M * ranges
            stayed = self.surfaces.smooth & (np.abs(self.change) < limit)
        normals = self.surfaces.scaled_normal[stayed]
        if len(normals) < MIN_RAYS:
            return np.eye(3), np.zeros(3)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        shares, axes = np.linalg.eigh(normals.T @ normals / len(normals))
        return axes.T, shares


def range_scatter(stack: SweepStack, lag: int) -> float:
    """Return the typical range change of a smooth surface over `lag` sweeps, in meters.

    For each pair of sweeps, changes due to moving objects are excluded, and the mean of the
    remaining changes is used. A median would be 0 if ranges are rounded more coarsely than their
    noise. The result is the median over all pairs, or 0 if no pair has enough rays.
    """
    scatter = []
    for first in even_indices(stack.sweep_count - lag, SWEEP_PAIRS).tolist():
        changes = RangeChanges.between(stack, first, first + lag)
        sizes = np.abs(changes.change[changes.chosen])
        if len(sizes) >= MIN_RAYS:
            by_noise = _CALM_SIGMAS * np.median(changes.sigma_m[changes.chosen])
            limit = max(_CALM_FACTOR * np.median(sizes), by_noise)
            scatter.append(sizes[sizes <= limit].mean())
    return float(np.median(scatter)) if scatter else 0.0


def _rigid_motion(design: Floats, change: Floats, noise: Floats) -> Floats:
    """Fit a rigid motion to range changes.

    The motion consists of the shift along x, y and z, and the yaw at `ARM_M`, in meters. A row of
    `design` contains the derivatives of a range with respect to the motion, and `noise` is the
    noise of `change` in meters. Components along principal axes of the covariance are set to 0 if
    they are not significant. The fit uses Huber's estimator, which reduces the influence of rays on
    moving objects.
    """
    motion: Floats = np.zeros(4)
    if len(change) < MIN_RAYS:
        return motion
    for _ in range(30):
        residual = np.abs(change - design @ motion) / noise
        weight = np.sqrt(np.minimum(1, 2 / np.maximum(residual, 1e-9))) / noise
        weighted = design * weight[:, None]
        motion = np.asarray(np.linalg.lstsq(weighted, change * weight, rcond=1e-6)[0], np.float64)
    covariance = sandwich(weighted, (change - design @ motion) * weight)
    variance, axes = np.linalg.eigh(covariance)
    components = axes.T @ motion
    significant = np.abs(components) > 5 * np.sqrt(np.maximum(variance, 0)) + 1e-9
    motion = axes @ np.where(significant, components, 0.0)
    return np.asarray(motion)


class Creep(NamedTuple):
    """Steady motion of a sensor during a recording.

    The motion is 0 if noise can explain the range changes.
    """

    shift: Floats  # (3,): meters from sweep to sweep
    rotation: Floats  # (3,): rotation vector from sweep to sweep, radians
    spread_m: float  # standard deviation that the motion causes in the affected ranges
    effect: float  # `spread_m` divided by the standard deviation of the noise


def fit_creep(stack: SweepStack) -> Creep:
    """Fit a steady motion of the sensor to the ranges of all sweeps.

    Each sweep has a small motion relative to the mean of all sweeps. It is fitted with Tukey's
    biweight, which ignores rays on moving objects. The steady motion is the slope of these motions.
    Its error is derived from the noise, and from leaving out each sector of a revolution in turn
    (jackknife), so that a single moving object is not mistaken for a motion of the sensor.
    Similarly, a common offset of all ranges that grows over time is not a motion. It occurs, for
    example, while a sensor warms up.
    """
    rays = _CreepRays.from_stack(stack)
    if len(rays.design) < MIN_RAYS:
        return Creep(np.zeros(3), np.zeros(3), 0.0, 0.0)
    time = rays.numbers - rays.numbers.mean()
    slope = rays.steady_motion(time / (time**2).sum())
    spread = slope.replicates - slope.replicates.mean(axis=0)
    covariance = slope.covariance + (_SECTORS - 1) / _SECTORS * spread.T @ spread
    variance, axes = np.linalg.eigh(covariance[:_OFFSET, :_OFFSET])
    components = axes.T @ slope.values[:_OFFSET]
    significant = np.abs(components) > _CREEP_SIGMAS * np.sqrt(variance)
    motion = axes @ np.where(significant, components, 0.0)
    spread_m = np.abs(rays.design[:, :_OFFSET] @ motion) * time.std()
    # In a street, only a few rays are sensitive to the motion.
    shown = np.argsort(spread_m / rays.sigma)[-MIN_RAYS:]
    effect = float((spread_m / rays.sigma)[shown[0]])
    return Creep(motion[:3], motion[3:] / ARM_M, float(np.median(spread_m[shown])), effect)


class _SweepMotion(NamedTuple):
    """Sensor motion relative to the mean of all sweeps, with an estimate of its errors.

    The seven values correspond to the columns of `_CreepRays.design`.
    """

    values: Floats  # (7,)
    covariance: Floats  # (7, 7): covariance due to noise
    replicates: Floats  # (sectors, 7): motions estimated without the rays of each sector


@dataclass(frozen=True, eq=False)
class _CreepRays:
    """Rays that hit smooth surfaces, selected from the mean of all sweeps."""

    numbers: Ints  # (t,): numbers of the sweeps
    # (k, 7): derivatives of ranges with respect to the shift, the rotation at `ARM_M`, and the
    # offset
    design: Floats
    change: Floats  # (t, k): ranges minus their medians, meters; NaN without a return
    sigma: Floats  # (k,): standard deviation of noise, meters
    sector: Ints  # (k,)

    @classmethod
    def from_stack(cls, stack: SweepStack) -> _CreepRays:
        """Select evenly spaced rays and sweeps."""
        numbers = even_indices(stack.sweep_count, _CREEP_SWEEPS)
        median = finite_median(stack.ranges, 0)
        count = np.isfinite(stack.ranges).sum(axis=0)
        surfaces = find_surfaces(stack, median, stack.rough_sigma / np.sqrt(np.maximum(count, 1)))
        with np.errstate(invalid="ignore"):
            chosen = surfaces.smooth & stack.steady & (surfaces.slope < FLAT_TANGENT * median)
            near = np.abs(stack.ranges - median) < _MAX_CREEP_SIGMAS * stack.rough_sigma
        chosen &= near.sum(axis=0) >= _MIN_NEAR_SHARE * count  # no object passes in front
        cell = np.nonzero(chosen & (count > stack.sweep_count / 2))
        rays = even_indices(len(cell[0]), _CREEP_RAYS)
        row = cell[0][rays]
        column = cell[1][rays]
        directions = stack.directions[row, column]
        normals = surfaces.scaled_normal[row, column]
        # A rotation w changes the direction d by w x d, and the range by w · (d x gradient).
        lever = -np.cross(directions, normals) * median[row, column, None]
        change = stack.ranges[numbers[:, None], row, column].astype(np.float64)
        change -= surfaces.azimuth_slope[row, column] * stack.azimuth_offsets[
            numbers[:, None], row, column
        ].astype(np.float64)
        return cls(
            numbers=numbers,
            design=np.hstack([-normals, lever / ARM_M, np.ones((len(row), 1))]),
            change=change - median[row, column],
            sigma=stack.rough_sigma[row, column],
            sector=column * _SECTORS // stack.ranges.shape[2],
        )

    def steady_motion(self, contrast: Floats) -> _SweepMotion:
        """Combine the motions of all sweeps into a single motion, using `contrast` as weights."""
        motions = [self._sweep_motion(change) for change in self.change]
        return _SweepMotion(
            np.tensordot(contrast, [motion.values for motion in motions], 1),
            np.tensordot(contrast**2, [motion.covariance for motion in motions], 1),
            np.tensordot(contrast, [motion.replicates for motion in motions], 1),
        )

    def _sweep_motion(self, change: Floats) -> _SweepMotion:
        """Fit the sensor motion of a sweep to its range changes."""
        returned = np.isfinite(change)
        design = self.design[returned] / self.sigma[returned, None]
        values = change[returned] / self.sigma[returned]
        prior = np.eye(design.shape[1]) / _PRIOR_M**2
        weight, scale = _tukey_weights(design, values, prior)
        weighted = design * weight[:, None]
        is_in = (self.sector[returned] == np.arange(_SECTORS)[:, None]).astype(np.float64)
        products = (weighted[:, :, None] * design[:, None, :]).reshape(len(design), -1)
        matrices = (is_in @ products).reshape(_SECTORS, *prior.shape)
        sides = is_in @ (weighted * values[:, None])
        inverse = np.linalg.inv(matrices.sum(axis=0) + prior)
        left_out = matrices.sum(axis=0) - matrices + prior
        rest = (sides.sum(axis=0) - sides)[..., None]
        replicates = np.linalg.solve(left_out, rest)[..., 0]
        return _SweepMotion(inverse @ sides.sum(axis=0), scale**2 * inverse, replicates)


def _tukey_weights(design: Floats, values: Floats, prior: Floats) -> tuple[Floats, float]:
    """Return the weights of a robust linear fit and the standard deviation of its residuals.

    The limit beyond which values are ignored decreases during the fit, so that larger motions are
    also found.
    """
    motion = np.zeros(design.shape[1])
    for limit in _TUKEY_LIMITS:
        residual = values - design @ motion
        weight = np.maximum(1 - (residual / limit) ** 2, 0) ** 2
        weighted = design * weight[:, None]
        motion = np.linalg.solve(weighted.T @ design + prior, weighted.T @ values)
    return weight, 1.4826 * float(np.median(np.abs(values - design @ motion)))

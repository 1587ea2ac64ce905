"""Estimates a sensor's performance from what it repeats while it stands; intervals are of 95 %."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.open3d_module import load_open3d
from ..base.sampling import even_indices
from ..sensor.noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS
from .repeats import Rays, Repeats

_Z = 1.959964  # of 95 %
_REJECTED = 1e-6  # chance of a variance above which a ray is left out
_SPAN = 2.0  # least quotient of far and near ranges that tells how noise grows
_TILT = 0.3  # least tangent of incidence of a tenth of the rays that tells noise of directions
_WEAK_RAYS = 30  # rays with partial losses that a threshold needs
_SKY = (5, 15)  # rows and columns of which no ray returns twice, around a ray into the sky
_PLANES, _PLANE_M, _PLANE_RAYS, _PLANE_POINTS = 8, 0.05, 300, 20_000
_NO_SCALE = "it needs the intensity of a white surface, if it is the same at all ranges (--white)"
_NOT_WEAK = "no surface is so weak that it loses half its pulses"
_RING_RAYS = 20  # rays on planes that the bias of a ring needs


class Estimate(NamedTuple):
    """A figure with its interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: Any, variance: Any) -> Estimate:
        """Make one of a normally distributed estimate."""
        half = _Z * float(np.sqrt(variance))
        return cls(float(value), float(value) - half, float(value) + half)

    @classmethod
    def mean(cls, values: Floats) -> Estimate:
        """Make one of the mean of values."""
        return cls.of(values.mean(), values.var() / len(values))

    def mapped(self, function: Callable[[float], Any]) -> Estimate:
        """Return the estimate of a function of the figure, which rises or falls."""
        value, *ends = (float(function(one)) for one in self)
        return Estimate(value, min(ends), max(ends))


def root(value: float) -> float:
    """Square root; 0 of what is negative."""
    return float(np.sqrt(max(value, 0.0)))


class Scatter(NamedTuple):
    """Noise of ranges, as `Noise` has it by range or by energy, and of directions."""

    near: Estimate  # standard deviation at range 0, or of the strongest returns, metres
    growth: Estimate | None  # metres a metre; by energy, metres times energy
    aim: Estimate | None  # radians
    deviance: float
    sigma: Floats  # (k,): of each ray, metres


def fit_performance(
    repeats: Repeats, rays: Rays, energy: Floats | None
) -> tuple[dict[str, Estimate], list[str], Scatter]:
    """Estimate what repeated sweeps tell, with the energies of rays (k,) if they are known.

    Returns figures by the names of `Noise`; in words those that are unknown; and the noise of
    ranges, by range or by energy, whichever is likelier.
    """
    known, unknown, sweeps = dict[str, Estimate](), list[str](), repeats.sweeps
    light = np.nan_to_num(rays.light) if energy is None else energy
    strong, threshold = light >= np.median(light), None
    for _ in range(3):  # the threshold says which rays lose nothing for their energy
        known["dropout"] = loss_share(sweeps - rays.count[strong], sweeps)
        if energy is not None:
            threshold = fit_threshold(energy, rays.count, sweeps, known["dropout"].value)
        if energy is None or threshold is None:
            break
        strong = energy > 2 * threshold.value
    found = fit_scatter(rays)
    if threshold is None:
        unknown.append(f"the detection range: {_NO_SCALE if energy is None else _NOT_WEAK}")
    else:
        known["detection_range_m"] = threshold.mapped(
            lambda one: 10 * np.sqrt(TARGET_REFLECTANCE / one)
        )
        other = fit_scatter(rays, energy)
        if other.growth is not None and other.deviance < found.deviance:
            found = other
            known["range_at_threshold_m"] = other.growth.mapped(lambda one: one / threshold.value)
    known["range_m"] = found.near
    if found.growth is None:
        unknown.append("how noise grows with the range: surfaces are about as far")
    elif "range_at_threshold_m" not in known:
        known["range_per_m"] = found.growth
    if found.aim is not None and found.aim.low > 0:
        known["angle_deg"] = found.aim.mapped(np.degrees)
    else:
        why = f"it is below {np.degrees(found.aim.high):.2g}°" if found.aim else "none is inclined"
        unknown.append(f"noise of directions, which shows on inclined surfaces: {why}")
    if (alarms := alarm_share(repeats)) is None:
        unknown.append("false alarms: no sky, or fewer than three sweeps")
    else:
        known["false_alarms"] = alarms
    return known, unknown, found


def fit_scatter(rays: Rays, energy: Floats | None = None) -> Scatter:
    """Fit noise of ranges and directions to the variances of rays, by their likelihood.

    What they do not tell, for want of ranges, energies or inclined surfaces, is None. Sandwich
    estimators give the intervals, which rays of unequal noise do not narrow.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    spread = rays.distance if energy is None else 1 / energy
    low, unit, high = np.quantile(spread, (0.05, 0.5, 0.95))
    tilted = np.quantile(rays.slope / rays.distance, 0.9) > _TILT
    known = np.array([True, high > _SPAN * low, tilted])
    kept, steep = rays.freedom > 0, np.median(rays.slope)
    usual = np.median(rays.variance[kept])
    power = 1 if energy is None else 2  # of the parameters of ranges; that of directions is squared

    def model(some: Floats) -> Floats:
        theta = np.zeros(3)
        theta[known] = some
        own = theta[0] + theta[1] * (spread / unit) ** power
        return usual * (own ** (2 / power) + theta[2] * (rays.slope / steep) ** 2)

    theta = np.array([1.0, 0.1, 0.1])[known]
    for _ in range(10):
        weight = np.sqrt(np.maximum(rays.freedom, 1) / 2) / model(theta)
        found = least_squares(
            lambda some: ((rays.variance - model(some)) * weight)[kept],  # noqa: B023
            theta, bounds=(0, np.inf), x_scale=np.maximum(theta, 0.01),
        )  # fmt: skip
        theta, expected = found.x, model(found.x)
        ratio = rays.variance / expected * rays.freedom
        kept = (rays.freedom > 0) & (ratio < chi2.isf(_REJECTED, np.maximum(rays.freedom, 1)))
    inverse, score = np.linalg.pinv(found.jac.T @ found.jac), found.jac * found.fun[:, None]
    spreads = np.diag(inverse @ (score.T @ score) @ inverse)
    of: list[Estimate | None] = [None] * 3
    units = (root(usual), root(usual) / unit, root(usual) / steep)
    for k, value, variance in zip(np.flatnonzero(known), theta, spreads, strict=True):
        squared = k == 2 or power == 2
        one = Estimate.of(value, variance).mapped(root if squared else lambda x: max(x, 0.0))
        of[k] = one.mapped(lambda x, unit=units[k]: x * unit)
    deviance = (rays.freedom * (np.log(expected) + rays.variance / expected))[rays.freedom > 0]
    near, growth, aim = of
    assert near is not None
    return Scatter(near, growth, aim, float(deviance.sum()), np.sqrt(expected))


def loss_share(lost: Ints, sweeps: int) -> Estimate:
    """Share of the pulses of rays, each of which loses so many of its `sweeps`, (k,)."""
    if not lost.any():
        return Estimate(0.0, 0.0, 3 / (len(lost) * sweeps))  # the rule of three
    return Estimate.mean(lost / sweeps).mapped(lambda one: max(one, 0.0))


def fit_threshold(energy: Floats, count: Ints, sweeps: int, dropout: float) -> Estimate | None:
    """Energy of which half of the pulses return, by the curve of `Noise.detected`.

    A ray is there only if a pulse returned: the likelihood is that of a truncated binomial
    distribution. None if too few rays lose some of their pulses.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import ndtr

    def share(log_threshold: float) -> Floats:
        seen = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * seen, 1e-9, 1 - 1e-9)

    def unlikely(log_threshold: float) -> float:
        p = share(log_threshold)
        some = np.log1p(-((1 - p) ** sweeps))
        return -float((count * np.log(p) + (sweeps - count) * np.log1p(-p) - some).sum())

    low, high = np.log(np.quantile(energy, (0.001, 0.999)))
    grid = np.linspace(low - 2, high, 60)
    best = int(np.argmin([unlikely(one) for one in grid]))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, 59)]
    found = minimize_scalar(unlikely, bounds=ends, method="bounded", options={"xatol": 1e-7}).x
    p, step = share(found), 1e-3
    if (p < 0.9 * (1 - dropout)).sum() < _WEAK_RAYS:
        return None
    # The score of each ray, whose counts have this mean; rays of unequal loss widen the interval.
    slope = (share(found + step) - share(found - step)) / (2 * step) / (p * (1 - p))
    mean = sweeps * p / (1 - (1 - p) ** sweeps)
    information = (slope**2 * (mean * (1 - p + sweeps * p) - mean**2)).sum()
    score = (slope**2 * (count - mean) ** 2).sum()
    return Estimate.of(found, max(score, information) / information**2).mapped(np.exp)


def alarm_share(repeats: Repeats) -> Estimate | None:
    """Share of pulses into the sky that return; None without sky, or with two sweeps.

    A pulse is one into the sky if no other of its ray returns, and no ray beside it repeats.
    """
    from scipy.ndimage import maximum_filter
    from scipy.stats import binomtest

    count = np.isfinite(repeats.ranges).sum(axis=0)
    # Weak surfaces, which return seldom, are beside those that return more often.
    sky = maximum_filter(count, size=_SKY, mode=("nearest", "wrap")) <= 1
    alarms = int((count[sky] == 1).sum())
    trials = repeats.sweeps * int((count[sky] == 0).sum()) + alarms
    if not trials or repeats.sweeps < 3:
        return None
    found = binomtest(alarms, trials).proportion_ci(method="exact")
    return Estimate(alarms / trials, float(found.low), float(found.high))


def channel_bias(rays: Rays, directions: Floats, blur: Floats) -> dict[int, Estimate]:
    """By how much the ranges of each row differ from those of all, on large planes: {row: metres}.

    Planes u · x = 1 and offsets b are fitted at once: 1 / r = u · d − b / r², times r². Ranges have
    standard deviations `blur` (k,), metres.
    """
    some = even_indices(len(rays), _PLANE_POINTS)
    plane = _planes(rays.distance[some, None] * directions[some])
    some, plane = some[plane >= 0], plane[plane >= 0]
    rows, place, many = np.unique(rays.row[some], return_inverse=True, return_counts=True)
    distance, way, blur = rays.distance[some], directions[some], blur[some]
    enough = many >= _RING_RAYS
    if enough.sum() < 3:
        return {}
    first, numbers = 3 * (plane.max() + 1), np.arange(len(some))
    design = np.zeros((len(some), first + len(rows)))
    for axis in range(3):
        design[numbers, 3 * plane + axis] = way[:, axis] * distance**2 / blur
    design[numbers, first + place] = -1 / blur
    off = np.zeros(len(some))
    for _ in range(4):
        kept = np.abs(off) <= 4 * 1.4826 * np.median(np.abs(off))
        used = design[kept]
        solved = np.linalg.lstsq(used, (distance / blur)[kept], rcond=None)[0]
        off = distance / blur - design @ solved
    inverse, score = np.linalg.pinv(used.T @ used, hermitian=True), used * off[kept][:, None]
    covariance = inverse @ (score.T @ score) @ inverse
    # One offset of all is nearly the same as other planes: the mean of the rings is 0.
    centred = np.eye(len(rows)) - enough / enough.sum()
    bias = centred @ solved[first:]
    spread = np.diag(centred @ covariance[first:, first:] @ centred.T)
    return {
        row: Estimate.of(*one)
        for row, *one, good in zip(rows.tolist(), bias, spread, enough, strict=True)
        if good
    }


def _planes(points: Floats) -> Ints:
    """Number of the large plane that each point (n, 3) lies in, -1 for none."""
    o3d = load_open3d()
    o3d.utility.random.seed(0)
    number, left = np.full(len(points), -1), np.arange(len(points))
    for plane in range(_PLANES):
        if len(left) < _PLANE_RAYS:
            break
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[left]))
        (*normal, off), _ = cloud.segment_plane(_PLANE_M, 3, 400)
        inside = np.abs(points[left] @ normal + off) < _PLANE_M  # of the plane of all inliers
        if inside.sum() < _PLANE_RAYS:
            break
        number[left[inside]] = plane
        left = left[~inside]
    return number

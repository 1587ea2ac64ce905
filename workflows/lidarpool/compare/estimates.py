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
_SPAN, _TILT = 2.0, 0.3  # least quotient of ranges, and tangent of incidence, that tell noise
_WEAK_RAYS, _RING_RAYS = 30, 20  # rays with losses that a threshold needs; that of a ring's bias
_SKY = (7, 31)  # rows and columns of which no ray returns twice, around a ray into the sky
_PLANES, _PLANE_M, _PLANE_RAYS, _PLANE_POINTS = 8, 0.05, 300, 20_000
_STEP = 1e-3  # of logarithms, for derivatives


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
    def mean(cls, values: Floats, power: float = 1.0) -> Estimate:
        """Make one of a power of the mean of values; a root of what is below 0 is 0."""
        made = cls.of(values.mean(), values.var() / len(values))
        return made if power == 1 else made.mapped(lambda x: max(x, 0.0) ** power)

    def mapped(self, function: Callable[[float], Any]) -> Estimate:
        """Return the estimate of a function of the figure, which rises or falls."""
        value, *ends = (float(function(one)) for one in self)
        return Estimate(value, min(ends), max(ends))


class RangeScatter(NamedTuple):
    """Noise of ranges, as `Noise` has it by range or by energy, and of directions."""

    near: Estimate  # standard deviation at range 0, or of the strongest returns, metres
    growth: Estimate | None  # metres a metre; by energy, metres times energy
    aim: Estimate | None  # radians
    deviance: float
    sigma: Floats  # (k,): of each ray, metres


def fit_performance(
    repeats: Repeats, rays: Rays, energy: Floats | None
) -> tuple[dict[str, Estimate | None], RangeScatter]:
    """Estimate what repeated sweeps tell, with the energies of rays (k,) if they are known.

    Returns figures by the names of `Noise`, None if unknown; and the noise of ranges, by range or
    by energy, whichever is likelier.
    """
    sweeps, light = len(repeats.ranges), np.nan_to_num(rays.light) if energy is None else energy
    strong, threshold = light >= np.median(light), None
    for _ in range(1 if energy is None else 3):  # the threshold tells what loses nothing by energy
        dropout = Estimate.mean(1 - rays.returns[strong] / sweeps)
        if energy is not None:
            threshold = fit_threshold(energy, rays.returns, sweeps, dropout.value)
            strong = energy > 2 * threshold.value if threshold else strong
    found, weak = fit_scatter(rays), None
    if threshold is not None:
        other = fit_scatter(rays, energy)
        if other.growth is not None and other.deviance < found.deviance:
            found, weak = other, other.growth.mapped(lambda one: one / threshold.value)
    return {
        "range_m": found.near,
        "range_per_m": None if weak else found.growth,
        "range_at_threshold_m": weak,
        "angle_deg": found.aim and found.aim.mapped(np.degrees),
        "detection_range_m": threshold
        and threshold.mapped(lambda one: 10 * np.sqrt(TARGET_REFLECTANCE / one)),
        "false_alarms": alarm_share(repeats),
        "dropout": dropout,
    }, found


def fit_scatter(rays: Rays, energy: Floats | None = None) -> RangeScatter:
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
    power, usual = 1 if energy is None else 2, max(float(np.median(rays.variance[kept])), 1e-12)

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
    spreads = np.diag(_sandwich(found.jac, found.fun))
    of: list[Any] = [None] * 3
    for k, *one in zip(np.flatnonzero(known), theta, spreads, strict=True):
        root = 0.5 if k == 2 else 1 / power
        scale = float(np.sqrt(usual)) / (1.0, unit, steep)[k]
        of[k] = Estimate(*(scale * max(x, 0.0) ** root for x in Estimate.of(*one)))
    likelihood = rays.freedom * (np.log(expected) + rays.variance / expected)
    near, growth, aim = of
    deviance = float(likelihood[rays.freedom > 0].sum())
    return RangeScatter(near, growth, aim, deviance, np.sqrt(expected))


def _sandwich(design: Floats, off: Floats) -> Floats:
    """Estimate the covariance of a least-squares fit whose residuals are of unequal size."""
    inverse, score = np.linalg.pinv(design.T @ design, hermitian=True), design * off[:, None]
    covariance: Floats = inverse @ (score.T @ score) @ inverse
    return covariance


def fit_threshold(energy: Floats, count: Ints, sweeps: int, dropout: float) -> Estimate | None:
    """Energy of which half of the pulses return, by the curve of `Noise.detected`.

    A ray is there only if a pulse returned: the likelihood is that of a truncated binomial
    distribution. None if too few rays lose some of their pulses.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import ndtr

    def seen(log_threshold: float) -> Floats:
        share = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * share, 1e-9, 1 - 1e-9)

    def unlikely(log_threshold: float) -> Floats:
        p: Floats = seen(log_threshold)
        there: Floats = np.log1p(-((1 - p) ** sweeps))
        return there - count * np.log(p) - (sweeps - count) * np.log1p(-p)

    low, high = np.log(np.quantile(energy, (0.001, 0.999)))
    grid = np.linspace(low - 2, high, 60)
    best = int(np.argmin([unlikely(one).sum() for one in grid]))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, 59)]
    found = minimize_scalar(lambda one: unlikely(one).sum(), bounds=ends, method="bounded").x
    if (seen(found) < 0.9 * (1 - dropout)).sum() < _WEAK_RAYS:
        return None
    before, at, after = (unlikely(found + by) for by in (-_STEP, 0, _STEP))
    information = (after - 2 * at + before).sum() / _STEP**2
    score = (((after - before) / (2 * _STEP)) ** 2).sum()
    return Estimate.of(found, score / information**2).mapped(np.exp)


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
    trials = len(repeats.ranges) * int((count[sky] == 0).sum()) + alarms
    if not trials or len(repeats.ranges) < 3:
        return None
    found = binomtest(alarms, trials).proportion_ci(method="exact")
    return Estimate(alarms / trials, float(found.low), float(found.high))


def channel_bias(rays: Rays, directions: Floats, blur: Floats) -> dict[int, Estimate]:
    """By how much the ranges of each row differ from those of all, on large planes: {row: metres}.

    Planes u · x = 1 and offsets b are fitted at once: 1 / r = u · d − b / r², times r². Ranges have
    standard deviations `blur` (k,), metres.
    """
    some = even_indices(len(rays.row), _PLANE_POINTS)
    plane = _planes(rays.distance[some, None] * directions[some])
    many = np.bincount(rays.row[some[plane >= 0]], minlength=rays.row.max() + 1)[rays.row[some]]
    some, plane = (one[(plane >= 0) & (many >= _RING_RAYS)] for one in (some, plane))
    rows, place = np.unique(rays.row[some], return_inverse=True)
    distance, way, blur = rays.distance[some], directions[some], blur[some]
    if len(rows) < 3:
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
    covariance = _sandwich(used, off[kept])
    # One offset of all is nearly the same as other planes: the mean of the rings is 0.
    centred = np.eye(len(rows)) - 1 / len(rows)
    bias = centred @ solved[first:]
    spread = np.diag(centred @ covariance[first:, first:] @ centred.T)
    return {row: Estimate.of(*one) for row, *one in zip(rows.tolist(), bias, spread, strict=True)}


def _planes(points: Floats) -> Ints:
    """Tell the number of the large plane that each point (n, 3) lies in; -1 for none."""
    o3d = load_open3d()
    o3d.utility.random.seed(0)
    number, left, plane = np.full(len(points), -1), np.arange(len(points)), 0
    while len(left) >= _PLANE_RAYS and plane < _PLANES:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[left]))
        (*normal, off), _ = cloud.segment_plane(_PLANE_M, 3, 400)
        inside = np.abs(points[left] @ normal + off) < _PLANE_M  # of the plane of all inliers
        if inside.sum() < _PLANE_RAYS:
            break
        number[left[inside]], left, plane = plane, left[~inside], plane + 1
    return number

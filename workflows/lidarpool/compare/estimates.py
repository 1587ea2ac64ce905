"""What the sweeps of a standing sensor tell of its performance; intervals are of 95 %."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Ints
from ..base.errors import LidarpoolError, prefixed
from ..base.open3d_module import load_open3d
from ..base.sampling import even_indices
from ..base.words import plural
from ..sensor.noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS
from .range_image import range_images
from .recordings import Recording

MOST_VALUES = 1 << 24  # returns in memory; of more sweeps than these make, some are read
_WHOLE = 0.8  # a sweep with fewer points than this share of the median is cut
_STILL_M = 0.1  # a median change of ranges, from sweep to sweep, of a sensor that moves
_KINK_M, _KINK = 0.01, 0.001  # by how much a surface may leave its plane within four columns
_SIGMAS = 6.0  # a return beyond these is of something that moves
_STEEPEST = 5.7  # tangent of incidence: beyond, a beam meets several surfaces
_BESIDE_M = 0.3  # how far a recorded surface may be from the scene's
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
        return cls(*(float(value + sigmas * np.sqrt(variance)) for sigmas in (0, -_Z, _Z)))

    @classmethod
    def mean(cls, values: Floats) -> Estimate:
        """Make one of the mean of values (n,)."""
        return cls.of(values.mean(), values.var() / len(values))

    def power(self, exponent: float, scale: float = 1.0) -> Estimate:
        """Return the estimate of a power, times a scale; what is below 0 counts as 0."""
        value, *ends = (float(scale * max(one, 0.0) ** exponent) for one in self)
        return Estimate(value, min(ends), max(ends))


@dataclass(frozen=True, eq=False)
class Repeats:
    """Returns in the same cells of a sensor, the highest ring first; NaN without a return."""

    rings: Ints  # (r,): numbers
    elevation_deg: Floats  # (r,)
    directions: Floats  # (r, c, 3): unit vectors
    ranges: Floats32  # (s, r, c): metres
    light: Floats32  # (s, r, c): intensities
    aside: Floats32  # (s, r, c): azimuths beside those of the directions, radians
    sigma: Floats  # (r, c): rough scatter of ranges from sweep to sweep, as its ring has it, metres
    sweeps: int  # that are whole
    moves: bool  # whether the sensor does, or most around it: only the first sweep is here
    notes: tuple[str, ...]

    @classmethod
    def read(cls, recording: Recording) -> Repeats:
        """Put the sweeps of a recording into the same cells, one after the other.

        LidarpoolError if it has no sweeps with points and rings, or they are of several sensors.
        """
        name, notes = recording.name, list(recording.notes)
        if recording.whole or not recording.count:
            raise LidarpoolError(f"{name} has no sweeps: give a recording of sweeps.")
        own = max((recording.turn(k) for k in range(min(3, recording.count))), key=len)
        if not len(own):
            raise LidarpoolError(f"{name} has no points: there is nothing to fit.")
        with prefixed(name):
            cells = range_images(own, own, ("the first", "the first"))
        shape = len(cells.rings), round(360 / cells.step_deg)
        numbers = even_indices(recording.count, max(MOST_VALUES // (shape[0] * shape[1]), 2))
        if len(numbers) < recording.count:
            notes.append(f"{len(numbers):,} of {recording.count:,} sweeps are used, evenly chosen")
        values = np.full((3, len(numbers), *shape), np.nan, np.float32)
        for k, number in enumerate(numbers.tolist()):
            if not len(turn := recording.turn(number)):
                continue
            with prefixed(name):
                names = f"sweep {number}", "an earlier one"
                found = range_images(turn, own, names, cells.step_deg)
                other = len(found.rings) > 1.2 * len(cells.rings)
                if other or found.hidden[0] > cells.hidden[0] + 0.25:
                    raise LidarpoolError(f"sweep {number} is of another sensor, or another mode.")
            _, rows, there = np.intersect1d(found.rings, cells.rings, return_indices=True)
            columns = round(found.begin_deg / found.step_deg) + np.arange(found.images.shape[-1])
            values[:, k, there[:, None], columns % shape[1]] = found.images[0][:, rows]
        counts = np.isfinite(values[0]).sum(axis=(1, 2))
        whole = counts >= _WHOLE * np.median(counts[counts > 0])
        if not whole.all():
            notes.append(f"{plural(int((~whole).sum()), 'sweep')} cut short, left out")
        values = values[:, whole]
        # Ranges change by noise from sweep to sweep; or on and on, if the sensor moves.
        step = _median(np.abs(np.diff(values[0], axis=0)), (0, 1, 2))
        drift = _median(np.abs(values[0, -1] - values[0, 0]), (0, 1))
        usual = min(0.6 + 0.4 * (whole.sum() - 1), 3) * step + 0.001
        if moves := bool(step > _STILL_M or drift > usual):
            values = values[:, :1]
        first = np.radians(cells.step_deg * np.arange(shape[1]))
        aside = (np.radians(values[2]) - first + np.pi) % (2 * np.pi) - np.pi
        mean = np.nansum(aside, axis=0) / np.maximum(np.isfinite(aside).sum(axis=0), 1)
        up, turned = np.radians(cells.elevation_deg)[:, None], first + mean
        level = np.cos(up) * np.cos(turned), np.cos(up) * np.sin(turned)
        sigma = _median(np.abs(np.diff(values[0], axis=0)), (0, 2)) / (0.6745 * np.sqrt(2))
        sigma = np.where(np.isnan(sigma), _KINK_M, np.maximum(sigma, 1e-4))
        return cls(
            cells.rings, cells.elevation_deg, np.stack([*level, np.sin(up) + 0 * mean], axis=-1),
            *values[:2], aside - mean, np.repeat(sigma[:, None], shape[1], axis=1),
            int(whole.sum()), moves, tuple(notes),
        )  # fmt: skip


def _median(values: Floats32, axis: int | tuple[int, ...]) -> Any:
    """Return medians over what is there, float64; of nothing NaN."""
    with warnings.catch_warnings(action="ignore"):
        return np.nanmedian(values, axis=axis).astype(np.float64)


def surfaces(repeats: Repeats, distance: Floats, blur: Floats) -> tuple[Floats, Floats, Bools]:
    """Find slopes and edges of a range image (r, c), whose ranges have errors of `blur` metres.

    Returns by how much the range changes with the azimuth, and with the direction where it changes
    most, metres in a radian; and whether the neighbours lie in one plane with it. (r, c) each.
    """
    ways, rows = repeats.directions, np.arange(len(distance))
    points = distance[..., None] * ways
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead, back, far, rear = (np.roll(points, by, axis=1) for by in (-1, 1, -2, 2))
        above, below = (points[np.clip(rows + by, 0, rows[-1])] for by in (-1, 1))
        rise = above - below if len(rows) > 2 else np.array([0, 0, 1.0])
        normal = np.cross(2 * (far - rear) + ahead - back, rise)
        # The range of a plane n · x = c in the direction d is c / (n · d).
        normal /= (normal * ways).sum(axis=-1, keepdims=True)
        change = distance[..., None] * (ways - normal)
        slope = np.linalg.norm(change, axis=-1)
        allowed = _KINK_M + _KINK * distance + 5 * blur
        smooth = slope < _STEEPEST * distance
        smooth &= np.abs((((ahead + back) / 2 - points) * normal).sum(axis=-1)) < allowed
        for beside in ((far + rear) / 2, above, below):
            smooth &= np.abs(((beside - points) * normal).sum(axis=-1)) < 2 * allowed
    return change[..., 1] * ways[..., 0] - change[..., 0] * ways[..., 1], slope, smooth


class Rays(NamedTuple):
    """Rays that meet smooth surfaces, (k,) each."""

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, metres
    slope: Floats  # by how much the range changes with the direction, metres in a radian
    light: Floats  # mean intensity; NaN if unknown
    returns: Ints  # sweeps with one
    variance: Floats  # of the range over the sweeps, square metres
    freedom: Ints  # returns of which it is, less one


def smooth_rays(
    repeats: Repeats, sigma: Floats, aim: float, expected: Floats | None = None
) -> Rays:
    """Choose rays without edges beside them, with the scatter of their ranges over the sweeps.

    Returns that noise of `sigma` (r, c) and directions that scatter by `aim` radians do not
    explain are left out, and rays with many of them. Slopes are those of a scene's ranges
    `expected` (r, c), if they are known.
    """
    middle, there = _median(repeats.ranges, 0), np.isfinite(repeats.ranges).sum(axis=0)
    blur = repeats.sigma / np.sqrt(np.maximum(there, 1))
    turn, slope, smooth = surfaces(repeats, middle, blur)
    if expected is not None:
        _, slope, _ = surfaces(repeats, expected, 0 * blur)
        smooth &= np.abs(middle - expected) < _BESIDE_M
    row, column = cell = np.nonzero(smooth)
    images = repeats.ranges, repeats.light, repeats.aside
    ranges, light, aside = (one[:, row, column].astype(np.float64) for one in images)
    ranges -= turn[cell] * aside
    slope, returns = slope[cell], there[cell]
    limit = np.where(returns > 1, _SIGMAS * np.hypot(sigma[cell], aim * slope), np.inf)
    kept = np.abs(ranges - middle[cell]) <= limit
    used = kept.sum(axis=0)
    mean, bright = (
        np.where(kept, one, 0).sum(axis=0) / np.maximum(used, 1) for one in (ranges, light)
    )
    variance = np.where(kept, (ranges - mean) ** 2, 0).sum(axis=0) / np.maximum(used - 1, 1)
    some = np.flatnonzero((used > 0) & (used >= _WHOLE * returns))
    rays = row, column, mean, slope, bright, returns, variance, used - 1
    return Rays._make(one[some] for one in rays)


def fit_performance(
    repeats: Repeats, rays: Rays, energy: Floats | None
) -> tuple[dict[str, Estimate], Floats]:
    """Estimate what repeated sweeps tell, with the energies of rays (k,) if they are known.

    Returns what is known by the names of `Noise`; and the standard deviations of rays (k,), metres,
    by range or by energy, whichever is likelier.
    """
    sweeps, light = len(repeats.ranges), np.nan_to_num(rays.light) if energy is None else energy
    strong, threshold = light >= np.median(light), None
    for _ in range(3):  # the threshold tells what loses nothing by energy
        dropout = Estimate.mean(1 - rays.returns[strong] / sweeps)
        if energy is not None:
            threshold = fit_threshold(energy, rays.returns, sweeps, dropout.value)
            strong = energy > 2 * threshold.value if threshold else strong
    figures, sigma, deviance = fit_scatter(rays, "range_per_m", rays.distance, 1)
    if threshold:
        other = fit_scatter(rays, "range_at_threshold_m", threshold.value / energy, 2)
        if "range_at_threshold_m" in other[0] and other[2] < deviance:
            figures, sigma, _ = other
        figures["detection_range_m"] = threshold.power(-0.5, 10 * np.sqrt(TARGET_REFLECTANCE))
    if alarms := alarm_share(repeats):
        figures["false_alarms"] = alarms
    return figures | {"dropout": dropout}, sigma


def fit_scatter(
    rays: Rays, growth: str, spread: Floats, power: int
) -> tuple[dict[str, Estimate], Floats, float]:
    """Fit noise of ranges and directions to the variances of rays, by their likelihood.

    Noise of ranges grows with a power of `spread` (k,). What rays do not tell, for want of spreads
    or inclined surfaces, is left out. Sandwich estimators give the intervals, which rays of unequal
    noise do not narrow. Returns figures, noise of ranges (k,) in metres, and the deviance.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    low, unit, high = np.quantile(spread, (0.05, 0.5, 0.95))
    tilted = np.quantile(rays.slope / rays.distance, 0.9) > _TILT
    known = np.array([True, high > _SPAN * low, tilted])
    kept, steep = rays.freedom > 0, np.median(rays.slope)
    usual = max(float(np.median(rays.variance[kept])), 1e-12)

    def model(some: Floats) -> Floats:
        theta = np.zeros(3)
        theta[known] = some
        own = theta[0] + theta[1] * (spread / unit) ** power
        return usual * (own ** (2 / power) + theta[2] * (rays.slope / steep) ** 2)

    theta = np.array([1.0, 0.1, 0.1])[known]
    for _ in range(10):
        weight = np.sqrt(rays.freedom / 2) / model(theta)
        found = least_squares(
            lambda some: ((rays.variance - model(some)) * weight)[kept],  # noqa: B023
            theta, bounds=(0, np.inf), x_scale=np.maximum(theta, 0.01),
        )  # fmt: skip
        theta, expected = found.x, model(found.x)
        kept = rays.freedom * rays.variance / expected < chi2.isf(_REJECTED, rays.freedom)
    names, roots = ("range_m", growth, "angle_deg"), (1 / power, 1 / power, 0.5)
    scales = np.sqrt(usual) / np.array([1, unit, np.radians(steep)])
    spreads, figures = np.diag(_sandwich(found.jac, found.fun)), {}
    for k, *one in zip(np.flatnonzero(known), theta, spreads, strict=True):
        figures[names[k]] = Estimate.of(*one).power(roots[k], scales[k])
    deviance = rays.freedom @ (np.log(expected) + rays.variance / expected)
    return figures, np.sqrt(expected), float(deviance)


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
    from scipy.optimize import brute
    from scipy.special import ndtr

    def seen(log_threshold: Any) -> Floats:
        share = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * share, 1e-9, 1 - 1e-9)

    def unlikely(log_threshold: Any) -> Floats:
        p: Floats = seen(log_threshold)
        there: Floats = np.log1p(-((1 - p) ** sweeps))
        return there - count * np.log(p) - (sweeps - count) * np.log1p(-p)

    low, high = np.log(np.quantile(energy, (0.001, 0.999)))
    (found,) = brute(lambda one: unlikely(one).sum(), [(low - 2, high)], Ns=60)
    if (seen(found) < 0.9 * (1 - dropout)).sum() < _WEAK_RAYS:
        return None
    before, at, after = (unlikely(found + by) for by in (-_STEP, 0, _STEP))
    information = (after - 2 * at + before).sum() / _STEP**2
    score = (((after - before) / (2 * _STEP)) ** 2).sum()
    return Estimate(*np.exp(Estimate.of(found, score / information**2)).tolist())


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
    return Estimate(alarms / trials, *map(float, binomtest(alarms, trials).proportion_ci()))


def ring_bias(rays: Rays, directions: Floats, blur: Floats) -> dict[int, Estimate]:
    """By how much the ranges of each row differ from those of all, on large planes: {row: metres}.

    Planes u · x = 1 and offsets b are fitted at once: 1 / r = u · d − b / r², times r². Ranges have
    standard deviations `blur` (k,), metres.
    """
    some = even_indices(len(rays.row), _PLANE_POINTS)
    plane = _planes(rays.distance[some, None] * directions[some])
    many = np.bincount(rays.row[some[plane >= 0]], minlength=rays.row.max() + 1)[rays.row[some]]
    some, plane = (one[(plane >= 0) & (many >= _RING_RAYS)] for one in (some, plane))
    rows, place = np.unique(rays.row[some], return_inverse=True)
    if len(rows) < 3:
        return {}
    distance = rays.distance[some] / blur[some]
    planes = np.eye(plane.max() + 1)[plane][:, :, None] * directions[some][:, None]
    planes = planes.reshape(len(some), -1) * rays.distance[some, None] ** 2
    design = np.hstack([planes, -np.eye(len(rows))[place]]) / blur[some, None]
    off = np.zeros(len(some))
    for _ in range(4):
        kept = np.abs(off) <= 4 * 1.4826 * np.median(np.abs(off))
        solved = np.linalg.lstsq(design[kept], distance[kept], rcond=None)[0]
        off, used = distance - design @ solved, design[kept]
    # One offset of all is nearly the same as other planes: the mean of the rings is 0.
    centred = np.hstack([np.zeros((len(rows), planes.shape[1])), np.eye(len(rows)) - 1 / len(rows)])
    spread = np.diag(centred @ _sandwich(used, off[kept]) @ centred.T)
    found = zip(rows.tolist(), centred @ solved, spread, strict=True)
    return {row: Estimate.of(*one) for row, *one in found}


def _planes(points: Floats) -> Ints:
    """Tell the number of the large plane that each point (n, 3) lies in; -1 for none."""
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
        number[left[inside]], left = plane, left[~inside]
    return number

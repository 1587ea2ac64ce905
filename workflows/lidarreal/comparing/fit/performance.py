"""Estimate noise, lost pulses and false alarms from the statistics of rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.sensor.noise import TARGET_REFLECTANCE, THRESHOLD_SIGMAS

from .estimates import MIN_RAYS, Estimate, sandwich
from .smooth_surfaces import MIN_RETURN_SHARE, SmoothRays
from .stack import SweepStack

# Rays are excluded if the probability of a larger variance is below these limits. The first limit
# excludes only outliers, the second the upper tail.
_OUTLIER_CHANCE = 1e-4
_TAIL_CHANCE = 0.1
# Number of rings in a patch of rays, and number of patches in a revolution.
_PATCH_ROWS = 4
_PATCHES = 36
_FRONTAL_TANGENT = 1.0  # tangent of incidence below which direction noise is negligible
_MIN_FRONTAL_RAYS = 100
_MIN_FRONTAL_SHARE = 0.05
# Maximum half width of a noise parameter's interval, relative to its value.
_MAX_HALF_INTERVAL = 0.75
_VARIANCE_ERROR = 0.03  # relative error of the variances of steep or distant rays
_MAX_VARIANCE_RATIO = 3.0  # larger ratios of variance and expected variance are clipped
# Minimum ratio of ranges, and minimum tangent of incidence, to determine how noise depends on them.
_MIN_RANGE_RATIO = 2.0
_MIN_TILT_TANGENT = 0.3

# Lost pulses and false alarms.
_MIN_WEAK_RAYS = 30  # minimum number of rays with losses to estimate a threshold
_LOG_STEP = 1e-3  # step of logarithms, for derivatives
# Around a ray into the sky, no ray within this number of rings and degrees of azimuth returns
# twice. Smaller gaps between leaves do not count as sky, because leaves may return once.
_SKY_RINGS = 7
_SKY_DEG = 36.0
# Minimum number of pulses into the sky to estimate the share of false alarms.
_MIN_SKY_PULSES = 1000


def has_frontal_rays(rays: SmoothRays) -> bool:
    """Return True if enough rays hit surfaces frontally to separate range and direction noise."""
    frontal = (rays.slope < _FRONTAL_TANGENT * rays.distance).sum()
    return bool(frontal >= max(_MIN_FRONTAL_RAYS, _MIN_FRONTAL_SHARE * len(rays.row)))


def fit_performance(
    rays: SmoothRays, energy: Floats | None, *, all_known: bool = False
) -> tuple[dict[str, Estimate], Floats]:
    """Estimate a sensor's noise and pulse losses from its rays.

    `energy` is the energy of each ray's returns, or None if unknown. If `all_known` is true, rays
    without any return are also known, because a scene is available.

    Returns
    -------
    estimates
        {field of `Noise`: estimate}. The fields are `range_m`, `angle_deg`, either `range_per_m` or
        `range_at_threshold_m` (whichever is more likely), `detection_range_m` and `dropout`. Fields
        that the rays do not determine are omitted.
    sigma
        Standard deviation of each ray's range in meters, from the more likely of the two models.
        Shape (k,).
    """
    threshold, dropout = _fit_detection(rays, energy, all_known)
    scatter = fit_scatter(rays, "range_per_m", rays.distance, 1)
    if energy is not None and threshold is not None:
        by_energy = fit_scatter(rays, "range_at_threshold_m", threshold.value / energy, 2)
        if "range_at_threshold_m" in by_energy.estimates and by_energy.deviance < scatter.deviance:
            scatter = by_energy
    figures = {}
    if has_frontal_rays(rays):
        figures = {
            name: estimate
            for name, estimate in scatter.estimates.items()
            if estimate.is_within(_MAX_HALF_INTERVAL)
        }
    if threshold is not None:
        figures["detection_range_m"] = threshold.power(-0.5, 10 * np.sqrt(TARGET_REFLECTANCE))
    if dropout is not None:
        figures["dropout"] = dropout
    return figures, scatter.sigma


def _fit_detection(
    rays: SmoothRays, energy: Floats | None, all_known: bool
) -> tuple[Estimate | None, Estimate | None]:
    """Estimate the energy at which half of the pulses return, and the loss rate at high energies.

    Values that cannot be determined are None. `energy` is None if it is unknown.
    """
    light = np.nan_to_num(rays.intensity) if energy is None else energy
    strong = light >= np.median(light)
    threshold = None
    dropout = lost_share(rays, strong, all_known=all_known)
    for _ in range(3):
        if energy is None:
            break
        lost = dropout.value if dropout else 0.0
        threshold = fit_threshold(energy, rays, lost, all_known=all_known)
        if threshold is None:
            break
        strong = energy > 2 * threshold.value  # none of these pulses is lost due to low energy
        dropout = lost_share(rays, strong, all_known=all_known) or dropout
    return threshold, dropout


def lost_share(rays: SmoothRays, chosen: Bools, *, all_known: bool = False) -> Estimate | None:
    """Estimate the fraction of pulses lost on the selected rays, or None if there are too few rays.

    Unless `all_known` is true, rays without any return are missing, so the remaining rays lose
    fewer pulses than average. To correct for this, the fraction is computed for each return from
    the other `trials - 1` pulses of its ray. The mean of (trials - returns) / (trials - 1) over all
    returns is unbiased.
    """
    min_trials = 1 if all_known else 2
    chosen = chosen & (rays.trials >= min_trials)
    if chosen.sum() < MIN_RAYS:
        return None
    return_counts = rays.return_counts[chosen]
    trials = rays.trials[chosen]
    if all_known:
        return Estimate.from_shares((trials - return_counts).astype(np.float64), trials)
    return Estimate.from_shares(
        (trials - return_counts) * return_counts / (trials - 1), return_counts
    )


class ScatterFit(NamedTuple):
    """Range noise and direction noise, fitted to the variances of rays."""

    # {`range_m`, `angle_deg` or the name of the increase, which are fields of `Noise`: estimate}
    estimates: dict[str, Estimate]
    sigma: Floats  # (k,): fitted standard deviation of the range of each ray, meters
    deviance: float  # deviance of the fit to all rays; smaller is more likely


class _VarianceSamples(NamedTuple):
    """Range variances of rays that lose few pulses.

    All arrays have shape (k,).
    """

    variance: Floats  # square meters
    freedom: Ints  # degrees of freedom of the variance
    growth: Floats  # quantity with which range noise grows, such as the range
    slope: Floats  # meters per radian
    distance: Floats  # meters
    patch: Ints  # number of the patch of neighboring rays, whose errors may be correlated


@dataclass(frozen=True, eq=False)
class _VarianceModel:
    """Model of the range variance that results from range noise and direction noise.

    The range noise grows with a quantity. The three parameters are relative to the typical variance
    v. The first is (σ / √v) to the power `power`, where σ is the range noise at a growth of 0. The
    second is the increase of this term at `growth_scale`. The third is the variance due to
    direction noise at `slope_scale`, divided by v. Methods accept only the parameters that are
    marked in `fitted`. The others are 0.
    """

    power: int  # power of σ and of the growth: 1 if noise adds, 2 if variances add
    fitted: Bools  # (3,): which parameters are fitted
    variance_scale: float  # typical variance v, square meters
    growth_scale: float  # typical growth, in the unit of the quantity
    slope_scale: float  # typical slope, meters per radian

    def variance(self, parameters: Floats, growth: Floats, slope: Floats) -> Floats:
        """Return the range variance of each ray in square meters."""
        theta = np.zeros(3)
        theta[self.fitted] = parameters
        range_term = theta[0] + theta[1] * (growth / self.growth_scale) ** self.power
        direction_term = theta[2] * (slope / self.slope_scale) ** 2
        return np.asarray(self.variance_scale * (range_term ** (2 / self.power) + direction_term))

    def predict(self, parameters: Floats, samples: _VarianceSamples) -> Floats:
        return self.variance(parameters, samples.growth, samples.slope)


def fit_scatter(rays: SmoothRays, increase_name: str, growth: Floats, power: int) -> ScatterFit:
    """Fit range noise and direction noise to the variances of rays by maximum likelihood.

    The range noise is a + b g for power 1, and √(a² + b² g²) for power 2, where g is `growth`. The
    parameter a is stored as `range_m`, and b as `increase_name`. Parameters that cannot be
    determined, because the growth does not vary or there are no inclined surfaces, are omitted.
    Intervals include sandwich estimates for patches of rays with correlated errors, and model
    errors due to edges, slopes and growth.
    """
    lower, middle, upper = np.quantile(growth, (0.05, 0.5, 0.95))
    samples = _variance_samples(rays, growth)
    is_tilted = np.quantile(rays.slope / rays.distance, 0.9) > _MIN_TILT_TANGENT
    model = _VarianceModel(
        power=power,
        # Growth is fitted even if it is undetermined, because it widens the interval of `range_m`.
        fitted=np.array([True, True, is_tilted]),
        variance_scale=max(float(np.median(samples.variance)), 1e-12),
        growth_scale=middle,
        slope_scale=np.median(rays.slope),
    )
    exponents = (1 / power, 1 / power, 0.5)
    scales = np.sqrt(model.variance_scale) / np.array([1, middle, np.radians(model.slope_scale)])
    theta, theta_variance = _fit_variances(model, samples)
    names = ("range_m", increase_name, "angle_deg")
    estimates = {
        names[k]: Estimate.from_variance(value, variance).power(exponents[k], scales[k])
        for k, value, variance in zip(
            np.flatnonzero(model.fitted), theta, theta_variance, strict=True
        )
        if k != 1 or upper > _MIN_RANGE_RATIO * lower
    }
    expected = model.predict(theta, samples)
    ratios = np.minimum(samples.variance / expected, _MAX_VARIANCE_RATIO)
    deviance = float(samples.freedom @ (np.log(expected) + ratios))
    return ScatterFit(estimates, np.sqrt(model.variance(theta, growth, rays.slope)), deviance)


def _variance_samples(rays: SmoothRays, growth: Floats) -> _VarianceSamples:
    """Select the rays that are used to fit the noise model.

    Rays that lose many pulses are excluded, because only their closer or brighter pulses return.
    `growth` is the quantity that range noise grows with.
    """
    repeated = (rays.freedom > 0) & (rays.return_counts >= MIN_RETURN_SHARE * rays.trials)
    patch_columns = max(int(rays.column.max()) // _PATCHES, 1)
    patch = rays.row // _PATCH_ROWS * (_PATCHES + 2) + rays.column // patch_columns
    return _VarianceSamples(
        variance=rays.variance[repeated],
        freedom=rays.freedom[repeated],
        growth=growth[repeated],
        slope=rays.slope[repeated],
        distance=rays.distance[repeated],
        patch=patch[repeated],
    )


def _fit_variances(model: _VarianceModel, samples: _VarianceSamples) -> tuple[Floats, Floats]:
    """Fit the model parameters to samples, and estimate the variances of these parameters."""
    start = np.array([1.0, 0.1, 0.1])[model.fitted]
    theta, covariance = _fit_trimmed(model, start, samples, _TAIL_CHANCE)
    # Edges that are finer than the ray spacing increase the variances of some rays. The change in
    # the parameters when fewer rays are excluded is used as a model error.
    untrimmed, _ = _fit_trimmed(model, theta, samples, _OUTLIER_CHANCE)
    variances = np.diag(covariance) + (theta - untrimmed) ** 2
    # Slopes are not exact, so variances of steep or distant rays may be inconsistent with others.
    for quantity in (samples.slope / samples.distance, samples.growth):
        error = _VARIANCE_ERROR * np.where(quantity > np.median(quantity), 1.0, -1.0)
        changed = samples._replace(variance=samples.variance * (1 + error))
        biased, _ = _fit_trimmed(model, theta, changed, _TAIL_CHANCE)
        variances += (biased - theta) ** 2
    return theta, variances


def _fit_trimmed(
    model: _VarianceModel, start: Floats, samples: _VarianceSamples, chance: float
) -> tuple[Floats, Floats]:
    """Fit a model to variances without outliers, and estimate the covariance of its parameters.

    Samples whose variance exceeds a quantile of the expected distribution are excluded. The
    probability to exceed the quantile is `chance`. The remaining samples have the mean of the
    truncated distribution. `start` contains the initial parameters.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    freedom = samples.freedom
    limit = chi2.isf(chance, freedom)
    inliers = np.ones(len(samples.variance), bool)
    truncated_mean = chi2.cdf(limit, freedom + 2) / (1 - chance)
    theta = start
    for step in range(12):
        expected = model.predict(theta, samples)
        if step:
            inliers = freedom * samples.variance / expected < limit
        scale = truncated_mean if step else 1.0
        weight = np.sqrt(freedom / 2) / expected

        def residuals(
            parameters: Floats,
            row_mask: Bools = inliers,
            weight: Floats = weight,
            scale: Any = scale,
        ) -> Any:
            variance = scale * model.predict(parameters, samples)
            return ((samples.variance - variance) * weight)[row_mask]

        x_scale = np.maximum(theta, 0.01)
        solved = least_squares(residuals, theta, bounds=(0, np.inf), x_scale=x_scale)
        theta = solved.x
    return theta, sandwich(solved.jac, solved.fun, samples.patch[inliers])


def fit_threshold(
    energy: Floats, rays: SmoothRays, dropout: float, *, all_known: bool = False
) -> Estimate | None:
    """Estimate the energy at which half of the pulses return, using the model of `Noise.detected`.

    `dropout` is the loss rate at any energy. Unless `all_known` is true, a ray is known only if at
    least one pulse returns, so the likelihood of a truncated binomial distribution is used. Return
    None if too few rays lose some of their pulses.
    """
    from scipy.optimize import brute
    from scipy.special import ndtr
    from scipy.stats import binom

    def detection(log_threshold: Any) -> Floats:
        fraction = ndtr(THRESHOLD_SIGMAS * (energy / np.exp(log_threshold) - 1))
        return np.clip((1 - dropout) * fraction, 1e-9, 1 - 1e-9)

    def deviance(log_threshold: Any) -> Floats:
        p: Floats = detection(log_threshold)
        likelihood = binom.logpmf(rays.return_counts, rays.trials, p)
        return (0 if all_known else np.log1p(-((1 - p) ** rays.trials))) - likelihood

    lower, upper = np.log(np.quantile(energy, (0.001, 0.999)))
    (fitted,) = brute(lambda guess: deviance(guess).sum(), [(lower - 2, upper)], Ns=60)
    if (detection(fitted) < 0.9 * (1 - dropout)).sum() < _MIN_WEAK_RAYS:
        return None
    below, center, above = (deviance(fitted + step) for step in (-_LOG_STEP, 0, _LOG_STEP))
    information = (above - 2 * center + below).sum() / _LOG_STEP**2
    score = (((above - below) / (2 * _LOG_STEP)) ** 2).sum()
    return Estimate(*np.exp(Estimate.from_variance(fitted, score / information**2)).tolist())


def alarm_share(stack: SweepStack) -> Estimate | None:
    """Estimate the fraction of pulses that return although they were emitted into the sky.

    A pulse counts as a sky pulse if no other pulse of its ray returns, and if no ray in its
    neighborhood returns twice. Rays with fewer than three pulses are ignored. Return None if there
    is too little sky, or if there are only two sweeps.
    """
    from scipy.ndimage import maximum_filter
    from scipy.stats import binomtest

    count = np.isfinite(stack.ranges).sum(axis=0)
    # Weak surfaces, which rarely return, are next to surfaces that return more often.
    size = _SKY_RINGS, round(_SKY_DEG / 360 * count.shape[1])
    repeated = maximum_filter(count, size=size, mode=("nearest", "wrap")) > 1
    sky = ~repeated & (stack.trials > 2) & stack.steady
    alarms = int((count[sky] == 1).sum())
    trials = int(stack.trials[sky & (count == 0)].sum()) + alarms
    if trials < _MIN_SKY_PULSES:
        return None
    return Estimate(alarms / trials, *map(float, binomtest(alarms, trials).proportion_ci()))

"""Determine the properties of an unknown intensity scale from recorded returns.

Intensities depend on the range, the angle of incidence and the reflectance, but only the range is
known. The functions therefore compare statistics of many returns, and rely on the fact that typical
surfaces have similar reflectances in most recordings.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.errors import LidarError
from lidarsim.media.materials import REFERENCE_M, normal_incidence_energy
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Bools, Floats
from lidarsim.numerics.even_samples import even_indices

_SWEEPS = 5  # maximum number of sweeps that are read
_MAX_RETURNS = 400_000  # maximum number of returns that are used
_MIN_RETURNS = 50  # minimum number of returns in a range interval
# Numbers of steps per unit that are tested. 8-bit codes are often divided by 255 or 256.
_STEPS_PER_UNIT = (1, 2, 10, 100, 255, 256, 1000, 4095, 10_000, 65_535, 100_000, 1_000_000)
# Largest values on scales from 0 to 1, by the number of steps. KITTI has steps of 0.01 up to 0.99.
_UNIT_LIMITS = {100.0: 0.99, 255.0: 1.0, 256.0: 255 / 256}
_MAX_ROUNDING = 0.02  # maximum distance of a value from a multiple of the step, in steps
_SATURATED_SHARE = 0.05  # minimum share of returns at the largest value in a saturated interval
_CLIPPED_SHARE = 1e-3  # minimum share of returns with the same largest value if they are clipped
# Returns above this height in the sensor frame are not from the ground, whose incidence angle
# increases with the range.
_ABOVE_GROUND_M = -0.5
# Minimum, preferred minimum and maximum range for `is_compensated`. At long range, fog and the
# detection threshold change intensities more than the distance does.
_LAW_RANGES_M = (2.0, 5.0, 40.0)
# Typical intensities decrease with a power of the range between 0 and -1 if they are compensated,
# and between -2 and -3 if they are energies. The second values apply to level ground, for which the
# cosine of the angle of incidence is inversely proportional to the range.
_LAW_EXPONENT = -1.5
_TYPICAL_RANGES_M = (5.0, 50.0)
_WHITE_QUANTILE = 0.99
_RETRO_FACTOR = 4.0  # a retroreflector has at least this multiple of the 95th percentile
_NEAR_EDGES_M = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_NEAR_REFERENCE_M = (10.0, 15.0)
_MIN_NEAR_RETURNS = 200
_GROUND_THICKNESS_M = 0.3  # maximum difference between the height of the ground and its mode
# A drop at close range is clear if the factors of this many intervals are less than this limit.
_CLEAR_DROP = 0.7
_CLEAR_INTERVALS = 3
_MIN_NEAR_FACTOR = 0.05
# The threshold is estimated beyond this range, in range intervals with this ratio of their limits.
_THRESHOLD_MIN_M = 15.0
_THRESHOLD_RATIO = 1.15
_THRESHOLD_QUANTILE = 0.05


def reference_numbers(recording: Recording) -> list[int]:
    """Return the numbers of at most five sweeps from which properties are determined."""
    return even_indices(len(recording), _SWEEPS).tolist()


class RecordedReturns(NamedTuple):
    """Returns from a few sweeps of a recording, with all their columns."""

    columns: dict[str, AnyArray]  # arrays of shape (n,)
    range_m: Floats  # (n,), distance from the sensor
    height_m: Floats  # (n,), z coordinate in the sensor frame

    @classmethod
    def from_recording(cls, recording: Recording) -> Self:
        """Read the returns of at most five sweeps.

        Raises
        ------
        LidarError
            If the recording has no sweeps or no returns, or if it cannot be read.
        """
        sweeps = [recording[number].returns() for number in reference_numbers(recording)]
        sweeps = [sweep for sweep in sweeps if len(sweep)]
        if not sweeps:
            raise LidarError(f"{recording.info.name} has no returns in the sweeps that were read.")
        names = [name for name in sweeps[0].columns if all(name in s.columns for s in sweeps)]
        kept = [even_indices(len(sweep), _MAX_RETURNS // len(sweeps)) for sweep in sweeps]
        pairs = [*zip(sweeps, kept, strict=True)]
        columns = {
            name: np.concatenate([np.asarray(sweep.columns[name])[rows] for sweep, rows in pairs])
            for name in names
        }
        points = np.concatenate([sweep.points[rows] for sweep, rows in pairs])
        return cls(columns, np.linalg.norm(points, axis=1), points[:, 2])

    def select(self, mask: Bools) -> Self:
        """Select returns with a mask. Shape (n,)."""
        columns = {name: values[mask] for name, values in self.columns.items()}
        return type(self)(columns, self.range_m[mask], self.height_m[mask])


def is_valid(values: AnyArray) -> Bools:
    """Return whether values are finite and not negative, so that they can be intensities."""
    if values.dtype.kind in "bu":
        return np.ones(len(values), np.bool_)
    return np.asarray(np.isfinite(values) & (values >= 0))


def smallest_positive(values: AnyArray) -> float:
    """Return the smallest positive value, or 0 if no value is 0. The values must be valid."""
    positive = values[values > 0]
    return float(positive.min()) if 0 < len(positive) < len(values) else 0.0


class Quantization(NamedTuple):
    """Steps and limits of recorded values.

    `steps_per_unit` is 0 if the values are continuous.
    """

    steps_per_unit: float
    max_value: float  # infinity if values are not limited

    @classmethod
    def from_values(cls, values: AnyArray) -> Self:
        """Determine the quantization from valid values. Shape (n,)."""
        distinct, counts = np.unique(values, return_counts=True)
        precision = 0.0 if values.dtype.kind in "iu" else 2 * float(np.finfo(values.dtype).eps)
        distinct = distinct.astype(np.float64)
        steps = _steps_per_unit(distinct, precision)
        return cls(steps, _max_value(distinct, counts, steps))

    @property
    def is_byte(self) -> bool:
        """Whether values are integers with 256 steps, or multiples of them."""
        return 0 < self.steps_per_unit <= 1 and self.max_value * self.steps_per_unit == 255

    @property
    def is_unit_byte(self) -> bool:
        """Whether values are 8-bit codes that are divided by 255 or 256."""
        return self.steps_per_unit in (255, 256) and self.max_value <= 1


def _steps_per_unit(distinct: Floats, precision: float) -> float:
    """Return the number of steps per unit, or 0 if values are continuous.

    `precision` is the relative precision of the values, which is 0 for integers.
    """
    largest = float(distinct[-1])
    for steps in _STEPS_PER_UNIT:
        rounding = precision * largest * steps
        if rounding > _MAX_ROUNDING:
            break
        scaled = distinct * steps
        if np.abs(scaled - np.rint(scaled)).max() > max(rounding, 1e-9):
            continue
        if steps > 1:
            return float(steps)
        # 8-bit codes that are stored as 16-bit integers are multiplied by 256 or 257.
        divisor = int(np.gcd.reduce(np.rint(distinct).astype(np.int64)))
        return 1.0 / divisor if divisor in (256, 257) else 1.0
    return 0.0


def _max_value(distinct: Floats, counts: AnyArray, steps_per_unit: float) -> float:
    """Return the largest value of the scale."""
    largest = float(distinct[-1])
    if 0 < steps_per_unit <= 1:
        unit = 1 / steps_per_unit
        return next((m * unit for m in (255, 65_535) if largest <= m * unit), np.inf)
    if steps_per_unit in _UNIT_LIMITS and largest <= 1:
        limit = _UNIT_LIMITS[steps_per_unit]
        return limit if largest < limit + 0.5 / steps_per_unit else 1.0
    clipped = largest.is_integer() and counts[-1] >= max(5, _CLIPPED_SHARE * counts.sum())
    return largest if clipped else np.inf


def is_compensated(values: Floats, returns: RecordedReturns, max_value: float) -> bool | None:
    """Return whether intensities are compensated for range, or None if this cannot be determined.

    Otherwise, they are energies, which decrease with the square of the range.

    Notes
    -----
    The exponent of the range is estimated robustly (Theil–Sen) from winsorized means in logarithmic
    range intervals. Intervals in which values are saturated are excluded. If possible, only returns
    above the ground are used.

    Parameters
    ----------
    values
        Valid intensities. Shape (n,).
    returns
        The returns to which the values belong.
    max_value
        Largest value of the scale.
    """
    lower_m, preferred_m, upper_m = _LAW_RANGES_M
    above = returns.height_m > _ABOVE_GROUND_M
    candidates = [(above, preferred_m), (above, lower_m), (~above, lower_m)]
    for mask, minimum_m in candidates:
        used = mask & (returns.range_m >= minimum_m) & (returns.range_m < upper_m)
        levels = _levels_by_range(values[used], returns.range_m[used], max_value)
        if len(levels) >= 3 and levels[-1][0] - levels[0][0] > np.log(1.5):
            exponents = [
                (level - first) / (log_range - log_first)
                for index, (log_first, first) in enumerate(levels)
                for log_range, level in levels[index + 1 :]
            ]
            return bool(np.median(exponents) > _LAW_EXPONENT)
    return None


def _levels_by_range(
    values: Floats, range_m: Floats, max_value: float
) -> list[tuple[float, float]]:
    """Return the logarithms of range and mean intensity for unsaturated range intervals."""
    levels = []
    edges = _LAW_RANGES_M[0] * 1.25 ** np.arange(15)
    for lower, upper in pairwise(edges):
        inside = (range_m >= lower) & (range_m < upper)
        if inside.sum() < _MIN_RETURNS:
            continue
        chosen = values[inside]
        if (chosen >= max_value).mean() > _SATURATED_SHARE:
            continue
        mean = np.minimum(chosen, np.quantile(chosen, 0.9)).mean()
        if mean > 0:
            levels.append((float(np.log(np.sqrt(lower * upper))), float(np.log(mean))))
    return levels


def typical_level(levels: Floats, range_m: Floats) -> float:
    """Return the median of levels, which are intensities without the influence of the range."""
    return float(np.median(_typical(levels, range_m)))


def white_level(levels: Floats, range_m: Floats) -> float:
    """Return the 99th percentile of levels, without retroreflectors.

    `levels` are intensities without the influence of the range. Shape (n,).
    """
    chosen = _typical(levels, range_m)
    diffuse = chosen[chosen <= _RETRO_FACTOR * max(float(np.quantile(chosen, 0.95)), 1e-300)]
    return float(np.quantile(diffuse, _WHITE_QUANTILE))


def _typical(levels: Floats, range_m: Floats) -> Floats:
    lower, upper = _TYPICAL_RANGES_M
    inside = (range_m >= lower) & (range_m < upper)
    return levels[inside] if inside.sum() >= _MIN_RETURNS else levels


class NearFactors(NamedTuple):
    """Share of the energy that the optics receive at close range, as a function of the range.

    The factors are interpolated linearly. They are constant outside the given ranges, and empty if
    energies are not reduced at close range.
    """

    range_m: tuple[float, ...] = ()
    factors: tuple[float, ...] = ()

    @classmethod
    def from_returns(cls, levels: Floats, returns: RecordedReturns) -> Self:
        """Fit factors that do not decrease with the range.

        The factors are empty if there is no clear drop at close range.

        Parameters
        ----------
        levels
            Intensities without the influence of the range. Shape (n,).
        returns
            The returns to which the levels belong.

        Notes
        -----
        The factor for a range interval is the maximum of four ratios, which compare the medians and
        the 90th percentiles of all returns and of returns from the ground. All returns are not
        sufficient, because the closest surface is often the ground or the vehicle, which may be
        darker than other surfaces. On the ground, the angle of incidence decreases at close range,
        so a drop cannot be explained by the angle. The fitted factors are therefore too large
        rather than too small.
        """
        ground = _is_ground(returns)
        groups = [(levels, returns.range_m), (levels[ground], returns.range_m[ground])]
        references = [_quantiles(*group, *_NEAR_REFERENCE_M) for group in groups]
        if not all(reference is not None and reference.all() for reference in references):
            return cls()
        centers = [_NEAR_REFERENCE_M[0]]
        factors = [1.0]
        for near_m, far_m in reversed([*pairwise(_NEAR_EDGES_M)]):
            quantiles = [_quantiles(*group, near_m, far_m) for group in groups]
            ratios = [
                float((chosen / reference).max())
                for chosen, reference in zip(quantiles, references, strict=True)
                if chosen is not None and reference is not None
            ]
            if len(ratios) < len(groups):
                continue
            centers.insert(0, (near_m + far_m) / 2)
            factors.insert(0, max(min(max(ratios), factors[0]), _MIN_NEAR_FACTOR))
        if sum(factor < _CLEAR_DROP for factor in factors) < _CLEAR_INTERVALS:
            return cls()
        return cls(tuple(centers), tuple(factors))

    def at(self, range_m: AnyFloats) -> Floats:
        """Return the factors for ranges in meters. Both arrays have shape (n,)."""
        if not self.range_m:
            return np.ones(len(range_m))
        return np.asarray(np.interp(range_m, self.range_m, self.factors))


def _quantiles(levels: Floats, range_m: Floats, near_m: float, far_m: float) -> Floats | None:
    """Return the median and the 90th percentile in a range interval, or None without data."""
    chosen = levels[(range_m >= near_m) & (range_m < far_m)]
    if len(chosen) < _MIN_NEAR_RETURNS:
        return None
    return np.asarray(np.quantile(chosen, (0.5, 0.9)))


def _is_ground(returns: RecordedReturns) -> Bools:
    """Return whether returns are close to the most frequent height below the sensor."""
    height_m = returns.height_m
    candidates = (height_m < _ABOVE_GROUND_M) & (returns.range_m < _NEAR_REFERENCE_M[1])
    if not candidates.any():
        return candidates
    bins, counts = np.unique(
        np.rint(height_m[candidates] / _GROUND_THICKNESS_M), return_counts=True
    )
    ground_m = bins[counts.argmax()] * _GROUND_THICKNESS_M
    return np.asarray(candidates & (np.abs(height_m - ground_m) < _GROUND_THICKNESS_M))


def weakest_energy(energy: Floats, range_m: Floats, step_energy: Floats) -> float:
    """Estimate the detection threshold from the weakest returns at medium and long range.

    Returns are detected if their energy exceeds the threshold, regardless of their range. The
    threshold is therefore the minimum, over range intervals, of a low quantile of the energies.

    Parameters
    ----------
    energy
        Energies of returns. Shape (n,).
    range_m
        Ranges in meters. Shape (n,).
    step_energy
        Smallest energy that the intensity scale resolves reliably at each range. Weaker returns are
        treated as if they had this energy. Shape (n,).
    """
    energy = np.maximum(energy, step_energy)
    start_m = _THRESHOLD_MIN_M
    if (range_m >= start_m).sum() < _MIN_RETURNS:
        start_m = float(np.quantile(range_m, 0.5))
    bins = np.floor(np.log(np.maximum(range_m / start_m, 1e-9)) / np.log(_THRESHOLD_RATIO))
    weakest = [
        float(np.quantile(energy[bins == number], _THRESHOLD_QUANTILE))
        for number, count in zip(*np.unique(bins, return_counts=True), strict=True)
        if number >= 0 and count >= _MIN_RETURNS
    ]
    if weakest:
        return min(weakest)
    return float(np.quantile(energy, _THRESHOLD_QUANTILE))


def range_of_energy(energy: float, reflectance: float) -> float:
    """Return the range in meters at which a perpendicular surface has the given energy."""
    return float(REFERENCE_M * np.sqrt(reflectance / energy)) if energy > 0 else np.inf


def range_factors(range_m: AnyFloats) -> Floats:
    """Return the energies from white surfaces at normal incidence. Both arrays have shape (n,)."""
    return np.asarray(normal_incidence_energy(np.asarray(range_m, np.float64)))

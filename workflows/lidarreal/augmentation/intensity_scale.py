"""Convert recorded intensities to received energies, and energies to recorded intensities.

The energy of a return is on the scale of the simulator: a white surface at normal incidence and a
distance of 10 m returns an energy of 1. Sensors record intensities on different scales. Many
compensate them for the range, so that a white surface has the same intensity at all distances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.columns.column_names import STRENGTHS
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Floats
from lidarsim.schema.checks import check_number
from lidarsim.sensor.reflectivity import SCALES, ByteScale
from lidarsim.sensor.sensor import Sensor
from lidarsim.words import format_rounded

from .intensity_fit import (
    NearFactors,
    Quantization,
    RecordedReturns,
    is_compensated,
    is_valid,
    range_factors,
    reference_numbers,
    smallest_positive,
    typical_level,
    white_level,
)

# An assumed scale must result in plausible reflectances, multiplied by the cosine of the angle of
# incidence. The median of codes has no lower limit, because fog reduces typical codes of real
# sensors to 1 or 2. The other limits apply to the 99th percentile.
_MAX_MEDIAN = 0.6
_BRIGHTEST = (0.25, 1.3)
_ZERO_STEPS = 0.25  # value that represents a recorded 0, in steps
_TYPICAL_REFLECTANCE = 0.2  # reflectance times cosine of the incidence, if it cannot be estimated
_RESOLVED_STEPS = 3  # smallest value, in steps, that is used to estimate the detection threshold
# Ranges and codes for which reflectivities are compared with energies, and the maximum deviation of
# the ratio. Simulations produce constant ratios, except for rounding.
_COMPARED_RANGES_M = (3.0, 60.0)
_COMPARED_CODES = (20, 100)
_MAX_RATIO_SPREAD = 1.1
_MAX_RATIO_ERROR = 0.01
_NO_DROP = NearFactors()
_SENSOR_ADVICE = "Pass `--model` to use the scale of a sensor."


@dataclass(frozen=True)
class IntensityScale:
    """Relationship between recorded intensities and received energies.

    Both conversions are inverse to each other, except for the quantization and the limits of the
    recorded values.

    Attributes
    ----------
    column
        Standard name of the column that contains the intensities. It is empty if there is no such
        column and all returns are assumed to have the same reflectance.
    dtype
        Type of the recorded values.
    quantization
        Steps and largest value of the recorded values.
    white
        Recorded value of a white surface at normal incidence. If intensities are energies, this
        value applies to a range of 10 m.
    compensated
        Whether intensities are compensated for the range. Otherwise, they are energies.
    codes
        Scale of the manufacturer if values are 8-bit codes or proportional to them. It is
        logarithmic for retroreflectors. None if energies are proportional to the values.
    codes_per_unit
        Number of codes per recorded unit, which is 255 if values range from 0 to 1.
    near
        Share of the energy that is recorded at close range.
    typical
        Median of the reflectance multiplied by the cosine of the angle of incidence.
    smallest
        Smallest positive value, if values are not quantized and some of them are 0.
    is_known
        Whether the scale is known, rather than assumed or fitted.
    note
        Sentences about assumed or fitted values, for the user. Empty if the scale is known.

    Notes
    -----
    Intensities that are negative, infinite or NaN are invalid. A return with an invalid intensity
    was detected, but its energy is unknown. It is assumed to come from a typical surface at normal
    incidence, and `scale_intensities` does not change its recorded value.

    If energies are clipped at the largest value, a saturated return has at least the energy of a
    typical surface at its range.
    """

    column: str
    dtype: np.dtype[Any]
    quantization: Quantization
    white: float
    compensated: bool
    codes: ByteScale | None = None
    codes_per_unit: float = 1.0
    near: NearFactors = _NO_DROP
    typical: float = _TYPICAL_REFLECTANCE
    smallest: float = 0.0
    is_known: bool = True
    note: str = ""

    @classmethod
    def for_recording(
        cls,
        recording: Recording,
        model: Sensor | None = None,
        assumed_reflectance: float | None = None,
    ) -> IntensityScale:
        """Determine the intensity scale of a recording from at most five sweeps.

        The scale is known for results, for bags of lidarpool with energies, for packet captures,
        and for 8-bit codes if the sensor model is given. Otherwise, a common scale is assumed if
        surfaces then have plausible reflectances. If no common scale is plausible, the intensity of
        a white surface is estimated from the brightest surfaces.

        Parameters
        ----------
        recording
            The recording.
        model
            Sensor model of the recording, or None if it is unknown.
        assumed_reflectance
            Reflectance that all returns are assumed to have. Recorded intensities are then ignored,
            and no intensities are written.

        Raises
        ------
        LidarError
            If the recording has no intensities, or if they are all equal.
        """
        if assumed_reflectance is not None:
            return cls.with_reflectance(assumed_reflectance)
        returns = RecordedReturns.from_recording(recording)
        return cls.from_returns(recording, returns, model)

    @classmethod
    def with_reflectance(cls, reflectance: float) -> Self:
        """Create the scale of a recording without intensities.

        Raises LidarError if the reflectance is not greater than 0 or exceeds 1.

        Examples
        --------
        >>> IntensityScale.with_reflectance(0.3).energies(None, np.array([20.0, 40.0]))
        array([0.075  , 0.01875])
        """
        check_number("assumed_reflectance", reflectance, gt=0, le=1)
        return cls(
            column="",
            dtype=np.dtype(np.float32),
            quantization=Quantization(0, np.inf),
            white=1.0,
            compensated=True,
            typical=reflectance,
            is_known=False,
            note=f"All returns are assumed to have a reflectance of {reflectance:g}.",
        )

    @classmethod
    def from_returns(
        cls, recording: Recording, returns: RecordedReturns, model: Sensor | None
    ) -> IntensityScale:
        """Determine the scale of a recording, some of whose returns have already been read.

        Raises LidarError in the same cases as `for_recording`.
        """
        column = _primary_column(recording, returns, model)
        recorded = returns.columns[column]
        valid = is_valid(recorded)
        if not valid.any() or (recorded[valid] == recorded[valid][0]).all():
            raise _unknown_error(recording, column, recorded[valid])
        fit = _Fit(recording, column, returns.select(valid), model)
        return fit.scale()

    @property
    def zero_value(self) -> float:
        """Value that represents a recorded 0, which is a weak return that was rounded down."""
        steps = self.quantization.steps_per_unit
        return _ZERO_STEPS / steps if steps else self.smallest / 2

    def with_codes(self, codes: ByteScale) -> Self:
        """Return a copy whose values are codes on a scale, one for each step of the values."""
        codes_per_unit = self.quantization.steps_per_unit
        return replace(
            self,
            codes=codes,
            codes_per_unit=codes_per_unit,
            white=codes.code / codes.reflectance / codes_per_unit,
        )

    def clip(self, energy: AnyFloats, saturation: float) -> Floats:
        """Limit energies to the energy at which the receiver saturates.

        Unlimited energies, as in results, are those before saturation and are not limited.
        """
        if not self.compensated and np.isinf(self.quantization.max_value):
            return np.asarray(energy, np.float64)
        return np.asarray(np.minimum(energy, saturation), np.float64)

    def energies(self, intensity: AnyArray | None, range_m: AnyFloats) -> Floats:
        """Convert recorded intensities to received energies.

        Parameters
        ----------
        intensity
            Recorded values, or None if there are none. Shape (n,).
        range_m
            Ranges in meters. Shape (n,).

        Returns
        -------
        array
            Energies. Shape (n,).
        """
        range_m = np.asarray(range_m)
        if intensity is None or not self.column:
            return self._typical_energies(range_m)
        return self._energies(np.asarray(intensity), range_m, self._factors(range_m))

    def _energies(self, intensity: AnyArray, range_m: AnyFloats, factors: Floats) -> Floats:
        """Convert recorded intensities, given the result of `_factors`."""
        values = intensity.astype(np.float64)
        invalid = np.flatnonzero(~is_valid(intensity))
        values[invalid] = 0
        energies = self._reflectances(values) * factors
        if not self.compensated and np.isfinite(self.quantization.max_value):
            saturated = np.flatnonzero(values >= self.quantization.max_value)
            typical = self._typical_energies(range_m[saturated])
            energies[saturated] = np.maximum(energies[saturated], typical)
        energies[invalid] = self._typical_energies(range_m[invalid])
        return energies

    def _typical_energies(self, range_m: AnyFloats) -> Floats:
        """Return the energies of typical surfaces at normal incidence."""
        return self.typical * range_factors(range_m)

    def intensities(self, energy: AnyFloats, range_m: AnyFloats) -> AnyArray:
        """Convert received energies to the values that the sensor would record.

        Parameters
        ----------
        energy
            Received energies. Shape (n,).
        range_m
            Ranges in meters. Shape (n,).

        Returns
        -------
        array
            Values on the scale of the recording, which are quantized, clipped, and have the dtype
            of the recording. Energies that are not positive have the value 0. Shape (n,).
        """
        return self._intensities(np.asarray(energy, np.float64), self._factors(range_m))

    def _intensities(self, energy: Floats, factors: Floats) -> AnyArray:
        """Convert received energies, given the result of `_factors`."""
        positive = np.where(energy > 0, energy, 0.0)
        values = self._values(positive / factors)
        steps, max_value = self.quantization
        values[values <= self.zero_value * (1 + 1e-9)] = 0
        if steps:
            values = np.rint(values * steps) / steps
        values = np.minimum(values, max_value)
        if self.dtype.kind in "iu":
            values = np.minimum(values, np.iinfo(self.dtype).max)
        return values.astype(self.dtype)

    def scale_intensities(
        self,
        intensity: AnyArray,
        old_energy: AnyFloats,
        new_energy: AnyFloats,
        old_range_m: AnyFloats,
        new_range_m: AnyFloats,
    ) -> AnyArray:
        """Return new recorded values for returns whose energy or range has changed.

        The energy of a recorded value is multiplied by the ratio of the new to the old energy. If
        neither the energy nor the range has changed, the recorded value is returned exactly.
        Invalid values are not changed.

        Parameters
        ----------
        intensity
            Recorded values. Shape (n,).
        old_energy, new_energy
            Energies before and after the change. Shape (n,).
        old_range_m, new_range_m
            Ranges in meters before and after the change. Shape (n,).

        Returns
        -------
        array
            Values on the scale of the recording, as from `intensities`. Shape (n,).
        """
        intensity = np.asarray(intensity)
        old_range_m = np.asarray(old_range_m, np.float64)
        new_range_m = np.asarray(new_range_m, np.float64)
        old = np.asarray(old_energy, np.float64)
        new = np.asarray(new_energy, np.float64)
        factors = self._factors(old_range_m)
        recorded = self._energies(intensity, old_range_m, factors)
        scaled = np.where(old > 0, recorded * (new / np.where(old > 0, old, 1.0)), new)
        if self.quantization.steps_per_unit:
            # A value that is the rounded old energy becomes the rounded new energy.
            finer = np.flatnonzero(old != recorded)
            rounded = self._intensities(old[finer], factors[finer])
            finer = finer[rounded == intensity[finer]]
            scaled[finer] = new[finer]
        moved = old_range_m != new_range_m
        rows = np.flatnonzero(moved)
        factors[rows] = self._factors(new_range_m[rows])
        result = self._intensities(scaled, factors)
        kept = np.flatnonzero(~(is_valid(intensity) & (moved | (old != new))))
        result[kept] = intensity[kept]
        return result

    def step_energies(self, range_m: AnyFloats, count: float | None = None) -> Floats:
        """Return the energies of a number of steps of the recorded values.

        By default, these are the smallest energies that the values resolve reliably. Both arrays
        have shape (n,).
        """
        steps = self.quantization.steps_per_unit
        if not steps or not self.column:
            return np.zeros(len(range_m))
        # Without compensation, returns close to the threshold have values of a few steps.
        if count is None:
            count = _RESOLVED_STEPS if self.compensated else 0.5
        values = np.full(len(range_m), count / steps)
        return self._reflectances(values) * self._factors(range_m)

    def _factors(self, range_m: AnyFloats) -> Floats:
        """Return the energy of a return divided by the result of `_reflectances`."""
        range_m = np.asarray(range_m, np.float64)
        factors = range_factors(range_m) if self.compensated else np.ones(len(range_m))
        return factors / self.near.at(range_m)

    def _reflectances(self, values: Floats) -> Floats:
        """Convert recorded values to reflectances, or to energies without compensation."""
        values = np.minimum(values, self.quantization.max_value)
        values = np.where(values > 0, values, self.zero_value)
        if self.codes is None:
            return values / self.white
        return self.codes.decode(values * self.codes_per_unit)

    def _values(self, reflectances: Floats) -> Floats:
        """Convert reflectances to recorded values. This inverts `_reflectances`."""
        if self.codes is None:
            return reflectances * self.white
        return self.codes.unrounded_codes(reflectances) / self.codes_per_unit


def _primary_column(recording: Recording, returns: RecordedReturns, model: Sensor | None) -> str:
    """Return the column that defines the energies.

    A calibrated reflectivity is preferred, unless the intensities of the recording are known to be
    energies or the user chose a column.
    """
    columns = returns.columns
    available = [name for name in STRENGTHS if name in columns]
    if not available:
        raise _unknown_error(recording, "", None)
    intensity, reflectivity = STRENGTHS
    if available != [intensity, reflectivity] or recording.info.intensity_column is not None:
        return available[0]
    is_stated = recording.info.energy_unit is not None or recording.info.white is not None
    if is_stated or _has_simulated_energies(returns):
        return intensity
    is_calibrated = model is not None or _is_ouster(columns)
    return reflectivity if is_calibrated and _are_bytes(columns[reflectivity]) else intensity


def _are_bytes(values: AnyArray) -> bool:
    valid = values[is_valid(values)]
    return bool(len(valid)) and Quantization.from_values(valid).is_byte


def _is_ouster(columns: dict[str, AnyArray]) -> bool:
    """Return whether the columns are those of an Ouster sensor."""
    return "reflectivity" in columns and bool({"ambient", "near_ir", "signal"} & {*columns})


def _is_livox(columns: dict[str, AnyArray]) -> bool:
    """Return whether the columns are those of a Livox sensor."""
    return "tag" in columns


def _has_simulated_energies(returns: RecordedReturns) -> bool:
    """Return whether intensities are energies that were computed by lidarpool.

    In this case, the ratio of the reflectivity to the energy is that of a known scale.
    """
    columns = returns.columns
    if not {*STRENGTHS} <= {*columns}:
        return False
    intensity, reflectivity = (np.asarray(columns[name], np.float64) for name in STRENGTHS)
    lower, upper = _COMPARED_RANGES_M
    low_code, high_code = _COMPARED_CODES
    used = (returns.range_m > lower) & (returns.range_m < upper) & (intensity > 0)
    used &= (reflectivity >= low_code) & (reflectivity <= high_code)
    if used.sum() < 100:
        return False
    ratios = reflectivity[used] * range_factors(returns.range_m[used]) / intensity[used]
    low, median, high = np.quantile(ratios, (0.1, 0.5, 0.9))
    expected = [scale.code / scale.reflectance for scale in SCALES.values()]
    return bool(
        high < _MAX_RATIO_SPREAD * low
        and min(abs(median / code - 1) for code in expected) < _MAX_RATIO_ERROR
    )


class UnknownIntensitiesError(LidarError):
    """Error raised if a recording has no usable intensities.

    `problem` is a sentence that states why. The message also names options of the command line.
    """

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"{problem} Pass `--intensity COLUMN` to use another column, or `--reflectance 0.3` to "
            "assume the same reflectance for all returns."
        )
        self.problem = problem

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.problem,)


def _unmeasured(recording: Recording) -> str:
    """Describe the recording without intensities, or its first sweep if other sweeps have some."""
    numbers = reference_numbers(recording)
    lacks = [not {*STRENGTHS} & {*recording[number].columns} for number in numbers]
    if all(lacks) or True not in lacks:
        return recording.info.name
    return _differing_sweep(recording, numbers[lacks.index(True)])


def _differing_sweep(recording: Recording, number: int) -> str:
    item = recording.info.files[number] if recording.info.files else f"sweep {number}"
    return f"Unlike other sweeps, {item} in {recording.info.name}"


def check_column(recording: Recording, sweep: Sweep, number: int, column: str) -> None:
    """Raise LidarError if a sweep lacks the column that defines the energies."""
    if column not in sweep.columns:
        raise UnknownIntensitiesError(
            f"{_differing_sweep(recording, number)} has no column {column!r}, so the energies of "
            "its returns are unknown."
        )


def _unknown_error(
    recording: Recording, column: str, values: AnyArray | None
) -> UnknownIntensitiesError:
    """Return the error for a recording without usable intensities."""
    if values is None:
        problem = f"{_unmeasured(recording)} has no intensity column"
    elif not len(values):
        problem = f"The column {column!r} of {recording.info.name} has no valid intensities"
    else:
        problem = f"All intensities of {recording.info.name} are {values[0]:g}"
    return UnknownIntensitiesError(f"{problem}, so the energies of its returns are unknown.")


@dataclass(frozen=True, eq=False)
class _Fit:
    """Returns with valid intensities, from which a scale is determined."""

    recording: Recording
    column: str
    returns: RecordedReturns
    model: Sensor | None

    def scale(self) -> IntensityScale:
        """Return the known, assumed or fitted scale."""
        recorded = self.returns.columns[self.column]
        quantization = Quantization.from_values(recorded)
        values = recorded.astype(np.float64)
        common = IntensityScale(
            column=self.column,
            dtype=recorded.dtype,
            quantization=quantization,
            white=1.0,
            compensated=True,
            smallest=smallest_positive(values),
        )
        scale = self._known(common, values)
        if scale is None:
            scale = self._assumed(common, values)
        levels = _levels(scale, values, self.returns.range_m)
        typical = typical_level(levels, self.returns.range_m)
        return replace(scale, typical=min(max(typical, 0.01), 1.0))

    def _known(self, common: IntensityScale, values: Floats) -> IntensityScale | None:
        """Return the scale if it is known, otherwise None."""
        recording = self.recording
        quantization = common.quantization
        unit = recording.info.energy_unit
        if unit is None and _has_simulated_energies(self.returns):
            unit = 1.0
        if unit is not None and self.column == "intensity":
            limits = quantization
            if not quantization.steps_per_unit:
                # The energies of a result are not limited, even if several returns are equal.
                limits = quantization._replace(max_value=np.inf)
            return replace(common, compensated=False, white=unit, quantization=limits)
        maker = "velodyne" if self.model is None else self.model.optics.reflectivity
        codes = SCALES[maker]
        if recording.info.white is not None:
            scale = common.with_codes(codes)
            if quantization.is_byte and scale.white == recording.info.white:
                return scale
            return replace(common, white=recording.info.white)
        if self.model is None or self._law(values, quantization) is False:
            return None
        if quantization.is_byte or quantization.is_unit_byte:
            return common.with_codes(codes)
        return None

    def _law(self, values: Floats, quantization: Quantization) -> bool | None:
        return is_compensated(values, self.returns, quantization.max_value)

    def _assumed(self, common: IntensityScale, values: Floats) -> IntensityScale:
        """Return a common scale if it is plausible, otherwise a fitted scale."""
        law = self._law(values, common.quantization)
        compensated = True if law is None else law
        scale = replace(common, compensated=compensated, is_known=False)
        range_m = self.returns.range_m
        for assumed, text in self._conventions(scale):
            levels = _levels(assumed, values, range_m)
            if assumed.codes is not None:
                is_plausible = typical_level(levels, range_m) <= _MAX_MEDIAN
            else:
                is_plausible = _BRIGHTEST[0] <= white_level(levels, range_m) <= _BRIGHTEST[1]
            if is_plausible:
                return self._with_near(assumed, values, text)
        levels = _levels(scale, values, range_m)
        white = white_level(levels, range_m)
        fitted = replace(scale, white=white)
        return self._with_near(fitted, values, f"{_white_text(fitted)}, the 99th percentile.")

    def _with_near(self, scale: IntensityScale, values: Floats, text: str) -> IntensityScale:
        """Add factors at close range and a note to an assumed scale."""
        range_m = self.returns.range_m
        unsaturated = values < scale.quantization.max_value
        levels = _levels(scale, values[unsaturated], range_m[unsaturated])
        near = NearFactors.from_returns(levels, self.returns.select(unsaturated))
        sentences = [f"The intensity scale of {self.recording.info.name} is unknown.", text]
        if near.range_m:
            sentences.append(
                f"Intensities decrease at ranges below {near.range_m[-1]:g} m, which was "
                "attributed to the optics."
            )
        if self.model is None:
            sentences.append(_SENSOR_ADVICE)
        else:
            sentences.append(
                f"The scale of {self.model.model} was not used, because the intensities are not "
                "8-bit codes that are compensated for the range."
            )
        return replace(scale, near=near, note=" ".join(sentences))

    def _conventions(self, scale: IntensityScale) -> list[tuple[IntensityScale, str]]:
        """Return common scales that are consistent with the values, and their descriptions."""
        quantization = scale.quantization
        if quantization.is_byte or quantization.is_unit_byte:
            if scale.compensated:
                name, codes = self._maker()
                assumed = scale.with_codes(codes)
                text = f"{_white_text(assumed)}, as on the scale of {name}."
                return [(assumed, text)]
            whites = [quantization.max_value]
        elif quantization.steps_per_unit:
            whites = []  # counts, whose unit depends on the sensor
        else:
            whites = [1.0] if scale.compensated else [1.0, 255.0]
        candidates = [replace(scale, white=white) for white in whites]
        return [(assumed, f"{_white_text(assumed)}, as in simulations.") for assumed in candidates]

    def _maker(self) -> tuple[str, ByteScale]:
        """Return the manufacturer that the columns indicate, and its scale."""
        columns = self.returns.columns
        if _is_livox(columns):
            return "Livox", SCALES["livox"]
        if self.column == "reflectivity" and _is_ouster(columns):
            return "Ouster", SCALES["ouster"]
        return "Velodyne, Ouster and RoboSense", SCALES["velodyne"]


def _white_text(scale: IntensityScale) -> str:
    """Describe the intensity of a white surface, in a sentence without a period."""
    distance = "" if scale.compensated else " at 10 m"
    return f"A white surface{distance} was assumed to have the intensity {_rounded(scale.white)}"


def _rounded(value: float) -> str:
    return format_rounded(value) if value < 1000 else f"{value:,.0f}"


def _levels(scale: IntensityScale, values: Floats, range_m: Floats) -> Floats:
    """Return the reflectances of surfaces multiplied by the cosine of the angle of incidence."""
    reflectances = scale._reflectances(values)
    return reflectances if scale.compensated else reflectances / range_factors(range_m)

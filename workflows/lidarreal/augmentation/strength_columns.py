"""Handle all columns of a recording that contain the strength of returns.

Sensors often record several such columns, for example signal counts and a reflectivity. One of them
defines the energies of returns. The others are related to it by factors, which are fitted to the
recorded returns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.columns.column_names import STRENGTHS
from lidarsim.columns.sweep import Columns
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Floats
from lidarsim.sensor.reflectivity import SCALES, ByteScale
from lidarsim.sensor.sensor import Sensor

from .detection_threshold import DetectionThreshold, detection_threshold
from .intensity_fit import Quantization, RecordedReturns, is_valid, range_factors, smallest_positive
from .intensity_scale import IntensityScale

# Columns that contain the strength of returns. Ambient light, such as `ambient` and `near_ir`, does
# not depend on the return.
_NAMES = (*STRENGTHS, "signal", "reflectance", "amplitude")
_MIN_STEPS = 5  # smallest value, in steps, that is used to fit a factor
_MIN_RETURNS = 20
_COARSE_STEPS = 10  # values below this, in steps, are resolved poorly
_MAX_CODE_ERROR = 0.03  # maximum relative error of the factor of 8-bit codes on a known scale


@dataclass(frozen=True)
class StrengthColumns:
    """Relationships between all strength columns of a recording and received energies.

    Ambient light and other columns are not changed.

    Attributes
    ----------
    scale
        Scale of the column that defines the energies.
    others
        Scales of all other columns.
    threshold
        Detection threshold of the sensor.
    """

    scale: IntensityScale
    others: tuple[IntensityScale, ...]
    threshold: DetectionThreshold

    @classmethod
    def for_recording(
        cls,
        recording: Recording,
        model: Sensor | None = None,
        assumed_reflectance: float | None = None,
    ) -> Self:
        """Determine the scales of a recording from at most five sweeps.

        The parameters and errors are those of `IntensityScale.for_recording`.
        """
        returns = RecordedReturns.from_recording(recording)
        if assumed_reflectance is not None:
            scale = IntensityScale.with_reflectance(assumed_reflectance)
            threshold = detection_threshold(scale, None, returns.range_m, model)
            return cls(scale, (), threshold)
        scale = IntensityScale.from_returns(recording, returns, model)
        intensity = returns.columns[scale.column]
        threshold = detection_threshold(scale, intensity, returns.range_m, model)
        names = dict.fromkeys((*_NAMES, recording.info.intensity_column or scale.column))
        energy = scale.energies(intensity, returns.range_m)
        others = [
            _fit_column(name, returns, energy, scale, model)
            for name in names
            if name in returns.columns and name != scale.column
        ]
        return cls(scale, tuple(other for other in others if other is not None), threshold)

    @property
    def note(self) -> str:
        """Sentences about assumed or fitted values, for the user.

        They are empty if everything is known.
        """
        threshold = "" if self.threshold.is_known else self.threshold.note
        return " ".join(filter(None, (self.scale.note, threshold)))

    def energies(self, columns: Columns, range_m: Floats) -> Floats:
        """Return the received energies of recorded returns.

        The main column may be a coarse code. If it resolves a weak return poorly, the energy comes
        from a column with a finer resolution.

        Parameters
        ----------
        columns
            Columns of a sweep. Arrays of shape (n,).
        range_m
            Ranges in meters. Shape (n,).

        Returns
        -------
        array
            Energies. Shape (n,).
        """
        energies = self.scale.energies(columns.get(self.scale.column), range_m)
        if not self.scale.column or not self.scale.quantization.steps_per_unit:
            return energies
        step = self.scale.step_energies(range_m, 1)
        for scale in self.others:
            values = columns.get(scale.column)
            if values is None:
                continue
            finer_step = scale.step_energies(range_m, 1)
            is_coarse = (energies < _COARSE_STEPS * step) & (finer_step < step / 2)
            rows = np.flatnonzero(is_coarse & is_valid(np.asarray(values)))
            energies[rows] = scale.energies(np.asarray(values)[rows], range_m[rows])
            step = np.where(is_coarse, finer_step, step)
        return energies

    def intensities(
        self, energy: AnyFloats, range_m: AnyFloats, saturation: float = np.inf
    ) -> dict[str, AnyArray]:
        """Return the values of all strength columns for new returns.

        Parameters
        ----------
        energy
            Received energies. Shape (n,).
        range_m
            Ranges in meters. Shape (n,).
        saturation
            Energy at which the receiver saturates.

        Returns
        -------
        dict
            Arrays of shape (n,), keyed by column name. Empty without an intensity column.
        """
        return {
            scale.column: scale.intensities(scale.clip(energy, saturation), range_m)
            for scale in self._scales
        }

    def scale_intensities(
        self,
        columns: Columns,
        old_energy: AnyFloats,
        new_energy: AnyFloats,
        old_range_m: AnyFloats,
        new_range_m: AnyFloats,
        saturation: float = np.inf,
    ) -> dict[str, AnyArray]:
        """Return the values of all strength columns after energies or ranges have changed.

        The other parameters are those of `IntensityScale.scale_intensities`. Columns that the sweep
        lacks are omitted.

        Parameters
        ----------
        columns
            Columns of a sweep. Arrays of shape (n,).
        saturation
            Energy at which the receiver saturates.

        Returns
        -------
        dict
            Arrays of shape (n,), keyed by column name.
        """
        return {
            scale.column: scale.scale_intensities(
                columns[scale.column],
                old_energy,
                scale.clip(new_energy, saturation),
                old_range_m,
                new_range_m,
            )
            for scale in self._scales
            if scale.column in columns
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the strength columns."""
        return tuple(scale.column for scale in self._scales)

    @property
    def _scales(self) -> tuple[IntensityScale, ...]:
        return (self.scale, *self.others) if self.scale.column else ()


class _Factor(NamedTuple):
    """Ratio of recorded values to reflectances or energies."""

    white: float
    compensated: bool
    spread: float  # interquartile range of the logarithm


def _fit_column(
    name: str,
    returns: RecordedReturns,
    energy: Floats,
    primary: IntensityScale,
    model: Sensor | None,
) -> IntensityScale | None:
    """Fit the scale of a column to the energies of returns.

    Return None if too few returns have usable values, such as in a column that is always 0.
    """
    recorded = returns.columns[name]
    valid = is_valid(recorded) & (energy > 0)
    if not recorded[valid].any():
        return None
    quantization = Quantization.from_values(recorded[valid])
    values = recorded.astype(np.float64)
    steps = quantization.steps_per_unit
    lowest = _MIN_STEPS / steps if steps else 0.0
    used = valid & (values > lowest) & (values < quantization.max_value)
    if used.sum() < _MIN_RETURNS:
        return None
    received = energy[used] * primary.near.at(returns.range_m[used])
    factor = min(
        _fit_factor(values[used], received / range_factors(returns.range_m[used]), True),
        _fit_factor(values[used], received, False),
        key=lambda factor: factor.spread,
    )
    scale = replace(
        primary,
        column=name,
        dtype=recorded.dtype,
        quantization=quantization,
        white=factor.white,
        compensated=factor.compensated,
        codes=None,
        codes_per_unit=1.0,
        smallest=smallest_positive(values[valid]),
        note="",
    )
    codes = _matching_codes(scale, model)
    return scale if codes is None else scale.with_codes(codes)


def _fit_factor(values: Floats, expected: Floats, compensated: bool) -> _Factor:
    lower, median, upper = np.quantile(np.log(values / expected), (0.25, 0.5, 0.75))
    return _Factor(float(np.exp(median)), compensated, float(upper - lower))


def _matching_codes(scale: IntensityScale, model: Sensor | None) -> ByteScale | None:
    """Return the scale of the manufacturer whose codes have the fitted factor."""
    if not (scale.compensated and scale.quantization.is_byte):
        return None
    candidates = SCALES if model is None else {"": SCALES[model.optics.reflectivity]}
    for codes in candidates.values():
        if abs(scale.white / scale.with_codes(codes).white - 1) < _MAX_CODE_ERROR:
            return codes
    return None

"""Determine the energy below which the sensor of a recording loses returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.media.materials import normal_incidence_energy
from lidarsim.numerics.arrays import AnyArray, Floats
from lidarsim.sensor.noise import TARGET_REFLECTANCE
from lidarsim.sensor.sensor import Sensor
from lidarsim.words import format_rounded

from .intensity_fit import range_of_energy, weakest_energy
from .intensity_scale import IntensityScale

# Maximum range of the sensor relative to the largest recorded range, if its model is unknown.
_MAX_RATIO = 2.0


@dataclass(frozen=True)
class DetectionThreshold:
    """Energy at which half of the returns are detected.

    Attributes
    ----------
    energy
        Threshold on the scale of the simulator. It is 0 if all returns are detected.
    range_m
        Range in meters at which half of the pulses are detected on a perpendicular surface with
        10 % reflectance.
    is_known
        Whether the threshold is from the data sheet of the sensor.
    note
        Sentence for the user.
    """

    energy: float
    range_m: float
    is_known: bool
    note: str


def detection_threshold(
    scale: IntensityScale,
    intensity: AnyArray | None,
    range_m: Floats,
    model: Sensor | None = None,
) -> DetectionThreshold:
    """Determine the detection threshold of the sensor of a recording.

    The threshold is that of the sensor model, if the model was loaded with
    ``performance="datasheet"``. Otherwise it is estimated from the weakest returns.

    Parameters
    ----------
    scale
        Intensity scale of the recording.
    intensity
        Recorded intensities of some sweeps, or None if there are none. Shape (n,).
    range_m
        Ranges in meters. Shape (n,).
    model
        Sensor model of the recording, or None if it is unknown.

    Notes
    -----
    The estimate is too high if no surface in the recording is so dark or so distant that its
    returns are lost.
    """
    if model is not None and model.noise is not None and model.noise.threshold > 0:
        energy = model.noise.threshold
        source = "from the data sheet"
    elif len(range_m):
        energies = scale.energies(intensity, range_m)
        energy = weakest_energy(energies, range_m, scale.step_energies(range_m))
        source = "estimated from the weakest returns"
        limit_m = _MAX_RATIO * float(np.max(range_m))
        if model is not None and np.isfinite(model.max_range_m):
            limit_m = model.max_range_m
        lowest = TARGET_REFLECTANCE * float(normal_incidence_energy(limit_m))
        if energy < lowest:
            energy = lowest
            source = "limited by the largest range"
    else:
        return DetectionThreshold(0.0, np.inf, False, "There are no returns, so none are lost.")
    distance = range_of_energy(energy, TARGET_REFLECTANCE)
    return DetectionThreshold(
        energy,
        distance,
        source == "from the data sheet",
        f"Half of the returns from a surface with 10 % reflectance are detected at "
        f"{format_rounded(distance)} m ({source}).",
    )

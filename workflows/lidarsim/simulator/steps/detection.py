"""Detection of the signals that exceed a receiver's threshold, and random loss of returns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...numerics.arrays import Bools, Floats, Integers
from ...numerics.random_numbers import Purpose, normal, uniform
from ...sensor.noise import THRESHOLD_SIGMAS, Noise
from ..returns import PulseReturns, number_within_ray
from .step import PulseBatch, PulseStep, Role, Setup

DETECTION = Purpose(4, "energy noise of a return")
LOSS = Purpose(5, "whether a return is lost")


class DetectionStep(PulseStep):
    """Simulation step that drops weak returns in waveforms, and a random fraction of all returns.

    The fraction is `Noise.dropout`.

    Without waveforms, `SeparationStep` drops returns with the same function, `is_detected`.
    """

    role = Role.CHANGES
    reads = "ray", "amplitude"
    purposes = LOSS, DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the receiver finds returns in waveforms and may lose some of them."""
        return setup.noise.loses_returns and setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Keep the detected returns of a batch."""
        scan, ray = batch.keys.scan_and_number(returns.ray)
        detected_mask = is_detected(
            self.setup.noise, returns.height, scan, ray, number_within_ray(returns.ray)
        )
        return returns.take(detected_mask)


def is_detected(
    noise: Noise, energy: Floats, scan: Integers, ray: Integers, number: Integers
) -> Bools:
    """Return whether returns with the given energies are detected.

    `energy` is the energy of a return, or its height in the waveform. `scan`, `ray` (the ray's
    number in its scan) and `number` (the return's number in its ray, from 0) are the keys of the
    random numbers.

    The signal with normally distributed noise must exceed a threshold. If the energy equals the
    threshold, half of the returns are detected. At 1.4 times this energy, 97.7 % are detected, and
    at a fifth of it, 3 in 100,000.
    """
    detected_mask = uniform(noise.seed, LOSS, scan, ray, number) >= noise.dropout
    if noise.detection_range_m is not None:
        detected_mask &= exceeds_threshold(noise, DETECTION, energy, scan, ray, number)
    return detected_mask


def exceeds_threshold(
    noise: Noise,
    purpose: Purpose,
    energy: Floats,
    scan: Integers,
    ray: Integers,
    number: ArrayLike = 0,
) -> Bools:
    """Return whether signals with noise exceed the threshold.

    The arguments are the same as in `is_detected`, with a purpose for the random numbers.
    """
    signal = THRESHOLD_SIGMAS * (energy / noise.threshold - 1)
    return np.asarray(signal + normal(noise.seed, purpose, scan, ray, number) > 0)

"""Detection: which signals of a receiver pass its threshold, and which returns are lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Integers
from ..sensor.noise import THRESHOLD_SIGMAS, Noise
from ..sensor.random_numbers import Purpose, normal, uniform
from .returns import PulseReturns, numbers
from .step import PulseBatch, PulseStep, Role, Setup

DETECTION = Purpose(4, "noise of a return's energy")
LOSS = Purpose(5, "whether a return is lost")


class DetectionStep(PulseStep):
    """Drops weak returns of waveforms, and a share of all returns.

    Without waveforms, `SeparationStep` drops them.
    """

    role = Role.CHANGES
    reads = "ray", "amplitude"
    purposes = LOSS, DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return True if the noise loses returns and returns are found in waveforms."""
        return setup.noise.loses and setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the detected returns."""
        scan, ray = batch.keys.scan_and_number(returns.ray)
        detected_mask = detected(self.setup.noise, returns.height, scan, ray, numbers(returns.ray))
        return returns.take(detected_mask)


def detected(
    noise: Noise, energy: Floats, scan: Integers, ray: Integers, number: Integers
) -> Bools:
    """Return whether returns (n,) are detected: (n,).

    The signal with its normally distributed noise has to pass a threshold: at an energy equal to
    the threshold half of the returns are detected, at 1.4 times as much 97.7 %, and at a fifth of
    the threshold 3 in 100,000.
    """
    detected_mask = uniform(noise.seed, LOSS, scan, ray, number) >= noise.dropout
    if noise.detection_range_m is not None:
        detected_mask &= passes(noise, DETECTION, energy, scan, ray, number)
    return detected_mask


def passes(
    noise: Noise,
    purpose: Purpose,
    energy: Floats,
    scan: Integers,
    ray: Integers,
    number: ArrayLike = 0,
) -> Bools:
    """Return whether signals (n,) with their noise pass the threshold, see `detected`: (n,)."""
    signal = THRESHOLD_SIGMAS * (energy / noise.threshold - 1)
    return np.asarray(signal + normal(noise.seed, purpose, scan, ray, number) > 0)

"""Detection of the signals that exceed a receiver's threshold, and random loss of returns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...numerics.arrays import Bools, Floats, Integers, to_writable
from ...numerics.random_numbers import Purpose, normal, quantiles, uniform
from ...sensor.noise import THRESHOLD_SIGMAS, Noise
from ..returns import PulseReturns, number_within_ray, require_column
from .particles import random_keys
from .step import PulseBatch, PulseStep, Role, Setup

DETECTION = Purpose(4, "energy noise of a return")
LOSS = Purpose(5, "whether a return is lost")


class DetectionStep(PulseStep):
    """Simulation step that drops weak returns, and a random fraction of all returns.

    The fraction is `Noise.dropout`. The step applies to waveforms and recorded pulses. Otherwise,
    `SeparationStep` drops returns in the same way as `is_detected`.

    A recorded return was detected with its recorded energy. The step therefore draws the noise of
    its energy from the part of the normal distribution with which it was detected.
    """

    role = Role.CHANGES
    reads = "ray", "amplitude"
    purposes = LOSS, DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether returns may be lost that `SeparationStep` does not drop."""
        return setup.noise.loses_returns and (setup.in_waveforms or setup.is_recorded)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Keep the detected returns of a batch."""
        if batch.recorded is not None:
            return self._detected_again(returns, batch)
        scan, ray = batch.keys.scan_and_number(returns.ray)
        number = number_within_ray(returns.ray)
        return returns.take(is_detected(self.setup.noise, returns.height, scan, ray, number))

    def _detected_again(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Keep the detected returns of a batch of recorded pulses."""
        from . import detection_loops  # imported here because numba takes half a second to import

        noise = self.setup.noise
        recorded_noise = require_column(self.setup.recorded_noise)
        recorded = require_column(batch.recorded)
        row_indices = np.empty(len(returns.ray), np.int64)
        count = detection_loops.find_detected(
            to_writable(returns.ray, np.int64),
            to_writable(returns.height),
            to_writable(require_column(returns.source), np.int32),
            to_writable(recorded.energy),
            detection_loops.DetectionLimits(
                float(noise.dropout),
                float(recorded_noise.dropout),
                float(noise.threshold),
                THRESHOLD_SIGMAS,
                quantiles(),
            ),
            random_keys(noise.seed, (LOSS, DETECTION), batch.keys, 0),
            row_indices,
        )
        return returns if count == len(row_indices) else returns.take(row_indices[:count])


def is_detected(
    noise: Noise,
    energy: Floats,
    scan: Integers,
    ray: Integers,
    number: Integers,
) -> Bools:
    """Return whether returns with the given energies are detected.

    `energy` is the energy of a return, or its height in the waveform. `scan`, `ray` (the ray's
    number in its scan) and `number` (the return's number in its ray, from 0) are the keys of the
    random numbers.

    The signal with normally distributed noise must exceed a threshold. If the energy equals the
    threshold, half of the returns are detected. At 1.4 times this energy, 97.7 % are detected, and
    at a fifth of it, 3 in 100,000.
    """
    detected_mask = np.ones(len(energy), np.bool_)
    if noise.dropout:
        detected_mask &= uniform(noise.seed, LOSS, scan, ray, number) >= noise.dropout
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

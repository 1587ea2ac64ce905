"""Detection of the signals that exceed a receiver's threshold, and random loss of returns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...numerics.arrays import Bools, Floats, Integers
from ...numerics.random_numbers import Purpose, normal, quantiles, raw, uniform
from ...sensor.noise import THRESHOLD_SIGMAS, Noise
from ..returns import PulseReturns, number_within_ray, require_column
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
        noise = self.setup.noise
        earlier_noise = self.setup.recorded_noise
        if batch.recorded is None or earlier_noise is None:
            scan, ray = batch.keys.scan_and_number(returns.ray)
            number = number_within_ray(returns.ray)
            return returns.take(is_detected(noise, returns.height, scan, ray, number))
        # Most signals exceed the threshold with any noise, so they need no random numbers.
        uncertain = returns.height <= (1 - quantiles()[0] / THRESHOLD_SIGMAS) * noise.threshold
        if noise.dropout or earlier_noise.dropout:
            uncertain[:] = True
        rows = np.flatnonzero(uncertain)
        if not len(rows):
            return returns
        scan, ray = batch.keys.scan_and_number(returns.ray[rows])
        number = rows - np.searchsorted(returns.ray, returns.ray[rows])
        source = require_column(returns.source)[rows]
        recorded = source >= 0
        detected_mask = ~uncertain
        detected_mask[rows] = is_detected(
            noise,
            returns.height[rows],
            scan,
            ray,
            number,
            dropout=np.where(recorded, earlier_noise.dropout, noise.dropout),
            earlier=np.where(recorded, batch.recorded.energy[source], np.inf),
        )
        return returns.take(detected_mask)


def is_detected(
    noise: Noise,
    energy: Floats,
    scan: Integers,
    ray: Integers,
    number: Integers,
    *,
    dropout: Floats | float | None = None,
    earlier: Floats | None = None,
) -> Bools:
    """Return whether returns with the given energies are detected.

    `energy` is the energy of a return, or its height in the waveform. `scan`, `ray` (the ray's
    number in its scan) and `number` (the return's number in its ray, from 0) are the keys of the
    random numbers. `dropout` (n,) overrides `Noise.dropout`. `earlier` (n,) are the energies with
    which returns were detected before, or inf for returns that were not.

    The signal with normally distributed noise must exceed a threshold. If the energy equals the
    threshold, half of the returns are detected. At 1.4 times this energy, 97.7 % are detected, and
    at a fifth of it, 3 in 100,000.
    """
    if dropout is None:
        dropout = noise.dropout
    detected_mask = np.ones(len(energy), np.bool_)
    if np.any(dropout):
        detected_mask &= uniform(noise.seed, LOSS, scan, ray, number) >= dropout
    if noise.detection_range_m is not None and earlier is None:
        detected_mask &= exceeds_threshold(noise, DETECTION, energy, scan, ray, number)
    elif noise.detection_range_m is not None and earlier is not None:
        detected_mask &= _is_detected_again(noise, energy, earlier, scan, ray, number)
    return detected_mask


def _is_detected_again(
    noise: Noise,
    energy: Floats,
    earlier: Floats,
    scan: Integers,
    ray: Integers,
    number: Integers,
) -> Bools:
    """Return whether returns are detected that were already detected with another energy.

    `earlier` (n,) are the energies with which the returns were detected, or inf for other returns.
    """
    limit = -THRESHOLD_SIGMAS * (earlier / noise.threshold - 1)
    lowest = np.searchsorted(quantiles(), limit, side="right")  # quantiles that were not detected
    index = (raw(noise.seed, DETECTION, scan, ray, number) >> np.uint64(48)).astype(np.int64)
    index = lowest + index * (len(quantiles()) - lowest) // len(quantiles())
    signal = THRESHOLD_SIGMAS * (energy / noise.threshold - 1)
    return np.asarray(signal + quantiles()[index] > 0)


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

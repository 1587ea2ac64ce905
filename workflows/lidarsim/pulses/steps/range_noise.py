"""Range errors: noise, range walk and lasting errors.

The noise is larger for weak returns.
"""

from __future__ import annotations

import numpy as np

from ...numerics.arrays import Floats, Integers, Ints
from ...numerics.elementary import exp, log
from ...numerics.random_numbers import Purpose, normal
from ...sensor.noise import Noise
from ..returns import PulseReturns, require_column
from .step import PulseBatch, PulseStep, Role, Setup

RANGE = Purpose(1, "range noise of a return")
CHANNEL = Purpose(60, "range error of a channel")


class RangeNoiseStep(PulseStep):
    """Simulation step that adds errors to the reported ranges."""

    role = Role.ON_REPORTED
    effects = "Weak returns and range walk", "Systematic errors"
    reads = "ray", "distance", "energy", "amplitude", "number"
    writes = ("reported",)
    purposes = RANGE, CHANNEL

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the noise changes ranges."""
        earlier = setup.recorded_noise
        return setup.noise.has_range_errors or (earlier is not None and earlier.has_range_errors)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add reported ranges to the returns of a batch."""
        earlier = self.setup.recorded_noise
        if earlier is None:
            return returns._replace(reported=self._reported(self.setup.noise, returns, batch))
        # The other noise is already in the recording.
        is_added = require_column(returns.source) < 0
        reported = returns.distance.copy()
        for noise, rows in ((self.setup.noise, is_added), (earlier, ~is_added)):
            if noise.has_range_errors and rows.any():
                reported[rows] = self._reported(noise, returns.take(rows), batch)
        return returns._replace(reported=reported)

    def _reported(self, noise: Noise, returns: PulseReturns, batch: PulseBatch) -> Floats:
        """Return the ranges in meters that are reported with the given noise."""
        # The leading edge of a clipped pulse is the same as that of the whole pulse.
        height = returns.height if self.setup.in_waveforms else returns.energy
        scan, ray = batch.keys.scan_and_number(returns.ray)
        distance = returns.distance
        if noise.channel_bias_m or noise.warm_up_m:
            channel = returns.ray % self.setup.sensor.channels
            distance = distance + lasting_errors(noise, channel, batch.firings.times(returns.ray))
        return noisy_ranges(noise, distance, height, scan, ray, require_column(returns.number))


def noisy_ranges(
    noise: Noise,
    distance: Floats,
    energy: Floats | None,
    scan: Integers,
    ray: Integers,
    number: Integers,
) -> Floats:
    """Return the reported ranges in meters, which are at least 0.

    `distance` (n,) is in meters. `energy` (n,) is the energy, or the height of the return in a
    waveform. It may be None if neither noise nor range walk depends on it. `scan`, `ray` and
    `number` (n,) are the numbers of scans, of rays in their scan, and of returns in their ray.
    """
    sigma = noise.range_m + noise.range_per_m * distance
    if noise.range_at_threshold_m and energy is not None:
        weak = noise.range_at_threshold_m * noise.threshold / energy
        sigma = np.sqrt(sigma * sigma + weak * weak)
    if noise.walk_m and energy is not None:
        distance = distance - range_walk(noise, energy)
    if sigma.any():  # avoids the cost of drawing random numbers
        distance = distance + sigma * normal(noise.seed, RANGE, scan, ray, number)
    return np.maximum(distance, 0)


def range_walk(noise: Noise, energy: Floats) -> Floats:
    """Return the range walk in meters, relative to a return at the detection threshold.

    A Gaussian pulse whose height is ``energy / threshold`` times a fixed threshold crosses the
    threshold √(2 ln(energy / threshold)) standard deviations before its maximum.
    """
    ratio = np.maximum(energy / noise.threshold, 1)
    return np.asarray(noise.walk_m * np.sqrt(2 * log(ratio)))


def lasting_errors(noise: Noise, channel: Integers, times_ns: Ints) -> Floats:
    """Return the lasting range errors, in meters, for the given channels and times.

    `times_ns` are nanoseconds since the start of the survey.
    """
    biases = np.asarray(noise.channel_bias_m, np.float64)
    if not biases.ndim:
        channels = np.arange(channel.max(initial=0) + 1)
        biases = biases * normal(noise.seed, CHANNEL, 0, channels)
    errors = biases[channel]
    if noise.warm_up_m:
        errors = errors + noise.warm_up_m * exp(times_ns * (-1e-9 / noise.warm_up_s))
    return errors

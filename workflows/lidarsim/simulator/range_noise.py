"""Errors of ranges: noise, of weak returns too, range walk, and errors that last."""

from __future__ import annotations

from ..sensor.noise import Purpose
from .returns import PulseReturns, made
from .step import PulseBatch, PulseStep, Setup


class RangeNoiseStep(PulseStep):
    """Moves the ranges of the returns that are kept."""

    effects = "Weak returns and range walk", "Errors that last"
    reads = "ray", "distance", "energy", "amplitude", "number"
    writes = ("reported",)
    purposes = Purpose.RANGE, Purpose.CHANNEL
    of_kept = True

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.moves_ranges

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        # The leading edge of a clipped pulse is that of the whole pulse.
        height = returns.height if self.setup.in_waveforms else returns.energy
        key = *batch.keys.of(returns.ray), made(returns.number)
        noise, distance = self.setup.noise, returns.distance
        if noise.channel_bias_m or noise.warm_up_m:
            channel = returns.ray % self.setup.sensor.channels
            distance = distance + noise.offsets(channel, batch.firings.times(returns.ray))
        return returns._replace(reported=noise.ranges(distance, height, *key))

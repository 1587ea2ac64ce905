"""Noise of ranges, of weak returns too, and range walk."""

from __future__ import annotations

from ..sensor.noise import Purpose
from .returns import PulseReturns, made
from .step import PulseBatch, PulseStep, Setup


class RangeNoiseStep(PulseStep):
    """Moves the ranges of the returns that are kept."""

    effects = ("Weak returns and range walk",)
    reads = "ray", "distance", "energy", "amplitude", "number"
    writes = ("reported",)
    purposes = (Purpose.RANGE,)
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
        return returns._replace(reported=self.setup.noise.ranges(returns.distance, height, *key))

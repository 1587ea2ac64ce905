"""Noise of ranges, of weak returns too, and range walk."""

from __future__ import annotations

from ..sensor.noise import Purpose
from .hits import Hits, made
from .step import Batch, Setup, Step


class RangeNoise(Step):
    """Moves the ranges of the returns that are kept."""

    effects = ("Weak returns and range walk",)
    reads = "ray", "distance", "energy", "amplitude", "number"
    writes = ("reported",)
    purposes = (Purpose.RANGE,)
    of_kept = True

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `Step.applies`."""
        return setup.noise.moves_ranges

    def apply(self, returns: Hits, batch: Batch) -> Hits:
        """See `Step.apply`."""
        height = returns.energy if returns.amplitude is None else returns.amplitude
        key = *batch.keys.of(returns.ray), made(returns.number)
        return returns._replace(reported=self.setup.noise.ranges(returns.distance, height, *key))

"""Noise of the directions in which beams are sent."""

from __future__ import annotations

import numpy as np

from ..sensor.noise import Purpose
from .returns import PulseReturns
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes


class AngleNoiseStep(PulseStep):
    """Casts beams in directions with noise; their reported directions have none."""

    purposes = Purpose.ACROSS, Purpose.UP

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.angle_deg > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`."""
        if setup.several:  # then some beams are turned at a time
            return Memory()
        return Memory(kept=32 * sizes.rays, casting=20 * sizes.rays)  # a direction each

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        rays = np.arange(batch.start, batch.stop)
        batch.offsets = np.stack(self.setup.noise.angles(*batch.keys.of(rays)), axis=1)
        return returns

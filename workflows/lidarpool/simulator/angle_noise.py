"""Errors of the directions in which beams are sent."""

from __future__ import annotations

import numpy as np

from ..base.vectors import hypot
from ..sensor.noise import Purpose
from .returns import PulseReturns
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes


class AngleNoiseStep(PulseStep):
    """Casts beams in directions with errors; their reported directions have none."""

    effects = ("Errors that last",)
    purposes = Purpose.ACROSS, Purpose.UP

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.moves_beams

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`."""
        if setup.several:  # then some beams are turned at a time
            return Memory()
        return Memory(kept=32 * sizes.rays, casting=20 * sizes.rays)  # a direction each

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        rays, noise, sensor = (
            np.arange(batch.start, batch.stop),
            self.setup.noise,
            batch.firings.sensor,
        )
        across, up = noise.angles(*batch.keys.of(rays))
        if noise.ripple_deg:
            firing, channel = np.divmod(rays, sensor.channels)
            beside = noise.ripple(sensor.head.azimuths(batch.firings.numbers))
            # A degree of azimuth is less across a beam, the steeper it looks.
            across += beside.take(firing) * hypot(*sensor.ahead.T[:2]).take(channel)
        batch.offsets = np.stack([across, up], axis=1)
        return returns

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
        rays, ripple = np.arange(batch.start, batch.stop), self.setup.noise.encoder_ripple
        across, up = self.setup.noise.angles(*batch.keys.of(rays))
        if ripple is not None:
            sensor = batch.firings.sensor
            firing, channel = np.divmod(rays, sensor.channels)
            beside = ripple.at(sensor.head.azimuths(batch.firings.numbers)).take(firing)
            # A degree of azimuth moves a beam by less, the steeper it looks.
            x, y, _ = sensor.ahead.T
            across = across + beside * hypot(x, y).take(channel)
        batch.offsets = np.stack([across, up], axis=1)
        return returns

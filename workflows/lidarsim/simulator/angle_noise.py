"""Errors of the directions in which beams are sent."""

from __future__ import annotations

import numpy as np

from ..base.elementary import sin_cos
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
        return setup.noise.angle_deg > 0 or setup.noise.ripple_deg > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`."""
        if setup.several:  # then some beams are turned at a time
            return Memory()
        return Memory(kept=32 * sizes.rays, casting=20 * sizes.rays)  # a direction each

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        noise, sensor = self.setup.noise, self.setup.sensor
        across, up = offsets = np.zeros((2, batch.stop - batch.start))
        if noise.angle_deg:
            across[:], up[:] = noise.angles(*batch.keys.of(np.arange(batch.start, batch.stop)))
        if noise.ripple_deg:
            azimuth = sensor.head.azimuths(batch.firings.numbers[batch.rows])
            sin, _ = sin_cos(noise.ripple_cycles * azimuth + np.radians(noise.ripple_phase_deg))
            # A degree of azimuth is less across a beam, the steeper it looks.
            level = hypot(*sensor.ahead.T[:2])
            across += ((np.radians(noise.ripple_deg) * sin)[:, None] * level).reshape(-1)
        batch.offsets = offsets.T
        return returns

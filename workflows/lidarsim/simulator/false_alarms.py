"""False alarms: noise of a receiver that passes its threshold."""

from __future__ import annotations

import numpy as np

from ..sensor.noise import Purpose
from ..sensor.optics import LIGHT_M_NS
from .returns import FALSE_ALARM, OF_RETURNS, PulseReturns, merged, unreal
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes


class FalseAlarmStep(PulseStep):
    """Adds false alarms to the returns of pulses."""

    effects = ("False alarms",)
    reads = "ray", "distance"
    writes = OF_RETURNS
    purposes = Purpose.ALARM, Purpose.PEAK

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.false_alarm_hz > 0

    @staticmethod
    def added(setup: Setup) -> float:
        """See `PulseStep.added`."""
        return setup.noise.false_alarm_hz * setup.sensor.gate_s

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: a cause of each return, and rays."""
        return Memory(kept=10 * sizes.returns, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        noise, sensor = self.setup.noise, self.setup.sensor
        rays = np.arange(batch.start, batch.stop)
        row, since, energy = noise.false_alarms(sensor.gate_s, *batch.keys.of(rays))
        distance = sensor.min_range_m + since * (LIGHT_M_NS * 1e9 / 2)
        return merged(returns, unreal(returns, rays[row], distance, energy, FALSE_ALARM))

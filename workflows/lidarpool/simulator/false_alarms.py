"""False alarms: noise of a receiver that passes its threshold."""

from __future__ import annotations

import numpy as np

from ..sensor.noise import Purpose
from ..sensor.optics import LIGHT_M_NS
from .hits import FALSE_ALARM, OF_RETURNS, Hits, merged, unreal
from .step import Batch, Memory, Setup, Sizes, Step


class FalseAlarms(Step):
    """Adds false alarms to the returns of pulses."""

    effects = ("False alarms",)
    reads = "ray", "distance"
    writes = OF_RETURNS
    purposes = Purpose.ALARM, Purpose.PEAK

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `Step.applies`."""
        return setup.noise.false_alarm_hz > 0

    @staticmethod
    def added(setup: Setup) -> float:
        """See `Step.added`."""
        return setup.noise.false_alarm_hz * setup.sensor.gate_s

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `Step.memory`."""
        return Memory(kept=10 * sizes.returns, casting=120 * sizes.beams)

    def apply(self, returns: Hits, batch: Batch) -> Hits:
        """See `Step.apply`."""
        noise, sensor = self.setup.noise, self.setup.sensor
        rays = np.arange(batch.start, batch.stop)
        row, since, energy = noise.false_alarms(sensor.gate_s, *batch.keys.of(rays))
        distance = sensor.min_range_m + since * (LIGHT_M_NS * 1e9 / 2)
        return merged(returns, unreal(returns, rays[row], distance, energy, FALSE_ALARM))

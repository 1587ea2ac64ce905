"""False alarms, which occur when receiver noise exceeds the detection threshold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...columns.table import CAUSES
from ...numerics.arrays import Floats, Indices, Integers
from ...numerics.elementary import exp, log
from ...numerics.random_numbers import Purpose, uniform
from ...sensor.noise import THRESHOLD_SIGMAS, Noise
from ...sensor.optics import LIGHT_M_NS
from ..returns import RETURN_COLUMNS, PulseReturns, merge_returns, returns_without_surface
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

FALSE_ALARM = CAUSES.index("false alarm")
ALARM = Purpose(20, "time until the next false alarm")
PEAK = Purpose(21, "energy of a false alarm")


class FalseAlarms(NamedTuple):
    """False alarms of rays.

    All arrays have shape (k,).
    """

    row: Indices  # rows of the rays that have the alarms
    time_s: Floats  # time since the receiver opened, seconds
    energy: Floats  # on the scale of `Noise.threshold`


class FalseAlarmStep(PulseStep):
    """Simulation step that adds false alarms to the returns of pulses."""

    role = Role.RECEIVES
    effects = ("False alarms",)
    reads = "ray", "distance"
    writes = RETURN_COLUMNS
    causes = (FALSE_ALARM,)
    purposes = ALARM, PEAK

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the receiver has false alarms."""
        return setup.noise.false_alarm_hz > 0

    @staticmethod
    def added_returns(setup: Setup) -> float:
        """Return the mean number of false alarms while the receiver waits for a pulse."""
        return setup.noise.false_alarm_hz * setup.sensor.gate_s

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of the rays and of the return causes, in bytes."""
        return Memory(retained=10 * sizes.return_count, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add the false alarms of rays to the returns of a batch."""
        sensor = self.setup.sensor
        rays = np.arange(batch.start, batch.stop)
        scan, ray = batch.keys.scan_and_number(rays)
        alarms = false_alarms(self.setup.noise, sensor.gate_s, scan, ray)
        distance = sensor.min_range_m + alarms.time_s * (LIGHT_M_NS * 1e9 / 2)
        alarm_returns = returns_without_surface(
            returns, rays[alarms.row], distance, alarms.energy, FALSE_ALARM
        )
        return merge_returns(returns, alarm_returns)


def false_alarms(noise: Noise, gate_s: float, scan: Integers, ray: Integers) -> FalseAlarms:
    """Sample false alarms of rays whose receivers are open for `gate_s` seconds.

    False alarms occur at a constant rate. Each is a maximum of the receiver noise above the
    threshold. Maxima of normally distributed narrowband noise follow a Rayleigh distribution (Rice
    1944).
    """
    ray_indices = np.arange(len(ray))
    since_s = np.zeros(len(ray))
    alarms: list[FalseAlarms] = []
    while len(ray_indices) or not alarms:
        number = len(alarms)
        # The time until the next false alarm is exponentially distributed.
        uniform_numbers = uniform(noise.seed, ALARM, scan[ray_indices], ray[ray_indices], number)
        in_gate = np.flatnonzero(uniform_numbers > exp(-noise.false_alarm_hz * (gate_s - since_s)))
        ray_indices = ray_indices[in_gate]
        since_s = since_s[in_gate] - log(uniform_numbers[in_gate]) / noise.false_alarm_hz
        since_s = np.minimum(since_s, gate_s)
        complement = 1 - uniform(noise.seed, PEAK, scan[ray_indices], ray[ray_indices], number)
        peak = np.sqrt(1 - 2 / (THRESHOLD_SIGMAS * THRESHOLD_SIGMAS) * log(complement))
        alarms.append(FalseAlarms(ray_indices, since_s, noise.threshold * peak))
    return FalseAlarms(*map(np.concatenate, zip(*alarms, strict=True)))

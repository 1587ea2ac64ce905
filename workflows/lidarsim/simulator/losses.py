"""Faults of sensors: dirt on the window, and channels, packets and scans without returns."""

from __future__ import annotations

import numpy as np

from ..base.arrays import owned
from ..base.elementary import sin_cos
from ..base.vectors import hypot
from ..sensor.random_numbers import Purpose, uniform
from .returns import PulseReturns, required
from .step import PulseBatch, PulseStep, Role, Setup

PACKET = Purpose(61, "whether a packet is lost")


class DirtStep(PulseStep):
    """Takes energy from light that passes a dirty part of the window."""

    role = Role.CHANGES
    effects = ("Faults",)
    reads = "ray", "energy"
    writes = ("energy",)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dirt"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        sensor = self.setup.sensor
        beams = np.arange(batch.start, batch.stop)
        share = np.ones(len(beams))
        x, y, z = sensor.directions(batch.firings.numbers[batch.rows]).reshape(-1, 3).T
        for one in self.setup.faults("dirt").values():
            begin, end = one.azimuth_deg or (0, 360)
            half = ((end - begin) % 360 or 360) / 2
            ends = begin + half, half, *(one.elevation_deg or (-90, 90))
            sin, cos = sin_cos(np.radians(ends))
            # Without angles of beams, which take long; a whole circle's sines are not exact.
            there = x * cos[0] + y * sin[0] >= cos[1] * hypot(x, y) - 1e-12
            there &= (z >= sin[2] - 1e-12) & (z <= sin[3] + 1e-12)
            if one.from_s or one.to_s is not None:
                there &= one.during(batch.firings.times(beams))
            share[there] *= required(one.transmission)
        share = share.repeat(batch.each)
        batch.hits, batch.air = (
            one and one._replace(energy=required(one.energy) * share.take(one.ray))
            for one in (returns, batch.air)
        )
        return required(batch.hits)


class LossStep(PulseStep):
    """Loses returns of dead channels and lost packets, and of scans that a frozen sensor lacks."""

    role = Role.CHANGES
    effects = ("Faults",)
    reads = ("ray",)
    purposes = (PACKET,)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dead_channels", "dropped_packets", "frozen"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        from . import fault_loops  # not before: numba takes half a second to import

        firings = batch.firings
        spec = batch.firings.spec
        seed = self.setup.noise.seed
        before, now = spec.repeats or (spec.ahead, 0)
        if spec.ahead != before - now:
            return returns.take(np.zeros(0, np.intp))
        faults = self.setup.faults("dead_channels", "dropped_packets")
        spans = np.array([fault.span_ns for fault in faults.values()]).reshape(-1, 2)
        channel = np.zeros((len(faults), firings.sensor.channels), np.bool_)
        firing = np.zeros((len(faults), len(firings.numbers)), np.bool_)
        for row, (place, fault) in enumerate(faults.items()):
            if fault.packet is None:
                channel[row, required(fault.channels)] = True
            else:
                packet = firings.numbers // fault.packet
                drawn = uniform(seed, PACKET, spec.station, packet, place)
                firing[row] = drawn < required(fault.share)
        rows = np.empty(len(returns.ray), np.int64)
        ray = owned(returns.ray, np.int64)
        count = fault_loops.remaining(ray, firings.times(ray), spans, firing, channel, rows)
        return returns if count == len(rows) else returns.take(rows[:count])

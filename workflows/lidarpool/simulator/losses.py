"""Faults of sensors: dirt on the window, and channels, packets and scans without returns."""

from __future__ import annotations

import numpy as np

from ..base.elementary import sin_cos
from ..base.vectors import hypot
from ..sensor.noise import Purpose, uniform
from .returns import PulseReturns, made
from .step import PulseBatch, PulseStep, Setup


class DirtStep(PulseStep):
    """Takes energy from light that passes a dirty part of the window."""

    effects = ("Faults",)
    reads = "ray", "energy"
    writes = ("energy",)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dirt"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        sensor, beams = self.setup.sensor, np.arange(batch.start, batch.stop)
        times, share = batch.firings.times(beams), np.ones(len(beams))
        rows = slice(batch.start // sensor.channels, batch.stop // sensor.channels)
        x, y, z = sensor.directions(batch.firings.numbers[rows]).reshape(-1, 3).T
        for one in self.setup.faults("dirt").values():
            begin, end = one.azimuth_deg or (0, 360)
            half = ((end - begin) % 360 or 360) / 2
            ends = begin + half, half, *(one.elevation_deg or (-90, 90))
            sin, cos = sin_cos(np.radians(ends))
            # Without angles of beams, which take long; a whole circle's sines are not exact.
            there = x * cos[0] + y * sin[0] >= cos[1] * hypot(x, y) - 1e-12
            there &= (z >= sin[2] - 1e-12) & (z <= sin[3] + 1e-12) & one.during(times)
            share[there] *= made(one.transmission)
        batch.hits, batch.air = (
            one and one._replace(energy=made(one.energy) * share[one.ray // batch.each])
            for one in (returns, batch.air)
        )
        return made(batch.hits)


class LossStep(PulseStep):
    """Loses returns of dead channels and lost packets, and of scans that a frozen sensor lacks."""

    effects = ("Faults",)
    reads = ("ray",)
    purposes = (Purpose.PACKET,)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dead_channels", "dropped_packets", "frozen"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        firings, spec = batch.firings, batch.firings.spec
        firing, channel = np.divmod(returns.ray, firings.sensor.channels)
        before, now = spec.repeats or (spec.ahead, 0)
        lost = np.full(len(firing), spec.ahead != before - now)
        times, seed = firings.times(returns.ray), self.setup.noise.seed
        for fault in self.setup.faults("dead_channels").values():
            lost |= np.isin(channel, made(fault.channels)) & fault.during(times)
        for place, fault in self.setup.faults("dropped_packets").items():
            packet = firings.numbers[firing] // made(fault.packet)
            drawn = uniform(seed, Purpose.PACKET, spec.station, packet, place)
            lost |= (drawn < made(fault.share)) & fault.during(times)
        return returns.take(~lost)

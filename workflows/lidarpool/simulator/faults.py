"""Faults of sensors: dirt, channels and packets without returns, stamps that are not the time."""

from __future__ import annotations

import numpy as np

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
        beams, firings = np.arange(batch.start, batch.stop), batch.firings
        times, share = firings.times(beams), np.ones(len(beams))
        azimuth, elevation = firings.angles(beams)
        for one in self.setup.faults("dirt").values():
            begin, end = one.azimuth_deg or (0, 360)
            low, high = one.elevation_deg or (-90, 90)
            there = (azimuth - begin) % 360 <= ((end - begin) % 360 or 360)
            there &= (elevation >= low) & (elevation <= high) & one.during(times)
            share[there] *= made(one.transmission)
        hits, air = (
            one and one._replace(energy=made(one.energy) * share[one.ray // batch.each])
            for one in (returns, batch.air)
        )
        batch.hits, batch.air = hits, air
        return made(hits)


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
            lost |= np.isin(channel, fault.channels) & fault.during(times)
        for place, fault in self.setup.faults("dropped_packets").items():
            packet = firings.numbers[firing] // fault.packet
            drawn = uniform(seed, Purpose.PACKET, spec.station, packet, place)
            lost |= (drawn < fault.share) & fault.during(times)
        return returns.take(~lost)


class StampStep(PulseStep):
    """Stamps returns as a sensor does whose clock jumps, or which sends old ones as new."""

    effects = ("Faults",)
    reads = ("ray",)
    writes = ("stamp",)
    of_kept = True

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("frozen", "time_jump"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        stamp, repeats = batch.firings.times(returns.ray), batch.firings.spec.repeats
        if repeats is not None:
            before, now = map(self.setup.survey.begins_ns, repeats)
            stamp += round(now - before)
        jumps = [one.jumps_ns(stamp) for one in self.setup.faults("time_jump").values()]
        return returns._replace(stamp=sum(jumps, stamp))

"""Faults of sensors: dirt, channels and packets without returns, stamps that are not the time."""

from __future__ import annotations

import numpy as np

from ..sensor.noise import Purpose, uniform
from .returns import PulseReturns, made
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes


class DirtStep(PulseStep):
    """Takes energy from the light that passes a dirty part of the window, out and back."""

    effects = ("Faults",)
    reads = "ray", "energy"
    writes = ("energy",)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dirt"))

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: directions, angles and shares of beams."""
        return Memory(casting=80 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        beams = np.arange(batch.start, batch.stop)
        times, share = batch.firings.times(beams), np.ones(len(beams))
        active = [one for _, one in self.setup.faults("dirt") if one.during(times).any()]
        if not active:
            return returns
        azimuth, elevation = batch.firings.angles(beams)
        for one in active:
            share[one.during(times) & one.covers(azimuth, elevation)] *= one.transmission or 0.0

        def dimmed(hits: PulseReturns) -> PulseReturns:
            return hits._replace(energy=made(hits.energy) * share[hits.ray // batch.each])

        if batch.air is not None:
            batch.air = dimmed(batch.air)
        batch.hits = dimmed(returns)
        return batch.hits


class LossStep(PulseStep):
    """Loses returns of dead channels, of packets that do not arrive, and of scans without older."""

    effects = ("Faults",)
    reads = ("ray",)
    purposes = (Purpose.PACKET,)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("dead_channels", "dropped_packets", "frozen"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        ray, firings, spec = returns.ray, batch.firings, batch.firings.spec
        before, now = spec.repeats or (0, -spec.ahead)
        if spec.scan - now > spec.scan + spec.ahead - before:  # the older sweep has fewer scans
            return returns.take(np.zeros(0, np.intp))
        times, lost = firings.times(ray), np.zeros(len(ray), np.bool_)
        for _, fault in self.setup.faults("dead_channels"):
            dead = np.isin(ray % firings.sensor.channels, fault.channels or ())
            lost |= dead & fault.during(times)
        seed, station = self.setup.noise.seed, spec.station
        for number, fault in self.setup.faults("dropped_packets"):
            packet = firings.numbers[ray // firings.sensor.channels] // (fault.packet or 1)
            drawn = uniform(seed, Purpose.PACKET, station, packet, number % 256)
            lost |= (drawn < (fault.share or 0.0)) & fault.during(times)
        return returns.take(~lost)


class StampStep(PulseStep):
    """Stamps returns as a sensor does whose clock jumps, or that sends old points as new ones."""

    effects = ("Faults",)
    reads = ("ray",)
    writes = ("stamp",)
    of_kept = True

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return bool(setup.faults("frozen", "time_jump"))

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`."""
        return Memory(kept=8 * sizes.points)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        stamp, repeats = batch.firings.times(returns.ray), batch.firings.spec.repeats
        if repeats is not None:
            before, now = map(self.setup.survey.begins_ns, repeats)
            stamp += round(now - before)
        jumps = [one.jump_ns(stamp) for _, one in self.setup.faults("time_jump")]
        return returns._replace(stamp=stamp + np.sum(jumps, axis=0, dtype=np.int64))

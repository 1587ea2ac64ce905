"""Sensor faults such as dirt on the window, dead channels, lost packets and frozen sweeps.

The directions that the platform blocks are here, too, because they have the same consequence.
"""

from __future__ import annotations

import numpy as np

from ...casting.motion import Firings
from ...numerics.arrays import Bools, Floats, to_writable
from ...numerics.elementary import sin_cos
from ...numerics.vectors import hypot
from ...survey.faults import PACKET, Fault
from ..returns import PulseReturns, require_column
from .step import PulseBatch, PulseStep, Role, Setup


class DirtStep(PulseStep):
    """Simulation step that attenuates light passing through dirt on the window."""

    role = Role.CHANGES
    effects = ("Faults",)
    reads = "ray", "energy"
    writes = ("energy",)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the window of the sensor has dirt."""
        return bool(setup.faults("dirt"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the hits with their energies reduced by dirt, and store them in the batch."""
        sensor = batch.firings.sensor
        beams = np.arange(batch.start, batch.stop)
        transmission = np.ones(len(beams))
        x, y, z = sensor.directions(batch.firings.numbers[batch.row_range]).reshape(-1, 3).T
        for fault in self.setup.faults("dirt").values():
            in_spot = _in_spot(fault, x, y, z)
            if fault.from_s or fault.to_s is not None:
                in_spot &= fault.is_active(batch.firings.times(beams))
            transmission[in_spot] *= require_column(fault.transmission)
        transmission = transmission.repeat(batch.subrays_per_beam)
        hits = returns._replace(
            energy=require_column(returns.energy) * transmission.take(returns.ray)
        )
        batch.hits = hits
        if batch.air is not None:
            energy = require_column(batch.air.energy) * transmission.take(batch.air.ray)
            batch.air = batch.air._replace(energy=energy)
        return hits


def _in_spot(fault: Fault, x: Floats, y: Floats, z: Floats) -> Bools:
    """Return whether unit directions in the sensor frame pass through the given dirt."""
    begin, end = fault.azimuth_deg or (0, 360)
    half = ((end - begin) % 360 or 360) / 2
    lowest, highest = fault.elevation_deg or (-90, 90)
    sin, cos = sin_cos(np.radians((begin + half, half, lowest, highest)))
    # Computing beam angles would be slow. The tolerance allows for inexact sines of a full circle.
    in_spot = x * cos[0] + y * sin[0] >= cos[1] * hypot(x, y) - 1e-12
    in_spot &= (z >= sin[2] - 1e-12) & (z <= sin[3] + 1e-12)
    return in_spot


def _without_blocked(returns: PulseReturns, firings: Firings) -> PulseReturns:
    """Drop the returns of pulses that the platform blocks."""
    if not firings.sensor.has_blocked_directions:
        return returns
    number, channel = np.divmod(returns.ray, firings.sensor.channels)
    is_blocked = firings.sensor.is_blocked(firings.numbers[number], channel)
    return returns.take(np.flatnonzero(~is_blocked))


class LossStep(PulseStep):
    """Simulation step for all causes of returns that are missing from the output of the sensor.

    These are blocked directions, dead channels, lost packets, and scans missing from frozen sweeps.
    """

    role = Role.CHANGES
    effects = ("Faults",)
    reads = ("ray",)
    purposes = (PACKET,)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the sensor has blocked directions or faults that remove returns."""
        if setup.sensor.has_blocked_directions:
            return True
        return bool(setup.faults("dead_channels", "dropped_packets", "frozen"))

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Drop the lost returns of a batch."""
        from . import fault_loops  # imported here because numba takes half a second to import

        firings = batch.firings
        spec = batch.firings.spec
        seed = self.setup.noise.seed
        # First scans of the sweep that a frozen sensor sends again, and of the sweep that it
        # replaces.
        first_sent_again, first_replaced = spec.repeats or (spec.random_offset, 0)
        if (
            spec.random_offset != first_sent_again - first_replaced
        ):  # the repeated sweep has no such scan
            return returns.take(np.zeros(0, np.intp))
        returns = _without_blocked(returns, firings)
        faults = self.setup.faults("dead_channels", "dropped_packets")
        spans = np.array([fault.span_ns for fault in faults.values()]).reshape(-1, 2)
        lost_channels = np.zeros((len(faults), firings.sensor.channels), np.bool_)
        lost_firings = np.zeros((len(faults), len(firings.numbers)), np.bool_)
        for row, (fault_number, fault) in enumerate(faults.items()):
            if fault.packet is None:
                lost_channels[row, require_column(fault.channels)] = True
            else:
                lost_firings[row] = fault.find_dropped(
                    firings.numbers, seed, spec.station, fault_number
                )
        row_indices = np.empty(len(returns.ray), np.int64)
        ray = to_writable(returns.ray, np.int64)
        count = fault_loops.remaining(
            ray, firings.times(ray), spans, lost_firings, lost_channels, row_indices
        )
        return returns if count == len(row_indices) else returns.take(row_indices[:count])

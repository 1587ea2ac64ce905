"""Saturation: pulses that fill the receiver are clipped and wide, and hide what is close."""

from __future__ import annotations

import numpy as np

from ..base.arrays import owned
from ..base.elementary import log
from ..base.elementary_scalars import log_of
from ..sensor.optics import FWHM, LIGHT_M_NS
from .returns import PulseReturns, made
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes

_TO_M = LIGHT_M_NS / 4  # half of a width, in range


class SaturationStep(PulseStep):
    """Clips and widens the pulses that fill the receiver, and joins them with what they hide."""

    effects = ("Saturation",)
    reads = "ray", "distance", "energy", "width", "amplitude"
    writes = "distance", "energy", "width", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.saturation is not None

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: widths, amplitudes, and what is made of them."""
        return Memory(kept=16 * sizes.returns, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        setup, optics = self.setup, self.setup.sensor.optics
        pulse_ns = setup.reporting.length_ns(optics)
        if setup.in_waveforms:
            pulse_ns = FWHM * setup.reporting.system_ns(optics)
        return saturated(returns, setup.noise.full, pulse_ns)


def saturated(returns: PulseReturns, full: float, pulse_ns: float) -> PulseReturns:
    """Clip returns at the height `full`, and join those that overlap clipped ones.

    A Gaussian pulse of height A, clipped at S, is above S / 2 for √(1 + log2(A / S)) of its full
    width at half maximum, `pulse_ns` unless a return has a width. With widths, as in waveforms, the
    range of a clipped return is that of its leading edge.
    """
    from . import pulse_loops  # not before: numba takes half a second to import

    height, waves = returns.height, returns.width is not None
    usual = made(returns.width) if waves else np.full(len(height), pulse_ns)
    whole = np.where(usual > 0, usual, pulse_ns)  # what has no echo has the width 0
    wide = whole * np.sqrt(1 + log(np.maximum(height / full, 1)) / log_of(2.0))
    front, back = returns.distance - _TO_M * wide, returns.distance + _TO_M * wide
    early = _TO_M * (wide - whole) if waves else 0.0
    distance = np.maximum(returns.distance - early, 0)
    clipped, there = height > full, np.empty(len(height), np.bool_)
    energy = made(returns.energy).copy()
    pulse_loops.filled(
        owned(returns.ray, np.int64), clipped, owned(height), front, back, distance, energy, there
    )
    width = np.where(clipped, (back - front) / (2 * _TO_M), usual)
    amplitude = np.minimum(height, full)
    return returns._replace(
        distance=distance, energy=energy, width=width, amplitude=amplitude
    ).take(there)

"""Saturation: pulses that fill the receiver are clipped and wide, and hide close returns."""

from __future__ import annotations

import numpy as np

from ...base.arrays import owned
from ...base.elementary import log
from ...base.elementary_scalars import log_of
from ...sensor.optics import FWHM, LIGHT_M_NS
from ..returns import PulseReturns, required
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

_HALF_WIDTH_M_NS = LIGHT_M_NS / 4  # half of a pulse's width, in meters of range per ns of width


class SaturationStep(PulseStep):
    """Clips and widens the pulses that fill the receiver, and joins pulses with hidden returns."""

    role = Role.RECEIVES
    effects = ("Saturation",)
    reads = "ray", "distance", "energy", "width", "amplitude"
    writes = "distance", "energy", "width", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the noise of the sensor has saturation."""
        return setup.noise.saturation is not None

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of widths, amplitudes and joined returns, in bytes."""
        return Memory(retained=16 * sizes.return_count, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Return the returns of a batch after saturation."""
        setup = self.setup
        optics = self.setup.sensor.optics
        pulse_ns = setup.reporting.length_ns(optics)
        if setup.in_waveforms:
            pulse_ns = FWHM * setup.reporting.system_ns(optics)
        return saturated(returns, setup.noise.full, pulse_ns)


def saturated(returns: PulseReturns, full: float, pulse_ns: float) -> PulseReturns:
    """Clip returns (n,) at the height `full`, and join returns that overlap clipped returns.

    A Gaussian pulse of height A, clipped at S, is above S / 2 for √(1 + log2(A / S)) of its full
    width at half maximum, `pulse_ns` unless a return has a width. With widths, as in waveforms, the
    range of a clipped return is early by half of what clipping adds to its width: the receiver
    measures its leading edge.
    """
    from . import saturation_loops  # not before: numba takes half a second to import

    height = returns.height
    in_waveforms = returns.width is not None
    width = required(returns.width) if in_waveforms else np.full(len(height), pulse_ns)
    unclipped = np.where(width > 0, width, pulse_ns)  # returns without a waveform have the width 0
    widened = unclipped * np.sqrt(1 + log(np.maximum(height / full, 1)) / log_of(2.0))
    early_m = _HALF_WIDTH_M_NS * (widened - unclipped) if in_waveforms else 0.0
    pulses = saturation_loops.Pulses(
        ray=owned(returns.ray, np.int64),
        clipped=height > full,
        height=owned(height),
        front=returns.distance - _HALF_WIDTH_M_NS * widened,
        back=returns.distance + _HALF_WIDTH_M_NS * widened,
        distance=np.maximum(returns.distance - early_m, 0),
        energy=required(returns.energy).copy(),
    )
    remains = np.empty(len(height), np.bool_)
    saturation_loops.join_clipped(pulses, remains)
    joined_ns = (pulses.back - pulses.front) / (2 * _HALF_WIDTH_M_NS)
    return returns._replace(
        distance=pulses.distance,
        energy=pulses.energy,
        width=np.where(pulses.clipped, joined_ns, width),
        amplitude=np.minimum(height, full),
    ).take(remains)

"""Saturation of the receiver, which clips and widens pulses and hides nearby returns."""

from __future__ import annotations

import numpy as np

from ...numerics.arrays import to_writable
from ...numerics.elementary import log
from ...numerics.elementary_scalars import log_of
from ...sensor.optics import FWHM, LIGHT_M_NS
from ..returns import PulseReturns, require_column
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

_HALF_WIDTH_M_NS = LIGHT_M_NS / 4  # half of a pulse's width in meters of range, per ns of width


class SaturationStep(PulseStep):
    """Simulation step that clips and widens strong pulses, and merges the returns they hide."""

    role = Role.RECEIVES
    effects = ("Saturation",)
    reads = "ray", "distance", "energy", "width", "amplitude"
    writes = "distance", "energy", "width", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the noise of the sensor includes saturation."""
        return setup.noise.saturation is not None

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of the widths, amplitudes and merged returns, in bytes."""
        return Memory(retained=16 * sizes.return_count, casting=120 * sizes.beams)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Apply saturation to the returns of a batch."""
        setup = self.setup
        optics = self.setup.sensor.optics
        pulse_ns = setup.reporting.length_ns(optics)
        if setup.in_waveforms:
            pulse_ns = FWHM * setup.reporting.system_ns(optics)
        return apply_saturation(returns, setup.noise.saturation_energy, pulse_ns)


def apply_saturation(returns: PulseReturns, full: float, pulse_ns: float) -> PulseReturns:
    """Clip returns at the height `full`, and merge returns that overlap clipped returns.

    A Gaussian pulse of height A, clipped at S, exceeds S / 2 for √(1 + log2(A / S)) of its full
    width at half maximum. This width is `pulse_ns` unless a return has its own width, as in
    waveforms. In that case, the range of a clipped return is too short by half of the width that
    clipping adds, because the receiver measures the leading edge.
    """
    from . import saturation_loops  # imported here because numba takes half a second to import

    height = returns.height
    in_waveforms = returns.width is not None
    width = require_column(returns.width) if in_waveforms else np.full(len(height), pulse_ns)
    unclipped = np.where(width > 0, width, pulse_ns)  # without a waveform, the width is 0
    widened = unclipped * np.sqrt(1 + log(np.maximum(height / full, 1)) / log_of(2.0))
    early_m = _HALF_WIDTH_M_NS * (widened - unclipped) if in_waveforms else 0.0
    pulses = saturation_loops.PulseExtents(
        ray=to_writable(returns.ray, np.int64),
        clipped=height > full,
        height=to_writable(height),
        front=returns.distance - _HALF_WIDTH_M_NS * widened,
        back=returns.distance + _HALF_WIDTH_M_NS * widened,
        distance=np.maximum(returns.distance - early_m, 0),
        energy=require_column(returns.energy).copy(),
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

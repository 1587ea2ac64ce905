"""Waveforms: what a receiver gets of a pulse over time, and the returns that are found in it.

Pulse and receiver are Gaussian. So a waveform is a sum of Gaussians, one for each hit of a sub-ray,
as wide as the pulse appears to the receiver: the system waveform (Wagner et al. 2006). Its height
is in units of energy: an echo that nothing has stretched is as high as its energy.

Loops of wave_loops.py find the returns, pulse by pulse, so the batches do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats, owned
from ..sensor.noise import Purpose
from ..sensor.optics import CUT, FWHM, LIGHT_M_NS
from .returns import NO_SURFACE, OF_RETURNS, Planes, PulseReturns, made, numbers
from .separation import surfaces_of
from .step import PulseBatch, PulseStep, Setup


class WaveformStep(PulseStep):
    """Finds returns in the waveforms of pulses."""

    effects = ("Waveforms",)
    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *OF_RETURNS, "velocity", "width", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        found = returns_in(returns, Digitizer.of(self.setup), batch.each, batch.planes)
        return found._replace(ray=batch.start + found.ray)


class DetectionStep(PulseStep):
    """Loses weak returns of waveforms, and a share of all; `SeparationStep` does that itself."""

    reads = "ray", "amplitude"
    purposes = Purpose.LOSS, Purpose.DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.noise.loses and setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        key = *batch.keys.of(returns.ray), numbers(returns.ray)
        return returns.take(self.setup.noise.detected(returns.height, *key))


@dataclass(frozen=True)
class Digitizer:
    """Standard deviation of the system waveform and the time between samples, ns."""

    sigma_ns: float
    sample_ns: float
    decomposes: bool  # into Gaussians; else it finds peaks

    @classmethod
    def of(cls, setup: Setup) -> Digitizer:
        """Make that of a sensor."""
        reporting = setup.reporting
        system_ns = reporting.system_ns(setup.sensor.optics)
        return cls(system_ns, reporting.sample_ns, reporting.waveform == "gaussian")

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the system waveform in range."""
        return self.sigma_ns * LIGHT_M_NS / 2

    @property
    def sigma(self) -> float:
        """Standard deviation of the system waveform, samples."""
        return self.sigma_ns / self.sample_ns

    @property
    def reach(self) -> int:
        """Samples before and behind an echo that it reaches."""
        return int(np.ceil(CUT * self.sigma))

    @property
    def per_m(self) -> float:
        """Samples in a metre of range."""
        return 2 / LIGHT_M_NS / self.sample_ns

    def amplitude(self, energy: Floats, width: Floats) -> Floats:
        """Heights of echoes (n,) by energy and full width at half maximum, ns; 0 is unknown."""
        system_ns = FWHM * self.sigma_ns
        return np.asarray(energy * (system_ns / np.where(width > 0, width, system_ns)))


def returns_in(
    hits: PulseReturns, digitizer: Digitizer, each: int = 1, planes: Planes | None = None
) -> PulseReturns:
    """Make returns of the waveforms of beams; arguments and order as of `separated`.

    Hits that lie close together, or on one surface (see `pulse_loops`), are one Gaussian with their
    mean and variance. Other waveforms are sampled and searched. The triangle and colour of a return
    are those of its strongest hit.
    """
    from . import wave_loops  # not before: numba takes half a second to import

    columns = owned(hits.ray, np.int64), owned(hits.distance), owned(made(hits.energy))
    row = np.empty((len(hits.ray), 2), np.int64)
    count, many = wave_loops.ordered(each, *columns, row)
    order = (row := row[:count])[:, 0]
    sub, far, light = (column[order] for column in columns)
    speed = np.zeros(0) if hits.velocity is None else hits.velocity[order]
    beam, hard = sub // each, hits.triangle[order] != NO_SURFACE
    new, still, some = np.empty((3, count), np.bool_)
    echo, found = np.full(count, -1), np.empty((3, count))
    whole, real = np.empty((2, count), np.int64), np.empty((4, count))
    scratch = np.empty(many * each, np.int64), np.empty(many + 1, np.int64)
    surfaces = each, *surfaces_of(each, planes), *scratch
    mine = sub, far, hard, row, still, some, np.ones(count, np.bool_)
    parts = np.empty((count, 2), np.int64)
    parts = parts[: wave_loops.divide(beam, digitizer.sigma_m, mine, surfaces, new, parts)]
    if len(parts):
        longest = float((far[parts[:, 1] - 1] - far[parts[:, 0]]).max()) * digitizer.per_m
        room = wave_loops.room_for(int(longest) + 2 * digitizer.reach + 8)
        digits, when = (digitizer.sigma, digitizer.decomposes), far * digitizer.per_m
        wave_loops.search(when, light / each, parts, digits, new, echo, found, room)
    sizes = digitizer.sigma_m, digitizer.per_m
    count = wave_loops.returns(
        beam, *sizes, mine, surfaces, new, light, owned(speed), echo, found, whole, real
    )
    beam, row = whole[:, :count].copy()
    distance, energy, velocity, width = real[:, :count].copy()
    return hits.take(row)._replace(
        ray=beam,
        distance=distance,
        energy=energy,
        velocity=None if hits.velocity is None else velocity,
        width=(wide := width * (FWHM * digitizer.sigma_ns)),
        amplitude=digitizer.amplitude(energy, wide),
    )

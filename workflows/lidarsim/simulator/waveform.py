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
from ..sensor.optics import CUT, FWHM, LIGHT_M_NS
from .returns import NO_SURFACE, OF_RETURNS, Planes, PulseReturns, made
from .separation import neighbours_of
from .step import PulseBatch, PulseStep, Role, Setup


class WaveformStep(PulseStep):
    """Finds returns in the waveforms of pulses."""

    role = Role.CHANGES | Role.RECEIVES
    effects = ("Waveforms",)
    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *OF_RETURNS, "velocity", "width", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        found = returns_in(returns, Digitizer.of(self.setup), batch.subrays_per_beam, batch.planes)
        return found._replace(ray=batch.start + found.ray)


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

    Hits that lie close together, or on one surface (see `pulse_loops.continue_surfaces`), are one
    Gaussian with their mean and variance. Other waveforms are sampled and searched. The triangle
    and colour of a return are those of its strongest hit.
    """
    from . import pulse_loops, wave_loops  # not before: numba takes half a second to import

    ray = owned(hits.ray, np.int64)
    distance = owned(hits.distance)
    energy = owned(made(hits.energy))
    row = np.empty((len(ray), 2), np.int64)
    count, hits_most = wave_loops.ordered(each, ray, distance, energy, row)
    row = row[:count]
    order = row[:, 0]
    light = wave_loops.WaveLight(
        energy[order], np.zeros(0) if hits.velocity is None else owned(hits.velocity[order])
    )
    pulse_hits = pulse_loops.PulseHits(
        subray=ray[order],
        distance=distance[order],
        row=row,
        subray_hits=np.empty(hits_most * each, np.int64),
        changes=np.empty(hits_most + 1, np.int64),
    )
    marks = wave_loops.WaveMarks(
        solid=hits.triangle[order] != NO_SURFACE,
        new=np.empty(count, np.bool_),
        apart=np.empty(count, np.bool_),
        searched=np.empty(count, np.bool_),
        every=np.ones(count, np.bool_),
    )
    echoes = wave_loops.WaveEchoes(np.full(count, -1), np.empty((3, count)))
    beam = pulse_hits.subray // each
    neighbours = neighbours_of(each, planes)
    parts = np.empty((count, 2), np.int64)
    parts_count = wave_loops.divide(
        beam, digitizer.sigma_m, pulse_hits, marks, each, neighbours, parts
    )
    parts = parts[:parts_count]
    if len(parts):
        lengths_m = pulse_hits.distance[parts[:, 1] - 1] - pulse_hits.distance[parts[:, 0]]
        longest = int(float(lengths_m.max()) * digitizer.per_m)
        room = wave_loops.room_for(longest + 2 * digitizer.reach + 8)
        sampling = (digitizer.sigma, digitizer.decomposes)
        when = pulse_hits.distance * digitizer.per_m
        wave_loops.search(when, light.energy / each, parts, sampling, marks.new, echoes, room)
    returns = wave_loops.MadeWaveReturns(
        beam=np.empty(count, np.int64),
        row=np.empty(count, np.int64),
        distance=np.empty(count),
        energy=np.empty(count),
        velocity=np.empty(count),
        width=np.empty(count),
    )
    digitizer_m = (digitizer.sigma_m, digitizer.per_m)
    count = wave_loops.returns(
        beam, digitizer_m, pulse_hits, marks, each, neighbours, light, echoes, returns
    )
    returns = returns.first(count)
    width = returns.width * (FWHM * digitizer.sigma_ns)
    return hits.take(returns.row)._replace(
        ray=returns.beam,
        distance=returns.distance,
        energy=returns.energy,
        velocity=None if hits.velocity is None else returns.velocity,
        width=width,
        amplitude=digitizer.amplitude(returns.energy, width),
    )

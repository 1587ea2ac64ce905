"""Waveforms, which record the light of a pulse over time, and the returns found in them.

Pulse and receiver response are Gaussian, so a waveform is a sum of Gaussians, one for each hit of a
sub-ray. Each is as wide as the pulse appears to the receiver, which is the system waveform (Wagner
et al. 2006). Heights are in units of energy, so a return that is not stretched by a slope is as
high as its energy.

The loops in wave_loops.py find returns pulse by pulse, so batches do not affect the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...numerics.arrays import Floats, Ints, to_writable
from ...sensor.optics import CUT, FWHM, LIGHT_M_NS
from ..returns import NO_SURFACE, RETURN_COLUMNS, Planes, PulseReturns, require_column
from .separation import neighbors_of
from .step import PulseBatch, PulseStep, Role, Setup

if TYPE_CHECKING:
    from .wave_loops import WaveHits, WavePeaks


class WaveformStep(PulseStep):
    """Simulation step that finds returns in the waveforms of pulses."""

    role = Role.CHANGES | Role.RECEIVES
    effects = ("Waveforms",)
    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *RETURN_COLUMNS, "velocity", "width", "amplitude"
    on_recordings = (
        "`returns.waveform` cannot be simulated on a recording, because a recording contains "
        "returns instead of waveforms. Reconstruct the scene with `lidarpool twin`, and simulate "
        "the sensor in it."
    )

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the sensor detects returns in waveforms."""
        return setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Find the returns in the waveforms of a batch. Their `ray` is the beam number."""
        digitizer = Digitizer.for_sensor(self.setup)
        in_waveforms = returns_in(returns, digitizer, batch.subrays_per_beam, batch.planes)
        return in_waveforms._replace(ray=batch.start + in_waveforms.ray)


@dataclass(frozen=True)
class Digitizer:
    """Settings of a receiver that samples waveforms and finds returns in the samples."""

    sigma_ns: float  # standard deviation of the system waveform, ns
    sample_ns: float  # time between samples, ns
    decomposes: bool  # whether waveforms are decomposed into Gaussians; otherwise peaks are found

    @classmethod
    def for_sensor(cls, setup: Setup) -> Digitizer:
        """Return the digitizer of a sensor."""
        reporting = setup.reporting
        system_ns = reporting.system_ns(setup.sensor.optics)
        return cls(system_ns, reporting.sample_ns, reporting.waveform == "gaussian")

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the system waveform, in meters of range."""
        return self.sigma_ns * LIGHT_M_NS / 2

    @property
    def sigma(self) -> float:
        """Standard deviation of the system waveform, in samples."""
        return self.sigma_ns / self.sample_ns

    @property
    def reach(self) -> int:
        """Number of samples, on either side of a return's peak, at which the return is not 0."""
        return int(np.ceil(CUT * self.sigma))

    @property
    def samples_per_m(self) -> float:
        """Number of samples per meter of range."""
        return 2 / LIGHT_M_NS / self.sample_ns

    def amplitude(self, energy: Floats, width: Floats) -> Floats:
        """Return the heights of returns with the given energies and widths.

        `width` is the full width at half maximum in ns. A return as wide as the system waveform is
        as high as its energy. A width of 0 means that the width is unknown, in which case it is
        assumed to be the width of the system waveform.
        """
        system_ns = FWHM * self.sigma_ns
        return np.asarray(energy * (system_ns / np.where(width > 0, width, system_ns)))


def returns_in(
    hits: PulseReturns, digitizer: Digitizer, subrays: int = 1, planes: Planes | None = None
) -> PulseReturns:
    """Find the returns in the waveforms of beams, and sort them by beam and distance.

    Hits that are close together, or on one surface (`pulse_loops.continue_surfaces`), form one
    Gaussian with their mean and variance. Other waveforms are sampled and searched. The triangle
    and color of a return come from its strongest hit.

    Parameters
    ----------
    hits
        Hits of sub-rays, sorted by sub-ray. `ray` is the number of the sub-ray in the batch.
    digitizer
        Sampling of the waveforms.
    subrays
        Number of sub-rays per beam.
    planes
        Planes of the hits. If None, no surface continues from sub-ray to sub-ray.

    Returns
    -------
    PulseReturns
        Returns whose `ray` is the number of the beam in the batch. Hits without energy are dropped.
    """
    from . import wave_loops  # imported here because numba takes half a second to import

    wave_hits = _wave_hits(hits, subrays)
    count = len(wave_hits.beam)
    neighbors = neighbors_of(subrays, planes)
    hit_ranges = np.empty((count, 2), np.int64)
    range_count = wave_loops.divide_into_waveforms(
        wave_hits, digitizer.sigma_m, neighbors, hit_ranges
    )
    hit_ranges = hit_ranges[:range_count]
    peaks = _search(wave_hits, digitizer, subrays, hit_ranges)
    output = wave_loops.WaveReturnArrays(
        beam=np.empty(count, np.int64),
        row=np.empty(count, np.int64),
        distance=np.empty(count),
        energy=np.empty(count),
        velocity=np.empty(count),
        width=np.empty(count),
    )
    count = wave_loops.make_returns(
        wave_hits, digitizer.sigma_m, digitizer.samples_per_m, neighbors, peaks, output
    )
    output = output.first(count)
    width = output.width * (FWHM * digitizer.sigma_ns)
    return hits.take(output.row)._replace(
        ray=output.beam,
        distance=output.distance,
        energy=output.energy,
        velocity=None if hits.velocity is None else output.velocity,
        width=width,
        amplitude=digitizer.amplitude(output.energy, width),
    )


def _wave_hits(hits: PulseReturns, subrays: int) -> WaveHits:
    """Return the hits with energy, sorted by beam and distance, for compiled loops.

    `marks.solid` and `marks.all_start` are filled in, and loops write the other marks.
    """
    from . import pulse_loops, wave_loops

    ray = to_writable(hits.ray, np.int64)
    distance = to_writable(hits.distance)
    energy = to_writable(require_column(hits.energy))
    row = np.empty(len(ray), np.int64)
    count, max_hits = wave_loops.order_hits(subrays, ray, distance, energy, row)
    order = row[:count]
    pulse_hits = pulse_loops.PulseHits(
        subray=ray[order],
        distance=distance[order],
        row=order,
        # Scratch memory of `continue_surfaces`.
        return_begin=np.empty(count, np.int64),
        subray_hits=np.empty(max_hits * subrays, np.int64),
        changes=np.empty(max_hits + 1, np.int64),
    )
    marks = wave_loops.WaveMarks(
        solid=hits.triangle[order] != NO_SURFACE,
        starts=np.empty(count, np.bool_),
        starts_surface=np.empty(count, np.bool_),
        searched=np.empty(count, np.bool_),
        all_start=np.ones(count, np.bool_),
    )
    return wave_loops.WaveHits(
        beam=pulse_hits.subray // subrays,
        pulses=pulse_hits,
        energy=energy[order],
        velocity=np.zeros(0) if hits.velocity is None else to_writable(hits.velocity[order]),
        marks=marks,
    )


def _search(hits: WaveHits, digitizer: Digitizer, subrays: int, hit_ranges: Ints) -> WavePeaks:
    """Search waveforms. Return the peak of each hit, and mark the first hit of each peak.

    `hit_ranges` (k, 2) are the first hit and one past the last hit of each waveform. This writes
    `hits.marks.starts`.
    """
    from . import wave_loops

    count = len(hits.beam)
    peaks = wave_loops.WavePeaks(np.full(count, -1), np.empty((3, count)))
    if not len(hit_ranges):
        return peaks
    distance = hits.pulses.distance
    lengths_m = distance[hit_ranges[:, 1] - 1] - distance[hit_ranges[:, 0]]
    longest = int(float(lengths_m.max()) * digitizer.samples_per_m)
    scratch = wave_loops.scratch_for(longest + 2 * digitizer.reach + 8)
    sampling = wave_loops.WaveSampling(digitizer.sigma, digitizer.decomposes)
    light = wave_loops.WaveLight(distance * digitizer.samples_per_m, hits.energy / subrays)
    wave_loops.search_waveforms(light, hit_ranges, sampling, hits.marks.starts, peaks, scratch)
    return peaks

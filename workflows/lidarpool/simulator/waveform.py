"""Waveforms: what a receiver gets of a pulse over time, and the returns that are found in it.

Pulse and receiver are Gaussian. So a waveform is a sum of Gaussians, one for each hit of a sub-ray,
as wide as the pulse appears to the receiver: the system waveform (Wagner et al. 2006). Its height
is in units of energy: an echo that nothing has stretched is as high as its energy.

Loops of wave_loops.py find the returns, pulse by pulse, so the batches do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Ints, Records, owned
from ..base.elementary import exp
from ..columns.waveforms import SILENT, ZERO, record
from ..sensor.noise import Purpose, normal, raw
from ..sensor.optics import FWHM, LIGHT_M_NS, WINDOW_SIGMAS
from .hits import NO_SURFACE, Hits, Keys, Planes, numbers
from .separation import surfaces_of

CUT = WINDOW_SIGMAS / 2  # standard deviations of the system waveform: beyond, an echo is 0 (4e-6)
BLOCK_SAMPLES = 1 << 20  # of recorded waveforms that are made at a time


@dataclass(frozen=True)
class Digitizer:
    """Standard deviation of the system waveform and the time between samples, ns."""

    sigma_ns: float
    sample_ns: float
    decomposes: bool  # into Gaussians; else it finds peaks

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

    def samples(self, distance: Floats) -> Floats:
        """Return when light comes back, samples after the pulse."""
        return distance * self.per_m

    def amplitude(self, energy: Floats, width: Floats) -> Floats:
        """Heights of echoes (n,) by energy and full width at half maximum, ns; 0 is unknown."""
        system_ns = FWHM * self.sigma_ns
        return np.asarray(energy * (system_ns / np.where(width > 0, width, system_ns)))


def returns_in(
    hits: Hits, digitizer: Digitizer, each: int = 1, planes: Planes | None = None
) -> Hits:
    """Make returns of the waveforms of beams; arguments and order as of `separated`.

    Hits that lie close together, or on one surface (see `pulse_loops`), are one Gaussian with their
    mean and variance. Other waveforms are sampled and searched. The triangle and colour of a return
    are those of its strongest hit.
    """
    from . import wave_loops  # not before: numba takes half a second to import

    speeds = np.zeros(0) if hits.velocity is None else hits.velocity
    most = len(hits.ray)
    whole, real = np.empty((2, most), np.int64), np.empty((4, most))
    count = wave_loops.returns(
        each, digitizer.sigma_m, (digitizer.sigma, digitizer.per_m, digitizer.decomposes),
        owned(hits.ray, np.int64), owned(hits.distance), owned(hits.energy),
        hits.triangle != NO_SURFACE, owned(speeds),
        *surfaces_of(each, planes), whole, real,
    )  # fmt: skip
    beam, row = whole[:, :count].copy()
    distance, energy, velocity, width = real[:, :count].copy()
    return hits.take(row)._replace(
        ray=beam,
        distance=distance,
        energy=energy,
        velocity=None if hits.velocity is None else velocity,
        width=width * (FWHM * digitizer.sigma_ns),
    )


def first_samples(when: Floats, sigma: float) -> tuple[Ints, int]:
    """First sample of each echo that is not 0, and how many there are, from the times (n,)."""
    return np.ceil(when - CUT * sigma).astype(np.int64), int(2 * CUT * sigma) + 1


def recorded(
    hits: Hits,
    returns: Hits,
    digitizer: Digitizer,
    each: int,
    count: int,
    noise: tuple[float, int, Keys] | None = None,
) -> Records:
    """Record the waveform around each return, `count` samples: (n,), see `record`.

    A window begins where the echo of its first return does, and returns of the same pulse share it
    as long as their echoes end within. Windows of a pulse that overlap hold the same samples.

    Parameters
    ----------
    hits
        Of all sub-rays, `each` of a beam, in the order of rays.
    returns
        Their `ray` is the beam, in order.
    noise
        Standard deviation of a sample, the seed, and the keys of beams.
    """
    out = np.zeros(len(returns.ray), record(count))
    out["sample_ps"] = round(1000 * digitizer.sample_ns)
    when = digitizer.samples(returns.distance)
    first = np.maximum(np.floor(when).astype(np.int64) - digitizer.reach, 0)
    last = np.ceil(when).astype(np.int64) + digitizer.reach
    place = numbers(returns.ray)
    begin = first.copy()
    for number in range(1, int(place.max(initial=0)) + 1):
        rows = np.flatnonzero(place == number)
        shared = (last[rows] < begin[rows - 1] + count) & (first[rows] >= begin[rows - 1])
        begin[rows] = np.where(shared, begin[rows - 1], first[rows])
    new = (place == 0) | (np.diff(begin, prepend=-1) != 0)
    window = np.cumsum(new) - 1
    beam, begins = returns.ray[new], begin[new]
    low, high = (np.searchsorted(hits.ray, (beam + step) * each) for step in (0, 1))
    unit = max(count, each * (2 * digitizer.reach + 1))
    size = max(1, BLOCK_SAMPLES // unit)
    out["begin"] = begin
    for start in range(0, len(beam), size):
        block = slice(start, start + size)
        samples = _window(hits, digitizer, each, begins[block], low[block], high[block], count)
        if noise is not None:
            sigma, seed, keys = noise
            scan, ray = keys.of(beam[block])
            stream = raw(seed, Purpose.SAMPLES, scan, ray)[:, None]
            number = begins[block, None] + np.arange(count)
            samples += sigma * normal(seed, Purpose.SAMPLE, stream, number >> 8, number & 255)
        steps, exponents = digitised(samples)
        low_row, high_row = np.searchsorted(window, [start, start + size])
        mine = window[low_row:high_row] - start
        out["samples"][low_row:high_row] = steps[mine]
        out["exponent"][low_row:high_row] = exponents[mine]
    return out


def _window(
    hits: Hits, digitizer: Digitizer, each: int, begins: Ints, low: Ints, high: Ints, count: int
) -> Floats:
    """Sample the waveforms of some windows, of the hits from `low` to `high`: (windows, count)."""
    sizes = high - low
    mine = np.repeat(np.arange(len(begins)), sizes)
    rows = np.arange(len(mine)) + np.repeat(low - np.cumsum(sizes) + sizes, sizes)
    when = digitizer.samples(hits.distance[rows])
    first, many = first_samples(when, digitizer.sigma)
    time = first[:, None] + np.arange(many)
    height = exp(-0.5 * ((time - when[:, None]) / digitizer.sigma) ** 2)
    height *= hits.energy[rows, None] / each
    place = time - begins[mine, None]
    inside = (place >= 0) & (place < count)
    place += count * mine[:, None]
    samples = np.bincount(place[inside], height[inside], minlength=len(begins) * count)
    return samples.reshape(len(begins), count).astype(np.float64)


def digitised(samples: Floats) -> tuple[NDArray[np.uint16], NDArray[np.int8]]:
    """Round samples (n, k) to whole numbers from `ZERO`, of a power of two that holds all of each.

    Returns them, uint16 (n, k), and the exponents (n,).
    """
    most = np.maximum(samples.max(axis=1) / (65_535 - ZERO), -samples.min(axis=1) / ZERO)
    _, exponents = np.frexp(most)
    exponents = np.clip(np.where(most > 0, exponents, SILENT), SILENT, 127)
    steps = np.rint(np.ldexp(samples, -exponents[:, None])) + ZERO
    return np.clip(steps, 0, 65_535).astype(np.uint16), exponents.astype(np.int8)

"""Recorded waveforms, which are the samples around each return."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...columns.waveforms import FAINTEST, ZERO, record
from ...numerics.arrays import Floats, Ints
from ...numerics.elementary import exp
from ...numerics.random_numbers import Purpose, normal, raw
from ...sensor.noise import THRESHOLD_SIGMAS
from ...sensor.optics import CUT
from ..returns import Keys, PulseReturns, number_within_ray, require_column
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .waveform import Digitizer

SAMPLES = Purpose(50, "stream of the samples of a waveform")
SAMPLE = Purpose(51, "noise of a sample")
BLOCK_SAMPLES = 1 << 20  # number of samples that are computed at a time


class Windows(NamedTuple):
    """Windows of consecutive waveform samples.

    All arrays have shape (n,).
    """

    beam: Ints  # number of the beam in the batch
    begin: Ints  # number of the first sample, counted from the firing
    first_hit: Ints  # row of the first hit of the beam
    stop_hit: Ints  # one past the row of the last hit of the beam

    def take(self, row_range: slice) -> Windows:
        """Return the selected windows."""
        return Windows(*(column[row_range] for column in self))


class RecordingStep(PulseStep):
    """Simulation step that records the waveforms of returns, including receiver noise."""

    role = Role.CHANGES
    effects = ("Waveforms",)
    reads = "ray", "distance"
    writes = ("waveform",)
    purposes = SAMPLES, SAMPLE
    on_recordings = (
        "Waveforms cannot be recorded for recorded pulses, because a recording contains returns "
        "instead of waveforms."
    )

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether waveforms are recorded."""
        return setup.waveform_samples > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of a block of samples and of all records, in bytes."""
        recorded = record(setup.waveform_samples).itemsize * sizes.return_count
        sampled = 40 * min(sizes.subrays * setup.waveform_samples, BLOCK_SAMPLES)
        return Memory(casting=sampled + recorded, counting=2.3 * recorded)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add recorded waveforms to the returns of a batch.

        A window starts where the signal of its first return starts. Later returns of the pulse
        share the window if their signals end within it. Overlapping windows of a pulse contain
        identical samples.
        """
        digitizer = Digitizer.for_sensor(self.setup)
        count = self.setup.waveform_samples
        records = np.zeros(len(returns.ray), record(count))
        records["sample_ps"] = round(1000 * digitizer.sample_ns)
        windows, window_of_return = _windows(returns, batch, digitizer, count)
        records["begin"] = windows.begin[window_of_return]
        samples_per_window = max(count, batch.subrays_per_beam * (2 * digitizer.reach + 1))
        size = max(1, BLOCK_SAMPLES // samples_per_window)
        for start in range(0, len(windows.beam), size):
            block = windows.take(slice(start, start + size))
            samples = _signal_samples(batch, digitizer, block, count)
            steps, exponents = digitize(self._received(samples, block, batch))
            first, stop = np.searchsorted(window_of_return, [start, start + size])
            window_indices = window_of_return[first:stop] - start
            records["samples"][first:stop] = steps[window_indices]
            records["exponent"][first:stop] = exponents[window_indices]
        return returns._replace(waveform=records)

    def _received(self, samples: Floats, windows: Windows, batch: PulseBatch) -> Floats:
        """Add receiver noise to samples in place, and clip the samples."""
        noise = self.setup.noise
        if noise.threshold:
            keys = Keys(batch.keys.scan, batch.keys.scan_starts - batch.start)
            scan, ray = keys.scan_and_number(windows.beam)
            stream = raw(noise.seed, SAMPLES, scan, ray)[:, None]
            number = windows.begin[:, None] + np.arange(samples.shape[1])
            errors = normal(noise.seed, SAMPLE, stream, number >> 8, number & 255)
            samples += (noise.threshold / THRESHOLD_SIGMAS) * errors
        return np.minimum(samples, noise.saturation_energy)


def _window_starts(distance: Floats, return_number: Ints, digitizer: Digitizer, count: int) -> Ints:
    """Return the first sample of each return's window, counted from the firing.

    `distance` (n,) is in meters, `return_number` (n,) counts the returns of each pulse from 0, and
    `count` is the number of samples per window. Returns that share a window have the same first
    sample.
    """
    time = distance * digitizer.samples_per_m
    first = np.maximum(np.floor(time).astype(np.int64) - digitizer.reach, 0)
    last = np.ceil(time).astype(np.int64) + digitizer.reach
    begin = first.copy()
    for number in range(1, int(return_number.max(initial=0)) + 1):
        row_indices = np.flatnonzero(return_number == number)
        shared = (last[row_indices] < begin[row_indices - 1] + count) & (
            first[row_indices] >= begin[row_indices - 1]
        )
        begin[row_indices] = np.where(shared, begin[row_indices - 1], first[row_indices])
    return begin


def _windows(
    returns: PulseReturns, batch: PulseBatch, digitizer: Digitizer, count: int
) -> tuple[Windows, Ints]:
    """Return windows of `count` samples around returns, and the window of each return."""
    return_number = number_within_ray(returns.ray)
    begin = _window_starts(returns.distance, return_number, digitizer, count)
    starts_window = (return_number == 0) | (np.diff(begin, prepend=-1) != 0)
    beam = returns.ray[starts_window] - batch.start
    ray = require_column(batch.hits).ray
    first_hit = np.searchsorted(ray, beam * batch.subrays_per_beam)
    stop_hit = np.searchsorted(ray, (beam + 1) * batch.subrays_per_beam)
    windows = Windows(beam, begin[starts_window], first_hit, stop_hit)
    return windows, np.cumsum(starts_window) - 1


def _signal_samples(
    batch: PulseBatch, digitizer: Digitizer, windows: Windows, count: int
) -> Floats:
    """Return the summed signals of the hits in each window, without noise."""
    hits = require_column(batch.hits)
    hit_counts = windows.stop_hit - windows.first_hit
    window = np.repeat(np.arange(len(hit_counts)), hit_counts)
    first_rows = windows.first_hit - np.cumsum(hit_counts) + hit_counts
    row_indices = np.arange(len(window)) + np.repeat(first_rows, hit_counts)
    time = hits.distance[row_indices] * digitizer.samples_per_m
    first = np.ceil(time - CUT * digitizer.sigma).astype(np.int64)  # first nonzero sample
    sample_times = first[:, None] + np.arange(int(2 * CUT * digitizer.sigma) + 1)
    height = exp(-0.5 * ((sample_times - time[:, None]) / digitizer.sigma) ** 2)
    height *= require_column(hits.energy)[row_indices, None] / batch.subrays_per_beam
    sample = sample_times - windows.begin[window, None]
    inside = (sample >= 0) & (sample < count)
    sample += count * window[:, None]
    samples = np.bincount(sample[inside], height[inside], minlength=len(hit_counts) * count)
    return samples.reshape(len(hit_counts), count).astype(np.float64)


def digitize(samples: Floats) -> tuple[NDArray[np.uint16], NDArray[np.int8]]:
    """Round samples to integers around `ZERO`. The step of each row is a power of two.

    Returns the integers as uint16 (n, k), and the exponents of the steps (n,).
    """
    scale = np.maximum(samples.max(axis=1) / (65_535 - ZERO), -samples.min(axis=1) / ZERO)
    _, exponents = np.frexp(scale)
    exponents = np.clip(exponents, FAINTEST, 127)
    steps = np.rint(np.ldexp(samples, -exponents[:, None])) + ZERO
    return np.clip(steps, 0, 65_535).astype(np.uint16), exponents.astype(np.int8)

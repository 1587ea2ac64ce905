"""Recorded waveforms: the samples around each return."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Ints
from ..base.elementary import exp
from ..columns.waveforms import SILENT, ZERO, record
from ..sensor.noise import THRESHOLD_SIGMAS
from ..sensor.optics import CUT
from ..sensor.random_numbers import Purpose, normal, raw
from .returns import Keys, PulseReturns, made, numbers
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .waveform import Digitizer

SAMPLES = Purpose(50, "stream of the samples of a waveform")
SAMPLE = Purpose(51, "noise of a sample")
BLOCK_SAMPLES = 1 << 20  # that are made at a time


class RecordingStep(PulseStep):
    """Records the waveforms of returns, with the noise of the receiver."""

    role = Role.CHANGES
    effects = ("Waveforms",)
    reads = "ray", "distance"
    writes = ("waveform",)
    purposes = SAMPLES, SAMPLE

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.waveform_samples > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: samples that are made at a time, and the records."""
        recorded = record(setup.waveform_samples).itemsize * sizes.returns
        sampled = 40 * min(sizes.subrays * setup.waveform_samples, BLOCK_SAMPLES)
        return Memory(casting=sampled + recorded, counting=2.3 * recorded)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`.

        A window begins where the echo of its first return does, and returns of the same pulse share
        it as long as their echoes end within. Windows of a pulse that overlap hold the same
        samples.
        """
        assert batch.hits is not None  # as there are sub-rays
        hits = batch.hits
        subrays_per_beam = batch.subrays_per_beam
        noise = self.setup.noise
        digitizer = Digitizer.of(self.setup)
        count = self.setup.waveform_samples
        beams = returns.ray - batch.start
        keys = batch.keys
        batch_keys = Keys(keys.scan, keys.begins - batch.start)
        records = np.zeros(len(beams), record(count))
        records["sample_ps"] = round(1000 * digitizer.sample_ns)
        time = returns.distance * digitizer.per_m
        first = np.maximum(np.floor(time).astype(np.int64) - digitizer.reach, 0)
        last = np.ceil(time).astype(np.int64) + digitizer.reach
        pulse_row = numbers(beams)
        begin = first.copy()
        for number in range(1, int(pulse_row.max(initial=0)) + 1):
            rows = np.flatnonzero(pulse_row == number)
            shared = (last[rows] < begin[rows - 1] + count) & (first[rows] >= begin[rows - 1])
            begin[rows] = np.where(shared, begin[rows - 1], first[rows])
        starts_window = (pulse_row == 0) | (np.diff(begin, prepend=-1) != 0)
        window = np.cumsum(starts_window) - 1
        beam = beams[starts_window]
        window_begin = begin[starts_window]
        first_hit, stop_hit = (
            np.searchsorted(hits.ray, (beam + step) * subrays_per_beam) for step in (0, 1)
        )
        unit = max(count, subrays_per_beam * (2 * digitizer.reach + 1))
        size = max(1, BLOCK_SAMPLES // unit)
        records["begin"] = begin
        for start in range(0, len(beam), size):
            block = slice(start, start + size)
            samples = _window(
                hits,
                digitizer,
                subrays_per_beam,
                window_begin[block],
                first_hit[block],
                stop_hit[block],
                count,
            )
            if noise.threshold:
                scan, ray = batch_keys.of(beam[block])
                stream = raw(noise.seed, SAMPLES, scan, ray)[:, None]
                number = window_begin[block, None] + np.arange(count)
                drawn = normal(noise.seed, SAMPLE, stream, number >> 8, number & 255)
                samples += (noise.threshold / THRESHOLD_SIGMAS) * drawn
            steps, exponents = digitised(np.minimum(samples, noise.full))
            low_row, high_row = np.searchsorted(window, [start, start + size])
            window_row = window[low_row:high_row] - start
            records["samples"][low_row:high_row] = steps[window_row]
            records["exponent"][low_row:high_row] = exponents[window_row]
        return returns._replace(waveform=records)


def _window(
    hits: PulseReturns,
    digitizer: Digitizer,
    subrays_per_beam: int,
    begin: Ints,
    first_hit: Ints,
    stop_hit: Ints,
    count: int,
) -> Floats:
    """Sample the waveforms of some windows, of the hits from `first_hit` to `stop_hit`: (windows, count)."""
    sizes = stop_hit - first_hit
    window = np.repeat(np.arange(len(begin)), sizes)
    rows = np.arange(len(window)) + np.repeat(first_hit - np.cumsum(sizes) + sizes, sizes)
    when = hits.distance[rows] * digitizer.per_m
    first = np.ceil(when - CUT * digitizer.sigma).astype(np.int64)  # that is not 0
    sample_times = first[:, None] + np.arange(int(2 * CUT * digitizer.sigma) + 1)
    height = exp(-0.5 * ((sample_times - when[:, None]) / digitizer.sigma) ** 2)
    height *= made(hits.energy)[rows, None] / subrays_per_beam
    sample = sample_times - begin[window, None]
    inside = (sample >= 0) & (sample < count)
    sample += count * window[:, None]
    samples = np.bincount(sample[inside], height[inside], minlength=len(begin) * count)
    return samples.reshape(len(begin), count).astype(np.float64)


def digitised(samples: Floats) -> tuple[NDArray[np.uint16], NDArray[np.int8]]:
    """Round samples (n, k) to whole numbers from `ZERO`, of a power of two that holds all of each.

    Returns them, uint16 (n, k), and the exponents (n,).
    """
    scale = np.maximum(samples.max(axis=1) / (65_535 - ZERO), -samples.min(axis=1) / ZERO)
    _, exponents = np.frexp(scale)
    exponents = np.clip(np.where(scale > 0, exponents, SILENT), SILENT, 127)
    steps = np.rint(np.ldexp(samples, -exponents[:, None])) + ZERO
    return np.clip(steps, 0, 65_535).astype(np.uint16), exponents.astype(np.int8)

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
from .returns import Keys, PulseReturns, numbers, required
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
        return setup.recorded > 0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: samples that are made at a time, and the records."""
        recorded = record(setup.recorded).itemsize * sizes.returns
        made = 40 * min(sizes.subrays * setup.recorded, BLOCK_SAMPLES)
        return Memory(casting=made + recorded, counting=2.3 * recorded)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`.

        A window begins where the echo of its first return does, and returns of the same pulse share
        it as long as their echoes end within. Windows of a pulse that overlap hold the same
        samples.
        """
        assert batch.hits is not None  # as there are sub-rays
        hits = batch.hits
        each = batch.each
        noise = self.setup.noise
        digitizer = Digitizer.for_sensor(self.setup)
        count = self.setup.recorded
        beams = returns.ray - batch.start
        keys = batch.keys
        here = Keys(keys.scan, keys.scan_starts - batch.start)
        out = np.zeros(len(beams), record(count))
        out["sample_ps"] = round(1000 * digitizer.sample_ns)
        when = returns.distance * digitizer.samples_per_m
        first = np.maximum(np.floor(when).astype(np.int64) - digitizer.reach, 0)
        last = np.ceil(when).astype(np.int64) + digitizer.reach
        place = numbers(beams)
        begin = first.copy()
        for number in range(1, int(place.max(initial=0)) + 1):
            rows = np.flatnonzero(place == number)
            shared = (last[rows] < begin[rows - 1] + count) & (first[rows] >= begin[rows - 1])
            begin[rows] = np.where(shared, begin[rows - 1], first[rows])
        new = (place == 0) | (np.diff(begin, prepend=-1) != 0)
        window = np.cumsum(new) - 1
        beam = beams[new]
        begins = begin[new]
        low, high = (np.searchsorted(hits.ray, (beam + step) * each) for step in (0, 1))
        unit = max(count, each * (2 * digitizer.reach + 1))
        size = max(1, BLOCK_SAMPLES // unit)
        out["begin"] = begin
        for start in range(0, len(beam), size):
            block = slice(start, start + size)
            samples = _window(hits, digitizer, each, begins[block], low[block], high[block], count)
            if noise.threshold:
                scan, ray = here.scan_and_number(beam[block])
                stream = raw(noise.seed, SAMPLES, scan, ray)[:, None]
                number = begins[block, None] + np.arange(count)
                drawn = normal(noise.seed, SAMPLE, stream, number >> 8, number & 255)
                samples += (noise.threshold / THRESHOLD_SIGMAS) * drawn
            steps, exponents = digitised(np.minimum(samples, noise.full))
            low_row, high_row = np.searchsorted(window, [start, start + size])
            mine = window[low_row:high_row] - start
            out["samples"][low_row:high_row] = steps[mine]
            out["exponent"][low_row:high_row] = exponents[mine]
        return returns._replace(waveform=out)


def _window(
    hits: PulseReturns,
    digitizer: Digitizer,
    each: int,
    begins: Ints,
    low: Ints,
    high: Ints,
    count: int,
) -> Floats:
    """Sample the waveforms of some windows, of the hits from `low` to `high`: (windows, count)."""
    sizes = high - low
    mine = np.repeat(np.arange(len(begins)), sizes)
    rows = np.arange(len(mine)) + np.repeat(low - np.cumsum(sizes) + sizes, sizes)
    when = hits.distance[rows] * digitizer.samples_per_m
    first = np.ceil(when - CUT * digitizer.sigma).astype(np.int64)  # that is not 0
    time = first[:, None] + np.arange(int(2 * CUT * digitizer.sigma) + 1)
    height = exp(-0.5 * ((time - when[:, None]) / digitizer.sigma) ** 2)
    height *= required(hits.energy)[rows, None] / each
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

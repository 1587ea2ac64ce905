"""Recorded waveforms of points, stored as a column of records that contain samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..numerics.arrays import AnyArray, Floats, Records

# Name of the column in parts. Among cloud files, only LAS and LAZ files can store waveforms.
WAVEFORM = "waveform"
ZERO = 2048  # digitized value that represents 0, since noise may be negative
FAINTEST = -126  # exponent of the weakest waveforms; 2**FAINTEST is a normal float32


def record(samples: int) -> np.dtype[np.void]:
    """Return the dtype of a waveform record with the given number of samples.

    The value of a sample is `(samples - ZERO) * 2.0**exponent` in units of energy. It is scaled so
    that an echo as narrow as the emitted pulse has a peak equal to its energy. Sample 0 is taken
    `begin` sample steps after firing, and the return follows `location_ps` after sample 0. `toward`
    is the direction to the sensor in the frame of the points, multiplied by half the distance in
    meters that light travels in a picosecond.
    """
    return np.dtype(
        [
            ("samples", "<u2", (samples,)),
            ("begin", "<u4"),
            ("sample_ps", "<u4"),
            ("location_ps", "<f4"),
            ("toward", "<f4", (3,)),
            ("exponent", "i1"),
            ("spare", "u1"),
        ]
    )


_RECORD_BYTES = record(0).itemsize


def column_type(samples: int) -> str:
    """Return the NumPy dtype string of the waveform column."""
    return f"V{record(samples).itemsize}"


def records(column: AnyArray) -> Records:
    """View a waveform column as records of the dtype that `record` returns."""
    return column.view(record((column.dtype.itemsize - _RECORD_BYTES) // 2))


@dataclass(frozen=True, eq=False)
class Waveforms:
    """Waveforms of points, in the order of the points in the cloud.

    Parameters
    ----------
    samples
        Amplitudes in units of `intensity`, with shape (n, samples). The peak of an echo that is as
        narrow as the emitted pulse equals its energy.
    times_ns
        Times of the samples after firing, in nanoseconds, with shape (n, samples).
    location_ns
        Times of the returns after firing, in nanoseconds, with shape (n,). They equal the range
        divided by half the speed of light.
    """

    samples: Floats
    times_ns: Floats
    location_ns: Floats

    @classmethod
    def from_records(cls, column: AnyArray) -> Waveforms:
        """Decode the waveforms in a column of records."""
        rows = records(column)
        heights = rows["samples"].astype(np.float64) - ZERO
        heights = np.ldexp(heights, rows["exponent"].astype(int)[:, None])
        step_ns = rows["sample_ps"].astype(np.float64) / 1000
        begin_ns = rows["begin"] * step_ns
        times_ns = begin_ns[:, None] + np.arange(heights.shape[1]) * step_ns[:, None]
        return cls(heights, times_ns, begin_ns + rows["location_ps"].astype(np.float64) / 1000)

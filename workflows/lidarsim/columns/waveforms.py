"""Recorded waveforms of points: a column of records with samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..numerics.arrays import AnyArray, Floats, Records

WAVEFORM = "waveform"  # name of the column in parts; of cloud files, only LAS holds waveforms
ZERO = 2048  # digitized value of 0; noise is also negative
FAINTEST = -126  # exponent of the faintest waveforms: 2**FAINTEST is a normal float32


def record(samples: int) -> np.dtype[np.void]:
    """Return the type of the record of a waveform of a number of samples.

    A sample is `(samples - ZERO) * 2.0**exponent`, in units of energy: the height of a returned
    pulse that is as narrow as the sent pulse is its energy. Sample 0 is `begin` sample steps after
    firing. The return is at `location_ps` after sample 0. `toward` is the direction to the sensor,
    times half the distance that light travels in a picosecond, meters, in the frame of the points.
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
    """Return NumPy's name of the type of the column."""
    return f"V{record(samples).itemsize}"


def records(column: AnyArray) -> Records:
    """Return a column (n,) as records (`record`)."""
    return column.view(record((column.dtype.itemsize - _RECORD_BYTES) // 2))


@dataclass(frozen=True, eq=False)
class Waveforms:
    """Waveforms of points in the order of points (`Cloud.waveforms`).

    Parameters
    ----------
    samples
        Heights (n, samples), in units of `intensity`: the height of a returned pulse that is as
        narrow as the sent pulse is its energy.
    times_ns
        Times of the samples after firing, (n, samples), nanoseconds.
    location_ns
        Times of the returns after firing, (n,), nanoseconds: ranges over half the speed of light.
    """

    samples: Floats
    times_ns: Floats
    location_ns: Floats

    @classmethod
    def from_records(cls, column: AnyArray) -> Waveforms:
        """Return the waveforms of a column of records."""
        rows = records(column)
        heights = rows["samples"].astype(np.float64) - ZERO
        heights = np.ldexp(heights, rows["exponent"].astype(int)[:, None])
        step_ns = rows["sample_ps"].astype(np.float64) / 1000
        begin_ns = rows["begin"] * step_ns
        times_ns = begin_ns[:, None] + np.arange(heights.shape[1]) * step_ns[:, None]
        return cls(heights, times_ns, begin_ns + rows["location_ps"].astype(np.float64) / 1000)

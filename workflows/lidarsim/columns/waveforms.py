"""Recorded waveforms of points: a column of records, each with its samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import AnyArray, Floats, Records

WAVEFORM = "waveform"  # name of the column in parts; in files of clouds it has no place but in LAS
ZERO = 2048  # that a digitised sample of 0 has, since noise goes below
SILENT = -126  # exponent of a waveform without light


def record(samples: int) -> np.dtype[np.void]:
    """Type of a waveform of so many samples.

    A sample is `(samples - ZERO) * 2.0**exponent`, in units of energy: the height of an echo as
    narrow as the pulse is its energy. Sample 0 is `begin` sample steps after the pulse left. The
    return is at `location_ps` after sample 0, and `toward` is the way to the sensor that light
    goes there and back in a picosecond, metres, in the axes of the points.
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


_REST = record(0).itemsize


def column_type(samples: int) -> str:
    """NumPy's name of the type of the column."""
    return f"V{record(samples).itemsize}"


def records(column: AnyArray) -> Records:
    """Return a column (n,) as records, see `record`."""
    return column.view(record((column.dtype.itemsize - _REST) // 2))


@dataclass(frozen=True, eq=False)
class Waveforms:
    """Waveforms of points in the order of points, see `Cloud.waveforms`.

    Parameters
    ----------
    samples
        Heights (n, samples), in units of `intensity`: an echo as narrow as the pulse is as high as
        its energy.
    times_ns
        When each was taken after the pulse left, (n, samples).
    location_ns
        When the return came back, (n,): at half of the speed of light its range.
    """

    samples: Floats
    times_ns: Floats
    location_ns: Floats

    @classmethod
    def of(cls, column: AnyArray) -> Waveforms:
        """Read a column of records."""
        rows = records(column)
        heights = rows["samples"].astype(np.float64) - ZERO
        heights = np.ldexp(heights, rows["exponent"].astype(int)[:, None])
        step_ns = rows["sample_ps"].astype(np.float64) / 1000
        begin_ns = rows["begin"] * step_ns
        times_ns = begin_ns[:, None] + np.arange(heights.shape[1]) * step_ns[:, None]
        return cls(heights, times_ns, begin_ns + rows["location_ps"].astype(np.float64) / 1000)

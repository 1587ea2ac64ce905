"""Unit and clock of the point times in a recording, determined from a few sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from lidarsim.columns.column_names import TIMES
from lidarsim.columns.sweep import Columns
from lidarsim.numerics.arrays import Floats

_TIME_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_MAX_OUTSIDE = 0.5  # sweeps by which a timestamp may lie before the first or after the last point
_MIN_SWEEP_S = 0.01
_MAX_SWEEP_S = 2.0
_MIN_TIMES = 8  # distinct times of a sweep; fewer are packet times, or lack precision


class PointClock(StrEnum):
    """Clock to which the point times of a recording refer."""

    RELATIVE = "relative to the timestamp of the sweep"
    ABSOLUTE = "clock of the timestamps"
    OTHER = "different clock"


class PointTimes(NamedTuple):
    """Unit and clock of the point times, which are the same for all sweeps of a recording.

    A sweep takes 0.01 to 2 s, so the range of its times determines whether their unit is s, ms, µs
    or ns.

    The timestamp of a sweep is the time of its first or last point, depending on the driver. In
    most sweeps, the range of the point times therefore contains zero, or almost does, if they are
    relative to the timestamp. If they are absolute, the range contains the timestamp. Otherwise
    they come from a different clock, and the first point of a sweep is assumed to be fired at the
    timestamp.
    """

    unit_s: float  # length of the unit of the stored times in seconds
    sweep_s: float  # median duration of a sweep in seconds
    clock: PointClock = PointClock.OTHER
    first_s: float = 0.0  # median time of the first point relative to the timestamp, in seconds

    @classmethod
    def from_sweeps(
        cls, sweeps: Sequence[Columns], stamps_s: Sequence[float] | Floats | None = None
    ) -> PointTimes | None:
        """Find the unit and the clock of the point times in several sweeps.

        `stamps_s` are the timestamps of these sweeps in seconds, or None if they are unknown.
        Returns None if the sweeps have no times.
        """
        parts = [_stored_times(columns) for columns in sweeps]
        spans = [
            float(part.since.max()) for part in parts if len(np.unique(part.since)) >= _MIN_TIMES
        ]
        if len(spans) <= len(sweeps) / 2:
            return None
        span = float(np.median(spans))
        unit_s = next((u for u in _TIME_UNITS_S if _MIN_SWEEP_S <= span * u <= _MAX_SWEEP_S), None)
        if unit_s is None:
            return None
        sweep_s = span * unit_s
        known = [row for row, part in enumerate(parts) if len(part.since)]
        firsts_s = np.array([parts[row].first for row in known]) * unit_s
        lasts_s = firsts_s + [parts[row].since.max() * unit_s for row in known]
        zeros_s = {PointClock.RELATIVE: np.zeros(len(known))}
        if stamps_s is not None:
            zeros_s[PointClock.ABSOLUTE] = np.asarray(stamps_s)[known]
        for clock, zero_s in zeros_s.items():
            outside_s = np.maximum(firsts_s - zero_s, zero_s - lasts_s)
            if np.median(outside_s) <= _MAX_OUTSIDE * sweep_s:
                return cls(unit_s, sweep_s, clock, float(np.median(firsts_s - zero_s)))
        return cls(unit_s, sweep_s)

    def relative_times(self, columns: Columns, stamp_s: float | None = None) -> Floats | None:
        """Return a sweep's point times in seconds relative to its timestamp.

        The shape is (n,). Returns None if times are missing, or if they are too far from each other
        or from the timestamp.
        """
        times = _stored_times(columns)
        since_s = times.since * self.unit_s
        if len(since_s) != len(next(iter(columns.values()), ())):
            return None
        if not len(since_s):
            return since_s
        first_s = 0.0
        if self.clock is not PointClock.OTHER:
            zero_s = stamp_s if self.clock is PointClock.ABSOLUTE and stamp_s is not None else 0.0
            first_s = times.first * self.unit_s - zero_s
        if since_s.max() > _MAX_SWEEP_S or abs(first_s) > _MAX_SWEEP_S:
            return None
        return since_s + first_s

    def clock_note(self, name: str) -> str:
        """Return a note if the times come from a different clock, or an empty string."""
        if self.clock is not PointClock.OTHER:
            return ""
        return (
            f"The point times in {name} use a different clock than the sweep timestamps. The first "
            "point of each sweep is assumed to be fired at the timestamp of the sweep."
        )


class _StoredTimes(NamedTuple):
    """Point times of a sweep in the unit of their column.

    They are empty if the sweep has none.
    """

    since: Floats  # (n,), times since the first point, without loss of precision
    first: float = 0.0  # time of the first point


def _stored_times(columns: Columns) -> _StoredTimes:
    values = next((columns[name] for name in TIMES if name in columns), ())
    times = np.asarray(values)
    if not len(times) or times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        return _StoredTimes(np.empty(0))
    if times.dtype.kind == "i":  # differences of short integers overflow
        times = times.astype(np.int64)
    first = times.min()
    return _StoredTimes(np.asarray((times - first).astype(np.float64)), float(first))

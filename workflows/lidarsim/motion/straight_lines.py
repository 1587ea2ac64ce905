"""Straight lines of a trajectory, such as the flight lines of an airborne survey."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats
from ..numerics.elementary import arctan2, interp
from ..numerics.vectors import norm

_STEP_S = 0.1  # positions are resampled to this interval, so that jitter is not taken for a turn
_MAX_STEPS = 1_000_000
_STEADY_S = 1.0  # minimum duration of a line
# On a line, the direction of travel varies by less than this angle within twice `_STEADY_S`, and
# differs from the line's median direction by less than this angle. Aircraft turn at a rate of at
# least 1.5 to 3 degrees per second.
_STEADY_DEG = 2.0
_TURN_DEG = 20.0  # minimum change of direction between two separate lines
_MOVES_M_S = 0.05  # minimum speed on a line


class StraightLines(NamedTuple):
    """Consecutive straight lines of a trajectory, without the turns between them."""

    starts_s: Floats  # (n,)
    stops_s: Floats  # (n,)
    lengths_m: Floats  # (n,)

    @property
    def seconds(self) -> float:
        """Total duration of the lines in seconds."""
        return float((self.stops_s - self.starts_s).sum())

    @property
    def length_m(self) -> float:
        """Total length of the lines in meters."""
        return float(self.lengths_m.sum())

    def mean_speed(self, start_s: float, stop_s: float) -> float | None:
        """Return the mean speed in m/s on the lines in a time interval, or None if it has no lines.

        Examples
        --------
        >>> lines = StraightLines(np.array([0.0, 20]), np.array([10.0, 30]), np.array([600.0, 300]))
        >>> lines.mean_speed(0, 30), lines.mean_speed(25, 40)
        (45.0, 30.0)
        """
        within_s = np.minimum(self.stops_s, stop_s) - np.maximum(self.starts_s, start_s)
        within_s = np.maximum(within_s, 0)
        if not within_s.any():
            return None
        speeds_m_s = self.lengths_m / (self.stops_s - self.starts_s)
        return float((speeds_m_s * within_s).sum() / within_s.sum())

    def seconds_within(self, spans_s: Sequence[tuple[float, float]]) -> Floats:
        """Return the time, in seconds, for which each line overlaps any of the given time spans.

        Overlaps of 0.1 s or less are ignored, because the ends of a line are not known more
        precisely. The result has shape (n,).

        Examples
        --------
        >>> lines = StraightLines(np.array([0.0, 20]), np.array([10.0, 30]), np.array([600.0, 300]))
        >>> lines.seconds_within([(0, 4), (2, 6), (18, 20.05)]).tolist()
        [6.0, 0.0]
        """
        total = np.zeros(len(self.starts_s))
        covered_to = -np.inf  # avoids counting overlapping spans twice
        for start, stop in sorted(spans_s):
            first = np.maximum(self.starts_s, max(start, covered_to))
            total += np.maximum(np.minimum(self.stops_s, stop) - first, 0)
            covered_to = max(covered_to, stop)
        return np.where(total > _STEP_S, total, 0.0)

    @classmethod
    def from_trajectory(cls, times_s: Floats, positions: Floats) -> StraightLines:
        """Find the straight lines of a trajectory that last at least a second.

        Only the horizontal direction of travel is considered.

        Parameters
        ----------
        times_s
            Times in seconds, in ascending order. Shape (k,).
        positions
            Positions in meters. Shape (k, 3).

        Examples
        --------
        >>> times = np.arange(0.0, 21.0, 0.5)
        >>> there_and_back = np.minimum(times, 20 - times)
        >>> positions = np.stack([60 * there_and_back] * 3, axis=1)
        >>> lines = StraightLines.from_trajectory(times, positions)
        >>> len(lines.starts_s), round(lines.seconds)
        (2, 20)
        """
        span_s = float(times_s[-1] - times_s[0]) if len(times_s) else 0.0
        if span_s < _STEADY_S:
            return cls(np.zeros(0), np.zeros(0), np.zeros(0))
        count = min(int(np.ceil(span_s / _STEP_S)), _MAX_STEPS) + 1
        grid = np.linspace(times_s[0], times_s[-1], count)
        x, y, z = (interp(grid, times_s, np.ascontiguousarray(row)) for row in positions.T)
        step_s = span_s / (count - 1)
        velocities = np.gradient(np.stack([x, y]), step_s, axis=1)
        headings = np.degrees(np.unwrap(arctan2(velocities[1], velocities[0])))
        moves: Bools = norm(velocities.T) > _MOVES_M_S
        pairs = _merge_runs(headings, _steady_runs(headings, moves, round(_STEADY_S / step_s)))
        passed_m = np.append(0.0, np.cumsum(norm(np.diff([x, y, z]).T)))
        starts, stops = np.reshape(pairs, (-1, 2)).astype(np.intp).T
        long = grid[stops] - grid[starts] >= _STEADY_S - 1e-9
        starts, stops = starts[long], stops[long]
        return cls(grid[starts], grid[stops], passed_m[stops] - passed_m[starts])


def _steady_runs(headings: Floats, moves: Bools, reach: int) -> list[tuple[int, int]]:
    """Return the first and last indices of runs in which the direction of travel is steady.

    A run starts as a range of steps that move and whose headings vary by less than `_STEADY_DEG`
    for `reach` steps before and after. It is then extended as long as the headings differ from its
    median by less than `_STEADY_DEG`. The headings are in degrees.
    """
    last = len(headings) - 1
    reach = max(min(reach, last // 2), 1)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(headings, reach, mode="edge"), 2 * reach + 1
    )
    steady = (np.ptp(windows, axis=1) < _STEADY_DEG) & moves
    edges = np.flatnonzero(np.diff(steady, prepend=False, append=False)).reshape(-1, 2)
    runs: list[tuple[int, int]] = []
    for start, stop in edges.tolist():
        near = np.abs(headings - np.median(headings[start:stop])) < _STEADY_DEG
        away = np.flatnonzero(~(near & moves))
        before = away[away < start]
        after = away[away >= stop]
        first = int(before[-1]) + 1 if len(before) else 0
        final = int(after[0]) - 1 if len(after) else last
        if not runs or first > runs[-1][1]:
            runs.append((first, final))
        else:
            runs[-1] = (runs[-1][0], max(final, runs[-1][1]))
    return runs


def _merge_runs(headings: Floats, runs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Merge runs between which the direction of travel changes by less than `_TURN_DEG`."""
    lines: list[tuple[int, int]] = []
    for start, stop in runs:
        if lines:
            first, final = lines[-1]
            changes = np.abs(headings[first : stop + 1] - np.median(headings[first : final + 1]))
            if changes.max() < _TURN_DEG:
                lines[-1] = (first, stop)
                continue
        lines.append((start, stop))
    return lines

"""Committed results of a job, which are its parts, planning trials and frames."""

from __future__ import annotations

import bisect
from dataclasses import replace
from operator import attrgetter

import numpy as np

from lidarscenario.plan import Trial
from lidarsim.numerics.arrays import Ints

from .stage_messages import Receipt

_FIRST = attrgetter("first")  # sort key of parts


class CommittedParts:
    """Receipts of a job's committed parts, in scan order."""

    def __init__(self) -> None:
        self.ordered: list[Receipt] = []  # without summaries
        self.scans_done = 0
        self.point_count = 0
        self.hit_count = 0

    @property
    def cell_box(self) -> Ints | None:
        """Lowest and highest cell of all points, or None if there are no points.

        The array has shape (2, 3).
        """
        boxes = [part.cell_box for part in self.ordered if part.cell_box]
        if not boxes:
            return None
        table = np.array(boxes, np.int64).reshape(-1, 2, 3)
        return np.stack([table[:, 0].min(axis=0), table[:, 1].max(axis=0)])

    def reaching_past(self, scan: int) -> list[Receipt]:
        """Return the parts that contain the given scan or any later scan, in scan order."""
        return [part for part in self.ordered[self._index(scan) :] if part.stop > scan]

    def part_of(self, scan: int) -> Receipt:
        """Return the part that contains a scan, or raise KeyError if the scan is not committed."""
        for part in self.ordered[self._index(scan) :][:1]:
            if scan in part.scans:
                return part
        raise KeyError(scan)

    def missing(self, first: int, stop: int) -> list[tuple[int, int]]:
        """Return the uncommitted scans from `first` to `stop` as half-open ranges."""
        absent: list[tuple[int, int]] = []
        index = self._index(first)
        while first < stop and index < len(self.ordered):
            part = self.ordered[index]
            if first < part.first:
                absent.append((first, min(part.first, stop)))
            first = max(first, part.stop)
            index += 1
        return [*absent, (first, stop)] if first < stop else absent

    def add(self, part: Receipt) -> None:
        """Add a part whose scans have not been committed before."""
        bare = replace(part, summaries=b"", record=None, held_at="")
        bisect.insort(self.ordered, bare, key=_FIRST)
        self._count(part, 1)

    def remove(self, part: Receipt) -> None:
        """Remove a part."""
        del self.ordered[self._index(part.first)]
        self._count(part, -1)

    def _index(self, scan: int) -> int:
        return max(0, bisect.bisect_right(self.ordered, scan, key=_FIRST) - 1)

    def _count(self, part: Receipt, sign: int) -> None:
        self.scans_done += sign * len(part.scans)
        self.point_count += sign * part.point_count
        self.hit_count += sign * part.hit_count


class CommittedResults:
    """Committed parts and planning trials of a job, and the frames delivered so far.

    `RunDatabase` modifies the parts and trials, and `advance_frames` modifies the frames.

    Parameters
    ----------
    number
        Number of the job in its run.
    scans
        Scans that the run casts.
    has_frames
        Whether scans are also delivered as frames.
    """

    def __init__(self, number: int, scans: range, *, has_frames: bool = False) -> None:
        self.number = number
        self.scans = scans
        self.has_frames = has_frames
        self.reset()

    def reset(self) -> None:
        """Remove all parts, trials and frames."""
        self.parts = CommittedParts()
        self.trials: list[Trial] = []
        self.frames = self.scans.start  # one past the last scan that was delivered as a frame

    def advance_frames(self, stop: int) -> None:
        """Record that all scans before `stop` were delivered as frames."""
        self.frames = stop

    @property
    def missing_count(self) -> int:
        """Number of scans that have not been committed."""
        return len(self.scans) - self.parts.scans_done

    @property
    def scans_complete(self) -> bool:
        """True if all scans have been committed and, in a job with frames, delivered."""
        framed = not self.has_frames or self.frames == self.scans.stop
        return framed and not self.missing_count

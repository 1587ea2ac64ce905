"""What a run has of one job: committed parts and trials, and what is read from them."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from lidarsim.base.arrays import Floats32, Ints
from lidarsim.base.errors import LidarError
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps

from ...columns.parts import StoredCloud, read_part, read_tally, unpack
from ...scenario.build import Job
from ..job_source import OneJob
from ..pipeline.messages import Receipt, samples_of_scan, scans_in_words, summary_type
from ..progress import Progress
from .database import JobParts

if TYPE_CHECKING:
    from .run_store import RunStore

SAMPLE_RAYS = 400  # of the pictures
CHECKERS = 4  # threads that check parts; each holds one in memory, twice
NAMED = 3  # parts, scans or files that a message names
_SAID = attrgetter("first", "stop", "rows")  # by a receipt, what the part must say as well


class JobPoints:
    """What a run has of one job: its committed parts and trials, and what is read from them."""

    def __init__(self, store: RunStore, job: Job) -> None:
        self.job, self._store = job, store
        only, count = isinstance(store.jobs, OneJob), job.survey.scan_count
        scans = store.jobs.shard.scans(count) if only else range(count)
        self.parts: JobParts = store.db.job(job.number, scans.stop, scans.start)
        self.parts.has_frames = only
        self.identified = only  # whether it is kept what the job is made of
        self.sweeps: Sweeps | None = None  # of a job for a data set, once it was made
        self.resumed = self.parts.scans_done  # scans whose points are of an earlier run

    def check(self, sizes: Mapping[str, int], strays: Sequence[str]) -> None:
        """Have the scans of missing and damaged parts cast again, and commit parts that are there.

        `sizes` are those of the files in storage, and `strays` names of the job's, of which the
        database may not know: it was lost, or is a copy of some seconds before.
        """
        lost: dict[str, list[Receipt]] = {"missing": [], "damaged": []}
        known = {part.name for part in self.parts.ordered}
        unknown = [name for name in strays if name not in known]
        pool = ThreadPoolExecutor(min(CHECKERS, os.cpu_count() or 1), "check")
        try:
            states = pool.map(lambda part: self._state(part, sizes), self.parts.ordered)
            for part, state in zip(self.parts.ordered, states, strict=True):
                if state:
                    lost[state].append(part)
            for what, parts in lost.items():
                if parts:
                    self._drop(what, parts)
            for receipt in filter(None, pool.map(self.receipt, unknown)):
                self._store.db.commit([receipt])
        finally:
            pool.shutdown(cancel_futures=True)
        self.resumed = self.parts.scans_done

    def _drop(self, what: str, parts: Sequence[Receipt]) -> None:
        self._store.db.drop(self.job.number, parts)
        names = listed([part.name for part in parts])
        scans = listed([scans_in_words(part.first, part.stop) for part in parts])
        verb = "was" if len(parts) == 1 else "were"
        self._store.notes.append(
            f"cast again: {scans}; {names} {verb} {what} in {self._store.storage.url}"
        )

    def _state(self, part: Receipt, sizes: Mapping[str, int]) -> str:
        """Say whether a part is not what its receipt says, to the checksum of each column."""
        if part.name not in sizes:
            return "missing"
        if sizes[part.name] != part.size:
            return "damaged"
        found = self.receipt(part.name)
        return "" if found is not None and _SAID(found) == _SAID(part) else "damaged"

    def receipt(self, name: str) -> Receipt | None:
        """Receipt of a part in storage; None if it is damaged."""
        storage = self._store.storage
        try:
            data = storage.read(name)
            return Receipt.of_part(unpack(data), self.job.number, name, len(data))
        except LidarError:
            return None
        except OSError as error:
            if error.errno in (errno.EIO, errno.ENOENT):  # a bad disk; just removed
                return None
            raise LidarError(
                f"The part {storage.path(name)} cannot be read: {error.strerror or error}."
            ) from error

    @property
    def kept(self) -> str:
        """Committed scans and trials in words; empty for none."""
        if self.parts.scans_done:
            return f"{self.parts.scans_done:,} of {len(self.parts.scans):,} scans"
        if self.parts.trials:
            return f"{len(self.parts.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def complete(self) -> bool:
        """Whether everything for a result is committed."""
        return self.parts.complete and len(self.parts.trials) == self.job.trials

    def progress(self) -> Progress:
        """Progress of a resumed run at its start."""
        parts = self.parts
        return Progress(
            scans=len(parts.scans),
            generated=parts.frames - parts.scans.start,
            cast=parts.scans_done,
            framed=parts.frames - parts.scans.start,
            collected=parts.scans_done,
            points=parts.point_count,
            trials=self.job.trials,
            trials_done=len(parts.trials),
        )

    def points(self) -> StoredCloud:
        """Points committed so far."""
        parts, job = self.parts.ordered, self.job
        world = job.survey.coordinates == "world"
        return StoredCloud(
            self._store.storage,
            [part.name for part in parts],
            [part.first for part in parts],
            [part.rows for part in parts],
            job.survey.stored_columns,
            self.parts.cells,
            job.survey.precision_m,
            job.scene.origin if world else np.zeros(3),
            keeper=self._store,
            sweeps=partial(Sweeps.of, job.survey, job.scene),
        )

    def points_of_scan(self, scan: int) -> Cloud:
        """Points of a committed scan."""
        part = self.parts.part_of(scan)
        columns = read_part(self._store.storage, part.name)
        ends = np.cumsum(columns.counts)
        at = scan - part.first
        rows = slice(int(ends[at] - columns.counts[at]), int(ends[at]))
        return self.points().cloud_of(columns, rows)

    def hit_counts(self) -> Ints:
        """Hits by counters of the scene, see `Scene.counters`."""
        counts = np.zeros(self.job.scene.counters, np.int64)
        for part in self.parts.ordered:
            triangles, hits = read_tally(self._store.storage, part.name)
            counts[triangles] += hits
        return counts

    def sample_rays(self) -> Floats32:
        """Return the ends of some rays, (k, 2, 3), metres, local coordinates."""
        survey = self.job.survey
        samples = samples_of_scan(survey.scan_count)
        kind = summary_type(samples)
        every = max(1, samples * survey.scan_count // SAMPLE_RAYS)
        rays = [np.empty((0, 2, 3), np.float32)]
        every_nth = range(0, survey.scan_count, every)
        wanted = dict.fromkeys(n for n in every_nth if not self.parts.missing(n, n + 1))
        for first, data in self.parts.summaries_of(list(wanted)):
            for scan, summary in enumerate(np.frombuffer(data, kind), first):
                ends = summary["samples"][~np.isnan(summary["samples"][:, 0])]
                if scan in wanted and len(ends):
                    start = np.asarray(survey.pose(scan).position, np.float32)
                    starts = np.broadcast_to(start, ends.shape)
                    rays.append(np.stack([starts, ends], axis=1))
        return np.concatenate(rays)


def listed(names: Sequence[str], most: int = NAMED) -> str:
    """Return the first names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more:,} more" if more > 0 else "")

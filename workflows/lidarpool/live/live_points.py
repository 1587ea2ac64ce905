"""The growing cloud on the live page, read from the parts that a run commits."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from ..base.arrays import Floats
from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.parts import read_part
from ..pipeline import Receipt
from ..run.result import RunResult
from ..run.store import RunStore

LIVE_POINTS = 150_000  # in the browser at a time
PARTS_NOTED = 64  # parts that wait to be read; of more, every second is skipped
PARTS_AT_ONCE = 8  # parts read for one drawing


class LivePoints:
    """Points and hits of a run, from as many of its parts as there is time to read.

    The run's thread records parts, the page's thread reads them. At the end an evenly spaced
    sample of the whole result replaces them, so skipped parts do not matter.
    """

    def __init__(self, store: RunStore, most: int = LIVE_POINTS) -> None:
        self._store, self._most = store, most
        self._points = store.points()  # knows what a part holds
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # of the points of a part that are taken
        self._counts = np.zeros(store.job.scene.counters, np.int64)
        self.hits = 0  # of the parts that were read
        self.version = 0  # incremented when there is something new to show
        self.cloud: Cloud | None = None

    def add(self, receipts: Sequence[Receipt]) -> None:
        """Record parts that are in storage; quick, reads nothing."""
        with self._lock:
            self._waiting += [part.name for part in receipts]
            while len(self._waiting) > PARTS_NOTED:
                del self._waiting[1::2]

    @property
    def waiting(self) -> bool:
        """Whether there are parts to read."""
        return bool(self._waiting)

    def gather(self) -> None:
        """Read some of the waiting parts, without those that cannot be read: the run says so."""
        with self._lock:
            names, self._waiting = self._waiting[:PARTS_AT_ONCE], self._waiting[PARTS_AT_ONCE:]
            clouds = [] if self.cloud is None else [self.cloud]
            for name in names:
                with suppress(LidarpoolError):
                    part = read_part(self._store.storage, name)
                    self._counts[part.triangles] += part.hits
                    self.hits += int(part.hits.sum())
                    rows = np.flatnonzero(self._random.random(len(part)) < self._share)
                    clouds.append(self._points.cloud_of(part, rows))
            if not names or not clouds:
                return
            cloud = Cloud.joined(clouds)
            while len(cloud) > self._most:
                self._share /= 2
                cloud = cloud.part(np.flatnonzero(self._random.random(len(cloud)) < 0.5))
            self.cloud = cloud
            self.version += 1

    def finish(self, result: RunResult) -> None:
        """Take a sample of all points, and all hits; the parts may then be removed."""
        with self._lock:
            self._waiting = []
            self._counts, self.hits = result.hit_counts, result.hits
            self.cloud = result.points.sample(self._most, PARTS_NOTED)
            self.version += 1

    def hit_counts(self) -> Floats:
        """Hits by counters of the scene, scaled up to all hits if some parts were not read."""
        with self._lock:
            return np.asarray(self._counts * (self._store.db.hits / max(self.hits, 1)))

"""The growing cloud as it is displayed, read from the parts that a run commits."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.parts import read_part
from ..run.result import RunResult
from ..run.store import RunStore
from ..scan import Receipt

LIVE_POINTS = 150_000  # in the browser at a time
PARTS_NOTED = 64  # parts that wait to be read; of more, every second is left out
PARTS_AT_ONCE = 8  # read for one drawing


class LivePoints:
    """Points and hits of a run, of as many of its parts as there is time to read.

    The run's thread notes parts, the page's reads them. At the end an even choice of the whole
    result takes their place, so that what was left out meanwhile does not matter.

    Parameters
    ----------
    store
        What the run commits to.
    most
        Points that are kept.
    """

    def __init__(self, store: RunStore, most: int = LIVE_POINTS) -> None:
        self._store, self._most = store, most
        self._points = store.points()  # knows what a part holds
        self._waiting: list[str] = []  # names of parts
        self._lock = threading.Lock()
        self._random = np.random.default_rng(0)
        self._share = 1.0  # of the points of a part that are taken
        self._counts = np.zeros(store.job.scene.triangles, np.int64)
        self.hits = 0  # of the parts that were read
        self.version = 0  # counts up when there is something else to show
        self.cloud: Cloud | None = None
        self.error = ""  # why a part could not be read, a sentence

    def add(self, receipts: Sequence[Receipt]) -> None:
        """Note parts that are in storage; cheap, and reads nothing."""
        with self._lock:
            self._waiting += [part.name for part in receipts]
            while len(self._waiting) > PARTS_NOTED:
                del self._waiting[1::2]

    def gather(self) -> None:
        """Read some of the parts that wait.

        A part that cannot be read is left out, and `error` says why: it is for the run to fail.
        """
        with self._lock:
            names, self._waiting = self._waiting[:PARTS_AT_ONCE], self._waiting[PARTS_AT_ONCE:]
            clouds = [cloud for name in names if (cloud := self._read(name)) is not None]
            if clouds:
                self._keep([self.cloud, *clouds] if self.cloud is not None else clouds)

    def _read(self, name: str) -> Cloud | None:
        try:
            part = read_part(self._store.storage, name)
        except LidarpoolError as error:
            self.error = str(error)
            return None
        self._counts[part.triangles] += part.hits
        self.hits += int(part.hits.sum())
        rows = np.flatnonzero(self._random.random(len(part)) < self._share)
        return self._points.cloud_of(part, rows)

    def _keep(self, clouds: list[Cloud]) -> None:
        """Keep these points, or half of them as often as they are too many."""
        cloud = Cloud.joined(clouds)
        while len(cloud) > self._most:
            self._share /= 2
            cloud = cloud.part(np.flatnonzero(self._random.random(len(cloud)) < 0.5))
        self.cloud = cloud
        self.version += 1

    def finish(self, result: RunResult) -> None:
        """Take an even choice of all points, and all hits; the parts may be removed after that."""
        with self._lock:
            self._waiting = []
            self.cloud = result.points.sample(self._most, PARTS_NOTED)
            self._counts, self.hits = result.hit_counts, result.hits
            self.version += 1

    def replace(self, cloud: Cloud) -> None:
        """Show other points, such as more of them."""
        with self._lock:
            self.cloud = cloud
            self.version += 1

    def hit_counts(self) -> NDArray[np.float64]:
        """Hits of each triangle, (f,), scaled up to all hits where not all parts were read."""
        with self._lock:
            counts = self._counts[: len(self._store.job.scene.faces)]
            return np.asarray(counts * (self._store.db.hits / max(self.hits, 1)))

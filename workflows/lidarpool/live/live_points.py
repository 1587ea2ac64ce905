"""The growing cloud as it is displayed, read from the parts that a run commits."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..columns.parts import PartColumns, StoredCloud, read_part
from ..columns.table import AXES, SCAN
from ..run.job import Job
from ..run.store import RunStore
from ..scan import Receipt
from .display import PointSample, display_rows, quantities, row_type

LIVE_POINTS = 150_000  # in the browser at a time
PARTS_NOTED = 64  # parts that wait to be read; of more, some stand for others
PARTS_AT_ONCE = 8  # read for one drawing


@dataclass(frozen=True)
class PartGroup:
    """Some parts, of which one is read.

    Parameters
    ----------
    name, read_hits
        The part that is read, and its hits.
    parts, rows, hits
        How many parts these are, and their points and hits.
    """

    name: str
    read_hits: int
    parts: int
    rows: int
    hits: int


class PartChoice:
    """An even choice of parts that come faster than they can be read, never more than so many.

    Where there are too many, the smallest two neighbours become one group, of which one part is
    read. Each is as likely to be that as it has hits.

    Parameters
    ----------
    most
        Groups that there may be.

    Examples
    --------
    >>> choice = PartChoice(2)
    >>> choice.add([Receipt(0, i, i + 1, str(i), 10, 0, 50, (), b"") for i in range(5)])
    >>> [(group.parts, group.rows) for group in choice.take(8)]
    [(2, 20), (3, 30)]
    """

    def __init__(self, most: int = PARTS_NOTED) -> None:
        self._most = most
        self._groups: list[PartGroup] = []
        self._random = random.Random(0)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._groups)

    def add(self, receipts: Iterable[Receipt]) -> None:
        """Note parts that are in storage; cheap, and reads nothing."""
        with self._lock:
            for part in receipts:
                self._groups.append(PartGroup(part.name, part.hits, 1, part.rows, part.hits))
                if len(self._groups) > self._most:
                    self._merge()

    def take(self, count: int) -> list[PartGroup]:
        """Take out at most so many groups, spread over all that there are."""
        with self._lock:
            total = len(self._groups)
            places = {i * total // count for i in range(count)} if count < total else range(total)
            taken = [self._groups[i] for i in places]
            self._groups = [g for i, g in enumerate(self._groups) if i not in places]
        return taken

    def _merge(self) -> None:
        groups = self._groups
        at = min(
            range(len(groups) - 1), key=lambda i: groups[i].parts + groups[i + 1].parts, default=0
        )
        one, other = groups[at : at + 2]
        hits = one.hits + other.hits
        read = one if self._random.random() * hits < one.hits else other
        groups[at : at + 2] = [
            PartGroup(
                read.name, read.read_hits, one.parts + other.parts, one.rows + other.rows, hits
            )
        ]


class LivePoints:
    """Points and hits of a run to show, of an even choice of its parts.

    One thread notes parts, another reads them. Where not all are read, those that are stand for
    the others: the hits of the triangles add up to the hits of all parts noted and taken up.

    Parameters
    ----------
    job
        What the run does.
    most
        Points that are kept.
    """

    def __init__(self, job: Job, most: int = LIVE_POINTS) -> None:
        self._survey, self._origin = job.survey, job.scene.origin
        table = (SCAN, *(c for c in job.survey.stored_columns if c not in AXES))
        self.quantities = quantities(table)
        self.parts = PartChoice()
        self.hits = 0  # of the parts that were taken up
        self.error = ""  # why a part could not be read, a sentence
        self._sample = PointSample(most, row_type(self.quantities))
        self._hit_counts = np.zeros(len(job.scene.faces))
        self._lock = threading.Lock()

    def gather(self, store: RunStore, count: int = PARTS_AT_ONCE) -> bool:
        """Read at most so many of the parts that wait; returns whether more do.

        A part that cannot be read is left out, and `error` says why: it is for the run to fail.
        """
        with self._lock:
            for group in self.parts.take(count):
                try:
                    part = read_part(store.storage, group.name)
                except LidarpoolError as error:
                    self.error = str(error)
                else:
                    self._take(part, group, store)
        return len(self.parts) > 0

    def _take(self, part: PartColumns, group: PartGroup, store: RunStore) -> None:
        if group.read_hits:
            self._hit_counts[part.triangles] += part.hits * (group.hits / group.read_hits)
        self.hits += group.hits
        chosen = self._sample.choose(group.rows, len(part))
        cloud = _reader(store).cloud_of(part, chosen)
        self._sample.put(
            display_rows(
                self.quantities,
                cloud.positions,
                self._origin,
                cloud.columns,
                self._sensors(cloud["scan"]),
            )
        )

    def _sensors(self, scans: NDArray[np.int32]) -> NDArray[np.float64]:
        """Where the sensor was when scans (n,) began, (n, 3), metres, world coordinates."""
        found, which = np.unique(scans, return_inverse=True)
        places = [self._survey.pose(scan).position for scan in found.tolist()]
        return np.array(places).reshape(-1, 3)[which] + self._origin

    @property
    def seen(self) -> int:
        """Points of the parts that were taken up."""
        return self._sample.seen

    @property
    def rows(self) -> NDArray[np.void]:
        """Those to show, see `display_rows`; a copy."""
        with self._lock:
            return self._sample.rows

    @property
    def hit_counts(self) -> NDArray[np.float64]:
        """Hits of each triangle, (f,), scaled up where not all parts were read; a copy."""
        with self._lock:
            return self._hit_counts.copy()


def _reader(store: RunStore) -> StoredCloud:
    """Return what makes points of parts; their list is the driver's, in another thread."""
    survey = store.job.survey
    return StoredCloud(
        store.storage,
        (),
        (),
        survey.stored_columns,
        None,
        survey.precision_m,
        store.job.scene.origin,
    )

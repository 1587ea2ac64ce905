"""What a data set's card is made of: a description, and figures of its jobs."""

from __future__ import annotations

import hashlib
import heapq
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from poolpart import TaskRecord

from ..base.arrays import Bools, Floats
from ..export.jobs import JobRow, Value
from ..pipeline.task_book import StageTotals
from .ranks import rank_correlation

FAILED_MOST, SLOWEST_MOST = 200, 10  # jobs that are kept whole
_COUNTS = ("scans", "sweeps", "rays", "hits", "points")


@dataclass(frozen=True, eq=False)
class CampaignInfo:
    """What a card says beside the table of jobs.

    Parameters
    ----------
    title
        Name of the data set.
    count
        Jobs of the description.
    seed
        Of what was drawn.
    format
        Of the jobs' files: kitti, nuscenes, mcap, parquet or folder.
    names
        Names of the varied values, in the order of the table's columns.
    sensors
        {name: model and rate in words}; the name is "" where there is only one.
    license
        As given; "" for none.
    versions
        Software on which the bytes of points depend, {name: version}.
    seconds
        Wall time of this run.
    resumed
        Jobs of an earlier run.
    notes
        Remarks for the user.
    picture
        PNG of one job, a local file; None for none.
    classes
        Names of semantic classes, {class: name}, as far as known.
    file
        Name of the description, as after ``lidarpool run``; "" for a campaign of Python.
    description
        The description as text.
    stages, records
        Tasks of this run: the totals of each stage, and some tasks.
    """

    title: str
    count: int
    seed: int
    format: str
    names: Sequence[str] = ()
    sensors: Mapping[str, str] = field(default_factory=dict)
    license: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    resumed: int = 0
    notes: Sequence[str] = ()
    picture: Path | None = None
    classes: Mapping[int, str] = field(default_factory=dict)
    file: str = "campaign.yaml"
    description: str = ""
    stages: Sequence[StageTotals] = ()
    records: Sequence[TaskRecord] = ()


@dataclass(frozen=True, eq=False)
class Varied:
    """What one quantity was in each job: numbers, or labels if a job had text, true or false."""

    name: str
    values: Floats  # (n,): numbers, or places in `labels`; NaN in jobs without the quantity
    labels: tuple[str, ...]  # empty for numbers

    @property
    def there(self) -> Floats:
        """Values of the jobs that have one."""
        return self.values[np.isfinite(self.values)]


class Figures:
    """Totals, and a few numbers of each job: 60 bytes, and 12 for each varied quantity.

    Parameters
    ----------
    names
        Names of the varied quantities.
    jobs
        Rows of the table, which are read once; `add` takes more.
    """

    def __init__(self, names: Sequence[str], jobs: Iterable[JobRow] = ()) -> None:
        self.jobs, self.done = 0, 0
        self.totals: Counter[str] = Counter(dict.fromkeys(_COUNTS, 0))
        self.splits: dict[str, Counter[str]] = {}  # {split: done jobs, sweeps, points}
        self.classes: Counter[int] = Counter()  # {class: points}
        self.classed: Counter[int] = Counter()  # {class: jobs that have it}
        self.seconds = 0.0
        self.failed: list[JobRow] = []  # the first of them
        self._slowest: list[tuple[float, int, JobRow]] = []
        self._each = {name: array("d") for name in ("points", "rays", "hits", "seconds", "failed")}
        self._numbers = {name: array("d") for name in names}
        self._codes = {name: array("i") for name in names}
        self._labels: dict[str, dict[str, int]] = {name: {} for name in names}
        self._digest = hashlib.sha256()
        for row in jobs:
            self.add(row)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_digest": None}  # a copy, as for charts, has no digest

    def add(self, row: JobRow) -> None:
        """Count one more job."""
        self.jobs += 1
        for name, kept in self._each.items():
            kept.append(not row.done if name == "failed" else getattr(row, name))
        for name, labels in self._labels.items():
            self._add_value(name, labels, row.values.get(name))
        if not row.done:
            if len(self.failed) < FAILED_MOST:
                self.failed.append(row)
            return
        self.done += 1
        self._digest.update(f"{row.name} {row.sha256}\n".encode())
        self.seconds += row.seconds
        counts = {name: getattr(row, name) for name in _COUNTS}
        self.totals.update(counts)
        self.splits.setdefault(row.split, Counter()).update(counts | {"jobs": 1})
        self.classes.update(row.classes)
        self.classed.update(row.classes.keys())
        entry = (row.seconds, -row.number, row)
        if len(self._slowest) < SLOWEST_MOST:
            heapq.heappush(self._slowest, entry)
        else:
            heapq.heappushpop(self._slowest, entry)

    def _add_value(self, name: str, labels: dict[str, int], value: Value | None) -> None:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        self._numbers[name].append(float(value) if number and value is not None else np.nan)
        if value is None or number:
            self._codes[name].append(-1)
        else:
            text = value if isinstance(value, str) else ("false", "true")[bool(value)]
            self._codes[name].append(labels.setdefault(text, len(labels)))

    def _varied(self, name: str) -> Varied:
        numbers, labels = np.array(self._numbers[name]), self._labels[name]
        if not labels:
            return Varied(name, numbers, ())
        texts = list(labels)
        text_of = np.array(self._codes[name])
        known = np.isfinite(numbers)
        for value in np.unique(numbers[known]).tolist():  # as «auto» beside 1 and 2
            texts.append(f"{value:g}")
            text_of[numbers == value] = len(texts) - 1
        order = sorted(range(len(texts)), key=lambda k: texts[k])
        place = np.append(np.argsort(order), -1)  # the last for -1
        values = place[text_of].astype(np.float64)
        values[values < 0] = np.nan
        return Varied(name, values, tuple(texts[k] for k in order))

    @property
    def sha256(self) -> str:
        """Digest of the names and points of all done jobs, in the order of their rows."""
        return self._digest.hexdigest()

    @property
    def varied(self) -> list[Varied]:
        """What each varied quantity was in each job."""
        return [self._varied(name) for name in self._numbers]

    @property
    def slowest(self) -> list[JobRow]:
        """Jobs that took longest to cast, the slowest first."""
        return [row for _, _, row in sorted(self._slowest, reverse=True)]

    def each(self, name: str) -> Floats:
        """Return points, rays, hits or seconds of each job (n,)."""
        return np.array(self._each[name])

    @property
    def failures(self) -> Bools:
        """Whether each job failed (n,)."""
        return np.array(self._each["failed"]) > 0

    def spread(self, name: str) -> dict[str, float] | None:
        """Minimum, 10th, 50th and 90th percentile and maximum over done jobs; None without any."""
        values = self.each(name)[~self.failures]
        if not len(values):
            return None
        names = ("lowest", "tenth", "median", "ninetieth", "highest")
        return dict(zip(names, np.percentile(values, (0, 10, 50, 90, 100)).tolist(), strict=True))

    def described(self) -> Iterator[dict[str, Any]]:
        """Yield the figures of each varied quantity."""
        done, points = ~self.failures, self.each("points")
        for varied in self.varied:
            known = done & np.isfinite(varied.values)
            there = varied.there
            out: dict[str, Any] = {"name": varied.name, "jobs": len(there)}
            if varied.labels:
                counts = np.bincount(there.astype(np.intp), minlength=len(varied.labels))
                out["values"] = dict(zip(varied.labels, counts.tolist(), strict=True))
            elif len(there):
                low, median, high = np.percentile(there, (0, 50, 100)).tolist()
                out |= {"lowest": low, "median": median, "highest": high}
                correlation = rank_correlation(varied.values[known], points[known])
                told = None if correlation is None else round(correlation, 6)
                out["rank_correlation_with_points"] = told
            yield out

"""Figures of the jobs of a data set."""

from __future__ import annotations

import hashlib
from array import array
from bisect import insort
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats
from ..export.jobs import JobRow
from .ranks import rank_correlation

FAILED_MOST, SLOWEST_MOST = 200, 10  # jobs that are kept whole
_COUNTS = ("scans", "sweeps", "rays", "hits", "points")


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
    """Totals, and a few numbers of each job: 40 bytes, and 9 for each varied quantity.

    Parameters
    ----------
    names
        Names of the varied quantities.
    jobs
        Rows of the table, which are read once; `add` takes more.
    """

    def __init__(self, names: Sequence[str], jobs: Iterable[JobRow] = ()) -> None:
        self.jobs = 0
        self.splits: dict[str, Counter[str]] = {}  # {split: done jobs, and their counts}
        self.classes: Counter[int] = Counter()  # {class: points}
        self.classed: Counter[int] = Counter()  # {class: jobs that have it}
        self.failed: list[JobRow] = []  # the first of them
        self.slowest: list[JobRow] = []  # those that took longest to cast, the slowest first
        self._each = {name: array("d") for name in ("points", "rays", "hits", "seconds", "failed")}
        # Numbers, or places in the labels; and which of both.
        self._values = {name: array("d") for name in names}
        self._labelled = {name: array("b") for name in names}
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
            value = row.values.get(name, np.nan)
            if labelled := isinstance(value, str | bool | np.bool_):
                text = value if isinstance(value, str) else str(value).lower()
                value = labels.setdefault(text, len(labels))
            self._values[name].append(value)
            self._labelled[name].append(labelled)
        if not row.done:
            if len(self.failed) < FAILED_MOST:
                self.failed.append(row)
            return
        self._digest.update(f"{row.name} {row.sha256}\n".encode())
        counts = {name: getattr(row, name) for name in _COUNTS}
        self.splits.setdefault(row.split, Counter()).update(counts, jobs=1)
        self.classes.update(row.classes)
        self.classed.update(row.classes.keys())
        insort(self.slowest, row, key=lambda row: (-row.seconds, row.number))
        del self.slowest[SLOWEST_MOST:]

    def _varied(self, name: str) -> Varied:
        values, labels = np.array(self._values[name]), dict(self._labels[name])
        known = np.isfinite(values)
        values[~known] = np.nan
        if not labels:
            return Varied(name, values, ())
        numbers = known & (np.array(self._labelled[name]) == 0)
        codes = values.copy()
        for value in np.unique(values[numbers]).tolist():  # as «auto» beside 1 and 2
            codes[numbers & (values == value)] = labels.setdefault(f"{value:g}", len(labels))
        order = sorted(labels)
        codes[known] = np.argsort([labels[text] for text in order])[codes[known].astype(np.intp)]
        return Varied(name, codes, tuple(order))

    @property
    def done(self) -> int:
        """How many jobs are done."""
        return sum(counts["jobs"] for counts in self.splits.values())

    @property
    def totals(self) -> dict[str, int]:
        """Scans, sweeps, rays, hits and points of all done jobs."""
        each = self.splits.values()
        return {name: sum(counts[name] for counts in each) for name in _COUNTS}

    @property
    def sha256(self) -> str:
        """Digest of the names and points of all done jobs, in the order of their rows."""
        return self._digest.hexdigest()

    @property
    def varied(self) -> list[Varied]:
        """What each varied quantity was in each job."""
        return [self._varied(name) for name in self._values]

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

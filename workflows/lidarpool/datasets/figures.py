"""Figures of a data set: totals, and a few numbers of each job."""

from __future__ import annotations

import hashlib
from array import array
from bisect import insort
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lidarsim.base.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.base.words import shortened, without_common_prefix

from .job_table import JobRow

# jobs that are kept whole
FAILED_MOST = 200
SLOWEST_MOST = 10
_COUNTS = ("scans", "sweeps", "rays", "hits", "points")
MOST_LABELS = 12  # bars; the rarest labels share the last one
_BINS = 24  # at most
_LETTER = 11.5  # width of a letter of a label, pixels


def rank_correlation(a: AnyArray, b: AnyArray) -> float | None:
    """Spearman's rank correlation, ties with their mean rank; None if one is constant or empty.

    Examples
    --------
    >>> rank_correlation(np.array([1.0, 2.0, 5.0, 9.0]), np.array([4.0, 3.0, 2.0, 1.0]))
    -1.0
    """
    ranks = []
    for values in (a, b):
        found, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
        if len(found) < 2:
            return None
        ranks.append((np.cumsum(counts) - (counts - 1) / 2)[inverse])
    return float(np.asarray(np.corrcoef(ranks))[0, 1])


@dataclass(frozen=True, eq=False)
class Varied:
    """What one quantity was in each job: numbers, or labels if a job had text, true or false."""

    name: str
    values: Floats  # (n,): numbers, or places in `labels`; NaN in jobs without the quantity
    labels: tuple[str, ...] = ()  # none for numbers

    @property
    def there(self) -> Floats:
        """Values of the jobs that have one."""
        return self.values[np.isfinite(self.values)]

    def counts(self) -> Ints:
        """How many jobs have each label."""
        return np.bincount(self.there.astype(np.intp), minlength=len(self.labels))

    def folded(self) -> Varied:
        """Let the rarest of many labels share the last one."""
        labels = self.labels
        if len(labels) <= MOST_LABELS:
            return self
        kept = np.sort(np.argsort(-self.counts(), kind="stable")[: MOST_LABELS - 1])
        place = np.append(np.full(len(labels), MOST_LABELS - 1.0), np.nan)
        place[kept] = np.arange(len(kept))
        values = place[np.nan_to_num(self.values, nan=-1).astype(np.intp)]
        others = f"{len(labels) - len(kept)} others"
        return Varied(self.name, values, (*(labels[k] for k in kept), others))

    @cached_property
    def edges(self) -> Floats:
        """Edges of bins (bins + 1,): of labels one each, of few whole numbers, or equal ones."""
        there = self.there
        low, high = (float(there.min()), float(there.max())) if len(there) else (0.0, 1.0)
        if high - low <= 30 and (there == np.round(there)).all():
            return np.arange(low - 0.5, high + 1)
        if low == high:
            low = low - 0.5
            high = high + 0.5
        bins = int(np.clip(2 * np.sqrt(len(there)), 6, _BINS))
        # Half of a logarithmic distribution lies below the geometric mean of its limits.
        middle = (np.sqrt(max(low, 0.0) * high) * (low + high) / 2) ** 0.5
        if low > 0 and high > 20 * low and np.median(there) < middle:
            return np.geomspace(low, high, bins + 1)
        return np.linspace(low, high, bins + 1)

    @property
    def is_log(self) -> bool:
        """Whether its axis is logarithmic, as its bins are."""
        wide = np.diff(self.edges)
        return bool(wide[-1] > 1.01 * wide[0])

    @cached_property
    def short_labels(self) -> list[str]:
        """Labels without what all have in common, and not too long."""
        return [shortened(label, 15) for label in without_common_prefix(self.labels)]

    def slanted(self, wide: float) -> bool:
        """Whether labels are too long to stand side by side."""
        longest = max(map(len, self.short_labels), default=0)
        return longest * _LETTER > wide / max(1, len(self.labels))


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
        # {split: done jobs and their counts}, {class: points and the jobs that have it}
        self.splits: dict[str, Counter[str]] = {}
        self.classes: dict[int, Counter[str]] = {}
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
        for number, points in row.classes.items():
            self.classes.setdefault(number, Counter()).update(points=points, jobs=1)
        insort(self.slowest, row, key=lambda row: (-row.seconds, row.number))
        del self.slowest[SLOWEST_MOST:]

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

    def _varied(self, name: str) -> Varied:
        values = np.array(self._values[name])
        labels = dict(self._labels[name])
        known = np.isfinite(values)
        values[~known] = np.nan
        if not labels:
            return Varied(name, values)
        numbers = known & (np.array(self._labelled[name]) == 0)
        codes = values.copy()
        for value in np.unique(values[numbers]).tolist():  # as «auto» beside 1 and 2
            codes[numbers & (values == value)] = labels.setdefault(f"{value:g}", len(labels))
        order = sorted(labels)
        codes[known] = np.argsort([labels[text] for text in order])[codes[known].astype(np.intp)]
        return Varied(name, codes, tuple(order))

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
        done = ~self.failures
        points = self.each("points")
        for varied in self.varied:
            known = done & np.isfinite(varied.values)
            there = varied.there
            out: dict[str, Any] = {"name": varied.name, "jobs": len(there)}
            if varied.labels:
                out["values"] = dict(zip(varied.labels, varied.counts().tolist(), strict=True))
            elif len(there):
                low, median, high = np.percentile(there, (0, 50, 100)).tolist()
                out |= {"lowest": low, "median": median, "highest": high}
                correlation = rank_correlation(varied.values[known], points[known])
                told = None if correlation is None else round(correlation, 6)
                out["rank_correlation_with_points"] = told
            yield out

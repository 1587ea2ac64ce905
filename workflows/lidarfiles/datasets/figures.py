"""Statistics of a data set, which are totals and a few values for each job."""

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

from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.words import remove_common_prefix, shorten_name

from .job_table import JobRow

# Maximum numbers of rows that are kept in full.
MAX_FAILED = 200
MAX_SLOWEST = 10
_COUNTS = ("scans", "sweeps", "rays", "hits", "points")
MAX_LABELS = 12  # maximum number of bars; the rarest labels share the last bar
_MAX_BINS = 24
_LETTER = 11.5  # average width of a letter in a label, in pixels


def rank_correlation(a: AnyArray, b: AnyArray) -> float | None:
    """Return Spearman's rank correlation, or None if all values of `a` or `b` are equal.

    Tied values receive their mean rank.

    Examples
    --------
    >>> rank_correlation(np.array([1.0, 2.0, 5.0, 9.0]), np.array([4.0, 3.0, 2.0, 1.0]))
    -1.0
    """
    ranks = []
    for values in (a, b):
        distinct, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
        if len(distinct) < 2:
            return None
        ranks.append((np.cumsum(counts) - (counts - 1) / 2)[inverse])
    return float(np.asarray(np.corrcoef(ranks))[0, 1])


@dataclass(frozen=True, eq=False)
class VariedQuantity:
    """Values of a varied quantity in all jobs.

    The values are numbers, or labels if the quantity is not a number in some job.
    """

    name: str
    values: Floats  # (n,): numbers, or indices into `labels`; NaN in jobs without the quantity
    labels: tuple[str, ...] = ()  # empty for numbers

    @property
    def known_values(self) -> Floats:
        """Values of those jobs in which the quantity is known."""
        return self.values[np.isfinite(self.values)]

    def counts(self) -> Ints:
        """Return the number of jobs for each label."""
        return np.bincount(self.known_values.astype(np.intp), minlength=len(self.labels))

    def merge_rare_labels(self) -> VariedQuantity:
        """Combine the rarest labels into one, to get at most `MAX_LABELS` labels."""
        labels = self.labels
        if len(labels) <= MAX_LABELS:
            return self
        frequent = np.sort(np.argsort(-self.counts(), kind="stable")[: MAX_LABELS - 1])
        new_indices = np.append(np.full(len(labels), MAX_LABELS - 1.0), np.nan)
        new_indices[frequent] = np.arange(len(frequent))
        values = new_indices[np.nan_to_num(self.values, nan=-1).astype(np.intp)]
        remainder = f"{len(labels) - len(frequent)} others"
        return VariedQuantity(self.name, values, (*(labels[k] for k in frequent), remainder))

    @cached_property
    def edges(self) -> Floats:
        """Edges of the histogram bins.

        The array has shape (bins + 1,). Each label or small integer has its own bin. Otherwise,
        bins have equal widths, or equal ratios if the values have a logarithmic distribution.
        """
        values = self.known_values
        lower, upper = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if upper - lower <= 30 and (values == np.round(values)).all():
            return np.arange(lower - 0.5, upper + 1)
        if lower == upper:
            lower = lower - 0.5
            upper = upper + 0.5
        bins = int(np.clip(2 * np.sqrt(len(values)), 6, _MAX_BINS))
        # The median of a logarithmic distribution is close to the geometric mean of its limits.
        middle = (np.sqrt(max(lower, 0.0) * upper) * (lower + upper) / 2) ** 0.5
        if lower > 0 and upper > 20 * lower and np.median(values) < middle:
            return np.geomspace(lower, upper, bins + 1)
        return np.linspace(lower, upper, bins + 1)

    @property
    def is_log(self) -> bool:
        """Whether the histogram bins and the axis of the chart are logarithmic."""
        widths = np.diff(self.edges)
        return bool(widths[-1] > 1.01 * widths[0])

    @cached_property
    def short_labels(self) -> list[str]:
        """Labels without their common prefix, truncated to 15 characters."""
        return [shorten_name(label, 15) for label in remove_common_prefix(self.labels)]

    def needs_slanted_labels(self, width: float) -> bool:
        """Return True if the labels do not fit horizontally on an axis of `width` pixels."""
        longest = max(map(len, self.short_labels), default=0)
        return longest * _LETTER > width / max(1, len(self.labels))


class DataSetStatistics:
    """Totals over all jobs, and a few values for each job.

    The memory use is 40 bytes per job, and 9 bytes per job for each varied quantity.

    Parameters
    ----------
    names
        Names of the varied quantities.
    jobs
        Table rows, which are read once. Use `add` to add further rows.
    """

    def __init__(self, names: Sequence[str], jobs: Iterable[JobRow] = ()) -> None:
        self.jobs = 0
        self.splits: dict[str, Counter[str]] = {}  # {split: finished jobs, and their counts}
        self.classes: dict[int, Counter[str]] = {}  # {class: points, and jobs that have the class}
        self.failed: list[JobRow] = []  # the first failed jobs
        self.slowest: list[JobRow] = []  # jobs with the longest casting times, slowest first
        self._per_job = {
            name: array("d") for name in ("points", "rays", "hits", "seconds", "failed")
        }
        # Numbers, or indices into the labels where `_labeled` is 1.
        self._values = {name: array("d") for name in names}
        self._labeled = {name: array("b") for name in names}
        self._labels: dict[str, dict[str, int]] = {name: {} for name in names}
        self._unset: Counter[str] = Counter()  # {name: jobs in which the quantity is not set}
        self._digest = hashlib.sha256()
        for row in jobs:
            self.add_job(row)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_digest": None}  # hash objects cannot be pickled

    def add_job(self, row: JobRow) -> None:
        """Add the table row of a job to the statistics."""
        self.jobs += 1
        for name, column in self._per_job.items():
            value = not row.done if name == "failed" else getattr(row, name)
            column.append(np.nan if value is None else value)
        for name, labels in self._labels.items():
            value = row.values.get(name)
            if value is None:
                self._unset[name] += row.done or name in row.values
                value = np.nan
            if labeled := isinstance(value, str | bool | np.bool_):
                text = value if isinstance(value, str) else str(value).lower()
                value = labels.setdefault(text, len(labels))
            self._values[name].append(value)
            self._labeled[name].append(labeled)
        if not row.done:
            if len(self.failed) < MAX_FAILED:
                self.failed.append(row)
            return
        self._digest.update(f"{row.name} {row.sha256}\n".encode())
        counts = {name: getattr(row, name) for name in _COUNTS}
        self.splits.setdefault(row.split, Counter()).update(counts, jobs=1)
        for number, points in row.classes.items():
            self.classes.setdefault(number, Counter()).update(points=points, jobs=1)
        if row.seconds is not None:
            insort(self.slowest, row, key=lambda row: (-(row.seconds or 0.0), row.number))
            del self.slowest[MAX_SLOWEST:]

    @property
    def done(self) -> int:
        """Number of finished jobs."""
        return sum(counts["jobs"] for counts in self.splits.values())

    @property
    def totals(self) -> dict[str, int]:
        """Numbers of scans, sweeps, rays, hits and points in all finished jobs."""
        counts_of_splits = self.splits.values()
        return {name: sum(counts[name] for counts in counts_of_splits) for name in _COUNTS}

    @property
    def sha256(self) -> str:
        """Hash of the names and points of all finished jobs, in the order of their rows."""
        return self._digest.hexdigest()

    @property
    def varied_quantities(self) -> list[VariedQuantity]:
        """Each varied quantity, with its values in all jobs."""
        return [self._varied(name) for name in self._values]

    def _varied(self, name: str) -> VariedQuantity:
        values = np.array(self._values[name])
        labels = dict(self._labels[name])
        has_value = np.isfinite(values)
        values[~has_value] = np.nan
        if not labels:
            return VariedQuantity(name, values)
        numbers = has_value & (np.array(self._labeled[name]) == 0)
        codes = values.copy()
        # If a quantity has both labels and numbers, such as "auto" and 2, numbers become labels.
        for value in np.unique(values[numbers]).tolist():
            codes[numbers & (values == value)] = labels.setdefault(f"{value:g}", len(labels))
        order = sorted(labels)
        codes[has_value] = np.argsort([labels[text] for text in order])[
            codes[has_value].astype(np.intp)
        ]
        return VariedQuantity(name, codes, tuple(order))

    def per_job(self, name: str) -> Floats:
        """Return the number of points, rays, hits or seconds of each job.

        The result has shape (jobs,). Unknown values are NaN.
        """
        return np.array(self._per_job[name])

    @property
    def failures(self) -> Bools:
        """Mask of the failed jobs.

        The array has shape (jobs,).
        """
        return np.array(self._per_job["failed"]) > 0

    def percentiles(self, name: str) -> dict[str, float] | None:
        """Return the minimum, 10th, 50th and 90th percentiles, and maximum over all finished jobs.

        Return None if no finished job has a known value.
        """
        values = self.per_job(name)[~self.failures]
        values = values[np.isfinite(values)]
        if not len(values):
            return None
        names = ("lowest", "tenth", "median", "ninetieth", "highest")
        return dict(zip(names, np.percentile(values, (0, 10, 50, 90, 100)).tolist(), strict=True))

    def summaries(self) -> Iterator[dict[str, Any]]:
        """Yield statistics of each varied quantity as a dictionary for JSON."""
        is_done = ~self.failures
        points = self.per_job("points")
        for varied in self.varied_quantities:
            has_value = is_done & np.isfinite(varied.values)
            values = varied.known_values
            figures: dict[str, Any] = {"name": varied.name, "jobs": len(values)}
            figures["unset"] = self._unset[varied.name]
            if varied.labels:
                figures["values"] = dict(zip(varied.labels, varied.counts().tolist(), strict=True))
            elif len(values):
                lowest, median, highest = np.percentile(values, (0, 50, 100)).tolist()
                figures |= {"lowest": lowest, "median": median, "highest": highest}
                correlation = rank_correlation(varied.values[has_value], points[has_value])
                rounded = None if correlation is None else round(correlation, 6)
                figures["rank_correlation_with_points"] = rounded
            yield figures

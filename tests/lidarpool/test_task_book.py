from __future__ import annotations

from itertools import pairwise

import pytest

from lidarpool.pipeline.task_book import MISPLACED_MOST, RECORDS_MOST, StageTotals, TaskBook
from poolpart import TaskRecord


def record(number: int, resources: tuple[str, ...] = ("GPU",), every: float = 1.0) -> TaskRecord:
    start = every * number
    return TaskRecord("intersect", "GPU", f"w{number % 3}", resources, start, start + 0.5, 2)


def test_totals_are_exact_however_many_tasks_there_are():
    book, count = TaskBook(), 5 * RECORDS_MOST
    for number in range(count):
        book.add(record(number))
    totals = book.stages["intersect"]
    assert (totals.tasks, totals.items) == (count, 2 * count)
    assert totals.seconds == pytest.approx(0.5 * count)
    assert (totals.start, totals.stop) == (0, count - 0.5)
    assert totals.workers == {"w0", "w1", "w2"}
    assert totals.resources == {"GPU": count}
    assert totals.violations == 0


def test_the_timeline_is_thinned_evenly():
    totals = StageTotals("intersect", "GPU")
    for number in range(5 * RECORDS_MOST):
        totals.add(record(number))
    kept = [r.start for r in totals.records]
    assert RECORDS_MOST / 2 <= len(kept) <= RECORDS_MOST
    steps = {b - a for a, b in pairwise(kept)}
    assert len(steps) == 1 and kept[0] == 0


def test_tasks_elsewhere_are_counted_and_the_first_are_kept():
    totals = StageTotals("intersect", "GPU")
    for number in range(3 * MISPLACED_MOST):
        totals.add(record(number, ("OTHER",) if number % 2 else ()))
    assert totals.violations == 3 * MISPLACED_MOST
    assert totals.misplaced == [
        record(n, ("OTHER",) if n % 2 else ()) for n in range(MISPLACED_MOST)
    ]
    assert totals.resources == {"OTHER": 30, "none": 30}

"""The driver's policies: how large batches are, where they go, and when they are tried again."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import pytest

from lidarpool.run.pipeline.batches import Batch, BatchState, Outcome
from lidarpool.run.pipeline.policies import (
    LATE_FACTOR,
    LATE_S,
    SUSPECT_DEATHS,
    TASKS_PER_COLLECTOR,
    TASKS_PER_SLOT,
    batches_per_task,
    choose_handovers,
    choose_offers,
    find_loss,
    late_after_s,
    scans_per_batch,
    slots_wanted,
)
from lidarpool.run.pipeline.stage_names import INTERSECT
from lidarpool.run.pipeline.task_book import MAX_MISPLACED, MAX_RECORDS, StageTotals, TaskBook
from lidarpool.run.pipeline.task_records import TaskRecord
from poolpart.task_locations import PartitionSnapshot, TaskLocation

A = "tcp://a:1"
B = "tcp://b:1"


JOB, OTHER, ELSEWHERE = (
    SimpleNamespace(number=number, scene_name=scene, scans_per_task=100)
    for number, scene in enumerate(("scene", "scene", "another scene"))
)


def batch(number, place=BatchState.WAITING, worker="", collector="", suspect="", job=JOB, scans=1):
    deaths = Counter({suspect: SUSPECT_DEATHS} if suspect else {})
    return Batch(
        job, number, number + scans, number, number, place, 0.0, str(number), worker, collector,
        deaths,
    )  # fmt: skip


def casting(number, worker, suspect=""):
    return batch(number, BatchState.CASTING, worker, suspect=suspect)


def waiting(count, first=10, **of):
    return [batch(number, **of) for number in range(first, first + count)]


def numbers(chosen):
    return [(one.first, where) for task, where in chosen for one in task]


# -- size ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("last", "fit", "count", "slots", "wanted"),
    [
        ([(0.1, 10)], 1000, 10**6, 2, 20),  # twice as long
        ([(0.4, 10)], 1000, 10**6, 2, 5),  # half
        ([(0.001, 10)], 1000, 10**6, 2, 80),  # at most eight times as many as the last
        ([(0.0, 1)], 1000, 10**6, 2, 8),
        ([(3.0, 1), (0.1, 10), (0.1, 10)], 1000, 10**6, 2, 20),  # the first one has compiled
        ([(0.1, 10), (0.1, 10), (0.001, 2)], 1000, 10**6, 2, 20),  # the last is a rest
        ([(9.0, 1)], 1000, 10**6, 2, 1),  # a scan at least
        ([(0.001, 10**5)], 1000, 10**9, 1, 1000),  # as many as fit into memory
        ([(0.001, 10**5)], 1, 10**9, 1, 1),
        ([(1.0, 3000)], 1000, 3200, 2, 150),  # small ones are not divided
        ([(1.0, 300)], 1000, 800, 2, 25),  # so many that all slots are busy to the end
        ([(1.0, 3)], 1000, 5, 2, 1),
    ],
)
def test_scans_of_a_batch(last, fit, count, slots, wanted):
    assert scans_per_batch(last, fit, count, slots) == wanted


def test_tasks_are_longer_where_there_are_more_slots():
    assert batches_per_task([], 4) == 1
    assert batches_per_task([(0.1, 1)] * 3, 4) == batches_per_task([(0.1, 1)] * 3, 50) == 4
    assert batches_per_task([(0.1, 1)] * 3, 100) == 8  # one driver has so many tasks a second
    assert batches_per_task([(2.0, 1)], 100) == 1


def test_slots_are_wanted_for_what_is_left():
    assert slots_wanted(100, None) == 100  # nothing is known of them
    assert slots_wanted(100, 0.1) == 1  # of 10 s
    assert slots_wanted(1000, 0.1) == 5
    assert slots_wanted(3, 60.0) == 3  # a scan is never split
    assert slots_wanted(0, 1.0) == slots_wanted(0, None) == 0


# -- where ---------------------------------------------------------------------------------------


def test_the_worker_with_the_least_work_for_its_slots_gets_the_next_batch():
    slots = {A: 1, B: 3}
    chosen = choose_offers([casting(0, A), casting(1, B), *waiting(9)], slots, max_weight=99)
    assert numbers(chosen)[:3] == [(10, B), (11, B), (12, A)]
    assert Counter(where for _, where in chosen) == {
        A: TASKS_PER_SLOT - 1,
        B: 3 * TASKS_PER_SLOT - 1,
    }


def sizes(there, per_task=4):
    return [len(task) for task, _ in choose_offers(there, {A: 1, B: 1}, 99, per_task)]


def test_small_batches_share_tasks_and_wait_for_others_where_nobody_waits_for_them():
    assert sizes(waiting(3)) == [2, 1]  # all slots get some
    assert sizes(waiting(10)) == [4, 4]
    there = [casting(0, A), casting(1, B)]
    assert sizes([*there, *waiting(3)]) == []
    assert sizes([*there, *waiting(5)]) == [4]
    slow = batch(0, BatchState.CAST, A)  # stage 4 is behind
    assert sizes([slow, *waiting(3)]) == []
    assert sizes([slow, *waiting(4)]) == [4]


def test_the_only_worker_is_left_to_a_suspect():
    suspect = batch(0, suspect=INTERSECT)
    assert choose_offers([suspect, *[casting(n, A) for n in (1, 2)]], {A: 1}, 20) == []
    assert numbers(choose_offers([suspect, *waiting(9)], {A: 1}, 20)) == [(0, A)]


def test_a_collector_on_the_host_of_the_columns_is_preferred():
    there = [batch(n, BatchState.CAST, worker) for n, worker in enumerate((A, B, A, A, A, A, A))]
    chosen = choose_handovers(there, {"collect-0": "tcp://b:7", "collect-1": "tcp://a:7"})
    assert dict(numbers(chosen)) == {
        0: "collect-1", 1: "collect-0", 2: "collect-1", 3: "collect-1", 4: "collect-0",
        5: "collect-0",
    }  # fmt: skip
    assert len(chosen) == 2 * TASKS_PER_COLLECTOR
    assert choose_handovers(there, {}) == []


def test_a_suspect_is_collected_alone():
    collectors = {"collect-0": A, "collect-1": B}
    suspect = batch(5, BatchState.CAST, A, suspect="collect")
    other = batch(6, BatchState.CAST, A)
    assert numbers(choose_handovers([other, suspect], collectors)) == [(5, "collect-0")]
    busy = batch(7, BatchState.COLLECTING, A, "collect-1")
    assert choose_handovers([suspect, other, busy], collectors) == []
    busy = batch(7, BatchState.COLLECTING, A, "collect-1", suspect="collect")
    assert choose_handovers([other, busy], collectors) == []
    assert numbers(
        choose_handovers([other, batch(8, BatchState.CAST, A, suspect="intersect")], collectors)
    )


# -- again ---------------------------------------------------------------------------------------

HERE = PartitionSnapshot(frozenset({A, B}), frozenset(), {A: 1, B: 1})


def test_a_silent_worker_is_left_if_there_is_another():
    seen = PartitionSnapshot(frozenset({A, B}), frozenset({A}), {B: 1})
    for place in (BatchState.CASTING, BatchState.CAST):
        assert find_loss(batch(0, place, A), seen, 1, 0.0, LATE_S) is Outcome.GONE
        assert find_loss(batch(0, place, A), seen, 0, 0.0, LATE_S) is None


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (TaskLocation("no-worker", (), 0), Outcome.REFUSED),
        (TaskLocation("processing", (A,), 0), Outcome.REFUSED),
        (TaskLocation("processing", (A,), 0, started=True), None),
        (TaskLocation("memory", (A,), 0), None),
        (None, None),
    ],
)
def test_a_worker_that_takes_no_tasks_ends_what_it_has_begun(task, reason):
    seen = PartitionSnapshot(HERE.members, frozenset(), {B: 1}, tasks={"0": task} if task else {})
    assert find_loss(casting(0, A), seen, 1, 0.0, LATE_S) is reason


def record(number: int, resources: tuple[str, ...] = ("GPU",), every: float = 1.0) -> TaskRecord:
    start = every * number
    return TaskRecord("intersect", "GPU", f"w{number % 3}", resources, start, start + 0.5, 2)


def test_totals_are_exact_however_many_tasks_there_are():
    book = TaskBook()
    count = 5 * MAX_RECORDS
    for number in range(count):
        book.add_task(record(number))
    totals = book.stages["intersect"]
    assert (totals.tasks, totals.items) == (count, 2 * count)
    assert totals.seconds == pytest.approx(0.5 * count)
    assert (totals.start, totals.stop) == (0, count - 0.5)
    assert totals.workers == {"w0", "w1", "w2"}
    assert totals.resources == {"GPU": count}
    assert totals.violations == 0


def test_tasks_elsewhere_are_counted_and_the_first_are_kept():
    totals = StageTotals("intersect", "GPU")
    for number in range(3 * MAX_MISPLACED):
        totals.add_task(record(number, ("OTHER",) if number % 2 else ()))
    assert totals.violations == 3 * MAX_MISPLACED
    assert totals.misplaced == [
        record(n, ("OTHER",) if n % 2 else ()) for n in range(MAX_MISPLACED)
    ]
    assert totals.resources == {"OTHER": 30, "none": 30}


def test_batches_are_late_by_what_others_took():
    assert (
        late_after_s([]) == float("inf") and late_after_s([(0.1, 1), (0.2, 1), (99.0, 1)]) == LATE_S
    )
    assert late_after_s([(10.0, 1), (20.0, 1), (30.0, 1)]) == LATE_FACTOR * 20

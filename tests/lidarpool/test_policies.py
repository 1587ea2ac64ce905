"""The driver's policies: how large batches are, where they go, and when they are tried again."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

import pytest

from lidarpool.pipeline.jobs import Batch, Outcome, Place
from lidarpool.pipeline.names import INTERSECT
from lidarpool.pipeline.policies import (
    AHEAD,
    COLLECTING,
    LATE_FACTOR,
    LATE_S,
    SUSPECT_DEATHS,
    TASK_BATCHES,
    TASK_SECONDS,
    batches_per_task,
    handovers,
    late_after_s,
    loss,
    offers,
    scans_per_batch,
    slots_wanted,
    weight,
)
from poolpart import Whereabouts
from poolpart.task_locations import TaskPlace

A, B = "tcp://a:1", "tcp://b:1"


JOB, OTHER, ELSEWHERE = (
    SimpleNamespace(number=number, scene=scene, fit=100)
    for number, scene in enumerate(("scene", "scene", "another scene"))
)


def batch(number, place=Place.WAITING, worker="", collector="", suspect="", job=JOB, scans=1):
    deaths = Counter({suspect: SUSPECT_DEATHS} if suspect else {})
    return Batch(
        job, number, number + scans, number, number, place, 0.0, str(number), worker, collector,
        deaths,
    )  # fmt: skip


def casting(number, worker, suspect=""):
    return batch(number, Place.CASTING, worker, suspect=suspect)


def waiting(count, first=10, **of):
    return [batch(number, **of) for number in range(first, first + count)]


def numbers(chosen):
    return [(one.first, where) for task, where in chosen for one in task]


# -- size ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "scans", "fit", "count", "slots", "wanted"),
    [
        (0.1, 10, 1000, 10**6, 2, 20),  # twice as long
        (0.4, 10, 1000, 10**6, 2, 5),  # half
        (0.001, 10, 1000, 10**6, 2, 20),  # at most twice as many as the last
        (0.0, 1, 1000, 10**6, 2, 2),
        (9.0, 1, 1000, 10**6, 2, 1),  # a scan at least
        (0.001, 10**5, 1000, 10**9, 1, 1000),  # as many as fit into memory
        (0.001, 10**5, 1, 10**9, 1, 1),
        (0.001, 10**5, 1000, 3200, 2, 100),  # so many that all slots are busy to the end
        (0.001, 10**5, 1000, 5, 2, 1),
    ],
)
def test_scans_of_a_batch(seconds, scans, fit, count, slots, wanted):
    assert scans_per_batch(seconds, scans, fit, count, slots) == wanted


def test_slots_are_wanted_for_what_is_left():
    assert slots_wanted(100, None) == 100  # nothing is known of them
    assert slots_wanted(100, 0.1) == 1  # of 10 s
    assert slots_wanted(1000, 0.1) == 5
    assert slots_wanted(3, 60.0) == 3  # a scan is never split
    assert slots_wanted(0, 1.0) == slots_wanted(0, None) == 0


# -- where ---------------------------------------------------------------------------------------


def test_the_worker_with_the_least_work_for_its_slots_gets_the_next_batch():
    slots = {A: 1, B: 3}
    chosen = offers([casting(0, A), casting(1, B), *waiting(9)], slots, most=99)
    assert numbers(chosen)[:3] == [(10, B), (11, B), (12, A)]
    assert Counter(where for _, where in chosen) == {A: AHEAD - 1, B: 3 * AHEAD - 1}


def sizes(there, per_task=4):
    return [len(task) for task, _ in offers(there, {A: 1, B: 1}, 99, per_task)]


def test_small_batches_share_tasks_and_wait_for_others_where_nobody_waits_for_them():
    assert sizes(waiting(3)) == [2, 1]  # all slots get some
    assert sizes(waiting(10)) == [4, 4]
    there = [casting(0, A), casting(1, B)]
    assert sizes([*there, *waiting(3)]) == []
    assert sizes([*there, *waiting(5)]) == [4]
    slow = batch(0, Place.CAST, A)  # stage 4 is behind
    assert sizes([slow, *waiting(3)]) == []
    assert sizes([slow, *waiting(4)]) == [4]


def test_a_task_has_as_many_batches_as_are_worth_it():
    assert batches_per_task([]) == 1
    assert batches_per_task([0.3, 0.2, 9.0]) == 1
    assert batches_per_task([TASK_SECONDS / 4.5]) == 4
    assert batches_per_task([0.0]) == TASK_BATCHES


def test_the_batches_of_a_task_fit_into_memory_together():
    assert weight([batch(0, scans=25)], 4) == weight([batch(0)], 4) == 1
    assert weight([batch(0, scans=50)], 4) == 2 and weight([batch(0, scans=100)], 1) == 1
    assert sizes(waiting(10, scans=50)) == [2, 2, 2, 2]
    assert sizes([*waiting(2, scans=75), *waiting(4, first=20)]) == [1, 2]
    there = waiting(20, scans=50)
    assert len(numbers(offers(there, {A: 9}, 12, 4))) == 6, "they count twice among all"


def test_jobs_of_one_scene_share_tasks_and_others_do_not():
    there = [batch(n, job=job) for n, job in enumerate((JOB, OTHER, ELSEWHERE) * 4)]
    tasks = [task for task, _ in offers(there, {A: 1, B: 1}, 99, 4)]
    assert [[b.first for b in task] for task in tasks] == [
        [0, 1, 3, 4],
        [2, 5, 8, 11],
        [6, 7, 9, 10],
    ]
    for one in there:
        one.divided = one.job is OTHER  # because a task with it has failed
    tasks = [task for task, _ in offers(there, {A: 1, B: 1}, 99, 4)]
    assert [{b.job.number for b in task} for task in tasks] == [{0}, {1}, {2}]


def test_there_are_at_most_so_many_batches_under_way():
    collecting = batch(0, Place.COLLECTING)
    there = [collecting, batch(1, Place.CAST), casting(2, A), *waiting(9)]
    assert numbers(offers(there, {A: 9}, most=5)) == [(10, A), (11, A)]
    assert offers(there, {A: 9}, most=2) == []
    assert offers(there, {}, most=99) == []


def test_a_suspect_has_a_worker_for_itself():
    suspect = batch(5, suspect="intersect")
    assert numbers(offers([suspect, *waiting(5)], {A: 1, B: 1}, 99)) == [(5, A), (10, B), (11, B)]
    alone = casting(0, A, suspect="intersect")
    assert {where for _, where in offers([alone, *waiting(5)], {A: 1, B: 1}, 99)} == {B}
    # Until a worker is free the others wait, too: they would occupy all.
    assert offers([casting(0, A), casting(1, B), suspect, *waiting(5)], {A: 1, B: 1}, 99) == []


def test_the_only_worker_is_left_to_a_suspect():
    suspect = batch(0, suspect=INTERSECT)
    assert offers([suspect, *[casting(n, A) for n in (1, 2)]], {A: 1}, 20) == []
    assert numbers(offers([suspect, *waiting(9)], {A: 1}, 20)) == [(0, A)]


def test_a_collector_on_the_host_of_the_columns_is_preferred():
    there = [batch(n, Place.CAST, worker) for n, worker in enumerate((A, B, A, A, A, A, A))]
    chosen = handovers(there, {"collect-0": "tcp://b:7", "collect-1": "tcp://a:7"})
    assert dict(numbers(chosen)) == {
        0: "collect-1", 1: "collect-0", 2: "collect-1", 3: "collect-1", 4: "collect-0",
        5: "collect-0",
    }  # fmt: skip
    assert len(chosen) == 2 * COLLECTING
    assert handovers(there, {}) == []


def test_a_suspect_is_collected_alone():
    collectors = {"collect-0": A, "collect-1": B}
    suspect = batch(5, Place.CAST, A, suspect="collect")
    other = batch(6, Place.CAST, A)
    assert numbers(handovers([other, suspect], collectors)) == [(5, "collect-0")]
    busy = batch(7, Place.COLLECTING, A, "collect-1")
    assert handovers([suspect, other, busy], collectors) == []
    busy = batch(7, Place.COLLECTING, A, "collect-1", suspect="collect")
    assert handovers([other, busy], collectors) == []
    assert numbers(handovers([other, batch(8, Place.CAST, A, suspect="intersect")], collectors))


# -- again ---------------------------------------------------------------------------------------

HERE = Whereabouts(frozenset({A, B}), frozenset(), {A: 1, B: 1})


def test_batches_are_late_by_what_others_took():
    assert late_after_s([]) == float("inf")
    assert late_after_s([0.1, 0.2, 99.0]) == LATE_S
    assert late_after_s([10.0, 20.0, 30.0]) == LATE_FACTOR * 20


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        (Place.WAITING, None),
        (Place.CASTING, Outcome.DIED),
        (Place.CAST, Outcome.GONE),
        (Place.COLLECTING, None),  # its collector may have the columns, and says if it has not
    ],
)
def test_the_batches_of_a_worker_that_is_gone(place, reason):
    assert loss(batch(0, place, "tcp://gone:1"), HERE, 2, 0.0, LATE_S) is reason


def test_a_silent_worker_is_left_if_there_is_another():
    seen = Whereabouts(frozenset({A, B}), frozenset({A}), {B: 1})
    for place in (Place.CASTING, Place.CAST):
        assert loss(batch(0, place, A), seen, 1, 0.0, LATE_S) is Outcome.GONE
        assert loss(batch(0, place, A), seen, 0, 0.0, LATE_S) is None


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (TaskPlace("no-worker", (), 0), Outcome.REFUSED),
        (TaskPlace("processing", (A,), 0), Outcome.REFUSED),
        (TaskPlace("processing", (A,), 0, started=True), None),
        (TaskPlace("memory", (A,), 0), None),
        (None, None),
    ],
)
def test_a_worker_that_takes_no_tasks_ends_what_it_has_begun(task, reason):
    seen = Whereabouts(HERE.members, frozenset(), {B: 1}, tasks={"0": task} if task else {})
    assert loss(casting(0, A), seen, 1, 0.0, LATE_S) is reason


@pytest.mark.parametrize(
    ("place", "prepared", "reason"),
    [
        (Place.WAITING, 2, None),
        (Place.CASTING, 2, Outcome.LATE),
        (Place.CASTING, 1, None),  # nobody else could do it
        (Place.CAST, 2, None),  # it waits for a collector
        (Place.COLLECTING, 1, Outcome.LATE),
    ],
)
def test_a_late_batch(place, prepared, reason):
    assert loss(batch(0, place, A), HERE, prepared, LATE_S + 1, LATE_S) is reason
    assert loss(batch(0, place, A), HERE, prepared, LATE_S - 1, LATE_S) is None

"""What a seed decides."""

from __future__ import annotations

from tests.chaos.events import KINDS
from tests.chaos.nemesis import RANDOM, make_plan

WORKER, DRIVER = ("cast.start", "cast.end"), ("driver.take",)


def test_a_seed_plays_the_same_faults_again():
    plans = [make_plan(seed, 30, WORKER, DRIVER, scans=100) for seed in (3, 3, 4)]
    assert plans[0] == plans[1] != plans[2]


def test_every_kind_is_there_at_every_point_of_the_workers_and_the_rest_at_random():
    plan = make_plan(0, 40, WORKER, DRIVER, scans=100)
    assert {(f.kind, f.point) for f in plan if f.point in WORKER} == {
        (kind, point) for kind in KINDS for point in WORKER
    }
    assert {f.partition for f in plan if f.point in DRIVER} == {"GPU", "LIDAR"}
    timed = [fault for fault in plan if fault.point == RANDOM]
    assert len(plan) == 40
    assert len(timed) == 40 - 12 - 2
    assert all(fault.partition for fault in timed)


def test_a_short_plan_has_every_kind_and_every_point():
    plan = make_plan(0, 10, WORKER, DRIVER, scans=100, crossed=False)
    assert {fault.kind for fault in plan} == set(KINDS)
    assert {fault.point for fault in plan} == {*WORKER, *DRIVER, RANDOM}

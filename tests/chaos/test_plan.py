"""What a seed decides."""

from __future__ import annotations

from tests.chaos.events import KINDS, RANDOM
from tests.chaos.nemesis import PARTITIONS, make_plan

WORKER, DRIVER = ("cast.start", "cast.end"), ("driver.take",)


def test_a_seed_plays_the_same_faults_again():
    plans = [make_plan(seed, 30, WORKER, DRIVER, scans=100) for seed in (3, 3, 4)]
    assert plans[0] == plans[1] != plans[2]


def test_a_long_plan_has_every_kind_at_every_point_of_the_workers_and_the_rest_at_random():
    plan = make_plan(0, 40, WORKER, DRIVER, scans=100)
    crossed = {(kind, point) for kind in KINDS for point in WORKER}
    assert {(f.kind, f.point) for f in plan if f.point in WORKER} == crossed
    assert {f.partition for f in plan if f.point in DRIVER} == {"GPU", "LIDAR"}
    assert {f.partition for f in plan if f.point == RANDOM} == set(PARTITIONS)
    assert len(plan) == 40


def test_a_short_plan_has_every_point():
    plan = make_plan(0, 6, WORKER, DRIVER, scans=100)
    assert {fault.point for fault in plan} == {*WORKER, *DRIVER, RANDOM}
    assert len(plan) == 6

"""The short version of `python -m tests.chaos`, and the deaths that are to be survived by name."""

from __future__ import annotations

import pytest
from tests.chaos.__main__ import Campaign
from tests.chaos.arena import Arena
from tests.chaos.events import KINDS
from tests.chaos.nemesis import RANDOM, Fault
from tests.chaos.points import STAGE_POINTS
from tests.chaos.survey import PAUSES, disturbed, reference, survey

SEED = 7
FAULTS = 20
PLANNED = 24  # some may find nobody to strike
TIME_TO_LIVE_S = 60  # all stops of the plan are short: a worker that is not heard of is only slow


@pytest.fixture(scope="module")
def arena():
    with Arena(pauses=PAUSES, time_to_live_s=TIME_TO_LIVE_S) as arena:
        yield arena


@pytest.fixture(scope="module")
def what():
    return survey(poses=1)


@pytest.fixture(scope="module")
def known(arena, what):
    return reference(arena, what)


def test_twenty_faults_are_survived(arena, what, known):
    campaign = Campaign(PLANNED, SEED, what, crossed=False)
    while not campaign.over:
        outcome = campaign.play(arena, known)
        assert outcome.sound, f"seed {SEED}: {outcome.error or outcome.verdict}"
    assert sum(campaign.done.values()) >= FAULTS
    assert {kind for kind, _ in campaign.done} == set(KINDS)
    reached = {point for _, point in campaign.done}
    assert {point for points in STAGE_POINTS.values() for point in points} <= reached
    assert campaign.summary() == f"faults {campaign.done.total()} lost 0 duplicated 0 identical yes"


def at(point, scan=150, kind="kill", number=0, **options):
    return Fault(number, kind, point, scan, **options)


DEATHS = {
    "before a cast": [at("intersect.start")],
    "during a cast": [at("intersect.cast")],
    "after a cast": [at("intersect.end")],
    "a collector with a part in memory": [at("collect.part")],
    "both collectors, one after the other": [
        at("collect.part"),
        at("collect.part", 200, number=1),
    ],
    "the sorter with frames buffered": [at("sort.get")],
    "the generator half way": [at("generate.put", 180)],
    "several at once": [
        at("intersect.cast"),
        at("collect.part", number=1),
        at("sort.put", number=2),
        at("generate.sent", number=3),
    ],
    "LIDAR workers whose clients are closed under the stages": [
        Fault(number, "restart", RANDOM, after_s=0.3, partition="LIDAR", pick=number % 2 / 2)
        for number in range(3)
    ],
}


@pytest.mark.parametrize("faults", DEATHS.values(), ids=DEATHS)
def test_whoever_dies_each_scan_arrives_once(arena, what, known, faults):
    outcome = disturbed(arena, what, known, faults)
    assert outcome.sound, outcome.error or outcome.verdict
    assert {point for _, point in outcome.done} == {fault.point for fault in faults}
    assert outcome.done.total() == len(faults)
    if all(fault.point != RANDOM for fault in faults):  # else they may have been idle just then
        assert outcome.verdict.recovered

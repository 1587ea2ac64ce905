"""The checker can fail: what is written carelessly does not pass it."""

from __future__ import annotations

import pytest
from tests.chaos import naive
from tests.chaos.arena import Arena
from tests.chaos.nemesis import Fault, make_plan

SCANS = 200
TIME_TO_LIVE_S = 300  # nobody is stopped here: a worker that is not heard of is only slow


@pytest.fixture(scope="module")
def arena():
    with Arena(pauses={"generate.put": 0.003}, time_to_live_s=TIME_TO_LIVE_S) as arena:
        yield arena


def test_undisturbed_even_the_naive_one_delivers_each_scan_once(arena):
    verdict = naive.disturbed(arena, SCANS, [])
    assert verdict.lost == verdict.duplicated == (), verdict  # in order is more than it can do
    assert verdict.expected == SCANS


@pytest.mark.parametrize(
    "faults",
    [
        [Fault(0, "kill", "intersect.cast", scan=80)],
        [Fault(0, "term", "collect.part", scan=80)],
        [Fault(0, "segv", "generate.sent", scan=80)],
        make_plan(1, 0, ("intersect.start", "collect.get", "generate.put"), (), SCANS, False),
    ],
    ids=["intersect.cast", "collect.part", "generate.sent", "by plan"],
)
def test_the_checker_finds_what_the_naive_one_loses_or_doubles(arena, faults):
    verdict = naive.disturbed(arena, SCANS, faults)
    assert verdict.lost or verdict.duplicated, verdict

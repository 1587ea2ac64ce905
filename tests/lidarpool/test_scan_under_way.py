"""Batches under way, and the pace of stage 1; no cluster."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from lidarpool.scan import pacer
from lidarpool.scan.pacer import Pacer
from lidarpool.scan.under_way import PIECES, Cast, Item, UnderWay
from poolpart import Ledger


@dataclass
class Task:
    """As much of a Future as an item asks."""

    status: str = "pending"


def wire(*scans: int) -> list[list[float]]:
    return [[scan, 0, 1, 0, 0, 0, 0, 0, 0] for scan in scans]


@pytest.fixture
def ledgers() -> tuple[Ledger, Ledger]:
    return Ledger(100), Ledger(100)


@pytest.fixture
def under_way(ledgers) -> UnderWay:
    return UnderWay(*ledgers)


def deliver(under_way: UnderWay, ledger: Ledger, stage: str, *scans: int) -> None:
    for scan in scans:
        if ledger.accept(scan):
            under_way.arrived(stage, scan)


def test_a_batch_is_released_when_all_has_arrived_both_ways(under_way, ledgers):
    frames, points = ledgers
    (item,) = under_way.add(wire(3, 4))
    deliver(under_way, frames, "sort", 3, 4, 4)
    assert item.left == {"collect": 2}
    deliver(under_way, points, "collect", 4)
    assert under_way.release() == []
    deliver(under_way, points, "collect", 3)
    assert under_way.release() == [item]
    assert len(under_way) == 0


def test_scans_that_want_other_stages_travel_apart(under_way, ledgers):
    """After a resume, some have their points or their frame already."""
    frames, points = ledgers
    frames.restore([0, 1])
    points.restore([1, 2, 3])
    items = under_way.add(wire(0, 1, 2, 3, 4))
    assert [(item.scans, set(item.left)) for item in items] == [
        ([0], {"collect"}),
        ([2, 3], {"sort"}),
        ([4], {"sort", "collect"}),
    ]


def test_a_divided_batch_holds_the_same_scans_as_suspect(under_way, ledgers):
    frames, _ = ledgers
    (item,) = under_way.add(wire(*range(40)))
    item.suspect.add("sort")
    deliver(under_way, frames, "sort", 0)
    pieces = under_way.split(item)
    assert [scan for piece in pieces for scan in piece.scans] == list(range(40))
    assert len(pieces) <= PIECES + 1
    assert all(piece.suspect == {"sort"} for piece in pieces)
    assert pieces[0].scans == [0] and set(pieces[0].left) == {"collect"}
    assert list(under_way) == pieces
    assert item not in under_way


def test_a_batch_is_divided_down_to_single_scans(under_way):
    (item,) = under_way.add(wire(*range(50)))
    for _ in range(3):
        item = under_way.split(item)[0]
    assert item.scans == [0]


def test_the_first_result_counts_unless_it_is_out_of_reach():
    one = Cast(Task("finished"), Task(), None, 0.0)
    two = Cast(Task(), Task("finished"), None, 0.0)
    item = Item(wire(1), {"sort": 1, "collect": 1}, casts=[one, two])
    assert item.ready("collect") is one.batch
    assert item.ready("sort") is two.frames
    assert not item.running
    one.reachable = False
    assert item.ready("collect") is None
    assert item.running


def test_what_cannot_be_done_is_given_up(under_way):
    good, bad = under_way.add(wire(1)) + under_way.add(wire(2))
    under_way.condemn(bad, "scan 2 is wrong")
    under_way.give_up("sort")
    assert list(under_way) == [good]
    assert good.left == {"collect": 1}
    assert under_way.condemned == ["scan 2 is wrong"]


def test_a_pacer_lets_scans_go_when_they_are_due(monkeypatch):
    now, slept = [100.0], []
    # Not in the module `time` itself, where other threads would be heard to sleep as well.
    clockwork = SimpleNamespace(monotonic=lambda: now[0], sleep=slept.append)
    monkeypatch.setattr(pacer, "time", clockwork)
    clock = Pacer(10.0, first=7)
    assert clock.due == 8
    now[0] += 0.25
    assert clock.due == 10
    clock.wait(10)
    assert slept == [pytest.approx(0.05)]
    now[0] += 0.03
    clock.wait(10)
    assert slept[1] == pytest.approx(0.02)

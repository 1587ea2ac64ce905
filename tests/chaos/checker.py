"""Verdicts on a run, from what was written down and what was delivered.

Nothing here knows how the run works but for the points that say that a scan was asked for,
delivered or let go of, and the delivered cloud is compared with what another, undisturbed run
had in it. So a fault of the code under test cannot hide in the checker.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ASKED = "generate.put"  # the scan was described: from here on it must arrive
DELIVERED = {"frame": "driver.frame", "points": "driver.points"}  # each way once
ORDERED = ("frame",)  # the ways in which scans arrive in order
RELEASED = "driver.release"  # the scan was let go of: it had arrived in every way
# Work on the scan began or was handed on; the second time is another attempt.
TRIED = ("generate.put", "intersect.start", "driver.handon", "driver.replay")


@dataclass(frozen=True)
class Verdict:
    """What became of the scans of a run; each list names scans, some possibly in two ways."""

    expected: int  # number of scans that should have arrived
    # Asked for, and not delivered, or without rows in the cloud that belong there.
    lost: tuple[str, ...] = ()
    # Delivered twice in one way, or with rows in the cloud twice.
    duplicated: tuple[str, ...] = ()
    # Delivered and never asked for, out of order, or let go of before they had arrived.
    unexpected: tuple[str, ...] = ()
    # Tried more than once, and delivered exactly once.
    recovered: tuple[int, ...] = field(default=(), repr=False)

    @property
    def sound(self) -> bool:
        """Whether every scan arrived once, in order."""
        return not (self.lost or self.duplicated or self.unexpected)

    def __str__(self) -> str:
        counts = (
            f"{self.expected} scans: lost {len(self.lost)}, duplicated {len(self.duplicated)}, "
            f"unexpected {len(self.unexpected)}, recovered {len(self.recovered)}"
        )
        named = [
            f"\n  {what}: {', '.join(which[:12])}{', …' if len(which) > 12 else ''}"
            for what, which in (
                ("lost", self.lost),
                ("duplicated", self.duplicated),
                ("unexpected", self.unexpected),
            )
            if which
        ]
        return counts + "".join(named)


def judge(
    events: Iterable[Mapping[str, Any]],
    scans: int,
    rows: Sequence[int],
    expected_rows: Sequence[int],
) -> Verdict:
    """Judge one run.

    `events` are what was logged of it, by process, in the order it happened there; `scans` is the
    number of scans asked for, numbered from 0; `rows` has the scan of each row of the delivered
    cloud, and `expected_rows` that of each row of the cloud as it should be.
    """
    log = list(events)
    every = set(range(scans))
    asked = {scan for event in log if event["point"] == ASKED for scan in event["scans"]}
    lost = [f"scan {scan} was never described" for scan in sorted(every - asked)]
    duplicated: list[str] = []
    unexpected: list[str] = []
    counts: dict[str, Counter[int]] = {}
    for way, point in DELIVERED.items():
        order = [scan for event in log if event["point"] == point for scan in event["scans"]]
        counts[way] = Counter(order)
        lost += [f"scan {s} ({way})" for s in sorted(every - counts[way].keys())]
        duplicated += [f"scan {s} ({way})" for s, n in sorted(counts[way].items()) if n > 1]
        strangers = sorted(counts[way].keys() - (asked & every))
        unexpected += [f"scan {s} ({way}, never asked for)" for s in strangers]
        if way in ORDERED:
            unexpected += [f"scan {s} ({way}, out of order)" for s in _out_of_order(order)]
    unexpected += _released_early(log)
    _compare_rows(rows, expected_rows, lost, duplicated, unexpected)
    arrived = {s for s in every if all(count[s] == 1 for count in counts.values())}
    return Verdict(
        scans,
        tuple(lost),
        tuple(duplicated),
        tuple(unexpected),
        tuple(sorted(arrived & _tried_again(log))),
    )


def _out_of_order(order: Sequence[int]) -> list[int]:
    """Scans that came after a later one."""
    found = []
    highest = -1
    for scan in order:
        if scan < highest:
            found.append(scan)
        highest = max(highest, scan)
    return found


def _released_early(log: Iterable[Mapping[str, Any]]) -> list[str]:
    """Scans that were let go of when they had not arrived in every way."""
    here: dict[str, set[int]] = {point: set() for point in DELIVERED.values()}
    found = []
    for event in log:
        if event["point"] in here:
            here[event["point"]].update(event["scans"])
        elif event["point"] == RELEASED:
            early = [s for s in event["scans"] if not all(s in there for there in here.values())]
            found += [f"scan {scan} (released before it had arrived)" for scan in early]
    return found


def _tried_again(log: Iterable[Mapping[str, Any]]) -> set[int]:
    tries = Counter(
        (scan, event["point"], event.get("stage", ""))
        for event in log
        if event["point"] in TRIED
        for scan in event["scans"]
    )
    return {scan for (scan, _, _), count in tries.items() if count > 1}


def _compare_rows(
    rows: Sequence[int],
    expected_rows: Sequence[int],
    lost: list[str],
    duplicated: list[str],
    unexpected: list[str],
) -> None:
    there = Counter(map(int, rows))
    wanted = Counter(map(int, expected_rows))
    for scan in sorted(there.keys() | wanted.keys()):
        if scan not in wanted:
            unexpected.append(f"scan {scan} (cloud: {there[scan]} rows of none)")
        elif there[scan] < wanted[scan]:
            lost.append(f"scan {scan} (cloud: {there[scan]} of {wanted[scan]} rows)")
        elif there[scan] > wanted[scan]:
            duplicated.append(f"scan {scan} (cloud: {there[scan]} rows for {wanted[scan]})")
    unexpected += [f"scan {scan} (cloud, out of order)" for scan in _out_of_order(list(rows))]

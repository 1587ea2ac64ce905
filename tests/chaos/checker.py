"""Verdict on a run, based on its log and its results.

The checker only knows the points at which a scan is requested, delivered or released, and compares
the delivered cloud with that of an undisturbed run. It shares no other code or knowledge with the
code under test, whose faults it could otherwise hide.
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
    """What happened to the scans of a run.

    Each list names scans. A scan can be listed for several reasons.
    """

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
        """Whether every scan arrived exactly once and in order."""
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
    """Find lost, duplicated and unexpected scans of a run.

    `events` is the log of the run, grouped by process and in order of time. `scans` is the number
    of requested scans, which are numbered from 0. `rows` contains the scan of each row in the
    delivered cloud, and `expected_rows` the scan of each row in the correct cloud.
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
    """Return the scans that arrived after a later scan."""
    found = []
    highest = -1
    for scan in order:
        if scan < highest:
            found.append(scan)
        highest = max(highest, scan)
    return found


def _released_early(log: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the scans that were released before they had been delivered in every way."""
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

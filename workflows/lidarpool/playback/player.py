"""Plays sweeps through a bridge, each at its time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, count, islice

from lidarsim.columns.cloud import Cloud

from .bridge import Bridge
from .schedule import MadeAhead, Schedule
from .sources import Played

# Sweeps that are cast before they are due, for each sensor.
AHEAD = 4
# How late a sweep may be before the user reads that casting falls behind, seconds.
_BEHIND_S = 0.005
BEHIND = (
    "casting falls behind: sweeps leave late. Use fewer rays, sub-rays or actors, or play slower "
    "(--rate)."
)
# From the start of the schedule to the first sweep, for what the bridge does before.
_START_NS = 100e6


def play_sweeps(
    played: Played,
    bridge: Bridge,
    schedule: Schedule,
    note: Callable[[str], None],
    *,
    loop: bool = False,
) -> None:
    """Send each sweep through a bridge when it is due; the schedule starts with the first sweeps.

    With `loop`, all sweeps are sent again and again, with times that go on. A sweep that is not
    cast in time is sent late, and the user is told once.
    """
    late_sweeps = 0
    sensors = len(played.sweeps.sensors)
    with MadeAhead(_laps(played, loop=loop), AHEAD * sensors) as made_ahead:
        sweeps = iter(made_ahead)
        first = list(islice(sweeps, sensors))
        schedule.start(min(bridge.due_ns(sweep) for sweep, _, _ in first), _START_NS)
        for sweep, points, shift_ns in chain(first, sweeps):
            late_s = schedule.wait_until(bridge.due_ns(sweep) + shift_ns)
            if late_s > _BEHIND_S:
                if not late_sweeps:
                    note(BEHIND)
                late_sweeps += 1
            bridge.send(sweep, points, shift_ns)
    if late_sweeps:
        note(f"{late_sweeps:,} sweeps were late.")


def _laps(played: Played, *, loop: bool) -> Iterator[tuple[int, Cloud, int]]:
    """Yield number and points of each sweep, and the shift of its times, nanoseconds."""
    period_ns = played.period_ns
    for lap in count() if loop else range(1):
        for sweep, points in played:
            yield sweep, points, lap * period_ns

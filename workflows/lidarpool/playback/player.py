"""Plays sweeps through a bridge, each at its time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, count, islice

from lidarsim.columns.cloud import Cloud
from lidarsim.words import plural

from .bridge import Bridge
from .schedule import BEHIND, BEHIND_S, MadeAhead, Schedule
from .sources import Played

# Sweeps that are cast before they are due, for each sensor: processors may be busy for a second.
AHEAD = 16
# From the start of the schedule to the first sweep, for what the bridge does before.
_START_NS = 100e6
_ShiftedSweep = tuple[int, Cloud, int]  # number, points, shift of times in nanoseconds


def play_sweeps(
    played: Played,
    bridge: Bridge,
    schedule: Schedule,
    note: Callable[[str], None],
    *,
    loop: bool = False,
    start_at_ns: int = 0,
) -> None:
    """Send each sweep through a bridge when it is due.

    The schedule starts with the first sweeps.

    With `loop`, all sweeps are sent again and again, with times that go on. A sweep that is not
    cast in time is sent late, and the user is told once. The schedule does not start before
    `start_at_ns` by `time.time_ns`.
    """
    late_sweeps = 0
    sensors = len(played.sweeps.sensors)
    with MadeAhead(_laps(played, loop=loop), AHEAD * sensors, played.threads) as made_ahead:
        sweeps = iter(made_ahead)
        first = list(islice(sweeps, sensors))
        for sweep, points, _ in first:
            bridge.prepare(sweep, points)
        delay_ns = max(_START_NS, start_at_ns - time.time_ns())
        schedule.start(min(bridge.due_ns(sweep) for sweep, _, _ in first), delay_ns)
        for sweep, points, shift_ns in chain(first, sweeps):
            due_ns = bridge.due_ns(sweep) + shift_ns
            schedule.wait_until(due_ns - bridge.lead_ns)
            if schedule.late_s(due_ns) > BEHIND_S:
                if not late_sweeps:
                    note(BEHIND)
                late_sweeps += 1
            bridge.send(sweep, points, shift_ns)
        bridge.finish()
    if late_sweeps:
        verb = "was" if late_sweeps == 1 else "were"
        note(f"{plural(late_sweeps, 'sweep')} {verb} sent late.")


def _laps(played: Played, *, loop: bool) -> Iterator[Callable[[], _ShiftedSweep]]:
    """Yield functions that cast or read the sweeps, lap after lap."""
    period_ns = played.period_ns
    for lap in count() if loop else range(1):
        for sweep in played.order:
            yield partial(_shifted, played, sweep, lap * period_ns)


def _shifted(played: Played, sweep: int, shift_ns: int) -> _ShiftedSweep:
    """Return number and points of a sweep, and the shift of its times, nanoseconds."""
    return sweep, played.points(sweep), shift_ns

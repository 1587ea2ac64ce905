"""Play back sweeps in real time through a bridge."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain, count, islice

from lidarsim.columns.cloud import Cloud
from lidarsim.words import plural

from .bridge import Bridge
from .schedule import BEHIND, BEHIND_S, Prefetcher, Schedule
from .sources import PlaybackSource

# Sweeps per sensor that are simulated in advance, since CPUs may be busy for a second.
AHEAD = 16
# Time from the start of the schedule to the first sweep, for preparations of the bridge.
_START_NS = 100e6
_ShiftedSweep = tuple[int, Cloud, int]  # number, points, time shift in nanoseconds


def play_sweeps(
    played: PlaybackSource,
    bridge: Bridge,
    schedule: Schedule,
    note: Callable[[str], None],
    *,
    loop: bool = False,
    start_at_ns: int = 0,
) -> None:
    """Send each sweep through a bridge at its scheduled time.

    A sweep that is not simulated in time is sent late, and the user is notified once.

    Parameters
    ----------
    played
        Sweeps to play.
    bridge
        Bridge that sends the sweeps.
    schedule
        Schedule, which is started with the first sweeps.
    note
        Function that prints a note for the user.
    loop
        Whether to repeat all sweeps endlessly, with continuing times.
    start_at_ns
        Earliest start of the schedule on the clock of `time.time_ns`.
    """
    late_sweeps = 0
    sensors = len(played.sweeps.sensors)
    with Prefetcher(_laps(played, loop=loop), AHEAD * sensors, played.threads) as prefetcher:
        sweeps = iter(prefetcher)
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


def _laps(played: PlaybackSource, *, loop: bool) -> Iterator[Callable[[], _ShiftedSweep]]:
    """For each sweep of each repetition, yield a function that reads the sweep."""
    period_ns = played.period_ns
    for lap in count() if loop else range(1):
        for sweep in played.order:
            yield partial(_read_sweep, played, sweep, lap * period_ns)


def _read_sweep(played: PlaybackSource, sweep: int, shift_ns: int) -> _ShiftedSweep:
    return sweep, played.points(sweep), shift_ns

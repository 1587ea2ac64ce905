"""A long survey with a worker killed every few seconds: `python -m tests.chaos.soak`.

The driver is a process of its own, the scheduler is in this one, so that the memory of each
is seen. Afterwards nothing may be left on the scheduler that was not there before.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from lidarpool import Survey

from .arena import Arena
from .checker import Verdict, judge
from .driver import Delivered, Driver
from .events import KILL, SEGV, TERM
from .nemesis import PARTITIONS, RANDOM, Fault, Nemesis
from .survey import STEPS, Reference, reference, survey
from .traces import scheduler_state, settled_differences

PACE_S = 0.02  # a scan
SAMPLE_EVERY_S = 0.5
EVERY_S = (1.0, 4.0)  # between two faults
SCANS_PER_FAULT = 20
TIME_TO_LIVE_S = 60  # nobody is stopped here: a worker that is not heard of is only slow
LETHAL = (KILL, KILL, TERM, SEGV)


@dataclass(frozen=True)
class Sample:
    """Resident memory at one moment, in MiB."""

    seconds: float
    driver: float
    scheduler: float

    @classmethod
    def now(cls, seconds: float, driver: int | None) -> Sample:
        """Look at a driver's process, and at this one."""
        return cls(seconds, _resident(driver), _resident(None))


def _resident(pid: int | None) -> float:
    try:
        return float(psutil.Process(pid).memory_info().rss) / (1 << 20)
    except psutil.NoSuchProcess:  # it has just ended
        return float("nan")


@dataclass(frozen=True)
class Soaked:
    """What a soak has shown."""

    samples: list[Sample]
    faults: Counter[str]
    delivered: Delivered
    verdict: Verdict
    identical: bool
    left_on_scheduler: list[str]

    @property
    def sound(self) -> bool:
        """Whether nothing is lost and nothing is left."""
        return (
            self.verdict.sound
            and self.identical
            and not (self.left_on_scheduler or self.delivered.misplaced)
        )

    def growth(self, who: str) -> float:
        """MiB by which memory grew from the second quarter of the time to the last."""
        values = [getattr(sample, who) for sample in self.samples]
        quarter = max(1, len(values) // 4)
        return float(np.nanmedian(values[-quarter:]) - np.nanmedian(values[quarter : 2 * quarter]))


def soak(arena: Arena, what: Survey, expected: Reference, seed: int) -> Soaked:
    """Survey while workers are killed all the time."""
    samples: list[Sample] = []
    arena.wait_until_whole()
    arena.board.forget_events()
    known = scheduler_state(arena.client)
    with Nemesis(arena, _faults(random.Random(seed), what.scan_count), drives=False) as nemesis:
        driver = Driver(arena.client.scheduler.address, what, None, arena.board.folder)
        while not driver.is_done and not arena.board.has_events:
            time.sleep(0.01)
        started = time.monotonic()
        while not driver.is_done:
            samples.append(Sample.now(time.monotonic() - started, driver.process.pid))
            time.sleep(SAMPLE_EVERY_S)
        delivered = driver.delivered()
    arena.wait_until_whole()
    left = settled_differences(arena.client, known)
    events = arena.board.events(delivered.run)
    rows = () if delivered.reference is None else delivered.reference.rows
    return Soaked(
        samples,
        _by_kind(nemesis.done),
        delivered,
        judge(events, what.scan_count, rows, expected.rows),
        delivered.reference == expected,
        left,
    )


def _faults(chance: random.Random, scans: int) -> list[Fault]:
    """Far more at random times than come to pass, and some that are sure to interrupt scans.

    Where workers start more slowly than they are killed the last of them come to an end, so
    that the survey does.
    """
    timed = [
        Fault(
            number,
            chance.choice(LETHAL),
            RANDOM,
            after_s=chance.uniform(*EVERY_S),
            partition=chance.choice(PARTITIONS),
            pick=chance.random(),
        )
        for number in range(scans // SCANS_PER_FAULT)
    ]
    # At the pace of a soak workers are idle at most moments: on a slow machine, with few kills,
    # every one of those above has been seen to find nothing under way.
    quarters = [scans * quarter // 4 for quarter in (1, 2, 3)]
    under_way = [Fault(10_000 + scan, KILL, "intersect.start", scan=scan) for scan in quarters]
    return timed + under_way


def _by_kind(done: Counter[tuple[str, str]]) -> Counter[str]:
    """Faults carried out, whatever the point."""
    kinds: Counter[str] = Counter()
    for (kind, _), number in done.items():
        kinds[kind] += number
    return kinds


def draw(soaked: Soaked, path: Path) -> None:
    """Draw the memory curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    seconds = [sample.seconds for sample in soaked.samples]
    for who in ("driver", "scheduler"):
        axes.plot(seconds, [getattr(sample, who) for sample in soaked.samples], label=who)
    axes.set(xlabel="seconds", ylabel="resident memory, MiB", ylim=(0, None))
    axes.set_title(f"{soaked.verdict.expected} scans, {soaked.faults.total()} workers killed")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> int:
    """Soak, and say what was found; returns 0 if all was well."""
    parser = argparse.ArgumentParser(prog="tests.chaos.soak", description=__doc__)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path, help="draw the memory into this file")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)  # that workers die here is no news
    what = survey(-(-options.scans // STEPS))
    with Arena(pauses={"generate.put": PACE_S}, time_to_live_s=TIME_TO_LIVE_S) as arena:
        soaked = soak(arena, what, reference(arena, what, None), options.seed)
    print(" seconds   driver  scheduler (MiB)")
    for sample in soaked.samples[:: max(1, len(soaked.samples) // 24)]:
        print(f"{sample.seconds:8.0f} {sample.driver:8.1f} {sample.scheduler:10.1f}")
    for who in ("driver", "scheduler"):
        print(f"{who}: {soaked.growth(who):+.1f} MiB from the second to the last quarter")
    print(soaked.delivered.error or soaked.verdict)
    print(f"faults: {dict(soaked.faults)}")
    print(f"identical: {soaked.identical}, misplaced tasks: {soaked.delivered.misplaced}")
    print("left on the scheduler:", soaked.left_on_scheduler or "nothing")
    if options.picture:
        draw(soaked, options.picture)
        print("drawn:", options.picture)
    print("sound" if soaked.sound else f"not sound; seed {options.seed}")
    return 0 if soaked.sound else 1


if __name__ == "__main__":
    sys.exit(main())

"""Run a long survey while workers are killed every few seconds: `python -m tests.chaos.soak`.

Driver and scheduler are in this process, whose memory is measured. At the end, the scheduler's
state must be the same as before.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from lidarpool import Survey

from .arena import Arena
from .events import KILL, RANDOM, SEGV, TERM, Fault
from .nemesis import PARTITIONS
from .survey import STEPS, Outcome, Reference, disturbed, reference, survey
from .traces import scheduler_state, settled_differences

PACE_S = 0.02  # a scan
SAMPLE_EVERY_S = 0.5
EVERY_S = (1.0, 4.0)  # between two faults
SCANS_PER_FAULT = 20
TIME_TO_LIVE_S = 60  # nobody is stopped here: a worker that is not heard of is only slow
LETHAL = (KILL, KILL, TERM, SEGV)


@dataclass(frozen=True)
class Soaked:
    """Results of a soak test."""

    outcome: Outcome
    memory: list[tuple[float, float]]  # seconds, MiB resident
    left_on_scheduler: list[str]

    @property
    def sound(self) -> bool:
        """Whether nothing was lost and nothing is left on the scheduler."""
        return self.outcome.sound and not self.left_on_scheduler

    @property
    def growth(self) -> float:
        """Growth of memory from the second to the last quarter of the time, in MiB."""
        values = [mebibytes for _, mebibytes in self.memory]
        quarter = max(1, len(values) // 4)
        return float(np.median(values[-quarter:]) - np.median(values[quarter : 2 * quarter]))


def soak(arena: Arena, what: Survey, expected: Reference, seed: int) -> Soaked:
    """Run a survey while workers are killed repeatedly."""
    memory: list[tuple[float, float]] = []
    over = threading.Event()
    started = time.monotonic()

    def watch() -> None:
        while not over.wait(SAMPLE_EVERY_S):
            resident = psutil.Process().memory_info().rss / (1 << 20)
            memory.append((time.monotonic() - started, resident))

    arena.wait_until_whole()
    before = scheduler_state(arena.client)
    watcher = threading.Thread(target=watch)
    watcher.start()
    faults = _faults(random.Random(seed), what.scan_count)
    outcome = disturbed(arena, what, expected, faults, planning=None)
    over.set()
    watcher.join()
    arena.wait_until_whole()
    return Soaked(outcome, memory, settled_differences(arena.client, before))


def _faults(chance: random.Random, scans: int) -> list[Fault]:
    """Return more faults at random times than can occur, and some that are sure to interrupt scans.

    The number of faults at random times is limited, so that the survey ends even if workers start
    more slowly than they are killed.
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


def draw(soaked: Soaked, path: Path) -> None:
    """Plot memory over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(*zip(*soaked.memory, strict=True))
    axes.set(xlabel="seconds", ylabel="resident memory, MiB", ylim=(0, None))
    verdict = soaked.outcome.verdict
    faults = soaked.outcome.done.total()
    axes.set_title(f"{verdict.expected} scans, {faults} workers killed")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> int:
    """Run the soak test, print its results, and return 0 if it is sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos.soak", description=__doc__)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path, help="draw the memory into this file")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)  # that workers die here is no news
    what = survey(-(-options.scans // STEPS))
    with Arena(pauses={"generate.put": PACE_S}, time_to_live_s=TIME_TO_LIVE_S) as arena:
        soaked = soak(arena, what, reference(arena, what, None), options.seed)
    outcome = soaked.outcome
    for seconds, mebibytes in soaked.memory[:: max(1, len(soaked.memory) // 24)]:
        print(f"{seconds:8.0f} s {mebibytes:8.1f} MiB")
    print(f"driver and scheduler: {soaked.growth:+.1f} MiB from the second to the last quarter")
    print(outcome.error or outcome.verdict)
    print(f"faults: {dict(outcome.done)}")
    print(f"identical: {outcome.identical}, misplaced tasks: {outcome.misplaced}")
    print("left on the scheduler:", soaked.left_on_scheduler or "nothing")
    if options.picture:
        draw(soaked, options.picture)
        print("drawn:", options.picture)
    print("sound" if soaked.sound else f"not sound; seed {options.seed}")
    return 0 if soaked.sound else 1


if __name__ == "__main__":
    sys.exit(main())

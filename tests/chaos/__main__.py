"""Disturb surveys until a given number of faults has been injected: `python -m tests.chaos`.

The last line of the output states whether anything was lost. Runs with the same seed inject the
same faults.
"""

from __future__ import annotations

import argparse
import logging
import math
import random
import sys
import time
from collections import Counter

from lidarpool import Survey

from .arena import Arena
from .events import KILL, KINDS, RANDOM, Fault
from .nemesis import make_plan
from .points import DRIVER_POINTS, RARE_POINTS, WORKER_POINTS
from .survey import PAUSES, Outcome, Reference, disturbed, reference, survey

FAULTS_PER_RUN = 8
SPARE_FAULTS = 0.05  # part that may find nobody to strike
VAIN_RUNS_MOST = 2  # one after the other in which nothing that was left to do could be done


class Campaign:
    """Sequence of disturbed runs whose faults are planned from one seed."""

    def __init__(self, faults: int, seed: int, what: Survey) -> None:
        self.what = what
        self.waiting = make_plan(seed, faults, WORKER_POINTS, DRIVER_POINTS, what.scan_count)
        self.lurking = [
            Fault(len(self.waiting) + number, KILL, point, partition="LIDAR")
            for number, point in enumerate(RARE_POINTS)
        ]
        self.outcomes: list[Outcome] = []
        self._chance = random.Random(seed + 1)

    @property
    def done(self) -> Counter[tuple[str, str]]:
        """Number of injected faults by kind and point."""
        return sum((outcome.done for outcome in self.outcomes), Counter())

    @property
    def over(self) -> bool:
        """Whether all faults have been injected, or the last runs injected none."""
        recent = self.outcomes[-VAIN_RUNS_MOST:]
        in_vain = len(recent) == VAIN_RUNS_MOST and not any(outcome.done for outcome in recent)
        return not self.waiting or in_vain

    def play(self, arena: Arena, known: Reference) -> Outcome:
        """Perform one run with the next faults."""
        faults = self.waiting[:FAULTS_PER_RUN]
        self.waiting = self.waiting[FAULTS_PER_RUN:]
        options = {
            "queue_capacity": self._chance.choice((2, 10)),
            "collectors": self._chance.choice((1, 2, 2)),
        }
        outcome = disturbed(arena, self.what, known, [*faults, *self.lurking], **options)
        self.waiting += [fault for fault in outcome.left if fault not in self.lurking]
        self.lurking = [fault for fault in self.lurking if fault in outcome.left]
        self.outcomes.append(outcome)
        return outcome

    def table(self) -> str:
        """Table of injected faults by kind and point."""
        done = self.done
        order = (*WORKER_POINTS, *DRIVER_POINTS, *RARE_POINTS, RANDOM)
        points = sorted({point for _, point in done}, key=order.index)
        width = max(map(len, points), default=0)
        lines = [" " * width + "".join(f"{kind:>9}" for kind in KINDS)]
        for point in points:
            cells = "".join(f"{done[kind, point] or '·':>9}" for kind in KINDS)
            lines.append(f"{point:<{width}}{cells}")
        return "\n".join(lines)

    def summary(self) -> str:
        """Last line of the output."""
        verdicts = [outcome.verdict for outcome in self.outcomes]
        lost = sum(len(verdict.lost) for verdict in verdicts)
        duplicated = sum(len(verdict.duplicated) for verdict in verdicts)
        identical = "yes" if all(outcome.identical for outcome in self.outcomes) else "no"
        faults = sum(self.done.values())
        return f"faults {faults} lost {lost} duplicated {duplicated} identical {identical}"


def _tell(number: int, outcome: Outcome, faults: int) -> None:
    state = "sound" if outcome.sound else "NOT SOUND"
    recovered = len(outcome.verdict.recovered)
    print(
        f"run {number}: {outcome.seconds:5.1f} s, {sum(outcome.done.values())} faults "
        f"({faults} so far), {recovered} scans recovered, {outcome.replayed} batches replayed, "
        f"{state}",
        flush=True,
    )
    if not outcome.sound:
        print(f"  {outcome.error}  {outcome.verdict}\n  identical: {outcome.identical}")
        print("  faults:", dict(outcome.done))


def main(arguments: list[str] | None = None) -> int:
    """Play the campaign and return 0 if every run was sound."""
    parser = argparse.ArgumentParser(prog="tests.chaos", description=__doc__)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=None, help="random by default")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)  # that workers die here is no news
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    campaign = Campaign(math.ceil((1 + SPARE_FAULTS) * options.faults), seed, survey())
    started = time.monotonic()
    with Arena(pauses=PAUSES) as arena:
        known = reference(arena, campaign.what)
        while not campaign.over:
            outcome = campaign.play(arena, known)
            _tell(len(campaign.outcomes), outcome, sum(campaign.done.values()))
    print(f"\n{campaign.table()}\n")
    grown = sum(outcome.grown for outcome in campaign.outcomes)
    runs = len(campaign.outcomes)
    print(
        f"{runs} runs in {time.monotonic() - started:.0f} s, in {grown} cloud.ply grew to its end"
    )
    if campaign.waiting:
        print("not reached:", ", ".join(f"{f.kind} at {f.point}" for f in campaign.waiting))
    sound = all(outcome.sound for outcome in campaign.outcomes)
    enough = sum(campaign.done.values()) >= options.faults
    if not sound or not enough:
        print(f"play it again with --seed {seed} --faults {options.faults}")
    print(campaign.summary())
    return 0 if sound and enough else 1


if __name__ == "__main__":
    sys.exit(main())

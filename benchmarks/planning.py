"""Seconds of a planning trial, and of its cost evaluations alone.

Run it on an idle core: `python benchmarks/planning.py`. Trials and evaluations take turns, so
that a machine which slows down slows both, and the time is the thread's own.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

from lidarpool.plan import Planning, best, run_trial
from lidarpool.plan.geometry import PathAxes
from lidarpool.plan.trial import prepare_swarm

SEED_SCENE = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]


def planning_of(discs: int, **search: int) -> Planning:
    """Return the default problem, or one with more discs of the same size at random places."""
    random = np.random.default_rng(0)
    centres = [*SEED_SCENE, *random.uniform(-19, 19, (max(0, discs - 6), 2))][:discs]
    return Planning((25, 25), (-30, -20), centres, 2.0, **search)


def seconds_of_evaluations(planning: Planning) -> float:
    """Seconds of as many evaluations as a trial makes, of paths in mid-search."""
    swarm = prepare_swarm(planning, PathAxes(planning.start, planning.target), seed=0)
    for _ in range(min(20, planning.iterations)):
        swarm.step()
    begun = time.thread_time()
    for _ in range(planning.iterations):
        swarm.paths.evaluate()
    return time.thread_time() - begun


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--discs", type=int, nargs="+", default=[6, 12, 25])
    parser.add_argument("--waypoints", type=int, nargs="+", default=[3, 5, 7])
    options = parser.parse_args(arguments)
    print("discs  waypoints  trial [ms]  evaluations alone [ms]  ratio  best path vs shortest")
    for discs in options.discs:
        for waypoints in options.waypoints:
            planning = planning_of(
                discs,
                waypoints=waypoints,
                particles=options.particles,
                iterations=options.iterations,
            )
            trials, whole, alone = [], [], []
            for number in range(options.repeats):
                begun = time.thread_time()
                trials.append(run_trial(planning, number))
                whole.append(time.thread_time() - begun)
                alone.append(seconds_of_evaluations(planning))
            ratio = statistics.median(w / a for w, a in zip(whole, alone, strict=True))
            plan = best(trials, planning)
            found = f"{plan.excess:+.4%}" if plan.collision_free else "no free path found"
            print(
                f"{discs:5d}  {waypoints:9d}  {1e3 * statistics.median(whole):10.1f}"
                f"  {1e3 * statistics.median(alone):22.1f}  {ratio:5.2f}  {found}"
            )


if __name__ == "__main__":
    main()

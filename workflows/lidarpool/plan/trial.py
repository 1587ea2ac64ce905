"""One trial: a swarm run to its end, on whatever worker."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from .axes import PathAxes
from .cost import PathCost
from .geometry import Floats, clearance, path_length, segment_distances
from .planning import Planning
from .randoms import Randoms
from .swarm import Swarm


@dataclass(frozen=True, eq=False)
class Trial:
    """What one swarm found.

    The same `Planning` and number give the same trial, to the bit, except for `seconds`.

    Parameters
    ----------
    trial
        Number of the trial, from 0.
    seed
        Seed of its random numbers.
    length
        Length of the path in metres.
    waypoints
        Corners of the path between its two ends, in metres: (k, 2).
    collision_free
        Whether the path enters no disc, by the exact check.
    seconds
        Time that the trial took.
    """

    trial: int
    seed: int
    length: float
    waypoints: Floats
    collision_free: bool
    seconds: float = field(compare=False)


def trial_seed(planning: Planning, trial: int) -> int:
    """Seed of trial number `trial`, independent of all others' (`numpy.random.SeedSequence`)."""
    sequence = np.random.SeedSequence(entropy=planning.seed, spawn_key=(trial,))
    return int(sequence.generate_state(1, np.uint64)[0])


def run_trial(planning: Planning, trial: int) -> Trial:
    """Search for a path with one particle swarm.

    A pure function on one thread: the result depends on `planning` and `trial` alone, not on
    where or beside what it runs.

    Parameters
    ----------
    planning
        The problem.
    trial
        Number of the trial, from 0.
    """
    begun = time.perf_counter()
    seed = trial_seed(planning, trial)
    axes = PathAxes(planning.start, planning.target)
    swarm = prepare_swarm(planning, axes, seed)
    for _ in range(planning.iterations):
        swarm.step()
    waypoints = axes.to_plane(swarm.best().astype(np.float64))
    path = with_ends(planning, waypoints)
    return Trial(
        trial=trial,
        seed=seed,
        length=path_length(path),
        waypoints=waypoints,
        collision_free=clearance(path, planning.centres, planning.radii) >= 0,
        seconds=time.perf_counter() - begun,
    )


def with_ends(planning: Planning, waypoints: Floats) -> Floats:
    """Return the whole path, (k + 2, 2): start, waypoints, target."""
    return np.vstack([planning.start, waypoints, planning.target])


def prepare_swarm(planning: Planning, axes: PathAxes, seed: int) -> Swarm:
    """Return the swarm of `planning`, spread as widely as a way around the discs may reach."""
    centres, radii = axes.to_local(planning.centres), planning.radii / axes.unit_m
    cost = PathCost(centres, radii, planning.waypoints, planning.particles)
    line = np.array([[-0.5, 0.0], [0.5, 0.0]])
    edges = segment_distances(line[:1], line[1:], centres)[0] + radii
    # No path worth having leaves the line by more than half its length.
    widest = min(float(edges.max(initial=0.0)), cost.entry_price / 2)
    return Swarm(cost, widest, Randoms(seed))

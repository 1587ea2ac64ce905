"""Planning trials that run one particle swarm each, and the best plan of all trials."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.schema.value_texts import one_line

from .cost import PathCost
from .geometry import PathAxes, clearance, path_length, segment_distances
from .planning import Planning
from .swarm import Randoms, Swarm
from .tangents import shortest_path_length


@dataclass(frozen=True, eq=False)
class Trial:
    """Result of a planning trial, in which one particle swarm searches for a path.

    The same `Planning` and trial index produce the same trial, bit for bit, except for `seconds`.
    """

    trial: int  # index, from 0
    seed: int  # seed of the random numbers
    length: float  # length of the path in meters
    waypoints: Floats  # (k, 2): corners of the path between its end points, in meters
    collision_free: bool  # whether the path enters no disc, according to the exact check
    seconds: float = field(compare=False)  # duration of the trial


def run_trial(planning: Planning, trial: int) -> Trial:
    """Search for a path with one particle swarm.

    The result depends only on `planning` and the trial index, and not on the worker or its other
    tasks. The search uses one thread.
    """
    started = time.perf_counter()
    # The spawn key makes the seed independent of the seeds of all other trials.
    sequence = np.random.SeedSequence(entropy=planning.seed, spawn_key=(trial,))
    seed = int(sequence.generate_state(1, np.uint64)[0])
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
        collision_free=clearance(path, planning.centers, planning.radii) >= 0,
        seconds=time.perf_counter() - started,
    )


def with_ends(planning: Planning, waypoints: Floats) -> Floats:
    """Return the entire path, with its start, waypoints and target.

    The array has shape (k + 2, 2).
    """
    return np.vstack([planning.start, waypoints, planning.target])


def prepare_swarm(planning: Planning, axes: PathAxes, seed: int) -> Swarm:
    """Return a swarm that is spread widely enough for any useful path around the discs."""
    centers = axes.to_local(planning.centers)
    radii = planning.radii / axes.unit_m
    cost = PathCost(centers, radii, planning.waypoints, planning.particles)
    line = np.array([[-0.5, 0.0], [0.5, 0.0]])
    edges = segment_distances(line[:1], line[1:], centers)[0] + radii
    # A path deviates from the line by at most half its length, and a path longer than the fixed
    # penalty is useless.
    widest = min(float(edges.max(initial=0.0)), cost.entry_price / 2)
    return Swarm(cost, widest, Randoms(seed))


@dataclass(frozen=True, eq=False)
class Plan:
    """Best path of all planning trials.

    Parameters
    ----------
    path
        Corners of the path from the start to the target, inclusive, in meters. Shape (k + 2, 2).
    length
        Length of the path in meters.
    shortest_possible
        Length of the shortest path in meters, computed from the tangents of the discs. It is inf if
        the discs completely block the way to the target.
    clearance
        Minimum distance from the path to a disc in meters. It is negative if the path enters a
        disc, and inf without discs.
    trial
        Index of the trial that found the path.
    trials
        Number of trials.
    """

    path: Floats
    length: float
    shortest_possible: float
    clearance: float
    trial: int
    trials: int
    __repr__ = one_line

    @property
    def collision_free(self) -> bool:
        """Whether the path enters no disc."""
        return self.clearance >= 0

    @property
    def excess(self) -> float:
        """Relative difference between the path length and the shortest possible length.

        For example, 0.01 is 1 %.
        """
        return self.length / self.shortest_possible - 1


def best(trials: Iterable[Trial], planning: Planning) -> Plan:
    """Return the shortest collision-free path of all trials.

    Each path is checked again, segment by segment, against every disc. If no path is
    collision-free, the path with the smallest depth in a disc is returned, and its `collision_free`
    is False. The order of `trials` does not matter. Ties are resolved in favor of the lowest trial
    index.

    Raises
    ------
    LidarError
        If `trials` is empty.
    """
    ranked = []
    for trial in trials:
        path = with_ends(planning, trial.waypoints)
        clearance_m = clearance(path, planning.centers, planning.radii)
        ranked.append((max(0.0, -clearance_m), path_length(path), trial.trial, clearance_m, path))
    if not ranked:
        raise LidarError("No planning trial was completed, so there is no best path.")
    _, length, number, clearance_m, path = min(ranked, key=lambda candidate: candidate[:3])
    return Plan(
        path=path,
        length=length,
        shortest_possible=shortest_path_length(
            planning.start, planning.target, planning.centers, planning.radii
        ),
        clearance=clearance_m,
        trial=number,
        trials=len(ranked),
    )

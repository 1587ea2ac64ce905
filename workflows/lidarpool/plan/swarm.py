"""A particle swarm: the arithmetic of moving, and of remembering what was best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .cost import PathCost, Singles
from .geometry import Floats
from .randoms import Randoms

# Constriction by Clerc and Kennedy (2002), in the form of an inertia weight (Shi and Eberhart
# 1998): chi = 0.7298 for phi = 2.05 + 2.05.
_INERTIA = np.float32(0.7298)
_PULL = 0.7298 * 2.05

_GROUPS = 10
_LEAST_GROUP = 20
_NARROWEST = 0.05  # spread of the first group; the unit is the distance from start to target
_LEAST_WIDEST = 0.2  # spread of the last group, at least


class Swarm:
    """Particles that are pulled to their own best place and to the best of their group.

    The particles are divided into groups (up to 10, as many as divide them evenly into 20 or
    more) that know nothing of each other. There is one way around the discs on either side of
    each, and a swarm with one common best settles early for one of them; ten groups, that start
    spread more and less widely about the straight line, settle for several.

    A particle's best place is kept as the displacement to it, which moving shortens by the
    velocity and a new best sets to zero: two plain products instead of a masked copy and a
    difference. It drifts by a rounding error in a move, which the discs' margin covers.

    Parameters
    ----------
    cost
        Where the particles live: its `waypoints` are their positions.
    widest
        How far from the straight line discs reach, in the frame's unit.
    randoms
        Source of random numbers.
    """

    def __init__(self, cost: PathCost, widest: float, randoms: Randoms) -> None:
        self._paths = cost
        corners, _, particles = cost.waypoints.shape
        rows = 2 * corners
        self._at = cost.waypoints.reshape(rows, particles)  # positions, a view
        self._groups = group_count(particles)
        spreads = _spreads(self._groups, widest)
        self._at[:] = _scattered(corners, particles, spreads, randoms)
        self._velocity = np.zeros_like(self._at)
        self._to_own = np.zeros_like(self._at)
        self._scratch = np.empty_like(self._at)
        self._not_better = np.empty(particles, np.float32)
        self._own_cost = np.full(particles, np.inf, np.float32)
        self._leader_at = np.empty((rows, self._groups), np.float32)
        self._to_leader = np.empty((rows, self._groups), np.float32)
        self._first = np.arange(self._groups) * (particles // self._groups)
        self._pulls = randoms.windows(rows * particles, scale=_PULL)

    def step(self, leader_costs: Singles) -> None:
        """Evaluate all particles, remember what was best, and move.

        Writes to `leader_costs`, (groups,), the lowest cost each group has met so far.
        """
        self._remember(self._paths.evaluate())
        self._own_cost.take(self._leaders, out=leader_costs)
        self._move()

    def best(self) -> Singles:
        """Corners of the best path so far: (waypoints, 2)."""
        leader = int(self._own_cost.argmin())
        return (self._at[:, leader] + self._to_own[:, leader]).reshape(-1, 2)

    def _remember(self, cost: Singles) -> None:
        np.greater_equal(cost, self._own_cost, out=self._not_better)
        np.minimum(cost, self._own_cost, out=self._own_cost)
        np.multiply(self._to_own, self._not_better, out=self._to_own)
        grouped = self._own_cost.reshape(self._groups, -1)
        self._leaders = grouped.argmin(axis=1) + self._first
        self._at.take(self._leaders, axis=1, out=self._leader_at, mode="clip")
        self._to_own.take(self._leaders, axis=1, out=self._to_leader, mode="clip")
        np.add(self._leader_at, self._to_leader, out=self._leader_at)

    def _move(self) -> None:
        at, velocity, scratch = self._at, self._velocity, self._scratch
        own_pull = self._pulls.draw().reshape(at.shape)
        leader_pull = self._pulls.draw().reshape(at.shape)
        np.multiply(velocity, _INERTIA, out=velocity)
        np.multiply(self._to_own, own_pull, out=scratch)
        np.add(velocity, scratch, out=velocity)
        by_group = (len(at), self._groups, -1)
        np.subtract(self._leader_at[..., None], at.reshape(by_group), out=scratch.reshape(by_group))
        np.multiply(scratch, leader_pull, out=scratch)
        np.add(velocity, scratch, out=velocity)
        np.add(at, velocity, out=at)
        np.subtract(self._to_own, velocity, out=self._to_own)


def group_count(particles: int) -> int:
    """Return how many groups, all of one size, `particles` are divided into."""
    return max(
        groups
        for groups in range(1, _GROUPS + 1)
        if groups == 1 or (particles % groups == 0 and particles // groups >= _LEAST_GROUP)
    )


def _spreads(groups: int, widest: float) -> NDArray[np.float64]:
    """How far from the straight line each group starts: (groups,), closer at the narrow end."""
    widest = max(_LEAST_WIDEST, widest)
    if groups == 1:
        return np.array([widest])
    share = np.arange(groups) / (groups - 1)
    return _NARROWEST + (widest - _NARROWEST) * share * share


def _scattered(corners: int, particles: int, spreads: Floats, randoms: Randoms) -> Singles:
    """First positions: corners evenly along the straight line, and off it by up to the spread."""
    shape = (corners, 2, len(spreads), particles // len(spreads))
    off = 2 * randoms.uniform(2 * corners * particles).reshape(shape) - 1
    off *= spreads.astype(np.float32)[:, None]
    along = np.arange(1, corners + 1) / (corners + 1) - 0.5
    off[:, 0] += along.astype(np.float32)[:, None, None]
    return off.reshape(2 * corners, particles)

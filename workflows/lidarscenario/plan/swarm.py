"""Particle swarm that searches for a short path, and its reproducible random numbers."""

from __future__ import annotations

import itertools
import math

import numpy as np

from lidarsim.numerics.arrays import Floats, Floats32

from .cost import PathCost

_GROUPS = 5
_MIN_GROUP = 20  # particles
_MIN_SPREAD = 0.05  # spread of the first group, as a multiple of the start-target distance
_MIN_LAST_SPREAD = 0.2  # minimum spread of the last group, in the same unit
# Drawing new random numbers for each move would take as long as all other computations. Instead,
# a table with enough numbers for `_TABLE_MOVES` moves is drawn once, and each move uses a block of
# the table that starts at a random index. Blocks overlap, but a number is used for a different
# particle and coordinate in each block.
_TABLE_MOVES = 2
_STARTS = 1021  # number of block starts before they repeat


class Randoms:
    """Reproducible random numbers in single precision, for seeds below 2**64.

    NumPy guarantees that the raw output of its bit generators does not change, but gives no such
    guarantee for `Generator` (NEP 19). Therefore the distributions are computed here.
    """

    def __init__(self, seed: int) -> None:
        self._bits = np.random.SFC64(seed)

    def uniform(self, count: int) -> Floats32:
        """Return `count` uniformly distributed numbers in [0, 1), which are multiples of 2**-24."""
        leading_bits = self._bits.random_raw(count) >> np.uint64(40)
        return leading_bits.astype(np.float32) * np.float32(2**-24)

    def normal(self, count: int) -> Floats32:
        """Return `count` approximately normally distributed numbers with mean 0 and variance 1.

        Each number is the sum of four uniform numbers (Irwin-Hall distribution), which are the
        16-bit quarters of a raw number. All values lie within ±3.5. The exact normal distribution
        would require logarithms, whose results differ between machines.
        """
        raw = self._bits.random_raw(count)
        total = np.zeros(count, np.uint64)
        for quarter in range(4):
            total += (raw >> np.uint64(16 * quarter)) & np.uint64(0xFFFF)
        # The sum of four integers below 2**16 has mean 2 (2**16 - 1) and variance ≈ 2**32 / 3.
        centered = total.astype(np.float32) - np.float32(2 * (2**16 - 1))
        return centered * np.float32(math.sqrt(3) / 2**16)

    def below(self, end: int, count: int) -> list[int]:
        """Return `count` random integers from 0 to `end` - 1, where `end` is far below 2**64."""
        return (self._bits.random_raw(count) % np.uint64(end)).tolist()


class Swarm:
    """Bare-bones particle swarm (Kennedy 2003) that is divided into independent groups.

    A particle has no velocity. In each step, it jumps to a random position around the midpoint
    between its own best position and the best position of its group. In each coordinate, the
    standard deviation is the distance between the two. Thus a particle searches closely where both
    agree, and widely where they differ. Compared with inertia and constriction (Shi and Eberhart
    1998, Clerc and Kennedy 2002), the method finds equally good paths in scenes with 6 to 25 discs,
    with two thirds of the arithmetic.

    A path can pass each disc on either side, and a swarm with one common best position soon commits
    to one combination of sides. Groups with different initial spreads commit to different
    combinations. The largest spread around the straight line is `widest`, as a multiple of the
    distance from start to target. The particles' positions are stored in `paths.waypoints`.
    """

    def __init__(self, paths: PathCost, widest: float, randoms: Randoms) -> None:
        corners, axes, particles = paths.waypoints.shape
        rows = corners * axes
        self.paths = paths
        self.groups = _group_count(particles)
        self._positions = paths.waypoints.reshape(rows, particles)  # positions, a view
        spreads = _spreads(self.groups, widest)
        start = _scatter_paths(corners, particles, spreads, randoms)
        self._positions[:] = start.reshape(rows, particles)
        self._best = self._positions.copy()  # best position of each particle
        self._best_cost = np.full(particles, np.inf, np.float32)
        self._jump = np.zeros_like(self._best)  # vector between a particle's best and its position
        self._better = np.empty(particles, np.float32)
        self._leaders = np.empty((rows, self.groups), np.float32)
        self._leader_numbers = np.empty(self.groups, np.intp)
        self._group_starts = np.arange(self.groups) * (particles // self.groups)
        # Relative positions of jumps, where 0 is the particle's best position and 1 its leader's.
        size = rows * particles
        self._shares = randoms.normal(_TABLE_MOVES * size) + np.float32(0.5)
        starts = randoms.below(len(self._shares) - size + 1, _STARTS)
        self._share_blocks = itertools.cycle([slice(start, start + size) for start in starts])
        # Further views of the same memory. Operations along one long axis are fastest.
        self._flat_positions = self._positions.reshape(-1)
        self._flat_best = self._best.reshape(-1)
        self._flat_jump = self._jump.reshape(-1)
        self._best_by_group = self._best.reshape(rows, self.groups, -1)
        self._jump_by_group = self._jump.reshape(rows, self.groups, -1)
        self._best_cost_by_group = self._best_cost.reshape(self.groups, -1)

    def step(self) -> None:
        """Evaluate all particles, record the best positions and move the particles."""
        self._remember(self.paths.evaluate())
        self._move()

    def best(self) -> Floats32:
        """Return the corners of the best path found so far.

        The array has shape (waypoints, 2).
        """
        return self._best[:, self._best_cost.argmin()].reshape(-1, 2)

    def _remember(self, cost: Floats32) -> None:
        """Update the best position of each particle, and the leader of each group."""
        np.less(cost, self._best_cost, out=self._better)  # 1.0 or 0.0
        np.minimum(cost, self._best_cost, out=self._best_cost)
        # Multiplying and adding takes half as long as a masked copy. The sum is the same as in
        # `_move`, so the recorded position is exactly the position that was evaluated.
        np.multiply(self._jump, self._better, out=self._jump)
        np.add(self._flat_best, self._flat_jump, out=self._flat_best)
        leaders = self._best_cost_by_group.argmin(axis=1, out=self._leader_numbers)
        np.add(leaders, self._group_starts, out=leaders)
        # Unless mode="clip" is set, `take` with `out` makes a temporary copy.
        self._best.take(leaders, axis=1, out=self._leaders, mode="clip")

    def _move(self) -> None:
        np.subtract(self._leaders[..., None], self._best_by_group, out=self._jump_by_group)
        np.multiply(self._flat_jump, self._shares[next(self._share_blocks)], out=self._flat_jump)
        np.add(self._flat_best, self._flat_jump, out=self._flat_positions)


def _group_count(particles: int) -> int:
    """Return the number of equal groups into which the particles are divided."""
    return max(
        groups
        for groups in range(1, _GROUPS + 1)
        if groups == 1 or (particles % groups == 0 and particles // groups >= _MIN_GROUP)
    )


def _spreads(groups: int, widest: float) -> Floats:
    """Return how widely the initial paths of each group spread around the straight line."""
    widest = max(_MIN_LAST_SPREAD, widest)
    if groups == 1:
        return np.array([widest])
    fraction = np.arange(groups) / (groups - 1)
    return _MIN_SPREAD + (widest - _MIN_SPREAD) * fraction * fraction


def _scatter_paths(corners: int, particles: int, spreads: Floats, randoms: Randoms) -> Floats32:
    """Return the initial positions of all particles.

    The array has shape (corners, 2, groups, size). The paths of the first group bend at one point,
    those of the second group at two points, and so on. Bends are drawn within the group's spread
    around the straight line, and corners are evenly spaced. Paths with few bends pass between discs
    more often than paths with independent corners.
    """
    groups = len(spreads)
    size = particles // groups
    bends = 2 * randoms.uniform(2 * corners * particles).reshape(groups, corners, 1, 2, size) - 1
    fractions = np.arange(1, corners + 1) / (corners + 1)
    positions = np.empty((corners, 2, groups, size), np.float32)
    for group, spread in enumerate(spreads):
        count = group % corners + 1
        # The weight of a bend is 1 at the bend and falls linearly to 0 at both adjacent bends.
        apart = np.abs(fractions * (count + 1) - np.arange(1, count + 1)[:, None])
        shares = (spread * np.maximum(1 - apart, 0)).astype(np.float32)[..., None, None]
        np.add.reduce(shares * bends[group, :count], axis=0, out=positions[:, :, group])
    positions[:, 0] += (fractions - 0.5).astype(np.float32)[:, None, None]
    return positions

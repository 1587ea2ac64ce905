"""A particle swarm, which moves particles and records the best, and its random numbers."""

from __future__ import annotations

import itertools
import math

import numpy as np

from lidarsim.base.arrays import Floats, Floats32

from .cost import PathCost

_GROUPS = 5
_MIN_GROUP = 20  # particles
_MIN_SPREAD = 0.05  # spread of the first group; the unit is the distance from start to target
_MIN_LAST_SPREAD = 0.2  # spread of the last group, at least
# New random numbers for each move would cost as much as all other arithmetic. So they are drawn
# once, into a table for `_TABLE_MOVES` moves, and each move takes a block of the table from a
# random start. Blocks overlap, but a number serves another particle and coordinate in each block.
_TABLE_MOVES = 2
_STARTS = 1021  # before they repeat


class Randoms:
    """Single-precision random numbers from a seed.

    NumPy guarantees the raw output of its bit generators, but not the output of its `Generator`
    (NEP 19), so the last step is computed here. The seed is below 2**64.
    """

    def __init__(self, seed: int) -> None:
        self._bits = np.random.SFC64(seed)

    def uniform(self, count: int) -> Floats32:
        """Return numbers uniform in [0, 1), multiples of 2**-24: (count,)."""
        leading_bits = self._bits.random_raw(count) >> np.uint64(40)
        return leading_bits.astype(np.float32) * np.float32(2**-24)

    def normal(self, count: int) -> Floats32:
        """Return numbers of mean 0 and variance 1, nearly normal: (count,).

        Each is the sum of four uniform numbers (Irwin-Hall), the four quarters of a raw number,
        so all are within 3.5. The exact distribution would need logarithms, which are not the
        same on every machine.
        """
        raw = self._bits.random_raw(count)
        total = np.zeros(count, np.uint64)
        for quarter in range(4):
            total += (raw >> np.uint64(16 * quarter)) & np.uint64(0xFFFF)
        # Four whole numbers below 2**16 have mean 2 (2**16 - 1) and variance near 2**32 / 3.
        centered = total.astype(np.float32) - np.float32(2 * (2**16 - 1))
        return centered * np.float32(math.sqrt(3) / 2**16)

    def below(self, end: int, count: int) -> list[int]:
        """Draw whole numbers from 0 to end - 1, for an `end` far below 2**64."""
        return (self._bits.random_raw(count) % np.uint64(end)).tolist()


class Swarm:
    """A bare-bones particle swarm (Kennedy 2003), in independent groups.

    A particle has no velocity. It jumps to a random position about the middle between its own
    best and its group's best, with their distance in each coordinate as the standard deviation:
    it searches closely where both agree, and widely where they differ. Compared with inertia and
    constriction (Shi and Eberhart 1998, Clerc and Kennedy 2002) it finds equally good paths, in
    scenes of 6 to 25 discs, with two thirds of the arithmetic.

    Discs can be passed on either side, and a swarm with one common best settles early on a
    choice of sides. Groups with different initial spreads settle on several: up to `widest` about
    the straight line, in units of its length. The `waypoints` of `paths` are the positions of the
    particles.
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
        # Position of a jump between the particle's best, 0, and its leader's, 1.
        size = rows * particles
        self._shares = randoms.normal(_TABLE_MOVES * size) + np.float32(0.5)
        starts = randoms.below(len(self._shares) - size + 1, _STARTS)
        self._share_blocks = itertools.cycle([slice(start, start + size) for start in starts])
        # Other views of the same memory: one long axis is fastest.
        self._flat_positions = self._positions.reshape(-1)
        self._flat_best = self._best.reshape(-1)
        self._flat_jump = self._jump.reshape(-1)
        self._best_by_group = self._best.reshape(rows, self.groups, -1)
        self._jump_by_group = self._jump.reshape(rows, self.groups, -1)
        self._best_cost_by_group = self._best_cost.reshape(self.groups, -1)

    def step(self) -> None:
        """Evaluate all particles, record the best, and jump."""
        self._remember(self.paths.evaluate())
        self._move()

    def best(self) -> Floats32:
        """Return the corners of the best path so far: (waypoints, 2)."""
        return self._best[:, self._best_cost.argmin()].reshape(-1, 2)

    def _remember(self, cost: Floats32) -> None:
        """Record the positions that are the best of their particles, and the groups' leaders."""
        np.less(cost, self._best_cost, out=self._better)  # 1.0 or 0.0
        np.minimum(cost, self._best_cost, out=self._best_cost)
        # A product and a sum take half the time of a masked copy. The sum equals the position from
        # `_move`, so the best is exactly the position that was evaluated.
        np.multiply(self._jump, self._better, out=self._jump)
        np.add(self._flat_best, self._flat_jump, out=self._flat_best)
        leaders = self._best_cost_by_group.argmin(axis=1, out=self._leader_numbers)
        np.add(leaders, self._group_starts, out=leaders)
        # Without mode="clip", take with out= goes through a copy.
        self._best.take(leaders, axis=1, out=self._leaders, mode="clip")

    def _move(self) -> None:
        """Let all particles jump."""
        np.subtract(self._leaders[..., None], self._best_by_group, out=self._jump_by_group)
        np.multiply(self._flat_jump, self._shares[next(self._share_blocks)], out=self._flat_jump)
        np.add(self._flat_best, self._flat_jump, out=self._flat_positions)


def _group_count(particles: int) -> int:
    """Return the number of equal groups that `particles` are divided into."""
    return max(
        groups
        for groups in range(1, _GROUPS + 1)
        if groups == 1 or (particles % groups == 0 and particles // groups >= _MIN_GROUP)
    )


def _spreads(groups: int, widest: float) -> Floats:
    """Return each group's initial spread about the straight line: (groups,)."""
    widest = max(_MIN_LAST_SPREAD, widest)
    if groups == 1:
        return np.array([widest])
    share = np.arange(groups) / (groups - 1)
    return _MIN_SPREAD + (widest - _MIN_SPREAD) * share * share


def _scatter_paths(corners: int, particles: int, spreads: Floats, randoms: Randoms) -> Floats32:
    """Return first positions: polylines about the straight line, (corners, 2, groups, size).

    A group's paths bend at 1, 2, 3, … points, drawn within its spread about the straight line, and
    their corners are evenly spaced. With few bends, paths lead between discs more often than with
    independent corners.
    """
    groups = len(spreads)
    size = particles // groups
    bends = 2 * randoms.uniform(2 * corners * particles).reshape(groups, corners, 1, 2, size) - 1
    fractions = np.arange(1, corners + 1) / (corners + 1)
    positions = np.empty((corners, 2, groups, size), np.float32)
    for group, spread in enumerate(spreads):
        count = group % corners + 1
        # 1 where a corner is at a bend, 0 from the bends on either side of it.
        apart = np.abs(fractions * (count + 1) - np.arange(1, count + 1)[:, None])
        shares = (spread * np.maximum(1 - apart, 0)).astype(np.float32)[..., None, None]
        np.add.reduce(shares * bends[group, :count], axis=0, out=positions[:, :, group])
    positions[:, 0] += (fractions - 0.5).astype(np.float32)[:, None, None]
    return positions

"""Follow light through voxel grids of leaf area density until it hits a leaf."""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Bools, Floats, Indices
from ..numerics.vectors import inverse, matmul, matvec
from ..scene.scene_instances import Instances

BLOCK_RAYS = 1 << 13  # number of rays that are followed at a time, to fit a cache
_LEVEL = 1e-30  # voxels per meter; light that is slower along an axis stays in its voxel layer


class GridPassage(NamedTuple):
    """Result of following n rays through k grids each."""

    meters: Floats  # (n,): distance from the start to the leaf that light hits, or inf
    # (n,): optical depth left until a leaf, at the end of the path; -inf if light hits a leaf.
    remaining_depth: Floats
    density: Floats  # (n, k): optical depth per meter of each grid at the leaf, 0 without a leaf


class _GridRays(NamedTuple):
    """State of light rays in the voxels of k grids.

    The last axis of each array is the axis of the rays.

    Rays are removed when they hit a leaf or reach the end of their path.
    """

    row: Indices  # (n,): number of the ray in its block
    uniform_density: Floats  # (n,): optical depth per meter of media that are not grids
    length: Floats  # (n,): path length, meters
    depth: Floats  # (n,): optical depth left until a leaf
    meters: Floats  # (n,): distance from the start
    cell: Floats  # (3, k, n): voxel indices of the light, which may be outside the grid
    step: Floats  # (3, k, n): -1, 0 or 1, the sign of the light's direction
    pace: Floats  # (3, k, n): meters per voxel; 0 for light that stays in its voxel layer
    shift: Floats  # (3, k, n): the next voxel border is at `cell * pace + shift` meters
    size: Floats  # (3, k, n): number of voxels of the grid
    first: Floats  # (k, n): index of the grid's first voxel among the densities of all grids
    # (k, n): optical depth per meter for a leaf area density of 1, which is the mean projection of
    # the leaves; 0 without a grid.
    projection: Floats

    def take(self, row_indices: Indices) -> _GridRays:
        return _GridRays._make(array[..., row_indices] for array in self)


class Grids:
    """Voxel grids of the instances in a scene.

    The densities of each part are stored once.
    """

    def __init__(self, shared: Instances) -> None:
        voxels = [part.voxels for part in shared.mesh_parts]
        sizes = [(0, 0, 0) if grid is None else grid.density.shape for grid in voxels]
        self._sizes = np.array(sizes, np.float64)
        self._starts = np.cumsum([0, *(int(np.prod(size)) for size in sizes[:-1])])
        densities = [grid.density.reshape(-1) for grid in voxels if grid is not None]
        self._values = densities[0] if len(densities) == 1 else np.concatenate(densities)
        self._matrices = np.array(
            [np.eye(3, 4) if grid is None else grid.matrix for grid in voxels], np.float64
        )
        self._place_instances(shared)

    @classmethod
    def from_instances(cls, shared: Instances | None) -> Grids | None:
        """Return the voxel grids of the instances, or None if no instance has a grid."""
        if shared is None or all(part.voxels is None for part in shared.mesh_parts):
            return None
        return cls(shared)

    def with_moved_instances(self, shared: Instances) -> Grids:
        """Return the grids with the current transforms of the instances."""
        grids = copy(self)
        grids._place_instances(shared)
        return grids

    def _place_instances(self, shared: Instances) -> None:
        """Compute each instance's grid origin, and its matrix from scene to voxel coordinates."""
        self._part = shared.part
        to_scene = shared.transforms
        matrices = self._matrices[self._part]
        self._origins = matvec(to_scene[:, :, :3], matrices[:, :, 3]) + to_scene[:, :, 3]
        self._to_grid = inverse(matmul(to_scene[:, :, :3], matrices[:, :, :3]))

    def follow(
        self,
        instances: Indices,
        starts: Floats,
        directions: Floats,
        projection: Floats,
        uniform_density: Floats,
        length: Floats,
        depth: Floats,
    ) -> GridPassage:
        """Follow n rays of light through grids, voxel by voxel (Amanatides and Woo 1987).

        Parameters
        ----------
        instances
            (n, k): instances whose grids overlap along the path, padded with -1.
        starts, directions
            (n, 3): origins and directions of the light in the scene frame.
        projection
            (n, k): optical depth per meter for a leaf area density of 1 in each grid.
        uniform_density
            (n,): optical depth per meter of media that are not grids.
        length
            (n,): path lengths in meters.
        depth
            (n,): optical depth after which the light hits a leaf.
        """
        passages = [
            self._follow_block(
                instances[block],
                starts[block],
                directions=directions[block],
                projection=projection[block],
                uniform_density=uniform_density[block],
                length=length[block],
                depth=depth[block],
            )
            for block in (
                slice(k, k + BLOCK_RAYS) for k in range(0, max(len(depth), 1), BLOCK_RAYS)
            )
        ]
        if len(passages) == 1:
            return passages[0]
        return GridPassage(*map(np.concatenate, zip(*passages, strict=True)))

    def _follow_block(
        self,
        instances: Indices,
        starts: Floats,
        directions: Floats,
        projection: Floats,
        uniform_density: Floats,
        length: Floats,
        depth: Floats,
    ) -> GridPassage:
        passage = GridPassage(
            np.full(len(depth), np.inf), np.full(len(depth), -np.inf), np.zeros(instances.shape)
        )
        rays = self._enter(
            instances,
            starts,
            directions=directions,
            projection=projection,
            uniform_density=uniform_density,
            length=length,
            depth=depth,
        )
        while len(rays.row):
            density, inside = self._density(rays)
            density *= rays.projection
            total = rays.uniform_density.copy()
            for grid_density in density:
                total += grid_density
            border = _border(rays, inside)
            border_m = np.minimum.reduce(border.reshape(-1, len(rays.row)))
            passed_depth = total * np.maximum(np.minimum(border_m, rays.length) - rays.meters, 0)
            meets_leaf = passed_depth > rays.depth
            row = rays.row[meets_leaf]
            passage.meters[row] = (
                rays.meters[meets_leaf] + rays.depth[meets_leaf] / total[meets_leaf]
            )
            passage.density[row] = density[:, meets_leaf].T
            remaining = rays.depth - passed_depth
            at_end = ~meets_leaf & (border_m >= rays.length)
            passage.remaining_depth[rays.row[at_end]] = remaining[at_end]
            rays = rays._replace(
                depth=remaining,
                # Because of rounding, a first border may lie before the start.
                meters=np.maximum(border_m, 0),
                cell=np.where(border <= border_m, rays.cell + rays.step, rays.cell),
            )
            followed = ~(meets_leaf | at_end)
            if not followed.all():
                rays = rays.take(np.flatnonzero(followed))
        return passage

    def _enter(
        self,
        instances: Indices,
        starts: Floats,
        directions: Floats,
        projection: Floats,
        uniform_density: Floats,
        length: Floats,
        depth: Floats,
    ) -> _GridRays:
        """Return the initial state of a block of rays, in the voxels where they start."""
        to_grid = self._to_grid[instances].transpose(2, 3, 1, 0)  # (axis, axis, k, n)
        x, y, z = (starts[:, None] - self._origins[instances]).transpose(2, 1, 0)
        u, v, w = directions.T[:, None]
        # Add products one by one, so that blocks of any size give identical bits.
        position = np.stack([(row[0] * x + row[1] * y) + row[2] * z for row in to_grid])
        direction = np.stack([(row[0] * u + row[1] * v) + row[2] * w for row in to_grid])
        level = np.abs(direction) < _LEVEL
        step = np.where(level, 0, np.sign(direction))
        pace = 1 / np.where(level, 1, direction)
        without_borders = level | (instances.T < 0)
        shift = np.where(without_borders, np.inf, ((step > 0) - position) * pace)
        pace[level] = 0
        return _GridRays(
            row=np.arange(len(depth)),
            uniform_density=uniform_density,
            length=length,
            depth=depth,
            meters=np.zeros(len(depth)),
            cell=np.floor(position),
            step=step,
            pace=pace,
            shift=shift,
            size=np.moveaxis(self._sizes[self._part[instances]], 2, 0).swapaxes(1, 2),
            first=self._starts[self._part[instances]].T,
            projection=np.where(instances < 0, 0, projection).T,
        )

    def _density(self, rays: _GridRays) -> tuple[Floats, Bools]:
        """Return the leaf area densities in m²/m³, and whether each ray is inside each grid.

        Both arrays have shape (k, n). Densities outside grids are 0.
        """
        i, j, k = rays.cell
        size = rays.size
        inside = np.asarray(((rays.cell >= 0) & (rays.cell < size)).all(axis=0))
        index = ((i * size[1] + j) * size[2] + k) + rays.first
        values = self._values[np.where(inside, index, 0).astype(np.intp)]
        return np.where(inside, values, 0.0), inside


def _border(rays: _GridRays, inside: Bools) -> Floats:
    """Return the distances in meters from the start to the next voxel borders.

    The shape is (3, k, n).

    For light that has left a grid for good, as determined from `inside` (k, n), there are no more
    borders, and `rays.shift` is set to inf.
    """
    beyond = ~inside & np.isfinite(rays.shift).any(axis=0)
    if beyond.any():
        in_front = (rays.cell < 0) & (rays.step <= 0)
        behind = (rays.cell >= rays.size) & (rays.step >= 0)
        leaves = (in_front | behind).any(axis=0)
        rays.shift[:, beyond & leaves] = np.inf
    return np.asarray(rays.cell * rays.pace + rays.shift)

"""Generate hills and mountains."""

from __future__ import annotations

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_fits, check_number
from lidarsim.schema.declared import Seed

from .plants import MAX_TREES, SCALES, SPECIES, all_trees, place_instances

_COARSEST = 4  # cells of the first octave along a side
_OCTAVES = 11
_ROUGHNESS = 0.5  # ratio between the heights of consecutive octaves
_RELIEF = 0.16  # maximum height divided by the side length

# A cell has at most one tree, at the flattest of a few positions in its central part.
_CELL_M = 5.0
_MAX_CELLS = 1_000
_TRIED = 4  # positions that are tried in a cell
_MIDDLE = 0.4  # size of the central part as a fraction of the cell
_STEEPEST = np.tan(np.radians(40.0))
_ROOT_M = 0.6
_EDGE_M = 5.0  # margin of the terrain without trees
_GLADE_M = 12.0  # radius without trees around the center, which is the default position of a sensor
_WOODS_M = 120.0  # size of woods
_WOOD_CELLS = 20  # minimum size of woods in cells
_DENSER = 5.0  # logarithm of the density ratio between woods and open land


def terrain(
    triangles: int = 2_000_000,
    seed: int = 0,
    side_m: float = 1000.0,
    trees: int = 0,
) -> Scene:
    """Return a square fractal terrain with ridges and valleys at every scale.

    The height is a sum of octaves of gradient noise (Perlin 1985), folded into ridges. Each octave
    is damped where the previous octaves are low, which makes low ground flatter. This is a
    multifractal (Musgrave, Kolb and Mace 1989).

    Parameters
    ----------
    triangles
        Number of triangles. The terrain is a complete grid, so it may have up to one row of
        triangles fewer.
    seed
        Seed of the random generator. The same arguments always result in the same terrain.
    side_m
        Side length in meters. The center is at (0, 0), and the lowest point is at z = 0.
    trees
        Number of trees. They are instances of the `SPECIES` in plants.py, in woods on slopes of up
        to 40 degrees, with conifers at higher altitudes. Their triangles are not counted in
        `triangles`.

    Raises
    ------
    LidarError
        If a number is out of range, or if there is not enough space for the trees.

    Examples
    --------
    >>> len(terrain(2_000).faces)
    1984
    """
    check_number("triangles", triangles, whole=True, ge=2, le=100_000_000)
    check_fits("seed", seed, Seed)
    check_number("side_m", side_m, gt=0, le=1e7)  # files reject coordinates beyond 1e8 m
    check_number("trees", trees, whole=True, ge=0, le=MAX_TREES)
    rows = int(np.sqrt(triangles / 2))
    columns = triangles // (2 * rows)
    x = np.linspace(0, 1, columns + 1)
    y = np.linspace(0, 1, rows + 1)
    height = _heights(x, y, np.random.default_rng(seed))
    points = np.empty((columns + 1, rows + 1, 3))
    points[..., 0] = (x[:, None] - 0.5) * side_m
    points[..., 1] = (y - 0.5) * side_m
    points[..., 2] = height * side_m
    faces = grid_faces(columns, rows).reshape(-1, 3)
    ground = SceneMesh("terrain", points.reshape(-1, 3), faces)
    return Scene.from_meshes([ground, *_woods(points[..., 2], side_m, trees, seed)])


def _woods(heights: Floats, side_m: float, count: int, seed: int) -> list[SceneInstance]:
    """Return trees that form woods, given the heights on a square grid."""
    if not count:
        return []
    rng = np.random.default_rng([seed, count])
    cells = min(int(side_m / _CELL_M), _MAX_CELLS)
    positions, slope = _flattest_positions(heights, side_m, cells, rng)
    fits = slope <= _STEEPEST
    fits &= np.hypot(*positions.T[:2]) > _GLADE_M
    fits &= np.abs(positions[:, :2]).max(axis=1) < side_m / 2 - _EDGE_M
    if fits.sum() < count:
        raise LidarError(
            f"The terrain has room for {fits.sum():,} trees, but {count:,} were requested. Make "
            "the terrain larger, or request fewer trees."
        )
    line = np.linspace(0, 1, cells) * min(side_m / _WOODS_M, cells / _WOOD_CELLS)
    density = np.exp(_DENSER * _noise(line, line, rng)).reshape(-1) * fits
    chosen = rng.choice(len(positions), count, replace=False, p=density / density.sum())
    # Conifers are higher up.
    conifer = rng.random(count) * heights.max() < positions[chosen, 2]
    kinds = np.array([species.conifer for species in SPECIES])
    kind = np.where(
        conifer, rng.choice(np.flatnonzero(kinds), count), rng.choice(np.flatnonzero(~kinds), count)
    )
    yaw = rng.uniform(0, 2 * np.pi, count)
    scale = rng.uniform(*SCALES, count)
    return place_instances(all_trees(seed, _ROOT_M), kind, positions[chosen], yaw, scale)


def _flattest_positions(
    heights: Floats, side_m: float, cells: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return the flattest of several random positions in each cell, and the slope there."""
    number = np.stack(np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"), axis=-1)
    inside = 0.5 + _MIDDLE * rng.uniform(-0.5, 0.5, (_TRIED, cells * cells, 2))
    fractions = (number.reshape(-1, 2) + inside) / max(cells, 1)
    height, slope = _ground_at(heights, side_m, fractions)
    best = slope.argmin(axis=0), np.arange(cells * cells)
    positions = np.column_stack([(fractions[best] - 0.5) * side_m, height[best]])
    return positions, slope[best]


def _ground_at(heights: Floats, side_m: float, share: Floats) -> tuple[Floats, Floats]:
    """Return the heights and slopes of the terrain at positions given as fractions of its sides."""
    size = np.array(heights.shape) - 1
    grid_position = share * size
    i, j = np.moveaxis(np.minimum(grid_position.astype(np.int64), size - 1), -1, 0)
    u = grid_position[..., 0] - i
    v = grid_position[..., 1] - j
    lower = heights[i, j]
    upper = heights[i + 1, j + 1]
    corner = np.where(u >= v, heights[i + 1, j], heights[i, j + 1])
    along_u = np.where(u >= v, corner - lower, upper - corner)
    along_v = np.where(u >= v, upper - corner, corner - lower)
    slope = np.hypot(along_u * size[0], along_v * size[1]) / side_m
    return lower + u * along_u + v * along_v, slope


def grid_faces(column_count: int, row_count: int) -> Ints:
    """Return two triangles for each grid cell. Shape (columns * rows, 2, 3).

    The grid has (columns + 1) x (rows + 1) points.
    """
    corner = (np.arange(column_count)[:, None] * (row_count + 1) + np.arange(row_count)).reshape(-1)
    beside = corner + row_count + 1
    return np.stack([corner, beside, beside + 1, corner, beside + 1, corner + 1], axis=1).reshape(
        -1, 2, 3
    )


def _heights(x: Floats, y: Floats, rng: np.random.Generator) -> Floats:
    """Return heights from 0 to `_RELIEF` on a grid from 0 to 1. Shape (len(x), len(y))."""
    total = np.zeros((len(x), len(y)))
    damping = np.ones_like(total)
    for octave in range(_OCTAVES):
        cells = _COARSEST << octave
        if octave and cells > 2 * max(len(x), len(y)):
            break  # finer than the grid
        ridge = 1 - np.abs(_noise(x * cells, y * cells, rng))
        ridge *= ridge * damping
        total += _ROUGHNESS**octave * ridge
        # High ground is rough, so the next octave is not damped there.
        np.clip(1.6 * ridge, 0, 1, out=damping)
    total -= total.min()
    highest = total.max()
    return total * (_RELIEF / highest) if highest else total


def _noise(x: Floats, y: Floats, rng: np.random.Generator) -> Floats:
    """Return gradient noise from about -1 to 1 on a grid. Shape (len(x), len(y)).

    The gradients are at integer coordinates.
    """
    shape = (int(x.max()) + 2, int(y.max()) + 2)
    angle = rng.uniform(0, 2 * np.pi, shape)
    slopes = np.cos(angle), np.sin(angle)
    i = x.astype(np.int64)
    j = y.astype(np.int64)
    u = (x - i)[:, None]
    v = (y - j)[None, :]
    blend_u, blend_v = (t * t * t * (t * (6 * t - 15) + 10) for t in (u, v))
    total = np.zeros((len(x), len(y)))
    for right in (0, 1):
        for up in (0, 1):
            corner = np.ix_(i + right, j + up)
            part = slopes[0][corner] * (u - right) + slopes[1][corner] * (v - up)
            part *= blend_u if right else 1 - blend_u
            part *= blend_v if up else 1 - blend_v
            total += part
    return total * 1.4

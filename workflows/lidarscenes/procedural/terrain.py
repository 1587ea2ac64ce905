"""Generated hills and mountains."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from lidarsim.base.arrays import Floats, Ints
from lidarsim.base.declared import Seed
from lidarsim.base.errors import LidarError
from lidarsim.base.validation import checked
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh

from .plants import MOST_TREES, SCALES, SPECIES, all_trees, placed

_COARSEST = 4  # cells of the first octave along a side
_OCTAVES = 11
_ROUGHNESS = 0.5  # height of each octave over that of the one before
_RELIEF = 0.16  # greatest height over the side's length

# One tree at most in a cell, at the flattest of some places in its middle part.
_CELL_M = 5.0
_MOST_CELLS = 1_000
_TRIED = 4
_MIDDLE = 0.4
_STEEPEST = np.tan(np.radians(40.0))
_ROOT_M = 0.6
_EDGE_M = 5.0  # of the terrain, without trees
_GLADE_M = 12.0  # without trees around the middle, where a sensor stands by default
# Size of woods, and in cells at least; how much denser than between them, as an exponent.
_WOODS_M = 120.0
_WOOD_CELLS = 20
_DENSER = 5.0


@checked
def terrain(
    triangles: Annotated[int, Field(ge=2, le=100_000_000)] = 2_000_000,
    seed: Seed = 0,
    # Files reject coordinates beyond 1e8 m.
    side_m: Annotated[float, Field(gt=0, le=1e7)] = 1000.0,
    trees: Annotated[int, Field(ge=0, le=MOST_TREES)] = 0,
) -> Scene:
    """Make a square of fractal terrain: ridges and valleys at every scale, flatter low down.

    The height is a sum of octaves of gradient noise (Perlin 1985), folded into ridges, where
    each octave is damped by the height that there is already: a multifractal (Musgrave, Kolb
    and Mace 1989).

    Parameters
    ----------
    triangles
        The scene has a full grid of them: up to one row fewer.
    seed
        The same numbers give the same terrain.
    side_m
        Length of a side, metres; (0, 0) is in the middle, and z = 0 is the lowest point.
    trees
        Number of trees, in woods on ground of at most 40 degrees: instances of one mesh for each
        of `SPECIES` in plants.py. Conifers are higher up. Their triangles are not
        counted in `triangles`.

    Raises
    ------
    LidarError
        For a number that is out of range, or trees that do not fit.

    Examples
    --------
    >>> len(terrain(2_000).faces)
    1984
    """
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
    """Place trees on ground of these heights over a square grid."""
    if not count:
        return []
    rng = np.random.default_rng([seed, count])
    cells = min(int(side_m / _CELL_M), _MOST_CELLS)
    number = np.stack(np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"), axis=-1)
    inside = 0.5 + _MIDDLE * rng.uniform(-0.5, 0.5, (_TRIED, cells * cells, 2))
    tried = (number.reshape(-1, 2) + inside) / max(cells, 1)
    height, slope = _ground_at(heights, side_m, tried)
    best = slope.argmin(axis=0), np.arange(cells * cells)
    share = tried[best]
    height = height[best]
    places = np.column_stack([(share - 0.5) * side_m, height])
    fits = slope[best] <= _STEEPEST
    fits &= np.hypot(*places.T[:2]) > _GLADE_M
    fits &= np.abs(places[:, :2]).max(axis=1) < side_m / 2 - _EDGE_M
    if fits.sum() < count:
        raise LidarError(
            f"The terrain has room for {fits.sum():,} trees, not {count:,}: make it larger, or "
            "take fewer trees."
        )
    line = np.linspace(0, 1, cells) * min(side_m / _WOODS_M, cells / _WOOD_CELLS)
    density = np.exp(_DENSER * _noise(line, line, rng)).reshape(-1) * fits
    chosen = rng.choice(len(places), count, replace=False, p=density / density.sum())
    # Conifers are higher up.
    conifer = rng.random(count) * heights.max() < height[chosen]
    kinds = np.array([species.conifer for species in SPECIES])
    kind = np.where(
        conifer, rng.choice(np.flatnonzero(kinds), count), rng.choice(np.flatnonzero(~kinds), count)
    )
    turn = rng.uniform(0, 2 * np.pi, count)
    scale = rng.uniform(*SCALES, count)
    return placed(all_trees(seed, _ROOT_M), kind, places[chosen], turn, scale)


def _ground_at(heights: Floats, side_m: float, share: Floats) -> tuple[Floats, Floats]:
    """Heights and slopes (rise over run) of the triangles at shares (..., 2) of the sides."""
    size = np.array(heights.shape) - 1
    at = share * size
    i, j = np.moveaxis(np.minimum(at.astype(np.int64), size - 1), -1, 0)
    u = at[..., 0] - i
    v = at[..., 1] - j
    low = heights[i, j]
    high = heights[i + 1, j + 1]
    corner = np.where(u >= v, heights[i + 1, j], heights[i, j + 1])
    along_u = np.where(u >= v, corner - low, high - corner)
    along_v = np.where(u >= v, high - corner, corner - low)
    slope = np.hypot(along_u * size[0], along_v * size[1]) / side_m
    return low + u * along_u + v * along_v, slope


def grid_faces(columns: int, rows: int) -> Ints:
    """Two triangles for each cell of a grid of (columns + 1) x (rows + 1) points: (c * r, 2, 3)."""
    corner = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).reshape(-1)
    beside = corner + rows + 1
    return np.stack([corner, beside, beside + 1, corner, beside + 1, corner + 1], axis=1).reshape(
        -1, 2, 3
    )


def _heights(x: Floats, y: Floats, rng: np.random.Generator) -> Floats:
    """Heights from 0 to `_RELIEF` over a grid of coordinates in 0 to 1: (len(x), len(y))."""
    total = np.zeros((len(x), len(y)))
    damping = np.ones_like(total)
    for octave in range(_OCTAVES):
        cells = _COARSEST << octave
        if octave and cells > 2 * max(len(x), len(y)):
            break  # finer than the grid can show
        ridge = 1 - np.abs(_noise(x * cells, y * cells, rng))
        ridge *= ridge * damping
        total += _ROUGHNESS**octave * ridge
        # High ground is rough: the next octave counts fully there.
        np.clip(1.6 * ridge, 0, 1, out=damping)
    total -= total.min()
    highest = total.max()
    return total * (_RELIEF / highest) if highest else total


def _noise(x: Floats, y: Floats, rng: np.random.Generator) -> Floats:
    """Gradient noise over a grid, about -1 to 1; a lattice of unit steps: (len(x), len(y))."""
    shape = (int(x.max()) + 2, int(y.max()) + 2)
    angle = rng.uniform(0, 2 * np.pi, shape)
    slopes = np.cos(angle), np.sin(angle)
    i = x.astype(np.int64)
    j = y.astype(np.int64)
    u = (x - i)[:, None]
    v = (y - j)[None, :]
    blend_u, blend_v = (t * t * t * (t * (6 * t - 15) + 10) for t in (u, v))
    out = np.zeros((len(x), len(y)))
    for right in (0, 1):
        for up in (0, 1):
            at = np.ix_(i + right, j + up)
            part = slopes[0][at] * (u - right) + slopes[1][at] * (v - up)
            part *= blend_u if right else 1 - blend_u
            part *= blend_v if up else 1 - blend_v
            out += part
    return out * 1.4

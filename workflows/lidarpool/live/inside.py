"""How a scene is shown so that one sees what its sensors see, wherever the camera goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..render.cutaway import Shell, enclosed, probes, some_of
from ..render.surface import Surface, unit
from ..scene.scene import Scene

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Reals = NDArray[np.float32]

ROOFED = 0.7  # of the steep rays from a sensor end in the scene: there is a roof over it
STEEP_DEG = (60.0, 90.0)
LOW = 5  # percentile of a ceiling's heights: lamps and beams are not left hanging
BELOW = 0.04  # of the way from the sensor up to the ceiling, that the cut is below it
TOUCHES = 1e-3  # of the scene's diagonal: a sensor on a surface does not stand under it
WALL = 0.02  # of the scene's diagonal: walls are thinner, roofs with what carries them too

CELLS = 80  # of a grid along the longest side of the walls
SAMPLES = 400_000  # places that the walls are entered into the grid by: many in each cell
SIZE = 0.7  # from the middle of a triangle to its corners, as a share of a point's size
APART = 0.3  # from a wall, as a share of a point's size: else the wall would show through


@dataclass(frozen=True, eq=False)
class InsideView:
    """What hides the sensors, for a camera that moves.

    Parameters
    ----------
    shell
        bool (f,): walls and roofs around the sensors. Shown from the sensors' side alone, they
        are there as far walls and vanish as near ones.
    turned
        bool (f,): those of the shell whose corners run clockwise, seen from the sensors.
    ceiling
        Height, in metres, just below the ceiling; None where the sensors see the sky.
    """

    shell: Flags
    turned: Flags
    ceiling: float | None

    @classmethod
    def of(cls, scene: Scene, poses: Floats) -> InsideView:
        """Find out what hides sensors at poses (p, 3), p >= 1, by casting rays from them."""
        surface, sensors = Surface.of(scene), some_of(poses)
        none = np.zeros(len(scene.faces), np.bool_)
        ceiling = _ceiling(surface, sensors)
        if not enclosed(surface, sensors):
            return cls(none, none, ceiling)
        middles = scene.vertices[scene.faces].mean(axis=1)
        shell = Shell.around(scene, sensors).holds(middles, np.arange(len(middles)))
        if ceiling is not None:  # else the houses along a street were taken for walls
            shell |= _outermost(surface, middles, sensors)
        lowest = sensors[:, 2].min()
        flat = np.abs(surface.face_normals[:, 2]) > 0.7
        shell &= ~(flat & (middles[:, 2] < lowest))  # the floor always stays
        shell &= scene.object_bounds[scene.face_object, 1, 2] > lowest  # and so do kerbs
        height = (surface.face_normals * middles).sum(axis=1)
        behind = surface.face_normals @ sensors.T < height[:, None]
        return cls(shell, shell & (behind.mean(axis=1) > 0.5), ceiling)

    def wound(self, corners: NDArray[np.float32]) -> NDArray[np.float32]:
        """Corners (f, 3, 3) of the triangles; anticlockwise from the sensors in the shell."""
        return np.where(self.turned[:, None, None], corners[:, ::-1], corners)


def _ceiling(surface: Surface, sensors: Floats) -> float | None:
    """Height just below the highest ceiling over sensors (p, 3), if most have one."""
    count = 256
    origins, directions = probes(sensors, count, *STEEP_DEG)
    low, high = surface.scene.bounds
    near = TOUCHES * float(np.linalg.norm(high - low))
    distance = surface.caster.cast(origins, directions, t_min=near).distance
    ends = (origins[:, 2] + distance * directions[:, 2]).reshape(-1, count)
    roofed = np.isfinite(ends).mean(axis=1) >= ROOFED
    if roofed.mean() < 0.5:
        return None
    known = np.where(np.isfinite(ends), ends, np.nan)[roofed]
    cuts = np.nanpercentile(known, LOW, axis=1)
    cuts -= BELOW * (cuts - sensors[roofed, 2])
    return float(cuts.max())


def _outermost(surface: Surface, middles: Floats, sensors: Floats) -> Flags:
    """Which triangles, with these middles (f, 3), have nothing behind them for the sensors.

    These are the shell of a closed building, however it is divided into objects.
    """
    apart = np.linalg.norm(middles[:, None] - sensors, axis=2)
    nearest = sensors[apart.argmin(axis=1)]
    onward = middles - nearest
    low, high = surface.scene.bounds
    wall = WALL * float(np.linalg.norm(high - low))
    ask = np.flatnonzero(apart.min(axis=1) > 0)
    rays = unit(onward[ask])
    behind = surface.caster.cast(middles[ask] + wall * rays, rays).distance
    out = np.zeros(len(middles), np.bool_)
    out[ask] = ~np.isfinite(behind)
    return out


@dataclass(frozen=True, eq=False)
class Walls:
    """Where walls are, in cells of a grid, and which way they face.

    Parameters
    ----------
    low
        (3,) lowest corner of the grid, metres.
    cell
        Size of a cell, metres.
    facing
        float32 (i, j, k, 3): unit vectors from the wall to the sensors; 0 where there is none.
    """

    low: Reals
    cell: float
    facing: Reals

    @classmethod
    def of(cls, corners: Reals) -> Walls | None:
        """Enter triangles (f, 3, 3) whose corners run anticlockwise, seen from the sensors.

        None if they have no area.
        """
        a, b, c = corners.transpose(1, 0, 2).astype(np.float64)
        doubled = np.cross(b - a, c - a)
        area = np.linalg.norm(doubled, axis=1)
        if not area.any():
            return None
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        cell = float((high - low).max()) / CELLS
        random = np.random.default_rng(0)
        which = random.choice(len(area), SAMPLES, p=area / area.sum())
        u, v = np.sort(random.random((2, SAMPLES)), axis=0)  # even over each triangle
        places = a[which] * u[:, None] + b[which] * (v - u)[:, None] + c[which] * (1 - v)[:, None]
        # A point lies a little before or behind its wall, which may be in the next cell.
        places += cell * random.uniform(-0.5, 0.5, places.shape)
        shape = np.ceil((high - low) / cell).astype(int) + 3
        facing = np.zeros((*shape, 3), np.float32)
        out = cls((low - cell).astype(np.float32), cell, facing)
        i, j, k = out._cells(places).T
        facing[i, j, k] = doubled[which] / area[which, None]
        return out

    def facing_at(self, positions: Reals) -> Reals:
        """Give for positions (n, 3) which way the wall there faces, (n, 3); 0 where there is none.

        What stands within a cell of a wall counts as part of it.
        """
        cells = self._cells(positions)
        within = ((cells >= 0) & (cells < self.facing.shape[:3])).all(axis=1, keepdims=True)
        i, j, k = np.where(within, cells, 0).T
        return np.asarray(self.facing[i, j, k] * within)

    def _cells(self, places: NDArray[np.floating]) -> NDArray[np.int64]:
        return np.asarray(np.floor((places - self.low) / self.cell).astype(np.int64))


def facing_triangles(positions: Reals, facing: Reals, size_m: float) -> Reals:
    """Small triangles (n, 3, 3) in place of points, to be seen from where they face.

    Parameters
    ----------
    positions
        (n, 3) metres.
    facing
        (n, 3) unit vectors.
    size_m
        Size of a point in metres.
    """
    aside = np.zeros_like(facing)
    aside[np.arange(len(facing)), np.abs(facing).argmin(axis=1)] = 1
    right = np.cross(aside, facing)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(facing, right)
    angles = 2 * np.pi * np.arange(3) / 3
    corners = (
        np.cos(angles)[:, None] * right[:, None] + np.sin(angles)[:, None] * up[:, None]
    )  # anticlockwise, as right, up and facing are right-handed
    middles = positions + APART * size_m * facing
    return np.asarray(middles[:, None] + SIZE * size_m * corners, np.float32)

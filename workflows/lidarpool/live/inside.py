"""How a scene is shown so that one sees what its sensors see, wherever the camera goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Scene
from ..view.cutaway import Shell, enclosed, probes, some_of
from ..view.surface import Surface, unit

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROOFED = 0.7  # of the steep rays from a sensor end in the scene: there is a roof over it
STEEP_DEG = (60.0, 90.0)
LOW = 5  # percentile of a ceiling's heights: lamps and beams are not left hanging
BELOW = 0.04  # of the way from the sensor up to the ceiling, that the cut is below it
TOUCHES = 1e-3  # of the scene's diagonal: a sensor on a surface does not stand under it
WALL = 0.02  # of the scene's diagonal: walls are thinner, roofs with what carries them too


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

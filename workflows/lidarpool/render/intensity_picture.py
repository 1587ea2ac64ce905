"""The picture of ray intensity: a scene coloured by how densely it was hit."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import ArrayLike, NDArray

from ..base.errors import LidarpoolError
from ..scene.scene import Scene
from .captions import facts
from .intensity import checked_counts, hit_density
from .page import Page
from .shot import SIZE, Shot, finite_points, take_shot
from .theme import Theme, mapped, theme_for

Floats = NDArray[np.float64]

MOST_RAYS = 600
WIDEST_RANGE = 300.0  # densest to sparsest colour


def draw_intensity(
    path: str | os.PathLike[str],
    scene: Scene,
    hit_counts: ArrayLike,
    poses: ArrayLike = (),
    sample_rays: ArrayLike = (),
    *,
    shot: Shot | None = None,
    size: tuple[int, int] = SIZE,
    dark: bool = False,
    backend: str = "auto",
) -> Path:
    """Draw a scene coloured by hits per square metre, with the sensors and sample rays.

    Parameters
    ----------
    path, scene, poses, shot, size, dark, backend
        See `draw_scene`.
    hit_counts
        (f,) hits of each triangle.
    sample_rays
        (n, 2, 3) start and end of rays, world coordinates; those that are not finite are left out,
        and of more than 600 an even choice is drawn.

    Raises
    ------
    LidarpoolError
        If there is not one count a triangle, or the file cannot be written.
    """
    sensors = finite_points(poses)
    rays = _rays(sample_rays)
    hits = checked_counts(scene, hit_counts)
    density = hit_density(scene, hits)
    shot = shot or take_shot(scene, sensors, size=size, backend=backend)
    theme = theme_for(dark)
    low, high = density_range(density)
    table = mapped("turbo", np.linspace(0.08, 0.97, 256))
    page = Page(size, theme)
    axes = page.show(
        shot, shot.paint(density_colours(density, hits > 0, (low, high), table, theme), theme, 0.5)
    )
    page.lines(axes, shot, rays - scene.origin, theme.ray, width=0.45, alpha=0.5)
    page.sensors(axes, shot, sensors - scene.origin)
    if density.any():
        page.colour_bar(table, LogNorm(low, high), "hits per square metre")
    else:
        page.note(axes, "no ray hit the scene")
    counted = facts((round(float(hits.sum())), "hit"), (len(sensors), "sensor position"))
    page.title("Ray intensity", f"{counted} · grey: hit by no ray")
    return page.save(path)


def density_range(density: Floats) -> tuple[float, float]:
    """Choose the ends of a logarithmic scale over densities (f,), leaving strays out."""
    hit = density[density > 0]
    low, high = np.percentile(hit, [10, 99.5]) if len(hit) else (1.0, 10.0)
    low = max(low, high / WIDEST_RANGE)
    return float(low), float(max(high, 2 * low))


def density_colours(
    density: Floats,
    hit: NDArray[np.bool_],
    scale: tuple[float, float],
    table: Floats,
    theme: Theme,
) -> Floats:
    """Colours of triangles (f, 3) by density and whether they were hit, both (f,)."""
    low, high = scale
    share = np.log(np.maximum(density, low) / low) / np.log(high / low)
    colours = table[np.clip(share * 255, 0, 255).astype(np.int64)]
    # Shared hits fade out to grey; triangles that were hit themselves are never grey.
    seen = np.where(hit, 1.0, np.clip(density / low / 0.6 - 0.3, 0, 1))[:, None]
    return np.asarray(theme.rgb["unseen"] * (1 - seen) + colours * seen)


def _rays(sample_rays: ArrayLike) -> Floats:
    """Finite rays (n, 2, 3), thinned to what a picture can hold."""
    rays = np.asarray(sample_rays, dtype=np.float64)
    if not rays.size:
        return np.empty((0, 2, 3))
    if rays.shape[1:] != (2, 3):
        raise LidarpoolError(f"Sample rays have shape {rays.shape}; expected (n, 2, 3).")
    rays = rays[np.isfinite(rays).all(axis=(1, 2))]
    return rays[np.linspace(0, len(rays) - 1, min(len(rays), MOST_RAYS)).astype(np.int64)]

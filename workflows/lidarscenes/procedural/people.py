"""Generate persons from about 400 triangles each."""

from __future__ import annotations

import numpy as np

from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes

from .city_kinds import Solid, loft

_SIDES = 10


def pedestrian() -> SceneMesh:
    """Return an adult of 1.75 m in mid-stride, facing x, with the feet at z = 0.

    Examples
    --------
    >>> person = pedestrian()
    >>> person.bounds[:, 2].tolist()
    [0.0, 1.75]
    """
    parts = [
        _tube((0.0, 0.0), 0.19, 0.12, [(0.8, 0.04), (0.95, 0.0), (1.3, 0.0), (1.45, 0.07)]),
        _tube((0.0, 0.0), 0.06, 0.06, [(1.42, 0.0), (1.54, 0.0)]),
        _tube((0.01, 0.0), 0.08, 0.1, [(1.5, 0.03), (1.58, 0.0), (1.68, 0.0), (1.75, 0.05)]),
    ]
    for side in (-1, 1):
        leg = [(0.0, 0.03), (0.08, 0.02), (0.45, 0.02), (0.88, 0.0)]
        arm = [(0.75, 0.02), (1.1, 0.01), (1.42, 0.0)]
        # Feet and hands swing in opposite directions.
        parts.append(_shear(_tube((0.0, 0.1 * side), 0.085, 0.085, leg), 0.2 * side, 0.88))
        parts.append(_shear(_tube((0.0, 0.23 * side), 0.05, 0.05, arm), -0.25 * side, 1.42))
        foot = loft(
            [(-0.1, -0.045), (0.16, -0.045), (0.16, 0.045), (-0.1, 0.045)], [(0, 0), (0.07, 0.01)]
        )
        parts.append(foot.translate(0.2 * side, 0.1 * side))
    return SceneMesh("pedestrian", *stack_meshes(parts))


def _tube(
    center: tuple[float, float],
    half_width: float,
    half_depth: float,
    profile: list[tuple[float, float]],
) -> Solid:
    """Return an elliptical tube with heights and insets as in `loft`."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    outline = np.stack([half_depth * np.cos(angle), half_width * np.sin(angle)], axis=1)
    return loft(outline, profile).translate(*center)


def _shear(solid: Solid, forward_m: float, top_m: float) -> Solid:
    """Move the point at z = 0 forward, and keep the height `top_m` in place."""
    vertices = solid.vertices.copy()
    vertices[:, 0] += forward_m * (1 - vertices[:, 2] / top_m)
    return Solid(vertices, solid.faces)

"""Generate cars that have recessed windows and four wheels, from a few hundred triangles each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes

from .city_kinds import lay_down, loft, regular_polygon

_RECESS_M = 0.03  # depth of a window
_FRAME = 0.12  # width of the frame as a fraction of the window


@dataclass(frozen=True)
class CarModel:
    """The side outline of a car that faces x, from front to back, in meters.

    Each station is (x, half width, height of the beltline, height of the roof). Without a cabin,
    the two heights are nearly equal. Windows are beside and between the stations of the cabin.
    """

    name: str
    stations: tuple[tuple[float, float, float, float], ...]
    glazed: range  # stations that are followed by windows
    axles: tuple[float, float]
    wheel_m: float = 0.33  # wheel radius


MODELS = (
    CarModel(
        "Saloon",
        (
            (2.28, 0.62, 0.6, 0.62), (2.1, 0.82, 0.72, 0.76), (1.0, 0.89, 0.88, 0.94),
            (0.28, 0.9, 0.92, 1.4), (-0.45, 0.9, 0.93, 1.46), (-1.2, 0.9, 0.94, 1.38),
            (-1.75, 0.88, 0.95, 1.02), (-2.2, 0.82, 0.9, 0.96), (-2.32, 0.7, 0.62, 0.64),
        ),
        range(2, 6),
        (1.4, -1.35),
    ),
    CarModel(
        "Estate",
        (
            (2.3, 0.62, 0.6, 0.62), (2.12, 0.83, 0.74, 0.78), (1.05, 0.9, 0.9, 0.96),
            (0.35, 0.91, 0.94, 1.45), (-0.45, 0.91, 0.95, 1.5), (-1.3, 0.91, 0.96, 1.49),
            (-1.95, 0.9, 0.97, 1.42), (-2.3, 0.86, 0.97, 1.02), (-2.4, 0.75, 0.6, 0.62),
        ),
        range(2, 7),
        (1.42, -1.4),
    ),
    CarModel(
        "Panel van",
        (
            (2.48, 0.7, 0.7, 0.72), (2.35, 0.9, 0.95, 1.0), (1.75, 0.96, 1.12, 1.2),
            (1.1, 0.98, 1.15, 1.9), (0.2, 0.98, 1.15, 2.02), (-1.0, 0.98, 1.15, 2.04),
            (-2.4, 0.97, 1.15, 2.0), (-2.48, 0.92, 1.0, 1.86),
        ),
        range(2, 4),
        (1.55, -1.5),
        0.35,
    ),
)  # fmt: skip


def car(model: CarModel) -> SceneMesh:
    """Return a car with its wheels at z = 0, centered at the origin.

    Examples
    --------
    >>> saloon = car(MODELS[0])
    >>> saloon.name, 400 < len(saloon.faces) < 800
    ('Saloon', True)
    """
    wheel = loft(
        regular_polygon(12, model.wheel_m), [(-0.11, 0.03), (-0.08, 0), (0.08, 0), (0.11, 0.03)]
    )
    track = max(half for _, half, _, _ in model.stations) - 0.1
    down = -wheel.vertices[:, 1].min()
    wheels = [lay_down(wheel).translate(x, y, down) for x in model.axles for y in (-track, track)]
    return SceneMesh(model.name, *stack_meshes([_body(model), *wheels]))


def all_cars() -> tuple[SceneMesh, ...]:
    """Return one car for each of `MODELS`."""
    return tuple(car(model) for model in MODELS)


def _body(model: CarModel) -> tuple[Floats, Ints]:
    """Return the vertices and faces of a car's body.

    The body consists of rings with eight corners each, connected by quadrilaterals.
    """
    rings = []
    for x, half, belt, roof in model.stations:
        top = half * (0.74 if roof - belt > 0.2 else 0.86)
        sill = 0.62 * model.wheel_m
        right = [(0.9 * half, sill), (half, 0.55 * belt), (0.97 * half, belt), (top, roof)]
        rings.append([(x, -y, z) for y, z in right] + [(x, y, z) for y, z in right[::-1]])
    ring = np.array(rings)
    quads: list[Floats] = []
    for k in range(len(ring) - 1):
        for side in range(8):
            next_side = (side + 1) % 8
            quad = ring[[k, k + 1, k + 1, k], [next_side, next_side, side, side]]
            # Sides 2 and 4 are above the beltline. Side 3 is the roof or, if it slopes, a
            # windshield.
            slopes = abs(ring[k, 3, 2] - ring[k + 1, 3, 2]) > 0.25
            glass = k in model.glazed and (side in (2, 4) or (side == 3 and slopes))
            quads += _window(quad) if glass else [quad]
    for end, direction in ((ring[0], -1), (ring[-1], 1)):
        quads += [end[[a, b, 7 - b, 7 - a][::direction]] for a, b in ((0, 1), (1, 2), (2, 3))]
    corners = np.array(quads)
    number = np.arange(4 * len(corners)).reshape(-1, 4)
    return corners.reshape(-1, 3), np.concatenate([number[:, :3], number[:, [0, 2, 3]]])


def _window(quad: Floats) -> list[Floats]:
    """Return the quadrilaterals that form a window's pane, recess, and frame."""
    middle = quad.mean(axis=0)
    normal = np.cross(quad[2] - quad[0], quad[3] - quad[1])
    hole = quad + _FRAME * (middle - quad)
    pane = hole - _RECESS_M * normal / np.linalg.norm(normal)
    quads = [pane]
    for k in range(4):
        next_corner = (k + 1) % 4
        quads.append(np.array([quad[k], quad[next_corner], hole[next_corner], hole[k]]))
        quads.append(np.array([hole[k], hole[next_corner], pane[next_corner], pane[k]]))
    return quads

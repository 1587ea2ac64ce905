"""Generate the objects that a vehicle must detect: road users, curbs and traffic cones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import box
from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes

from .cars import MODELS, car
from .city_kinds import Solid, lay_down, loft, regular_polygon
from .people import pedestrian

CHILD_M = 1.1  # height of a five-year-old child
_CURB_M = (4.0, 0.15, 0.15)  # length, width and height
_CONE_M = 0.75  # height
_WHEEL_M = 0.34  # radius of a bicycle wheel
_AXLES_M = (0.53, -0.53)
_TUBE_M = 0.025  # half width of the frame tubes


def child() -> SceneMesh:
    """Return a child that is 1.1 m tall, in mid-stride, facing x, with the feet at z = 0."""
    adult = pedestrian()
    scale = CHILD_M / float(adult.vertices[:, 2].max())
    return replace(adult, name="child", vertices=adult.vertices * scale)


def cyclist() -> SceneMesh:
    """Return a cyclist on a bicycle that faces x, with the wheels at z = 0.

    Examples
    --------
    >>> rider = cyclist()
    >>> np.ptp(rider.bounds, axis=0).round(1).tolist()
    [1.7, 0.6, 1.8]
    """
    wheel = lay_down(loft(regular_polygon(16, _WHEEL_M), [(-0.02, 0.01), (0.02, 0.01)]))
    lift = -float(wheel.vertices[:, 2].min())
    parts = [wheel.translate(x, 0, lift) for x in _AXLES_M]
    saddle, pedals, head = (-0.2, 0, 0.95), (-0.05, 0, 0.3), (0.4, 0, 0.9)
    axles = [(x, 0, lift) for x in _AXLES_M]
    frame = [(axles[1], saddle), (axles[1], pedals), (pedals, saddle), (pedals, head)]
    frame += [(saddle, head), (axles[0], (0.42, 0, 1.0))]
    parts += [_limb(np.array(ends), _TUBE_M) for ends in frame]
    parts.append(_limb(np.array([(0.42, -0.27, 1.02), (0.42, 0.27, 1.02)]), _TUBE_M))
    parts.append(_limb(np.array([(-0.2, 0, 0.95), (0.1, 0, 1.5)]), 0.16))
    skull = loft(regular_polygon(8, 0.1), [(1.5, 0.03), (1.58, 0), (1.68, 0), (1.76, 0.05)])
    parts.append(skull.translate(0.16))
    for side, foot in ((-1, (0.02, 0.14)), (1, (-0.1, 0.45))):
        y = 0.1 * side
        knee = (0.2, y, 0.62 if foot[1] < 0.3 else 0.85)
        parts.append(_limb(np.array([(-0.2, y, 0.95), knee]), 0.07))
        parts.append(_limb(np.array([knee, (foot[0], y, foot[1])]), 0.05))
        parts.append(_limb(np.array([(0.08, 0.18 * side, 1.42), (0.42, 0.24 * side, 1.04)]), 0.04))
    return SceneMesh("cyclist", *stack_meshes(parts))


def curb() -> SceneMesh:
    """Return a curb segment along x that is 4 m long, 0.15 m wide and 0.15 m high."""
    return box("curb", _CURB_M)


def cone() -> SceneMesh:
    """Return a traffic cone that is 0.75 m tall, on a square base."""
    foot = loft(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.2, [(0, 0), (0.03, 0)])
    body = loft(regular_polygon(12, 0.15), [(0.03, 0), (_CONE_M, 0.12)])
    return SceneMesh("cone", *stack_meshes([foot, body]))


def _limb(ends: Floats, half_width: float) -> Solid:
    """Return a square bar between two points. `ends` has shape (2, 3)."""
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    along = along / length
    side = np.cross(along, [0.0, 1.0, 0.0] if abs(along[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    axes = np.stack([np.cross(side, along), side, along])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half_width
    bar = loft(corners, [(0, 0), (length, 0)])
    return Solid(bar.vertices @ axes + ends[0], bar.faces)


# Built-in targets by class. Each mesh faces x and stands on z = 0.
ROAD_USERS: Mapping[str, Callable[[], SceneMesh]] = MappingProxyType(
    {
        "pedestrian": pedestrian,
        "child": child,
        "car": lambda: replace(car(MODELS[0]), name="car"),
        "cyclist": cyclist,
        "curb": curb,
        "cone": cone,
    }
)

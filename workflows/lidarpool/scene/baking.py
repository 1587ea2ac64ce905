"""Meshes of actors that deform, of the objects of a file and their poses; wheels that turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from ..base.arrays import Floats
from ..base.elementary import sin_cos
from ..base.errors import LidarpoolError
from ..base.words import did_you_mean
from .actors import one_mesh
from .animation import Animation
from .scene_instances import SceneInstance
from .scene_mesh import SceneMesh

_TURN = 64  # poses of a wheel: between two of them it is 0.12 % smaller
_ROUND = 0.05  # how much length and height of a wheel may differ


def animated(
    name: str,
    objects: Sequence[SceneMesh | SceneInstance],
    poses: Sequence[Floats],
    played: tuple[float, float | None, bool],
) -> SceneMesh:
    """Join objects to one mesh with an animation; it is solid.

    Parameters
    ----------
    name, objects
        As of `one_mesh`.
    poses
        Vertices (f, v, 3) of each object.
    played
        `step_s`, `speed_m_s` and `repeat` of the `Animation`.
    """
    flat = [one.flat() if isinstance(one, SceneInstance) else one for one in objects]
    solid = [replace(one, cutouts=()) for one in flat]
    whole = one_mesh(name, solid)
    vertices = np.empty((len(poses[0]), *whole.vertices.shape))
    for number, out in enumerate(vertices):
        pairs = zip(solid, poses, strict=True)
        out[:] = one_mesh(name, [replace(o, vertices=own[number]) for o, own in pairs]).vertices
    return replace(whole, vertices=vertices[0], animation=Animation(vertices, *played))


def rolling(
    objects: Sequence[SceneMesh | SceneInstance],
    wheels: Sequence[str],
    tell: Callable[[str], None],
) -> tuple[list[Floats], float]:
    """Turn wheels about their middles, once while an actor drives their circumference.

    They roll along x, about y. Smaller ones turn a whole number of times meanwhile.

    Parameters
    ----------
    objects
        Of a file; the others stay as they are.
    wheels
        Names of the objects that are wheels, with * and ?.
    tell
        Called with a line on wheels that are not round.

    Returns
    -------
    Vertices (f, v, 3) of each object, and metres from each pose to the next.

    Raises
    ------
    LidarpoolError
        If no object has such a name, or none of them is round.
    """
    flat = [one.flat() if isinstance(one, SceneInstance) else one for one in objects]
    radii: dict[int, float] = {}
    for number, one in enumerate(flat):
        if any(fnmatchcase(one.name, wheel) for wheel in wheels):
            length, _, height = np.ptp(one.bounds, axis=0).tolist()
            if abs(length - height) > _ROUND * height:
                tell(
                    f"{one.name} has no axle, and does not turn: it is {length:.3g} m long and "
                    f"{height:.3g} m high, not round about y"
                )
            else:
                radii[number] = height / 2
    if not radii:
        names = [one.name for one in flat]
        hint = did_you_mean(wheels[0], names) or f" There are {', '.join(names[:8])}."
        raise LidarpoolError(f"no object that wheels names ({', '.join(wheels)}) can turn.{hint}")
    largest = max(radii.values())
    turns = [round(largest / radii[k]) if k in radii else 0 for k in range(len(flat))]
    count = _TURN * max(turns) + 1
    poses = []
    for one, own in zip(flat, turns, strict=True):
        middle = one.bounds.mean(axis=0)
        sine, cosine = sin_cos(2 * np.pi * own * np.linspace(0, 1, count))
        x, y, z = (one.vertices - middle).T
        x, z = (
            cosine[:, None] * x + sine[:, None] * z,
            cosine[:, None] * z - sine[:, None] * x,
        )
        poses.append(np.stack([x, np.broadcast_to(y, x.shape), z], axis=2) + middle)
    return poses, 2 * np.pi * largest / (count - 1)

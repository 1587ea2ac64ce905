"""Wheels that turn as a car drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from ..base.elementary import sin_cos
from ..base.errors import LidarError
from ..base.words import did_you_mean
from .animation import Animation
from .scene_instances import SceneInstance
from .scene_mesh import SceneMesh

_TURN = 64  # poses of a wheel: between two of them it is 0.12 % smaller
_TURNS_MOST = 10  # of the smallest one in a turn of the largest: poses of all are kept as often
_ROUND = 0.05  # how much length and height of a wheel may differ


def rolling(
    objects: Sequence[SceneMesh | SceneInstance], wheels: Sequence[str], tell: Callable[[str], None]
) -> list[SceneMesh]:
    """Turn wheels about their middles, once while an actor drives their circumference.

    They roll along x, about y. Smaller ones turn a whole number of times meanwhile.

    Parameters
    ----------
    objects
        Of a file; the others stay as they are.
    wheels
        Names of the objects that are wheels, with * and ?.
    tell
        Called with a line on wheels that are not round, or small beside others.

    Returns
    -------
    The objects, wheels with an animation for 1 m/s.

    Raises
    ------
    LidarError
        If no object has one of the names, or none of them is round.
    """
    flat = [one.flat() if isinstance(one, SceneInstance) else one for one in objects]
    names = [one.name for one in flat]
    for wheel in wheels:
        if not any(fnmatchcase(name, wheel) for name in names):
            hint = did_you_mean(wheel, names) or f" There are {', '.join(names[:5])}."
            raise LidarError(f"wheels names {wheel!r}, but no object has that name.{hint}")
    radii: dict[int, float] = {}
    still: list[str] = []  # notes on wheels that are not round
    for number, one in enumerate(flat):
        if any(fnmatchcase(one.name, wheel) for wheel in wheels):
            length, _, height = np.ptp(one.bounds, axis=0).tolist()
            if abs(length - height) > _ROUND * height or not height:
                still.append(
                    f"{one.name} has no axle, and does not turn: it is {length:.3g} m long and "
                    f"{height:.3g} m high, not round about y"
                )
            else:
                radii[number] = height / 2
    if not radii:
        raise LidarError(f"no object that wheels names can turn: {still[0]}.")
    largest = max(radii.values())
    turns = {number: round(largest / radius) for number, radius in radii.items()}
    for number in [number for number, own in turns.items() if own > _TURNS_MOST]:
        smaller = f"{turns.pop(number)} times smaller than the largest"
        still.append(f"{flat[number].name} is {smaller}, and does not turn")
    for line in still:
        tell(line)
    count = _TURN * max(turns.values())
    for number, own in turns.items():
        middle = flat[number].bounds.mean(axis=0)
        sine, cosine = np.array(sin_cos(2 * np.pi * own * np.linspace(0, 1, count + 1)))[..., None]
        x, y, z = (flat[number].vertices - middle).T
        poses = np.stack([cosine * x + sine * z, y + 0 * sine, cosine * z - sine * x], axis=2)
        animation = Animation(poses + middle, 2 * np.pi * largest / count, 1.0)
        flat[number] = replace(flat[number], cutouts=(), animation=animation)
    return flat

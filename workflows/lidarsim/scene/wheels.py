"""Wheels that rotate while a vehicle moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from ..numerics.elementary import sin_cos
from ..words import name_hint
from .animation import Animation
from .scene_instances import SceneInstance
from .scene_mesh import SceneMesh

_POSES_PER_REVOLUTION = 64  # linear interpolation between poses shrinks a wheel by up to 0.12 %
# Maximum revolutions of a wheel per revolution of the largest wheel. All wheels have the same
# number of poses, so fast wheels increase the number of poses of the other wheels.
_MAX_REVOLUTIONS = 10
_ROUNDNESS = 0.05  # maximum difference between length and height, relative to the height


def animate_wheels(
    objects: Sequence[SceneMesh | SceneInstance],
    wheels: Sequence[str],
    report: Callable[[str], None],
) -> list[SceneMesh]:
    """Animate wheels that roll along x and rotate about y around their centers.

    The largest wheels make one revolution while the actor travels the length of their
    circumference. In the same time, smaller wheels make a whole number of revolutions.

    Parameters
    ----------
    objects
        Objects of a scene file. Objects that are not wheels do not change.
    wheels
        Names of the wheels, which can contain the wildcards * and ?.
    report
        Called with a message for each wheel that is not round or is too small compared to other
        wheels.

    Returns
    -------
    list[SceneMesh]
        All objects. Wheels have an animation for a speed of 1 m/s.

    Raises
    ------
    LidarError
        If no object matches one of the names, or if none of the matching objects is round.
    """
    meshes = [item.flat() if isinstance(item, SceneInstance) else item for item in objects]
    _check_names(wheels, [mesh.name for mesh in meshes])
    radii, notes = _radii(meshes, wheels)
    if not radii:
        raise LidarError(f"no object in wheels can rotate: {notes[0]}.")
    largest = max(radii.values())
    revolutions = {index: round(largest / radius) for index, radius in radii.items()}
    for index in [index for index, count in revolutions.items() if count > _MAX_REVOLUTIONS]:
        smaller = f"{revolutions.pop(index)} times smaller than the largest wheel"
        notes.append(f"{meshes[index].name} is {smaller} and does not rotate")
    for line in notes:
        report(line)
    steps = _POSES_PER_REVOLUTION * max(revolutions.values())
    step_s = 2 * np.pi * largest / steps
    for index, count in revolutions.items():
        vertices = _rotated_vertices(meshes[index], count, steps)
        animation = Animation(vertices, step_s, 1.0)
        meshes[index] = replace(meshes[index], cutouts=(), animation=animation)
    return meshes


def _check_names(wheels: Sequence[str], names: Sequence[str]) -> None:
    """Raise LidarError if a pattern in `wheels` does not match the name of any object."""
    for wheel in wheels:
        if not any(name == wheel or fnmatchcase(name, wheel) for name in names):
            raise LidarError(
                f"wheels contains {wheel!r}, but no object has that name.{name_hint(wheel, names)}"
            )


def _radii(
    meshes: Sequence[SceneMesh], wheels: Sequence[str]
) -> tuple[dict[int, float], list[str]]:
    """Return the radii of round wheels, keyed by mesh index, and messages about other wheels.

    The radii are in meters.
    """
    radii: dict[int, float] = {}
    notes: list[str] = []
    for index, mesh in enumerate(meshes):
        if any(mesh.name == wheel or fnmatchcase(mesh.name, wheel) for wheel in wheels):
            length, _, height = np.ptp(mesh.bounds, axis=0).tolist()
            if abs(length - height) > _ROUNDNESS * height or not height:
                notes.append(
                    f"{mesh.name} is not round about its y axis ({length:.3g} m long, "
                    f"{height:.3g} m high) and does not rotate"
                )
            else:
                radii[index] = height / 2
    return radii, notes


def _rotated_vertices(mesh: SceneMesh, revolutions: int, steps: int) -> Floats:
    """Return the vertices of a mesh at each step of a rotation about its center.

    The axis is parallel to y. The shape is (steps + 1, v, 3).
    """
    middle = mesh.bounds.mean(axis=0)
    angles = 2 * np.pi * revolutions * np.linspace(0, 1, steps + 1)
    sine, cosine = np.array(sin_cos(angles))[..., None]
    x, y, z = (mesh.vertices - middle).T
    poses = np.stack([cosine * x + sine * z, y + 0 * sine, cosine * z - sine * x], axis=2)
    return np.asarray(poses + middle)

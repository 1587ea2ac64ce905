"""The place of a scene in the coordinate system that a scenario states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.files.coordinate_systems import outside_system, target_problem, zone_in_area
from lidarsim.scene.scene import Scene

# Coordinates of the files and `world.origin` are the same place, given twice, if both are this far
# from zero, and differ by less than this share. Local coordinates are near zero.
_FAR_M = 50_000.0
_SAME_SHARE = 0.2
_PROJECTED_M = 100_000.0


def check_epsg(epsg: int, scene: Scene) -> None:
    """Check that a coordinate system is in meters that are true where a scene is.

    Raises
    ------
    LidarError
        If lengths in the system are wrong by more than 1 % in the middle of the scene, or not in
        meters. Without rasterio, only systems for maps of the world are refused.
    """
    x, y = _middle(scene).tolist()
    problem = target_problem(
        epsg, x, y, why_there=", where the scene is (`world.origin` moves the scene)"
    )
    if problem and outside_system(epsg, x, y):
        raise LidarError(place_problem(scene, epsg))
    if problem:
        raise LidarError(f"`world.epsg` (`epsg` in Python) is {problem}.")


def place_problem(scene: Scene, epsg: int | None) -> str:
    """Return a warning of a scene that is likely not where its world coordinates say, or "".

    It is likely elsewhere if it is far outside the area of use of the coordinate system, or if
    `world.origin` was added to coordinates that are world coordinates already.

    Parameters
    ----------
    scene
        The scene at its place in the world.
    epsg
        EPSG code of the coordinate system, or None if none is stated.
    """
    x, y = _middle(scene).tolist()
    if epsg is not None and (area := outside_system(epsg, x, y)):
        return f"The scene is at x {x:,.0f}, y {y:,.0f}, outside {area}. {_remedies(epsg, scene)}"
    if _is_added_twice(scene):
        origin = _in_words(scene.world_origin)
        in_files = _in_words(_middle(scene) - scene.world_origin[:2])
        return (
            f"`world.origin` ({origin}) is added to the coordinates of the scene's files, "
            f"although these coordinates are already close to it ({in_files}). If they are world "
            "coordinates, remove `world.origin`."
        )
    return ""


def missing_system(scene: Scene, epsg: int | None) -> str:
    """Return a note on a scene in projected coordinates of which the system is not stated, or "".

    `scene` is at its place in the world. Coordinates of 100 km and more are likely projected.
    """
    middle = _middle(scene)
    if epsg is not None or np.linalg.norm(middle) < _PROJECTED_M:
        return ""
    return (
        f"the scene is at {_in_words(middle)}, which are probably projected coordinates, but no "
        "coordinate system is set. Files such as LAS and LAZ will therefore not state one. Set "
        "`world: {epsg: CODE}` in the scenario"
    )


def _middle(scene: Scene) -> Floats:
    """Return x and y of the middle of a scene, (2,), world meters."""
    middle: Floats = (scene.bounds.mean(axis=0) + scene.origin)[:2]
    return middle


def _is_added_twice(scene: Scene) -> bool:
    """Return whether the coordinates of the files are near `world.origin`, and far from zero."""
    origin = scene.world_origin[:2]
    in_files = _middle(scene) - origin
    distance_m = float(np.linalg.norm(origin))
    return distance_m > _FAR_M and bool(
        np.linalg.norm(in_files - origin) < _SAME_SHARE * distance_m
    )


def _remedies(epsg: int, scene: Scene) -> str:
    """Return sentences on what to change for a scene outside the area of use of its system."""
    placed = _middle(scene)
    in_files = placed - scene.world_origin[:2]
    zone = zone_in_area(epsg, *placed.tolist())
    example = "" if zone is None else f", such as EPSG:{zone}, in which they are inside this area"
    other_system = f"set `world.epsg` to the system of these coordinates{example}"
    if (placed != in_files).any():
        fits = "" if outside_system(epsg, *in_files.tolist()) else ", which moves it inside"
        return (
            f"If the files of the scene have world coordinates, remove `world.origin`{fits}. "
            f"Otherwise, {other_system}."
        )
    return (
        f"If the files of the scene have world coordinates, {other_system}. If they have local "
        "coordinates, set `world.origin` to the world coordinates of their origin."
    )


def _in_words(place: Sequence[float] | Floats) -> str:
    """Return x and y in words."""
    return f"x {place[0]:,.0f}, y {place[1]:,.0f}"

"""Check the location of a scene in the coordinate system of a scenario."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.files.coordinate_systems import (
    includes_offset,
    outside_system,
    target_problem,
    zone_in_area,
)
from lidarsim.scene.scene import Scene

_PROJECTED_M = 100_000.0  # coordinates this far from zero are probably projected


def check_epsg(epsg: int, scene: Scene) -> None:
    """Raise LidarError unless a coordinate system is in true meters at the scene's location.

    Raises
    ------
    LidarError
        If the unit of the system is not the meter, or if lengths at the center of the scene are
        wrong by more than 1 %. If rasterio is not installed, only systems for world maps are
        rejected.
    """
    x, y = _center(scene).tolist()
    problem = target_problem(
        epsg, x, y, why_there=", where the scene is (`world.origin` moves the scene)"
    )
    if problem and outside_system(epsg, x, y):
        raise LidarError(location_warning(scene, epsg))
    if problem:
        raise LidarError(f"`world.epsg` (`epsg` in Python) is {problem}.")


def location_warning(scene: Scene, epsg: int | None) -> str:
    """Return a warning if a scene is probably in the wrong location, or an empty string.

    The location is probably wrong if it is far outside the area of use of the coordinate system, or
    if `world.origin` was added to coordinates that are already world coordinates.

    Parameters
    ----------
    scene
        The scene in world coordinates.
    epsg
        EPSG code of the coordinate system, or None if it is unknown.
    """
    x, y = _center(scene).tolist()
    if epsg is not None and (area := outside_system(epsg, x, y)):
        return f"The scene is at x {x:,.0f}, y {y:,.0f}, outside {area}. {_remedies(epsg, scene)}"
    if _is_added_twice(scene):
        origin = _format_xy(scene.world_origin)
        in_files = _format_xy(_center(scene) - scene.world_origin[:2])
        return (
            f"`world.origin` ({origin}) is added to the coordinates of the scene's files, "
            f"although these coordinates are already close to it ({in_files}). If they are world "
            "coordinates, remove `world.origin`."
        )
    return ""


def missing_epsg_note(scene: Scene, epsg: int | None) -> str:
    """Return a note if projected coordinates have no coordinate system, or an empty string.

    Otherwise, return an empty string. `scene` is in world coordinates. Coordinates of 100 km and
    more are probably projected.
    """
    center = _center(scene)
    if epsg is not None or np.linalg.norm(center) < _PROJECTED_M:
        return ""
    return (
        f"the scene is at {_format_xy(center)}, which are probably projected coordinates, but no "
        "coordinate system is set. Files such as LAS and LAZ will therefore not state one. Set "
        "`world: {epsg: CODE}` in the scenario"
    )


def _center(scene: Scene) -> Floats:
    """Return the horizontal center of a scene in world coordinates."""
    center: Floats = (scene.bounds.mean(axis=0) + scene.origin)[:2]
    return center


def _is_added_twice(scene: Scene) -> bool:
    """Return whether the coordinates in the files probably include `world.origin` already."""
    origin = scene.world_origin[:2]
    return includes_offset(_center(scene) - origin, origin)


def _remedies(epsg: int, scene: Scene) -> str:
    """Return advice for a scene outside the area of use of its coordinate system."""
    placed = _center(scene)
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


def _format_xy(position: Sequence[float] | Floats) -> str:
    return f"x {position[0]:,.0f}, y {position[1]:,.0f}"

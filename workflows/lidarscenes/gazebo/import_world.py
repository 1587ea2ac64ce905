"""Worlds of Gazebo as scenarios: a sensor for each lidar, on one carrier that stands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from lidarsim.base.errors import LidarError, explained, unreadable
from lidarsim.base.input_files import read_input
from lidarsim.scene.files.scene_graph import MeshFileError

from ..writers.lidar_scenario import write_scenario
from .frames import numbers_of
from .lidars import lidars_of
from .world import World, load_world


def import_world(world: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a world as a scenario into a folder: `scenario.yaml`, and a data file of each lidar.

    Parameters
    ----------
    world
        A .sdf or .world file with lidars.
    folder
        The folder, which exists.
    assets
        Folders in which models are looked for first.

    Returns
    -------
    What is not as in Gazebo, a line each.

    Raises
    ------
    LidarError
        If the world cannot be read, or has no lidar.
    """
    if len(assets) > 1:
        raise LidarError("it is of Gazebo: give one folder, --assets DIR.")
    loaded = _loaded(world, assets)
    lidars = [*lidars_of(loaded)]
    if not lidars:
        raise LidarError(
            f"it has no lidar (gpu_lidar, gpu_ray, lidar, ray): lidarpool init --mesh "
            f"{world.name} makes a scenario for a sensor of yours."
        )
    entry = {"file": world, **({"assets": assets[0]} if assets else {})}
    return write_scenario(folder, "Gazebo", entry, lidars, _materials(loaded))


def _loaded(world: Path, assets: Sequence[Path]) -> World:
    """Return a world; LidarError if the file cannot be read."""
    with explained("it cannot be read"):
        data = read_input(world)
    try:
        return load_world(data, world, (world.parent.resolve(), *(f.resolve() for f in assets)))
    except MeshFileError as error:
        raise LidarError(f"it {error}.") from error
    except ValueError as error:
        raise LidarError(unreadable("it", error)) from error


def _materials(world: World) -> dict[str, Any]:
    """Return the section of materials, for shapes with a <laser_retro>."""
    if not any(_has_retro(link.link.element) for link in world.links):
        return {}
    return {"materials": [{"objects": "*", "reflectance": "texture"}]}


def _has_retro(link: Element) -> bool:
    """Return True if a shape of a link has a <laser_retro> above 0."""
    shapes = [*link.findall("visual"), *link.findall("collision")]
    return any(numbers_of(shape, "laser_retro", 1, "0").item() > 0 for shape in shapes)

"""Convert Gazebo worlds to scenarios. Each lidar becomes a sensor on a stationary platform."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from glob import escape
from itertools import compress
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, explain_os_errors, unreadable_message
from lidarsim.io.input_files import read_input
from lidarsim.scene.files.scene_graph import MeshFileError, ReadOptions
from lidarsim.scene.object_names import unique_names
from lidarsim.words import printable

from ..writers.lidar_scenario import write_scenario
from .frames import child_numbers
from .lidars import find_lidars, unknown_sensors
from .visibility_flags import ALL_BITS, read_flags
from .world import GazeboOptions, GazeboWorld, build_content, load_world


def import_world(world: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a world as a scenario, which is a `scenario.yaml` file and a data file for each lidar.

    Parameters
    ----------
    world
        A .sdf or .world file with lidars.
    folder
        Existing output folder.
    assets
        Folders that are searched first for models.

    Returns
    -------
    Differences from Gazebo, one line each.

    Raises
    ------
    LidarError
        If the world cannot be read or has no lidar.
    """
    if len(assets) > 1:
        raise LidarError("it is a Gazebo world, for which only one `--assets` folder is allowed.")
    loaded = _loaded(world, assets)
    lidars = [*find_lidars(loaded)]
    unsupported = [*loaded.notes.remote_lines(), *unknown_sensors(loaded)]
    if not lidars:
        reason = "".join(f" It contains {line}." for line in loaded.notes.remote_lines())
        reason += "".join(f" {line}" for line in unknown_sensors(loaded))
        raise LidarError(
            "it contains no sensor of type gpu_lidar, gpu_ray, lidar or ray. To use another "
            f"sensor, create a scenario with `lidarpool init --mesh {world.name}`.{reason}"
        )
    entry = {"file": world, **({"assets": assets[0]} if assets else {})}
    unseen = _unseen_objects(loaded, [lidar.mask for lidar in lidars], _folders(world, assets))
    seeing = [lidar.lidar._replace(unseen=tuple(unseen.get(lidar.mask, ()))) for lidar in lidars]
    return write_scenario(folder, "Gazebo", entry, seeing, _materials(loaded), unsupported)


def _unseen_objects(
    world: GazeboWorld, masks: Sequence[int], folders: tuple[Path, ...]
) -> dict[int, list[str]]:
    """Return name patterns for the objects that lidars do not see, by <visibility_mask>.

    The names are those in the scene. The meshes of the world are read only if a lidar does not see
    one of the visuals.
    """
    visuals = [shape for link in world.links for shape in link.link.element.findall("visual")]
    # Visuals with flags of 0 are invisible to all lidars, and never part of the scene.
    flags = {read_flags(visual) for visual in visuals} - {0}
    if all(mask and all(mask & value for value in flags) for mask in masks):
        return {}
    options = ReadOptions(masks=False, colors=False, folders=folders, own=GazeboOptions())
    with np.errstate(all="ignore"):
        content, placed = build_content(world, options)
    # The content has the same order, but lacks objects without an area.
    rest = iter(placed)
    objects = [item.name for item in content.meshes]
    flags_of_objects = [
        next(item.flags for item in rest if item.node.name == name) for name in objects
    ]
    moving = [part.name for part in content.moving]
    names = unique_names([printable(name) for name in (*objects, *moving)])
    flags_of_objects += [ALL_BITS] * len(moving)
    return {
        mask: _patterns(names, [not flags & mask for flags in flags_of_objects])
        for mask in {*masks}
    }


def _patterns(names: Sequence[str], is_unseen: Sequence[bool]) -> list[str]:
    """Return patterns that match the names of unseen objects and no others.

    If a model has several objects that are all unseen, the pattern is MODEL/*.
    """
    if all(is_unseen):
        return ["*"]
    models = [name.partition("/")[0] for name in names]
    counts = Counter(models)
    unseen_counts = Counter(compress(models, is_unseen))
    patterns: dict[str, None] = {}
    for name, model in compress(zip(names, models, strict=True), is_unseen):
        is_whole = 1 < counts[model] == unseen_counts[model]
        patterns[f"{escape(model)}/*" if is_whole else escape(name)] = None
    return [*patterns]


def _folders(world: Path, assets: Sequence[Path]) -> tuple[Path, ...]:
    """Return the folders that may contain files of a world, starting with its own folder."""
    return world.parent.resolve(), *(folder.resolve() for folder in assets)


def _loaded(world: Path, assets: Sequence[Path]) -> GazeboWorld:
    """Load the world that is to be converted.

    Raises LidarError if the file cannot be read.
    """
    with explain_os_errors("it cannot be read"):
        data = read_input(world)
    try:
        return load_world(data, world, _folders(world, assets))
    except MeshFileError as error:
        raise LidarError(f"it {error}.") from error
    except ValueError as error:
        raise LidarError(unreadable_message("it", error)) from error


def _materials(world: GazeboWorld) -> dict[str, Any]:
    """Return a `materials` section if any shape has a <laser_retro>, otherwise no section."""
    if not any(_has_retro(link.link.element) for link in world.links):
        return {}
    return {"materials": [{"objects": "*", "reflectance": "texture"}]}


def _has_retro(link: Element) -> bool:
    """Return True if any shape of a link has a positive <laser_retro>."""
    shapes = [*link.findall("visual"), *link.findall("collision")]
    return any(child_numbers(shape, "laser_retro", 1, "0").item() > 0 for shape in shapes)

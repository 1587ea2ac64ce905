"""Meshes of objects that are inserted into recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarscenes.procedural.cars import MODELS, car
from lidarscenes.procedural.people import pedestrian
from lidarsim.errors import LidarError
from lidarsim.io.input_files import not_found
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.mesh_formats import endings, format_of
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.vocabulary import INSERTIONS
from lidarsim.words import did_you_mean


def load_insertion(shape: str | Path, report: Callable[[str], None] = lambda _: None) -> SceneMesh:
    """Return the mesh of an inserted object, whose lowest point is at z = 0.

    Parameters
    ----------
    shape
        Name of a built-in mesh, "car" or "pedestrian", or a mesh file in which x is forward. All
        objects in the file are joined.
    report
        Function that is called with notes about the file.

    Raises
    ------
    LidarError
        If `shape` is not a built-in mesh, or if the file does not exist or cannot be read.
    """
    if str(shape) == "car":
        return replace(car(MODELS[0]), name="car")
    if str(shape) == "pedestrian":
        return pedestrian()
    path = Path(shape)
    if not path.exists():
        if path.suffix and format_of(path):
            raise LidarError(not_found(path))
        names = ", ".join(INSERTIONS)
        raise LidarError(
            f"There is no object {str(shape)!r} to insert.{did_you_mean(str(shape), INSERTIONS)} "
            f"Specify {names} or a mesh file ({' '.join(endings())})."
        )
    objects = load_objects(path, report=report, axes=report)
    mesh = join_meshes(path.stem, objects.at_start(lambda line: report(f"{path} moves {line}")))
    lowest_m = float(mesh.vertices[:, 2].min())
    return replace(mesh, vertices=mesh.vertices - np.array([0.0, 0.0, lowest_m]))

"""Toy files (.toy), lines of x, y and z of corners of triangles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from lidarsim.base.declared import about
from lidarsim.base.validation import checked_fields
from lidarsim.scene.files.scene_graph import Content, ReadOptions
from lidarsim.scene.scene_mesh import SceneMesh


@dataclass(frozen=True)
@checked_fields
class ToyOptions:
    """Options of toy files."""

    lift_m: Annotated[float, about("of a toy (.toy): height to lift it by, metres", le=9)] = 0.0


def read_toy(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the triangles of a file as an object."""
    own: ToyOptions = options.own
    corners = np.array(data.split(), np.float64).reshape(-1, 3)
    corners[:, 2] += own.lift_m
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Content([SceneMesh(path.stem, corners, faces)], unit_m=1.0, up_axis="z")

"""Read MuJoCo models (MJCF) as scenes, with the geoms that a lidar sees in the initial state.

MuJoCo itself (Apache-2.0) reads the files in a separate process (see `model_child.py`). Geoms are
converted to meshes as in `lidarsim.worlds.MujocoScanner`.
"""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError
from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.files.scene_graph import (
    MAX_NODES,
    Content,
    MeshFileError,
    ObjectFrame,
    PlacedNode,
    ReadOptions,
    placed_content,
)
from lidarsim.scene.masks import MaskNotes
from lidarsim.scene.object_names import unique_names
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import affine
from lidarsim.schema.declared import Several, Text, about
from lidarsim.words import list_names, name_hint, printable
from lidarsim.worlds.mujoco_bodies import (
    BodySelection,
    create_bodies,
    describe_soft_bodies,
    find_excluded,
    names_of,
    visible_geoms,
)
from lidarsim.worlds.mujoco_geoms import GeomType
from lidarsim.worlds.shape_meshes import SAG_M, count_segments

from ..files.child_process import ReaderProcess
from .model_sources import check_sources

MUJOCO_BYTES = 512 * 2**20  # memory that MuJoCo needs for any file
_ADVICE = "simplify its meshes, or divide the model"
# Half the side of planes without a size: a minimum in meters, and a multiple of the model's size.
_MIN_PLANE_M = 200.0
_PLANE_SIZES = 5.0
_MAX_ROUND_TRIANGLES = 4_000_000  # total for spheres, ellipsoids, capsules, and cylinders
_MAX_SAG_M = 1.0


@dataclass(frozen=True)
class MujocoOptions:
    """Options for reading MuJoCo models."""

    keyframe: Annotated[
        Text | None,
        about("keyframe that determines the poses of the bodies (MuJoCo models only)", "home"),
    ] = None
    groups: Annotated[
        Several[Annotated[int, Field(ge=0, le=5)]],
        about("geom groups that are read (MuJoCo models only)"),
    ] = (0, 1, 2)
    exclude: Annotated[
        Several[Text], about("bodies and geoms that are not read (MuJoCo models only)")
    ] = ()


def read_mjcf(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a model's geoms in their initial state, with one object for each body.

    Named geoms of the world body are separate objects.
    """
    model = load_model(data, path, options)
    content = placed_content(_placed(model, options))
    content.unit_m = 1.0
    content.up_axis = "z"
    content.notes = _notes(model, options)
    if not content.meshes and not content.skipped:
        groups = tuple(options.own.groups)
        raise MeshFileError(
            f"contains nothing that a lidar can detect in the groups {groups}. Select other "
            "groups with `groups`"
        )
    return content


def load_model(data: bytes, path: Path, options: ReadOptions) -> SimpleNamespace:
    """Return the arrays of a model and its initial state, by their MuJoCo names.

    Raises
    ------
    ValueError
        If MuJoCo refuses the model.
    LidarError, MeshFileError
        If MuJoCo is not installed, or the file is not a model or needs too much memory.
    """
    allowance = Allowance(0, _ADVICE)
    check_sources(data, path, options, allowance)
    if find_spec("mujoco") is None:
        command = install_command("mujoco")
        raise MeshFileError(
            f"is a MuJoCo model, which requires the package mujoco. Install it with `{command}`"
        )
    if sys.platform == "win32":  # memory limits of processes are not supported
        raise MeshFileError("is a MuJoCo model, which is not supported on Windows")
    request = {"keyframe": options.own.keyframe, "colors": options.colors}
    with TemporaryDirectory() as folder:
        child = ReaderProcess(
            Path(__file__).with_name("model_child.py"),
            "MuJoCo",
            allowance.limit + MUJOCO_BYTES,
            Path(folder),  # MuJoCo writes a log file to it
            hidden=("MUJOCO_",),
        )
        frames = child.frames(path, request, lambda _, size: allowance.reserve(size))
        with closing(frames):
            frame, arrays = next(frames)
    if frame["what"] == "keyframes":
        keyframe = str(options.own.keyframe)
        hint = name_hint(keyframe, frame["names"])
        raise LidarError(f"the model has no keyframe {keyframe!r}.{hint}")
    fields = dict(zip(frame.pop("names"), arrays, strict=True))
    if not options.colors:  # the pixels of textures were not read
        fields["mat_texid"] = np.full_like(fields["mat_texid"], -1)
    return SimpleNamespace(**frame, **fields)


def body_object_names(model: Any, options: ReadOptions) -> dict[int, str]:
    """Return the name of the scene object for each body of a model.

    Bodies without an object, and the world body, are missing.
    """
    bodies, geoms = find_excluded(model, options.own.exclude)
    seen = visible_geoms(model, _choice(model, options.own, bodies, geoms))
    content = placed_content(_placed(model, options))
    names = [printable(item.name) for item in content.meshes]
    # If names repeat, the last object belongs to the body, because geoms of the world come first.
    unique = dict(zip(names, unique_names(names), strict=True))
    body_names = [printable(name) for name in names_of(model, "body")]
    with_geoms = {int(body) for body in np.asarray(model.geom_bodyid)[seen]} - {0}
    return {body: unique[body_names[body]] for body in with_geoms if body_names[body] in unique}


def _placed(model: Any, options: ReadOptions) -> list[PlacedNode]:
    """Return the meshes of all bodies, placed at their poses in the initial state."""
    bodies, geoms = find_excluded(model, options.own.exclude)
    choice = _choice(model, options.own, bodies, geoms)
    named = _named_geoms_of_world(model)
    others = np.arange(1, len(model.body_parentid)).tolist()
    unnamed = sorted({*range(len(model.geom_type))} - {*named})
    world = choice._replace(
        objects="geom",
        excluded_bodies=[*bodies, *others],
        excluded_geoms=[*geoms, *unnamed],
    )
    inner = choice._replace(excluded_geoms=[*geoms, *named])
    meshes: dict[int, SceneMesh] = {}  # {id of the triangles: mesh}
    nodes = []
    for part in (world, inner):
        parts = create_bodies(model, part)
        nodes += [
            PlacedNode(
                _stripped(mesh, options),
                np.eye(4),
                mesh.name,
                frame=ObjectFrame(np.eye(4), is_static=True),
            )
            for mesh in parts.static
        ]
        for body, mesh in parts.moving:
            shared = meshes.setdefault(id(mesh.faces), _stripped(mesh, options))
            matrix = body_matrix(model, body)
            frame = ObjectFrame(matrix, is_static=False)
            nodes.append(PlacedNode(shared, matrix, mesh.name, frame=frame))
    return nodes


def _choice(
    model: Any, options: MujocoOptions, bodies: list[int], geoms: list[int]
) -> BodySelection:
    """Select the visible parts of a model.

    Raises MeshFileError if there are too many geoms.
    """
    plane_m = max(_MIN_PLANE_M, _PLANE_SIZES * min(model.extent_m, 1e6))
    choice = BodySelection(options.groups, bodies, geoms, "body", plane_m=plane_m)
    seen = np.array(visible_geoms(model, choice), np.int64)
    if len(seen) > MAX_NODES:
        raise MeshFileError(
            f"has {len(seen):,} geoms, and the limit is {MAX_NODES:,}. Split the model"
        )
    return choice._replace(sag_m=_sag_m(model, seen))


def _sag_m(model: Any, geoms: Ints) -> float:
    """Return the sag for round geoms in meters. It is larger if there are many of them."""
    kinds = np.column_stack([model.geom_type[geoms], model.geom_size[geoms]])
    shapes, counts = np.unique(kinds, axis=0, return_counts=True)
    sag_m = SAG_M
    while sag_m < _MAX_SAG_M:
        triangles = (
            int(count) * _round_triangles(int(shape[0]), shape[1:], sag_m)
            for shape, count in zip(shapes, counts, strict=True)
        )
        if sum(triangles) <= _MAX_ROUND_TRIANGLES:
            break
        sag_m *= 2
    return sag_m


def _round_triangles(kind: int, size: Floats, sag_m: float) -> int:
    """Return a round geom's number of triangles, or 0 for other geoms."""
    match kind:
        case GeomType.SPHERE | GeomType.CAPSULE | GeomType.ELLIPSOID:
            radius = float(size.max() if kind == GeomType.ELLIPSOID else size[0])
            return count_segments(radius, sag_m) ** 2
        case GeomType.CYLINDER:
            return 4 * count_segments(float(size[0]), sag_m)
    return 0


def _named_geoms_of_world(model: Any) -> list[int]:
    """Return the indices of the world body's named geoms."""
    names = names_of(model, "geom")
    return [
        geom
        for geom in np.flatnonzero(np.asarray(model.geom_bodyid) == 0).tolist()
        if names[geom] != f"geom {geom}"
    ]


def body_matrix(model: Any, body: int) -> Floats:
    """Return the 4 x 4 matrix that transforms from a body frame to the world."""
    return affine(model.xmat[body].reshape(3, 3), model.xpos[body])


def _stripped(mesh: SceneMesh, options: ReadOptions) -> SceneMesh:
    """Remove colors and materials from a mesh if they are not requested."""
    return replace(
        mesh,
        colors=mesh.colors if options.colors else None,
        materials=mesh.materials if options.materials else None,
    )


def _notes(model: Any, options: ReadOptions) -> list[str]:
    """Return notes on content that was not read, as clauses that can follow the file name."""
    notes = (
        [f"contains soft bodies, which were skipped: {soft}"]
        if (soft := describe_soft_bodies(model))
        else []
    )
    if model.warnings:
        notes.append(
            f"causes warnings in MuJoCo: {list_names([text.strip() for text in model.warnings], 3)}"
        )
    if not options.masks:
        return notes
    transparent = MaskNotes()
    opacity = np.asarray(model.mat_rgba).reshape(-1, 4)[:, 3]
    names = names_of(model, "mat")
    for material in np.unique(model.geom_matid).tolist():
        if material >= 0 and 0 < opacity[material] < 1:
            transparent.glass[names[material]] = None
    return notes + transparent.lines()

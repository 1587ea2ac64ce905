"""Mesh files: .glb .gltf .obj .stl .ply .off .dae .3mf, to named meshes in metres, Z-up."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from .dae import read_dae
from .errors import LidarpoolError
from .mesh import Mesh
from .meshguard import find_fault
from .threemf import placed_objects
from .transform import UNITS_M, UP_AXES, Transform

SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".off", ".dae", ".3mf")
UNITLESS = (".obj", ".stl", ".ply", ".off")  # that cannot say in which unit their numbers are

# By the 3MF core specification, 3.4.
_3MF_UNITS_M = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "millimeters": 1e-3,  # what trimesh says where the file says nothing
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}


def load_meshes(
    path: str | Path,
    *,
    unit: str | None = None,
    up_axis: str | None = None,
    transform: Transform | None = None,
) -> tuple[Mesh, ...]:
    """Read all objects of a mesh file.

    Every instance of a scene graph is a mesh of its own, named by its node; files without
    names give one object named by the file.

    Parameters
    ----------
    path
        One of `SUFFIXES`, whatever the case.
    unit
        One of `UNITS_M`; None takes the file's own (.dae, .3mf, .glb and .gltf), else metres.
    up_axis
        'x', 'y' or 'z'; None takes the file's own (.dae), the standard's (Y-up for .glb and
        .gltf, Z-up for .3mf), else Z-up.
    transform
        Placement in the world, in metres, after unit and up axis.

    Returns
    -------
    Meshes in world coordinates. All arithmetic is in double precision; formats that store
    single precision (.glb, .gltf, binary .stl) are only as good as what they hold.

    Raises
    ------
    LidarpoolError
        If the file cannot be read whole, or there are no triangles in it.
    """
    path = Path(path)
    if unit is not None and unit not in UNITS_M:
        raise LidarpoolError(f"unit is {unit!r}; it must be one of {', '.join(UNITS_M)}.")
    if up_axis is not None and up_axis not in UP_AXES:
        raise LidarpoolError(f"up_axis is {up_axis!r}; it must be x, y or z.")
    data = _bytes_of(path)
    try:
        fault = find_fault(path, data)
        meshes, own_unit_m, own_axis = ([], None, None) if fault else _read(path, data)
    except MemoryError:
        raise
    except LidarpoolError as error:
        raise LidarpoolError(f"{path}: {error}") from error
    except Exception as error:
        # The readers raise whatever they stumble over: ValueError, IndexError, KeyError,
        # AssertionError, BadZipFile, XMLSyntaxError, DaeError, NotImplementedError, …
        reason = re.sub(r"\s+", " ", str(error)).strip()[:200] or type(error).__name__
        raise LidarpoolError(
            f"{path} is broken or cut short ({reason}): export it again."
        ) from error
    if fault:
        raise LidarpoolError(f"{path} {fault}.")
    if not meshes:
        raise LidarpoolError(
            f"{path} holds no triangles: it is empty, cut short, or not a {path.suffix} file."
        )
    unit_m = UNITS_M[unit] if unit else own_unit_m or 1.0
    upright = Transform(UP_AXES[up_axis or own_axis or "z"] * unit_m, np.zeros(3))
    placed = [_moved(mesh, upright) for mesh in meshes]
    return tuple(_moved(mesh, transform) for mesh in placed) if transform else tuple(placed)


def _bytes_of(path: Path) -> bytes:
    """Check that `path` is a readable file of a known kind, and read it."""
    if not path.exists():
        raise LidarpoolError(f"{path} does not exist: check the name and the folder.")
    if not path.is_file():
        raise LidarpoolError(f"{path} is not a file: give a mesh file ({' '.join(SUFFIXES)}).")
    if path.suffix.lower() not in SUFFIXES:
        raise LidarpoolError(
            f"{path} has the ending {path.suffix or '(none)'}, which is not a mesh format that "
            f"can be read; these are: {' '.join(SUFFIXES)}."
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be read: {error.strerror}.") from error
    if not data:
        raise LidarpoolError(f"{path} is empty (0 bytes): export the mesh again.")
    return data


def _read(path: Path, data: bytes) -> tuple[list[Mesh], float | None, str | None]:
    """Meshes in the file's own unit and axes; metres in its unit and its up axis, if stated."""
    suffix = path.suffix.lower()
    if suffix == ".dae":
        return read_dae(path)
    options: dict[str, Any] = {}
    if suffix in (".glb", ".gltf", ".obj", ".ply"):
        options["skip_materials"] = True  # nor are their pictures looked for
    if suffix == ".obj":
        # Objects are split by name ('o', or 'g' where there is no 'o'), never by material.
        named = re.search(rb"^o\s", data, re.MULTILINE) is not None
        options |= {"split_objects": True, "split_groups": not named, "group_material": False}
    scene = trimesh.load_scene(str(path), file_type=suffix[1:], process=False, **options)
    meshes = _objects(scene, path)
    if suffix in (".glb", ".gltf"):
        return meshes, 1.0, "y"
    if suffix == ".3mf":
        _check_complete(scene, placed_objects(data))
        stated = {mesh.metadata.get("units") for mesh in scene.geometry.values()}
        unknown = stated - set(_3MF_UNITS_M)
        if unknown:
            raise ValueError(f"unknown unit {', '.join(map(repr, unknown))}")
        return meshes, _3MF_UNITS_M[stated.pop()] if stated else None, "z"
    return meshes, None, None


def _check_complete(scene: trimesh.Scene, placed: int | None) -> None:
    found = len(scene.graph.nodes_geometry)
    if placed is not None and placed != found:
        raise LidarpoolError(
            f"{found:,} of the {placed:,} objects that it places can be read: export it without "
            "nested components and repeated part numbers, or as .glb."
        )


def _objects(scene: trimesh.Scene, path: Path) -> list[Mesh]:
    """One mesh for each node with triangles, nodes' transforms applied."""
    parts: dict[str, list[Mesh]] = {}  # {node of the object: its primitives}
    for node in scene.graph.nodes_geometry:
        matrix, key = scene.graph[node]
        geometry = scene.geometry[key]
        faces = np.asarray(getattr(geometry, "faces", ()), dtype=np.int64).reshape(-1, 3)
        if not len(faces):
            continue  # lines or points, which reflect no light
        owner = str(node)
        if geometry.metadata.get("from_gltf_primitive"):
            # A glTF mesh of several materials comes as one node for each, with random names,
            # under the node that the file names.
            owner = str(scene.graph.transforms.parents[node])
        name = _object_name(owner, str(key), geometry, path)
        mesh = Mesh(name, geometry.vertices, faces)
        parts.setdefault(owner, []).append(_moved(mesh, Transform.from_matrix(matrix)))
    # The readers of .glb, .gltf and .obj give the last object first.
    owners = list(parts)
    if path.suffix.lower() in (".glb", ".gltf", ".obj"):
        owners.reverse()
    return [_joined(parts[owner]) for owner in owners]


def _object_name(owner: str, key: str, geometry: Any, path: Path) -> str:
    """Name of the object that belongs to node `owner`, `key` being its geometry's name."""
    suffix = path.suffix.lower()
    if suffix in (".stl", ".ply", ".off"):
        return str(geometry.metadata.get("name") or path.stem)
    if suffix == ".obj" and key == path.name:
        return path.stem
    # A number is what the glTF reader calls a node without a name.
    return key if owner.isdigit() else owner


def _joined(parts: list[Mesh]) -> Mesh:
    """One mesh of several."""
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        parts[0].name,
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + at for part, at in zip(parts, first, strict=True)]),
    )


def _moved(mesh: Mesh, transform: Transform) -> Mesh:
    """Mesh with its vertices transformed, its faces still facing outward."""
    faces = mesh.faces[:, ::-1] if transform.mirrors else mesh.faces
    return Mesh(mesh.name, transform.apply(mesh.vertices), faces)

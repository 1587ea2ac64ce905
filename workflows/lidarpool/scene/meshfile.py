"""Mesh files: .glb .gltf .obj .stl .ply .off .dae .3mf, to named meshes in metres, Z-up."""

from __future__ import annotations

import codecs
import errno
import io
import json
import logging
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import LidarpoolError
from ..base.words import did_you_mean
from .gltf_buffers import buffers_beside
from .mesh import Mesh
from .meshfault import MeshFileError
from .meshguard import binary_stl_size, find_fault, gltf_fault, gltf_header
from .objfile import read_obj
from .offfile import read_off
from .plymesh import read_ply_mesh
from .threemf import placed_objects
from .transform import UNITS_M, UP_AXES, Transform

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".off", ".dae", ".3mf")
UNITLESS = (".obj", ".stl", ".ply", ".off")  # that cannot say in which unit their numbers are

# Nothing on Earth is farther from the origin of its map; see also `sections.Coordinate`.
FARTHEST_M = 1e8
_LETTERS = 200  # of a name, or of what a reader says

# What trimesh logs of files goes to those who listen, instead of to the terminal with a traceback.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

# {ending: reader} of the formats whose faces are polygons.
_POLYGONS = {".obj": read_obj, ".ply": read_ply_mesh, ".off": read_off}

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
    with np.errstate(all="ignore"):  # of broken numbers in files; what is not finite is refused
        meshes, own_unit_m, own_axis = _read_whole(path, data)
        unit_m = UNITS_M[unit] if unit else own_unit_m or 1.0
        upright = Transform(UP_AXES[up_axis or own_axis or "z"] * unit_m, np.zeros(3))
        try:
            return tuple(_placed(mesh, path.stem, upright, transform) for mesh in meshes)
        except LidarpoolError as error:
            raise LidarpoolError(f"{path}: {error}") from error


def _read_whole(path: Path, data: bytes) -> tuple[list[Mesh], float | None, str | None]:
    """As `_read`, whatever the file is: at least one mesh, or LidarpoolError."""
    try:
        if fault := find_fault(path, data):
            raise MeshFileError(fault)
        meshes, own_unit_m, own_axis = _read(path, data)
    except MemoryError:
        raise
    except MeshFileError as refused:
        raise LidarpoolError(f"{path} {refused}.") from refused
    except LidarpoolError as error:
        raise LidarpoolError(f"{path}: {error}") from error
    except Exception as error:
        # The readers raise whatever they stumble over: ValueError, IndexError, KeyError,
        # AssertionError, BadZipFile, XMLSyntaxError, DaeError, NotImplementedError, …
        reason = _printable(str(error)) or type(error).__name__
        raise LidarpoolError(
            f"{path} is broken or cut short ({reason}): export it again."
        ) from error
    if not meshes:
        raise LidarpoolError(
            f"{path} holds no triangles: it is empty, cut short, or not a {path.suffix} file."
        )
    return meshes, own_unit_m, own_axis


def _bytes_of(path: Path) -> bytes:
    """Check that `path` is a readable file of a known kind, and read it."""
    try:
        kind = path.stat().st_mode
    except OSError as error:
        if error.errno == errno.ENOENT and path.is_symlink():
            raise LidarpoolError(
                f"{path} is a link to {path.readlink()}, which does not exist: mend the link, or "
                "give the file itself."
            ) from error
        if error.errno in (errno.ENOENT, errno.ENOTDIR):
            raise LidarpoolError(
                f"{path} does not exist: check the name and the folder.{_like(path)}"
            ) from error
        raise LidarpoolError(f"{path} cannot be read: {error.strerror}.") from error
    except ValueError as error:  # a zero in the name
        raise LidarpoolError(f"{path} is not the name of a file: {error}.") from error
    if not stat.S_ISREG(kind):
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
    return data.removeprefix(codecs.BOM_UTF8)  # which editors put before text


def _like(path: Path) -> str:
    """Mesh file beside a name that is not there, whose name is much the same."""
    try:
        beside = [other.name for other in path.parent.iterdir()]
    except OSError:
        return ""
    return did_you_mean(path.name, [name for name in beside if name.lower().endswith(SUFFIXES)])


def _read(path: Path, data: bytes) -> tuple[list[Mesh], float | None, str | None]:
    """Meshes in the file's own unit and axes; metres in its unit and its up axis, if stated."""
    suffix = path.suffix.lower()
    if suffix in _POLYGONS:
        return _POLYGONS[suffix](data, path.stem), None, None
    if suffix == ".dae":
        from .dae import read_dae

        return read_dae(io.BytesIO(data))
    if suffix in (".glb", ".gltf"):
        return _read_gltf(path, data), 1.0, "y"
    if suffix == ".3mf":
        return _read_3mf(path, data)
    # A few bytes behind the last triangle are more than trimesh expects.
    scene = _trimesh_scene(data[: binary_stl_size(data)], suffix)
    return _objects(scene, path), None, None


def _trimesh_scene(data: bytes, suffix: str, **options: Any) -> trimesh.Scene:
    import trimesh  # not above: half a second that workers, who read no files, do without

    return trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], process=False, **options)


def _read_gltf(path: Path, data: bytes) -> list[Mesh]:
    """Meshes of a .glb or .gltf file."""
    suffix = path.suffix.lower()
    header = gltf_header(path, data)
    buffers = buffers_beside(header, path)
    if fault := gltf_fault(header, len(data) + sum(map(len, buffers.values()))):
        raise MeshFileError(fault)
    if suffix == ".gltf":
        data = json.dumps(header).encode()
    # Neither materials nor their pictures are looked for, and no other file is opened.
    scene = _trimesh_scene(data, suffix, resolver=buffers, skip_materials=True)
    return _objects(scene, path)


def _read_3mf(path: Path, data: bytes) -> tuple[list[Mesh], float | None, str | None]:
    """As `_read`, for .3mf files."""
    scene = _trimesh_scene(data, ".3mf")
    _check_complete(scene, placed_objects(data))
    stated = {mesh.metadata.get("units") for mesh in scene.geometry.values()}
    unknown = stated - set(_3MF_UNITS_M)
    if unknown:
        raise ValueError(f"unknown unit {', '.join(map(repr, unknown))}")
    return _objects(scene, path), _3MF_UNITS_M[stated.pop()] if stated else None, "z"


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
    # The reader of .glb and .gltf gives the last object first.
    owners = list(parts)
    if path.suffix.lower() in (".glb", ".gltf"):
        owners.reverse()
    return [_joined(parts[owner]) for owner in owners]


def _object_name(owner: str, key: str, geometry: Any, path: Path) -> str:
    """Name of the object that belongs to node `owner`, `key` being its geometry's name."""
    if path.suffix.lower() == ".stl":
        name = str(geometry.metadata.get("name") or path.stem)
        # What trimesh calls a solid without a name.
        return path.stem if re.fullmatch(r"geometry_\d+", name) else name
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


def _placed(mesh: Mesh, stem: str, upright: Transform, transform: Transform | None) -> Mesh:
    """Mesh in the world, its name fit for terminals and files."""
    mesh = _moved(mesh, upright)
    if transform is not None:
        mesh = _moved(mesh, transform)
    reach = np.abs(mesh.vertices).max()
    if reach > FARTHEST_M:
        raise LidarpoolError(
            f"Object {mesh.name!r} reaches {reach:.3g} m from the origin, farther than anything "
            "on Earth: check its unit and where it is placed."
        )
    return Mesh(_printable(mesh.name) or _printable(stem), mesh.vertices, mesh.faces)


def _printable(text: str) -> str:
    """Text from a file on one line of bounded length, without codes that a terminal obeys."""
    kept = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(kept.split())[:_LETTERS]


def _moved(mesh: Mesh, transform: Transform) -> Mesh:
    """Mesh with its vertices transformed, its faces still facing outward."""
    faces = mesh.faces[:, ::-1] if transform.mirrors else mesh.faces
    return Mesh(mesh.name, transform.apply(mesh.vertices), faces)

"""Write scenes as mesh files."""

from __future__ import annotations

import os
from itertools import groupby
from pathlib import Path

import numpy as np

from lidarsim.errors import LidarError, MissingFileError, explain_os_errors
from lidarsim.io.storage import replace_file
from lidarsim.scene.files.meshfile import FORMAT_COMMENT
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import stack_meshes
from lidarsim.scene.simplified import SimplifiedScene

from .glb_file import encode_glb

SUFFIXES = (".ply", ".glb", ".obj")


def write_scene(path: str | Path, scene: Scene) -> Path:
    """Write a scene to a mesh file in a format that `Scene.load` can read.

    A .ply file stores one object without a name, while .glb and .obj store all objects with their
    names. Only .glb stores masks and colors. In .ply and .obj, triangles are opaque and gray. If a
    triangle has both a mask and a texture, its color is the mean of the texture. All formats store
    world coordinates in meters. A .glb file is Y-up, as its standard requires, and .ply and .obj
    files are Z-up. Coordinates in .ply and .glb have single precision. In .glb, they are relative
    to the scene's origin. `Scene.epsg` and `Scene.vertical_datum` are preserved. A comment, or the
    generator in .glb, identifies this package as the writer of the file for `load_meshes`. An
    existing file is replaced only once the new file is complete.

    Raises
    ------
    LidarError
        If the path has another extension, the folder is missing or not writable, the disk is full,
        or the precision of a .ply file is insufficient for a scene far from the origin.
    """
    path = Path(path)
    check_target(path)
    data = _encoded(path.suffix.lower(), scene)
    with explain_os_errors(f"{path} cannot be written"):
        replace_file(path, data)
    return path


def check_target(path: Path) -> None:
    """Check that a scene can be written to a path. Call this before generating the scene.

    Raises
    ------
    LidarError
        If the extension is not one of `SUFFIXES`, or the folder is missing or not writable.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise LidarError(
            f"{path} has the extension {path.suffix or '(none)'}. Scenes can be written as "
            f"{', '.join(SUFFIXES)}."
        )
    if not path.parent.is_dir():
        raise MissingFileError(f"The folder {path.parent} does not exist. Create it first.")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise LidarError(f"{path} cannot be written. Choose another path.")


def _encoded(suffix: str, scene: Scene) -> bytes:
    """Return a scene as the content of a file with the given extension in `SUFFIXES`."""
    import trimesh
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.ply import export_ply

    if scene.has_voxels.any():
        name = scene.object_names[scene.has_voxels.argmax()]
        raise LidarError(
            f"{name!r} consists of voxels, which cannot be written. Use its .vox file instead."
        )
    if suffix == ".ply":
        if scene.origin.any():
            step = np.spacing(np.float32(np.abs(scene.origin).max()))
            x, y, _ = scene.origin
            raise LidarError(
                "A .ply file stores coordinates in single precision, which limits their resolution "
                f"to {step:.2g} m at x {x:.0f}, y {y:.0f}. Write a .glb or .obj file instead."
            )
        drawn = SimplifiedScene.from_scene(scene, scene.triangles).scene
        joined = trimesh.Trimesh(drawn.vertices + drawn.origin, drawn.faces, process=False)
        data = bytes(export_ply(joined, vertex_normal=False))
        head, _, tail = data.partition(b"\ncomment ")
        comments = "".join(f"\ncomment {line}" for line in _comments(scene))
        return head + f"{comments}\n".encode() + tail.partition(b"\n")[2]
    if suffix == ".glb":
        return encode_glb(scene)
    objects = trimesh.Scene()
    for name, parts in groupby(scene.meshes(), lambda mesh: mesh.name):
        flat = [part.flat() if isinstance(part, SceneInstance) else part for part in parts]
        vertices, faces = stack_meshes((mesh.vertices, mesh.faces) for mesh in flat)
        objects.add_geometry(trimesh.Trimesh(vertices, faces, process=False), name, name)
    text = export_obj(objects, include_normals=False, include_texture=False)
    comments = "".join(f"# {line}\n" for line in _comments(scene))
    return f"{comments}{text}".encode()


def _comments(scene: Scene) -> list[str]:
    """Return the comments at the start of a file, on units, axes, and the coordinate system."""
    comments = [FORMAT_COMMENT]
    comments += [] if scene.epsg is None else [f"crs: EPSG:{scene.epsg}"]
    datum = scene.vertical_datum.encode("ascii", "replace").decode()
    return comments + ([f"vertical datum: {datum}"] if datum else [])

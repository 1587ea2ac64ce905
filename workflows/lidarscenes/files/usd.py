"""Read OpenUSD scenes (.usd, .usda, .usdc, .usdz) with usd-core (Pixar, license TOST-1.0).

`usd_child.py` reads the scenes in a separate process, and explains why. usd-core resolves
references to other files, but content from outside the scene's folder is refused.
`usd_materials.py` reads masks and colors.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.environment.extras import install_command
from lidarsim.io.allowance import Allowance, memory_share
from lidarsim.numerics.arrays import AnyArray
from lidarsim.numerics.vectors import inverse, matmul
from lidarsim.scene.actors import box
from lidarsim.scene.animation import RATE_HZ
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.companions import outside_message
from lidarsim.scene.files.gltf_animation import find_animation
from lidarsim.scene.files.polygons import triangulate
from lidarsim.scene.files.scene_graph import (
    MAX_NODES,
    SHORTER,
    SMALLER,
    Content,
    MeshFileError,
    Node,
    Piece,
    PlacedNode,
    ReadOptions,
    RigidPart,
    bake_animation,
    join_pieces,
    placed_content,
    placed_nodes,
)
from lidarsim.scene.scene_instances import SceneInstance, polar_scales
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import capsule, cylinder, revolve
from lidarsim.scene.transform import UP_AXES
from lidarsim.words import plural

from .child_process import Frame, ReaderProcess
from .usd_materials import MeshAppearance, UsdMaterials, material_pieces

_LIMITS = {
    "prims and instances": MAX_NODES,
    "poses of moving objects": 1_000_000,
    "moving objects": 10_000,
}
USD_CORE_BYTES = 512 * 2**20  # memory that usd-core needs for any file
_LATEST_S = 9e8
_SEGMENTS = 64  # sides of spheres, cylinders, cones, and capsules


def read_usd(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read all prims that are visible at the first time, including motions or an animation."""
    if find_spec("pxr") is None:
        command = install_command("lidarpool[usd]")
        raise MeshFileError(
            f"is an OpenUSD file, which requires usd-core. Install it with `{command}`"
        )
    if sys.platform == "win32":  # memory limits of processes are not supported
        raise MeshFileError(
            "is an OpenUSD file, which is not supported on Windows. Export it as .glb"
        )
    # All files share an allowance.
    allowance = Allowance(0, SMALLER if options.animation is None else SHORTER)
    with closing(_frames(path, options, allowance)) as frames:
        stage, _ = next(frames)
        contents = _contents(frames, stage, path.stem, options, allowance)
        if options.animation is None:
            return next(contents)
        find_animation(stage["animations"], options.animation)
        return bake_animation(contents, stage["times_s"], allowance)


def _contents(
    frames: Iterator[Frame],
    stage: dict[str, Any],
    stem: str,
    options: ReadOptions,
    allowance: Allowance,
) -> Iterator[Content]:
    """Yield the content for each pose of an animation, or only for the first time."""
    materials = UsdMaterials(allowance, options)
    meshes: dict[int, list[SceneMesh]] = {}
    for frame, arrays in frames:
        match frame["what"]:
            case "image" | "material":
                materials.add_frame(frame, arrays)
            case "mesh":
                meshes[frame["number"]] = _polygon_mesh(frame, arrays, allowance, materials)
            case "shape":
                meshes[frame["number"]] = _shape_mesh(frame, arrays, materials)
            case "nodes":
                content = _content(stage | frame, arrays, meshes, stem, allowance)
                content.notes += materials.notes.lines()
                yield _with_notes(content, stage, frame["counts"])
                materials.colored = False  # all poses use the colors of the first one


def _frames(path: Path, options: ReadOptions, allowance: Allowance) -> Generator[Frame]:
    """Read a file in a separate process, and yield the frames that it writes."""

    def take(frame: dict[str, Any], size: int) -> None:
        """Count an array's size toward the memory limit.

        Images also raise the limit for the content.
        """
        if frame["what"] == "image":
            allowance.grow(size)
        allowance.reserve(size)

    child = ReaderProcess(
        Path(__file__).with_name("usd_child.py"),
        "usd-core",
        memory_share() + USD_CORE_BYTES,
        path.parent,
        hidden=("PXR_",),  # the user's plug-ins and search paths would change the scene
        # If the memory limit prevents a thread from starting, usd-core waits for it until the time
        # limit. Using a single thread takes a sixth longer for 100 layers.
        environment={"PXR_WORK_THREAD_LIMIT": "1"},
    )
    request = options._asdict() | {"most": _LIMITS, "rate_hz": RATE_HZ}
    with closing(child.frames(path, request, take)) as frames:
        for frame, arrays in frames:
            if frame["what"] == "too many":
                limit = f"{_LIMITS[frame['of']]:,} {frame['of']}"
                raise MeshFileError(f"has more than {limit}. Export it in parts")
            for file in map(Path, frame.get("files", ())):
                if not (options.allows(file) or file.samefile(path)):
                    raise MeshFileError(
                        outside_message(os.path.relpath(file, path.resolve().parent))
                    )
                allowance.add_file(file)
            yield frame, arrays


def _polygon_mesh(
    frame: dict[str, Any], arrays: list[AnyArray], allowance: Allowance, materials: UsdMaterials
) -> list[SceneMesh]:
    """Return polygons as a list with one mesh, or an empty list if there are no triangles."""
    name = frame["name"]
    allowance.reserve(24 * len(arrays[2]) + 4 * 8 * len(arrays[1]))
    sizes, corners, points, holes = arrays[:4]
    sizes = sizes.astype(np.int64)
    corners = corners.astype(np.int64)
    if (sizes < 0).any() or sizes.sum() != len(corners):
        raise ValueError(
            f"{name!r} declares polygons with {sizes.sum():,} corners but contains {len(corners):,}"
        )
    solid = np.ones(len(sizes), bool)
    solid[holes[(holes >= 0) & (holes < len(sizes))]] = False
    vertices = points.reshape(-1, 3).astype(np.float64)
    try:
        if "materials" in frame:
            allowance.reserve(15 * 8 * len(corners))
            pieces = material_pieces(frame, arrays, vertices, (sizes, corners, solid), materials)
        else:
            outlines = corners[np.repeat(solid, sizes)]
            pieces = iter([Piece(vertices, triangulate(vertices, outlines, sizes[solid]))])
        return join_pieces(name, pieces, allowance)
    except ValueError as error:
        raise ValueError(f"{name!r}: {error}") from error


def _shape_mesh(
    frame: dict[str, Any], arrays: list[AnyArray], materials: UsdMaterials
) -> list[SceneMesh]:
    """Return a primitive shape as a list with one mesh, or an empty list if its size is zero."""
    mesh = _plain_shape(frame)
    if mesh is None or "materials" not in frame:
        return [mesh] if mesh else []
    rows = np.arange(len(mesh.faces))
    look = MeshAppearance(frame, arrays, {"constant": np.zeros((len(rows), 3), np.int64)})
    number = next((number for number, _ in frame["materials"]), None)
    # Shapes lack texture coordinates and therefore have no masks. This call only adds a note.
    materials.cutout(number, look, rows)
    named = FaceMaterials.from_name(materials.name(number))
    return [replace(mesh, colors=materials.colors(number, look, rows), materials=named)]


def _plain_shape(frame: dict[str, Any]) -> SceneMesh | None:
    """Return a primitive shape without materials, or None if one of its sizes is zero."""
    name = frame["name"]
    kind = frame["kind"]
    size = frame["sizes"]
    axis = "XYZ".index(size.get("axis", "Z"))
    if min(value for value in size.values() if not isinstance(value, str)) <= 0:
        return None
    if kind == "Cube":
        edge = size["size"]
        return box(name, (edge, edge, edge)).affine_transform(
            name, np.eye(3), np.array([0, 0, -edge / 2])
        )
    if kind == "Plane":
        sides = ("width", "length") if axis == 2 else ("length", "width")
        x, y = (size[side] / 2 for side in sides)
        corners = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)])
        mesh = SceneMesh(name, corners, np.array([(0, 1, 2), (0, 2, 3)]))
    elif kind == "Cone":
        half = size["height"] / 2
        mesh = revolve([(0, -half), (size["radius"], -half), (0, half)], _SEGMENTS, name)
    else:
        shape = cylinder if kind == "Cylinder" else capsule
        mesh = shape(size["radius"], size.get("height", 0), _SEGMENTS, name)
    # Shapes are created along z. Permute the axes to match the stated axis.
    return SceneMesh(name, np.roll(mesh.vertices, axis + 1, axis=1), mesh.faces)


def _content(
    frame: dict[str, Any],
    arrays: list[AnyArray],
    meshes: dict[int, list[SceneMesh]],
    stem: str,
    allowance: Allowance,
) -> Content:
    """Place the meshes as the nodes of a scene specify."""
    moving = frame["moving"]
    matrices = arrays[0].copy()
    motions = arrays[1 : 1 + len(moving)]
    copies = arrays[1 + len(moving) :]
    nodes = frame["nodes"]

    def node(key: Any) -> Node:
        if isinstance(key, tuple):
            copied, array, row = key
            if row is not None:
                return Node("", copies[array][row], (), [copied])
            name, mesh, *_ = nodes[copied]
            return Node(name, np.eye(4), meshes[mesh], (), matmul(copies[array], matrices[copied]))
        name, mesh, children, instanced = nodes[key]
        for copied, array in instanced:
            inner = nodes[copied]
            alone = inner[1] is not None and not (inner[2] or inner[3])  # only a mesh
            rows = [None] if alone else range(len(copies[array]))
            children += [(copied, array, row) for row in rows]
        return Node(name, matrices[key], meshes.get(mesh, ()), children)

    placed = _with_distinct_names(placed_nodes(frame["roots"], node, stem))
    content = placed_content(placed, copy_all=len(frame["times_s"]) > 1)
    for number, motion in zip(moving, motions, strict=True):
        # The scale is applied to the mesh, because actors cannot be scaled.
        matrices[number] = np.eye(4)
        scale = matrices[number, :3, :3]
        poses = motion[:, 1:].reshape(-1, 3, 4)
        scale[:] = polar_scales(poses[:1, :, :3])[0]
        part = placed_content(placed_nodes([number], node, stem))
        content.skipped += part.skipped
        if part.meshes:
            shared = [item.mesh for item in part.meshes if isinstance(item, SceneInstance)]
            # Actors cannot have instances, so their triangles are copied.
            allowance.reserve(sum(80 * len(mesh.faces) for mesh in shared))
            rotations = matmul(poses[:, :, :3], inverse(scale))
            times = (motion[:, 0] - frame["start"]) / frame["rate_hz"]
            if not (np.abs(times) < _LATEST_S).all():
                raise ValueError("its times are not finite, or span more than 30 years")
            content.moving.append(
                RigidPart(nodes[number][0], part.meshes, times, poses[:, :, 3], rotations)
            )
    return content


def _with_distinct_names(nodes: list[PlacedNode]) -> list[PlacedNode]:
    """Give distinct names to nodes whose prims have the same name.

    The new name is that of an enclosing prim that contains no other prim with the shared name. The
    least frequent such name is chosen, or the innermost of several. For example, a chess set has
    many prims called "Render" in prims called "Geom", each in a "King" or "Queen". If the enclosing
    prim contains other meshes, the names are joined, as in "King/Render".
    """
    # Copies of a node share a path.
    paths = {node.path for node in nodes if node.path}
    uses = Counter(path[-1] for path in paths)
    mesh_counts: Counter[Any] = Counter()  # {prim, or prim and name: meshes in the prim}
    for path in paths:
        for depth in range(1, len(path)):
            mesh_counts.update([path[:depth], (path[:depth], path[-1])])
    outer_paths = {
        path: [path[:depth] for depth in range(len(path) - 1, 0, -1)]
        for path in paths
        if uses[path[-1]] > 1
    }
    candidates = {
        path: [prim for prim in outer if mesh_counts[prim, path[-1]] == 1]
        for path, outer in outer_paths.items()
    }
    rarity = Counter((path[-1], prim[-1]) for path, prims in candidates.items() for prim in prims)
    names = {}
    for path, prims in candidates.items():
        best = min(prims, key=lambda prim: rarity[path[-1], prim[-1]], default=None)
        if best and rarity[path[-1], best[-1]] < uses[path[-1]]:
            names[path] = best[-1] if mesh_counts[best] == 1 else f"{best[-1]}/{path[-1]}"
    return [node._replace(name=names.get(node.path, node.name)) for node in nodes]


def _with_notes(content: Content, stage: dict[str, Any], counts: dict[str, int]) -> Content:
    """Set the unit and up axis of scene content, and add notes on what is not read."""
    content.unit_m = stage["unit_m"]
    content.up_axis = stage["up_axis"]
    if not 0 < stage["unit_m"] < np.inf:
        raise ValueError(f"the unit is {stage['unit_m']} meters, but it must be a positive number")
    if stage["up_axis"] not in UP_AXES:
        raise ValueError(f"the value of upAxis is {stage['up_axis'][:20]!r}, which is not an axis")
    content.rotation_note = "as the file states" if stage["up_stated"] else "the OpenUSD default"
    if not stage["unit_stated"]:
        content.unit_note = (
            "does not specify a length unit. Centimeters, the OpenUSD default, are assumed"
        )
    notes = content.notes
    notes += _notes(stage, counts)
    if notes and not (content.meshes or content.moving):
        raise MeshFileError(f"contains no triangles. It {notes[0]}")
    return content


def _notes(stage: dict[str, Any], counts: dict[str, int]) -> Iterator[str]:
    """Yield notes on content that is not read, given prim counts by kind."""
    moving, skinned, smooth = (counts.pop(k, 0) for k in ("moving", "skinned", "subdivided"))
    if stage["materialx"]:
        yield (
            "uses materials in MaterialX files, which usd-core does not support. These "
            "materials were skipped"
        )
    if names := [name[-80:] for name in stage["missing"]]:
        listed = ", ".join(map(repr, names[:3])) + ", …" * (len(names) > 3)
        yield f"refers to content that is missing or cannot be read, which was skipped: {listed}"
    if counts:
        listed = ", ".join(f"{n} {kind}" for kind, n in counts.items())
        yield f"contains prims that were skipped: {listed}"
    if moving:
        yield (
            f"contains {plural(moving, 'object')} with unsupported motion, such as deformation or "
            "moving instances. The first frame is used"
        )
    if stage["animations"] and len(stage["times_s"]) == 1:
        yield (
            "contains animated skeletons, which are treated as static. To animate an actor, set "
            "animation: NAME"
        )
    if skinned:
        bent = plural(skinned, "mesh", "meshes")
        yield (
            f"contains {bent} deformed by skeletons in instances, which is not supported. The "
            "undeformed shape is used"
        )
    if smooth:
        yield (
            f"contains {plural(smooth, 'subdivision mesh', 'subdivision meshes')}. Subdivision "
            "is not supported, so the coarse mesh is used"
        )

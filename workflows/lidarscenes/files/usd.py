"""OpenUSD scenes, .usd .usda .usdc .usdz, through usd-core (Pixar, licence TOST-1.0).

`usd_child.py` reads them in a process of its own, and says why. References to other files are
resolved by usd-core; content from outside the scene's folder is refused. `usd_materials.py` has
masks and colours.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.base.allowance import Allowance, bytes_of, memory_share
from lidarsim.base.arrays import AnyArray
from lidarsim.base.vectors import inverse, matmul
from lidarsim.base.words import plural
from lidarsim.scene.actors import box
from lidarsim.scene.animation import RATE_HZ
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.companions import outside
from lidarsim.scene.files.gltf_animation import find_animation
from lidarsim.scene.files.polygons import triangulated
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
from lidarsim.scene.scene_instances import SceneInstance, scale_of
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import capsule, cylinder, revolve
from lidarsim.scene.transform import UP_AXES

from .usd_materials import Look, UsdMaterials, dressed

_MOST = {"prims and copies": MAX_NODES, "poses of what moves": 1_000_000, "moving objects": 10_000}
_BASE = 512 * 2**20  # bytes that usd-core takes for any file
_LATEST_S = 9e8
_SEGMENTS = 64  # around spheres, cylinders, cones and capsules

_Frame = tuple[dict[str, Any], list[AnyArray]]


def read_usd(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read all prims of a scene that are shown, at its first time, and how they move."""
    if find_spec("pxr") is None:
        raise MeshFileError('is OpenUSD, which usd-core reads: pip install "lidarpool[usd]"')
    if sys.platform == "win32":  # which has no limits of memory for a process
        raise MeshFileError("is OpenUSD, which is not read on Windows: export it as .glb")
    allowance = Allowance(0, SMALLER if wanted.animation is None else SHORTER)  # of all its files
    with closing(_frames(path, wanted, allowance)) as frames:
        stage, _ = next(frames)
        contents = _contents(frames, stage, path.stem, wanted, allowance)
        if wanted.animation is None:
            return next(contents)
        find_animation(stage["animations"], wanted.animation)
        return bake_animation(contents, stage["times_s"], allowance)


def _contents(
    frames: Iterator[_Frame],
    stage: dict[str, Any],
    stem: str,
    wanted: ReadOptions,
    allowance: Allowance,
) -> Iterator[Content]:
    """Yield the content of each pose."""
    materials = UsdMaterials(allowance, wanted)
    meshes: dict[int, list[SceneMesh]] = {}
    for frame, arrays in frames:
        match frame["what"]:
            case "image" | "material":
                materials.add(frame, arrays)
            case "mesh":
                meshes[frame["number"]] = _mesh(frame, arrays, allowance, materials)
            case "shape":
                meshes[frame["number"]] = _shape(frame, arrays, materials)
            case "nodes":
                content = _content(stage | frame, arrays, meshes, stem, allowance)
                content.notes += materials.notes.lines()
                yield _with_notes(content, stage, frame["counts"])
                materials.coloured = False  # all poses have the colours of the first


def _frames(path: Path, wanted: ReadOptions, allowance: Allowance) -> Generator[_Frame]:
    """Read a file in a process of its own, and give what that writes."""
    script = Path(__file__).with_name("usd_child.py")
    memory = memory_share() + _BASE
    # The user's plug-ins and search paths would make it another scene.
    environment = {name: text for name, text in os.environ.items() if not name.startswith("PXR_")}
    # A thread that is refused for the memory limit would be waited for until the alarm. One thread
    # takes a sixth longer for 100 layers.
    environment |= {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
    asked = wanted._asdict() | {"most": _MOST, "memory": memory, "rate_hz": RATE_HZ}
    with subprocess.Popen(
        # -P: our modules must not take the place of the library's.
        [sys.executable, "-P", script, path.absolute(), json.dumps(asked, default=str)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=path.parent,
        env=environment,
    ) as child:
        assert child.stdout
        try:
            while line := child.stdout.readline():
                frame = json.loads(line)
                arrays = []
                for kind, shape in frame["arrays"]:
                    size = np.dtype(kind).itemsize * math.prod(shape)
                    if frame["what"] == "image":
                        allowance.grow(size)
                    allowance.take(size)
                    arrays.append(np.frombuffer(child.stdout.read(size), kind).reshape(shape))
                match frame["what"]:
                    case "error":
                        raise ValueError(frame["reason"])
                    case "too many":
                        what = f"{_MOST[frame['of']]:,} {frame['of']}"
                        raise MeshFileError(f"has more than {what}: export it in parts")
                for file in map(Path, frame.get("files", ())):
                    if not (wanted.allows(file) or file.samefile(path)):
                        raise MeshFileError(outside(os.path.relpath(file, path.resolve().parent)))
                    allowance.add_file(file)
                yield frame, arrays
            code = child.wait()
        finally:
            child.kill()
    if code == -signal.SIGALRM:
        raise ValueError("usd-core takes too long for it")
    why = signal.Signals(-code).name if code < 0 else f"status {code}"
    raise ValueError(f"usd-core ended with {why}, or needs more than {bytes_of(memory)} of memory")


def _mesh(
    frame: dict[str, Any], arrays: list[AnyArray], allowance: Allowance, materials: UsdMaterials
) -> list[SceneMesh]:
    """Mesh of polygons; none without triangles."""
    name = frame["name"]
    allowance.take(24 * len(arrays[2]) + 4 * 8 * len(arrays[1]))
    sizes, corners, points, holes = arrays[:4]
    sizes = sizes.astype(np.int64)
    corners = corners.astype(np.int64)
    if (sizes < 0).any() or sizes.sum() != len(corners):
        raise ValueError(
            f"{name!r} has polygons of {sizes.sum():,} corners, {len(corners):,} are there"
        )
    solid = np.ones(len(sizes), bool)
    solid[holes[(holes >= 0) & (holes < len(sizes))]] = False
    vertices = points.reshape(-1, 3).astype(np.float64)
    try:
        if "materials" in frame:
            allowance.take(15 * 8 * len(corners))
            pieces = dressed(frame, arrays, vertices, (sizes, corners, solid), materials)
        else:
            outlines = corners[np.repeat(solid, sizes)]
            pieces = iter([Piece(vertices, triangulated(vertices, outlines, sizes[solid]))])
        return join_pieces(name, pieces, allowance)
    except ValueError as error:
        raise ValueError(f"{name!r}: {error}") from error


def _shape(
    frame: dict[str, Any], arrays: list[AnyArray], materials: UsdMaterials
) -> list[SceneMesh]:
    """Mesh of a cube, sphere, cylinder, cone, capsule or plane; none if it has no size."""
    made = _outline(frame)
    if made is None or "materials" not in frame:
        return [made] if made else []
    rows = np.arange(len(made.faces))
    look = Look(frame, arrays, {"constant": np.zeros((len(rows), 3), np.int64)})
    number = next((number for number, _ in frame["materials"]), None)
    # Without texture coordinates they have no masks either, and a note says so.
    materials.cutout(number, look, rows)
    named = FaceMaterials.named(materials.name(number))
    return [replace(made, colours=materials.colours(number, look, rows), materials=named)]


def _outline(frame: dict[str, Any]) -> SceneMesh | None:
    name = frame["name"]
    kind = frame["kind"]
    size = frame["sizes"]
    axis = "XYZ".index(size.get("axis", "Z"))
    if min(value for value in size.values() if not isinstance(value, str)) <= 0:
        return None
    if kind == "Cube":
        edge = size["size"]
        return box(name, (edge, edge, edge)).moved(name, np.eye(3), np.array([0, 0, -edge / 2]))
    if kind == "Plane":
        along = ("width", "length") if axis == 2 else ("length", "width")
        x, y = (size[side] / 2 for side in along)
        corners = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)])
        made = SceneMesh(name, corners, np.array([(0, 1, 2), (0, 2, 3)]))
    elif kind == "Cone":
        half = size["height"] / 2
        made = revolve([(0, -half), (size["radius"], -half), (0, half)], _SEGMENTS, name)
    else:
        shape = cylinder if kind == "Cylinder" else capsule
        made = shape(size["radius"], size.get("height", 0), _SEGMENTS, name)
    # From an axis along z to its own.
    return SceneMesh(name, np.roll(made.vertices, axis + 1, axis=1), made.faces)


def _content(
    frame: dict[str, Any],
    arrays: list[AnyArray],
    meshes: dict[int, list[SceneMesh]],
    stem: str,
    allowance: Allowance,
) -> Content:
    """Place meshes by the nodes of a scene."""
    matrices, *more = arrays
    matrices = matrices.copy()
    moving = frame["moving"]
    motions = more[: len(moving)]
    copies = more[len(moving) :]
    nodes = frame["nodes"]

    def node(key: Any) -> Node:
        if isinstance(key, tuple):
            copied, places, row = key
            if row is not None:
                return Node("", copies[places][row], (), [copied])
            name, mesh, *_ = nodes[copied]
            return Node(name, np.eye(4), meshes[mesh], (), matmul(copies[places], matrices[copied]))
        name, mesh, children, instanced = nodes[key]
        for copied, places in instanced:
            inner = nodes[copied]
            alone = inner[1] is not None and not (inner[2] or inner[3])  # a mesh, and no more
            rows = [None] if alone else range(len(copies[places]))
            children += [(copied, places, row) for row in rows]
        return Node(name, matrices[key], meshes.get(mesh, ()), children)

    placed = _named(placed_nodes(frame["roots"], node, stem))
    content = placed_content(placed, copy_all=len(frame["times_s"]) > 1)
    for number, motion in zip(moving, motions, strict=True):
        # Its mesh has the scale, since actors have none.
        matrices[number] = np.eye(4)
        stretch = matrices[number, :3, :3]
        places = motion[:, 1:].reshape(-1, 3, 4)
        stretch[:] = scale_of(places[0, :, :3])
        found = placed_content(placed_nodes([number], node, stem))
        content.skipped += found.skipped
        if found.meshes:
            shared = [one.mesh for one in found.meshes if isinstance(one, SceneInstance)]
            # An actor has no instances.
            allowance.take(sum(80 * len(mesh.faces) for mesh in shared))
            turns = matmul(places[:, :, :3], inverse(stretch))
            times = (motion[:, 0] - frame["start"]) / frame["rate_hz"]
            if not (np.abs(times) < _LATEST_S).all():
                raise ValueError("its times are not finite, or reach over 30 years")
            content.moving.append(
                RigidPart(nodes[number][0], found.meshes, times, places[:, :, 3], turns)
            )
    return content


def _named(places: list[PlacedNode]) -> list[PlacedNode]:
    """Name prims of one name by what they are in.

    Of the prims that such a prim does not share with others of its name, the nearest whose name is
    the rarest: a chess set has many «Render» in many «Geom», each in a «King» or «Queen». If there
    are further meshes in that prim, the names are joined, «King/Render».
    """
    # Copies have one path.
    paths = {place.path for place in places if place.path}
    uses = Counter(path[-1] for path in paths)
    within: Counter[Any] = Counter()  # {prim, or prim and name: meshes in it}
    for path in paths:
        for depth in range(1, len(path)):
            within.update([path[:depth], (path[:depth], path[-1])])
    above = {
        path: [path[:depth] for depth in range(len(path) - 1, 0, -1)]
        for path in paths
        if uses[path[-1]] > 1
    }
    own = {
        path: [one for one in found if within[one, path[-1]] == 1] for path, found in above.items()
    }
    rarity = Counter((path[-1], one[-1]) for path, found in own.items() for one in found)
    names = {}
    for path, found in own.items():
        best = min(found, key=lambda one: rarity[path[-1], one[-1]], default=None)
        if best and rarity[path[-1], best[-1]] < uses[path[-1]]:
            names[path] = best[-1] if within[best] == 1 else f"{best[-1]}/{path[-1]}"
    return [place._replace(name=names.get(place.path, place.name)) for place in places]


def _with_notes(content: Content, stage: dict[str, Any], counts: dict[str, int]) -> Content:
    """Add units, axes and notes."""
    content.unit_m = stage["unit_m"]
    content.up_axis = stage["up_axis"]
    if not 0 < stage["unit_m"] < np.inf:
        raise ValueError(f"its unit is {stage['unit_m']} metres")
    if stage["up_axis"] not in UP_AXES:
        raise ValueError(f"its upAxis is {stage['up_axis'][:20]!r}")
    content.turned = "as it states" if stage["up_stated"] else "as OpenUSD asks"
    if not stage["unit_stated"]:
        content.unit_note = "states no unit and is taken in centimetres, as OpenUSD asks"
    moving, skinned, smooth = (counts.pop(k, 0) for k in ("moving", "skinned", "subdivided"))
    notes = content.notes
    if stage["materialx"]:
        notes.append(
            "has materials in MaterialX files, which usd-core does not read: they are lacking"
        )
    if names := [name[-80:] for name in stage["missing"]]:
        listed = ", ".join(map(repr, names[:3])) + ", …" * (len(names) > 3)
        notes.append(f"refers to what is not there or cannot be read, and lacks it: {listed}")
    if counts:
        listed = ", ".join(f"{n} {kind}" for kind, n in counts.items())
        notes.append(f"is read without {listed}")
    if moving:
        notes.append(
            f"moves {plural(moving, 'object')} otherwise than as a whole, or in copies: taken at "
            "the first time, and still"
        )
    if stage["animations"] and len(stage["times_s"]) == 1:
        notes.append("has skeletons that move: they stand still; actors move by animation: NAME")
    if skinned:
        bent = plural(skinned, "mesh", "meshes")
        notes.append(f"bends {bent} by skeletons in instances, which is not read: taken unbent")
    if smooth:
        notes.append(f"subdivides {plural(smooth, 'mesh', 'meshes')}: taken as modelled, coarse")
    if notes and not (content.meshes or content.moving):
        raise MeshFileError(f"holds no triangles, and {notes[0]}")
    return content

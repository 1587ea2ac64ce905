"""Scene graphs of mesh files: nodes that place meshes and other nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...io.allowance import Allowance, bytes_of, memory_share
from ...io.named_files import is_inside
from ...numerics.arrays import AnyArray, Floats, Ints
from ...numerics.vectors import matmul, rank
from .. import colors, face_materials
from ..animation import Animation
from ..colors import Colors
from ..face_materials import FaceMaterials
from ..scene_instances import MAX_COORDINATE_M, SceneInstance
from ..scene_mesh import Cutout, SceneMesh, compacted, stacked
from .polygons import check_corners

# Advice on a file that unpacks to too much, without and with an animation.
SMALLER = "Export it in parts, or as .ply"
SHORTER = "Shorten its animation, or simplify its mesh"
# A mesh becomes instances if that saves as many triangles; triangles of faces are cast faster.
SHARED_TRIANGLES = 100_000
MAX_NODES = 200_000  # nodes of a scene, counting every instance
_MAX_PATH_NAMES = 16  # names of nodes that a placed node remembers
MAX_TRIANGLES = np.iinfo(np.int32).max  # limit for all placed meshes


@dataclass(frozen=True)
class Raster:
    """Description of a mesh read from a raster of heights."""

    crs: str  # coordinate system of the mesh, as "EPSG:25832" or WKT; empty if unknown
    epsg: int | None
    summary: str  # size, step and coordinate system, for users


class ObjectClass(NamedTuple):
    """A semantic class that a format gives to its objects."""

    name: str
    patterns: tuple[str, ...]  # patterns of the names of its objects


class MeshFileError(Exception):
    """An error of a mesh file, as a clause that follows the file's name."""


class ReadOptions(NamedTuple):
    """Content to read from a mesh file, besides triangles."""

    masks: bool
    colors: bool
    # Resolved folders: files that the mesh file names are read only from these and below.
    folders: tuple[Path, ...]
    # Unit and up axis that the user gives, else None. They are applied to the content, except the
    # unit of rasters, for which the reader applies the unit to the heights.
    unit: str | None = None
    up_axis: str | None = None
    animation: str | None = None  # name of the animation to bake; "" for the first
    materials: bool = False  # names of the materials of faces
    skins_at_rest: bool = False  # meshes that a skeleton moves, which else are refused
    own: Any = None  # options of this format alone, an instance of `MeshFormat.options`

    def allows(self, file: Path) -> bool:
        """Return True if a file that the mesh file names may be read."""
        return is_inside(file, self.folders)


class RigidPart(NamedTuple):
    """Objects that move as a rigid body, and the poses of the body."""

    name: str
    objects: Sequence[SceneMesh | SceneInstance]
    times_s: Floats  # (k,), ascending, since the survey's start; static before and after
    positions: Floats  # (k, 3)
    rotations: Floats  # (k, 3, 3), perhaps rounded or scaled


# Generator that files written by lidarpool name: .glb is Y-up, others are Z-up.
GENERATOR = "lidarpool"


@dataclass
class Content:
    """Content of a mesh file.

    `meshes` and `moving` are in the file's unit and frame.
    """

    meshes: Sequence[SceneMesh | SceneInstance]
    moving: list[RigidPart] = field(default_factory=list)
    unit_m: float | None = None  # meters in the file's unit; None if unknown
    up_axis: str | None = None  # 'x', 'y' or 'z'; None if neither file nor format states an axis
    generator: str = ""  # the program that wrote the file, if known
    turned: str = ""  # why a Y-up file is rotated, for a note; empty for no note
    unit_note: str = ""  # clause on a unit that the file does not state
    skipped: list[str] = field(default_factory=list)  # names of objects without an area
    notes: list[str] = field(default_factory=list)  # clauses that follow the file's name
    raster: Raster | None = None
    epsg: int | None = None  # code of the coordinate system in meters, if the file states it
    is_landscape: bool = False  # whether the file is of land, never of a single object
    # {number of ASPRS LAS: class} of formats whose objects have types
    classes: Mapping[int, ObjectClass] = field(default_factory=dict)


@dataclass
class Node:
    """A node, which places meshes and child nodes."""

    name: str  # empty where the file has no name
    matrix: Floats  # (4, 4), from the node's coordinates to the parent's
    # In the node's coordinates; nodes of the same mesh have the same object.
    meshes: Sequence[SceneMesh] = ()
    children: Iterable[Hashable] = ()  # keys of the child nodes
    # (k, 4, 4), to the node's coordinates: poses of copies of the meshes; None for a single copy
    copies: Floats | None = None
    skinned: bool = False  # joints place the meshes, which are in coordinates of the file


class PlacedNode(NamedTuple):
    """A mesh, and its matrix in a scene graph."""

    mesh: SceneMesh
    matrix: Floats  # (4, 4), from the mesh's coordinates to the file's
    name: str
    path: tuple[str, ...] = ()  # names of the innermost nodes that contain the mesh


def placed_nodes(
    roots: Iterable[Any], node_of: Callable[[Any], Node], stem: str
) -> list[PlacedNode]:
    """Return all placed meshes of a scene graph, whose nodes may have several parents.

    `roots` are keys of the outermost nodes, and `node_of` returns the node of a key. A placed mesh
    is named by the nearest node with a name, else by the mesh, else by `stem`.

    Raises
    ------
    MeshFileError
        If nodes contain each other without end, or there are more than `MAX_NODES`.
    """
    node_of = cache(node_of)
    placed = []
    visited = 0
    stack: list[Any] = [(key, np.eye(4), ()) for key in reversed(list(roots))]
    while stack:
        key, parent_matrix, path = stack.pop()
        node = node_of(key)
        visited += 1 if node.copies is None else 1 + len(node.copies)
        # A few lines can make any number of nodes.
        if visited + len(stack) > MAX_NODES:
            raise MeshFileError(
                f"has more than {MAX_NODES:,} nodes and copies, or nodes that contain each other. "
                "Export it in parts"
            )
        matrix = matmul(parent_matrix, node.matrix)
        path = (*path[1 - _MAX_PATH_NAMES :], node.name) if node.name else path
        matrices = [matrix] if node.copies is None else matmul(matrix, node.copies)
        matrices = [np.eye(4)] if node.skinned else matrices
        placed += [
            PlacedNode(mesh, mesh_matrix, path[-1] if path else mesh.name or stem, path)
            for mesh_matrix in matrices
            for mesh in node.meshes
        ]
        stack += [(child, matrix, path) for child in reversed(list(node.children))]
    return placed


def placed_content(placed: Sequence[PlacedNode], *, copy_all: bool = False) -> Content:
    """Return the content of placed meshes: instances of meshes that many share, and copies.

    Meshes with masks that are placed twice become instances too, since each copy would have a part
    for itself. With `copy_all` all meshes are copied, even meshes scaled to zero.

    Raises
    ------
    MeshFileError
        If a matrix is not finite or not affine, if there are too many triangles, or if the copies
        would take more than a quarter of the memory.
    """
    objects: list[SceneMesh | SceneInstance] = []
    content = Content(objects)
    uses = Counter(mesh for mesh, *_ in placed)
    shared_meshes = {
        mesh
        for mesh, n in uses.items()
        if not copy_all and (n - 1) * len(mesh.faces) >= (1 if mesh.cutouts else SHARED_TRIANGLES)
    }
    copied_bytes = [
        mesh.vertices.nbytes + mesh.faces.nbytes for mesh, *_ in placed if mesh not in shared_meshes
    ]
    if (total := sum(copied_bytes)) > memory_share():
        raise MeshFileError(
            f"places {len(copied_bytes):,} objects, which require {bytes_of(total)}. The limit is "
            f"{bytes_of(memory_share())}, a quarter of the memory. {SMALLER}"
        )
    triangles = sum(n * len(mesh.faces) for mesh, n in uses.items())
    if triangles > MAX_TRIANGLES:
        raise MeshFileError(
            f"places {len(placed):,} objects with a total of {triangles:,} triangles, but the "
            f"limit is {MAX_TRIANGLES:,}. {SMALLER}"
        )
    matrices = np.array([node.matrix for node in placed]).reshape(-1, 4, 4)
    valid = np.isfinite(matrices).all(axis=(1, 2)) & (matrices[:, 3] == [0, 0, 0, 1]).all(axis=1)
    if not valid.all():
        _, matrix, name, _ = placed[int(valid.argmin())]
        raise MeshFileError(
            f"places {name[:80]!r} with a matrix that is not a valid transform: {matrix.tolist()}"
        )
    ranks = rank(matrices[:, :3, :3]).tolist()
    for (mesh, matrix, name, _), dimensions in zip(placed, ranks, strict=True):
        if (dimensions < 2 or (mesh in shared_meshes and not mesh.has_area)) and not copy_all:
            content.skipped.append(name)
        elif (
            mesh in shared_meshes
            and dimensions == 3
            and (np.abs(matrix[:3, 3]) <= MAX_COORDINATE_M).all()
        ):
            objects.append(SceneInstance(mesh, matrix, name))
        else:
            objects.append(mesh.moved(name, matrix[:3, :3], matrix[:3, 3]))
    return content


def bake_animation(
    contents: Iterable[Content], times_s: Sequence[float], allowance: Allowance
) -> Content:
    """Join contents of the same meshes at even times (k,) to a content of animated meshes.

    Raises
    ------
    MeshFileError
        If the animation has no duration, or the number of vertices changes.
    """
    if not times_s[-1] > times_s[0]:
        raise MeshFileError("has an animation without a duration. Add a second keyframe")
    content = Content(())
    pose_arrays = list[Floats]()
    count = len(times_s)
    used_bytes = 0
    for index, pose in zip(range(count), contents, strict=False):
        vertices_now = [mesh.vertices for mesh in pose.meshes if isinstance(mesh, SceneMesh)]
        if not index:
            allowance.take(count * sum(vertices.nbytes for vertices in vertices_now))
            content = pose
            used_bytes = allowance.used_bytes
            pose_arrays = [np.empty((count, *vertices.shape)) for vertices in vertices_now]
        allowance.used_bytes = used_bytes
        if list(map(len, vertices_now)) != [len(poses[0]) for poses in pose_arrays]:
            raise MeshFileError(
                f"has a different number of vertices in pose {index}. Remove animation"
            )
        for poses, vertices in zip(pose_arrays, vertices_now, strict=True):
            poses[index] = vertices
    step_s = (times_s[-1] - times_s[0]) / (count - 1)
    animations = iter([Animation(poses, step_s) for poses in pose_arrays])
    meshes = [mesh for mesh in content.meshes if isinstance(mesh, SceneMesh)]
    content.meshes = [replace(mesh, animation=next(animations)) for mesh in meshes]
    return content


class Piece(NamedTuple):
    """Triangles of a mesh: all opaque, or all with the same mask."""

    vertices: AnyArray  # (v, 3)
    faces: Ints  # (f, 3)
    cutout: Cutout | None = None
    colors: Colors | None = None
    material: str = ""  # name of the material of all faces, if `ReadOptions.materials`


def join_pieces(
    name: str, pieces: Iterable[Piece], allowance: Allowance | None = None
) -> list[SceneMesh]:
    """Join pieces to a mesh, in a list, which is empty if the pieces have no faces.

    Pieces with masks are last. Formats whose files cannot unpack to much more than they hold need
    no allowance.

    Raises
    ------
    ValueError
        If a face refers to a missing vertex.
    LidarError
        If the pieces take more memory than allowed.
    """
    solid: list[Piece] = []
    masked: dict[int, list[Piece]] = {}  # {id of a mask: its pieces}
    for piece in pieces:
        if len(piece.faces):
            compact = _compacted_piece(piece, allowance)
            cut = compact.cutout
            group = solid if cut is None else masked.setdefault(id(cut.mask), [])
            group.append(compact)
    if not solid and not masked:
        return []
    cutouts = []
    for mask_pieces in masked.values():
        cuts = [piece.cutout for piece in mask_pieces if piece.cutout]
        cutouts.append(Cutout(cuts[0].mask, np.concatenate([cut.uv for cut in cuts])))
    ordered = [*chain(solid, *masked.values())]
    sizes = [len(piece.faces) for piece in ordered]
    vertices, faces = stacked((piece.vertices, piece.faces) for piece in ordered)
    return [
        SceneMesh(
            name,
            vertices,
            faces,
            tuple(cutouts),
            colors.join_colors([piece.colors for piece in ordered], sizes),
            materials=face_materials.join_materials(
                [FaceMaterials.named(piece.material) for piece in ordered], sizes
            ),
        )
    ]


def _compacted_piece(piece: Piece, allowance: Allowance | None) -> Piece:
    """Return a piece without unused vertices, which many pieces may share."""
    vertices, faces, cutout, face_colors, material = piece
    check_corners(faces, len(vertices))
    if allowance is not None:
        extra = 0 if cutout is None else cutout.uv.nbytes
        extra += 0 if face_colors is None else 40 * len(faces)
        allowance.take(faces.nbytes + extra)
    vertices, faces = compacted(vertices, faces)
    if allowance is not None:
        allowance.take(24 * len(vertices))  # double precision
    return Piece(vertices, faces, cutout, face_colors, material)

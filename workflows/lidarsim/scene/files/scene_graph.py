"""Scene graphs of mesh files, whose nodes place meshes and other nodes."""

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
from ..scene_mesh import Cutout, SceneMesh, drop_unused_vertices, stack_meshes
from .polygons import check_corners

# Advice for files whose content is too large, without and with an animation.
SMALLER = "Export it in parts, or as .ply"
SHORTER = "Shorten its animation, or simplify its mesh"
# A mesh is instantiated only if this saves as many triangles, since ray casting is faster for
# triangles that are copied.
SHARED_TRIANGLES = 100_000
MAX_NODES = 200_000  # maximum number of nodes in a scene, including copies
_MAX_PATH_NAMES = 16  # maximum number of names in `PlacedNode.path`
MAX_TRIANGLES = np.iinfo(np.int32).max  # maximum total of all placed meshes


@dataclass(frozen=True)
class Raster:
    """Metadata of a mesh that was read from an elevation raster."""

    crs: str  # coordinate system of the mesh, as "EPSG:25832" or WKT; empty if unknown
    epsg: int | None
    summary: str  # size, step and coordinate system, as shown to users


class ObjectClass(NamedTuple):
    """A semantic class that a file format assigns to its objects."""

    name: str
    patterns: tuple[str, ...]  # name patterns of its objects


class MeshFileError(Exception):
    """An error in a mesh file, whose message is a clause that follows the name of the file."""


class ReadOptions(NamedTuple):
    """Options that control what is read from a mesh file besides triangles."""

    masks: bool
    colors: bool
    # Resolved folders. Files that the mesh file refers to are only read from these folders and
    # their subfolders.
    folders: tuple[Path, ...]
    # Unit and up axis if the user specifies them. They are applied after reading, except for
    # rasters, whose reader applies the unit to the heights.
    unit: str | None = None
    up_axis: str | None = None
    animation: str | None = None  # name of the animation to bake, or "" for the first
    materials: bool = False  # whether to read the material names of faces
    skins_at_rest: bool = False  # whether to read skinned meshes, which are rejected otherwise
    own: Any = None  # format-specific options, an instance of `MeshFormat.options`

    def allows(self, file: Path) -> bool:
        """Return whether a file that the mesh file refers to can be read."""
        return is_inside(file, self.folders)


NamedFrames = tuple[tuple[str, Floats], ...]  # names and (4, 4) matrices, outermost first


class ObjectFrame(NamedTuple):
    """Frame of an object, to which the poses from a program that controls the world refer."""

    matrix: Floats  # (4, 4), from the frame to file coordinates; it may contain a scale
    enclosing: NamedFrames = ()  # frames that carry the object
    is_static: bool | None = None  # whether the object never moves, or None if it is not stated


class RigidPart(NamedTuple):
    """Objects that move as a rigid body, and the poses of this body."""

    name: str
    objects: Sequence[SceneMesh | SceneInstance]
    times_s: Floats  # (k,), ascending, since the start of the survey; static before and after
    positions: Floats  # (k, 3)
    rotations: Floats  # (k, 3, 3), possibly rounded or scaled


# Generator stated in files written by lidarpool, of which .glb is Y-up and all others are Z-up.
GENERATOR = "lidarpool"


@dataclass
class Content:
    """Content of a mesh file.

    `meshes` and `moving` are in the units and the coordinate frame of the file.
    """

    meshes: Sequence[SceneMesh | SceneInstance]
    moving: list[RigidPart] = field(default_factory=list)
    # Frames of `meshes`, or empty if the format has none. The frames are in file coordinates.
    frames: Sequence[ObjectFrame] = ()
    # Frames without an object, each after the frames that carry it.
    empty_frames: Sequence[NamedFrames] = ()
    root_frame: str = ""  # name of the frame of the file, if the file states it
    unit_m: float | None = None  # length unit of the file in meters, or None if unknown
    up_axis: str | None = None  # 'x', 'y' or 'z', or None if neither file nor format specifies it
    generator: str = ""  # program that wrote the file, if known
    rotation_note: str = ""  # note on why a Y-up file is rotated, or empty
    unit_note: str = ""  # note on the unit if the file does not state it, or empty
    skipped: list[str] = field(default_factory=list)  # names of objects with zero area
    notes: list[str] = field(default_factory=list)  # clauses that follow the name of the file
    raster: Raster | None = None
    epsg: int | None = None  # code of the coordinate system in meters, if the file states it
    vertical_datum: str = ""  # name of the datum of heights, if the file states it
    is_landscape: bool = False  # whether the file represents terrain rather than an object
    # {ASPRS LAS class number: class}, for formats in which objects have types
    classes: Mapping[int, ObjectClass] = field(default_factory=dict)


@dataclass
class Node:
    """A scene graph node, which places meshes and child nodes."""

    name: str  # empty if the file does not state a name
    matrix: Floats  # (4, 4), from node coordinates to parent coordinates
    # In node coordinates. Nodes with the same mesh refer to the same object.
    meshes: Sequence[SceneMesh] = ()
    children: Iterable[Hashable] = ()  # keys of the child nodes
    # Poses of several copies of the meshes in node coordinates, (k, 4, 4). None for a single copy.
    copies: Floats | None = None
    skinned: bool = False  # whether joints place the meshes, which are in file coordinates then


class PlacedNode(NamedTuple):
    """A mesh and its transform in a scene graph."""

    mesh: SceneMesh
    matrix: Floats  # (4, 4), from mesh coordinates to file coordinates
    name: str
    path: tuple[str, ...] = ()  # names of the closest ancestors and of the node, which is last
    frame: ObjectFrame | None = None  # None for the frame of the mesh, without enclosing frames


def placed_nodes(
    roots: Iterable[Any], node_of: Callable[[Any], Node], stem: str
) -> list[PlacedNode]:
    """Return all placed meshes of a scene graph, in which a node can have several parents.

    A placed mesh is named after its node. If the node has no name, the mesh is named after the
    closest ancestor with a name. Without such an ancestor, the mesh keeps its own name, or is named
    `stem` if it has none.

    Parameters
    ----------
    roots
        Keys of the root nodes.
    node_of
        Function that returns the node with a given key.
    stem
        Name for meshes without a name.

    Raises
    ------
    MeshFileError
        If nodes contain each other in a cycle, or if there are more than `MAX_NODES` nodes.
    """
    node_of = cache(node_of)
    placed = []
    visited = 0
    # Keys of nodes, with the matrix of the parent, and the names and matrices of the ancestors.
    stack: list[Any] = [(key, np.eye(4), ()) for key in reversed(list(roots))]
    while stack:
        key, parent_matrix, ancestors = stack.pop()
        node = node_of(key)
        visited += 1 if node.copies is None else 1 + len(node.copies)
        # A small file can declare any number of nodes.
        if visited + len(stack) > MAX_NODES:
            raise MeshFileError(
                f"has more than {MAX_NODES:,} nodes and copies, or nodes that contain each other. "
                "Export it in parts"
            )
        matrix = matmul(parent_matrix, node.matrix)
        if node.name:
            ancestors = (*ancestors[1 - _MAX_PATH_NAMES :], (node.name, matrix))
        path = tuple(name for name, _ in ancestors)
        matrices = [matrix] if node.copies is None else matmul(matrix, node.copies)
        matrices = [np.eye(4)] if node.skinned else matrices
        placed += [
            PlacedNode(
                mesh,
                mesh_matrix,
                path[-1] if path else mesh.name or stem,
                path,
                ObjectFrame(mesh_matrix, ancestors[:-1] if node.name else ancestors),
            )
            for mesh_matrix in matrices
            for mesh in node.meshes
        ]
        stack += [(child, matrix, ancestors) for child in reversed(list(node.children))]
    return placed


def placed_content(placed: Sequence[PlacedNode], *, copy_all: bool = False) -> Content:
    """Convert placed meshes to instances and copies.

    Meshes that are placed often become instances if this saves many triangles. Meshes with masks
    become instances if they are placed at least twice, since each copy would require a separate
    part. With `copy_all`, all meshes are copied, even those that are scaled to zero.

    Raises
    ------
    MeshFileError
        If a matrix is not finite or not affine, if there are too many triangles, or if the copies
        would require more than a quarter of the memory.
    """
    objects: list[SceneMesh | SceneInstance] = []
    frames: list[ObjectFrame] = []
    content = Content(objects, frames=frames)
    uses = Counter(node.mesh for node in placed)
    shared_meshes = {
        mesh
        for mesh, n in uses.items()
        if not copy_all and (n - 1) * len(mesh.faces) >= (1 if mesh.cutouts else SHARED_TRIANGLES)
    }
    copied_bytes = [
        node.mesh.vertices.nbytes + node.mesh.faces.nbytes
        for node in placed
        if node.mesh not in shared_meshes
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
        node = placed[int(valid.argmin())]
        raise MeshFileError(
            f"places {node.name[:80]!r} with a matrix that is not a valid transform: "
            f"{node.matrix.tolist()}"
        )
    ranks = rank(matrices[:, :3, :3]).tolist()
    for (mesh, matrix, name, _, frame), dimensions in zip(placed, ranks, strict=True):
        if (dimensions < 2 or (mesh in shared_meshes and not mesh.has_area)) and not copy_all:
            content.skipped.append(name)
            continue
        frames.append(frame or ObjectFrame(matrix))
        if (
            mesh in shared_meshes
            and dimensions == 3
            and (np.abs(matrix[:3, 3]) <= MAX_COORDINATE_M).all()
        ):
            objects.append(SceneInstance(mesh, matrix, name))
        else:
            objects.append(mesh.affine_transform(name, matrix[:3, :3], matrix[:3, 3]))
    return content


def bake_animation(
    contents: Iterable[Content], times_s: Sequence[float], allowance: Allowance
) -> Content:
    """Combine meshes at evenly spaced times into animated meshes.

    `contents` yields the same meshes, in the pose of each time.

    Raises
    ------
    MeshFileError
        If the animation has no duration, or if the number of vertices changes.
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
            allowance.reserve(count * sum(vertices.nbytes for vertices in vertices_now))
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
    """Triangles of a mesh that are either all opaque or have the same mask."""

    vertices: AnyArray  # (v, 3)
    faces: Ints  # (f, 3)
    cutout: Cutout | None = None
    colors: Colors | None = None
    material: str = ""  # material name of all faces if `ReadOptions.materials` is set


def join_pieces(
    name: str, pieces: Iterable[Piece], allowance: Allowance | None = None
) -> list[SceneMesh]:
    """Merge pieces into a list with a single mesh.

    The list is empty if the pieces have no faces. Pieces with masks come last. No allowance is
    required for formats in which the content cannot be much larger than the file.

    Raises
    ------
    ValueError
        If a face refers to a vertex that does not exist.
    LidarError
        If the pieces require more memory than allowed.
    """
    solid: list[Piece] = []
    masked: dict[int, list[Piece]] = {}  # {id of a mask: its pieces}
    for piece in pieces:
        if len(piece.faces):
            compact = _compact_piece(piece, allowance)
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
    vertices, faces = stack_meshes((piece.vertices, piece.faces) for piece in ordered)
    return [
        SceneMesh(
            name,
            vertices,
            faces,
            tuple(cutouts),
            colors.join_colors([piece.colors for piece in ordered], sizes),
            materials=face_materials.join_materials(
                [FaceMaterials.from_name(piece.material) for piece in ordered], sizes
            ),
        )
    ]


def _compact_piece(piece: Piece, allowance: Allowance | None) -> Piece:
    """Remove unused vertices from a piece, which can share its vertices with other pieces."""
    vertices, faces, cutout, face_colors, material = piece
    check_corners(faces, len(vertices))
    if allowance is not None:
        extra = 0 if cutout is None else cutout.uv.nbytes
        extra += 0 if face_colors is None else 40 * len(faces)
        allowance.reserve(faces.nbytes + extra)
    vertices, faces = drop_unused_vertices(vertices, faces)
    if allowance is not None:
        allowance.reserve(24 * len(vertices))  # double precision
    return Piece(vertices, faces, cutout, face_colors, material)

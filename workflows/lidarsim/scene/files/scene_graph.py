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

from ...base.allowance import Allowance, bytes_of, memory_share
from ...base.arrays import AnyArray, Floats, Ints
from ...base.vectors import matmul, rank
from .. import colours, face_materials
from ..animation import Animation
from ..colours import Colours
from ..face_materials import FaceMaterials
from ..scene_instances import SceneInstance
from ..scene_mesh import Cutout, SceneMesh, compacted, stacked
from .polygons import check_corners

# What helps if a file unpacks to too much, without and with an animation.
SMALLER = "export it in parts, or as .ply"
SHORTER = "shorten its animation or simplify its mesh"
# A mesh becomes one of instances if that saves so many triangles; single triangles are cast faster.
SHARED_TRIANGLES = 100_000
MOST_NODES = 200_000  # most nodes of a scene, counting every instance
_NAMES = 16  # of nodes that a place remembers
MOST_TRIANGLES = np.iinfo(np.int32).max  # of all places


@dataclass(frozen=True)
class Raster:
    """What was taken of a raster of heights."""

    crs: str  # coordinate system of the mesh, as "EPSG:25832" or WKT; empty if it states none
    epsg: int | None
    told: str  # for users


class ObjectClass(NamedTuple):
    """A semantic class that a format gives to its objects."""

    name: str
    patterns: tuple[str, ...]  # of the names of its objects


class MeshFileError(Exception):
    """An error of a mesh file, as a clause that follows its name."""


Window = tuple[float, float, float, float]  # lowest x and y, highest x and y


class RasterOptions(NamedTuple):
    """How a raster of heights is read; see `read_raster`."""

    unit: str | None = None  # of its heights; None for that of the file
    step_m: float | None = None  # step of the grid of mean heights; None takes the pixels
    window: Window | None = None  # metres, in the coordinate system of the mesh; None takes all
    epsg: int | None = None  # coordinate system of the mesh; None for one that suits the file


class ReadOptions(NamedTuple):
    """What to read of a mesh file, besides triangles."""

    masks: bool
    colours: bool
    folders: tuple[Path, ...]  # resolved; files that it names are read only from these and below
    animation: str | None = None  # to bake, by its name; "" for the first
    materials: bool = False  # names of the materials of faces
    raster: RasterOptions = RasterOptions()

    def allows(self, file: Path) -> bool:
        """Whether a file that is named may be read."""
        return any(file.resolve().is_relative_to(folder) for folder in self.folders)


class RigidPart(NamedTuple):
    """Objects that move as one, and how: turned, then moved."""

    name: str
    objects: Sequence[SceneMesh | SceneInstance]
    times_s: Floats  # (k,), ascending, since the survey's start; before and after
    # them it stands
    positions: Floats  # (k, 3)
    rotations: Floats  # (k, 3, 3), perhaps rounded or scaled


@dataclass
class Content:
    """Content of a mesh file.

    `meshes` and `moving` are in the file's unit and axes.
    """

    meshes: Sequence[SceneMesh | SceneInstance]
    moving: list[RigidPart] = field(default_factory=list)
    unit_m: float | None = None  # metres in its unit; None if unknown
    up_axis: str | None = None  # 'x', 'y' or 'z'; None if neither it nor its format states one
    generator: str = ""  # the program that wrote it, if known
    turned: str = ""  # why a Y-up file is turned, if to be told
    unit_note: str = ""  # clause on a unit that it does not state
    skipped: list[str] = field(default_factory=list)  # names of objects without an area
    notes: list[str] = field(default_factory=list)  # clauses that follow the file's name
    raster: Raster | None = None
    # {number of ASPRS LAS: class} of formats whose objects have types
    classes: Mapping[int, ObjectClass] = field(default_factory=dict)


@dataclass
class Node:
    """A node, which places meshes and other nodes."""

    name: str  # empty where the file has none
    matrix: Floats  # (4, 4), from its coordinates to those of its parent
    meshes: Sequence[SceneMesh] = ()  # in its coordinates; the same objects wherever a mesh is used
    children: Iterable[Hashable] = ()  # keys of the nodes in it
    # (k, 4, 4), to its coordinates: its meshes are in all these places; None for one
    copies: Floats | None = None
    skinned: bool = False  # its joints place its meshes, which are in coordinates of the file


class PlacedNode(NamedTuple):
    """A mesh in its own coordinates, and where a scene graph places it."""

    mesh: SceneMesh
    matrix: Floats  # (4, 4), to the coordinates of the file
    name: str
    path: tuple[str, ...] = ()  # names of the nodes that it is in, of the innermost few


def placed_nodes(
    roots: Iterable[Any], node_of: Callable[[Any], Node], stem: str
) -> list[PlacedNode]:
    """Find all places of meshes in a scene graph; a node may be in several others.

    `roots` are keys of the outermost nodes, and `node_of` returns the node of a key. An instance is
    named by the nearest node with a name, else by its mesh, else it gets `stem`.

    Raises
    ------
    MeshFileError
        If nodes contain each other without end, or there are some hundred thousand places.
    """
    node_of = cache(node_of)
    placed = []
    begun = 0
    stack: list[Any] = [(key, np.eye(4), ()) for key in reversed(list(roots))]
    while stack:
        key, above, path = stack.pop()
        node = node_of(key)
        begun += 1 if node.copies is None else 1 + len(node.copies)
        # A few lines can make any number of nodes.
        if begun + len(stack) > MOST_NODES:
            raise MeshFileError(
                f"has nodes that contain each other, or copies, more than {MOST_NODES:,} in all: "
                "export it in parts"
            )
        matrix = matmul(above, node.matrix)
        path = (*path[1 - _NAMES :], node.name) if node.name else path
        places = [matrix] if node.copies is None else matmul(matrix, node.copies)
        places = [np.eye(4)] if node.skinned else places
        placed += [
            PlacedNode(mesh, place, path[-1] if path else mesh.name or stem, path)
            for place in places
            for mesh in node.meshes
        ]
        stack += [(child, matrix, path) for child in reversed(list(node.children))]
    return placed


def placed_content(placed: Sequence[PlacedNode], *, copy_all: bool = False) -> Content:
    """Make instances of meshes that many places share, and copy the others to their places.

    Meshes with masks are not copied either, since each copy would have a part of its own. With
    `copy_all` there is a copy for each place, even of what is scaled to zero.

    Raises
    ------
    MeshFileError
        If a matrix is none of a place, or the copies would take more than a quarter of the memory.
    """
    objects: list[SceneMesh | SceneInstance] = []
    content = Content(objects)
    uses = Counter(mesh for mesh, *_ in placed)
    shared = {
        mesh
        for mesh, n in uses.items()
        if not copy_all and (n - 1) * len(mesh.faces) >= (1 if mesh.cutouts else SHARED_TRIANGLES)
    }
    own = [mesh.vertices.nbytes + mesh.faces.nbytes for mesh, *_ in placed if mesh not in shared]
    if sum(own) > memory_share():
        raise MeshFileError(
            f"places {len(own):,} objects, which would take {bytes_of(sum(own))}, of at most "
            f"{bytes_of(memory_share())}, a quarter of the memory: {SMALLER}"
        )
    triangles = sum(n * len(mesh.faces) for mesh, n in uses.items())
    if triangles > MOST_TRIANGLES:
        raise MeshFileError(
            f"places {len(placed):,} objects of {triangles:,} triangles in all, of at most "
            f"{MOST_TRIANGLES:,}: {SMALLER}"
        )
    matrices = np.array([place.matrix for place in placed]).reshape(-1, 4, 4)
    good = np.isfinite(matrices).all(axis=(1, 2)) & (matrices[:, 3] == [0, 0, 0, 1]).all(axis=1)
    if not good.all():
        _, matrix, name, _ = placed[int(good.argmin())]
        raise MeshFileError(
            f"places {name[:80]!r} by a matrix that is none of a place: {matrix.tolist()}"
        )
    ranks = rank(matrices[:, :3, :3]).tolist()
    for (mesh, matrix, name, _), dimensions in zip(placed, ranks, strict=True):
        if (dimensions < 2 or (mesh in shared and not mesh.has_area)) and not copy_all:
            content.skipped.append(name)
        elif mesh in shared and dimensions == 3:
            objects.append(SceneInstance(mesh, matrix, name))
        else:
            objects.append(mesh.moved(name, matrix[:3, :3], matrix[:3, 3]))
    return content


def bake_animation(
    poses: Iterable[Content], times_s: Sequence[float], allowance: Allowance
) -> Content:
    """Join poses of the same meshes, at times that are even, to one content that is animated."""
    if not times_s[-1] > times_s[0]:
        raise MeshFileError("has an animation without a duration: give it two keys")
    content = Content(())
    moves = list[Floats]()
    count = len(times_s)
    taken = 0
    for number, pose in zip(range(count), poses, strict=False):
        now = [mesh.vertices for mesh in pose.meshes if isinstance(mesh, SceneMesh)]
        if not number:
            allowance.take(count * sum(vertices.nbytes for vertices in now))
            content = pose
            taken = allowance.taken
            moves = [np.empty((count, *vertices.shape)) for vertices in now]
        allowance.taken = taken
        if list(map(len, now)) != [len(own[0]) for own in moves]:
            raise MeshFileError(f"has other vertices in pose {number}: leave out animation")
        for own, vertices in zip(moves, now, strict=True):
            own[number] = vertices
    animations = iter([Animation(own, (times_s[-1] - times_s[0]) / (count - 1)) for own in moves])
    meshes = [mesh for mesh in content.meshes if isinstance(mesh, SceneMesh)]
    content.meshes = [replace(mesh, animation=next(animations)) for mesh in meshes]
    return content


class Piece(NamedTuple):
    """Triangles of a mesh, all opaque or all with one mask."""

    vertices: AnyArray  # (v, 3)
    faces: Ints  # (f, 3)
    cutout: Cutout | None = None
    colours: Colours | None = None
    material: str = ""  # name of the material of all its faces, if names are wanted


def join_pieces(
    name: str, pieces: Iterable[Piece], allowance: Allowance | None = None
) -> list[SceneMesh]:
    """Join pieces to one mesh, those with masks last; none without faces.

    Formats whose files cannot unpack to much more than they hold need no allowance.

    Raises
    ------
    ValueError
        If a face refers to a missing vertex; LidarError if it takes more than allowed.
    """
    solid: list[Piece] = []
    masked: dict[int, list[Piece]] = {}  # {id of a mask: its pieces}
    for piece in pieces:
        if len(piece.faces):
            own = _own(piece, allowance)
            cut = own.cutout
            (solid if cut is None else masked.setdefault(id(cut.mask), [])).append(own)
    if not solid and not masked:
        return []
    cutouts = []
    for some in masked.values():
        cuts = [piece.cutout for piece in some if piece.cutout]
        cutouts.append(Cutout(cuts[0].mask, np.concatenate([cut.uv for cut in cuts])))
    ordered = [*chain(solid, *masked.values())]
    sizes = [len(one.faces) for one in ordered]
    coloured = colours.join_colours([one.colours for one in ordered], sizes)
    named = face_materials.join_materials(
        [FaceMaterials.named(one.material) for one in ordered], sizes
    )
    parts = stacked((one.vertices, one.faces) for one in ordered)
    return [SceneMesh(name, *parts, tuple(cutouts), coloured, materials=named)]


def _own(piece: Piece, allowance: Allowance | None) -> Piece:
    """Return a piece without unused vertices; many pieces may share all of them."""
    vertices, faces, cutout, painted, material = piece
    check_corners(faces, len(vertices))
    if allowance is not None:
        extra = 0 if cutout is None else cutout.uv.nbytes
        extra += 0 if painted is None else 40 * len(faces)
        allowance.take(faces.nbytes + extra)
    vertices, faces = compacted(vertices, faces)
    if allowance is not None:
        allowance.take(24 * len(vertices))  # in double precision
    return Piece(vertices, faces, cutout, painted, material)

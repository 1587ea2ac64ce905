"""Voxels that the surfaces and solids of a scene occupy at a given time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...motion.trajectory import full_poses, presence_ns
from ...numerics.arrays import AnyArray, Bools, Floats, Indices, Integers, Ints, Ints32, to_writable
from ...numerics.vectors import matmul, matvec, rotate
from ...scene.scene import Scene
from .grid import VoxelGrid

BLOCK_FACES = 1 << 18  # number of triangles that are transformed at a time


class GridPose(NamedTuple):
    """Pose of a grid in the scene frame."""

    position: Floats  # (3,), meters
    rotation: Floats  # (3, 3), from the frame of the grid to the scene frame


class ClosedParts(NamedTuple):
    """Closed components of a mesh, which enclose a volume."""

    faces: Indices  # (k,), faces of all components, sorted by component
    starts: Indices  # (components + 1,), first row of each component in `faces`

    @classmethod
    def of_mesh(cls, vertices: Floats, faces: Integers, owners: Integers) -> ClosedParts:
        """Find the components of a mesh in which each edge joins two consistently oriented faces.

        Vertices with the same position and the same owner are merged. `owners` (f,) are the objects
        of the faces.
        """
        from . import voxel_loops as loops  # imported here because numba is slow to import

        corners, count = _merged_corners(vertices, faces, owners)
        proper = np.flatnonzero((corners != np.roll(corners, -1, axis=1)).all(axis=1))
        corners = corners[proper]
        component = loops.components_of(corners, count)[corners[:, 0]]
        is_open = np.zeros(count, np.bool_)
        is_open[component[_has_open_edge(corners, count)]] = True
        kept = np.flatnonzero(~is_open[component])
        kept = kept[np.argsort(component[kept], kind="stable")]
        first_rows = np.flatnonzero(np.diff(component[kept], prepend=-1))
        return cls(proper[kept], np.append(first_rows, len(kept)))

    def of_faces(self, count: int) -> Ints32:
        """Return the first face of the component of each of `count` faces, or -1 for none."""
        component = np.full(count, -1, np.int32)
        component[self.faces] = np.repeat(self.faces[self.starts[:-1]], np.diff(self.starts))
        return component


def _merged_corners(vertices: Floats, faces: Integers, owners: Integers) -> tuple[Ints, int]:
    """Return the corners (f, 3) of faces as indices of distinct vertices, and the vertex count."""
    object_of_vertex = np.zeros((len(vertices), 1))
    object_of_vertex[faces.ravel(), 0] = np.repeat(owners, 3)
    keys = np.concatenate([vertices + 0.0, object_of_vertex], axis=1)  # -0 becomes 0
    rows = keys.view(np.dtype((np.void, keys.itemsize * 4)))[:, 0]
    distinct, merged = np.unique(rows, return_inverse=True)
    return merged.reshape(-1)[faces].astype(np.int64), len(distinct)


def _has_open_edge(corners: Ints, count: int) -> Bools:
    """Return whether each face has an edge that does not join two consistently oriented faces.

    `corners` (f, 3) are vertex indices below `count`.
    """
    if not len(corners):
        return np.zeros(0, np.bool_)
    following = np.roll(corners, -1, axis=1)
    edges = corners * count + following
    opposite = following * count + corners
    distinct, times = np.unique(edges, return_counts=True)
    is_single = times[np.searchsorted(distinct, edges)] == 1
    rows = np.minimum(np.searchsorted(distinct, opposite), len(distinct) - 1)
    return np.asarray(~(is_single & (distinct[rows] == opposite)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh of a scene in the scene frame, with the number of its first triangle."""

    vertices: Floats  # (v, 3), meters
    faces: Integers  # (f, 3)
    shown: Bools | None  # (f,), faces that the sensor can see; None for all
    closed: ClosedParts
    first: int


class SceneVoxels:
    """Voxelizes a scene without the objects that a mask marks as unseen."""

    def __init__(self, scene: Scene, unseen: Bools | None) -> None:
        self._scene = scene
        names = len(scene.object_names)
        self._seen = np.ones(names, np.bool_) if unseen is None else ~unseen
        self._closed: dict[int, ClosedParts] = {}  # {id of the faces: closed components}

    def triangles(self, grid: VoxelGrid, pose: GridPose, time_ns: float) -> Ints32:
        """Return the triangle of each voxel at a time in nanoseconds, or -1 for none.

        The shape is that of the grid. Surfaces take precedence over solids, unless they only touch
        a voxel whose center is inside a solid, such as the ground below a car.
        """
        from . import voxel_loops as loops  # imported here because numba is slow to import

        triangle = np.full(grid.shape, -1, np.int32)
        square = np.full(grid.shape, np.inf)
        bodies = [self._placed(body, grid, pose) for body in self._bodies(grid, pose, time_ns)]
        solid = np.full(grid.shape, -1, np.int32)
        for body in bodies:
            for faces in _solids_in_grid(body, grid):
                corners = to_writable(body.vertices[body.faces[faces]])
                loops.add_interior(corners, body.first + int(faces[0]), solid)
        for body in bodies:
            component = body.closed.of_faces(len(body.faces))
            for faces in _blocks_in_grid(body, grid):
                numbers = (body.first + faces).astype(np.int32)
                parts = np.where(component[faces] < 0, -1, body.first + component[faces])
                corners = to_writable(body.vertices[body.faces[faces]])
                loops.add_surfaces(
                    corners, numbers, parts.astype(np.int32), solid, triangle, square
                )
        return np.where(triangle < 0, solid, triangle)

    @staticmethod
    def _placed(body: Body, grid: VoxelGrid, pose: GridPose) -> Body:
        """Return a body whose vertices are in voxels of the grid."""
        in_frame = rotate(body.vertices - pose.position, pose.rotation.T)
        return Body(grid.to_voxels(in_frame), body.faces, body.shown, body.closed, body.first)

    def _bodies(self, grid: VoxelGrid, pose: GridPose, time_ns: float) -> Iterator[Body]:
        """Yield the bodies that may be in the grid, in the order of their triangle numbers."""
        scene = self._scene
        if len(scene.faces):
            shown = self._seen[scene.face_object]
            closed = self._closed_parts(scene.vertices, scene.faces, scene.face_object)
            yield Body(scene.vertices, scene.faces, None if shown.all() else shown, closed, 0)
        first = len(scene.faces)
        if (instances := scene.instances) is not None:
            starts = first + np.cumsum([0, *instances.sizes])
            near = _may_overlap(instances.bounds, grid, pose) & self._seen[instances.owner]
            for number in np.flatnonzero(near).tolist():
                part = instances.mesh_parts[instances.part[number]]
                matrix = instances.transforms[number]
                vertices = rotate(part.vertices, matrix[:, :3]) + matrix[:, 3]
                closed = self._closed_parts(part.vertices, part.faces)
                yield Body(vertices, part.faces, None, closed, int(starts[number]))
            first = int(starts[-1])
        for number, actor in enumerate(scene.actors):
            appears, leaves = presence_ns(actor.trajectory)
            if appears <= time_ns <= leaves and self._seen[len(scene.names) + number]:
                yield self._actor_body(number, first, time_ns)
            first += len(actor.mesh.faces)

    def _actor_body(self, number: int, first: int, time_ns: float) -> Body:
        """Return the body of an actor at its pose, with its deformation."""
        actor = self._scene.actors[number]
        mesh = actor.mesh
        vertices = mesh.vertices
        at_ns = np.array([time_ns])
        if mesh.animation is not None:
            vertices = mesh.animation.vertices_at(actor.frames_at(at_ns)[0])[0][0]
        positions, rotations = full_poses(actor.trajectory, 0, at_ns)
        vertices = rotate(vertices, rotations[0]) + positions[0]
        return Body(
            vertices, mesh.faces, None, self._closed_parts(mesh.vertices, mesh.faces), first
        )

    def _closed_parts(
        self, vertices: Floats, faces: Integers, owners: Integers | None = None
    ) -> ClosedParts:
        """Return the closed components of a mesh, which are computed only once."""
        if id(faces) not in self._closed:
            owners = np.zeros(len(faces), np.int64) if owners is None else owners
            self._closed[id(faces)] = ClosedParts.of_mesh(vertices, faces, owners)
        return self._closed[id(faces)]


def _may_overlap(bounds: Floats, grid: VoxelGrid, pose: GridPose) -> Bools:
    """Return whether boxes (n, 2, 3) in the scene frame overlap the bounding box of a grid."""
    corners = np.array([grid.lower, grid.upper], np.float64)
    center = matvec(pose.rotation, corners.mean(axis=0)) + pose.position
    half = matmul(np.abs(pose.rotation), np.ptp(corners, axis=0)[:, None] / 2)[:, 0]
    half += grid.voxel_m
    return np.asarray(
        ((bounds[:, 0] <= center + half) & (bounds[:, 1] >= center - half)).all(axis=1)
    )


def _overlaps(lower: AnyArray, upper: AnyArray, grid: VoxelGrid) -> Bools:
    """Return whether boxes (n, 3) in voxels overlap a grid, with a margin of a voxel."""
    return np.asarray(((lower <= np.array(grid.shape) + 1) & (upper >= -1)).all(axis=1))


def _blocks_in_grid(body: Body, grid: VoxelGrid) -> Iterator[Indices]:
    """Yield the visible faces whose bounding boxes overlap the grid, in blocks."""
    for start in range(0, len(body.faces), BLOCK_FACES):
        faces = body.faces[start : start + BLOCK_FACES]
        a, b, c = (body.vertices[faces[:, corner]] for corner in range(3))
        lower = np.minimum(np.minimum(a, b), c)
        upper = np.maximum(np.maximum(a, b), c)
        kept = _overlaps(lower, upper, grid)
        if body.shown is not None:
            kept &= body.shown[start : start + BLOCK_FACES]
        if kept.any():
            yield start + np.flatnonzero(kept)


def _solids_in_grid(body: Body, grid: VoxelGrid) -> Iterator[Indices]:
    """Yield the faces of each closed component whose bounding box overlaps the grid."""
    faces, starts = body.closed
    if not len(faces):
        return
    corners = body.vertices[body.faces[faces]]
    lower = np.minimum.reduceat(corners.min(axis=1), starts[:-1])
    upper = np.maximum.reduceat(corners.max(axis=1), starts[:-1])
    kept = _overlaps(lower, upper, grid)
    if body.shown is not None:
        kept &= body.shown[faces[starts[:-1]]]
    for number in np.flatnonzero(kept).tolist():
        yield faces[starts[number] : starts[number + 1]]

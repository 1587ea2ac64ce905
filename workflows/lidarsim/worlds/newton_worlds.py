"""Meshes of the objects in the worlds of a Newton model."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Indices
from ..numerics.vectors import rotate
from ..scene.colors import Colors, as_bytes
from ..scene.scene_mesh import SceneMesh, stack_meshes
from .newton_model import NewtonModel
from .newton_shapes import create_shape_mesh
from .shape_meshes import ShapeMesh

Objects = Literal["body", "shape"]


class NewtonObject(NamedTuple):
    """A body, or a shape that is an object of its own."""

    name: str
    mesh: SceneMesh  # in the frame of the body, or of a shape that belongs to no body
    key: Hashable  # equal objects have equal keys and share the arrays of their meshes
    body: int  # -1 for a shape that belongs to no body
    matrix: Floats  # (4, 4): pose of a shape that belongs to no body, in world coordinates


class WorldView(NamedTuple):
    """The objects that the lidars in a world see."""

    shared: list[NewtonObject]  # stationary objects that all worlds share
    fixed: list[NewtonObject]  # stationary objects of this world
    moving: list[NewtonObject]  # bodies

    @property
    def signature(self) -> Hashable:
        """Key that is equal for worlds with the same objects, at any poses."""
        return tuple((item.name, item.key) for item in (*self.fixed, *self.moving))

    @property
    def fixed_matrices(self) -> Floats:
        """Poses of the stationary objects of this world.

        The shape is (k, 4, 4).
        """
        return np.array([item.matrix for item in self.fixed]).reshape(-1, 4, 4)

    @property
    def bodies(self) -> Indices:
        """Indices of the bodies in the model.

        The shape is (k,).
        """
        return np.array([item.body for item in self.moving], np.intp)


class ObjectMeshes:
    """Creates the objects of a model. Equal objects share the arrays of their meshes.

    Parameters
    ----------
    model
        The model.
    shapes
        Indices of the visible shapes.
    objects
        Whether each body or each shape is an object.
    sag_m
        As for `create_shape_mesh`.
    """

    def __init__(self, model: NewtonModel, shapes: Indices, objects: Objects, sag_m: float) -> None:
        self._model = model
        self._objects = objects
        self._sag_m = sag_m
        self._shapes: dict[Hashable, ShapeMesh] = {}  # meshes in the frames of the shapes
        self._meshes: dict[Hashable, SceneMesh] = {}
        self._by_world: dict[int, list[NewtonObject]] = {}
        for group in self._groups(shapes):
            world = int(model.shape_world[group[0]])
            self._by_world.setdefault(world, []).append(self._object(group))

    def view(self, world: int | None) -> WorldView:
        """Return the objects that lidars see in a world, or in all worlds if `world` is None."""
        shared = self._by_world.get(-1, [])
        own = [
            item
            for number, items in self._by_world.items()
            if number >= 0 and world in (None, number)
            for item in items
        ]
        return WorldView(
            [item for item in shared if item.body < 0],
            [item for item in own if item.body < 0],
            [item for item in (*shared, *own) if item.body >= 0],
        )

    def _groups(self, shapes: Indices) -> list[list[int]]:
        """Return the shapes of each object."""
        by_body: dict[int, list[int]] = {}
        groups = []
        for shape in shapes.tolist():
            body = int(self._model.shape_body[shape])
            if body >= 0 and self._objects == "body" and body in by_body:
                by_body[body].append(shape)
                continue
            groups.append([shape])
            by_body[body] = groups[-1]
        return groups

    def _object(self, shapes: list[int]) -> NewtonObject:
        model = self._model
        first = shapes[0]
        body = int(model.shape_body[first])
        key = tuple(self._key(shape, placed=body >= 0) for shape in shapes)
        mesh = self._meshes.get(key)
        if mesh is None:
            mesh = self._meshes[key] = self._mesh(shapes, placed=body >= 0)
        by_shape = body < 0 or self._objects == "shape"
        name = model.shape_labels[first] if by_shape else model.body_labels[body]
        matrix = model.shape_matrix[first] if body < 0 else np.eye(4)
        return NewtonObject(name, mesh, key, body, matrix)

    def _key(self, shape: int, *, placed: bool) -> Hashable:
        """Return a key of the mesh of a shape, and of its pose in the body frame if `placed`."""
        model = self._model
        return (
            int(model.shape_type[shape]),
            model.shape_scale[shape].tobytes(),
            model.shape_color[shape].tobytes(),
            id(model.shape_source[shape]),
            model.shape_matrix[shape].tobytes() if placed else b"",
        )

    def _mesh(self, shapes: list[int], *, placed: bool) -> SceneMesh:
        """Create an unnamed mesh, in the body frame if `placed`, otherwise in the shape frame."""
        meshes = [self._shape_mesh(shape) for shape in shapes]
        if placed:
            meshes = [
                _placed(mesh, self._model.shape_matrix[shape])
                for shape, mesh in zip(shapes, meshes, strict=True)
            ]
        vertices, faces = stack_meshes(meshes)
        face_colors = as_bytes(self._model.shape_color[shapes])
        counts = [len(mesh.faces) for mesh in meshes]
        colors = Colors.from_face_colors(np.repeat(face_colors, counts, axis=0))
        return SceneMesh("", vertices, faces, colors=colors)

    def _shape_mesh(self, shape: int) -> ShapeMesh:
        model = self._model
        source = model.shape_source[shape]
        kind = int(model.shape_type[shape])
        scale = model.shape_scale[shape]
        key = kind, scale.tobytes(), id(source)
        if key not in self._shapes:
            try:
                self._shapes[key] = create_shape_mesh(kind, scale, source, self._sag_m)
            except LidarError as error:
                raise LidarError(
                    f"The shape {model.shape_labels[shape]!r} cannot be converted to a mesh. "
                    f"{error} To ignore it, pass its label as `exclude`."
                ) from error
        return self._shapes[key]


def equal_matrices(views: Sequence[WorldView]) -> bool:
    """Return whether the stationary objects have the same poses in all views."""
    first = views[0].fixed_matrices
    return all(np.array_equal(first, view.fixed_matrices) for view in views)


def _placed(mesh: ShapeMesh, matrix: Floats) -> ShapeMesh:
    return ShapeMesh(rotate(mesh.vertices, matrix[:3, :3]) + matrix[:3, 3], mesh.faces)

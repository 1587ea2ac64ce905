"""The scene: triangles of all objects, near a local origin."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.arguments import as_array, checked, checked_fields, shown
from ..base.errors import LidarpoolError
from ..base.words import counted
from .actors import Actor
from .mesh import Mesh, points_array, stacked
from .meshfile import load_meshes
from .shapes import seed_objects
from .transform import Transform

# Single precision, which ray casters use, resolves a millimetre up to this distance.
FAR_FROM_ZERO_M = 10_000.0


@dataclass(frozen=True, eq=False)
@checked_fields
class Scene:
    """Triangles to scan, and the object of each.

    Coordinates are local: world = `vertices` + `origin`. The origin is zero unless the scene
    lies farther than 10 km from zero (georeferenced data); then it is a point of whole metres
    in the scene's middle, so that single precision is enough for the local coordinates.

    Parameters
    ----------
    vertices
        float64 (v, 3), metres, Z-up, local.
    faces
        int32 (f, 3), f >= 1, indices into `vertices`.
    face_object
        int32 (f,), for each triangle the index of its object in `names`.
    names
        Names of the objects, without duplicates.
    origin
        float64 (3,), whole metres.
    actors
        Moving objects, numbered after the others.

    Raises
    ------
    LidarpoolError
        If there is no triangle, or the arrays do not fit together.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_object: NDArray[np.int32]
    names: tuple[str, ...]
    origin: NDArray[np.float64]
    actors: tuple[Actor, ...] = ()

    def __repr__(self) -> str:
        sides = " x ".join(f"{side:,.2f}" for side in np.ptp(self.bounds, axis=0))
        objects = counted(len(self.all_names), "object")
        return f"<Scene: {objects}, {counted(self.triangles, 'triangle')}, {sides} m>"

    def __post_init__(self) -> None:
        vertices = points_array("the scene", self.vertices)
        faces = np.ascontiguousarray(as_array("faces", self.faces, np.int32))
        owners = np.ascontiguousarray(as_array("face_object", self.face_object, np.int32))
        (origin,) = points_array("the scene's origin", [as_array("origin", self.origin)])
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
            raise LidarpoolError(f"A scene needs triangles, faces of (f, 3), not {faces.shape}.")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise LidarpoolError(f"Faces must name the {len(vertices)} vertices, from 0 up.")
        if owners.shape != faces.shape[:1] or owners.min() < 0 or owners.max() >= len(self.names):
            raise LidarpoolError(
                f"face_object must give one of the {len(self.names)} objects, from 0 up, for "
                f"each of the {len(faces)} faces."
            )
        arrays = {"vertices": vertices, "faces": faces, "face_object": owners, "origin": origin}
        for name, array in arrays.items():
            array = array.view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "actors", tuple(self.actors))

    @classmethod
    def seed(cls) -> Scene:
        """Return the default scene: six surfaces of revolution, 76,800 triangles.

        Examples
        --------
        >>> len(Scene.seed().faces)
        76800
        """
        return cls.from_meshes(seed_objects())

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        unit: str | None = None,
        up_axis: str | None = None,
        transform: Transform | None = None,
    ) -> Scene:
        """Read a mesh file: .glb .gltf .obj .stl .ply .off .dae .3mf.

        Parameters
        ----------
        path
            The file; its objects keep their names.
        unit
            Length unit of the file: um, mm, cm, dm, m, km, in, ft, yd or mi. None takes what
            the file states, else metres.
        up_axis
            Axis of the file that points up: x, y or z. None takes what the file or its format
            states, else z.
        transform
            Placement of the mesh in the world, in metres, after unit and up axis: a
            `lidarpool.scene.transform.Transform`.

        Raises
        ------
        LidarpoolError
            If the file cannot be read completely, or has no triangles.
        """
        return cls.from_meshes(load_meshes(path, unit=unit, up_axis=up_axis, transform=transform))

    @classmethod
    @checked
    def from_meshes(cls, meshes: Iterable[Mesh]) -> Scene:
        """Make a scene of objects, each mesh one object.

        Parameters
        ----------
        meshes
            In world coordinates. Duplicate names are numbered: Shelf, Shelf.2.

        Raises
        ------
        LidarpoolError
            If there are none, or more vertices or triangles than 32 bits can count.
        """
        parts = list(meshes)
        for part in parts:
            if not isinstance(part, Mesh):
                raise LidarpoolError(
                    f"meshes holds {shown(part)}; each must be a Mesh(name, vertices, faces)."
                )
        if not parts:
            raise LidarpoolError("A scene needs at least one object with triangles.")
        sizes = [len(mesh.faces) for mesh in parts]
        points, most = sum(len(mesh.vertices) for mesh in parts), np.iinfo(np.int32).max
        if max(points, sum(sizes)) > most:
            raise LidarpoolError(
                f"The scene has {points} vertices and {sum(sizes)} triangles; at most {most} of "
                "each can be numbered."
            )
        vertices, faces = stacked((mesh.vertices, mesh.faces) for mesh in parts)
        origin = local_origin(vertices)
        return cls(
            vertices=vertices - origin,
            faces=faces.astype(np.int32),
            face_object=np.repeat(np.arange(len(parts), dtype=np.int32), sizes),
            names=unique_names([mesh.name for mesh in parts]),
            origin=origin,
        )

    def with_actors(self, actors: Iterable[Actor]) -> Scene:
        """Return the same scene with other actors; the triangles are not copied.

        Raises
        ------
        LidarpoolError
            If something is no actor.
        """
        found = tuple(actors)
        for actor in found:
            if not isinstance(actor, Actor):
                raise LidarpoolError(
                    f"actors holds {shown(actor)}; each must be an Actor(mesh, trajectory)."
                )
        scene = copy(self)
        object.__setattr__(scene, "actors", found)
        return scene

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all objects, actors after the others."""
        return unique_names((*self.names, *(actor.name for actor in self.actors)))

    @property
    def triangles(self) -> int:
        """Number of triangles, including those of actors."""
        return len(self.faces) + sum(len(actor.mesh.faces) for actor in self.actors)

    def solid(self, time_ns: float | None = None) -> Scene:
        """All triangles, those of actors after the others: in their own axes, or where they are.

        Parameters
        ----------
        time_ns
            Nanoseconds since the survey's start.
        """
        if not self.actors:
            return self
        meshes = [actor.mesh if time_ns is None else actor.placed(time_ns) for actor in self.actors]
        moving = [(mesh.vertices, mesh.faces.astype(np.int32)) for mesh in meshes]
        owners = np.repeat(
            np.arange(len(self.names), len(self.all_names), dtype=np.int32),
            [len(mesh.faces) for mesh in meshes],
        )
        return Scene(
            *stacked([(self.vertices, self.faces), *moving]),
            np.append(self.face_object, owners),
            self.all_names,
            self.origin,
        )

    def meshes(self) -> tuple[Mesh, ...]:
        """Return the objects that have triangles, in world coordinates and in order."""
        order = np.argsort(self.face_object, kind="stable")
        ends = np.cumsum(np.bincount(self.face_object, minlength=len(self.names)))[:-1]
        out = []
        for name, rows in zip(self.names, np.split(order, ends), strict=True):
            if len(rows):
                used, faces = np.unique(self.faces[rows], return_inverse=True)
                out.append(Mesh(name, self.vertices[used] + self.origin, faces.reshape(-1, 3)))
        return tuple(out)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the triangles, local coordinates: (2, 3)."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @cached_property
    def object_bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of each object, local coordinates: (objects, 2, 3).

        An object without triangles has (+inf, -inf).
        """
        corners = self.vertices[self.faces]
        low = np.full((len(self.names), 3), np.inf)
        high = np.full((len(self.names), 3), -np.inf)
        np.minimum.at(low, self.face_object, corners.min(axis=1))
        np.maximum.at(high, self.face_object, corners.max(axis=1))
        return np.stack([low, high], axis=1)

    @cached_property
    def footprints(self) -> NDArray[np.float64]:
        """Circle around each object seen from above, local: (objects, 3) as x, y, radius.

        The circle is centred on the object's bounding rectangle and reaches its farthest
        vertex: exact for discs and rectangles, at most 1.42 times too wide for other outlines.
        """
        centres = self.object_bounds[..., :2].mean(axis=1)
        reach = np.zeros(len(self.names))
        for corner in range(3):
            offset = self.vertices[self.faces[:, corner], :2] - centres[self.face_object]
            np.maximum.at(reach, self.face_object, np.hypot(*offset.T))
        return np.column_stack([centres, reach])


def local_origin(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Choose the origin for world coordinates (v, 3): zero, or whole metres in their middle.

    Whole metres are exact in double precision, so that subtracting and adding them again gives the
    same coordinates.
    """
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    if np.abs(middle).max() <= FAR_FROM_ZERO_M:
        return np.zeros(3)
    return np.round(middle)


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """Make names unique by numbering repeated ones: Shelf, then Shelf.2.

    Examples
    --------
    >>> unique_names(["Shelf", "Shelf", "Shelf.2", "Shelf"])
    ('Shelf', 'Shelf.3', 'Shelf.2', 'Shelf.4')
    """
    given = set(names)
    taken: set[str] = set()
    numbers: dict[str, int] = {}  # {name: the last number given to it}
    out = []
    for name in names:
        unique = name
        while unique in taken or (unique != name and unique in given):
            numbers[name] = numbers.get(name, 1) + 1
            unique = f"{name}.{numbers[name]}"
        taken.add(unique)
        out.append(unique)
    return tuple(out)

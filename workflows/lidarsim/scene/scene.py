"""Scenes, which hold the triangles of all objects relative to a local origin."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..environment.notebook import html_picture, html_table
from ..errors import LidarError
from ..media.materials import SurfaceKinds
from ..motion.trajectory import Track
from ..numerics.arrays import Bools, Floats, Indices, Ints32
from ..numerics.vectors import hypot
from ..schema.checks import as_array, check_fields, check_list
from ..schema.value_texts import format_value
from ..words import list_names, plural
from .actors import Actor
from .colors import GRAY, Colors, are_valid_indices, join_colors
from .face_materials import ObjectMaterials
from .files.meshfile import Objects, load_objects, warn
from .object_names import SameNames, resolve_same_names, unique_names
from .scene_instances import Instances, MeshPart, SceneInstance, split_by_masks
from .scene_mesh import Cutout, SceneMesh, drop_unused_vertices, points_array, stack_meshes
from .shapes import seed_objects
from .transform import Transform

# Up to this distance, the single precision of the ray casters resolves a millimeter.
MAX_LOCAL_COORDINATE_M = 10_000.0

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene of named objects that consist of triangles.

    Coordinates are local: world coordinates are `vertices` + `origin`. The origin is zero unless
    the scene is more than 10 km away from zero, as in georeferenced data. In that case, the origin
    is near the center of the scene, in whole meters, so that single precision is sufficient for
    local coordinates.

    Parameters
    ----------
    vertices
        Local coordinates in meters, with z pointing up. Shape (v, 3), float64.
    faces
        Indices into `vertices`. At least one face is required, unless there are instances. Shape
        (f, 3), int32.
    face_object
        Index into `names` of the object to which each triangle belongs. Shape (f,), int32.
    names
        Unique names of the static objects. The number of an object is its index in `names`.
        `object_names` also contains the actors.
    origin
        World coordinates of the local origin, which are whole meters plus `world_origin`. Shape
        (3,), float64.
    world_origin
        Offset in meters that `with_world_origin` added to `origin`. Without it, world coordinates
        are the coordinates in the scene files. Shape (3,), float64.
    actors
        Moving objects, numbered after the static objects. `faces` does not contain their meshes.
    instances
        Static triangles that are not in `faces`. They belong to mesh parts that are stored once and
        placed any number of times, or that have a mask (transparent pixels) or voxels (leaves).
        Triangles are numbered in the following order: `faces`, then all instances, then the actors.
    colors
        Colors of `faces`, or None. Instances and actors have their own colors.
    materials
        Material names of the static faces in the scene files, or None.
    epsg
        EPSG code of the world coordinates, if the scene file specifies it. Pass it to `Survey` to
        write it to the results.
    vertical_datum
        Name of the vertical datum of the world coordinates, "ellipsoid" for ellipsoidal heights, or
        an empty string if the scene file does not specify it.

    Raises
    ------
    LidarError
        If there are no triangles, or if the arrays are inconsistent.
    """

    vertices: Floats
    faces: Ints32
    face_object: Ints32
    names: tuple[str, ...]
    origin: Floats
    actors: tuple[Actor, ...] = ()
    instances: Instances | None = None
    colors: Colors | None = None
    materials: ObjectMaterials | None = None
    world_origin: Floats = field(default_factory=lambda: np.zeros(3))
    epsg: int | None = None
    vertical_datum: str = ""

    def __repr__(self) -> str:
        sides = " x ".join(f"{side:,.2f}" for side in np.ptp(self.bounds, axis=0))
        objects = plural(len(self.object_names), "object")
        return f"<Scene: {objects}, {plural(self.triangles, 'triangle')}, {sides} m>"

    def _repr_html_(self) -> str:
        """Return an HTML table of the main properties, and an image if a plug-in draws scenes."""
        sides = " × ".join(f"{side:,.2f}" for side in np.ptp(self.bounds, axis=0))
        object_names = self.object_names
        rows = {
            "scene": f"{plural(len(object_names), 'object')}: {list_names(object_names, 8)}",
            "triangles": f"{self.triangles:,}",
            "extent": f"{sides} m",
        }
        if self.origin.any():
            rows["origin"] = ", ".join(f"{value:,.0f}" for value in self.origin) + " m"
        if self.actors:
            rows["actors"] = list_names([actor.name for actor in self.actors], 8)
        if names := [name for name in self.material_names if name]:
            rows["materials"] = list_names(names, 8)
        return html_table(rows.items()) + html_picture(self)

    def __post_init__(self) -> None:
        check_fields(self)
        vertices = points_array("the scene", self.vertices)
        faces = np.ascontiguousarray(as_array("faces", self.faces, np.int32))
        owners = np.ascontiguousarray(as_array("face_object", self.face_object, np.int32))
        (origin,) = points_array("the scene's origin", [as_array("origin", self.origin)])
        world_origin = _world_position(self.world_origin)
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not (len(faces) or self.instances):
            raise LidarError(
                f"The faces of a scene must have the shape (f, 3), but have {faces.shape}."
            )
        if not are_valid_indices(faces, len(vertices)):
            raise LidarError(f"Faces must refer to the {len(vertices)} vertices, counted from 0.")
        if owners.shape != faces.shape[:1] or not are_valid_indices(owners, len(self.names)):
            raise LidarError(
                f"face_object must have the index of one of the {len(self.names)} objects, counted "
                f"from 0, for each of the {len(faces)} faces."
            )
        arrays = {"vertices": vertices, "faces": faces, "face_object": owners}
        arrays |= {"origin": origin, "world_origin": world_origin}
        for name, array in arrays.items():
            # A read-only array belongs to another scene. Both scenes share the same object.
            if array.flags.writeable:
                array = array.view()
                array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "actors", tuple(self.actors))
        if self.colors is not None:
            self.colors.check("the scene", len(faces))

    @classmethod
    def seed(cls) -> Scene:
        """Return the demo scene of six surfaces of revolution with 76,800 triangles.

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
        same_names: SameNames = "number",
        **options: Any,
    ) -> Scene:
        """Read a scene from a file, such as .glb, .obj, .usd, CityJSON, .xodr, .ifc or .tif.

        Parameters
        ----------
        path
            Path of the scene file. Objects keep their names.
        same_names
            How to treat objects with the same name: "number" appends numbers (Wall, Wall.2), and
            "join" merges them into one object.
        **options
            Options for all formats are listed below. Options for specific formats, such as
            `storeys` for buildings (.ifc) and `step_m` for rasters, have the same names as in
            `scene.files` in scenarios. The only exception is `epsg`, the coordinate system to which
            a raster is transformed. Scenarios use `world.epsg` instead.

        Other Parameters
        ----------------
        unit
            Length unit of the file: um, mm, cm, dm, m, km, in, ft, yd or mi. The default is the
            unit that the file specifies (.dae, .3mf, .usd, .glb and .gltf), otherwise meters.
        up_axis
            Axis that points up in the file: x, y or z. The default is the axis that the file (.dae,
            .usd) or its format (y for .glb and .gltf) specifies, otherwise z.
        transform
            A `lidarsim.scene.transform.Transform` that places the mesh in the world, in meters. It
            is applied after `unit` and `up_axis`.
        opacity
            With "mask", light passes where the image of a material is transparent (.glb, .gltf,
            .obj, .usd). With "ignore", all triangles are opaque, and no images are read.
        colors
            Whether to read base colors and their images (.glb, .gltf, .obj, .dae, .usd, CityJSON,
            .xodr, and .ifc without images) and vertex colors (.glb, .gltf, .obj, .ply, .off, .usd).
        materials
            Whether to store the material names of faces (.glb, .gltf, .obj, .dae, .3mf, .usd,
            CityJSON, .xodr, .ifc), so that a `Material` can select faces by these names.
        assets
            Folder with additional files to which the scene file refers. Files are read from this
            folder, from the folder of the scene file, and from their subfolders. Models of a Gazebo
            world are searched for in this folder first.

        Returns
        -------
        Scene
            The scene. Moving objects in a .usd file become actors if the scene has static objects.

        Raises
        ------
        LidarError
            If the file cannot be read completely, contains no triangles, or requires an option that
            is not set.
        """
        if options.get("animation") is not None:
            raise LidarError(
                f"{path}: animation cannot be used in a scene. Create an Actor from "
                "load_objects(path, animation=…) and join_meshes."
            )
        objects = load_objects(path, **options)
        static = resolve_same_names(
            objects.static, same_names, lambda note: warn(f"{path}: {note}")
        )
        return cls.from_objects(objects._replace(static=tuple(static)))

    @classmethod
    def from_objects(cls, objects: Objects, report: Callable[[str], None] = _log.warning) -> Scene:
        """Create a scene from the objects of mesh files.

        A scene requires at least one static object. If there are none, the actors become static
        objects at their first pose, and `report` is called with a warning that their motion is
        lost.
        """
        if not objects.static:
            note_start = "a scene requires at least one static object. This scene moves "
            return cls.from_meshes(objects.at_start(lambda line: report(note_start + line)))
        scene = cls.from_meshes(objects.static)
        object.__setattr__(scene, "epsg", objects.epsg)
        object.__setattr__(scene, "vertical_datum", objects.vertical_datum)
        actors = []
        for actor in objects.actors:
            track = actor.trajectory
            assert isinstance(track, Track)
            track = replace(track, positions=track.positions - scene.origin)
            actors.append(replace(actor, trajectory=track))
        return scene.with_actors(actors) if actors else scene

    @classmethod
    def from_meshes(cls, meshes: Iterable[SceneMesh | SceneInstance]) -> Scene:
        """Create a scene with one object per mesh.

        Parameters
        ----------
        meshes
            Meshes in world coordinates, or instances. Instances of the same mesh share its
            triangles. Duplicate names are numbered (Shelf, Shelf.2).

        Raises
        ------
        LidarError
            If there are no meshes, or if the number of vertices or triangles exceeds the range of
            32-bit integers.
        """
        check_list("meshes", meshes)
        objects = list(meshes)
        _check_objects(objects)
        split = _split_by_kind(objects)
        _check_counts(split)
        sizes = [len(mesh.faces) for mesh in split.meshes]
        vertices = np.zeros((0, 3))
        faces = np.zeros((0, 3), np.int64)
        if split.meshes:
            vertices, faces = stack_meshes((mesh.vertices, mesh.faces) for mesh in split.meshes)
        instances = split.instances()
        corners = [vertices]
        if instances is not None:
            corners.append(instances.bounds.reshape(-1, 3))
        origin = local_origin(np.concatenate(corners))
        if instances is not None and origin.any():
            instances = instances.relative_to(origin)
        return cls(
            vertices=vertices - origin,
            faces=faces.astype(np.int32),
            face_object=np.repeat(np.array(split.mesh_owners, np.int32), sizes),
            names=unique_names([item.name for item in objects]),
            origin=origin,
            instances=instances,
            colors=join_colors([mesh.colors for mesh in split.meshes], sizes),
            materials=ObjectMaterials.from_meshes(
                [
                    (item if isinstance(item, SceneMesh) else item.mesh).materials
                    for item in objects
                ],
                [mesh.materials for mesh in split.meshes],
                sizes,
            ),
        )

    def with_actors(self, actors: Iterable[Actor]) -> Scene:
        """Return a copy of the scene with its actors replaced.

        Both scenes share the static triangles.

        Raises
        ------
        LidarError
            If `actors` contains anything other than actors.
        """
        actors = tuple(actors)
        for actor in actors:
            if not isinstance(actor, Actor):
                raise LidarError(
                    "actors must contain Actor(mesh, trajectory), but contains "
                    f"{format_value(actor)}."
                )
        scene = copy(self)
        object.__setattr__(scene, "actors", actors)
        return scene

    def with_world_origin(self, world_origin: ArrayLike) -> Scene:
        """Return the same scene at another location in the world.

        Local coordinates and the poses of surveys do not change.

        Parameters
        ----------
        world_origin
            Offset in meters that is added to the coordinates in the scene files when points are
            written. Shape (3,). An offset of zero restores the original location.

        Examples
        --------
        >>> Scene.seed().with_world_origin((500_000, 5_400_000, 0)).origin.tolist()
        [500000.0, 5400000.0, 0.0]
        """
        added = _world_position(world_origin)
        if np.array_equal(added, self.world_origin):
            return self
        scene = copy(self)
        object.__setattr__(scene, "origin", self.origin - self.world_origin + added)
        object.__setattr__(scene, "world_origin", added)
        return scene

    def with_instance_poses(
        self, instance_indices: Indices, positions: Floats, rotations: Floats
    ) -> Scene:
        """Return a copy of the scene in which some instances are moved to new poses.

        Instances keep their scales.

        Parameters
        ----------
        instance_indices
            Indices of the instances to move. Shape (m,).
        positions
            New positions of the mesh frames in local coordinates, in meters. Shape (m, 3).
        rotations
            Rotation matrices from the mesh frames to local coordinates. Shape (m, 3, 3).
        """
        assert self.instances is not None
        scene = copy(self)
        for cached in ("bounds", "object_bounds", "footprints"):
            vars(scene).pop(cached, None)
        moved = self.instances.with_poses(instance_indices, positions, rotations)
        object.__setattr__(scene, "instances", moved)
        return scene

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of all objects, with static objects first and actors last.

        The column `object` contains indices into these names.
        """
        if not self.actors:
            return self.names
        return unique_names((*self.names, *(actor.name for actor in self.actors)))

    @property
    def surface_kinds(self) -> SurfaceKinds:
        """Surface kinds of all objects, with one per material of each object.

        The surface kinds of actors come last.
        """
        names = self.object_names
        static = [()] * len(self.names) if self.materials is None else self.materials.names
        moving = [
            () if actor.mesh.materials is None else actor.mesh.materials.names
            for actor in self.actors
        ]
        materials = [object_materials or ("",) for object_materials in (*static, *moving)]
        counts = [len(object_materials) for object_materials in materials]
        if max(counts, default=1) == 1:
            return SurfaceKinds(names, np.arange(len(names)), [name for (name,) in materials])
        owners = np.repeat(np.arange(len(names)), counts)
        return SurfaceKinds(names, owners, list(chain.from_iterable(materials)))

    @property
    def has_mixed_objects(self) -> bool:
        """Whether any object has faces with different materials."""
        static = () if self.materials is None else self.materials.names
        moving = (actor.mesh.materials for actor in self.actors)
        return any(len(names) > 1 for names in static) or any(
            materials is not None and len(materials.names) > 1 for materials in moving
        )

    @property
    def material_names(self) -> tuple[str, ...]:
        """Distinct names of all face materials.

        The column `material` contains indices into these names.
        """
        return tuple(name for name in dict.fromkeys(self.surface_kinds.material) if name)

    @property
    def face_materials(self) -> Ints32 | None:
        """Index into `material_names` for each static face, or None if no material has a name.

        The index is -1 for faces whose material has no name.
        """
        if self.materials is None or not self.material_names:
            return None
        kinds = self.surface_kinds
        numbers = {name: number for number, name in enumerate(self.material_names)}
        of_kind = np.array([numbers.get(name, -1) for name in kinds.material], np.int32)
        rows = kinds.first[self.face_object]
        if self.materials.index is not None:
            is_mixed = np.array([len(names) > 1 for names in self.materials.names])
            rows = rows + self.materials.index * is_mixed[self.face_object]
        return of_kind[rows]

    @property
    def masked_objects(self) -> tuple[str, ...]:
        """Names of the objects with opacity masks, in the order of `object_names`."""
        owners = set()
        if (instances := self.instances) is not None:
            owners = set(instances.owners(lambda part: part.mask is not None).tolist())
        first_actor = len(self.names)
        owners |= {first_actor + i for i, actor in enumerate(self.actors) if actor.mesh.cutouts}
        return tuple(name for i, name in enumerate(self.object_names) if i in owners)

    @property
    def all_colors(self) -> list[Colors]:
        """Colors of all parts of the scene that have colors.

        The list contains the colors of `faces`, of instances and of actors, in this order. It is
        empty if the entire scene is gray.
        """
        parts = self.instances.mesh_parts if self.instances else ()
        colors = [self.colors, *(part.colors for part in parts)]
        colors += [actor.mesh.colors for actor in self.actors]
        return [mesh_colors for mesh_colors in colors if mesh_colors is not None]

    @property
    def has_colors(self) -> Bools:
        """Boolean mask of the objects that have a color.

        The shape is (objects,). Actors come last.
        """
        has_color = np.zeros(len(self.object_names), np.bool_)
        if (colors := self.colors) is not None:
            gray = np.array([image is GRAY for image in colors.images])
            # Faces without a color have the image `GRAY` if other faces are colored.
            has_color[self.face_object[~gray[colors.image]]] = True
        if (instances := self.instances) is not None:
            has_color[instances.owners(lambda part: part.colors is not None)] = True
        has_color[len(self.names) :] = [actor.mesh.colors is not None for actor in self.actors]
        return has_color

    @property
    def has_voxels(self) -> Bools:
        """Boolean mask of the objects that are filled with leaf voxels.

        The shape is (objects,). Actors come last.
        """
        has_voxels = np.zeros(len(self.names) + len(self.actors), np.bool_)
        if (instances := self.instances) is not None:
            has_voxels[instances.owners(lambda part: part.voxels is not None)] = True
        return has_voxels

    @property
    def triangles(self) -> int:
        """Number of triangles, including those of all instances and actors."""
        instance_triangles = self.instances.triangles if self.instances else 0
        return (
            len(self.faces)
            + instance_triangles
            + sum(len(actor.mesh.faces) for actor in self.actors)
        )

    @property
    def kept_triangles(self) -> int:
        """Number of static triangles in memory.

        Triangles that several instances share are counted once.
        """
        parts = self.instances.mesh_parts if self.instances else ()
        return len(self.faces) + sum(len(part.faces) for part in parts)

    @property
    def counters(self) -> int:
        """Number of hit counters.

        Each triangle in `faces`, each instance, and each triangle of an actor has a counter, in
        this order.
        """
        instance_count = len(self.instances) if self.instances else 0
        return (
            len(self.faces) + instance_count + sum(len(actor.mesh.faces) for actor in self.actors)
        )

    def solid(self, time_ns: float) -> Scene:
        """Return a scene in which the actors are static objects at their poses at a given time.

        The returned scene has no instances. However, a scene without actors is returned unchanged,
        including its instances.

        Parameters
        ----------
        time_ns
            Time in nanoseconds since the start of the survey.
        """
        if not self.actors:
            return self
        meshes = [actor.mesh_at(time_ns) for actor in self.actors]
        moving = [(mesh.vertices, mesh.faces.astype(np.int32)) for mesh in meshes]
        owners = np.repeat(
            np.arange(len(self.names), len(self.object_names), dtype=np.int32),
            [len(mesh.faces) for mesh in meshes],
        )
        sizes = [len(self.faces), *(len(faces) for _, faces in moving)]
        return Scene(
            *stack_meshes([(self.vertices, self.faces), *moving]),
            np.append(self.face_object, owners),
            self.object_names,
            self.origin,
            world_origin=self.world_origin,
            colors=join_colors([self.colors, *(mesh.colors for mesh in meshes)], sizes),
        )

    def meshes(self) -> tuple[SceneMesh | SceneInstance, ...]:
        """Return the static objects that have triangles, in order and in world coordinates.

        An object with masks is split into one mesh or instance per part.
        """
        by_object: list[list[SceneMesh | SceneInstance]] = [[] for _ in self.names]
        order = np.argsort(self.face_object, kind="stable")
        stops = np.cumsum(np.bincount(self.face_object, minlength=len(self.names)))[:-1]
        for owner, rows in enumerate(np.split(order, stops)):
            if len(rows):
                by_object[owner].append(self._mesh_of_faces(owner, rows))
        if (instances := self.instances) is not None:
            meshes = [
                self._mesh_of_shared_part(instances, index)
                for index in range(len(instances.mesh_parts))
            ]
            for index, matrix, owner in zip(
                instances.part, instances.transforms, instances.owner, strict=True
            ):
                transform = Transform(matrix[:, :3], matrix[:, 3] + self.origin)
                instance = SceneInstance(meshes[index], transform, self.names[owner])
                by_object[owner].append(instance)
        return tuple(item for items in by_object for item in items)

    def _mesh_of_faces(self, owner: int, face_indices: Indices) -> SceneMesh:
        points, faces = drop_unused_vertices(self.vertices, self.faces[face_indices])
        return SceneMesh(
            self.names[owner],
            points + self.origin,
            faces,
            colors=self.colors and self.colors.take(face_indices),
            materials=None
            if self.materials is None
            else self.materials.for_object(owner, face_indices),
        )

    def _mesh_of_shared_part(self, instances: Instances, index: int) -> SceneMesh:
        """Return a part that instances share as a mesh in the frame of the part.

        The mesh is named after the first object that contains the part.
        """
        part = instances.mesh_parts[index]
        cutouts = () if part.mask is None or part.uv is None else (Cutout(part.mask, part.uv),)
        return SceneMesh(
            self.names[instances.owner[np.argmax(instances.part == index)]],
            part.vertices,
            part.faces.astype(np.int64),
            cutouts,
            part.colors,
            part.voxels,
            materials=part.materials,
        )

    @cached_property
    def bounds(self) -> Floats:
        """Bounding box of the static triangles in local coordinates, in meters.

        The shape is (2, 3).
        """
        corners = self._face_bounds
        if self.instances:
            corners = np.concatenate([corners, self.instances.bounds.reshape(-1, 3)])
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @cached_property
    def _face_bounds(self) -> Floats:
        """Bounding box of `faces` in local coordinates, in meters.

        The shape is (2, 3), or (0, 3) if there are no faces.
        """
        is_used = np.zeros(len(self.vertices), np.bool_)
        is_used[self.faces] = True
        used = self.vertices[is_used]
        return np.stack([used.min(axis=0), used.max(axis=0)]) if len(used) else used

    @cached_property
    def object_bounds(self) -> Floats:
        """Bounding boxes of the static objects in local coordinates, in meters.

        The shape is (objects, 2, 3). The box of an object without triangles is (+inf, -inf).
        """
        corners = self.vertices[self.faces]
        lower = np.full((len(self.names), 3), np.inf)
        upper = np.full((len(self.names), 3), -np.inf)
        np.minimum.at(lower, self.face_object, corners.min(axis=1))
        np.maximum.at(upper, self.face_object, corners.max(axis=1))
        if (instances := self.instances) is not None:
            np.minimum.at(lower, instances.owner, instances.bounds[:, 0])
            np.maximum.at(upper, instances.owner, instances.bounds[:, 1])
        return np.stack([lower, upper], axis=1)

    @cached_property
    def footprints(self) -> Floats:
        """Bounding circles of the static objects in the xy plane.

        The shape is (objects, 3). Each row contains x, y and the radius in meters, in local
        coordinates.

        The circle is centered on the bounding rectangle of the object and passes through its
        farthest vertex. It is exact for discs and rectangles. For other outlines, the radius is at
        most 1.42 times too large.
        """
        centers = self.object_bounds[..., :2].mean(axis=1)
        reach = np.zeros(len(self.names))
        for corner in range(3):
            offset = self.vertices[self.faces[:, corner], :2] - centers[self.face_object]
            np.maximum.at(reach, self.face_object, hypot(*offset.T))
        if (instances := self.instances) is not None:
            np.maximum.at(reach, instances.owner, instances.reach(centers[instances.owner]))
        return np.column_stack([centers, reach])


def _world_position(value: ArrayLike) -> Floats:
    position = np.array(as_array("world_origin", value))
    if position.shape != (3,) or not np.isfinite(position).all():
        raise LidarError(
            f"world_origin must be x, y and z in meters, but is {format_value(value)}."
        )
    position.flags.writeable = False
    return position


def local_origin(vertices: Floats) -> Floats:
    """Return a suitable local origin for world coordinates.

    The origin is zero, or the center of the bounding box in whole meters if that center is more
    than `MAX_LOCAL_COORDINATE_M` away from zero along any axis. Whole meters are exact in double
    precision, so that subtracting the origin and adding it again restores the coordinates.
    """
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    if np.abs(middle).max() <= MAX_LOCAL_COORDINATE_M:
        return np.zeros(3)
    return np.round(middle)


class _PlacedPart(NamedTuple):
    owner: int  # index of the object
    part: int  # index of the part
    matrix: Floats  # (4, 4), from the frame of the part to world coordinates


@dataclass
class _SplitObjects:
    """Objects of a scene, split into meshes to copy and parts to instantiate.

    Meshes are in world coordinates. Parts are in the frame of their mesh. The owner of a mesh or
    part is the index of its object.
    """

    meshes: list[SceneMesh] = field(default_factory=list)  # without masks and voxels
    mesh_owners: list[int] = field(default_factory=list)  # index of each mesh's object
    mesh_parts: list[MeshPart] = field(default_factory=list)
    placed_parts: list[_PlacedPart] = field(default_factory=list)

    def add_mesh(self, owner: int, mesh: SceneMesh) -> None:
        """Add a mesh whose triangles are copied to the scene."""
        self.meshes.append(mesh)
        self.mesh_owners.append(owner)

    def instances(self) -> Instances | None:
        """Return the instances in world coordinates, or None if there are none."""
        if not self.placed_parts:
            return None
        owners, parts, matrices = zip(*self.placed_parts, strict=True)
        return Instances(
            tuple(self.mesh_parts),
            np.array(parts, np.intp),
            np.array(matrices)[:, :3],
            np.array(owners, np.int32),
        )


def _check_objects(objects: Sequence[object]) -> None:
    for item in objects:
        if not isinstance(item, (SceneMesh, SceneInstance)):
            raise LidarError(
                "meshes must contain SceneMesh or SceneInstance, but contains "
                f"{format_value(item)}."
            )
    if not objects:
        raise LidarError("A scene requires at least one object with triangles.")


def _split_by_kind(objects: Sequence[SceneMesh | SceneInstance]) -> _SplitObjects:
    """Split objects into meshes to copy and parts to instantiate.

    A `SceneMesh` without masks and voxels is copied. All other meshes are divided into one part for
    each mask and one part for the opaque triangles. The parts of a `SceneInstance` all become
    instances. The opaque part of a `SceneMesh` is copied, whereas its parts with a mask or voxels
    become instances.
    """
    split = _SplitObjects()
    part_indices: dict[SceneMesh, range] = {}
    for owner, item in enumerate(objects):
        is_mesh = isinstance(item, SceneMesh)
        if isinstance(item, SceneMesh):
            if not item.cutouts and item.voxels is None:
                split.add_mesh(owner, item)
                continue
            mesh = item
            matrix = np.eye(4)
        else:
            mesh = item.mesh
            matrix = item.matrix
        if mesh not in part_indices:
            first = len(split.mesh_parts)
            split.mesh_parts += split_by_masks(mesh)
            part_indices[mesh] = range(first, len(split.mesh_parts))
        for index in part_indices[mesh]:
            part = split.mesh_parts[index]
            if is_mesh and part.mask is None and part.voxels is None:
                split.add_mesh(owner, _mesh_of_part(item.name, part))
            else:
                split.placed_parts.append(_PlacedPart(owner, index, matrix))
    return split


def _mesh_of_part(name: str, part: MeshPart) -> SceneMesh:
    return SceneMesh(
        name,
        part.vertices,
        part.faces.astype(np.int64),
        colors=part.colors,
        materials=part.materials,
    )


def _check_counts(split: _SplitObjects) -> None:
    """Raise LidarError if there are more vertices or triangles than 32-bit integers can index."""
    vertices = sum(len(mesh.vertices) for mesh in split.meshes)
    triangles = sum(len(mesh.faces) for mesh in split.meshes)
    triangles += sum(len(split.mesh_parts[placed.part].faces) for placed in split.placed_parts)
    max_count = np.iinfo(np.int32).max
    if max(vertices, triangles) > max_count:
        raise LidarError(
            f"The scene has {vertices} vertices and {triangles} triangles, but each is limited to "
            f"{max_count}."
        )

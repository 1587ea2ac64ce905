"""The scene: triangles of all objects, near a local origin."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..base.arrays import Bools, Floats, Ints32
from ..base.errors import LidarError
from ..base.validation import as_array, checked, checked_fields, shown
from ..base.vectors import hypot
from ..base.words import plural
from ..sensor import Pose, Track
from ..sensor.materials import SurfaceKinds
from . import colours as coloured
from .actors import Actor
from .colours import Colours, within
from .face_materials import ObjectMaterials
from .files.meshfile import Objects, OpacityMode, load_objects, warn
from .files.scene_graph import Window
from .object_names import SameNames, told_apart, unique_names
from .scene_instances import Instances, MeshPart, SceneInstance, parts_of
from .scene_mesh import Cutout, SceneMesh, compacted, points_array, stacked
from .shapes import seed_objects
from .transform import Transform

# Single precision, which ray casters use, resolves a millimetre up to this distance.
FAR_FROM_ZERO_M = 10_000.0

_log = logging.getLogger(__name__)


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
    instances
        Triangles that are kept once and are in several places, or have a mask; they are numbered
        after `faces`, instance by instance. Those of actors follow.
    colours
        Of `faces`; None if they have none.
    materials
        Names of the materials of the objects; None if they have none.

    Raises
    ------
    LidarError
        If there is no triangle, or the arrays do not fit together.
    """

    vertices: Floats
    faces: Ints32
    face_object: Ints32
    names: tuple[str, ...]
    origin: Floats
    actors: tuple[Actor, ...] = ()
    instances: Instances | None = None
    colours: Colours | None = None
    materials: ObjectMaterials | None = None

    def __repr__(self) -> str:
        sides = " x ".join(f"{side:,.2f}" for side in np.ptp(self.bounds, axis=0))
        objects = plural(len(self.all_names), "object")
        return f"<Scene: {objects}, {plural(self.triangles, 'triangle')}, {sides} m>"

    def __post_init__(self) -> None:
        vertices = points_array("the scene", self.vertices)
        faces = np.ascontiguousarray(as_array("faces", self.faces, np.int32))
        owners = np.ascontiguousarray(as_array("face_object", self.face_object, np.int32))
        (origin,) = points_array("the scene's origin", [as_array("origin", self.origin)])
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not (len(faces) or self.instances):
            raise LidarError(f"A scene needs triangles, faces of (f, 3), not {faces.shape}.")
        if not within(faces, len(vertices)):
            raise LidarError(f"Faces must name the {len(vertices)} vertices, from 0 up.")
        if owners.shape != faces.shape[:1] or not within(owners, len(self.names)):
            raise LidarError(
                f"face_object must give one of the {len(self.names)} objects, from 0 up, for "
                f"each of the {len(faces)} faces."
            )
        arrays = {"vertices": vertices, "faces": faces, "face_object": owners, "origin": origin}
        for name, array in arrays.items():
            if array.flags.writeable:  # else it is another scene's, and known by its identity
                array = array.view()
                array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "actors", tuple(self.actors))
        if self.colours is not None:
            self.colours.check("the scene", len(faces))

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
        opacity: OpacityMode = "mask",
        colours: bool = False,
        materials: bool = False,
        step_m: float | None = None,
        window: Window | None = None,
        epsg: int | None = None,
        assets: str | Path | None = None,
        same_names: SameNames = "number",
    ) -> Scene:
        """Read a scene file, such as .glb, .obj, .usd, CityJSON, or a raster of heights (.tif).

        Parameters
        ----------
        path
            The file; its objects keep their names.
        unit
            Length unit of the file: um, mm, cm, dm, m, km, in, ft, yd or mi. None takes what
            the file states (.dae, .3mf, .usd, .glb and .gltf), else metres.
        up_axis
            Axis of the file that points up: x, y or z. None takes what the file (.dae, .usd) or
            its format states (y of .glb and .gltf), else z.
        transform
            Placement of the mesh in the world, in metres, after unit and up axis: a
            `lidarsim.scene.transform.Transform`.
        opacity
            With "mask", light passes where the image of a material is transparent (.glb, .gltf,
            .obj, .usd). With "ignore", triangles are solid, and no image is read.
        colours
            Whether to read base colours and their images (.glb, .gltf, .obj, .dae, .usd, CityJSON
            without images), and colours of vertices (.glb, .gltf, .obj, .ply, .off, .usd).
        materials
            Whether faces keep the names of their materials (.glb, .gltf, .obj, .dae, .3mf, .usd,
            CityJSON), by which `Material` may choose them.
        step_m, window, epsg
            Of a raster: see `lidarsim.scene.files.meshfile.load_objects`.
        assets
            A folder: files that the file names are read from here and below, and from its own
            folder and below.
        same_names
            With "number", objects that have the name of another one get a number: Wall, Wall.2.
            With "join", all objects of a name are one object.

        Returns
        -------
        Objects of .usd that move are its actors, if others stand.

        Raises
        ------
        LidarError
            If the file cannot be read completely, or has no triangles.
        """
        found = load_objects(
            path,
            unit=unit,
            up_axis=up_axis,
            transform=transform,
            opacity=opacity,
            colours=colours,
            materials=materials,
            step_m=step_m,
            window=window,
            epsg=epsg,
            assets=assets,
        )
        standing = told_apart(found.standing, same_names, lambda note: warn(f"{path}: {note}"))
        return cls.of_objects(found._replace(standing=tuple(standing)))

    @classmethod
    def of_objects(cls, objects: Objects, tell: Callable[[str], None] = _log.warning) -> Scene:
        """Make a scene of the objects of mesh files; `tell` is called if none stands."""
        if not objects.standing:
            lost = "nothing stands in the scene, and without that nothing moves: "
            return cls.from_meshes(objects.still(lambda line: tell(lost + line)))
        scene = cls.from_meshes(objects.standing)
        local = []
        for actor in objects.moving:
            track = actor.trajectory
            assert isinstance(track, Track)
            track = replace(track, positions=track.positions - scene.origin)
            local.append(replace(actor, trajectory=track))
        return scene.with_actors(local) if local else scene

    @classmethod
    @checked
    def from_meshes(cls, meshes: Iterable[SceneMesh | SceneInstance]) -> Scene:
        """Make a scene of objects, each mesh one object.

        Parameters
        ----------
        meshes
            In world coordinates, or instances of meshes, whose triangles are kept once. Duplicate
            names are numbered: Shelf, Shelf.2.

        Raises
        ------
        LidarError
            If there are none, or more vertices or triangles than 32 bits can count.
        """
        objects = list(meshes)
        for one in objects:
            if not isinstance(one, (SceneMesh, SceneInstance)):
                raise LidarError(
                    f"meshes holds {shown(one)}; each must be a SceneMesh(name, vertices, faces), "
                    "or a SceneInstance of one."
                )
        if not objects:
            raise LidarError("A scene needs at least one object with triangles.")
        plain: list[tuple[int, SceneMesh]] = []  # (object, mesh without masks and voxels)
        shared: list[tuple[int, int, Floats]] = []  # (object, part, matrix)
        parts: list[MeshPart] = []
        known: dict[SceneMesh, list[int]] = {}  # {mesh of instances: its parts}
        for number, one in enumerate(objects):
            if isinstance(one, SceneMesh) and not one.cutouts and one.voxels is None:
                plain.append((number, one))
                continue
            mesh, matrix = (
                (one, np.eye(4)) if isinstance(one, SceneMesh) else (one.mesh, one.matrix)
            )
            if mesh not in known:
                made = list(parts_of(mesh))
                known[mesh] = list(range(len(parts), len(parts) + len(made)))
                parts += made
            for part in known[mesh]:
                if isinstance(one, SceneMesh) and parts[part].mask is None and one.voxels is None:
                    solid = parts[part]
                    corners = solid.faces.astype(np.int64)
                    mesh = SceneMesh(
                        one.name,
                        solid.vertices,
                        corners,
                        colours=solid.colours,
                        materials=solid.materials,
                    )
                    plain.append((number, mesh))
                else:
                    shared.append((number, part, matrix))
        sizes = [len(mesh.faces) for _, mesh in plain]
        points = sum(len(mesh.vertices) for _, mesh in plain)
        most = np.iinfo(np.int32).max
        triangles = sum(sizes) + sum(len(parts[part].faces) for _, part, _ in shared)
        if max(points, triangles) > most:
            raise LidarError(
                f"The scene has {points} vertices and {triangles} triangles; at most {most} of "
                "each can be numbered."
            )
        vertices = np.zeros((0, 3))
        faces = np.zeros((0, 3), np.int64)
        if plain:
            vertices, faces = stacked((mesh.vertices, mesh.faces) for _, mesh in plain)
        instances = None
        ends = [vertices]
        if shared:
            owners, used, matrices = zip(*shared, strict=True)
            transforms = np.array(matrices)[:, :3]
            instances = Instances(
                tuple(parts), np.array(used, np.intp), transforms, np.array(owners, np.int32)
            )
            ends.append(instances.bounds.reshape(-1, 3))
        origin = local_origin(np.concatenate(ends))
        if instances is not None and origin.any():
            transforms = transforms - np.pad(origin[:, None], ((0, 0), (3, 0)))
            bounds = instances.bounds - origin
            instances = replace(instances, transforms=transforms)
            vars(instances)["bounds"] = bounds  # which take time
        return cls(
            vertices=vertices - origin,
            faces=faces.astype(np.int32),
            face_object=np.repeat(np.array([n for n, _ in plain], np.int32), sizes),
            names=unique_names([one.name for one in objects]),
            origin=origin,
            instances=instances,
            colours=coloured.joined([mesh.colours for _, mesh in plain], sizes),
            materials=ObjectMaterials.of(
                [(one if isinstance(one, SceneMesh) else one.mesh).materials for one in objects],
                [mesh.materials for _, mesh in plain],
                sizes,
            ),
        )

    def with_actors(self, actors: Iterable[Actor]) -> Scene:
        """Return the same scene with other actors; the triangles are not copied.

        Raises
        ------
        LidarError
            If something is no actor.
        """
        found = tuple(actors)
        for actor in found:
            if not isinstance(actor, Actor):
                raise LidarError(
                    f"actors holds {shown(actor)}; each must be an Actor(mesh, trajectory)."
                )
        scene = copy(self)
        object.__setattr__(scene, "actors", found)
        return scene

    def moved(self, owner: int, pose: Pose) -> Scene:
        """Return the same scene with the instances of an object at a pose of their mesh's axes.

        They keep their scale; the pose is in local coordinates.
        """
        assert self.instances is not None
        scene = copy(self)
        for made_before in ("bounds", "object_bounds", "footprints"):
            vars(scene).pop(made_before, None)
        moved = self.instances.moved(owner, np.array(pose.position), pose.rotation_matrix)
        object.__setattr__(scene, "instances", moved)
        return scene

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all objects, actors after the others."""
        if not self.actors:
            return self.names
        return unique_names((*self.names, *(actor.name for actor in self.actors)))

    @property
    def surface_kinds(self) -> SurfaceKinds:
        """Kinds of surfaces: objects, actors after the others, by the materials of their faces."""
        names = self.all_names
        of_objects = [()] * len(self.names) if self.materials is None else self.materials.names
        of_actors = [
            () if actor.mesh.materials is None else actor.mesh.materials.names
            for actor in self.actors
        ]
        materials = [of_one or ("",) for of_one in (*of_objects, *of_actors)]
        if all(len(of_one) == 1 for of_one in materials):
            return SurfaceKinds(names, np.arange(len(names)), [name for (name,) in materials])
        owners = np.repeat(np.arange(len(names)), [len(of_one) for of_one in materials])
        return SurfaceKinds(names, owners, [name for of_one in materials for name in of_one])

    @property
    def has_mixed_objects(self) -> bool:
        """Whether an object has faces of several materials."""
        of_objects = () if self.materials is None else self.materials.names
        of_actors = (actor.mesh.materials for actor in self.actors)
        return any(len(names) > 1 for names in of_objects) or any(
            materials is not None and len(materials.names) > 1 for materials in of_actors
        )

    @property
    def material_names(self) -> tuple[str, ...]:
        """Names of all materials of faces, each once: what the column `material` counts."""
        return tuple(name for name in dict.fromkeys(self.surface_kinds.material) if name)

    @property
    def masked(self) -> tuple[str, ...]:
        """Names of the objects that stop light only in part, in order."""
        owners = set()
        if (shared := self.instances) is not None:
            owners = set(shared.owners(lambda part: part.mask is not None).tolist())
        own = len(self.names)
        owners |= {own + i for i, actor in enumerate(self.actors) if actor.mesh.cutouts}
        return tuple(name for i, name in enumerate(self.all_names) if i in owners)

    @property
    def coloured(self) -> list[Colours]:
        """Colours of all that has some: the faces, parts of instances, actors."""
        parts = self.instances.parts if self.instances else ()
        found = [self.colours, *(part.colours for part in parts)]
        found += [actor.mesh.colours for actor in self.actors]
        return [colours for colours in found if colours is not None]

    @property
    def has_colours(self) -> Bools:
        """Whether each object, actors after the others, has a colour: (objects,)."""
        found = np.zeros(len(self.all_names), np.bool_)
        if (own := self.colours) is not None:
            grey = np.array([image is coloured.GREY for image in own.images])
            found[self.face_object[~grey[own.image]]] = True
        if (shared := self.instances) is not None:
            found[shared.owners(lambda part: part.colours is not None)] = True
        found[len(self.names) :] = [actor.mesh.colours is not None for actor in self.actors]
        return found

    @property
    def has_voxels(self) -> Bools:
        """Whether each object, actors after the others, has voxels: (objects,)."""
        found = np.zeros(len(self.names) + len(self.actors), np.bool_)
        if (shared := self.instances) is not None:
            found[shared.owners(lambda part: part.voxels is not None)] = True
        return found

    @property
    def triangles(self) -> int:
        """Number of triangles, including those of instances and actors."""
        shared = self.instances.triangles if self.instances else 0
        return len(self.faces) + shared + sum(len(actor.mesh.faces) for actor in self.actors)

    @property
    def kept_triangles(self) -> int:
        """Number of triangles in memory, those that instances share once; without actors."""
        parts = self.instances.parts if self.instances else ()
        return len(self.faces) + sum(len(part.faces) for part in parts)

    @property
    def counters(self) -> int:
        """Length of a count of hits: of each triangle, and of each instance as a whole.

        Those of instances follow `faces`; those of the actors' triangles come last.
        """
        shared = len(self.instances) if self.instances else 0
        return len(self.faces) + shared + sum(len(actor.mesh.faces) for actor in self.actors)

    def solid(self, time_ns: float) -> Scene:
        """All triangles at a time, those of actors after the others; there are no instances.

        Parameters
        ----------
        time_ns
            Nanoseconds since the survey's start.
        """
        if not self.actors:
            return self
        meshes = [actor.placed(time_ns) for actor in self.actors]
        moving = [(mesh.vertices, mesh.faces.astype(np.int32)) for mesh in meshes]
        owners = np.repeat(
            np.arange(len(self.names), len(self.all_names), dtype=np.int32),
            [len(mesh.faces) for mesh in meshes],
        )
        sizes = [len(self.faces), *(len(faces) for _, faces in moving)]
        return Scene(
            *stacked([(self.vertices, self.faces), *moving]),
            np.append(self.face_object, owners),
            self.all_names,
            self.origin,
            colours=coloured.joined([self.colours, *(mesh.colours for mesh in meshes)], sizes),
        )

    def meshes(self) -> tuple[SceneMesh | SceneInstance, ...]:
        """Return the objects that have triangles, in world coordinates and in order.

        Of an object with masks, each part is one.
        """
        order = np.argsort(self.face_object, kind="stable")
        ends = np.cumsum(np.bincount(self.face_object, minlength=len(self.names)))[:-1]
        out: list[list[SceneMesh | SceneInstance]] = [[] for _ in self.names]
        for name, rows, found in zip(self.names, np.split(order, ends), out, strict=True):
            if len(rows):
                points, faces = compacted(self.vertices, self.faces[rows])
                own = self.colours and self.colours.take(rows)
                owner = int(self.face_object[rows[0]])
                named = None if self.materials is None else self.materials.of_object(owner, rows)
                mesh = SceneMesh(name, points + self.origin, faces, colours=own, materials=named)
                found.append(mesh)
        if (shared := self.instances) is not None:
            meshes = [
                SceneMesh(
                    self.names[shared.owner[np.argmax(shared.part == number)]],
                    part.vertices,
                    part.faces.astype(np.int64),
                    () if part.mask is None or part.uv is None else (Cutout(part.mask, part.uv),),
                    part.colours,
                    part.voxels,
                    materials=part.materials,
                )
                for number, part in enumerate(shared.parts)
            ]
            for number, matrix, owner in zip(
                shared.part, shared.transforms, shared.owner, strict=True
            ):
                placed = Transform(matrix[:, :3], matrix[:, 3] + self.origin)
                out[owner].append(SceneInstance(meshes[number], placed, self.names[owner]))
        return tuple(one for found in out for one in found)

    @cached_property
    def bounds(self) -> Floats:
        """Lowest and highest corner of the triangles, local coordinates: (2, 3)."""
        ends = self._own_bounds
        if self.instances:
            ends = np.concatenate([ends, self.instances.bounds.reshape(-1, 3)])
        return np.stack([ends.min(axis=0), ends.max(axis=0)])

    @cached_property
    def _own_bounds(self) -> Floats:
        """Bounds of `faces` alone: (2, 3), or (0, 3) if there are none."""
        there = np.zeros(len(self.vertices), np.bool_)
        there[self.faces] = True
        used = self.vertices[there]
        return np.stack([used.min(axis=0), used.max(axis=0)]) if len(used) else used

    @cached_property
    def object_bounds(self) -> Floats:
        """Lowest and highest corner of each object, local coordinates: (objects, 2, 3).

        An object without triangles has (+inf, -inf).
        """
        corners = self.vertices[self.faces]
        low = np.full((len(self.names), 3), np.inf)
        high = np.full((len(self.names), 3), -np.inf)
        np.minimum.at(low, self.face_object, corners.min(axis=1))
        np.maximum.at(high, self.face_object, corners.max(axis=1))
        if (shared := self.instances) is not None:
            np.minimum.at(low, shared.owner, shared.bounds[:, 0])
            np.maximum.at(high, shared.owner, shared.bounds[:, 1])
        return np.stack([low, high], axis=1)

    @cached_property
    def footprints(self) -> Floats:
        """Circle around each object seen from above, local: (objects, 3) as x, y, radius.

        The circle is centred on the object's bounding rectangle and reaches its farthest
        vertex: exact for discs and rectangles, at most 1.42 times too wide for other outlines.
        """
        centres = self.object_bounds[..., :2].mean(axis=1)
        reach = np.zeros(len(self.names))
        for corner in range(3):
            offset = self.vertices[self.faces[:, corner], :2] - centres[self.face_object]
            np.maximum.at(reach, self.face_object, hypot(*offset.T))
        if (shared := self.instances) is not None:
            np.maximum.at(reach, shared.owner, shared.reach(centres[shared.owner]))
        return np.column_stack([centres, reach])


def local_origin(vertices: Floats) -> Floats:
    """Choose the origin for world coordinates (v, 3): zero, or whole metres in their middle.

    Whole metres are exact in double precision, so that subtracting and adding them again gives the
    same coordinates.
    """
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    if np.abs(middle).max() <= FAR_FROM_ZERO_M:
        return np.zeros(3)
    return np.round(middle)

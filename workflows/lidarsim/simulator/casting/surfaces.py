"""Surfaces: objects, their materials, and the energy of returns."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...base.arrays import Bools, Floats, Floats32, Indices, Integers, Ints, Ints32, UInts32, owned
from ...base.vectors import applied, into_axes, inverse, length, products
from ...media.materials import NEAR_NM, Material, MaterialTable, at_right_angles, first_matches
from ...motion.trajectory import velocities
from ...scene.actors import distinct_meshes
from ...scene.colours import GREY, Colours, Lookup, join_colours, luminance, packed
from ...scene.face_materials import FaceMaterials
from ...scene.scene import Scene
from ...sensor import Sensor
from ...survey.survey import Survey
from .actor_trajectories import ActorTrajectories
from .voxels import Grids

if TYPE_CHECKING:
    from .surface_loops import Incidence, TriangleNumbers, TriangleOwners

_log = logging.getLogger(__name__)

LEVEL = math.sqrt(0.75)  # smallest z of the normals of surfaces that hold water: 30 degrees
BLOCK_FACES = 1 << 18  # triangles whose normals are computed at a time
BLOCK_HITS = 1 << 14  # hits whose colours are looked up at a time, to fit a cache


_NO_ROWS = np.zeros(0, np.intp)
_NO_NORMALS = np.zeros((0, 3), np.float32)


class SensorLight(NamedTuple):
    """Wavelength of a sensor, and the air and water that its light meets."""

    wavelength_nm: float
    extinction: float  # 1/m
    wet: float = 0.0  # share of surfaces that face up that is below a film of water


class _Corners(NamedTuple):
    """Corners of triangles of actors that deform, in the frames of the actors: (n, 3, 3) each."""

    corners: Floats  # metres
    velocities: Floats  # m/s
    at_rest: Floats  # corners of the mesh at rest


class LitHits(NamedTuple):
    """Hits of rays on surfaces."""

    normals: Floats  # (n, 3): unit normals in the scene frame, on either side of the surface
    cosines: Floats  # (n,): cosines of the angles between normals and directions, of either sign
    kinds: Ints32  # (n,): kinds of surfaces, rows of the table of materials
    energy: Floats  # (n,): see `Surfaces.energy`; less below a film of water
    film: Bools | None = None  # (n,): whether there may be a film of water


def light_of(survey: Survey, sensor: Sensor) -> SensorLight:
    """Return the light of a sensor in the air of a survey.

    Values are floats: for an int, loops would be compiled once more.
    """
    return SensorLight(sensor.optics.wavelength_nm, survey.extinction(sensor), float(survey.wet))


def warn_of_grey(scene: Scene, survey: Survey) -> None:
    """Warn if a survey takes colours for reflectance, and the scene has no colours."""
    if not scene.coloured and any(m.reflectance == "texture" for m in survey.materials):
        _log.warning(
            "a material has reflectance: texture, but nothing in the scene has colours, so that "
            "all is grey; in Python, Scene.load(path, colours=True) reads them"
        )


class Surfaces:
    """Optical properties of triangles.

    Triangles are numbered by the scene's faces, then instance by instance, then by actors. Stored
    triangles are the scene's faces, then the distinct meshes of actors, then the parts of meshes
    that instances place, each once: instances of a part share its stored triangles. `wavelengths`
    are the wavelengths of all sensors, nanometres.

    A kind of surface is an object, or a material of an object whose files have several materials;
    it is a row of the table of materials. Objects of actors follow the static objects.

    Raises
    ------
    LidarError
        If there are materials, and an object has none, or a name fits no object.
    """

    def __init__(
        self,
        scene: Scene,
        materials: tuple[Material, ...],
        wavelengths: Iterable[float] = (NEAR_NM,),
    ) -> None:
        self._scene = scene
        self._materials = materials
        self._static_objects = len(scene.names)  # objects
        self.counters = scene.counters
        kinds = scene.surface_kinds
        self._tables = {
            nm: MaterialTable.build(materials, kinds, nm, scene.has_voxels) for nm in wavelengths
        }
        self.material_kinds = kinds
        self.grids = Grids.from_instances(scene.instances)
        instances = scene.instances
        face_count = len(scene.faces)
        instance_sizes = np.zeros(0, np.int64) if instances is None else instances.sizes
        # First triangle of each instance, and of actors.
        self._instance_starts = face_count + np.cumsum([0, *instance_sizes])
        actor_sizes = [len(actor.mesh.faces) for actor in scene.actors]
        self._meshes, self._actor_mesh = distinct_meshes(scene.actors)
        mesh_sizes = [len(mesh.faces) for mesh in self._meshes]
        self._mesh_starts = mesh_starts = face_count + np.cumsum([0, *mesh_sizes])
        actor_starts = self._instance_starts[-1] + np.cumsum([0, *actor_sizes])[:-1]
        # (actors,): add to the number of an actor's triangle for its row among stored triangles.
        self._actor_shifts = mesh_starts[self._actor_mesh] - actor_starts
        self._parts_start = int(mesh_starts[-1])
        owners = np.arange(
            self._static_objects, self._static_objects + len(actor_sizes), dtype=np.int32
        )
        # Objects of the triangles of faces and of actors; the last is of no triangle.
        objects = [scene.face_object, np.repeat(owners, actor_sizes), np.full(1, -1, np.int32)]
        self.owners = np.concatenate(objects)

    @cached_property
    def _normal_matrices(self) -> Floats:
        """Matrices (n, 3, 3) from normals of parts to normals of instances, of any length."""
        instances = self._scene.instances
        if instances is None:
            return np.zeros((0, 3, 3))
        return np.ascontiguousarray(inverse(instances.transforms[:, :, :3]).transpose(0, 2, 1))

    @property
    def materials(self) -> MaterialTable:
        """Materials of kinds of surfaces, at all wavelengths the same but for reflectance."""
        return next(iter(self._tables.values()))

    def at_wavelength(self, wavelength_nm: float) -> MaterialTable:
        """Materials of kinds of surfaces at the wavelength of a sensor."""
        return self._tables[wavelength_nm]

    def moved(self, scene: Scene) -> Surfaces:
        """Return the surfaces of a scene in which instances have new transforms."""
        assert scene.instances is not None
        surfaces = copy(self)
        surfaces._scene = scene
        vars(surfaces).pop("_normal_matrices", None)
        surfaces.grids = self.grids and self.grids.moved(scene.instances)
        return surfaces

    def _locate(self, triangle: Integers) -> TriangleOwners:
        """Return the stored rows, objects and instances of triangles (n,)."""
        from . import surface_loops  # not before: numba takes half a second to import

        count = len(triangle)
        row, instance = np.empty((2, count), np.int64)
        located = surface_loops.TriangleOwners(row, np.empty(count, np.int32), instance)
        surface_loops.find_owners(owned(triangle, np.int32), self._triangle_numbers, located)
        return located

    @cached_property
    def _triangle_numbers(self) -> TriangleNumbers:
        """Numbers of triangles, objects and instances, for loops."""
        from .surface_loops import TriangleNumbers

        instances = self._scene.instances
        no_instances = np.zeros(0, np.int64)
        return TriangleNumbers(
            instance_starts=owned(self._instance_starts, np.int64),
            owners=owned(self.owners, np.int32),
            instance_objects=owned(
                no_instances if instances is None else instances.owner, np.int32
            ),
            instance_rows=owned(
                no_instances if instances is None else self._part_starts[instances.part], np.int64
            ),
            actor_shifts=owned(self._actor_shifts, np.int64),
            static_objects=self._static_objects,
        )

    def normals(
        self, triangle: Integers, times: Floats | Ints, trajectories: ActorTrajectories
    ) -> Floats:
        """Return the unit normals of triangles (n,) in the scene frame: float64 (n, 3).

        The normals are as exact as single precision. Normals of actors are rotated by the poses of
        the actors at times (n,), nanoseconds.
        """
        directions = np.zeros((len(triangle), 3))
        incidence, _ = self._meet(triangle, directions, self.materials, times, trajectories)
        return incidence.normals.T

    def _meet(
        self,
        triangle: Integers,
        directions: Floats,
        table: MaterialTable,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> tuple[Incidence, Ints32]:
        """Return the incidence of rays on triangles (n,), and the kinds of their surfaces (n,).

        `directions` (n, 3) are in the scene frame, and `times` (n,) are nanoseconds, for the poses
        of actors. `Incidence.back`, the energy received from 10 m, assumes surfaces that
        are neither textured nor rough.
        """
        from . import surface_loops  # not before: numba takes half a second to import

        poses = np.zeros((12, 0))
        run = np.zeros(0, np.int64)
        row, objects, instance = self._locate(triangle)
        kinds = self._kinds_of(row, objects)
        deformed_normals = _NO_NORMALS
        if trajectories:
            actors = objects - np.int64(self._static_objects)
            poses, run = trajectories.runs(actors, owned(times))
            if len(deforming := trajectories.deforming(actors)):
                deformed = self._deformed(
                    row[deforming], actors[deforming], times[deforming], trajectories
                )
                deformed_normals = _normals(deformed.corners)
                row[deforming] = ~np.arange(len(deforming))  # rows of `deformed_normals`
        cosines, back = np.empty((2, len(row)))
        incidence = surface_loops.Incidence(np.empty((3, len(row))), cosines, back)
        surface_loops.meet(
            surface_loops.HitSurfaces(row, kinds, instance, run),
            owned(directions.T),
            surface_loops.NormalTables(
                self.unit_normals, deformed_normals, self._normal_matrices, poses
            ),
            table.reflectance,
            table.retro,
            incidence,
        )
        return incidence, kinds

    def lit(
        self,
        triangle: Integers,
        directions: Floats,
        distance: Floats,
        light: SensorLight,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
        colours: UInts32 | None = None,
    ) -> LitHits:
        """Return normals, cosines, kinds of surfaces and received energies of hits of rays (n,).

        Parameters
        ----------
        triangle, distance
            (n,): triangles on which the rays end, and the rays' lengths (optical paths), metres.
        directions
            (n, 3): unit directions of the rays, scene frame.
        light
            Light of the sensor.
        times
            (n,): nanoseconds, for the poses of actors.
        trajectories
            Trajectories of the actors.
        colours
            (n,): packed, needed where materials are `textured`.
        """
        from . import surface_loops

        table = self.at_wavelength(light.wavelength_nm)
        incidence, kinds = self._meet(triangle, directions, table, times, trajectories)
        normals, cosines, back = incidence
        bright = luminance(colours) if table.textured and colours is not None else None
        if table.textured or table.roughness.any():
            back = table.scattered(kinds, np.abs(cosines), bright)
        film = None
        if light.wet:
            film = np.empty(len(cosines), np.bool_)
            water = surface_loops.WaterFilm(LEVEL, light.wet, table.passes | table.leafy)
            shares = table.shares(kinds, bright)
            surface_loops.soak(normals[2], cosines, kinds, shares, water, film, back)
        surface_loops.fade(owned(distance), light.extinction, back)
        return LitHits(normals.T, cosines, kinds, back, film)

    def _deformed(
        self,
        rows: Indices,
        actors: Integers,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> _Corners:
        """Return the corners of triangles of actors that deform, at times (n,), nanoseconds.

        `rows` (n,) are rows of stored triangles, and `actors` (n,) their actors.
        """
        corners, corner_velocities, at_rest = np.empty((3, len(rows), 3, 3))
        frames, frame_rates = trajectories.played(actors, times)
        mesh_numbers = self._actor_mesh[actors]
        for mesh_number in np.unique(mesh_numbers).tolist():
            mesh = self._meshes[mesh_number]
            with_mesh = np.flatnonzero(mesh_numbers == mesh_number)
            assert mesh.animation is not None
            vertex_rows = mesh.faces[rows[with_mesh] - self._mesh_starts[mesh_number]]
            corners[with_mesh], steps = mesh.animation.vertices_at(frames[with_mesh], vertex_rows)
            corner_velocities[with_mesh] = steps * frame_rates[with_mesh, None, None]
            at_rest[with_mesh] = mesh.vertices[vertex_rows]
        return _Corners(corners, corner_velocities, at_rest)

    def _actor_rows(
        self, triangle: Integers, trajectories: ActorTrajectories
    ) -> tuple[Indices, Integers]:
        """Return the indices in `triangle` (n,) of actors' triangles, and the actors: (k,) each.

        Without trajectories, there are no actors, and the arrays are empty.
        """
        if not trajectories:
            return _NO_ROWS, _NO_ROWS
        rows = np.flatnonzero(triangle >= self._instance_starts[-1])
        return rows, self.objects(triangle[rows]) - self._static_objects

    def colours(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> UInts32:
        """Return the colours of points (n, 3) on triangles (n,), packed: (n,).

        Points are in the scene frame, metres. Without colours in the scene, all points are grey.
        Actors have their poses at times (n,), nanoseconds.
        """
        if self._lookup is None:
            return np.full(len(triangle), packed(GREY[0])[0])
        result = np.empty(len(triangle), np.uint32)
        for begin in range(0, len(triangle), BLOCK_HITS):
            block = slice(begin, begin + BLOCK_HITS)
            result[block] = self._block_colours(
                triangle[block], points[block], times[block], trajectories
            )
        return result

    def _block_colours(
        self, triangle: Integers, points: Floats, times: Any, trajectories: ActorTrajectories
    ) -> UInts32:
        """Return the colours of points of a block of hits, see `colours`."""
        assert self._lookup is not None
        stored_rows, _, instance = self._locate(triangle)
        on_instances = np.flatnonzero(instance >= 0)
        if len(on_instances) or trajectories:
            points = points.copy()
        if len(on_instances):
            assert self._scene.instances is not None
            instance_numbers = instance[on_instances]
            from_origins = (
                points[on_instances] - self._scene.instances.transforms[instance_numbers, :, 3]
            )
            points[on_instances] = into_axes(from_origins, self._normal_matrices[instance_numbers])
        on_actors, actor = self._actor_rows(triangle, trajectories)
        if len(on_actors):
            positions, rotations = trajectories.poses(actor, times[on_actors].astype(np.float64))
            points[on_actors] = into_axes(points[on_actors] - positions, rotations)
            if len(deforming := trajectories.deforming(actor)):  # to the mesh at rest
                rows = on_actors[deforming]
                deformed = self._deformed(
                    stored_rows[rows], actor[deforming], times[rows], trajectories
                )
                weights = _weights(deformed.corners, points[rows])
                points[rows] = applied(deformed.at_rest.transpose(0, 2, 1), weights)
        return self._lookup.colours_at(stored_rows, points)

    def velocities(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the velocities of points (n, 3) on triangles (n,) in the scene frame, m/s: (n, 3).

        Actors have their poses at times (n,), nanoseconds.
        """
        result = np.zeros((len(triangle), 3))
        on_actors, actor = self._actor_rows(triangle, trajectories)
        for number in np.unique(actor).tolist():
            trajectory = trajectories[number]
            rows = on_actors[actor == number]
            if trajectory.moves:
                times_ns = times[rows].astype(np.float64)
                positions, _ = trajectory.poses(0, times_ns)
                velocity, rate = velocities(trajectory, 0, times_ns)
                result[rows] = velocity + np.cross(rate, points[rows] - positions)
        if len(deforming := trajectories.deforming(actor)):
            rows = on_actors[deforming]
            result[rows] += self._deformation_velocities(
                triangle[rows], points[rows], times[rows], actor[deforming], trajectories
            )
        return result

    def _deformation_velocities(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        actor: Integers,
        trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the velocities of points by the deformation of actors: (n, 3), m/s.

        Points (n, 3) and velocities are in the scene frame; `actor` (n,) are the deforming actors.
        """
        times_ns = times.astype(np.float64)
        positions, rotations = trajectories.poses(actor, times_ns)
        deformed = self._deformed(self._locate(triangle).row, actor, times_ns, trajectories)
        weights = _weights(deformed.corners, into_axes(points - positions, rotations))
        return applied(rotations, applied(deformed.velocities.transpose(0, 2, 1), weights))

    @cached_property
    def _lookup(self) -> Lookup | None:
        """Colours of the stored triangles; None if the scene has no colours."""
        bodies = self._stored_bodies
        sizes = [len(faces) for _, faces, _ in bodies]
        colours = join_colours([colours for _, _, colours in bodies], sizes)
        if colours is None:
            return None
        corners = (
            vertices[faces[begin : begin + BLOCK_FACES]]
            for vertices, faces, _ in bodies
            for begin in range(0, len(faces), BLOCK_FACES)
        )
        return Lookup(colours, corners)

    def bodies(self) -> tuple[Ints, Floats]:
        """Return the bodies to which triangles belong, in the order of `SceneCaster`.

        Returns
        -------
        bodies
            (b, 3): the scene's faces, unless there are no faces, each instance, and all actors as
            one body. Columns are the first triangle; the object, or -1 if `owners` has the object
            of each triangle; and the row of the first normal in `unit_normals`, or -1 for actors,
            which share normals. In `owners`, actors follow the scene's faces.
        normal_matrices
            (b, 3, 3): matrices from normals in `unit_normals` to normals in the scene frame, of any
            length.
        """
        face_count, actors_start = self._instance_starts[[0, -1]]
        identity = np.eye(3)[None]
        bodies: list[Any] = [[[actors_start - face_count, -1, -1]]]
        normal_matrices = [identity]
        if (instances := self._scene.instances) is not None:
            first_rows = self._part_starts[instances.part]
            bodies.insert(
                0, np.stack([self._instance_starts[:-1], instances.owner, first_rows], axis=1)
            )
            normal_matrices.insert(0, self._normal_matrices)
        if face_count:
            bodies.insert(0, [[0, -1, 0]])
            normal_matrices.insert(0, identity)
        return np.concatenate(bodies).astype(np.int64), np.concatenate(normal_matrices)

    def objects(self, triangle: Integers) -> Ints32:
        """Return the objects of triangles (n,): (n,); -1 without a surface."""
        if self._scene.instances is None:
            return self.owners[triangle]
        return self._locate(triangle).object

    def kinds(self, triangle: Integers) -> Ints32:
        """Return the kinds of surfaces of triangles (n,): (n,); -1 without a surface.

        Names of materials that match the same material of the survey, in an object, are one kind.
        """
        if self._kind_in_object is None:
            return self.objects(triangle)
        rows, objects, _ = self._locate(triangle)
        return self._kinds_of(rows, objects)

    def _kinds_of(self, rows: Indices, objects: Ints32) -> Ints32:
        """Return the kinds of surfaces, from rows of stored triangles (n,) and objects (n,): (n,).

        Objects are an argument because instances that share stored triangles may differ in object.
        """
        if self._kind_in_object is None:
            return objects
        kinds = self.material_kinds.first[:-1][objects] + self._kind_in_object[rows]
        return np.where(objects < 0, np.int32(-1), self._material_kind[kinds])

    @cached_property
    def _kind_in_object(self) -> Ints32 | None:
        """Kind of each stored triangle, numbered within its object: (f,).

        None if each object has a single kind, which has the number of the object.
        """
        if len(self.material_kinds.object) == len(self.material_kinds.names):
            return None
        scene = self._scene
        parts = () if scene.instances is None else scene.instances.parts
        meshes = [(len(mesh.faces), mesh.materials) for mesh in self._meshes]
        meshes += [(len(part.faces), part.materials) for part in parts]
        face_materials = None if scene.materials is None else scene.materials.index
        numbers = [
            np.zeros(len(scene.faces), np.int32) if face_materials is None else face_materials
        ]
        for size, materials in meshes:
            index = None if materials is None else materials.index
            numbers.append(np.zeros(size, np.int32) if index is None else index)
        return np.concatenate(numbers)

    def material_numbers(self, triangle: Integers) -> Ints32:
        """Return the materials of triangles, as numbers of `Scene.material_names`; -1 for none."""
        rows, objects, _ = self._locate(triangle)
        kinds = self.material_kinds.first[:-1][objects]
        if self._kind_in_object is not None:
            kinds = kinds + self._kind_in_object[rows]
        return np.where(objects < 0, np.int32(-1), self._number_of_kind[kinds])

    @cached_property
    def _number_of_kind(self) -> Ints32:
        """Number of the name of each kind's material; -1 for none."""
        numbers = {name: number for number, name in enumerate(self._scene.material_names)}
        return np.array([numbers.get(name, -1) for name in self.material_kinds.material], np.int32)

    @cached_property
    def _material_kind(self) -> Ints32:
        """First kind of the same object that has the same material, for each kind: (kinds,).

        Several names of materials in an object's files may match a single material of the survey.
        Their faces are then a single kind, so that a body of water or leaves whose faces have
        several names is closed.
        """
        kinds = self.material_kinds
        first = first_matches(self._materials, self.material_kinds)
        keys = np.stack([kinds.object, first], axis=1)
        _, rows, combination = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        return rows[combination.reshape(-1)].astype(np.int32)

    def instances(self, triangle: Integers) -> Indices:
        """Return the instances of triangles (n,), which all belong to instances: (n,)."""
        return np.searchsorted(self._instance_starts, triangle, side="right") - 1

    def counter(self, triangle: Integers) -> Integers:
        """Return the rows of hit counters (n,), in which hits on triangles (n,) are counted.

        Each of the scene's faces has a counter, each instance has a single counter for all its
        triangles, and each triangle of an actor has a counter, in this order: `Scene.counters`.
        """
        if self._scene.instances is None:
            return triangle
        face_count, actors_start = self._instance_starts[[0, -1]]
        instance = self._locate(triangle).instance
        # Triangles of instances, less one counter for each instance.
        shift = actors_start - face_count - (len(self._instance_starts) - 1)
        face_or_actor = np.where(triangle >= actors_start, triangle - shift, triangle)
        return np.where(instance >= 0, face_count + instance, face_or_actor)

    def energy(
        self,
        triangle: Integers,
        cosine: Floats,
        distance: Floats,
        light: SensorLight,
        colours: UInts32 | None = None,
    ) -> Floats:
        """Return the received energy of rays that end on triangles (n,), at distances in metres.

        ``reflectance * cosine * (10 m / distance)**2 * exp(-2 * extinction * distance)``; for a
        retro-reflector, a gain replaces the cosine; rough surfaces add gloss; distances below
        `NEAREST_M` count as `NEAREST_M`. Where materials are `textured`, the colours (n,) are
        needed.
        """
        table = self.at_wavelength(light.wavelength_nm)
        bright = luminance(colours) if table.textured and colours is not None else None
        scattered = table.scattered(self.kinds(triangle), cosine, bright)
        return np.asarray(scattered * at_right_angles(distance, light.extinction))

    @cached_property
    def solids(self) -> tuple[Bools, Bools]:
        """Whether surfaces that hold a medium are closed, and whether they point inwards: (kinds,).

        Surfaces point inwards if they are closed and have a negative volume.
        """
        table = self.materials
        scene = self._scene
        closed = np.ones(len(table.reflectance), np.bool_)
        volume = np.zeros(len(closed))
        for kind in np.flatnonzero(table.leafy | table.refracts).tolist():
            bodies: list[tuple[Floats, Integers]] = []
            owner = int(self.material_kinds.object[kind])
            if owner >= self._static_objects:
                mesh = scene.actors[owner - self._static_objects].mesh
                bodies.append((mesh.vertices, self._of_kind(kind, mesh.faces, mesh.materials)))
            else:
                bodies.append((scene.vertices, self._faces_of(kind)))
            if scene.instances is not None:
                for row in np.unique(scene.instances.part[scene.instances.owner == owner]):
                    part = scene.instances.parts[row]
                    faces = self._of_kind(kind, part.faces, part.materials)
                    bodies.append((part.vertices, faces))
            for vertices, faces in bodies:
                if not len(faces):
                    continue
                closed[kind] &= _closed(vertices, faces)
                volume[kind] += _volume(vertices, faces)
        return closed, closed & (volume < 0)

    @cached_property
    def _faces_by_object(self) -> tuple[Indices, Indices]:
        """Rows of the scene's faces by objects, and where each object starts in this order."""
        owners = self._scene.face_object
        order = np.argsort(owners, kind="stable")
        return order, np.searchsorted(owners[order], np.arange(self._static_objects + 1))

    def _faces_of(self, kind: int) -> Integers:
        """Return the scene's faces of a kind of surface, (f, 3)."""
        order, starts = self._faces_by_object
        owner = int(self.material_kinds.object[kind])
        rows = order[starts[owner] : starts[owner + 1]]
        if self._scene.materials is None:
            return self._scene.faces[rows]
        materials = self._scene.materials.of_object(owner, rows)
        return self._of_kind(kind, self._scene.faces[rows], materials)

    def _of_kind(self, kind: int, faces: Integers, materials: FaceMaterials | None) -> Integers:
        """Select the faces of a kind of surface from faces of an object, (f, 3)."""
        if self._kind_in_object is None:
            return faces
        kinds = self.material_kinds
        index = 0 if materials is None or materials.index is None else materials.index
        face_kinds = self._material_kind[kinds.first[kinds.object[kind]] + index]
        return faces[np.broadcast_to(face_kinds == kind, len(faces))]

    @cached_property
    def media(self) -> tuple[int, ...]:
        """Kinds of surfaces of closed static objects, also in instances, that hold a medium."""
        table = self.materials
        closed, _ = self.solids
        holds_medium = (table.leafy | table.refracts) & closed
        holds_medium &= self.material_kinds.object < self._static_objects
        return tuple(np.flatnonzero(holds_medium).tolist())

    def spread_out(self, by_m: float) -> Floats:
        """Return the vertices of the scene's faces, with surfaces of media moved outwards.

        Water that touches its basin, or leaves that touch other leaves, would share a surface with
        the basin, and light that meets one surface would miss the other.
        """
        if not self.media:
            return self._scene.vertices
        vertices = self._scene.vertices.copy()
        inwards = self.solids[1]
        for kind in self.media:
            faces = self._faces_of(kind)
            if not len(faces):
                continue
            vertex_rows, corners = np.unique(faces, return_inverse=True)
            positions, vertex_position = np.unique(
                vertices[vertex_rows], axis=0, return_inverse=True
            )
            vertex_position = vertex_position.reshape(-1)
            corners = vertex_position[corners.reshape(-1)].reshape(-1, 3)
            a, b, c = positions[corners].transpose(1, 0, 2)
            normals = np.cross(b - a, c - a) * (-1 if inwards[kind] else 1)
            normals /= np.maximum(length(normals)[:, None], 1e-300)
            # Least squares: a vertex moves to where all its triangles are `by_m` further out.
            squares = np.zeros((len(positions), 3, 3))
            sums = np.zeros((len(positions), 3))
            np.add.at(squares, corners, (normals[:, :, None] * normals[:, None])[:, None])
            np.add.at(sums, corners, normals[:, None])
            squares += 1e-3 * np.eye(3)
            step = by_m * applied(inverse(squares), sums)
            positions += np.clip(step, -4 * by_m, 4 * by_m)
            vertices[vertex_rows] = positions[vertex_position]
        return vertices

    @property
    def _stored_bodies(self) -> list[tuple[Floats, Integers, Colours | None]]:
        """Vertices, faces and colours of stored triangles: scene, meshes of actors, and parts."""
        scene = self._scene
        bodies: list[tuple[Floats, Integers, Colours | None]] = [
            (scene.vertices, scene.faces, scene.colours)
        ]
        bodies += [(mesh.vertices, mesh.faces, mesh.colours) for mesh in self._meshes]
        if scene.instances is not None:
            parts = scene.instances.parts
            bodies += [(part.vertices, part.faces, part.colours) for part in parts]
        return bodies

    @cached_property
    def unit_normals(self) -> Floats32:
        """Unit normals of the stored triangles: (f, 3)."""
        bodies = self._stored_bodies
        normals = np.empty((sum(len(faces) for _, faces, _ in bodies), 3), np.float32)
        row = 0
        for vertices, faces, _ in bodies:
            for begin in range(0, len(faces), BLOCK_FACES):
                block = faces[begin : begin + BLOCK_FACES]
                normals[row : row + len(block)] = _normals(vertices[block])
                row += len(block)
        return normals

    @cached_property
    def _part_starts(self) -> Indices:
        """Stored row of the first triangle of each part of instances."""
        assert self._scene.instances is not None
        sizes = [len(part.faces) for part in self._scene.instances.parts]
        return self._parts_start + np.cumsum([0, *sizes[:-1]])


def _normals(corners: Floats) -> Floats32:
    """Return unit normals (n, 3) of triangles (n, 3, 3), in single precision."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    return (normals / np.maximum(length(normals)[:, None], 1e-300)).astype(np.float32)


def _weights(corners: Floats, points: Floats) -> Floats:
    """Return weights (n, 3) of the corners (n, 3, 3) of triangles at points (n, 3) on triangles."""
    a, b, c = corners.transpose(1, 2, 0)
    edge_1 = b - a
    edge_2 = c - a
    offset = points.T - a
    square_1 = products(edge_1, edge_1)
    edge_product = products(edge_1, edge_2)
    square_2 = products(edge_2, edge_2)
    product_1 = products(offset, edge_1)
    product_2 = products(offset, edge_2)
    area = np.maximum(square_1 * square_2 - edge_product * edge_product, 1e-300)
    v = (square_2 * product_1 - edge_product * product_2) / area
    w = (square_1 * product_2 - edge_product * product_1) / area
    return np.stack([1 - v - w, v, w], axis=1)


def _closed(vertices: Floats, faces: Integers) -> bool:
    """Return whether a surface has no gaps: two triangles that wind alike share each edge."""
    vertex_rows, corners = np.unique(faces, return_inverse=True)
    # With flat shading, triangles share positions, not vertices.
    _, vertex_position = np.unique(vertices[vertex_rows], axis=0, return_inverse=True)
    corners = vertex_position.reshape(-1)[corners.reshape(-1)].reshape(-1, 3).astype(np.int64)
    starts = corners.reshape(-1)
    stops = np.roll(corners, -1, axis=1).reshape(-1)
    edges = starts != stops
    starts = starts[edges]
    stops = stops[edges]
    forward = np.sort(starts * len(vertex_rows) + stops)
    backward = np.sort(stops * len(vertex_rows) + starts)
    return bool(np.array_equal(forward, backward))


def _volume(vertices: Floats, faces: Integers) -> float:
    """Return the volume within a closed surface, m³; negative if its triangles wind inwards."""
    a, b, c = (vertices[faces] - vertices[faces[0, 0]]).transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)

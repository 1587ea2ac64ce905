"""Surfaces: objects, their materials, and the energy of returns."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from copy import copy
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Indices, Integers, Ints, Ints32, UInts32, owned
from ..base.vectors import applied, into_axes, inverse, length, products
from ..scene.actors import distinct_meshes
from ..scene.colours import GREY, Colours, Lookup, join_colours, luminance, packed
from ..scene.face_materials import FaceMaterials
from ..scene.scene import Scene
from ..sensor import Sensor, Survey
from ..sensor.materials import NEAR_NM, Material, MaterialTable, at_right_angles, first_matches
from ..sensor.trajectory import velocities
from .actor_trajectories import ActorTrajectories
from .voxels import Grids

_log = logging.getLogger(__name__)

LEVEL = math.sqrt(0.75)  # z of the normals of surfaces that water stays on, up to 30 degrees
BLOCK_FACES = 1 << 18  # triangles whose normals are made at a time
BLOCK_HITS = 1 << 14  # hits whose colours are looked up at a time, to fit a cache


_NONE = np.zeros(0, np.intp)
_NO_NORMALS = np.zeros((0, 3), np.float32)


class Light(NamedTuple):
    """Light of a sensor in the air."""

    wavelength_nm: float
    extinction: float  # 1/m
    wet: float = 0.0  # share of what faces up that is below a film of water


class Lit(NamedTuple):
    """How rays meet surfaces."""

    normals: Floats  # (n, 3)
    along: Floats  # (n,): cosines of the angles between normals and directions, of either sign
    kinds: Ints32  # (n,): rows of the table of materials
    energy: Floats  # (n,): see `Surfaces.energy`
    film: Bools | None = None  # (n,): whether there may be a film of water


def light_of(survey: Survey, sensor: Sensor) -> Light:
    """Light of a sensor in the air of a survey, in floats: of an int, loops compile once more."""
    return Light(sensor.optics.wavelength_nm, survey.extinction(sensor), float(survey.wet))


def warn_of_grey(scene: Scene, survey: Survey) -> None:
    """Warn if a survey is to take colours for reflectance, and nothing has colours."""
    if not scene.coloured and any(m.reflectance == "texture" for m in survey.materials):
        _log.warning(
            "a material has reflectance: texture, but nothing in the scene has colours, so that "
            "all is grey; in Python, Scene.load(path, colours=True) reads them"
        )


class Surfaces:
    """Optical properties of triangles.

    Triangles are numbered by the scene's faces, then instance by instance, then by actors.
    `wavelengths` are those of all sensors, nanometres.

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
        self._standing = len(scene.names)  # objects
        self.counters = scene.counters
        kinds = scene.surface_kinds
        self._tables = {
            nm: MaterialTable.build(materials, kinds, nm, scene.has_voxels) for nm in wavelengths
        }
        self.material_kinds = kinds
        self.grids = Grids.of(scene.instances)
        shared = scene.instances
        plain = len(scene.faces)
        sizes = np.zeros(0, np.int64) if shared is None else shared.sizes
        # Where the triangles of each instance begin, and those of actors.
        self._begins = plain + np.cumsum([0, *sizes])
        moving = [len(actor.mesh.faces) for actor in scene.actors]
        self._meshes, self._shape = distinct_meshes(scene.actors)
        self._firsts = firsts = plain + np.cumsum([0, *(len(mesh.faces) for mesh in self._meshes)])
        # What leads from a triangle of an actor to its row among those that are kept once.
        self._to_kept = firsts[self._shape] - self._begins[-1] - np.cumsum([0, *moving])[:-1]
        self._parts_begin = int(firsts[-1])
        owners = np.arange(self._standing, self._standing + len(moving), dtype=np.int32)
        # Objects of the triangles of faces and of actors; the last is of no triangle.
        owned = [scene.face_object, np.repeat(owners, moving), np.full(1, -1, np.int32)]
        self.owners = np.concatenate(owned)
        self._turns = np.zeros((0, 3, 3)) if shared is None else _turns(shared.transforms)

    @property
    def materials(self) -> MaterialTable:
        """Materials of kinds of surfaces, at all wavelengths the same but for reflectance."""
        return next(iter(self._tables.values()))

    def at(self, wavelength_nm: float) -> MaterialTable:
        """Materials of kinds of surfaces at the wavelength of a sensor."""
        return self._tables[wavelength_nm]

    def moved(self, scene: Scene, rows: Indices) -> Surfaces:
        """Return the same with some of the scene's instances in other places."""
        assert scene.instances is not None
        made = copy(self)
        made._scene = scene
        made._turns = self._turns.copy()
        made._turns[rows] = _turns(scene.instances.transforms[rows])
        made.grids = self.grids and self.grids.moved(scene.instances)
        return made

    def _find(self, triangle: Integers) -> tuple[Indices, Ints32, Indices]:
        """Rows among the triangles that are kept once, objects, and instances or -1: (n,) each."""
        from . import surface_loops  # not before: numba takes half a second to import

        count = len(triangle)
        (rows, which), objects = np.empty((2, count), np.int64), np.empty(count, np.int32)
        surface_loops.find(owned(triangle, np.int32), *self._numbers, rows, objects, which)
        return rows, objects, which

    @cached_property
    def _numbers(self) -> tuple[Any, ...]:
        """Numbers of triangles, objects and instances, see `surface_loops.find`."""
        shared = self._scene.instances
        none = np.zeros(0, np.int64)
        placed = (
            (none, none) if shared is None else (shared.owner, self._first_of_part[shared.part])
        )
        owner = owned(placed[0], np.int32)
        firsts = owned(placed[1], np.int64)
        begins = owned(self._begins, np.int64)
        to_kept = owned(self._to_kept, np.int64)
        return begins, owned(self.owners, np.int32), owner, firsts, to_kept, self._standing

    def normals(self, triangle: Integers, times: Floats | Ints, ways: ActorTrajectories) -> Floats:
        """Return the unit normals of triangles (n,): (n, 3), in single precision.

        Those of actors are rotated by the pose on their ways at the times (n,), nanoseconds.
        """
        return self._met(triangle, np.zeros((len(triangle), 3)), self.materials, times, ways)[0].T

    def _met(
        self,
        triangle: Integers,
        directions: Floats,
        table: MaterialTable,
        times: Floats | Ints,
        ways: ActorTrajectories,
    ) -> tuple[Floats, Floats, Ints32, Floats]:
        """Return normals (3, n), products with directions, kinds of surfaces, light sent back."""
        from . import surface_loops  # not before: numba takes half a second to import

        poses = np.zeros((12, 0))
        run = np.zeros(0, np.int64)
        rows, objects, which = self._find(triangle)
        kinds = self._kinds_of(rows, objects)
        own = _NO_NORMALS
        if ways:
            actors = objects - np.int64(self._standing)
            poses, run = ways.runs(actors, owned(times))
            if len(on := ways.deforming(actors)):
                corners, *_ = self._bent(rows[on], actors[on], times[on], ways)
                own = _normals(corners)
                rows[on] = ~np.arange(len(on))
        normals, (along, back) = np.empty((3, len(rows))), np.empty((2, len(rows)))
        given = self._turns, self.unit_normals, own, run, poses, table.reflectance, table.retro
        hits = rows, kinds, which, owned(directions.T)
        surface_loops.meet(*hits, *given, normals, along, back)
        return normals, along, kinds, back

    def lit(
        self,
        triangle: Integers,
        directions: Floats,
        distance: Floats,
        light: Light,
        times: Floats | Ints,
        ways: ActorTrajectories,
        colours: UInts32 | None = None,
    ) -> Lit:
        """How rays (n,) with unit directions (n, 3) meet triangles; others as of `energy`."""
        from . import surface_loops

        table = self.at(light.wavelength_nm)
        normals, along, kinds, back = self._met(triangle, directions, table, times, ways)
        bright = luminance(colours) if table.textured and colours is not None else None
        if table.textured or table.roughness.any():
            back = table.scattered(kinds, np.abs(along), bright)
        film = None
        if light.wet:
            film = np.empty(len(along), np.bool_)
            dry = table.passes | table.leafy
            shares = table.shares(kinds, bright)
            given = normals[2], along, kinds, dry, shares, LEVEL, light.wet
            surface_loops.soak(*given, film, back)
        surface_loops.fade(owned(distance), light.extinction, back)
        return Lit(normals.T, along, kinds, back, film)

    def _bent(
        self, rows: Indices, actors: Integers, times: Floats | Ints, ways: ActorTrajectories
    ) -> tuple[Floats, Floats, Floats]:
        """Corners of triangles of actors that deform, at times, their velocities, and at rest.

        Each is (n, 3, 3), in the axes of the actors; triangles are rows of those kept once.
        """
        corners, speeds, rest = np.empty((3, len(rows), 3, 3))
        frames, rates = ways.played(actors, times)
        shapes = self._shape[actors]
        for one in np.unique(shapes).tolist():
            mesh = self._meshes[one]
            own = np.flatnonzero(shapes == one)
            assert mesh.animation is not None
            vertex = mesh.faces[rows[own] - self._firsts[one]]
            corners[own], moves = mesh.animation.vertices_at(frames[own], vertex)
            speeds[own] = moves * rates[own, None, None]
            rest[own] = mesh.vertices[vertex]
        return corners, speeds, rest

    def _on_actors(self, triangle: Integers, ways: ActorTrajectories) -> tuple[Indices, Integers]:
        """Rows of triangles (n,) that belong to actors, and to which; none without `ways`."""
        if not ways:
            return _NONE, _NONE
        rows = np.flatnonzero(triangle >= self._begins[-1])
        return rows, self.objects(triangle[rows]) - self._standing

    def colours(
        self, triangle: Integers, points: Floats, times: Floats | Ints, ways: ActorTrajectories
    ) -> UInts32:
        """Colours of points (n, 3) on triangles (n,), packed; others as for `normals`."""
        if self._lookup is None:
            return np.full(len(triangle), packed(GREY[0])[0])
        out = np.empty(len(triangle), np.uint32)
        for begin in range(0, len(triangle), BLOCK_HITS):
            block = slice(begin, begin + BLOCK_HITS)
            out[block] = self._colours(triangle[block], points[block], times[block], ways)
        return out

    def _colours(
        self, triangle: Integers, points: Floats, times: Any, ways: ActorTrajectories
    ) -> UInts32:
        assert self._lookup is not None
        rows, _, which = self._find(triangle)
        on = np.flatnonzero(which >= 0)
        if len(on) or ways:
            points = points.copy()
        if len(on):
            assert self._scene.instances is not None
            back = points[on] - self._scene.instances.transforms[which[on], :, 3]
            points[on] = into_axes(back, self._turns[which[on]])
        moving, actor = self._on_actors(triangle, ways)
        if len(moving):
            places, rotations = ways.poses(actor, times[moving].astype(np.float64))
            points[moving] = into_axes(points[moving] - places, rotations)
            if len(bent := ways.deforming(actor)):  # to where they are on the mesh at rest
                on = moving[bent]
                corners, _, rest = self._bent(rows[on], actor[bent], times[on], ways)
                points[on] = applied(rest.transpose(0, 2, 1), _weights(corners, points[on]))
        return self._lookup.colours_at(rows, points)

    def velocities(
        self, triangle: Integers, points: Floats, times: Floats | Ints, ways: ActorTrajectories
    ) -> Floats:
        """Velocities of points (n, 3) on triangles (n,), m/s: (n, 3); others as for `normals`."""
        out = np.zeros((len(triangle), 3))
        moving, actor = self._on_actors(triangle, ways)
        for number in np.unique(actor).tolist():
            way = ways[number]
            rows = moving[actor == number]
            if way.moves:
                at = times[rows].astype(np.float64)
                places, _ = way.poses(0, at)
                velocity, rate = velocities(way, 0, at)
                out[rows] = velocity + np.cross(rate, points[rows] - places)
        if len(bent := ways.deforming(actor)):
            rows = moving[bent]
            own = actor[bent]
            at = times[rows].astype(np.float64)
            places, turns = ways.poses(own, at)
            corners, speeds, _ = self._bent(self._find(triangle[rows])[0], own, at, ways)
            weights = _weights(corners, into_axes(points[rows] - places, turns))
            out[rows] += applied(turns, applied(speeds.transpose(0, 2, 1), weights))
        return out

    @cached_property
    def _lookup(self) -> Lookup | None:
        """Colours of the triangles that are kept once; None if there are none."""
        bodies = self._kept
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
        """Return what bodies the triangles belong to, in the order of `SceneCaster`.

        Returns
        -------
        bodies
            (b, 3): the scene's faces, if there are any, each instance, and all actors as one. Of
            each its first triangle, its object, or -1 if `owners` has that of each triangle, and
            the row of its first normal in `unit_normals`, or -1 for the actors, which share theirs.
            In `owners`, actors begin behind the scene's faces.
        turns
            (b, 3, 3): matrices that take its normals to the scene's axes, but for their length.
        """
        plain, actors = self._begins[[0, -1]]
        one = np.eye(3)[None]
        bodies: list[Any] = [[[actors - plain, -1, -1]]]
        turns = [one]
        if (shared := self._scene.instances) is not None:
            firsts = self._first_of_part[shared.part]
            bodies.insert(0, np.stack([self._begins[:-1], shared.owner, firsts], axis=1))
            turns.insert(0, self._turns)
        if plain:
            bodies.insert(0, [[0, -1, 0]])
            turns.insert(0, one)
        return np.concatenate(bodies).astype(np.int64), np.concatenate(turns)

    def objects(self, triangle: Integers) -> Ints32:
        """Objects of triangles (n,); -1 of no surface."""
        if self._scene.instances is None:
            return self.owners[triangle]
        return self._find(triangle)[1]

    def kinds(self, triangle: Integers) -> Ints32:
        """Kinds of surfaces of triangles (n,), rows of the table of materials; -1 of no surface."""
        if self._kind_in_object is None:
            return self.objects(triangle)
        rows, objects, _ = self._find(triangle)
        return self._kinds_of(rows, objects)

    def _kinds_of(self, rows: Indices, objects: Ints32) -> Ints32:
        """Kinds of surfaces of triangles, by rows among those that are kept once, and objects."""
        if self._kind_in_object is None:
            return objects
        kinds = self.material_kinds.first[:-1][objects] + self._kind_in_object[rows]
        return np.where(objects < 0, np.int32(-1), self._merged[kinds])

    @cached_property
    def _kind_in_object(self) -> Ints32 | None:
        """Number of the kind of each triangle kept once among those of its object, (f,).

        None if each object has one kind, which then has the number of the object.
        """
        if len(self.material_kinds.object) == len(self.material_kinds.names):
            return None
        scene = self._scene
        parts = () if scene.instances is None else scene.instances.parts
        meshes = [(len(mesh.faces), mesh.materials) for mesh in self._meshes]
        meshes += [(len(part.faces), part.materials) for part in parts]
        plain = None if scene.materials is None else scene.materials.index
        numbers = [np.zeros(len(scene.faces), np.int32) if plain is None else plain]
        for size, materials in meshes:
            index = None if materials is None else materials.index
            numbers.append(np.zeros(size, np.int32) if index is None else index)
        return np.concatenate(numbers)

    def material_numbers(self, triangle: Integers) -> Ints32:
        """Numbers of the names of triangles' materials, see `Scene.material_names`; -1 for none."""
        rows, objects, _ = self._find(triangle)
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
    def _merged(self) -> Ints32:
        """First kind of the same object that has the same material, for each kind.

        A surface with several names is one surface where one entry is for all of them: closed, if
        it holds a medium.
        """
        kinds = self.material_kinds
        first = first_matches(self._materials, self.material_kinds)
        keys = np.stack([kinds.object, first], axis=1)
        _, rows, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        return rows[which.reshape(-1)].astype(np.int32)

    def instances(self, triangle: Integers) -> Indices:
        """Instances that triangles (n,) belong to; each belongs to one."""
        return np.searchsorted(self._begins, triangle, side="right") - 1

    def counter(self, triangle: Integers) -> Integers:
        """Counters of hits of triangles (n,), see `Scene.counters`."""
        if self._scene.instances is None:
            return triangle
        plain, actors = self._begins[[0, -1]]
        which = self._find(triangle)[2]
        apart = actors - plain - (len(self._begins) - 1)
        own = np.where(triangle >= actors, triangle - apart, triangle)
        return np.where(which >= 0, plain + which, own)

    def energy(
        self,
        triangle: Integers,
        cosine: Floats,
        distance: Floats,
        light: Light,
        colours: UInts32 | None = None,
    ) -> Floats:
        """Received energy of rays that end on triangles (n,), at distances in metres.

        ``reflectance * cosine * (10 m / distance)**2 * exp(-2 * extinction * distance)``; for a
        retro-reflector, a gain replaces the cosine. Where materials are `textured`, the colours
        (n,) are needed.
        """
        table = self.at(light.wavelength_nm)
        bright = luminance(colours) if table.textured and colours is not None else None
        scattered = table.scattered(self.kinds(triangle), cosine, bright)
        return np.asarray(scattered * at_right_angles(distance, light.extinction))

    @cached_property
    def solids(self) -> tuple[Bools, Bools]:
        """Whether surfaces that hold a medium are closed, and point inwards, by kinds: (k,).

        They point inwards if they are closed and have a negative volume.
        """
        table = self.materials
        scene = self._scene
        closed = np.ones(len(table.reflectance), np.bool_)
        volume = np.zeros(len(closed))
        for number in np.flatnonzero(table.leafy | table.refracts).tolist():
            bodies: list[tuple[Floats, Integers]] = []
            owner = int(self.material_kinds.object[number])
            if owner >= self._standing:
                mesh = scene.actors[owner - self._standing].mesh
                bodies.append((mesh.vertices, self._of_kind(number, mesh.faces, mesh.materials)))
            else:
                bodies.append((scene.vertices, self._faces_of(number)))
            if scene.instances is not None:
                for row in np.unique(scene.instances.part[scene.instances.owner == owner]):
                    part = scene.instances.parts[row]
                    faces = self._of_kind(number, part.faces, part.materials)
                    bodies.append((part.vertices, faces))
            for vertices, faces in bodies:
                if not len(faces):
                    continue
                closed[number] &= _closed(vertices, faces)
                volume[number] += _volume(vertices, faces)
        return closed, closed & (volume < 0)

    @cached_property
    def _by_object(self) -> tuple[Indices, Indices]:
        """Rows of the scene's faces in the order of objects, and where those of each begin."""
        owners = self._scene.face_object
        order = np.argsort(owners, kind="stable")
        return order, np.searchsorted(owners[order], np.arange(self._standing + 1))

    def _faces_of(self, number: int) -> Integers:
        """Those of the scene's faces that are of a kind of surface."""
        order, begins = self._by_object
        owner = int(self.material_kinds.object[number])
        rows = order[begins[owner] : begins[owner + 1]]
        if self._scene.materials is None:
            return self._scene.faces[rows]
        materials = self._scene.materials.of_object(owner, rows)
        return self._of_kind(number, self._scene.faces[rows], materials)

    def _of_kind(self, number: int, faces: Integers, materials: FaceMaterials | None) -> Integers:
        """Those of some faces of an object that are of a kind of surface."""
        if self._kind_in_object is None:
            return faces
        kinds = self.material_kinds
        index = 0 if materials is None or materials.index is None else materials.index
        kind = self._merged[kinds.first[kinds.object[number]] + index]
        return faces[np.broadcast_to(kind == number, len(faces))]

    @cached_property
    def media(self) -> tuple[int, ...]:
        """Kinds of surfaces of the scene's faces that hold a medium within a closed surface."""
        table, (closed, _) = self.materials, self.solids
        held = (table.leafy | table.refracts) & closed
        held &= self.material_kinds.object < self._standing
        return tuple(np.flatnonzero(held).tolist())

    def spread_out(self, by_m: float) -> Floats:
        """Vertices of the scene's faces, where surfaces of media are so many metres further out.

        Water that touches its basin, or leaves that touch others, would share a surface with them,
        and light that meets one of two would miss the other.
        """
        if not self.media:
            return self._scene.vertices
        vertices = self._scene.vertices.copy()
        inwards = self.solids[1]
        for number in self.media:
            faces = self._faces_of(number)
            if not len(faces):
                continue
            used, corners = np.unique(faces, return_inverse=True)
            places, same = np.unique(vertices[used], axis=0, return_inverse=True)
            same = same.reshape(-1)
            corners = same[corners.reshape(-1)].reshape(-1, 3)
            a, b, c = places[corners].transpose(1, 0, 2)
            normals = np.cross(b - a, c - a) * (-1 if inwards[number] else 1)
            normals /= np.maximum(length(normals)[:, None], 1e-300)
            # Each vertex goes where all of its triangles are so much further out, or nearly.
            squares = np.zeros((len(places), 3, 3))
            sums = np.zeros((len(places), 3))
            np.add.at(squares, corners, (normals[:, :, None] * normals[:, None])[:, None])
            np.add.at(sums, corners, normals[:, None])
            squares += 1e-3 * np.eye(3)
            step = by_m * applied(inverse(squares), sums)
            places += np.clip(step, -4 * by_m, 4 * by_m)
            vertices[used] = places[same]
        return vertices

    @property
    def _kept(self) -> list[tuple[Floats, Integers, Colours | None]]:
        """Vertices, faces and colours of the triangles that are kept once.

        Those of the meshes of actors follow the scene's, and those of the parts of instances follow
        them.
        """
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
        """Unit normals of `_kept`: (f, 3)."""
        bodies = self._kept
        out = np.empty((sum(len(faces) for _, faces, _ in bodies), 3), np.float32)
        at = 0
        for vertices, faces, _ in bodies:
            for begin in range(0, len(faces), BLOCK_FACES):
                block = faces[begin : begin + BLOCK_FACES]
                out[at : at + len(block)] = _normals(vertices[block])
                at += len(block)
        return out

    @cached_property
    def _first_of_part(self) -> Indices:
        """Rows at which the parts of instances begin."""
        assert self._scene.instances is not None
        sizes = [len(part.faces) for part in self._scene.instances.parts]
        return self._parts_begin + np.cumsum([0, *sizes[:-1]])


def _turns(transforms: Floats) -> Floats:
    """Matrices (n, 3, 3) that take normals of parts to those of instances, but for their length."""
    return np.ascontiguousarray(inverse(transforms[:, :, :3]).transpose(0, 2, 1))


def _normals(corners: Floats) -> Floats32:
    """Return unit normals (n, 3) of triangles (n, 3, 3), in single precision."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    return (normals / np.maximum(length(normals)[:, None], 1e-300)).astype(np.float32)


def _weights(corners: Floats, points: Floats) -> Floats:
    """Weights (n, 3) of the corners (n, 3, 3) of triangles at points (n, 3) on them."""
    a, b, c = corners.transpose(1, 2, 0)
    one = b - a
    other = c - a
    to = points.T - a
    square = products(one, one)
    both = products(one, other)
    square_2 = products(other, other)
    along = products(to, one)
    along_2 = products(to, other)
    area = np.maximum(square * square_2 - both * both, 1e-300)
    v = (square_2 * along - both * along_2) / area
    w = (square * along_2 - both * along) / area
    return np.stack([1 - v - w, v, w], axis=1)


def _closed(vertices: Floats, faces: Integers) -> bool:
    """Whether a surface has no gaps: each edge is one of two triangles that wind alike."""
    used, corners = np.unique(faces, return_inverse=True)
    # Vertices of flat shading are one for each triangle.
    _, same = np.unique(vertices[used], axis=0, return_inverse=True)
    corners = same.reshape(-1)[corners.reshape(-1)].reshape(-1, 3).astype(np.int64)
    ahead = corners.reshape(-1)
    after = np.roll(corners, -1, axis=1).reshape(-1)
    some = ahead != after
    there, back = (
        np.sort(one[some] * len(used) + other[some])
        for one, other in ((ahead, after), (after, ahead))
    )
    return bool(np.array_equal(there, back))


def _volume(vertices: Floats, faces: Integers) -> float:
    """Volume within a closed surface, m³; negative if its triangles wind the other way."""
    a, b, c = (vertices[faces] - vertices[faces[0, 0]]).transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)

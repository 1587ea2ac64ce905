"""Actors: objects that move through the scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..base.arrays import Floats, Indices
from ..base.elementary import interp
from ..base.errors import LidarError, prefixed
from ..base.validation import checked_fields
from ..base.vectors import length, products, turned
from ..sensor import Stations, Track, Trajectory
from ..sensor.trajectory import CENTRE, check_rotations, full_poses, presence_ns, quaternions_of
from . import face_materials
from .colours import joined
from .scene_instances import SceneInstance, parts_of
from .scene_mesh import SceneMesh, stacked

SAMPLES_MOST = 200_000  # poses of all actors
# by which ways of unknown classes are measured
WAY_POSES = 10_001
LONG_NS = 1e12
AT_ZERO = Stations((CENTRE,))


@dataclass(frozen=True, eq=False)
@checked_fields
class Actor:
    """A moving object.

    Parameters
    ----------
    mesh
        Its triangles in its own axes (x ahead, z up), and its name.
    trajectory
        Poses of its axes, in the scene's local coordinates; its only station begins with the
        survey. By default it stands at zero, until `Scanner.move` moves it.
    offset_s
        Where in the mesh's animation it is as the survey, or by speed the way, begins, seconds.
    spray
        Whether it raises spray where the weather has some, and it moves.

    Raises
    ------
    LidarError
        If the mesh has voxels, or the first rotation of the trajectory mirrors or deforms.
    """

    mesh: SceneMesh
    trajectory: Trajectory = AT_ZERO
    offset_s: float = 0.0
    spray: bool = True

    def __post_init__(self) -> None:
        if self.mesh.voxels is not None:
            raise LidarError(
                f"{self.name!r} is of voxels, which cannot move: name it in scene.files or copies."
            )
        if not isinstance(self.trajectory, Track | Stations):
            self._check_first_pose()

    def _check_first_pose(self) -> None:
        """Check the first rotation of a trajectory of another class, which may be a user's."""
        first_ns = max(presence_ns(self.trajectory)[0], 0.0)
        try:
            _, rotations = full_poses(self.trajectory, 0, np.array([first_ns]))
        except LidarError:  # it does not cover this time, which `check` says
            return
        with prefixed(f"Actor {self.name!r}"):
            check_rotations(np.asarray(rotations, np.float64))

    @property
    def name(self) -> str:
        """Its name."""
        return self.mesh.name

    def placed(self, time_ns: float) -> SceneMesh:
        """Its mesh at a time, in the scene's local coordinates; one point if it is absent."""
        positions, rotations = self.trajectory.poses(0, np.array([time_ns]))
        vertices = self.mesh.vertices
        if (animation := self.mesh.animation) is not None:
            vertices = animation.at(self.played(np.array([time_ns]))[0])[0][0]
        vertices = turned(vertices, None if rotations is None else rotations[0])
        first, last = presence_ns(self.trajectory)
        vertices = vertices if first <= time_ns <= last else 0 * vertices
        # Masks do not show.
        return SceneMesh(
            self.name, vertices + positions[0], self.mesh.faces, colours=self.mesh.colours
        )

    def played(self, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return frames of its animation at times (k,), nanoseconds, and frames a second then."""
        seconds, rates = self.seconds(times_ns)
        animation = self.mesh.animation
        assert animation is not None
        if not animation.repeat:
            rates = rates * ((seconds >= 0) & (seconds < animation.duration_s))
        return animation.frames(seconds), rates / animation.step_s

    def bounds_between(self, begins_ns: Floats, ends_ns: Floats) -> Floats:
        """Boxes of all its poses between times (k,), nanoseconds, in its own axes: (k, 2, 3)."""
        if (animation := self.mesh.animation) is None:
            return self.mesh.bounds[None].repeat(len(begins_ns), axis=0)
        times = np.linspace(begins_ns, ends_ns, 5)  # it may go there and back
        seconds = self.seconds(times.reshape(-1))[0].reshape(times.shape)
        return animation.bounds_between(seconds.min(axis=0), seconds.max(axis=0))

    def seconds(self, times_ns: Floats) -> tuple[Floats, Floats]:
        """Seconds of its animation at times (k,), nanoseconds, and how many a second pass then."""
        animation = self.mesh.animation
        assert animation is not None
        if (speed := animation.speed_m_s) is None:
            return times_ns / 1e9 + self.offset_s, np.ones(len(times_ns))
        at, metres = self._way
        speeds = np.diff(metres, prepend=metres[0], append=metres[-1])
        speeds[1:-1] /= np.diff(at) / 1e9
        passing = speeds[np.searchsorted(at, times_ns, "right")]
        return interp(times_ns, at, metres) / speed + self.offset_s, passing / speed

    @cached_property
    def _way(self) -> tuple[Floats, Floats]:
        """Times (k,), nanoseconds, and how far it has gone by then, metres; back is negative.

        Before and after it stands.
        """
        way = self.trajectory
        if not way.moves:
            return np.zeros(1), np.zeros(1)
        if isinstance(way, Track):
            times = (way.times_s - (way.start_s or 0.0)) * 1e9
        else:
            times = np.linspace(0, min(way.duration_ns, LONG_NS), WAY_POSES)
        positions, rotations = way.poses(0, times.clip(*presence_ns(way)))
        steps = np.diff(positions, axis=0)
        metres = length(steps)
        if rotations is not None:
            back = products(steps.T, rotations[:-1, :, 0].T) < 0
            metres = np.where(back, -metres, metres)
        return times, np.append(0.0, np.cumsum(metres))

    def samples(self, duration_ns: float, count: int) -> tuple[Floats, Floats, Floats]:
        """Return times (k,), nanoseconds, positions (k, 3) and quaternions (k, 4), for drawings.

        They are even over the part of a survey of `duration_ns` in which it is in the scene.
        """
        appears, leaves = presence_ns(self.trajectory)
        first = max(appears, 0.0)
        times = np.linspace(first, max(min(leaves, duration_ns), first + 1e6), count)
        positions, rotations = full_poses(self.trajectory, 0, times)
        return times, positions, quaternions_of(rotations)

    def check(self, begin_ns: float, end_ns: float) -> None:
        """Check that its trajectory covers a time; LidarError if not."""
        try:
            self.trajectory.poses(0, np.array([begin_ns, end_ns], np.float64))
        except LidarError as error:
            words = str(error).rstrip(".")
            raise LidarError(
                f"Actor {self.name!r}: {words}: let its trajectory begin before the first scan and "
                "end after the last."
            ) from error


def check_spray(actors: Iterable[Actor]) -> None:
    """Check that actors that raise spray have a size; LidarError if not."""
    for actor in actors:
        if actor.spray and not (np.ptp(actor.mesh.vertices, axis=0) > 0).all():
            raise LidarError(
                f"Actor {actor.name!r} raises spray as wide and high as it is, and is flat: give "
                "it a mesh with a length, width and height, or spray: false."
            )


def samples_each(actors: Sequence[Actor], most: int) -> int:
    """Return how many poses of each actor a drawing keeps: `most` of each, fewer of many actors."""
    return max(20, min(most, SAMPLES_MOST // max(len(actors), 1)))


def shapes_of(actors: Iterable[Actor]) -> tuple[list[SceneMesh], Indices]:
    """Meshes (m,) of actors, each once, and which of them each actor (a,) has.

    Meshes are the same if they share their arrays, which pickling preserves.
    """
    numbers: dict[tuple[int, ...], int] = {}  # {ids of the arrays: number of the mesh}
    meshes: list[SceneMesh] = []
    which = []
    for mesh in (actor.mesh for actor in actors):
        parts = (
            mesh.vertices, mesh.faces, mesh.colours, mesh.materials, mesh.animation, *mesh.cutouts,
        )  # fmt: skip
        number = numbers.setdefault(tuple(map(id, parts)), len(meshes))
        if number == len(meshes):
            meshes.append(mesh)
        which.append(number)
    return meshes, np.array(which, np.intp)


def one_mesh(name: str, objects: Iterable[SceneMesh | SceneInstance]) -> SceneMesh:
    """Join objects to one; masks are kept, and the animation of some, without the masks."""
    flat = [one.flat() if isinstance(one, SceneInstance) else one for one in objects]
    if any(part.voxels is not None for part in flat):
        if flat[1:]:
            raise LidarError(f"{name!r} has voxels, and cannot be joined to other objects.")
        return replace(flat[0], name=name)
    if any(mesh.animation for mesh in flat):
        return _one_animated(name, flat)
    parts = [part for mesh in flat for part in parts_of(mesh)]
    parts.sort(key=lambda part: part.mask is not None)  # those with masks last
    vertices, faces = stacked((part.vertices, part.faces) for part in parts)
    cutouts = [cut for mesh in flat for cut in mesh.cutouts]
    sizes = [len(part.faces) for part in parts]
    colours = joined([part.colours for part in parts], sizes)
    materials = face_materials.joined([part.materials for part in parts], sizes)
    return SceneMesh(name, vertices, faces, tuple(cutouts), colours, materials=materials)


def _one_animated(name: str, meshes: Sequence[SceneMesh]) -> SceneMesh:
    """Join meshes of which some have poses of one animation."""
    first = next(mesh.animation for mesh in meshes if mesh.animation)
    still = (len(first.vertices), 1, 1)
    poses = [m.animation.vertices if m.animation else np.tile(m.vertices, still) for m in meshes]
    animation = replace(first, vertices=np.concatenate(poses, axis=1))
    sizes = [len(mesh.faces) for mesh in meshes]
    colours = joined([mesh.colours for mesh in meshes], sizes)
    materials = face_materials.joined([mesh.materials for mesh in meshes], sizes)
    parts = stacked((mesh.vertices, mesh.faces) for mesh in meshes)
    return SceneMesh(name, *parts, colours=colours, animation=animation, materials=materials)


def box(name: str, size_m: tuple[float, float, float]) -> SceneMesh:
    """Return a box of a length, width and height, its origin in the middle of its underside."""
    corners = np.array([(x, y, z) for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    sides = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [[a, b, c] for a, b, c, _ in sides] + [[a, c, d] for a, _, c, d in sides]
    return SceneMesh(name, corners * size_m, np.array(faces))

"""Actors, which are objects that move through the scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..errors import LidarError, prefix_errors
from ..motion.rotations import check_rotations, quaternions_of
from ..motion.trajectory import (
    CENTER,
    StaticPose,
    Stations,
    Track,
    Trajectory,
    check_trajectory_type,
    full_poses,
    presence_ns,
)
from ..numerics.arrays import Floats, Indices
from ..numerics.elementary import interp
from ..numerics.vectors import dot, norm, rotate
from ..schema.checks import check_fields, check_fits
from ..schema.value_texts import one_line
from . import face_materials
from .colors import join_colors
from .scene_instances import SceneInstance, split_by_masks
from .scene_mesh import SceneMesh, stack_meshes

MAX_SAMPLES = 200_000  # drawn poses of all actors
# Number of poses and maximum duration for measuring the length of user-defined trajectories.
TRAJECTORY_POSES = 10_001
MAX_DURATION_NS = 1e12
AT_ZERO = Stations((CENTER,))
CHECKED_TRAJECTORIES = (Track, Stations, StaticPose)  # their rotations need no further checks


class ActorSamples(NamedTuple):
    """Sampled poses of an actor."""

    times_ns: Floats  # (k,), nanoseconds since the start of the survey
    positions: Floats  # (k, 3), local coordinates in meters
    quaternions: Floats  # (k, 4)


@dataclass(frozen=True, eq=False)
class Actor:
    """An object that moves during a survey.

    Parameters
    ----------
    mesh
        Mesh in the frame of the actor (x forward, z up). Its name is the name of the actor.
    trajectory
        Poses of the actor in local scene coordinates. The trajectory has a single station, which
        starts with the survey. By default, the actor stays at the origin until it is moved by
        `Scanner.move`.
    offset_s
        Animation time of the mesh at the start of the survey, in seconds. If the speed of the actor
        controls the animation, it is the animation time at the start of the trajectory.
    spray
        Whether the actor raises spray while it moves. It has an effect only if the weather includes
        spray.

    Raises
    ------
    LidarError
        If the mesh contains voxels, or if the first rotation of the trajectory is not a valid
        rotation matrix.
    """

    mesh: SceneMesh
    trajectory: Trajectory = AT_ZERO
    offset_s: float = 0.0
    spray: bool = True

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        check_trajectory_type("trajectory", self.trajectory)
        if self.mesh.voxels is not None:
            raise LidarError(
                f"{self.name!r} contains voxels, which cannot move. List it in scene.files or "
                "scene.copies."
            )
        if not isinstance(self.trajectory, CHECKED_TRAJECTORIES):
            self._check_first_pose()

    def _check_first_pose(self) -> None:
        """Check the initial rotation, since the trajectory's class can be user-defined."""
        first_ns = max(presence_ns(self.trajectory)[0], 0.0)
        try:
            _, rotations = full_poses(self.trajectory, 0, np.array([first_ns]))
        except LidarError:  # the trajectory does not cover this time, which `check` reports
            return
        with prefix_errors(f"Actor {self.name!r}"):
            check_rotations(np.asarray(rotations, np.float64))

    def with_trajectory(self, trajectory: Trajectory) -> Actor:
        """Return a copy of the actor with another trajectory.

        Raises
        ------
        LidarError
            If the first rotation of the trajectory is not a valid rotation matrix.
        """
        actor = object.__new__(type(self))  # ten times as fast as `copy`
        vars(actor).update(vars(self), trajectory=trajectory)
        vars(actor).pop("_traveled", None)
        if not isinstance(trajectory, CHECKED_TRAJECTORIES):
            actor._check_first_pose()
        return actor

    @property
    def name(self) -> str:
        """Name of the actor, which is the name of its mesh."""
        return self.mesh.name

    @property
    def bounds(self) -> Floats:
        """Bounding box of the mesh over all animation frames, in the actor frame and in meters.

        The shape is (2, 3).
        """
        return (self.mesh.animation or self.mesh).bounds

    def mesh_at(self, time_ns: float) -> SceneMesh:
        """Return the mesh at a given time in local scene coordinates.

        At times when the actor is absent, the mesh is collapsed to a point.
        """
        positions, rotations = self.trajectory.poses(0, np.array([time_ns]))
        vertices = self.mesh.vertices
        if (animation := self.mesh.animation) is not None:
            vertices = animation.vertices_at(self.frames_at(np.array([time_ns]))[0])[0][0]
        vertices = rotate(vertices, None if rotations is None else rotations[0])
        first, last = presence_ns(self.trajectory)
        vertices = vertices if first <= time_ns <= last else 0 * vertices
        # This method is only used for pictures, which do not show masks.
        return SceneMesh(
            self.name, vertices + positions[0], self.mesh.faces, colors=self.mesh.colors
        )

    def frames_at(self, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the animation frames and frame rates at several times.

        Times have shape (k,) and are in nanoseconds since the start of the survey. Frame
        numbers can be fractional, and rates are in frames per second.
        """
        seconds, rates = self.seconds(times_ns)
        animation = self.mesh.animation
        assert animation is not None
        if not animation.repeat:
            rates = rates * ((seconds >= 0) & (seconds < animation.duration_s))
        return animation.frames(seconds), rates / animation.step_s

    def seconds(self, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the animation times and playback rates at several times.

        Times have shape (k,) and are in nanoseconds since the start of the survey. Animation times
        are in seconds. A playback rate is the animation time that passes per second of the survey.
        """
        animation = self.mesh.animation
        assert animation is not None
        if (speed := animation.speed_m_s) is None:
            return times_ns / 1e9 + self.offset_s, np.ones(len(times_ns))
        passed_ns, distances_m = self._traveled
        speeds = np.diff(distances_m, prepend=distances_m[0], append=distances_m[-1])
        speeds[1:-1] /= np.diff(passed_ns) / 1e9
        rates = speeds[np.searchsorted(passed_ns, times_ns, "right")] / speed
        return interp(times_ns, passed_ns, distances_m) / speed + self.offset_s, rates

    @cached_property
    def _traveled(self) -> tuple[Floats, Floats]:
        """Sample times in nanoseconds, and the distances traveled up to these times in meters.

        Distances decrease while the actor moves backward. The actor is stationary before the first
        and after the last time. Both arrays have shape (k,).
        """
        trajectory = self.trajectory
        if not trajectory.moves:
            return np.zeros(1), np.zeros(1)
        if isinstance(trajectory, Track):
            times_ns = (trajectory.times_s - (trajectory.start_s or 0.0)) * 1e9
        else:
            times_ns = np.linspace(
                0, min(trajectory.duration_ns, MAX_DURATION_NS), TRAJECTORY_POSES
            )
        positions, rotations = trajectory.poses(0, times_ns.clip(*presence_ns(trajectory)))
        steps = np.diff(positions, axis=0)
        steps_m = norm(steps)
        faces_travel = isinstance(trajectory, Track) and trajectory.quaternions is None
        if rotations is not None and not faces_travel:
            backward = dot(steps.T, rotations[:-1, :, 0].T) < 0
            steps_m = np.where(backward, -steps_m, steps_m)
        return times_ns, np.append(0.0, np.cumsum(steps_m))

    def samples(self, duration_ns: float, count: int) -> ActorSamples:
        """Return `count` poses that are evenly spaced in time, for drawing the trajectory.

        The poses cover the time during which the actor is present in a survey of `duration_ns`
        nanoseconds.
        """
        appears, leaves = presence_ns(self.trajectory)
        first = max(appears, 0.0)
        times_ns = np.linspace(first, max(min(leaves, duration_ns), first + 1e6), count)
        positions, rotations = full_poses(self.trajectory, 0, times_ns)
        return ActorSamples(times_ns, positions, quaternions_of(rotations))

    def check(self, start_ns: float, stop_ns: float) -> None:
        """Check that the trajectory covers a time interval in nanoseconds.

        Raises
        ------
        LidarError
            If the trajectory does not cover the interval.
        """
        try:
            self.trajectory.poses(0, np.array([start_ns, stop_ns], np.float64))
        except LidarError as error:
            reason = str(error).rstrip(".")
            raise LidarError(
                f"Actor {self.name!r}: {reason}. Extend its trajectory or shorten the survey. To "
                "keep the first and last pose outside the trajectory, set `beyond: hold`; to "
                "remove the actor there, set `beyond: absent`."
            ) from error


def check_spray(actors: Iterable[Actor]) -> None:
    """Raise LidarError if an actor that raises spray is flat."""
    for actor in actors:
        if actor.spray and not (np.ptp(actor.mesh.vertices, axis=0) > 0).all():
            raise LidarError(
                f"Actor {actor.name!r} is flat, so the size of its spray is unknown. Use a mesh "
                "with a length, width and height, or set spray to false."
            )


def samples_per_actor(actors: Sequence[Actor], max_samples: int) -> int:
    """Return the number of poses to draw for each actor.

    The number is `max_samples`, or fewer if there are many actors, but at least 20.
    """
    return max(20, min(max_samples, MAX_SAMPLES // max(len(actors), 1)))


def distinct_meshes(meshes: Iterable[SceneMesh]) -> tuple[list[SceneMesh], Indices]:
    """Return the distinct meshes, and for each mesh the index of its distinct mesh.

    Two meshes are the same if they share their arrays, even if their names differ. Pickling
    preserves this.
    """
    mesh_indices: dict[tuple[int, ...], int] = {}  # {ids of the arrays: index of the mesh}
    distinct: list[SceneMesh] = []
    indices = []
    for mesh in meshes:
        arrays = (
            mesh.vertices,
            mesh.faces,
            mesh.colors,
            mesh.voxels,
            mesh.materials,
            mesh.animation,
            *mesh.cutouts,
        )
        index = mesh_indices.setdefault(tuple(map(id, arrays)), len(distinct))
        if index == len(distinct):
            distinct.append(mesh)
        indices.append(index)
    return distinct, np.array(indices, np.intp)


def join_meshes(name: str, objects: Iterable[SceneMesh | SceneInstance]) -> SceneMesh:
    """Merge objects into one mesh in world coordinates.

    Masks are kept unless a mesh is animated.

    Raises
    ------
    LidarError
        If a mesh with voxels would be merged with another mesh.
    """
    flat = [item.flat() if isinstance(item, SceneInstance) else item for item in objects]
    if any(part.voxels is not None for part in flat):
        if flat[1:]:
            raise LidarError(f"{name!r} contains voxels and cannot be joined with other objects.")
        return replace(flat[0], name=name)
    if any(mesh.animation for mesh in flat):
        return _join_animated(name, flat)
    parts = [part for mesh in flat for part in split_by_masks(mesh)]
    parts.sort(key=lambda part: part.mask is not None)  # parts with masks last
    vertices, faces = stack_meshes((part.vertices, part.faces) for part in parts)
    cutouts = [cutout for mesh in flat for cutout in mesh.cutouts]
    sizes = [len(part.faces) for part in parts]
    colors = join_colors([part.colors for part in parts], sizes)
    materials = face_materials.join_materials([part.materials for part in parts], sizes)
    return SceneMesh(name, vertices, faces, tuple(cutouts), colors, materials=materials)


def _join_animated(name: str, meshes: Sequence[SceneMesh]) -> SceneMesh:
    """Merge meshes that are static or belong to the same animation."""
    first = next(mesh.animation for mesh in meshes if mesh.animation)
    repeats = (len(first.vertices), 1, 1)
    poses = [
        mesh.animation.vertices if mesh.animation else np.tile(mesh.vertices, repeats)
        for mesh in meshes
    ]
    animation = replace(first, vertices=np.concatenate(poses, axis=1))
    sizes = [len(mesh.faces) for mesh in meshes]
    colors = join_colors([mesh.colors for mesh in meshes], sizes)
    materials = face_materials.join_materials([mesh.materials for mesh in meshes], sizes)
    parts = stack_meshes((mesh.vertices, mesh.faces) for mesh in meshes)
    return SceneMesh(name, *parts, colors=colors, animation=animation, materials=materials)


def box(name: str, size_m: tuple[float, float, float]) -> SceneMesh:
    """Create a box mesh whose origin is the center of its bottom face.

    Parameters
    ----------
    name
        Name of the object.
    size_m
        Length along x, width along y and height along z, in meters.

    Examples
    --------
    >>> box("Car", (4.5, 1.8, 1.5)).bounds.tolist()
    [[-2.25, -0.9, 0.0], [2.25, 0.9, 1.5]]
    """
    check_fits("size_m", size_m, tuple[float, float, float])
    corners = np.array([(x, y, z) for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    sides = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [[a, b, c] for a, b, c, _ in sides] + [[a, c, d] for a, _, c, d in sides]
    return SceneMesh(name, corners * size_m, np.array(faces))

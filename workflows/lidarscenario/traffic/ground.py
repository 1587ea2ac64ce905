"""Upward-facing surfaces of a scene, on which copies, traffic and platforms are placed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.media.materials import match_names
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Track
from lidarsim.numerics.arrays import Floats, Indices, Ints32
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.words import name_hint
from raybeam import RayCaster, available_backends

STEP_M = 0.5  # maximum distance between the poses of a trajectory that follows a surface
MAX_STEPS = 1_000_000


class SupportSurfaces:
    """Upward-facing triangles of all or some objects in a scene.

    If there are several surfaces at a position, the highest is used. `scene` is None if the scene
    has no triangles, and `objects` contains the indices of the objects, or None for all objects.
    """

    def __init__(self, scene: Scene | None, objects: Indices | None = None) -> None:
        self._scene = scene
        self._objects = objects
        self._selections: dict[tuple[str, ...], SupportSurfaces] = {}  # {name patterns: surfaces}

    @property
    def origin(self) -> Floats:
        """Origin of the scene in world coordinates, in meters.

        The array has shape (3,).
        """
        return np.zeros(3) if self._scene is None else self._scene.origin

    def select(self, names: Sequence[str]) -> SupportSurfaces:
        """Return the surfaces of objects whose names match one of the patterns.

        Raise LidarError if no object matches a pattern, or if none of the triangles faces up.
        """
        key = tuple(names)
        scene = self._scene
        if key in self._selections:
            return self._selections[key]
        if scene is None:
            raise LidarError(
                "The scene has no surface to place objects on. Add `scene.files`, or "
                "`scene.ground` and a rectangle as `within`."
            )
        rows = [match_names(name, scene.names) for name in names]
        for name, matches in zip(names, rows, strict=True):
            if not len(matches):
                raise LidarError(
                    f"`surfaces` contains {name!r}, but no object has that name."
                    f"{name_hint(name, scene.names)}"
                )
        matches = np.unique(np.concatenate(rows))
        selected = self if len(matches) == len(scene.names) else SupportSurfaces(scene, matches)
        if not len(selected._tops[0]):
            raise LidarError(
                f"{', '.join(map(repr, names))} cannot be used as surfaces, because none of their "
                "triangles faces up."
            )
        self._selections[key] = selected
        return selected

    @cached_property
    def _tops(self) -> tuple[Floats, Ints32]:
        """Upward-facing triangles, and the index of each triangle's object.

        The triangles are in local coordinates and have shape (f, 3, 3). The indices have shape
        (f,).
        """
        assert self._scene is not None
        scene = self._scene
        shared = self._scene.instances
        if shared and (self._objects is None or np.isin(shared.owner, self._objects).any()):
            # The triangles of instances are exact, unless there are millions of them.
            scene = SimplifiedScene.from_scene(scene).scene
        corners = scene.vertices[scene.faces]
        owner = scene.face_object
        if self._objects is not None:
            selected = np.isin(owner, self._objects)
            corners = corners[selected]
            owner = owner[selected]
        (ax, ay), (bx, by) = ((corners[:, k] - corners[:, 0]).T[:2] for k in (1, 2))
        up = ax * by - ay * bx > 0
        return corners[up], owner[up]

    @cached_property
    def _caster(self) -> RayCaster:
        # CUDA is not used, because its context would remain in this process.
        backend = "numpy" if available_backends()["tiles"] else "tiles"
        corners = self._tops[0].reshape(-1, 3)
        return RayCaster(corners, np.arange(len(corners)).reshape(-1, 3), backend)

    @property
    def rectangle(self) -> Floats:
        """Minimum x and y, and maximum x and y, in world coordinates.

        The array has shape (4,).
        """
        assert self._scene is not None
        x, y = self._tops[0][..., :2].reshape(-1, 2).T
        origin = self._scene.origin[[0, 1, 0, 1]]
        return np.array([x.min(), y.min(), x.max(), y.max()]) + origin

    @cached_property
    def owners(self) -> Ints32:
        """Indices of the objects with upward-facing triangles, in ascending order."""
        return np.unique(self._tops[1])

    def heights_below(self, positions: Floats) -> tuple[Floats, Ints32]:
        """Return the height of the highest surface at each position, and the object it belongs to.

        Parameters
        ----------
        positions
            Horizontal positions in world coordinates, in meters. Shape (n, 2).

        Returns
        -------
        heights
            Heights in world coordinates, in meters, or NaN if there is no surface. Shape (n,).
        objects
            Indices of the objects, or -1 if there is no surface. Shape (n,).
        """
        heights = np.full(len(positions), np.nan)
        objects = np.full(len(positions), -1, np.int32)
        if self._scene is None or not len(self._tops[0]):
            return heights, objects
        corners, owner = self._tops
        origin = self._scene.origin
        top = float(corners[..., 2].max()) + 1.0
        origins = np.column_stack([positions - origin[:2], np.full(len(positions), top)])
        hits = self._caster.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        hit_rays = hits.hit
        heights[hit_rays] = top - hits.distance[hit_rays] + origin[2]
        objects[hit_rays] = owner[hits.triangle[hit_rays]]
        return heights, objects


def follow_surfaces(track: Track, support: SupportSurfaces) -> list[Track]:
    """Return the parts of a trajectory that are on surfaces.

    Poses are at most `STEP_M` apart. Their z axes are perpendicular to the mean slope of the
    surface within a meter, and their headings are preserved.

    Parameters
    ----------
    track
        Trajectory in the local coordinates of a scene, with heights relative to the surfaces.
    support
        Surfaces that the trajectory follows.

    Returns
    -------
    list of Track
        Trajectories in the local coordinates of the scene. There is one for each part of `track`
        that is on the surfaces.

    Raises
    ------
    LidarError
        If the trajectory is too long.
    """
    track = track.with_turns
    times = _step_times(track)
    moved = replace(track, start_s=float(times[0]), duration_s=None)
    positions, rotations = moved.poses(0, (times - times[0]) * 1e9)
    positions = positions.copy()
    forward = rotations[:, :2, 0] / np.linalg.norm(rotations[:, :2, 0], axis=1)[:, None]
    heights, axes = _surface_poses(positions[:, :2], forward, support)
    # `heights` are world coordinates. The heights of the trajectory are relative to the surface,
    # but the origin has been subtracted from them, so the sum is in local coordinates.
    positions[:, 2] += heights
    edges = np.flatnonzero(np.diff(np.isfinite(heights), prepend=False, append=False))
    parts = [
        slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist() if stop - start > 1
    ]
    return [
        replace(
            track,
            times_s=times[rows],
            positions=positions[rows],
            quaternions=quaternions_of(axes[rows]),
        )
        for rows in parts
    ]


def _step_times(track: Track) -> Floats:
    """Return times in seconds at which poses along a trajectory are at most `STEP_M` apart.

    Raise LidarError if there are too many.
    """
    distances_m = np.linalg.norm(np.diff(track.positions, axis=0), axis=1)
    steps = np.maximum(np.ceil(distances_m / STEP_M), 1).astype(np.int64)
    if steps.sum() > MAX_STEPS:
        raise LidarError(
            f"The trajectory is {distances_m.sum() / 1000:,.0f} km long, but the limit for "
            f"following surfaces is {MAX_STEPS * STEP_M / 1000:,.0f} km."
        )
    fractions = np.concatenate([np.arange(n) / n for n in steps.tolist()])
    segments = np.repeat(np.arange(len(steps)), steps)
    times = track.times_s[segments] + fractions * np.diff(track.times_s)[segments]
    return np.append(times, track.times_s[-1])


def _surface_poses(
    positions: Floats, forward: Floats, support: SupportSurfaces
) -> tuple[Floats, Floats]:
    """Return the heights and axes of poses that stand on surfaces and follow their slope.

    Parameters
    ----------
    positions
        Horizontal positions in local coordinates, in meters. Shape (n, 2).
    forward
        Directions of travel as unit vectors. Shape (n, 2).
    support
        The surfaces.

    Returns
    -------
    heights
        Heights in world coordinates, in meters, or NaN if there is no surface. Shape (n,).
    axes
        Rotation matrices of the poses. Shape (n, 3, 3).
    """
    leftward = np.column_stack([-forward[:, 1], forward[:, 0]])
    probes = [
        positions + STEP_M * direction
        for direction in (0 * forward, forward, -forward, leftward, -leftward)
    ]
    origin = support.origin
    heights = [support.heights_below(probe + origin[:2])[0] for probe in probes]
    center, front, back, left, right = (np.where(np.isnan(h), heights[0], h) for h in heights)
    x = np.column_stack([2 * STEP_M * forward, front - back])
    y = np.column_stack([2 * STEP_M * leftward, left - right])
    x /= np.linalg.norm(x, axis=1)[:, None]
    z = np.cross(x, y)
    z /= np.linalg.norm(z, axis=1)[:, None]
    return center, np.stack([x, np.cross(z, x), z], axis=2)

"""Surfaces of a scene that face up, which copies, traffic and carriers stand on."""

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

STEP_M = 0.5  # step of a trajectory that follows a surface
MAX_STEPS = 1_000_000


class StandingSurfaces:
    """The triangles of a scene that face up, of all objects or of a selection.

    The highest of several surfaces counts. `scene` is None for a scene without triangles.
    """

    def __init__(self, scene: Scene | None, objects: Indices | None = None) -> None:
        self._scene = scene
        self._objects = objects
        self._selections: dict[tuple[str, ...], StandingSurfaces] = {}  # {names: their surfaces}

    @property
    def origin(self) -> Floats:
        """Origin of the scene, (3,), world meters."""
        return np.zeros(3) if self._scene is None else self._scene.origin

    def of_objects(self, names: Sequence[str]) -> StandingSurfaces:
        """Return the surfaces of the objects that fit names.

        Raises LidarError if no triangle faces up.
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
        selected = self if len(matches) == len(scene.names) else StandingSurfaces(scene, matches)
        if not len(selected._tops[0]):
            raise LidarError(
                f"{', '.join(map(repr, names))} cannot be used as surfaces, because none of their "
                "triangles faces up."
            )
        self._selections[key] = selected
        return selected

    @cached_property
    def _tops(self) -> tuple[Floats, Ints32]:
        """Triangles that face up, local (f, 3, 3), and their objects (f,)."""
        assert self._scene is not None
        scene = self._scene
        shared = self._scene.instances
        if shared and (self._objects is None or np.isin(shared.owner, self._objects).any()):
            scene = SimplifiedScene.from_scene(scene).scene
        corners = scene.vertices[scene.faces]
        owner = scene.face_object
        if self._objects is not None:
            of_objects = np.isin(owner, self._objects)
            corners = corners[of_objects]
            owner = owner[of_objects]
        (ax, ay), (bx, by) = ((corners[:, k] - corners[:, 0]).T[:2] for k in (1, 2))
        up = ax * by - ay * bx > 0
        return corners[up], owner[up]

    @cached_property
    def _caster(self) -> RayCaster:
        """Ray caster of the surfaces."""
        # Never CUDA, whose context would stay in this process.
        backend = "numpy" if available_backends()["tiles"] else "tiles"
        corners = self._tops[0].reshape(-1, 3)
        return RayCaster(corners, np.arange(len(corners)).reshape(-1, 3), backend)

    @property
    def rectangle(self) -> Floats:
        """Lowest x and y, highest x and y of the surfaces, world meters: (4,)."""
        assert self._scene is not None
        x, y = self._tops[0][..., :2].reshape(-1, 2).T
        origin = self._scene.origin[[0, 1, 0, 1]]
        return np.array([x.min(), y.min(), x.max(), y.max()]) + origin

    @cached_property
    def owners(self) -> Ints32:
        """Indices of the objects that have triangles facing up, ascending."""
        return np.unique(self._tops[1])

    def heights_below(self, positions: Floats) -> tuple[Floats, Ints32]:
        """Return the heights of the surface below positions (n, 2), and its objects, world meters.

        Both are (n,): nan and -1 without a surface.
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


def follow_surfaces(track: Track, standing: StandingSurfaces) -> list[Track]:
    """Return the pieces of a trajectory that are on surfaces, with a pose every 0.5 m.

    Heights of the trajectory are above the surface. The z axes of the poses are the mean normal
    of the surface within a meter; headings stay.

    Parameters
    ----------
    track
        In a scene's local coordinates; heights above the surface.

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
    ahead = rotations[:, :2, 0] / np.linalg.norm(rotations[:, :2, 0], axis=1)[:, None]
    heights, axes = _surface_poses(positions[:, :2], ahead, standing)
    positions[:, 2] += heights  # world heights: the heights they are added to lack the origin
    edges = np.flatnonzero(np.diff(np.isfinite(heights), prepend=False, append=False))
    stretches = [
        slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist() if stop - start > 1
    ]
    return [
        replace(
            track,
            times_s=times[rows],
            positions=positions[rows],
            quaternions=quaternions_of(axes[rows]),
        )
        for rows in stretches
    ]


def _step_times(track: Track) -> Floats:
    """Return times in seconds at steps of at most `STEP_M`.

    Raises LidarError if there are too many.
    """
    distances_m = np.linalg.norm(np.diff(track.positions, axis=0), axis=1)
    steps = np.maximum(np.ceil(distances_m / STEP_M), 1).astype(np.int64)
    if steps.sum() > MAX_STEPS:
        raise LidarError(
            f"The trajectory is {distances_m.sum() / 1000:,.0f} km long, but the limit for "
            f"following surfaces is {MAX_STEPS * STEP_M / 1000:,.0f} km."
        )
    shares = np.concatenate([np.arange(n) / n for n in steps.tolist()])
    segments = np.repeat(np.arange(len(steps)), steps)
    times = track.times_s[segments] + shares * np.diff(track.times_s)[segments]
    return np.append(times, track.times_s[-1])


def _surface_poses(
    positions: Floats, ahead: Floats, standing: StandingSurfaces
) -> tuple[Floats, Floats]:
    """Return the heights (n,) of surfaces below positions, and the axes (n, 3, 3) of the slope.

    `positions` (n, 2) are local, in meters; `ahead` (n, 2) are the unit directions of travel.
    """
    leftward = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    probes = [
        positions + STEP_M * direction
        for direction in (0 * ahead, ahead, -ahead, leftward, -leftward)
    ]
    origin = standing.origin
    heights = [standing.heights_below(probe + origin[:2])[0] for probe in probes]
    middle, front, back, port, starboard = (np.where(np.isnan(h), heights[0], h) for h in heights)
    x = np.column_stack([2 * STEP_M * ahead, front - back])
    y = np.column_stack([2 * STEP_M * leftward, port - starboard])
    x /= np.linalg.norm(x, axis=1)[:, None]
    z = np.cross(x, y)
    z /= np.linalg.norm(z, axis=1)[:, None]
    return middle, np.stack([x, np.cross(z, x), z], axis=2)

"""What copies, traffic and carriers stand on: surfaces of a scene that face up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from lidarsim.base.arrays import Floats, Indices, Ints32
from lidarsim.base.errors import LidarError
from lidarsim.base.words import did_you_mean
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.sensor import Track
from lidarsim.sensor.materials import rows_named
from lidarsim.sensor.trajectory import quaternions_of
from raybeam import RayCaster, available_backends

STEP_M = 0.5  # of a trajectory that follows a surface
STEPS_MOST = 1_000_000


class Standing:
    """What one can stand on in a scene: the triangles of some objects that face up.

    Of several above a place the highest counts. None is a scene without triangles.
    """

    def __init__(self, scene: Scene | None, objects: Indices | None = None) -> None:
        self._scene = scene
        self._objects = objects
        self._parts: dict[tuple[str, ...], Standing] = {}  # {names: of these objects}

    @property
    def origin(self) -> Floats:
        """Of the scene, (3,)."""
        return np.zeros(3) if self._scene is None else self._scene.origin

    def only(self, names: Sequence[str]) -> Standing:
        """Return the same of some objects; LidarError if there is nothing to stand on."""
        key = tuple(names)
        scene = self._scene
        if key in self._parts:
            return self._parts[key]
        if scene is None:
            raise LidarError(
                "there is nothing to stand on: add scene.files, or scene.ground and a rectangle "
                "(within)."
            )
        rows = [rows_named(name, scene.names) for name in names]
        for name, found in zip(names, rows, strict=True):
            if not len(found):
                hint = (
                    did_you_mean(name, scene.names) or f" There are {', '.join(scene.names[:5])}."
                )
                raise LidarError(f"surfaces names {name!r}, but no object has that name.{hint}")
        found = np.unique(np.concatenate(rows))
        made = self if len(found) == len(scene.names) else Standing(scene, found)
        if not len(made._tops[0]):
            raise LidarError(f"nothing of {', '.join(map(repr, names))} faces up.")
        self._parts[key] = made
        return made

    @cached_property
    def _tops(self) -> tuple[Floats, Ints32]:
        """Triangles that face up, local (f, 3, 3), and their objects (f,)."""
        assert self._scene is not None
        drawn = self._scene
        shared = self._scene.instances
        if shared and (self._objects is None or np.isin(shared.owner, self._objects).any()):
            drawn = SimplifiedScene.from_scene(drawn).scene
        corners = drawn.vertices[drawn.faces]
        owner = drawn.face_object
        if self._objects is not None:
            own = np.isin(owner, self._objects)
            corners = corners[own]
            owner = owner[own]
        (ax, ay), (bx, by) = ((corners[:, k] - corners[:, 0]).T[:2] for k in (1, 2))
        up = ax * by - ay * bx > 0
        return corners[up], owner[up]

    @cached_property
    def _caster(self) -> RayCaster:
        # Never CUDA, whose context would stay in this process.
        backend = "numpy" if available_backends()["embree"] else "embree"
        corners = self._tops[0].reshape(-1, 3)
        return RayCaster(corners, np.arange(len(corners)).reshape(-1, 3), backend)

    @property
    def rectangle(self) -> Floats:
        """Lowest and highest x and y, world metres: (4,)."""
        assert self._scene is not None
        x, y = self._tops[0][..., :2].reshape(-1, 2).T
        at = self._scene.origin[[0, 1, 0, 1]]
        return np.array([x.min(), y.min(), x.max(), y.max()]) + at

    @cached_property
    def owners(self) -> Ints32:
        """Objects that have triangles here."""
        return np.unique(self._tops[1])

    def under(self, places: Floats) -> tuple[Floats, Ints32]:
        """Heights below places (n, 2), world metres, nan for none; and their objects, -1."""
        heights = np.full(len(places), np.nan)
        objects = np.full(len(places), -1, np.int32)
        if self._scene is None or not len(self._tops[0]):
            return heights, objects
        corners, owner = self._tops
        origin = self._scene.origin
        top = float(corners[..., 2].max()) + 1.0
        origins = np.column_stack([places - origin[:2], np.full(len(places), top)])
        hits = self._caster.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        on = hits.hit
        heights[on] = top - hits.distance[on] + origin[2]
        objects[on] = owner[hits.triangle[on]]
        return heights, objects


def following(track: Track, standing: Standing) -> list[Track]:
    """Return the pieces of a trajectory that are on surfaces, with a pose every 0.5 m.

    Its heights are added to those of the surface, which its axes lean with: their z is the mean
    normal of a metre around. Headings are kept.

    Parameters
    ----------
    track
        In a scene's local coordinates; heights above the surface.

    Raises
    ------
    LidarError
        If it is too long.
    """
    ways = np.linalg.norm(np.diff(track.positions, axis=0), axis=1)
    steps = np.maximum(np.ceil(ways / STEP_M), 1).astype(np.int64)
    if steps.sum() > STEPS_MOST:
        raise LidarError(
            f"the trajectory is {ways.sum() / 1000:,.0f} km long; at most "
            f"{STEPS_MOST * STEP_M / 1000:,.0f} km can follow surfaces."
        )
    shares = np.concatenate([np.arange(n) / n for n in steps.tolist()])
    begins = np.repeat(np.arange(len(steps)), steps)
    times = track.times_s[begins] + shares * np.diff(track.times_s)[begins]
    times = np.append(times, track.times_s[-1])
    moved = replace(track, start_s=float(times[0]), duration_s=None)
    places, turns = moved.poses(0, (times - times[0]) * 1e9)
    places = places.copy()
    ahead = turns[:, :2, 0] / np.linalg.norm(turns[:, :2, 0], axis=1)[:, None]
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    probes = [places[:, :2] + STEP_M * way for way in (0 * ahead, ahead, -ahead, left, -left)]
    origin = standing.origin
    heights = [standing.under(probe + origin[:2])[0] for probe in probes]
    middle, front, back, port, starboard = (np.where(np.isnan(h), heights[0], h) for h in heights)
    x = np.column_stack([2 * STEP_M * ahead, front - back])
    y = np.column_stack([2 * STEP_M * left, port - starboard])
    x /= np.linalg.norm(x, axis=1)[:, None]
    z = np.cross(x, y)
    z /= np.linalg.norm(z, axis=1)[:, None]
    places[:, 2] += middle  # of the world: what it is added to is less the origin
    axes = np.stack([x, np.cross(z, x), z], axis=2)
    edges = np.flatnonzero(np.diff(np.isfinite(middle), prepend=False, append=False))
    runs = [slice(*ends) for ends in edges.reshape(-1, 2).tolist() if ends[1] - ends[0] > 1]
    return [
        replace(
            track, times_s=times[run], positions=places[run], quaternions=quaternions_of(axes[run])
        )
        for run in runs
    ]

"""A scanner in a world whose bodies start to move, appear and vanish."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..media.materials import Material
from ..motion.trajectory import StaticPose, Track
from ..numerics.arrays import Floats, Ints32
from ..scene.actors import Actor
from ..scene.scene import Scene
from ..scene.scene_mesh import SceneMesh
from ..sensor import Sensor
from ..simulator.scanner import Scanner
from ..survey.survey import Mounted
from .world import World, WorldBody

# A body that deviates less from its pose in the file is static, so that the rounding of published
# poses does not change any range. The unit is meters, or radians for rotations.
_MAX_DEVIATION = 1e-6
_MAX_ROUNDING = 1e-9  # deviation that rounding can cause
_NOTHING = "(nothing)"  # name of an invisible object in scenes without static objects


class WorldScanner:
    """A sensor in a world that another program controls.

    A body is part of the static scene until it leaves its pose in the file. The results for a world
    at rest are therefore those of a `Scanner` of the file. From then on, the body is an actor. The
    acceleration structures are rebuilt when a body starts to move, appears or vanishes.

    Parameters
    ----------
    world
        The world.
    sensor
        The lidar, or a `Mounted` lidar on a frame. Patterns in `unseen` that match no body are
        ignored until they do.
    **options
        Options of `Scanner`.
    """

    def __init__(self, world: World, sensor: Sensor | Mounted, **options: Any) -> None:
        self._world = world
        self._sensor = sensor if isinstance(sensor, Mounted) else Mounted(sensor)
        self._options = options
        # Bodies that have moved. If there is a static scene, all bodies are actors.
        self._moved: set[str] = set()
        self._absent: frozenset[str] = frozenset()
        self._scanner: Scanner | None = None
        self._numbers: Ints32 = np.zeros(0, np.int32)  # {object in the scanner: index in `names`}

    @property
    def world(self) -> World:
        """The world, including bodies that are absent."""
        return self._world

    @world.setter
    def world(self, world: World) -> None:
        self._world = world
        self._scanner = None

    @property
    def sensor(self) -> Mounted:
        """The sensor."""
        return self._sensor

    @sensor.setter
    def sensor(self, sensor: Mounted) -> None:
        self._sensor = sensor
        self._scanner = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the static objects and of all bodies, present or not."""
        static = () if self._world.static is None else self._world.static.names
        return (*static, *(body.name for body in self._world.bodies))

    @property
    def scanner(self) -> Scanner:
        """Scanner of the world, with the bodies that have moved as actors."""
        if self._scanner is None:
            self._build()
        assert self._scanner is not None
        return self._scanner

    def sweep(
        self,
        number: int,
        times_s: Floats,
        sensor_poses: Floats,
        body_poses: Mapping[str, Floats],
        absent: Collection[str] = (),
    ) -> Cloud:
        """Simulate a sweep of the moving world.

        Parameters
        ----------
        number
            Number of the sweep, as in `Scanner.sweep`.
        times_s
            Times of the poses in seconds, in ascending order. Sweep 0 starts at 0. Shape (k,), with
            k of at least 2.
        sensor_poses
            Matrices from the frame of the sensor or its platform to the world. Shape (k, 4, 4).
        body_poses
            Matrices from the frame of each body to the world, by the name of the body. Bodies
            without poses are at their poses in the file. Shape (k, 4, 4).
        absent
            Names of bodies that are not in the world.

        Returns
        -------
        Cloud
            The returns. The column `object` contains indices into `names`.

        Raises
        ------
        LidarError
            If a body cannot move.
        """
        self._update_bodies(body_poses, frozenset(absent))
        scanner = self.scanner
        origin = scanner.origin
        actors = {actor.name for actor in scanner.scene.actors}
        moving = [body for body in self._world.bodies if body.name in actors]
        if moving:
            held = (len(times_s), 4, 4)
            matrices = np.array(
                [body_poses.get(body.name, np.broadcast_to(body.matrix, held)) for body in moving]
            )
            matrices[..., :3, 3] -= origin
            scanner.move([body.name for body in moving], matrices, times_s=times_s)
        cloud = scanner.sweep(_trajectory(times_s, sensor_poses, origin), number=number)
        return replace(
            cloud, columns={**cloud.columns, "object": self._numbers[cloud.columns["object"]]}
        )

    def _update_bodies(self, body_poses: Mapping[str, Floats], absent: frozenset[str]) -> None:
        """Discard the scanner if a body has started to move, has appeared or has vanished."""
        deviations = {
            body.name: float(np.abs(body_poses[body.name] - body.matrix).max())
            for body in self._world.bodies
            if body.name in body_poses and body.name not in self._moved
        }
        if max(deviations.values(), default=0.0) > _MAX_DEVIATION:
            # Bodies that settle start to move soon after each other. Rebuild once for all of them.
            self._moved |= {name for name, value in deviations.items() if value > _MAX_ROUNDING}
            self._scanner = None
        if absent != self._absent:
            self._absent = absent
            self._scanner = None

    def _build(self) -> None:
        """Build the scanner for the bodies that are present."""
        world = self._world
        present = [body for body in world.bodies if body.name not in self._absent]
        can_be_static = world.static is None
        moving = [body for body in present if not can_be_static or body.name in self._moved]
        static = [body.item for body in present if can_be_static and body.name not in self._moved]
        actors = [_actor(body) for body in moving]
        unseen = list(self._sensor.unseen)
        if world.static is not None:
            scene = world.static
        elif static:
            scene = Scene.from_meshes(static)
        else:  # a scene requires a static object
            corners = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])
            scene = Scene.from_meshes([SceneMesh(_NOTHING, corners, np.array([[0, 1, 2]]))])
            unseen.append(_NOTHING)
        actors = [
            actor.with_trajectory(_local_pose(body, scene.origin))
            for actor, body in zip(actors, moving, strict=True)
        ]
        scene = scene.with_actors([*scene.actors, *actors])
        names = scene.object_names
        matching = tuple(pattern for pattern in unseen if _matches_any(pattern, names))
        options = dict(self._options)
        if options.get("materials"):
            options["materials"] = _matching_materials(options["materials"], names)
        self._scanner = Scanner(scene, replace(self._sensor, unseen=matching), **options)
        rows = {name: row for row, name in enumerate(self.names)}
        self._numbers = np.array([rows.get(name, -1) for name in names], np.int32)


def _actor(body: WorldBody) -> Actor:
    if not body.can_move:
        raise LidarError(
            f"{body.name!r} contains voxels, so it cannot move. Keep it at its pose in the file."
        )
    return Actor(body.mesh(), spray=False)


def _local_pose(body: WorldBody, origin: Floats) -> StaticPose:
    return StaticPose(body.matrix[:3, 3] - origin, body.matrix[:3, :3])


def _trajectory(times_s: Floats, poses: Floats, origin: Floats) -> StaticPose | Track:
    """Return the trajectory of the sensor in local coordinates, which is static if possible."""
    local = poses.copy()
    local[:, :3, 3] -= origin
    if (local == local[0]).all():
        return StaticPose(local[0, :3, 3], local[0, :3, :3])
    # The first pose is held, because the scanner also requires the pose at time 0.
    (path,) = Track.from_matrices(times_s, local[None], "hold")
    return path


def _matches_any(pattern: str, names: Collection[str]) -> bool:
    return pattern in names or any(fnmatchcase(name, pattern) for name in names)


def _matching_materials(materials: Collection[Material], names: Collection[str]) -> list[Material]:
    """Return the materials that apply to at least one object, without their other patterns."""
    matching = []
    for material in materials:
        patterns = material.objects
        if patterns is None:
            matching.append(material)
            continue
        used = [pattern for pattern in patterns if _matches_any(pattern, names)]
        if used:
            matching.append(replace(material, objects=used))
    return matching

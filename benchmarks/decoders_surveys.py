"""Surveys for benchmarks/decoders.py: sensors whose packets are written, and a drive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.writing import ExportSpec, with_format_columns
from lidarpool import Material, Mounted, Pose, Scene, Survey, Track, load_sensor
from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.actors import Actor, box, join_meshes
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sweeps.sweeps import Sweeps

from .odometry import cloud_of

START = datetime(2026, 11, 27, 12, 0, tzinfo=UTC)  # of the drive
_STEPS_PER_REVOLUTION = 36
_SWEEP_S = 0.1  # of the drive's first sensor
_SPEED_MPS = 8.0  # of the car
_TURN_DEG = 30.0  # of the car in all
_GUEST_S = (0.63, 1.38)  # time for which one of the cars is in the scene
_PEDESTRIAN = Path(__file__).resolve().parents[1] / "examples/pedestrian.glb"


class Mover(NamedTuple):
    """Actor that moves at constant velocity."""

    mesh: SceneMesh
    start: tuple[float, float, float]  # position at time 0, meters
    velocity: tuple[float, float, float]  # m/s
    present_s: tuple[float, float] = (-1.0, 60.0)

    @property
    def kind(self) -> str:
        """Name of the actor without its number, such as 'Walker'."""
        return self.mesh.name.rpartition(" ")[0]

    @property
    def actor(self) -> Actor:
        """The actor on its trajectory.

        Its axes are level, and its x axis points ahead.
        """
        times_s = np.array(self.present_s)
        positions = np.array(self.start) + np.outer(times_s, self.velocity)
        return Actor(self.mesh, Track(times_s, positions, start_s=0.0, beyond="absent"))

    def center(self, time_s: float) -> Floats:
        """Return the exact center (3,) of the box at the given time, in meters."""
        x, y, z = self.actor.bounds.mean(axis=0)
        heading = np.arctan2(self.velocity[1], self.velocity[0])
        cos, sin = np.cos(heading), np.sin(heading)
        middle = np.array([x * cos - y * sin, x * sin + y * cos, z])
        return np.asarray(np.array(self.start) + time_s * np.array(self.velocity) + middle)


@dataclass(frozen=True, eq=False)
class Drive:
    """Survey with its scene, its actors and its cloud."""

    survey: Survey
    scene: Scene
    movers: tuple[Mover, ...] = ()

    @property
    def sweeps(self) -> Sweeps:
        """Sweeps of the survey."""
        return self.cloud.sweeps()

    @cached_property
    def cloud(self) -> Cloud:
        """Cloud of the survey, which is cast in this process."""
        return cloud_of(self.survey, self.scene)

    @cached_property
    def points(self) -> list[Cloud]:
        """Points of each sweep."""
        return list(self.sweeps.points(self.cloud))

    @cached_property
    def as_fired(self) -> Floats:
        """Points (n, 3) in the sensor frame at their firing times, in meters."""
        sweeps = enumerate(self.points)
        return np.concatenate([self.sweeps.as_fired(number, points) for number, points in sweeps])

    def in_world(self, sweep: int) -> Floats:
        """Return the points (n, 3) of a sweep in world coordinates, in meters."""
        return self.points[sweep].positions.astype(np.float64)

    def centers(self, times_s: Floats, actors: Ints) -> Floats:
        """Return the box centers (n, 3) of the given actors at the given times, in meters."""
        rows = zip(times_s.tolist(), actors.tolist(), strict=True)
        return np.array([self.movers[int(actor)].center(time_s) for time_s, actor in rows])

    def sizes(self, actors: Ints) -> Floats:
        """Return the box sizes (n, 3) of the given actors, in meters."""
        bounds = np.array([mover.actor.bounds for mover in self.movers])
        return np.ptp(bounds, axis=1)[actors]

    def velocities(self, actors: Ints) -> Floats:
        """Return the velocities (n, 3) of the given actors in m/s."""
        return np.array([mover.velocity for mover in self.movers])[actors]


def packets_of(model: str, scene: Scene, revolutions: int) -> Drive:
    """Return a survey of a static sensor whose packets are written."""
    survey = Survey(
        load_sensor(model),
        [(-20.0, -3.0, 2.0)],
        steps=_STEPS_PER_REVOLUTION * revolutions,
        columns=["time", "reflectivity", "range", "ray"],
        precision_m=1e-5,
        keep_every=1,
    )
    return Drive(with_format_columns(survey, [ExportSpec("pcap")]), scene)


def drive_of(scene: Scene, sweeps: int) -> Drive:
    """Return the drive of a car with two lidars that turns left.

    The second lidar rotates twice as fast.
    """
    walker = join_meshes("Walker 1", load_objects(_PEDESTRIAN, animation="Walk").static)
    assert walker.animation is not None
    walker = replace(walker, animation=replace(walker.animation, speed_m_s=1.4))
    movers = (
        Mover(box("Bus 1", (11, 2.5, 3)), (-14, 3.5, 0), (3, 0, 0)),
        Mover(box("Car 1", (4.5, 1.8, 1.5)), (12, 0.5, 0), (-15, 0, 0)),
        Mover(walker, (-16, -6, 0), (1.12, -0.84, 0)),
        Mover(box("Car 2", (4.2, 1.8, 1.4)), (-35, 0, 0), (9, 0.5, 0), _GUEST_S),
    )
    duration_s = sweeps * _SWEEP_S
    half = np.radians(_TURN_DEG) / 2
    trajectory = Track(
        [0, duration_s],
        [[-20, -3, 0], [-20 + _SPEED_MPS * duration_s, -1, 0]],
        [[0, 0, 0, 1], [0, 0, np.sin(half), np.cos(half)]],
    )
    rear = load_sensor("velodyne/vlp32c", rate_hz=20)
    survey = Survey(
        sensors=[
            Mounted(load_sensor("velodyne/vlp16"), Pose((0, 0, 1.9)), "roof"),
            Mounted(rear, Pose((-1, 0, 1.9), 180.0), "rear"),
        ],
        trajectory=trajectory,
        columns=["time", "intensity", "reflectivity", "class"],
        materials=[
            Material("Walker*", semantic_class=2),
            Material("Bus*", semantic_class=3),
            Material("Car*", semantic_class=3),
            Material("*", semantic_class=1),
        ],
        classes={1: "static", 2: "person", 3: "vehicle"},
        start=START,
    )
    return Drive(survey, scene.with_actors([mover.actor for mover in movers]), movers)

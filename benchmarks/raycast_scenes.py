"""Scenes and lidar rays for benchmarks/raycast.py and benchmarks/trees.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarpool import Scene, Sensor, Survey
from lidarscenes.procedural.city import city
from lidarscenes.procedural.terrain import terrain
from raybeam import RayCaster

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Job:
    """Mesh and the rays to cast at it.

    Attributes
    ----------
    name
        Name of the scene.
    vertices, faces
        float64 (v, 3) and int32 (f, 3): vertices and triangles of the mesh.
    origins
        float64 (p, 3): origins of the rays. All rays are cast from each origin.
    directions
        float64 (n, 3): directions of the rays as unit vectors in the sensor frame.
    rotation
        float64 (3, 3): rotation from the sensor frame to the scene.
    order
        Order of the rays: "coherent", as in the firing order of a lidar, or "shuffled".
    """

    name: str
    vertices: Float
    faces: NDArray[np.int32]
    origins: Float
    directions: Float
    rotation: Float
    order: str = "coherent"

    @property
    def rays(self) -> int:
        """Total number of rays from all origins."""
        return len(self.origins) * len(self.directions)

    def shuffled(self) -> Job:
        """Return the job with the same rays in random order."""
        directions = np.random.default_rng(0).permutation(self.directions)
        return replace(self, directions=directions, order="shuffled")


def _tilted_rotation(degrees: float) -> Float:
    """Return the rotation of a sensor: by an angle about z, then by two degrees about x."""
    a = np.radians(degrees)
    b = np.radians(2.0)
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return about_z @ about_x


def _job(name: str, scene: Scene, origins: Float, sensor: Sensor) -> Job:
    """Make a job of one sensor revolution."""
    return Job(
        name,
        np.array(scene.vertices),
        np.array(scene.faces),
        np.atleast_2d(np.asarray(origins, dtype=np.float64)),
        sensor.directions(np.arange(sensor.period)).reshape(-1, 3),
        _tilted_rotation(17.0),
    )


def _named(kind: str, triangles: int) -> str:
    """Return the name of a scene, such as 'city 1e5'."""
    return f"{kind} {triangles:.0e}".replace("e+0", "e")


def _lidar(rays: int) -> Sensor:
    """Make a sensor with 128 rings over 45 degrees and about `rays` rays per revolution."""
    return Sensor.grid(rays_per_revolution=max(36, rays // 128), layers=128, vertical_fov_deg=45)


def survey_job(rays: int) -> Job:
    """Make a job from the scene, sensor and three poses of the default survey."""
    survey = Survey(poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    origins = np.array([pose.position for pose in survey.poses])
    firings_per_revolution = max(36, min(survey.sensor.period or 0, rays // 120))
    sensor = replace(
        survey.sensor, head=replace(survey.sensor.head, firings_per_turn=firings_per_revolution)
    )
    return _job("default survey", Scene.seed(), origins, sensor)


def city_job(triangles: int, rays: int) -> Job:
    """Make a city with the sensor at the central crossing."""
    return _job(_named("city", triangles), city(triangles), [0, 0, 2], _lidar(rays))


def positions_job(triangles: int, rays: int, *, inside: bool) -> Job:
    """Make a city with the sensor in streets, or inside buildings, where all rays hit."""
    scene = city(triangles)
    sensor = _lidar(rays)
    lower_m, upper_m = scene.bounds
    random = np.random.default_rng(0)
    positions = np.full((24, 3), lower_m[2] + 2)
    positions[:, :2] = lower_m[:2] + (upper_m - lower_m)[:2] * random.uniform(0.3, 0.7, (24, 2))
    caster = RayCaster(scene.vertices, scene.faces)
    directions = sensor.directions(np.arange(36)).reshape(-1, 3)
    share = np.array([caster.cast(position, directions).hit.mean() for position in positions])
    chosen = positions[(share > 0.97) == inside][:4]
    return _job(_named("inside" if inside else "street", triangles), scene, chosen, sensor)


def terrain_job(triangles: int, rays: int) -> Job:
    """Make a terrain with the sensor 30 m above its center."""
    scene = terrain(triangles)
    down = RayCaster(scene.vertices, scene.faces, "numpy").cast([0.1, 0.2, 1e4], [[0, 0, -1]])
    height = 1e4 - float(down.distance[0]) + 30
    return _job(_named("terrain", triangles), scene, [0.1, 0.2, height], _lidar(rays))


def mesh_job(path: Path, rays: int) -> Job:
    """Make a job from a mesh file.

    The sensor is at the center, 1.5 m above the lowest point.
    """
    scene = Scene.load(path)
    lower_m, upper_m = scene.bounds
    middle = (lower_m + upper_m) / 2
    return _job(path.stem, scene, [*middle[:2], lower_m[2] + 1.5], _lidar(rays))


def jobs(
    rays: int, meshes: list[Path], quick: bool, large: bool = False
) -> dict[str, Callable[[], Job]]:
    """Return functions that make jobs, keyed by their scene name in `--scene`.

    With `large`, they include a city of ten million triangles, which takes minutes and 13 GB.
    """
    cities = [2_000] if quick else [100_000, 1_000_000]
    if large:
        cities.append(10_000_000)
    hills = 2_000 if quick else 2_000_000
    streets = max(cities[0], 20_000)  # smaller cities have no rooms
    makers: dict[str, Callable[[], Job]] = {"survey": partial(survey_job, rays)}
    for triangles in cities:
        name = _named("city", triangles).replace(" ", "-")
        makers[name] = partial(city_job, triangles, rays)
    makers["street"] = partial(positions_job, streets, rays, inside=False)
    makers["inside"] = partial(positions_job, streets, rays, inside=True)
    makers[_named("terrain", hills).replace(" ", "-")] = partial(terrain_job, hills, rays)
    return makers | {path.stem: partial(mesh_job, path, rays) for path in meshes}

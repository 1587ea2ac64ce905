"""Walls, sensors and simulations for plots of receiver effects."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpool import Beams, Noise, Optics, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.simulator.rig import Rig

BLUE = "#1f5fa8"
RED = "#c8502b"
GRAY = "#8a8a8a"
WIDE_RAD = 0.01  # beam of the sensors that hear each other


def wall(
    name: str, x: float, y: tuple[float, float] = (-50, 50), z: tuple[float, float] = (-50, 50)
) -> SceneMesh:
    """Return a rectangle that is perpendicular to the x axis."""
    corners = [[x, y[0], z[0]], [x, y[1], z[0]], [x, y[1], z[1]], [x, y[0], z[1]]]
    return SceneMesh(name, np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))


def room(x: float, y: float, z: float = 6.0) -> list[SceneMesh]:
    """Return the four walls of a room around the origin."""
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    walls = []
    for number, (start, stop) in enumerate(zip(corners, np.roll(corners, -1, 0), strict=True)):
        vertices = np.array([[*start, -z], [*stop, -z], [*stop, z], [*start, z]])
        walls.append(SceneMesh(f"W{number}", vertices, np.array([[0, 1, 2], [0, 2, 3]])))
    return walls


def fixed_beams(rays: int, max_range_m: float = 1e4) -> Sensor:
    """Return a sensor that fires `rays` beams along x simultaneously."""
    return Sensor(Beams(np.zeros(rays)), Spin(1, 360), 0.0, max_range_m)


def spinning_beam(firings: int, rate_hz: float = 10.0, clockwise: bool = False) -> Sensor:
    """Return a sensor with a wide beam that rotates about z."""
    optics = Optics(divergence_mrad=1000 * WIDE_RAD)
    head = Spin(firings, 360, rate_hz, clockwise)
    return Sensor(Beams(np.zeros(1)), head, 0.5, 150.0, optics=optics)


def cloud(scene: Scene, survey: Survey) -> dict[str, NDArray[Any]]:
    """Return the causes, positions, ranges and intensities of all points of a survey."""
    batches = list(Rig(scene, survey).cast(0, survey.scan_count))
    causes = [
        np.zeros(len(b)) if b.pulse_returns.cause is None else b.pulse_returns.cause
        for b in batches
    ]
    positions = np.concatenate([b.positions for b in batches])
    return {
        "cause": np.concatenate(causes),
        "range": np.concatenate([b.pulse_returns.distance for b in batches]),
        "intensity": np.concatenate([b.intensity for b in batches]),
        **dict(zip("xyz", positions.T, strict=True)),
    }


def points(meshes: list[SceneMesh], survey: Survey) -> dict[str, NDArray[Any]]:
    """Simulate all scans of a survey and return the values of its stored columns."""
    rig = Rig(Scene.from_meshes(meshes), survey, "numpy")
    batches = list(rig.cast(0, survey.scan_count))
    return {
        column.name: np.concatenate([column.make(batch) for batch in batches])
        for column in survey.stored_columns
    }


def cast_scan(
    meshes: list[SceneMesh], sensor: Sensor, noise: Noise, **options: Any
) -> dict[str, Any]:
    """Cast a scan with a sensor at the origin and return its columns."""
    common = {"columns": ("ray", "range", "intensity", "cause"), "keep_every": 1}
    survey = Survey(sensor, poses=[(0, 0, 0)], steps=1, noise=noise, **{**common, **options})
    return points(meshes, survey)

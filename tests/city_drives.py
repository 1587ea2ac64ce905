"""Straight drives through a small city, with and without moving cars."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tests.simulated_drives import simulated_drive

from lidarfiles import save_cloud
from lidarscenes.procedural.cars import MODELS, car
from lidarscenes.procedural.city import city
from lidarsim import Actor, Cloud, Mounted, Pose, Scene, Sensor, Survey, Track, load_sensor
from lidarsim.numerics.arrays import Floats

SPEED_M_S = 4.0
# Start, speed and acceleration along x, lateral position and start time of moving cars.
CARS = ((-10.0, 5.0, 0.6, -3.0, 0.0), (14.0, -9.0, 0.0, 3.0, 0.0), (-16.0, 0.0, 4.0, -6.3, 0.4))


def write_city_drive(path: Path, sensor: Sensor, sweep_count: int, start_x_m: float) -> Path:
    """Write a bag of sweeps at 10 Hz from a sensor that moves along x at `SPEED_M_S`."""
    save_cloud(_drive(city(5_000), sensor, sweep_count, start_x_m, 1e-3), path)
    return path


def car_position(number: int, time_s: float) -> Floats:
    """Return the position of a moving car, which is parked before its start time."""
    start_m, speed_m_s, acceleration_m_s2, side_m, start_s = CARS[number]
    driven_s = max(time_s - start_s, 0.0)
    along_m = start_m + speed_m_s * driven_s + acceleration_m_s2 * driven_s**2 / 2
    return np.array([along_m, side_m, 0.0])


def car_drive(model: str, options: dict[str, Any], sweep_count: int) -> Cloud:
    """Return the sweeps of a drive among the moving `CARS`, as a cloud in memory."""
    times_s = np.arange(0, 0.1 * sweep_count + 0.3, 0.05)
    turned = np.array([0.0, 0.0, 1.0, 0.0])  # oncoming
    actors = []
    for number, (_, speed_m_s, *_) in enumerate(CARS):
        positions = np.array([car_position(number, time_s) for time_s in times_s.tolist()])
        quaternion = turned if speed_m_s < 0 else np.array([0.0, 0.0, 0.0, 1.0])
        track = Track(times_s, positions, np.tile(quaternion, (len(times_s), 1)))
        actors.append(Actor(replace(car(MODELS[number]), name=f"Car {number + 1}"), track))
    scene = city(5_000).with_actors(actors)
    return _drive(scene, load_sensor(model, **options), sweep_count, -24.0, 1e-4)


def _drive(
    scene: Scene, sensor: Sensor, sweep_count: int, start_x_m: float, precision_m: float
) -> Cloud:
    """Simulate a straight drive and return its cloud, which has sweeps."""
    end_s = 0.1 * (sweep_count + 1)
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, 1.9)), "lidar")],
        trajectory=Track([0, end_s], [[start_x_m, -3, 0], [SPEED_M_S * end_s + start_x_m, -3, 0]]),
        steps=36 * sweep_count,
        columns=["time", "intensity", "class", "ray", "range"],
        precision_m=precision_m,
    )
    return simulated_drive(scene, survey)

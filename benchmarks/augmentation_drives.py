"""Simulated drives through a city, in clear air and in the conditions of `benchmarks.augmentation`.

All drives of a sensor have the same rays, so returns can be compared pulse by pulse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.recordings.opening import open_recording, with_sweeps
from lidarpool import (
    Actor,
    Cloud,
    Fault,
    Material,
    Noise,
    Scene,
    Sensor,
    Survey,
    Track,
    load_sensor,
)
from lidarreal.augmentation.effects import Effects
from lidarscenes.procedural.city import city
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import AXES, CAUSES, SCAN
from lidarsim.media.weather import Weather
from lidarsim.numerics.arrays import Bools, Floats
from lidarsim.scene.actors import box
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

HEIGHT_M = 1.9
SPEED_M_S = 10.0
SWEEP_S = 0.1
AIR = CAUSES.index("air")
SURFACE = CAUSES.index("surface")
COLUMNS = ("time", "range", "intensity", "cause", "signal", "reflectivity")
CARS = 12
CAR_M = (4.5, 1.8, 1.5)
MATERIALS = (
    Material("ground", 0.15),
    Material("pavement", 0.3),
    Material("building-*", 0.4),
    Material("tree-*", 0.35),
    Material("*", 0.5),
)


@dataclass(frozen=True)
class Condition:
    """Weather, noise and faults of a drive."""

    weather: Mapping[str, Any] = field(default_factory=dict)
    noise: Mapping[str, Any] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()

    @property
    def effects(self) -> Effects:
        """Return the condition as effects for `augment`."""
        return Effects(weather=Weather(**self.weather), noise=self.noise, faults=self.faults)


CLEAR = Condition()
CONDITIONS = {
    "rain, 25 mm/h": Condition({"rain_mm_h": 25.0}),
    "fog, visibility 100 m": Condition({"visibility_km": 0.1}),
    "snow, 2 mm/h": Condition({"snow_mm_h": 2.0}),
    "dust, 60 mg/m³": Condition({"dust_mg_m3": 60.0}),
    "dirt": Condition(faults=(Fault("dirt", azimuth_deg=(-30, 60), transmission=0.2),)),
    "saturation": Condition(noise={"saturation": 5.0}),
    "dead channels": Condition(faults=(Fault("dead_channels", channels=[2, 5, 11]),)),
    "dropped packets": Condition(faults=(Fault("dropped_packets", share=0.1, packet=16),)),
}


def detecting_sensor(name: str, detection_range_m: float | None, subrays: int) -> Sensor:
    """Load a sensor model with its data sheet performance.

    `detection_range_m` is assumed if the data sheet does not state a detection range.
    """
    sensor = load_sensor(name, performance="datasheet")
    noise = sensor.noise or Noise()
    if detection_range_m is not None:
        noise = replace(noise, detection_range_m=detection_range_m)
    return replace(sensor, noise=noise, returns=replace(sensor.returns, subrays=subrays))


def street(triangles: int, cars: int = CARS, seed: int = 0) -> Scene:
    """Make a city with cars that drive along the street of the sensor, in both directions."""
    random = np.random.default_rng(seed)
    actors = []
    for number in range(cars):
        heading = 1.0 if number % 2 else -1.0
        start = np.array([random.uniform(-45, 45), -3.0 * heading, 0.0])
        end = start + 8.0 * heading * np.array([10.0, 0, 0])
        track = Track([0, 10], [start, end], yaw_deg=0 if heading > 0 else 180)
        actors.append(Actor(box(f"Car {number}", CAR_M), track))
    return city(triangles, seed=seed).with_actors(actors)


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive of one sensor through a scene, with motion-distorted points."""

    scene: Scene
    sensor: Sensor
    sweeps: int
    coordinates: str = "sensor"  # "world" for motion-compensated sweeps

    def survey(self, condition: Condition, seed: int) -> Survey:
        """Return the survey of the drive in a condition."""
        noise = replace(self.sensor.noise or Noise(), **condition.noise, seed=seed)
        duration_s = self.sweeps * SWEEP_S
        start = np.array([-10.0, 0, HEIGHT_M])
        end = [start[0] + SPEED_M_S * duration_s, 0, HEIGHT_M]
        return Survey(
            self.sensor,
            trajectory=Track([0, duration_s], [start, end]),
            columns=COLUMNS,
            coordinates=self.coordinates,
            materials=MATERIALS,
            noise=noise,
            faults=condition.faults,
            **condition.weather,
        )

    def cloud(self, condition: Condition = CLEAR, seed: int = 0) -> Cloud:
        """Simulate the drive in this process."""
        survey = self.survey(condition, seed)
        rig = Rig(self.scene, survey, threads=2)
        part = columns_of(list(rig.cast(0, survey.scan_count)))
        table = (SCAN, *(column for column in survey.stored_columns if column not in AXES))
        origin = self.scene.origin if self.coordinates == "world" else np.zeros(3)
        sweeps = partial(Sweeps.from_survey, survey, self.scene)
        return part.cloud(table, survey.precision_m, origin, sweeps=sweeps)

    def recording(self, condition: Condition = CLEAR, seed: int = 0) -> Recording:
        """Simulate the drive, and open it as a recording."""
        return with_sweeps(open_recording(self.cloud(condition, seed)))


def ranges(sweep: Sweep) -> Floats:
    """Return the ranges of the points in meters. Shape (n,)."""
    return np.asarray(np.linalg.norm(np.asarray(sweep.points, np.float64), axis=1))


def from_air(sweep: Sweep) -> Bools:
    """Return whether each point is a return from the air. Shape (n,)."""
    return np.asarray(sweep.columns["cause"] == AIR)

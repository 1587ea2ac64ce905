"""Effects that are simulated on recorded sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarsim.media.materials import Material
from lidarsim.media.weather import Weather
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor.optics import Mode
from lidarsim.survey.faults import Fault


@dataclass(frozen=True, eq=False)
class Insertion:
    """A stationary object that is placed relative to the sensor in the first sweep.

    Attributes
    ----------
    mesh
        Mesh of the object, with z up and x forward. Its name is the name of the object.
    x_m, y_m
        Position in the sensor frame of the first sweep, in meters.
    z_m
        Height of the mesh origin in the same frame in meters, or None to place the object on the
        recorded ground.
    heading_deg
        Heading in degrees, counterclockwise from the x axis of the sensor.
    class_name
        Semantic class of the object, or an empty string.
    """

    mesh: SceneMesh
    x_m: float
    y_m: float
    z_m: float | None = None
    heading_deg: float = 0.0
    class_name: str = ""


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects that are simulated on recorded sweeps.

    Attributes
    ----------
    weather
        Weather, which is added to the weather of the recording.
    noise
        Values of fields of `Noise` that the user has set. They are added to the noise of the
        recording. `detection_range_m`, `overlap_m` and `saturation` describe the receiver.
    faults
        Faults of the sensor.
    mode
        Returns that are reported for each pulse (`Returns.mode`), or None for as many returns as
        the recording has.
    actors
        Inserted objects in the world frame of the recording. Times are counted from the first
        sweep.
    insertions
        Inserted objects in the sensor frame of the first sweep.
    materials
        Materials of inserted objects.
    classes
        Names of semantic classes by number.
    seed
        Seed of all random numbers.
    """

    weather: Weather = field(default_factory=Weather)
    noise: Mapping[str, Any] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    mode: Mode | None = None
    actors: tuple[Actor, ...] = ()
    insertions: tuple[Insertion, ...] = ()
    materials: tuple[Material, ...] = ()
    classes: Mapping[int, str] = field(default_factory=dict)
    seed: int = 0

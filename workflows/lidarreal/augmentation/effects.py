"""Effects that are simulated on recorded sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.prepare import prepare_actors
from lidarscenario.scenario import Scenario
from lidarsim.errors import LidarError, Mistakes
from lidarsim.io.yamlfile import read_yaml
from lidarsim.media.materials import Material
from lidarsim.media.weather import Weather
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_fields
from lidarsim.schema.declared import declared_values
from lidarsim.schema.value_texts import one_line
from lidarsim.sensor import Noise
from lidarsim.sensor.optics import Mode
from lidarsim.survey.faults import Fault
from lidarsim.words import did_you_mean

from .recorded_sections import check_content, check_sections, check_spray, effect_errors


@dataclass(frozen=True, eq=False, repr=False)
class Insertion:
    """A stationary object that is placed relative to the sensor in the first sweep.

    Attributes
    ----------
    mesh
        Mesh of the object, with z up and x forward.
    x_m, y_m
        Position in the sensor frame of the first sweep, in meters.
    z_m
        Height of the mesh origin in the same frame in meters, or None to place the object on the
        recorded ground.
    heading_deg
        Heading in degrees, counterclockwise from the x axis of the sensor.
    class_name
        Semantic class of the object, or an empty string. Names that data sets use for the same
        class, such as "person" and "pedestrian", are equivalent.
    name
        Name by which materials select the object. The default is the name of the mesh. If
        several objects have the same name, numbers are appended, as in "car_2".
    """

    mesh: SceneMesh
    x_m: float
    y_m: float
    z_m: float | None = None
    heading_deg: float = 0.0
    class_name: str = ""
    name: str = ""

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False, repr=False)
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
        Inserted objects in the sensor frame of the first sweep. Effects files do not contain them.
    materials
        Materials of inserted objects.
    classes
        Names of semantic classes by number.
    seed
        Seed of all random numbers.
    notes
        Notes about files that the effects use.
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
    notes: tuple[str, ...] = field(default=(), compare=False)

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        names = [entry.name for entry in fields(Noise) if entry.name != "seed"]
        if "seed" in self.noise:
            raise LidarError("`noise` must not contain a seed. Set `seed` of the effects instead.")
        for name in self.noise:
            if name not in names:
                raise LidarError(
                    f"{name!r} is not a field of the noise.{did_you_mean(name, names)}"
                )
        mistakes = Mistakes()
        mistakes.lines += effect_errors(self.noise, self.faults, self.weather)
        mistakes.raise_if_any()

    @classmethod
    def load(
        cls, path: str | Path | None = None, options: Mapping[str, Any] = MappingProxyType({})
    ) -> Self:
        """Read an effects file.

        Parameters
        ----------
        path
            Path of the file (YAML). It has the sections `weather`, `noise`, `faults`, `returns`,
            `actors`, `traffic`, `materials` and `classes` of a scenario. By default, only the
            `options` have effects.
        options
            Sections that override those of the file. Fields of a section are merged, and faults
            replace the faults of the same kind.

        Raises
        ------
        LidarError
            If the file is invalid, or if a section or field cannot be applied to a recording.
        """
        if path is None:
            return cls.from_scenario(Scenario.from_data(dict(options), source="the options"))
        path = Path(path)
        if is_campaign(path):
            raise LidarError(
                f"{path} is a campaign of several variants. Use its base, or run the campaign with "
                "`lidarpool augment`."
            )
        data = _merge_sections(read_yaml(path, _FORM), options)
        check_content(data, str(path))
        return cls.from_scenario(Scenario.from_data(data, source=str(path), folder=path.parent))

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> Self:
        """Create effects from the sections of a scenario that change pulses.

        Raises
        ------
        LidarError
            If a file cannot be read, or if a section or field cannot be applied to a recording.
        """
        check_sections(scenario)
        prepared = prepare_actors(scenario)
        actors = tuple(prepared.actors)
        check_spray(scenario, actors)
        noise = {name: getattr(scenario.noise, name) for name in scenario.noise.model_fields_set}
        has_mode = "mode" in scenario.returns.model_fields_set
        return cls(
            weather=Weather(**declared_values(scenario.weather, Weather)),
            noise={name: value for name, value in sorted(noise.items()) if name != "seed"},
            faults=tuple(scenario.faults),
            mode=scenario.returns.mode if has_mode else None,
            actors=actors,
            materials=tuple(prepared.materials),
            classes=dict(prepared.classes),
            seed=scenario.noise.seed,
            notes=tuple(prepared.notes),
        )

    @property
    def is_empty(self) -> bool:
        """Whether there are no effects."""
        weather = self.weather
        has_air = weather.attenuates or weather.spray_g_m3
        has_noise = any(value != getattr(Noise, name) for name, value in self.noise.items())
        changes = (has_air, has_noise, self.faults, self.mode, self.actors, self.insertions)
        return not any(changes)


_FORM = "an effects file contains sections such as weather:, noise:, faults: and actors:"


def _merge_sections(data: dict[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of an effects file in which options override fields and faults."""
    merged = dict(data)
    for name, value in options.items():
        earlier = data.get(name)
        if name == "faults":
            kinds = {fault["kind"] for fault in value}
            entries = earlier if isinstance(earlier, list) else [earlier] if earlier else []
            kept = [f for f in entries if not isinstance(f, dict) or f.get("kind") not in kinds]
            merged[name] = [*kept, *value]
        elif isinstance(earlier, dict) and isinstance(value, Mapping):
            merged[name] = {**earlier, **value}
        else:
            merged[name] = value
    return merged

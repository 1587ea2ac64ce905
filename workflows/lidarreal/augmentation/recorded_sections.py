"""Checks of scenarios that describe effects on recordings.

Only the sections that change pulses after they have been fired can be applied to a recording. Steps
of the simulation declare whether they can act on recorded pulses (`PulseStep.on_recordings`). This
module refuses everything else with the reason and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lidarscenario.scenario import Scenario
from lidarsim.errors import Mistakes
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import CENTER
from lidarsim.pulses.steps.step import Setup
from lidarsim.pulses.steps.step_list import STEPS
from lidarsim.scene.actors import Actor
from lidarsim.sensor import Noise, Returns, Sensor
from lidarsim.simulator.recorded_sweeps import scene_of_bodies
from lidarsim.survey.faults import Fault
from lidarsim.survey.survey import Mounted, Survey

SECTIONS = (
    *("weather", "noise", "faults", "returns"),
    *("actors", "traffic", "materials", "classes"),
)
_TWIN = "Reconstruct the scene with `lidarpool twin`, and simulate the sensor in it."
_POSES = "because the poses of the sensor are those of the recording. Remove `{0}`."
_SENSOR = (
    "because the sensor is that of the recording. Specify its model with `--model`, or resample "
    "the recording to another sensor with `--sensor`."
)
# {section: why it cannot be applied to a recording, and a remedy}
_OTHER_SECTIONS = {
    "scene": (
        "because the scene is that of the recording. To insert objects, use `actors`. To change "
        "the scene, reconstruct it with `lidarpool twin`."
    ),
    "world": "because the coordinates are those of the recording. Remove `world`.",
    "sensor": _SENSOR,
    "sensors": _SENSOR,
    "poses": _POSES.format("poses"),
    "trajectory": _POSES.format("trajectory"),
    "mount": _POSES.format("mount"),
    "steps": (
        "because the number of sweeps is that of the recording. To select sweeps, use `--sweeps`."
    ),
    "navigation": "because a recording has no motion to measure. Remove `navigation`.",
    "cloud": "because the columns are those of the recording. Remove `cloud`.",
    "output": "because the format is that of the recording. To choose another, use `--format`.",
    "planning": "because paths are planned in a scene. Remove `planning`.",
    "pool": "because sweeps do not use the partitions of a survey. Use `--workers` instead.",
}
_BEAM = f"because the beam of the sensor cannot be changed after the fact. {_TWIN}"
_WAVEFORM = f"because a recording contains returns instead of waveforms. {_TWIN}"
# {field: why it cannot be applied to a recording, and a remedy}
_OTHER_FIELDS = {
    "returns.subrays": _BEAM,
    "returns.divergence_mrad": _BEAM,
    "returns.pulse_ns": _BEAM,
    "returns.beam_profile": _BEAM,
    "returns.exit_diameter_m": _BEAM,
    "returns.waveform": _WAVEFORM,
    "returns.sample_ns": _WAVEFORM,
    "returns.bandwidth_mhz": _WAVEFORM,
    "noise.velocity_m_s": (
        "because the radial velocities of a recording are kept. Remove `noise.velocity_m_s`."
    ),
}
# {kind of a fault: why it cannot be applied to a recording, and a remedy}
_OTHER_FAULTS = {
    "frozen": (
        "because a frozen sensor repeats an earlier sweep instead of changing pulses. Repeat the "
        "sweep in the recording."
    ),
    "time_jump": (
        "because it changes timestamps instead of pulses. Change the timestamps in the recording."
    ),
}
_DETECTION_RANGE_M = 100.0  # only decides whether steps apply


def check_content(data: Mapping[str, Any], source: str) -> None:
    """Check the content of an effects file for fields that cannot be applied to a recording.

    `check_sections` does the same for a valid scenario. This check comes first, so that the message
    does not depend on the sensor that a scenario without a sensor has by default.

    Raises
    ------
    LidarError
        If the content has such fields.
    """
    mistakes = Mistakes()
    for path, reason in _OTHER_FIELDS.items():
        section, _, name = path.partition(".")
        fields = data.get(section)
        default = Scenario.model_fields[section].get_default(call_default_factory=True)
        if (
            isinstance(fields, Mapping)
            and name in fields
            and fields[name] != getattr(default, name)
        ):
            mistakes.lines.append(f"{source}: `{path}` cannot be applied to a recording, {reason}")
    mistakes.raise_if_any()


def check_sections(scenario: Scenario) -> None:
    """Check that all sections and fields of a scenario can be applied to a recording.

    Raises
    ------
    LidarError
        If a section or field has no effect on recorded pulses. The message has a line for each of
        them, with the reason and a remedy.
    """
    mistakes = Mistakes()
    mistakes.lines += [f"{scenario.source}: {reason}" for reason in _section_errors(scenario)]
    mistakes.raise_if_any()


def check_spray(scenario: Scenario, actors: tuple[Actor, ...]) -> None:
    """Raise LidarError if spray is set, but no inserted vehicle can raise it."""
    mistakes = Mistakes()
    if scenario.weather.spray_g_m3 and not any(a.spray and a.trajectory.moves for a in actors):
        mistakes.lines.append(
            f"{scenario.source}: `weather.spray_g_m3` requires an inserted vehicle that moves, "
            "because the speeds of recorded vehicles are unknown. Add it to `actors` with a "
            "trajectory."
        )
    mistakes.raise_if_any()


def _section_errors(scenario: Scenario) -> Iterator[str]:
    """Yield a sentence for each section or field that cannot be applied to a recording."""
    changed = _changed_fields(scenario)
    for name in sorted(changed - {*SECTIONS}):
        default = f"because it describes a survey. Remove `{name}`."
        yield f"`{name}` cannot be applied to a recording, {_OTHER_SECTIONS.get(name, default)}"
    for section in ("noise", "returns"):
        for name in sorted(_changed_fields(getattr(scenario, section))):
            if reason := _OTHER_FIELDS.get(f"{section}.{name}"):
                yield f"`{section}.{name}` cannot be applied to a recording, {reason}"
    yield from effect_errors(dict(scenario.noise), scenario.faults, scenario.weather)
    yield from _placement_errors(scenario)


def effect_errors(
    noise: Mapping[str, Any], faults: Sequence[Fault], weather: Weather
) -> Iterator[str]:
    """Yield a sentence for each effect that cannot be applied to a recording.

    Parameters
    ----------
    noise
        Values of fields of `Noise`.
    faults, weather
        Faults and weather.
    """
    yield from _step_errors(noise)
    yield from _fault_errors(faults)
    yield from _weather_errors(weather)


def _changed_fields(section: Any) -> set[str]:
    """Return the names of fields that are set and differ from their default values."""
    fields = type(section).model_fields
    return {
        name
        for name in section.model_fields_set
        if getattr(section, name) != fields[name].get_default(call_default_factory=True)
    }


def _step_errors(noise: Mapping[str, Any]) -> Iterator[str]:
    """Yield the reason of each simulation step that applies, but cannot act on recorded pulses."""
    if not noise.keys() - {"range_m", "range_per_m", "dropout", "seed"}:
        return
    noise = {"detection_range_m": _DETECTION_RANGE_M} | {
        name: value for name, value in noise.items() if value is not None
    }
    returns = Returns(divergence_mrad=1.0)
    sensor = Sensor.grid(max_range_m=_DETECTION_RANGE_M)
    survey = Survey(
        sensors=[Mounted(sensor, name="lidar"), Mounted(sensor, name="other")],  # for crosstalk
        poses=[CENTER],
        noise=Noise(**noise),
        returns=returns,
    )
    setup = Setup(scene_of_bodies(), survey, 0, None)
    for step in STEPS:
        if step.on_recordings and step.applies(setup):
            yield step.on_recordings


def _fault_errors(faults: Sequence[Fault]) -> Iterator[str]:
    for number, fault in enumerate(faults):
        if fault.kind in _OTHER_FAULTS:
            yield (
                f"faults[{number}]: A fault of kind {fault.kind!r} cannot be simulated on a "
                f"recording, {_OTHER_FAULTS[fault.kind]}"
            )
        if fault.sensor is not None:
            yield (
                f"faults[{number}]: `sensor` cannot be set, because the sensors of a recording "
                "are augmented one by one. Remove `sensor`."
            )


def _weather_errors(weather: Weather) -> Iterator[str]:
    if weather.wet and not weather.spray_g_m3:
        yield (
            "`weather.wet` cannot be simulated on a recording, because the reflection of recorded "
            f"surfaces does not change. {_TWIN}"
        )
    if weather.spray_g_m3 and not weather.wet:
        yield "`weather.spray_g_m3` requires wet ground. Set `weather.wet`."


def _placement_errors(scenario: Scenario) -> Iterator[str]:
    """Yield a sentence for each actor whose height depends on surfaces of a scene."""
    remedy = (
        "because a recording has no named surfaces. Set heights in the world frame of the "
        "recording."
    )
    for entry in scenario.actors:
        if entry.trajectory is not None and entry.trajectory.surfaces is not None:
            yield (
                f"actor {entry.name!r}: `trajectory.surfaces` cannot be applied to a recording, "
                f"{remedy}"
            )
    if scenario.traffic is not None and scenario.traffic.surfaces is not None:
        yield f"`traffic.surfaces` cannot be applied to a recording, {remedy}"

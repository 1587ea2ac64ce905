"""Notes about likely mistakes in a valid scenario."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

from lidarsim.columns.table import VELOCITY
from lidarsim.media.materials import FAR_NM, NEAR_NM, MaterialTable, extinction, reflectances
from lidarsim.media.weather import FOG_LIDAR_RATIO_SR
from lidarsim.motion.headings import CORNER_M
from lidarsim.motion.navigation import Gnss, Imu
from lidarsim.motion.trajectory import CENTER, Track, presence_ns
from lidarsim.pulses.steps.particles import WeatherStep
from lidarsim.pulses.steps.step_list import setup_of
from lidarsim.scene.files.mesh_formats import format_of
from lidarsim.scene.files.meshfile import is_written_by_lidarpool
from lidarsim.scene.scene import Scene
from lidarsim.sensor.optics import TWO_RETURNS
from lidarsim.survey.survey import START_FROM, Survey
from lidarsim.words import format_as_scenario, format_rounded, join_names, list_names, plural

from .georeference import missing_epsg_note
from .prepare import PreparedScenario
from .scenario import Scenario, mesh_survey_name

# Plausible lengths of scenes. Larger or smaller scenes probably have a wrong unit.
LARGE_M = 500.0
LARGE_STL_M = 20.0  # most .stl files contain parts in millimeters
LARGE_OBJECT_M = 10.0  # single objects are rarely longer than a bus
LARGE_STATED_M = 100.0  # some exporters write glTF in millimeters, although it must be in meters
SMALL_M = 0.2
_LAST_DATE = datetime(2100, 1, 1, tzinfo=UTC)  # later times are probably not seconds since 1970
HAZE_KM = 10.0  # lidars cannot detect backscatter if the visibility is better
MIN_STEPS = 100  # minimum length of a scene in units of the precision


def advice(prepared: PreparedScenario) -> list[str]:
    """Return notes about likely mistakes, such as a wrong unit that results in an unusual size.

    The notes also cover skipped objects, files whose up axis was assumed, default poses, and
    settings that have no effect.
    """
    notes = prepared.findings.notes
    remarks = prepared.findings.remarks
    axes = [
        _with_command_option(remark) if _is_mesh_survey(prepared.scenario) else remark
        for remark in remarks[:1]
    ]
    if others := len(remarks[1:]):
        axes = [f"{axes[0]}. The same applies to {plural(others, 'other file')}"]
    side = float(np.ptp(prepared.scene.bounds, axis=0).max())
    step = prepared.survey.precision_m
    placement_notes = () if prepared.placement is None else prepared.placement.notes
    system = missing_epsg_note(prepared.scene, prepared.survey.epsg)
    likely = filter(
        None, (_size_note(prepared, side), system, *placement_notes, _color_note(prepared))
    )
    coarse = [
        f"points are rounded to {step:g} m, but the scene is only {side:.3g} m long. Set a smaller "
        "`cloud.precision_m` in a scenario"
    ] * (side < MIN_STEPS * step)
    labels = _unnamed_classes(prepared.survey)
    if any(column.name == "class" for column in prepared.survey.stored_columns):
        labels = chain(unlabeled_notes(prepared.scene, prepared.survey), labels)
    settings = (*coarse, *_format_notes(prepared), *labels, *_without_effect(prepared.scenario))
    light = (
        *_single_returns(prepared),
        *_dark_fog(prepared.survey),
        *_assumed_wavelengths(prepared),
    )
    groups = (
        *(notes, axes, likely, _heading_notes(prepared.findings.without_angles)),
        *(settings, light, _timing_notes(prepared)),
    )
    return [format_as_scenario(line) for line in chain.from_iterable(groups)]


def unlabeled_notes(scene: Scene, survey: Survey) -> list[str]:
    """Return a note if static objects have no class although the cloud stores classes.

    The list is empty if the survey assigns a name to class 0, for example "background".
    """
    if 0 in survey.classes:
        return []
    kinds = scene.surface_kinds
    table = MaterialTable.build(survey.materials, kinds, voxels=scene.has_voxels)
    has_class = np.zeros(len(scene.object_names), np.bool_)
    has_class[kinds.object[table.semantic_class > 0]] = True
    if not has_class.any():
        return [
            (
                "points are labeled by class, but no object has a class, so all points have class "
                "0. Set `class` in `materials`, `copies`, `actors` or `traffic`, and name the "
                "classes in `classes`; see docs/how-to/labels.md"
            )
        ]
    without = [name for name, known in zip(scene.names, has_class, strict=False) if not known]
    if not without:
        return []
    return [
        (
            f"points are labeled by class, but {len(without):,} of "
            f"{plural(len(scene.names), 'static object')} "
            f"{'have' if without[1:] else 'has'} no class ({list_names(without, 3)}). Their points "
            "have class 0. Set `class` in `materials`, or name class 0 in `classes`; see "
            "docs/how-to/labels.md"
        )
    ]


def _is_mesh_survey(scenario: Scenario) -> bool:
    files = [scenario.path(entry.file) for entry in scenario.scene.files]
    return scenario.source in map(mesh_survey_name, files)


def _with_command_option(remark: str) -> str:
    """Rewrite a remark about axes to name the command-line option instead of the field."""
    return re.sub(r'<file\.up_axis="(\w)">', r"`--up-axis \1`", remark).replace(
        "set up_axis explicitly", "pass `--up-axis` explicitly"
    )


def _unnamed_classes(survey: Survey) -> Iterator[str]:
    """Yield a note if some but not all classes of a survey have names."""
    used = {material.semantic_class for material in survey.materials}
    if unnamed := sorted(used - {0, *survey.classes}) if survey.classes else []:
        noun = "classes" if unnamed[1:] else "class"
        names = ", ".join(f"{number}: …" for number in unnamed)
        yield (
            f"{noun} {list_names([*map(str, unnamed)])} of materials or actors "
            f"{'have' if unnamed[1:] else 'has'} no name. Add `{{{names}}}` to `classes`"
        )


def _format_notes(prepared: PreparedScenario) -> list[str]:
    specs = prepared.scenario.output.write
    notes = (note for spec in specs for note in spec.cloud_format.survey_notes(prepared.survey))
    return [*dict.fromkeys(notes)]


def _size_note(prepared: PreparedScenario, side: float) -> str:
    """Return a note if the scene's length suggests a wrong unit, or an empty string otherwise.

    `side` is the length of the longest side in meters.
    """
    scenario = prepared.scenario
    placement = prepared.placement
    files = [entry.file for entry in scenario.scene.files if entry.unit is None]
    # City models, whose files assign classes, are large.
    files = [file for file in files if file not in prepared.findings.classes]
    unitless = [file for file in files if _lacks_unit(scenario.path(file))]
    has_stl = any(file.lower().endswith(".stl") for file in unitless)
    min_m = SMALL_M
    max_m = LARGE_STL_M if has_stl else LARGE_M
    if surrounded := placement is not None and placement.surrounds_object:
        min_m = 0.0
        max_m = LARGE_OBJECT_M if unitless else LARGE_STATED_M
    if not (unitless or (surrounded and files)) or min_m <= side <= max_m:
        return ""
    unit = "mm" if side > max_m else "km"
    name = (unitless or files)[0]
    assumed = (
        f"{name} states no unit. If it is in meters,"
        if unitless
        else f"the format of {name} prescribes meters, so"
    )
    return (
        f"{assumed} the scene is {format_rounded(side, 5)} m long. If this is wrong, set the "
        f"`unit` of the file in `scene.files` (possibly {unit}), or pass `--unit {unit}` with a "
        "mesh file"
    )


def _lacks_unit(path: Path) -> bool:
    row = format_of(path)
    return row is not None and row.unitless and not is_written_by_lidarpool(path)


def _color_note(prepared: PreparedScenario) -> str:
    """Return a note about objects that lack colors required by a setting, or an empty string."""
    scene = prepared.scene
    if not prepared.scenario.needs_colors:
        return ""
    if not scene.all_colors:
        return (
            "a column or `reflectance: texture` uses colors, but no object of the scene has "
            "colors, so all surfaces are gray"
        )
    names = scene.object_names
    kinds = scene.surface_kinds
    table = MaterialTable.build(prepared.survey.materials, kinds, voxels=scene.has_voxels)
    textured = np.zeros(len(names), np.bool_)
    textured[kinds.object[table.scale > 0]] = True
    if not len(gray := np.flatnonzero(textured & ~scene.has_colors)):
        return ""
    shown = ", ".join(names[i] for i in gray[:3]) + ", …" * (len(gray) > 3)
    return (
        f"{len(gray):,} of {plural(int(textured.sum()), 'object')} with `reflectance: texture` "
        f"{'has' if len(gray) == 1 else 'have'} no colors and {'is' if len(gray) == 1 else 'are'} "
        f"treated as gray: {shown}"
    )


def _without_effect(scenario: Scenario) -> Iterator[str]:
    """Yield notes about settings that have no effect or contradict each other."""
    for entry in scenario.output.write:
        yield from entry.frame_notes(scenario.cloud.coordinates)
        yield from entry.cloud_format.renaming_notes([*scenario.sensors])
    written = {entry.format for entry in scenario.output.write}
    if scenario.cloud.waveform_samples and not {"las", "laz"} & written:
        yield (
            "`cloud.waveform_samples` has no effect, because only LAS and LAZ files store "
            "waveforms, and no such file is written. Set `output: {write: [las]}`"
        )
    is_default = scenario.weather.fog_lidar_ratio_sr in (None, FOG_LIDAR_RATIO_SR)
    if not is_default and scenario.weather.visibility_km is None:
        yield "`weather.fog_lidar_ratio_sr` has no effect without `weather.visibility_km`"
    if scenario.weather.spray_g_m3 and not (scenario.actors or scenario.traffic):
        yield "`weather.spray_g_m3` has no effect without moving actors or traffic"
    if scenario.cloud.actor_visibility and not (scenario.actors or scenario.traffic):
        yield "`cloud.actor_visibility` has no effect without actors or traffic"
    if scenario.noise.stray_light and not any(entry.retro for entry in scenario.materials):
        yield "`noise.stray_light` has no effect without a material with `retro: true`"
    trajectory = scenario.trajectory
    imu = scenario.navigation and scenario.navigation.imu
    if imu and trajectory and trajectory.interpolation == "linear" and len(trajectory.points) != 2:
        yield (
            "the measurements of `navigation.imu` jump at the poses of a trajectory with linear "
            "interpolation. Set `trajectory.interpolation: smooth`"
        )
    yield from _georeferencing_notes(scenario)
    if scenario.noise.velocity_m_s and VELOCITY not in scenario.cloud.columns:
        yield (
            f"`noise.velocity_m_s` has no effect without the column {VELOCITY}. Add it to "
            "`cloud.columns`"
        )


def _georeferencing_notes(scenario: Scenario) -> Iterator[str]:
    """Yield notes about errors of the trajectory that have no effect on the points."""
    navigation = scenario.navigation
    if navigation is None:
        return
    imu = navigation.imu
    gnss = navigation.gnss
    attitude = imu is not None and (imu.roll_pitch_deg or imu.heading_deg)
    mount = navigation.mount_error != CENTER
    if scenario.cloud.georeferencing == "exact":
        names = ["navigation.mount_error"] * mount
        names += ["navigation.imu.roll_pitch_deg", "navigation.imu.heading_deg"] if attitude else []
        if names:
            yield (
                f"{', '.join(f'`{name}`' for name in names)}: these errors affect only points that "
                "are georeferenced by the measured trajectory. Set `cloud.georeferencing: measured`"
            )
        return
    if imu is not None and imu != Imu(rate_hz=imu.rate_hz, mount=imu.mount) and not attitude:
        yield (
            "the errors of `navigation.imu` affect its samples, but the measured trajectory has no "
            "attitude errors. Set `navigation.imu.roll_pitch_deg` and `heading_deg`"
        )
    if not mount and not attitude and gnss in (None, gnss and Gnss(rate_hz=gnss.rate_hz)):
        yield (
            "points are georeferenced by the measured trajectory, which has no errors. Set errors "
            "in `navigation`, such as `gnss.drift_horizontal_m` or `mount_error`"
        )


def _single_returns(prepared: PreparedScenario) -> Iterator[str]:
    """Yield a note if sensors report several returns, but each pulse can have only one return.

    False alarms are ignored, although they are also returns.
    """
    survey = prepared.survey
    setups = [
        setup_of(prepared.scene, survey, number) for number in range(len(survey.mounted_sensors))
    ]
    single = [
        setup
        for setup in setups
        if setup.reporting.mode in (*TWO_RETURNS, "all")
        and setup.reporting.subrays == 1
        and not (setup.has_onward_light or WeatherStep.applies(setup) or survey.spray_g_m3)
    ]
    if not single:
        return
    reporting = single[0].reporting
    has_divergence = reporting.divergence_mrad or single[0].sensor.optics.divergence_mrad
    divergence = "" if has_divergence else ", divergence_mrad: 3"
    names = [survey.mounted_sensors[setup.number].name for setup in single]
    of_sensors = f" of {list_names(names)}" if all(names) else ""
    yield (
        f"the returns mode{of_sensors} is {reporting.mode}, but a pulse never has a second return, "
        "because each beam is a single ray that hits one surface. Set `returns: {subrays: 7"
        f"{divergence}}}`"
    )


def _dark_fog(survey: Survey) -> Iterator[str]:
    """Yield a note if fog attenuates the light without causing returns."""
    if survey.visibility_km is None or survey.visibility_km > HAZE_KM:
        return
    if survey.fog_lidar_ratio_sr is None:
        yield (
            "fog attenuates light but causes no returns, because `weather.fog_lidar_ratio_sr` is "
            "null"
        )
        return
    without = [
        carried
        for carried, noise in zip(survey.mounted_sensors, survey.noise_each, strict=True)
        if noise.detection_range_m is None
    ]
    if without:
        names = [carried.name for carried in without]
        of_sensors = f" of {list_names(names)}" if all(names) else ""
        yield (
            "fog attenuates light but causes no returns, because "
            f"`noise.detection_range_m`{of_sensors} is not set. Set it to the range at 10 % "
            "reflectance, for example `noise: {detection_range_m: 90}`"
        )


def _assumed_wavelengths(prepared: PreparedScenario) -> Iterator[str]:
    """Yield notes about effects that depend on a wavelength that no source of a sensor states."""
    survey = prepared.survey
    sections = prepared.scenario.sensors.values() or (prepared.scenario.sensor,)
    models = dict.fromkeys(
        carried.sensor.model
        for section, carried in zip(sections, survey.mounted_sensors, strict=True)
        if (section.model or section.calibration) and carried.sensor.optics.wavelength_nm is None
    )
    if not models:
        return
    for effect in _effects_of_wavelength(survey):
        yield (
            f"the wavelength of {join_names([*models])} is unknown and simulated as {NEAR_NM:g} "
            f"nm, but {effect}. If you know the wavelength, set `optics.wavelength_nm` in a copy "
            "of the sensor file"
        )


def _effects_of_wavelength(survey: Survey) -> Iterator[str]:
    """Describe effects of the survey that depend on the wavelength. Dust does not."""
    spectra = {entry.spectrum for entry in survey.materials if entry.spectrum is not None}
    shares = {name: reflectances()[name].shares for name in sorted(spectra)}
    if any(near != far for near, far in shares.values()):
        name = max(shares, key=lambda name: abs(shares[name][0] - shares[name][1]))
        near, far = shares[name]
        yield (
            f"reflectances depend on it: the spectrum {name!r} is {near:.2f} at {NEAR_NM:g} nm and "
            f"{far:.2f} at {FAR_NM:g} nm"
        )
    if survey.visibility_km is not None:
        near, far = (1e3 * extinction(survey.visibility_km, nm) for nm in (NEAR_NM, FAR_NM))
        yield (
            f"the extinction by fog depends on it: it is {near:.3g}/km at {NEAR_NM:g} nm and "
            f"{far:.3g}/km at {FAR_NM:g} nm"
        )


def _heading_notes(without_angles: Mapping[str, bool]) -> Iterator[str]:
    """Yield a note about trajectories that do not specify angles.

    `without_angles` maps the name of each trajectory to whether its path has corners.
    """
    if not without_angles:
        return
    names = [*without_angles]
    note = (
        f"the trajectory of {list_names(names)} has no angles, so its poses are level and face the "
        "direction of travel"
    )
    if names[1:]:
        note = (
            f"the trajectories of {list_names(names)} have no angles, so their poses are level and "
            "face the direction of travel"
        )
    if any(without_angles.values()):
        note += (
            f". At a corner between straight lines, the poses turn from {CORNER_M:g} m before to "
            f"{CORNER_M:g} m after the corner. For a path without corners, set `interpolation: "
            "smooth`"
        )
    yield note


def _timing_notes(prepared: PreparedScenario) -> Iterator[str]:
    """Yield notes about implausible or inconsistent times.

    The notes concern dates that are not stored, faults during which no sweep starts, actors that
    are absent during the survey, and animations that end before the survey.
    """
    survey = prepared.survey
    if isinstance(survey.path, Track) and survey.start is None:
        start_s = survey.path.start_s
        assert start_s is not None  # set by Track.__post_init__
        if START_FROM.timestamp() <= start_s < _LAST_DATE.timestamp():
            moment = datetime.fromtimestamp(start_s, UTC).isoformat()
            yield (
                f"the trajectory starts at {start_s:.0f} s, but point times are relative to the "
                "start of the survey. If the trajectory times are seconds since 1970, set "
                f"`cloud: {{start: {moment}}}` to keep the date"
            )
    end = np.array([prepared.survey.duration_ns])
    for number, (_, starts, _) in enumerate(survey.sweeps_each):
        for index, fault in survey.sensor_faults(number, "frozen").items():
            if not fault.is_active(starts).any():
                sensor = survey.mounted_sensors[number].name or "the sensor"
                yield (
                    f"`faults[{index}]` does not freeze {sensor}, because no sweep starts during "
                    "the fault"
                )
    for actor in prepared.scene.actors:
        first, last = presence_ns(actor.trajectory)
        if first > end[0] or last < 0:
            yield f"{actor.name} is not in the scene during the survey. Check its times"
        animation = actor.mesh.animation
        if animation and not animation.repeat and actor.seconds(end)[0][0] > animation.duration_s:
            yield (
                f"the animation of {actor.name} ends after {format_rounded(animation.duration_s)} "
                "s, before the end of the survey, and its last pose is kept. To repeat the "
                "animation, set `repeat: true`"
            )

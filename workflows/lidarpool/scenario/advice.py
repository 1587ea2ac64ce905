"""Notes on likely mistakes in a scenario that can be built."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

from lidarsim.base.words import as_scenario, listed, plural, rounded
from lidarsim.columns.table import VELOCITY
from lidarsim.media.materials import MaterialTable
from lidarsim.media.weather import FOG_LIDAR_RATIO_SR
from lidarsim.motion.headings import CORNER_M
from lidarsim.motion.trajectory import Track, presence_ns
from lidarsim.scene.files.mesh_formats import format_of
from lidarsim.scene.files.meshfile import written_by_lidarpool
from lidarsim.sensor.optics import TWO_RETURNS
from lidarsim.simulator.steps.particles import WeatherStep
from lidarsim.simulator.steps.step_list import setup_of
from lidarsim.survey.survey import START_FROM, Survey

from ..clouds.laser_scan import has_planar_sensors
from .build import Built
from .scenario import Scenario

# Sizes of scenes in meters are between these. An .stl is mostly a part, in millimeters; an object
# seen from outside is rarely longer than a bus. glTF is in meters, and some exporters write
# millimeters.
LARGE_M = 500.0
LARGE_STL_M = 20.0
LARGE_OBJECT_M = 10.0
LARGE_STATED_M = 100.0
SMALL_M = 0.2
_LAST_DATE = datetime(2100, 1, 1, tzinfo=UTC)  # later seconds since 1970 are likely no dates
HAZE_KM = 10.0  # no lidar detects light that returns from clearer air
MIN_STEPS = 100  # smallest length of a scene, in steps of the precision


def advice(built: Built) -> list[str]:
    """Return notes on likely mistakes, such as a size that suggests another unit.

    There are also notes on objects that were left out, files whose axes were guessed, poses that
    were chosen, and settings without effect.
    """
    notes = built.findings.notes
    remarks = built.findings.remarks
    axes = [f"{remark} (--up-axis AXIS with a mesh file)" for remark in remarks[:1]]
    if remarks[1:]:
        axes = [f"{axes[0]}; {plural(len(remarks) - 1, 'more file')}, too"]
    side = float(np.ptp(built.scene.bounds, axis=0).max())
    step = built.survey.precision_m
    every = built.survey.keep_every
    placed = "" if built.placing is None else built.placing.note
    likely = filter(None, (_size_note(built, side), placed, _color_note(built)))
    scanners = [
        "bags have a LaserScan of a 2D scanner only if every return is kept: set cloud.keep_every "
        "to 1"
    ] * (_writes_bags(built.scenario) and every > 1 and has_planar_sensors(built.survey))
    coarse = [
        f"points are rounded to {step:g} m, and the scene is {side:.3g} m long: give a smaller "
        "cloud.precision_m in a scenario"
    ] * (side < MIN_STEPS * step)
    unlabeled = [
        note for entry in built.scenario.output.write for note in entry.unlabeled(built.survey)
    ]
    labels = (*unlabeled, *_unnamed_classes(built.survey))
    settings = (*coarse, *scanners, *labels, *_without_effect(built.scenario))
    light = (*_single_returns(built), *_dark_fog(built.survey))
    groups = (
        *(notes, axes, likely, _heading_notes(built.findings.without_angles)),
        *(settings, light, _timing_notes(built)),
    )
    return [as_scenario(line) for line in chain.from_iterable(groups)]


def _unnamed_classes(survey: Survey) -> Iterator[str]:
    """Yield a note if some classes have names, and others of the survey's objects have none."""
    used = {material.semantic_class for material in survey.materials}
    if unnamed := sorted(used - {0, *survey.classes}) if survey.classes else []:
        noun = "classes" if unnamed[1:] else "class"
        names = ", ".join(f"{number}: …" for number in unnamed)
        yield (
            f"{noun} {listed([*map(str, unnamed)])} of materials or actors without a name: add "
            f"{{{names}}} to classes"
        )


def _writes_bags(scenario: Scenario) -> bool:
    """Return whether the output has a bag with messages of 2D scanners."""
    return any(entry.row.laser_scans for entry in scenario.output.write)


def _size_note(built: Built, side: float) -> str:
    """Return a note if the longest side of the scene (meters) suggests another unit, else ""."""
    scenario = built.scenario
    placing = built.placing
    files = [entry.file for entry in scenario.scene.files if entry.unit is None]
    files = [file for file in files if file not in built.findings.classes]  # towns are large
    unitless = [file for file in files if _lacks_unit(scenario.path(file))]
    has_stl = any(file.lower().endswith(".stl") for file in unitless)
    min_m = SMALL_M
    max_m = LARGE_STL_M if has_stl else LARGE_M
    if surrounded := placing is not None and placing.surrounds_object:
        min_m = 0.0
        max_m = LARGE_OBJECT_M if unitless else LARGE_STATED_M
    if not (unitless or (surrounded and files)) or min_m <= side <= max_m:
        return ""
    unit = "mm" if side > max_m else "km"
    stated = "states no unit" if unitless else "is in meters by its format"
    return (
        f"{(unitless or files)[0]} {stated}, and in meters the scene is {rounded(side, 5)} m long. "
        f"If that is wrong, give the file's unit ({unit}?) in scene.files, or --unit {unit} with a "
        "mesh file"
    )


def _lacks_unit(path: Path) -> bool:
    """Return whether neither a mesh file nor its format states a unit."""
    row = format_of(path)
    return row is not None and row.unitless and not written_by_lidarpool(path)


def _color_note(built: Built) -> str:
    """Return a note on objects that lack the colors that settings need, or an empty string."""
    scene = built.scene
    if not built.scenario.colored:
        return ""
    if not scene.colored:
        return (
            "a column or reflectance: texture needs colors, but nothing in the scene has any, "
            "so that all is gray"
        )
    names = scene.object_names
    kinds = scene.surface_kinds
    table = MaterialTable.build(built.survey.materials, kinds, voxels=scene.has_voxels)
    textured = np.zeros(len(names), np.bool_)
    textured[kinds.object[table.scale > 0]] = True
    if not len(gray := np.flatnonzero(textured & ~scene.has_colors)):
        return ""
    shown = ", ".join(names[i] for i in gray[:3]) + ", …" * (len(gray) > 3)
    return (
        f"{len(gray):,} of {plural(int(textured.sum()), 'object')} with reflectance: texture "
        f"have no colors and are gray: {shown}"
    )


def _without_effect(scenario: Scenario) -> Iterator[str]:
    """Yield notes on settings without effect, and on contradictions between settings."""
    for entry in scenario.output.write:
        yield from entry.contradictions(scenario.cloud.coordinates)
        yield from entry.renamed([*scenario.sensors])
    written = {entry.format for entry in scenario.output.write}
    if scenario.cloud.waveform_samples and not {"las", "laz"} & written:
        yield (
            "cloud.waveform_samples: only LAS and LAZ files hold waveforms, and none is "
            "written: add output: {write: [las]}"
        )
    is_default = scenario.weather.fog_lidar_ratio_sr in (None, FOG_LIDAR_RATIO_SR)
    if not is_default and scenario.weather.visibility_km is None:
        yield "weather.fog_lidar_ratio_sr without weather.visibility_km is no fog"
    if scenario.weather.spray_g_m3 and not (scenario.actors or scenario.traffic):
        yield "weather.spray_g_m3 needs actors or traffic that move, and there are none"
    if scenario.noise.stray_light and not any(entry.retro for entry in scenario.materials):
        yield "noise.stray_light needs materials with retro: true, and there are none"
    trajectory = scenario.trajectory
    imu = scenario.navigation and scenario.navigation.imu
    if imu and trajectory and trajectory.interpolation == "linear" and len(trajectory.points) != 2:
        yield "navigation.imu has jumps at linear poses: give trajectory.interpolation: smooth"
    if scenario.noise.velocity_m_s and VELOCITY not in scenario.cloud.columns:
        yield f"noise.velocity_m_s is that of the column {VELOCITY}: add it to cloud.columns"


def _single_returns(built: Built) -> Iterator[str]:
    """Yield a note if sensors report several returns, and no pulse has a second one.

    False alarms do not count, although they are returns, too.
    """
    survey = built.survey
    setups = [setup_of(built.scene, survey, number) for number in range(len(survey.carried))]
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
    names = [survey.carried[setup.number].name for setup in single]
    of_sensors = f" of {listed(names)}" if all(names) else ""
    yield (
        f"the returns mode{of_sensors} is {reporting.mode}, but a pulse never has a second return, "
        "because each beam is a single ray that meets one surface. Set returns: {subrays: 7"
        f"{divergence}}}"
    )


def _dark_fog(survey: Survey) -> Iterator[str]:
    """Yield notes if fog attenuates light and returns none."""
    if survey.visibility_km is None or survey.visibility_km > HAZE_KM:
        return
    if survey.fog_lidar_ratio_sr is None:
        yield (
            "weather.fog_lidar_ratio_sr is null: fog attenuates light, and no light returns from it"
        )
        return
    without = [
        carried
        for carried, noise in zip(survey.carried, survey.noise_each, strict=True)
        if noise.detection_range_m is None
    ]
    if without:
        names = [carried.name for carried in without]
        of_sensors = f" of {listed(names)}" if all(names) else ""
        yield (
            "fog attenuates light, and no light returns from it, because noise.detection_range_m"
            f"{of_sensors} is not known. Set it to the range at 10 % reflectance, for example "
            "noise: {detection_range_m: 90}"
        )


def _heading_notes(without_angles: Mapping[str, bool]) -> Iterator[str]:
    """Yield notes on trajectories without angles: {name: whether the path has corners}."""
    if not without_angles:
        return
    names = [*without_angles]
    note = (
        f"the trajectory of {listed(names)} has no angles: it is level and faces the direction of "
        "travel"
    )
    if names[1:]:
        note = (
            f"the trajectories of {listed(names)} have no angles: they are level and face the "
            "direction of travel"
        )
    if any(without_angles.values()):
        note += (
            f". At a corner between straight lines, the turn takes {CORNER_M:g} m before and after "
            "it; interpolation: smooth makes a path without corners"
        )
    yield note


def _timing_notes(built: Built) -> Iterator[str]:
    """Yield notes on times: a date that is lost, faults without sweeps, and absent actors.

    Animations of actors that end before the survey have notes, too.
    """
    survey = built.survey
    if isinstance(survey.path, Track) and survey.start is None:
        start_s = survey.path.start_s
        assert start_s is not None  # every track has a start
        if START_FROM.timestamp() <= start_s < _LAST_DATE.timestamp():
            moment = datetime.fromtimestamp(start_s, UTC).isoformat()
            yield (
                f"times of the trajectory begin at {start_s:.0f} s, and times of points at the "
                f"survey's start: if these seconds are since 1970, give start: {moment} in cloud "
                "to keep the date"
            )
    end = np.array([built.survey.duration_ns])
    for number, (_, starts, _) in enumerate(survey.sweeps_each):
        for index, fault in survey.faults_of(number, "frozen").items():
            if not fault.during(starts).any():
                sensor = survey.carried[number].name or "the sensor"
                yield f"faults[{index}] does not freeze {sensor}: no sweep begins meanwhile"
    for actor in built.scene.actors:
        first, last = presence_ns(actor.trajectory)
        if first > end[0] or last < 0:
            yield f"{actor.name} is not in the scene during the survey: check its times"
        animation = actor.mesh.animation
        if animation and not animation.repeat and actor.seconds(end)[0][0] > animation.duration_s:
            yield (
                f"{actor.name}: its animation of {rounded(animation.duration_s)} s ends before the "
                "survey does, and its last pose remains: give repeat: true"
            )

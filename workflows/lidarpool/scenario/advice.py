"""Notes on likely mistakes in a scenario that can be built."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lidarsim.base.words import as_scenario, plural
from lidarsim.columns.table import VELOCITY
from lidarsim.scene.files.mesh_formats import format_of
from lidarsim.scene.files.meshfile import written_by_lidarpool
from lidarsim.sensor.materials import MaterialTable
from lidarsim.sensor.models import STATED
from lidarsim.sensor.trajectory import presence_ns

from ..export.laser_scan import has_planar_sensors
from .build import Built
from .scenario import Scenario
from .sections import SensorSection

# Sizes of scenes in metres are between these. An .stl is mostly a part, in millimetres; an object
# to look at from outside is rarely longer than a bus. glTF is in metres, and some exporters write
# millimetres.
LARGE_M = 500.0
LARGE_STL_M = 20.0
LARGE_OBJECT_M = 10.0
LARGE_STATED_M = 100.0
SMALL_M = 0.2
FINE = 100  # a scene is at least so many steps of the precision long


def advice(built: Built) -> list[str]:
    """Return notes on likely mistakes, such as a size that suggests another unit.

    Also on objects that were left out, on files whose axes were guessed, on poses that were chosen,
    on figures that data sheets lack, and on settings without effect.
    """
    notes = built.found.notes
    remarks = built.found.remarks
    axes = [f"{remark} (--up-axis AXIS with a mesh file)" for remark in remarks[:1]]
    if remarks[1:]:
        axes = [f"{axes[0]}; {plural(len(remarks) - 1, 'more file')}, too"]
    side = float(np.ptp(built.scene.bounds, axis=0).max())
    step = built.survey.precision_m
    every = built.survey.keep_every
    placed = "" if built.placing is None else built.placing.note
    likely = filter(None, (_of_size(built, side), placed, _of_colours(built)))
    unstated = dict.fromkeys(_of_datasheets(built))
    scanners = [
        "bags have a LaserScan of a 2D scanner only if every return is kept: set cloud.keep_every "
        "to 1"
    ] * (_writes_bags(built.scenario) and every > 1 and has_planar_sensors(built.survey))
    coarse = [
        f"points are rounded to {step:g} m, and the scene is {side:.3g} m long: give a smaller "
        "cloud.precision_m in a scenario"
    ] * (side < FINE * step)
    settings = (*coarse, *scanners, *_without_effect(built.scenario))
    lines = (*notes, *axes, *likely, *unstated, *settings, *_ended(built))
    return [as_scenario(line) for line in lines]


def _writes_bags(scenario: Scenario) -> bool:
    return any(entry.row.laser_scans for entry in scenario.output.write)


def _of_size(built: Built, side: float) -> str:
    scenario = built.scenario
    placing = built.placing
    files = [entry.file for entry in scenario.scene.files if entry.unit is None]
    files = [file for file in files if file not in built.found.classes]  # towns are large
    unitless = [file for file in files if _lacks_unit(scenario.path(file))]
    parts = any(file.lower().endswith(".stl") for file in unitless)
    least = SMALL_M
    large = LARGE_STL_M if parts else LARGE_M
    if around := placing is not None and placing.around:
        least = 0.0
        large = LARGE_OBJECT_M if unitless else LARGE_STATED_M
    if not (unitless or (around and files)) or least <= side <= large:
        return ""
    unit = "mm" if side > large else "km"
    said = "states no unit" if unitless else "is in metres by its format"
    return (
        f"{(unitless or files)[0]} {said}, and in metres the scene is {side:,.5g} m long. If "
        f"that is wrong, give the file's unit ({unit}?) in scene.files, or --unit {unit} with a "
        "mesh file"
    )


def _lacks_unit(path: Path) -> bool:
    """Whether a mesh file states no unit, nor does its format."""
    row = format_of(path)
    return row is not None and row.unitless and not written_by_lidarpool(path)


def _of_colours(built: Built) -> str:
    scene = built.scene
    if not built.scenario.coloured:
        return ""
    if not scene.coloured:
        return (
            "a column or reflectance: texture needs colours, but nothing in the scene has any, "
            "so that all is grey"
        )
    names = scene.all_names
    kinds = scene.surface_kinds
    table = MaterialTable.build(built.survey.materials, kinds, voxels=scene.has_voxels)
    textured = np.zeros(len(names), np.bool_)
    textured[kinds.object[table.scale > 0]] = True
    if not len(grey := np.flatnonzero(textured & ~scene.has_colours)):
        return ""
    shown = ", ".join(names[i] for i in grey[:3]) + ", …" * (len(grey) > 3)
    return (
        f"{len(grey):,} of {plural(int(textured.sum()), 'object')} with reflectance: texture "
        f"have no colours and are grey: {shown}"
    )


def _of_datasheets(built: Built) -> Iterator[str]:
    """Name what the data sheets of sensors do not state, and the scenario does not give."""
    scenario = built.scenario
    given = built.scenario.noise.model_fields_set
    sections: Mapping[str, SensorSection] = scenario.sensors or {"": scenario.sensor}
    for section, carried in zip(sections.values(), built.survey.carried, strict=True):
        lacking = (name for name in STATED if not getattr(carried.noise, name, True))
        if left := [name for name in lacking if name not in given]:
            lacks = ", ".join(f"{STATED[name]} (noise.{name})" for name in left)
            yield f"{section.model} gives no {lacks}: they have no effect"


def _without_effect(scenario: Scenario) -> Iterator[str]:
    """Tell of settings that another one keeps from having an effect, or contradicts."""
    for entry in scenario.output.write:
        yield from entry.contradictions(scenario.cloud.coordinates)
    written = {entry.format for entry in scenario.output.write}
    if scenario.cloud.waveform_samples and not {"las", "laz"} & written:
        yield (
            "cloud.waveform_samples: only LAS and LAZ files hold waveforms, and none is "
            "written: add output: {write: [las]}"
        )
    if scenario.weather.fog_lidar_ratio_sr is not None and scenario.weather.visibility_km is None:
        yield "weather.fog_lidar_ratio_sr without weather.visibility_km is no fog"
    if scenario.weather.spray_g_m3 and not (scenario.actors or scenario.traffic):
        yield "weather.spray_g_m3 needs actors or traffic that move, and there are none"
    if scenario.noise.stray_light and not any(entry.retro for entry in scenario.materials):
        yield "noise.stray_light needs materials with retro: true, and there are none"
    way = scenario.trajectory
    imu = scenario.navigation and scenario.navigation.imu
    if imu and way and way.interpolation == "linear" and len(way.points) != 2:
        yield "navigation.imu has jumps at linear poses: give trajectory.interpolation: smooth"
    if scenario.noise.velocity_m_s and VELOCITY not in scenario.cloud.columns:
        yield f"noise.velocity_m_s is that of the column {VELOCITY}: add it to cloud.columns"


def _ended(built: Built) -> Iterator[str]:
    """Tell of frozen sensors without sweeps, and of actors that are not there, or end early."""
    survey = built.survey
    end = np.array([built.survey.duration_ns])
    for number, (_, begins, _) in enumerate(survey.sweeps_each):
        for place, fault in survey.faults_of(number, "frozen").items():
            if not fault.during(begins).any():
                sensor = survey.carried[number].name or "the sensor"
                yield f"faults[{place}] does not freeze {sensor}: no sweep begins meanwhile"
    for actor in built.scene.actors:
        first, last = presence_ns(actor.trajectory)
        if first > end[0] or last < 0:
            yield f"{actor.name} is not in the scene during the survey: check its times"
        own = actor.mesh.animation
        if own and not own.repeat and actor.seconds(end)[0][0] > own.duration_s:
            yield (
                f"{actor.name}: its animation of {own.duration_s:.3g} s ends before the survey "
                "does, and its last pose remains: give repeat: true"
            )

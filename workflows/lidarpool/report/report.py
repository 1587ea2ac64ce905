"""Create the report of a run as a dictionary for JSON."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.flight_lines import summarize_flight_lines
from lidarscenario.plan.flight_density import (
    DensityMap,
    cell_side_m,
    longest_side_m,
    summarize_density,
)
from lidarscenario.plan.planning import Search
from lidarscenario.scenario import Scenario
from lidarsim._version import __version__
from lidarsim.columns.table import NO_SURFACE
from lidarsim.io.storage import Storage
from lidarsim.media.weather import Weather
from lidarsim.scene.scene import Scene
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import CloudOptions, Survey

from ..run.pipeline.stage_names import COLLECT, EXPORT, GENERATE, INTERSECT, SORT
from ..run.pipeline.task_book import StageTotals, union
from ..run.planning_trials import TRIAL
from ..run.run_result import RunResult
from .cloud_counts import CloudCounts

ELEVATION_RAYS = 20_000  # number of rays from which the elevation range is computed
# {stage: displayed name}, in the order of the pipeline
STAGES = {
    GENERATE: "generate",
    INTERSECT: "intersect",
    SORT: "sort frames",
    COLLECT: "collect points",
    EXPORT: "export cloud",
    TRIAL: "plan path",
}
_PACKAGES = (
    "numpy", "dask", "distributed", "trimesh", "numba", "open3d-cpu", "open3d",
    "matplotlib", "cupy-cuda12x", "cupy-cuda13x",
)  # fmt: skip
# Entries of the report that `--json` prints.
_SUMMARY_ENTRIES = (
    "backend", "notes", "scans", "sweeps", "rays", "hits", "points", "points_by_object", "seconds",
    "placement_violations", "replayed", "resumed_scans", "flight",
)  # fmt: skip
_MAX_SQUARES = 1000  # maximum number of squares along each side of a planned area
_PLANNING = ("trials", "best_length", "shortest_possible", "collision_free")


def versions() -> dict[str, str]:
    """Return the versions of lidarpool, Python and the main dependencies as {name: version}."""
    result = {"lidarpool": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            result[name] = version(name)
    return result


def make_report(result: RunResult, cloud: CloudCounts) -> dict[str, Any]:
    """Return the report of a run as a dictionary for JSON.

    Lengths are in meters and times are in seconds. Infinite and unknown values are None.
    """
    scene = result.scene
    survey = result.survey
    tasks: dict[str, dict[str, int]] = {}  # {partition: {stage: number of tasks}}
    for stage in result.stages:
        for name, count in stage.resources.items():
            tasks.setdefault(name, {})[stage.stage] = count
    has_materials = any(column.name == "material" for column in cloud.table)
    counts = cloud.by_material.tolist()
    by_material = dict(zip(scene.material_names, counts, strict=True))
    density = cloud.density if survey.coordinates == "world" else None  # also None without points
    return {
        "versions": versions(),
        "identity": dict(result.identity),
        "fields": result.fields,
        "machine": {"system": platform.platform(), "processor": platform.machine()},
        "backend": result.backend,
        "notes": list(result.notes),
        "parameters": _describe_parameters(scene, survey),
        "scans": survey.scan_count,
        "sweeps": survey.sweep_count,
        "rays": result.rays,
        "hits": result.hit_count,
        # The hit counts of a large scene are only read if they are required.
        "hits_on_surfaces": int(result.hit_counts.sum()) if cloud.no_surface else result.hit_count,
        "points": len(result.points),
        "points_by_object": {
            name: int(count)
            for name, count in zip(scene.object_names, cloud.by_object, strict=True)
        }
        | ({NO_SURFACE: cloud.no_surface} if cloud.no_surface else {}),
        "classes": {str(n): {"points": k} for n, k in enumerate(cloud.by_class.tolist()) if k},
        **({"class_names": dict(survey.classes)} if survey.classes else {}),
        **({"points_by_material": by_material} if has_materials else {}),
        "points_per_m2": density and density._asdict(),
        "columns": _describe_columns(cloud),
        "seconds": {
            "total": round(result.seconds, 3),
            "survey": round(result.survey_seconds, 3),
            "planning": round(result.planning_seconds, 3),
            "survey_and_planning_overlap": round(overlap_seconds(result.stages), 3),
        },
        "stages": stage_statistics(result.stages),
        "tasks": tasks,
        "placement_violations": sum(stage.violations for stage in result.stages),
        "misplaced_tasks": [asdict(record) for s in result.stages for record in s.misplaced][:20],
        "replayed": result.replayed,
        "resumed_scans": result.resumed,
        "planning": _describe_planning(result),
    }


def describe_flight(scenario: Scenario | None, scene: Scene, cloud: CloudCounts) -> dict[str, Any]:
    """Compare the density of a cloud with the flight plan of its scenario.

    The result has the entry `flight`, or is empty if there is no plan. The value is None if the
    points are not in world coordinates, or if there are none.
    """
    if scenario is None or scenario.flight is None:
        return {}
    plan = scenario.flight
    found = None
    if scenario.cloud.coordinates == "world" and cloud.point_count:
        squares = cloud.squares(longest_side_m(plan.area) / _MAX_SQUARES)
        squares = squares._replace(corner=squares.corner - scene.world_origin[:2])
        least_m = cell_side_m(plan.density_m2, plan.area)
        counted = DensityMap.from_squares(squares, plan.area, least_m)
        found = summarize_density(counted, plan.density_m2)
    return {"flight": found and found._asdict()}


def summarize_report(folder: Path | Storage, report: dict[str, Any]) -> dict[str, Any]:
    """Return the main statistics and the file paths of a report, as `--json` prints them."""
    planning = report["planning"]
    return {
        "folder": str(folder),
        "files": {name: f"{folder}/{name}" for name in report["files"]},
        **{name: report[name] for name in _SUMMARY_ENTRIES if name in report},
        "planning": planning and {name: planning[name] for name in _PLANNING},
    }


def _describe_parameters(scene: Scene, survey: Survey) -> dict[str, Any]:
    """Describe the scene, sensors and options of a survey."""
    options = declared_values(survey, CloudOptions) | declared_values(survey, Weather)
    del options["columns"]  # the report has a separate entry for the columns
    sensors = [
        _describe_sensor(mounted.sensor)
        | {"returns": asdict(returns), "noise": asdict(mounted.noise or survey.noise)}
        | ({"unseen": list(mounted.unseen)} if mounted.unseen else {})
        for mounted, returns in zip(survey.mounted_sensors, survey.returns_each, strict=True)
    ]
    return {
        "objects": len(scene.object_names),
        "triangles": scene.triangles,
        "origin": scene.origin.tolist(),
        "epsg": survey.epsg,
        "world_origin": scene.world_origin.tolist(),
        "sensor": sensors[0],
        "sensors": {
            mounted.name: sensor
            for mounted, sensor in zip(survey.mounted_sensors, sensors, strict=True)
            if mounted.name
        },
        "actors": [actor.name for actor in scene.actors],
        "poses": survey.path.stations,
        "duration_s": survey.duration_ns / 1e9,
        "trajectory_s": survey.duration_ns / 1e9 if survey.path.moves else None,
        "flight_lines": summarize_flight_lines(survey),
        "steps": survey.steps_each[0],
        "materials": len(survey.materials),
        "navigation": None if survey.navigation is None else asdict(survey.navigation),
        **({"faults": [fault.to_dict() for fault in survey.faults]} if survey.faults else {}),
        **options,
        "start": None if survey.start is None else survey.start.isoformat(),
    }


def _describe_columns(cloud: CloudCounts) -> list[dict[str, Any]]:
    return [
        {
            "name": column.name,
            "file_name": column.in_files,
            "dtype": np.dtype(column.dtype).name,
            "unit": column.unit,
            "meaning": column.meaning,
            "kind": column.kind,
            "lowest": _finite(lower),
            "highest": _finite(upper),
        }
        for column in cloud.table
        for lower, upper in [cloud.limits.get(column.name, (0, 0))]
    ]


def _describe_sensor(sensor: Sensor) -> dict[str, Any]:
    """Describe the beams of a sensor, and the numeric and text properties of its scan head."""
    firings = np.arange(ELEVATION_RAYS // sensor.channels + 1)
    elevations = np.degrees(np.arcsin(sensor.directions(firings)[..., 2].clip(-1, 1)))
    head = {
        name: value
        for name, value in vars(sensor.head).items()
        if not name.startswith("_") and isinstance(value, (int, float, str))
        # The head of a frame-based sensor is only a clock.
        if sensor.cycle != "frame" or name == "rate_hz"
    }
    return {
        "kind": sensor.model,
        "channels": sensor.channels,
        "elevation_deg": [round(float(elevations.min()), 6), round(float(elevations.max()), 6)],
        "head": {"kind": type(sensor.head).__name__, **head},
        "cycle": sensor.cycle,
        "min_range_m": sensor.min_range_m,
        "max_range_m": _finite(sensor.max_range_m),
    }


def stage_statistics(totals: Iterable[StageTotals]) -> dict[str, dict[str, Any]]:
    """Return the tasks, items, task time, elapsed time and workers of each stage."""
    return {
        stage.stage: {
            "partition": stage.partition,
            "tasks": stage.tasks,
            "items": stage.items,
            "task_seconds": round(stage.seconds, 4),
            "span_seconds": round(stage.stop - stage.start, 4),
            "workers": sorted(stage.workers),
        }
        for stage in sort_stages(totals)
    }


def sort_stages(totals: Iterable[StageTotals]) -> list[StageTotals]:
    """Sort stages in the order of the pipeline."""
    return sorted(totals, key=lambda stage: [*STAGES].index(stage.stage))


def overlap_seconds(totals: Iterable[StageTotals]) -> float:
    """Return the time during which casting overlapped with planning trials, in seconds."""
    busy = {stage.stage: union(stage.busy) for stage in totals}
    casting, planning = (busy.get(stage, []) for stage in (INTERSECT, TRIAL))
    return sum(max(0.0, min(a[1], b[1]) - max(a[0], b[0])) for a in casting for b in planning)


def _describe_planning(result: RunResult) -> dict[str, Any] | None:
    """Describe the planning problem and the planned path in world coordinates.

    Return None if no path was planned.
    """
    plan = result.plan
    planning = result.planning
    if plan is None or planning is None:
        return None
    origin = result.scene.origin[:2]
    return {
        "start": (planning.start + origin).tolist(),
        "target": (planning.target + origin).tolist(),
        "obstacles": len(planning.radii),
        **declared_values(planning, Search),
        "trials": plan.trials,
        "collision_free_trials": sum(trial.collision_free for trial in result.trials),
        "best_trial": plan.trial,
        "best_length": plan.length,
        "shortest_possible": _finite(plan.shortest_possible),
        "excess": _finite(plan.excess),
        "clearance": _finite(plan.clearance),
        "collision_free": plan.collision_free,
        "path": (plan.path + origin).tolist(),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

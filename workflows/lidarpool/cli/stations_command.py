"""The `lidarpool stations` command, which plans the stations of a terrestrial scan.

With `--cloud`, the command measures the coverage of an existing scan instead.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarsim.errors import LidarError
from lidarsim.words import join_names, plural, printable

from . import completion
from . import shared_options as options
from .first_step import print_first_step
from .planned_scene import (
    carried_sections,
    comment_lines,
    planned_columns,
    prepared_with_notes,
    sensor_entry,
)
from .shared_options import overwrite

if TYPE_CHECKING:
    from lidarscenario.plan.stations import StationPlan, SurveyCoverage
    from lidarscenario.prepare import PreparedScenario
    from lidarscenario.scenario import Scenario
    from lidarsim.numerics.arrays import Floats
    from lidarsim.sensor import Sensor

    from ..connection.tls_files import TlsFiles

PLAN_FILE = "stations.yaml"
PICTURE_FILE = "stations.png"
_FORMATS = ("laz", "e57")  # formats to which the results of plans are exported
# Options for the computation of a plan in several processes, which can be resumed.
_MAP_OPTIONS = ("resume", "restart", "workers", "scheduler")
_SHOWN_OBJECTS = 12  # maximum number of objects listed individually
_DOMINANT_SHARE = 0.75  # an object with a larger share of the reachable area causes a note
_MIN_REACHABLE_SHARE = 0.25  # a target with a smaller reachable share causes a note


def _parse_percentage(text: str) -> float:
    """Parse a percentage such as 95% or 95."""
    try:
        fraction = float(text.removesuffix("%")) / 100
    except ValueError:
        fraction = math.nan
    if not (0.01 <= fraction <= 1):
        raise click.BadParameter(
            f"{text!r} is not a valid percentage. Expected a value from 1% to 100%, such as 95%."
        )
    return fraction


@click.command(context_settings={"show_default": True})
@click.argument("scene", metavar="MESH|SCENARIO", type=click.Path(path_type=Path))
@click.option(
    "--sensor",
    "model",
    metavar="MODEL|FILE.yaml",
    shell_complete=completion.sensors,
    help="Sensor model, as listed by lidarpool sensors, with or without its manufacturer, or a "
    "sensor file (default: the model in the scenario).",
)
@click.option(
    "--target",
    "targets",
    metavar="NAME",
    multiple=True,
    help=(
        "Object to cover, as a name or a pattern with * and ?; can be repeated (default: all "
        "objects). Other objects only occlude."
    ),
)
@options.path(
    "--cloud",
    "cloud",
    help="Measure the coverage of this result or cloud from the stations in SCENARIO, instead of "
    "choosing stations.",
)
@click.option(
    "--within",
    "within_m",
    default=0.1,
    metavar="M",
    help="With --cloud, maximum distance in meters between a covered surface and a point.",
)
@click.option(
    "--count",
    type=click.IntRange(1, 100),
    help="Number of stations; cannot be combined with --coverage.",
)
@click.option(
    "--coverage",
    type=_parse_percentage,
    metavar="SHARE",
    help=(
        "Add stations until this share of the reachable area is covered, such as 95%; cannot be "
        "combined with --count (default: add stations as long as each adds at least 1%)."
    ),
)
@click.option(
    "--height",
    "height_m",
    type=options.Number(0, min_open=True),
    default=1.7,
    metavar="M",
    help="Height of the instrument above the floor in meters.",
)
@click.option(
    "--spacing",
    "spacing_m",
    type=options.Number(0, min_open=True),
    metavar="M",
    help="Spacing of the candidate positions in meters (default: about 600 candidates).",
)
@click.option(
    "--slant",
    "slant_deg",
    type=options.Number(0, 90, min_open=True),
    default=80.0,
    metavar="DEG",
    help="Maximum angle of incidence in degrees.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Output folder for stations.yaml and stations.png (default: named after the scene).",
)
@options.mesh_reading
@options.scheduler
@options.workers
@options.unfinished("plan")
@overwrite
@options.as_json
def stations(
    scene: Path,
    model: str | None,
    cloud: Path | None,
    of_mesh: dict[str, Any],
    **settings: Any,
) -> None:
    """Choose or evaluate the stations of a terrestrial scan.

    Stations are chosen one by one from candidate positions on the floor. The next station is always
    the candidate that adds the most coverage, which is the covered share of the reachable area. A
    surface is reachable if at least one candidate sees it within the range and the field of view of
    the sensor, and within --slant. The output is a scenario with the stations, and a picture of the
    surfaces that they cover.

    With --cloud, no stations are chosen. Instead, the command measures the coverage of an existing
    scan. The coverage is the share of the area reachable from the stations in SCENARIO that is
    close to a point of the scan. The scan can be a result or any cloud that `lidarpool compare`
    reads.

    \b
    Examples:
      lidarpool stations hall.glb --sensor riegl-vz400 --coverage 95%
      lidarpool stations site.glb --sensor riegl-vz400 --coverage 95% --target "Wall*" --target Roof
      lidarpool stations hall.stl --sensor riegl-vz400 --unit mm --up-axis y
      lidarpool stations hall/scenario.yaml --sensor riegl-vz400 --count 6 --out hall/stations
      lidarpool stations site.glb --sensor riegl-vz400 --spacing 0.5 --workers 8 --resume
      lidarpool stations hall-stations/stations.yaml --cloud hall-scan
    """  # noqa: D301 - Click requires the character \b
    if settings["count"] is not None and settings["coverage"] is not None:
        raise click.UsageError("`--count` and `--coverage` cannot be combined.")
    options.check_workers(settings["workers"], settings["scheduler"])
    options.check_unfinished(resume=settings["resume"], restart=settings["restart"])
    print_first_step("reading the scene", quiet=settings["as_json"])
    from lidarfiles.clouds.folder import check_new_result, result_folder
    from lidarscenario.scenario import Scenario

    within_m = settings.pop("within_m")
    if cloud is not None:
        _reject_planning_options(scene, settings | {"model": model})
        if not within_m > 0:
            raise LidarError(f"`--within` must be greater than 0, but is {within_m:g}.")
        scenario = Scenario.load(scene, of_mesh)
        sight = {key: settings[key] for key in ("slant_deg", "targets")}
        _show_coverage(scenario, cloud, settings["as_json"], within_m=within_m, **sight)
    else:
        out = settings.pop("out")
        folder = Path(f"{scene.stem}-stations") if out is None else out
        start = {name: settings.pop(name) for name in ("resume", "restart")}
        with result_folder(folder):
            files = (PLAN_FILE, PICTURE_FILE)
            check_new_result(folder, files, **start, overwrite=settings.pop("overwrite"))
            scenario = Scenario.load(scene, of_mesh)
            own = scenario.sensor
            if model is None and own.model is None and own.calibration is None:
                raise click.UsageError(
                    f"`--sensor` is required, because {scene} does not specify a sensor model."
                )
            _plan(scene, scenario, model, folder, start, **settings)


def _plan(
    path: Path,
    scenario: Scenario,
    model: str | None,
    folder: Path,
    start: dict[str, bool],
    *,
    scheduler: str | None,
    files: TlsFiles,
    workers: int | None,
    as_json: bool,
    **settings: Any,
) -> None:
    """Choose stations, write them to a scenario and a plot, and print a summary."""
    from lidarfiles.work.work import Inputs, Work
    from lidarscenario.plan.stations import plan_stations, sensor_elevations

    from ..report.result_pictures import draw_stations
    from ..run.cluster.connection import connect_client
    from .terminal import Terminal

    sensor, entry = _planned_sensor(scenario, model, folder)
    sensor_elevations(sensor)  # an unsuitable sensor is reported before the scene is read
    terminal = Terminal(quiet=as_json)
    prepared, notes = prepared_with_notes(scenario, terminal)
    columns = planned_columns(_FORMATS, prepared.survey.materials)
    sections, omissions = carried_sections(scenario, folder, columns)
    if sections.pop("navigation", None):
        omissions.append("`navigation` is omitted, because the stations are separate poses")
    remarks = [f"Warning: {warning}" for warning in terminal.warnings]
    remarks += [f"Note: {note}." for note in omissions]
    scene = prepared.scene.with_world_origin((0, 0, 0))
    others = {str(file): file for file in sorted(scenario.files) if file != path}
    inputs = Inputs(
        {"scene": path, **others},
        {
            "objects and sections": (scene, sections, remarks),
            "sensor": (sensor, entry),
            "options": settings,
        },
    )
    with Work.open(folder, inputs, noun="plan", **start) as work:
        with (
            nullcontext() if scheduler is None else connect_client(scheduler, files) as client,
            terminal.status("computing the visibility from all candidate positions"),
        ):
            plan = plan_stations(
                scene, sensor, client=client, workers=workers, work=work, **settings
            )
        text = _stations_scenario(sections | {"sensor": entry}, plan, settings["targets"], remarks)
        with work.publishing(PLAN_FILE) as staged:
            (staged / PLAN_FILE).write_text(text, "utf-8", newline="\n")
            with terminal.status("drawing the picture"):
                draw_stations(plan).save(staged / PICTURE_FILE)
    omissions += _shortfalls(plan, settings["count"], settings["coverage"])
    _print_plan(plan, prepared, settings["targets"], notes, omissions, as_json)
    if not as_json:
        click.echo(f"stations in {click.format_filename(folder)}: {PLAN_FILE}, {PICTURE_FILE}")
        click.echo(f"next: lidarpool check {shlex.quote(str(folder / PLAN_FILE))}")


def _print_plan(
    plan: StationPlan,
    prepared: PreparedScenario,
    targets: Sequence[str],
    notes: list[str],
    shortfalls: list[str],
    as_json: bool,
) -> None:
    """Print the stations and the covered areas. `notes` have already been printed."""
    if targets:
        more = _unreachable_notes(prepared.scene.names, plan, "candidate positions")
    else:
        more = _target_notes(plan, prepared)
    shortfalls = [*shortfalls, *more]
    figures = _plan_figures(plan, prepared, [*notes, *shortfalls])
    note_lines = map("note: {}".format, shortfalls)
    options.print_results(figures, chain(_plan_lines(plan, prepared, targets), note_lines), as_json)


def _reject_planning_options(scene: Path, settings: dict[str, Any]) -> None:
    """Raise UsageError for options that cannot be combined with `--cloud`."""
    chosen = {
        "--sensor": settings["model"],
        "--out": settings["out"],
        "--count": settings["count"],
        "--coverage": settings["coverage"],
        "--spacing": settings["spacing_m"],
    }
    if unused := [f"`{name}`" for name, value in chosen.items() if value is not None]:
        raise click.UsageError(
            f"{join_names(unused)} cannot be used with `--cloud`, because the stations and the "
            f"sensor are those in {scene}."
        )
    map_options = {f"--{name}": settings[name] for name in _MAP_OPTIONS}
    if unused := [f"`{name}`" for name, value in map_options.items() if value]:
        raise click.UsageError(
            f"{join_names(unused)} cannot be used with `--cloud`, which reads the points in this "
            "process and writes no files."
        )


def _show_coverage(
    scenario: Scenario,
    cloud: Path,
    as_json: bool,
    *,
    within_m: float,
    slant_deg: float,
    targets: Sequence[str],
) -> None:
    """Print how much of the visible area a cloud covers.

    The visible area is the area that can be seen from the stations of the scenario.
    """
    from lidarfiles.clouds.posed_sweeps import PosedSweeps
    from lidarfiles.recordings.opening import open_recording
    from lidarreal.comparing.compared_sweep import compared_in_world
    from lidarreal.comparing.stated_frames import StatedFrame, check_same_systems
    from lidarscenario.plan.stations import survey_coverage

    from .terminal import Terminal

    if scenario.poses is None:
        raise LidarError(
            "`--cloud` requires a scenario with stations, but the scenario has no poses. Use "
            "the file stations.yaml from lidarpool stations, or set `poses` to the stations "
            "of the scan."
        )
    recording = open_recording(cloud)
    terminal = Terminal(quiet=as_json)
    prepared, notes = prepared_with_notes(scenario, terminal)
    if len(prepared.survey.mounted_sensors) > 1:
        raise LidarError(
            "`--cloud` requires a scenario with a single sensor, but the scenario has several."
        )
    heights = (str(system.vertical_datum or "") for system in prepared.findings.systems)
    scene_frame = StatedFrame.from_epsg(
        prepared.survey.epsg, f"the scene of {scenario.source}", next(filter(None, heights), "")
    )
    cloud_frame = StatedFrame.from_recording(recording, recording.info.name)
    more = [*check_same_systems([cloud_frame, scene_frame]), *recording.omission_notes]
    sweeps = PosedSweeps(recording)
    clouds = (compared_in_world(sweeps, number).points for number in range(len(recording)))
    with terminal.status("finding points near the reachable surfaces"):
        coverage = survey_coverage(
            prepared.scene,
            prepared.survey.mounted_sensors[0].sensor,
            _station_positions(prepared),
            clouds,
            targets=targets,
            within_m=within_m,
            slant_deg=slant_deg,
        )
    if not coverage.reachable_m2.any():
        raise LidarError(
            f"No surface{_target_phrase(targets)} is reachable from the stations. Check their "
            "poses and the unit of the scene."
        )
    figures = _coverage_figures(coverage, prepared) | {
        "stations": prepared.survey.path.stations,
        "within_m": within_m,
        "notes": [*notes, *more, *sweeps.notes],
    }
    head = (
        f"{figures['reachable_m2']:,.0f} m²{_target_phrase(targets)} are reachable from "
        f"{plural(figures['stations'], 'station')}, and {figures['covered']:.1%} of this area is "
        f"within {within_m:g} m of a point"
    )
    table = _object_lines(prepared.scene.names, coverage)
    note_lines = map("note: {}".format, more)
    options.print_results(figures, chain([head], table, note_lines), as_json)


def _station_positions(prepared: PreparedScenario) -> Floats:
    """Return the sensor position at each station in world coordinates, in meters.

    The result has shape (s, 3).
    """
    path = prepared.survey.path
    mount = prepared.survey.mounted_sensors[0].mount
    poses = [path.pose(number, 0.0).compose(mount) for number in range(path.stations)]
    return prepared.scene.with_world_origin((0, 0, 0)).origin + [pose.position for pose in poses]


def _coverage_figures(coverage: SurveyCoverage, prepared: PreparedScenario) -> dict[str, Any]:
    """Return the coverage of a cloud as a dictionary for JSON."""
    names = prepared.scene.names
    reachable_m2 = float(coverage.reachable_m2.sum())
    return {
        "reachable_m2": reachable_m2,
        "covered": float(coverage.covered_m2.sum()) / reachable_m2,
        "objects": _object_figures(names, coverage),
    }


def _object_figures(
    names: Sequence[str], areas: StationPlan | SurveyCoverage
) -> dict[str, dict[str, float]]:
    """Return the areas of each target as a dictionary for JSON."""
    kinds = ("area_m2", "reachable_m2", "covered_m2")
    return {
        name: {kind: float(getattr(areas, kind)[index]) for kind in kinds}
        for index, name in enumerate(names)
        if areas.targets[index]
    }


def _target_phrase(targets: Sequence[str]) -> str:
    return f" of {join_names(targets)}" if targets else ""


def _target_notes(plan: StationPlan, prepared: PreparedScenario) -> Iterator[str]:
    """Yield a note if one object accounts for most of the reachable area."""
    reachable_m2 = plan.reachable_m2
    largest = int(reachable_m2.argmax())
    fraction = float(reachable_m2[largest] / reachable_m2.sum())
    if fraction > _DOMINANT_SHARE and (reachable_m2 > 0).sum() > 1:
        yield (
            f"{printable(prepared.scene.names[largest])} accounts for {fraction:.0%} of the "
            "reachable area, so it largely determines the stations. To cover other objects, select "
            "them with `--target`"
        )


def _unreachable_notes(
    names: Sequence[str], areas: StationPlan | SurveyCoverage, positions: str
) -> Iterator[str]:
    """Yield a note about targets whose area is mostly unreachable.

    `positions` describes the positions from which they cannot be reached, such as "stations".
    """
    is_unreachable = areas.targets & (areas.reachable_m2 < _MIN_REACHABLE_SHARE * areas.area_m2)
    order = (-areas.area_m2).argsort(kind="stable")
    few = [
        f"{areas.reachable_m2[k]:,.1f} of {areas.area_m2[k]:,.1f} m² of {printable(names[k])}"
        for k in order[is_unreachable[order]].tolist()
    ]
    if few:
        more = len(few) - _SHOWN_OBJECTS
        shown = few if more <= 0 else [*few[:_SHOWN_OBJECTS], f"little of {more:,} others"]
        yield (
            f"Only {join_names(shown)} {'is' if len(few) == 1 else 'are'} reachable from the "
            f"{positions}, and the coverage does not count the rest. The rest is hidden, out of "
            "range or outside the field of view, or its angle of incidence exceeds `--slant`"
        )


def _shortfalls(plan: StationPlan, count: int | None, coverage: float | None) -> Iterator[str]:
    """Yield notes if a plan has less coverage or fewer stations than the user requested."""
    from lidarscenario.plan.stations import MAX_STATIONS

    reached = float(plan.coverage[-1])
    if coverage is not None and reached < coverage:
        yield (
            f"The coverage of {coverage:.0%} was not reached. The maximum of {MAX_STATIONS} "
            f"stations covers {reached:.1%}. Increase `--height`, `--slant` or `--spacing`"
        )
    if count is not None and len(plan.stations) < count:
        yield (
            f"{len(plan.stations)} of {count} stations already cover all surfaces that are "
            "reachable from the candidate positions"
        )


def _planned_sensor(
    scenario: Scenario, model: str | None, folder: Path
) -> tuple[Sensor, dict[str, Any]]:
    """Return the sensor of a plan, with its section in the planned scenario.

    It is the sensor of the scenario if no model is given. The plan replaces its mount and steps.
    """
    from lidarsim.motion.trajectory import CENTER
    from lidarsim.schema.model_names import full_name
    from lidarsim.sensor.models import load_sensor

    if model is not None:
        model = full_name(model)
        return load_sensor(model), {"model": sensor_entry(model, folder)}
    section = scenario.sensor
    mounted = section.mounted_sensor(scenario.path, CENTER, scenario.noise, scenario.returns)
    entry = scenario.content(folder)["sensor"]
    entry.pop("step_deg", None)
    return mounted.sensor, entry


def _stations_scenario(
    sections: dict[str, Any], plan: StationPlan, targets: Sequence[str], remarks: Sequence[str]
) -> str:
    """Return the text of a scenario file with stations as poses and remarks as comments."""
    import yaml

    poses = [[round(float(part), 3) for part in position] for position in plan.stations]
    data = sections | {"poses": poses, "steps": 36}
    head = (
        f"# {plural(len(plan.stations), 'station')}, in the order in which they were chosen. "
        f"They cover {plan.coverage[-1]:.1%} of the\n# reachable area{_target_phrase(targets)}. "
        "Each station scans one revolution in steps of 10 degrees.\n"
    )
    head += comment_lines(remarks)
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _plan_figures(
    plan: StationPlan, prepared: PreparedScenario, notes: list[str]
) -> dict[str, Any]:
    """Return a station plan as a dictionary for JSON."""
    names = prepared.scene.names
    return {
        "sensor": plan.sight.sensor.model,
        "places": len(plan.candidates),
        "spacing_m": plan.spacing_m,
        "stations": [
            {"position": [round(float(part), 3) for part in position], "coverage": float(fraction)}
            for position, fraction in zip(plan.stations, plan.coverage, strict=True)
        ],
        "objects": _object_figures(names, plan),
        "epsg": prepared.survey.epsg,
        "world_origin": [*prepared.scenario.world.origin],
        "notes": notes,
    }


def _plan_lines(
    plan: StationPlan, prepared: PreparedScenario, targets: Sequence[str]
) -> Iterator[str]:
    """Format the stations and covered areas of a plan as lines of text."""
    names = prepared.scene.names
    yield (
        f"{plural(len(plan.candidates), 'candidate position')} on a grid of "
        f"{plan.spacing_m:g} m, from which {plan.reachable_m2.sum():,.0f} "
        f"m²{_target_phrase(targets)} are reachable (within range, field of view and slant)"
    )
    yield "station        x          y          z   covered     added"
    previous_fraction = 0.0
    rows = zip(plan.stations.tolist(), plan.coverage.tolist(), strict=True)
    for number, ((x, y, z), fraction) in enumerate(rows, 1):
        gain = fraction - previous_fraction
        yield f"{number:7} {x:10,.2f} {y:10,.2f} {z:10,.2f} {fraction:9.1%} {gain:9.1%}"
        previous_fraction = fraction
    yield from _object_lines(names, plan)
    blind = int((plan.targets & (plan.reachable_m2 == 0)).sum())
    if blind:
        yield f"not reachable from any candidate position: {plural(blind, 'object')}"
    yield from options.world_lines(prepared.survey.epsg, prepared.scenario.world.origin)


def _object_lines(names: Sequence[str], areas: StationPlan | SurveyCoverage) -> Iterator[str]:
    """Yield the lines of a table of objects, in descending order of uncovered area."""
    uncovered_m2 = areas.reachable_m2 - areas.covered_m2
    order = (-uncovered_m2).argsort(kind="stable").tolist()
    order = [k for k in order if areas.reachable_m2[k] > 0]
    shown = order[:_SHOWN_OBJECTS]
    labels = [printable(name) for name in names]  # not shortened, so they can be used for --target
    groups = [(labels[k], [k]) for k in shown]
    if further := order[_SHOWN_OBJECTS:]:
        groups.append((f"{len(further):,} others", further))
    width = max(6, *(len(label) for label, _ in groups))
    yield f"{'object':<{width}} {'area':>12} {'reachable':>12}   covered"
    for label, members in groups:
        area, reachable, covered = (
            kind[members].sum() for kind in (areas.area_m2, areas.reachable_m2, areas.covered_m2)
        )
        yield f"{label:<{width}} {area:9,.1f} m² {reachable:9,.1f} m² {covered / reachable:9.1%}"

"""Implementation of the commands `init`, `import`, `check`, `schema`, `scene` and `sensors`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarsim.errors import LidarError
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.sensor_files.format_table import FORMATS
from lidarsim.words import plural

from ..processes.rare_collections import no_collections
from . import completion
from . import shared_options as options
from .first_step import print_first_step
from .shared_options import WARNED, Command, combine, overwrite

if TYPE_CHECKING:
    from distributed import Client

    from lidarsim.io.storage import Storage
    from lidarsim.scene.scene import Scene
    from lidarsim.sensor import Sensor
    from lidarsim.sensor.models import SensorModel

    from ..connection.tls_files import TlsFiles

MAX_COPIED_TRIANGLES = 20_000_000  # limit for file formats without instances
_SENSOR_FORMATS = "File format: " + ", ".join(row.name for row in FORMATS) + "."


@click.command()
@click.argument(
    "folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path(), required=False
)
@options.path("--mesh", "meshes", multiple=True, help="Mesh file to survey; can be repeated.")
@options.mesh_options
@options.flag("--all", "every", help="Write all fields with their defaults and descriptions.")
def init(folder: Path, meshes: tuple[Path, ...], of_mesh: dict[str, Any], every: bool) -> None:
    """Create a scenario file.

    The scenario contains the given options and defaults for everything else. Its JSON Schema is
    written to the same folder, so that editors can complete and check it. An existing scenario is
    not overwritten.

    \b
    Examples:
      lidarpool init
      lidarpool init surveys/hall --mesh hall.stl --unit mm --sensor ouster/os1-64
      lidarpool init every --all
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.advice import advice
    from lidarscenario.prepare import prepare
    from lidarscenario.scenario import Scenario, mesh_data
    from lidarscenario.schema import (
        SCENARIO_FILE,
        SCHEMA_FILE,
        scenario_schema,
        scenario_template,
        schema_text,
        short_scenario,
    )

    if not meshes and {"unit", "up_axis"} & of_mesh.keys():
        raise click.UsageError("`--unit` and `--up-axis` require `--mesh`.")
    target = folder / SCENARIO_FILE
    data = mesh_data(meshes, folder, of_mesh)
    note = ""
    notes = []
    if data and not target.exists():
        # Paths are relative to the working directory, because `folder` may not exist yet.
        content = {"scene": "seed"} | mesh_data(meshes, Path(), of_mesh)
        scenario = Scenario.from_data(content, source=str(target))
        prepared = prepare(scenario, plans=False)
        notes = advice(prepared)
        if (placing := prepared.placement) is not None:
            note = placing.note
            data["poses"] = placing.entries
            data |= {"sensor": dict(placing.grid)} if placing.grid else {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with target.open("x", encoding="utf-8", newline="\n") as file:
            file.write((scenario_template if every else short_scenario)(data, note))
        (folder / SCHEMA_FILE).write_text(
            schema_text(scenario_schema()), encoding="utf-8", newline="\n"
        )
    except FileExistsError as error:
        raise LidarError(
            f"{error.filename} already exists and is not overwritten. Remove it, or pass another "
            "folder: lidarpool init DIR."
        ) from error
    name = click.format_filename(target)
    if meshes:
        listed = ", ".join(click.format_filename(path) for path in meshes)
        click.echo(f"Created {name} for {listed}.")
        for note in notes:
            click.echo(f"note: {note}")
    else:
        click.echo(f"Created {name} for the six objects of the demo.")
        click.echo("To use your own mesh: lidarpool init DIR --mesh FILE [--unit mm]")
    click.echo(f"next: lidarpool check {shlex.quote(str(target))}")


@click.command(name="import")
@click.argument("survey", metavar="SURVEY", type=click.Path(path_type=Path))
@click.option(
    "--assets",
    metavar="DIR",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    multiple=True,
    help="Folder in which references in the survey are resolved; can be repeated (default: the "
    "folder of the survey and its parents).",
)
@options.path("--out", "-o", metavar="DIR", help="Output folder (default: the name of the survey).")
def import_(survey: Path, assets: tuple[Path, ...], out: Path | None) -> None:
    """Convert a survey from another program to a scenario.

    Supported inputs are HELIOS++ surveys and scanners, Gazebo worlds (.sdf, .world) with their
    lidars, MuJoCo models (.xml) with their rangefinders, ray tables of a sensor (.csv, .npz,
    .parquet), OmniLidar prims (.usd, .usda), and formats of installed plug-ins. Features that are
    not supported are printed. Mesh files are referenced, not copied.

    \b
    Examples:
      lidarpool import helios/data/surveys/toyblocks/als_toyblocks.xml
      lidarpool import survey.xml --assets helios/python/pyhelios -o surveys/wood
      lidarpool import worlds/house.sdf --assets models
      lidarpool import robot.xml
      lidarpool import mid360.csv
      lidarpool import scanners_tls.xml#vlp16
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.points.point_scene import surfel_mesh
    from lidarscenario.prepare import prepare
    from lidarscenario.scenario import Scenario
    from lidarscenario.sections import SensorSection
    from lidarscenes.files.formats import WORLDS
    from lidarscenes.gazebo.import_world import import_world
    from lidarscenes.helios import import_scanner, import_survey, is_scanner
    from lidarscenes.mujoco.import_model import import_model
    from lidarscenes.sensors.import_sensor import ENDINGS, import_sensor

    from .import_plugins import (
        SCENARIO_FILE,
        find_importer,
        import_atomically,
        import_with_plugin,
        is_mujoco_model,
    )

    def check(path: Path) -> None:
        prepare(Scenario.load(path))

    folder = out or Path(survey.stem)
    if folder.exists():  # before the survey is read to determine its format
        raise LidarError(f"{folder} already exists. Pass another folder with `--out`.")
    if survey.suffix.lower() in WORLDS:
        unsupported = import_atomically(import_world, survey, folder, assets, check)
    elif is_mujoco_model(survey):
        unsupported = import_atomically(import_model, survey, folder, assets, check)
    elif is_scanner(survey):
        unsupported = import_atomically(import_scanner, survey, folder, assets, check)
    elif (plugin := find_importer(survey)) is not None:
        unsupported = import_with_plugin(plugin, survey, folder, assets, check=check)
    elif survey.suffix.lower() in ENDINGS:
        unsupported = import_atomically(import_sensor, survey, folder, assets, check)
    else:
        unsupported = import_survey(
            survey, folder, assets, check=check, surfels=surfel_mesh
        ).unsupported
    file = folder / SCENARIO_FILE
    scenario = Scenario.load(file)
    own_sensors = len(scenario.sensors) or int(scenario.sensor != SensorSection())
    sensors = plural(own_sensors, "sensor")
    files = plural(len(scenario.scene.files), "mesh file")
    click.echo(f"{click.format_filename(file)}: {sensors}, {files}")
    for line in unsupported:
        click.echo(f"not supported: {line}")
    click.echo(f"next: lidarpool check {shlex.quote(str(file))}")


def _connect(scheduler: str | None, files: TlsFiles) -> AbstractContextManager[Client | None]:
    """Return a context manager that yields a client, or None if there is no scheduler."""
    if scheduler is None:
        return nullcontext()
    from ..run.cluster.connection import connect_client  # imported here because it imports Dask

    return connect_client(scheduler, files)


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@options.mesh_options
@options.out
@options.scheduler
@options.cluster
@options.backend
@options.job
@options.strict
@options.as_json
def check(
    *,
    scenario: Path,
    of_mesh: dict[str, Any],
    out: Path | Storage,
    scheduler: str | None,
    files: TlsFiles,
    cluster: Path | None,
    backend: str | None,
    number: int | None,
    strict: bool,
    as_json: bool,
) -> None:
    """Validate a scenario and estimate points, memory and disk space.

    No workers are started. For a campaign, the varied quantities are listed and five of the jobs
    are checked. If some jobs of a campaign cannot be run, `lidarpool run` completes the others.

    The number of points is estimated by casting a sample of the rays in this process. A warning is
    printed for implausible poses, trajectories and noise. The exit code is 0 if the scenario or all
    checked jobs of the campaign can be run, and 2 otherwise.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check campaign.yaml --job 17
      lidarpool check hall.glb --scheduler tcp://127.0.0.1:8786 --json
      lidarpool check part.stl --unit mm --sensor ouster/os1-64 --pose 0,0,1.9
    """  # noqa: D301 - Click requires the character \b
    print_first_step("reading the scene", quiet=as_json)
    with no_collections():
        from ..run.cluster_file import ClusterFile
        from ..run.options import RunOptions
        from .forecast_text import forecast_scenario

    try:
        file = None if cluster is None else ClusterFile.load(cluster)
        with _connect(scheduler, files) as client:
            run_options = RunOptions(cluster=file)
            figures, lines = forecast_scenario(
                scenario,
                of_mesh,
                number,
                client,
                out,
                run_options,
                backend,
                quiet=as_json,
            )
    except LidarError as error:
        if as_json:
            reasons = {"reasons": [str(error)], "notes": [], "warnings": []}
            options.print_results({"can_run": False, **reasons}, (), True)
        raise
    options.print_results(figures, lines, as_json)
    subject = "scenario" if number is None else "job"
    if figures["reasons"]:
        reasons = figures["reasons"]
        if "checked" in figures:
            raise LidarError("\n".join([_failed_jobs(figures), *reasons]))
        start = f"The {subject} cannot be run{':' if reasons[1:] else '.'}"
        raise LidarError(start + ("\n" if reasons[1:] else " ") + "\n".join(reasons))
    if not as_json:
        words = ["lidarpool", "run", str(scenario), *options.command_arguments(of_mesh)]
        settings: dict[str, object] = {"out": out, "scheduler": scheduler, "cluster": cluster}
        settings |= {"backend": backend, "job": number}
        if figures["occupied"]:
            settings["out"] = _unused_target(out)
        for name, value in settings.items():
            if value is not None and str(value) != "lidarpool-out":
                words += [f"--{name}", str(value)]
        subject = "campaign" if "checked" in figures else subject
        click.echo(f"The {subject} can be run: {shlex.join(words)}")
    if strict and figures["warnings"]:
        sys.exit(WARNED)


def _failed_jobs(figures: dict[str, Any]) -> str:
    """Format the first line of the error message about campaign jobs that cannot run."""
    failed = len(figures["failed"])
    checked = figures["checked"]
    if failed < checked:
        return f"{failed} of {checked} checked jobs cannot be run; the others can."
    return (
        f"None of the {checked} checked jobs can be run."
        if failed > 1
        else "The job cannot be run."
    )


def _unused_target(target: Path | Storage) -> str:
    from lidarsim.io.storage import Storage

    names = (f"{str(target).rstrip('/')}-{number}" for number in count(2))
    return next(name for name in names if not Storage.at(name).entries())


@click.command()
@click.option("--campaign", is_flag=True, help="Print the schema of campaign files.")
@click.option("--vehicle", is_flag=True, help="Print the schema of vehicle files.")
def schema(campaign: bool, vehicle: bool) -> None:
    """Print the JSON Schema of scenario files.

    Editors can use the schema to complete and check scenarios. Visual Studio Code requires the
    extension redhat.vscode-yaml; Vim, Emacs and other editors require yaml-language-server. The
    first line of the scenario must refer to the schema:

    \b
      # yaml-language-server: $schema=scenario.schema.json

    \b
    Examples:
      lidarpool schema > scenario.schema.json
      lidarpool schema --campaign > campaign.schema.json
      lidarpool schema --vehicle > vehicle.schema.json
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.schema import campaign_schema, scenario_schema, schema_text, vehicle_schema

    if campaign and vehicle:
        raise click.UsageError("`--campaign` and `--vehicle` cannot be combined.")
    chosen = campaign_schema if campaign else vehicle_schema if vehicle else scenario_schema
    click.echo(schema_text(chosen()), nl=False)


@click.group(name="scene")
def scene() -> None:
    """Generate a scene, or convert a point cloud to one."""


_out = click.argument("out", type=click.Path(path_type=Path), metavar="OUT.ply|.glb|.obj")


def _generated_scene_options(triangles: int) -> Callable[[Command], Command]:
    """Return a decorator that adds the options shared by all generated scenes."""
    return combine(
        _out,
        overwrite,
        click.option("--triangles", default=triangles, help="Approximate number of triangles."),
        click.option("--seed", default=0, help="Seed of the random generator."),
    )


@scene.command(context_settings={"show_default": True})
@_generated_scene_options(triangles=100_000)
@click.option("--trees", default=0, help="Number of detailed trees, which replace the simple ones.")
@click.option("--cars", default=0, help="Number of detailed cars, which replace the simple ones.")
def city(out: Path, triangles: int, seed: int, overwrite: bool, trees: int, cars: int) -> None:
    """Generate a city with streets, houses, towers, trees and cars.

    The size of the city grows with the number of triangles.

    \b
    Examples:
      lidarpool scene city city.glb
      lidarpool scene city city.ply --triangles 10000000 --seed 7
      lidarpool scene city green.glb --trees 500 --cars 200
    """  # noqa: D301 - Click requires the character \b
    from lidarscenes.procedural.city import city as make

    _write_scene(out, lambda: make(triangles, seed, trees, cars), overwrite, paint=True)


@scene.command(context_settings={"show_default": True})
@_generated_scene_options(triangles=2_000_000)
@click.option("--side", default=1000.0, help="Side length in meters.")
@click.option(
    "--trees", default=0, help="Number of trees, which form woods where the ground is not steep."
)
def terrain(out: Path, triangles: int, seed: int, side: float, overwrite: bool, trees: int) -> None:
    """Generate a square terrain with hills and mountains.

    The resolution of the terrain grows with the number of triangles.

    \b
    Examples:
      lidarpool scene terrain hills.ply
      lidarpool scene terrain small.obj --triangles 20000 --side 100
      lidarpool scene terrain woods.glb --trees 10000
    """  # noqa: D301 - Click requires the character \b
    from lidarscenes.procedural.terrain import terrain as make

    _write_scene(out, lambda: make(triangles, seed, side, trees), overwrite, paint=True)


@scene.command()
@click.option(
    "--voxel-m",
    type=options.Number(),
    help="Voxel size in meters; one point is kept per voxel (default: the point spacing).",
)
@click.option(
    "--size",
    default=1.0,
    show_default=True,
    help="Scale factor of the surfels; larger surfels close gaps but extend further beyond edges.",
)
@click.option(
    "--unit",
    type=click.Choice([*UNITS_M]),
    help="Length unit of the cloud (default: from a .las or .laz file, otherwise m).",
)
@click.option(
    "--epsg",
    type=click.IntRange(1024, 32767),
    metavar="CODE",
    help="Convert the cloud, for example from degrees or Web Mercator, to the coordinate system "
    "with this EPSG code, whose unit must be meters.",
)
@options.flag("--keep-noise", help="Include withheld points and noise.")
@click.option(
    "--color",
    type=click.Choice(["rgb", "intensity"]),
    help="Source of the surfel colors (default: rgb if the cloud has it, otherwise intensity).",
)
@overwrite
@click.argument("cloud", type=click.Path(path_type=Path), metavar="CLOUD")
@_out
def points(cloud: Path, out: Path, overwrite: bool, **settings: Any) -> None:
    """Convert a point cloud to a scene that can be scanned again.

    The z axis of CLOUD must point up. Supported formats are .ply, .pcd, .las, .laz, .e57, .parquet,
    text (.xyz, .txt, .asc, .csv), Leica .pts and .ptx, .npy, and .bin from KITTI or nuScenes.

    \b
    Examples:
      lidarpool scene points scan.ply place.glb
      lidarpool scene points survey.laz place.obj --voxel-m 0.5
      lidarpool scene points scan.xyz place.glb --unit mm
      lidarpool scene points tile.laz place.glb --epsg 32618
      lidarpool scene points stations.e57 place.glb --color intensity
    """  # noqa: D301 - Click requires the character \b
    from lidarscenario.points.point_scene import points_to_scene

    def report(note: str) -> None:
        click.echo(f"note: {note}", err=True)

    def make() -> Scene:
        made = points_to_scene(cloud, report=report, **settings)
        place = made.scene
        if made.gap_note:
            report(f"{cloud}: {made.gap_note}")
        if place.epsg is not None:
            report(f"{out} uses the coordinate system of {cloud}, EPSG:{place.epsg}")
        if out.suffix.lower() != ".glb" and (place.has_colors.any() or place.material_names):
            report(
                f"{out} cannot store the colors and classes of {cloud}. Write a .glb file to "
                "keep them."
            )
        return place

    _write_scene(out, make, overwrite)


def _write_scene(
    file: Path, make: Callable[[], Scene], overwrite: bool, paint: bool = False
) -> None:
    """Create a scene and write it to a file.

    `make` returns the scene. It is only called after the output file has been checked. If `paint`
    is True, colors are added to the scene if the file format supports them.
    """
    from lidarscenes.procedural.paint import paint_scene
    from lidarscenes.writers.scene_file import check_target, write_scene

    check_target(file)
    if file.exists() and not overwrite:
        raise LidarError(f"{file} already exists. Use another name, or pass `--overwrite`.")
    scene = make()
    if file.suffix.lower() == ".glb":  # the only format that can store colors
        scene = paint_scene(scene) if paint else scene
    elif scene.instances and scene.triangles > MAX_COPIED_TRIANGLES:
        raise LidarError(
            f"{file} would contain {scene.triangles:,} triangles, because only .glb files can "
            "store instances. Write a .glb file."
        )
    write_scene(file, scene)
    lower, upper = scene.bounds
    size = " x ".join(f"{length:.0f}" for length in upper - lower)
    click.echo(
        f"{scene.triangles:,} triangles, {plural(len(scene.names), 'object')}, {size} m: "
        f"{click.format_filename(file)}"
    )


@click.command()
@click.argument(
    "model", required=False, metavar="[MODEL|FILE.yaml]", shell_complete=completion.sensors
)
@options.path(
    "--out",
    metavar="FILE",
    help="Export the sensor to FILE. The format is determined by --as or by the file extension; "
    ".png draws the scan pattern.",
    shell_complete=completion.sensor_file,
)
@click.option(
    "--as",
    "file_format",
    metavar="FORMAT",
    help=_SENSOR_FORMATS,
    shell_complete=completion.sensor_formats,
)
@click.option(
    "--seconds",
    type=options.Number(0, 1e6, min_open=True),
    metavar="S",
    help="Duration of the pattern (default: one revolution or frame).",
)
@click.option(
    "--revolutions",
    type=click.IntRange(1, 10_000_000),
    metavar="N",
    help="Number of revolutions or frames, instead of --seconds.",
)
@options.path("--calibration", help="Calibration file of the unit, as in a scenario.")
@click.option(
    "--columns",
    type=click.IntRange(1, 100_000),
    metavar="N",
    help="Columns per revolution, as in a scenario.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=options.Number(),
    metavar="HZ",
    help="Revolutions per second, as rate_hz in a scenario.",
)
@click.option(
    "--min-range",
    "min_range_m",
    type=options.Number(),
    metavar="M",
    help="Minimum range in meters.",
)
@click.option(
    "--max-range",
    "max_range_m",
    type=options.Number(),
    metavar="M",
    help="Maximum range in meters.",
)
@options.overwrite
def sensors(
    model: str | None,
    out: Path | None,
    file_format: str | None,
    seconds: float | None,
    revolutions: int | None,
    overwrite: bool,
    **settings: Any,
) -> None:
    """List the sensor models, or describe or export one of them.

    Exported files contain the rays in firing order; docs/how-to/other-simulators.md describes the
    conventions. Properties that the format cannot store are printed.

    \b
    Examples:
      lidarpool sensors
      lidarpool sensors velodyne/vlp16
      lidarpool sensors velodyne/vlp16 --out vlp16.png
      lidarpool sensors livox/mid360 --seconds 4 --out mid360.csv --as livox
      lidarpool sensors --calibration unit.json --out unit.npz
    """  # noqa: D301 - Click requires the character \b
    from lidarsim.sensor.models import load_sensor

    settings = {name: value for name, value in settings.items() if value is not None}
    writing = [file_format, seconds, revolutions, *settings]
    if out is None and any(value is not None for value in writing):
        raise click.UsageError(
            "The options of `lidarpool sensors` only apply to an exported file. Pass `--out FILE`."
        )
    if model is None and "calibration" not in settings:
        if out is not None:
            raise click.UsageError("Specify the model to export, or pass `--calibration FILE`.")
        _list_models()
        return
    if out is not None and out.exists() and not overwrite:
        raise LidarError(f"{out} already exists. Use another name, or pass `--overwrite`.")
    if model is not None:
        _show_model(model)
    if out is None:
        assert model is not None  # `--calibration` requires `--out`
        command = f"lidarpool sensors {shlex.quote(model)} --out"
        click.echo(f"To draw its pattern: {command} pattern.png")
        click.echo(f"To export its rays: {command} rays.npz")
        return
    sensor = load_sensor(model, **settings)
    if out.suffix.lower() != ".png" or file_format is not None:
        _write_sensor(sensor, out, file_format, seconds, revolutions)
        return
    if seconds is not None or revolutions is not None:
        raise click.UsageError("`--seconds` and `--revolutions` cannot be used with a .png file.")
    from lidarview.render.pattern_picture import draw_pattern

    draw_pattern(out, sensor)
    click.echo(click.format_filename(out))


def _write_sensor(
    sensor: Sensor,
    out: Path,
    file_format: str | None,
    seconds: float | None,
    revolutions: int | None,
) -> None:
    """Export a sensor to a file, and print which properties the file format cannot store."""
    from lidarsim.sensor.export import export_sensor

    file = export_sensor(sensor, out, format=file_format, seconds=seconds, revolutions=revolutions)
    size = plural(len(file.rays), "ray") if len(file.rays) else plural(sensor.channels, "channel")
    click.echo(f"{size}: {click.format_filename(out)}")
    if file.left_out:
        click.echo(f"not stored in the file: {'; '.join(file.left_out)}")


def _list_models() -> None:
    from lidarsim.schema.model_names import model_names, plugin_model_names

    heads = ("model", "channels", "field of view", "range", "rate (Hz)", "points/s")
    rows = [heads, *map(_model_row, (*model_names(), *plugin_model_names()))]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        click.echo("  ".join(map(str.ljust, row, widths)).rstrip())


def _show_model(name: str) -> None:
    """Print the properties of a sensor model and the sources of their values."""
    from lidarsim.schema.model_names import model_names, plugin_model_names
    from lidarsim.sensor.models import format_noise, read_model

    described = read_model(name)
    click.echo(described.name)
    lines = [*described.sources.items()]
    if described.typical:
        lines.insert(
            0, ("rays", "typical pattern; use calibration: FILE for the rays of a specific unit")
        )
    if described.performance is not None:
        sheet = described.datasheet()
        built_in = name in (*model_names(), *plugin_model_names())
        lines.append(
            (
                "data sheet",
                "the noise and returns below apply "
                + ("with performance: datasheet" if built_in else "unless performance is ideal"),
            )
        )
        lines.append(("noise", format_noise(sheet.noise)))
        lines.append(("returns", f"mode: {sheet.returns.mode}, subrays: {sheet.returns.subrays}"))
        lines += [("unknown", ", ".join(sheet.missing))] if sheet.missing else []
    for figure, words in lines:
        click.echo(f"{figure:<11}  {words}")


def _model_row(name: str) -> tuple[str, ...]:
    """Return a sensor model's row in the table that `_list_models` prints."""
    from lidarsim.sensor.models import read_model

    model = read_model(name)
    min_range_m, max_range_m = model.range_m or (0.0, float("inf"))
    rates = dict.fromkeys(model.rates_hz or (model.rate_hz,))
    firings, rate = model.firing_rates(None, None)
    beams = model.beams
    channels = len(beams.elevation_deg) or len(beams.time_us) or 1
    view = _field_of_view(name, model)
    if model.typical:
        view += ", typical"
    rates_text = " to ".join(f"{rate_hz:g}" for rate_hz in rates)
    points = f"{firings * rate * channels:,.0f}"
    ranges = f"{min_range_m:g} to {max_range_m:g} m"
    return name, f"{channels:,}", view, ranges, rates_text, points


def _field_of_view(name: str, model: SensorModel) -> str:
    import numpy as np

    from lidarsim.sensor.models import load_sensor

    elevations_deg = model.beams.elevation_deg
    if model.mirror:
        return f"{model.mirror.width_deg:g}° across track, downward"
    if not model.prisms:
        return f"360° x {min(elevations_deg):.1f}° to {max(elevations_deg):.1f}°"
    x, y, z = load_sensor(name).directions(np.arange(20_000)).reshape(-1, 3).T
    if len(elevations_deg) < 2:
        return f"{2 * np.degrees(np.arccos(x.min())):.1f}° circle, forward"
    lowest, highest = np.degrees(np.arcsin(np.clip([z.min(), z.max()], -1, 1)))
    width = 2 * np.degrees(np.abs(np.arctan2(y, x)).max())
    return f"{width:.0f}° x {lowest:.1f}° to {highest:.1f}°"

"""The commands before a run: scenarios, `lidarpool scene …`, `sensors` and `stations`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from contextlib import nullcontext
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarsim.base.errors import LidarError
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import plural
from lidarsim.sensor_files.format_table import FORMATS

from . import completion
from . import shared_options as options
from .first_step import begin
from .shared_options import WARNED, Command, combine, overwrite

if TYPE_CHECKING:
    from lidarsim.base.storage import Storage
    from lidarsim.scene.scene import Scene
    from lidarsim.sensor import Sensor
    from lidarsim.sensor.models import SensorModel

    from ..base.tls_files import TlsFiles

MAX_COPIED_TRIANGLES = 20_000_000  # limit for files that cannot share triangles
_SENSOR_FORMATS = "Format of the file: " + ", ".join(row.name for row in FORMATS) + "."


@click.command()
@click.argument(
    "folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path(), required=False
)
@options.path(
    "--mesh", "meshes", multiple=True, help="Mesh file to survey; may be given several times."
)
@options.mesh_options
@options.flag("--all", "every", help="Write every field with its default and a description.")
def init(folder: Path, meshes: tuple[Path, ...], of_mesh: dict[str, Any], every: bool) -> None:
    """Write a commented scenario file with your options and poses.

    All other settings have their defaults. The JSON Schema of the scenario is written beside the
    file, so that editors complete and check the scenario. An existing scenario is not overwritten.

    \b
    Examples:
      lidarpool init
      lidarpool init surveys/hall --mesh hall.stl --unit mm --sensor ouster/os1-64
      lidarpool init every --all
    """  # noqa: D301 - click wants the character, not its name
    from ..scenario.advice import advice
    from ..scenario.build import build
    from ..scenario.default_poses import as_entry
    from ..scenario.scenario import Scenario, mesh_data
    from ..scenario.schema import (
        SCENARIO_FILE,
        SCHEMA_FILE,
        scenario_schema,
        scenario_template,
        schema_text,
        short_scenario,
    )

    if not meshes and {"unit", "up_axis"} & of_mesh.keys():
        raise click.UsageError("--unit and --up-axis say how to read a mesh: name it with --mesh.")
    target = folder / SCENARIO_FILE
    data = mesh_data(meshes, folder, of_mesh)
    note = ""
    notes = []
    if data and not target.exists():
        # From here: the scenario's folder need not be there yet.
        content = {"scene": "seed"} | mesh_data(meshes, Path(), of_mesh)
        scenario = Scenario.from_data(content, source=str(target))
        built = build(scenario, plans=False)
        notes = advice(built)
        if (placing := built.placing) is not None:
            note = placing.note
            data["poses"] = [as_entry(pose) for pose in placing.poses]
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
            f"{error.filename} exists, and is not overwritten: name another folder, "
            "lidarpool init DIR, or remove it."
        ) from error
    name = click.format_filename(target)
    if meshes:
        listed = ", ".join(click.format_filename(path) for path in meshes)
        click.echo(f"{name} is a survey of {listed}: change what you like.")
        for note in notes:
            click.echo(f"note: {note}")
    else:
        click.echo(f"{name} is a survey of the six objects of the demo: change what you like.")
        click.echo("for a mesh of your own: lidarpool init DIR --mesh FILE [--unit mm]")
    click.echo(f"next: lidarpool check {shlex.quote(str(target))}")


@click.command(name="import")
@click.argument("survey", metavar="SURVEY", type=click.Path(path_type=Path))
@click.option(
    "--assets",
    metavar="DIR",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    multiple=True,
    help="Folder where references in the survey start; may be given several times.  "
    "[default: the survey's, and those above it]",
)
@options.path(
    "--out", "-o", metavar="DIR", help="Folder for the scenario.  [default: named after the survey]"
)
def import_(survey: Path, assets: tuple[Path, ...], out: Path | None) -> None:
    """Write a survey of another program as a scenario.

    Surveys and scanners of HELIOS++ are read, worlds of Gazebo (.sdf, .world) with their lidars,
    models of MuJoCo (.xml) with their rangefinders, rays of a sensor (.csv, .npz, .parquet),
    OmniLidar prims (.usd, .usda), and surveys for which a plug-in is installed. Unsupported
    features are listed, one line each. Mesh files stay where they are.

    \b
    Examples:
      lidarpool import helios/data/surveys/toyblocks/als_toyblocks.xml
      lidarpool import survey.xml --assets helios/python/pyhelios -o surveys/wood
      lidarpool import worlds/house.sdf --assets models
      lidarpool import robot.xml
      lidarpool import mid360.csv
      lidarpool import scanners_tls.xml#vlp16
    """  # noqa: D301 - click wants the character, not its name
    from lidarscenes.files.formats import WORLDS
    from lidarscenes.gazebo.import_world import import_world
    from lidarscenes.helios import import_scanner, import_survey, is_scanner
    from lidarscenes.mujoco.import_model import import_model
    from lidarscenes.sensors.import_sensor import ENDINGS, import_sensor

    from ..scenario.build import build
    from ..scenario.point_scene import surfels
    from ..scenario.scenario import Scenario
    from ..scenario.sections import SensorSection
    from .import_plugins import SCENARIO_FILE, import_by, import_whole, importer_of, is_mujoco_model

    def check(path: Path) -> None:
        build(Scenario.load(path))

    folder = out or Path(survey.stem)
    if survey.suffix.lower() in WORLDS:
        left_out = import_whole(import_world, survey, folder, assets, check)
    elif is_mujoco_model(survey):
        left_out = import_whole(import_model, survey, folder, assets, check)
    elif is_scanner(survey):
        left_out = import_whole(import_scanner, survey, folder, assets, check)
    elif (plugin := importer_of(survey)) is not None:
        left_out = import_by(plugin, survey, folder, assets, check=check)
    elif survey.suffix.lower() in ENDINGS:
        left_out = import_whole(import_sensor, survey, folder, assets, check)
    else:
        left_out = import_survey(survey, folder, assets, check=check, surfels=surfels).left_out
    file = folder / SCENARIO_FILE
    scenario = Scenario.load(file)
    own_sensors = len(scenario.sensors) or int(scenario.sensor != SensorSection())
    sensors = plural(own_sensors, "sensor")
    files = plural(len(scenario.scene.files), "mesh file")
    click.echo(f"{click.format_filename(file)}: {sensors}, {files}")
    for line in left_out:
        click.echo(f"not supported: {line}")
    click.echo(f"next: lidarpool check {shlex.quote(str(file))}")


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
    """Show the forecast and the needs of a run.

    The scenario is checked; nothing is started. Of a campaign, the values that vary, and five of
    its jobs.

    Some rays are cast here to estimate the number of points. Warnings name poses, trajectories and
    noise that real surveys do not have. The exit code is 0 if it can run, and 2, with the reasons,
    if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check campaign.yaml --job 17
      lidarpool check hall.glb --scheduler tcp://127.0.0.1:8786 --json
      lidarpool check part.stl --unit mm --sensor ouster/os1-64 --pose 0,0,1.9
    """  # noqa: D301 - click wants the character, not its name
    begin("reading the scene", quiet=as_json)
    from ..run.cluster.connection import connected
    from ..run.cluster_file import ClusterFile
    from ..run.options import RunOptions
    from .forecast_text import forecast_scenario

    try:
        file = None if cluster is None else ClusterFile.load(cluster)
        with nullcontext() if scheduler is None else connected(scheduler, files) as client:
            run_options = RunOptions(out=out, cluster=file)
            figures, lines = forecast_scenario(
                scenario,
                of_mesh,
                number,
                client,
                run_options,
                backend,
                quiet=as_json,
            )
    except LidarError as error:
        if as_json:
            reasons = {"reasons": [str(error)], "notes": [], "warnings": []}
            options.show({"can_run": False, **reasons}, (), True)
        raise
    options.show(figures, lines, as_json)
    if figures["reasons"]:
        reasons = figures["reasons"]
        start = "it cannot run:\n" if reasons[1:] else "it cannot run. "
        raise LidarError(start + "\n".join(reasons))
    if not as_json:
        words = ["lidarpool", "run", str(scenario), *options.as_words(of_mesh)]
        settings: dict[str, object] = {"out": out, "scheduler": scheduler, "cluster": cluster}
        settings |= {"backend": backend, "job": number}
        if figures["occupied"]:
            settings["out"] = _free_target(out)
        for name, value in settings.items():
            if value is not None and str(value) != "lidarpool-out":
                words += [f"--{name}", str(value)]
        click.echo(f"it can run: {shlex.join(words)}")
    if strict and figures["warnings"]:
        sys.exit(WARNED)


def _free_target(target: Path | Storage) -> str:
    """Return the name of a free target beside a target that holds another result."""
    from lidarsim.base.storage import Storage

    names = (f"{str(target).rstrip('/')}-{number}" for number in count(2))
    return next(name for name in names if not Storage.at(name).entries())


@click.command()
@click.option("--campaign", is_flag=True, help="Of campaign files.")
def schema(campaign: bool) -> None:
    """Print the JSON Schema of scenario files.

    Editors complete and check scenarios with it.

    Visual Studio Code does with the extension redhat.vscode-yaml, Vim, Emacs and others with
    yaml-language-server, once the first line of a scenario names the schema's file:
    # yaml-language-server: $schema=scenario.schema.json

    \b
    Examples:
      lidarpool schema > scenario.schema.json
      lidarpool schema --campaign > campaign.schema.json
    """  # noqa: D301 - click wants the character, not its name
    from ..scenario.schema import campaign_schema, scenario_schema, schema_text

    click.echo(schema_text(campaign_schema() if campaign else scenario_schema()), nl=False)


@click.group(name="scene")
def scene() -> None:
    """Make scenes as mesh files: generated, or of a point cloud."""


_out = click.argument("out", type=click.Path(path_type=Path), metavar="OUT.ply|.glb|.obj")


def _generated_scene_options(triangles: int) -> Callable[[Command], Command]:
    """Add the output file, the number of triangles, and a seed."""
    return combine(
        _out,
        overwrite,
        click.option("--triangles", default=triangles, help="Approximate number."),
        click.option("--seed", default=0, help="The same seed gives the same scene."),
    )


@scene.command(context_settings={"show_default": True})
@_generated_scene_options(triangles=100_000)
@click.option("--trees", default=0, help="Number of detailed trees, instead of the simple ones.")
@click.option("--cars", default=0, help="Number of detailed cars, instead of the simple ones.")
def city(out: Path, triangles: int, seed: int, overwrite: bool, trees: int, cars: int) -> None:
    """Make a city: streets, houses, towers, trees, cars.

    A city with more triangles is larger.

    \b
    Examples:
      lidarpool scene city city.glb
      lidarpool scene city city.ply --triangles 10000000 --seed 7
      lidarpool scene city green.glb --trees 500 --cars 200
    """  # noqa: D301 - click wants the character, not its name
    from lidarscenes.procedural.city import city as make

    _write(out, lambda: make(triangles, seed, trees, cars), overwrite, paint=True)


@scene.command(context_settings={"show_default": True})
@_generated_scene_options(triangles=2_000_000)
@click.option("--side", default=1000.0, help="Length of a side in metres.")
@click.option("--trees", default=0, help="Number of trees, in woods on ground that is not steep.")
def terrain(out: Path, triangles: int, seed: int, side: float, overwrite: bool, trees: int) -> None:
    """Make a square of hills and mountains.

    A square with more triangles is finer.

    \b
    Examples:
      lidarpool scene terrain hills.ply
      lidarpool scene terrain small.obj --triangles 20000 --side 100
      lidarpool scene terrain woods.glb --trees 10000
    """  # noqa: D301 - click wants the character, not its name
    from lidarscenes.procedural.terrain import terrain as make

    _write(out, lambda: make(triangles, seed, side, trees), overwrite, paint=True)


@scene.command()
@click.option(
    "--voxel-m",
    type=float,
    help="Edge of cubes with one point each; by default the spacing of the points.",
)
@click.option(
    "--size",
    default=1.0,
    show_default=True,
    help="Factor of the surfels' sides: larger ones close gaps, and reach farther beyond edges.",
)
@click.option(
    "--unit",
    type=click.Choice([*UNITS_M]),
    help="Unit of x, y and z; by default that of a .las or .laz, else m.",
)
@click.option(
    "--epsg",
    type=click.IntRange(1024, 32767),
    metavar="CODE",
    help="EPSG code of a system in metres, to which a cloud is brought from the system that it "
    "states: from degrees, or from Web Mercator.",
)
@options.flag("--keep-noise", help="Make surfaces of withheld points and noise, too.")
@click.option(
    "--colour",
    type=click.Choice(["rgb", "intensity"]),
    help="What colours the surfels; by default rgb, else intensity, as the cloud has them.",
)
@overwrite
@click.argument("cloud", type=click.Path(path_type=Path), metavar="CLOUD")
@_out
def points(cloud: Path, out: Path, overwrite: bool, **settings: Any) -> None:
    """Make a scene of a point cloud, Z-up: a scan that can be scanned again.

    CLOUD: .ply, .pcd, .las, .laz, .e57, text (.xyz, .txt, .asc, .csv), .pts or .ptx of Leica, .npy,
    or .bin of KITTI or nuScenes.

    \b
    Examples:
      lidarpool scene points scan.ply place.glb
      lidarpool scene points survey.laz place.obj --voxel-m 0.5
      lidarpool scene points scan.xyz place.glb --unit mm
      lidarpool scene points tile.laz place.glb --epsg 32618
      lidarpool scene points stations.e57 place.glb --colour intensity
    """  # noqa: D301 - click wants the character, not its name
    from ..scenario.point_scene import points_to_scene

    def tell(note: str) -> None:
        click.echo(f"note: {note}", err=True)

    def make() -> Scene:
        made = points_to_scene(cloud, tell=tell, **settings)
        place = made.scene
        if made.gap_note:
            tell(f"{cloud}: {made.gap_note}")
        if place.epsg is not None:
            tell(f"{out} keeps the coordinate system of {cloud}, EPSG:{place.epsg}")
        if out.suffix.lower() != ".glb" and (place.has_colours.any() or place.material_names):
            tell(f"{out} holds no colours and classes: write a .glb to keep those of {cloud}")
        return place

    _write(out, make, overwrite)


def _write(file: Path, make: Callable[[], Scene], overwrite: bool, paint: bool = False) -> None:
    """Make a scene and write the scene to a file.

    `paint` gives a generated scene its colours.
    """
    from lidarscenes.procedural.paint import painted
    from lidarscenes.writers.scene_file import check_target, write_scene

    check_target(file)
    if file.exists() and not overwrite:
        raise LidarError(f"{file} exists: give another name, or --overwrite.")
    scene = make()
    if file.suffix.lower() == ".glb":  # other formats hold no colours
        scene = painted(scene) if paint else scene
    elif scene.instances and scene.triangles > MAX_COPIED_TRIANGLES:
        raise LidarError(
            f"{file} would hold {scene.triangles:,} triangles, because only .glb files have a tree "
            "once for many places: write one."
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
    help="Write the sensor for other programs, in the format of the ending or of --as; .png draws "
    "its pattern.",
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
    type=click.FloatRange(0, 1e6, min_open=True),
    metavar="S",
    help="Duration of the pattern in the file.  [default: one revolution or frame]",
)
@click.option(
    "--revolutions",
    type=click.IntRange(1, 10_000_000),
    metavar="N",
    help="Revolutions or frames in the file instead.",
)
@options.path("--calibration", help="The unit's calibration, as in a scenario.")
@click.option("--columns", type=click.IntRange(1, 100_000), metavar="N", help="As in a scenario.")
@click.option("--rate", "rate_hz", type=float, metavar="HZ", help="rate_hz of a scenario.")
@click.option("--min-range", "min_range_m", type=float, metavar="M", help="As in a scenario.")
@click.option("--max-range", "max_range_m", type=float, metavar="M", help="As in a scenario.")
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
    """List sensor models, show the figures of a model, or write it as a file.

    Files are rays in the order of firing: docs/how-to/other-simulators.md has their conventions.
    What a format does not hold is printed.

    \b
    Examples:
      lidarpool sensors
      lidarpool sensors velodyne/vlp16
      lidarpool sensors velodyne/vlp16 --out vlp16.png
      lidarpool sensors livox/mid360 --seconds 4 --out mid360.csv --as livox
      lidarpool sensors --calibration unit.json --out unit.npz
    """  # noqa: D301 - click wants the character, not its name
    from lidarsim.sensor.models import load_sensor

    settings = {name: value for name, value in settings.items() if value is not None}
    writing = [file_format, seconds, revolutions, *settings]
    if out is None and any(value is not None for value in writing):
        raise click.UsageError("These options are for a file: name it, --out FILE.")
    if model is None and "calibration" not in settings:
        if out is not None:
            raise click.UsageError("Name the model that is to be written, or --calibration FILE.")
        _list_models()
        return
    if model is not None:
        _show_model(model)
    if out is None:
        assert model is not None  # a calibration needs a file
        command = f"lidarpool sensors {shlex.quote(model)} --out"
        click.echo(f"to draw its pattern: {command} pattern.png")
        click.echo(f"for other programs: {command} rays.npz")
        return
    sensor = load_sensor(model, **settings)
    if out.suffix.lower() != ".png" or file_format is not None:
        _write_sensor(sensor, out, overwrite, file_format, seconds, revolutions)
        return
    if seconds is not None or revolutions is not None:
        raise click.UsageError("A picture shows fixed durations: leave the duration out.")
    from lidarview.render.pattern_picture import (
        draw_pattern,  # imports Matplotlib, which figures do not need
    )

    draw_pattern(out, sensor)
    click.echo(click.format_filename(out))


def _write_sensor(
    sensor: Sensor,
    out: Path,
    overwrite: bool,
    file_format: str | None,
    seconds: float | None,
    revolutions: int | None,
) -> None:
    """Write a sensor as a file, and print what the file does not hold."""
    from lidarsim.sensor.export import export_sensor

    if out.exists() and not overwrite:
        raise LidarError(f"{out} exists: give another name, or --overwrite.")
    file = export_sensor(sensor, out, format=file_format, seconds=seconds, revolutions=revolutions)
    size = plural(len(file.rays), "ray") if len(file.rays) else plural(sensor.channels, "channel")
    click.echo(f"{size}: {click.format_filename(out)}")
    if file.left_out:
        click.echo(f"not in the file: {'; '.join(file.left_out)}")


def _list_models() -> None:
    """Print the models with their main figures."""
    from lidarsim.base.model_names import model_names, plugin_model_names

    heads = ("model", "channels", "field of view", "range", "turns a second", "points a second")
    rows = [heads, *map(_row, (*model_names(), *plugin_model_names()))]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        click.echo("  ".join(map(str.ljust, row, widths)).rstrip())


def _show_model(name: str) -> None:
    """Print the figures of a model and their sources."""
    from lidarsim.sensor.models import read_model, shown_noise

    described = read_model(name)
    click.echo(described.name)
    lines = [*described.sources.items()]
    if described.typical:
        lines.insert(0, ("rays", "a typical pattern; calibration: FILE has those of a unit"))
    if described.performance is not None:
        sheet = described.datasheet()
        lines.append(("noise", shown_noise(sheet.noise)))
        lines.append(("returns", f"mode: {sheet.returns.mode}, subrays: {sheet.returns.subrays}"))
        lines += [("unknown", ", ".join(sheet.missing))] if sheet.missing else []
    for figure, words in lines:
        click.echo(f"{figure:<11}  {words}")


def _row(name: str) -> tuple[str, ...]:
    """Return name, channels, field of view, range, rates and points a second of a model."""
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
    """Return the field of view of a model in words."""
    import numpy as np

    from lidarsim.sensor.models import load_sensor

    elevations_deg = model.beams.elevation_deg
    if model.mirror:
        return f"{model.mirror.width_deg:g}° across, below"
    if not model.prisms:
        return f"360° x {min(elevations_deg):.1f}° to {max(elevations_deg):.1f}°"
    x, y, z = load_sensor(name).directions(np.arange(20_000)).reshape(-1, 3).T
    if len(elevations_deg) < 2:
        return f"{2 * np.degrees(np.arccos(x.min())):.1f}° circle ahead"
    lowest, highest = np.degrees(np.arcsin(np.clip([z.min(), z.max()], -1, 1)))
    width = 2 * np.degrees(np.abs(np.arctan2(y, x)).max())
    return f"{width:.0f}° x {lowest:.1f}° to {highest:.1f}°"

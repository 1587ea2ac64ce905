"""The commands before a run: `lidarpool init`, `import`, `check`, `schema` and `scene …`."""

from __future__ import annotations

import os
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..base.errors import LidarpoolError
from ..base.storage import Storage
from ..base.vocabulary import UNITS_M
from ..base.words import counted
from . import options

if TYPE_CHECKING:
    from ..run.connection import TlsFiles


from collections.abc import Callable
from typing import TYPE_CHECKING

from .options import Command, overwrite, together

if TYPE_CHECKING:
    from ..scene.scene import Scene

MOST_COPIED = 20_000_000  # triangles of files that cannot share them
_out = click.argument("out", type=click.Path(path_type=Path), metavar="OUT.ply|.glb|.obj")


@click.command()
@click.argument(
    "folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path(), required=False
)
@click.option(
    "--mesh",
    "meshes",
    metavar="FILE",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Mesh file to survey; may be given several times.",
)
@click.option(
    "--unit",
    type=click.Choice(list(UNITS_M)),
    help="Length unit of these files; by default the one they state, else metres.",
)
@click.option(
    "--up-axis",
    type=click.Choice(["x", "y", "z"]),
    help="Axis of these files that points up; by default the one they state, else z.",
)
def init(folder: Path, meshes: tuple[Path, ...], unit: str | None, up_axis: str | None) -> None:
    """Write a commented scenario file with all defaults.

    Its JSON Schema is written beside it, so that editors complete and check it. An existing
    scenario is not overwritten.

    \b
    Examples:
      lidarpool init
      lidarpool init surveys/hall --mesh hall.stl --unit mm
    """  # noqa: D301 - click wants the character, not its name
    from ..scenario.advice import advice
    from ..scenario.build import build
    from ..scenario.scenario import Scenario
    from ..scenario.schema import SCHEMA_FILE, scenario_schema, schema_text
    from ..scenario.template import SCENARIO_FILE, scenario_template

    if not meshes and (unit or up_axis):
        raise click.UsageError("--unit and --up-axis say how to read a mesh: name it with --mesh.")
    target = folder / SCENARIO_FILE
    entries = [_entry(path, folder, unit, up_axis) for path in meshes]
    placing, notes = None, []
    if meshes and not target.exists():
        there = [e | {"file": str(p.absolute())} for e, p in zip(entries, meshes, strict=True)]
        read = Scenario.from_data({"scene": {"files": there}}, source=str(target))
        built = build(read)
        placing, notes = built.placing, advice(built)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with target.open("x", encoding="utf-8", newline="\n") as file:
            file.write(scenario_template(entries, placing))
        (folder / SCHEMA_FILE).write_text(
            schema_text(scenario_schema()), encoding="utf-8", newline="\n"
        )
    except FileExistsError as error:
        raise LidarpoolError(
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
        click.echo(f"{name} is the default survey: change what you like.")
        click.echo("for a mesh of your own: lidarpool init DIR --mesh FILE [--unit mm]")
    click.echo(f"next: lidarpool check {shlex.quote(str(target))}")


def _entry(path: Path, folder: Path, unit: str | None, up_axis: str | None) -> dict[str, str]:
    """Entry of `scene.files` for a mesh file, relative to the scenario's folder."""
    from ..scene.meshfile import SUFFIXES

    if not path.is_file() or path.suffix.lower() not in SUFFIXES:
        raise LidarpoolError(
            f"{path} has no mesh format that can be read; these can: {' '.join(SUFFIXES)}."
        )
    said = {"file": Path(os.path.relpath(path, folder)).as_posix()}
    return said | {k: v for k, v in (("unit", unit), ("up_axis", up_axis)) if v}


@click.command(name="import")
@click.argument("survey", metavar="SURVEY.xml", type=click.Path(path_type=Path))
@click.option(
    "--assets",
    metavar="DIR",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    multiple=True,
    help="Folder where references in the survey start; may be given several times.  "
    "[default: the survey's, and those above it]",
)
@click.option(
    "--out",
    "-o",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Folder for the scenario.  [default: named after the survey]",
)
def import_(survey: Path, assets: tuple[Path, ...], out: Path | None) -> None:
    """Write a HELIOS++ survey as a scenario.

    Unsupported features are listed, one line each. Mesh files stay where they are.

    \b
    Examples:
      lidarpool import helios/data/surveys/toyblocks/als_toyblocks.xml
      lidarpool import survey.xml --assets helios/python/pyhelios -o surveys/wood
    """  # noqa: D301 - click wants the character, not its name
    from ..importers.helios import import_survey

    made = import_survey(survey, out or Path(survey.stem), assets)
    sensors, files = len(made.scenario.sensors), len(made.scenario.scene.files)
    name = click.format_filename(made.path)
    click.echo(f"{name}: {counted(sensors, 'sensor')}, {counted(files, 'mesh file')}")
    for line in made.left_out:
        click.echo(f"not supported: {line}")
    click.echo(f"next: lidarpool check {shlex.quote(str(made.path))}")


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@options.out
@options.scheduler
@options.cluster
@options.backend
@options.no_plan
@options.job
@options.as_json
def check(
    scenario: Path,
    out: Path | Storage,
    scheduler: str | None,
    files: TlsFiles,
    cluster: Path | None,
    backend: str | None,
    no_plan: bool,
    number: int | None,
    as_json: bool,
) -> None:
    """Show what a run would do and need.

    The scenario is checked; nothing is started. Of a campaign, the values that vary, and five of
    its jobs.

    Some rays are cast here to estimate the number of points. The exit code is 0 if it can run,
    and 2, with the reasons, if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check campaign.yaml --job 17
      lidarpool check hall.glb --no-plan --scheduler tcp://127.0.0.1:8786 --json
    """  # noqa: D301 - click wants the character, not its name
    from ..run.cluster_file import ClusterFile
    from ..run.connection import connected
    from .forecast import look_at

    try:
        file = None if cluster is None else ClusterFile.load(cluster)
        with nullcontext() if scheduler is None else connected(scheduler, files) as client:
            found, lines = look_at(
                scenario, number, client, no_plan=no_plan, quiet=as_json,
                backend=backend, out=out, cluster=file,
            )  # fmt: skip
    except LidarpoolError as error:
        if as_json:
            options.show({"can_run": False, "reasons": [str(error)], "notes": []}, (), True)
        raise
    options.show(found, lines, as_json)
    if found["reasons"]:
        raise LidarpoolError("it cannot run. " + " ".join(found["reasons"]))
    if not as_json:
        words = ["lidarpool", "run", str(scenario)]
        given: dict[str, Any] = {"out": out, "scheduler": scheduler, "cluster": cluster}
        for name, value in (given | {"backend": backend, "job": number}).items():
            wanted = value is not None and str(value) != "lidarpool-out"
            words += [f"--{name}", str(value)] if wanted else []
        click.echo(f"it can run: {shlex.join([*words, *['--no-plan'] * no_plan])}")


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
    """Make scenes as mesh files: generated ones, or of a point cloud."""


def _made(triangles: int) -> Callable[[Command], Command]:
    """Add the output file, the number of triangles, and a seed."""
    return together(
        _out,
        overwrite,
        click.option("--triangles", default=triangles, help="Approximate number."),
        click.option("--seed", default=0, help="The same seed gives the same scene."),
    )


@scene.command(context_settings={"show_default": True})
@_made(triangles=100_000)
@click.option("--trees", default=0, help="Number of detailed trees, instead of the simple ones.")
@click.option("--cars", default=0, help="Number of detailed cars, instead of the simple ones.")
def city(out: Path, triangles: int, seed: int, overwrite: bool, trees: int, cars: int) -> None:
    """Make a city: streets, houses, towers, trees, cars; more triangles make it larger.

    \b
    Examples:
      lidarpool scene city city.glb
      lidarpool scene city city.ply --triangles 10000000 --seed 7
      lidarpool scene city green.glb --trees 500 --cars 200
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.city import city as make

    _write(out, lambda: make(triangles, seed, trees, cars), overwrite)


@scene.command(context_settings={"show_default": True})
@_made(triangles=2_000_000)
@click.option("--side", default=1000.0, help="Length of a side in metres.")
@click.option("--trees", default=0, help="Number of trees, in woods on ground that is not steep.")
def terrain(out: Path, triangles: int, seed: int, side: float, overwrite: bool, trees: int) -> None:
    """Make a square of hills and mountains; more triangles make it finer.

    \b
    Examples:
      lidarpool scene terrain hills.ply
      lidarpool scene terrain small.obj --triangles 20000 --side 100
      lidarpool scene terrain woods.glb --trees 10000
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.terrain import terrain as make

    _write(out, lambda: make(triangles, seed, side, trees), overwrite)


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
@overwrite
@click.argument("cloud", type=click.Path(path_type=Path), metavar="CLOUD.ply|.pcd|.xyz|.las|.laz")
@_out
def points(cloud: Path, out: Path, voxel_m: float | None, size: float, overwrite: bool) -> None:
    """Make a scene of a point cloud, in metres and Z-up: a scan that can be scanned again.

    \b
    Examples:
      lidarpool scene points scan.ply place.glb
      lidarpool scene points survey.laz place.obj --voxel-m 0.5
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.points import scene_of_points

    _write(out, lambda: scene_of_points(cloud, voxel_m=voxel_m, size=size), overwrite)


def _write(out: Path, make: Callable[[], Scene], overwrite: bool) -> None:
    from ..base.errors import LidarpoolError
    from ..base.words import counted
    from ..scene.paint import painted
    from ..scene.scene_file import check_target, write_scene

    check_target(out)
    if out.exists() and not overwrite:
        raise LidarpoolError(f"{out} exists: give another name, or --overwrite.")
    made = make()
    if out.suffix.lower() == ".glb":  # others keep no colours
        made = painted(made)
    elif made.instances and made.triangles > MOST_COPIED:
        raise LidarpoolError(
            f"{out} would hold {made.triangles:,} triangles, because only .glb files have a tree "
            "once for many places: write one."
        )
    write_scene(out, made)
    low, high = made.bounds
    click.echo(
        f"{made.triangles:,} triangles, {counted(len(made.names), 'object')}, "
        f"{' x '.join(f'{length:.0f}' for length in high - low)} m: {click.format_filename(out)}"
    )

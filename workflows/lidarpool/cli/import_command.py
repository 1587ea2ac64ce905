"""The command `lidarpool import`: surveys of other programs as scenarios."""

from __future__ import annotations

import shlex
from pathlib import Path

import click


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
    from ..base.words import counted
    from ..importers.helios import import_survey

    made = import_survey(survey, out or Path(survey.stem), assets)
    sensors, files = len(made.scenario.sensors), len(made.scenario.scene.files)
    name = click.format_filename(made.path)
    click.echo(f"{name}: {counted(sensors, 'sensor')}, {counted(files, 'mesh file')}")
    for line in made.left_out:
        click.echo(f"not supported: {line}")
    click.echo(f"next: lidarpool check {shlex.quote(str(made.path))}")

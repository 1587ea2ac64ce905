"""The commands that help to write a scenario: `lidarpool init` and `lidarpool schema`."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from ..base.errors import LidarpoolError
from ..scenario.schema import SCHEMA_FILE, schema_text
from ..scenario.template import scenario_template
from ..scene.meshfile import SUFFIXES
from ..scene.transform import UNITS_M, UP_AXES

SCENARIO_FILE = "scenario.yaml"


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
    help="Survey this mesh file; may be given several times.",
)
@click.option(
    "--unit",
    type=click.Choice(list(UNITS_M)),
    help="Length unit of these files; by default what they state, else metres.",
)
@click.option(
    "--up-axis",
    type=click.Choice(list(UP_AXES)),
    help="Axis of these files that points up; by default what they state, else z.",
)
def init(folder: Path, meshes: tuple[Path, ...], unit: str | None, up_axis: str | None) -> None:
    """Write a commented scenario file with all defaults into a folder.

    Beside it goes its JSON Schema, with which editors complete and check it. Nothing that is
    there is overwritten.

    \b
    Examples:
      lidarpool init
      lidarpool init surveys/hall --mesh hall.stl --unit mm
    """  # noqa: D301 - click wants the character, not its name
    target = folder / SCENARIO_FILE
    commands = tuple(f"lidarpool {verb} {SCENARIO_FILE}" for verb in ("check", "run"))
    if not meshes and (unit or up_axis):
        raise click.UsageError("--unit and --up-axis say how to read a mesh: name it with --mesh.")
    files = [_entry(path, folder, unit, up_axis) for path in meshes]
    _write_new(
        {
            target: scenario_template(commands, SCHEMA_FILE, files),
            folder / SCHEMA_FILE: schema_text(),
        }
    )
    name = click.format_filename(target)
    if meshes:
        listed = ", ".join(click.format_filename(path) for path in meshes)
        click.echo(f"{name} is a survey of {listed}: change what you like.")
    else:
        click.echo(f"{name} is the default survey: change what you like.")
        click.echo("for a mesh of your own: lidarpool init DIR --mesh FILE [--unit mm]")
    click.echo(f"next: lidarpool check {shlex.quote(str(target))}")


def _entry(path: Path, folder: Path, unit: str | None, up_axis: str | None) -> dict[str, str]:
    """Entry of `scene.files` for a mesh file, named as seen from the scenario's folder."""
    if not path.is_file():
        raise LidarpoolError(f"{path} is not a file: give a mesh file with --mesh.")
    if path.suffix.lower() not in SUFFIXES:
        raise LidarpoolError(
            f"{path} has the ending {path.suffix or '(none)'}, which is not a mesh format that "
            f"can be read; these are: {' '.join(SUFFIXES)}."
        )
    try:
        name = Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive of Windows
        name = path.absolute().as_posix()
    said = {"file": name, "unit": unit, "up_axis": up_axis}
    return {field: value for field, value in said.items() if value}


@click.command()
def schema() -> None:
    """Print the JSON Schema of scenario files, for editors that complete them.

    Visual Studio Code does with the extension redhat.vscode-yaml, Vim, Emacs and others with
    yaml-language-server, once the first line of a scenario names the schema's file:
    # yaml-language-server: $schema=scenario.schema.json

    \b
    Examples:
      lidarpool schema > scenario.schema.json
      lidarpool schema | less
    """  # noqa: D301 - click wants the character, not its name
    click.echo(schema_text(), nl=False)


def _write_new(texts: dict[Path, str]) -> None:
    """Write files that are not there yet, all or none; one that is as it should be may stay.

    Raises
    ------
    LidarpoolError
        If one of them is there with another content, or cannot be written.
    """
    made: list[Path] = []
    try:
        missing = [path for path in texts if not _is_there(path, texts[path])]
        for path in missing:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("x", encoding="utf-8", newline="\n") as file:
                made.append(path)
                file.write(texts[path])
    except OSError as error:
        for path in made:
            path.unlink(missing_ok=True)
        raise LidarpoolError(
            f"{error.filename or made[-1]} cannot be written ({error.strerror}): name a folder "
            "that can, lidarpool init DIR."
        ) from error


def _is_there(path: Path, text: str) -> bool:
    """Whether a file is there with this text; LidarpoolError if it has another one."""
    if not path.exists():
        return False
    # The scenario is the user's as soon as it is there, also while they have not changed it.
    if path.name == SCENARIO_FILE or path.read_bytes() != text.encode():
        raise LidarpoolError(
            f"{path} is there already, and is not overwritten: name another folder, "
            "lidarpool init DIR, or remove it."
        )
    return True

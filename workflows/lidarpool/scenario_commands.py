"""The commands that help to write a scenario: `lidarpool init` and `lidarpool schema`."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from .errors import LidarpoolError
from .schema import SCHEMA_FILE, schema_text
from .template import scenario_template

SCENARIO_FILE = "scenario.yaml"


@click.command()
@click.argument(
    "folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path(), required=False
)
def init(folder: Path) -> None:
    """Write a commented scenario file with all defaults into a folder.

    Beside it goes its JSON Schema, with which editors complete and check it. Nothing that is
    there is overwritten.

    \b
    Examples:
      lidarpool init
      lidarpool init surveys/hall
    """  # noqa: D301 - click wants the character, not its name
    target = folder / SCENARIO_FILE
    commands = tuple(f"lidarpool {verb} {SCENARIO_FILE}" for verb in ("check", "run"))
    _write_new(
        {
            target: scenario_template(commands, SCHEMA_FILE),
            folder / SCHEMA_FILE: schema_text(),
        }
    )
    click.echo(f"{click.format_filename(target)} is the default survey: change what you like.")
    click.echo(f"next: lidarpool check {shlex.quote(str(target))}")


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

"""The command `lidarpool plot`: draw the pictures of a finished result again."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from ..base.errors import LidarpoolError
from ..base.vocabulary import PICTURES


def _size(ctx: click.Context, param: click.Parameter, value: Any) -> tuple[int, int]:
    """Parse width and height in pixels from a text such as 1600x1000."""
    if found := re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", value):
        return int(found[1]), int(found[2])
    raise click.BadParameter(
        f"{value!r} is not a picture size: give width x height in pixels, such as 1600x1000."
    )


@click.command()
@click.argument("result", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option(
    "--only",
    type=click.Choice(PICTURES),
    multiple=True,
    help="Picture to draw; may be given several times.  [default: all]",
)
@click.option(
    "--size",
    callback=_size,
    metavar="WxH",
    default="1600x1000",
    show_default=True,
    help="Width and height in pixels.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the pictures.  [default: FOLDER]",
)
@click.option(
    "--colour",
    metavar="COLUMN",
    default="z",
    show_default=True,
    help="Column to colour the points of the cloud by.",
)
def plot(
    result: Path, only: tuple[str, ...], size: tuple[int, int], out: Path | None, colour: str
) -> None:
    """Draw the pictures of a result again.

    \b
    Examples:
      lidarpool plot lidarpool-out
      lidarpool plot lidarpool-out --only cloud --colour intensity --size 2400x1500 --out figures
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..report.pictures import draw_pictures
    from ..run.picture_file import PICTURE_FILE, Pictured

    if not (result / PICTURE_FILE).exists():
        raise LidarpoolError(
            f"{result} holds no {PICTURE_FILE}, the data of the pictures: give the "
            "folder of a finished run (its --out)."
        )
    keep_freed_memory()
    shown = Pictured.load(result / PICTURE_FILE)
    for path in draw_pictures(shown, result / "cloud.ply", out or result, only, size, colour):
        click.echo(click.format_filename(path))

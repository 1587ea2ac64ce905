"""The command `lidarpool plot`: draw the pictures of a finished result again."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..base.errors import LidarpoolError
from ..base.vocabulary import PICTURES
from . import options

if TYPE_CHECKING:
    from ..base.storage import Storage


def _size(ctx: click.Context, param: click.Parameter, value: Any) -> tuple[int, int]:
    """Parse width and height in pixels from a text such as 1600x1000."""
    if found := re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", value):
        return int(found[1]), int(found[2])
    raise click.BadParameter(
        f"{value!r} is not a picture size: give width x height in pixels, such as 1600x1000."
    )


@click.command()
@options.result
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
@options.copies
@click.option(
    "--colour",
    metavar="COLUMN",
    default="z",
    show_default=True,
    help="Column to colour the points of the cloud by; rgb for red, green and blue.",
)
def plot(
    result: Path | Storage,
    only: tuple[str, ...],
    size: tuple[int, int],
    out: Path | Storage | None,
    colour: str,
) -> None:
    """Draw the pictures of a result again.

    \b
    Examples:
      lidarpool plot lidarpool-out
      lidarpool plot lidarpool-out --only cloud --colour intensity --size 2400x1500 --out figures
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..export.folder import local_folder, local_result, send
    from ..report.pictures import draw_pictures
    from ..run.picture_file import PICTURE_FILE, Pictured

    place = result if out is None else out
    with local_result(result, (PICTURE_FILE, "cloud.ply")) as made:
        if not (made / PICTURE_FILE).exists():
            raise LidarpoolError(
                f"{result} holds no {PICTURE_FILE}, the data of the pictures: give the "
                "folder of a finished run (its --out)."
            )
        keep_freed_memory()
        shown, cloud = Pictured.load(made / PICTURE_FILE), made / "cloud.ply"
        with local_folder(place) as folder:
            for path in draw_pictures(shown, cloud, folder, only, size, colour):
                click.echo(click.format_filename(send(path, place)))

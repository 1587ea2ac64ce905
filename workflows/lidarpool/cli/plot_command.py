"""The command `lidarpool plot`: the pictures of a finished result, drawn again."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from ..base.errors import LidarpoolError
from ..export.ply import read_positions
from ..run.picture_file import PICTURE_FILE, PICTURES, Pictured

CLOUD = "cloud.ply"
FORMATS = ("png", "pdf")
# Endings of pictures that one may ask for in vain, rather than of folders.
OTHER_FORMATS = frozenset({"eps", "gif", "jpeg", "jpg", "ps", "svg", "tif", "tiff", "webp"})
SIDE_LEAST, SIDE_MOST = 480, 4096  # letters need some pixels; each takes 0.4 kB of memory
SIDES_RATIO = 2  # at most, or legends do not fit


class PictureSize(click.ParamType[tuple[int, int]]):
    """Width and height in pixels, such as 1600x1000."""

    name = "size"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """Take a text apart."""
        if isinstance(value, tuple):
            return value
        found = re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", value)
        size = (int(found[1]), int(found[2])) if found else (0, 0)
        least, most = min(size), max(size)
        if least < SIDE_LEAST or most > SIDE_MOST or most > SIDES_RATIO * least:
            self.fail(
                f"{value!r} is no size for a picture: give width x height in pixels, each "
                f"{SIDE_LEAST} to {SIDE_MOST}, one at most twice the other, such as 1600x1000.",
                param,
                ctx,
            )
        return size


@click.command()
@click.argument("result", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option(
    "--only",
    type=click.Choice(PICTURES),
    multiple=True,
    help="Draw this one; may be given several times.  [default: all]",
)
@click.option("--dark", is_flag=True, help="Dark pages; their files end in -dark.")
@click.option(
    "--size",
    type=PictureSize(),
    metavar="WxH",
    default="1600x1000",
    show_default=True,
    help="Width and height in pixels.",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(FORMATS),
    help="Kind of file; by default png, or as --out ends.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder for the pictures, or the file of a single one.  [default: FOLDER]",
)
def plot(
    result: Path,
    only: tuple[str, ...],
    dark: bool,
    size: tuple[int, int],
    kind: str | None,
    out: Path | None,
) -> None:
    """Draw the pictures of a finished result again: scene, intensity, cloud and path.

    \b
    Examples:
      lidarpool plot lidarpool-out --dark
      lidarpool plot lidarpool-out --only cloud --size 2400x1500 --out cloud.pdf
    """  # noqa: D301 - click wants the character, not its name
    # Matplotlib is a second that --help can do without.
    from ..report.pictures import picture_makers

    shown = _pictured(result)
    makers = picture_makers(
        shown, lambda: _points(result / CLOUD), only or PICTURES, size=size, dark=dark
    )
    _check_all_there(only, makers, result)
    for name, path in _targets(list(makers), dark, kind, result if out is None else out):
        makers[name](path)
        click.echo(click.format_filename(path))


def _pictured(folder: Path) -> Pictured:
    file = folder / PICTURE_FILE
    if not folder.is_dir():
        there = "is a file" if folder.exists() else "does not exist"
        raise LidarpoolError(f"{folder} {there}: give the folder of a finished run (its --out).")
    if not file.exists():
        earlier = (folder / "report.json").exists()
        raise LidarpoolError(
            f"{folder} holds no {PICTURE_FILE}, which the pictures are drawn from: "
            + (
                "its run was by an earlier version; run it again (report.html says how)."
                if earlier
                else "give the folder of a finished run (its --out)."
            )
        )
    return Pictured.load(file)


def _points(path: Path) -> tuple[Any, int]:
    """Points of a cloud as they are drawn: few enough, and how many there are."""
    from ..render.cloud_picture import MOST_POINTS

    return read_positions(path, MOST_POINTS)


def _check_all_there(only: Sequence[str], makers: dict[str, Callable[..., Any]], at: Path) -> None:
    """Refuse a picture that was asked for and that there is not."""
    if missing := [name for name in only if name not in makers]:
        raise LidarpoolError(
            f"{at} has no picture {missing[0]!r}, since its run planned no path: choose from "
            f"{', '.join(name for name in PICTURES if name not in missing)}."
        )


def _targets(names: list[str], dark: bool, kind: str | None, out: Path) -> list[tuple[str, Path]]:
    """File of each picture; folders are made."""
    ending = out.suffix.lower().removeprefix(".")
    if ending in FORMATS and not out.is_dir():
        if len(names) != 1:
            raise LidarpoolError(
                f"{out} is one file, for {len(names)} pictures: choose one with --only, such as "
                f"--only {names[0]}, or give a folder with --out."
            )
        if kind not in (None, ending):
            raise LidarpoolError(f"{out} ends in .{ending}, and --format is {kind}: drop one.")
        return [(names[0], out)]
    if ending in OTHER_FORMATS and not out.is_dir():
        raise LidarpoolError(
            f"{out} ends in .{ending}, which is not drawn: give a file that ends in "
            f"{' or '.join(f'.{name}' for name in FORMATS)}, or a folder."
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LidarpoolError(
            f"The folder {out} cannot be made ({error.strerror or error}): give another folder "
            "with --out, or a file that ends in .png or .pdf."
        ) from error
    return [(name, out / f"{name}{'-dark' * dark}.{kind or FORMATS[0]}") for name in names]

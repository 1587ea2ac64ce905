"""The command `lidarpool export`: the cloud of a finished result in other formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..base.errors import LidarpoolError
from ..export.table import EXPORTS, LAYOUTS
from . import options

if TYPE_CHECKING:
    from ..base.storage import Storage


@click.command()
@options.result
@click.option(
    "--format",
    "-f",
    "formats",
    type=click.Choice(list(EXPORTS)),
    multiple=True,
    required=True,
    help="Format to write; may be given several times.",
)
@click.option(
    "--layout",
    type=click.Choice(list(LAYOUTS)),
    default="velodyne",
    show_default=True,
    help="Layout of points in mcap and rosbag2.",
)
@options.copies
@options.overwrite
def export(
    result: Path | Storage,
    formats: tuple[str, ...],
    layout: str,
    out: Path | Storage | None,
    overwrite: bool,
) -> None:
    """Write the cloud of a finished result in other formats.

    \b
    Examples:
      lidarpool export lidarpool-out --format laz
      lidarpool export lidarpool-out --format mcap --layout autoware --out bags
    """  # noqa: D301 - click wants the character, not its name
    from ..base.storage import Storage
    from ..columns.cloud_file import CloudFile
    from ..export.folder import local_result, result_folder, send
    from ..export.formats import Format
    from ..export.navigation import FILES as INSTRUMENT_FILES
    from ..export.sweeps import SWEEPS_FILE, Sweeps

    # The report of a result is moved into place last.
    needed = ("cloud.ply", SWEEPS_FILE, "report.json")
    place = result if out is None else out
    if isinstance(result, Path) and result.is_file():
        raise LidarpoolError(f"{result} is a file: give its folder, {result.parent}.")
    with local_result(result, (*needed, *INSTRUMENT_FILES)) as made:
        for name in needed:
            if not (made / name).exists():
                raise LidarpoolError(
                    f"{result} holds no {name}: give the folder of a finished run (its --out); "
                    "lidarpool run --resume continues an unfinished one."
                )
        sweeps = Sweeps.load(made / SWEEPS_FILE)
        cloud = CloudFile(made / "cloud.ply")
        wanted = [Format(name, layout) for name in dict.fromkeys(formats)]
        written: list[str] = []
        with result_folder(place) as folder:
            for one in wanted:  # before any is written, which may take long
                one.check(folder / one.file, cloud, overwrite=overwrite)
                if isinstance(place, Storage) and not overwrite and one.file in place.entries():
                    raise LidarpoolError(
                        f"{place.path(one.file)} is there already: give another place with --out, "
                        "or --overwrite."
                    )
            try:
                for one in wanted:
                    one.write(folder / one.file, cloud, sweeps, overwrite=overwrite)
                    written.append(click.format_filename(send(folder / one.file, place)))
                    for note in one.notes(cloud):
                        click.echo(f"note: {note}", err=True)
                    click.echo(written[-1])
            except (LidarpoolError, KeyboardInterrupt) as error:
                if written:
                    error.add_note(f"Written before: {', '.join(written)}.")
                raise

"""The command `lidarpool export`: the cloud of a finished result in other formats."""

from __future__ import annotations

from pathlib import Path

import click

from ..base.errors import LidarpoolError
from ..base.vocabulary import FORMATS, LAYOUTS


@click.command()
@click.argument("result", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "-f",
    "formats",
    type=click.Choice(list(FORMATS)),
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
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the files.  [default: FOLDER]",
)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
def export(
    result: Path, formats: tuple[str, ...], layout: str, out: Path | None, overwrite: bool
) -> None:
    """Write the cloud of a finished result in other formats.

    \b
    Examples:
      lidarpool export lidarpool-out --format laz
      lidarpool export lidarpool-out --format mcap --layout autoware --out bags
    """  # noqa: D301 - click wants the character, not its name
    from ..export.cloud_file import CloudFile
    from ..export.folder import result_folder
    from ..export.formats import Format
    from ..export.sweeps import SWEEPS_FILE, Sweeps

    # The report of a result is moved into place last.
    for name in ("cloud.ply", SWEEPS_FILE, "report.json"):
        if not (result / name).exists():
            raise LidarpoolError(
                f"{result} holds no {name}: give the folder of a finished run (its --out); "
                "lidarpool run --resume continues an unfinished one."
            )
    sweeps = Sweeps.load(result / SWEEPS_FILE)
    cloud = CloudFile(result / "cloud.ply")
    wanted = [Format(name, layout) for name in dict.fromkeys(formats)]
    written: list[str] = []
    with result_folder(result if out is None else out) as folder:
        for one in wanted:  # before any is written, which may take long
            one.check(folder / one.file, cloud, overwrite=overwrite)
        try:
            for one in wanted:
                one.write(folder / one.file, cloud, sweeps, overwrite=overwrite)
                written.append(click.format_filename(folder / one.file))
                for note in one.notes(cloud):
                    click.echo(f"note: {note}", err=True)
                click.echo(written[-1])
        except (LidarpoolError, KeyboardInterrupt) as error:
            if written:
                error.add_note(f"Written before: {', '.join(written)}.")
            raise

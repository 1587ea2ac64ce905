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
    help="Write this one; may be given several times.",
)
@click.option(
    "--layout",
    type=click.Choice(list(LAYOUTS)),
    default="velodyne",
    show_default=True,
    help="Of the points of mcap and rosbag2.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Folder.  [default: FOLDER]"
)
@click.option("--overwrite", is_flag=True, help="Replace what is there.")
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
    from ..export.formats import Format
    from ..export.sweeps import SWEEPS_FILE, Sweeps

    if not (result / SWEEPS_FILE).exists():
        raise LidarpoolError(
            f"{result} holds no {SWEEPS_FILE}: give the folder of a finished run (its --out)."
        )
    sweeps = Sweeps.load(result / SWEEPS_FILE)
    cloud = CloudFile(result / "cloud.ply")
    out = result if out is None else out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LidarpoolError(
            f"The folder {out} cannot be made ({error.strerror}): give another with --out."
        ) from error
    wanted = [Format(name, layout) for name in formats]
    for one in wanted:  # before the first of them takes its time
        one.check(out / one.file, cloud, overwrite=overwrite)
    for one in wanted:
        one.write(out / one.file, cloud, sweeps, overwrite=overwrite)
        if left := one.left_out(cloud):
            click.echo(f"note: {one.name} does not hold {', '.join(left)}", err=True)
        click.echo(click.format_filename(out / one.file))

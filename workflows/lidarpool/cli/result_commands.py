"""The commands for results and recordings: `plot`, `export`, `view`, `compare` and `fit`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import click

from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from lidarsim.base.vocabulary import PICTURES, UNITS_M

from ..export.format_table import EXPORTS, FORMATS, LAYOUTS
from . import shared_options as options


def _size(text: str) -> tuple[int, int]:
    """Parse width and height in pixels from a text such as 1600x1000."""
    if found := re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", text):
        return int(found[1]), int(found[2])
    raise click.BadParameter(
        f"{text!r} is not a picture size: give width x height in pixels, such as 1600x1000."
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
    type=_size,
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
def plot(result: Path | Storage, out: Path | Storage | None, **given: Any) -> None:
    """Draw the pictures of a result, also into its report.html.

    \b
    Examples:
      lidarpool plot lidarpool-out
      lidarpool plot lidarpool-out --only cloud --colour intensity --size 2400x1500 --out figures
    """  # noqa: D301 - click wants the character, not its name
    from lidarview.picture_file import PICTURE_FILE, PictureContent

    from ..base.fork_server import keep_freed_memory
    from ..export.folder import local_folder, local_result, send
    from ..report.output import CLOUD, PAGE
    from ..report.result_pictures import draw_pictures

    place = result if out is None else out
    with local_result(result, (PICTURE_FILE, CLOUD, PAGE)) as made:
        if not (made / PICTURE_FILE).exists():
            raise LidarError(
                f"{result} holds no {PICTURE_FILE}, the data of the pictures: give the "
                "folder of a finished run (its --out)."
            )
        keep_freed_memory()
        shown = PictureContent.load(made / PICTURE_FILE)
        with nullcontext(made) if out is None else local_folder(out) as folder:
            for path in draw_pictures(shown, made, folder, **given):
                click.echo(click.format_filename(send(path, place)))
            if out is None and (made / PAGE).exists():
                send(made / PAGE, place)


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
@click.option(
    "--compensated",
    is_flag=True,
    help="Points of mcap, rosbag2 and pcd at the start of the sweep, without their times.",
)
@options.copies
@options.overwrite
def export(
    result: Path | Storage,
    formats: tuple[str, ...],
    layout: str,
    compensated: bool,
    out: Path | Storage | None,
    overwrite: bool,
) -> None:
    """Write the cloud of a finished result in other formats.

    \b
    Examples:
      lidarpool export lidarpool-out --format laz
      lidarpool export lidarpool-out --format mcap --layout autoware --out bags
    """  # noqa: D301 - click wants the character, not its name
    from lidarsim.columns.cloud_file import CloudFile
    from lidarsim.sweeps.instruments import INSTRUMENT_FILES
    from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

    from ..export.folder import local_result, result_folder, send
    from ..export.formats import Format

    # The report of a result is moved into place last.
    needed = ("cloud.ply", SWEEPS_FILE, "report.json")
    place = result if out is None else out
    if isinstance(result, Path) and result.is_file():
        raise LidarError(f"{result} is a file: give its folder, {result.parent}.")
    with local_result(result, (*needed, *INSTRUMENT_FILES)) as made:
        for name in needed:
            if not (made / name).exists():
                raise LidarError(
                    f"{result} holds no {name}: give the folder of a finished run (its --out); "
                    "lidarpool run --resume continues an unfinished one."
                )
        sweeps = Sweeps.load(made / SWEEPS_FILE)
        cloud = CloudFile(made / "cloud.ply")
        # As the layout, for the formats that have the option; refused if none has.
        choosing = {name for name in formats if FORMATS[name].raw_or_compensated} or {*formats}
        wanted = [
            Format(name, layout, compensated and name in choosing)
            for name in dict.fromkeys(formats)
        ]
        written: list[str] = []
        with result_folder(place) as folder:
            for one in wanted:  # before any is written, which may take long
                one.check(folder / one.row.file, cloud, overwrite=overwrite)
                if isinstance(place, Storage) and not overwrite and one.row.file in place.entries():
                    raise LidarError(
                        f"{place.path(one.row.file)} is there already: give another place with "
                        "--out, or --overwrite."
                    )
            try:
                for one in wanted:
                    one.write(folder / one.row.file, cloud, sweeps, overwrite=overwrite)
                    written.append(click.format_filename(send(folder / one.row.file, place)))
                    for note in one.notes(cloud, sweeps):
                        click.echo(f"note: {note}", err=True)
                    click.echo(written[-1])
            except (LidarError, KeyboardInterrupt) as error:
                if written:
                    error.add_note(f"Written before: {', '.join(written)}.")
                raise


@click.command()
@click.argument("results", metavar="RESULT...", type=options.StoragePath(), nargs=-1, required=True)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1, or the next free one; 0 for any.",
)
@options.flag("--no-browser", help="Only print the address.")
@options.new_file("--film", help="Write a .gif or .webp instead: along a drive, or all around.")
@options.new_file("--export", help="Write the page as one .html instead, of at most 25 MB.")
def view(
    results: Sequence[Path | Storage],
    port: int,
    no_browser: bool,
    film: Path | None,
    export: Path | None,
) -> None:
    """Show a result or a cloud in the browser, or write it as a file to share.

    Several results are shown in one view, with a colour each.

    \b
    Examples:
      lidarpool view lidarpool-out
      lidarpool view lidarpool-out/cloud.ply --no-browser
      lidarpool view before after
      lidarpool view drive --film drive.gif --export drive.html
    """  # noqa: D301 - click wants the character, not its name
    from lidarsim.sweeps.sweeps import SWEEPS_FILE
    from lidarview.picture_file import PICTURE_FILE
    from lidarview.viewer.sharing import share
    from lidarview.viewer.view import CLOUD, open_results, show_view

    from ..export.folder import local_result
    from .terminal import Terminal

    if (film or export) and len(results) > 1:
        raise LidarError("--film and --export take one result: give them one after the other.")
    with ExitStack() as stack:
        files = (CLOUD, PICTURE_FILE, SWEEPS_FILE)
        made = [stack.enter_context(local_result(result, files)) for result in results]
        if film or export:
            share(made[0], film, export, Terminal())
        else:
            show_view(open_results(made), port=port, browser=not no_browser)


@click.command()
@click.argument("a", metavar="A", type=click.Path(path_type=Path))
@click.argument("b", metavar="B", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("lidarpool-compare"),
    show_default=True,
    help="Folder for compare.html, compare.json and pictures; earlier ones are replaced.",
)
@click.option("--sweep", "sweeps", type=int, multiple=True, help="Compare only this pair, from 0.")
@click.option(
    "--match",
    type=click.Choice(["order", "time"]),
    default="order",
    show_default=True,
    help="Which sweeps belong together.",
)
@click.option("--sensor-a", metavar="NAME", help="Sensor of A, or topic of a bag, of several.")
@click.option("--sensor-b", metavar="NAME", help="The same of B.")
@click.option("--intensity-a", metavar="COLUMN", help="Column of A to compare as intensity.")
@click.option("--intensity-b", metavar="COLUMN", help="The same of B.")
@click.option(
    "--unit-a",
    type=click.Choice([*UNITS_M]),
    help="Unit of A; by default that of a .las or .laz, else m.",
)
@click.option("--unit-b", type=click.Choice([*UNITS_M]), help="The same of B.")
@click.option("--azimuth-deg", type=float, help="Width of a cell; by default the step of pulses.")
@click.option(
    "--distance",
    "distances_m",
    type=float,
    metavar="METRES",
    multiple=True,
    default=(0.05, 0.1, 0.2, 0.5),
    show_default=True,
    help="Distance for the F-score; may be given several times.",
)
@click.option(
    "--most-points",
    type=int,
    default=10_000_000,
    show_default=True,
    help="Points of a cloud without sweeps that are held in memory.",
)
@options.as_json
def compare(a: Path, b: Path, out: Path, as_json: bool, **given: Any) -> None:
    """Compare two clouds or recordings of the same place; B is the reference.

    A and B: results, data sets, .ply, .pcd or folders of them, .las, .laz, bags of ROS 2, .pcap and
    .osf. Sweeps of one sensor are compared by range images; clouds without rings by distances.

    \b
    Examples:
      lidarpool compare noisy clean
      lidarpool compare result recording.mcap --sensor-b /lidar/points --out compared
      lidarpool compare scan.laz earlier.laz --distance 0.05
      lidarpool compare scan.laz model.ply --unit-b ft
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..compare.comparison import compare as compared

    keep_freed_memory()
    found = compared(a, b, **given)
    page = next(path for path in found.save(out) if path.suffix == ".html")
    words = [repr(found), f"page     {click.format_filename(page)}"]
    options.show(found.figures, words, as_json)


@click.command()
@click.argument("recording", metavar="RECORDING", type=click.Path(path_type=Path))
@options.new_file("--out", required=True, help="Sensor file, .yaml; its page is a .html beside it.")
@click.option("--model", metavar="MODEL|FILE", help="The sensor, for what the recording hides.")
@options.path("--scene", help="The place, a mesh.")
@options.pose
@click.option("--sensor", metavar="NAME", help="Sensor of the recording, or topic of a bag.")
@click.option("--intensity", metavar="COLUMN", help="Column of the intensity.")
@click.option("--white", type=float, help="Intensity of white, if it is the same at all ranges.")
@options.as_json
def fit(recording: Path, out: Path, as_json: bool, **given: Any) -> None:
    """Fit a sensor to a recording of a unit that stands: noise, lost returns, false alarms.

    RECORDING is one that `lidarpool compare` reads, with sweeps and rings.

    \b
    Examples:
      lidarpool fit recording.pcap --model velodyne/vlp16 --out my-vlp16.yaml
      lidarpool fit sweeps --white 255 --out mine.yaml
      lidarpool fit recording.mcap --scene hall.glb --pose 2,0,1.5 --out mine.yaml
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..compare.fit import fit as fitted

    keep_freed_memory()
    found = fitted(recording, **given)
    words = [repr(found), *map(click.format_filename, found.save(out))]
    options.show(found.figures, words, as_json)

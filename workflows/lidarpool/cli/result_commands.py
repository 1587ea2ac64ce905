"""Implementation of the commands `plot`, `export`, `view` and `fit`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarfiles.clouds.built_in_formats import EXPORTS, LAYOUTS
from lidarfiles.clouds.format_table import format_row, load_format
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.schema.vocabulary import PICTURES

from . import completion
from . import shared_options as options

if TYPE_CHECKING:
    from lidarfiles.clouds.writing import ExportSpec
    from lidarsim.io.storage import Storage


def _parse_size(text: str) -> tuple[int, int]:
    """Parse an image size in pixels, such as 1600x1000."""
    if match := re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", text):
        return int(match[1]), int(match[2])
    raise click.BadParameter(
        f"{text!r} is not a picture size. Expected width x height in pixels, such as 1600x1000."
    )


class _FormatName(click.Choice[str]):
    """Parameter type for the name of an output format that is built in or provided by a plug-in."""

    def __init__(self) -> None:
        super().__init__(EXPORTS)

    def convert(self, value: str, param: Any, ctx: Any) -> str:
        if value in EXPORTS or value == "ply":
            return super().convert(value, param, ctx)
        format_row(value)
        return value


@click.command()
@options.result
@click.option(
    "--only",
    type=click.Choice(PICTURES),
    multiple=True,
    help="Picture to draw; can be repeated (default: all).",
)
@click.option(
    "--size",
    type=_parse_size,
    metavar="WxH",
    default="1600x1000",
    show_default=True,
    help="Picture size in pixels.",
)
@options.copies
@click.option(
    "--color",
    metavar="COLUMN",
    shell_complete=completion.colors,
    default="z",
    show_default=True,
    help="Column by which points are colored, or rgb.",
)
def plot(result: Path | Storage, out: Path | Storage | None, **settings: Any) -> None:
    """Draw the pictures of a result and add them to report.html.

    \b
    Examples:
      lidarpool plot lidarpool-out
      lidarpool plot lidarpool-out --only cloud --color intensity --size 2400x1500 --out figures
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.clouds.folder import local_result, path_in
    from lidarfiles.picture_file import PICTURE_FILE, PictureContent
    from lidarfiles.processes.freed_memory import keep_freed_memory

    from ..report.result_files import CLOUD, PAGE
    from ..report.result_pictures import publish_pictures

    target = result if out is None else out
    with local_result(result, (PICTURE_FILE, CLOUD, PAGE)) as folder:
        if not (folder / PICTURE_FILE).exists():
            raise LidarError(
                f"{result} does not contain {PICTURE_FILE}, from which the pictures are drawn. "
                "Pass the output folder of a finished run."
            )
        keep_freed_memory()
        content = PictureContent.load(folder / PICTURE_FILE)
        page_folder = folder if out is None else out
        page = page_folder / PAGE if isinstance(page_folder, Path) else None
        for name in publish_pictures(content, folder, target, page, **settings):
            click.echo(click.format_filename(path_in(target, name)))


@click.command()
@options.result
@click.option(
    "--format",
    "-f",
    "formats",
    type=_FormatName(),
    shell_complete=completion.format_name,
    multiple=True,
    required=True,
    help="Output format, built in or from a plug-in; can be repeated.",
)
@click.option(
    "--layout",
    type=click.Choice(list(LAYOUTS)),
    default="velodyne",
    show_default=True,
    help="Point layout in mcap and rosbag2.",
)
@click.option(
    "--compensated",
    is_flag=True,
    help="Compensate the motion within each sweep in mcap, rosbag2 and pcd; removes the point "
    "times.",
)
@click.option(
    "--compensated-actors",
    is_flag=True,
    help=(
        "Move the points of each actor to its pose at the start of the sweep (formats with sweeps "
        "only)."
    ),
)
@click.option(
    "--pose-rate-hz",
    type=options.Number(0, 10_000, min_open=True),
    metavar="RATE",
    help="Poses per second on /tf in mcap and rosbag2 (default: one per sweep).",
)
@click.option(
    "--organized",
    is_flag=True,
    help="Write one point per ray to mcap and rosbag2, with NaN for rays without a return.",
)
@click.option(
    "--intensity-full-scale",
    type=options.Number(0, min_open=True),
    metavar="INTENSITY",
    help="Intensity that is stored as 65,535 in las and laz (default: a value that at most 1 % of "
    "the points reach).",
)
@options.copies
@options.overwrite
def export(
    result: Path | Storage,
    formats: tuple[str, ...],
    out: Path | Storage | None,
    overwrite: bool,
    **settings: Any,
) -> None:
    """Convert a result to other formats.

    \b
    Examples:
      lidarpool export lidarpool-out --format laz
      lidarpool export lidarpool-out --format mcap --layout autoware --out bags
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.clouds.folder import local_result, path_in, result_folder
    from lidarfiles.picture_file import PICTURE_FILE, PictureContent
    from lidarfiles.work.publishing import move_into_place
    from lidarsim.columns.cloud_file import CloudFile
    from lidarsim.io.storage import staging
    from lidarsim.sweeps.instruments import INSTRUMENT_FILES
    from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

    # report.json is written last, so it marks a complete result.
    required = ("cloud.ply", SWEEPS_FILE, "report.json")
    target = result if out is None else out
    if isinstance(result, Path) and result.is_file():
        raise LidarError(f"{result} is a file. Pass its folder, {result.parent}.")
    specs = _make_export_specs(formats, **settings)
    _check_not_existing(target, [chosen.row.file for chosen in specs], overwrite=overwrite)
    with local_result(result, (*required, PICTURE_FILE, *INSTRUMENT_FILES)) as source:
        for name in required:
            if not (source / name).exists():
                raise LidarError(
                    f"{result} does not contain {name}. Pass the output folder of a finished "
                    "run. To finish an interrupted run, use `lidarpool run --resume`."
                )
        sweeps = Sweeps.load(source / SWEEPS_FILE)
        cloud = CloudFile(source / "cloud.ply")
        pictures = partial(PictureContent.load_from, source)
        written: list[str] = []
        with result_folder(target) as folder:
            for chosen in specs:  # reports errors before any file is written
                chosen.check(folder / chosen.row.file, cloud, overwrite=overwrite)
            try:
                for chosen in specs:
                    name = chosen.row.file
                    path = path_in(target, name)
                    with (
                        explain_os_errors(f"{path} cannot be written"),
                        staging(folder, target) as staged,
                    ):
                        full_scale = chosen.write(staged / name, cloud, sweeps, content=pictures)
                        move_into_place(staged, target, last=name)
                    written.append(click.format_filename(path))
                    for note in chosen.notes(cloud, sweeps):
                        click.echo(f"note: {note}", err=True)
                    if full_scale is not None:
                        _print_note(f"{chosen.title} stores the intensity {full_scale:g} as 65,535")
                    click.echo(written[-1])
            except (LidarError, KeyboardInterrupt) as error:
                if written:
                    error.add_note(f"These files have already been written: {', '.join(written)}.")
                raise


def _check_not_existing(target: Path | Storage, files: Sequence[str], *, overwrite: bool) -> None:
    """Raise LidarError if the target already contains a file that must not be overwritten."""
    from lidarfiles.clouds.folder import check_not_existing  # imported late to keep --help fast

    if isinstance(target, Path):
        check_not_existing((target / file for file in files), overwrite=overwrite)
        return
    existing = set() if overwrite else set(files) & set(target.entries())
    if existing:
        raise LidarError(
            f"{target.path(min(existing))} already exists. Pass another folder with `--out`, or "
            "pass `--overwrite`."
        )


def _make_export_specs(names: Iterable[str], layout: str, **options: Any) -> list[ExportSpec]:
    """Return the export specification of each format, with the options that it supports.

    An option that none of the formats supports is passed to all of them, so that it is rejected.
    """
    from lidarfiles.clouds.writing import ExportSpec

    formats = {name: load_format(name) for name in names}
    refused = [
        option
        for option in options
        if not any(cloud_format.supports(option) for cloud_format in formats.values())
    ]
    return [
        ExportSpec(
            name,
            layout,
            **{
                option: value
                for option, value in options.items()
                if option in refused or cloud_format.supports(option)
            },
        )
        for name, cloud_format in formats.items()
    ]


def _print_note(note: str) -> None:
    click.echo(f"note: {note}", err=True)


@click.command()
@click.argument("results", metavar="RESULT...", type=options.StoragePath(), nargs=-1, required=True)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1; if it is in use, the next free one. 0 selects any free port.",
)
@options.flag("--no-browser", help="Print the address without opening a browser.")
@options.new_file(
    "--film",
    help="Render an animation, along the trajectory or around the scene, to a .gif or .webp file.",
)
@options.new_file("--export", help="Export the view as a single .html file of at most 25 MB.")
@options.flag("--keep-noise", help="Include withheld points and noise of .las and .laz files.")
@options.mesh_reading
def view(
    results: Sequence[Path | Storage],
    port: int,
    no_browser: bool,
    film: Path | None,
    export: Path | None,
    keep_noise: bool,
    of_mesh: dict[str, Any],
) -> None:
    """Show results, recordings or scenes in the browser.

    RESULT is a result, a data set, a point cloud or recording (.ply, .las, .laz, .pcd, .e57,
    .parquet, text such as .csv, .pts, .ptx, .npy, .bin, .mcap, .pcap, .osf, or a folder with
    rosbag2, KITTI, nuScenes, WebDataset, PCD or range images), or a scenario or mesh. Several
    inputs are shown in one view with different colors.

    \b
    Examples:
      lidarpool view lidarpool-out
      lidarpool view drive.yaml
      lidarpool view part.stl --unit mm --up-axis y
      lidarpool view recording.mcap --no-browser
      lidarpool view before after
      lidarpool view drive --film drive.gif --export drive.html
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.clouds.folder import local_result
    from lidarfiles.picture_file import PICTURE_FILE
    from lidarsim.sweeps.sweeps import SWEEPS_FILE
    from lidarview.viewer.result_views import show_view
    from lidarview.viewer.view import CLOUD

    from ..pages.opened import growing_view, is_data_set, open_views

    if film and len(results) > 1:
        raise LidarError("`--film` requires a single input.")
    if data_sets := [result for result in results if is_data_set(result)]:
        if len(results) > 1 or film or export:
            raise LidarError(
                f"{data_sets[0]} is a data set with several jobs. View it on its own, without "
                "`--film` and `--export`."
            )
        options.reject_mesh_options(of_mesh, data_sets[0])
        from ..pages.job_list import JobList, show_jobs

        show_jobs(JobList(data_sets[0]), port=port, browser=not no_browser)
        return
    reading = {"keep_noise": keep_noise, "of_mesh": of_mesh, "report": _print_note}
    with ExitStack() as stack:
        files = (CLOUD, PICTURE_FILE, SWEEPS_FILE)
        folders = [stack.enter_context(local_result(result, files)) for result in results]
        if film or export:
            from lidarview.viewer.sharing import export_view

            from .terminal import Terminal

            shared = open_views(folders, **reading)
            export_view(shared, film, export, Terminal().writing)
        else:
            growing = None
            if len(folders) == 1 and not of_mesh:
                growing = growing_view(folders[0], keep_noise=keep_noise)
            shown = growing or open_views(folders, **reading)
            show_view(shown, port=port, browser=not no_browser)


@click.command()
@click.argument("recording", metavar="RECORDING", type=click.Path(path_type=Path))
@options.new_file(
    "--out",
    required=True,
    help="Output sensor file (.yaml); a report is written next to it as .html. With --pattern, "
    "without a report, and also .npz, .csv or .parquet for a list of rays.",
)
@click.option(
    "--pattern",
    is_flag=True,
    help="Estimate the ray directions and firing times of an unknown sensor instead of its noise.",
)
@click.option(
    "--model",
    metavar="MODEL|FILE",
    shell_complete=completion.sensors,
    help="Sensor model for the properties that cannot be estimated from the recording.",
)
@options.path("--scene", help="Mesh file of the scene, such as place.glb of lidarpool twin.")
@options.poses
@click.option(
    "--sensor", metavar="NAME", help="Sensor or topic of the recording, if it contains several."
)
@click.option("--intensity", metavar="COLUMN", help="Column that contains the intensity.")
@click.option(
    "--white-intensity",
    "white",
    type=options.Number(),
    help="Intensity of a white surface, if intensities do not depend on the range.",
)
@options.overwrite
@options.as_json
def fit(
    recording: Path,
    out: Path,
    pattern: bool,
    pose: Sequence[Sequence[float]],
    overwrite: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Estimate noise, dropout and false alarms from a recording.

    With --pattern, estimate the scan pattern of a sensor that has no model.

    RECORDING can have any format that `lidarpool compare` reads, and must contain sweeps and rings.
    The sensor must be stationary unless the scene is given with --scene and its poses are known.

    \b
    Examples:
      lidarpool fit recording.pcap --model velodyne/vlp16 --out my-vlp16.yaml
      lidarpool fit sweeps --white-intensity 255 --out mine.yaml
      lidarpool fit recording.mcap --scene hall.glb --pose 2,0,1.5 --out mine.yaml
      lidarpool fit drive.mcap --scene twin/place.glb --out mine.yaml
      lidarpool fit --pattern recording.pcd --out mine.yaml
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.clouds.folder import check_not_existing
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarreal.comparing.fit.fitting import fit as fitted

    keep_freed_memory()
    if pattern:
        _fit_pattern(recording, out, as_json, overwrite=overwrite, pose=pose, **settings)
        return
    check_not_existing([out, out.with_suffix(".html")], overwrite=overwrite)
    fitted_sensor = fitted(recording, pose=[*pose] or None, **settings)
    lines = [repr(fitted_sensor), *map(click.format_filename, fitted_sensor.save(out))]
    options.print_results(fitted_sensor.figures, lines, as_json)


def _fit_pattern(
    recording: Path,
    out: Path,
    as_json: bool,
    *,
    overwrite: bool,
    sensor: str | None = None,
    **settings: Any,
) -> None:
    """Estimate a scan pattern. The extension of the output file selects its form."""
    from lidarfiles.clouds.folder import check_not_existing
    from lidarreal.scan_patterns.fitting import check_pattern_file, fit_pattern
    from lidarsim.sensor.models import MODEL_FILES

    unused = [name for name, value in settings.items() if value]
    if unused:
        option = {"white": "white-intensity"}.get(unused[0], unused[0])
        raise click.UsageError(f"--{option} cannot be combined with --pattern.")
    check_pattern_file(out)
    check_not_existing([out], overwrite=overwrite)
    as_rays = out.suffix.lower() not in MODEL_FILES
    fitted = fit_pattern(recording, as_rays=as_rays, sensor=sensor)
    lines = [repr(fitted), *map(click.format_filename, fitted.save(out))]
    options.print_results(fitted.figures, lines, as_json)

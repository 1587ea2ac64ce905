"""Implementation of the command `compare`."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from lidarsim.errors import explain_os_errors
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.words import join_alternatives, join_names

from . import shared_options as options

if TYPE_CHECKING:
    from lidarreal.comparing.comparison import Comparison
    from lidarreal.comparing.surveys import SurveyComparison

STRIPS = "strips"
SURVEY_METHODS = ("auto", "pairs", "planes", "m3c2", "mesh", STRIPS)
# Options by the kind of comparison that uses them. The other options apply to all kinds.
_SWEEP_OPTIONS = (
    *("sweeps", "match", "intensity_a", "intensity_b", "azimuth_deg", "distances_m", "protocol"),
)
_CLOUD_OPTIONS = ("sensor_a", "sensor_b", "unit_a", "unit_b", "max_points")
_SURVEY_OPTIONS = ("up_axis", "radius_m", "max_distance_m")
_STRIP_OPTIONS = ("cell_m", "max_roughness_m")
_POINT_FILES = (".laz", ".las", ".ply", ".e57")  # formats of `--points`
_SHARED = ("keep_noise", "on_progress")


@click.command()
@click.argument("a", metavar="A", type=click.Path(path_type=Path))
@click.argument("others", metavar="B", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("lidarpool-compare"),
    show_default=True,
    help="Output folder for compare.html, compare.json and pictures; existing files are replaced.",
)
@click.option(
    "--sweep",
    "sweeps",
    type=int,
    multiple=True,
    help="Index of a pair of sweeps to compare, starting at 0; can be repeated (default: all).",
)
@click.option(
    "--match",
    type=click.Choice(["order", "time"]),
    default="order",
    show_default=True,
    help="How to pair the sweeps of A and B.",
)
@click.option("--sensor-a", metavar="NAME", help="Sensor or topic of A, if A contains several.")
@click.option("--sensor-b", metavar="NAME", help="Sensor or topic of B, if B contains several.")
@click.option("--intensity-a", metavar="COLUMN", help="Column of A to compare as intensity.")
@click.option("--intensity-b", metavar="COLUMN", help="Column of B to compare as intensity.")
@click.option(
    "--unit-a",
    type=click.Choice([*UNITS_M]),
    help="Length unit of A (default: from a .las or .laz file, otherwise m).",
)
@click.option(
    "--unit-b",
    type=click.Choice([*UNITS_M]),
    help="Length unit of B (default: from a .las or .laz file or a mesh, otherwise m).",
)
@options.flag("--keep-noise", help="Include withheld points and noise of .las and .laz files.")
@click.option(
    "--azimuth-deg",
    type=options.Number(),
    help="Cell width of the range images in degrees (default: the azimuth step of the sensor).",
)
@click.option(
    "--distance",
    "distances_m",
    type=options.Number(),
    metavar="M",
    multiple=True,
    default=(0.05, 0.1, 0.2, 0.5),
    show_default=True,
    help="Distance threshold in meters for the F-score; can be repeated.",
)
@click.option(
    "--max-points",
    type=int,
    default=10_000_000,
    show_default=True,
    help="Maximum number of points to load from a cloud without sweeps, or from a survey.",
)
@click.option(
    "--protocol",
    type=click.Choice(["lidar4d"]),
    help="Published evaluation protocol whose metrics are also computed.",
)
@click.option(
    "--survey",
    type=click.Choice(SURVEY_METHODS),
    help="Compare surveys in world coordinates: ΔE, ΔN and Δh of paired points, distances from "
    "planes, M3C2, signed distances from a mesh, or height differences between strips.",
)
@click.option(
    "--up-axis",
    type=click.Choice([*"xyz"]),
    help="Up axis of the mesh B (default: from the file, otherwise z). With --survey.",
)
@click.option(
    "--radius",
    "radius_m",
    type=options.Number(),
    metavar="M",
    help="Radius of the planes and cylinders in meters (default: from the point density of B). "
    "With --survey planes or m3c2.",
)
@click.option(
    "--max-distance",
    "max_distance_m",
    type=options.Number(),
    metavar="M",
    help="Maximum distance from B in meters (default: 1). With --survey planes, m3c2 or mesh.",
)
@click.option(
    "--cell",
    "cell_m",
    type=options.Number(),
    metavar="M",
    default=1.0,
    show_default=True,
    help="Width of the cells in which strips are compared, in meters. With --survey strips.",
)
@click.option(
    "--max-roughness",
    "max_roughness_m",
    type=options.Number(),
    metavar="M",
    default=0.1,
    show_default=True,
    help="Maximum standard deviation of points from the plane of their cell, in meters. With "
    "--survey strips.",
)
@click.option(
    "--points",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Also write the deviation at each point to a .laz, .las, .ply or .e57 file, replacing an "
    "existing file. With m3c2, the file includes the level of detection. With --survey.",
)
@options.as_json
@click.pass_context
def compare(
    context: click.Context,
    /,
    a: Path,
    others: tuple[Path, ...],
    out: Path,
    as_json: bool,
    survey: str | None,
    points: Path | None,
    **settings: Any,
) -> None:
    """Compare two point clouds or recordings of the same scene.

    B is the reference. A and B can be results, data sets, .ply or .pcd files or folders of these,
    .las, .laz, .e57, .pts, .ptx, .npy, .bin, .pcap, .osf or text files such as .csv, or ROS 2 bags.
    Sweeps of the same sensor are compared as range images, and clouds without rings by point
    distances.

    With --survey, points are compared in world coordinates. B can also be a mesh. With --survey
    strips, B is optional, and there can be any number of files.

    \b
    Examples:
      lidarpool compare noisy clean
      lidarpool compare result recording.mcap --sensor-b /lidar/points --out compared
      lidarpool compare scan.laz earlier.laz --distance 0.05
      lidarpool compare scan.laz model.ply --unit-b ft
      lidarpool compare simulated recorded --protocol lidar4d
      lidarpool compare noisy clean --survey pairs
      lidarpool compare scan.laz design.glb --survey mesh --max-distance 0.5
      lidarpool compare after.e57 before.e57 --survey m3c2 --points change.laz
      lidarpool compare flight.laz --survey strips --cell 2
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarfiles.work.publishing import publishing

    if survey != STRIPS and len(others) != 1:
        if not others:
            raise click.UsageError("Missing argument 'B'.")
        raise click.UsageError("More than two clouds require `--survey strips`.")
    if survey is None:
        survey_only = (*_SURVEY_OPTIONS, *_STRIP_OPTIONS, "points")
        _reject_options(context, survey_only, "requires `--survey`")
    elif survey == STRIPS:
        unused = (*_SWEEP_OPTIONS, *_CLOUD_OPTIONS, *_SURVEY_OPTIONS)
        _reject_options(context, unused, "cannot be used with `--survey strips`")
    else:
        _reject_options(context, _SWEEP_OPTIONS, "cannot be used with `--survey`")
        _reject_options(context, _STRIP_OPTIONS, "requires `--survey strips`")
    if points is not None and points.suffix not in _POINT_FILES:
        raise click.UsageError(
            f"`--points` is {points}, but its extension must be {join_alternatives(_POINT_FILES)}."
        )
    keep_freed_memory()
    from .terminal import Terminal

    with Terminal(as_json=as_json).writing("comparing the clouds", logged=False) as show:
        comparison = _compared(survey, a, others, settings | {"on_progress": show})
    with ExitStack() as stack:
        if points is not None:
            stack.enter_context(explain_os_errors(f"{points} cannot be written"))
            staged = stack.enter_context(publishing(points)) / points.name
            comparison.save_points(staged)  # type: ignore[union-attr]  # it is one of surveys
            # Earlier points must not be taken for those of the new comparison.
            points.unlink(missing_ok=True)
        saved = comparison.save(out)
    page = next(path for path in saved if path.suffix == ".html")
    label = f"{'page':<{9 if survey is None else 10}}"
    lines = [repr(comparison), f"{label}{click.format_filename(page)}"]
    if points is not None:
        lines.append(f"points    {click.format_filename(points)}")
    options.print_results(comparison.figures, lines, as_json)


def _compared(
    survey: Any, a: Path, others: tuple[Path, ...], settings: dict[str, Any]
) -> Comparison | SurveyComparison:
    """Compare clouds with the options that apply to the kind of comparison."""

    def chosen(*names: str) -> dict[str, Any]:
        return {name: settings[name] for name in names}

    if survey is None:
        from lidarreal.comparing.two_clouds import compare as compare_clouds

        kept = chosen(*_SWEEP_OPTIONS, *_CLOUD_OPTIONS, *_SHARED)
        return compare_clouds(a, others[0], **kept)
    from lidarreal.comparing.surveys import compare_strips, compare_surveys

    if survey == STRIPS:
        return compare_strips(a, *others, **chosen(*_STRIP_OPTIONS, *_SHARED))
    kept = chosen(*_CLOUD_OPTIONS, *_SURVEY_OPTIONS, *_SHARED)
    return compare_surveys(a, others[0], method=survey, **kept)


def _reject_options(context: click.Context, names: Iterable[str], problem: str) -> None:
    """Raise UsageError if the user has set one of the options."""
    flags = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    given = [
        f"`{flags[name]}`"
        for name in names
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]
    if given:
        verb = problem.replace("requires", "require") if len(given) > 1 else problem
        raise click.UsageError(f"{join_names(given)} {verb}.")

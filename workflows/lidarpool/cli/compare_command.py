"""The command `lidarpool compare`: two clouds or recordings of the same place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from . import options


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
@click.option(
    "--sweep",
    "sweeps",
    type=click.IntRange(0),
    metavar="N",
    multiple=True,
    help="Compare only this pair of sweeps, from 0; may be given several times.",
)
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
    "--azimuth-deg",
    type=click.FloatRange(0, 90, min_open=True),
    help="Width of a cell of the range images; by default the step from pulse to pulse.",
)
@click.option(
    "--distance",
    "distances_m",
    type=click.FloatRange(0, min_open=True),
    metavar="METRES",
    multiple=True,
    help="Distance for the F-score; may be given several times.  [default: 0.05 0.1 0.2 0.5]",
)
@click.option(
    "--most-points",
    type=click.IntRange(1000),
    default=10_000_000,
    show_default=True,
    help="Points of a cloud without sweeps that are held in memory.",
)
@options.as_json
def compare(a: Path, b: Path, out: Path, as_json: bool, **given: Any) -> None:
    """Compare two clouds or recordings of the same place; B is the reference.

    A and B: the folder of a result or data set, a .ply, a .pcd or a folder of them, a .las or .laz,
    a bag of ROS 2 (.mcap, or its folder). Sweeps of one sensor are compared by range images, in
    the axes of the sensor; clouds without rings by nearest neighbours alone.

    \b
    Examples:
      lidarpool compare noisy clean
      lidarpool compare result recording.mcap --sensor-b /lidar/points --out compared
      lidarpool compare scan.laz earlier.laz --distance 0.05
    """  # noqa: D301 - click wants the character, not its name
    from ..base.fork_server import keep_freed_memory
    from ..report.comparison import DISTANCES_M
    from ..report.comparison import compare as compared

    keep_freed_memory()
    given["distances_m"] = given["distances_m"] or DISTANCES_M
    given["sweeps"] = given["sweeps"] or None
    found = compared(a, b, **given)
    page = next(path for path in found.save(out) if path.suffix == ".html")
    click.echo(json.dumps(found.figures, indent=1, allow_nan=False) if as_json else repr(found))
    if not as_json:
        click.echo(f"page     {click.format_filename(page)}")

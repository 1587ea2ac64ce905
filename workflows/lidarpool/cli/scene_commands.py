"""The commands `lidarpool scene …`: generated scenes, and point clouds, as mesh files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import Command, overwrite, together

if TYPE_CHECKING:
    from ..scene.scene import Scene


MOST_COPIED = 20_000_000  # triangles of files that cannot share them


@click.group(name="scene")
def scene() -> None:
    """Make scenes as mesh files: generated ones, or of a point cloud."""


_out = click.argument("out", type=click.Path(path_type=Path), metavar="OUT.ply|.glb|.obj")


def _made(triangles: int) -> Callable[[Command], Command]:
    """Add the output file, the number of triangles, and a seed."""
    return together(
        _out,
        overwrite,
        click.option("--triangles", default=triangles, help="Approximate number."),
        click.option("--seed", default=0, help="The same seed gives the same scene."),
    )


@scene.command(context_settings={"show_default": True})
@_made(triangles=100_000)
@click.option("--trees", default=0, help="Number of detailed trees, instead of the simple ones.")
@click.option("--cars", default=0, help="Number of detailed cars, instead of the simple ones.")
def city(out: Path, triangles: int, seed: int, overwrite: bool, trees: int, cars: int) -> None:
    """Make a city: streets, houses, towers, trees, cars; more triangles make it larger.

    \b
    Examples:
      lidarpool scene city city.glb
      lidarpool scene city city.ply --triangles 10000000 --seed 7
      lidarpool scene city green.glb --trees 500 --cars 200
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.city import city as make

    _write(out, lambda: make(triangles, seed, trees, cars), overwrite)


@scene.command(context_settings={"show_default": True})
@_made(triangles=2_000_000)
@click.option("--side", default=1000.0, help="Length of a side in metres.")
@click.option("--trees", default=0, help="Number of trees, in woods on ground that is not steep.")
def terrain(out: Path, triangles: int, seed: int, side: float, overwrite: bool, trees: int) -> None:
    """Make a square of hills and mountains; more triangles make it finer.

    \b
    Examples:
      lidarpool scene terrain hills.ply
      lidarpool scene terrain small.obj --triangles 20000 --side 100
      lidarpool scene terrain woods.glb --trees 10000
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.terrain import terrain as make

    _write(out, lambda: make(triangles, seed, side, trees), overwrite)


@scene.command()
@click.option(
    "--voxel-m",
    type=float,
    help="Edge of cubes with one point each; by default the spacing of the points.",
)
@click.option(
    "--size",
    default=1.0,
    show_default=True,
    help="Factor of the surfels' sides: larger ones close gaps, and reach farther beyond edges.",
)
@overwrite
@click.argument("cloud", type=click.Path(path_type=Path), metavar="CLOUD.ply|.pcd|.xyz|.las|.laz")
@_out
def points(cloud: Path, out: Path, voxel_m: float | None, size: float, overwrite: bool) -> None:
    """Make a scene of a point cloud, in metres and Z-up: a scan that can be scanned again.

    \b
    Examples:
      lidarpool scene points scan.ply place.glb
      lidarpool scene points survey.laz place.obj --voxel-m 0.5
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.points import scene_of_points

    _write(out, lambda: scene_of_points(cloud, voxel_m=voxel_m, size=size), overwrite)


def _write(out: Path, make: Callable[[], Scene], overwrite: bool) -> None:
    from ..base.errors import LidarpoolError
    from ..base.words import counted
    from ..scene.paint import painted
    from ..scene.scene_file import check_target, write_scene

    check_target(out)
    if out.exists() and not overwrite:
        raise LidarpoolError(f"{out} exists: give another name, or --overwrite.")
    made = make()
    if out.suffix.lower() == ".glb":  # others keep no colours
        made = painted(made)
    elif made.instances and made.triangles > MOST_COPIED:
        raise LidarpoolError(
            f"{out} would hold {made.triangles:,} triangles, because only .glb files have a tree "
            "once for many places: write one."
        )
    write_scene(out, made)
    low, high = made.bounds
    click.echo(
        f"{made.triangles:,} triangles, {counted(len(made.names), 'object')}, "
        f"{' x '.join(f'{length:.0f}' for length in high - low)} m: {click.format_filename(out)}"
    )

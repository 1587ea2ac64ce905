"""The commands `lidarpool scene …`: scenes to try things on, as mesh files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from poolpart.wording import counted

from ..scene.scene import Scene

_out = click.argument("out", type=click.Path(path_type=Path), metavar="OUT.ply|.glb|.obj")


def _triangles(default: int) -> Callable[[Any], Any]:
    return click.option(
        "--triangles", type=int, default=default, show_default=True, help="About how many."
    )


_seed = click.option(
    "--seed", type=int, default=0, show_default=True, help="The same seed gives the same scene."
)


@click.group(name="scene")
def scene() -> None:
    """Make scenes to survey, as mesh files."""


@scene.command()
@_out
@_triangles(100_000)
@_seed
def city(out: Path, triangles: int, seed: int) -> None:
    """Make a city: streets, houses, towers, trees, cars; more triangles make it larger.

    \b
    Examples:
      lidarpool scene city city.glb
      lidarpool scene city city.ply --triangles 10000000 --seed 7
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.city import city as make

    _write(out, lambda: make(triangles, seed))


@scene.command()
@_out
@_triangles(2_000_000)
@_seed
@click.option(
    "--side", type=float, default=1000.0, show_default=True, help="Length of a side in metres."
)
def terrain(out: Path, triangles: int, seed: int, side: float) -> None:
    """Make a square of hills and mountains; more triangles make it finer.

    \b
    Examples:
      lidarpool scene terrain hills.ply
      lidarpool scene terrain small.obj --triangles 20000 --side 100
    """  # noqa: D301 - click wants the character, not its name
    from ..scene.terrain import terrain as make

    _write(out, lambda: make(triangles, seed, side))


def _write(out: Path, make: Callable[[], Scene]) -> None:
    from ..scene.scene_file import check_target, write_scene  # trimesh would slow down --help

    check_target(out)
    made = make()
    write_scene(out, made)
    objects = len(made.names)
    low, high = made.bounds
    size = " x ".join(f"{length:.0f}" for length in high - low)
    click.echo(
        f"{len(made.faces):,} triangles, {counted(objects, 'object')}, {size} m: "
        f"{click.format_filename(out)}"
    )

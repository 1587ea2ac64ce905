"""The `lidarpool occupancy` command, which writes occupancy grids for sweeps."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lidarsim.words import plural

from . import shared_options as options
from .first_step import print_first_step
from .shared_options import overwrite

if TYPE_CHECKING:
    from lidarsim.simulator.occupancy import GridFrame

    from ..connection.tls_files import TlsFiles

Corners = tuple[float, float, float, float, float, float]


def _parse_extent(text: str) -> Corners:
    """Parse opposite corners of a grid in the form x0,y0,z0,x1,y1,z1."""
    try:
        x0, y0, z0, x1, y1, z1 = map(float, text.split(","))
    except ValueError as error:
        message = (
            f"{text!r} is not an extent. Expected X0,Y0,Z0,X1,Y1,Z1 in meters, such as "
            "-40,-40,-1,40,40,5.4."
        )
        raise click.BadParameter(message) from error
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        raise click.BadParameter(
            f"{text!r} is not an extent, because the lower corner must come first, as in "
            "-40,-40,-1,40,40,5.4."
        )
    return x0, y0, z0, x1, y1, z1


@click.command()
@click.argument("scenario", metavar="SCENARIO", type=click.Path(path_type=Path))
@click.option(
    "--layout",
    type=click.Choice(["occ3d", "semantickitti"]),
    required=True,
    help="File layout, with its default extent, voxel size and frame.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    required=True,
    help="Output folder, created if necessary.",
)
@click.option("--sensor", metavar="NAME", help="Sensor of the scenario (default: the first one).")
@click.option(
    "--extent",
    type=_parse_extent,
    metavar="X0,Y0,Z0,X1,Y1,Z1",
    help="Opposite corners of the grid in meters (default: those of the layout).",
)
@click.option(
    "--voxel-size",
    "voxel_m",
    type=options.Number(0, min_open=True),
    metavar="M",
    help="Edge length of a voxel in meters (default: that of the layout).",
)
@click.option(
    "--frame",
    type=click.Choice(["platform", "sensor"]),
    help="Frame of the grid (default: platform for occ3d, sensor for semantickitti).",
)
@click.option(
    "--following",
    type=click.IntRange(0),
    metavar="N",
    default=0,
    show_default=True,
    help="Number of following sweeps whose rays also make voxels valid. Layout semantickitti only.",
)
@click.option(
    "--job", type=click.IntRange(0), metavar="N", help="Write only job N of the campaign."
)
@options.backend
@options.scheduler
@options.workers
@options.unfinished("computation")
@overwrite
@options.flag("--quiet", "-q", help="Do not show progress.")
@options.as_json
def occupancy(
    scenario: Path,
    *,
    layout: str,
    out: Path,
    sensor: str | None,
    extent: Corners | None,
    voxel_m: float | None,
    frame: GridFrame | None,
    following: int,
    job: int | None,
    backend: str | None,
    scheduler: str | None,
    files: TlsFiles,
    workers: int | None,
    resume: bool,
    restart: bool,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Write the true occupancy of a voxel grid for each sweep.

    SCENARIO is a scenario or a campaign. The class and the instance of each voxel are determined
    from the surfaces of the scene at the start of the sweep, and the rays of the sensor determine
    which voxels are observed. The rays are simulated by this command, so the scenario does not have
    to be run first.

    The layout occ3d writes gts/SCENE/FRAME_TOKEN/labels.npz as in Occ3D-nuScenes. The layout
    semantickitti writes sequences/00/voxels/000000.bin, .label, .occluded and .invalid as in
    SemanticKITTI.

    \b
    Examples:
      lidarpool occupancy street.yaml --layout occ3d --out street/occ3d
      lidarpool occupancy street.yaml --layout semantickitti --following 10 --out street/kitti
      lidarpool occupancy campaign.yaml --layout occ3d --out grids --scheduler tcp://127.0.0.1:8786
    """  # noqa: D301 - Click requires the character \b
    options.check_workers(workers, scheduler)
    options.check_unfinished(resume=resume, restart=restart)
    print_first_step("reading the scene", quiet=quiet or as_json)
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarscenario.occupancy.layouts import LAYOUTS
    from lidarscenario.occupancy.writing import OccupancySettings, write_occupancy
    from lidarsim.simulator.occupancy import VoxelGrid

    from ..run.cluster.connection import connect_client
    from .terminal import Terminal

    keep_freed_memory()
    terminal = Terminal(quiet, False, as_json)
    grid = LAYOUTS[layout].grid
    corners = extent or (*grid.lower, *grid.upper)
    settings = OccupancySettings(
        layout,
        VoxelGrid(corners[:3], corners[3:], voxel_m or grid.voxel_m),
        frame,
        sensor,
        following,
        backend,
    )
    client = nullcontext() if scheduler is None else connect_client(scheduler, files)
    with (
        client as connected,
        terminal.writing("computing the grids") as show,
    ):
        written = write_occupancy(
            scenario,
            out,
            settings,
            job=job,
            client=connected,
            workers=workers,
            resume=resume,
            restart=restart,
            overwrite=overwrite,
            progress=lambda done, total: show("occupancy", done, total, "sweeps"),
        )
    figures = {
        "folder": str(out),
        "layout": layout,
        "jobs": written.jobs,
        "sweeps": written.sweeps,
        "files": written.files,
        "shape": settings.chosen_grid.shape,
        "notes": list(written.notes),
    }
    shape = " x ".join(map(str, settings.chosen_grid.shape))
    lines = [*terminal.notes(written.notes)]
    lines.append(f"{plural(written.sweeps, 'grid')} of {shape} voxels in {out}")
    options.print_results(figures, lines, as_json)

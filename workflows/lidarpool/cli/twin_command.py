"""The `lidarpool twin` command, which reconstructs a scene from a recording."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import completion
from . import shared_options as options
from .shared_options import overwrite

if TYPE_CHECKING:
    from ..connection.tls_files import TlsFiles


@click.command()
@click.argument("recording", metavar="RECORDING", type=click.Path(path_type=Path))
@options.path("--out", "-o", metavar="DIR", required=True, help="Output folder.")
@click.option(
    "--model",
    metavar="MODEL|FILE",
    shell_complete=completion.sensors,
    help="Sensor model of the recording; required for sensors without rings.",
)
@options.path(
    "--trajectory",
    help="File with the poses of the sensor, either with timestamps or as one KITTI row per sweep "
    "(default: from the recording, otherwise estimated by registration).",
)
@click.option(
    "--voxel-m",
    type=options.Number(),
    default=0.1,
    show_default=True,
    help="Spacing of the surfels in meters.",
)
@click.option(
    "--sensor", metavar="NAME", help="Sensor or topic of the recording, if it contains several."
)
@click.option("--intensity", metavar="COLUMN", help="Column that contains the intensity.")
@click.option(
    "--lidar4d-window",
    type=int,
    metavar="FRAME",
    help="First frame of a window of KITTI-360 in which LiDAR4D was evaluated, such as 4950. Only "
    "this window is used, and the same frames are held out.",
)
@click.option(
    "--actors",
    type=click.Choice(["boxes", "clusters", "none"]),
    help="How moving objects are found: from the labeled boxes of the recording, from clusters of "
    "points that moved, or not at all (default: boxes if the recording has any, otherwise "
    "clusters).",
)
@options.scheduler
@options.unfinished("reconstruction")
@overwrite
@options.as_json
def twin(
    recording: Path,
    out: Path,
    *,
    scheduler: str | None,
    files: TlsFiles,
    resume: bool,
    restart: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Reconstruct the scene of a recorded drive and its moving objects.

    The output folder contains the static scene (place.glb), the moving objects (actors), the
    trajectory (trajectory.csv), the sensor (sensor.yaml), a scenario that combines them, and
    report.html, which compares held-out sweeps with simulated sweeps. RECORDING can have any format
    that `lidarpool compare` reads, and must contain sweeps.

    \b
    Examples:
      lidarpool twin drive.mcap --out twin
      lidarpool twin sweeps --trajectory poses.txt --out twin
      lidarpool twin mid360.mcap --model livox/mid360 --out twin
      lidarpool twin hour.mcap --out twin --resume --scheduler tcp://127.0.0.1:8786
      lidarpool run twin/scenario.yaml --sensor hesai/pandar128 --out again
    """  # noqa: D301 - Click requires the character \b
    from lidarfiles.processes.freed_memory import keep_freed_memory
    from lidarreal.reconstruction.building import twin as build
    from lidarreal.reconstruction.twin import SCENARIO_FILE

    from ..run.cluster.connection import connect_client

    options.check_unfinished(resume=resume, restart=restart)
    keep_freed_memory()

    def report(line: str) -> None:
        if not as_json:
            click.echo(f"{line} …", err=True)

    with nullcontext() if scheduler is None else connect_client(scheduler, files) as client:
        built = build(
            recording,
            client=client,
            out=out,
            resume=resume,
            restart=restart,
            report=report,
            **settings,
        )
    paths = [click.format_filename(out / name) for name in built.file_names]
    scenario = shlex.quote(str(out / SCENARIO_FILE))
    following = f"next: lidarpool run {scenario} [--sensor MODEL]"
    options.print_results(built.figures, [repr(built), *paths, following], as_json)

"""The command `lidarpool check`: what a run would do and take, before anything starts."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from poolpart.wording import counted

from ..base.errors import LidarpoolError
from ..run.connection import connected
from ..run.job import make_job
from ..scenario.scenario import Scenario
from .completion import complete_backend
from .terminal import shown_status
from .tls_options import tls_file_options, tls_files_for

if TYPE_CHECKING:
    from .forecast import Forecast


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("lidarpool-out"),
    show_default=True,
    help="Folder that the results would go to; it is not made.",
)
@click.option("--scheduler", metavar="ADDRESS", help="Ask this Dask cluster whether it can do it.")
@tls_file_options
@click.option(
    "--backend",
    metavar="[auto|cuda|embree|numpy]",
    shell_complete=complete_backend,
    help="Ray caster of stage 2; by default the scenario's, else the fastest there is.",
)
@click.option("--no-plan", is_flag=True, help="Leave the path planning out.")
@click.option("--json", "as_json", is_flag=True, help="Print it as one JSON document.")
def check(
    scenario: Path,
    out: Path,
    scheduler: str | None,
    backend: str | None,
    no_plan: bool,
    as_json: bool,
    tls_ca: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
) -> None:
    """Check a scenario, and tell what a run would do and take; nothing is started.

    Some rays are cast here to estimate the number of points. The exit code is 0 if it can run,
    and 2, with the reasons, if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check hall.glb --no-plan --scheduler tcp://127.0.0.1:8786 --json
    """  # noqa: D301 - click wants the character, not its name
    from .forecast import forecast  # Matplotlib is a third of the time that --help would take

    files = tls_files_for(scheduler, tls_ca, tls_cert, tls_key)
    read = Scenario.load(scenario)
    job = make_job(read, backend, no_plan)
    cluster = nullcontext() if scheduler is None else connected(scheduler, files)
    with cluster as client, shown_status("casting some rays", as_json):
        made = forecast(job, read.pool, out, client, read.unitless_files)
    if as_json:
        click.echo(json.dumps(made.as_data(), indent=1, allow_nan=False))
    else:
        for line in told(made):
            click.echo(line)
    if made.reasons:
        raise LidarpoolError("it cannot run. " + " ".join(made.reasons))
    if not as_json:
        click.echo(f"it can run: {_run_line(scenario, out, scheduler, backend, no_plan)}")


def told(made: Forecast) -> Iterator[str]:
    """Tell of it in lines for people."""
    from ..scenario.advice import in_metres
    from .forecast import in_bytes

    job, needs, sample = made.job, made.needs, made.sample
    survey, planning = job.survey, job.planning
    sensor = survey.sensor
    turn = f"{sensor.channels:,} a firing"
    if sensor.period is not None:
        turn = f"{sensor.period:,} x {sensor.channels:,} a turn"
    objects = counted(len(job.scene.names), "object")
    yield f"scene       {objects}, {len(job.scene.faces):,} triangles"
    low, high = job.scene.bounds + job.scene.origin
    yield f"size        {' x '.join(map(in_metres, high - low))} m; " + ", ".join(
        f"{axis} {in_metres(a)} to {in_metres(b)}"
        for axis, a, b in zip("xyz", low, high, strict=True)
    )
    yield (
        f"survey      {counted(survey.scan_count, 'scan')} from "
        f"{counted(survey.path.stations, 'pose')}, "
        f"{survey.ray_count:,} rays ({turn})"
    )
    if sample is not None:
        yield (
            f"points      about {sample.points:,} of {sample.hits:,} hits; an estimate from "
            f"{sample.rays:,} rays cast here with {sample.backend}"
        )
    yield f"planning    {f'{planning.trials:,} trials' if planning else 'none'}"
    yield f"backend     {made.backend or 'none yet'}" + (" (auto)" if job.backend == "auto" else "")
    for name, (needed, there) in made.slots.items():
        yield f"{name:<10}  {counted(there, 'slot')}, at least {needed:,} needed"
    if needs is not None:
        limit = f" of {in_bytes(made.memory)}" if made.memory else ""
        whole = f"memory      about {in_bytes(made.memory_needed)}{limit}"
        if made.memory_needed == needs.gpu_worker:  # another cluster's, whose workers differ
            yield f"{whole} in a GPU worker; the driver {in_bytes(needs.driver)}"
        else:
            yield (
                f"{whole}; a GPU worker {in_bytes(needs.gpu_worker)}, "
                f"the driver {in_bytes(needs.driver)}"
            )
        result = needs.cloud + needs.pictures
        yield (
            f"disk        about {in_bytes(needs.parts)} meanwhile and {in_bytes(result)} for "
            f"the result; {in_bytes(made.disk_free)} free"
        )
    for note in made.notes:
        yield f"note: {note}"


def _run_line(
    scenario: Path, out: Path, scheduler: str | None, backend: str | None, no_plan: bool
) -> str:
    """Command that runs what was checked; certificates are to be given again."""
    words = ["lidarpool", "run", str(scenario)]
    if out != Path("lidarpool-out"):
        words += ["--out", str(out)]
    for name, value in (("--scheduler", scheduler), ("--backend", backend)):
        words += [name, value] if value else []
    return shlex.join([*words, *(["--no-plan"] if no_plan else [])])

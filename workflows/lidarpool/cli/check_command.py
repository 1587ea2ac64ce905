"""The command `lidarpool check`: what a run would do and take, before anything starts."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click
from dask.utils import format_bytes

from poolpart.wording import counted

from ..base.errors import LidarpoolError
from ..run.connection import TlsFiles, connected
from ..run.job import make_job
from ..scenario.scenario import Scenario
from . import options
from .terminal import shown_status

if TYPE_CHECKING:
    from .forecast import Forecast


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@options.out
@options.scheduler
@options.backend
@options.no_plan
@click.option("--json", "as_json", is_flag=True, help="Print it as one JSON document.")
def check(
    scenario: Path,
    out: Path,
    scheduler: str | None,
    files: TlsFiles,
    backend: str | None,
    no_plan: bool,
    as_json: bool,
) -> None:
    """Check a scenario, and tell what a run would do and take; nothing is started.

    Some scans are cast here to estimate the number of points. The exit code is 0 if it can run,
    and 2, with the reasons, if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check hall.glb --no-plan --scheduler tcp://127.0.0.1:8786 --json
    """  # noqa: D301 - click wants the character, not its name
    from .forecast import forecast  # Matplotlib is a third of the time that --help would take

    read = Scenario.load(scenario)
    job = make_job(read, backend, no_plan)
    cluster = nullcontext() if scheduler is None else connected(scheduler, files)
    with cluster as client, shown_status("casting some rays", as_json):
        made = forecast(job, read.pool, out, client)
    made.notes += read.advice(job.scene)
    if as_json:
        click.echo(json.dumps(made.as_data(), indent=1, allow_nan=False))
    else:
        for line in told(made):
            click.echo(line)
    if made.reasons:
        raise LidarpoolError("it cannot run. " + " ".join(made.reasons))
    if not as_json:
        words = ["lidarpool", "run", str(scenario)]
        for name, value in (("--out", out), ("--scheduler", scheduler), ("--backend", backend)):
            words += [name, str(value)] if value and str(value) != "lidarpool-out" else []
        click.echo(f"it can run: {shlex.join([*words, *['--no-plan'] * no_plan])}")


def told(made: Forecast) -> Iterator[str]:
    """Tell of it in lines for people."""
    job, sample = made.job, made.sample
    survey, sensor = job.survey, job.survey.sensor
    turn = f"{sensor.channels:,} a firing"
    if sensor.period is not None:
        turn = f"{sensor.period:,} x {sensor.channels:,} a turn"
    objects = counted(len(job.scene.names), "object")
    yield f"scene       {objects}, {len(job.scene.faces):,} triangles"
    low, high = job.scene.bounds + job.scene.origin
    yield f"size        {' x '.join(f'{side:,.2f}' for side in high - low)} m; " + ", ".join(
        f"{axis} {a:,.2f} to {b:,.2f}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    yield (
        f"survey      {counted(survey.scan_count, 'scan')} from "
        f"{counted(survey.path.stations, 'pose')}, {survey.ray_count:,} rays ({turn})"
    )
    if sample is not None:
        yield (
            f"points      about {sample.points:,} of {sample.hits:,} hits; an estimate from "
            f"{sample.rays:,} rays cast here"
        )
    yield f"planning    {f'{job.trials:,} trials' if job.trials else 'none'}"
    yield f"backend     {made.backend or 'none yet'}" + (" (auto)" if job.backend == "auto" else "")
    for name, (needed, there) in made.slots.items():
        yield f"{name:<10}  {counted(there, 'slot')}, at least {needed:,} needed"
    limit = f" of {format_bytes(made.memory)}" if made.memory else ""
    yield f"memory      about {format_bytes(made.memory_needed)}{limit}"
    yield (
        f"disk        about {format_bytes(made.parts)} meanwhile and "
        f"{format_bytes(made.result)} for the result; {format_bytes(made.free)} free"
    )
    for note in made.notes:
        yield f"note: {note}"

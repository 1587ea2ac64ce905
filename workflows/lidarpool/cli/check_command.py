"""The command `lidarpool check`: what a run would do and need, before anything starts."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..base.errors import LidarpoolError
from . import options

if TYPE_CHECKING:
    from ..base.storage import Storage
    from ..run.connection import TlsFiles
    from ..run.job import Job


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@options.out
@options.scheduler
@options.cluster
@options.backend
@options.no_plan
@options.as_json
def check(
    scenario: Path,
    out: Path | Storage,
    scheduler: str | None,
    files: TlsFiles,
    cluster: Path | None,
    backend: str | None,
    no_plan: bool,
    as_json: bool,
) -> None:
    """Show what a run would do and need.

    The scenario is checked; nothing is started.

    Some scans are cast here to estimate the number of points. The exit code is 0 if it can run,
    and 2, with the reasons, if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check hall.glb --no-plan --scheduler tcp://127.0.0.1:8786 --json
    """  # noqa: D301 - click wants the character, not its name
    from ..run.cluster_file import ClusterFile
    from ..run.connection import connected
    from ..run.job import make_job
    from ..scenario.scenario import Scenario
    from .forecast import forecast
    from .run_command import formats_of
    from .terminal import shown_status

    try:
        file = None if cluster is None else ClusterFile.load(cluster)
        read = Scenario.load(scenario)
        with shown_status("reading the scene", as_json, logged=False):
            job = make_job(read, backend, no_plan)
        running = nullcontext() if scheduler is None else connected(scheduler, files)
        with running as client, shown_status("casting some rays", as_json):
            found = forecast(job, read.pool, out, client, formats_of(read), file)
        found["notes"] += read.advice(job.scene)
        found["sources"] = read.sources
    except LidarpoolError as error:
        if as_json:
            found = {"can_run": False, "reasons": [str(error)], "notes": []}
            click.echo(json.dumps(found, indent=1))
        raise
    if as_json:
        click.echo(json.dumps(found, indent=1, allow_nan=False))
    else:
        for line in told(job, found):
            click.echo(line)
    if found["reasons"]:
        raise LidarpoolError("it cannot run. " + " ".join(found["reasons"]))
    if not as_json:
        words = ["lidarpool", "run", str(scenario)]
        given = {"out": out, "scheduler": scheduler, "cluster": cluster, "backend": backend}
        for name, value in given.items():
            words += [f"--{name}", str(value)] if value and str(value) != "lidarpool-out" else []
        click.echo(f"it can run: {shlex.join([*words, *['--no-plan'] * no_plan])}")


def told(job: Job, found: dict[str, Any]) -> Iterator[str]:
    """Print a forecast as lines of text."""
    from dask.utils import format_bytes

    from ..base.words import counted

    sensor, estimate, disk = job.survey.sensor, found["estimate"], found["disk"]
    turn = f"{sensor.channels:,} a firing"
    if sensor.period is not None and sensor.cycle != "frame":
        turn = f"{sensor.period:,} x {sensor.channels:,} a {sensor.cycle}"
    yield f"scene       {counted(found['objects'], 'object')}, {found['triangles']:,} triangles"
    for file, taken in found["sources"].items():
        yield f"file        {file}: {taken}"
    sides = list(zip("xyz", *found["bounds"], strict=True))
    spans = ", ".join(f"{axis} {low:,.2f} to {high:,.2f}" for axis, low, high in sides)
    yield f"size        {' x '.join(f'{high - low:,.2f}' for _, low, high in sides)} m; {spans}"
    if masked := found["masked"]:
        have = "object has masks" if len(masked) == 1 else "objects have masks"
        shown = ", ".join(masked[:3]) + ", …" * (len(masked) > 3)
        yield f"masks       {len(masked):,} {have}: {shown}"
    drive = found["drive"]
    where = "along a trajectory" if drive else f"from {counted(found['poses'], 'pose')}"
    several = len(job.survey.carried) > 1
    turn = f"{len(job.survey.carried)} sensors" if several else turn
    yield f"survey      {counted(found['scans'], 'scan')} {where}, {found['rays']:,} rays ({turn})"
    if drive:
        yield f"trajectory  {drive['metres']:,.2f} m in {drive['seconds']:,.3f} s"
        for one in drive["sensors"]:
            turns = ""
            if one["turns"]:
                turns = f", {one['turns']:,.2f} {one['cycle']}s; in one the carrier moves "
                turns += f"{one['metres_a_turn']:,.3f} m"
            firings = counted(one["firings"], "firing")
            yield f"{one['name'] or 'sensor':<11} {one['model']}, {firings}{turns}"
    returns = job.survey.returns
    if drive or returns != type(returns)():
        rays = f", {returns.subrays} sub-rays a beam" if returns.subrays > 1 else ""
        yield f"returns     {returns.mode} of each pulse{rays}"
    if estimate:
        yield (
            f"points      about {estimate['points']:,} of {estimate['hits']:,} hits; an estimate "
            f"from {estimate['rays']:,} rays cast here"
        )
    yield f"planning    {f'{job.trials:,} trials' if job.trials else 'none'}"
    backend = found["backend"]
    kind = {None: "", "cuda": "GPU "}.get(backend, "CPU ")
    workers = counted(found["casters"], f"{kind}worker")
    yield f"cast by     {workers} ({backend or 'backend not known yet'})"
    for name, slots in found["slots"].items():
        yield f"{name:<10}  {counted(slots['there'], 'slot')}, at least {slots['needed']:,} needed"
    there = found["memory"]["there"]
    limit = f" of {format_bytes(there)}" if there else ""
    yield f"memory      about {format_bytes(found['memory']['needed'])}{limit}"
    parts, result, free = (format_bytes(disk[name]) for name in ("parts", "result", "free"))
    yield f"disk        about {parts} during the run and {result} for the result; {free} free"
    for note in found["notes"]:
        yield f"note: {note}"

"""The command `lidarpool check`: what a run would do and need, before anything starts."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator
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
    from ..scenario.campaign import Campaign
    from ..scenario.scenario import Scenario

_LOOKED_AT = 5  # jobs of a campaign


@click.command()
@click.argument("scenario", type=click.Path(path_type=Path))
@options.out
@options.scheduler
@options.cluster
@options.backend
@options.no_plan
@options.job
@options.as_json
def check(
    scenario: Path,
    out: Path | Storage,
    scheduler: str | None,
    files: TlsFiles,
    cluster: Path | None,
    backend: str | None,
    no_plan: bool,
    number: int | None,
    as_json: bool,
) -> None:
    """Show what a run would do and need.

    The scenario is checked; nothing is started. Of a campaign, the values that vary, and five of
    its jobs.

    Some rays are cast here to estimate the number of points. The exit code is 0 if it can run,
    and 2, with the reasons, if it cannot.

    \b
    Examples:
      lidarpool check scenario.yaml
      lidarpool check campaign.yaml --job 17
      lidarpool check hall.glb --no-plan --scheduler tcp://127.0.0.1:8786 --json
    """  # noqa: D301 - click wants the character, not its name
    from ..run.cluster_file import ClusterFile
    from ..run.connection import connected
    from ..run.job import with_options
    from ..scenario.advice import advice
    from ..scenario.build import build
    from ..scenario.campaign import Campaign, is_campaign
    from ..scenario.job import job_of
    from ..scenario.scenario import Scenario
    from .forecast import forecast
    from .run_command import formats_of
    from .terminal import shown_status

    def look(read: Scenario, plans: bool) -> tuple[Job, dict[str, Any]]:
        with shown_status("reading the scene", as_json, logged=False):
            built = build(read, plans=plans)
            job = with_options(job_of(built), read.pool, backend)
        running = nullcontext() if scheduler is None else connected(scheduler, files)
        with running as client, shown_status("casting some rays", as_json):
            found = forecast(job, read.pool, out, client, formats_of(read), file)
        found["notes"] += advice(built)
        found["sources"] = dict(built.found.sources)
        return job, found

    try:
        file = None if cluster is None else ClusterFile.load(cluster)
        if not is_campaign(scenario):
            if number is not None:
                raise LidarpoolError(f"{scenario} is no campaign, and has no job {number}.")
            job, found = look(Scenario.load(scenario), not no_plan)
            lines = told(job, found)
        elif number is None:
            campaign = Campaign.load(scenario)
            campaign.check_files()
            found = _look_at_jobs(campaign, look)
            lines = _of_campaign(campaign, found)
        else:
            campaign = Campaign.load(scenario)
            read = campaign.scenario(number)
            assert read is not None, "of a file"
            job, found = look(read, False)
            found["job"] = _figures(campaign, number, found)
            lines = told(job, found)
    except LidarpoolError as error:
        if as_json:
            found = {"can_run": False, "reasons": [str(error)], "notes": []}
            click.echo(json.dumps(found, indent=1))
        raise
    if as_json:
        click.echo(json.dumps(found, indent=1, allow_nan=False))
    else:
        for line in lines:
            click.echo(line)
    if found["reasons"]:
        raise LidarpoolError("it cannot run. " + " ".join(found["reasons"]))
    if not as_json:
        words = ["lidarpool", "run", str(scenario)]
        given: dict[str, Any] = {"out": out, "scheduler": scheduler, "cluster": cluster}
        for name, value in (given | {"backend": backend, "job": number}).items():
            wanted = value is not None and str(value) != "lidarpool-out"
            words += [f"--{name}", str(value)] if wanted else []
        click.echo(f"it can run: {shlex.join([*words, *['--no-plan'] * no_plan])}")


def _look_at_jobs(
    campaign: Campaign, look: Callable[[Scenario, bool], tuple[Job, dict[str, Any]]]
) -> dict[str, Any]:
    """Look at some jobs of a campaign, the first and the last among them; they plan no paths."""
    from dataclasses import asdict

    last = campaign.count - 1
    jobs, notes, reasons = [], [], []
    for number in dict.fromkeys(last * i // (_LOOKED_AT - 1) for i in range(_LOOKED_AT)):
        try:
            read = campaign.scenario(number)
            assert read is not None, "of a file"
            _, found = look(read, False)
        except LidarpoolError as error:
            reasons.append(str(error))
            continue
        jobs.append(_figures(campaign, number, found))
        notes += found["notes"]
        reasons += found["reasons"]
    return {
        "can_run": not reasons,
        "reasons": list(dict.fromkeys(reasons)),
        "notes": list(dict.fromkeys(notes)),
        "count": campaign.count,
        "seed": campaign.seed,
        "choices": dict(campaign.choices),
        "splits": dict(campaign.splits),
        "keep": asdict(campaign.keep),
        "jobs": jobs,
    }


def _figures(campaign: Campaign, number: int, found: dict[str, Any]) -> dict[str, Any]:
    """Return a job of a campaign and its figures, as plain data."""
    return {
        "number": number,
        "name": campaign.name(number),
        "split": campaign.split(number),
        "values": campaign.values(number),
    } | {name: found[name] for name in ("objects", "triangles", "scans", "rays", "estimate")}


def _of_campaign(campaign: Campaign, found: dict[str, Any]) -> Iterator[str]:
    """Print what was found out of a campaign as lines of text."""
    from ..base.words import counted

    kept = campaign.keep.format + f", {campaign.keep.layout}" * (campaign.keep.format == "mcap")
    yield f"campaign    {counted(campaign.count, 'job')}, seed {campaign.seed}, kept as {kept}"
    for name, words in campaign.choices.items():
        yield f"varied      {name}: {words}"
    if campaign.splits:
        shares = ", ".join(f"{name} {share:.4g}" for name, share in campaign.splits.items())
        yield f"splits      {shares}"
    for job in found["jobs"]:
        yield f"job         {_in_words(job)}"
        points = ""
        if job["estimate"]:
            points = f", about {job['estimate']['points']:,} points"
        yield (
            f"            {counted(job['objects'], 'object')}, {counted(job['scans'], 'scan')}, "
            f"{job['rays']:,} rays{points}"
        )
    if found["jobs"]:
        share = campaign.count / len(found["jobs"])
        scans = round(share * sum(job["scans"] for job in found["jobs"]))
        rays = round(share * sum(job["rays"] for job in found["jobs"]))
        points = sum((job["estimate"] or {"points": 0})["points"] for job in found["jobs"])
        yield (
            f"in all      about {scans:,} scans, {rays:,} rays and {round(share * points):,} "
            f"points, judged by {counted(len(found['jobs']), 'job')}"
        )
    for note in found["notes"]:
        yield f"note: {note}"


def _in_words(job: dict[str, Any]) -> str:
    shown = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in job["values"].items()}
    values = ", ".join(f"{name} {value}" for name, value in shown.items())
    split = f" ({job['split']})" if job["split"] else ""
    return f"{job['name']}{split}{': ' if values else ''}{values}"


def told(job: Job, found: dict[str, Any]) -> Iterator[str]:
    """Print a forecast as lines of text."""
    from dask.utils import format_bytes

    from ..base.words import counted

    sensor, estimate, disk = job.survey.sensor, found["estimate"], found["disk"]
    if "job" in found:
        yield f"job         {_in_words(found['job'])}"
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
    returns = job.survey.returns_each[0]
    if drive or returns != type(returns)():
        rays = f", {returns.subrays} sub-rays a beam" if returns.subrays > 1 else ""
        yield f"returns     {returns.mode} of each pulse{rays}"
    if alpha := job.survey.extinction(sensor):
        left = f"{100 * math.exp(-100 * alpha):.2g} % of the light from 50 m is left"
        yield f"air         takes {1000 * alpha:.3g}/km: {left}"
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

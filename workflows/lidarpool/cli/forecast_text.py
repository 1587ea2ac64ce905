"""Output of `lidarpool check`, which estimates the size of a survey or of a campaign's jobs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarscenario.advice import advice, unlabeled_notes
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.job import Job
from lidarscenario.plan.flight_density import expected_density, summarize_density
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import PreparedScenario, prepare
from lidarscenario.scenario import Scenario
from lidarsim.errors import LidarError
from lidarsim.io.allowance import bytes_of
from lidarsim.io.storage import Storage
from lidarsim.words import format_rounded, format_scan_counts, list_names, plural

from ..identity.job_errors import summarize_errors
from ..report.result_files import check_existing
from ..run.forecast import forecast
from ..run.job_source import SingleJob
from ..run.options import RunOptions
from ..run.pipeline.stage_names import GPU
from .shared_options import world_lines
from .terminal import Terminal

if TYPE_CHECKING:
    from distributed import Client

    from lidarscenario.campaign.campaign import CampaignSpec

FORECAST_JOBS = 5  # number of campaign jobs that are checked
_JOB_COUNTS = ("objects", "triangles", "scans", "sweeps", "rays", "estimate")


def forecast_scenario(
    path: Path,
    of_mesh: Mapping[str, Any],
    number: int | None,
    client: Client | None,
    out: Path | Storage,
    options: RunOptions,
    backend: str | None,
    *,
    quiet: bool,
) -> tuple[dict[str, Any], Iterator[str]]:
    """Estimate the points, memory and disk space of a run.

    Parameters
    ----------
    path
        Scenario, mesh or campaign file. For a campaign, evenly spaced jobs including the first and
        the last are checked, without path planning.
    of_mesh
        Arguments of `mesh_data`.
    number
        Number of the campaign job to check. By default, several jobs are checked.
    client
        Client of a running cluster, if there is one.
    out
        Output folder of the run.
    options, backend
        Options of the run, and the ray-casting backend if the user has selected one.
    quiet
        Whether to suppress progress messages.

    Returns
    -------
    Plain data for JSON, and the same data as lines of text.

    Raises
    ------
    LidarError
        If the scenario is invalid, or if `number` is passed for a file that is not a campaign.
    """
    campaign = None
    if not of_mesh and is_campaign(path):
        from lidarscenario.campaign.campaign import (
            CampaignSpec,  # imported late because scenarios need less
        )

        campaign = CampaignSpec.load(path)
    if campaign is None and number is not None:
        raise LidarError(
            f"{path} is not a campaign. `--job {number}` can only be used with a campaign."
        )

    terminal = Terminal(quiet)
    has_jobs = campaign is not None and number is None  # each job has a separate output folder

    def forecast_job(job_number: int = 0) -> tuple[Job, dict[str, Any]]:
        scenario = (
            Scenario.load(path, of_mesh) if campaign is None else campaign.scenario(job_number)
        )
        assert scenario is not None, "a campaign that was read from a file has a scenario"
        with terminal.status("reading the scene", logged=False):
            prepared = prepare(scenario, plans=campaign is None)
            job = prepared.job
        with terminal.status("casting sample rays"):
            figures = forecast(
                job,
                out,
                options.with_pool(scenario.pool, {"backend": backend}),
                client,
                refuse=None if has_jobs else partial(_check_existing, job, out),
            )
        figures["notes"] += advice(prepared)
        figures["warnings"] += plausibility_warnings(prepared)
        figures["sources"] = dict(prepared.findings.sources)
        figures["flight"] = _flight_figures(prepared)
        if campaign is not None:
            file_format = campaign.keep.export_spec
            figures["notes"] += file_format.frame_notes(scenario.cloud.coordinates)
            figures["notes"] += file_format.cloud_format.renaming_notes([*scenario.sensors])
            if "class" in file_format.needs:
                figures["notes"] += unlabeled_notes(job.scene, job.survey)
            figures["job"] = _job_figures(campaign, job_number, figures)
        return job, figures

    if campaign is None or not has_jobs:
        job, figures = forecast_job(number or 0)
        return figures, _job_lines(job, figures)
    figures = _campaign_figures(campaign, out, lambda number: forecast_job(number)[1])
    return figures, _campaign_lines(campaign, figures)


def _flight_figures(prepared: PreparedScenario) -> dict[str, Any] | None:
    """Compare the expected density with the flight plan, or return None if there is no plan."""
    plan = prepared.scenario.flight
    if plan is None:
        return None
    scene = prepared.scene.with_world_origin((0, 0, 0))
    expected = expected_density(scene, prepared.survey, plan.area)
    return summarize_density(expected, plan.density_m2)._asdict()


def _check_existing(job: Job, out: Path | Storage) -> None:
    """Raise LidarError if the output folder contains something that a run must not replace."""
    check_existing(out, job.survey, job.outputs, SingleJob(job))


def _campaign_figures(
    campaign: CampaignSpec, out: Path | Storage, forecast_job: Callable[[int], dict[str, Any]]
) -> dict[str, Any]:
    """Estimate the size of a campaign from evenly spaced jobs.

    `forecast_job` returns the estimates for a single job.
    """
    campaign.check_files()
    jobs: list[dict[str, Any]] = []
    notes: list[str] = []
    warnings: list[str] = []
    errors: list[tuple[str, str]] = []  # (job name, error)
    last = campaign.count - 1
    numbers = dict.fromkeys(last * i // (FORECAST_JOBS - 1) for i in range(FORECAST_JOBS))
    for job_number in numbers:
        name = campaign.name(job_number)
        try:
            figures = forecast_job(job_number)
        except LidarError as error:
            errors.append((name, str(error)))
            continue
        jobs.append(figures["job"])
        notes += figures["notes"]
        warnings += figures["warnings"]
        errors += [(name, reason) for reason in figures["reasons"]]
    return {
        "can_run": not errors,
        "reasons": summarize_errors(errors),
        "occupied": _holds_files(out),
        "notes": list(dict.fromkeys(notes)),
        "warnings": list(dict.fromkeys(warnings)),
        "count": campaign.count,
        "checked": len(numbers),
        "failed": [*dict.fromkeys(name for name, _ in errors)],
        "seed": campaign.seed,
        "choices": dict(campaign.choices),
        "splits": dict(campaign.splits),
        "keep": asdict(campaign.keep),
        "jobs": jobs,
    }


def _job_figures(campaign: CampaignSpec, number: int, figures: dict[str, Any]) -> dict[str, Any]:
    return {
        "number": number,
        "name": campaign.name(number),
        "split": campaign.split(number),
        "values": campaign.values(number),
        **{name: figures[name] for name in _JOB_COUNTS},
    }


def _holds_files(folder: Path | Storage) -> bool:
    with suppress(NotADirectoryError):
        return bool(Storage.at(folder).entries())
    return False


def _campaign_lines(campaign: CampaignSpec, figures: dict[str, Any]) -> Iterator[str]:
    data_set = campaign.keep.format + f", {campaign.keep.layout}" * (campaign.keep.format == "mcap")
    yield f"campaign    {plural(campaign.count, 'job')}, seed {campaign.seed}, stored as {data_set}"
    for name, words in campaign.choices.items():
        yield f"varied      {name}: {words}"
    if campaign.splits:
        shares = ", ".join(f"{name} {share:.4g}" for name, share in campaign.splits.items())
        yield f"splits      {shares}"
    yield f"checked     {figures['checked']:,} of {plural(campaign.count, 'job')}"
    for job in figures["jobs"]:
        yield f"job         {_describe_job(job)}"
        points = ""
        if job["estimate"]:
            points = f", about {job['estimate']['points']:,} points"
        yield (
            f"            {plural(job['objects'], 'object')}, "
            f"{format_scan_counts(job['scans'], job['sweeps'])}, {job['rays']:,} rays{points}"
        )
    if figures["jobs"]:
        share = campaign.count / len(figures["jobs"])
        scans, sweeps, rays = (
            round(share * sum(job[name] for job in figures["jobs"]))
            for name in ("scans", "sweeps", "rays")
        )
        points = sum((job["estimate"] or {"points": 0})["points"] for job in figures["jobs"])
        yield (
            f"total       about {format_scan_counts(scans, sweeps)}, {rays:,} rays and "
            f"{round(share * points):,} points, estimated from "
            f"{plural(len(figures['jobs']), 'job')}"
        )
    yield from _remarks(figures)


def _remarks(figures: dict[str, Any]) -> Iterator[str]:
    for note in figures["notes"]:
        yield f"note: {note}"
    for warning in figures["warnings"]:
        yield f"warning: {warning}"


def _describe_job(job: dict[str, Any]) -> str:
    """Return the job's name, split and varied values as text."""
    shown = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in job["values"].items()}
    shown = {k: "none" if v is None else v for k, v in shown.items()}
    values = ", ".join(f"{name} {value}" for name, value in shown.items())
    split = f" ({job['split']})" if job["split"] else ""
    return f"{job['name']}{split}{': ' if values else ''}{values}"


def _job_lines(job: Job, figures: dict[str, Any]) -> Iterator[str]:
    if "job" in figures:
        yield f"job         {_describe_job(figures['job'])}"
    yield from _scene_lines(figures)
    yield from _survey_lines(job, figures)
    if drive := figures["drive"]:
        yield from _drive_lines(drive)
    yield from _return_lines(job, figures)
    if flight := figures["flight"]:
        yield (
            f"density     {flight['mean_m2']:.3g} points per m² in the planned area, of which 95 % "
            f"has at least {flight['low_m2']:.3g} (plan: {flight['planned_m2']:.3g}; cells of "
            f"{flight['cell_m']:g} m)"
        )
    yield f"planning    {f'{job.trials:,} trials' if job.trials else 'none'}"
    yield from _resource_lines(figures)
    yield from _remarks(figures)


def _scene_lines(figures: dict[str, Any]) -> Iterator[str]:
    yield f"scene       {', '.join(plural(figures[f'{n}s'], n) for n in ('object', 'triangle'))}"
    for file, content in figures["sources"].items():
        yield f"file        {file}: {content}"
    sides = list(zip("xyz", *figures["bounds"], strict=True))
    spans = ", ".join(f"{axis} {lower:,.2f} to {upper:,.2f}" for axis, lower, upper in sides)
    lengths = " x ".join(f"{upper - lower:,.2f}" for _, lower, upper in sides)
    yield f"size        {lengths} m; {spans}"
    yield from world_lines(figures["epsg"], figures["world_origin"])
    if masked := figures["masked"]:
        shown = ", ".join(masked[:3]) + ", …" * (len(masked) > 3)
        have = plural(len(masked), "object has masks", "objects have masks")
        yield f"masks       {have}: {shown}"


def _survey_lines(job: Job, figures: dict[str, Any]) -> Iterator[str]:
    sensor = job.survey.sensor
    pattern = f"{sensor.channels:,} per firing"
    if len(job.survey.mounted_sensors) > 1:
        pattern = f"{len(job.survey.mounted_sensors)} sensors"
    elif sensor.period is not None and sensor.cycle != "frame":
        pattern = f"{sensor.period:,} x {sensor.channels:,} per {sensor.cycle}"
    path = f"from {plural(figures['poses'], 'pose')}"
    if figures["drive"]:
        path = "along a trajectory"
    scans = format_scan_counts(figures["scans"], figures["sweeps"])
    yield f"survey      {scans} {path}, {figures['rays']:,} rays ({pattern})"
    performance = figures["performance"]
    of_sensors = (f"{name}: " * bool(name) + words for name, words in performance.items())
    yield f"performance {'; '.join(of_sensors)}"
    for name, unseen in figures["unseen"].items():
        by_sensor = f"by {name}, " * bool(name)
        yield f"unseen      {by_sensor}{plural(len(unseen), 'object')}: {list_names(unseen)}"


def _drive_lines(drive: dict[str, Any]) -> Iterator[str]:
    """Yield lines about the trajectory's length and each sensor's firings."""
    lines = drive["lines"]
    of_lines = ""
    if lines:
        of_lines = f"; {plural(lines['count'], 'scanned flight line')}, "
        of_lines += f"{lines['length_m']:,.0f} m in {lines['seconds']:,.1f} s"
    yield f"trajectory  {drive['meters']:,.2f} m in {drive['seconds']:,.3f} s{of_lines}"
    for sensor in drive["sensors"]:
        cycles = ""
        if sensor["turns"]:
            cycles = f", {sensor['turns']:,.2f} {sensor['cycle']}s; the platform moves"
            cycles += (
                f" {sensor['meters_a_turn']:,.3f} m per "
                f"{sensor['cycle']}{' on the flight lines' if lines else ''}"
            )
        firings = plural(sensor["firings"], "firing")
        yield f"{sensor['name'] or 'sensor':<11} {sensor['model']}, {firings}{cycles}"


def _return_lines(job: Job, figures: dict[str, Any]) -> Iterator[str]:
    survey = job.survey
    returns = survey.returns_each[0]
    if figures["drive"] or returns != type(returns)():
        rays = f", {returns.subrays} sub-rays per beam" if returns.subrays > 1 else ""
        yield f"returns     {returns.mode} of each pulse{rays}"
    if extinction := survey.extinction(survey.sensor):
        light = (
            f"{format_rounded(100 * math.exp(-100 * extinction))} % of the light returns from 50 m"
        )
        yield f"air         extinction {format_rounded(1000 * extinction)}/km: {light}"
    if estimate := figures["estimate"]:
        without = survey.faults and 2 * estimate["rays"] < survey.ray_count
        yield (
            f"points      about {estimate['points']:,} of {estimate['hits']:,} hits, rounded "
            f"to {survey.precision_m:g} m; estimated from {estimate['rays']:,} sample "
            f"rays{', without faults' if without else ''}"
        )


def _resource_lines(figures: dict[str, Any]) -> Iterator[str]:
    backend = figures["backend"]
    device = {None: "backend not yet known", "cuda": "GPU, cuda"}.get(backend, f"CPU, {backend}")
    yield f"cast by     {plural(figures['casters'], 'casting worker')} ({device})"
    for name, slots in figures["slots"].items():
        label = name
        partition = ""
        if name == GPU:  # the name of the partition, even if its workers have no GPU
            label = "casting"
            partition = " in partition GPU"
        count = plural(slots["there"], "slot")
        yield f"{label:<10}  {count}{partition}, at least {slots['needed']:,} needed"
    available = figures["memory"]["there"]
    limit = f" of {bytes_of(available)}" if available else ""
    yield f"memory      about {bytes_of(figures['memory']['needed'])}{limit}"
    disk = figures["disk"]
    parts, result, free = (bytes_of(disk[name]) for name in ("parts", "result", "free"))
    yield f"disk        about {parts} during the run and {result} for the result; {free} free"

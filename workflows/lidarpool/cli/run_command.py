"""Implementation of the commands `run` and `demo`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from lidarfiles.clouds.folder import local_result, output_destination, result_folder
from lidarfiles.datasets.job_table import Tally, read_table
from lidarscenario.advice import advice
from lidarscenario.job import Job
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import PreparedScenario, prepare
from lidarscenario.scenario import Scenario
from lidarscenario.shard import Shard, describe_shard
from lidarsim.casting.scene_caster import check_backend_here
from lidarsim.columns.table import NO_SURFACE
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.words import format_scan_counts, plural

from ..pages import page_of
from ..processes import timeline
from ..report.output import SurveyOutput, run_survey
from ..report.report import summarize_report
from ..report.result_files import CLOUD
from ..run.job_source import SingleJob
from ..run.options import RunOptions
from ..run.run_result import RunResult
from ..run.runner import cast_to_store
from ..run.store.run_store import RUN_FOLDER
from .shared_options import print_results
from .terminal import Terminal

if TYPE_CHECKING:
    from lidarscenario.campaign.campaign import CampaignSpec


def run_scenario(
    scenario: Scenario,
    out: Path | Storage,
    terminal: Terminal,
    options: RunOptions,
    backend: str | None = None,
    *,
    extent: str | None = None,
    shard: Shard | None = None,
    scenario_source: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Run a scenario, write the result and print a summary.

    If a `shard` is selected, only its scans are run. The run store is kept for a later merge, and
    `scenario_source` is saved in it.

    Raises
    ------
    LidarError
        If the run fails. Notes of the error describe the results that were kept.
    """
    options = options.with_pool(scenario.pool, {"backend": backend})
    for output_format in scenario.output.write:  # reports errors before the scene is read
        output_format.check_installed()
    if options.starts_workers:
        check_backend_here(options.backend)
    with terminal.status("reading the scene", logged=False):
        prepared = prepare(scenario)
    timeline.record_step(timeline.SCENE)
    for warning in plausibility_warnings(prepared):
        terminal.warn(warning)
    if shard is None:
        _run_survey(prepared, out, options, terminal, extent)
        return
    jobs = SingleJob(prepared.job, shard, title=scenario.title)
    scenario_source = {
        **scenario_source,
        "extent": extent or "page",
        "scans": prepared.survey.scan_count,
    }
    with result_folder(out), page_of(jobs, options.live) as page:
        result = cast_to_store(
            jobs, options, terminal, page, scenario_source=scenario_source, target=out
        )
    points = len(result.points)
    line = (
        f"{describe_shard(str(shard))} in {out}: {plural(points, 'point')}. To combine the shards, "
        "use lidarpool merge"
    )
    figures = {"folder": str(out), "shard": str(shard), "points": points}
    print_results(figures, [*terminal.notes(result.notes), line], terminal.as_json)


def _run_survey(
    prepared: PreparedScenario,
    out: Path | Storage,
    options: RunOptions,
    terminal: Terminal,
    extent: str | None,
    compare: Callable[[RunResult], str] | None = None,
) -> None:
    """Run a prepared survey, write its result and print a summary.

    `compare` checks the result before it is written. It returns a note or raises an error.
    """
    job = prepared.job
    for note in advice(prepared):
        terminal.report(note)
    jobs = SingleJob(job, title=prepared.scenario.title)
    output = SurveyOutput(out, job.survey, job.outputs, extent or "page", prepared.scenario)
    with page_of(jobs, options.live) as page:
        result, report = run_survey(jobs, options, output, terminal, page, compare)
        lines = _result_lines(out, result, job, report, terminal)
        print_results(summarize_report(out, report), lines, terminal.as_json)
        timeline.record_step(timeline.SUMMARY)
        if options.live and options.stay:
            with local_result(out, [CLOUD]) as folder:
                page.keep_open(folder / CLOUD)


def run_campaign(
    campaign: CampaignSpec,
    out: Path | Storage,
    terminal: Terminal,
    options: RunOptions,
    backend: str | None,
) -> None:
    """Run a campaign, write the data set and print a summary.

    Raises
    ------
    LidarError
        If the run or one of the jobs fails.
    """
    # Imported late, because surveys do not need the formats of data sets.
    from ..report.campaign_output import describe_failures
    from ..report.campaign_output import run_campaign as cast_campaign

    if options.pace is not None:
        raise click.UsageError(
            "`--pace` can only be used with a single survey, not with a campaign."
        )
    options = options.with_pool(campaign.pool, {"backend": backend})
    campaign.keep.export_spec.check_installed()
    for warning in _first_job_warnings(campaign, terminal):
        terminal.warn(warning)
    with page_of(campaign, options.live) as page:
        run = cast_campaign(out, campaign, options, terminal, page)
        names = ("points", "rays", "seconds", "casting_seconds", "resumed", "notes")
        figures = {"folder": str(out), "jobs": run.done}
        figures |= {"failed": [row.name for row in run.failed]}
        figures |= {name: getattr(run, name) for name in names}
        lines = [
            *terminal.notes(run.notes),
            f"{plural(run.done, 'job')}, {plural(run.rays, 'ray')}, "
            f"{plural(run.points, 'point')} in the data set ({run.seconds:.1f} s)",
            f"data set in {click.format_filename(str(out))}; see its README.md",
        ]
        print_results(figures, lines, terminal.as_json)
        timeline.record_step(timeline.SUMMARY)
        if options.live and options.stay:
            page.keep_open()
    if run.failed:
        raise LidarError(describe_failures(run))


def _first_job_warnings(campaign: CampaignSpec, terminal: Terminal) -> list[str]:
    """Return warnings about implausible settings in the first job of a campaign or shard.

    Errors are ignored, because the run will report them.
    """
    if not campaign.numbers:
        return []
    number = campaign.numbers[0]
    with suppress(LidarError), terminal.status("reading the scene", logged=False):
        if (scenario := campaign.scenario(number)) is not None:  # jobs may come from a function
            warnings = plausibility_warnings(prepare(scenario, plans=False))
            return [f"job {campaign.name(number)}: {warning}" for warning in warnings]
    return []


def run_job(
    campaign: CampaignSpec,
    number: int,
    out: Path | Storage,
    terminal: Terminal,
    options: RunOptions,
    backend: str | None,
    extent: str | None,
) -> None:
    """Run a single job of a campaign, and write its result as for a survey.

    If `out` contains the data set of the campaign, the result is written to a folder in the data
    set, and its points are compared with those in the data set.

    Raises
    ------
    LidarError
        If the points differ, or if they cannot be compared because the data set was created with
        different software or the files of the job are damaged.
    """
    from lidarfiles.datasets.dataset import DataSet  # imported late, as in `run_campaign`

    from ..report.campaign_output import CAMPAIGN_FILE, check_same_campaign, verify_dataset

    target = Storage.at(out)
    name = campaign.name(number)
    dataset = DataSet(target, **asdict(campaign.keep))
    compare: Callable[[RunResult], str] | None = None
    if CAMPAIGN_FILE in target.entries():
        backend = check_same_campaign(target, campaign)["backend"]
        verify_dataset(target, number)
        out = output_destination(f"{out}/job-{name}")
        options = replace(options, folder=Storage.at(out).below(RUN_FOLDER))
        compare = partial(_compare_with_dataset, target, number, name)
    prepared = campaign.prepare(number, dataset.columns)
    for warning in plausibility_warnings(prepared):
        terminal.warn(warning)
    prepared = replace(prepared, job=prepared.job.with_fields(number=0))
    options = options.with_pool(prepared.scenario.pool, {"backend": backend})
    _run_survey(prepared, out, options, terminal, extent, compare)


def _compare_with_dataset(dataset: Storage, number: int, name: str, result: RunResult) -> str:
    """Compare a job's points with those in the data set, and return a note if they are equal.

    Return an empty string if the data set does not contain the job. Raise LidarError if the points
    differ.
    """
    hashes = [row.sha256 for row in read_table(dataset) if row.number == number and row.done]
    if not hashes:
        return ""
    if Tally.from_cloud(result.points).sha256 not in hashes:
        raise LidarError(
            f"The points of job {name} differ from those in {dataset}, because a file that the "
            "job uses, such as an image of a mesh, has changed."
        )
    return f"the points of job {name} are bit-identical to those in {dataset}"


def _result_lines(
    target: Path | Storage,
    result: RunResult,
    job: Job,
    report: dict[str, Any],
    terminal: Terminal,
) -> Iterator[str]:
    """Yield a summary of the result as lines of text."""
    yield from terminal.notes(report["notes"])
    hits_elsewhere = result.hit_count - report["hits_on_surfaces"]
    yield (
        f"{format_scan_counts(job.survey.scan_count, job.survey.sweep_count)}, "
        f"{plural(result.rays, 'ray')}, {plural(result.hit_count, 'hit')}"
        f"{f' ({hits_elsewhere:,} not on a surface)' if hits_elsewhere > 0 else ''}, "
        f"{plural(len(result.points), 'point')} in the cloud{_objects_with_points(report)}"
        f"{result.thinning_note} ({result.backend}, {result.survey_seconds:.1f} s)"
    )
    if (plan := result.plan) is not None:
        outcome = "no collision-free path was found"
        if plan.collision_free:
            outcome = f"collision-free path of {plan.length:.2f} m"
        possible = "no path is possible, because the obstacles block the way"
        if math.isfinite(plan.shortest_possible):
            possible = f"the shortest possible path is {plan.shortest_possible:.2f} m"
        yield f"{outcome}; {possible} ({plan.trials} trials, {result.planning_seconds:.1f} s)"
    yield f"results in {click.format_filename(str(target))}: {', '.join(report['files'])}"


def _objects_with_points(report: dict[str, Any]) -> str:
    """Return a phrase with the number of objects that have points, or an empty string."""
    counts = [n for name, n in report["points_by_object"].items() if name != NO_SURFACE]
    hit = sum(count > 0 for count in counts)
    if not hit:
        return ""
    return f" on {f'{hit:,} of ' * (hit < len(counts))}{plural(len(counts), 'object')}"

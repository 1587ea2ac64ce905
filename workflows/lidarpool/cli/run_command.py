"""The commands `run` and `demo` without their options: survey, planning, files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from distributed import Client

from ..base.open3d_module import load_open3d
from ..base.storage import Storage
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..base.words import counted
from ..export.folder import local_result, result_folder
from ..export.formats import Format
from ..live.pages import page_of_run
from ..pipeline import LIDAR, OTHER
from ..pipeline.database import FILE
from ..report.output import CLOUD, further_files, refuse_to_replace, write_result
from ..report.report import summary
from ..run.checks import slots_needed
from ..run.cluster_file import ClusterFile
from ..run.conductor import Page, conducted
from ..run.connection import TlsFiles, connected, local_client, started_client
from ..run.identity import identity_of
from ..run.job import Job, make_job
from ..run.result import RunResult
from ..run.store import RUN_FOLDER, RunStore, drop_run
from ..run.watch import Waiting
from ..scenario.placing import seen_from
from ..scenario.scenario import Scenario
from ..scenario.sections import PoolSection
from ..simulator.world import check_backend_here
from .logs import set_logs
from .terminal import shown_progress, shown_status, tell
from .worker_logs import WorkerLogs


@dataclass(frozen=True)
class RunOptions:
    """How a scenario is to be run: the options of `lidarpool run`, where they are told of.

    `resumable`: keep the run in the output folder; otherwise `resume` and `fresh` have no effect.
    """

    out: Path | Storage
    scheduler: str | None = None
    cluster: ClusterFile | None = None
    files: TlsFiles | None = None
    tls: bool = False
    backend: str | None = None
    no_plan: bool = False
    resumable: bool = True
    resume: bool = False
    fresh: bool = False
    verify: bool = False
    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    live: bool = False
    stay: bool = True
    only: str | None = None
    overwrite: bool = False
    parts: str | None = None
    wait_s: float = WAIT_S
    patience_s: float = PATIENCE_S

    @property
    def here(self) -> bool:
        """Whether it is to be run on a cluster of this machine, made for it."""
        return self.scheduler is None and self.cluster is None


def run_scenario(
    scenario: Scenario,
    options: RunOptions,
    job: Job | None = None,
    judge: Callable[[RunResult], str] = lambda result: "",
) -> None:
    """Run a scenario, write the result and print a summary.

    The `job` is by default that of the scenario; `judge` returns a note on its result.

    LidarpoolError if the run fails; notes of the error say what was kept.
    """
    set_logs(options.verbose)
    if options.here:  # before reading the scene, which may take long
        check_backend_here(options.backend or scenario.pool.backend)
    with shown_status("reading the scene", options.quiet, logged=False):
        job = job or make_job(
            scenario,
            options.backend,
            options.no_plan,
            wait_s=options.wait_s,
            patience_s=options.patience_s,
        )
    if options.cluster is not None:
        options.cluster.require(slots_needed(job))
    if not options.quiet:
        for note in scenario.advice(job.scene):
            tell(f"note: {note}")
    with ExitStack() as whole, page_of_run(job, options.live) as page:
        result, report = _run(scenario, job, options, page, whole, judge)
        if options.as_json:
            click.echo(json.dumps(summary(options.out, report), indent=1, allow_nan=False))
        else:
            _tell(options.out, result, job, report)
        if options.live and options.stay:
            with local_result(options.out, [CLOUD]) as folder:
                page.stay(folder / CLOUD)


def _run(
    scenario: Scenario,
    job: Job,
    options: RunOptions,
    page: Page,
    whole: ExitStack,
    judge: Callable[[RunResult], str],
) -> tuple[RunResult, dict[str, Any]]:
    """Run what is not done yet, write the result, and return it with its report.

    Once the result is in place, a note says so in any error or interrupt that ends `whole`.
    """
    formats = formats_of(scenario)
    for one in formats:
        one.check_installed()
    load_open3d()  # what writes the cloud in the end
    out = options.out

    def in_place() -> None:
        whole.enter_context(_noting_complete(out))
        store.remove()

    with result_folder(out) as folder:
        kept = Storage.at(out).below(RUN_FOLDER)
        goes_on = options.resume and FILE in kept.sizes()
        if not goes_on:
            further, own = further_files(job.survey, formats), partial(identity_of, job)
            refuse_to_replace(out, own, further, overwrite=options.overwrite)
        store = _store(job, options, kept, goes_on)
        with conducted(
            store,
            lambda waiting: cluster_of(scenario.pool, slots_needed(job), options, waiting),
            own=options.here,
            progress=shown_progress(options.quiet),
            page=nullcontext(page),
            tell=teller(options),
            keep=any(one.in_pieces for one in formats),
        ) as (result, workers):
            page.finish(result)
            if note := judge(result):
                result = replace(result, notes=(*result.notes, note))
            only_cloud = options.only == "cloud"
            what = "the cloud" if only_cloud else "the cloud, the pictures and the report"
            with shown_status(f"writing {what}", options.quiet):
                report = write_result(
                    folder, out, result, scenario, in_place, only_cloud, formats, workers
                )
    return result, report


def no_hits(job: Job) -> str:
    """Return advice for a survey without hits."""
    (x, y, z) = job.survey.pose(0).position + job.scene.origin
    where = f"the sensor begins at ({x:,.3f}, {y:,.3f}, {z:,.3f})"
    seen = seen_from(job.scene, job.survey.carried[0])
    return f"no ray hit anything: check poses, ranges and units; {where}; {seen}"


def formats_of(scenario: Scenario) -> list[Format]:
    """List the formats that a scenario exports the cloud to."""
    return [one for one in scenario.output.write if one.format != "ply"]


@contextmanager
def _noting_complete(out: Path | Storage) -> Iterator[None]:
    """Add a note to an error or interrupt that the result is complete."""
    try:
        yield
    except BaseException as error:
        error.add_note(f"The result in {out} is complete.")
        raise


def _store(job: Job, options: RunOptions, place: Storage, goes_on: bool) -> RunStore:
    """Store of the run, with what an earlier run has left if it is to be resumed."""
    if not options.resumable:
        return RunStore(job)
    if options.fresh:
        drop_run(place)
    with shown_status("checking the points of the earlier run", options.quiet or not goes_on):
        store = RunStore(job, place, options.parts, resume=options.resume)
    if options.resume and not (store.kept or store.notes):
        store.notes.append(f"there was nothing to resume in {options.out}")
    return store


def cluster_of(
    pool: PoolSection, slots: Mapping[str, int], options: RunOptions, waiting: Waiting
) -> AbstractContextManager[Client]:
    """Client of the cluster that is to be started or connected to, for so many slots."""
    if options.scheduler is not None:
        return connected(options.scheduler, options.files, waiting)
    if options.cluster is not None:
        started = started_client(options.cluster, teller(options))
        return _with_status(started, f"starting {options.cluster}", options)
    local = local_client(
        gpu_workers=pool.gpu, lidar_slots=slots[LIDAR], other_workers=pool.other,
        planning=OTHER in slots, tls=options.tls,
    )  # fmt: skip
    return _with_status(local, "starting the workers", options)


@contextmanager
def _with_status(
    cluster: AbstractContextManager[Client], starting: str, options: RunOptions
) -> Iterator[Client]:
    """Show a status until the cluster has started."""
    with ExitStack() as stack:
        with shown_status(starting, options.quiet):
            client = stack.enter_context(cluster)
            if options.here:  # its workers share the terminal
                set_logs(options.verbose)
                client.register_plugin(WorkerLogs(options.verbose))
        yield client


def teller(options: RunOptions) -> Callable[[str], None]:
    """Return what prints a note, unless it is to be quiet."""
    return lambda words: None if options.quiet else tell(f"note: {words}")


def _tell(out: Path | Storage, result: RunResult, job: Job, report: dict[str, Any]) -> None:
    for note in report["notes"]:
        click.echo(f"note: {note}")
    if not result.hits:
        click.echo(f"note: {no_hits(job)}")
    on = report["hits_on_surfaces"]
    click.echo(
        f"{counted(job.survey.scan_count, 'scan')}, {counted(result.rays, 'ray')}, "
        f"{counted(on, 'hit')} on {counted(len(job.scene.all_names), 'object')}"
        f"{f' and {result.hits - on:,} on none' if result.hits > on else ''}, "
        f"{counted(len(result.points), 'point')} in the cloud{result.thinned} "
        f"({result.backend}, {result.survey_seconds:.1f} s)"
    )
    if (plan := result.plan) is not None:
        found = "no path free of collisions was found"
        if plan.collision_free:
            found = f"path of {plan.length:.2f} m, free of collisions"
        possible = "no path is possible, the obstacles leave no way"
        if math.isfinite(plan.shortest_possible):
            possible = f"the shortest possible is {plan.shortest_possible:.2f} m"
        click.echo(f"{found}; {possible} ({plan.trials} trials, {result.planning_seconds:.1f} s)")
    click.echo(f"results in {click.format_filename(str(out))}: {', '.join(report['files'])}")

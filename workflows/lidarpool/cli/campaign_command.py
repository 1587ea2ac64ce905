"""The command `run` for campaigns, without its options: many jobs, or one of them again."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import click
from distributed import Client

from ..base.errors import LidarpoolError
from ..base.storage import Storage
from ..base.words import counted
from ..export.dataset import DataSet
from ..export.folder import output_place
from ..export.jobs import Tally
from ..live.pages import page_of
from ..pipeline import LIDAR
from ..report.campaign_output import (
    CAMPAIGN_FILE,
    Making,
    check_same,
    failures,
    job_again,
    make_dataset,
    row_of,
    verify,
)
from ..run.campaign import CampaignRun
from ..run.checks import slots_needed
from ..run.job import Job
from ..run.result import RunResult
from ..run.watch import Waiting
from ..scenario.campaign import Campaign
from ..scenario.scenario import Scenario
from .logs import set_logs
from .run_command import RunOptions, cluster_of, run_scenario, teller
from .terminal import shown_progress


def run_campaign(campaign: Campaign, options: RunOptions, retry_failed: bool) -> None:
    """Run a campaign, and print a summary; LidarpoolError if it or a job fails."""
    set_logs(options.verbose)
    if options.only:
        raise LidarpoolError("--only is for one survey: a data set is written as a whole.")
    pool = (campaign.describe(0).scenario or Scenario()).pool

    def cluster(waiting: Waiting, job: Job) -> AbstractContextManager[Client]:
        slots = slots_needed(job)
        slots[LIDAR] += 1
        if options.cluster is not None:
            options.cluster.require(slots)
        return cluster_of(pool, slots, options, waiting)

    making = Making(
        options.out, options.here, options.resume, options.fresh, retry_failed, options.verify,
        options.overwrite, options.parts, options.backend, options.wait_s, options.patience_s,
    )  # fmt: skip
    shown = campaign.count, campaign.names, campaign.title or "campaign"
    with page_of(options.live, *shown) as page:
        progress = shown_progress(options.quiet)
        run = make_dataset(campaign, making, cluster, progress, teller(options), page)
        _tell(run, options)
        if options.live and options.stay:
            page.stay()
    if run.failed:
        raise LidarpoolError(failures(run))


def _tell(run: CampaignRun, options: RunOptions) -> None:
    if options.as_json:
        told: dict[str, Any] = {
            "folder": str(options.out),
            "jobs": run.done,
            "failed": [row.name for row in run.failed],
            "points": run.points,
            "rays": run.rays,
            "seconds": run.seconds,
            "casting_seconds": run.casting_seconds,
            "resumed": run.resumed,
            "notes": list(run.notes),
        }
        click.echo(json.dumps(told, indent=1, allow_nan=False))
    else:
        for note in run.notes:
            click.echo(f"note: {note}")
        click.echo(
            f"{counted(run.done, 'job')}, {counted(run.rays, 'ray')}, "
            f"{counted(run.points, 'point')} in the data set ({run.seconds:.1f} s)"
        )
        click.echo(f"data set in {click.format_filename(str(options.out))}: see README.md there")


def run_job(campaign: Campaign, number: int, options: RunOptions) -> None:
    """Run one job of a campaign again, and write it as the result of a survey.

    Where the place is the data set of the campaign, the result is a folder in it, and its points
    must be those of the data set. LidarpoolError if they are not, or cannot be: it was made by
    other software, or its files there are damaged.
    """
    place = Storage.at(options.out)
    dataset = DataSet(place, campaign.keep.format, campaign.keep.layout)
    of_dataset = CAMPAIGN_FILE in place.entries()
    if of_dataset:
        backend = check_same(place, campaign)["backend"]
        verify(place, number)
        name = campaign.describe(number).name
        options = replace(options, out=output_place(f"{options.out}/job-{name}"), backend=backend)
    described, job = job_again(
        campaign,
        number,
        dataset.columns,
        backend=options.backend,
        wait_s=options.wait_s,
        patience_s=options.patience_s,
    )
    assert described.scenario is not None, "of a file"

    def compare(result: RunResult) -> str:
        row = row_of(place, number) if of_dataset else None
        if row is None or row.error:
            return ""
        if Tally.of(result.points).sha256 != row.sha256:
            raise LidarpoolError(
                f"job {described.name} has other points than those in {place}: files that it is "
                "made of have changed, such as images of a mesh."
            )
        return f"the points are those of job {described.name} in {place}, bit for bit"

    run_scenario(described.scenario, options, job, compare)

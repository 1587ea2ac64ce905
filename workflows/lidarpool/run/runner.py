"""A run: its jobs are cast, and their points are committed to a store.

`cast_to_store` below is the shortest kind of run: open a store, cast what is missing, and keep the
points in the store. `simulate` and the shards of surveys are runs of this kind. `run_survey`
(`report/output.py`) and `run_campaign` (`report/campaign_output.py`) do the same, and then publish
a result, such as `cloud.ply`, and remove the store. `merge` (`report/merging.py`) fills a store
with the points of shards instead of casting, and publishes it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from typing import Any

from ..datasets.dataset import DataSet
from ..datasets.job_table import JobRow
from ..identity.shard import ALL
from ..scenario.job import Job
from .cluster.cluster import ClusterConnection
from .committed import Committed
from .job_source import JobMaker, Jobs
from .listener import Listener
from .options import RunOptions
from .pipeline.stage_messages import ScanFrame
from .progress import Screen
from .run_loop import RunLoop
from .run_page import RunPage
from .run_result import RunResult
from .store.run_store import RunStore, remove_run


def cast_to_store(
    jobs: Jobs,
    options: RunOptions,
    screen: Screen,
    page: RunPage,
    on_frame: Callable[[ScanFrame], None] | None = None,
    made_of: Mapping[str, Any] | None = None,
    target: object = None,
) -> RunResult:
    """Cast the only job of a run, and leave its points in the store of the run.

    `on_frame` is called with each frame in scan order. `made_of` is stored with the points, so that
    the shards of a survey can be merged. Messages name `target`, or the store by default.
    """
    listener = Listener(page, on_frame, pace=options.pace)
    with (
        ClusterConnection(jobs, options, screen) as connection,
        open_store(jobs, options, screen, target) as store,
    ):
        committed = cast(store, connection, listener)
        result = committed.result(screen)
        store.keep(made_of, result.notes)
        page.finish(result.seconds, result)
        return result


@contextmanager
def open_store(
    jobs: Jobs, options: RunOptions, screen: Screen, target: object = None
) -> Iterator[RunStore]:
    """Open the store of a run, which may have points of an earlier run.

    `target` is the location of the result, which messages name; by default, the store.

    Notes of errors and interrupts in the body name what stays in the store.

    LidarError if the store belongs to another run, or has an unfinished run that is not to be
    continued.
    """
    if options.restart and options.folder is not None:
        remove_run(options.folder)
    checking = "checking the points of the earlier run"
    with screen.status(checking) if options.continues_run else nullcontext():
        store = RunStore(
            jobs,
            options.backend,
            options.folder,
            options.scratch_dir,
            resume=options.may_continue,
            warnings=screen.warnings,
        )
    # A task of a batch queue resumes its shard whether the shard has begun or not.
    explained = store.committed_in_words or store.notes or jobs.shard != ALL
    if options.resume and store.only_job and not explained:
        store.notes.append(f"{target or options.folder} contained no unfinished run to resume")
    with store.kept_on_error():
        yield store


def cast(
    store: RunStore,
    connection: ClusterConnection,
    listener: Listener,
    dataset: DataSet | None = None,
) -> Committed:
    """Cast all scans of a run that are not committed.

    Parameters
    ----------
    store
        Store of the run, which is committed to.
    connection
        Connection to the cluster, which is opened if anything is left to be cast.
    listener
        Object that is notified of the parts and frames of a survey.
    dataset
        Data set that the jobs of a campaign are written to. The parts of a survey stay in the
        store.

    Raises
    ------
    LidarError
        If the cluster lacks workers or software, or a task fails.
    """
    page = listener.page
    maker: JobMaker | None = None  # makes the jobs of a campaign
    if dataset is not None:
        remaining = (number for number in store.jobs.numbers if not store.db.ended(number))
        maker = JobMaker(store.jobs, remaining, dataset.columns)
    if store.only_job is not None:
        page.begun(store.only_job)
    with nullcontext() if maker is None else closing(maker):
        first = _first_job(store, maker, page)
        if first is None:
            return Committed(store)
        cluster = connection.open(first, store)
        page.follow(cluster.partitions, dataset)
        loop = RunLoop(cluster, store, maker, dataset, listener)
        with connection.screen.progress() as show:
            loop.run(first, show)
    return Committed(
        store,
        stages=loop.stages,
        seconds=time.monotonic() - store.opened_at,
        survey_seconds=loop.times.get("survey", 0.0),
        planning_seconds=loop.times.get("planning", 0.0),
        replayed=loop.replayed,
    )


def _first_job(store: RunStore, maker: JobMaker | None, page: RunPage) -> Job | None:
    """Return the first job to run, or None if nothing is left to cast, plan or deliver.

    Jobs that cannot be made are recorded as failed.
    """
    if maker is None:
        only_job = store.only_job
        assert only_job is not None, "of a survey"
        return None if only_job.complete else only_job.job
    while isinstance(entry := maker.take(wait=True), JobRow):
        store.end([entry])
        page.ended(entry)
    return entry

"""Cast the jobs of a run, and commit their points to a store.

`cast_to_store` leaves the points in the store. `run_survey` (`report/output.py`) and `run_campaign`
(`report/campaign_output.py`) also publish a result, such as `cloud.ply`, and then remove the store.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from lidarfiles.datasets.job_table import JobRow
from lidarscenario.job import Job

from .cluster.cluster import ClusterConnection
from .committed import CommittedRun
from .job_source import JobProducer, Jobs
from .listener import Listener
from .options import RunOptions
from .pipeline.stage_messages import ScanFrame
from .progress import Screen
from .run_loop import RunLoop
from .run_page import RunPage
from .run_result import RunResult
from .store.run_store import RunStore, remove_run

if TYPE_CHECKING:
    from lidarfiles.datasets.dataset import DataSet


def cast_to_store(
    jobs: Jobs,
    options: RunOptions,
    screen: Screen,
    page: RunPage,
    on_frame: Callable[[ScanFrame], None] | None = None,
    scenario_source: Mapping[str, Any] | None = None,
    target: object = None,
) -> RunResult:
    """Cast the only job of a run, leaving its points in the run store.

    `on_frame` is called with each frame, in scan order. The store records `scenario_source`, the
    path and settings of the scenario, so that shards can be merged later. Messages refer to the
    location of the result as `target`, which defaults to the location of the store.
    """
    listener = Listener(page, on_frame, pace=options.pace)
    with (
        ClusterConnection(jobs, options, screen) as connection,
        open_store(jobs, options, screen, target) as store,
    ):
        committed = cast(store, connection, listener)
        result = committed.result(screen)
        store.close_with_points(scenario_source, result.notes)
        page.finish(result.seconds, result)
        return result


@contextmanager
def open_store(
    jobs: Jobs, options: RunOptions, screen: Screen, target: object = None
) -> Iterator[RunStore]:
    """Open the store of a run, which may contain points from an earlier run.

    If the body raises an error, a note on the error states which results remain in the store.

    Parameters
    ----------
    target
        Location of the result for messages. Defaults to the location of the store.

    Raises
    ------
    LidarError
        If the store belongs to a different run, or contains an unfinished run and the options do
        not request to continue it.
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
    if options.resume:
        store.note_nothing_to_resume(target or options.folder)
    with store.kept_on_error():
        yield store


def cast(
    store: RunStore,
    connection: ClusterConnection,
    listener: Listener,
    dataset: DataSet | None = None,
) -> CommittedRun:
    """Cast those scans of a run that have not been committed.

    Parameters
    ----------
    store
        Store that the points are committed to.
    connection
        Connection to the cluster. It is opened only if there are scans to cast.
    listener
        Listener that is notified of the committed parts and frames of a survey.
    dataset
        Data set that the jobs of a campaign are written to. Pass None for a survey, whose parts
        stay in the store.

    Raises
    ------
    LidarError
        If the cluster lacks workers or software, or if a task fails.
    """
    page = listener.page
    maker: JobProducer | None = None  # only for campaigns
    if dataset is not None:
        remaining = (number for number in store.jobs.numbers if not store.db.has_ended(number))
        maker = JobProducer(store.jobs, remaining, dataset.columns)
    if store.only_job is not None:
        page.on_survey_start(store.only_job)
    with nullcontext() if maker is None else closing(maker):
        first = _first_job(store, maker, page)
        if first is None:
            return CommittedRun(store)
        cluster = connection.open(first, store)
        page.follow(cluster.partitions, dataset)
        loop = RunLoop(cluster, store, maker, dataset, listener)
        with connection.screen.progress() as show:
            committed = loop.run(first, show)
    return committed


def _first_job(store: RunStore, maker: JobProducer | None, page: RunPage) -> Job | None:
    """Return the first job to run, or None if the run is already complete.

    Jobs that cannot be created are recorded as failed.
    """
    if maker is None:
        only_job = store.only_job
        assert only_job is not None, "a run without a job maker is a survey"
        return None if only_job.is_complete else only_job.job
    while isinstance(entry := maker.pop(wait=True), JobRow):
        store.commit_jobs([entry])
        page.on_job_end(entry)
    return entry

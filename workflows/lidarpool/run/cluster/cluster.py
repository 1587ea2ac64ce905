"""Cluster of a run, which is checked before jobs are cast and monitored during the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from typing import Any, Self

from distributed import Client, get_worker
from distributed.comm.core import CommClosedError

from lidarfiles.work.cluster_map import CLUSTER_LOST, is_connection_lost
from lidarscenario.job import Job
from lidarsim.casting.scene_caster import check_backend_here
from lidarsim.errors import LidarError
from poolpart import Partition, PoolError
from poolpart.task_context import own_client

from ...processes import timeline
from ..job_source import Jobs
from ..options import RunOptions
from ..pipeline.stage_names import GPU, LIDAR, OTHER
from ..progress import Screen
from ..store.run_store import RunStore
from .checks import check_formats, check_workers, find_workers, gpu_note
from .connection import (
    BackgroundClient,
    check_starts_workers,
    connect_client,
    local_client,
    start_client,
)
from .requirements import slots_needed
from .tasks import TaskGroup
from .watch import WaitTimer, Watch


class ClusterConnection:
    """Connection of a run to its cluster. It is opened only if there are scans to cast.

    When the context is entered, workers on this machine start in the background, unless the run may
    continue an earlier run that is already complete. When the context exits, workers that were
    started for the run are stopped.

    Attributes
    ----------
    cluster
        Cluster of the run, or None until the connection is opened.
    """

    def __init__(self, jobs: Jobs, options: RunOptions, screen: Screen) -> None:
        self.cluster: Cluster | None = None
        self.screen = screen
        self._jobs = jobs
        self._options = options
        self._stack = ExitStack()
        self._local: BackgroundClient | None = None  # workers on this machine

    def __enter__(self) -> Self:
        options = self._options
        if options.starts_workers and not options.may_continue:
            job = self._jobs.only_job
            planning = job is not None and job.planning is not None
            slots = slots_needed(options, planning=planning, writing=job is None)
            self._local = self._stack.push(_start_local(options, slots))
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def open(self, first: Job, store: RunStore) -> Cluster:
        """Connect to the cluster, and check that it has enough slots for the job `first`.

        Raise LidarError if workers, memory or software are missing.
        """
        options = self._options
        if options.starts_workers:
            check_backend_here(store.backend or options.backend, store.advice)
        writing = store.only_job is None
        slots = slots_needed(options, planning=first.planning is not None, writing=writing)
        if options.cluster is not None:
            options.cluster.require(slots)
        waiting = WaitTimer(options.startup_timeout_s, self.screen.report)
        client = self._stack.enter_context(
            open_client(options, slots, waiting, self.screen, self._local)
        )
        timeline.record_step(timeline.WORKERS)
        self.cluster = Cluster(client, first, store, options, self.screen, slots, waiting)
        return self.cluster

    def close(self) -> None:
        """Stop workers that were started for the run, or disconnect from an existing cluster."""
        self.cluster = None
        self._stack.close()


def open_client(
    options: RunOptions,
    required_slots: Mapping[str, int],
    waiting: WaitTimer,
    screen: Screen,
    local: BackgroundClient | None = None,
) -> AbstractContextManager[Client]:
    """Connect to an existing cluster, or start a cluster with the required slots.

    `local` is the new cluster if it is on this machine and is already starting.
    """
    if options.client is not None:
        return nullcontext(options.client)
    if options.scheduler is not None:
        with suppress(ValueError):  # raised outside of tasks
            if get_worker().scheduler.address == options.scheduler:
                return nullcontext(own_client())
        return connect_client(options.scheduler, options.files, waiting)
    if options.cluster is not None:
        started = start_client(options.cluster, screen.report)
        return screen.start_cluster(started, f"starting {options.cluster}")
    local = local or _start_local(options, required_slots)
    return screen.start_cluster(local, "starting the workers", shares_terminal=True)


def _start_local(options: RunOptions, slots: Mapping[str, int]) -> BackgroundClient:
    check_starts_workers()
    workers = options.gpu_workers, options.other_workers
    return BackgroundClient(local_client(slots, *workers, tls=options.tls))


class Cluster:
    """Cluster of a run, which has been checked for the run's jobs.

    Parameters
    ----------
    client
        Client of the cluster.
    first
        First job to cast, for which the cluster is checked.
    store
        Store of the run, which contains the remaining jobs and the software of an earlier run.
    options
        Options of the run.
    screen
        Output for messages.
    required_slots
        Number of slots that the run requires, by partition.
    waiting
        Time limit for missing workers.

    Raises
    ------
    LidarError
        If workers, memory or software are missing.
    """

    def __init__(
        self,
        client: Client,
        first: Job,
        store: RunStore,
        options: RunOptions,
        screen: Screen,
        required_slots: Mapping[str, int],
        waiting: WaitTimer,
    ) -> None:
        self.client = client
        self.options = options
        self._screen = screen
        # The address is stored for messages about a lost cluster. It is empty for a client that was
        # never connected, which is refused below.
        self.address: str = getattr(client.scheduler, "address", "")
        if client.asynchronous:
            raise LidarError("The client is asynchronous. Create it without `asynchronous=True`.")
        self.partitions = {name: Partition(name, client) for name in (GPU, LIDAR, OTHER)}
        try:
            self._request_slots(first, store, required_slots)
            self._workers = find_workers(
                client,
                required_slots,
                store.backend or options.backend,
                store.advice,
                store.casting if store.committed_text else {},
                waiting,
                writing=store.only_job is None,
            )
            self.backend = self._workers.backend
            self.software = self._workers.software
            only_job = store.only_job
            if only_job is not None:  # data sets of campaigns only use built-in formats
                check_formats(client, self._workers.pool, first.outputs)
            store.cast_with(self.backend, self.software)
            if only_job is not None:  # the jobs of a campaign are checked when they begin
                self.check(only_job.job)
        except LidarError:
            self._release_slots()
            raise
        except Exception as error:  # the type of the error depends on the request
            if client.status != "running" or isinstance(error, CommClosedError):
                raise self._lost_error() from error
            raise
        names = sorted({name for worker in self._workers.pool for name in worker.partitions})
        self.partitions = {name: Partition(name, client) for name in names}
        # Number of LIDAR slots at the start that the long stages leave free.
        self.spare = max(1, self.partitions[LIDAR].slots - 2 - options.collectors)
        if note := gpu_note(self._workers.pool, self._workers.casting, self.backend):
            store.notes.append(note)
        self._callers_error: BaseException | None = None
        timeline.record_step(timeline.CHECKED)

    def _request_slots(
        self, first: Job, store: RunStore, required_slots: Mapping[str, int]
    ) -> None:
        """Request slots for the remaining scans. Only adaptive partitions react to the request."""
        scan_count = first.survey.scan_count * (len(store.jobs.numbers) - store.db.ended_count)
        if store.only_job is not None:
            scan_count = len(store.only_job.scans) - store.only_job.resumed
        for name, slots in required_slots.items():
            self.partitions[name].request_slots(max(slots, scan_count) if name == GPU else slots)

    def _release_slots(self) -> None:
        """Let adaptive partitions release the workers that they started for the run."""
        if self.client.status == "running":
            with suppress(PoolError, OSError):
                for partition in self.partitions.values():
                    partition.request_slots(0)

    def _lost_error(self) -> LidarError:
        return LidarError(
            f"The cluster at {self.address} is no longer reachable, or the tasks of this run were "
            "cancelled by a different client. The run ended without a result."
        )

    def tasks(self, name: str) -> TaskGroup[Any]:
        """Return an empty group of tasks for a partition."""
        return TaskGroup(self.partitions[name], self.software["lidarpool"])

    def watch(self, names: Sequence[str], lasting: Sequence[str] = ()) -> Watch:
        """Start watching the workers of the given partitions with a `Watch`."""
        return Watch(
            self.client, names, lasting, self.options.worker_timeout_s, self._screen.report
        )

    def check(self, job: Job) -> None:
        """Raise JobError if the memory of the workers is insufficient for a job."""
        check_workers(job, self.options, self.backend, self._workers.casting)

    def call(self, callback: Callable[..., None], *arguments: Any) -> None:
        """Call a callback that the user provided.

        Its errors are recorded, so that an OSError is not mistaken for an error of the cluster.
        """
        try:
            callback(*arguments)
        except BaseException as error:
            self._callers_error = error
            raise

    @contextmanager
    def partitions_page(self) -> Iterator[None]:
        """Serve the partitions page during the body, and print its address.

        Do nothing if the scheduler serves no pages, or if the cluster was started for this run.
        """
        if self.options.starts_workers:
            yield
            return
        with suppress(PoolError):
            self._screen.report(f"partitions page: {self._workers.pool.page()}")
        try:
            yield
        finally:
            if self.client.status == "running":
                with suppress(PoolError, *CLUSTER_LOST):
                    self._workers.pool.leave_page()

    @contextmanager
    def stop_on_error(self, stop: Callable[[str], None]) -> Iterator[None]:
        """If the body raises an error, call `stop` with the reason, and convert cluster errors.

        Finally, the partitions are allowed to shrink.
        """
        try:
            yield
        except BaseException as error:
            # A client that loses its scheduler cancels all futures, so tasks appear as cancelled.
            # A few seconds later the client closes, and its methods may then raise any error.
            lost = is_connection_lost(self.client, error)
            stop(f"the run was stopped: {str(error) or type(error).__name__}")
            if error is self._callers_error:
                raise
            if isinstance(error, PoolError) and not lost:
                raise LidarError(str(error)) from error
            if isinstance(error, CLUSTER_LOST) or (lost and isinstance(error, Exception)):
                raise self._lost_error() from error
            raise
        finally:
            self._release_slots()

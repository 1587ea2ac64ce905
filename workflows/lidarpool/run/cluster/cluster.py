"""A cluster that can run some jobs: checked, and watched for its loss."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

from distributed import Client, get_worker
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from lidarsim.base.errors import LidarError
from poolpart import Partition, PipeClosed, PipeFailed, PoolError
from poolpart.task_context import own_client

from ...base import timeline
from ...scenario.build import Job
from ..options import RunOptions
from ..pipeline.names import GPU, LIDAR, OTHER
from ..progress import Screen
from ..store.run_store import RunStore
from .checks import check_formats, check_workers, find_workers, gpu_note, slots_needed
from .connection import check_starts_workers, connected, local_client, started_client
from .tasks import Tasks
from .watch import Waiting, Watch

LOST_S = 0.5  # for a client to notice that its scheduler is gone

# Errors that Dask raises once the scheduler is gone; those of connections are OSErrors.
_CLUSTER_LOST = (OSError, FutureCancelledError, PipeClosed, PipeFailed)


def client_of(
    options: RunOptions, needed: Mapping[str, int], waiting: Waiting, screen: Screen
) -> AbstractContextManager[Client]:
    """Client of the cluster that is there, or started, for so many slots of each partition."""
    if options.client is not None:
        return nullcontext(options.client)
    if options.scheduler is not None:
        with suppress(ValueError):  # outside of tasks there is no worker
            if get_worker().scheduler.address == options.scheduler:
                return nullcontext(own_client())
        return connected(options.scheduler, options.files, waiting)
    if options.cluster is not None:
        started = started_client(options.cluster, screen.tell)
        return screen.starting(started, f"starting {options.cluster}")
    check_starts_workers()
    workers = options.gpu_workers, options.other_workers
    local = local_client(needed, *workers, tls=options.tls)
    return screen.starting(local, "starting the workers", own=True)


class Cluster:
    """The cluster that is there, or started, once it was checked for jobs such as `first`.

    `store` says which are left, and what earlier runs cast with; `enter` has the cluster left or
    stopped in the end. LidarError if it lacks something.
    """

    def __init__(
        self,
        first: Job,
        store: RunStore,
        options: RunOptions,
        screen: Screen,
        enter: Callable[[AbstractContextManager[Client]], Client],
    ) -> None:
        writing = store.only is None
        needed = slots_needed(options, planning=first.planning is not None, writing=writing)
        if options.cluster is not None:
            options.cluster.require(needed)
        waiting = Waiting(options.wait_s, screen.tell)
        self.client = client = enter(client_of(options, needed, waiting, screen))
        timeline.mark(timeline.WORKERS)
        self.options = options
        self._screen = screen
        # For errors about a lost cluster; a client that was never connected is refused below.
        self.address: str = getattr(client.scheduler, "address", "")
        if client.asynchronous:
            raise LidarError("The client is asynchronous: give one made without asynchronous=True.")
        self.partitions = {name: Partition(name, client) for name in (GPU, LIDAR, OTHER)}
        try:
            left = first.survey.scan_count * (len(store.jobs.numbers) - store.db.ended_count)
            if store.only is not None:
                left = len(store.only.scans) - store.only.resumed
            for name, slots in needed.items():  # partitions may grow with their work
                self.partitions[name].want(max(slots, left) if name == GPU else slots)
            self._pool, self._casting, self.backend, self.software = find_workers(
                client,
                needed,
                store.backend or options.backend,
                store.advice,
                store.casting if store.kept else {},
                waiting,
                writing=writing,
            )
            if store.only is not None:  # jobs of campaigns are written in formats of the table
                check_formats(client, self._pool, first.outputs)
            store.cast_with(self.backend, self.software)
            if store.only is not None:  # others are checked one by one
                self.check(store.only.job)
        except LidarError:
            self._want_nothing()
            raise
        except Exception as error:  # the kind depends on the request
            if client.status != "running" or isinstance(error, CommClosedError):
                raise self._lost_error() from error
            raise
        names = sorted({name for worker in self._pool for name in worker.partitions})
        self.partitions = {name: Partition(name, client) for name in names}
        # Slots of LIDAR that the long stages leave, as they are at the start.
        self.spare = max(1, self.partitions[LIDAR].slots - 2 - options.collectors)
        if note := gpu_note(self._pool, self._casting, self.backend):
            store.notes.append(note)
        self._callers_error: BaseException | None = None
        timeline.mark(timeline.CHECKED)

    def _want_nothing(self) -> None:
        """Let partitions shrink that have grown for the run."""
        if self.client.status == "running":
            with suppress(PoolError, OSError):
                for partition in self.partitions.values():
                    partition.want(0)

    def _lost_error(self) -> LidarError:
        return LidarError(
            f"The cluster at {self.address} cannot be reached any more, or somebody cancelled "
            "the tasks of this run; it has ended without a result."
        )

    def tasks(self, name: str) -> Tasks[Any]:
        """Tasks for a partition, none yet."""
        return Tasks(self.partitions[name], self.software["lidarpool"])

    def watch(self, names: Sequence[str], lasting: Sequence[str] = ()) -> Watch:
        """Watch workers of partitions from now on, see `Watch`."""
        return Watch(self.client, names, lasting, self.options.patience_s, self._screen.tell)

    def check(self, job: Job) -> None:
        """Check that the workers have memory for a job; JobError if not."""
        check_workers(job, self.options, self.backend, self._casting)

    def call(self, callback: Callable[..., None], *arguments: Any) -> None:
        """Call a callback of the caller; its OSError must not look like the cluster's."""
        try:
            callback(*arguments)
        except BaseException as error:
            self._callers_error = error
            raise

    @contextmanager
    def partitions_page(self) -> Iterator[None]:
        """Show the page of partitions while the body runs, and print its address.

        Does nothing if the scheduler serves no pages, or the cluster is the run's own.
        """
        if self.options.own:
            yield
            return
        with suppress(PoolError):
            self._screen.tell(f"partitions page: {self._pool.page()}")
        try:
            yield
        finally:
            if self.client.status == "running":
                with suppress(PoolError, *_CLUSTER_LOST):
                    self._pool.leave_page()

    @contextmanager
    def stopping(self, stop: Callable[[str], None]) -> Iterator[None]:
        """On any error of the body, call `stop` with the reason, and say if the cluster was lost.

        In the end its partitions may shrink.
        """
        try:
            yield
        except BaseException as error:
            # A client that loses its scheduler cancels all futures, so tasks look cancelled.
            # After some seconds it gives up and closes, and any call of it makes any error.
            lost = self._is_lost(error)
            stop(f"the run was stopped: {str(error) or type(error).__name__}")
            if error is self._callers_error:
                raise
            if isinstance(error, PoolError) and not lost:
                raise LidarError(str(error)) from error
            if isinstance(error, _CLUSTER_LOST) or (lost and isinstance(error, Exception)):
                raise self._lost_error() from error
            raise
        finally:
            self._want_nothing()

    def _is_lost(self, error: BaseException) -> bool:
        """Whether the scheduler is gone: a call may fail a moment before the client knows."""
        until = time.monotonic() + LOST_S
        while (
            self.client.status == "running"
            and isinstance(error, _CLUSTER_LOST)
            and time.monotonic() < until
        ):
            time.sleep(0.01)
        return self.client.status != "running"

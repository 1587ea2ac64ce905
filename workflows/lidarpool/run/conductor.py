"""Conducts a run from its store to its result, for `lidarpool run` and for `simulate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path

from distributed import Client

from poolpart import Partition

from ..pipeline import LIDAR, Frame
from ..simulator.world import check_backend_here
from .progress import Progress, Show
from .ranges import LidarWorkers
from .result import RunResult
from .run import drive, make_result
from .store import RunStore
from .watch import Waiting


class Page:
    """What a run tells its live page, see `lidarpool.live.run_page`; here of one without a page."""

    def follow(self, store: RunStore) -> None:
        """Show what is committed from now on."""

    def with_progress(self, show: Show, partitions: Mapping[str, Partition]) -> Show:
        """Return a function that calls `show`, and updates the page."""
        return show

    def on_frame(self, frame: Frame, take: Callable[[Frame], None]) -> None:
        """Call `take` with a frame, and show it."""
        take(frame)

    def finish(self, result: RunResult) -> None:
        """Show the whole result; its parts may then be removed."""

    def stay(self, cloud: Path) -> None:
        """Keep the page until its user ends it; points are read from the written `cloud`."""


@contextmanager
def conducted(
    store: RunStore,
    cluster: Callable[[Waiting], AbstractContextManager[Client]],
    *,
    own: bool,
    progress: AbstractContextManager[Callable[[Progress], None]],
    page: AbstractContextManager[Page],
    tell: Callable[[str], None],
    on_frame: Callable[[Frame], None] = lambda frame: None,
    keep: bool = False,
) -> Iterator[tuple[RunResult, LidarWorkers | None]]:
    """Do what is left of a run; the body gets its result.

    `cluster` starts a cluster or connects to one, if anything is left to do; it shares its time to
    wait with the workers. `own` says that it is a local one for this run: then the backend must be
    available here, and there is no page of partitions. With `keep` the cluster lasts as long as the
    body, which also gets workers of LIDAR that write formats of many files, or None if nothing was
    left to do.

    An error or interrupt, also of the body, is noted with how to resume. LidarpoolError if the
    cluster lacks something or a task fails.
    """
    workers = None
    with store.kept_on_error(), page as live, ExitStack() as stack:
        live.follow(store)
        if store.complete:
            result = make_result(store)
        else:
            if own:
                check_backend_here(store.backend or store.job.backend, store.advice)
            waiting = Waiting(store.job.wait_s, tell)
            client = stack.enter_context(cluster(waiting))
            with progress as show:
                result, on = drive(
                    client,
                    store,
                    tell,
                    waiting,
                    own=own,
                    on_frame=partial(live.on_frame, take=on_frame),
                    watched=live.with_progress,
                    show=show,
                )
            if keep:
                workers = LidarWorkers(client, on.partitions[LIDAR], store.job.patience_s, tell)
            else:
                stack.close()
        yield result, workers

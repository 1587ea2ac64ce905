"""Conducts a run from its store to its result, for `lidarpool run` and for `simulate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

from distributed import Client

from ..pipeline import LIDAR, Frame
from ..simulator.world import check_backend_here
from .page import Page
from .progress import Progress
from .ranges import LidarWorkers
from .result import RunResult
from .run import drive, make_result
from .store import RunStore
from .watch import Waiting


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
        live.begun(store)
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
                    on_frame=on_frame,
                    page=live,
                    show=show,
                )
            if keep:
                workers = LidarWorkers(client, on.partitions[LIDAR], store.job.patience_s, tell)
            else:
                stack.close()
        yield result, workers

"""Long-running stages 1, 3 and 4, and the pipes between them and the driver.

The functions that run on workers are in `stage1_generate.py`, `stage3_sort.py` and
`stage4_collect.py`. Each of them processes messages from the driver until a pipe is closed. A
failed pipe also ends a stage silently, because the driver knows the reason. Each stage secedes from
the thread pool of its worker but keeps its slot, so that a worker with one thread and four LIDAR
slots can run four of them.

A pipe consists of a Dask Queue and a Dask Variable, which other clients can access by name. In the
following names, RUN is the ID of the run, and N increases each time a stage is started.

===============================  ============================================
lidarpool-RUN-scans              ranges of scans and errors, from stage 1 to the driver
lidarpool-RUN-news               summaries in order, receipts and errors, from stages 3 and 4
lidarpool-RUN-generate-N         surveys to describe, from the driver to stage 1
lidarpool-RUN-sort-N             summaries, from the driver to stage 3
lidarpool-RUN-collect-C-N        batches to collect, from the driver to collector C of stage 4
===============================  ============================================
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

from distributed import Future, Lock

from lidarfiles.parts.parts import probe_name
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.words import plural
from poolpart import Partition, Pipe, PipeFailed
from poolpart.fetch import fetch_available, fetch_held_bytes
from poolpart.pipe import delete_pipes, exchange_items, set_advice
from poolpart.task_locations import PartitionSnapshot, take_snapshot

from ...identity.software import call_with_same_sources
from .failures import convert_storage_errors, memory_clause, raise_if_failed, was_killed
from .stage1_generate import generate
from .stage3_sort import sort_frames
from .stage4_collect import collect
from .stage_messages import CollectOrder, Description, Message, Receipt, StageStart, Summaries
from .stage_names import COLLECT, GENERATE, SORT
from .task_records import TaskRecord

REFRESH_EVERY_S = 0.5
SETTLE_S = 2.0  # time limit for a submitted task to start
MAX_DEATHS = 12  # maximum number of deaths of a stage without any commits in between
ASK_LOCK_S = 0.05  # time limit for acquiring the lock
LAST_WORDS_S = 3.0  # time limit for the stages to exit after everything has been committed

# `LongStages` restarts lost stages, so the pipes must not fail together with a task. A restarted
# stage may report the same items again, and their recipients recognize them.
_PIPE_OPTIONS = {"fails_with_tasks": False, "drop_repeats": False}

Order = Description | CollectOrder | Summaries  # message from the driver to a stage


@dataclass(eq=False)
class _StageTask:
    future: Future
    worker: str  # address of the worker to which the task is restricted
    inlet: Pipe  # pipe from the driver to the task
    since: float  # monotonic time of submission
    dead_since: float | None = None  # monotonic time at which its worker was found dead


class LongStages:
    """Long-running stages, each of which is started on a chosen worker and restarted if it dies.

    Dask's own scheduling does not suit tasks that run as long as the run. It may assign two stages
    to the same slot, where the second would wait forever, and it fails a task when its fourth
    worker has died.

    All stages are started together while holding a cluster-wide lock, and only if there are slots
    for all of them. Otherwise, two runs that each have some of the slots would wait for each other
    forever.

    Parameters
    ----------
    partition
        LIDAR partition.
    run
        ID of the run, which is part of the names of tasks and pipes.
    sources
        Value of ``lidarpool`` in the software of the run, which workers must have.
    storage
        Storage for parts.
    mark
        Mark of the run, which is part of the names of its files.
    queue_capacity
        Number of items that stage 1 may be ahead.
    collectors
        Number of collectors (stage 4).
    patience_s
        Time limit for missing slots, in seconds.
    """

    def __init__(
        self,
        partition: Partition,
        run: str,
        sources: str,
        storage: Storage,
        mark: str,
        *,
        queue_capacity: int,
        collectors: int,
        patience_s: float,
    ) -> None:
        self.client = partition.client
        self.partition = partition
        self.run = run
        self.collector_count = collectors
        self._sources = sources
        self._storage = storage
        self._lock_name = f"lidarpool-start-{partition.name}"
        self._patience_s = patience_s
        self._names = [GENERATE, SORT, *(f"{COLLECT}-{number}" for number in range(collectors))]
        self._tasks: dict[str, _StageTask] = {}
        self._submitted = 0
        # Name and content of a file with which workers check whether they can access the storage.
        self.probe = (probe_name(mark, run), secrets.token_bytes(16))
        scans, news = f"lidarpool-{run}-scans", f"lidarpool-{run}-news"
        self._scans = Pipe(scans, queue_capacity, self.client, **_PIPE_OPTIONS)
        self._news = Pipe(news, 64, self.client, **_PIPE_OPTIONS)  # from stages 3 and 4
        self._outbox: dict[str, list[Order]] = {}  # {name of a pipe: messages}
        self._refreshed_at = 0.0  # monotonic time of the last `refresh`
        self._progress = -1  # progress of the driver at the last `refresh`
        self._deaths: dict[str, list[str]] = {}  # {stage: workers that died since the last commit}
        self._enough_at = time.monotonic()  # last time at which there were enough slots
        self._waited_from: float | None = None  # start of the wait for slots of other runs
        self.waiting = False  # True while other runs hold the slots
        self._closed_at: float | None = None
        self._hidden: set[str] = set()  # addresses of workers that cannot access the storage
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the run."""
        noun = "worker" if len(self._hidden) == 1 else "workers"
        workers = f"{noun} {', '.join(sorted(self._hidden))} of partition {self.partition.name}"
        note = f"{workers} cannot access {self._storage.url}, so the driver wrote the parts"
        return [*self._notes, *([note] if self._hidden else [])]

    def open(self) -> None:
        """Create the pipes and the probe file, which `finish` removes."""
        with convert_storage_errors(self._storage):
            self._storage.prepare()
            self._storage.write(*self.probe)
        for pipe in (self._scans, self._news):
            pipe.create()

    # -- messages --------------------------------------------------------------------------

    def wait(
        self, seconds: float, keys: Sequence[str], *, scans: bool, linger_s: float = 0.0
    ) -> list[Message]:
        """Exchange messages with the stages, and return the received ones.

        A single request sends and receives all messages, because each request takes the driver and
        the scheduler about one millisecond.

        Parameters
        ----------
        seconds
            Maximum time to wait for a message or for a task in `keys`.
        keys
            Keys of tasks. The method also returns when one of them finishes.
        scans
            Whether to receive messages from stage 1.
        linger_s
            Time to wait for further messages after the first one.
        """
        pipes = [self._news.name, *([self._scans.name] if scans else [])]
        puts = {name: [orders] for name, orders in self._outbox.items()}
        self._outbox = {}
        news = exchange_items(self.client, seconds, pipes, keys, puts=puts, linger_s=linger_s)
        return [*chain.from_iterable(news.values())]

    def send(self, name: str, messages: Sequence[Order]) -> None:
        """Send messages to a stage during the next call of `wait`.

        Messages to a stage that is not running or is being replaced are lost. The driver sends all
        orders again when the stage has started.
        """
        task = self._tasks.get(name)
        if task is not None:
            self._outbox.setdefault(task.inlet.name, []).extend(messages)

    def set_message_scans(self, scans: int) -> None:
        """Set the number of scans in each message from stage 1."""
        set_advice(self._scans, scans)

    def store_held(self, receipt: Receipt) -> bool:
        """Store a part that a worker holds in memory.

        Returns False if the part is lost.
        """
        self._hidden.add(receipt.held_at)
        data = fetch_held_bytes(self.client, receipt.held_at, receipt.name)
        if data is None:
            return False
        with convert_storage_errors(self._storage):
            self._storage.write(receipt.name, data)
        return True

    @property
    def collectors(self) -> dict[str, str]:
        """Addresses of the workers on which collectors run, keyed by collector name."""
        return {
            name: task.worker
            for name, task in self._tasks.items()
            if name.startswith(COLLECT) and task.dead_since is None
        }

    @property
    def lacks_slot(self) -> bool:
        """True if a stage whose worker has died still waits for a free slot."""
        return any(task.dead_since is not None for task in self._tasks.values())

    # -- starting --------------------------------------------------------------------------

    def _start(self) -> None:
        """Start all stages if there are enough free slots, or else try again in the next call."""
        lock = Lock(self._lock_name, scheduler_rpc=self.client.scheduler, loop=self.client.loop)
        acquired = False
        with suppress(RuntimeError):  # another run has just removed the lock (`_forget_lock`)
            acquired = lock.acquire(timeout=ASK_LOCK_S)
        if not acquired:
            self.waiting = True
            return
        try:
            self._start_all()
        finally:
            lock.release()

    def _start_all(self) -> None:
        locations = self._locate()
        now_s = time.monotonic()
        slot_count = len(self._names)
        free = {address: count for address, count in locations.free.items() if count > 0}
        if sum(free.values()) < slot_count:
            self.waiting = locations.slots >= slot_count
            if self.waiting:
                self._waited_from = self._waited_from or now_s
                self._enough_at = now_s
            elif now_s - self._enough_at > self._patience_s:
                raise self._too_few(
                    f"Partition {self.partition.name!r} has had {plural(locations.slots, 'slot')} "
                    f"for {self._patience_s:.0f} s, but the run needs {slot_count}."
                )
            return
        self.waiting = False
        if self._waited_from is not None:
            self._notes.append(
                f"the survey waited {now_s - self._waited_from:.1f} s for other runs to release "
                f"{slot_count} slots of partition {self.partition.name}"
            )
        for name in self._names:
            self._submit(name, free)
        # The tasks must be known to the scheduler before another run can acquire the lock.
        while len(self._locate().tasks) < slot_count and time.monotonic() < now_s + SETTLE_S:
            time.sleep(0.005)

    def _too_few(self, problem: str) -> LidarError:
        return LidarError(
            f'{problem} Start another worker with `--resources "{self.partition.name}=1"` and '
            "repeat the run."
        )

    def _locate(self) -> PartitionSnapshot:
        keys = [task.future.key for task in self._tasks.values()]
        return take_snapshot(self.client, self.partition.name, keys)

    # -- restarting --------------------------------------------------------------------------

    def refresh(self, progress: int) -> tuple[Mapping[str, str], Sequence[str]]:
        """Start all stages, or restart those that have died or are waiting for a slot.

        Do nothing if the last call is recent.

        Parameters
        ----------
        progress
            Any number that increases when scans are committed.

        Returns
        -------
        Addresses of workers that have died, by the name of their stage, and the names of all stages
        that were started or restarted.

        Raises
        ------
        LidarError
            If a stage has failed or keeps dying without any commits in between, or if the partition
            has had too few slots for too long.
        """
        now_s = time.monotonic()
        if now_s - self._refreshed_at < REFRESH_EVERY_S:
            return {}, ()
        self._refreshed_at = now_s
        if progress > self._progress:
            self._progress = progress
            self._deaths = {}
        if not self._tasks:
            self._start()
            return {}, [*self._tasks]
        for name, task in self._tasks.items():
            if not was_killed(task.future):
                raise_if_failed(task.future, f"Stage {name}")
        return self._restart(now_s)

    def _restart(self, now_s: float) -> tuple[dict[str, str], list[str]]:
        """Restart stages that have died or are waiting for a slot.

        Returns the same values as `refresh`.
        """
        died: dict[str, str] = {}
        started: list[str] = []
        locations = self._locate()
        free = dict(locations.free)
        for name, task in list(self._tasks.items()):
            if task.future.status == "finished":
                self._check_end(name)
                continue
            room = max(free.values(), default=0) > 0
            # A silent worker may respond again, so it keeps its stages if no other slot is free.
            lost = task.future.status == "error" or task.worker not in locations.members
            if task.dead_since is None and (lost or (task.worker in locations.silent and room)):
                task.dead_since = now_s
                died[name] = task.worker
                self._count_death(name, task.worker)
            queued = self._is_queued(task, locations, now_s)
            if room and (queued or task.dead_since is not None):
                free[task.worker] = free.get(task.worker, 0) + queued
                self._submit(name, free)
                started.append(name)
            else:
                self._check_patience(name, task, now_s)
        return died, started

    @staticmethod
    def _is_queued(task: _StageTask, locations: PartitionSnapshot, now_s: float) -> bool:
        """Return True if a task has not started because its worker has more tasks than slots."""
        return (
            task.dead_since is None
            and now_s - task.since > SETTLE_S
            and not locations.is_long_running(task.future.key)
            and locations.free.get(task.worker, 0) < 0
        )

    def _check_patience(self, name: str, task: _StageTask, now_s: float) -> None:
        """Raise LidarError if a dead stage has waited too long for a free slot."""
        # A dead collector can be tolerated while others are running.
        spare = name.startswith(COLLECT) and self.collectors
        if task.dead_since and now_s - task.dead_since > self._patience_s and not spare:
            raise self._too_few(
                f"Since the worker of stage {name} died, the stage has waited "
                f"{self._patience_s:.0f} s for a free slot in partition {self.partition.name!r}."
            )

    def _check_end(self, name: str) -> None:
        """Raise LidarError if a stage has exited before `close` was called.

        The cause can only be a different client that has ended a pipe.
        """
        if self._closed_at is None:
            pipes = ", ".join(repr(pipe.name) for pipe in self._pipes)
            raise LidarError(
                f"Stage {name} ended too early, because a different client closed, failed or "
                f"deleted a Queue or Variable of this run ({pipes}). Repeat the run without "
                "modifying these objects."
            )

    def _count_death(self, name: str, worker: str) -> None:
        """Count the death of a worker, and raise LidarError if the stage keeps dying."""
        died = self._deaths.setdefault(name, [])
        died.append(worker)
        if len(died) > MAX_DEATHS:
            raise LidarError(
                f"Stage {name} was started {len(died)} times, and each time its worker died before "
                f"any scan was committed{memory_clause(self.client, died)}. See the logs of the "
                "LIDAR workers."
            )

    def _submit(self, name: str, free: dict[str, int]) -> None:
        """Start a stage, using a new key, on the worker with the most free slots.

        The stage gets a new pipe, and the pipe of its predecessor is deleted. If the predecessor
        was only suspended, it would otherwise take items from the pipe after resuming. Without its
        pipe, it exits and releases its slot.
        """
        worker = max(free, key=lambda address: (free[address], address))
        free[worker] -= 1
        number = self._submitted
        self._submitted += 1
        earlier = self._tasks.get(name)
        if earlier is not None:
            delete_pipes(self.client, [earlier.inlet.name])
        inlet_name = f"lidarpool-{self.run}-{name}-{number}"
        inlet = Pipe(inlet_name, 1_000_000, self.client, **_PIPE_OPTIONS).create()
        start = StageStart(self.run, name.partition("-")[0], number)
        work: dict[str, tuple[Any, ...]] = {
            GENERATE: (generate, start, inlet, self._scans),
            SORT: (sort_frames, start, inlet, self._news),
            COLLECT: (collect, start, self._storage, self.probe, inlet, self._news),
        }
        future = self.partition.submit(
            call_with_same_sources,
            self._sources,
            *work[start.stage],
            key=f"{name}-{self.run}-{number}",
            workers=worker,
        )
        self._tasks[name] = _StageTask(future, worker, inlet, time.monotonic())
        if earlier is not None:
            earlier.future.cancel()  # discards the result if the task is still running

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Shut down the stages after all results have been committed."""
        # The pipes of stage 1 are closed, too, because it may still describe a failed survey.
        for pipe in self._pipes:
            if pipe is not self._news:
                pipe.close()
        self._closed_at = time.monotonic()

    @property
    def is_closing(self) -> bool:
        """True if the stages have exited or are shutting down."""
        return self._closed_at is not None

    @property
    def _pipes(self) -> list[Pipe]:
        return [self._scans, self._news, *(task.inlet for task in self._tasks.values())]

    @property
    def has_ended(self) -> bool:
        """True if all stages have exited after `close`, or if the shutdown has timed out."""
        if self._closed_at is None:
            return False
        late = time.monotonic() - self._closed_at > LAST_WORDS_S
        return late or all(task.future.done() for task in self._tasks.values())

    def stop(self, reason: str) -> None:
        """Stop all stages immediately because the run has failed."""
        for pipe in self._pipes:
            with suppress(PipeFailed):  # the pipe has not been created or is already deleted
                pipe.fail(reason)

    def finish(self, other_futures: Sequence[Future]) -> list[TaskRecord]:
        """Wait briefly for the stages to exit, and remove their state from the scheduler.

        Parameters
        ----------
        other_futures
            Futures of other tasks, which are cancelled as well.

        Returns
        -------
        Records of the stages whose workers can be reached.
        """
        futures = [task.future for task in self._tasks.values()]
        try:
            self._closed_at = self._closed_at or time.monotonic()
            while not self.has_ended:
                time.sleep(0.01)
            ended = [future.key for future in futures if future.status == "finished"]
            results = fetch_available(self.client, ended)
            return [results[key] for key in ended if key in results]
        finally:
            delete_pipes(self.client, [pipe.name for pipe in self._pipes])
            # Dask would keep an unused lock forever.
            self.client.run_on_scheduler(_forget_lock, name=self._lock_name)
            # All futures are cancelled in one message, because the client may be closed afterwards.
            self.client.cancel([*futures, *other_futures])
            with suppress(OSError):
                self._storage.remove([self.probe[0]])


def _forget_lock(name: str, dask_scheduler: Any = None) -> None:
    semaphores = dask_scheduler.extensions["semaphores"]
    if not semaphores.leases.get(name) and not semaphores.metrics["pending"].get(name):
        semaphores.close(name=name)

"""The long-running stages 1, 3 and 4, and the pipes between them and the driver.

A pipe is a Queue and a Variable of Dask, which other clients see by its name. RUN is the id of the
run, in the keys of its tasks as well; N grows each time that a stage is started.

===============================  ============================================
lidarpool-RUN-scans              ranges of scans, from stage 1 to the driver
lidarpool-RUN-news               frames, receipts and errors, from stages 3 and 4 to the driver
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
from typing import Any

from distributed import Future, Lock

from lidarsim.base.errors import LidarError
from lidarsim.base.storage import Storage
from poolpart import Partition, Pipe, PipeFailed
from poolpart.fetch import fetch_available, take_held
from poolpart.pipe import forget_pipes, take_news
from poolpart.task_locations import TaskLocations, look_for_tasks

from ...base.software import call_alike
from ...columns.parts import probe_name
from .failures import raise_if_failed, storing, was_killed, words_on_memory
from .messages import CollectOrder, Description, Message, Receipt, StageStart, Summaries
from .names import COLLECT, GENERATE, SORT
from .placement import TaskRecord
from .stages import collect, generate, sort_frames

LOOK_EVERY_S = 0.5
SETTLE_S = 2.0  # for a task that was just submitted to start
DEATHS_MOST = 12  # deaths of one stage with nothing committed in between
ASK_LOCK_S = 0.05
LAST_WORDS_S = 3.0  # for the stages to end after everything was committed

Order = Description | CollectOrder | Summaries  # to a stage


@dataclass(eq=False)
class _Task:
    """Current state of a stage."""

    future: Future
    worker: str  # address of the one worker that it may run on
    inlet: Pipe  # from the driver
    since: float
    dead_since: float | None = None  # it has died, and has not been restarted yet


class LongStages:
    """Runs each long stage on a chosen worker, and restarts it when the worker dies.

    Dask would do both, but not in a way that suits tasks as long as the run: it may give two of
    them to one slot, where the second waits for the first for ever; and it counts the deaths of
    a task's workers, and fails the task at the fourth. All stages are started together, under a
    lock of the cluster, when there are slots for all: two runs with some of the slots each would
    wait for each other for ever.

    `run` is the run's id, part of the names of tasks and pipes; `sources` is ``lidarpool`` of its
    `software`. Parts go to `storage`, where files have the run's `mark`. Stage 1 may be
    `queue_capacity` items ahead, and slots are waited for `patience_s`.
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
        self._tasks: dict[str, _Task] = {}
        self._submitted = 0
        # A file in the storage, by which collectors find out whether they see it.
        self.probe = (probe_name(mark, run), secrets.token_bytes(16))
        self._scans = Pipe(f"lidarpool-{run}-scans", queue_capacity, self.client)
        self._news = Pipe(f"lidarpool-{run}-news", 64, self.client)  # from stages 3 and 4
        self.inbox: list[Message] = []  # what has come, for the driver to take
        self._outbox: dict[str, list[Order]] = {}  # by pipe
        self._looked_at = 0.0
        self._progress = -1  # when something was last committed
        self._deaths: dict[str, list[str]] = {}  # {name: workers that have died since then}
        self._enough_at = time.monotonic()  # slots, free or not
        self._waited_from: float | None = None  # waited for slots that others held
        self.waiting = False  # whether it waits for such slots
        self._closed_at: float | None = None
        self._hidden: set[str] = set()  # addresses of workers that do not see the storage
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """What a user should know."""
        workers = f"{', '.join(sorted(self._hidden))} of partition {self.partition.name}"
        note = f"{workers} cannot see {self._storage.url}: the driver wrote their parts"
        return [*self._notes, *([note] if self._hidden else [])]

    def open(self) -> None:
        """Make the pipes; `look` starts the stages, and `finish` must be called after this."""
        with storing(self._storage):
            self._storage.prepare()
            self._storage.write(*self.probe)
        for pipe in (self._scans, self._news):
            pipe.create()

    # -- messages --------------------------------------------------------------------------

    def wait(
        self, seconds: float, keys: Sequence[str], *, scans: bool, linger_s: float = 0.0
    ) -> None:
        """Wait until there are messages or one of some tasks has ended, at most so long.

        Then it waits a moment for more, `linger_s`.

        The same request sends what was to be sent, and takes all messages, those of stage 1 only
        if `scans` are wanted: each request costs driver and scheduler a millisecond.
        """
        pipes = [self._news.name, *([self._scans.name] if scans else [])]
        puts = {name: [orders] for name, orders in self._outbox.items()}
        self._outbox = {}
        found = take_news(self.client, seconds, pipes, keys, puts=puts, linger_s=linger_s)
        for items in found.values():
            self.inbox += items

    def send(self, name: str, messages: Sequence[Order]) -> None:
        """Send messages to a stage with the next `wait`.

        They are lost if it is not running, or is being replaced: then it gets all of it.
        """
        task = self._tasks.get(name)
        if task is not None:
            self._outbox.setdefault(task.inlet.name, []).extend(messages)

    def advise(self, scans: int) -> None:
        """Tell stage 1 how many scans an item should have."""
        self._scans.advise(scans)

    def store_held(self, receipt: Receipt) -> bool:
        """Store a part of a worker that does not see the storage; False if it is lost."""
        self._hidden.add(receipt.held_at)
        data = take_held(self.client, receipt.held_at, receipt.name)
        if data is None:
            return False
        with storing(self._storage):
            self._storage.write(receipt.name, data)
        return True

    @property
    def collectors(self) -> dict[str, str]:
        """{name of a running task of stage 4: address of its worker}."""
        return {
            name: task.worker
            for name, task in self._tasks.items()
            if name.startswith(COLLECT) and task.dead_since is None
        }

    @property
    def lacks_slot(self) -> bool:
        """Whether a stage whose worker has died waits for a free slot."""
        return any(task.dead_since is not None for task in self._tasks.values())

    # -- starting --------------------------------------------------------------------------

    def _start(self) -> None:
        """Start every stage, each on a free slot; if there are too few, the next `look` does it."""
        lock = Lock(self._lock_name, scheduler_rpc=self.client.scheduler, loop=self.client.loop)
        acquired = False
        with suppress(RuntimeError):  # another run has just removed it, see `_forget_lock`
            acquired = lock.acquire(timeout=ASK_LOCK_S)
        if not acquired:
            self.waiting = True
            return
        try:
            self._start_all()
        finally:
            lock.release()

    def _start_all(self) -> None:
        # All or none, and under a lock: two runs might each get slots that the other needs.
        seen = self._look()
        now = time.monotonic()
        needed = len(self._names)
        free = {address: count for address, count in seen.free.items() if count > 0}
        if sum(free.values()) < needed:
            self.waiting = seen.slots >= needed
            if self.waiting:
                self._waited_from = self._waited_from or now
                self._enough_at = now
            elif now - self._enough_at > self._patience_s:
                what = f"has had {seen.slots} of the {needed} slots needed for"
                raise self._too_few(f"Partition {self.partition.name!r} {what}")
            return
        self.waiting = False
        if self._waited_from is not None:
            self._notes.append(
                f"the survey waited {now - self._waited_from:.1f} s for partition "
                f"{self.partition.name}, until other runs had left it {needed} slots"
            )
        for name in self._names:
            self._submit(name, free)
        # Another run may look once the lock is free: the scheduler must know the tasks by then.
        while len(self._look().tasks) < needed and time.monotonic() < now + SETTLE_S:
            time.sleep(0.005)

    def _too_few(self, what: str, since: str = "") -> LidarError:
        return LidarError(
            f"{what} {self._patience_s:.0f} s{since}: start another worker with --resources "
            f'"{self.partition.name}=1" and run it again.'
        )

    def _look(self) -> TaskLocations:
        keys = [task.future.key for task in self._tasks.values()]
        return look_for_tasks(self.client, self.partition.name, keys)

    # -- looking after them ------------------------------------------------------------------

    def look(self, progress: int) -> tuple[Mapping[str, str], Sequence[str]]:
        """From time to time, start all stages, or those again that died or wait behind another.

        `progress` is any number that grows when something is committed. Returns the stages whose
        workers have died, {name: address}, and those that were started, for the first time or
        again.

        LidarError if a stage has failed, or keeps dying with nothing committed in between, or
        the partition has too few slots for too long.
        """
        now = time.monotonic()
        if now - self._looked_at < LOOK_EVERY_S:
            return {}, ()
        self._looked_at = now
        if progress > self._progress:
            self._progress = progress
            self._deaths = {}
        if not self._tasks:
            self._start()
            return {}, [*self._tasks]
        for name, task in self._tasks.items():
            if not was_killed(task.future):
                raise_if_failed(task.future, f"stage {name}")
        died: dict[str, str] = {}
        started: list[str] = []
        seen = self._look()
        free = dict(seen.free)
        for name, task in list(self._tasks.items()):
            if task.future.status == "finished":
                self._check_end(name)
                continue
            room = max(free.values(), default=0) > 0
            # A silent worker may wake up: it keeps its stages while there are no other slots.
            lost = task.future.status == "error" or task.worker not in seen.members
            if task.dead_since is None and (lost or (task.worker in seen.silent and room)):
                task.dead_since = now
                died[name] = task.worker
                self._count_death(name, task.worker)
            # Whether it waits behind another, on a worker with more tasks than slots.
            behind = (
                task.dead_since is None
                and now - task.since > SETTLE_S
                and not seen.runs_for_long(task.future.key)
                and seen.free.get(task.worker, 0) < 0
            )
            if room and (behind or task.dead_since is not None):
                free[task.worker] = free.get(task.worker, 0) + behind
                self._submit(name, free)
                started.append(name)
                continue
            # One of several collectors is not needed: the others do its work.
            spare = name.startswith(COLLECT) and self.collectors
            if task.dead_since and now - task.dead_since > self._patience_s and not spare:
                what = f"no free slot in partition {self.partition.name!r} for"
                raise self._too_few(f"Stage {name} has had {what}", " since its worker died")
        return died, started

    def _check_end(self, name: str) -> None:
        """LidarError if a stage has ended before `close`, as when somebody ends its pipe."""
        if self._closed_at is None:
            pipes = ", ".join(repr(pipe.name) for pipe in self._pipes)
            raise LidarError(
                f"Stage {name} has ended too early: another client has closed, failed or deleted a "
                f"Queue or Variable of this run ({pipes}). Leave these alone, and run it again."
            )

    def _count_death(self, name: str, worker: str) -> None:
        """LidarError when a stage keeps dying."""
        died = self._deaths.setdefault(name, [])
        died.append(worker)
        if len(died) > DEATHS_MOST:
            raise LidarError(
                f"stage {name} was started {len(died)} times, and each time its worker died before "
                f"anything was committed{words_on_memory(self.client, died)}: look into the logs "
                "of the LIDAR workers."
            )

    def _submit(self, name: str, free: dict[str, int]) -> None:
        """Start a stage, under a new key, on the worker with the most free slots.

        It gets a new pipe: a predecessor that was only stopped would take items out of a shared
        one when it wakes up, and keep its slot. Without its pipe it ends.
        """
        worker = max(free, key=lambda address: (free[address], address))
        free[worker] -= 1
        number = self._submitted
        self._submitted = self._submitted + 1
        earlier = self._tasks.get(name)
        if earlier is not None:
            forget_pipes(self.client, [earlier.inlet.name])
        inlet = Pipe(f"lidarpool-{self.run}-{name}-{number}", 1_000_000, self.client).create()
        me = StageStart(self.run, name.partition("-")[0], number)
        work: dict[str, tuple[Any, ...]] = {
            GENERATE: (generate, me, inlet, self._scans),
            SORT: (sort_frames, me, inlet, self._news),
            COLLECT: (collect, me, self._storage, self.probe, inlet, self._news),
        }
        future = self.partition.submit(
            call_alike,
            self._sources,
            *work[me.stage],
            key=f"{name}-{self.run}-{number}",
            workers=worker,
        )
        self._tasks[name] = _Task(future, worker, inlet, time.monotonic())
        if earlier is not None:
            earlier.future.cancel()  # if it still runs, its result is dropped

    # -- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Let all stages end: everything is committed."""
        # Stage 1 may still describe a survey that has failed.
        for pipe in self._pipes:
            if pipe is not self._news:
                pipe.close()
        self._closed_at = time.monotonic()

    @property
    def closed(self) -> bool:
        """Whether the stages were told to end."""
        return self._closed_at is not None

    @property
    def _pipes(self) -> list[Pipe]:
        return [self._scans, self._news, *(task.inlet for task in self._tasks.values())]

    @property
    def ended(self) -> bool:
        """True once all stages have exited after `close`, or the shutdown timeout has elapsed."""
        if self._closed_at is None:
            return False
        late = time.monotonic() - self._closed_at > LAST_WORDS_S
        return late or all(task.future.done() for task in self._tasks.values())

    def stop(self, reason: str) -> None:
        """End all stages at once, because the run has failed."""
        for pipe in self._pipes:
            with suppress(PipeFailed):  # not made yet, or gone already
                pipe.fail(reason)

    def finish(self, others: Sequence[Future]) -> list[TaskRecord]:
        """Wait a moment for the stages to end, and clean up the scheduler; cancel others as well.

        Returns the records of the stages whose workers can be reached.
        """
        futures = [task.future for task in self._tasks.values()]
        try:
            self._closed_at = self._closed_at or time.monotonic()
            while not self.ended:
                time.sleep(0.01)
            ended = [future.key for future in futures if future.status == "finished"]
            found = fetch_available(self.client, ended)
            return [found[key] for key in ended if key in found]
        finally:
            forget_pipes(self.client, [pipe.name for pipe in self._pipes])
            # Dask would keep the lock; another run may hold it.
            self.client.run_on_scheduler(_forget_lock, name=self._lock_name)
            # In one message: the answer to a second one could miss a client that leaves.
            self.client.cancel([*futures, *others])
            with suppress(OSError):
                self._storage.remove([self.probe[0]])


def _forget_lock(name: str, dask_scheduler: Any = None) -> None:
    semaphores = dask_scheduler.extensions["semaphores"]
    if not semaphores.leases.get(name) and not semaphores.metrics["pending"].get(name):
        semaphores.close(name=name)

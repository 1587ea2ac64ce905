"""The long-running tasks of stages 1, 3 and 4: starts them on free slots, and again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from distributed import Client, Future, Lock

from poolpart import Partition, Whereabouts, look_for_tasks

from ..base.errors import LidarpoolError
from ..base.software import call_alike
from .failures import raise_if_failed, was_killed, words_on_memory

LOOK_EVERY_S = 0.5
SETTLE_S = 2.0  # for a task that was just submitted to start
DEATHS_MOST = 12  # deaths of one stage with nothing committed in between
ASK_LOCK_S = 0.05

# Makes a stage's task from the number of the attempt: a function and its arguments.
Work = tuple[Callable[..., Any], tuple[Any, ...]]
Command = Callable[[int], Work]


@dataclass(eq=False)
class _Task:
    """Current state of a stage."""

    future: Future
    worker: str  # address of the one worker that it may run on
    since: float
    dead_since: float | None = None  # it has died, and has not been restarted yet
    died: list[str] = field(default_factory=list)  # earlier workers, in a row
    progress: int = -1  # progress when it last died


class LongStages:
    """Runs each stage on a chosen worker, and restarts it when the worker dies.

    Dask would do both, but not in a way that suits tasks as long as the run: it may give two of
    them to one slot, where the second waits for the first for ever; and it counts the deaths of
    a task's workers, and fails the task at the fourth. All stages are started together, under a
    lock of the cluster, when there are slots for all: two runs with some of the slots each would
    wait for each other for ever.

    Parameters
    ----------
    client, partition
        Where the stages run.
    run
        Id of the run, part of the tasks' keys.
    sources
        ``lidarpool`` of the run's `software`.
    commands
        Makers of the stages' tasks, by name; called for each start.
    on_death
        Called with the name of a stage whose worker has died.
    patience_s
        How long to wait for slots, seconds.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        run: str,
        sources: str,
        commands: Mapping[str, Command],
        on_death: Callable[[str], None],
        patience_s: float,
    ) -> None:
        self.client, self.partition, self.run = client, partition, run
        self._sources = sources
        self._commands, self._on_death, self._patience_s = commands, on_death, patience_s
        self._tasks: dict[str, _Task] = {}
        self._submitted = 0
        self._looked_at = 0.0
        self._enough_at = time.monotonic()  # slots, free or not
        self._waited_from: float | None = None  # waited for slots that others held
        self.waiting = False  # whether it waits for such slots
        self.notes: list[str] = []  # what a user should know

    @property
    def futures(self) -> dict[str, Future]:
        """The stages by name."""
        return {name: task.future for name, task in self._tasks.items()}

    @property
    def done(self) -> bool:
        """Whether all have ended."""
        return all(task.future.done() for task in self._tasks.values())

    def worker_of(self, name: str) -> str:
        """Address of the worker of a running stage; else ""."""
        task = self._tasks.get(name)
        return task.worker if task and task.dead_since is None else ""

    def start(self) -> None:
        """Start every stage, each on a free slot; if there are too few, `look` does it later.

        Raises
        ------
        LidarpoolError
            If the partition has too few slots for too long.
        """
        lock = Lock(self._lock_name, scheduler_rpc=self.client.scheduler, loop=self.client.loop)
        acquired = False
        with suppress(RuntimeError):  # another run has just removed it, see `forget_lock`
            acquired = lock.acquire(timeout=ASK_LOCK_S)
        if not acquired:
            self.waiting = True
            return
        try:
            self._start_all()
        finally:
            lock.release()

    @property
    def _lock_name(self) -> str:
        return f"lidarpool-start-{self.partition.name}"

    def forget_lock(self) -> None:
        """Remove the lock from the scheduler unless another run holds it: Dask would keep it."""
        self.client.run_on_scheduler(_forget_lock, name=self._lock_name)

    def _start_all(self) -> None:
        seen = self._look()
        free = {address: count for address, count in seen.free.items() if count > 0}
        now, needed = time.monotonic(), len(self._commands)
        if sum(free.values()) >= needed:
            self.waiting = False
            if self._waited_from is not None:
                self.notes.append(
                    f"the survey waited {now - self._waited_from:.1f} s for partition "
                    f"{self.partition.name}, until other runs had left it {needed} slots"
                )
            for name in self._commands:
                self._submit(name, free)
            # Another run may look once the lock is free: the scheduler must know the tasks by then.
            deadline = now + SETTLE_S
            keys = {task.future.key for task in self._tasks.values()}
            while self._look().tasks.keys() < keys and time.monotonic() < deadline:
                time.sleep(0.005)
            return
        self.waiting = seen.slots >= needed
        if self.waiting:
            self._waited_from = self._waited_from or now
            self._enough_at = now
        elif now - self._enough_at > self._patience_s:
            raise LidarpoolError(
                f"Partition {self.partition.name!r} has had {seen.slots} of the {needed} slots "
                f"needed for {self._patience_s:.0f} s: start another worker with "
                f'--resources "{self.partition.name}=1" and run it again.'
            )

    def _look(self) -> Whereabouts:
        keys = [task.future.key for task in self._tasks.values()]
        return look_for_tasks(self.client, self.partition.name, keys)

    def look(self, progress: int) -> None:
        """From time to time, restart stages that died or wait behind another.

        Parameters
        ----------
        progress
            Any number that grows when something is committed.

        Raises
        ------
        LidarpoolError
            If a stage has failed, or keeps dying with nothing committed in between.
        """
        now = time.monotonic()
        if now - self._looked_at < LOOK_EVERY_S:
            return
        self._looked_at = now
        if not self._tasks:
            self.start()
            return
        self._check()
        seen = self._look()
        free = dict(seen.free)
        for name, task in list(self._tasks.items()):
            if task.future.status == "finished":
                continue
            room = max(free.values(), default=0) > 0
            # A silent worker may wake up: it keeps its stages while there are no other slots.
            if task.dead_since is None and (
                self._has_died(task, seen) or (task.worker in seen.silent and room)
            ):
                task.dead_since = now
                self._on_death(name)
            if task.dead_since is not None:
                if room:
                    self._restart(name, task, free, progress)
                else:
                    self._wait_for_slot(name, now - task.dead_since)
            elif room and self._is_behind_another(task, seen, now):
                free[task.worker] += 1
                self._on_death(name)
                self._submit(name, free)

    def _check(self) -> None:
        for name, task in self._tasks.items():
            if task.future.status != "error" or not was_killed(task.future):
                raise_if_failed(task.future, f"stage {name}")

    def _has_died(self, task: _Task, seen: Whereabouts) -> bool:
        if task.future.status == "error":
            return True
        return task.worker not in seen.members

    def _is_behind_another(self, task: _Task, seen: Whereabouts, now: float) -> bool:
        """Whether a task waits behind another on a worker with more tasks than slots."""
        settled = now - task.since > SETTLE_S
        behind = not seen.runs_for_long(task.future.key) and seen.free.get(task.worker, 0) < 0
        return settled and behind

    def _wait_for_slot(self, name: str, seconds: float) -> None:
        """LidarpoolError when a stage has had no slot for long.

        One of several collectors is not needed: the others do its work.
        """
        kind = name.partition("-")[0]
        spare = any(
            other != name and other.startswith(kind) and task.dead_since is None
            for other, task in self._tasks.items()
        )
        if seconds > self._patience_s and not spare:
            raise LidarpoolError(
                f"Stage {name} has had no free slot in partition {self.partition.name!r} for "
                f"{self._patience_s:.0f} s since its worker died: start another worker with "
                f'--resources "{self.partition.name}=1" and run it again.'
            )

    def _restart(self, name: str, task: _Task, free: dict[str, int], progress: int) -> None:
        died = [*(task.died if progress == task.progress else []), task.worker]
        if len(died) > DEATHS_MOST:
            raise LidarpoolError(
                f"stage {name} was started {len(died)} times, and each time its worker died before "
                f"anything was committed{words_on_memory(self.client, died)}: look into the logs "
                "of the LIDAR workers."
            )
        self._submit(name, free)
        self._tasks[name].died, self._tasks[name].progress = died, progress

    def _submit(self, name: str, free: dict[str, int]) -> None:
        """Start a stage, under a new key, on the worker with the most free slots."""
        worker = max(free, key=lambda address: (free[address], address))
        free[worker] -= 1
        number, self._submitted = self._submitted, self._submitted + 1
        function, arguments = self._commands[name](number)
        earlier = self._tasks.get(name)
        key = f"{name}-{self.run}-{number}"
        future = self.partition.submit(
            call_alike, self._sources, function, *arguments, key=key, workers=worker
        )
        self._tasks[name] = _Task(future, worker, time.monotonic())
        if earlier is not None:
            # If it still runs, it ends with its pipe; its result is dropped.
            earlier.future.cancel()


def _forget_lock(name: str, dask_scheduler: Any = None) -> None:
    semaphores = dask_scheduler.extensions["semaphores"]
    if not semaphores.leases.get(name) and not semaphores.metrics["pending"].get(name):
        semaphores.close(name=name)

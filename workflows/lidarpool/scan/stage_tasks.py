"""The long-running tasks of stages 1, 3 and 4: started where there is room, and kept alive."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from distributed import Client, Future, KilledWorker

from poolpart import Partition, Slots, look_at_slots

from .. import watch
from ..errors import LidarpoolError

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 0.5
SETTLE_S = 2.0  # for a task that was just submitted to start
DEATHS_MOST = 5  # of one stage with nothing delivered in between

# Makes what a stage is to do, from the attempt's number: a function and its arguments.
Command = Callable[[int], tuple[Callable[..., Any], tuple[Any, ...]]]


@dataclass(eq=False)
class _Task:
    """One stage as it runs now."""

    future: Future
    worker: str  # address of the one worker that it may run on
    since: float
    dead_since: float | None = None  # it cannot be started again
    deaths: int = 0  # in a row
    progress: int = -1  # what had been delivered when it last died


class StageTasks:
    """Runs each stage on a worker of its own choosing, and starts it again when that dies.

    Dask would do both, in ways that do not fit tasks as long as the run: it may give two of
    them to one slot, where the second waits until the first has ended, which it never does;
    and it blames a task for the deaths of the workers it ran on, so that the fourth ends it.

    Parameters
    ----------
    client
        Client of the cluster.
    partition
        Where the stages run.
    key
        Makes a key of a name.
    commands
        What each stage is to do, by name; asked again each time the stage is started.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        key: Callable[[str], str],
        commands: Mapping[str, Command],
    ) -> None:
        self.client, self.partition = client, partition
        self._key, self._commands = key, commands
        self._tasks: dict[str, _Task] = {}
        self._submitted = 0
        self._looked_at = 0.0

    @property
    def futures(self) -> dict[str, Future]:
        """The stages by name."""
        return {name: task.future for name, task in self._tasks.items()}

    @property
    def done(self) -> bool:
        """Whether all have ended."""
        return all(task.future.done() for task in self._tasks.values())

    def start(self) -> None:
        """Start every stage, each on a free slot as far as there are any."""
        free = dict(look_at_slots(self.client, self.partition.name).free)
        for name in self._commands:
            self._submit(name, free)

    def look(self, progress: int) -> None:
        """See, once in a while, to stages that died or wait behind another.

        Parameters
        ----------
        progress
            Any number that grows when something is delivered.

        Raises
        ------
        LidarpoolError
            If a stage keeps dying with nothing delivered in between.
        """
        now = time.monotonic()
        if now - self._looked_at < LOOK_EVERY_S:
            return
        self._looked_at = now
        slots = look_at_slots(
            self.client, self.partition.name, [task.future.key for task in self._tasks.values()]
        )
        free = dict(slots.free)
        for name, task in list(self._tasks.items()):
            if task.future.status == "finished":
                continue
            if self._has_died(task, slots):
                if max(free.values(), default=0) > 0:
                    self._restart(name, task, free, progress)
                else:
                    self._mourn(name, task, now)
            elif self._waits(task, slots, now) and max(free.values(), default=0) > 0:
                free[task.worker] += 1
                self._submit(name, free)

    def _has_died(self, task: _Task, slots: Slots) -> bool:
        if task.future.status == "error":
            return was_killed(task.future)
        return task.worker not in slots.present

    def _waits(self, task: _Task, slots: Slots, now: float) -> bool:
        """Whether a task is behind another on a worker that has more than its slots hold."""
        settled = now - task.since > SETTLE_S
        return (
            settled and task.future.key not in slots.running and slots.free.get(task.worker, 0) < 0
        )

    def _mourn(self, name: str, task: _Task, now: float) -> None:
        """Note a stage that has no slot to be started in; LidarpoolError when that lasts.

        One of several collectors is not missed: the others do its work.
        """
        task.dead_since = task.dead_since or now
        if now - task.dead_since > watch.PATIENCE_S and not self._is_spare(name):
            raise LidarpoolError(
                f"Stage {name} has had no free slot in partition {self.partition.name!r} for "
                f"{watch.PATIENCE_S:.0f} s since its worker died: start another worker with "
                f'--resources "{self.partition.name}=1" and run it again.'
            )

    def _is_spare(self, name: str) -> bool:
        kind = name.partition("-")[0]
        return any(
            other != name and other.startswith(kind) and task.dead_since is None
            for other, task in self._tasks.items()
        )

    def _restart(self, name: str, task: _Task, free: dict[str, int], progress: int) -> None:
        deaths = 1 if progress != task.progress else task.deaths + 1
        if deaths > DEATHS_MOST:
            raise LidarpoolError(
                f"stage {name} was started {deaths} times, and each time its worker died before "
                "anything was delivered: look into the logs of the LIDAR workers."
            )
        self._submit(name, free)
        self._tasks[name].deaths, self._tasks[name].progress = deaths, progress
        logger.info("stage %s was started again; its worker had died", name)

    def _submit(self, name: str, free: dict[str, int]) -> None:
        """Start a stage, under a key of its own, where most slots are free."""
        if not free:
            raise LidarpoolError(
                f"Partition {self.partition.name!r} has no worker that takes tasks, for stage "
                f'{name}: start one with --resources "{self.partition.name}=1".'
            )
        worker = max(free, key=lambda address: (free[address], address))
        free[worker] -= 1
        number, self._submitted = self._submitted, self._submitted + 1
        function, arguments = self._commands[name](number)
        earlier = self._tasks.get(name)
        future = self.partition.submit(
            function, *arguments, key=f"{self._key(name)}-{number}", worker=worker
        )
        self._tasks[name] = _Task(future, worker, time.monotonic())
        if earlier is not None:
            # Where it still runs after all, it ends with the pipes; what comes twice is dropped.
            earlier.future.cancel()


def was_killed(future: Future) -> bool:
    """Whether a failed task was given up by Dask because its workers kept dying."""
    return isinstance(future.exception(timeout=10), KilledWorker)

"""The long-running tasks of stages 1, 3 and 4: started where there is room, and kept alive."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from distributed import Client, Future

from poolpart import Partition, Slots, claim_slots, drop_claim, look_at_slots

from .. import watch
from ..errors import LidarpoolError
from .failures import was_killed, words_on_memory

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 0.5
SETTLE_S = 2.0  # for a task that was just submitted to start
DEATHS_MOST = 12  # of one stage with nothing delivered in between; `Handover` needs up to eight

# Makes what a stage is to do, from the attempt's number: a function and its arguments.
Work = tuple[Callable[..., Any], tuple[Any, ...]]
Command = Callable[[int], Work]


@dataclass(eq=False)
class _Task:
    """One stage as it runs now."""

    future: Future
    worker: str  # address of the one worker that it may run on
    since: float
    dead_since: float | None = None  # it has died, and was not started again yet
    died: list[str] = field(default_factory=list)  # earlier workers, in a row
    progress: int = -1  # what had been delivered when it last died


class StageTasks:
    """Runs each stage on a worker of its own choosing, and starts it again when that dies.

    Dask would do both, in ways that do not fit tasks as long as the run: it may give two of
    them to one slot, where the second waits until the first has ended, which it never does;
    and it blames a task for the deaths of the workers it ran on, so that the fourth ends it.
    The stages are started all together, when there are slots for all of them: two runs that
    each had some of the slots would wait for each other for ever.

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
    on_deaths
        Called with the names of stages whose workers have died, before any is started again.
    where
        Says, for a message, how far a stage had come.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        key: Callable[[str], str],
        commands: Mapping[str, Command],
        on_deaths: Callable[[list[str]], None],
        where: Callable[[str], str],
    ) -> None:
        self.client, self.partition = client, partition
        self._on_deaths, self._where = on_deaths, where
        self._key, self._commands = key, commands
        self._tasks: dict[str, _Task] = {}
        self._submitted = 0
        self._looked_at = 0.0
        self._enough_at = time.monotonic()  # slots, free or not
        self._refused_at: float | None = None  # first, because other runs held them
        self.waiting = False  # for slots that others hold, to start with
        self.notes: list[str] = []  # what a user should know

    @property
    def futures(self) -> dict[str, Future]:
        """The stages by name."""
        return {name: task.future for name, task in self._tasks.items()}

    @property
    def _first_keys(self) -> list[str]:
        """Keys of the stages as they are started first, for which slots are claimed."""
        return [f"{self._key(name)}-{number}" for number, name in enumerate(self._commands)]

    @property
    def done(self) -> bool:
        """Whether all have ended."""
        return all(task.future.done() for task in self._tasks.values())

    def start(self) -> None:
        """Start every stage, each on a free slot; if there are too few, `look` does it later.

        Raises
        ------
        LidarpoolError
            If the partition has too few slots, and goes on having too few.
        """
        keys = self._first_keys
        claim = claim_slots(self.client, self.partition.name, keys)
        now = time.monotonic()
        self.waiting = not claim.granted and claim.slots >= len(keys)
        if claim.granted:
            free = dict(claim.free)
            if self._refused_at is not None:
                self.notes.append(
                    f"the survey waited {now - self._refused_at:.1f} s for partition "
                    f"{self.partition.name}, until other runs had left it {len(keys)} slots"
                )
            for name in self._commands:
                self._submit(name, free)
        elif self.waiting:
            self._refused_at = self._refused_at or now
            self._enough_at = now
        elif now - self._enough_at > watch.PATIENCE_S:
            raise LidarpoolError(
                f"Partition {self.partition.name!r} has had {claim.slots} of the {len(keys)} "
                f"slots needed for {watch.PATIENCE_S:.0f} s: start another worker with "
                f'--resources "{self.partition.name}=1" and run it again.'
            )

    def give_back(self) -> None:
        """Give back the slots that were granted and not used."""
        drop_claim(self.client, self._first_keys)

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
        if not self._tasks:
            self.start()
            return
        slots = look_at_slots(
            self.client, self.partition.name, [task.future.key for task in self._tasks.values()]
        )
        free = dict(slots.free)
        self._mark_dead(slots, now)
        for name, task in list(self._tasks.items()):
            if task.future.status == "finished":
                continue
            has_room = max(free.values(), default=0) > 0
            if task.dead_since is not None:
                if has_room:
                    self._restart(name, task, free, progress)
                else:
                    self._mourn(name, task, now)
            elif has_room and self._waits(task, slots, now):
                free[task.worker] += 1
                self._submit(name, free)

    def _mark_dead(self, slots: Slots, now: float) -> None:
        """Note the stages whose workers have died; all that died together in one go."""
        going = {
            name: task
            for name, task in self._tasks.items()
            if task.future.status != "finished" and task.dead_since is None
        }
        dead = [name for name, task in going.items() if self._has_died(task, slots)]
        # A worker that is silent may wake up: its stages are left to it while there is no
        # other place for them.
        places = sum(max(0, count) for count in slots.free.values()) - len(dead)
        silent = [n for n, t in going.items() if n not in dead and t.worker in slots.silent]
        dead += silent[: max(0, places)]
        for name in dead:
            going[name].dead_since = now
        if dead:
            self._on_deaths(dead)

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
        since = now if task.dead_since is None else task.dead_since
        if now - since > watch.PATIENCE_S and not self._is_spare(name):
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
        died = [*(task.died if progress == task.progress else []), task.worker]
        if len(died) > DEATHS_MOST:
            raise LidarpoolError(
                f"stage {name} was started {len(died)} times{self._where(name)}, and each time "
                f"its worker died before anything was delivered"
                f"{words_on_memory(self.client, died)}: look into the logs of the LIDAR workers."
            )
        self._submit(name, free)
        self._tasks[name].died, self._tasks[name].progress = died, progress
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

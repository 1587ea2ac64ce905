"""The GPU workers and their casting tasks: wanted, prepared, refused, paused, silent, gone."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import Enum
from typing import Any

from distributed import Client, Future

from poolpart import Partition, Whereabouts, fetch_available, look_for_tasks

from ..base.errors import LidarpoolError
from ..base.software import difference, software_there
from .cast import intersect
from .failures import raise_if_failed, rig_is_missing, was_killed, words_on_memory
from .messages import Span
from .names import INTERSECT
from .rigs import RigPlan, drop_rig

LOOK_EVERY_S = 1.0
SETUP_DEATHS = 4  # workers in a row that may die while they prepare themselves
ANSWER_S = 1.0  # longest wait for a prepared worker's answer without a sign of life
RELEASE_S = 3.0  # for workers to drop their rigs
PREPARING = "preparing the scene on the GPU workers"


class Outcome(Enum):
    """State of a casting task that has not failed by itself."""

    PENDING = "pending"
    DONE = "done"
    KILLED = "killed"  # its worker died or left
    NO_RIG = "no rig"  # its worker has dropped the scene


class CastingWorkers:
    """The GPU workers with a rig, and their tasks; each makes its own rig, including late ones.

    A worker's software is checked before it unpickles anything: a worker with other sources of
    lidarpool, or whose NumPy or ray caster gives other bits, is refused by name and casts nothing.

    Rigs have the name `handle` and are made of `plan`; `software` is that of the workers that may
    cast, see `base.software`.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        handle: str,
        plan: RigPlan,
        software: Mapping[str, str],
    ) -> None:
        self._client, self._partition = client, partition
        self.handle, self._packed = handle, plan.packed()
        self._backend, self._software = plan.backend, dict(software)
        self._plan: Future | None = None  # the packed plan, on the workers
        self._setups: dict[str, Future] = {}  # {address: task that is preparing the worker}
        # {address of a worker that is prepared: batches at a time}. The answers are not kept on the
        # workers: one with a result cannot be returned to the queue.
        self._prepared: dict[str, int] = {}
        self._refused: dict[str, str] = {}  # {address: reason of refusal}
        self._count = self._offered = 0
        self._casts: dict[str, Future] = {}  # {key: casting task}
        self._died: list[str] = []  # workers that died while preparing, in a row
        self._looked_at = float("-inf")
        self.seen = Whereabouts()
        self._wanted = -1  # slots, as the scheduler knows
        self._adapts = True  # the partition grows with what is wanted, as far as known
        self.notes: list[str] = []  # what a user should know

    @property
    def slots(self) -> dict[str, int]:
        """{address of a prepared worker that takes tasks: batches at a time}."""
        return {a: slots for a, slots in self._prepared.items() if a in self.seen.free}

    @property
    def slot_count(self) -> int:
        """Batches that all prepared workers cast at a time; at least 1."""
        return max(1, sum(self.slots.values()))

    @property
    def futures(self) -> list[Future]:
        """All tasks."""
        plan = [self._plan] if self._plan else []
        return [*self._casts.values(), *self._setups.values(), *plan]

    @property
    def pending(self) -> list[str]:
        """Keys of the tasks that have not ended."""
        casts = [key for key, future in self._casts.items() if future.status == "pending"]
        return casts + [future.key for future in self._setups.values()]

    # -- casting ---------------------------------------------------------------------------

    def cast(self, spans: Sequence[Span], worker: str) -> str:
        """Offer batches to a worker as one task; returns its key."""
        # A key of its own for each offer: a task that is released and submitted again under its
        # key stays with the worker that still runs it, whatever `workers` says (in 4 of 4 tries).
        self._offered += 1
        key = f"{INTERSECT}-{self.handle}-{spans[0][0]}-{spans[-1][1]}.{self._offered}"
        self._casts[key] = self._partition.submit(
            intersect, self.handle, spans, key=key, workers=worker
        )
        return key

    def outcome(self, key: str) -> Outcome:
        """State of a casting task; LidarpoolError if it has failed."""
        future = self._casts[key]
        if future.status == "finished":
            return Outcome.DONE
        if future.status == "error" and rig_is_missing(future):
            return Outcome.NO_RIG
        if future.status == "error" and was_killed(future):
            return Outcome.KILLED
        raise_if_failed(future, f"stage {INTERSECT}")  # the error names the scans
        return Outcome.PENDING

    def forget(self, key: str) -> None:
        """Cancel a casting task, or drop its result."""
        if (future := self._casts.pop(key, None)) is not None:
            future.release()

    def words_on_memory(self, worker: str) -> str:
        """Clause for a message about a dead worker, if a nanny ended it for its memory."""
        return words_on_memory(self._client, [worker])

    # -- preparing workers -------------------------------------------------------------------

    def look(self) -> Whereabouts | None:
        """From time to time, handle workers that have joined or left, or take no tasks.

        Returns where workers and casting tasks are, None if it is not time to look. LidarpoolError
        if preparing the scene fails, or kills several workers in a row.
        """
        if time.monotonic() - self._looked_at <= LOOK_EVERY_S:
            self._check()
            return None
        self._looked_at = time.monotonic()
        keys = [future.key for future in self.futures]
        self.seen = look_for_tasks(self._client, self._partition.name, keys)
        known = self._setups.keys() | self._prepared.keys()
        for address in known - self.seen.members:
            self._remove(address)
        for address in sorted(self.seen.free.keys() - known):
            if address not in self._refused:
                self._prepare(address)
        self._check()
        return self.seen

    def _check(self) -> None:
        """Record the workers that are prepared."""
        for address, future in list(self._setups.items()):
            if future.status == "finished" and address in self.seen.free:
                self._take(address, future)
            elif future.status == "error" and not was_killed(future):
                raise_if_failed(future, PREPARING)
        if self._plan is not None and self._plan.status in ("lost", "cancelled", "error"):
            self._plan = None  # sent again for the next worker that needs it

    def drop(self, address: str) -> None:
        """Prepare a worker again: its rig is gone."""
        self._setups.pop(address, None)
        self._prepared.pop(address, None)

    def want(self, slots: int) -> None:
        """Want so many slots of a partition that grows with its work; 0 when there is no more.

        The driver binds each batch to a worker, so that no batch waits for workers to come.
        """
        if slots != self._wanted and self._adapts:
            self._wanted = slots
            self._adapts = self._partition.want(slots)
        if not slots:
            self._plan = None  # it would keep a worker

    def release(self) -> None:
        """Let the workers drop their rigs, as far as they can be reached."""
        addresses = [a for a in self.slots if a in self.seen.members]
        self._prepared.clear()
        if self._client.status == "running":
            self.want(0)
        if addresses and self._client.status == "running":
            # Dask tries for half a minute to reach a worker that is ending.
            with suppress(TimeoutError):
                self._client.run(
                    drop_rig,
                    self.handle,
                    workers=addresses,
                    on_error="ignore",
                    callback_timeout=RELEASE_S,
                )

    def _prepare(self, address: str) -> None:
        if self._plan is None:
            key = f"scene-{self.handle}-{self._count}"
            self._plan = share(self._partition, self._packed, key=key)
        self._count += 1
        self._setups[address] = self._partition.submit(
            _preparation(self._backend, self._software),
            self.handle,
            self._plan,
            key=f"prepare-{self.handle}-{self._count}",
            priority=10,
            workers=address,
        )

    def _take(self, address: str, future: Future) -> None:
        """Record a worker that has answered; one that has stopped since is asked again."""
        found = fetch_available(self._client, [future.key], ANSWER_S, at=address)
        if future.key not in found:
            return
        answer: dict[str, Any] = found[future.key]
        del self._setups[address]
        if differs := difference(answer["software"], self._software):
            self._refused[address] = differs
            self.notes.append(
                f"worker {answer['worker']} at {address} has {differs}: it cast nothing"
            )
            if self._refused.keys() >= self.seen.members:
                raise LidarpoolError(
                    f"No worker of partition {self._partition.name!r} has the run's software: the "
                    f"one at {address} has {differs}. Install the same on all."
                )
            return
        self._prepared[address] = max(1, answer["slots"].get(self._partition.name, 1))
        self._died.clear()

    def _remove(self, address: str) -> None:
        """Remove a worker that has gone; the scene may have killed it."""
        self._refused.pop(address, None)
        if self._prepared.pop(address, None) is not None:
            return
        future = self._setups.pop(address)
        place = self.seen.tasks.get(future.key)
        if place is not None and place.deaths:
            self._died.append(address)
        if len(self._died) >= SETUP_DEATHS and not self.slots:
            raise LidarpoolError(
                f"{PREPARING} has killed {len(self._died)} of them in a row"
                f"{words_on_memory(self._client, self._died)}: "
                "look into their logs, or try another backend."
            )


def share(partition: Partition, thing: Any, **options: Any) -> Future:
    """Have a thing on a worker, for tasks to fetch; Dask makes it again if that worker dies."""
    with warnings.catch_warnings():
        # A large one makes a large graph, which is the only way to have it recomputed.
        warnings.filterwarnings("ignore", message="Sending large graph")
        return partition.submit(_same, thing, **options)


def _same(thing: Any) -> Any:
    return thing


def _preparation(backend: str, wanted: dict[str, str]) -> Callable[[str, bytes], dict[str, Any]]:
    """Make the task that prepares a worker.

    It is nested, so that it is sent by value: a worker without the package, or with another
    version, can still say so.
    """
    software = software_there(backend)

    def prepare(handle: str, packed: bytes) -> dict[str, Any]:
        from distributed import get_worker

        worker = get_worker()
        slots = {name: int(count) for name, count in worker.state.total_resources.items()}
        here = software()
        if here == wanted:
            from lidarpool.pipeline.rigs import set_up

            set_up(handle, packed)
        return {"worker": str(worker.name), "software": here, "slots": slots}

    return prepare

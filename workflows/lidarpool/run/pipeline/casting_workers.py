"""The GPU workers and their casting tasks: wanted, checked, refused, paused, silent, gone."""

from __future__ import annotations

import pickle
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from typing import Any

import cloudpickle
from distributed import Future

from lidarsim.base.errors import LidarError
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Survey
from poolpart import Partition
from poolpart.fetch import fetch_available
from poolpart.task_locations import TaskLocations, look_for_tasks
from poolpart.workers import worker_identities

from ...base.software import difference, software_there
from .batches import Outcome
from .failures import JobError, error_of, raise_if_failed, was_killed, words_on_memory
from .messages import BatchRange
from .names import INTERSECT
from .rigs import CastWork, RigFailed, RigMissing, drop_all, intersect

LOOK_EVERY_S = 1.0
_UNSENT = pickle.PicklingError, TypeError, AttributeError, ValueError, RecursionError
SETUP_DEATHS = 4  # workers in a row that may die while they are checked
ANSWER_S = 1.0  # longest wait for a checked worker's answer without a sign of life
RELEASE_S = 3.0  # for workers to drop their rigs
SPARE_SCENES = 2  # of which no survey is under way, kept for the next one
INLINE_BYTES = 1 << 17  # larger things are sent to a worker once, and fetched from there by others
CHECKING = "checking the casting workers"
PREPARING = "preparing the scene on the casting workers"


@dataclass(eq=False)
class _Packed:
    """What tasks bring to workers that lack it: bytes, or what a worker has of a large thing."""

    name: str  # on the workers
    pack: Callable[[], bytes]  # makes it, again if it is lost
    data: bytes | Future
    sent: set[str] = field(default_factory=set)  # addresses of workers that it was sent to
    there: set[str] = field(default_factory=set)  # of those that have it

    def release(self) -> None:
        """Let the cluster forget it now: frames of a job's error may keep this object a while."""
        if isinstance(self.data, Future):
            self.data.release()


class CastingWorkers:
    """The GPU workers that may cast, and their casting tasks, for all jobs of a run.

    A worker's software is checked before it unpickles anything: a worker with other sources of
    lidarpool, or whose NumPy or ray caster gives other bits, is refused by name and casts nothing.
    The first tasks of a job on a worker bring what that worker makes its rig of.

    Each task is bound to one worker. Dask lets such a task wait for ever when the worker is gone,
    so `look` asks every second which workers there are. In return, Dask never fails a task for the
    deaths of its neighbours, and the driver knows which batches a dead worker had.

    `run` is the run's id; `software` is that of the workers that may cast, see `base.software`.
    """

    def __init__(
        self, partition: Partition, run: str, backend: str, software: Mapping[str, str]
    ) -> None:
        self._client = partition.client
        self._partition = partition
        self.run = run
        self._backend = backend
        self._software = dict(software)
        # {job: what its rig is made of: a plan, and the scene's still part, which others may share}
        self._jobs: dict[int, tuple[_Packed, _Packed]] = {}
        # Of jobs, and those used last; what packs them keeps what they are known by.
        self._scenes: dict[tuple[int, ...], _Packed] = {}
        self._unneeded: dict[str, list[str]] = {}  # {address: rigs and scenes it may drop}
        self._setups: dict[str, Future] = {}  # {address: task that is checking the worker}
        # {address of a worker that may cast: tasks at a time}. The answers are not kept on the
        # workers: one with a result cannot be returned to the queue.
        self._checked: dict[str, int] = {}
        self._refused: dict[str, str] = {}  # {address: reason of refusal}
        self._count = 0  # of the names and keys that were given
        self._casts: dict[str, tuple[Future, list[int]]] = {}  # {key: casting task, its jobs}
        self._died: list[str] = []  # workers that died while they were checked, in a row
        self._looked_at = float("-inf")
        self.seen = TaskLocations()
        self._wanted = -1  # slots, as the scheduler knows
        self._adapts = True  # the partition grows with what is wanted, as far as known
        self.notes: list[str] = []  # what a user should know

    @property
    def slots(self) -> dict[str, int]:
        """{address of a worker that was checked and takes tasks: tasks at a time}."""
        return {a: slots for a, slots in self._checked.items() if a in self.seen.free}

    @property
    def slot_count(self) -> int:
        """Tasks that all workers cast at a time; at least 1."""
        return max(1, sum(self.slots.values()))

    @property
    def futures(self) -> list[Future]:
        """All tasks."""
        brought = [one.data for one in self._packed_things if isinstance(one.data, Future)]
        return [*(cast for cast, _ in self._casts.values()), *self._setups.values(), *brought]

    @property
    def _packed_things(self) -> list[_Packed]:
        return [*(rig for rig, _ in self._jobs.values()), *self._scenes.values()]

    @property
    def pending(self) -> list[str]:
        """Keys of the tasks that have not ended."""
        casts = [key for key, (future, _) in self._casts.items() if future.status == "pending"]
        return casts + [future.key for future in self._setups.values()]

    # -- jobs ------------------------------------------------------------------------------

    def add(self, job: int, scene: Scene, survey: Survey) -> tuple[bytes, str]:
        """Let a job be cast; returns its survey, pickled, and a name that jobs of one scene share.

        JobError if it cannot be pickled.
        """
        try:
            packed = _pickled(survey)
            # What identifies its still part while it exists: jobs of it share their trees.
            key = tuple(id(getattr(scene, f.name)) for f in fields(scene) if f.name != "actors")
            still = self._scenes.pop(key, None)
            if still is None:
                still = self._packed("scene", lambda: _pickled(scene.with_actors(())))
            self._scenes[key] = still  # the last used
            plan = still.name, scene.actors, packed, self._backend
            self._jobs[job] = self._packed(str(job), lambda: _pickled(plan)), still
        except _UNSENT as error:  # of pickling what a user has defined
            raise JobError(f"The survey cannot be sent to the workers: {error}") from error
        return packed, still.name

    def remove(self, job: int) -> None:
        """Cast nothing more of a job.

        With the next task of another, the workers drop its rig, and scenes that were not used last.
        """
        if (left := self._jobs.pop(job, None)) is None:
            return
        old = [left[0]]
        if len(self._scenes) > SPARE_SCENES:
            used = [scene for _, scene in self._jobs.values()]
            spare = [key for key, scene in self._scenes.items() if scene not in used]
            old += [self._scenes.pop(key) for key in spare[: max(0, len(spare) - SPARE_SCENES)]]
        for packed in old:
            packed.release()
            for address in packed.sent & self._checked.keys():
                self._unneeded.setdefault(address, []).append(packed.name)

    def _packed(self, what: str, pack: Callable[[], bytes]) -> _Packed:
        data = pack()
        self._count += 1
        name = f"{self.run}.{what}-{self._count}"
        return _Packed(name, pack, data if len(data) <= INLINE_BYTES else self._shared(name, data))

    def _shared(self, name: str, data: bytes) -> Future:
        self._count += 1
        return share(self._partition, data, key=f"{name}-packed-{self._count}", priority=10)

    def _brought(self, packed: _Packed, worker: str) -> bytes | Future | None:
        """Return what a task brings to a worker; None if it is there."""
        if worker in packed.there:
            return None
        packed.sent.add(worker)
        if isinstance(packed.data, Future) and packed.data.status in ("lost", "cancelled", "error"):
            packed.data = self._shared(packed.name, packed.pack())
        return packed.data

    # -- casting ---------------------------------------------------------------------------

    def cast(self, batches: Iterable[tuple[int, BatchRange]], worker: str) -> str:
        """Offer batches, each with its job, to a worker as one task; returns its key.

        The jobs must share a scene.
        """
        spans: dict[int, list[BatchRange]] = {}
        for job, span in batches:
            spans.setdefault(job, []).append(span)
        first = next(iter(spans))
        works = [CastWork(job, self._jobs[job][0].name, tuple(of)) for job, of in spans.items()]
        things = [self._jobs[first][1], *(self._jobs[job][0] for job in spans)]
        brought = [self._brought(packed, worker) for packed in things]
        # A key of its own for each offer: a task that is released and submitted again under its
        # key stays with the worker that still runs it, whatever `workers` says (in 4 of 4 tries).
        self._count += 1
        key = f"{INTERSECT}-{self.run}-{first}-{spans[first][0][0]}.{self._count}"
        unneeded = self._unneeded.pop(worker, [])
        future = self._partition.submit(
            intersect, works, unneeded, *brought, key=key, workers=worker
        )
        self._casts[key] = future, [*spans]
        return key

    def outcome(self, key: str, worker: str) -> Outcome:
        """State of a casting task; JobError if it has failed, and is of one job."""
        future, jobs = self._casts[key]
        status = future.status
        if status == "pending":
            return Outcome.PENDING
        packed = {thing for job in jobs for thing in self._jobs.get(job, ())}
        if status == "finished":
            for one in packed:
                one.there.add(worker)
            return Outcome.DONE
        error = error_of(future)
        if isinstance(error, RigMissing):
            for one in packed:
                one.there.discard(worker)
            return Outcome.NO_RIG
        if was_killed(future):
            return Outcome.DIED
        if status == "error" and len(jobs) > 1:
            return Outcome.DIVIDE
        what = PREPARING if isinstance(error, RigFailed) else f"stage {INTERSECT}"
        raise_if_failed(future, what, JobError)  # whose words name the scans
        return Outcome.PENDING

    def forget(self, key: str) -> None:
        """Cancel a casting task, or drop its result."""
        if (cast := self._casts.pop(key, None)) is not None:
            cast[0].release()

    def words_on_memory(self, worker: str) -> str:
        """Clause for a message about a dead worker, if a nanny ended it for its memory."""
        return words_on_memory(self._client, [worker])

    # -- checking workers --------------------------------------------------------------------

    def look(self) -> TaskLocations | None:
        """From time to time, handle workers that have joined or left, or take no tasks.

        Returns where workers and casting tasks are, None if it is not time to look. LidarError
        if no worker may cast, or several in a row die while they are checked.
        """
        if time.monotonic() - self._looked_at <= LOOK_EVERY_S:
            self._check()
            return None
        self._looked_at = time.monotonic()
        keys = [future.key for future in self.futures]
        self.seen = look_for_tasks(self._client, self._partition.name, keys)
        known = self._setups.keys() | self._checked.keys()
        for address in known - self.seen.members:
            self._remove(address)
        for address in sorted(self.seen.free.keys() - known - self._refused.keys()):
            self._count += 1
            self._setups[address] = self._partition.submit(
                software_there(self._backend),
                key=f"check-{self.run}-{self._count}",
                priority=10,
                workers=address,
            )
        self._check()
        return self.seen

    def _check(self) -> None:
        """Record the workers that may cast."""
        answered = {}
        for address, future in self._setups.items():
            if future.status == "finished" and address in self.seen.free:
                answered[future.key] = address
            elif future.status == "error" and not was_killed(future):
                raise_if_failed(future, CHECKING)
        if not answered:
            return
        # All at a time: one by one, 200 workers on a busy machine took minutes. A worker that has
        # stopped since is asked again.
        found = fetch_available(self._client, answered, ANSWER_S)
        identities = worker_identities(self._client)
        for key, software in found.items():
            address = answered[key]
            if address in identities:  # else it has left
                self._take(address, software, identities[address])

    def want(self, slots: int) -> None:
        """Want so many slots of a partition that grows with its work; 0 when there is no more.

        The driver binds each batch to a worker, so that no batch waits for workers to come.
        """
        if slots != self._wanted and self._adapts:
            self._wanted = slots
            self._adapts = self._partition.want(slots)
        if not slots:  # what workers have for tasks would keep these workers
            for packed in self._packed_things:
                packed.release()
            self._jobs.clear()
            self._scenes.clear()

    def release(self) -> None:
        """Let the workers drop their rigs, as far as they can be reached."""
        addresses = [*self._checked.keys() & self.seen.members]
        self._checked.clear()
        if self._client.status == "running":
            self.want(0)
        if addresses and self._client.status == "running":
            # Dask tries for half a minute to reach a worker that is ending.
            with suppress(TimeoutError):
                self._client.run(
                    drop_all,
                    self.run,
                    workers=addresses,
                    on_error="ignore",
                    callback_timeout=RELEASE_S,
                )

    def _take(self, address: str, software: Mapping[str, str], identity: Mapping[str, Any]) -> None:
        """Record a worker that has answered, with the software that it has."""
        del self._setups[address]
        if differs := difference(software, self._software):
            self._refused[address] = differs
            self.notes.append(
                f"worker {identity['name']} at {address} has {differs}: it cast nothing"
            )
            if self._refused.keys() >= self.seen.members:
                raise LidarError(
                    f"No worker of partition {self._partition.name!r} has the run's software: the "
                    f"one at {address} has {differs}. Install the same on all."
                )
            return
        slots = identity["resources"].get(self._partition.name, 1)
        self._checked[address] = max(1, int(slots))
        self._died.clear()

    def _remove(self, address: str) -> None:
        """Remove a worker that has gone."""
        self._refused.pop(address, None)
        self._unneeded.pop(address, None)
        for packed in self._packed_things:
            packed.there.discard(address)
        if self._checked.pop(address, None) is not None:
            return
        future = self._setups.pop(address)
        place = self.seen.tasks.get(future.key)
        if place is not None and place.deaths:
            self._died.append(address)
        if len(self._died) >= SETUP_DEATHS and not self.slots:
            raise LidarError(
                f"{CHECKING} has killed {len(self._died)} of them in a row"
                f"{words_on_memory(self._client, self._died)}: "
                "look into their logs."
            )


def _pickled(thing: object) -> bytes:
    data: bytes = cloudpickle.dumps(thing, protocol=5)
    return data


def share(partition: Partition, thing: Any, **options: Any) -> Future:
    """Have a thing on a worker, for tasks to fetch; Dask makes it again if that worker dies."""
    with warnings.catch_warnings():
        # A large one makes a large graph, which is the only way to have it recomputed.
        warnings.filterwarnings("ignore", message="Sending large graph")
        return partition.submit(_same, thing, **options)


def _same(thing: Any) -> Any:
    return thing

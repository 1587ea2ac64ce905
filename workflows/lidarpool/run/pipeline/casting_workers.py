"""GPU workers and their casting tasks.

Workers may join, leave, stop responding or be paused at any time, and are checked before they cast.
"""

from __future__ import annotations

import pickle
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from typing import Any
from urllib.parse import urlsplit

import cloudpickle
from distributed import Future
from distributed.utils import get_ip

from lidarsim.errors import LidarError, message_of
from lidarsim.scene.scene import Scene
from lidarsim.survey.survey import Survey
from poolpart import Partition
from poolpart.fetch import fetch_available
from poolpart.task_locations import PartitionSnapshot, take_snapshot
from poolpart.workers import worker_identities

from ...identity.software import describe_difference, software_query
from ...processes.shared_memory import Pickled, SharedHandle, SharedValue
from .batches import Outcome
from .failures import DeviceLost, JobError, error_of, memory_clause, raise_if_failed, was_killed
from .rigs import MemoryUnseen, RigFailed, RigMissing, drop_all
from .stage2_intersect import CastWork, intersect
from .stage_messages import BatchRange
from .stage_names import INTERSECT

REFRESH_EVERY_S = 1.0
_UNSENT = pickle.PicklingError, TypeError, AttributeError, ValueError, RecursionError
LOST_DEVICES = 3  # number of processes that lose their GPU before the run fails
SETUP_DEATHS = 4  # number of consecutive workers that die while being checked before the run fails
ANSWER_S = 1.0  # time limit for fetching the answer of a worker that does not respond
RELEASE_S = 3.0  # time limit for workers to drop their rigs
SPARE_SCENES = 2  # number of unused scenes that are kept for the next survey
INLINE_BYTES = 1 << 17  # larger payloads are not sent with each task
CHECKING = "Checking the casting workers"
PREPARING = "Preparing the scene on the casting workers"


class CastingWorkers:
    """GPU workers of a run and their casting tasks, which may belong to several jobs.

    The software of a worker is checked before the worker unpickles anything. A worker is refused if
    it has different sources of lidarpool, or a version of NumPy or of the ray caster that may
    produce different bits. The first tasks of a job on a worker carry the plan and the scene from
    which the worker builds its rig.

    Each task is restricted to one worker. If this worker leaves, Dask lets the task wait forever,
    so `refresh` checks every second which workers exist. The advantage is that Dask never fails a
    task because of other tasks on a dead worker, and that the driver knows which batches a dead
    worker had.

    Parameters
    ----------
    partition
        GPU partition.
    run
        ID of the run.
    backend
        Name of the ray-casting backend.
    software
        Software that workers must have, as returned by `identity.software.software`.
    """

    def __init__(
        self, partition: Partition, run: str, backend: str, software: Mapping[str, str]
    ) -> None:
        self._client = partition.client
        self._partition = partition
        self.run = run
        self._backend = backend
        self._software = dict(software)
        # {job: (plan of its rig, static part of its scene)}. Several jobs may share a scene.
        self._jobs: dict[int, tuple[_Payload, _Payload]] = {}
        # {ids of the fields of a scene: static part of the scene}, in order of their last use. The
        # payload keeps a reference to the scene, so that the ids remain valid.
        self._scenes: dict[tuple[int, ...], _Payload] = {}
        self._workers: dict[str, _Worker] = {}  # {address: worker}
        self._name_count = 0  # number of names and keys that have been generated
        self._casts: dict[str, tuple[Future, list[int]]] = {}  # {key: (casting task, its jobs)}
        self._died: list[str] = []  # consecutive workers that died while being checked
        self._refreshed_at = float("-inf")
        self.locations = PartitionSnapshot()
        self._requested_slots = -1  # last number that was sent to the scheduler
        self._adapts = True  # False once the partition is known not to be adaptive
        self.notes: list[str] = []  # notes for the user
        self._lost_devices: set[str] = set()  # processes whose GPU has stopped responding

    @property
    def slots(self) -> dict[str, int]:
        """Number of concurrent tasks for each usable worker, by address.

        A worker is usable if it passed all checks and accepts tasks.
        """
        free = self.locations.free
        return {
            a: worker.slots for a, worker in self._workers.items() if worker.slots and a in free
        }

    @property
    def slot_count(self) -> int:
        """Total number of concurrent casting tasks on all workers, or 1 if there are none."""
        return max(1, sum(self.slots.values()))

    @property
    def futures(self) -> list[Future]:
        """Futures of all casting tasks, worker checks and shared payloads."""
        shared = [payload.future for payload in self._payloads if payload.future is not None]
        return [*(cast for cast, _ in self._casts.values()), *self._checks.values(), *shared]

    @property
    def _casting(self) -> set[str]:
        return {a for a, worker in self._workers.items() if worker.slots}

    @property
    def _refused(self) -> set[str]:
        return self._workers.keys() - self._casting - self._checks.keys()

    @property
    def _checks(self) -> dict[str, Future]:
        """Unfinished software checks of workers, keyed by worker address."""
        return {a: worker.check for a, worker in self._workers.items() if worker.check is not None}

    @property
    def _payloads(self) -> list[_Payload]:
        return [*(rig for rig, _ in self._jobs.values()), *self._scenes.values()]

    @property
    def pending(self) -> list[str]:
        """Keys of the unfinished tasks."""
        casts = [key for key, (future, _) in self._casts.items() if future.status == "pending"]
        return casts + [check.key for check in self._checks.values()]

    # -- jobs ------------------------------------------------------------------------------

    def register_job(self, job: int, scene: Scene, survey: Survey) -> tuple[bytes, str]:
        """Register a job to be cast.

        Returns
        -------
        The pickled survey of the job, and a name that is the same for all jobs with this scene.

        Raises
        ------
        JobError
            If the job cannot be pickled.
        """
        try:
            packed: bytes = cloudpickle.dumps(survey, protocol=5)
            # Jobs with the same key have the same static scene, and share its trees.
            key = tuple(id(getattr(scene, f.name)) for f in fields(scene) if f.name != "actors")
            static_scene = self._scenes.pop(key, None)
            if static_scene is None:
                static_scene = self._payload("scene", lambda: scene.with_actors(()))
            self._scenes[key] = static_scene  # moves it to the end
            plan = static_scene.name, scene.actors, packed, self._backend
            self._jobs[job] = self._payload(str(job), lambda: plan), static_scene
        except _UNSENT as error:  # raised when pickling user-defined classes
            raise JobError(
                f"The survey cannot be sent to the workers: {message_of(error)}"
            ) from error
        return packed, static_scene.name

    def remove(self, job: int) -> None:
        """Stop casting a job.

        Workers drop its rig and old unused scenes when they receive their next task.
        """
        if (payloads := self._jobs.pop(job, None)) is None:
            return
        old = [payloads[0]]
        if len(self._scenes) > SPARE_SCENES:
            used = [scene for _, scene in self._jobs.values()]
            spare = [key for key, scene in self._scenes.items() if scene not in used]
            old += [self._scenes.pop(key) for key in spare[: max(0, len(spare) - SPARE_SCENES)]]
        for payload in old:
            payload.release()
            for address in payload.recipients & self._casting:
                self._workers[address].unneeded.append(payload.name)

    def _payload(self, label: str, make: Callable[[], object]) -> _Payload:
        self._name_count += 1
        return _Payload(f"{self.run}.{label}-{self._name_count}", make, self._partition)

    # -- casting ---------------------------------------------------------------------------

    def submit(self, batches: Iterable[tuple[int, BatchRange]], worker: str) -> str:
        """Submit a task that casts several batches on a worker, and return its key.

        Each batch is given as its job and its scans. The jobs must share a scene.
        """
        spans: dict[int, list[BatchRange]] = {}
        for job, span in batches:
            spans.setdefault(job, []).append(span)
        first = next(iter(spans))
        works = [
            CastWork(job, self._jobs[job][0].name, tuple(spans_of_job))
            for job, spans_of_job in spans.items()
        ]
        payloads = [self._jobs[first][1], *(self._jobs[job][0] for job in spans)]
        arguments = [payload.argument_for(worker) for payload in payloads]
        # Each offer has a new key. If a task is released and submitted again with the same key,
        # Dask leaves it on the worker that is still running it, regardless of `workers`.
        self._name_count += 1
        key = f"{INTERSECT}-{self.run}-{first}-{spans[first][0][0]}.{self._name_count}"
        unneeded = []
        if worker in self._workers:
            unneeded = self._workers[worker].unneeded
            self._workers[worker].unneeded = []
        future = self._partition.submit(
            intersect, works, unneeded, *arguments, key=key, workers=worker
        )
        self._casts[key] = future, [*spans]
        return key

    def outcome(self, key: str, worker: str) -> Outcome:
        """Return the outcome of a casting task.

        Raise JobError if the task has failed and contains batches of a single job.
        """
        future, jobs = self._casts[key]
        status = future.status
        if status == "pending":
            return Outcome.PENDING
        payloads = {payload for job in jobs for payload in self._jobs.get(job, ())}
        if status == "finished":
            for payload in payloads:
                payload.record_copy(worker)
            return Outcome.DONE
        error = error_of(future)
        if isinstance(error, RigMissing):
            for payload in payloads:
                payload.record_loss(worker, unseen=isinstance(error, MemoryUnseen))
            return Outcome.NO_RIG
        if isinstance(error, DeviceLost):
            self._count_lost_device(error, worker)
            return Outcome.DIED
        if was_killed(future):
            return Outcome.DIED
        if status == "error" and len(jobs) > 1:
            return Outcome.SEPARATE_JOBS
        activity = PREPARING if isinstance(error, RigFailed) else f"Stage {INTERSECT}"
        raise_if_failed(future, activity, JobError)  # the message includes the scans
        return Outcome.PENDING

    def _count_lost_device(self, error: DeviceLost, worker: str) -> None:
        """Refuse a worker that has lost its GPU, and raise LidarError if this keeps happening."""
        if error.process in self._lost_devices:
            return
        self._lost_devices.add(error.process)
        # When the process has been restarted, it has a new address and is no longer refused.
        self._workers[worker] = _Worker(None)
        self.notes.append(f"the GPU of {worker} stopped responding ({error})")
        if not error.restarts:
            raise LidarError(
                f"The GPU of {worker} stopped responding ({error}), and the worker has no nanny "
                "that would restart it. Restart the worker and continue with `--resume`."
            )
        if len(self._lost_devices) >= LOST_DEVICES:
            raise LidarError(
                f"GPUs have failed {LOST_DEVICES} times, most recently on {worker} ({error}). "
                "Check the output of nvidia-smi and dmesg there, and continue with `--resume`."
            )

    def release_task(self, key: str) -> None:
        """Cancel a casting task, or release its result."""
        if (cast := self._casts.pop(key, None)) is not None:
            cast[0].release()

    def memory_clause(self, worker: str) -> str:
        """Return a clause for messages if a worker was terminated for using too much memory."""
        return memory_clause(self._client, [worker])

    # -- checking workers --------------------------------------------------------------------

    def refresh(self) -> PartitionSnapshot | None:
        """Update the list of workers, unless it was updated recently.

        Returns
        -------
        Locations of the workers and casting tasks, or None if the last update is recent.

        Raises
        ------
        LidarError
            If no worker can be used, or if several consecutive workers die while being checked.
        """
        if time.monotonic() - self._refreshed_at <= REFRESH_EVERY_S:
            self._check()
            return None
        self._refreshed_at = time.monotonic()
        keys = [future.key for future in self.futures]
        self.locations = take_snapshot(self._client, self._partition.name, keys)
        for address in self._workers.keys() - self.locations.members - self._refused:
            self._remove(address)
        for address in sorted(self.locations.free.keys() - self._workers.keys()):
            self._name_count += 1
            check = self._partition.submit(
                software_query(self._backend),
                key=f"check-{self.run}-{self._name_count}",
                priority=10,
                workers=address,
            )
            self._workers[address] = _Worker(check)
        self._check()
        return self.locations

    def _check(self) -> None:
        """Process the results of finished software checks."""
        addresses = {}
        for address, future in self._checks.items():
            if future.status == "finished" and address in self.locations.free:
                addresses[future.key] = address
            elif future.status == "error" and not was_killed(future):
                raise_if_failed(future, CHECKING)
        if not addresses:
            return
        # All answers are fetched together. Fetching them one by one took minutes with 200 workers.
        # If a worker has stopped responding, its answer is fetched in a later call.
        answers = fetch_available(self._client, addresses, ANSWER_S)
        identities = worker_identities(self._client)
        for key, software in answers.items():
            address = addresses[key]
            if address in identities:  # otherwise the worker has left
                self._accept(address, software, identities[address])

    def request_slots(self, slots: int) -> None:
        """Tell an adaptive partition how many slots are needed. Pass 0 after all jobs have ended.

        The request is necessary because each batch is restricted to an existing worker, so that no
        tasks wait for further workers.
        """
        if slots != self._requested_slots and self._adapts:
            self._requested_slots = slots
            self._adapts = self._partition.request_slots(slots)
        if not slots:  # workers that hold payloads would not be retired
            for payload in self._payloads:
                payload.release()
            self._jobs.clear()
            self._scenes.clear()

    def release(self) -> None:
        """Make all reachable workers drop their rigs."""
        addresses = [*self._casting & self.locations.members]
        for address in self._casting:
            del self._workers[address]
        if self._client.status == "running":
            self.request_slots(0)
        if addresses and self._client.status == "running":
            # Dask would spend half a minute trying to reach a worker that is exiting.
            with suppress(TimeoutError):
                self._client.run(
                    drop_all,
                    self.run,
                    workers=addresses,
                    on_error="ignore",
                    callback_timeout=RELEASE_S,
                )

    def _accept(
        self, address: str, software: Mapping[str, str], identity: Mapping[str, Any]
    ) -> None:
        """Accept a worker if its software matches, or refuse it otherwise."""
        worker = self._workers[address]
        worker.check = None
        if differs := describe_difference(software, self._software):
            self.notes.append(
                f"worker {identity['name']} at {address} was not used because it has {differs}"
            )
            if self._refused >= self.locations.members:
                raise LidarError(
                    f"No worker of partition {self._partition.name!r} has the software that the "
                    f"run requires. The worker at {address} has {differs}. Install the same "
                    "versions on all workers."
                )
            return
        worker.slots = max(1, int(identity["resources"].get(self._partition.name, 1)))
        self._died.clear()

    def _remove(self, address: str) -> None:
        check = self._workers.pop(address).check
        for payload in self._payloads:
            payload.record_loss(address)
        if check is None:
            return
        location = self.locations.tasks.get(check.key)
        if location is not None and location.deaths:
            self._died.append(address)
        if len(self._died) >= SETUP_DEATHS and not self.slots:
            raise LidarError(
                f"{len(self._died)} casting workers in a row died while they were checked"
                f"{memory_clause(self._client, self._died)}. See their logs."
            )


class _Payload:
    """Value that is sent with a casting task if the worker does not have a copy yet.

    Small values are sent with the tasks. Large values are stored in shared memory, which workers on
    this machine can map. Other workers receive a future of the pickled value.
    """

    def __init__(self, name: str, make: Callable[[], object], partition: Partition) -> None:
        self.name = name  # name of the value on the workers
        self.future: Future | None = None  # None until a worker needs it
        self.recipients: set[str] = set()  # addresses of workers to which the value was sent
        self._make = make  # function that creates the value, again if the future is lost
        self._partition = partition
        self._holders: set[str] = set()  # addresses of workers that have a copy
        self._blind: set[str] = set()  # addresses of workers that cannot access `_shared`
        self._futures = 0  # number of futures that have been created
        self._small: Pickled | None = None
        self._shared: SharedValue | None = None
        pickled = Pickled.from_value(make())
        if pickled.nbytes <= INLINE_BYTES:
            self._small = pickled.copy()
        else:
            with suppress(OSError):  # the system has no shared memory or not enough of it
                self._shared = SharedValue(pickled)

    def argument_for(self, worker: str) -> Pickled | SharedHandle | Future | None:
        """Return the task argument that carries the value to a worker, or None if it has a copy."""
        if worker in self._holders:
            return None
        self.recipients.add(worker)
        if self._small is not None:
            return self._small
        if self._shared is not None and worker not in self._blind and _is_local(worker):
            return self._shared.handle
        if self.future is None or self.future.status in ("lost", "cancelled", "error"):
            self._futures += 1
            self.future = submit_value(
                self._partition,
                Pickled.from_value(self._make()).copy(),
                key=f"{self.name}-packed-{self._futures}",
                priority=10,
            )
        return self.future

    def record_copy(self, worker: str) -> None:
        self._holders.add(worker)

    def record_loss(self, worker: str, *, unseen: bool = False) -> None:
        """Record that a worker does not have a copy of the value.

        `unseen` is True if the worker cannot access the shared memory.
        """
        self._holders.discard(worker)
        if unseen:
            self._blind.add(worker)

    def release(self) -> None:
        """Release the memory immediately, because tracebacks may keep this object alive."""
        if self._shared is not None:
            self._shared.close()
        if self.future is not None:
            self.future.release()


@dataclass(eq=False)
class _Worker:
    """Worker of the GPU partition that is being checked, or was accepted or refused.

    A worker is refused if it has different software or has lost its GPU. Refused workers are
    remembered even if they leave.
    """

    # Task that queries the software of the worker. It is released after the check, because an
    # adaptive cluster does not retire workers that hold results.
    check: Future | None
    slots: int = 0  # number of concurrent tasks, or 0 for a worker that has not been accepted
    unneeded: list[str] = field(default_factory=list)  # rigs and scenes that the worker may drop


def _is_local(address: str) -> bool:
    return urlsplit(address).hostname in (None, "127.0.0.1", "::1", get_ip())


def submit_value(partition: Partition, value: Any, **options: Any) -> Future:
    """Make a value available to other tasks by submitting a task that returns it.

    In contrast to scattered data, the value is not lost if the worker that holds it dies.
    """
    with warnings.catch_warnings():
        # The value is embedded in the task graph, so Dask warns about the size of the graph.
        warnings.filterwarnings("ignore", message="Sending large graph")
        return partition.submit(_identity, value, **options)


def _identity(value: Any) -> Any:
    return value

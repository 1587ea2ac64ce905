"""Checks before a run starts, so that it does not fail in the middle."""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from distributed import Client

from lidarsim._version import __version__
from lidarsim.base.errors import LidarError
from lidarsim.simulator.memory import MB, cast_bytes
from lidarsim.simulator.scene_caster import AUTO_TAKES
from poolpart import Pool, PoolError, WorkerInfo
from poolpart.task_locations import look_for_tasks
from poolpart.workers import ask_workers, worker_identities
from raybeam import available_backends

from ...base.software import difference, software, software_there
from ...scenario.build import Job
from ...scenario.sections import TaskOptions
from ..pipeline.failures import JobError
from ..pipeline.names import COLLECT, GENERATE, GPU, LIDAR, OTHER, SORT
from .watch import Waiting, queued

LOOK_EVERY_S = 0.2


class TooFewWorkersError(LidarError):
    """A partition lacks workers or slots; more may join."""


def slots_needed(tasks: TaskOptions, *, planning: bool, writing: bool = False) -> dict[str, int]:
    """Slots that a run needs in each partition, {name: slots}; those that write jobs need one."""
    return {GPU: 1, LIDAR: 2 + tasks.collectors + writing} | ({OTHER: 1} if planning else {})


def find_workers(
    client: Client,
    needed: Mapping[str, int],
    wanted: str,
    advice: str = AUTO_TAKES,
    earlier: Mapping[str, str] | None = None,
    waiting: Waiting | None = None,
    *,
    writing: bool = False,
) -> tuple[Pool, list[WorkerInfo], str, dict[str, str]]:
    """Find all workers, the casting ones among them, their backend and their software.

    `wanted` is a backend, `advice` ends the message if it is not available, and `earlier` is the
    software that a resumed run was cast with. Workers that are missing or just died, or whose jobs
    are in the queue, are waited for as long as `waiting` says. `writing` says that jobs are
    written, too.

    LidarError if workers, slots `needed` or the backend are missing, or versions differ.
    """
    while True:
        looked = time.monotonic()
        try:
            pool = _survey_pool(client, needed, writing)
            casting = [worker for worker in pool if worker.resources.get(GPU)]
            backend = common_backend(client, wanted, casting, advice)
            casts = common_software(client, backend, casting, earlier or {})
            return pool, casting, backend, casts
        except TooFewWorkersError as error:
            coming = 0  # jobs: a queue does not say which of them have died
            if waiting is not None:
                coming = sum(look_for_tasks(client, name).coming for name in needed)
            # One that has just died takes half a minute not to answer, which is no waiting: what
            # counts is when the last look began.
            if waiting is None or not waiting.left(looked):
                if coming:
                    error.add_note(f"{queued(coming)}: if they wait, give --wait more time.")
                raise
            why = str(error).partition(": start ")[0] + (f"; {queued(coming)}" if coming else "")
            waiting.tell("workers", why)  # who waits has started them
        time.sleep(LOOK_EVERY_S)


def check_memory(job: Job, tasks: TaskOptions, backend: str, room: float, worker: str) -> None:
    """Refuse scans and batches for which a worker has too little memory: `room`, bytes a slot.

    JobError: another job may fit.
    """
    takes = partial(cast_bytes, job.scene, job.survey, on_device=backend == "cuda")
    if (all_scans := takes(job.survey.scan_count)) <= room:
        return
    scan = takes(1)
    limit = f"more than the {room / MB:,.0f} MB that {worker} has for each slot"
    if scan > room:
        raise JobError(
            f"Casting one scan takes about {scan / MB:,.0f} MB, {limit}: take a smaller step_deg, "
            "fewer rays or columns, or give casting workers a larger --memory-limit."
        )
    if min(tasks.batch_mb * MB, all_scans) > room:
        raise JobError(
            f"batch_mb is {tasks.batch_mb:,}, {limit}: make it smaller, or give casting workers a "
            "larger --memory-limit."
        )


def check_workers(
    job: Job, tasks: TaskOptions, backend: str, casting: Iterable[WorkerInfo]
) -> None:
    """Check that casting workers have memory for a job; JobError if not."""
    each = {w.address: w.memory / max(1, w.resources[GPU]) for w in casting if w.memory}
    if each:  # the least alone: a campaign of tiny jobs cannot look at hundreds of workers for each
        address = min(each, key=each.__getitem__)
        check_memory(job, tasks, backend, each[address], f"the casting worker at {address}")


def _survey_pool(client: Client, needed: Mapping[str, int], writing: bool) -> Pool:
    """All workers of the cluster, after checking that they suffice."""
    workers = worker_identities(client)
    if not workers:
        raise TooFewWorkersError(
            f"The cluster at {client.scheduler.address} has no workers: start some, for "
            f'example dask worker {client.scheduler.address} --resources "GPU=1"'
        )
    # Only those that will work: a cluster may have other workers, with other packages.
    _check_versions(client, [a for a, w in workers.items() if {*needed} & {*w["resources"]}])
    try:
        pool = Pool.from_client(client, declaring=set(needed))
        pool.require(dict.fromkeys(needed, 0))  # that none declares two
    except PoolError as error:  # errors that more workers do not correct
        raise LidarError(str(error)) from error
    purpose = {
        GPU: "stage 2 casts the rays",
        LIDAR: f"{GENERATE}, {SORT} and {needed.get(LIDAR, 0) - 2 - writing} x {COLLECT}"
        f"{', and writing jobs of a campaign' if writing else ''}",
        OTHER: "path planning; or leave it out with --no-plan",
    }
    try:
        pool.require(needed, purpose)
    except PoolError as error:
        raise TooFewWorkersError(str(error)) from error
    return pool


def _check_versions(client: Client, workers: Sequence[str]) -> None:
    """Check that the workers at these addresses have this Python and these sources."""
    here = platform.python_version()
    for address, python in ask_workers(client, platform.python_version, workers).items():
        if str(python).split(".")[:2] != here.split(".")[:2]:  # code is sent to it by value
            raise LidarError(
                f"The worker at {address} has Python {python}, here it is {here}: install the same "
                "one on both sides."
            )
    ours = software()["lidarpool"]
    for address, answer in _answers(client, software_there(), workers).items():
        if not answer:
            raise LidarError(
                f"The worker at {address} does not have lidarpool: install lidarpool "
                f"{__version__} in the environment that dask worker is started from."
            )
        if answer["lidarpool"] != ours:
            raise LidarError(
                f"The worker at {address} has lidarpool {answer['lidarpool']}, here it is "
                f"{ours}: install the same on both sides, and start the worker again."
            )


def common_software(
    client: Client, backend: str, workers: Sequence[WorkerInfo], earlier: Mapping[str, str]
) -> dict[str, str]:
    """Software of the workers that cast: `earlier` if there is one, else what most of them have.

    Workers with another are refused one by one when they are prepared. LidarError if none has
    the earlier one.
    """
    answers = _answers(client, software_there(backend), [worker.address for worker in workers])
    if earlier and dict(earlier) not in answers.values():
        address, there = next(iter(answers.items()))
        raise LidarError(
            "The scans of the run were cast with other software than the casting workers have: "
            f"the worker at {address} has {difference(there, earlier)}. Continue it there, or drop "
            "it with --fresh (in Python remove_run)."
        )
    counts = Counter(tuple(answer.items()) for answer in answers.values())
    most = max(counts, key=lambda one: (counts[one], one))
    return dict(earlier) if earlier else dict(most)


def _answers(
    client: Client, question: Callable[[], Any], workers: Sequence[str]
) -> Mapping[str, Any]:
    """Return what the workers at these addresses answer; the first error of one is raised."""
    answers = ask_workers(client, question, workers)
    if workers and not answers:
        raise TooFewWorkersError(
            "The workers of partition 'GPU' left before the run started: their logs say why."
        )
    for answer in answers.values():
        if isinstance(answer, BaseException):
            raise answer
    return answers


def gpu_note(pool: Iterable[WorkerInfo], casting: Sequence[WorkerInfo], backend: str) -> str:
    """Say that GPUs of a cluster stay idle; empty if it has none, or they are used."""
    if backend == "cuda" or not any(worker.gpus for worker in pool):
        return ""
    if any(worker.gpus for worker in casting):
        return f"the GPUs of partition GPU are not used: the rays are cast with {backend}"
    return f"no GPU in partition GPU: CPU workers cast the rays with {backend}"


def common_backend(
    client: Client, wanted: str, workers: Sequence[WorkerInfo], advice: str = AUTO_TAKES
) -> str:
    """Name of the ray-casting backend to use on all these workers.

    "auto" is resolved here, once: if each worker chose for itself, a cloud would depend on which
    worker casts which scan. LidarError, which ends with `advice`, if a worker lacks it.
    """
    answers = _answers(client, available_backends, [worker.address for worker in workers])
    if wanted == "auto":
        names = next(iter(answers.values()))
        return next(n for n in names if not any(reasons[n] for reasons in answers.values()))
    for address, reasons in answers.items():
        if reason := reasons.get(wanted, "there is no backend of that name"):
            raise LidarError(
                f"Backend {wanted!r} cannot be used on the casting worker at {address}: "
                f"{reason}. {advice}"
            )
    return wanted

"""Checks before a run starts, so that it does not fail in the middle."""

from __future__ import annotations

import platform
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from distributed import Client

from lidarsim._version import __version__
from lidarsim.errors import LidarError
from lidarsim.simulator.casting.scene_caster import AUTO_ADVICE
from lidarsim.simulator.memory import MB, cast_bytes
from poolpart import Pool, PoolError, WorkerInfo
from poolpart.task_locations import take_snapshot
from poolpart.workers import run_on_workers, worker_identities
from raybeam import available_backends

from ...clouds.writing import ExportSpec
from ...identity.software import describe_difference, software, software_query
from ...scenario.job import Job
from ...scenario.sections import TaskOptions
from ..pipeline.failures import JobError
from ..pipeline.stage_names import COLLECT, GENERATE, GPU, LIDAR, OTHER, SORT
from .watch import Waiting, queued

LOOK_EVERY_S = 0.2


class TooFewWorkersError(LidarError):
    """Error for a partition without enough workers or slots, which may still join."""


class SurveyWorkers(NamedTuple):
    """Workers of a run, and the backend and software that the scans are cast with."""

    pool: Pool  # all workers
    casting: list[WorkerInfo]  # workers of partition GPU
    backend: str
    software: dict[str, str]  # software of the casting workers


def slots_needed(tasks: TaskOptions, *, planning: bool, writing: bool = False) -> dict[str, int]:
    """Return the slots that a run needs in each partition, {name: slots}."""
    return {GPU: 1, LIDAR: 2 + tasks.collectors + writing} | ({OTHER: 1} if planning else {})


def find_workers(
    client: Client,
    required_slots: Mapping[str, int],
    requested: str,
    advice: str = AUTO_ADVICE,
    earlier: Mapping[str, str] | None = None,
    waiting: Waiting | None = None,
    *,
    writing: bool = False,
) -> SurveyWorkers:
    """Wait for the workers of a run, and check that they suffice.

    Parameters
    ----------
    client
        Client of the cluster.
    required_slots
        {partition: slots that the run needs}.
    requested
        The requested backend.
    advice
        End of the message if the backend is not available.
    earlier
        Software that a resumed run was cast with.
    waiting
        Time to wait for workers that are missing or just died, or whose jobs are in the queue.
    writing
        Whether LIDAR workers write jobs, too.

    Raises
    ------
    LidarError
        If workers, slots or the backend are missing, or versions differ.
    """
    while True:
        start_s = time.monotonic()
        try:
            pool = _survey_pool(client, required_slots, writing)
            casting = [worker for worker in pool if worker.resources.get(GPU)]
            backend = common_backend(client, requested, casting, advice)
            casting_software = common_software(client, backend, casting, earlier or {})
            return SurveyWorkers(pool, casting, backend, casting_software)
        except TooFewWorkersError as error:
            coming = 0  # jobs in a queue, which does not say which jobs have died
            if waiting is not None:
                coming = sum(take_snapshot(client, name).queued_jobs for name in required_slots)
            # A worker that has just died takes half a minute not to answer, which does not count
            # as waiting: the remaining time is taken at the start of this attempt.
            if waiting is None or not waiting.remaining_s(start_s):
                if coming:
                    error.add_note(
                        f"{queued(coming)}. If they are only waiting in the queue, increase "
                        "`--startup-timeout`."
                    )
                raise
            # Without the advice to start workers: a user who waits has started some.
            shortage = re.split(r"(?i)[:.] start ", str(error), maxsplit=1)[0]
            waiting.tell("workers", shortage + (f"; {queued(coming)}" if coming else ""))
        time.sleep(LOOK_EVERY_S)


def check_memory(
    job: Job, tasks: TaskOptions, backend: str, available_bytes: float, worker: str
) -> None:
    """Raise JobError if a worker has too little memory for scans or batches: bytes a slot.

    The error is a JobError because another job may fit.
    """
    peak_bytes = partial(cast_bytes, job.scene, job.survey, on_device=backend == "cuda")
    if (all_scans := peak_bytes(job.survey.scan_count)) <= available_bytes:
        return
    scan_bytes = peak_bytes(1)
    limit = f"{worker} has only {available_bytes / MB:,.0f} MB for each slot"
    if scan_bytes > available_bytes:
        raise JobError(
            f"Casting one scan takes about {scan_bytes / MB:,.0f} MB, but {limit}. Use a smaller "
            "`step_deg`, fewer rays or fewer columns, or start the casting workers with a larger "
            "`--memory-limit`."
        )
    if min(tasks.batch_mb * MB, all_scans) > available_bytes:
        raise JobError(
            f"`batch_mb` is {tasks.batch_mb:,}, but {limit}. Reduce it, or start the casting "
            "workers with a larger `--memory-limit`."
        )


def check_workers(
    job: Job, tasks: TaskOptions, backend: str, casting: Iterable[WorkerInfo]
) -> None:
    """Raise JobError if a casting worker has too little memory for a job."""
    bytes_per_slot = {w.address: w.memory / max(1, w.resources[GPU]) for w in casting if w.memory}
    # Only the smallest: a campaign of tiny jobs has no time for hundreds of workers a job.
    if bytes_per_slot:
        address = min(bytes_per_slot, key=bytes_per_slot.__getitem__)
        check_memory(
            job, tasks, backend, bytes_per_slot[address], f"the casting worker at {address}"
        )


def _survey_pool(client: Client, required_slots: Mapping[str, int], writing: bool) -> Pool:
    """Return all workers of the cluster, after checking that they suffice."""
    workers = worker_identities(client)
    if not workers:
        raise TooFewWorkersError(
            f"The cluster at {client.scheduler.address} has no workers. Start workers, for "
            f'example with `dask worker {client.scheduler.address} --resources "GPU=1"`.'
        )
    # Only workers of this run: a cluster may have other workers, with other packages.
    _check_versions(
        client, [a for a, w in workers.items() if {*required_slots} & {*w["resources"]}]
    )
    try:
        pool = Pool.from_client(client, declaring=set(required_slots))
        pool.require(dict.fromkeys(required_slots, 0))  # no worker may declare two partitions
    except PoolError as error:  # errors that more workers do not correct
        raise LidarError(str(error)) from error
    purpose = {
        GPU: "stage 2 casts the rays",
        LIDAR: f"{GENERATE}, {SORT} and {required_slots.get(LIDAR, 0) - 2 - writing} x {COLLECT}"
        f"{', and writing jobs of a campaign' if writing else ''}",
        OTHER: "path planning, unless `planning` is removed from the scenario",
    }
    try:
        pool.require(required_slots, purpose)
    except PoolError as error:
        raise TooFewWorkersError(str(error)) from error
    return pool


def _check_versions(client: Client, workers: Sequence[str]) -> None:
    """Check that the workers at these addresses have the driver's Python and sources."""
    driver_version = platform.python_version()
    for address, python in run_on_workers(client, platform.python_version, workers).items():
        # Code is sent to workers by value, which needs the same minor version.
        if str(python).split(".")[:2] != driver_version.split(".")[:2]:
            raise LidarError(
                f"The worker at {address} has Python {python}, but the run requires Python "
                f"{driver_version}. Install the same version on both machines."
            )
    driver_sources = software()["lidarpool"]
    for address, answer in _answers(client, software_query(), workers).items():
        if not answer:
            raise LidarError(
                f"The worker at {address} does not have lidarpool. Install lidarpool "
                f"{__version__} in the environment from which `dask worker` is started."
            )
        if answer["lidarpool"] != driver_sources:
            raise LidarError(
                f"The worker at {address} has lidarpool {answer['lidarpool']}, but the run "
                f"requires lidarpool {driver_sources}. Install the same version on both machines, "
                "and restart the worker."
            )


def check_formats(client: Client, pool: Pool, formats: Iterable[ExportSpec]) -> None:
    """Check that the LIDAR workers can write the formats of plug-ins.

    LidarError if a worker has another version of a plug-in, or cannot import it.
    """
    written = [spec for spec in formats if spec.has_many_files and spec.row.plugin is not None]
    if not written:
        return
    plugins = [spec.row.plugin for spec in written if spec.row.plugin is not None]
    required = software(plugins=plugins)
    writing = [worker.address for worker in pool if worker.resources.get(LIDAR)]
    for address, answer in _answers(client, software_query(plugins=plugins), writing).items():
        if differs := describe_difference(answer, required):
            raise LidarError(
                f"The worker at {address} has {differs}. Install the same version on both "
                "machines, and restart the worker."
            )
    can_write = partial(_check_installed, written)
    for address, answer in run_on_workers(client, can_write, writing).items():
        if isinstance(answer, LidarError):
            raise LidarError(
                f"The worker at {address} cannot write the results. {answer}"
            ) from answer


def _check_installed(formats: Iterable[ExportSpec]) -> None:
    for file_format in formats:
        file_format.check_installed()


def common_software(
    client: Client, backend: str, workers: Sequence[WorkerInfo], earlier: Mapping[str, str]
) -> dict[str, str]:
    """Return the software that scans are cast with: `earlier`, or the most common of the workers.

    Workers with different software are refused when they are prepared. LidarError if no worker has
    the `earlier` software.
    """
    answers = _answers(client, software_query(backend), [worker.address for worker in workers])
    if earlier and dict(earlier) not in answers.values():
        address, installed = next(iter(answers.items()))
        raise LidarError(
            "The software on the casting workers differs from the software with which the run "
            f"was started. The worker at {address} has {describe_difference(installed, earlier)}. "
            "Continue the run with the earlier software, or remove it with `--restart` "
            "(`remove_run` in Python)."
        )
    counts = Counter(tuple(answer.items()) for answer in answers.values())
    common = max(counts, key=lambda items: (counts[items], items))
    return dict(earlier) if earlier else dict(common)


def _answers(
    client: Client, question: Callable[[], Any], workers: Sequence[str]
) -> Mapping[str, Any]:
    """Return the answers of workers by address, or raise the first error."""
    answers = run_on_workers(client, question, workers)
    if workers and not answers:
        raise TooFewWorkersError(
            "The workers of partition 'GPU' left before the run started. See their logs."
        )
    for answer in answers.values():
        if isinstance(answer, BaseException):
            raise answer
    return answers


def gpu_note(pool: Iterable[WorkerInfo], casting: Sequence[WorkerInfo], backend: str) -> str:
    """Return a note if GPUs of a cluster stay idle, else an empty string."""
    if backend == "cuda" or not any(worker.gpus for worker in pool):
        return ""
    if any(worker.gpus for worker in casting):
        return (
            "the GPUs of partition GPU are not used, because the rays are cast with the backend "
            f"{backend!r}"
        )
    return (
        "partition GPU has no worker with a GPU, so CPU workers cast the rays with the backend "
        f"{backend!r}"
    )


def common_backend(
    client: Client, requested: str, workers: Sequence[WorkerInfo], advice: str = AUTO_ADVICE
) -> str:
    """Return the name of a ray-casting backend that all these workers have.

    "auto" is resolved here, once: if each worker chose for itself, a cloud would depend on the
    distribution of scans to workers. LidarError, which ends with `advice`, if a worker lacks the
    backend.
    """
    answers = _answers(client, available_backends, [worker.address for worker in workers])
    if requested == "auto":
        names = next(iter(answers.values()))
        return next(n for n in names if not any(reasons[n] for reasons in answers.values()))
    for address, reasons in answers.items():
        if reason := reasons.get(requested, "it has no backend with this name"):
            raise LidarError(
                f"Backend {requested!r} cannot be used on the casting worker at {address}: "
                f"{reason}. {advice}"
            )
    return requested

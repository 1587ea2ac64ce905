"""Check a cluster before a run starts, so that the run does not fail later."""

from __future__ import annotations

import platform
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from distributed import Client

from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.identity.versions import software
from lidarscenario.job import Job
from lidarscenario.sections import TaskOptions
from lidarsim._version import __version__
from lidarsim.casting.scene_caster import AUTO_ADVICE
from lidarsim.errors import LidarError
from poolpart import Pool, PoolError, WorkerInfo
from poolpart.task_locations import take_snapshot
from poolpart.workers import run_on_workers, worker_identities
from raybeam import available_backends

from ...identity.software import describe_difference, software_query
from ..pipeline.stage_names import COLLECT, GENERATE, GPU, LIDAR, OTHER, SORT
from .requirements import check_memory
from .watch import WaitTimer, queued_clause

LOOK_EVERY_S = 0.2


class TooFewWorkersError(LidarError):
    """Raised if a partition has too few workers or slots, but further workers may still join."""


class SurveyWorkers(NamedTuple):
    """Workers of a run, with the ray-casting backend and software that they use."""

    pool: Pool  # all workers
    casting: list[WorkerInfo]  # workers in the GPU partition
    backend: str
    software: dict[str, str]  # software of the casting workers


def find_workers(
    client: Client,
    required_slots: Mapping[str, int],
    requested: str,
    advice: str = AUTO_ADVICE,
    earlier: Mapping[str, str] | None = None,
    waiting: WaitTimer | None = None,
    *,
    writing: bool = False,
) -> SurveyWorkers:
    """Wait until the workers that a run requires are available, and check them.

    Parameters
    ----------
    client
        Client of the cluster.
    required_slots
        Number of slots that the run requires, by partition.
    requested
        Requested backend.
    advice
        End of the error message if the backend is not available.
    earlier
        Software with which the scans of a resumed run were cast.
    waiting
        Time limit for workers that are missing or have just died, or whose jobs are queued.
    writing
        Whether LIDAR workers also write the jobs of a data set.

    Raises
    ------
    LidarError
        If workers, slots or the backend are missing, or if versions differ.
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
            coming = 0  # number of queued jobs, which may include jobs that have died
            if waiting is not None:
                coming = sum(take_snapshot(client, name).queued_jobs for name in required_slots)
            # The request to a worker that has just died times out after half a minute. This time
            # does not count, so the remaining time is that at the start of this attempt.
            if waiting is None or not waiting.remaining_s(start_s):
                if coming:
                    error.add_note(
                        f"{queued_clause(coming)}. If they are only waiting in the queue, increase "
                        "`--startup-timeout`."
                    )
                raise
            # The advice to start workers is omitted, because the user has already started some.
            shortage = re.split(r"(?i)[:.] start ", str(error), maxsplit=1)[0]
            waiting.report("workers", shortage + (f"; {queued_clause(coming)}" if coming else ""))
        time.sleep(LOOK_EVERY_S)


def check_workers(
    job: Job, tasks: TaskOptions, backend: str, casting: Iterable[WorkerInfo]
) -> None:
    """Raise JobError if the memory of a casting worker is insufficient for a job."""
    bytes_per_slot = {w.address: w.memory / max(1, w.resources[GPU]) for w in casting if w.memory}
    # Only the worker with the least memory is checked. Checking hundreds of workers would take too
    # long for the small jobs of a campaign.
    if bytes_per_slot:
        address = min(bytes_per_slot, key=bytes_per_slot.__getitem__)
        check_memory(
            job, tasks, backend, bytes_per_slot[address], f"the casting worker at {address}"
        )


def _survey_pool(client: Client, required_slots: Mapping[str, int], writing: bool) -> Pool:
    """Return all workers of the cluster, after checking that they are sufficient."""
    workers = worker_identities(client)
    if not workers:
        raise TooFewWorkersError(
            f"The cluster at {client.scheduler.address} has no workers. Start workers, for "
            f'example with `dask worker {client.scheduler.address} --resources "GPU=1"`.'
        )
    # The cluster may have other workers with different packages, which are ignored.
    _check_versions(
        client, [a for a, w in workers.items() if {*required_slots} & {*w["resources"]}]
    )
    try:
        pool = Pool.from_client(client, declaring=set(required_slots))
        pool.require(dict.fromkeys(required_slots, 0))  # no worker may declare two partitions
    except PoolError as error:  # errors that additional workers cannot resolve
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
    """Check that all workers have the Python version and the sources of the driver."""
    driver_version = platform.python_version()
    for address, python in run_on_workers(client, platform.python_version, workers).items():
        # Code is sent to workers by value, which requires the same minor version.
        if str(python).split(".")[:2] != driver_version.split(".")[:2]:
            raise LidarError(
                f"The worker at {address} has Python {python}, but the run requires Python "
                f"{driver_version}. Install the same version on both machines."
            )
    driver_sources = software()["lidarpool"]
    for address, answer in _query_workers(client, software_query(), workers).items():
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
    """Check that LIDAR workers can write the formats that plug-ins provide.

    Raise LidarError if a worker has a different version of a plug-in or cannot import it.
    """
    written = [spec for spec in formats if spec.has_many_files and spec.row.plugin is not None]
    if not written:
        return
    plugins = [spec.row.plugin for spec in written if spec.row.plugin is not None]
    required = software(plugins=plugins)
    writing = [worker.address for worker in pool if worker.resources.get(LIDAR)]
    for address, answer in _query_workers(client, software_query(plugins=plugins), writing).items():
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
    """Return the software versions with which scans are cast.

    A resumed run uses the `earlier` software. Otherwise, the most common software of the workers is
    used. Workers with different software are rejected when they are checked later. Raise LidarError
    if no worker has the earlier software.
    """
    answers = _query_workers(
        client, software_query(backend), [worker.address for worker in workers]
    )
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


def _query_workers(
    client: Client, question: Callable[[], Any], workers: Sequence[str]
) -> Mapping[str, Any]:
    """Call a function on workers and return the results by address, or raise the first error."""
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
    """Return a note if the cluster has unused GPUs, or an empty string otherwise."""
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
    """Return the name of a ray-casting backend that is available on all workers.

    "auto" is resolved once for all workers. If each worker chose its own backend, the cloud would
    depend on how scans are distributed among workers.

    Raises
    ------
    LidarError
        If the backend is missing on a worker. The message ends with `advice`.
    """
    answers = _query_workers(client, available_backends, [worker.address for worker in workers])
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

"""Slots and memory that a run requires, and the workers of a local cluster.

These functions need neither Dask nor a cluster, so that `lidarpool check` can use them.
"""

from __future__ import annotations

from functools import partial

from lidarscenario.job import Job
from lidarscenario.sections import TaskOptions
from lidarsim.simulator.memory import MB, cast_bytes

from ..pipeline.failures import JobError
from ..pipeline.stage_names import GPU, LIDAR, OTHER


def slots_needed(tasks: TaskOptions, *, planning: bool, writing: bool = False) -> dict[str, int]:
    """Return the number of slots that a run requires in each partition."""
    return {GPU: 1, LIDAR: 2 + tasks.collectors + writing} | ({OTHER: 1} if planning else {})


def check_memory(
    job: Job, tasks: TaskOptions, backend: str, available_bytes: float, worker: str
) -> None:
    """Raise JobError if a worker has too little memory for the scans or batches of a job.

    The error is a JobError, because other jobs may require less memory.

    Parameters
    ----------
    available_bytes
        Memory of the worker for each slot, in bytes.
    worker
        Description of the worker for the message.
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


def default_workers(cores: int, gpus: int) -> dict[str, int]:
    """Return the default numbers of GPU and OTHER workers on a machine.

    The GPU partition has one worker per GPU or, on a machine without GPUs, CPU workers for three
    quarters of the cores. OTHER has workers for the remaining cores. The LIDAR stages mostly wait,
    so they share one process.

    Examples
    --------
    >>> default_workers(cores=2, gpus=0), default_workers(cores=16, gpus=2)
    ({'GPU': 2, 'OTHER': 1}, {'GPU': 2, 'OTHER': 13})
    """
    casting = gpus or max(1, cores - cores // 4)
    return {GPU: casting, OTHER: max(1, cores - casting - (1 if gpus and cores > 2 else 0))}

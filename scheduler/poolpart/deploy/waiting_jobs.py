"""Jobs of other users that wait in the queue, for partitions that make room for them.

The queue is listed rarely, because each listing puts load on the queueing system, which all users
share. Jobs that are released until the next listing are subtracted from its result.
"""

from __future__ import annotations

import asyncio
import getpass
import os
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import PoolError

LIST_EVERY_S = 30.0  # interval between listings
_ANSWER_S = 30.0  # time limit for a listing
_SLURM_REASONS = ("Resources", "Priority")  # of jobs that start as soon as resources are free


class QueueWatch:
    """Number of jobs that a partition should release for the waiting jobs of other users.

    Parameters
    ----------
    count_waiting
        Function that returns the number of waiting jobs of other users. It is called in a thread.

    Attributes
    ----------
    problem
        Reason why the queue could not be listed the last time, or "".
    """

    def __init__(self, count_waiting: Callable[[], int]) -> None:
        self.problem = ""
        self._count_waiting = count_waiting
        self._listing: asyncio.Task[None] | None = None
        self._listed_at = -LIST_EVERY_S
        self._waiting = 0  # result of the last listing
        self._released = 0  # number of running jobs closed since then

    def to_release(self) -> int | None:
        """Return the number of jobs to release now, or None if no other jobs wait."""
        return max(0, self._waiting - self._released) if self._waiting else None

    def count_released(self, jobs: int) -> None:
        """Record that running jobs of the partition were closed."""
        self._released += jobs

    def refresh(self, has_jobs: bool) -> None:
        """List the queue in the background if it is time to do so.

        Without jobs, the partition cannot release anything, and the queue is only listed until no
        other jobs wait.
        """
        is_due = time.monotonic() - self._listed_at >= LIST_EVERY_S
        if is_due and (has_jobs or self._waiting) and self._listing is None:
            self._listing = asyncio.ensure_future(self._list())

    async def _list(self) -> None:
        """List the queue. If this fails, assume that no other jobs are waiting."""
        self._waiting, self.problem = await asyncio.to_thread(self._try_to_count)
        self._released = 0
        self._listed_at = time.monotonic()
        self._listing = None

    def _try_to_count(self) -> tuple[int, str]:
        """Return the number of waiting jobs, and the reason if it could not be determined."""
        try:
            waiting = self._count_waiting()
        except Exception as error:  # the function may be the user's
            return 0, str(error) or type(error).__name__
        if isinstance(waiting, bool) or not isinstance(waiting, int) or waiting < 0:
            return 0, f"Expected a number of jobs, but got {waiting!r}."
        return waiting, ""


def waiting_jobs_counter(
    cluster: Any, partition: str, value: Any, options: Mapping[str, Any]
) -> Callable[[], int] | None:
    """Return the function for the option `yield_to_others` of a partition.

    The result is None if the partition does not yield.

    Parameters
    ----------
    cluster
        Cluster that starts the jobs.
    partition
        Name of the partition.
    value
        Value of the option: a boolean, or a function.
    options
        Options of a job of the partition.

    Raises
    ------
    PoolError
        If the value is invalid, or if the jobs of the cluster are not in a Slurm queue.
    """
    if callable(value):
        counter: Callable[[], int] = value
        return counter
    if not isinstance(value, bool):
        raise PoolError(
            f"Invalid value {value!r} for `yield_to_others` of partition {partition!r}. Expected "
            "true, or a function that returns the number of waiting jobs of other users."
        )
    if not value:
        return None
    job_class: Any = getattr(cluster, "job_cls", None)
    if getattr(job_class, "submit_command", None) != "sbatch":
        raise PoolError(
            f"Partition {partition!r} cannot list the queue of a {type(cluster).__name__}, because "
            "it is not a Slurm queue. Set `yield_to_others` to a function that returns the number "
            "of waiting jobs of other users."
        )
    header = job_class(cluster.scheduler_address, name=f"{partition}-0", **options).job_header
    queues = re.findall(r"^#SBATCH +(?:-p *|--partition[= ] *)(\S+)", header, re.MULTILINE)
    queue = queues[-1] if queues else None
    return lambda: count_slurm_jobs(queue)


def count_slurm_jobs(queue: str | None = None) -> int:
    """Count the jobs of other users that wait in a Slurm queue until resources are free.

    Jobs that wait for another reason are not counted, for example jobs that are held, depend on
    other jobs, or would exceed a limit of their user.

    Parameters
    ----------
    queue
        Name of the Slurm partition, or several names separated by commas. None means the default
        partition.

    Returns
    -------
    int
        Number of jobs. Each element of a job array counts.

    Raises
    ------
    PoolError
        If Slurm does not respond.
    """
    if queue is None:
        names = _ask_slurm("sinfo", "--noheader", "--format=%P").split()
        queue = ",".join({name.removesuffix("*") for name in names if name.endswith("*")})
    lines = _ask_slurm(
        *("squeue", "--noheader", "--array", "--states=PENDING"),
        *(f"--partition={queue}", "--format=%u %r"),
    ).splitlines()
    user = getpass.getuser()
    jobs = (line.split(maxsplit=1) for line in lines)
    return sum(owner != user and reason in _SLURM_REASONS for owner, reason in jobs)


def _ask_slurm(*command: str) -> str:
    """Run a command of Slurm and return its output.

    Raises
    ------
    PoolError
        If the command fails, or does not end in time.
    """
    # Variables such as SQUEUE_USERS would filter the output.
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("SQUEUE_", "SINFO_"))
    }
    try:
        return subprocess.run(
            command,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
            timeout=_ANSWER_S,
        ).stdout
    except subprocess.CalledProcessError as error:
        raise PoolError(f"{command[0]} failed: {error.stderr.strip()}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PoolError(f"{command[0]} failed: {error}") from error

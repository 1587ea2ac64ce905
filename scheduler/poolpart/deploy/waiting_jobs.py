"""Jobs of other users that wait in the queue, for partitions that make room for them.

The queue is listed rarely, because each listing puts load on the queueing system, which all users
share. Jobs that are released until the next listing are subtracted from its result. Partitions that
use the same queue share a `QueueWatch`, so that a waiting job is only counted once.

A listing runs in a daemon thread, and the event loop of the cluster only checks whether it has
ended. A command or function that hangs therefore blocks neither the loop nor the end of the
process.
"""

from __future__ import annotations

import getpass
import inspect
import logging
import math
import os
import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from numbers import Integral
from typing import Any

from ..adapting import QueueReport
from ..errors import PoolError
from ..extras.background import run_in_background

logger = logging.getLogger(__name__)

LIST_EVERY_S = 30.0  # interval between listings
LISTING_S = 60.0  # time limit for a listing
HOLD_S = 300.0  # time for which the last result holds jobs back while the queue cannot be listed
_COMMAND_S = 25.0  # time limit for a command of Slurm, of which a listing may need two
_SLURM_REASONS = ("Resources", "Priority")  # of jobs that start as soon as resources are free

Counter = Callable[[], int]


class QueueWatch:
    """Waiting jobs of other users in a queue, and the jobs to release for them.

    Parameters
    ----------
    count_waiting
        Function that returns the number of waiting jobs of other users. It is called in a thread.
    partitions
        Names of the partitions whose jobs are in this queue.

    Attributes
    ----------
    problem
        Reason why the queue could not be listed the last time, or "".
    """

    def __init__(self, count_waiting: Counter, partitions: Sequence[str]) -> None:
        self.count_waiting = count_waiting
        self.partitions = tuple(partitions)
        self.problem = ""
        self._listing: Future[int] | None = None
        self._began_at = -math.inf  # time when the last listing began
        self._listed_at = -math.inf  # time when the last successful listing ended
        self._waiting = 0  # result of the last successful listing
        # Numbers of running jobs closed since the last listing, and in the interval before. The
        # queueing system needs some time to assign a released node to a waiting job.
        self._released = self._released_before = 0

    def report(self) -> QueueReport:
        """Return the current state for the scheduler."""
        to_release: int | None = None
        if self.problem:
            # Keep the jobs. If others were waiting a short time ago, start no further jobs.
            if self._waiting and time.monotonic() - self._listed_at < HOLD_S:
                to_release = 0
        elif self._waiting:
            to_release = max(0, self._waiting - self._released - self._released_before)
        waiting = None if self.problem else self._waiting
        return QueueReport(self.partitions, to_release, waiting, self.problem)

    def count_released(self, jobs: int) -> None:
        """Record that running jobs of the partitions were closed."""
        self._released += jobs

    def refresh(self, has_jobs: bool) -> None:
        """Start a listing if it is time to do so, and apply the result of one that has ended.

        Without jobs, the partitions cannot release anything, and the queue is only listed until no
        other jobs wait.
        """
        now = time.monotonic()
        if self._listing is None:
            is_due = now - self._began_at >= LIST_EVERY_S
            if is_due and (has_jobs or self._waiting or self.problem):
                self._began_at = now
                self._listing = run_in_background(self._count)
        elif now - self._began_at >= LISTING_S:
            # The result would be outdated. Do not start another listing while this one hangs.
            self._set_problem(f"The listing has not ended after {LISTING_S:g} s.")
            if self._listing.done():
                self._listing = None
        elif self._listing.done():
            error = self._listing.exception()
            if error is None:
                self._set_waiting(self._listing.result())
            else:
                is_ours = isinstance(error, PoolError)
                self._set_problem(str(error) if is_ours else f"{type(error).__name__}: {error}")
            self._listing = None

    def _set_waiting(self, waiting: int) -> None:
        if self.problem:
            logger.info("The queue of %s can be listed again.", self.names)
        self.problem = ""
        self._waiting = waiting
        self._released_before = self._released
        self._released = 0
        self._listed_at = time.monotonic()

    def _set_problem(self, problem: str) -> None:
        if not self.problem:
            logger.info("The queue of %s cannot be listed. %s", self.names, problem)
        self.problem = problem

    @property
    def names(self) -> str:
        """The partitions in words, for messages."""
        plural = "s" if len(self.partitions) > 1 else ""
        return f"partition{plural} {' and '.join(map(repr, self.partitions))}"

    def _count(self) -> int:
        """Count the waiting jobs, in a thread.

        Raises
        ------
        PoolError
            If the function does not return a number of jobs.
        """
        waiting: Any = self.count_waiting()
        if isinstance(waiting, bool) or not isinstance(waiting, Integral) or int(waiting) < 0:
            raise PoolError(
                "The function for `yield_to_others` must return a number of jobs, but it returned "
                f"{waiting!r:.100}."
            )
        return int(waiting)


def watch_queues(counters: Mapping[str, Counter]) -> list[QueueWatch]:
    """Create a watch for each queue, given the function that counts for each partition.

    Partitions with the same function share a watch.
    """
    partitions: list[tuple[Counter, list[str]]] = []
    for name, counter in counters.items():
        # A list, because functions of users may not be hashable.
        shared = next((names for other, names in partitions if other == counter), None)
        if shared is None:
            partitions.append((counter, [name]))
        else:
            shared.append(name)
    return [QueueWatch(counter, names) for counter, names in partitions]


@dataclass(frozen=True)
class SlurmCounter:
    """Function that counts waiting jobs in a Slurm queue. Those of the same queue are equal."""

    queue: str | None  # as in `count_slurm_jobs`

    def __call__(self) -> int:
        """Return the number of waiting jobs of other users."""
        return count_slurm_jobs(self.queue)


def waiting_jobs_counter(
    cluster: Any, partition: str, value: Any, options: Mapping[str, Any]
) -> Counter | None:
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
        _check_counter(partition, value)
        counter: Counter = value
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
    return SlurmCounter(",".join(sorted({*queues[-1].split(",")})) if queues else None)


def _check_counter(partition: str, function: Callable[..., Any]) -> None:
    """Raise PoolError if a function cannot be called without arguments, or is a coroutine function.

    It would otherwise only fail when the queue is listed for the first time.
    """
    called = getattr(function, "__call__", function)  # noqa: B004 - of an object that is callable
    if inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(called):
        raise PoolError(
            f"`yield_to_others` of partition {partition!r} is a coroutine function. Pass a plain "
            "function, which is called in a thread."
        )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some functions written in C have no signature
        return
    try:
        signature.bind()
    except TypeError as error:
        raise PoolError(
            f"`yield_to_others` of partition {partition!r} must be a function without required "
            f"arguments, but got {function!r}: {error}."
        ) from error


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
            timeout=_COMMAND_S,
        ).stdout
    except subprocess.CalledProcessError as error:
        raise PoolError(f"{command[0]} failed: {error.stderr.strip()}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PoolError(f"{command[0]} failed: {error}") from error

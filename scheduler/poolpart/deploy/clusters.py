"""Start partitions whose workers are queued jobs, or processes on other hosts (SSH).

The number of jobs is either fixed or depends on the amount of work. In the latter case,
`adapting.py` decides on the scheduler which jobs to start and end.
"""

from __future__ import annotations

import asyncio
import logging
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dask
from distributed import SpecCluster, Status
from distributed.deploy import ssh
from tornado.ioloop import PeriodicCallback

from ..adapting import IDLE_S, JobBounds, JobSpec, QueueReport, add_partitions, advise_jobs
from ..errors import PoolError
from ..internals.names import ADAPTING, CLUSTERS, require_feature
from ..internals.scheduler import run_on_cluster_scheduler
from ..rules import check_count, check_name
from .waiting_jobs import Counter, waiting_jobs_counter, watch_queues

logger = logging.getLogger(__name__)

_NAME = "poolpart"  # name of the cluster's periodic callback that manages the jobs
ADAPT_EVERY_S = 1.0  # interval at which partitions are adapted to their tasks
CHECK_EVERY_S = 5.0  # interval between checks for lost workers
INFO_MARK = " - INFO - "  # identifies lines in Dask's logs that are not warnings or errors
_DEATH_S = 60  # time without a scheduler after which a worker exits, as in dask-jobqueue


def start_partitions(
    cluster: SpecCluster,
    partitions: Mapping[str, Mapping[str, Any]],
    report: Callable[[str], object] = logger.warning,
) -> None:
    """Start the workers of partitions on a dask-jobqueue cluster or an `SSHCluster`.

    The workers declare their partition from the beginning and are named after it, for example
    ``GPU-0`` and ``GPU-1``. The function returns when all jobs have been submitted, or all hosts
    have been contacted. Workers join when the queue has started them. While the cluster is open,
    jobs that have ended are submitted again. Partitions with ``adapt`` submit jobs while tasks
    wait, and stop idle jobs. All jobs end with the cluster.

    Parameters
    ----------
    cluster
        Cluster without workers, such as ``SLURMCluster(cores=1, memory="8GB")`` or
        ``SSHCluster(["head"])``.
    partitions
        Mapping of each name to its options. ``workers`` is the number of workers (1 by default),
        and ``slots`` is the number of tasks that each worker runs at the same time (1 by default).
        Instead of ``workers``, ``adapt`` sets the minimum and maximum number, for example ``[0,
        8]`` (see `Partition.adapt`), and ``idle_s`` the time in seconds without work after which a
        job ends (60 by default). With ``yield_to_others``, the partition releases jobs while jobs
        of other users wait in the queue. Its value is True for Slurm, or a function that returns
        the number of these jobs. Partitions in the same queue, or with the same function, release
        one job together for each of these jobs. If the queue cannot be listed, no jobs are
        released, and the problem is reported. All other options are passed to the class of the
        cluster, for example ``job_extra_directives``, ``queue`` or ``memory``. An `SSHCluster`
        accepts ``connect_options``, ``remote_python``, ``worker_class``, ``worker_options`` and
        ``hosts``.
        Workers are distributed over the hosts in turn. By default, there is one for each host.
    report
        Function that is called with problems that occur later: the last line of a job's log while
        workers are missing, or the reason why a worker cannot be started.

    Raises
    ------
    PoolError
        If the cluster has another type, already has workers, or does not accept an option, or if
        poolpart is not installed in the environment of the scheduler.
    RuntimeError
        If a job is rejected, or a host does not respond. The cluster may also raise other errors.

    Examples
    --------
    >>> with SLURMCluster(cores=1, memory="8GB") as cluster:           # doctest: +SKIP
    ...     start_partitions(
    ...         cluster,
    ...         {
    ...             "GPU": {"adapt": [0, 8], "job_extra_directives": ["--gres=gpu:1"]},
    ...             "IO": {"slots": 8},
    ...         },
    ...     )
    """
    require_feature(CLUSTERS)
    jobqueue = sys.modules.get("dask_jobqueue")
    if jobqueue and isinstance(cluster, jobqueue.JobQueueCluster):
        describe = _describe_job
    elif getattr(cluster, "scheduler_spec", {}).get("cls") is ssh.Scheduler:
        describe = _describe_process
    else:
        raise PoolError(
            f"A {type(cluster).__name__} has only one kind of worker. Start its workers, then "
            "divide them with `Pool.from_client(client).divide(…)`. Only dask-jobqueue clusters "
            "and `SSHCluster` can start workers by partition."
        )
    if cluster.worker_spec or _NAME in cluster.periodic_callbacks:
        raise PoolError(
            f"The cluster already has {len(cluster.worker_spec)} workers or jobs. Create a cluster "
            "that starts no workers: omit `n_workers`, or pass an `SSHCluster` only the "
            "scheduler's host."
        )
    parts = {
        name: _PartitionJobs.from_options(cluster, describe, name, options)
        for name, options in partitions.items()
    }
    cluster.sync(_JobStarter(cluster, parts, report).start)


Describe = Callable[[Any, str, str, int, int, Mapping[str, Any]], dict[str, Any]]


@dataclass
class _PartitionJobs:
    """Jobs that form a partition."""

    name: str
    options: Mapping[str, Any]  # options of the cluster's class that differ for this partition
    initial_count: int  # number of jobs to start initially
    spec: JobSpec
    describe: Describe
    count_waiting: Counter | None = None  # None if the partition does not yield to other users
    submitted: int = 0  # number of jobs submitted so far
    host_indices: dict[str, int] = field(default_factory=dict)  # {job: index of its host}

    @classmethod
    def from_options(
        cls, cluster: SpecCluster, describe: Describe, name: str, options: Mapping[str, Any]
    ) -> _PartitionJobs:
        """Create a partition's jobs from its options, without starting them.

        Raises
        ------
        PoolError
            If an option is invalid.
        """
        check_name(name)
        cluster_options = dict(options)
        slots = cluster_options.pop("slots", 1)
        check_count(f"the number of slots of partition {name!r}", slots)
        bounds = pop_bounds(name, cluster_options)
        yields = cluster_options.pop("yield_to_others", False)
        if yields and bounds is None:
            raise PoolError(
                f"Partition {name!r} sets `yield_to_others`, which requires `adapt`. Set `adapt`, "
                "for example to [0, 8]."
            )
        try:
            if bounds is not None:
                count = bounds.minimum
            else:
                hosts = cluster_options.get("hosts", ".")
                count = cluster_options.pop("workers", len(hosts))
            check_count(f"the number of workers of partition {name!r}", count, minimum=0)
            # Describing a sample job checks that the cluster's class accepts the options.
            sample = describe(cluster, f"{name}-0", name, slots, 0, cluster_options)
        except (TypeError, ValueError) as error:
            raise PoolError(f"Partition {name!r} cannot be started. {error}") from error
        spec = JobSpec(slots, len(sample.get("group", ".")), bounds)
        count_waiting = waiting_jobs_counter(cluster, name, yields, sample["options"])
        return cls(name, cluster_options, count, spec, describe, count_waiting)

    def add(self, cluster: SpecCluster, count: int) -> None:
        """Add jobs to the cluster, which starts them when it is awaited."""
        for _ in range(count):
            # Each job has a new name. For some time after a worker was lost, Dask would mistake a
            # job with the same name for the lost worker, and cancel the job.
            job = f"{self.name}-{self.submitted}"
            self.submitted += 1
            used = self.host_indices.values()
            index = next(number for number in range(self.submitted) if number not in used)
            self.host_indices[job] = index
            spec = self.describe(cluster, job, self.name, self.spec.slots, index, self.options)
            cluster.worker_spec[job] = spec

    def workers(self, cluster: SpecCluster) -> dict[str, list[str]]:
        """Return the worker names of each submitted job."""
        return {
            job: [job + suffix for suffix in cluster.worker_spec[job].get("group", [""])]
            for job in self.host_indices
            if job in cluster.workers
        }


def pop_bounds(name: str, options: dict[str, Any]) -> JobBounds | None:
    """Convert the options `adapt` and `idle_s` of a partition to bounds, and remove them.

    The result is None if the partition is not adaptive.

    Raises
    ------
    PoolError
        If the options are invalid.
    """
    adapt = options.pop("adapt", None)
    idle_s = options.pop("idle_s", None)
    if adapt is None:
        if idle_s is not None:
            raise PoolError(
                f"Partition {name!r} sets `idle_s`, which requires `adapt`. Set `adapt`, for "
                "example to [0, 8]."
            )
        return None
    require_feature(ADAPTING)
    if "workers" in options or not isinstance(adapt, Sequence) or len(adapt) != 2:
        raise PoolError(
            f"Invalid value {adapt!r} for `adapt` of partition {name!r}. Expected the minimum and "
            "maximum number of workers, for example [0, 8]. `adapt` cannot be combined with "
            "`workers`."
        )
    minimum, maximum = adapt
    return JobBounds.from_user_values(name, minimum, maximum, IDLE_S if idle_s is None else idle_s)


class _JobStarter:
    """Starts the jobs of all partitions, and replaces jobs that were lost."""

    def __init__(
        self,
        cluster: SpecCluster,
        partition_jobs: Mapping[str, _PartitionJobs],
        report: Callable[[str], object],
    ) -> None:
        self._cluster = cluster
        self._parts = partition_jobs
        self._report = report
        samples = (
            part.describe(cluster, "", part.name, 1, 0, part.options)
            for part in partition_jobs.values()
        )
        self._logs = JobLogs(sample["options"] for sample in samples)
        self._watches = watch_queues(
            {
                name: part.count_waiting
                for name, part in partition_jobs.items()
                if part.count_waiting is not None
            }
        )
        self._messages: set[str] = set()  # reported messages, without their numbers
        self._logs_read_at = time.monotonic()

    async def start(self) -> None:
        """Submit the initial jobs, and manage all jobs until the cluster is closed."""
        specs = {name: part.spec for name, part in self._parts.items()}
        try:
            await run_on_cluster_scheduler(self._cluster, add_partitions, specs=specs)
        except ModuleNotFoundError as error:
            raise PoolError(
                f"The scheduler of the cluster cannot import {error.name!r}. Start it in the same "
                "environment as this process."
            ) from error
        for part in self._parts.values():
            part.add(self._cluster, part.initial_count)
        await _start_workers(self._cluster)
        callback = PeriodicCallback(self._manage_jobs, 1000 * ADAPT_EVERY_S)
        self._cluster.periodic_callbacks[_NAME] = callback  # stops when the cluster is closed
        callback.start()

    async def _manage_jobs(self) -> None:
        """Follow the scheduler's advice, restart lost workers, and report errors in job logs."""
        if self._cluster.status != Status.running:
            return
        with suppress(OSError):  # the scheduler is closing
            changed = await self._adapt()
            looked_at = time.monotonic()
            due = looked_at - self._logs_read_at >= CHECK_EVERY_S
            if changed or due:
                # When a SpecCluster is awaited, it starts the workers that it has lost.
                try:
                    await _start_workers(self._cluster)
                except Exception as error:
                    self._report_once(f"A worker could not be started: {error}")
            if due:
                self._logs_read_at = looked_at
                if self._cluster.plan - self._cluster.observed:  # workers are missing
                    for line in self._logs.new_last_lines():
                        self._report_once(line)

    async def _adapt(self) -> bool:
        """Apply the scheduler's advice on jobs, and return whether any jobs must start."""
        jobs = {name: part.workers(self._cluster) for name, part in self._parts.items()}
        advice = await run_on_cluster_scheduler(
            self._cluster, advise_jobs, jobs=jobs, queues=self._queue_reports(jobs)
        )
        for watch in self._watches:
            watch.count_released(sum(advice[name].closed_jobs for name in watch.partitions))
        for name, advice_of_part in advice.items():  # adaptive partitions only
            part = self._parts[name]
            to_start = advice_of_part.jobs_to_start
            await asyncio.gather(
                *(self._remove_job(part, job) for job in advice_of_part.jobs_to_forget)
            )
            if self._cluster.status != Status.running:
                return False
            # Jobs that were lost or could not be submitted are submitted again first.
            lost = [job for job in part.host_indices if job not in self._cluster.workers]
            await asyncio.gather(*(self._remove_job(part, job) for job in lost[to_start:]))
            part.add(self._cluster, to_start - len(lost))
        return any(advice_of_part.jobs_to_start for advice_of_part in advice.values())

    def _queue_reports(self, jobs: Mapping[str, Mapping[str, Sequence[str]]]) -> list[QueueReport]:
        """Return the states of the queues that partitions share with other users."""
        for watch in self._watches:
            watch.refresh(has_jobs=any(jobs[name] for name in watch.partitions))
            if watch.problem:
                self._report_once(
                    f"No jobs of {watch.names} are released for other users, because the queue "
                    f"cannot be listed. {watch.problem}"
                )
        return [watch.report() for watch in self._watches]

    async def _remove_job(self, part: _PartitionJobs, job: str) -> None:
        """Remove a job. Its workers have been closed, or will be closed when they join."""
        self._cluster.worker_spec.pop(job, None)
        part.host_indices.pop(job, None)
        worker = self._cluster.workers.get(job)
        if worker is not None:
            worker.status = Status.closing  # otherwise, the cluster would refuse to close
            with suppress(OSError):  # the process has already ended
                await worker.close()
            worker.status = Status.closed
            self._cluster.workers.pop(job, None)

    def _report_once(self, message: str) -> None:
        """Report a message, unless it differs from an earlier message only in its numbers."""
        line = " ".join(message.split())[:400]
        text = re.sub(r"\d+", "", line)
        # An earlier message may be contained in this one, which can be a line of a log file.
        if not any(earlier in text for earlier in self._messages):
            self._messages.add(text)
            self._report(line)


async def _start_workers(cluster: SpecCluster) -> None:
    """Start the specified workers that the cluster is missing."""
    try:
        await cluster
    except Exception:
        for name, worker in list(cluster.workers.items()):
            if worker.status == Status.created:  # the next call will try to start it again
                del cluster.workers[name]
            # A cluster refuses to close while it has jobs that were not submitted. The status has
            # no other use, so that of running jobs does not matter.
            worker.status = Status.failed
        raise


class JobLogs:
    """Log files of jobs, which may explain why workers are missing.

    Dask does not notice if a job ends before its worker has connected.
    """

    def __init__(self, jobs: Iterable[Mapping[str, Any]]) -> None:
        self._folders = {Path(job["log_directory"]) for job in jobs if job.get("log_directory")}
        self._read = self._files()  # logs that existed before, or have been read
        self._previous: set[tuple[Path, int]] = set()

    def _files(self) -> set[tuple[Path, int]]:
        """Return the path and modification time (in nanoseconds) of each log file."""
        files = (path for folder in self._folders for path in folder.glob("*") if path.is_file())
        return {(path, path.stat().st_mtime_ns) for path in files}

    def new_last_lines(self) -> Iterator[str]:
        """Yield the last line of each new log file that has not changed since the previous call."""
        files = self._files()
        unchanged = (files & self._previous) - self._read
        self._read |= unchanged
        self._previous = files
        for path, _ in sorted(unchanged):
            with path.open("rb") as log:
                log.seek(max(0, path.stat().st_size - 4000))
                last_line = log.read().decode(errors="replace").rstrip().rpartition("\n")[2]
            if last_line and INFO_MARK not in last_line:
                yield f"The last line of the log {path} is: {last_line}"


def _describe_job(
    cluster: Any,
    name: str,
    partition: str,
    slots: int,
    index: int,
    partition_options: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the specification of a dask-jobqueue job.

    Each process of the job declares the slots as a resource. The options `cores` and `processes`
    determine its number of threads. `index` is not used, because the queue selects the host.
    """
    options = {**cluster.new_spec["options"], **partition_options}
    defaults = {"processes": 1, "worker_extra_args": [], "log_directory": None}
    for option, default in defaults.items():
        if options.get(option) is None:
            key = f"jobqueue.{options['config_name']}.{option}"
            options[option] = dask.config.get(key, None) or default
    declared = ["--resources", f"{partition}={slots}"]
    options["worker_extra_args"] = [*options["worker_extra_args"], *declared]
    # Creating a job raises an error if it does not accept an option.
    cluster.job_cls(cluster.scheduler_address, name=name, **options)
    processes = options["processes"]
    group = {"group": [f"-{process}" for process in range(processes)]} if processes > 1 else {}
    return {**cluster.new_spec, **group, "options": options}


def _describe_process(
    cluster: Any,
    name: str,
    partition: str,
    slots: int,
    index: int,
    partition_options: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the specification of an SSHCluster worker on the host with the given index."""
    common = cluster.scheduler_spec["options"]
    options = {key: common[key] for key in ("connect_options", "remote_python")} | dict(
        partition_options
    )
    hosts: Sequence[str] = options.pop("hosts", ())
    if isinstance(hosts, str) or not hosts:
        raise ValueError("`hosts` is missing. Set it to a list of hosts for the workers.")
    kwargs = {"name": name, "nthreads": slots, "resources": {partition: slots}}
    kwargs["death_timeout"] = _DEATH_S  # some SSH servers do not end the processes of a client
    options["kwargs"] = kwargs | options.pop("worker_options", {})
    options["address"] = hosts[index % len(hosts)]
    ssh.Worker(cluster.scheduler_address, **options)  # raises an error if an option is unknown
    return {"cls": ssh.Worker, "options": options}

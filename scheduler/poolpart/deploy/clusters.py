"""Partitions whose workers are jobs of a queue, or processes that SSH starts.

Their number is fixed, or follows the work; then `adapting.py` decides, on the scheduler.
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

from ..adapting import IDLE_S, Bounds, JobKind, begin, look
from ..errors import PoolError
from ..internals.names import ADAPTING, CLUSTERS, require
from ..internals.scheduler import ask_of_cluster
from ..rules import check_count, check_name

logger = logging.getLogger(__name__)

_NAME = "poolpart"  # of what looks after the jobs of a cluster
_ADAPT_EVERY_S = 1.0
_LOOK_EVERY_S = 5.0  # for workers that are gone
INFORMATION = " - INFO - "  # in lines of Dask's logs that are no complaints
_DEATH_S = 60  # a worker that finds no scheduler for so long ends, as those of dask-jobqueue do


def start_partitions(
    cluster: SpecCluster,
    partitions: Mapping[str, Mapping[str, Any]],
    tell: Callable[[str], object] = logger.warning,
) -> None:
    """Start the workers of partitions on a cluster of dask-jobqueue, or on an `SSHCluster`.

    They declare their partition from the start, and are named after it: ``GPU-0``, ``GPU-1``.
    This returns when all jobs are in the queue, or all hosts have been reached; workers join when
    the queue has started them. As long as the cluster is open, a job that has ended is submitted
    again, and partitions with ``adapt`` get jobs as tasks wait for them, and return idle ones. They
    go away with the cluster.

    Parameters
    ----------
    cluster
        One without workers: ``SLURMCluster(cores=1, memory="8GB")``, ``SSHCluster(["head"])``.
    partitions
        {name: options}. ``workers`` is their number, 1 by default, and ``slots`` the tasks that
        each takes at a time, 1 by default. In place of ``workers``, ``adapt`` is their least and
        greatest number, such as ``[0, 8]``, and ``idle_s`` after how many seconds without work
        they are returned, 60 by default; see `Partition.adapt`. All other options are those of the
        cluster's class, where this partition differs: ``job_extra_directives``, ``queue``,
        ``memory``. An SSHCluster takes ``connect_options``, ``remote_python``, ``worker_class``,
        ``worker_options``, and ``hosts``, which workers are dealt out to in turn; by default there
        is one for each.
    tell
        Called with what went wrong later: the last line of a job's log while workers are missing,
        or why a worker cannot be started.

    Raises
    ------
    PoolError
        If the cluster is another, has workers, or does not take an option, or its scheduler lacks
        this package.
    RuntimeError
        Or what else the cluster raises where a job is refused, or a host does not answer.

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
    require(CLUSTERS)
    jobqueue = sys.modules.get("dask_jobqueue")
    if jobqueue and isinstance(cluster, jobqueue.JobQueueCluster):
        describe = _job
    elif getattr(cluster, "scheduler_spec", {}).get("cls") is ssh.Scheduler:
        describe = _process
    else:
        raise PoolError(
            f"A {type(cluster).__name__} has workers of one kind: start them, and divide them with "
            "Pool.from_client(client).divide(…). Clusters of dask-jobqueue and SSHCluster can "
            "start them by partition."
        )
    if cluster.worker_spec or _NAME in cluster.periodic_callbacks:
        raise PoolError(
            f"The cluster has {len(cluster.worker_spec)} workers, or jobs for some, already: make "
            "one without (no n_workers; of an SSHCluster's hosts only the scheduler's)."
        )
    parts = {
        name: _PartitionJobs.of(cluster, describe, name, own) for name, own in partitions.items()
    }
    cluster.sync(_JobStarter(cluster, parts, tell).begin)


Describe = Callable[[Any, str, str, int, int, Mapping[str, Any]], dict[str, Any]]


@dataclass
class _PartitionJobs:
    """The jobs of one partition."""

    name: str
    own: Mapping[str, Any]  # options of the cluster's class
    count: int  # of jobs at first
    kind: JobKind
    describe: Describe
    made: int = 0  # jobs so far
    places: dict[str, int] = field(default_factory=dict)  # {job: its place, that of a host}

    @classmethod
    def of(
        cls, cluster: SpecCluster, describe: Describe, name: str, options: Mapping[str, Any]
    ) -> _PartitionJobs:
        """Read the options of a partition; PoolError if one is wrong. Nothing is started."""
        check_name(name)
        own = dict(options)
        slots = own.pop("slots", 1)
        check_count(f"The number of slots of partition {name!r}", slots)
        bounds, idle_s = None, own.pop("idle_s", None)
        if (adapt := own.pop("adapt", None)) is not None:
            require(ADAPTING)
            if "workers" in own or not isinstance(adapt, Sequence) or len(adapt) != 2:
                raise PoolError(
                    f"adapt of partition {name!r} is {adapt!r}; give the least and the greatest "
                    "number of workers, such as [0, 8], and no workers beside it."
                )
            least, most = adapt
            bounds = Bounds.checked(name, least, most, IDLE_S if idle_s is None else idle_s)
        elif idle_s is not None:
            raise PoolError(f"Partition {name!r} has idle_s without adapt: give it [0, 8] or so.")
        try:
            count = bounds.minimum if bounds else own.pop("workers", len(own.get("hosts", ".")))
            check_count(f"The number of workers of partition {name!r}", count, least=0)
            sample = describe(cluster, f"{name}-0", name, slots, 0, own)  # that it can be done
        except (TypeError, ValueError) as error:
            raise PoolError(f"Partition {name!r} cannot be started: {error}") from error
        kind = JobKind(slots, len(sample.get("group", ".")), bounds)
        return cls(name, own, count, kind, describe)

    def add(self, cluster: SpecCluster, count: int) -> None:
        """Have the cluster start so many more jobs."""
        for _ in range(count):
            # A new name for each: for some time after a worker was lost, Dask would take another
            # job of its name for it, and cancel it.
            job = f"{self.name}-{self.made}"
            self.made += 1
            place = next(n for n in range(self.made) if n not in self.places.values())
            self.places[job] = place
            spec = self.describe(cluster, job, self.name, self.kind.slots, place, self.own)
            cluster.worker_spec[job] = spec

    def workers(self, cluster: SpecCluster) -> dict[str, list[str]]:
        """Names of the workers of each job that was submitted, by job."""
        return {
            job: [job + suffix for suffix in cluster.worker_spec[job].get("group", [""])]
            for job in self.places
            if job in cluster.workers
        }


class _JobStarter:
    """Starts the jobs of partitions: all that are to be there, and again those that are lost."""

    def __init__(
        self,
        cluster: SpecCluster,
        parts: Mapping[str, _PartitionJobs],
        tell: Callable[[str], object],
    ) -> None:
        self._cluster, self._parts, self._tell = cluster, parts, tell
        samples = (p.describe(cluster, "", p.name, 1, 0, p.own) for p in parts.values())
        self._logs = _JobLogs(sample["options"] for sample in samples)
        self._told: set[str] = set()
        self._looked = time.monotonic()

    async def begin(self) -> None:
        """Submit the first jobs, and look after all of them as long as the cluster is open."""
        kinds = {name: part.kind for name, part in self._parts.items()}
        try:
            await ask_of_cluster(self._cluster, begin, kinds=kinds)
        except ModuleNotFoundError as error:
            raise PoolError(
                f"The cluster's scheduler has no module {error.name!r}: start it in the same "
                "environment as this process."
            ) from error
        for part in self._parts.values():
            part.add(self._cluster, part.count)
        await _start(self._cluster)
        again = PeriodicCallback(self._look, 1000 * _ADAPT_EVERY_S)
        self._cluster.periodic_callbacks[_NAME] = again  # ends with the cluster
        again.start()

    async def _look(self) -> None:
        if self._cluster.status != Status.running:
            return
        with suppress(OSError):  # the scheduler is ending
            changed = await self._adapt()
            now = time.monotonic()
            due = now - self._looked >= _LOOK_EVERY_S
            if changed or due:
                # A SpecCluster lets go of a worker that is lost, and starts another when asked to.
                try:
                    await _start(self._cluster)
                except Exception as error:
                    self._say(f"A worker cannot be started: {error}")
            if due:
                self._looked = now
                if self._cluster.plan - self._cluster.observed:  # workers are missing
                    for line in self._logs.endings():
                        self._say(line)

    async def _adapt(self) -> bool:
        """Do what the scheduler advises; returns whether jobs have to be started."""
        jobs = {name: part.workers(self._cluster) for name, part in self._parts.items()}
        advice = await ask_of_cluster(self._cluster, look, jobs=jobs)
        for name, one in advice.items():
            part = self._parts[name]
            await asyncio.gather(*(self._end(part, job) for job in one.ended))
            if self._cluster.status != Status.running:
                return False
            # Lost ones, and those that could not be submitted.
            again = [job for job in part.places if job not in self._cluster.workers]
            await asyncio.gather(*(self._end(part, job) for job in again[one.more :]))
            part.add(self._cluster, one.more - len(again))
        return any(one.more for one in advice.values())

    async def _end(self, part: _PartitionJobs, job: str) -> None:
        """Let go of a job: its workers have been closed, or will be if they join."""
        self._cluster.worker_spec.pop(job, None)
        part.places.pop(job, None)
        if (worker := self._cluster.workers.get(job)) is not None:
            worker.status = Status.closing  # else the cluster refuses to close meanwhile
            with suppress(OSError):  # its process has ended
                await worker.close()
            worker.status = Status.closed
            self._cluster.workers.pop(job, None)

    def _say(self, words: str) -> None:
        line = " ".join(words.split())[:400]
        alike = re.sub(r"\d+", "", line)  # but for the numbers of jobs
        if not any(one in alike for one in self._told):  # also in the log of this program itself
            self._told.add(alike)
            self._tell(line)


async def _start(cluster: SpecCluster) -> None:
    """Start what the cluster lacks of the workers that it is to have."""
    try:
        await cluster
    except Exception:
        for name, worker in list(cluster.workers.items()):
            if worker.status == Status.created:  # it is tried again
                del cluster.workers[name]
            # While it knows of jobs that were not submitted, a cluster refuses to close.
            worker.status = Status.failed
        raise


class _JobLogs:
    """Logs of jobs: why workers are missing. Dask does not notice jobs that end before."""

    def __init__(self, jobs: Iterable[Mapping[str, Any]]) -> None:
        self._folders = {Path(job["log_directory"]) for job in jobs if job.get("log_directory")}
        self._done = self._files()  # logs that are older, or have been read
        self._last: set[tuple[Path, int]] = set()

    def _files(self) -> set[tuple[Path, int]]:
        """All files, and when they were written to."""
        files = (path for folder in self._folders for path in folder.glob("*") if path.is_file())
        return {(path, path.stat().st_mtime_ns) for path in files}

    def endings(self) -> Iterator[str]:
        """Last lines of logs that have not changed since the last look."""
        now = self._files()
        still = (now & self._last) - self._done
        self._done |= still
        self._last = now
        for path, _ in sorted(still):
            with path.open("rb") as log:
                log.seek(max(0, path.stat().st_size - 4000))
                last = log.read().decode(errors="replace").rstrip().rpartition("\n")[2]
            if last and INFORMATION not in last:
                yield f"The log {path} ends: {last}"


def _job(
    cluster: Any, name: str, partition: str, slots: int, number: int, own: Mapping[str, Any]
) -> dict[str, Any]:
    """Describe a job as a cluster of dask-jobqueue does."""
    options = {**cluster.new_spec["options"], **own}
    defaults = {"processes": 1, "worker_extra_args": [], "log_directory": None}
    for option, default in defaults.items():
        if options.get(option) is None:
            key = f"jobqueue.{options['config_name']}.{option}"
            options[option] = dask.config.get(key, None) or default
    declared = ["--resources", f"{partition}={slots}"]
    options["worker_extra_args"] = [*options["worker_extra_args"], *declared]
    cluster.job_cls(cluster.scheduler_address, name=name, **options)  # that it takes them
    processes = options["processes"]
    group = {"group": [f"-{process}" for process in range(processes)]} if processes > 1 else {}
    return {**cluster.new_spec, **group, "options": options}


def _process(
    cluster: Any, name: str, partition: str, slots: int, number: int, own: Mapping[str, Any]
) -> dict[str, Any]:
    """Describe a worker as an SSHCluster does."""
    common = cluster.scheduler_spec["options"]
    options = {key: common[key] for key in ("connect_options", "remote_python")} | dict(own)
    hosts: Sequence[str] = options.pop("hosts", ())
    if isinstance(hosts, str) or not hosts:
        raise ValueError('it needs "hosts", a list of those that its workers are to be on.')
    kwargs = {"name": name, "nthreads": slots, "resources": {partition: slots}}
    kwargs["death_timeout"] = _DEATH_S  # not every SSH server ends processes for its client
    options["kwargs"] = kwargs | options.pop("worker_options", {})
    options["address"] = hosts[number % len(hosts)]
    ssh.Worker(cluster.scheduler_address, **options)  # that it takes them
    return {"cls": ssh.Worker, "options": options}

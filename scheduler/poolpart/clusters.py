"""Partitions whose workers are jobs of a queue, or processes that SSH starts."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import dask
from distributed import SpecCluster, Status
from distributed.deploy import ssh
from tornado.ioloop import PeriodicCallback

from .errors import PoolError
from .rules import check_count, check_name

logger = logging.getLogger(__name__)

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
    again. They go away with the cluster.

    Parameters
    ----------
    cluster
        One without workers: ``SLURMCluster(cores=1, memory="8GB")``, ``SSHCluster(["head"])``.
    partitions
        {name: options}. ``workers`` is their number, 1 by default, and ``slots`` the tasks that
        each takes at a time, 1 by default. All other options are those of the cluster's class,
        where this partition differs: ``job_extra_directives``, ``queue``, ``memory``. An
        SSHCluster takes ``connect_options``, ``remote_python``, ``worker_class``,
        ``worker_options``, and ``hosts``, which workers are dealt out to in turn; by default there
        is one for each.
    tell
        Called with what went wrong later: the last line of a job's log while workers are missing,
        or why a lost worker cannot be started again.

    Raises
    ------
    PoolError
        If the cluster is another, has workers, or does not take an option.
    RuntimeError
        Or what else the cluster raises where a job is refused, or a host does not answer.

    Examples
    --------
    >>> with SLURMCluster(cores=1, memory="8GB") as cluster:           # doctest: +SKIP
    ...     start_partitions(
    ...         cluster,
    ...         {
    ...             "GPU": {"workers": 2, "job_extra_directives": ["--gres=gpu:1"]},
    ...             "IO": {"slots": 8},
    ...         },
    ...     )
    """
    jobqueue = sys.modules.get("dask_jobqueue")
    if jobqueue and isinstance(cluster, jobqueue.JobQueueCluster):
        describe = _jobs
    elif getattr(cluster, "scheduler_spec", {}).get("cls") is ssh.Scheduler:
        describe = _processes
    else:
        raise PoolError(
            f"A {type(cluster).__name__} has workers of one kind: start them, and divide them with "
            "Pool.from_client(client).divide(…). Clusters of dask-jobqueue and SSHCluster can "
            "start them by partition."
        )
    if cluster.worker_spec:
        raise PoolError(
            f"The cluster has {len(cluster.worker_spec)} workers, or jobs for some, already: make "
            "one without (no n_workers; of an SSHCluster's hosts only the scheduler's)."
        )
    workers: dict[str, Any] = {}
    for name, options in partitions.items():
        check_name(name)
        own = dict(options)
        slots = own.pop("slots", 1)
        check_count(f"The number of slots of partition {name!r}", slots)
        try:
            count = own.pop("workers", len(own.get("hosts", ".")))
            check_count(f"The number of workers of partition {name!r}", count, least=0)
            for number in range(count):
                worker = f"{name}-{number}"
                workers[worker] = describe(cluster, worker, name, slots, number, own)
        except (TypeError, ValueError) as error:
            raise PoolError(f"Partition {name!r} cannot be started: {error}") from error

    cluster.worker_spec.update(workers)
    logs = _JobLogs(cluster)
    cluster.sync(_start, cluster)
    told: set[str] = set()

    def say(words: str) -> None:
        line = " ".join(words.split())[:400]
        alike = re.sub(r"\d+", "", line)  # but for the numbers of jobs
        if not any(one in alike for one in told):  # also in the log of this program itself
            told.add(alike)
            tell(line)

    async def start_again() -> None:
        # A SpecCluster lets go of a worker that is lost, and starts another when it is asked to.
        if cluster.status == Status.running:
            try:
                await _start(cluster)
            except Exception as error:
                say(f"A worker was lost, and cannot be started again: {error}")
            with suppress(OSError):
                for line in logs.endings() if cluster.plan - cluster.observed else ():
                    say(line)

    def watch() -> None:
        again = PeriodicCallback(start_again, 1000 * _LOOK_EVERY_S)
        cluster.periodic_callbacks["partitions"] = again
        again.start()

    cluster.loop.add_callback(watch)


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

    def __init__(self, cluster: SpecCluster) -> None:
        jobs = [spec["options"] for spec in cluster.worker_spec.values()]
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


def _jobs(
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


def _processes(
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

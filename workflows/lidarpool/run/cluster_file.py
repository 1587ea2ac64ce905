"""Cluster files: YAML with the cluster to start for a run, and its workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from distributed import SpecCluster, SSHCluster
from distributed.deploy import ssh
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from lidarsim.environment.extras import install_command
from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.errors import LidarError
from lidarsim.io.yamlfile import read_yaml
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.words import did_you_mean, plural
from poolpart.deploy import start_partitions
from poolpart.deploy.clusters import INFO_MARK

from .pipeline.stage_names import GPU, LIDAR, OTHER

# A scheduler that SSH has started outlives a driver that was killed: it ends after this time
# without tasks.
_IDLE_TIMEOUT = "1h"
_CONNECT_TIMEOUT = "30s"  # limit for a host to answer


class WorkerGroup(BaseModel):
    """Workers of a partition; extra fields override arguments of the cluster."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)

    workers: int = Field(1, ge=0, le=10_000)
    adapt: list[int] | None = Field(None, min_length=2, max_length=2)  # least and greatest number
    idle_s: float | None = Field(None, ge=0, allow_inf_nan=False)
    slots: int = Field(1, ge=1, le=10_000)
    hosts: list[str] | None = Field(None, min_length=1)

    @property
    def worker_limit(self) -> int:
        """Largest number of workers."""
        if self.adapt:
            return self.adapt[1]
        counted = self.hosts and "workers" not in self.model_fields_set
        return len(self.hosts or ()) if counted else self.workers

    def __str__(self) -> str:
        return f"{self.adapt[0]} to {self.worker_limit}" if self.adapt else str(self.worker_limit)

    def mistake(self) -> str:
        """Return a message about a wrong number of workers, or no text without a mistake."""
        if self.adapt is None:
            return "" if self.idle_s is None else "idle_s requires adapt, such as `adapt: [0, 8]`."
        if "workers" in self.model_fields_set:
            return "adapt and workers cannot be combined."
        min_workers, max_workers = self.adapt
        if not 0 <= min_workers <= max_workers <= 10_000 or max_workers < 1:
            return (
                "adapt must be the minimum and the maximum number of workers, such as [0, 8], but "
                f"is {self.adapt}."
            )
        return ""


class ClusterFile(BaseModel):
    """The cluster to start, as docs/how-to/queues.md describes."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    cluster: str  # class, such as ``dask_jobqueue.SLURMCluster`` or ``distributed.SSHCluster``
    arguments: dict[str, Any] = {}
    partitions: dict[str, WorkerGroup]
    _source: str = PrivateAttr("cluster file")

    @classmethod
    def load(cls, path: Path) -> ClusterFile:
        """Read a file and import the class of the cluster, but start no worker.

        LidarError if the file cannot be read, a field is wrong, a package is missing, or the class
        is not a cluster.
        """
        content = read_yaml(path, "a cluster file contains cluster:, arguments: and partitions:")
        with convert_validation_errors(cls, path, content):
            file = cls.model_validate(content)
        file._source = str(path)
        for name, workers in file.partitions.items():
            if name not in (GPU, LIDAR, OTHER):
                raise LidarError(
                    f"{path}: Unknown partition {name!r}."
                    f"{did_you_mean(name, (GPU, LIDAR, OTHER))} The partitions of a survey are "
                    f"{GPU}, {LIDAR} and {OTHER}."
                )
            if mistake := workers.mistake():
                raise LidarError(f"{path}: partitions.{name}.{mistake}")
        file._factory()
        return file

    @property
    def slots(self) -> dict[str, int]:
        """Largest number of slots of each partition."""
        return {name: group.worker_limit * group.slots for name, group in self.partitions.items()}

    def require(self, required_slots: Mapping[str, int]) -> None:
        """Raise LidarError if a partition cannot have the required slots."""
        for name, required in required_slots.items():
            if (available := self.slots.get(name, 0)) < required:
                raise LidarError(
                    f"{self._source}: Partition {name} has {plural(available, 'slot')}, but the "
                    f"run needs {required}. Increase its `slots` or `workers`, for example "
                    f"`slots: {required}`."
                )

    def __str__(self) -> str:
        partitions = ", ".join(f"{name} {workers}" for name, workers in self.partitions.items())
        total = plural(sum(group.worker_limit for group in self.partitions.values()), "worker")
        total = (
            f"up to {total}" if any(group.adapt for group in self.partitions.values()) else total
        )
        return f"{self.cluster.rpartition('.')[2]}: {total}, {partitions}"

    @contextmanager
    def started(self, tell: Callable[[str], object]) -> Iterator[SpecCluster]:
        """Start the cluster with its workers, which run or are in a queue, while the body runs.

        `tell` is called with messages about failing workers. LidarError if the cluster does not
        start, or does not accept an argument.
        """
        arguments = dict(self.arguments)
        partitions = self.model_dump(exclude_unset=True)["partitions"]
        factory = self._factory()
        ssh_lines: list[str] = []
        try:
            if factory is SSHCluster:
                shared = {"worker_options", "worker_class"} & arguments.keys()
                common = {option: arguments.pop(option) for option in shared}
                partitions = {name: common | options for name, options in partitions.items()}
                for option, key, value in (
                    ("scheduler_options", "idle_timeout", _IDLE_TIMEOUT),
                    ("connect_options", "connect_timeout", _CONNECT_TIMEOUT),
                ):
                    arguments[option] = {key: value} | arguments.get(option, {})
            with _listening(ssh_lines):
                cluster = factory(**arguments)
                try:
                    start_partitions(cluster, partitions, tell)
                except BaseException:
                    cluster.close()
                    raise
        except Exception as error:  # sbatch, SSH and constructors raise any error
            # The messages of jobqueue go on with all arguments.
            message = str(error).partition(" Very likely")[0]
            message = ": ".join(
                [message, *[line for line in ssh_lines if INFO_MARK not in line][-1:]]
            )
            reason = " ".join(f"{type(error).__name__}: {message}".split())[:400]
            raise LidarError(
                f"{self._source}: {self.cluster} could not be started ({reason})."
            ) from error
        with cluster:
            yield cluster

    def _factory(self) -> Any:
        """Return the class of the cluster, or raise LidarError for another name."""
        package, _, name = self.cluster.rpartition(".")
        try:
            # Keeps the signal handlers of this process: dask-jobqueue installs its own.
            with defer_interrupts():
                factory = getattr(import_module(package), name, None)
        except ModuleNotFoundError as error:
            raise LidarError(
                f"{self._source}: {self.cluster} is not installed ({error}). "
                f"To install dask-jobqueue and the requirements of SSHCluster, run "
                f"{install_command('lidarpool[clusters]')}."
            ) from error
        except ValueError:  # no dot
            factory = None
        if factory is not SSHCluster and not (
            isinstance(factory, type) and issubclass(factory, SpecCluster)
        ):
            raise LidarError(
                f"{self._source}: {self.cluster} cannot start workers for each partition. "
                "Set `cluster` to a class of dask_jobqueue, such as dask_jobqueue.SLURMCluster, or "
                "to distributed.SSHCluster. To use a different cluster, start it yourself and "
                "pass `--scheduler`."
            )
        return factory


@contextmanager
def _listening(lines: list[str]) -> Iterator[None]:
    """Append output of processes that SSH starts, which Dask only logs, to `lines`."""

    def info(line: str, *arguments: object) -> None:
        lines.append(line)
        log(line, *arguments)

    log = ssh.logger.info
    ssh.logger.info = info
    try:
        yield
    finally:
        del ssh.logger.info

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

from lidarsim.base.errors import LidarError
from lidarsim.base.interrupts import deferred_interrupts
from lidarsim.base.validation import sentences
from lidarsim.base.words import did_you_mean, plural
from lidarsim.base.yamlfile import read_yaml
from poolpart.deploy import start_partitions
from poolpart.deploy.clusters import INFORMATION

from ..pipeline.names import GPU, LIDAR, OTHER

# A scheduler that SSH has started outlives a driver that was killed: it ends when it has been
# without tasks for so long. And a host that does not answer is given up after so long.
_IDLE = "1h"
_CONNECT = "30s"


class WorkerGroup(BaseModel):
    """Workers of a partition; other fields are arguments of the cluster that differ for it."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)

    workers: int = Field(1, ge=0, le=10_000)
    adapt: list[int] | None = Field(None, min_length=2, max_length=2)  # least and greatest number
    idle_s: float | None = Field(None, ge=0, allow_inf_nan=False)
    slots: int = Field(1, ge=1, le=10_000)
    hosts: list[str] | None = Field(None, min_length=1)

    @property
    def most(self) -> int:
        """Workers that there may be."""
        if self.adapt:
            return self.adapt[1]
        counted = self.hosts and "workers" not in self.model_fields_set
        return len(self.hosts or ()) if counted else self.workers

    def __str__(self) -> str:
        return f"{self.adapt[0]} to {self.most}" if self.adapt else str(self.most)

    def wrong(self) -> str:
        """Say what is wrong with the number of workers; empty if nothing is."""
        if self.adapt is None:
            return "" if self.idle_s is None else "idle_s needs adapt beside it, such as [0, 8]."
        if "workers" in self.model_fields_set:
            return "adapt is a number of workers too: leave out workers."
        least, most = self.adapt
        if not 0 <= least <= most <= 10_000 or most < 1:
            return f"adapt is {self.adapt}: give the least and the greatest number, such as [0, 8]."
        return ""


class ClusterFile(BaseModel):
    """The cluster to start; see docs/how-to/queues.md."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    cluster: str  # class, such as ``dask_jobqueue.SLURMCluster`` or ``distributed.SSHCluster``
    arguments: dict[str, Any] = {}
    partitions: dict[str, WorkerGroup]
    _source: str = PrivateAttr("cluster file")

    @classmethod
    def load(cls, path: Path) -> ClusterFile:
        """Read a file and import what it names; nothing is started.

        LidarError if it cannot be read, a field is wrong, a package is missing, or the class is
        not a cluster.
        """
        content = read_yaml(path, "a cluster file has cluster:, arguments: and partitions:")
        with sentences(cls, path):
            file = cls.model_validate(content)
        file._source = str(path)
        for name, workers in file.partitions.items():
            if name not in (GPU, LIDAR, OTHER):
                raise LidarError(
                    f"{path}: partitions.{name} is not a partition of a survey: GPU, LIDAR or "
                    f"OTHER.{did_you_mean(name, (GPU, LIDAR, OTHER))}"
                )
            if wrong := workers.wrong():
                raise LidarError(f"{path}: partitions.{name}.{wrong}")
        file._factory()
        return file

    @property
    def slots(self) -> dict[str, int]:
        """Slots of each partition, the most that it may have."""
        return {name: one.most * one.slots for name, one in self.partitions.items()}

    def require(self, needed: Mapping[str, int]) -> None:
        """Check that the partitions have so many slots; LidarError if not."""
        for name, least in needed.items():
            if (there := self.slots.get(name, 0)) < least:
                raise LidarError(
                    f"{self._source}: partition {name} has {there} of the {least} slots needed: "
                    f"give it more slots or workers, such as {{slots: {least}}}."
                )

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {workers}" for name, workers in self.partitions.items())
        total = plural(sum(one.most for one in self.partitions.values()), "worker")
        total = f"up to {total}" if any(one.adapt for one in self.partitions.values()) else total
        return f"{self.cluster.rpartition('.')[2]}: {total}, {parts}"

    @contextmanager
    def started(self, tell: Callable[[str], object]) -> Iterator[SpecCluster]:
        """Cluster with these workers, which are there or in a queue, as long as the body runs.

        `tell` is called with what goes wrong with workers meanwhile. LidarError if it does not
        start, or does not take an argument.
        """
        arguments = dict(self.arguments)
        partitions = self.model_dump(exclude_unset=True)["partitions"]
        factory = self._factory()
        heard: list[str] = []
        try:
            if factory is SSHCluster:
                shared = {"worker_options", "worker_class"} & arguments.keys()
                common = {option: arguments.pop(option) for option in shared}
                partitions = {name: common | own for name, own in partitions.items()}
                for option, key, value in (
                    ("scheduler_options", "idle_timeout", _IDLE),
                    ("connect_options", "connect_timeout", _CONNECT),
                ):
                    arguments[option] = {key: value} | arguments.get(option, {})
            with _listening(heard):
                cluster = factory(**arguments)
                try:
                    start_partitions(cluster, partitions, tell)
                except BaseException:
                    cluster.close()
                    raise
        except Exception as error:  # of sbatch, of SSH, of a constructor: any
            told = str(error).partition(" Very likely")[0]  # jobqueue goes on with all arguments
            told = ": ".join([told, *[line for line in heard if INFORMATION not in line][-1:]])
            reason = " ".join(f"{type(error).__name__}: {told}".split())[:400]
            raise LidarError(
                f"{self._source}: {self.cluster} was not started ({reason})."
            ) from error
        with cluster:
            yield cluster

    def _factory(self) -> Any:
        """Import the class; only clusters are taken."""
        package, _, name = self.cluster.rpartition(".")
        try:
            with deferred_interrupts():  # and their handlers kept: dask-jobqueue brings its own
                found = getattr(import_module(package), name, None)
        except ModuleNotFoundError as error:
            raise LidarError(
                f"{self._source}: {self.cluster} is not installed ({error}): pip install "
                "'lidarpool[clusters]' has dask-jobqueue and what SSHCluster needs."
            ) from error
        except ValueError:  # no dot
            found = None
        if found is not SSHCluster and not (
            isinstance(found, type) and issubclass(found, SpecCluster)
        ):
            raise LidarError(
                f"{self._source}: {self.cluster} cannot be started by partition: "
                "give dask_jobqueue.SLURMCluster, another of dask_jobqueue, or "
                "distributed.SSHCluster. Start others yourself, and use --scheduler."
            )
        return found


@contextmanager
def _listening(heard: list[str]) -> Iterator[None]:
    """Collect what processes that SSH starts say until they are up; Dask only logs it."""

    def info(line: str, *arguments: object) -> None:
        heard.append(line)
        log(line, *arguments)

    log = ssh.logger.info
    ssh.logger.info = info
    try:
        yield
    finally:
        del ssh.logger.info

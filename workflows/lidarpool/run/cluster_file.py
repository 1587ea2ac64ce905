"""YAML files that describe the cluster and workers to start for a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from lidarsim.environment.extras import install_command
from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.errors import LidarError
from lidarsim.io.yamlfile import read_yaml
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.words import did_you_mean, plural

from .pipeline.stage_names import GPU, LIDAR, OTHER

if TYPE_CHECKING:
    from distributed import SpecCluster

# A scheduler that was started over SSH keeps running if the driver is killed, so it exits after
# being idle for this time.
_IDLE_TIMEOUT = "1h"
_CONNECT_TIMEOUT = "30s"  # time limit for connecting to a host


class WorkerGroup(BaseModel):
    """Workers of a partition in a cluster file.

    Extra fields override the arguments of the cluster for these workers.
    """

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)

    workers: int = Field(1, ge=0, le=10_000)
    adapt: list[int] | None = Field(None, min_length=2, max_length=2)  # minimum and maximum number
    idle_s: float | None = Field(None, ge=0, allow_inf_nan=False)
    yield_to_others: bool = False
    slots: int = Field(1, ge=1, le=10_000)
    hosts: list[str] | None = Field(None, min_length=1)

    @property
    def worker_limit(self) -> int:
        """Maximum number of workers in the group."""
        if self.adapt:
            return self.adapt[1]
        counted = self.hosts and "workers" not in self.model_fields_set
        return len(self.hosts or ()) if counted else self.workers

    def __str__(self) -> str:
        return f"{self.adapt[0]} to {self.worker_limit}" if self.adapt else str(self.worker_limit)

    def describe_mistake(self) -> str:
        """Return an error message if the number of workers is invalid, or else an empty string."""
        if self.adapt is None:
            options = {"idle_s": self.idle_s is not None, "yield_to_others": self.yield_to_others}
            option = next((name for name, is_set in options.items() if is_set), "")
            return option and f"{option} requires adapt, such as `adapt: [0, 8]`."
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
    """Description of a cluster that can be started.

    See docs/how-to/queues.md for the format.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    cluster: str  # class such as ``dask_jobqueue.SLURMCluster`` or ``distributed.SSHCluster``
    arguments: dict[str, Any] = {}
    partitions: dict[str, WorkerGroup]
    _source: str = PrivateAttr("cluster file")

    @classmethod
    def load(cls, path: Path) -> ClusterFile:
        """Read a cluster file, and import the cluster's class without starting workers.

        Raises
        ------
        LidarError
            If the file cannot be read, a field is invalid, a package is missing, or the class is
            not a supported cluster.
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
            if mistake := workers.describe_mistake():
                raise LidarError(f"{path}: partitions.{name}.{mistake}")
        file._import_class()
        return file

    @property
    def slots(self) -> dict[str, int]:
        """Maximum number of slots in each partition."""
        return {name: group.worker_limit * group.slots for name, group in self.partitions.items()}

    def require(self, required_slots: Mapping[str, int]) -> None:
        """Raise LidarError if a partition has fewer slots than required."""
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
    def start(self, report: Callable[[str], object]) -> Iterator[SpecCluster]:
        """Start the cluster and its workers, and stop them at the end of the context.

        Workers may still be waiting in the queue of a batch system when the body starts.

        Parameters
        ----------
        report
            Function that is called with messages about failing workers.

        Raises
        ------
        LidarError
            If the cluster does not start or does not accept an argument.
        """
        # These modules are imported late, because a run without a cluster file needs none of them.
        from distributed import SSHCluster

        from poolpart.deploy import start_partitions
        from poolpart.deploy.clusters import INFO_MARK

        arguments = dict(self.arguments)
        partitions = self.model_dump(exclude_unset=True)["partitions"]
        factory = self._import_class()
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
            with _capture_ssh_output(ssh_lines):
                cluster = factory(**arguments)
                try:
                    start_partitions(cluster, partitions, report)
                except BaseException:
                    cluster.close()
                    raise
        except Exception as error:  # sbatch, SSH and constructors may raise any error
            # In messages of dask-jobqueue, this text is followed by all arguments.
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

    def _import_class(self) -> Any:
        """Import the cluster's class, or raise LidarError if it is not supported."""
        from distributed import SpecCluster, SSHCluster  # imported late, as in `start`

        package, _, name = self.cluster.rpartition(".")
        try:
            # dask-jobqueue installs signal handlers, which must not replace those of this process.
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
def _capture_ssh_output(lines: list[str]) -> Iterator[None]:
    """Append the output of processes that Dask starts over SSH to `lines`.

    Dask only logs this output.
    """
    from distributed.deploy import ssh  # imported late, as in `start`

    def info(line: str, *arguments: object) -> None:
        lines.append(line)
        log(line, *arguments)

    log = ssh.logger.info
    ssh.logger.info = info
    try:
        yield
    finally:
        del ssh.logger.info

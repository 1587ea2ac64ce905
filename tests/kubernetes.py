"""A stand-in for dask-kubernetes: worker groups whose workers are in this process.

It has the documented interface of `dask_kubernetes.operator.KubeCluster`, and does what the source
of the operator's controller does: Deployments start a container again that has ended, and a group
that shrinks closes the least busy workers of the whole cluster.
"""

from __future__ import annotations

import asyncio
import re
import sys
from types import ModuleType
from typing import Any
from uuid import uuid4

from distributed import Scheduler, SpecCluster, Worker
from tests.clusters import QUIET

_clusters: list[KubeCluster] = []  # those that run


class NotFoundError(Exception):
    """Kubernetes has no object of this name."""


class Deployment:
    """A Deployment of a worker, as `kr8s.objects` has it."""

    def __init__(self, name: str, namespace: str | None = None) -> None:
        self.name = name
        self.namespace = namespace

    def delete(self) -> None:
        for cluster in _clusters:
            cluster.check_api()
            if cluster.namespace == self.namespace and self.name in cluster.deployments:
                cluster.sync(cluster._delete, self.name)
                return
        raise NotFoundError(self.name)


class KubeCluster(SpecCluster):
    """A cluster with worker groups."""

    def __init__(self, *, name: str, namespace: str = "default", n_workers: int = 3) -> None:
        assert n_workers == 0
        self.namespace = namespace
        self.deployments: dict[str, str] = {}  # {name of a worker: name of its group}
        self.retired: list[str] = []  # workers that the operator has closed
        self.started: list[str] = []  # names of workers, again for each start of a container
        self.sizes: list[tuple[str, int]] = []  # calls of `scale`
        self.is_away = False  # whether all calls of Kubernetes raise an error
        self._commands: dict[str, list[str]] = {}  # {group: command of its workers}
        self._containers: dict[str, asyncio.Task[None]] = {}
        options = {"host": "127.0.0.1", "port": 0, "dashboard": False}
        options["dashboard_address"] = "127.0.0.1:0"
        scheduler = {"cls": Scheduler, "options": options}
        super().__init__({}, scheduler, name=name, silence_logs=QUIET)
        _clusters.append(self)

    def add_worker_group(
        self,
        name: str,
        n_workers: int = 3,
        image: str | None = None,
        resources: dict[str, dict[str, str]] | None = None,
        worker_command: str | list[str] | None = None,
        env: dict[str, str] | None = None,
        custom_spec: dict[str, Any] | None = None,
    ) -> None:
        assert re.fullmatch(r"[a-z0-9-]+", name)
        assert worker_command is not None
        command = worker_command.split(" ") if isinstance(worker_command, str) else worker_command
        self._commands[name] = command
        self.sync(self._set_size, name, n_workers)

    def delete_worker_group(self, name: str) -> None:
        self.sync(self._set_size, name, 0)
        del self._commands[name]

    def scale(self, n: int, worker_group: str = "default") -> None:
        if worker_group == "default":  # the end of a SpecCluster, too
            super().scale(n)
            return
        self.check_api()
        self.sizes.append((worker_group, n))
        self.sync(self._set_size, worker_group, n)

    def check_api(self) -> None:
        if self.is_away:
            raise ConnectionError("the API server is away")

    async def _set_size(self, group: str, n: int) -> None:
        """Start or close workers, as the operator does when the number of replicas changes."""
        deployments = [name for name, its_group in self.deployments.items() if its_group == group]
        for _ in range(n - len(deployments)):
            worker = f"{self.name}-{group}-worker-{uuid4().hex[:10]}"
            self.deployments[worker] = group
            self._containers[worker] = asyncio.ensure_future(self._run(worker, group))
        if n < len(deployments):
            number = len(deployments) - n
            names = self.scheduler.workers_to_close(n=number, attribute="name")
            await self.scheduler.retire_workers(names=names)
            self.retired += names
            for name in names:
                await self._delete(name)

    async def _run(self, worker: str, group: str) -> None:
        """Start a container, again and again, as Kubernetes does."""
        command = self._commands[group]
        partition, slots = command[command.index("--resources") + 1].split("=")
        options = {"resources": {partition: int(slots)}, "host": "127.0.0.1", "dashboard": False}
        while True:
            self.started.append(worker)
            async with Worker(
                self.scheduler_address, name=worker, nthreads=1, **options
            ) as running:
                await running.finished()
            await asyncio.sleep(0.05)

    async def _delete(self, worker: str) -> None:
        """Delete the Deployment of a worker, and end its container."""
        del self.deployments[worker]
        container = self._containers.pop(worker)
        container.cancel()
        await asyncio.wait([container])

    async def _close(self) -> None:
        for worker in list(self.deployments):
            await self._delete(worker)
        await super()._close()
        if self in _clusters:
            _clusters.remove(self)


def install(monkeypatch: Any) -> None:
    """Let programs import the stand-in as dask-kubernetes and kr8s."""
    names = {
        "dask_kubernetes": {},
        "dask_kubernetes.operator": {"KubeCluster": KubeCluster},
        "kr8s": {"NotFoundError": NotFoundError},
        "kr8s.objects": {"Deployment": Deployment},
    }
    for name, attributes in names.items():
        module = ModuleType(name)
        vars(module).update(attributes)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("poolpart.deploy.worker_groups.ADAPT_EVERY_S", 0.05)

"""What is known of one worker; a leaf module."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class WorkerInfo:
    """One worker of a cluster.

    Parameters
    ----------
    name
        The worker's name. One that it was given stays when a nanny restarts the worker; the
        address does not, nor a name that Dask made of the address.
    address, host
        Where it listens, and on which host.
    nthreads
        Its threads.
    memory
        Its memory limit in bytes, 0 for none.
    gpus
        UUIDs of the CUDA devices it may use, by ordinal.
    resources
        Dask resources that it declares, by name.
    """

    name: str
    address: str
    host: str
    nthreads: int
    memory: int = 0
    gpus: tuple[str, ...] = ()
    resources: Mapping[str, float] = field(default_factory=dict)

    @property
    def partitions(self) -> frozenset[str]:
        """The partitions that it belongs to: the resources of which it has a slot."""
        return frozenset(name for name, slots in self.resources.items() if slots)

    def with_gpus(self, gpus: Iterable[str]) -> WorkerInfo:
        """Describe the same worker with these GPUs."""
        return replace(self, gpus=tuple(gpus))

    @classmethod
    def from_identity(
        cls, address: str, identity: Mapping[str, Any], gpus: tuple[str, ...] = ()
    ) -> WorkerInfo:
        """From what the scheduler says of a worker."""
        return cls(
            name=str(identity["name"]),
            address=address,
            host=identity["host"],
            nthreads=identity["nthreads"],
            memory=identity["memory_limit"] or 0,
            gpus=gpus,
            resources=dict(identity["resources"]),
        )

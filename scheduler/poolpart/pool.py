"""All workers of a cluster, and how they are divided into partitions."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from distributed import Client

from .errors import PoolError
from .partition import Partition
from .probe import declare_resource, probe_worker
from .restarts import KeepResources
from .worker_info import WorkerInfo

logger = logging.getLogger(__name__)


class Pool:
    """Some workers of a Dask cluster that can be divided into partitions.

    Start with all of them (`Pool.from_client`); `partition` takes some out under a name and
    returns the rest, which can be divided again. A cluster whose workers were started with
    ``--resources "GPU=1"`` and the like is divided already: see `partitions`.

    Examples
    --------
    >>> pool = Pool.from_client(client)                                # doctest: +SKIP
    >>> gpu, rest = pool.partition("GPU", max_workers_per_gpu=1)       # doctest: +SKIP
    >>> lidar, rest = rest.partition("LIDAR", n_workers=4)             # doctest: +SKIP
    >>> other, _ = rest.partition("OTHER", workers=rest.names)         # doctest: +SKIP
    >>> gpu.submit(pow, 2, 10).result()                                # doctest: +SKIP
    1024
    """

    def __init__(self, client: Client, workers: Sequence[WorkerInfo]) -> None:
        self.client = client
        self.workers = tuple(workers)

    @classmethod
    def from_client(cls, client: Client) -> Pool:
        """All workers that the client's cluster has now, with their GPUs.

        Raises
        ------
        PoolError
            If the cluster has no workers, or one cannot import this package.
        """
        identities = client.scheduler_info(n_workers=-1)["workers"]
        if not identities:
            raise PoolError(
                f"The cluster at {client.scheduler.address} has no workers: start some with "
                f'dask worker {client.scheduler.address} --resources "GPU=1"'
            )
        facts = client.run(probe_worker, workers=list(identities), on_error="return")
        for address, fact in facts.items():
            if isinstance(fact, BaseException):
                raise PoolError(
                    f"Worker {identities[address]['name']} at {address} cannot tell about its "
                    f"machine ({type(fact).__name__}: {fact}); is poolpart installed there?"
                )
        return cls(
            client,
            [
                WorkerInfo.from_identity(address, identity, facts[address]["gpus"])
                for address, identity in identities.items()
                if address in facts  # one may have gone since
            ],
        )

    # -- looking -----------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.workers)

    def __iter__(self) -> Iterator[WorkerInfo]:
        return iter(self.workers)

    def __repr__(self) -> str:
        hosts = {worker.host for worker in self.workers}
        gpus = {gpu for worker in self.workers for gpu in worker.gpus}
        declared = Counter(name for worker in self.workers for name in worker.resources)
        parts = "".join(f", {name} {count}" for name, count in sorted(declared.items()))
        return (
            f"<Pool of {len(self)} workers on {len(hosts)} hosts with {len(gpus)} GPUs{parts}>"
        )

    @property
    def names(self) -> list[str]:
        """Names of the workers."""
        return [worker.name for worker in self.workers]

    def partitions(self) -> dict[str, Partition]:
        """The partitions that the workers declare, by name."""
        names = sorted({name for worker in self.workers for name in worker.resources})
        return {name: Partition(name, self.client) for name in names}

    def require(self, slots: Mapping[str, int], purpose: Mapping[str, str]) -> None:
        """Check that partitions have enough slots before anything is submitted.

        Dask itself would wait, silently and for ever, for a resource that nobody declares.

        Parameters
        ----------
        slots
            Slots needed, by partition.
        purpose
            What they are needed for, by partition; shown in the error.

        Raises
        ------
        PoolError
            If a partition has fewer, or a worker declares two of the partitions.
        """
        for worker in self.workers:
            if len(several := [name for name in slots if worker.resources.get(name)]) > 1:
                raise PoolError(
                    f"Worker {worker.name} declares {' and '.join(several)}: give each worker "
                    "one of them, since a task of one holds up those of the other."
                )
        for name, needed in slots.items():
            there = int(sum(worker.resources.get(name, 0) for worker in self.workers))
            if there < needed:
                raise PoolError(
                    f"Partition {name!r} has {there} of the {needed} slots needed "
                    f"({purpose[name]}): start workers with --resources \"{name}=1\" "
                    f'or one with --nthreads {needed} --resources "{name}={needed}".'
                )

    # -- dividing ----------------------------------------------------------------------

    def partition(
        self,
        name: str,
        *,
        max_workers_per_gpu: int | None = None,
        max_workers_per_host: int | None = None,
        n_workers: int | None = None,
        workers: Sequence[str] | None = None,
        slots: int | None = None,
    ) -> tuple[Partition, Pool]:
        """Take workers out of this pool under a name.

        Give exactly one selector. The chosen workers declare the Dask resource `name`, and
        declare it again when their nanny restarts them.

        Parameters
        ----------
        name
            Name of the partition and of the resource.
        max_workers_per_gpu
            On each host, so many workers for each GPU. Where the pool has no GPU at all, the
            partition falls back to so many CPU workers a host; its `note` says so.
        max_workers_per_host
            So many workers of each host.
        n_workers
            So many workers, wherever they are.
        workers
            These workers, by name or address.
        slots
            Tasks that each worker takes at a time; its number of threads by default.

        Returns
        -------
        partition, remainder
            The partition, and a pool of the workers that are left.

        Raises
        ------
        PoolError
            If the selectors are not exactly one, a worker is not in this pool or belongs to
            another partition, or there are too few.
        """
        given = {
            "max_workers_per_gpu": max_workers_per_gpu,
            "max_workers_per_host": max_workers_per_host,
            "n_workers": n_workers,
            "workers": workers,
        }
        chosen_by = [key for key, value in given.items() if value is not None]
        if len(chosen_by) != 1:
            raise PoolError(
                f"Give exactly one of {', '.join(given)} to partition {name!r}, "
                f"not {' and '.join(chosen_by) or 'none'}."
            )
        for key in chosen_by[:1]:
            value = given[key]
            if isinstance(value, int) and value < 1:
                raise PoolError(f"{key} is {value}; a partition needs at least 1 worker.")

        # A worker that declares something else is another partition's.
        free = [w for w in self.workers if not set(w.resources) - {name}]
        note = ""
        if workers is not None:
            chosen = self._named(name, workers, free)
        elif n_workers is not None:
            chosen = free[:n_workers]
            if len(chosen) < n_workers:
                raise PoolError(
                    f"Partition {name!r} asks for {n_workers} workers; the pool has "
                    f"{len(free)} that belong to no partition."
                )
        elif max_workers_per_host is not None:
            chosen = _per_host(free, dict.fromkeys(_hosts(free), max_workers_per_host))
        else:
            assert max_workers_per_gpu is not None
            gpus = {h: len({g for w in free if w.host == h for g in w.gpus}) for h in _hosts(free)}
            if any(gpus.values()):
                free = [w for w in free if w.gpus]
                chosen = _per_host(free, {h: n * max_workers_per_gpu for h, n in gpus.items()})
            else:
                note = "no GPU in the pool: CPU workers instead"
                logger.warning("Partition %r: %s", name, note)
                chosen = _per_host(free, dict.fromkeys(_hosts(free), max_workers_per_gpu))
        if not chosen:
            raise PoolError(
                f"No worker is left for partition {name!r}: all {len(self)} of this pool "
                "belong to others. Start more workers."
            )
        self._declare(name, chosen, slots)
        rest = Pool(self.client, [w for w in self.workers if w not in chosen])
        return Partition(name, self.client, note), rest

    def _named(
        self, name: str, workers: Sequence[str], free: Sequence[WorkerInfo]
    ) -> list[WorkerInfo]:
        by_name = {key: w for w in self.workers for key in (w.name, w.address)}
        if unknown := [str(w) for w in workers if str(w) not in by_name]:
            raise PoolError(
                f"Partition {name!r}: {', '.join(unknown)} not in this pool, which has "
                f"{', '.join(self.names) or 'no workers'}."
            )
        chosen = list(dict.fromkeys(by_name[str(w)].name for w in workers))
        for worker in self.workers:
            if worker.name in chosen and worker not in free:
                raise PoolError(
                    f"Worker {worker.name} already declares {', '.join(worker.resources)}; a "
                    "worker belongs to one partition."
                )
        return [w for w in self.workers if w.name in chosen]

    def _declare(self, name: str, chosen: Sequence[WorkerInfo], slots: int | None) -> None:
        wanted = {worker.name: slots or worker.nthreads for worker in chosen}
        # First the nannies: a worker that dies right after would come back without.
        self.client.register_plugin(KeepResources(name, wanted))
        self.client.run(
            declare_resource, wanted, name, workers=[worker.address for worker in chosen]
        )


def _hosts(workers: Sequence[WorkerInfo]) -> list[str]:
    return list(dict.fromkeys(worker.host for worker in workers))


def _per_host(workers: Sequence[WorkerInfo], limit: Mapping[str, int]) -> list[WorkerInfo]:
    return [
        worker
        for host in _hosts(workers)
        for worker in [w for w in workers if w.host == host][: limit[host]]
    ]

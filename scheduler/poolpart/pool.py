"""All workers of a cluster, and their division into partitions."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from distributed import Client

from .adapting import adaptive_names
from .division import ask, ask_to_dissolve, declare
from .errors import PoolError
from .extras.dashboard_page import leave_page, partitions_page
from .extras.notebook import table_of_partitions
from .partition import Partition
from .pipe_states import names_of_pipes
from .probe import worker_gpus
from .rules import Rule, check_name, named, per_gpu, per_host
from .rules import n_workers as count
from .steward import names_with_rule
from .workers import WorkerInfo, all_workers, ask_workers, note_on_slots, on_scheduler

if TYPE_CHECKING:
    from .deploy.local_pool import LocalPool

logger = logging.getLogger(__name__)


class Pool:
    """Workers of a Dask cluster that can be divided into partitions.

    `Pool.from_client` returns all workers of a cluster. `partition` takes some of them under a name
    and returns the partition and a pool of the remaining workers; `divide` makes several partitions
    by rules. A pool is a view of the running cluster: workers that join later belong to it, and
    each use asks the scheduler.

    If workers were started with ``--resources "GPU=1"`` and the like, the cluster is divided
    already: ``pool["GPU"]`` returns a partition. At the end of a ``with pool:`` block, the
    partitions that the pool has made are dissolved. `Pool.local` starts a separate cluster, which
    ends with its block.

    Examples
    --------
    >>> pool = Pool.from_client(client)                                # doctest: +SKIP
    >>> gpu, rest = pool.partition("GPU", max_workers_per_gpu=1)       # doctest: +SKIP
    >>> io, rest = rest.partition("IO", n_workers=4)                   # doctest: +SKIP
    >>> other, _ = rest.partition("OTHER", workers=rest.names)         # doctest: +SKIP
    >>> gpu.submit(pow, 2, 10).result()                                # doctest: +SKIP
    1024
    """

    def __init__(self, client: Client, workers: Sequence[WorkerInfo]) -> None:
        self.client = client
        self._workers = tuple(workers)  # at the last look
        # Workers as this pool saw them first: {name: description}
        self._first_seen = {worker.name: worker for worker in self._workers}
        # Whether a worker of the cluster belongs to this pool; None if the workers are fixed.
        self._belongs: Callable[[WorkerInfo], bool] | None = None
        self._noted: set[str] = set()  # partitions whose note was logged
        self._partition_names: list[str] = []  # made by this pool or its remainders
        self._local: LocalPool | None = None  # the cluster that `local` has started

    @classmethod
    def from_client(cls, client: Client, declaring: Set[str] | None = None) -> Pool:
        """Return a pool of all workers of the client's cluster.

        Workers that join later belong to the pool as well.

        Parameters
        ----------
        client
            Client of the cluster.
        declaring
            Only workers that declare one of these resources; others are not contacted, and need
            not have this package.

        Raises
        ------
        PoolError
            If the cluster has no workers and no adaptive partitions, a worker cannot import this
            package, or the client is closed or asynchronous.
        """
        if not all_workers(client) and not on_scheduler(client, adaptive_names):
            raise PoolError(
                f"The cluster at {client.scheduler.address} has no workers: start some with "
                f'dask worker {client.scheduler.address} --resources "GPU=1"'
            )
        pool = cls(client, ())
        pool._belongs = partial(_declares_one_of, names=declaring)
        pool._first_seen = {worker.name: worker for worker in pool.workers}
        return pool

    @classmethod
    def local(
        cls,
        partitions: Mapping[str, tuple[int, int]],
        *,
        idle_s: float = math.inf,
        **options: Any,
    ) -> Pool:
        """Start a cluster on this machine, divided into partitions, and a client of it.

        At the end of a ``with`` block, they end, whatever runs. The workers are processes; a script
        needs no main guard.

        Parameters
        ----------
        partitions
            {name: (workers, slots of each worker)}. A worker has as many threads as slots.
        idle_s
            Everything also ends after so many seconds without a task, a result that somebody keeps,
            or a pipe. The log says so; the pool can then no longer be used.
        options
            Others of `poolpart.deploy.local_cluster`.

        Raises
        ------
        PoolError
            If there would be no worker, a number is not possible, or the workers do not start.

        Examples
        --------
        >>> with Pool.local({"GPU": (1, 1), "IO": (1, 8)}) as pool:      # doctest: +SKIP
        ...     pool["GPU"].submit(pow, 2, 10).result()
        1024
        """
        from .deploy.local_pool import LocalPool  # dividing a cluster needs nothing that starts one

        started = LocalPool(partitions, idle_s, options)
        try:
            pool = cls.from_client(started.client)
        except BaseException:
            started.close()
            raise
        pool._local = started
        return pool

    # -- looking -----------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.workers)

    def __iter__(self) -> Iterator[WorkerInfo]:
        return iter(self.workers)

    def __repr__(self) -> str:
        try:
            workers = self.workers
            declared = Counter(name for w in all_workers(self.client) for name in w.partitions)
        except (PoolError, OSError):  # its client was closed
            workers = self._workers
            declared = Counter()
        hosts = {worker.host for worker in workers}
        gpus = {gpu for worker in workers for gpu in worker.gpus}
        parts = ", ".join(f"{name} {count}" for name, count in sorted(declared.items()))
        parts = f"; partitions: {parts}" if parts else ""
        return f"<Pool: workers {len(workers)}, hosts {len(hosts)}, GPUs {len(gpus)}{parts}>"

    def _repr_html_(self) -> str:
        """Return the table of all partitions of the cluster that notebooks show."""
        return table_of_partitions(self.client, repr(self))

    def __getitem__(self, name: str) -> Partition:
        if (part := (parts := self.partitions()).get(name)) is None:
            names = ", ".join(parts) or "none yet: divide makes some"
            raise PoolError(f"There is no partition {name!r}; there are {names}.")
        if part.note and name not in self._noted:
            self._noted.add(name)
            logger.warning("Partition %r: %s", name, part.note)
        return part

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The workers that belong to the pool now, with their GPUs.

        A remainder has the workers that are in no partition. Only workers that have joined since
        the last look are asked for their GPUs.
        """
        if self._belongs is not None:
            present = [worker for worker in all_workers(self.client) if self._belongs(worker)]
            gpus = {worker.address: worker.gpus for worker in self._workers}
            gpus |= _ask_for_gpus(self.client, [w for w in present if w.address not in gpus])
            # Workers that have not answered have left, or are silent.
            self._workers = tuple(
                w.with_gpus(gpus[w.address]) for w in present if w.address in gpus
            )
        return self._workers

    @property
    def names(self) -> list[str]:
        """Names of the workers."""
        return [worker.name for worker in self.workers]

    def partitions(self) -> dict[str, Partition]:
        """Return the partitions that workers declare now, and adaptive partitions, by name.

        A partition that its workers were started with has a `note` if their slots and threads
        differ.
        """
        workers = all_workers(self.client)
        names = {name for worker in workers for name in worker.partitions}
        adaptive, with_rule = on_scheduler(self.client, _adaptive_and_divided)
        return {
            name: Partition(
                name, self.client, "" if name in with_rule else note_on_slots(name, workers)
            )
            for name in sorted(names | adaptive)
        }

    def require(self, slots: Mapping[str, int], purpose: Mapping[str, str] | None = None) -> None:
        """Check that partitions have enough slots before tasks are submitted.

        Dask itself would wait silently for ever for a resource that no worker declares.

        Parameters
        ----------
        slots
            Slots needed, by partition.
        purpose
            What they are needed for, by partition; shown in the error.

        Raises
        ------
        PoolError
            If a partition has fewer, or a worker declares two of the partitions or a number of
            slots that is not whole.
        """
        workers = self.workers
        for worker in workers:
            for name in slots.keys() & worker.resources.keys():
                if (has := worker.resources[name]) % 1 or not 0 <= has < 2**31:
                    raise PoolError(
                        f"Worker {worker.name} declares {name}={has:g}: give it a whole number of "
                        f'slots, such as --resources "{name}=1".'
                    )
            if len(several := [name for name in slots if name in worker.partitions]) > 1:
                raise PoolError(
                    f"Worker {worker.name} declares {' and '.join(several)}: give each worker "
                    "one of them, because tasks of one would delay those of the other."
                )
        for name, minimum in slots.items():
            total = int(sum(worker.resources.get(name, 0) for worker in workers))
            if total < minimum:
                reason = f" ({purpose[name]})" if purpose and name in purpose else ""
                raise PoolError(
                    f"Partition {name!r} has {total} of the "
                    f"{minimum} {'slot' if minimum == 1 else 'slots'} needed{reason}: "
                    f'start workers with --resources "{name}=1" or one with --nthreads {minimum} '
                    f'--resources "{name}={minimum}".'
                )

    # -- dividing ----------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if self._local is not None:
            self._local.close()
            return
        try:
            if self._partition_names:  # `dissolve` may have undone them by now
                ask_to_dissolve(self.client, self._partition_names, timeout_s=30.0)
                self._partition_names.clear()
        except (PoolError, OSError) as failure:
            if error is None:
                raise
            error.add_note(f"poolpart: the partitions stay: {failure}")  # what came first counts

    def divide(self, rules: Mapping[str, Rule]) -> dict[str, Partition]:
        """Divide this pool by rules, which stay in force, also when this client has gone.

        Each rule takes from the workers that the rules before it have left. The scheduler keeps
        the rules: a worker that joins later gets its partition by them, first where workers are
        missing, and waiting tasks run. A restarted worker returns to its partition; its place is
        kept for half a minute. An adaptive cluster keeps the workers that a partition needs for
        its minimum.

        Parameters
        ----------
        rules
            Rule of each partition, by name: `per_gpu`, `per_host`, `n_workers`,
            `named` or `rest`.

        Returns
        -------
        dict
            The partitions by name.

        Raises
        ------
        PoolError
            If a partition would have fewer workers than its minimum, or another client makes one
            of this name at the same moment.

        Examples
        --------
        >>> from poolpart import Pool, per_gpu, per_host, rest
        >>> parts = Pool.from_client(client).divide(                   # doctest: +SKIP
        ...     {"GPU": per_gpu(1), "IO": per_host(2), "OTHER": rest(exclusive=True)}
        ... )
        >>> parts["GPU"].submit(pow, 2, 10).result()                   # doctest: +SKIP
        1024
        """
        return self._divide(rules, rules)[0]

    def partition(
        self,
        name: str,
        *,
        max_workers_per_gpu: int | None = None,
        max_workers_per_host: int | None = None,
        n_workers: int | None = None,
        workers: Sequence[str] | None = None,
        slots: int | None = None,
        minimum: int = 1,
        exclusive: bool = False,
    ) -> tuple[Partition, Pool]:
        """Take workers out of this pool under a name.

        Give exactly one selector, which chooses from the workers that the pool has now. The chosen
        workers declare the Dask resource `name`, also after a restart by their nanny. Pending tasks
        for the resource are sent to them. Workers that belong to another partition are not chosen.
        Workers that join later are chosen by the same selector, as with `divide`.

        Parameters
        ----------
        name
            Name of the partition and of the resource.
        max_workers_per_gpu
            At most so many workers for each GPU. If the pool has no GPU at all, the partition
            takes so many CPU workers a host instead. A warning says so, which `note` keeps.
        max_workers_per_host
            At most so many workers of each host.
        n_workers
            So many workers, wherever they are.
        workers
            These workers, by name or address.
        slots, minimum, exclusive
            As of every `Rule`.

        Returns
        -------
        partition, remainder
            The partition, and a pool of the remaining workers.

        Raises
        ------
        PoolError
            If the selectors are not exactly one, a worker is not in this pool or belongs to
            another partition, there are too few, or other workers have this partition.
        """
        common: dict[str, Any] = {"slots": slots, "minimum": minimum, "exclusive": exclusive}
        numbers = (
            (max_workers_per_gpu, per_gpu),
            (max_workers_per_host, per_host),
            (n_workers, count),
        )
        selectors: list[Rule] = [rule(n, **common) for n, rule in numbers if n is not None]
        if workers is not None:
            if isinstance(workers, str) or not isinstance(workers, Iterable):
                raise PoolError(
                    f"The workers of partition {name!r} are {workers!r}: give a list of names or "
                    f"addresses, such as [{str(workers)!r}], or a number by n_workers."
                )
            workers = list(workers)
            selectors.append(named(*workers, **common))
        if len(selectors) != 1:
            raise PoolError(
                "Give exactly one of max_workers_per_gpu, max_workers_per_host, n_workers and "
                f"workers to partition {name!r}, not {len(selectors)}."
            )
        [rule] = selectors
        # All of the workers have to be present now; later there may be fewer.
        initial_minimum = n_workers or len(workers or ()) or max(1, minimum)
        parts, remainder = self._divide(
            {name: rule}, {name: replace(rule, minimum=initial_minimum)}
        )
        return parts[name], remainder

    def page(self) -> str:
        """Add a page to Dask's dashboard and return its URL.

        The page shows partitions, stages, workers and pipes.

        All users of the cluster can see it, and it is read-only. It needs no bokeh, and is as
        public as the dashboard: on a shared network, whoever reaches one can see the other. It
        stays until the last client that wanted it closes or leaves it (`leave_page`), or all
        partitions are dissolved.

        Raises
        ------
        PoolError
            If the scheduler lacks this package, or runs no HTTP server.
        """
        return partitions_page(self.client)

    def pipes(self) -> list[str]:
        """Return the names of all pipes of the cluster, created by any client.

        Dask's ``Queue(name)`` has the items of a pipe, and ``Variable(name)`` its state.
        """
        return sorted(on_scheduler(self.client, names_of_pipes))

    def leave_page(self) -> None:
        """Remove the page, unless further clients want the page."""
        on_scheduler(self.client, leave_page, owner=self.client.id)

    def dissolve(self, timeout_s: float = 30.0) -> list[str]:
        """Undo every partition that any client has made while this cluster ran.

        Workers declare their original resources again. Rules, fences, statistics and the page
        are removed. Results that are held stay; if one is lost, any worker recomputes it.
        Partitions that workers were started with stay.

        Parameters
        ----------
        timeout_s
            How long to wait for the partitions' tasks to end.

        Returns
        -------
        list of str
            Names of the partitions.

        Raises
        ------
        PoolError
            If their tasks have not ended; then everything stays.
        """
        names = ask_to_dissolve(self.client, None, timeout_s)
        self._partition_names.clear()
        return names

    def _divide(
        self, rules: Mapping[str, Rule], initial_rules: Mapping[str, Rule]
    ) -> tuple[dict[str, Partition], Pool]:
        """Make all partitions or none, and return them by name, with a pool of the remainder.

        Workers are chosen by `initial_rules` at first, and by `rules` when workers join later.
        """
        if not isinstance(rules, Mapping):
            raise PoolError(
                f"The rules are {rules!r}: give them by partition, such as "
                '{"IO": n_workers(2), "OTHER": rest()}.'
            )
        for name, rule in rules.items():
            check_name(name)
            if not isinstance(rule, Rule):
                raise PoolError(
                    f"The rule of partition {name!r} is {rule!r}: give one such as n_workers(2), "
                    "per_gpu(1) or rest()."
                )
        for worker in self.workers:  # workers that have joined since the pool was made
            first_seen = self._first_seen.get(worker.name, worker)
            self._first_seen[worker.name] = first_seen.with_gpus(worker.gpus)
        notes, remaining_workers = ask(
            self.client,
            declare,
            rules=dict(rules),
            initial_rules=dict(initial_rules),
            pool=self._first_seen,
            known_partitions=set(self.partitions()),
            own_partitions=set(self._partition_names),
        )
        parts = {name: Partition(name, self.client, note, True) for name, note in notes.items()}
        for part in parts.values():
            if part.note:
                logger.warning("Partition %r: %s", part.name, part.note)
        self._partition_names += parts
        remainder = Pool(self.client, remaining_workers)
        if self._belongs is not None:
            remainder._belongs = partial(_is_free, of=self._belongs)
        remainder._partition_names = self._partition_names
        return parts, remainder


def _adaptive_and_divided(dask_scheduler: Any = None) -> tuple[Set[str], Set[str]]:
    """Return the names of adaptive partitions, and of partitions with a rule.

    Runs on the scheduler.
    """
    return adaptive_names(dask_scheduler), names_with_rule(dask_scheduler)


def _declares_one_of(worker: WorkerInfo, names: Set[str] | None) -> bool:
    """Return whether a worker declares one of these resources, or True if `names` is None."""
    return names is None or not names.isdisjoint(worker.resources)


def _is_free(worker: WorkerInfo, of: Callable[[WorkerInfo], bool]) -> bool:
    """Return whether a worker is in no partition, and belongs to a pool."""
    return not worker.partitions and of(worker)


def _ask_for_gpus(client: Client, workers: Sequence[WorkerInfo]) -> dict[str, tuple[str, ...]]:
    """Return the GPUs of workers by address, without workers that do not answer.

    Raises PoolError if a worker cannot describe its machine.
    """
    answers = ask_workers(client, worker_gpus, [worker.address for worker in workers])
    for worker in workers:
        if isinstance(error := answers.get(worker.address), BaseException):
            raise PoolError(
                f"Worker {worker.name} at {worker.address} cannot describe its machine "
                f"({type(error).__name__}: {error}). Is poolpart installed there?"
            )
    return answers

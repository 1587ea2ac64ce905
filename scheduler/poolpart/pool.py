"""The pool of all workers in a cluster, which can be divided into partitions."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from distributed import Client

from .adapting import adaptive_names
from .balancing import BalancedGroup, balance_partitions, names_of_groups
from .division import call_steward, create_partitions, request_dissolution
from .errors import PoolError
from .extras.dashboard_page import leave_page, open_page
from .extras.notebook import table_of_partitions
from .internals.partition_client import whole_client
from .membership import partition_names
from .partition import Partition
from .pipe_states import names_of_pipes
from .probe import worker_gpus
from .rules import Rule, check_name, named, per_gpu, per_host
from .rules import n_workers as count
from .shares import check_weight, client_name, set_weight
from .steward import names_with_rule
from .workers import WorkerInfo, all_workers, run_on_scheduler, run_on_workers, slots_note

if TYPE_CHECKING:
    from .deploy.local_pool import LocalPool

logger = logging.getLogger(__name__)


class Pool:
    """Pool of Dask workers, which can be divided into partitions.

    `Pool.from_client` returns all workers of a cluster. `partition` creates a partition, and
    returns it together with a pool of the remaining workers. `divide` creates several partitions
    according to rules. A pool is a view of the running cluster: it includes workers that join
    later, and each access requests the current state from the scheduler.

    If workers were started with ``--resources "GPU=1"``, the cluster is already divided, and
    ``pool["GPU"]`` returns the partition. At the end of a ``with pool:`` block, the partitions that
    the pool has created are dissolved. `Pool.local` starts a separate cluster, which is closed at
    the end of its block.

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
        self.client = whole_client(client)
        self._workers = tuple(workers)  # workers at the last access
        # {name: description at the first access}
        self._first_seen = {worker.name: worker for worker in self._workers}
        # Predicate for the workers that belong to this pool. None if the workers are fixed.
        self._belongs: Callable[[WorkerInfo], bool] | None = None
        self._noted: set[str] = set()  # partitions whose note was logged
        self._partition_names: list[str] = []  # partitions created by this pool or its remainders
        self._local: LocalPool | None = None  # cluster started by `local`

    @classmethod
    def from_client(cls, client: Client, declaring: Set[str] | None = None) -> Pool:
        """Create a pool of all workers in the client's cluster.

        The pool also includes workers that join later.

        Parameters
        ----------
        client
            Client of the cluster.
        declaring
            Names of resources. If given, the pool contains only workers that declare one of them.
            Other workers are not contacted and do not need this package.

        Raises
        ------
        PoolError
            If the cluster has neither workers nor adaptive partitions, if a worker cannot import
            this package, or if the client is closed or asynchronous.

        Examples
        --------
        >>> Pool.from_client(client)                                       # doctest: +SKIP
        <Pool: workers 3, hosts 1, GPUs 0; partitions: IO 1, OTHER 2>
        """
        if not all_workers(client) and not run_on_scheduler(client, adaptive_names):
            raise PoolError(
                f"The cluster at {client.scheduler.address} has no workers. Start workers, for "
                f'example with `dask worker {client.scheduler.address} --resources "GPU=1"`.'
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
        """Start a cluster with partitions on this machine, and return its pool.

        At the end of a ``with`` block, the cluster is closed, even if tasks are running. Each
        worker is a separate process. Scripts do not need an ``if __name__ == "__main__":`` guard.

        Parameters
        ----------
        partitions
            Mapping of each partition name to (number of workers, slots per worker). A worker has as
            many threads as slots.
        idle_s
            Time in seconds after which an idle cluster is closed. The cluster is idle if it has no
            tasks, no results that a client holds, and no pipes. When it is closed, a warning is
            logged, and the pool can no longer be used.
        options
            Further options for `poolpart.deploy.local_cluster`.

        Raises
        ------
        PoolError
            If `partitions` requests no workers, if a number is invalid, or if the workers do not
            start.

        Examples
        --------
        >>> with Pool.local({"GPU": (1, 1), "IO": (1, 8)}) as pool:      # doctest: +SKIP
        ...     pool["GPU"].submit(pow, 2, 10).result()
        1024
        """
        from .deploy.local_pool import LocalPool  # not needed to divide a running cluster

        started = LocalPool(partitions, idle_s, options)
        try:
            pool = cls.from_client(started.client)
        except BaseException:
            started.close()
            raise
        pool._local = started
        return pool

    # -- workers and partitions --------------------------------------------------------

    def __len__(self) -> int:
        return len(self.workers)

    def __iter__(self) -> Iterator[WorkerInfo]:
        return iter(self.workers)

    def __repr__(self) -> str:
        try:
            workers = self.workers
            declared = Counter(dict.fromkeys(run_on_scheduler(self.client, partition_names), 0))
            declared.update(name for w in all_workers(self.client) for name in w.partitions)
        except (PoolError, OSError):  # the client was closed
            workers = self._workers
            declared = Counter()
        hosts = {worker.host for worker in workers}
        gpus = {gpu for worker in workers for gpu in worker.gpus}
        parts = ", ".join(f"{name} {count}" for name, count in sorted(declared.items()))
        parts = f"; partitions: {parts}" if parts else ""
        return f"<Pool: workers {len(workers)}, hosts {len(hosts)}, GPUs {len(gpus)}{parts}>"

    def _repr_html_(self) -> str:
        """Return an HTML table of all partitions for notebooks."""
        return table_of_partitions(self.client, repr(self))

    def __getitem__(self, name: str) -> Partition:
        if (part := (parts := self.partitions()).get(name)) is None:
            if not parts:
                raise PoolError(
                    f"There is no partition {name!r}, because the pool has not been divided. Use "
                    "`Pool.divide` to create partitions."
                )
            names = ", ".join(map(repr, parts))
            raise PoolError(
                f"There is no partition {name!r}. Existing partitions: {names}. Create it with "
                f'`Pool.divide`, or start workers with `--resources "{name}=1"`.'
            )
        if part.note and name not in self._noted:
            self._noted.add(name)
            logger.warning("Partition %r: %s", name, part.note)
        return part

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """Workers that currently belong to the pool, with their GPUs.

        If the pool is the remainder of a division, these are the workers without a partition. Only
        workers that have joined since the last access are queried for their GPUs.
        """
        if self._belongs is not None:
            present = [worker for worker in all_workers(self.client) if self._belongs(worker)]
            gpus = {worker.address: worker.gpus for worker in self._workers}
            gpus |= _ask_for_gpus(self.client, [w for w in present if w.address not in gpus])
            # Workers that did not respond have left or are silent, and are omitted.
            self._workers = tuple(
                w.with_gpus(gpus[w.address]) for w in present if w.address in gpus
            )
        return self._workers

    @property
    def names(self) -> list[str]:
        """Names of the workers in the pool."""
        return [worker.name for worker in self.workers]

    def partitions(self) -> dict[str, Partition]:
        """Return all partitions in the cluster by name, including those without workers.

        These are the partitions that a division has created, adaptive partitions, and the
        partitions in which workers were started. A partition of the last kind is not listed while
        none of its workers is running, unless workers were moved into or out of it. It has a `note`
        if a worker's number of slots differs from its number of threads.

        Examples
        --------
        >>> list(pool.partitions())                                        # doctest: +SKIP
        ['GPU', 'IO']
        """
        workers = all_workers(self.client)
        names, with_rule, scheduler_id = run_on_scheduler(self.client, _all_and_divided)
        return {
            name: Partition(
                name,
                self.client,
                "" if name in with_rule else slots_note(name, workers),
                by_rule=scheduler_id if name in with_rule else "",
            )
            for name in names
        }

    def require(self, slots: Mapping[str, int], purpose: Mapping[str, str] | None = None) -> None:
        """Check that partitions have enough slots, before any tasks are submitted.

        In plain Dask, if no worker declares the resource of a task, the task waits forever without
        a message.

        Parameters
        ----------
        slots
            Required number of slots of each partition, by name.
        purpose
            Purpose of the slots of each partition, by name. It is included in the error message.

        Raises
        ------
        PoolError
            If a partition has too few slots, if a worker declares two of the partitions, or if a
            number of slots is not an integer.

        Examples
        --------
        >>> pool.require({"GPU": 1, "IO": 4})                              # doctest: +SKIP
        """
        workers = self.workers
        for worker in workers:
            for name in slots.keys() & worker.resources.keys():
                if (has := worker.resources[name]) % 1 or not 0 <= has < 2**31:
                    raise PoolError(
                        f"Worker {worker.name} declares {name}={has:g}, which is not a valid "
                        "number of slots. Start it with an integer, for example "
                        f'`--resources "{name}=1"`.'
                    )
            if len(several := [name for name in slots if name in worker.partitions]) > 1:
                raise PoolError(
                    f"Worker {worker.name} declares the resources {' and '.join(several)}. Start "
                    "each worker with only one of them, because tasks of one partition would delay "
                    "tasks of the other."
                )
        for name, minimum in slots.items():
            total = int(sum(worker.resources.get(name, 0) for worker in workers))
            if total < minimum:
                reason = f" ({purpose[name]})" if purpose and name in purpose else ""
                raise PoolError(
                    f"Partition {name!r} has {total} of the {minimum} required "
                    f"{'slot' if minimum == 1 else 'slots'}{reason}. Start workers with "
                    f'`--resources "{name}=1"`, or one worker with `--nthreads {minimum} '
                    f'--resources "{name}={minimum}"`.'
                )

    # -- division ----------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if self._local is not None:
            self._local.close()
            return
        try:
            if self._partition_names:  # empty if `dissolve` was called in the block
                request_dissolution(self.client, self._partition_names, timeout_s=30.0)
                self._partition_names.clear()
        except (PoolError, OSError) as failure:
            if error is None:
                raise
            # The first error is more important than the failure that follows it.
            error.add_note(f"poolpart: The partitions were not dissolved. {failure}")

    def divide(self, rules: Mapping[str, Rule]) -> dict[str, Partition]:
        """Divide this pool into partitions according to rules.

        Each rule selects from the workers that the previous rules have not selected. The rules
        remain in force after this client has closed: the scheduler assigns workers that join later,
        first to partitions with missing workers, and sends waiting tasks to them. A restarted
        worker returns to its partition, where its place is reserved for half a minute. An adaptive
        cluster keeps the workers that a partition needs for its minimum.

        Parameters
        ----------
        rules
            Mapping of partition names to rules (`per_gpu`, `per_host`, `n_workers`, `named` or
            `rest`).

        Returns
        -------
        dict
            Partitions by name. If a partition has fewer workers than its rule requests, its `note`
            contains the reason, which is logged as a warning.

        Raises
        ------
        PoolError
            If a partition would have fewer workers than its minimum, or if another client creates a
            partition of this name at the same time.

        Examples
        --------
        >>> from poolpart import Pool, per_gpu, per_host, rest
        >>> parts = Pool.from_client(client).divide(                   # doctest: +SKIP
        ...     {"GPU": per_gpu(1), "IO": per_host(2), "OTHER": rest(exclusive=True)}
        ... )
        >>> parts["GPU"].submit(pow, 2, 10).result()                   # doctest: +SKIP
        1024
        """
        return self._divide(rules)[0]

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
        """Create a partition from workers in this pool.

        Pass exactly one of the selectors `max_workers_per_gpu`, `max_workers_per_host`, `n_workers`
        and `workers`. It selects from the current workers of the pool that do not belong to another
        partition. The selected workers declare the Dask resource `name`, even after their nanny has
        restarted them. Pending tasks that request the resource are sent to them. Workers that join
        later are selected by the same rule, as with `divide`.

        Parameters
        ----------
        name
            Name of the partition and of the resource.
        max_workers_per_gpu
            Maximum number of workers for each GPU. If the pool has no GPU, the partition takes up
            to this number of CPU workers on each host instead. A warning is logged and stored in
            `note`.
        max_workers_per_host
            Maximum number of workers on each host.
        n_workers
            Number of workers on any host.
        workers
            Names or addresses of workers.
        slots, minimum, exclusive
            Options of the rule. See `Rule`. If the rule selects fewer workers than it requests, but
            at least `minimum`, the partition has a `note`, which is logged as a warning.

        Returns
        -------
        partition, remainder
            The partition, and a pool of the remaining workers.

        Raises
        ------
        PoolError
            If no selector or several selectors are passed, if the rule selects fewer workers than
            `minimum`, or if other workers already have this partition.

        Examples
        --------
        >>> gpu, remainder = pool.partition("GPU", max_workers_per_gpu=1)  # doctest: +SKIP
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
                    f"Invalid value {workers!r} for `workers` of partition {name!r}. Expected a "
                    f"list of names or addresses, for example [{str(workers)!r}]. To select a "
                    "number of workers, use `n_workers`."
                )
            workers = list(workers)
            selectors.append(named(*workers, **common))
        if len(selectors) != 1:
            raise PoolError(
                f"Partition {name!r} requires exactly one of `max_workers_per_gpu`, "
                "`max_workers_per_host`, `n_workers` and `workers`, but "
                f"{len(selectors) or 'none'} were given."
            )
        [rule] = selectors
        parts, remainder = self._divide({name: rule})
        return parts[name], remainder

    def balance(
        self,
        partitions: Iterable[Partition | str],
        *,
        min: int | Mapping[str, int] = 1,  # noqa: A002 - reads as a bound
        max: int | Mapping[str, int] | None = None,  # noqa: A002
        workers: Iterable[str | int] | None = None,
    ) -> BalancedGroup:
        """Move workers between partitions according to their work, until the group is stopped.

        Twice a second, the scheduler estimates how many workers each partition needs: the rate at
        which tasks arrive or finish, times their mean running time, plus up to a quarter if tasks
        or items of pipes wait. If a partition has too few workers and others can spare some, up to
        an eighth of the workers are moved at a time. Each of them first finishes its running tasks.
        If there is a group of the same partitions, it is replaced, and both objects
        refer to the new group.

        Parameters
        ----------
        partitions
            Partitions or their names. Other partitions, for example with GPUs, neither give nor
            receive workers.
        min, max
            Minimum and maximum number of workers of each partition, as a number for all partitions
            or by name. A partition also keeps the minimum of its rule.
        workers
            Names of the workers that may be moved. By default, all of them may be moved, and it is
            an error if only some of them have GPUs.

        Returns
        -------
        BalancedGroup
            Object with the methods `stats`, which reports all moves and their reasons, and `stop`.

        Raises
        ------
        PoolError
            If a partition does not exist, is adaptive, or belongs to another group, if a bound is
            invalid or does not fit the number of workers or the minimum of a rule, if `workers`
            names a worker that is in none of the partitions, or if only some of the workers have
            GPUs.

        Notes
        -----
        A worker whose tasks do not finish within a minute stays in its partition, and is not moved
        again for five minutes. A task that runs as long as the program therefore keeps its worker.

        Examples
        --------
        >>> group = pool.balance([decode, detect], min=1)                  # doctest: +SKIP
        >>> group.stats()                                                  # doctest: +SKIP
        <BalanceStats: 7 moves>
        partition  workers  demand  backlog  tasks/s  task seconds  wait seconds
        DECODE     56       58.2    180      331      0.17          0.37
        DETECT     70       72.1    232      331      0.21          0.49
        """
        if isinstance(partitions, str | Partition) or not isinstance(partitions, Iterable):
            raise PoolError(
                f"Invalid value {partitions!r} for `partitions`. Expected a list of partitions or "
                "of their names, for example `[decode, detect]`."
            )
        names = [part.name if isinstance(part, Partition) else part for part in partitions]
        return balance_partitions(self.client, names, min, max, workers)

    def balanced_groups(self) -> list[BalancedGroup]:
        """Return all balanced groups in the cluster, including those of other clients.

        A group that was created outside of a ``with`` block continues after its client has closed.
        Its method `stop` ends it.

        Examples
        --------
        >>> for group in pool.balanced_groups():                           # doctest: +SKIP
        ...     group.stop()
        """
        groups = run_on_scheduler(self.client, names_of_groups)
        return [BalancedGroup(self.client, names) for names in groups]

    def set_weight(self, client: Client | str, weight: float) -> None:
        """Give a client a larger or smaller share of the slots of all partitions.

        If tasks of several clients wait in a partition, each client gets slot time in proportion to
        its weight, which is 1 by default. The weight does not reserve slots: if a client has no
        tasks, the others use its share.

        Parameters
        ----------
        client
            Client, or the name of a client, as in ``Client(address, name="alice")``. Clients with
            the same name share one weight. The scheduler keeps the weight when the client
            disconnects. It can be set before a client with this name connects.
        weight
            Positive number. A client with a weight of 3 gets three times as much slot time as one
            with a weight of 1.

        Raises
        ------
        PoolError
            If the weight is not a positive number, if the name is empty, or if the installed
            version of Dask does not support shares.

        Examples
        --------
        >>> pool.set_weight("alice", 3)                                    # doctest: +SKIP
        """
        name = client_name(client.id) if isinstance(client, Client) else client
        if not isinstance(name, str) or not name:
            raise PoolError(
                f"Invalid client {client!r}. Expected a client or its name, for example "
                '`Client(address, name="alice")` or "alice".'
            )
        number = check_weight(weight)
        run_on_scheduler(self.client, set_weight, name=name, weight=number)

    def page(self) -> str:
        """Add a page to Dask's dashboard, and return its URL.

        The page shows partitions, stages, workers and pipes. It is read-only, does not require
        bokeh, and is visible to all users of the cluster. It is as public as the dashboard: on a
        shared network, everyone who can reach the dashboard can see it. The page is removed when
        the last client that has opened it closes or calls `leave_page`, or when all partitions are
        dissolved.

        Raises
        ------
        PoolError
            If poolpart is not installed in the scheduler's environment, or if the scheduler has no
            HTTP server.

        Examples
        --------
        >>> pool.page()                                                    # doctest: +SKIP
        'http://127.0.0.1:8787/partitions'
        """
        return open_page(self.client)

    def pipes(self) -> list[str]:
        """Return the names of all pipes in the cluster, including those of other clients.

        Dask's ``Queue(name)`` contains the items of a pipe, and ``Variable(name)`` its state.
        """
        return sorted(run_on_scheduler(self.client, names_of_pipes))

    def leave_page(self) -> None:
        """Remove the page, unless another client has also opened it."""
        run_on_scheduler(self.client, leave_page, owner=self.client.id)

    def dissolve(self, timeout_s: float = 30.0) -> list[str]:
        """Dissolve all partitions in this cluster, including those of other clients.

        Workers declare their original resources again. Rules, statistics and the page are removed,
        and exclusive workers accept other tasks again. Results that a client holds are kept. If
        such a result is lost, any worker may recompute it. Partitions in which workers were started
        remain.

        Parameters
        ----------
        timeout_s
            Maximum time in seconds to wait for the tasks of the partitions to finish.

        Returns
        -------
        list of str
            Names of the dissolved partitions.

        Raises
        ------
        PoolError
            If tasks have not finished in time. In this case, nothing changes.
        """
        names = request_dissolution(self.client, None, timeout_s)
        self._partition_names.clear()
        return names

    def _divide(self, rules: Mapping[str, Rule]) -> tuple[dict[str, Partition], Pool]:
        """Create either all partitions or none, and return them and the remaining pool."""
        if not isinstance(rules, Mapping):
            raise PoolError(
                f"Invalid rules {rules!r}. Expected a mapping of partition names to rules, for "
                'example `{"IO": n_workers(2), "OTHER": rest()}`.'
            )
        for name, rule in rules.items():
            check_name(name)
            if not isinstance(rule, Rule):
                raise PoolError(
                    f"Invalid rule {rule!r} for partition {name!r}. Expected a rule such as "
                    "`n_workers(2)`, `per_gpu(1)` or `rest()`."
                )
        for worker in self.workers:  # adds workers that have joined since the last access
            first_seen = self._first_seen.get(worker.name, worker)
            self._first_seen[worker.name] = first_seen.with_gpus(worker.gpus)
        notes, remaining_workers, scheduler_id = call_steward(
            self.client,
            create_partitions,
            rules=dict(rules),
            pool=self._first_seen,
            known_partitions=set(self.partitions()),
            own_partitions=set(self._partition_names),
        )
        parts = {
            name: Partition(name, self.client, note, scheduler_id) for name, note in notes.items()
        }
        for part in parts.values():
            if part.note:
                logger.warning("Partition %r: %s", part.name, part.note)
        self._partition_names += parts
        remainder = Pool(self.client, remaining_workers)
        if self._belongs is not None:
            remainder._belongs = partial(_is_free, of=self._belongs)
        remainder._partition_names = self._partition_names
        return parts, remainder


def _all_and_divided(dask_scheduler: Any = None) -> tuple[list[str], Set[str], str]:
    """Return the names of all partitions, of those with a rule, and the ID of the scheduler.

    Runs on the scheduler.
    """
    names = partition_names(dask_scheduler)
    return names, names_with_rule(dask_scheduler), str(dask_scheduler.id)


def _declares_one_of(worker: WorkerInfo, names: Set[str] | None) -> bool:
    """Return whether a worker declares any of the resources, or True if `names` is None."""
    return names is None or not names.isdisjoint(worker.resources)


def _is_free(worker: WorkerInfo, of: Callable[[WorkerInfo], bool]) -> bool:
    """Return whether a worker has no partition and satisfies a pool's predicate."""
    return not worker.partitions and of(worker)


def _ask_for_gpus(client: Client, workers: Sequence[WorkerInfo]) -> dict[str, tuple[str, ...]]:
    """Return the GPUs of each worker by address, omitting workers that do not respond.

    Raises
    ------
    PoolError
        If a worker cannot report its GPUs.
    """
    answers = run_on_workers(client, worker_gpus, [worker.address for worker in workers])
    for worker in workers:
        if isinstance(error := answers.get(worker.address), BaseException):
            raise PoolError(
                f"Worker {worker.name} at {worker.address} cannot report its GPUs "
                f"({type(error).__name__}: {error}). Check that poolpart is installed there."
            )
    return answers

"""Making partitions of workers that were chosen for them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress

from distributed import Client

from .declare import declare
from .dissolve import dissolve
from .errors import PoolError
from .fence import raise_fence
from .inherit import inherit
from .partition import Partition
from .rules import Rule
from .stats import watch
from .worker_info import WorkerInfo

logger = logging.getLogger(__name__)


def make_partitions(
    client: Client,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[WorkerInfo]],
    notes: Mapping[str, str],
    cluster: Iterable[WorkerInfo],
) -> dict[str, Partition]:
    """Make partitions, all of them or none.

    Parameters
    ----------
    client
        Client of the cluster.
    rules
        What each partition wants, by name.
    chosen
        Workers that it begins with.
    notes
        What a user should know of it, where there is anything.
    cluster
        All workers.

    Raises
    ------
    PoolError
        If another worker has such a partition already, or one leaves meanwhile.
    """
    for name in rules:
        names = {worker.name for worker in chosen[name]}
        _check_sole(name, [worker for worker in cluster if worker.name not in names])
        if note := notes.get(name):
            logger.warning("Partition %r: %s", name, note)
    declare(client, rules, chosen, list(cluster))
    try:
        watch(client)
        for name, rule in rules.items():
            inherit(client, name)
            if rule.exclusive:
                raise_fence(client, name)
    except PoolError:
        with suppress(PoolError):  # the first error is the one to tell of
            dissolve(client, list(rules), timeout_s=0)
        raise
    return {name: Partition(name, client, notes.get(name, "")) for name in rules}


def _check_sole(name: str, others: Iterable[WorkerInfo]) -> None:
    if members := [worker.name for worker in others if name in worker.partitions]:
        raise PoolError(
            f"There is a partition {name!r} already, with {', '.join(members)}, which this "
            f"call does not choose: give another name, or use Pool.partitions()[{name!r}]."
        )

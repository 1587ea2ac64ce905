"""Making partitions of workers that were chosen for them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from distributed import Client

from .declare import declare
from .partition import Partition
from .rules import Rule
from .worker_info import WorkerInfo

logger = logging.getLogger(__name__)


def make_partitions(
    client: Client,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[WorkerInfo]],
    notes: Mapping[str, str],
    cluster: Sequence[WorkerInfo],
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
        If another worker has such a partition already, one leaves meanwhile, or somebody else
        makes such a partition or takes one of the workers at the same moment.
    """
    for name, note in notes.items():
        if note:
            logger.warning("Partition %r: %s", name, note)
    declare(client, rules, chosen, cluster)
    return {name: Partition(name, client, notes.get(name, "")) for name in rules}

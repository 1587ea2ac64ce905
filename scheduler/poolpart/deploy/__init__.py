"""Clusters whose workers form partitions from the start: on this machine, in queues, over SSH.

Partitions and pipes need none of it: they divide any running cluster.
"""

from .clusters import start_partitions
from .local import local_cluster
from .local_processes import forked_workers

__all__ = ["forked_workers", "local_cluster", "start_partitions"]

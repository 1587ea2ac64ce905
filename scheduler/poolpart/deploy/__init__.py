"""Clusters whose workers form partitions from the start: on this machine, in queues, over SSH.

Worker groups of Kubernetes are scaled. Partitions and pipes need none of it: they divide any
running cluster.
"""

from .clusters import start_partitions
from .kubernetes import KubernetesGroups
from .local import local_cluster
from .local_processes import forked_workers
from .worker_groups import WorkerGroups, scale_groups

__all__ = [
    "KubernetesGroups",
    "WorkerGroups",
    "forked_workers",
    "local_cluster",
    "scale_groups",
    "start_partitions",
]

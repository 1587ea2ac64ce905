"""Start clusters whose workers form partitions from the beginning.

The workers run locally, in queues, over SSH, or in Kubernetes.

Partitions and pipes do not need these modules, because they can divide any running cluster.
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

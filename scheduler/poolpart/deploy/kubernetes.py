"""Worker groups managed by the dask-kubernetes operator, for `scale_groups`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import PoolError


class KubernetesGroups:
    """Worker groups of a dask-kubernetes `KubeCluster`, for `scale_groups`.

    This class was tested with a stand-in for the documented interface of dask-kubernetes 2026.3.0.
    It has not been tested on a Kubernetes cluster.

    The worker group of the partition ``GPU`` is called ``gpu``, because Kubernetes does not allow
    capital letters and underscores in names. Add it with ``cluster.add_worker_group("gpu",
    n_workers=…, worker_command=…)``. Its worker command declares the partition, for example ``dask
    worker --nthreads 1 --resources GPU=1``. A ``KubeCluster(n_workers=0)`` has no workers outside
    of the groups.

    Parameters
    ----------
    cluster
        A `dask_kubernetes.operator.KubeCluster` that is not asynchronous.

    Notes
    -----
    According to its source code, the operator closes the least busy workers of the whole cluster if
    a group shrinks, even if they belong to other groups. Therefore, the Deployments of the workers
    that `scale_groups` has closed are deleted first. The group then already has its new size, and
    the operator closes no worker. This requires the permission to delete Deployments in the
    namespace of the cluster.
    """

    def __init__(self, cluster: Any) -> None:
        for attribute in ("scale", "add_worker_group", "namespace"):
            if not hasattr(cluster, attribute):
                raise PoolError(
                    "`KubernetesGroups` expects a `KubeCluster` from `dask_kubernetes.operator`, "
                    f"but got a {type(cluster).__name__}, which has no attribute `{attribute}`."
                )
        self._cluster = cluster

    def scale(self, group: str, n: int, leaving: Sequence[str] = ()) -> None:
        """Set the number of workers in a group. See `WorkerGroups.scale`."""
        if leaving:
            self._delete(leaving)
        self._cluster.scale(n, worker_group=group.lower().replace("_", "-"))

    def _delete(self, workers: Sequence[str]) -> None:
        """Delete the Deployments of workers. A Deployment has the same name as its worker."""
        from kr8s import NotFoundError  # a dependency of dask-kubernetes
        from kr8s.objects import Deployment

        for worker in workers:
            try:
                Deployment(worker, namespace=self._cluster.namespace).delete()
            except NotFoundError:  # an earlier call has deleted it
                continue

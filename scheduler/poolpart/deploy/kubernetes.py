"""Worker groups of the operator of dask-kubernetes, as groups that `scale_groups` scales."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import PoolError


class KubernetesGroups:
    """Worker groups of a `KubeCluster` of dask-kubernetes, for `scale_groups`.

    This was tested against the documented interface of dask-kubernetes 2026.3.0; it was not run on
    a cluster.

    The worker group of partition ``GPU`` is ``gpu``: Kubernetes permits neither capitals nor
    underscores in names. It is added by ``cluster.add_worker_group("gpu", n_workers=…,
    worker_command=…)``. Its worker command declares the partition, such as ``dask worker
    --nthreads 1 --resources GPU=1``. A ``KubeCluster(n_workers=0)`` has no workers outside the
    groups.

    Parameters
    ----------
    cluster
        A `dask_kubernetes.operator.KubeCluster` that is not asynchronous.

    Notes
    -----
    By its source, the operator closes the least busy workers of the whole cluster when a group
    shrinks, even if they belong to other groups. So the Deployments of the workers that
    `scale_groups` has closed are deleted first: then the group has its new size, and the operator
    closes no worker. That needs the right to delete Deployments in the cluster's namespace.
    """

    def __init__(self, cluster: Any) -> None:
        for attribute in ("scale", "add_worker_group", "namespace"):
            if not hasattr(cluster, attribute):
                raise PoolError(
                    "KubernetesGroups takes a KubeCluster of dask_kubernetes.operator, not a "
                    f"{type(cluster).__name__}, which has no {attribute}."
                )
        self._cluster = cluster

    def scale(self, group: str, n: int, leaving: Sequence[str] = ()) -> None:
        """Give a group `n` workers, as `WorkerGroups.scale` describes."""
        if leaving:
            self._delete(leaving)
        self._cluster.scale(n, worker_group=group.lower().replace("_", "-"))

    def _delete(self, workers: Sequence[str]) -> None:
        """Delete the Deployments of workers, which are named after their workers."""
        from kr8s import NotFoundError  # dask-kubernetes needs kr8s, too
        from kr8s.objects import Deployment

        for worker in workers:
            try:
                Deployment(worker, namespace=self._cluster.namespace).delete()
            except NotFoundError:  # an earlier call has deleted it
                continue

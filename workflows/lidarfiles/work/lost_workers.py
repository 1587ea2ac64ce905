"""Error of a map whose workers are lost."""

from __future__ import annotations

from lidarsim.errors import LidarError


class LostWorkersError(LidarError):
    """Raised if the cluster is lost, or if an item repeatedly kills its workers."""

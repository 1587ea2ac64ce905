"""Features that begin and end with partitions on a scheduler, unknown to the core.

The core calls `FEATURES` where partitions begin and end, and where tasks are counted. The modules
of `extras` add themselves: inheritance, the page of partitions, and figures for Prometheus.
"""

from __future__ import annotations

from collections.abc import Iterable, Set
from typing import Any


class Feature:
    """A feature beside the core. Its methods run on the scheduler, and do nothing by default."""

    def begin(self, scheduler: Any, names: Iterable[str]) -> str:
        """Begin in partitions and return a remark for users on what this version of Dask lacks."""
        return ""

    def end(self, scheduler: Any, name: str) -> None:
        """End in a partition, if the feature has begun there."""

    def names(self, scheduler: Any) -> Set[str]:
        """Return the partitions that the feature has begun in."""
        return frozenset()

    async def wait_for_workers(self) -> None:
        """Wait, for a limited time, until workers know what has started and stopped."""

    def end_all(self, scheduler: Any) -> None:
        """End with the last partition that has a rule."""

    def begin_counting(self, statistics: Any) -> None:
        """Begin when a scheduler begins to count its tasks, in a `TaskStatistics`."""

    def end_counting(self, statistics: Any) -> None:
        """End when a scheduler ends to count its tasks."""


FEATURES: list[Feature] = []  # filled when `poolpart` is imported


def begin_features(scheduler: Any, names: Iterable[str]) -> str:
    """Begin all features in partitions and return their remarks for users, or ""."""
    names = [*names]
    return "; ".join(filter(None, (feature.begin(scheduler, names) for feature in FEATURES)))


def end_features(scheduler: Any, name: str) -> None:
    """End all features in a partition."""
    for feature in FEATURES:
        feature.end(scheduler, name)


def names_with_features(scheduler: Any) -> frozenset[str]:
    """Return the partitions that features have begun in."""
    return frozenset().union(*(feature.names(scheduler) for feature in FEATURES))


async def wait_for_features() -> None:
    """Wait, for a limited time, until workers know which features have started and stopped."""
    for feature in FEATURES:
        await feature.wait_for_workers()

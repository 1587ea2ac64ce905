"""Interface for features that are enabled per partition and of which the core knows nothing.

The core calls the objects in `FEATURES` when a partition is created or dissolved, and when the
scheduler begins or stops counting tasks. The modules in `extras` add their features to the list:
inheritance of partitions by nested tasks, the dashboard page, and Prometheus metrics.
"""

from __future__ import annotations

from collections.abc import Iterable, Set
from typing import Any


class Feature:
    """Base class for features. Its methods run on the scheduler, and do nothing by default."""

    def enable(self, scheduler: Any, names: Iterable[str]) -> str:
        """Enable the feature in the given partitions.

        Returns a note for users if this version of Dask does not support a part of the feature, or
        an empty string.
        """
        return ""

    def disable(self, scheduler: Any, name: str) -> None:
        """Disable the feature in a partition in which it is enabled."""

    def names(self, scheduler: Any) -> Set[str]:
        """Return the names of the partitions in which the feature is enabled."""
        return frozenset()

    async def wait_for_workers(self) -> None:
        """Wait until workers have applied recent changes, up to a time limit."""

    def clean_up(self, scheduler: Any) -> None:
        """Clean up after the last partition with a rule has been dissolved."""

    def begin_counting(self, statistics: Any) -> None:
        """Prepare the feature when the scheduler begins to count tasks."""

    def end_counting(self, statistics: Any) -> None:
        """Clean up the feature when the scheduler stops counting tasks."""


FEATURES: list[Feature] = []  # filled when `poolpart` is imported


def enable_features(scheduler: Any, names: Iterable[str]) -> str:
    """Enable all features in the given partitions, and return notes for users."""
    names = [*names]
    return "; ".join(filter(None, (feature.enable(scheduler, names) for feature in FEATURES)))


def disable_features(scheduler: Any, name: str) -> None:
    """Disable all features in the given partition."""
    for feature in FEATURES:
        feature.disable(scheduler, name)


def names_with_features(scheduler: Any) -> frozenset[str]:
    """Return the names of the partitions with at least one feature."""
    return frozenset().union(*(feature.names(scheduler) for feature in FEATURES))


async def wait_for_features() -> None:
    """Wait until workers have applied recent changes to all features, up to a time limit."""
    for feature in FEATURES:
        await feature.wait_for_workers()

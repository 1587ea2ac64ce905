"""Publish metrics of partitions for Prometheus at the scheduler's ``/metrics`` endpoint.

Like Dask's own metrics, they require the package prometheus-client in the scheduler's environment.
They can be used to scale or to send alerts according to the demand of each partition, which Dask's
metrics of the whole cluster do not show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from weakref import WeakKeyDictionary

import dask

from ..features import FEATURES, Feature
from ..partition_stats import PartitionStats

_LABELS = ["partition"]


class PartitionCollector:
    """Prometheus collector that provides the statistics of all partitions."""

    def __init__(self, collect_stats: Callable[[], list[PartitionStats]]) -> None:
        self._collect_stats = collect_stats

    def describe(self) -> Iterator[Any]:
        """Return no metrics, because the scheduler may not be ready when the collector is added."""
        return iter(())

    def collect(self) -> Iterator[Any]:
        """Yield all metric families. The label "" stands for tasks without a partition."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        namespace = dask.config.get("distributed.dashboard.prometheus.namespace", "dask")
        prefix = f"{namespace}_partition"
        gauges = {
            "workers": GaugeMetricFamily(f"{prefix}_workers", "Workers", labels=_LABELS),
            "slots": GaugeMetricFamily(f"{prefix}_slots", "Slots on all workers", labels=_LABELS),
            "busy": GaugeMetricFamily(f"{prefix}_busy_slots", "Slots in use", labels=_LABELS),
        }
        tasks = GaugeMetricFamily(f"{prefix}_tasks", "Unfinished tasks", labels=[*_LABELS, "state"])
        ended = CounterMetricFamily(
            f"{prefix}_tasks_ended", "Finished tasks", labels=[*_LABELS, "state"]
        )
        running = CounterMetricFamily(
            f"{prefix}_running_seconds", "Running time of finished tasks", labels=_LABELS
        )
        waiting = CounterMetricFamily(
            f"{prefix}_waiting_seconds",
            "Time that finished tasks waited for a worker or a slot",
            labels=_LABELS,
        )
        for stats in self._collect_stats():
            for field, family in gauges.items():
                family.add_metric([stats.name], getattr(stats, field))
            for state in ("waiting", "queued", "running"):
                tasks.add_metric([stats.name, state], getattr(stats, state))
            for state in ("done", "failed"):
                ended.add_metric([stats.name, state], getattr(stats, state))
            running.add_metric([stats.name], stats.seconds)
            waiting.add_metric([stats.name], stats.queued_seconds)
        yield from (*gauges.values(), tasks, ended, running, waiting)


class _Metrics(Feature):
    """Feature that publishes metrics as long as the scheduler counts tasks."""

    def __init__(self) -> None:
        self._collectors: WeakKeyDictionary[Any, PartitionCollector] = WeakKeyDictionary()

    def begin_counting(self, statistics: Any) -> None:
        """Add the metrics to ``/metrics`` if prometheus-client is installed."""
        try:
            from prometheus_client import REGISTRY
        except ImportError:
            return
        collector = PartitionCollector(statistics.all_stats)
        self._collectors[statistics] = collector
        REGISTRY.register(collector)

    def end_counting(self, statistics: Any) -> None:
        """Remove the metrics from the endpoint."""
        collector = self._collectors.pop(statistics, None)
        if collector is not None:
            from prometheus_client import REGISTRY

            REGISTRY.unregister(collector)


FEATURES.append(_Metrics())

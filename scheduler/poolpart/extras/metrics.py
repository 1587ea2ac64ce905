"""Publish metrics of partitions for Prometheus at the scheduler's ``/metrics`` endpoint.

Like Dask's own metrics, they require the package prometheus-client in the scheduler's environment.
They can be used to scale or to send alerts according to the demand of each partition, which Dask's
metrics of the whole cluster do not show.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any
from weakref import WeakKeyDictionary

import dask

from ..balancing import current_loads, move_counts
from ..features import FEATURES, Feature
from ..partition_stats import PartitionStats

_LABELS = ["partition"]


class PartitionCollector:
    """Prometheus collector that provides the statistics of all partitions and balanced groups."""

    def __init__(self, statistics: Any) -> None:
        self._statistics = statistics

    def describe(self) -> Iterator[Any]:
        """Return no metrics, because the scheduler may not be ready when the collector is added."""
        return iter(())

    def collect(self) -> Iterator[Any]:
        """Yield all metric families. The label "" stands for tasks without a partition."""
        namespace = dask.config.get("distributed.dashboard.prometheus.namespace", "dask")
        all_stats = self._statistics.all_stats()
        yield from _partition_families(f"{namespace}_partition", all_stats)
        yield from _client_families(f"{namespace}_partition_client", all_stats)
        yield from self._balance_families(f"{namespace}_partition_balance")

    def _balance_families(self, prefix: str) -> Iterator[Any]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        share = GaugeMetricFamily(
            f"{prefix}_share", "Fraction of the workers of a balanced group", labels=_LABELS
        )
        gauges = {
            "demand": GaugeMetricFamily(f"{prefix}_demand", "Workers demanded", labels=_LABELS),
            "backlog": GaugeMetricFamily(
                f"{prefix}_backlog", "Unfinished tasks and items in pipes", labels=_LABELS
            ),
            "wait_s": GaugeMetricFamily(
                f"{prefix}_wait_seconds", "Expected waiting time of a new task", labels=_LABELS
            ),
        }
        moves = CounterMetricFamily(
            f"{prefix}_moves",
            "Workers moved to another partition",
            labels=["source", "destination"],
        )
        scheduler = self._statistics.scheduler
        for loads in current_loads(scheduler):
            total = sum(load.workers for load in loads.values())
            for name, load in loads.items():
                share.add_metric([name], load.workers / total if total else 0.0)
                for field, family in gauges.items():
                    family.add_metric([name], getattr(load, field))
        for pair, count in move_counts(scheduler).items():
            moves.add_metric(pair, count)
        yield from (share, *gauges.values(), moves)


def _partition_families(prefix: str, all_stats: Iterable[PartitionStats]) -> Iterator[Any]:
    """Yield the metric families with one label, the partition."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    gauges = {
        "workers": GaugeMetricFamily(f"{prefix}_workers", "Workers", labels=_LABELS),
        "slots": GaugeMetricFamily(f"{prefix}_slots", "Slots on all workers", labels=_LABELS),
        "busy": GaugeMetricFamily(f"{prefix}_busy_slots", "Slots in use", labels=_LABELS),
        "peak_memory": GaugeMetricFamily(
            f"{prefix}_peak_memory_bytes",
            "Highest memory of a worker process while it was running a task",
            labels=_LABELS,
        ),
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
    piping = CounterMetricFamily(
        f"{prefix}_pipe_seconds", "Time that tasks waited for pipes", labels=_LABELS
    )
    for stats in all_stats:
        for field, family in gauges.items():
            family.add_metric([stats.name], getattr(stats, field))
        for state in ("waiting", "queued", "running"):
            tasks.add_metric([stats.name, state], getattr(stats, state))
        for state in ("done", "failed"):
            ended.add_metric([stats.name, state], getattr(stats, state))
        running.add_metric([stats.name], stats.seconds)
        waiting.add_metric([stats.name], stats.queued_seconds)
        piping.add_metric([stats.name], stats.pipe_seconds)
    yield from (*gauges.values(), tasks, ended, running, waiting, piping)


def _client_families(prefix: str, all_stats: Iterable[PartitionStats]) -> Iterator[Any]:
    """Yield the metric families with two labels, the partition and the client."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    labels = [*_LABELS, "client"]
    gauges = {
        "weight": GaugeMetricFamily(f"{prefix}_weight", "Weight", labels=labels),
        "share": GaugeMetricFamily(
            f"{prefix}_share", "Fraction of the recently used slot time", labels=labels
        ),
        "slots": GaugeMetricFamily(f"{prefix}_slots", "Slots in use", labels=labels),
        "waiting": GaugeMetricFamily(
            f"{prefix}_waiting_tasks", "Tasks that wait for a slot", labels=labels
        ),
    }
    counters = {
        "seconds": CounterMetricFamily(
            f"{prefix}_slot_seconds", "Slot time of finished tasks", labels=labels
        ),
        "queued_seconds": CounterMetricFamily(
            f"{prefix}_waiting_seconds", "Time that tasks waited for a slot", labels=labels
        ),
    }
    families = gauges | counters
    for stats in all_stats:
        for client, of_client in stats.clients.items():
            for field, family in families.items():
                family.add_metric([stats.name, client], getattr(of_client, field))
    yield from families.values()


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
        collector = PartitionCollector(statistics)
        self._collectors[statistics] = collector
        REGISTRY.register(collector)

    def end_counting(self, statistics: Any) -> None:
        """Remove the metrics from the endpoint."""
        collector = self._collectors.pop(statistics, None)
        if collector is not None:
            from prometheus_client import REGISTRY

            REGISTRY.unregister(collector)


FEATURES.append(_Metrics())

"""Pool partitions and pipes for Dask clusters."""

from .devices import assign_devices, own_device
from .errors import PipeClosed, PipeFailed, PoolError
from .fence import lower_fence, raise_fence
from .fetch import fetch_available, fetch_from, hold_for_driver, take_held
from .local import local_cluster
from .mapping import Results
from .page import (
    has_partitions_page,
    partitions_page,
    remove_partitions_page,
    tell_page,
)
from .partition import Partition
from .pipe import Pipe, await_news, forget_pipes, take_news
from .placement import Recorder, TaskRecord, placement_violations, recorded
from .pool import Pool
from .remote import ask_workers, worker_identities
from .rules import Rule, n_workers, named, per_gpu, per_host, rest
from .stats import PartitionStats, StageStats
from .task_context import WorkerLeft, own_client, telling_departure
from .task_locations import Slots, TaskPlace, Whereabouts, look_at_slots, look_for_tasks
from .tracing import trace, trace_to
from .worker_info import WorkerInfo

__all__ = [
    "Partition",
    "PartitionStats",
    "Pipe",
    "PipeClosed",
    "PipeFailed",
    "Pool",
    "PoolError",
    "Recorder",
    "Results",
    "Rule",
    "Slots",
    "StageStats",
    "TaskPlace",
    "TaskRecord",
    "Whereabouts",
    "WorkerInfo",
    "WorkerLeft",
    "ask_workers",
    "assign_devices",
    "await_news",
    "fetch_available",
    "fetch_from",
    "forget_pipes",
    "has_partitions_page",
    "hold_for_driver",
    "local_cluster",
    "look_at_slots",
    "look_for_tasks",
    "lower_fence",
    "n_workers",
    "named",
    "own_client",
    "own_device",
    "partitions_page",
    "per_gpu",
    "per_host",
    "placement_violations",
    "raise_fence",
    "recorded",
    "remove_partitions_page",
    "rest",
    "take_held",
    "take_news",
    "tell_page",
    "telling_departure",
    "trace",
    "trace_to",
    "worker_identities",
]

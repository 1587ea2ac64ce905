"""Pool partitions and pipes for Dask clusters."""

from .devices import own_device
from .errors import PipeClosed, PipeFailed, PoolError
from .fetch import fetch_available, hold_for_driver, take_held
from .mapping import Results
from .partition import Partition
from .pipe import Pipe, forget_pipes, take_news
from .placement import Recorder, TaskRecord, placement_violations, recorded
from .pool import Pool
from .rules import Rule, n_workers, named, per_gpu, per_host, rest
from .stats import PartitionStats, StageStats
from .task_context import WorkerLeft, own_client, telling_departure
from .task_locations import TaskLocations, TaskPlace, look_for_tasks
from .workers import WorkerInfo, ask_workers, worker_identities

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
    "StageStats",
    "TaskLocations",
    "TaskPlace",
    "TaskRecord",
    "WorkerInfo",
    "WorkerLeft",
    "ask_workers",
    "fetch_available",
    "forget_pipes",
    "hold_for_driver",
    "look_for_tasks",
    "n_workers",
    "named",
    "own_client",
    "own_device",
    "per_gpu",
    "per_host",
    "placement_violations",
    "recorded",
    "rest",
    "take_held",
    "take_news",
    "telling_departure",
    "worker_identities",
]

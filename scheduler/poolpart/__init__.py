"""Divide the workers of a Dask cluster into partitions, and connect tasks with pipes."""

from . import extras as extras  # registers the features
from ._version import __version__
from .balance_stats import BalanceStats, DemandStats, WorkerMove
from .balancing import BalancedGroup
from .devices import own_device, own_device_share
from .errors import PipeClosed, PipeFailed, PoolError, TaskTimeoutError
from .extras.background import after_all
from .extras.cancelling import cancelled
from .extras.listening import PipeListener
from .mapping import Results
from .partition import Partition
from .partition_stats import ClientStats, PartitionStats, StageStats
from .pipe import Pipe
from .pool import Pool
from .rules import Rule, n_workers, named, per_gpu, per_host, rest
from .task_table import TaskRow, TaskTable
from .workers import WorkerInfo

__all__ = [
    "BalanceStats",
    "BalancedGroup",
    "ClientStats",
    "DemandStats",
    "Partition",
    "PartitionStats",
    "Pipe",
    "PipeClosed",
    "PipeFailed",
    "PipeListener",
    "Pool",
    "PoolError",
    "Results",
    "Rule",
    "StageStats",
    "TaskRow",
    "TaskTable",
    "TaskTimeoutError",
    "WorkerInfo",
    "WorkerMove",
    "__version__",
    "after_all",
    "cancelled",
    "n_workers",
    "named",
    "own_device",
    "own_device_share",
    "per_gpu",
    "per_host",
    "rest",
]

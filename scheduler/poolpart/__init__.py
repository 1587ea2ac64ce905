"""Pool partitions, pipes and a delivery ledger for Dask clusters."""

from .asking import ask_workers
from .awaiting import await_news
from .backoff import Backoff
from .claims import Claim, claim_slots, drop_claim
from .current_client import own_client
from .departure import WorkerLeft, telling_departure
from .devices import assign_devices, own_device
from .errors import PipeClosed, PipeFailed, PoolError
from .fence import lower_fence, raise_fence
from .fetch import fetch_available
from .identities import worker_identities
from .ledger import Ledger
from .local import local_cluster
from .mapping import Results
from .page import (
    has_partitions_page,
    partitions_page,
    remove_partitions_page,
    tell_page,
)
from .partition import Partition
from .pipe import Pipe
from .pipe_parts import forget_pipes
from .placement import Recorder, TaskRecord, placement_violations, recorded
from .pool import Pool
from .rules import Rule, n_workers, named, per_gpu, per_host, rest
from .slots import Slots, look_at_slots
from .stats import PartitionStats, StageStats
from .tracing import trace, trace_to
from .whereabouts import TaskPlace, Whereabouts, look_for_tasks
from .worker_info import WorkerInfo

__all__ = [
    "Backoff",
    "Claim",
    "Ledger",
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
    "claim_slots",
    "drop_claim",
    "fetch_available",
    "forget_pipes",
    "has_partitions_page",
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
    "tell_page",
    "telling_departure",
    "trace",
    "trace_to",
    "worker_identities",
]

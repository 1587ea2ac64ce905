"""List the private API of Dask that poolpart uses, and check that it exists.

Private names may change in any release of Dask. Before a feature is used, `require_feature` checks
the names that it needs. If a name is missing, a `PoolError` reports it, and all other features
continue to work. docs/pool-partitions/dask-internals.md contains a table of `PRIVATE_NAMES`.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import distributed

from ..errors import PoolError
from .partition_client import PRIVATE_NAMES as CLIENT_NAMES
from .queues import PRIVATE_NAMES as PIPE_NAMES

TESTED = "2025.5.0", "2026.8.0"  # oldest and newest tested version of distributed (`make compat`)

NESTED = "keeping nested tasks in their partition"
EXISTING = "moving shared tasks into a partition"
REFUSING = "rejecting tasks that can never run"
FENCES = "exclusive partitions"
DIVIDING = "dividing a pool"
CHOOSING = "choosing workers in constant time"
SHUFFLES = "shuffles inside a partition"
MAP = "Partition.map"
PIPES = "pipes"
FETCHING = "fetching results directly from workers"
PAGE = "the partitions page"
CLUSTERS = "clusters with several kinds of workers"
ADAPTING = "adaptive partitions"
CANCELLING = "Partition.cancel"
CLIENTS = "Partition.as_client"
BALANCING = "Pool.balance"
BLAMING = "blaming the death of a worker on running tasks only"
SHARES = "fair shares"
WATCHING = "moving waiting tasks to free slots, and time limits of tasks"
READING = "errors for inputs that cannot be unpickled"


@dataclass(frozen=True)
class PrivateNames:
    """Private Dask names that a feature needs for a given purpose."""

    feature: str
    names: tuple[str, ...]  # "module:object.attribute", followed by "(parameters)" for methods
    purpose: str
    tests: tuple[str, ...]  # relative to tests/poolpart unless a folder is given


_SCHEDULER = "distributed.scheduler:Scheduler"
_SCHEDULER_TASK = "distributed.scheduler:TaskState"
_SCHEDULER_WORKER = "distributed.scheduler:WorkerState"
_STEALING = "distributed.stealing:WorkStealing"
_WORKER_STATE = "distributed.worker_state_machine:WorkerState"
_WORKER_TASK = "distributed.worker_state_machine:TaskState"

PRIVATE_NAMES = (
    PrivateNames(
        NESTED,
        (
            f"{_SCHEDULER}._create_taskstate_from_graph"
            "(submitting_task, annotations_by_type, global_annotations, dsk)",
            f"{_SCHEDULER}.aliases",
            f"{_SCHEDULER}.resources",
        ),
        "nested tasks inherit the partition of their parent",
        (
            "test_inherit.py::test_at_any_depth_and_on_a_single_slot",
            "test_inherit.py::test_what_an_actor_submits_belongs_to_the_partition_of_the_actor",
        ),
    ),
    PrivateNames(
        NESTED,
        (
            "distributed.utils:SyncMethodMixin.sync",
            "distributed.client:Future._result",
            "distributed.client:Future._exception",
            "distributed.client:Future._traceback",
            "distributed.client:Client._gather",
            "distributed.client:_wait",
            "distributed.client:as_completed.__next__",
            "distributed.actor:ActorFuture.result",
        ),
        "detect that a task is waiting; wrapped once per process and never restored",
        ("test_lending.py::test_what_another_library_has_wrapped_meanwhile_stays",),
    ),
    PrivateNames(
        NESTED,
        (
            f"{_WORKER_STATE}.tasks",
            f"{_WORKER_STATE}.all_running_tasks",
            f"{_WORKER_STATE}.available_resources",
            f"{_WORKER_STATE}.nthreads",
            f"{_WORKER_TASK}.resource_restrictions",
            f"{_WORKER_TASK}.annotations",
            "distributed.worker_state_machine:UnpauseEvent",
            "distributed.worker:thread_state",
            f"{_SCHEDULER}.worker_plugins",
        ),
        "a waiting task lends its slots; lending is set up before a worker receives tasks",
        (
            "test_lending.py::test_on_one_slot_nested_tasks_and_their_parent_run_one_at_a_time",
            "test_lending.py::test_a_tree_of_waiting_tasks_on_two_slots_ends",
            "test_lending.py::test_a_worker_without_this_package_ignores_the_plugin",
        ),
    ),
    PrivateNames(
        NESTED,
        (
            "distributed.client:Client._send_to_scheduler(msg)",
            "distributed.worker:Worker._get_client(timeout)",
        ),
        "name the submitting task in coroutines; wrapped once per process and never restored",
        (
            "test_inherit.py::test_tasks_that_a_coroutine_of_the_task_submits",
            "test_lending.py::test_nested_tasks_of_tasks_that_secede",
        ),
    ),
    PrivateNames(
        NESTED,
        (
            "distributed.worker:Worker.active_threads",
            "distributed.worker:Worker.active_threads_lock",
            "distributed.worker:Worker.executor",
            "distributed.threadpoolexecutor:ThreadPoolExecutor._threads",
            f"{_WORKER_STATE}.long_running",
            f"{_WORKER_TASK}.resource_restrictions",
        ),
        "a task that has seceded lends its slots until it rejoins",
        ("test_lending.py::test_nested_tasks_of_tasks_that_secede",),
    ),
    PrivateNames(
        EXISTING,
        (
            f"{_SCHEDULER}._create_taskstate_from_graph"
            "(annotations_by_type, global_annotations, dsk)",
            f"{_SCHEDULER}._apply_annotations(tasks, annotations_by_type, global_annotations)",
            f"{_SCHEDULER}.transitions",
            f"{_SCHEDULER_TASK}.resource_restrictions",
            f"{_SCHEDULER_TASK}.worker_restrictions",
            f"{_SCHEDULER_TASK}.host_restrictions",
            f"{_SCHEDULER_TASK}.loose_restrictions",
            f"{_SCHEDULER_TASK}.annotations",
        ),
        "tasks of an earlier computation that run again, or have not started, change their place",
        (
            "test_partition_client.py::test_released_results_are_computed_again_in_the_partition",
            "test_partition_client.py::test_queued_tasks_of_another_client_move_to_the_partition",
        ),
    ),
    PrivateNames(
        REFUSING,
        (
            f"{_SCHEDULER}._create_taskstate_from_graph"
            "(client, annotations_by_type, global_annotations)",
            f"{_SCHEDULER}.resources",
        ),
        "raise an error instead of letting a task wait forever, without a request per task",
        (
            "test_membership.py::test_by_another_client",
            "test_membership.py::test_more_slots_than_any_worker_has",
            "test_membership.py::test_workers_by_name_address_or_both",
        ),
    ),
    PrivateNames(
        FENCES,
        (
            f"{_SCHEDULER}.valid_workers(ts)",
            f"{_SCHEDULER}.decide_worker_rootish_queuing_disabled(ts)",
            f"{_SCHEDULER}.decide_worker_non_rootish(ts)",
            f"{_SCHEDULER}.idle_task_count",
        ),
        "keep other tasks off the workers",
        (
            "test_fence.py::test_other_tasks_stay_out",
            "test_fence.py::test_nothing_is_stolen_into_a_partition",
            "test_fence.py::test_root_tasks_are_held_back_as_before",
        ),
    ),
    PrivateNames(
        CHOOSING,
        (
            f"{_SCHEDULER}.decide_worker_non_rootish(ts)",
            f"{_SCHEDULER}.worker_objective(ts, ws)",
            f"{_SCHEDULER_TASK}.host_restrictions",
            f"{_SCHEDULER_WORKER}.long_running",
        ),
        "compare a few workers per task instead of all",
        ("test_choosing.py::test_simulated_workers_get_tasks_as_evenly_as_from_dask",),
    ),
    PrivateNames(
        SHARES,
        (
            f"{_SCHEDULER}.decide_worker_non_rootish(ts)",
            f"{_SCHEDULER}.bulk_schedule_unrunnable_after_adding_worker(ws)",
            f"{_SCHEDULER}.transitions",
            f"{_SCHEDULER}.unrunnable",
            f"{_SCHEDULER}.no_workers_timeout",
            f"{_SCHEDULER}.generation",
            f"{_SCHEDULER_TASK}.state",
            f"{_SCHEDULER_TASK}.priority",
            f"{_SCHEDULER_TASK}.who_wants",
            f"{_SCHEDULER_TASK}.annotations",
            f"{_SCHEDULER}.valid_workers(ts)",
            f"{_STEALING}.move_task_request(ts, victim, thief)",
            f"{_STEALING}.in_flight",
            f"{_SCHEDULER_WORKER}.processing",
        ),
        "hold tasks back until a slot and enough memory are free; let clients take turns",
        (
            "test_shares.py::test_a_second_client_does_not_wait_for_all_tasks_of_the_first",
            "test_memory.py::test_tasks_that_are_moved_find_their_memory",
        ),
    ),
    PrivateNames(
        SHUFFLES,
        (
            "distributed.shuffle._scheduler_plugin:ShuffleSchedulerPlugin._calculate_worker_for"
            "(spec)",
            "distributed.shuffle._core:barrier_key",
        ),
        "keep shuffles on the permitted workers",
        (
            "test_shuffles.py::test_inside_a_task_of_a_partition",
            "test_shuffles.py::test_of_a_collection_that_a_partition_computes",
        ),
    ),
    PrivateNames(
        DIVIDING,
        (
            f"{_SCHEDULER}.resources",
            f"{_SCHEDULER_WORKER}.resources",
            f"{_SCHEDULER_WORKER}.used_resources",
            f"{_SCHEDULER_WORKER}.extra",
            f"{_WORKER_STATE}.total_resources",
            f"{_WORKER_STATE}.available_resources",
            f"{_WORKER_STATE}.all_running_tasks",
        ),
        "read and change the resources that workers declare",
        (
            "test_moves.py::test_slots_are_those_of_the_partition",
            "test_moves.py::test_a_cancelled_task_that_is_on_its_way_when_its_worker_leaves",
        ),
    ),
    PrivateNames(
        DIVIDING,
        (
            f"{_SCHEDULER}.bulk_schedule_unrunnable_after_adding_worker",
            f"{_SCHEDULER}.transitions",
            f"{_SCHEDULER}.check_idle_saturated",
            f"{_SCHEDULER}.stimulus_queue_slots_maybe_opened",
        ),
        "resume tasks that wait for a slot",
        ("test_fence.py::test_waiting_tasks_go_to_a_worker_that_leaves_the_partition",),
    ),
    PrivateNames(
        DIVIDING,
        (f"{_STEALING}.move_task_request", f"{_STEALING}.in_flight"),
        "move waiting tasks off a worker that changes its partition",
        ("test_moves.py::test_what_has_not_started_is_shared_out_evenly",),
    ),
    PrivateNames(
        DIVIDING,
        (
            "distributed.core:clean_exception",
            "distributed.worker:Worker.run",
            "distributed.scheduler:Scheduler.identity",
        ),
        "send requests to single workers",
        ("test_pool.py::test_more_workers_than_dask_lists_by_default",),
    ),
    PrivateNames(
        MAP,
        ("distributed.client:Future._state",),
        "detect lost results",
        ("test_mapping.py::test_results_that_are_lost_before_they_are_fetched",),
    ),
    PrivateNames(
        PIPES,
        PIPE_NAMES,
        "implement a pipe as a Queue and a Variable that all clients can use",
        (
            "test_pipe_processes.py::test_deleting_forgets_consumers_that_were_killed",
            "test_pipe_processes.py::test_a_plain_client_of_another_process_uses_queue_and_variable",
            "test_pipe.py::test_using_a_deleted_pipe_says_so_and_does_not_bring_it_back",
        ),
    ),
    PrivateNames(
        PIPES,
        (
            f"{_SCHEDULER_TASK}.annotations",
            f"{_SCHEDULER_TASK}.exception_blame",
            f"{_SCHEDULER_TASK}.exception_text",
        ),
        "let a pipe fail when a task that uses it fails",
        (
            "test_listening.py::test_a_producer_that_fails_ends_the_listener",
            "test_pipe.py::test_a_producer_that_is_cancelled_ends_its_consumers",
        ),
    ),
    PrivateNames(
        FETCHING,
        ("distributed.utils_comm:gather_from_workers", "distributed.worker:Worker.handlers"),
        "do not wait for dead workers",
        ("test_fetch.py::test_a_worker_that_is_slow_is_waited_for",),
    ),
    PrivateNames(
        PAGE,
        (f"{_SCHEDULER}.http_application",),
        "serve the page as part of Dask's dashboard",
        ("test_page.py::test_it_is_served_and_taken_away",),
    ),
    PrivateNames(
        CLUSTERS,
        (
            "distributed.deploy.cluster:Cluster._update_worker_status",
            "distributed.nanny:Nanny.instantiate",
            "distributed.utils:_forkserver_preload_set",
            "distributed.deploy.spec:SpecCluster.worker_spec",
            "distributed.deploy.spec:SpecCluster.new_spec",
            "distributed.deploy.spec:SpecCluster.scheduler_spec",
            "distributed.deploy.spec:SpecCluster.workers",
            "distributed.deploy.spec:SpecCluster.scheduler_comm",
            "distributed.deploy.ssh:Worker",
            f"{_SCHEDULER}.transition_counter",
        ),
        "start workers of several kinds, forked from one process and restarted by their nannies",
        (
            "test_local.py::test_a_worker_that_is_slow_to_come_back_is_not_given_up",
            "test_local.py::test_a_script_needs_no_main_guard_and_what_it_defines_reaches_the_workers",
            "test_clusters.py::test_a_job_that_was_lost_is_submitted_again",
        ),
    ),
    PrivateNames(
        ADAPTING,
        (
            f"{_SCHEDULER}.handle_worker_status_change",
            f"{_SCHEDULER}.stream_comms",
            f"{_SCHEDULER}.retire_workers",
            f"{_SCHEDULER}.gather_on_worker",
            f"{_SCHEDULER}.close_worker",
            f"{_SCHEDULER}.unrunnable",
            f"{_SCHEDULER}.running",
            f"{_SCHEDULER}.resources",
            f"{_SCHEDULER_WORKER}.resources",
            f"{_SCHEDULER_WORKER}.nbytes",
            f"{_SCHEDULER_WORKER}.used_resources",
            f"{_SCHEDULER_WORKER}.processing",
            f"{_SCHEDULER_WORKER}.long_running",
            f"{_SCHEDULER_WORKER}.has_what",
            f"{_SCHEDULER_WORKER}.actors",
            f"{_SCHEDULER_TASK}.worker_restrictions",
            f"{_SCHEDULER_TASK}.host_restrictions",
            f"{_SCHEDULER_TASK}.loose_restrictions",
        ),
        "adapt the number of jobs to the waiting tasks; stop idle workers without data loss",
        (
            "test_adapting.py::test_no_task_is_lost_or_run_again_while_workers_come_and_go",
            "test_adapting.py::test_a_worker_is_kept_for_what_would_be_lost_with_it",
            "test_adapting.py::test_a_worker_whose_job_was_cancelled_too_late_gets_no_task",
            "test_worker_groups.py::test_a_container_of_a_closed_worker_gets_no_task_and_is_removed",
            "test_yielding.py::test_a_job_ends_after_its_task_and_is_replaced_when_no_other_waits",
        ),
    ),
    PrivateNames(
        BALANCING,
        (f"{_SCHEDULER}.unrunnable", f"{_SCHEDULER_WORKER}.used_resources"),
        "count the slots that unfinished tasks request",
        ("test_balancing.py::test_submitted_tasks_attract_workers_in_bursts",),
    ),
    PrivateNames(
        CANCELLING,
        (
            f"{_SCHEDULER}.stimulus_cancel(keys, client, force, reason, msg)",
            f"{_SCHEDULER}.transitions(recommendations, stimulus_id)",
            f"{_SCHEDULER}.gather_on_worker",
            f"{_SCHEDULER}.restart_workers(workers, timeout, stimulus_id)",
            f"{_SCHEDULER}.handle_worker_status_change",
            f"{_SCHEDULER}.stream_comms",
            f"{_SCHEDULER_TASK}.processing_on",
            f"{_SCHEDULER_TASK}.priority",
            f"{_SCHEDULER_TASK}.run_spec",
            f"{_SCHEDULER_WORKER}.executing",
            f"{_SCHEDULER_WORKER}.long_running",
            f"{_SCHEDULER_WORKER}.processing",
            f"{_SCHEDULER_WORKER}.has_what",
            f"{_SCHEDULER_WORKER}.actors",
            f"{_SCHEDULER_WORKER}.nanny",
            f"{_WORKER_STATE}.all_running_tasks",
            f"{_WORKER_TASK}.start_time",
            f"{_WORKER_TASK}.state",
        ),
        "restart a worker that only runs canceled tasks",
        (
            "test_cancelling.py::test_a_worker_with_nothing_but_cancelled_tasks_is_restarted",
            "test_cancelling.py::test_waiting_tasks_and_results_move_to_another_worker",
            "test_cancelling.py::test_a_function_sees_that_it_was_cancelled",
        ),
    ),
    PrivateNames(
        CLIENTS,
        CLIENT_NAMES,
        "show only the workers of a partition to libraries",
        (
            "test_partition_client.py::test_only_the_workers_of_the_partition_are_shown",
            "test_partition_client.py::test_tasks_find_the_client_of_their_partition",
        ),
    ),
    PrivateNames(
        READING,
        (
            f"{_SCHEDULER}.stimulus_task_erred(worker, stimulus_id, key, run_id)",
            f"{_SCHEDULER}.handle_task_erred(key, stimulus_id)",
            f"{_SCHEDULER}.transitions(recommendations, stimulus_id)",
            f"{_SCHEDULER}.stream_comms",
            f"{_SCHEDULER_TASK}.run_id",
            f"{_SCHEDULER_TASK}.processing_on",
            "distributed.core:error_message",
            "distributed.core:connect(addr)",
            "distributed.core:send_recv(comm)",
        ),
        "let a task fail if its worker cannot unpickle an input",
        ("test_unreadable.py::test_a_task_whose_worker_cannot_unpickle_its_input_fails",),
    ),
    PrivateNames(
        BLAMING,
        (
            f"{_SCHEDULER}.remove_worker(address, expected)",
            f"{_SCHEDULER}.handlers",
            f"{_SCHEDULER_TASK}.suspicious",
            f"{_SCHEDULER_TASK}.priority",
            "distributed.scheduler:TaskPrefix.suspicious",
            f"{_SCHEDULER_WORKER}.executing",
            f"{_SCHEDULER_WORKER}.long_running",
            f"{_SCHEDULER_WORKER}.processing",
            f"{_SCHEDULER_WORKER}.extra",
        ),
        "count the death of a worker only against tasks that may have been running",
        ("test_deaths.py::test_only_running_tasks_are_blamed",),
    ),
    PrivateNames(
        WATCHING,
        (
            f"{_STEALING}.move_task_request(ts, victim, thief)",
            f"{_STEALING}.in_flight",
            f"{_SCHEDULER}.valid_workers(ts)",
            f"{_SCHEDULER}.running",
            f"{_SCHEDULER}.handle_task_erred(key, stimulus_id)",
            f"{_SCHEDULER}.handle_worker_status_change",
            f"{_SCHEDULER_TASK}.priority",
            f"{_SCHEDULER_TASK}.annotations",
            f"{_SCHEDULER_TASK}.run_id",
            f"{_SCHEDULER_WORKER}.executing",
            f"{_SCHEDULER_WORKER}.long_running",
            f"{_SCHEDULER_WORKER}.last_seen",
            f"{_SCHEDULER_WORKER}.processing",
            f"{_SCHEDULER_WORKER}.used_resources",
            f"{_WORKER_STATE}.all_running_tasks",
            f"{_WORKER_TASK}.start_time",
        ),
        "move tasks that wait behind others, and end tasks that run too long",
        (
            "test_watching.py::test_tasks_do_not_wait_while_another_slot_is_free",
            "test_watching.py::test_a_task_that_takes_too_long_fails",
            "test_watching.py::test_only_the_task_that_blocks_its_worker_fails",
        ),
    ),
)


def require_feature(feature: str) -> None:
    """Check that this version of Dask provides the private names that a feature needs.

    The first call in a process also warns if this version of Dask was not tested.

    Raises
    ------
    PoolError
        If names are missing.
    """
    warn_if_untested()
    missing = missing_names(feature)
    if missing:
        raise PoolError(
            f"distributed {distributed.__version__} has no {', '.join(missing)}, which poolpart "
            f"requires for {feature}. Install a version from {TESTED[0]} to {TESTED[1]}."
        )


@cache
def missing_names(feature: str) -> tuple[str, ...]:
    """Return the private names for a feature that this version of Dask does not provide."""
    names = [name for row in PRIVATE_NAMES if row.feature == feature for name in row.names]
    return tuple(name.partition(":")[2] for name in names if not _exists(name))


@cache
def warn_if_untested() -> None:
    """Warn once per process if poolpart was not tested with this version of Dask."""
    oldest, version, newest = map(_numbers, (TESTED[0], distributed.__version__, TESTED[1]))
    if not oldest <= version <= newest:
        warnings.warn(
            f"poolpart was tested with distributed {TESTED[0]} to {TESTED[1]}, but the installed "
            f"version is {distributed.__version__}.",
            stacklevel=3,
        )


def table_row(row: PrivateNames) -> str:
    """Return a row for the table in docs/pool-partitions.md."""
    short = ", ".join(f"`{name.partition(':')[2]}`" for name in row.names)
    tests = ", ".join(f"`{test}`" for test in row.tests)
    return f"| {row.feature} | {short} | {row.purpose} | {tests} |"


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers in a version such as 2026.8.0 or 2026.8.0+14.g1234abc."""
    return tuple(int(number) for number in version.partition("+")[0].split(".") if number.isdigit())


def _exists(name: str) -> bool:
    """Return whether an attribute exists and, if it is a method, has the given parameters."""
    path, _, parameters = name.removesuffix(")").partition("(")
    module_name, _, attributes = path.partition(":")
    try:
        owner: Any = import_module(module_name)
    except ImportError:
        return False
    *parents, last = attributes.split(".")
    for parent in parents:
        owner = getattr(owner, parent, None)
    if last not in _attributes(owner):
        return False
    if not parameters:
        return True
    method = getattr(owner, last)
    return {*parameters.split(", ")} <= inspect.signature(method).parameters.keys()


def _attributes(owner: Any) -> set[str]:
    """Return the names of all attributes that an object, or an instance of a class, may have."""
    names = set(dir(owner))
    if isinstance(owner, type):
        for kind in owner.__mro__:
            names.update(vars(kind).get("__annotations__", ()), _slots(kind))
            names.update(_assigned(kind))
    return names


def _slots(kind: type) -> Iterator[str]:
    slots = vars(kind).get("__slots__", ())
    yield from (slots,) if isinstance(slots, str) else slots


def _assigned(kind: type) -> tuple[str, ...]:
    """Return all names in the code of a class's constructor, such as unannotated attributes."""
    constructor = vars(kind).get("__init__")
    code = getattr(inspect.unwrap(constructor), "__code__", None) if constructor else None
    return code.co_names if code is not None else ()

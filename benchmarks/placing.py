"""Measure how fast and how evenly tasks are placed on clusters of different sizes.

    python -m benchmarks.placing [--workers N ...]

A real scheduler has simulated workers that never respond. Tasks are placed and ended by the
scheduler's own transitions. Half of the workers belong to an exclusive partition. For each cluster
size, the benchmark lists

- the time to place a task of the partition or any other task in microseconds, with and without
  poolpart's rule, both behind the same fence;
- the mean end of tasks with random durations, relative to the mean end with Dask's own choice, and
  the longest queue of a worker.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import logging
import random
import time
from collections import defaultdict, deque
from typing import Any, NamedTuple

from dask._task_spec import Task
from distributed import Scheduler, Status
from distributed.scheduler import WorkerState

from poolpart.choosing import NAME as CHOICE
from poolpart.features import enable_features
from poolpart.fence import raise_fence
from poolpart.shares import NAME as SHARES

from .harness import argument_parser, write_results

PARTITION = "A"
KEYS = ("us", "end", "longest")  # of the results
_numbers = itertools.count()


class _Silence:
    """Stand-in for the connection to a worker that drops all messages."""

    def send(self, *messages: Any) -> None:
        """Drop messages."""

    async def close(self) -> None:
        """Keep the connection open."""

    abort = close

    def closed(self) -> bool:
        """Return True, so that no connection is closed."""
        return True


def add_workers(scheduler: Any, number: int) -> None:
    """Add simulated workers with one thread each.

    Every second worker declares the partition.
    """
    for index in range(number):
        address = f"tcp://10.{index >> 16}.{index >> 8 & 255}.{index & 255}:1"
        worker = WorkerState(
            address=address,
            status=Status.running,
            pid=0,
            name=index,
            nthreads=1,
            memory_limit=0,
            local_directory="",
            nanny=None,
            server_id=address,
            services={},
            versions={},
            extra={},
            scheduler=scheduler,
        )
        scheduler.workers[address] = worker
        scheduler.aliases[index] = address
        scheduler.running.add(worker)
        scheduler.total_nthreads += 1
        scheduler.stream_comms[address] = _Silence()
        scheduler.host_info.setdefault(worker.host, {"addresses": set(), "nthreads": 0})
        scheduler.host_info[worker.host]["addresses"].add(address)
        if index % 2:
            worker.resources = {PARTITION: 1}
            worker.used_resources = {PARTITION: 0}
            scheduler.resources.setdefault(PARTITION, {})[address] = 1
        scheduler.check_idle_saturated(worker)
        for plugin in list(scheduler.plugins.values()):
            plugin.add_worker(scheduler, address)


class Tasks:
    """Tasks that are placed and ended by hand, with or without a partition."""

    def __init__(self, scheduler: Any, partition: bool) -> None:
        self.scheduler = scheduler
        self.partition = partition
        self.name = f"tasks{next(_numbers)}"
        self.count = 0

    def assign(self, number: int) -> tuple[list[Any], float]:
        """Place all tasks, and return their states and the elapsed time in seconds."""
        states = []
        for _ in range(number):
            self.count += 1
            # Dask queues tasks of large groups without asking for a worker of each.
            key = (f"{self.name}-{self.count // 10}", self.count)
            state = self.scheduler.new_task(key, Task(key, abs, 1), "released")
            state.priority = (0, self.count)
            if self.partition:
                state.resource_restrictions = {PARTITION: 1}
            states.append(state)
        start = time.perf_counter()
        for state in states:
            self.scheduler.transitions({state.key: "waiting"}, "benchmark")
        seconds = time.perf_counter() - start
        return states, seconds

    def end(self, states: list[Any]) -> None:
        """End the tasks and remove them from the scheduler."""
        for state in states:
            self.scheduler.transition(
                state.key,
                "memory",
                "benchmark",
                worker=state.processing_on.address,
                nbytes=1,
                type=b"",
                typename="int",
                startstops=[],
            )
            self.scheduler.transitions({state.key: "forgotten"}, "benchmark")
        # In a partition, tasks wait on the scheduler until a slot is free.
        if (shares := self.scheduler.plugins.get(SHARES)) is not None:
            shares.dispatch()


def cost_us(scheduler: Any, partition: bool, number: int) -> float:
    """Return the time to place a task in microseconds, as the minimum of three rounds."""
    tasks = Tasks(scheduler, partition)
    rounds = []
    for _ in range(3):
        states, seconds = tasks.assign(number)
        assert all(state.processing_on for state in states)
        tasks.end(states)
        rounds.append(seconds / number * 1e6)
    return min(rounds)


class Flow(NamedTuple):
    """Results of simulating tasks of random durations on a cluster."""

    mean_end: float  # when a task ends on average, in mean durations
    longest_queue: int  # tasks that one worker had at a time


def flow(scheduler: Any, partition: bool, tasks_per_worker: int) -> Flow:
    """Simulate tasks on a cluster.

    Three tasks per two workers are placed at once, then a new task for each ended task.
    """
    workers = len(scheduler.workers) // 2
    rng = random.Random(7)
    durations = [rng.expovariate(1.0) for _ in range(workers * tasks_per_worker)]
    tasks = Tasks(scheduler, partition)
    queues: dict[Any, deque[Any]] = defaultdict(deque)  # {worker: states of its tasks}
    events: list[tuple[float, int, Any]] = []  # heap: end, number of the task, worker
    numbers: dict[Any, int] = {}  # {state of a task: its number}
    waiting: list[Any] = []  # states of tasks without a worker
    end_times: list[float] = []
    longest_queue = 0

    def start_next(worker: Any, time_s: float) -> None:
        if queues[worker]:
            number = numbers[queues[worker][0]]
            heapq.heappush(events, (time_s + durations[number], number, worker))

    def add(count: int, time_s: float) -> None:
        nonlocal longest_queue
        states, _ = tasks.assign(min(count, len(durations) - len(numbers)))
        for state in states:
            numbers[state] = len(numbers)
        waiting.extend(states)
        for state in [state for state in waiting if state.processing_on]:
            waiting.remove(state)
            queue = queues[state.processing_on]
            queue.append(state)
            longest_queue = max(longest_queue, len(queue))
            if len(queue) == 1:
                start_next(state.processing_on, time_s)

    add(workers * 3 // 2, 0.0)
    while events:
        event_time, _, worker = heapq.heappop(events)
        end_times.append(event_time)
        tasks.end([queues[worker].popleft()])
        start_next(worker, event_time)
        add(1, event_time)
    return Flow(sum(end_times) / len(end_times), longest_queue)


async def measure(number: int, rounds: int, tasks_per_worker: int) -> dict[str, Any]:
    """Measure one cluster size, with and without poolpart's rule."""
    figures: dict[str, Any] = {"workers": number}
    for label in ("dask", "poolpart"):
        async with Scheduler(port=0, host="127.0.0.1", dashboard=False) as scheduler:
            enable_features(scheduler, [PARTITION])
            raise_fence(scheduler, PARTITION)
            if label == "dask":
                scheduler.plugins[CHOICE].uninstall()
                scheduler.plugins[SHARES].remove_partition(PARTITION)
            add_workers(scheduler, number)
            for name, partition in (("partition", True), ("others", False)):
                figures[f"{name}_{label}_us"] = cost_us(scheduler, partition, rounds)
                mean_end, longest_queue = flow(scheduler, partition, tasks_per_worker)
                figures[f"{name}_{label}_end"] = mean_end
                figures[f"{name}_{label}_longest"] = longest_queue
            for address in list(scheduler.workers):
                scheduler.workers.pop(address)
                scheduler.stream_comms.pop(address)
            scheduler.running.clear()
    return figures


def main(arguments: list[str] | None = None) -> None:
    """Measure all cluster sizes and print the results."""
    parser = argument_parser(__doc__)
    parser.add_argument("--workers", type=int, nargs="+", default=[40, 4000])
    parser.add_argument("--tasks", type=int, default=400, help="number of tasks to place at a time")
    parser.add_argument(
        "--per-worker", type=int, default=2, help="tasks of random duration per worker"
    )
    options = parser.parse_args(arguments)
    logging.getLogger("distributed").setLevel(logging.ERROR)
    results = []
    for number in options.workers:
        values = asyncio.run(measure(number, options.tasks, options.per_worker))
        results.append(values)
        for name in ("partition", "others"):
            cost, end, queue = (values[f"{name}_poolpart_{key}"] for key in KEYS)
            dask_cost, dask_end, dask_queue = (values[f"{name}_dask_{key}"] for key in KEYS)
            print(
                f"{number:>6} workers, tasks of {name:<9}: {cost:7.0f} µs, Dask {dask_cost:7.0f};"
                f" mean end {end / dask_end:.3f} x Dask's;"
                f" longest queue {queue}, Dask {dask_queue}"
            )
    write_results(options.json, results)


if __name__ == "__main__":
    main()

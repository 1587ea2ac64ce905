"""Decide how many workers each partition of a balanced group should have.

The policy receives a sample of each partition at regular intervals, and returns the workers to move
next. It knows nothing of Dask, so that it can be tested and simulated by values alone.

The *demand* of a partition is the number of slots that its work keeps busy: the number of tasks per
second that arrive or finish, whichever is higher, times the mean running time of a task. If tasks
wait, the demand is higher by up to a quarter, so that the partition catches up. The limit on this
surplus matters in a pipeline, where the first stage often has an endless supply of tasks. A backlog
there must not draw all workers to the first stage, because results would then accumulate in front
of the second one. Since each item passes through both stages, the rates of the stages are equal in
the end, and the workers are divided in proportion to the running times.

Three rules keep workers from being moved back and forth. They are only moved if a partition has
fewer slots than it demands, if the partition that is worst off gains more than the uncertainty of
the measurement, and only a few at a time.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass

MEMORY_TASKS = 6.0  # rates and running times are averaged over this many running times of a task
MIN_MEMORY_S = 1.0  # minimum averaging time
SURPLUS = 0.25  # maximum additional demand of a partition with waiting tasks, as a fraction
CATCH_UP_TASKS = 5.0  # waiting time, in running times of a task, that causes the maximum surplus
MIN_GAIN = 0.03  # minimum relative gain of the partition that is worst off
NOISE = 0.25  # standard deviations of the number of finished tasks that are added to the minimum
STEP = 0.125  # maximum fraction of the group's workers that are being moved at a time


@dataclass(frozen=True)
class LoadSample:
    """State of a partition at one time, with counts since an arbitrary start.

    Parameters
    ----------
    workers
        Number of workers, including those that are being moved into the partition, but without
        those that are being restarted.
    minimum, maximum
        Bounds on the number of workers.
    slots
        Number of slots per worker.
    movable
        Number of workers that may be moved to other partitions.
    finished
        Number of tasks that have finished so far.
    seconds
        Total running time of these tasks in seconds, without the time that they waited for pipes.
    backlog
        Number of unfinished tasks, plus the number of items in the pipes that feed the partition.
    fullness
        Number of items in the fullest pipe that feeds the partition, as a fraction of its capacity.
        Producers wait if it is 1.
    """

    workers: int
    minimum: int = 1
    maximum: float = math.inf
    slots: float = 1.0
    movable: int = 1_000_000
    finished: int = 0
    seconds: float = 0.0
    backlog: float = 0.0
    fullness: float = 0.0


@dataclass(frozen=True)
class Demand:
    """Estimated demand of a partition.

    Parameters
    ----------
    slots
        Number of slots that the partition demands.
    rate
        Number of tasks per second that arrive or finish, whichever is higher.
    task_s
        Mean running time of a task in seconds, or 0 if no task has finished.
    wait_s
        Expected waiting time of a task that arrives now, in seconds.
    """

    slots: float = 0.0
    rate: float = 0.0
    task_s: float = 0.0
    wait_s: float = 0.0


@dataclass(frozen=True)
class WorkerShift:
    """Number of workers to move from one partition to another."""

    source: str
    destination: str
    workers: int


class _Averages:
    """Exponentially weighted totals of a partition."""

    def __init__(self) -> None:
        self.elapsed_s = 0.0
        self.arrived = 0.0
        self.finished = 0.0
        self.seconds = 0.0
        self.task_s = 0.0  # mean running time, which is kept while no tasks finish
        self.pressure = 0.0  # average between 0 (no waiting tasks) and 1 (maximum surplus)
        self.wait_s = 0.0
        self._last: LoadSample | None = None

    def update(self, sample: LoadSample, elapsed_s: float, memory_s: float) -> None:
        """Add a sample that was taken `elapsed_s` seconds after the previous one."""
        last = self._last
        self._last = sample
        if last is None:
            return
        weight = math.exp(-elapsed_s / memory_s)
        finished = max(0, sample.finished - last.finished)
        arrived = max(0.0, finished + sample.backlog - last.backlog)
        self.elapsed_s = weight * self.elapsed_s + elapsed_s
        self.arrived = weight * self.arrived + arrived
        self.finished = weight * self.finished + finished
        self.seconds = weight * self.seconds + max(0.0, sample.seconds - last.seconds)
        if self.finished >= 1.0:
            self.task_s = self.seconds / self.finished
        self._update_pressure(sample, weight)

    def _update_pressure(self, sample: LoadSample, weight: float) -> None:
        """Update the waiting time of tasks, and the pressure that it causes."""
        waiting = max(0.0, sample.backlog - sample.workers * sample.slots)
        self.wait_s = waiting / self.rate if self.rate else 0.0
        ratio = self.wait_s / (CATCH_UP_TASKS * self.task_s) if self.task_s else 0.0
        pressure = min(1.0, max(ratio, sample.fullness))
        # The depth of a small pipe changes more quickly than samples are taken.
        self.pressure = weight * self.pressure + (1.0 - weight) * pressure

    @property
    def rate(self) -> float:
        """Number of tasks per second that arrive or finish, whichever is higher."""
        return max(self.arrived, self.finished) / self.elapsed_s if self.elapsed_s else 0.0

    def demand(self, sample: LoadSample) -> Demand:
        """Estimate the demand of the partition."""
        if not self.task_s:
            # No task has finished yet, so only the number of tasks is known.
            slots = max(sample.workers, 1) * sample.slots
            return Demand(min(sample.backlog, (1.0 + SURPLUS) * slots))
        slots = self.rate * self.task_s * (1.0 + SURPLUS * self.pressure)
        return Demand(slots, self.rate, self.task_s, self.wait_s)


class BalancePolicy:
    """Estimates demands from samples, and decides which workers to move."""

    def __init__(self) -> None:
        self.demands: dict[str, Demand] = {}  # estimates at the last sample, by partition
        self._averages: dict[str, _Averages] = {}
        self._is_moving = False  # whether workers are moved until the target is reached

    def update(
        self, samples: Mapping[str, LoadSample], elapsed_s: float, moving: int = 0
    ) -> list[WorkerShift]:
        """Add samples of all partitions, and return the workers to move now.

        Parameters
        ----------
        samples
            Samples by partition.
        elapsed_s
            Time in seconds since the previous samples.
        moving
            Number of workers that are still finishing the tasks of their former partition.
        """
        self._averages = {name: self._averages.get(name, _Averages()) for name in samples}
        longest_s = max((average.task_s for average in self._averages.values()), default=0.0)
        memory_s = max(MIN_MEMORY_S, MEMORY_TASKS * longest_s)
        for name, sample in samples.items():
            self._averages[name].update(sample, elapsed_s, memory_s)
            self.demands[name] = self._averages[name].demand(sample)
        targets = divide_by_demand(samples, {name: self.demands[name].slots for name in samples})
        self._is_moving = self._is_worth_moving(samples, targets)
        if not self._is_moving:
            return []
        total = sum(sample.workers for sample in samples.values())
        limit = max(1, int(STEP * total)) - moving
        return _shifts(samples, targets, limit)

    def _is_worth_moving(
        self, samples: Mapping[str, LoadSample], targets: Mapping[str, int]
    ) -> bool:
        """Return whether the targets are sufficiently better than the present division."""
        if any(s.workers < min(s.minimum, targets[name]) for name, s in samples.items()):
            return True  # a partition has lost workers
        # Partitions at their maximum cannot gain, and must not hide the gain of others.
        rivals = [name for name, sample in samples.items() if sample.workers < sample.maximum]
        present = min((self._supply(samples[n], samples[n].workers, n) for n in rivals), default=1)
        if present >= 1.0 or all(targets[n] == samples[n].workers for n in samples):
            return False
        future = min(self._supply(samples[name], targets[name], name) for name in rivals)
        if self._is_moving:
            return future > present
        fewest = min(self._averages[name].finished for name in rivals if self.demands[name].slots)
        return future > present * (1.0 + MIN_GAIN + NOISE / math.sqrt(max(1.0, fewest)))

    def _supply(self, sample: LoadSample, workers: int, name: str) -> float:
        """Return the number of slots as a fraction of the demand."""
        demand = self.demands[name].slots
        return workers * sample.slots / demand if demand else math.inf


def divide_by_demand(
    samples: Mapping[str, LoadSample], demands: Mapping[str, float]
) -> dict[str, int]:
    """Divide the workers of a group in proportion to the demands, within the bounds.

    Partitions keep the workers that may not be moved. Workers are assigned one after the other to
    the partition with the fewest slots for its demand. Workers that nobody demands stay.

    Examples
    --------
    >>> samples = {"A": LoadSample(63), "B": LoadSample(63)}
    >>> divide_by_demand(samples, {"A": 17.0, "B": 21.0})
    {'A': 56, 'B': 70}
    """
    targets = {
        name: min(sample.workers, max(sample.minimum, sample.workers - sample.movable))
        for name, sample in samples.items()
    }
    spare = sum(sample.workers for sample in samples.values()) - sum(targets.values())
    for name, sample in samples.items():  # partitions that have lost workers
        added = min(spare, max(0, sample.minimum - targets[name]))
        targets[name] += added
        spare -= added
    queue = [
        (targets[name] * samples[name].slots / demand, name)
        for name, demand in demands.items()
        if demand and targets[name] < samples[name].maximum
    ]
    heapq.heapify(queue)
    while spare and queue:
        _, name = heapq.heappop(queue)
        targets[name] += 1
        spare -= 1
        if targets[name] < samples[name].maximum:
            supply = targets[name] * samples[name].slots / demands[name]
            heapq.heappush(queue, (supply, name))
    for name, sample in samples.items():  # workers that nobody can use
        returned = min(spare, max(0, sample.workers - targets[name]))
        targets[name] += returned
        spare -= returned
    return targets


def _shifts(
    samples: Mapping[str, LoadSample], targets: Mapping[str, int], limit: int
) -> list[WorkerShift]:
    """Return up to `limit` workers to move towards the targets, largest differences first."""
    excess = {name: sample.workers - targets[name] for name, sample in samples.items()}
    shifts = []
    while limit > 0:
        source = max(excess, key=excess.__getitem__)
        destination = min(excess, key=excess.__getitem__)
        workers = min(limit, excess[source], -excess[destination])
        if workers <= 0:
            break
        shifts.append(WorkerShift(source, destination, workers))
        excess[source] -= workers
        excess[destination] += workers
        limit -= workers
    return shifts

"""Simulation of partitions that share workers, to test the policy of balanced groups.

Workers have one slot each. Between the stages of a chain are pipes: a stage whose next pipe is full
keeps its finished items, and their workers wait.
"""

import heapq
import math
from collections import Counter, deque
from itertools import pairwise

from poolpart.balance_policy import BalancePolicy, LoadSample

TICK_S = 0.5


class Stage:
    def __init__(self, name, workers, task_s, capacity=math.inf, supply=None, **bounds):
        self.name = name
        self.workers = workers  # including those that are still busy elsewhere
        self.present = workers  # those that run tasks of this stage
        self.task_s = task_s  # function of the time that returns the running time of a task
        self.capacity = capacity  # of the pipe in front of the stage
        self.supply = supply  # function of the time: items that have arrived, unless chained
        self.bounds = bounds
        self.supplied = 0
        self.depth = 0
        self.busy = 0
        self.blocked = 0  # busy workers that wait for space in the next pipe
        self.leaving = deque()  # destinations of workers that leave after their task
        self.finished = 0
        self.seconds = 0.0

    def sample(self):
        return LoadSample(
            self.workers,
            finished=self.finished,
            seconds=self.seconds,
            backlog=self.depth + self.busy,
            fullness=self.depth / self.capacity,
            **self.bounds,
        )


class Cluster:
    def __init__(self, *stages, chained=True, balanced=True):
        self.stages = {stage.name: stage for stage in stages}
        self.following = {a.name: b for a, b in pairwise(stages)} if chained else {}
        self.policy = BalancePolicy() if balanced else None
        self.time = 0.0
        self.next_tick = TICK_S
        self.running = []  # heap of (end, number, stage, seconds)
        self.number = 0
        self.done = []  # (time, stage) of each item that has left the last stage or its only one
        self.history = []  # (time, workers by stage) at each tick
        self.moved = 0

    def run(self, until):
        while self.time < until:
            self._start_tasks()
            self.time = min(self.next_tick, self.running[0][0] if self.running else math.inf)
            if self.time == self.next_tick:
                self.next_tick += TICK_S
                self._balance()
            else:
                _, _, stage, seconds = heapq.heappop(self.running)
                stage.seconds += seconds
                stage.blocked += 1
        return self

    def throughput(self, start, end):
        return sum(start <= time < end for time, _ in self.done) / (end - start)

    def settled_after(self, start, name, expected):
        """Return the time after `start` from which on the size of a stage is as expected."""
        late = [t for t, sizes in self.history if t >= start and sizes[name] not in expected]
        return max(late, default=start) - start

    def _start_tasks(self):
        for stage in reversed(self.stages.values()):  # the last stage makes space first
            following = self.following.get(stage.name)
            while stage.blocked and (following is None or following.depth < following.capacity):
                stage.blocked -= 1
                stage.busy -= 1
                stage.finished += 1
                if following is None:
                    self.done.append((self.time, stage.name))
                else:
                    following.depth += 1
                    self._fill(following)
                self._let_go(stage)
            if stage.supply is not None:
                arrived = min(
                    stage.supply(self.time) - stage.supplied, stage.capacity - stage.depth
                )
                stage.supplied += arrived
                stage.depth += arrived
        for stage in self.stages.values():
            self._fill(stage)

    def _fill(self, stage):
        while stage.depth >= 1 and stage.busy < stage.present:
            stage.depth -= 1
            stage.busy += 1
            if stage.supply is not None and stage.capacity < math.inf:
                added = min(1, stage.supply(self.time) - stage.supplied)
                stage.supplied += added
                stage.depth += added
            self.number += 1
            seconds = stage.task_s(self.time)
            heapq.heappush(self.running, (self.time + seconds, self.number, stage, seconds))

    def _let_go(self, stage):
        while stage.leaving and (stage.busy < stage.present):
            stage.present -= 1
            stage.leaving.popleft().present += 1

    def _balance(self):
        self.history.append((self.time, {s.name: s.workers for s in self.stages.values()}))
        if self.policy is None:
            return
        samples = {stage.name: stage.sample() for stage in self.stages.values()}
        moving = sum(len(stage.leaving) for stage in self.stages.values())
        for shift in self.policy.update(samples, TICK_S, moving):
            source = self.stages[shift.source]
            destination = self.stages[shift.destination]
            source.workers -= shift.workers
            destination.workers += shift.workers
            source.leaving.extend([destination] * shift.workers)
            self.moved += shift.workers
            self._let_go(source)


def count_by_stage(cluster):
    return Counter(stage for _, stage in cluster.done)

"""A simulated partition, whose slots the share policy divides among simulated clients."""

import heapq
from collections import deque
from dataclasses import dataclass, field

from poolpart.share_policy import SharePolicy, has_room

MESSAGE_S = 0.002  # time that a message between scheduler and worker takes
CHARGE_EVERY_S = 0.5


@dataclass
class User:
    """Client with an endless supply of tasks between `start` and `end`."""

    name: str
    task_s: object  # function that returns the running time of the next task
    weight: float = 1.0
    start: float = 0.0
    end: float = float("inf")
    slots: int = 1
    most: float = float("inf")  # maximum number of unfinished tasks
    prefix: str = "f"
    unfinished: int = 0


@dataclass
class Worker:
    slots: int = 1
    queue: deque = field(default_factory=deque)  # received tasks, in order
    free: int = 0
    used: int = 0  # slots of assigned tasks, as the scheduler knows
    assigned_s: float = 0.0


class SharedPartition:
    def __init__(self, users, workers, slots=1):
        self.users = {user.name: user for user in users}
        self.workers = [Worker(slots, free=slots) for _ in range(workers)]
        self.policy = SharePolicy()
        for user in users:
            self.policy.set_weight(user.name, user.weight)
        self.time = 0.0
        self.events = []  # heap of (time, number, function, arguments)
        self.number = 0
        self.runs = []  # (user, start, end, slots, number of the worker)
        self.longest_s = 0.0
        self.open = set(range(workers))
        self.assigned = {}  # {key: (number of the worker, user)}

    def run(self, until):
        for user in self.users.values():
            self._at(user.start, self._supply, user)
        self._at(CHARGE_EVERY_S, self._charge)
        while self.events and self.events[0][0] <= until:
            self.time, _, function, arguments = heapq.heappop(self.events)
            function(*arguments)
        self.time = until
        return self

    def kill(self, time, worker):
        """At a time, lose all tasks of a worker, which run again."""
        self._at(time, self._lose, worker)

    # -- results -----------------------------------------------------------------------

    def used(self, start, end, user=None):
        """Return the slot time that a user, or everyone, has used in an interval."""
        return sum(
            max(0.0, min(until, end) - max(since, start)) * slots
            for name, since, until, slots, _ in self.runs
            if user in (None, name) and since < end and until > start
        )

    def shares(self, start, end):
        total = self.used(start, end)
        return {name: self.used(start, end, name) / total for name in self.users}

    def busy(self, start, end):
        slots = sum(worker.slots for worker in self.workers)
        return self.used(start, end) / (slots * (end - start))

    def first_start(self, user, after=0.0):
        return min(since for name, since, *_ in self.runs if name == user and since >= after)

    # -- events ------------------------------------------------------------------------

    def _at(self, time, function, *arguments):
        self.number += 1
        heapq.heappush(self.events, (time, self.number, function, arguments))

    def _charge(self):
        self.policy.charge_running(self.time)
        self._at(self.time + CHARGE_EVERY_S, self._charge)

    def _supply(self, user):
        if user.start <= self.time < user.end:
            added = min(50 - self.policy.account(user.name).waiting, user.most - user.unfinished)
            if added > 0:
                self.policy.add_waiting(user.name, self.time, added)
                user.unfinished += added
        elif waiting := self.policy.account(user.name).waiting:  # it cancels them
            self.policy.remove_waiting(user.name, waiting)
            user.unfinished -= waiting
        self._dispatch()

    def _dispatch(self):
        while self.open and (names := self.policy.clients_in_turn()):
            name = names[0]
            number = min(self.open, key=lambda n: self.workers[n].used / self.workers[n].slots)
            user = self.users[name]
            self.number += 1
            key = self.number
            charge = self.policy.start(key, name, user.prefix, user.slots, self.time)
            self.assigned[key] = number, user
            self._assign(number, user.slots, charge.slots * charge.expected_s)
            self._at(self.time + MESSAGE_S, self._receive, number, key, user, charge)

    def _assign(self, number, slots, seconds):
        worker = self.workers[number]
        worker.used += slots
        worker.assigned_s += seconds
        if has_room(worker.slots, worker.used, worker.assigned_s, number in self.open):
            self.open.add(number)
        else:
            self.open.discard(number)

    def _receive(self, number, key, user, charge):
        if key in self.assigned:
            self.workers[number].queue.append((key, user, charge))
            self._begin(number)

    def _begin(self, number):
        worker = self.workers[number]
        while worker.queue and worker.queue[0][1].slots <= worker.free:
            key, user, charge = worker.queue.popleft()
            worker.free -= user.slots
            seconds = user.task_s()
            self.longest_s = max(self.longest_s, seconds)
            self.runs.append((user.name, self.time, self.time + seconds, user.slots, number))
            self._at(self.time + seconds, self._end, number, key, user, charge, seconds)

    def _end(self, number, key, user, charge, seconds):
        if key not in self.assigned:
            return
        self.workers[number].free += user.slots
        self._begin(number)
        self._at(self.time + MESSAGE_S, self._finish, number, key, user, charge, seconds)

    def _lose(self, number):
        """Lose the tasks of a worker, which wait again, and start it again at once."""
        worker = self.workers[number] = Worker(self.workers[number].slots)
        worker.free = worker.slots
        self.open.add(number)
        self.runs = [
            (name, since, min(until, self.time) if on == number else until, slots, on)
            for name, since, until, slots, on in self.runs
        ]
        for key, (on, user) in list(self.assigned.items()):
            if on == number:
                del self.assigned[key]
                self.policy.finish(key, self.time, None, lost=True)
                self.policy.add_waiting(user.name, self.time)
        self._dispatch()

    def _finish(self, number, key, user, charge, seconds):
        if self.assigned.pop(key, None) is None:
            return
        self.policy.finish(key, self.time, seconds)
        user.unfinished -= 1
        self._assign(number, -user.slots, -charge.slots * charge.expected_s)
        self._supply(user)

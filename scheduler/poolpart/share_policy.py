"""Decide whose task runs next, so that the clients of a partition get fair shares of its slots.

The policy knows clients, weights and running times, but does not depend on Dask, so that it can be
tested and simulated with plain values. It only chooses a client. The order of a client's own tasks
is up to the caller.

The algorithm is start-time fair queueing. Each client has a *tag*: the slot time in seconds that
its tasks have used, divided by its weight. The waiting client with the lowest tag is next, and its
tag increases by the expected time of the task. Expected times are learned from earlier tasks of the
same client and prefix. As they may be wrong, the tag is corrected when the task ends, and while a
task runs longer than expected. A task that occupies several slots counts several times, and a task
that has lent its slots does not count meanwhile.

A client without tasks does not save up credit: when it has tasks again, its tag is raised to the
lowest tag of the clients that wait, without the time that their running tasks are expected to use
from now on. A client that is new, or that returns, therefore gets the next free slot, and its share
of the slot time from then on.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

UNKNOWN_S = 0.5  # expected running time of a task if the client has not finished a similar one
LEARNING = 0.3  # weight of the latest running time in the moving average
RECENT_S = 60.0  # shares and waiting times are averaged over about this time
DECAY_EVERY_S = 1.0  # interval between updates of these averages
LEAD_S = 0.2  # a worker receives tasks in advance for up to this time per slot
MAX_LEAD_TASKS = 64  # maximum number of tasks that it receives in advance, per slot


def has_room(slots: float, used: float, assigned_s: float, had_room: bool = False) -> bool:
    """Return whether a worker should receive another task now.

    A worker with a free slot should. If its tasks are short, a worker also receives tasks in
    advance, so that its slots do not wait for the next task. Long tasks are not assigned in
    advance, because the client whose turn it is when a slot becomes free should get this slot.

    Parameters
    ----------
    slots, used
        Number of slots of the worker, and number of slots that its assigned tasks request.
    assigned_s
        Expected slot time of the tasks that are assigned to the worker, in seconds.
    had_room
        Whether the worker had room before. Otherwise, it has room again when half of the tasks that
        it received in advance have ended. Several tasks in one message are cheaper.

    Examples
    --------
    >>> has_room(slots=1, used=0, assigned_s=0.0)
    True
    >>> [has_room(slots=1, used=1, assigned_s=seconds) for seconds in (0.05, 10.0)]
    [True, False]
    """
    if used < slots:
        return True
    lead = slots if had_room else 0.5 * slots
    return assigned_s < LEAD_S * lead and used < slots + MAX_LEAD_TASKS * lead


@dataclass(slots=True)
class StartedTask:
    """Task that was assigned to a worker, and what its client was charged for it."""

    client: str
    prefix: str
    slots: float
    expected_s: float  # expected running time in seconds
    since: float  # time when the task was assigned, or when it got its lent slots back
    charged_s: float  # running time that the client was charged for
    earlier_s: float = 0.0  # running time before the latest loan of its slots
    is_lent: bool = False  # whether the task has lent its slots


@dataclass(slots=True)
class ClientAccount:
    """Slot time that a client has used, and the time that it is charged."""

    weight: float = 1.0
    tag: float = 0.0
    waiting: int = 0  # number of tasks that wait for a slot
    started: int = 0  # number of tasks that are assigned to workers
    slots: float = 0.0  # number of slots that these tasks take, without lent slots
    # Sums over these tasks, multiplied by their slots, without tasks that have lent their slots:
    charged_s: float = 0.0  # charge for the present run
    since: float = 0.0  # start of the present run
    seconds: float = 0.0  # total slot time used, in seconds
    started_tasks: int = 0  # total number of tasks that were assigned to workers
    waited_s: float = 0.0  # total time that these tasks waited, in seconds
    durations: dict[str, float] = field(default_factory=dict)  # {prefix: mean running time}
    recent_s: float = 0.0  # slot time in the recent past, which decays
    recent_at: float = 0.0  # time of the last change of `recent_s`
    recent_wait_s: float = 0.0  # mean waiting time of recent tasks

    @property
    def is_active(self) -> bool:
        """Whether the client has tasks that wait or run."""
        return bool(self.waiting or self.started)

    def ahead(self, now: float) -> float:
        """Return the part of the tag that running tasks are expected to use from now on."""
        used_s = self.slots * now - self.since
        return max(0.0, self.charged_s - used_s) / self.weight

    def recent_at_time(self, now: float) -> float:
        """Return the slot time that the client has used recently, in seconds."""
        return self.recent_s * math.exp(-max(0.0, now - self.recent_at) / RECENT_S)


class SharePolicy:
    """Accounts of the clients of a partition.

    Times are in seconds since an arbitrary start.

    Examples
    --------
    >>> policy = SharePolicy()
    >>> policy.set_weight("alice", 3)
    >>> for client in ("alice", "bob"):
    ...     policy.add_waiting(client, now=0.0, tasks=100)
    >>> for number in range(8):
    ...     _ = policy.start(number, policy.clients_in_turn()[0], "f", slots=1, now=0.0)
    >>> policy.accounts["alice"].slots, policy.accounts["bob"].slots
    (6.0, 2.0)
    """

    def __init__(self) -> None:
        self.accounts: dict[str, ClientAccount] = {}
        self._weights: dict[str, float] = {}
        self._tasks: dict[Any, StartedTask] = {}  # assigned tasks, by key
        self._floor = 0.0  # highest tag at the time when no client was active

    # -- clients -----------------------------------------------------------------------

    def set_weight(self, client: str, weight: float) -> None:
        """Set the weight of a client, also if it has no tasks yet. It is 1 by default."""
        self._weights[client] = weight
        if client in self.accounts:
            self.accounts[client].weight = weight

    def account(self, client: str) -> ClientAccount:
        """Return the account of a client, which is created if necessary."""
        account = self.accounts.get(client)
        if account is None:
            account = self.accounts[client] = ClientAccount(self._weights.get(client, 1.0))
        return account

    def remove_idle(self, present: Collection[str], now: float) -> None:
        """Remove idle clients that have disconnected and whose tag no longer delays them."""
        lowest = self._virtual_time(now)
        for client, account in list(self.accounts.items()):
            if client not in present and not account.is_active and account.tag <= lowest:
                del self.accounts[client]

    def clients_in_turn(self) -> list[str]:
        """Return the clients with waiting tasks, in the order in which they are next."""
        waiting = [client for client, account in self.accounts.items() if account.waiting]
        if len(waiting) > 1:
            waiting.sort(key=lambda client: self.accounts[client].tag)
        return waiting

    def fair_slots(self, client: str, slots: float) -> float:
        """Return how many of the slots a client would get now if all active clients wait."""
        weights = {name: a.weight for name, a in self.accounts.items() if a.is_active}
        weights[client] = self._weights.get(client, 1.0)
        return slots * weights[client] / sum(weights.values())

    def share(self, client: str, now: float) -> float:
        """Return the fraction of the recently used slot time that a client has used."""
        total = sum(account.recent_at_time(now) for account in self.accounts.values())
        return self.accounts[client].recent_at_time(now) / total if total else 0.0

    def seconds_of(self, client: str, prefix: str) -> float:
        """Return the expected running time of a client's tasks with a key prefix, in seconds."""
        return self.accounts[client].durations.get(prefix, UNKNOWN_S)

    # -- tasks -------------------------------------------------------------------------

    def add_waiting(self, client: str, now: float, tasks: int = 1) -> None:
        """Record that tasks of a client wait for a slot."""
        account = self.account(client)
        if not account.waiting:
            account.tag = max(account.tag, self._virtual_time(now) + account.ahead(now))
        account.waiting += tasks

    def remove_waiting(self, client: str, tasks: int = 1) -> None:
        """Record that tasks of a client no longer wait, for example because they were canceled."""
        self.accounts[client].waiting -= tasks
        self._update_floor()

    def start(
        self,
        key: Any,
        client: str,
        prefix: str,
        slots: float,
        now: float,
        waited_s: float = 0.0,
        passed_over: Collection[str] = (),
    ) -> StartedTask:
        """Charge a client for a waiting task that is assigned to a worker, and return the charge.

        Parameters
        ----------
        key, client, prefix, slots
            Key of the task, its client, its key prefix, and the number of slots that it requests.
        now
            Present time.
        waited_s
            Time in seconds that the task has waited for a slot.
        passed_over
            Clients whose turn it was, but whose tasks could not use a free slot. They do not save
            up credit either.
        """
        account = self.account(client)
        for other in passed_over:
            self.accounts[other].tag = max(self.accounts[other].tag, account.tag)
        account.waiting -= 1
        account.started += 1
        account.started_tasks += 1
        account.waited_s += waited_s
        account.recent_wait_s += LEARNING * (waited_s - account.recent_wait_s)
        expected_s = self.seconds_of(client, prefix)
        task = StartedTask(client, prefix, slots, expected_s, now, expected_s)
        account.tag += slots * expected_s / account.weight
        self._add_run(account, task, 1)
        self._tasks[key] = task
        return task

    def finish(
        self, key: Any, now: float, seconds: float | None, *, lost: bool = False
    ) -> StartedTask | None:
        """Correct the charge for a task that has ended, and return the former charge, if any.

        Parameters
        ----------
        key, now
            Key of the task and present time.
        seconds
            Measured running time in seconds. None if the task was lost or canceled. In this case,
            its client is charged for the time since the task was assigned.
        lost
            Whether the task was lost with its worker. In this case, its client is charged for at
            most the expected time, also if the worker did not respond for longer.
        """
        task = self._tasks.pop(key, None)
        if task is None:
            return None
        account = self.accounts[task.client]
        lent = task.is_lent or task.earlier_s
        if not task.is_lent:
            self._add_run(account, task, -1)
        if seconds is None or lent:
            used_s = task.earlier_s + (0.0 if task.is_lent else now - task.since)
            if lost:
                used_s = min(used_s, task.expected_s)
        else:
            used_s = seconds
        self._charge(account, task, used_s)
        account.started -= 1
        if not account.started:  # avoids the accumulation of rounding errors
            account.slots = account.charged_s = account.since = 0.0
        used = task.slots * used_s
        account.seconds += used
        if now - account.recent_at > DECAY_EVERY_S:
            account.recent_s = account.recent_at_time(now)
            account.recent_at = now
        account.recent_s += used
        if seconds is not None:
            known_s = account.durations.get(task.prefix, used_s)
            account.durations[task.prefix] = known_s + LEARNING * (used_s - known_s)
        if not account.is_active:
            self._update_floor()
        return task

    def lend(self, key: Any, now: float) -> None:
        """Stop charging for a task that lends its slots."""
        task = self._tasks.get(key)
        if task is not None and not task.is_lent:
            account = self.accounts[task.client]
            self._add_run(account, task, -1)
            task.earlier_s += now - task.since
            task.is_lent = True
            self._charge(account, task, task.earlier_s)

    def take_back(self, key: Any, now: float) -> None:
        """Charge again for a task that has its slots back."""
        task = self._tasks.get(key)
        if task is not None and task.is_lent:
            task.since = now
            task.is_lent = False
            self._add_run(self.accounts[task.client], task, 1)

    def charge_running(self, now: float) -> None:
        """Charge clients for tasks that have been running longer than expected."""
        for task in self._tasks.values():
            if not task.is_lent:
                used_s = task.earlier_s + now - task.since
                if used_s > task.charged_s:
                    account = self.accounts[task.client]
                    self._add_run(account, task, -1)
                    self._charge(account, task, used_s)
                    self._add_run(account, task, 1)

    @staticmethod
    def _charge(account: ClientAccount, task: StartedTask, used_s: float) -> None:
        """Charge a client for the given running time of a task, instead of the former charge."""
        account.tag += task.slots * (used_s - task.charged_s) / account.weight
        task.charged_s = used_s

    @staticmethod
    def _add_run(account: ClientAccount, task: StartedTask, sign: int) -> None:
        """Add the present run of a task to the sums of its client, or subtract it."""
        slots = sign * task.slots
        account.slots += slots
        account.charged_s += slots * (task.charged_s - task.earlier_s)
        account.since += slots * task.since

    # -- virtual time ------------------------------------------------------------------

    def _virtual_time(self, now: float) -> float:
        """Return the tag that a client without tasks has at least when it has tasks again."""
        accounts = self.accounts.values()
        waiting = [a.tag - a.ahead(now) for a in accounts if a.waiting]
        if waiting:
            return min(waiting)
        return min((a.tag - a.ahead(now) for a in accounts if a.started), default=self._floor)

    def _update_floor(self) -> None:
        """When no client is active anymore, all of them start with the same tag later."""
        if not any(account.is_active for account in self.accounts.values()):
            self._floor = max((a.tag for a in self.accounts.values()), default=self._floor)

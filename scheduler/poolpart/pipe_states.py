"""The scheduler's side of pipes, each of which consists of a Dask Queue and a Dask Variable.

The Queue contains the items. The Variable is the only copy of the pipe's state. A client that sets
it to ``{**state, "closed": True}`` closes the pipe. Other clients can put, get and inspect items
with Dask's own classes.

Pipes use special requests, because those of Dask lack three things. `Queue.get` does not know its
client, so an item is lost if the client that waits for it is killed. A queue cannot be closed.
State and items cannot be requested together. A special request only waits for the pipes that it
names, and only takes items if its client is still connected.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from collections import defaultdict, deque
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .accepted_items import AcceptedItems
from .errors import PipeClosed, PipeFailed
from .internals.queues import (
    BoundedQueue,
    QueueAndVariable,
    Waiters,
    intercept_variable_set,
    wait_until,
)
from .internals.scheduler import handlers_of
from .stats import NAME as STATISTICS
from .stats import partition_of

logger = logging.getLogger(__name__)

NAME = "poolpart-pipes"
CHANGE, PUT, TAKE = (f"poolpart_pipes_{name}" for name in ("change", "put", "take"))

Reply = dict[str, Any]  # state of a pipe, and the answer to a request
Replies = dict[str, Reply]  # replies by pipe, for pipes that exist

USES_PIPES = "poolpart-pipes"  # annotation of tasks with the names of their pipes
_UNFINISHED = ("waiting", "queued", "no-worker", "processing")  # states of unfinished tasks
_ENDED = ("memory", "erred", "forgotten")  # states of tasks that have ended
MAX_KEPT = 1000  # maximum number of forgotten tasks whose items are still recognized
_SETTABLE = ("closed", "failure", "advice")  # fields that any client may set


class PipeState:
    """State and queue of a pipe, on the scheduler.

    The value of the Variable, which all clients can read, is a dict with these fields:

    ==========  ========================================================================
    owner       ID of the client that created the pipe, which ends with this client
    capacity    maximum number of queued items
    producers   number of producers, each of which has to close the pipe
    closed_by   producers that have closed the pipe: keys of their tasks, or random IDs
    closed      whether the pipe is closed and accepts no more items
    failure     reason why the pipe has failed, or ""
    advice      number of records that the consumer recommends to bundle in an item
    ==========  ========================================================================
    """

    def __init__(
        self,
        scheduler: Any,
        name: str,
        owner: str,
        capacity: int,
        producers: int,
        drop_repeats: bool,
    ) -> None:
        self.name = name
        self.owner = owner  # constant, and still available if a client deletes the Variable
        self.putters: set[Any] = set()  # keys of the tasks that have put items
        self.takers: set[Any] = set()  # keys of the tasks that have requested items
        self.drops_repeats = drop_repeats
        self.accepted: dict[Any, AcceptedItems] = {}  # {task key: items of the task}
        self.consumers: set[str] = set()  # partitions that process the items
        self.queue = BoundedQueue(capacity, self.put_error, self.get_error)
        value = {
            "owner": owner,
            "capacity": capacity,
            "producers": producers,
            "closed_by": (),
            "closed": False,
            "failure": "",
            "advice": 1,
        }
        self._dask = QueueAndVariable(scheduler, name, self.queue, value)
        self.put = self._dask.put
        self.pop_items = self._dask.pop_items
        self.delete = self._dask.delete
        self.wake_early_readers = self._dask.wake_early_readers

    @property
    def value(self) -> dict[str, Any]:
        """Current value of the Variable, which contains the state."""
        value: dict[str, Any] = self._dask.value
        return value

    @property
    def exists(self) -> bool:
        """Whether the Queue and the Variable both exist. Clients can delete either of them."""
        return self._dask.exists

    @property
    def has_ended(self) -> bool:
        """Whether the pipe was closed, was deleted, or has failed."""
        return not self.exists or self.value["closed"] or bool(self.value["failure"])

    def get_error(self) -> PipeFailed | None:
        """Return the error that `get` would raise now, or None."""
        if not self.exists:
            return PipeFailed(f"Pipe {self.name!r} does not exist. It was deleted.")
        reason = self.value["failure"]
        return PipeFailed(reason) if reason else None

    def put_error(self) -> PipeFailed | PipeClosed | None:
        """Return the error that `put` would raise now, or None."""
        if (error := self.get_error()) is not None:
            return error
        return PipeClosed(f"Pipe {self.name!r} is closed.") if self.value["closed"] else None

    @property
    def summary(self) -> tuple[int, int, str]:
        """Number of items, capacity, and a description of the state."""
        end = self.put_error()
        words = "closed" if isinstance(end, PipeClosed) else f"failed: {end}" if end else "open"
        return self.queue.qsize(), self.queue.capacity, words

    def change(self, **changes: Any) -> None:
        """Change fields of the Variable's value."""
        self._dask.set({**self.value, **changes})

    def close(self, producer: str) -> None:
        """Close the pipe on behalf of a producer.

        The pipe is closed once all producers have closed it.
        """
        closed_by = tuple(dict.fromkeys((*self.value["closed_by"], producer)))
        closed = self.value["closed"] or len(closed_by) >= self.value["producers"]
        self.change(closed_by=closed_by, closed=closed)

    def fail(self, reason: str) -> None:
        """Make the pipe fail.

        If it has already failed, the first reason is kept, because later failures are consequences
        of it.
        """
        self.change(failure=self.value["failure"] or reason)

    def check(self, value: Any) -> None:
        """Raise ValueError if a client may not set the Variable to the given value."""
        if not self.exists:
            raise ValueError(f"Variable {self.name!r} belonged to a pipe that was deleted.")
        if doubt := self._invalid_reason(value):
            raise ValueError(
                f"Variable {self.name!r} holds the state of a pipe, and {doubt}. The current state "
                f"is {self.value}. Get the value with `Variable.get`, and only change `closed`, "
                "`failure` and `advice`."
            )

    def _invalid_reason(self, value: Any) -> str:
        """Return why a client may not set the Variable to the given value, or "" if it may."""
        state = self.value
        if not isinstance(value, dict) or value.keys() != state.keys():
            return f"the value {value!r} has different fields"
        for name, setting in value.items():
            current = state[name]
            if name == "closed_by" and isinstance(setting, list | tuple):
                # Lists from other processes arrive as tuples, unlike lists from this process.
                setting = tuple(setting)
                current = tuple(current)
            if type(setting) is not type(current):
                return f"`{name}` cannot be {setting!r}"
            if name not in _SETTABLE and setting != current:
                return f"`{name}` cannot be changed to {setting!r}"
        if state["closed"] and not value["closed"]:
            return "a closed pipe cannot be opened again"
        if state["failure"] and value["failure"] != state["failure"]:
            return "the reason for a failure cannot be changed"
        return "" if value["advice"] >= 1 else f"`advice` must be at least 1, not {value['advice']}"


def pipes_of(scheduler: Any) -> dict[str, PipeState]:
    """Return the states of all pipes by name."""
    return scheduler.plugins[NAME].states if NAME in scheduler.plugins else {}


def names_of_pipes(dask_scheduler: Any = None) -> list[str]:
    """Return the names of all pipes. Runs on the scheduler."""
    return list(pipes_of(dask_scheduler))


def describe_pipe(name: str, dask_scheduler: Any = None) -> str:
    """Describe a pipe's state and its number of items. Runs on the scheduler."""
    pipe = pipes_of(dask_scheduler).get(name)
    if pipe is None:
        return "does not exist"
    depth, capacity, state = pipe.summary
    return f"{depth} of {capacity} items, {state}"


def feeding_pipes(scheduler: Any, partition: str) -> list[PipeState]:
    """Return the existing pipes whose items are processed by a partition."""
    pipes = pipes_of(scheduler).values()
    return [state for state in pipes if partition in state.consumers and state.exists]


async def create_pipe(
    name: str,
    owner: str,
    capacity: int,
    producers: int,
    drop_repeats: bool = True,
    dask_scheduler: Any = None,
) -> bool:
    """Create a pipe, or return False if the name is already in use. Runs on the scheduler."""
    # The last request of a killed owner may arrive after the owner was removed. Nobody would delete
    # its pipe or receive the reply.
    if QueueAndVariable.is_used(dask_scheduler, name) or owner not in dask_scheduler.clients:
        return False
    if NAME not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(PipeRegistry(dask_scheduler))
    state = PipeState(dask_scheduler, name, owner, capacity, producers, drop_repeats)
    pipes_of(dask_scheduler)[name] = state
    await state.wake_early_readers()
    return True


def reply_without_pipes(**_: Any) -> Replies:
    """Reply to any client request while there are no pipes."""
    return {}


def install_pipe_handlers(dask_scheduler: Any = None) -> None:
    """Install handlers for pipe requests, even if there are no pipes. Runs on the scheduler.

    For a request without a handler, Dask would log a traceback, in addition to the error of the
    client.
    """
    for handler in (CHANGE, PUT, TAKE):
        handlers_of(dask_scheduler).setdefault(handler, reply_without_pipes)


def fail_pipes_of_killed_task(
    scheduler: Any, key: Any, annotations: Mapping[str, Any] | None
) -> None:
    """Make a canceled task's pipes fail after its worker was restarted."""
    if NAME in scheduler.plugins:
        scheduler.plugins[NAME].fail_for_killed(key, (annotations or {}).get(USES_PIPES, ()))


def delete_existing_pipes(names: Collection[str], dask_scheduler: Any = None) -> None:
    """Delete those named pipes that exist. Runs on the scheduler."""
    if NAME in dask_scheduler.plugins:
        dask_scheduler.plugins[NAME].delete(names)


class PipeRegistry(SchedulerPlugin):
    """Scheduler plugin with the states of all pipes. It is removed after the last pipe."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.states: dict[str, PipeState] = {}
        # {task key: requests that wait for the end of the task}
        self._awaited: defaultdict[Any, Waiters] = defaultdict(Waiters)
        # Keys of unfinished tasks with pipes that were released from their worker or the queue.
        # Dask either runs such a task again or forgets it.
        self._released: set[Any] = set()
        self._kept: deque[Any] = deque()  # keys of forgotten tasks whose items are still known
        handlers = handlers_of(scheduler)
        handlers.update({CHANGE: self.change, PUT: self.put, TAKE: self.pop_items})
        self._end_interception = intercept_variable_set(handlers, self._check, self._notify)

    # -- hooks of the scheduler --------------------------------------------------------

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Delete the pipes that belong to a client that has left."""
        self.delete([name for name, state in self.states.items() if state.owner == client])

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Notify requests that wait for the end of a task, and fail the pipes of lost tasks."""
        # Polling every 5 ms used 2 % of a core on the scheduler of a run.
        if finish in _ENDED and key in self._awaited:
            self._awaited[key].notify()
        if finish == "released" and start == "processing":
            for accepted in self._all_accepted_items(key):
                accepted.may_still_run = True
        elif finish == "forgotten":
            self._forget_accepted_items(key)
        task = self.scheduler.tasks[key]
        if task.annotations and (names := task.annotations.get(USES_PIPES)):
            self._fail_if_lost(task, names, start, finish)

    def _all_accepted_items(self, key: Any) -> list[AcceptedItems]:
        """Return what each pipe has accepted from a task."""
        return [s.accepted[key] for s in self.states.values() if key in s.accepted]

    def _forget_accepted_items(self, key: Any) -> None:
        """Forget the items of a task that the scheduler has forgotten.

        If the task may still run on a worker, its items are kept for a while.
        """
        forgotten = self._all_accepted_items(key)
        for accepted in forgotten:
            accepted.is_forgotten = True
        if any(accepted.may_still_run for accepted in forgotten):
            self._kept.append(key)
            if len(self._kept) <= MAX_KEPT:
                return
            key = self._kept.popleft()
        for state in self.states.values():
            if key in state.accepted and state.accepted[key].is_forgotten:
                del state.accepted[key]

    def _fail_if_lost(self, task: Any, names: Sequence[str], start: str, finish: str) -> None:
        """Make a task's pipes fail if the task is lost."""
        # Otherwise, the tasks at the other end of the pipe would wait until the pipe is deleted.
        if finish == "erred":
            blamed = task.exception_blame or task
            error = blamed.exception_text or "the workers that ran the task died"
            self._fail_soon(names, f"Task {task.key!r}, which uses the pipe, failed: {error}.")
        elif finish == "forgotten" and task.key in self._released:
            reason = (
                f"Task {task.key!r}, which uses the pipe, was canceled before it had used the "
                "pipe. Dask also cancels a task if no reference to its future is kept."
            )
            self._fail_soon(names, reason, cancelled=task.key)
        if finish == "released" and start in _UNFINISHED:
            self._released.add(task.key)
        else:
            self._released.discard(task.key)

    def _fail_soon(self, names: Sequence[str], reason: str, cancelled: Any = None) -> None:
        """Fail those pipes that are still open after the current step of the event loop.

        `cancelled` is the key of a canceled task. If this task has already used a pipe, the pipe
        does not fail, because the task is running and can continue to use the pipe. Dask does not
        stop functions.
        """

        def fail() -> None:
            for state in self._existing(names).values():
                if not state.has_ended and cancelled not in state.putters | state.takers:
                    state.fail(reason)

        # The call is deferred, because `Scheduler.restart` and the removal of a client cancel the
        # tasks before they call `restart` and `remove_client`, which know the actual reason.
        asyncio.get_running_loop().call_soon(fail)

    def fail_for_killed(self, key: Any, names: Sequence[str]) -> None:
        """Make a canceled task's open pipes fail after its worker was restarted."""
        for state in self._existing(names).values():
            # If a consumer is lost, other consumers can continue, so the pipe does not fail.
            if not state.has_ended and key not in state.takers:
                state.fail(
                    f"Task {key!r}, which uses the pipe, was canceled, and its worker "
                    "was restarted."
                )

    def restart(self, scheduler: Any) -> None:
        """Make all open pipes fail, because `Client.restart` has ended the tasks that used them."""
        # Dask does not reset queues and variables in a restart. Without this method, `get`, `put`,
        # `for_each` and listeners would wait until the pipe is deleted, whereas futures and maps
        # raise a CancelledError immediately.
        self._released.clear()
        for state in self.states.values():
            if not state.has_ended:
                state.fail(
                    "The cluster was restarted by Client.restart, which ends all tasks. Create the "
                    "pipe again, and submit the tasks again."
                )

    def delete(self, names: Collection[str]) -> None:
        """Delete those named pipes that exist, and remove the plugin after the last pipe."""
        for name in self.states.keys() & set(names):
            self.states.pop(name).delete()
        if not self.states:
            self.scheduler.remove_plugin(NAME)
            self._end_interception()
            # Clients that have used pipes may still send requests.
            handlers_of(self.scheduler).update(
                dict.fromkeys((CHANGE, PUT, TAKE), reply_without_pipes)
            )

    def _check(self, name: str, value: Any) -> None:
        """Raise ValueError if a client sets the Variable of a pipe to an invalid value."""
        if (state := self.states.get(name)) is not None:
            state.check(value)

    def _notify(self, name: str) -> None:
        """Notify waiting requests after a client has set a Variable."""
        if (state := self.states.get(name)) is not None:
            state.queue.waiters.notify()

    # -- requests ----------------------------------------------------------------------

    def change(
        self,
        names: Sequence[str],
        client_id: str,
        producer: str = "",
        failure: str = "",
        advice: int = 0,
    ) -> Replies:
        """Close pipes on behalf of a producer, make pipes fail, or set the advice.

        The answer is the number of queued items.
        """
        states = self._existing(names)
        for state in states.values():
            if producer:
                state.close(producer)
            if failure:
                state.fail(failure)
            if advice:
                state.change(advice=advice)
        return self._replies(states, lambda state: state.queue.qsize())

    def put(
        self,
        names: Sequence[str],
        client_id: str,
        items: list[bytes],
        unbounded: bool,
        seconds: float,
        task: Any = None,
        run: float = 0.0,
    ) -> Replies | Awaitable[Replies]:
        """Put items into a pipe once it has space for at least one of them.

        The answer is the number of items that were put, including items that were dropped because
        an earlier run of the task has put them. If there is space, the reply is returned directly,
        because Dask would create a task for a coroutine, which takes longer than the request
        itself.

        Parameters
        ----------
        names
            Name of the pipe.
        client_id
            ID of the client. Items of a client that has left are not put.
        items
            Pickled items.
        unbounded
            Whether to ignore the capacity.
        seconds
            Maximum wait.
        task
            Key of the requesting task, or None outside tasks.
        run
            Time when this run of the task started, or 0 outside tasks.
        """

        def put_into(state: PipeState) -> int:
            if client_id not in self.scheduler.clients:
                return 0
            accepted = self._accepted_items(state, task, run)
            dropped = 0 if accepted is None else accepted.skip_repeats(run, items)
            if state.has_ended:
                return dropped
            end = None if unbounded else dropped + state.queue.free_capacity
            fitting = items[dropped:end]
            state.put(fitting)
            if accepted is not None and fitting and not accepted.append(run, fitting):
                logger.warning(
                    "Task %r runs again, and sends items to pipe %r that differ from those of its "
                    "previous run. Some of its items may arrive twice.",
                    task,
                    state.name,
                )
            return dropped + len(fitting)

        def can_proceed(state: PipeState) -> bool:
            if unbounded or state.has_ended or state.queue.free_capacity:
                return True
            accepted = self._accepted_items(state, task, run)
            return accepted is not None and accepted.count_repeats(run, items) > 0

        def ready() -> bool:
            return all(can_proceed(state) for state in states.values())

        async def later() -> Replies:
            began_at = time.monotonic()
            await wait_until(ready, [state.queue.waiters for state in states.values()], seconds)
            self._add_wait(task, began_at)
            return self._replies(states, put_into)

        states = self._existing(names)
        for state in states.values():
            state.putters |= {task} - {None}
        return self._replies(states, put_into) if ready() else later()

    def _accepted_items(self, state: PipeState, task: Any, run: float) -> AcceptedItems | None:
        """Return the items that a pipe has accepted from a task, or None if they are not recorded.

        A task that takes items from any pipe receives different items when it runs again, so all
        of its items are accepted.
        """
        if not state.drops_repeats:
            return None
        is_known = task in self.scheduler.tasks
        accepted = state.accepted.get(task)
        if is_known and (accepted is None or accepted.is_forgotten):
            # A task with the key of a forgotten task is a different task.
            accepted = state.accepted[task] = AcceptedItems()
        if accepted is None:
            return None
        runs_again = accepted.count > 0 and accepted.starts(run)
        if runs_again and any(task in other.takers for other in self.states.values()):
            accepted.accept_all(run)
        return accepted

    async def pop_items(
        self,
        names: Sequence[str],
        client_id: str,
        seconds: float,
        *,
        linger_s: float = 0.0,
        keys: Sequence[str] = (),
        puts: Mapping[str, list[bytes]] | None = None,
        limit: int = sys.maxsize,
        task: Any = None,
        partition: str = "",
    ) -> Replies:
        """Take items from pipes, after waiting for an item or for the end of a pipe or task.

        Parameters
        ----------
        names
            Pipes to take from.
        client_id
            ID of the client. A client that has left receives no items.
        seconds
            Maximum wait.
        linger_s
            Maximum wait for further items after the first one, within `seconds`.
        keys
            Tasks whose end also ends the wait.
        puts
            Items by pipe, which are put before the wait regardless of the capacity of the pipe.
        limit
            Number of items to take from each pipe. If it is 0, the request waits for the end of a
            pipe or a task.
        task
            Key of the requesting task, or None outside tasks.
        partition
            Partition whose tasks will process the items. By default, that of the requesting task.
        """
        for name, items in (puts or {}).items():
            self.put([name], client_id, items, unbounded=True, seconds=0.0)

        def has_items(state: PipeState) -> bool:
            return limit > 0 and not state.queue.empty()

        def has_news() -> bool:
            awaited = (self.scheduler.tasks.get(key) for key in keys)
            return (
                len(states) < len(names)
                or any(has_items(state) or state.has_ended for state in states.values())
                or any(found is None or found.state in _ENDED for found in awaited)
            )

        def is_full_or_ended() -> bool:
            return any(
                state.has_ended or not state.queue.free_capacity for state in states.values()
            )

        def take_from(state: PipeState) -> list[Any]:
            return state.pop_items(limit) if client_id in self.scheduler.clients else []

        states = self._states_for_taker(task, partition, names)
        began_at = time.monotonic()
        pipe_waiters = [state.queue.waiters for state in states.values()]
        try:
            task_waiters = [self._awaited[key] for key in keys]
            await wait_until(has_news, pipe_waiters + task_waiters, seconds)
        finally:
            for key in keys:
                if not self._awaited[key]:
                    del self._awaited[key]
        if linger_s:
            await wait_until(is_full_or_ended, pipe_waiters, min(linger_s, seconds))
        self._add_wait(task, began_at)
        return self._replies(states, take_from)

    def _states_for_taker(
        self, task: Any, partition: str, names: Sequence[str]
    ) -> dict[str, PipeState]:
        """Return the states of the named pipes that exist, and record who takes items."""
        states = self._existing(names)
        if not partition and task is not None and (found := self.scheduler.tasks.get(task)):
            partition = partition_of(found)
        for state in states.values():
            state.takers |= {task} - {None}
            state.consumers |= {partition} - {""}
        return states

    def _add_wait(self, task: Any, began_at: float) -> None:
        """Add the time since `began_at` to the statistics of the waiting task."""
        statistics = self.scheduler.plugins.get(STATISTICS)
        if statistics is not None and task is not None:
            statistics.add_pipe_wait(task, time.monotonic() - began_at)

    def _existing(self, names: Sequence[str]) -> dict[str, PipeState]:
        states = {name: self.states[name] for name in names if name in self.states}
        return {name: state for name, state in states.items() if state.exists}

    def _replies(self, states: dict[str, PipeState], answer: Callable[[PipeState], Any]) -> Replies:
        """Return a reply that contains `answer(state)` for each pipe that still exists."""
        replies: Replies = {}
        for name, state in states.items():
            if state.exists:
                value = state.value
                replies[name] = {part: value[part] for part in _SETTABLE}
                replies[name]["answer"] = answer(state)
        return replies

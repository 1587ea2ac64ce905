"""Create a value, such as a model, once in each worker process for the tasks of a stage.

A stage is a call of `Partition.map` or `Partition.for_each`. Each of its tasks carries the setup
function. The first task of the stage in a process calls the function, and the process keeps the
value until the scheduler announces the end of the stage. The client reports this end. If a client
disconnects, all of its stages end. In plain Dask, the result of a task could be shared in a similar
way, but the scheduler drops copies of results on workers that do not need them at the moment.

If Dask pauses a worker because of its memory usage, values that no task is using are released. The
worker could not release them later, because a paused worker does not start tasks.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
import logging
import threading
import uuid
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakSet

from dask.utils import funcname
from distributed import Client, Status, get_worker
from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PoolError
from .internals.scheduler import call_worker
from .workers import run_on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-setups"
SETUP_COUNTS = "The running time of a task includes the time for calling `setup`."
WATCH_S = 0.5  # interval between checks whether a worker is paused
MOST_ENDED = 1000  # maximum number of ended stages that a process remembers


@dataclass(frozen=True)
class StageSetup:
    """Function that creates the value of a stage, and a unique ID of the stage."""

    function: Callable[[], Any]
    stage_id: str = field(default_factory=lambda: uuid.uuid4().hex)

    @classmethod
    def from_user_value(cls, function: Callable[[], Any] | None) -> StageSetup | None:
        """Return the setup for a new stage, or None if there is no setup function.

        Raises
        ------
        PoolError
            If the function is not callable, or is a coroutine function.
        """
        if function is None:
            return None
        if not callable(function) or inspect.iscoroutinefunction(function):
            raise PoolError(
                f"Invalid value {function!r} for `setup`. Expected a plain function without "
                "arguments, such as `setup=load_model`."
            )
        return cls(function)

    def begin(self, client: Client) -> None:
        """Register the stage, so that its values are released if the client disconnects.

        Raises
        ------
        PoolError
            If poolpart is not installed in the scheduler's environment, or if the client is closed.
        """
        run_on_scheduler(client, _begin_stage, stage_id=self.stage_id, client_id=client.id)

    def end(self, client: Client) -> None:
        """Let all workers release the value, without waiting for them."""

        async def send() -> None:
            with suppress(OSError, RuntimeError):  # the client is closing, which ends its stages
                await client.run_on_scheduler(_end_stage, stage_id=self.stage_id)

        if client.status == "running":
            with suppress(RuntimeError):  # its event loop was closed
                client.loop.add_callback(send)

    @contextmanager
    def value(self) -> Iterator[Any]:
        """Provide this process's value within the block, and create it if necessary."""
        with _values.use(self) as value:
            yield value


class FunctionWithSetup:
    """Function whose first argument is the value of its stage."""

    def __init__(self, function: Callable[..., Any], setup: StageSetup) -> None:
        self.function = function
        self.setup = setup
        self.__name__ = funcname(function)  # Dask derives the keys of tasks from it

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function with the value of the stage, followed by the arguments."""
        with self.setup.value() as value:
            return self.function(value, *args, **kwargs)


# -- worker processes --------------------------------------------------------------------


class _Value:
    """Value of a stage in this process."""

    def __init__(self) -> None:
        self.lock = threading.Lock()  # held while the value is being created
        self.is_created = False
        self.value: Any = None
        self.users = 0  # number of tasks that are using the value or waiting for it
        self.workers: WeakSet[Any] = WeakSet()  # a process can contain several workers

    def is_on_paused_worker(self) -> bool:
        return any(worker.status == Status.paused for worker in self.workers)

    def create(self, setup: StageSetup) -> Any:
        """Return the value, which the first caller creates while the others wait."""
        with self.lock:
            if not self.is_created:
                try:
                    self.value = setup.function()
                except Exception as error:
                    error.add_note(
                        f"The error occurred in the setup function {funcname(setup.function)!r} on "
                        f"worker {get_worker().name}."
                    )
                    raise
                self.is_created = True
            return self.value


class _Values:
    """Values of all stages in this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: dict[str, _Value] = {}  # by stage ID
        self._ended: dict[str, None] = {}  # IDs of ended stages, oldest first
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    @contextmanager
    def use(self, setup: StageSetup) -> Iterator[Any]:
        """Provide the value of a stage within the block.

        Raises
        ------
        PoolError
            If the stage has ended. The task was canceled, but Dask has started it nevertheless.
        """
        with self._lock:
            if setup.stage_id in self._ended:
                raise PoolError("The `map` or `for_each` call of this task has ended.")
            value = self._values.setdefault(setup.stage_id, _Value())
            value.users += 1
            value.workers.add(get_worker())
            if self._thread is None:
                self._thread = threading.Thread(target=self._watch, name=NAME, daemon=True)
                self._thread.start()
        try:
            yield value.create(setup)
        finally:
            with self._lock:
                value.users -= 1

    def end(self, stage_ids: Collection[str]) -> None:
        """Release the values of stages that have ended, once their running tasks have ended.

        The values are released in another thread, because their finalizers may take a while.
        """
        with self._lock:
            self._ended |= dict.fromkeys(stage_ids)
            for oldest in [*self._ended][:-MOST_ENDED]:
                del self._ended[oldest]
            self._wake.set()

    def _watch(self) -> None:
        """Release values until none is left."""
        while True:
            self._wake.wait(WATCH_S)
            with self._lock:
                self._wake.clear()
                idle = [stage_id for stage_id, value in self._values.items() if not value.users]
                ended = [stage_id for stage_id in idle if stage_id in self._ended]
                paused = [
                    stage_id
                    for stage_id in idle
                    if stage_id not in self._ended and self._values[stage_id].is_on_paused_worker()
                ]
                released = [self._values.pop(stage_id) for stage_id in ended + paused]
                if not self._values:
                    self._thread = None
            if paused:
                logger.warning(
                    "The worker is paused because of its memory usage, so the values of %d setup "
                    "functions were released. The next task of a stage creates its value again.",
                    len(paused),
                )
            if released:
                released.clear()
                gc.collect()  # models often contain reference cycles
            if self._thread is not threading.current_thread():
                return


_values = _Values()


def _end_on_worker(stage_ids: Collection[str]) -> Callable[..., None]:
    """Return a function that ends stages on a worker, even if poolpart is not installed there."""

    def end(dask_worker: Any = None) -> None:
        with suppress(ImportError):
            from poolpart.setups import _values

            _values.end(stage_ids)

    return end


# -- scheduler ---------------------------------------------------------------------------


class StageRegistry(SchedulerPlugin):
    """Scheduler plugin that knows the stages with setup functions. It is removed after the last."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.stages: defaultdict[str, set[str]] = defaultdict(set)  # {client ID: stage IDs}
        self._requests: set[asyncio.Task[None]] = set()

    def remove_client(self, scheduler: Any, client: str) -> None:
        """End all stages of a client that has left."""
        self.end(self.stages.pop(client, set()))

    def end(self, stage_ids: Collection[str]) -> None:
        """Let all workers release the values of stages. Workers that do not respond are ignored."""
        if stage_ids:
            # The requests are independent, so that a stopped worker does not delay the others.
            for address in self.scheduler.workers:
                request = asyncio.ensure_future(self._end_on(address, stage_ids))
                self._requests.add(request)
                request.add_done_callback(self._requests.discard)
        for client in [client for client, stages in self.stages.items() if not stages]:
            del self.stages[client]
        if not self.stages:
            self.scheduler.remove_plugin(NAME)

    async def _end_on(self, address: str, stage_ids: Collection[str]) -> None:
        with suppress(OSError, RuntimeError):
            await call_worker(self.scheduler, address, _end_on_worker(stage_ids))


def _begin_stage(stage_id: str, client_id: str, dask_scheduler: Any = None) -> None:
    # The last request of a client that was killed may arrive after the client was removed.
    if client_id in dask_scheduler.clients:
        if NAME not in dask_scheduler.plugins:
            dask_scheduler.add_plugin(StageRegistry(dask_scheduler))
        dask_scheduler.plugins[NAME].stages[client_id].add(stage_id)


def _end_stage(stage_id: str, dask_scheduler: Any = None) -> None:
    registry: StageRegistry | None = dask_scheduler.plugins.get(NAME)
    if registry is None:  # the client has left
        return
    for stages in registry.stages.values():
        stages.discard(stage_id)
    registry.end([stage_id])

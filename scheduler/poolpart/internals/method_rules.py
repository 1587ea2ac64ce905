"""Rules before, after and in place of methods of a scheduler, since its plugins only observe."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterable
from typing import Any

import distributed

from ..errors import PoolError
from .scheduler import SUBMITTER, Resources, Submitter, actor_of_method

logger = logging.getLogger(__name__)

# Plugins of the scheduler only observe. An attribute of the instance hides the class's method
# until it is deleted.

After = Callable[..., Any]  # gets the method's result and its arguments; returns the result
Before = Callable[[dict[str, Any]], dict[str, Any]]  # gets the keyword arguments; returns them
Instead = Callable[..., Any]  # gets the method's arguments; NotImplemented: the method is called


class _Method:
    """Replacement of a method: the method itself, with rules before, after and in place of it.

    A rule that raises is skipped, and the log says so once: other users of the cluster get what
    Dask does without it. An error of the method itself reaches its caller unchanged.
    """

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original
        self.__name__ = original.__name__  # the server logs the name of the handler
        self.before: list[Before] = []
        self.instead: list[Instead] = []
        self.after: list[After] = []
        self._said: set[Any] = set()  # rules whose failure has been logged

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        for before in self.before:
            try:
                kwargs = before(kwargs)
            except Exception:
                self._step_aside(before)
        for instead in self.instead:
            try:
                result = instead(*args, **kwargs)
            except Exception:
                self._step_aside(instead)
                continue
            if result is not NotImplemented:
                return result
        result = self.original(*args, **kwargs)
        for after in self.after:
            try:
                result = after(result, *args, **kwargs)
            except Exception:
                self._step_aside(after)
        return result

    def _step_aside(self, rule: Any) -> None:
        if rule not in self._said:
            self._said.add(rule)
            logger.exception(
                "A rule of poolpart for %s failed with distributed %s, so Dask decides without "
                "it: tasks may run outside their partition, or others in it.",
                self.__name__,
                distributed.__version__,
            )


class Rules:
    """Rules for methods of a running scheduler; several may have rules for one method."""

    def __init__(self) -> None:
        self._places: list[tuple[Any, str, Any]] = []

    def after(self, owner: Any, name: str, rule: After, parameter: str) -> None:
        """Call `rule(result, …)` with a method's result and arguments; it returns a result.

        `parameter` is the name of the method's only parameter. PoolError if this version of Dask
        has no such method; then all rules are removed.
        """
        self._stand_in(owner, name, {parameter}).after.append(rule)
        self._places.append((owner, name, rule))

    def before(self, owner: Any, name: str, rule: Before, *parameters: str) -> None:
        """Call `rule(keywords)` before a method; it returns the keywords to use."""
        self._stand_in(owner, name, {*parameters}).before.append(rule)
        self._places.append((owner, name, rule))

    def instead(self, owner: Any, name: str, rule: Instead, parameter: str) -> None:
        """Call `rule(…)` in place of a method, unless it returns NotImplemented."""
        self._stand_in(owner, name, {parameter}).instead.append(rule)
        self._places.append((owner, name, rule))

    def _stand_in(self, owner: Any, name: str, parameters: set[str]) -> _Method:
        method = getattr(type(owner), name, None)
        if method is None or not parameters <= inspect.signature(method).parameters.keys():
            self.take_back()
            raise PoolError(
                f"{type(owner).__name__} of distributed {distributed.__version__} has no "
                f"{name}({', '.join(sorted(parameters))}), which poolpart needs: use a version "
                "that it asks for."
            )
        stand_in = vars(owner).get(name)
        if not isinstance(stand_in, _Method):
            stand_in = _Method(getattr(owner, name))
            setattr(owner, name, stand_in)
        return stand_in

    def take_back(self) -> None:
        """Remove these rules."""
        while self._places:
            owner, name, rule = self._places.pop()
            method = vars(owner)[name]
            for rules in (method.before, method.instead, method.after):
                rules[:] = [other for other in rules if other != rule]
            if not (method.before or method.instead or method.after):
                delattr(owner, name)


def rule_for_graphs(rules: Rules, scheduler: Any, bequeath: Callable[[Any], Resources]) -> None:
    """Give tasks resources that their graph leaves open, by the task that submits the graph.

    `bequeath` returns them, from the state of the submitting task. Each task is annotated with the
    task that submits it, so that workers know which tasks wait for slots of their parents.
    """

    def before(graph: dict[str, Any]) -> dict[str, Any]:
        name = graph["submitting_task"]
        task = scheduler.tasks.get(name) or actor_of_method(scheduler, name)
        inherited = bequeath(task) if task is not None else {}
        if not inherited:
            return graph
        address = task.processing_on.address if task.processing_on else ""  # not of an actor
        submitter = Submitter(task.key, address)
        global_annotations = graph["global_annotations"] or {}
        by_type = graph["annotations_by_type"]  # {"workers": {key: …}, "resources": …}
        by_type = {**by_type, SUBMITTER: dict.fromkeys(graph["dsk"], submitter)}
        if "resources" not in global_annotations and "workers" not in global_annotations:
            stated = by_type.get("resources", {})
            restricted = stated.keys() | by_type.get("workers", {}).keys()
            heirs = {key: inherited for key in graph["dsk"] if key not in restricted}
            by_type["resources"] = {**stated, **heirs}
        return {**graph, "annotations_by_type": by_type}

    rules.before(
        scheduler,
        "_create_taskstate_from_graph",
        before,
        *("submitting_task", "annotations_by_type", "global_annotations", "dsk"),
    )


def rule_for_shuffles(rules: Rules, scheduler: Any) -> None:
    """Let shuffles and rechunks choose permitted workers for their output.

    Dask pins each output to any worker of the cluster, even if the tasks ask for a resource that
    the worker lacks; they would wait for ever.
    """
    if not (shuffle := scheduler.extensions.get("shuffle")):
        return

    def after(chosen: dict[Any, str], spec: Any) -> dict[Any, str]:
        from distributed.shuffle._core import barrier_key  # not where poolpart is imported

        valid = scheduler.valid_workers(scheduler.tasks[barrier_key(spec.id)])
        if not valid:  # any worker, or none
            return chosen
        allowed = sorted(worker.address for worker in valid)
        start = hash(spec.id)  # so that many small shuffles do not all use the first worker
        return {
            output: worker if worker in allowed else allowed[(start + number) % len(allowed)]
            for number, (output, worker) in enumerate(chosen.items())
        }

    rules.after(shuffle, "_calculate_worker_for", after, "spec")


def rule_for_fences(
    rules: Rules, scheduler: Any, closed: set[Any], stop: Callable[[Any], bool]
) -> None:
    """Keep tasks away from workers behind a fence.

    `closed` are the states of those workers, read each time; `stop` says whether a task has to stay
    out. PoolError if this version of Dask places tasks in another way.
    """
    if not isinstance(getattr(scheduler, "idle_task_count", None), set):
        raise PoolError(
            f"The scheduler of distributed {distributed.__version__} keeps no set of idle "
            "workers, which fences need: use a version that poolpart asks for."
        )

    def valid_workers(valid: Any, task: Any) -> Any:
        if not stop(task):
            return valid
        remainder = scheduler.running - closed
        if valid is None:
            return remainder
        allowed = valid - closed
        # Loose restrictions; without this Dask would then take any worker.
        return allowed or (remainder if task.loose_restrictions else allowed)

    def rootish(worker: Any, task: Any) -> Any:
        return (
            scheduler.decide_worker_non_rootish(task) if worker in closed and stop(task) else worker
        )

    rules.after(scheduler, "valid_workers", valid_workers, "ts")
    rules.after(scheduler, "decide_worker_rootish_queuing_disabled", rootish, "ts")
    scheduler.idle_task_count = _OpenWorkers(closed, scheduler.idle_task_count)


def rule_for_choice(rules: Rules, scheduler: Any, choose: Callable[[Any], Any]) -> None:
    """Let `choose` choose the workers of tasks, as far as it does not return NotImplemented.

    PoolError if this version of Dask places tasks in another way.
    """
    rules.instead(scheduler, "decide_worker_non_rootish", choose, "ts")


def take_back_fences(rules: Rules, scheduler: Any) -> None:
    """Remove that rule from the scheduler."""
    rules.take_back()
    scheduler.idle_task_count = set(scheduler.idle_task_count)


def could_take(scheduler: Any, task: Any) -> Any:
    """Workers that Dask itself would let take a task."""
    valid = type(scheduler).valid_workers(scheduler, task)
    return scheduler.running if valid is None else valid


class _OpenWorkers(set[Any]):
    """Workers with room for tasks from the queue, without those behind fences."""

    def __init__(self, closed: set[Any], workers: Iterable[Any]) -> None:
        super().__init__(workers)
        self.difference_update(closed)
        self._closed = closed

    def add(self, worker: Any) -> None:
        if worker not in self._closed:
            super().add(worker)

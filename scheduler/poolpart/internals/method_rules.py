"""Rules before, after and in place of methods of a scheduler, since its plugins only observe."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterable
from typing import Any

import distributed

from ..errors import PoolError
from .scheduler import SUBMITTER, Resources, SubmittingTask, actor_of_method

logger = logging.getLogger(__name__)

# Plugins of the scheduler only observe. An attribute of the instance hides the class's method
# until it is deleted.

After = Callable[..., Any]  # gets the method's result and its arguments; returns the result
Before = Callable[[dict[str, Any]], dict[str, Any]]  # gets the keyword arguments; returns them
Instead = Callable[..., Any]  # gets the method's arguments; NotImplemented: the method is called


class _Method:
    """Replacement of a method: the original, with rules before, after and in place of a call.

    A rule that raises is skipped, and the log says so once: other users of the cluster get what
    Dask does without it. An error of the method itself reaches its caller unchanged, and so does a
    PoolError of a rule before the call: the rule refuses the call.
    """

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original
        self.__name__ = original.__name__  # the server logs the name of the handler
        self.rules_before: list[Before] = []
        self.rules_instead: list[Instead] = []
        self.rules_after: list[After] = []
        self._logged: set[Any] = set()  # rules whose failure has been logged

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        for rule_before in self.rules_before:
            try:
                kwargs = rule_before(kwargs)
            except PoolError:
                raise
            except Exception:
                self._log_failure(rule_before)
        for rule_instead in self.rules_instead:
            try:
                result = rule_instead(*args, **kwargs)
            except Exception:
                self._log_failure(rule_instead)
                continue
            if result is not NotImplemented:
                return result
        result = self.original(*args, **kwargs)
        for rule_after in self.rules_after:
            try:
                result = rule_after(result, *args, **kwargs)
            except Exception:
                self._log_failure(rule_after)
        return result

    def _log_failure(self, rule: Any) -> None:
        """Log the exception of a rule, at its first failure."""
        if rule not in self._logged:
            self._logged.add(rule)
            logger.exception(
                "The poolpart rule for %s failed with distributed %s and is ignored. Tasks may run "
                "outside their partition, and other tasks may run inside it.",
                self.__name__,
                distributed.__version__,
            )


class MethodRules:
    """Rules for methods of a running scheduler.

    Several objects may have rules for a method.
    """

    def __init__(self) -> None:
        self._added: list[tuple[Any, str, Any]] = []  # (object, name of its method, rule)

    def call_after(self, owner: Any, name: str, rule: After, parameter: str) -> None:
        """Call `rule(result, …)` after a method, with its result and arguments, for a new result.

        `parameter` is the name of the method's only parameter. PoolError if this version of Dask
        has no such method; then all rules are removed.
        """
        self._stand_in(owner, name, {parameter}).rules_after.append(rule)
        self._added.append((owner, name, rule))

    def call_before(self, owner: Any, name: str, rule: Before, *parameters: str) -> None:
        """Call `rule(keywords)` before a method, for the keyword arguments to use."""
        self._stand_in(owner, name, {*parameters}).rules_before.append(rule)
        self._added.append((owner, name, rule))

    def call_instead(self, owner: Any, name: str, rule: Instead, parameter: str) -> None:
        """Call `rule(…)` in place of a method.

        If that is NotImplemented, the method runs.
        """
        self._stand_in(owner, name, {parameter}).rules_instead.append(rule)
        self._added.append((owner, name, rule))

    def _stand_in(self, owner: Any, name: str, parameters: set[str]) -> _Method:
        method = getattr(type(owner), name, None)
        if method is None or not parameters <= inspect.signature(method).parameters.keys():
            self.remove_all()
            raise PoolError(
                f"{type(owner).__name__} in distributed {distributed.__version__} has no method "
                f"{name}({', '.join(sorted(parameters))}), which poolpart requires. Install a "
                "version of distributed that poolpart supports."
            )
        stand_in = vars(owner).get(name)
        if not isinstance(stand_in, _Method):
            stand_in = _Method(getattr(owner, name))
            setattr(owner, name, stand_in)
        return stand_in

    def remove_all(self) -> None:
        """Remove these rules."""
        while self._added:
            owner, name, rule = self._added.pop()
            method = vars(owner)[name]
            for rules in (method.rules_before, method.rules_instead, method.rules_after):
                if rule in rules:
                    rules.remove(rule)
            if not (method.rules_before or method.rules_instead or method.rules_after):
                delattr(owner, name)


def add_graph_rule(
    rules: MethodRules, scheduler: Any, bequeath: Callable[[Any], Resources]
) -> None:
    """Give the tasks of a graph that a task submits the resources that the graph leaves open.

    `bequeath` returns these resources for the state of the submitting task. Each task is annotated
    with the task that submits it, so that workers know which tasks wait for slots of their parents.
    """

    def add_annotations(graph: dict[str, Any]) -> dict[str, Any]:
        name = graph["submitting_task"]
        task = scheduler.tasks.get(name) or actor_of_method(scheduler, name)
        inherited = bequeath(task) if task is not None else {}
        if not inherited:
            return graph
        address = task.processing_on.address if task.processing_on else ""  # not of an actor
        submitter = SubmittingTask(task.key, address)
        global_annotations = graph["global_annotations"] or {}
        by_type = graph["annotations_by_type"]  # {"workers": {key: …}, "resources": …}
        by_type = {**by_type, SUBMITTER: dict.fromkeys(graph["dsk"], submitter)}
        if "resources" not in global_annotations and "workers" not in global_annotations:
            stated = by_type.get("resources", {})
            restricted = stated.keys() | by_type.get("workers", {}).keys()
            heirs = {key: inherited for key in graph["dsk"] if key not in restricted}
            by_type["resources"] = {**stated, **heirs}
        return {**graph, "annotations_by_type": by_type}

    rules.call_before(
        scheduler,
        "_create_taskstate_from_graph",
        add_annotations,
        *("submitting_task", "annotations_by_type", "global_annotations", "dsk"),
    )


def add_arrival_rule(rules: MethodRules, scheduler: Any, check: Before) -> None:
    """Call `check` with the arguments of each graph that arrives, so that its PoolError refuses it.

    The client then gets the error from each of the graph's futures.
    """
    rules.call_before(
        scheduler,
        "_create_taskstate_from_graph",
        check,
        *("client", "annotations_by_type", "global_annotations"),
    )


def add_shuffle_rule(rules: MethodRules, scheduler: Any) -> None:
    """Let shuffles and rechunks choose permitted workers for their output.

    Dask pins each output to any worker of the cluster, even if the tasks ask for a resource that
    the worker lacks; they would wait for ever.
    """
    if not (shuffle := scheduler.extensions.get("shuffle")):
        return

    def move_outputs(chosen: dict[Any, str], spec: Any) -> dict[Any, str]:
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

    rules.call_after(shuffle, "_calculate_worker_for", move_outputs, "spec")


def add_fence_rules(
    rules: MethodRules, scheduler: Any, closed: set[Any], stop: Callable[[Any], bool]
) -> None:
    """Keep tasks away from workers behind a fence.

    `closed` are the states of those workers, read each time; `stop` says whether a task has to stay
    out. PoolError if this version of Dask places tasks in another way.
    """
    if not isinstance(getattr(scheduler, "idle_task_count", None), set):
        raise PoolError(
            f"The scheduler of distributed {distributed.__version__} has no set of idle workers, "
            "which exclusive partitions require. Install a version of distributed that poolpart "
            "supports."
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

    rules.call_after(scheduler, "valid_workers", valid_workers, "ts")
    rules.call_after(scheduler, "decide_worker_rootish_queuing_disabled", rootish, "ts")
    scheduler.idle_task_count = _OpenWorkers(closed, scheduler.idle_task_count)


def add_choice_rule(rules: MethodRules, scheduler: Any, choose: Callable[[Any], Any]) -> None:
    """Let `choose` choose the workers of tasks, unless `choose` returns NotImplemented.

    PoolError if this version of Dask places tasks in another way.
    """
    rules.call_instead(scheduler, "decide_worker_non_rootish", choose, "ts")


def add_failed_fetch_rule(
    rules: MethodRules, scheduler: Any, report: Callable[[Any, str], None]
) -> None:
    """Call `report(task, address)` if a worker could not fetch a result that another worker has."""

    def look(key: Any, worker: str, **message: Any) -> Any:
        task = scheduler.tasks.get(key)
        holders = [h.address for h in task.who_has or ()] if task is not None else []
        if holders and worker not in holders:
            report(task, worker)
        return NotImplemented  # Dask ignores the message

    rules.call_instead(scheduler, "stimulus_task_erred", look, "key")


def remove_fence_rules(rules: MethodRules, scheduler: Any) -> None:
    """Remove the rule for fences from the scheduler."""
    rules.remove_all()
    scheduler.idle_task_count = set(scheduler.idle_task_count)


def workers_without_fences(scheduler: Any, task: Any) -> Any:
    """Return the workers that could take a task if there were no fences."""
    valid = type(scheduler).valid_workers(scheduler, task)
    return scheduler.running if valid is None else valid


class _OpenWorkers(set[Any]):
    """Workers outside fences that have room for tasks from the queue."""

    def __init__(self, closed: set[Any], workers: Iterable[Any]) -> None:
        super().__init__(workers)
        self.difference_update(closed)
        self._closed = closed

    def add(self, worker: Any) -> None:
        if worker not in self._closed:
            super().add(worker)

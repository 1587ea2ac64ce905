"""Rules that a running scheduler applies before, after, or instead of its own methods.

They are required because scheduler plugins can only observe. A rule is installed as an attribute of
the scheduler instance, which hides the method of the class until the attribute is deleted.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Collection, Iterable
from typing import Any

import distributed

from ..errors import PoolError
from .scheduler import (
    SUBMITTER,
    Resources,
    SubmittingTask,
    actor_of_method,
    is_bound,
    requires_any,
    reschedule_tasks,
)

logger = logging.getLogger(__name__)

After = Callable[..., Any]  # receives the method's result and arguments, and returns a result
Before = Callable[[dict[str, Any]], dict[str, Any]]  # receives and returns keyword arguments
Instead = Callable[..., Any]  # receives the arguments; NotImplemented means to call the method


class _Method:
    """Replacement for a method. It applies rules before, after, or instead of the original.

    If a rule raises an exception, the rule is skipped and the first such exception is logged, so
    that other users of the cluster get Dask's own behavior. Errors of the original method reach the
    caller unchanged, and so does a PoolError that a rule raises before the call in order to reject
    it.
    """

    def __init__(self, original: Callable[..., Any]) -> None:
        self.original = original
        self.__name__ = original.__name__  # appears in the server's log
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
        """Log a rule's exception when the rule fails for the first time."""
        if rule not in self._logged:
            self._logged.add(rule)
            logger.exception(
                "The poolpart rule for %s failed with distributed %s and is ignored. Tasks may run "
                "outside their partition, and other tasks may run inside it.",
                self.__name__,
                distributed.__version__,
            )


class MethodRules:
    """Set of rules for the methods of a running scheduler.

    Several sets can have rules for the same method.
    """

    def __init__(self) -> None:
        self._added: list[tuple[Any, str, Any]] = []  # (object, method name, rule)

    def call_after(self, owner: Any, name: str, rule: After, parameter: str) -> None:
        """Call `rule(result, …)` after a method, and return the result of the rule instead.

        `parameter` is the name of a parameter that the method must have.

        Raises
        ------
        PoolError
            If this version of Dask has no such method. All rules of this set are removed first.
        """
        self._stand_in(owner, name, {parameter}).rules_after.append(rule)
        self._added.append((owner, name, rule))

    def call_before(self, owner: Any, name: str, rule: Before, *parameters: str) -> None:
        """Call `rule(keywords)` before a method, and pass the returned keywords to the method.

        `parameters` are the names of parameters that the method must have. This method raises the
        same error as `call_after`.
        """
        self._stand_in(owner, name, {*parameters}).rules_before.append(rule)
        self._added.append((owner, name, rule))

    def call_instead(self, owner: Any, name: str, rule: Instead, parameter: str) -> None:
        """Call `rule(…)` instead of a method, unless the rule returns NotImplemented.

        `parameter` is the name of a parameter that the method must have. This method raises the
        same error as `call_after`.
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
        """Remove all rules in this set, and restore methods without other rules."""
        while self._added:
            owner, name, rule = self._added.pop()
            method = vars(owner)[name]
            for rules in (method.rules_before, method.rules_instead, method.rules_after):
                if rule in rules:
                    rules.remove(rule)
            if not (method.rules_before or method.rules_instead or method.rules_after):
                delattr(owner, name)


def add_graph_rule(
    rules: MethodRules, scheduler: Any, inherited_resources: Callable[[Any], Resources]
) -> None:
    """Make nested tasks inherit resources from the task that submits them.

    `inherited_resources` returns these resources for the state of the submitting task. Tasks that
    specify resources, or workers that do not declare them, inherit nothing. Each nested task is
    also annotated with its submitting task, so that workers can recognize tasks that wait for the
    slots of their parents.
    """

    def declare_all(workers: Any, resources: Resources) -> bool:
        """Return whether the workers, which a user has specified, declare the resources."""
        listed = workers if isinstance(workers, list | tuple | set) else [workers]
        addresses = {scheduler.aliases.get(worker, worker) for worker in listed}
        return all(addresses <= scheduler.resources.get(name, {}).keys() for name in resources)

    def add_annotations(graph: dict[str, Any]) -> dict[str, Any]:
        name = graph["submitting_task"]
        task = scheduler.tasks.get(name) or actor_of_method(scheduler, name)
        inherited = inherited_resources(task) if task is not None else {}
        if not inherited:
            return graph
        address = task.processing_on.address if task.processing_on else ""  # "" for actors
        submitter = SubmittingTask(task.key, address)
        global_annotations = graph["global_annotations"] or {}
        by_type = graph["annotations_by_type"]  # {"workers": {key: …}, "resources": …}
        by_type = {**by_type, SUBMITTER: dict.fromkeys(graph["dsk"], submitter)}
        if "resources" not in global_annotations and (
            "workers" not in global_annotations
            or declare_all(global_annotations["workers"], inherited)
        ):
            stated = by_type.get("resources", {})
            bound = by_type.get("workers", {}).items()
            elsewhere = {key for key, workers in bound if not declare_all(workers, inherited)}
            heirs = dict.fromkeys(graph["dsk"].keys() - stated.keys() - elsewhere, inherited)
            by_type["resources"] = {**stated, **heirs}
        return {**graph, "annotations_by_type": by_type}

    rules.call_before(
        scheduler,
        "_create_taskstate_from_graph",
        add_annotations,
        *("submitting_task", "annotations_by_type", "global_annotations", "dsk"),
    )


def add_existing_task_rule(rules: MethodRules, scheduler: Any, partitions: Collection[str]) -> None:
    """Apply the annotations of an arriving graph to its existing tasks that have not started.

    Dask only applies them to new tasks. Therefore, an intermediate result that has been released,
    and that the graph needs again, would be computed where an earlier graph has placed it.

    Released tasks are treated like new tasks. Tasks that wait to run for another computation are
    only changed if the graph assigns them to one of the partitions, which may change later, and if
    they are not bound to workers. Nothing else is changed, so that graphs without a partition
    behave as in plain Dask.
    """

    def apply_annotations(graph: dict[str, Any]) -> dict[str, Any]:
        found = [scheduler.tasks[key] for key in graph["dsk"] if key in scheduler.tasks]
        idle = [task for task in found if task.state in _NOT_STARTED and not _in_shuffle(task)]
        annotations = {name: graph[name] for name in ("annotations_by_type", "global_annotations")}
        changed = [task for task in idle if is_changed(task, **annotations)]
        for task in changed:
            task.resource_restrictions = task.worker_restrictions = task.host_restrictions = None
            task.loose_restrictions = False
            task.annotations = None
        if changed:
            scheduler._apply_annotations(changed, **annotations)
            reschedule_tasks(scheduler, [t for t in changed if t.state in ("queued", "no-worker")])
        return graph

    def is_changed(
        task: Any, annotations_by_type: dict[str, Any], global_annotations: dict[str, Any] | None
    ) -> bool:
        resources = (global_annotations or {}).get("resources")
        resources = annotations_by_type.get("resources", {}).get(task.key, resources)
        if callable(resources):
            resources = resources(task.key)
        if not set(resources or ()).isdisjoint(partitions):
            return task.state == "released" or not is_bound(task)
        return task.state == "released" and requires_any(task, partitions)

    rules.call_before(
        scheduler,
        "_create_taskstate_from_graph",
        apply_annotations,
        *("annotations_by_type", "global_annotations", "dsk"),
    )


_NOT_STARTED = frozenset({"released", "waiting", "queued", "no-worker"})


def _in_shuffle(task: Any) -> bool:
    """Return whether a running shuffle has bound a task to a worker."""
    return "shuffle_original_restrictions" in (task.annotations or {})


def add_arrival_rule(rules: MethodRules, scheduler: Any, check: Before) -> None:
    """Call `check` for each arriving graph, which it may change or reject.

    If `check` raises a PoolError, all futures of the graph raise this error.
    """
    rules.call_before(
        scheduler,
        "_create_taskstate_from_graph",
        check,
        *("client", "annotations_by_type", "global_annotations"),
    )


def add_shuffle_rule(rules: MethodRules, scheduler: Any) -> None:
    """Make shuffles and rechunks place their outputs on permitted workers.

    Dask assigns each output to any worker of the cluster, even if its task requests a resource that
    the worker does not have. Such a task would wait forever.
    """
    if not (shuffle := scheduler.extensions.get("shuffle")):
        return

    def move_outputs(chosen: dict[Any, str], spec: Any) -> dict[Any, str]:
        from distributed.shuffle._core import barrier_key  # imported late to save time

        valid = scheduler.valid_workers(scheduler.tasks[barrier_key(spec.id)])
        if not valid:  # None if any worker is valid, empty if no worker is
            return chosen
        allowed = sorted(worker.address for worker in valid)
        start = hash(spec.id)  # distributes small shuffles over the workers
        return {
            output: worker if worker in allowed else allowed[(start + number) % len(allowed)]
            for number, (output, worker) in enumerate(chosen.items())
        }

    rules.call_after(shuffle, "_calculate_worker_for", move_outputs, "spec")


def add_fence_rules(
    rules: MethodRules, scheduler: Any, enclosed: set[Any], keeps_out: Callable[[Any], bool]
) -> None:
    """Keep tasks off workers within a fence.

    `enclosed` contains the states of these workers, and may change later. `keeps_out` returns
    whether a task is not allowed on them.

    Raises
    ------
    PoolError
        If this version of Dask lacks the required private API.
    """
    if not isinstance(getattr(scheduler, "idle_task_count", None), set):
        raise PoolError(
            f"The scheduler of distributed {distributed.__version__} has no set of idle workers, "
            "which exclusive partitions require. Install a version of distributed that poolpart "
            "supports."
        )

    def valid_workers(valid: Any, task: Any) -> Any:
        if not keeps_out(task):
            return valid
        remainder = scheduler.running - enclosed
        if valid is None:
            return remainder
        allowed = valid - enclosed
        # With loose restrictions, Dask would use any worker if this set were empty.
        return allowed or (remainder if task.loose_restrictions else allowed)

    def rootish(worker: Any, task: Any) -> Any:
        if worker in enclosed and keeps_out(task):
            return scheduler.decide_worker_non_rootish(task)
        return worker

    rules.call_after(scheduler, "valid_workers", valid_workers, "ts")
    rules.call_after(scheduler, "decide_worker_rootish_queuing_disabled", rootish, "ts")
    scheduler.idle_task_count = _OpenWorkers(enclosed, scheduler.idle_task_count)


def add_choice_rule(rules: MethodRules, scheduler: Any, choose: Callable[[Any], Any]) -> None:
    """Let `choose` select a worker for each task, unless it returns NotImplemented.

    Raises
    ------
    PoolError
        If this version of Dask lacks the required private API.
    """
    rules.call_instead(scheduler, "decide_worker_non_rootish", choose, "ts")


_DEAD = "poolpart-dead"  # key in the scheduler's state of a worker: whether it is being removed


def add_removal_rule(
    rules: MethodRules, scheduler: Any, prepare: Callable[[Any], None]
) -> Callable[[], None]:
    """Call `prepare(worker)` before a worker that has died is removed, once for each worker.

    Returns a function that removes the rule.
    """

    def remove(address: str, *, expected: bool = False, **options: Any) -> Any:
        worker = scheduler.workers.get(address)
        # Dask removes a worker when its connection closes and when its nanny reports the end.
        if worker is not None and not expected and not worker.extra.get(_DEAD):
            worker.extra[_DEAD] = True
            prepare(worker)
        return NotImplemented

    rules.call_instead(scheduler, "remove_worker", remove, "expected")
    handler = scheduler.handlers["unregister"]
    stand_in = scheduler.remove_worker
    scheduler.handlers["unregister"] = stand_in  # instead of the method of the class

    def end() -> None:
        rules.remove_all()
        if scheduler.handlers["unregister"] is stand_in:
            scheduler.handlers["unregister"] = handler

    return end


def add_failed_fetch_rule(
    rules: MethodRules, scheduler: Any, report: Callable[[Any, str], None]
) -> None:
    """Call `report(task, address)` if a worker fails to fetch a result from another worker."""

    def look(key: Any, worker: str, **message: Any) -> Any:
        task = scheduler.tasks.get(key)
        holders = [h.address for h in task.who_has or ()] if task is not None else []
        if holders and worker not in holders:
            report(task, worker)
        return NotImplemented  # Dask ignores the message

    rules.call_instead(scheduler, "stimulus_task_erred", look, "key")


def remove_fence_rules(rules: MethodRules, scheduler: Any) -> None:
    """Remove the rules for fences from the scheduler."""
    rules.remove_all()
    scheduler.idle_task_count = set(scheduler.idle_task_count)


def workers_without_fences(scheduler: Any, task: Any) -> Any:
    """Return the workers that could run a task if there were no fences."""
    valid = type(scheduler).valid_workers(scheduler, task)
    return scheduler.running if valid is None else valid


class _OpenWorkers(set[Any]):
    """Replacement of the scheduler's set of idle workers that excludes workers within fences."""

    def __init__(self, enclosed: set[Any], workers: Iterable[Any]) -> None:
        super().__init__(workers)
        self.difference_update(enclosed)
        self._enclosed = enclosed

    def add(self, worker: Any) -> None:
        if worker not in self._enclosed:
            super().add(worker)

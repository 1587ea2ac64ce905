"""Blame the death of a worker only on tasks that may have been running.

Dask counts the death of a worker against all tasks that are assigned to it, also if they are still
waiting for a slot, and lets a task fail with `KilledWorker` after four deaths. If hundreds of tasks
are assigned, a worker that is killed four times for other reasons makes all of them fail. With this
rule, the death counts only against the tasks of a partition that may have been running.

The scheduler learns which tasks a worker runs from its heartbeats, and assumes that the free slots
run the tasks that come next. See `running_candidates`.
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any

from ..internals.method_rules import MethodRules, add_removal_rule
from ..internals.scheduler import acquit_tasks, requires_any, running_candidates


class DeathBlame:
    """Scheduler rule that acquits tasks that were not running when their worker died.

    `names` are the names of the partitions, a set that the caller updates.
    """

    def __init__(self, scheduler: Any, names: Set[str]) -> None:
        self._names = names
        self._rules = MethodRules()
        self._uninstall = add_removal_rule(self._rules, scheduler, self._acquit)

    def uninstall(self) -> None:
        """Remove the rule from the scheduler."""
        self._uninstall()

    def _acquit(self, worker: Any) -> None:
        """Compensate the death of a worker, which Dask counts against each of its tasks."""
        blamed = running_candidates(worker)
        tasks = (task for task in worker.processing if requires_any(task, self._names))
        acquit_tasks(task for task in tasks if task not in blamed)

"""Planning trials, which the driver gradually submits to the OTHER partition."""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Sequence

from lidarscenario.plan import Planning, Trial, run_trial
from poolpart.task_locations import PartitionSnapshot

from .cluster.tasks import TaskGroup
from .pipeline.failures import raise_if_failed, was_killed
from .pipeline.task_records import call_recorded

TRIAL = "trial"
MAX_ROUNDS = 3  # maximum number of times that a trial is submitted if its workers die
LOOK_EVERY_S = 1.0


class TrialRunner:
    """Runner of a survey's planning trials on the workers of a partition.

    Call `step` repeatedly until `finished` is True. Trials in `earlier_trials`, which an earlier
    run has finished, are not repeated.
    """

    def __init__(
        self, tasks: TaskGroup[int], planning: Planning, earlier_trials: Sequence[Trial] = ()
    ) -> None:
        self.tasks = tasks
        self.planning = planning
        self.trials: list[Trial] = list(earlier_trials)
        self._run_id = uuid.uuid4().hex[:8]
        finished_numbers = {trial.trial for trial in earlier_trials}
        self._waiting = deque(
            n for n in range(planning.trials) if n not in finished_numbers
        )  # numbers
        self._rounds: Counter[int] = Counter()  # {number: times that the trial was submitted}
        self._locate_tasks()

    @property
    def is_finished(self) -> bool:
        """True if all trials have finished."""
        return len(self.trials) == self.planning.trials

    def step(self) -> None:
        """Collect results and submit further trials, or raise LidarError if a trial has failed."""
        running = self.tasks.running
        if running and time.monotonic() - self._located_at > LOOK_EVERY_S:
            self._leave_silent_workers()
        for number, future in self.tasks.pop_failed():
            # Dask fails a task after several of its workers have died, whatever the cause.
            if was_killed(future) and self._rounds[number] < MAX_ROUNDS:
                self._waiting.append(number)
            else:
                raise_if_failed(future, f"Planning trial {number}")
        self.trials += [trial for _, trial in self.tasks.pop_finished()]
        for _ in range(min(self._max_running - len(running), len(self._waiting))):
            self._submit(self._waiting.popleft())

    def _submit(self, number: int, worker: str | None = None) -> None:
        self.tasks.submit(
            number,
            call_recorded,
            TRIAL,
            self.tasks.partition.name,
            run_trial,
            self.planning,
            number,
            key=f"{TRIAL}-{self._run_id}-{number}.{self._rounds[number]}",
            workers=worker,
        )
        self._rounds[number] += 1

    def _leave_silent_workers(self) -> None:
        """Resubmit trials whose workers do not respond or have left."""
        locations = self._locate_tasks()
        running = self.tasks.running
        responding = sorted(locations.members - locations.silent)
        # A trial that is restricted to a worker that has left would wait forever.
        waiting = {
            key for key, location in locations.tasks.items() if location.state == "no-worker"
        }
        lost = [f for f in running if f.key in waiting or locations.is_unreachable(f.key)]
        for index, future in enumerate(lost if responding else []):
            self._submit(running.pop(future), responding[index % len(responding)])

    def _locate_tasks(self) -> PartitionSnapshot:
        self._located_at = time.monotonic()
        locations = self.tasks.locate()
        # One pending trial per slot prevents idle slots, causes adaptive partitions to grow, and
        # limits the number of trials that are lost when a worker dies.
        self._max_running = 2 * max(1, locations.max_slots)
        return locations

"""The driver's side of planning: trials on the OTHER partition, a few at a time."""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Sequence

from poolpart.task_locations import PartitionSnapshot

from ..plan import Planning, Trial, run_trial
from .cluster.tasks import Tasks
from .pipeline.failures import raise_if_failed, was_killed
from .pipeline.task_records import recorded

TRIAL = "trial"
MAX_ROUNDS = 3  # submissions of a trial whose workers die
LOOK_EVERY_S = 1.0


class TrialPump:
    """Runs the trials of a planning, by `step` until `finished`.

    `earlier_trials` were finished by an earlier run.
    """

    def __init__(
        self, tasks: Tasks[int], planning: Planning, earlier_trials: Sequence[Trial] = ()
    ) -> None:
        self.tasks = tasks
        self.planning = planning
        self.trials: list[Trial] = list(earlier_trials)
        self._run_id = uuid.uuid4().hex[:8]
        finished_numbers = {trial.trial for trial in earlier_trials}
        self._waiting = deque(
            n for n in range(planning.trials) if n not in finished_numbers
        )  # numbers
        self._rounds: Counter[int] = Counter()  # {number: submissions of the trial}
        self._look()

    @property
    def finished(self) -> bool:
        """True if all trials have ended."""
        return len(self.trials) == self.planning.trials

    def step(self) -> None:
        """Take results and submit more trials. LidarError if a trial has failed."""
        running = self.tasks.running
        if running and time.monotonic() - self._looked_at > LOOK_EVERY_S:
            self._leave_silent_workers()
        for number, future in self.tasks.take_failed():
            # Dask gives up tasks after several deaths of their workers, whatever the cause.
            if was_killed(future) and self._rounds[number] < MAX_ROUNDS:
                self._waiting.append(number)
            else:
                raise_if_failed(future, f"Planning trial {number}")
        self.trials += [trial for _, trial in self.tasks.take_done()]
        for _ in range(min(self._max_running - len(running), len(self._waiting))):
            self._submit(self._waiting.popleft())

    def _submit(self, number: int, worker: str | None = None) -> None:
        self.tasks.submit(
            number,
            recorded,
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
        """Rerun trials whose workers are silent or have gone."""
        locations = self._look()
        running = self.tasks.running
        responding = sorted(locations.members - locations.silent)
        # A trial bound to a worker that has gone waits for ever.
        waiting = {
            key for key, location in locations.tasks.items() if location.state == "no-worker"
        }
        lost = [f for f in running if f.key in waiting or locations.is_unreachable(f.key)]
        for index, future in enumerate(lost if responding else []):
            self._submit(running.pop(future), responding[index % len(responding)])

    def _look(self) -> PartitionSnapshot:
        self._looked_at = time.monotonic()
        locations = self.tasks.look()
        # A trial waits behind each running trial: no slot idles, and a dying worker loses few.
        # Waiting trials make an adaptive partition start workers.
        self._max_running = 2 * max(1, locations.max_slots)
        return locations

"""The driver's side of planning: trials on the OTHER partition, a few under way at a time."""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Sequence

from distributed import Client, Future

from poolpart import Partition, recorded

from .errors import LidarpoolError
from .plan import Plan, Planning, Trial, best, run_trial
from .task_book import TaskBook

TRIAL = "trial"


class TrialPump:
    """Runs the trials of a planning; `step` it until `finished`, as `scan.SurveyPump`.

    Parameters
    ----------
    client
        Client of the cluster.
    partition
        Where the trials run.
    planning
        What to plan.
    done
        Trials that an earlier run has finished.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        planning: Planning,
        done: Sequence[Trial] = (),
    ) -> None:
        self.client, self.partition, self.planning = client, partition, planning
        self.trials: list[Trial] = list(done)
        self.book = TaskBook()
        self._run_id = uuid.uuid4().hex[:8]
        known = {trial.trial for trial in done}
        self._waiting = deque(n for n in range(planning.trials) if n not in known)  # numbers
        self._running: dict[Future, int] = {}  # {future: number of the trial}
        # One waits behind each that runs: no slot idles, and a dying worker takes few along.
        self._most = 2 * max(1, partition.slots)

    @property
    def finished(self) -> bool:
        """Whether all trials have ended."""
        return len(self.trials) == self.planning.trials

    def step(self) -> bool:
        """Take results and submit more; returns whether there was anything to do.

        Raises
        ------
        LidarpoolError
            If a trial has failed.
        """
        done = [f for f in self._running if f.status in ("finished", "error", "cancelled")]
        for future in done:
            number = self._running.pop(future)
            if future.status == "error":
                error = future.exception(timeout=10)
                raise LidarpoolError(f"Planning trial {number} failed: {error}")
            if future.status == "cancelled":
                raise LidarpoolError(
                    f"Planning trial {number} was cancelled from outside this run."
                )
            trial, record = future.result(timeout=30)
            self.trials.append(trial)
            self.book.add(record)
        room = min(self._most - len(self._running), len(self._waiting))
        for _ in range(room):
            number = self._waiting.popleft()
            future = self.partition.submit(
                recorded,
                TRIAL,
                self.partition.name,
                run_trial,
                self.planning,
                number,
                key=f"{TRIAL}-{self._run_id}-{number}",
            )
            self._running[future] = number
        return bool(done or room > 0)

    def stop(self, reason: str) -> None:
        """Start no more trials; those that run end by themselves in a fraction of a second."""
        self.client.cancel(list(self._running))

    def finish(self) -> None:
        """Let go of everything on the scheduler."""
        self._running.clear()

    def plan(self) -> Plan:
        """Best plan of all trials, whatever order they ended in."""
        self.trials.sort(key=lambda trial: trial.trial)
        return best(self.trials, self.planning)

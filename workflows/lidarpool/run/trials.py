"""The driver's side of planning: trials on the OTHER partition, a few at a time."""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Sequence

from distributed import Client, Future

from poolpart import Partition, Whereabouts, fetch_available, look_for_tasks, recorded

from ..base.software import call_alike
from ..pipeline.failures import raise_if_failed, was_killed
from ..pipeline.task_book import TaskBook
from ..plan import Planning, Trial, run_trial

TRIAL = "trial"
ROUNDS_MOST = 3  # submissions of a trial whose workers die
LOOK_EVERY_S = 1.0


class TrialPump:
    """Runs the trials of a planning; `step` it until `finished`, as a `SurveyDriver`.

    `sources` is ``lidarpool`` of the run's `software`, and `done` are trials that an earlier run
    has finished.
    """

    def __init__(
        self,
        client: Client,
        partition: Partition,
        planning: Planning,
        sources: str,
        done: Sequence[Trial] = (),
    ) -> None:
        self.client, self.partition, self.planning = client, partition, planning
        self._sources = sources
        self.trials: list[Trial] = list(done)
        self.book = TaskBook()
        self._run_id = uuid.uuid4().hex[:8]
        known = {trial.trial for trial in done}
        self._waiting = deque(n for n in range(planning.trials) if n not in known)  # numbers
        self._running: dict[Future, int] = {}  # {future: number of the trial}
        self._rounds: Counter[int] = Counter()  # {number: how often it was submitted}
        self._look()

    @property
    def finished(self) -> bool:
        """Whether all trials have ended."""
        return len(self.trials) == self.planning.trials

    def step(self) -> bool:
        """Take results and submit more; returns whether there was anything to do.

        LidarpoolError if a trial has failed.
        """
        if self._running and time.monotonic() - self._looked_at > LOOK_EVERY_S:
            self._leave_silent_workers()
        done = [f for f in self._running if f.status in ("error", "cancelled")]
        for future in done:
            number = self._running.pop(future)
            # Dask gives up tasks after several deaths of their workers, whatever the cause.
            if was_killed(future) and self._rounds[number] < ROUNDS_MOST:
                self._waiting.append(number)
            else:
                raise_if_failed(future, f"Planning trial {number}")
        finished = [f for f in self._running if f.status == "finished"]
        found = fetch_available(self.client, [f.key for f in finished]) if finished else {}
        for future in finished:
            if future.key in found:
                del self._running[future]
                trial, record = found[future.key]
                self.trials.append(trial)
                self.book.add(record)
        room = min(self._most - len(self._running), len(self._waiting))
        for _ in range(room):
            self._submit(self._waiting.popleft())
        return bool(done or found or room > 0)

    def _submit(self, number: int, worker: str | None = None) -> None:
        future = self.partition.submit(
            call_alike,
            self._sources,
            recorded,
            TRIAL,
            self.partition.name,
            run_trial,
            self.planning,
            number,
            key=f"{TRIAL}-{self._run_id}-{number}.{self._rounds[number]}",
            workers=worker,
        )
        self._rounds[number] += 1
        self._running[future] = number

    def _leave_silent_workers(self) -> None:
        """Rerun trials whose workers are silent or have gone."""
        seen = self._look()
        heard = sorted(seen.members - seen.silent)
        # A trial bound to a worker that has gone waits for ever.
        waiting = {key for key, place in seen.tasks.items() if place.state == "no-worker"}
        lost = [f for f in self._running if f.key in waiting or seen.out_of_reach(f.key)]
        for place, future in enumerate(lost if heard else []):
            self._submit(self._running.pop(future), heard[place % len(heard)])

    def _look(self) -> Whereabouts:
        self._looked_at = time.monotonic()
        keys = [future.key for future in self._running]
        seen = look_for_tasks(self.client, self.partition.name, keys)
        # One waits behind each running trial: no slot idles, and a dying worker loses few. Trials
        # that wait have more workers started, where their number adapts.
        self._most = 2 * max(1, seen.most_slots)
        return seen

    def stop(self, reason: str) -> None:
        """Start no more trials; running ones end in a fraction of a second."""
        self.client.cancel(list(self._running))

    def finish(self) -> None:
        """Release everything on the scheduler."""
        self._running.clear()

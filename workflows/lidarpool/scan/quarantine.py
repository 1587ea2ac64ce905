"""Finding the scan that kills the workers which cast it, without blaming its neighbours.

A worker that dies takes along whatever was assigned to it. Dask counts that death against
each of these tasks and gives all of them up after some; most of them are innocent. So what
was there at two deaths is set apart: nothing else is submitted meanwhile, and one batch at a
time is cast, alone on a worker. An innocent one passes. One whose worker dies is divided
into smaller ones, down to single scans, and a single scan is to blame when worker after
worker has died of it alone. A worker that somebody kills at random hits now this scan, now
that, and no scan so often in a row.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from poolpart import look_for_tasks

from .crew import Crew
from .failures import was_killed, words_on_memory
from .stage_names import INTERSECT
from .survey_run import SurveyRun
from .under_way import Cast, Item, UnderWay

KILLS_MOST = 3  # workers in a row that a single scan may kill
LOOK_EVERY_S = 0.2


@dataclass
class _Trial:
    """One suspect, alone on a worker."""

    item: Item
    cast: Cast
    worker: str
    looked_at: float = 0.0


class Quarantine:
    """Tries suspects of stage 2 one at a time.

    Parameters
    ----------
    run
        The run.
    crew
        The workers.
    under_way
        The batches; the suspects are among them.
    submit
        Submits a batch to one worker, for a reason.
    """

    def __init__(
        self,
        run: SurveyRun,
        crew: Crew,
        under_way: UnderWay,
        submit: Callable[[Item, str, str], Cast],
    ) -> None:
        self._run, self._crew, self._under_way, self._submit = run, crew, under_way, submit
        self._trial: _Trial | None = None
        self._killed: list[str] = []  # workers that died of the scan that is being tried

    @property
    def busy(self) -> bool:
        """Whether there is anybody to try."""
        return any(INTERSECT in item.suspect for item in self._under_way)

    def add(self, item: Item) -> None:
        """Set a batch apart."""
        if INTERSECT not in item.suspect:
            item.suspect.add(INTERSECT)
            item.casts.clear()  # none of them may run beside a trial

    def step(self) -> bool:
        """Go on with the trials; returns whether anything was done."""
        if self._trial is not None and self._trial.item in self._under_way:
            return self._watch(self._trial)
        self._trial = None
        suspects = [item for item in self._under_way if INTERSECT in item.suspect]
        if not suspects or (worker := self._free_worker()) is None:
            return False
        item = suspects[0]
        item.casts.clear()
        self._trial = _Trial(item, self._submit(item, worker, "on trial"), worker)
        return True

    def _free_worker(self) -> str | None:
        """Address of a prepared worker on which nothing of this run is."""
        running = [
            cast.batch.key
            for item in self._under_way
            if item.running
            for cast in item.casts
            if cast.batch.status != "finished"
        ]
        if not running:
            return self._crew.idle([])
        seen = look_for_tasks(self._run.client, self._run.gpu.name, running)
        return self._crew.idle(worker for place in seen.tasks.values() for worker in place.workers)

    def _watch(self, trial: _Trial) -> bool:
        futures = (trial.cast.batch, trial.cast.frames)
        if all(future.status == "finished" for future in futures):
            self._acquit(trial)
            return True
        if any(future.status == "error" and was_killed(future) for future in futures):
            self._blame(trial)
            return True
        now = time.monotonic()
        if now - trial.looked_at < LOOK_EVERY_S:
            return False
        trial.looked_at = now
        seen = look_for_tasks(self._run.client, self._run.gpu.name, [f.key for f in futures])
        if trial.worker in seen.members and trial.worker not in seen.silent:
            return False
        place = seen.tasks.get(trial.cast.batch.key)
        if place is not None and place.deaths:
            self._blame(trial)
        else:  # it left in peace, or is only stopped: nobody is to blame
            self._trial = None
        return True

    def _acquit(self, trial: _Trial) -> None:
        trial.item.suspect.discard(INTERSECT)
        self._killed.clear()
        self._trial = None

    def _blame(self, trial: _Trial) -> None:
        item = trial.item
        self._trial = None
        self._killed.append(trial.worker)
        if len(item.scans) > 1:
            self._under_way.split(item)
            return
        item.kills[INTERSECT] += 1
        if item.kills[INTERSECT] >= KILLS_MOST:
            memory = words_on_memory(self._run.client, self._killed)
            self._under_way.condemn(
                item,
                f"{item.name} kills the worker that casts it: {KILLS_MOST} of them died, one "
                f"after the other, with nothing else of this run on them{memory}. Look into the "
                "logs of the GPU workers, or try another backend.",
            )

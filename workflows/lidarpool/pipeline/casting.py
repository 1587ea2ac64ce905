"""Stage 2 as the driver sees it: who casts which batches, and which are cast again."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable

from poolpart import TaskRecord, Whereabouts

from . import policies
from .batches import Batch, Batches, Place
from .failures import JobError
from .jobs import JobState
from .names import GPU, INTERSECT, LIDAR
from .policies import Loss, Verdict
from .workers import CastingWorkers, Outcome


class Casting:
    """Offers the batches of all jobs to workers, and judges those with which workers die.

    There are `collectors` tasks of stage 4. Jobs that cannot be cast are in `failed`, until they
    are dropped.
    """

    def __init__(self, workers: CastingWorkers, collectors: int) -> None:
        self.batches = Batches()
        self.failed: dict[JobState, JobError] = {}
        self._workers, self._collectors = workers, collectors
        self._seconds: deque[float] = deque(maxlen=64)  # casting times of batches
        self._total = (0.0, 0)  # casting time of scans, and their number
        self._per_task = 1  # small batches of a task
        # {job: batches that were tried alone before any was cast, each with a worker that died}
        self._first_deaths: dict[JobState, list[Batch]] = {}

    # -- how much --------------------------------------------------------------------------

    @property
    def most(self) -> int:
        """Batches that may be under way, by weight."""
        return policies.most_under_way(self._workers.slot_count, self._collectors, self._per_task)

    def room(self, job: JobState) -> float:
        """Batches that may be taken of a job, by weight."""
        under_way = sum(policies.weight(batch, self._per_task) for batch in self.batches)
        return policies.room(under_way, self.batches.span(job), self.most)

    def slots_wanted(self, left: int) -> int:
        """Slots that so many scans are worth; at least 1."""
        seconds, scans = self._total
        return max(1, policies.slots_wanted(left, seconds / scans if scans else None))

    def learn(self, records: Iterable[TaskRecord]) -> None:
        """Take account of how long batches took to cast."""
        for record in records:
            self._seconds.append(record.seconds)
            self._total = (self._total[0] + record.seconds, self._total[1] + record.items)
        self._per_task = policies.batches_per_task(self._seconds)

    # -- casting ---------------------------------------------------------------------------

    def offer(self) -> bool:
        """Offer waiting batches to workers that have room."""
        if not (waiting := self.batches.waiting):
            return False
        there = [*waiting, *self.batches.at(Place.CASTING, Place.CAST, Place.COLLECTING)]
        chosen = policies.offers(there, self._workers.slots, self.most, self._per_task)
        for task, worker in chosen:
            key = self._workers.cast([(batch.job.number, batch.span) for batch in task], worker)
            for batch in task:
                self.batches.offered(batch, key, worker, time.monotonic())
                batch.job.trace("submit", INTERSECT, batch.scans)
        return bool(chosen)

    def check(self) -> bool:
        """Look which casting tasks have ended."""
        moved = False
        for key, worker in self.batches.casting.items():
            batches = self.batches.of_task(key)
            try:
                outcome = self._workers.outcome(key, worker)
            except JobError as error:
                self.failed.setdefault(batches[0].job, error)
                continue
            if outcome is not Outcome.PENDING:
                moved = True
                self._end(batches, outcome)
        return moved

    def _end(self, batches: list[Batch], outcome: Outcome) -> None:
        """Take the outcome of a casting task."""
        for batch in batches:
            if outcome is Outcome.DONE:
                self.batches.move(batch, Place.CAST, time.monotonic())
                batch.job.count_cast(len(batch))
            elif outcome is Outcome.NO_RIG:
                self.again(batch, "its worker has no scene any more")
            elif outcome is Outcome.KILLED:
                self._lose(batch, Loss.DIED)
            elif outcome is Outcome.DIVIDE:
                self.again(batch, "its task failed, perhaps because of another job")
                batch.divided = True

    def leave_workers(self, seen: Whereabouts) -> None:
        """Offer batches again whose workers died, are silent, late, or take no tasks."""
        prepared, late_s = len(self._workers.slots), policies.late_after_s(self._seconds)
        for batch in self.batches:
            if reason := policies.loss(batch, seen, prepared, time.monotonic(), late_s):
                self._lose(batch, reason)

    def again(self, batch: Batch, reason: str, place: Place = Place.WAITING) -> None:
        """Return a batch to be cast again, or only to be collected again."""
        if place is Place.WAITING:
            self._forget(batch)
        self.batches.move(batch, place, time.monotonic())
        batch.job.count_again()
        batch.job.trace("replay", INTERSECT, batch.scans, reason=reason)

    def remove(self, batch: Batch) -> None:
        """Remove a batch; its job fails if it was the last beside condemned ones."""
        self._forget(batch)
        self.batches.remove(batch)
        if batch.job.condemned and not self.batches.of(batch.job):
            self.failed.setdefault(batch.job, JobError("\n".join(batch.job.condemned)))

    def drop(self, job: JobState) -> None:
        """Remove all batches of a job that has ended."""
        for batch in self.batches.of(job):
            self._forget(batch)
            self.batches.remove(batch)
        self._first_deaths.pop(job, None)
        self.failed.pop(job, None)

    def _forget(self, batch: Batch) -> None:
        """Drop a batch's casting task, unless others of the same task need it."""
        if key := self.batches.forget_task(batch):
            self._workers.forget(key)

    # -- poison batches ----------------------------------------------------------------------

    def _lose(self, batch: Batch, reason: Loss) -> None:
        self.again(batch, reason.value)
        if reason is Loss.DIED:
            self.blame(batch, INTERSECT, batch.worker)

    def blame(self, batch: Batch, stage: str, worker: str) -> None:
        """Count the death of a worker against its batches, see `policies.verdict`."""
        batch.deaths[stage] += 1
        if stage == INTERSECT and not batch.job.cast and policies.was_alone(batch, stage):
            self._blame_scene(batch, worker)
        judged = policies.verdict(batch.deaths[stage], len(batch))
        if judged is Verdict.SPLIT:
            self._forget(batch)
            self.batches.split(batch, Counter({stage: policies.SUSPECT_DEATHS}))
        elif judged is Verdict.POISON:
            partition = GPU if stage == INTERSECT else LIDAR
            batch.job.condemn(
                f"{batch.name} kills the worker that runs stage {stage}: "
                f"{policies.KILLS_MOST} workers died, one after the other, with no other scan in "
                "that stage"
                f"{self._workers.words_on_memory(worker)}. Look into the logs of the "
                f"{partition} workers."
            )
            self.remove(batch)

    def _blame_scene(self, batch: Batch, worker: str) -> None:
        """Count a death with a batch alone, before any was cast: it may be the scene that kills.

        The next to be tried is another batch. The job fails once several have killed.
        """
        deaths = self._first_deaths.setdefault(batch.job, [])
        deaths[:] = [o for o in deaths if o.stop <= batch.first or batch.stop <= o.first] + [batch]
        self.batches.postpone(batch)
        if len(deaths) >= policies.KILLS_MOST:
            names = ", ".join(one.name for one in deaths)
            error = JobError(
                f"GPU workers die whatever they cast first: {len(deaths)} died, one "
                f"after the other, with nothing but {names}"
                f"{self._workers.words_on_memory(worker)}. The scene may need more memory than "
                "they have: look into their logs, or try another backend."
            )
            self.failed.setdefault(batch.job, error)

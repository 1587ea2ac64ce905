"""Stage 2 from the driver's side: batches submitted, and submitted again where need be.

Dask itself runs a task again whose worker has died. What is left to do here: to make out the
one that kills its workers among those that were only beside it (`quarantine.py`), and not to
wait for a worker that gives no sign of life, or for one on which a batch does not end.
"""

from __future__ import annotations

import statistics
import time
from collections import Counter, deque
from collections.abc import Iterable

from distributed import Future

from poolpart import TaskRecord, Whereabouts

from .casting import frames_of, intersect
from .crew import Crew
from .failures import raise_if_failed, was_killed
from .quarantine import Quarantine
from .stage_names import INTERSECT
from .survey_run import SurveyRun
from .under_way import Cast, Item, UnderWay

LATE_S = 30.0  # a batch is late when it takes so long, and
LATE_FACTOR = 10.0  # so much longer than others
CASTS_MOST = 4  # submissions of one batch that are under way at a time
SUSPECT_DEATHS = 2  # workers that may die while a batch is assigned to them
PEERS = 64  # batches whose time is remembered


class Caster:
    """Submits batches to the GPU partition and sees that each comes to an end.

    Parameters
    ----------
    run
        The run.
    crew
        The workers.
    under_way
        The batches.
    """

    def __init__(self, run: SurveyRun, crew: Crew, under_way: UnderWay) -> None:
        self._run, self._crew, self._under_way = run, crew, under_way
        self._seconds: deque[float] = deque(maxlen=PEERS)
        self.quarantine = Quarantine(run, crew, under_way, self.submit)
        self.recast = 0  # batches that were submitted once more

    @property
    def running_most(self) -> int:
        """Batches that are submitted ahead: enough that no worker idles, few that can be lost."""
        return 2 * self._crew.slots + 2

    @property
    def room(self) -> int:
        """Batches that may be submitted now."""
        if not self._crew.takes_work or self.quarantine.busy:
            return 0
        return self.running_most - sum(item.running for item in self._under_way)

    def submit(self, item: Item, worker: str | None = None, reason: str = "") -> Cast:
        """Submit a batch; with a reason, once more."""
        run, first = self._run, item.scans[0]
        if worker is None and self._crew.seen.silent:
            worker = self._choose()  # Dask would go on giving work to those that are silent
        if reason:
            self.recast += 1
            run.trace("recast", INTERSECT, item.scans, reason=reason)
        batch = run.gpu.submit(
            intersect,
            self._crew.setup,
            list(item.wire),
            run.id,
            key=run.new_key(INTERSECT, first),
            worker=worker,
        )
        frames = run.gpu.submit(
            frames_of,
            batch,
            key=run.new_key("frames", first),
            priority=1,
            worker=worker,
        )
        cast = Cast(batch, frames, worker, time.monotonic())
        item.casts.append(cast)
        # What was handed on of an earlier cast may never be found: this one's will be.
        item.handed_on.clear()
        run.trace("submit", INTERSECT, item.scans)
        return cast

    def learn(self, records: Iterable[TaskRecord]) -> None:
        """Note how long batches take."""
        self._seconds.extend(record.seconds for record in records)

    def step(self) -> bool:
        """See to the batches; returns whether anything was done.

        Raises
        ------
        LidarpoolError
            If a batch has failed, or a scan kills its workers.
        """
        self._check()
        if self._crew.due:
            keys = [future.key for item in self._under_way for future in _futures(item)]
            seen = self._crew.look(keys)
            for item in self._under_way:
                self._look_after(item, seen)
        self._crew.check()
        moved = False
        for item in self._under_way:
            if not item.casts and INTERSECT not in item.suspect:  # a piece of a larger one
                self.submit(item, reason="one of its scans is suspect")
                moved = True
        return self.quarantine.step() or moved

    def _check(self) -> None:
        for item in self._under_way:
            for future in _futures(item):
                if future.status == "error" and was_killed(future):
                    self.quarantine.add(item)
                    break
                raise_if_failed(
                    future, f"stage {INTERSECT}, scans {item.scans[0]} to {item.scans[-1]}"
                )

    def _look_after(self, item: Item, seen: Whereabouts) -> None:
        """Send a batch to quarantine, or elsewhere, if that is what it needs."""
        if INTERSECT in item.suspect:
            return
        for cast in item.casts:
            cast.reachable = not any(seen.out_of_reach(future.key) for future in _of(cast))
        places = [seen.tasks.get(cast.batch.key) for cast in item.casts]
        if any(place and place.deaths >= SUSPECT_DEATHS for place in places) and item.running:
            self.quarantine.add(item)
        elif self._crew.prepared and all(self._is_lost(cast, seen) for cast in item.casts):
            # The lost ones stay, but for the oldest: their workers may wake up.
            del item.casts[: 1 - CASTS_MOST]
            self.submit(item, reason="its worker is silent or gone")
        elif item.running and self._is_late(item):
            busy = [a for place in places if place for a in place.workers]
            if worker := self._crew.idle(busy):
                self.submit(item, worker, "it takes far longer than others")

    def _is_lost(self, cast: Cast, seen: Whereabouts) -> bool:
        """Whether nothing will come of a cast, as far as can be seen."""
        if cast.worker is None or cast.worker in seen.members:
            return not cast.reachable
        return any(future.status != "finished" for future in _of(cast))

    def _is_late(self, item: Item) -> bool:
        if len(item.casts) >= CASTS_MOST or not self._seconds:
            return False
        limit = max(LATE_S, LATE_FACTOR * statistics.median(self._seconds))
        return time.monotonic() - item.casts[-1].since > limit

    def _choose(self) -> str | None:
        """Worker with the fewest batches of those that are heard of."""
        loads = Counter(cast.worker for item in self._under_way for cast in item.casts)
        return min(self._crew.prepared, key=lambda address: (loads[address], address), default=None)


def _of(cast: Cast) -> tuple[Future, ...]:
    return cast.batch, cast.frames


def _futures(item: Item) -> list[Future]:
    return [future for cast in item.casts for future in _of(cast)]

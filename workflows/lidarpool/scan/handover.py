"""Handing on what stage 2 has made to stages 3 and 4, again and again where need be.

What a stage was given and has not delivered is lost when its worker dies, and is handed on
once more. A scan that kills the worker each time would go on doing so, and be one of many
that were there. So what was there at two deaths is suspect, and while there are suspects,
one batch at a time is given to one stage at a time: what the worker then dies of is known.
A batch is divided, down to single scans, as in `quarantine.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from poolpart import Ledger, Pipe, forget_pipes

from .messages import Attempt
from .stage_names import COLLECT, SORT
from .survey_run import SurveyRun
from .under_way import Item, UnderWay

PUT_S = 20.0  # for a put; the pipes have room for all that is under way
SUSPECT_LOSSES = 2  # deaths of a stage while it had a batch
KILLS_MOST = 3  # workers in a row that a single scan may kill
STAGES = (SORT, COLLECT)


class Handover:
    """Gives results to stages 3 and 4.

    Parameters
    ----------
    run
        The run.
    under_way
        The batches.
    frames
        The frames that have arrived.
    capacity
        Batches that are under way at most.
    """

    def __init__(self, run: SurveyRun, under_way: UnderWay, frames: Ledger, capacity: int) -> None:
        self._run, self._under_way, self._frames = run, under_way, frames
        self.capacity = capacity
        self.replayed = 0  # batches that were put into a pipe once more
        self.cast = 0  # scans that stage 2 has finished
        self._sorter = -1  # number of the attempt that sorts
        self._inlets: dict[str, Pipe] = {}
        self._greeted: set[int] = set()  # attempts that have said hello
        self._alone: tuple[str, Item] | None = None  # what is under way where there are suspects

    def start(self) -> None:
        """Make the pipes."""
        self._inlets[COLLECT] = self._pipe(COLLECT).create()

    @property
    def pipes(self) -> list[Pipe]:
        """The pipes that there are."""
        return list(self._inlets.values())

    def inlet(self, stage: str, attempt: int) -> Pipe:
        """Pipe that an attempt of a stage is to read.

        Each sorter has one of its own. One that was only stopped, and goes on beside the one
        that has replaced it, would take every other batch, and neither could go on in order.
        Collectors need no order, and share.
        """
        if stage == SORT:
            self._close_sorter()
            self._inlets[SORT] = self._pipe(f"{SORT}-{attempt}").create()
            self._sorter = attempt
        return self._inlets[stage]

    def is_stale(self, attempt: Attempt) -> bool:
        """Whether an attempt was replaced, so that what it says does not matter any more."""
        return attempt.stage == SORT and attempt.number != self._sorter

    def greet(self, attempt: Attempt) -> None:
        """Note that an attempt has started; the second time, that Dask has started it again."""
        if attempt.number in self._greeted:
            self._note_death(attempt.stage)
        self._greeted.add(attempt.number)

    def note_deaths(self, stages: Collection[str]) -> None:
        """Note that workers of these stages have died, with what they had been given.

        Stages whose workers died together are to be told of together: of the several tasks
        of a stage that were there only one had the batch that is blamed.
        """
        for stage in STAGES:
            if stage in stages:
                self._note_death(stage)
        if SORT in stages:
            self._close_sorter()

    def _note_death(self, stage: str) -> None:
        if self._alone is not None and self._alone[0] == stage:
            item, self._alone = self._alone[1], None
            if item.waits_in(stage) and item in self._under_way:
                self._blame(stage, item)
        for item in self._under_way:
            if item.waits_in(stage):
                item.losses[stage] += 1
                if item.losses[stage] >= SUSPECT_LOSSES:
                    item.suspect.add(stage)
        self._take_back(stage)

    def resend(self) -> bool:
        """Hand on once more what was given to stages whose pipes are empty."""
        resent = False
        for stage, inlet in self._inlets.items():
            if not inlet.depth:  # else it is not lost, but waits for a reader
                resent |= self._take_back(stage)
        self._alone = None
        return resent

    def hand_on(self) -> bool:
        """Put what stage 2 has finished into the pipes; returns whether there was any."""
        if any(item.suspect & item.left.keys() for item in self._under_way):
            return self._hand_on_one()
        self._alone = None
        moved = False
        for stage in self._inlets:
            waiting = [item for item in self._open(stage) if item.ready(stage)]
            if waiting:
                self._put(stage, waiting)
                moved = True
        return moved

    def close(self) -> None:
        """Tell both stages that nothing more will come."""
        for inlet in self._inlets.values():
            inlet.close()

    def _close_sorter(self) -> None:
        if earlier := self._inlets.pop(SORT, None):
            forget_pipes(self._run.client, [earlier.name])  # which ends its reader
            self._take_back(SORT)

    def _open(self, stage: str) -> list[Item]:
        """Batches that a stage has yet to be given."""
        return [i for i in self._under_way if stage in i.left and stage not in i.handed_on]

    def _hand_on_one(self) -> bool:
        """Put one batch into one pipe, if the last one has come out."""
        if self._alone is not None:
            stage, item = self._alone
            if item in self._under_way and item.waits_in(stage):
                return False
            self._alone = None
        for stage in self._inlets:
            waiting = sorted(self._open(stage), key=lambda item: item.scans[0])
            if not any(stage in item.suspect for item in waiting):
                continue
            if stage == SORT:  # which delivers in order
                waiting = waiting[:1]
            if ready := [item for item in waiting if item.ready(stage)]:
                self._put(stage, ready[:1])
                self._alone = (stage, ready[0])
                return True
        return False

    def _put(self, stage: str, items: Iterable[Item]) -> None:
        items = list(items)
        keys = [future.key for item in items if (future := item.ready(stage))]
        again = [item for item in items if item.puts[stage]]
        if again:
            self.replayed += len(again)
            self._run.trace("replay", stage, [scan for item in again for scan in item.scans])
        inlet = self._inlets[stage]
        inlet.capacity = self._room
        inlet.put({"base": self._frames.first_missing, "keys": keys}, timeout_s=PUT_S)
        for item in items:
            item.handed_on.add(stage)
            item.puts[stage] += 1
            if not item.counted:
                item.counted = True
                self.cast += len(item.scans)
            self._run.trace("handon", stage, item.scans)

    def _take_back(self, stage: str) -> bool:
        """Count what a stage has not delivered as not given to it."""
        lost = [item for item in self._under_way if item.waits_in(stage)]
        for item in lost:
            item.handed_on.discard(stage)
        return bool(lost)

    def _blame(self, stage: str, item: Item) -> None:
        """Draw the conclusion from a death with nothing else there."""
        if len(item.scans) > 1:
            for piece in self._under_way.split(item):
                piece.suspect.add(stage)
            return
        item.handed_on.discard(stage)
        item.suspect.add(stage)
        item.kills[stage] += 1
        if item.kills[stage] >= KILLS_MOST:
            self._under_way.condemn(
                item,
                f"{item.name} kills the worker that runs stage {stage}: {KILLS_MOST} of them "
                "died, one after the other, with no other scan in that stage. Look into the "
                "logs of the LIDAR workers.",
            )

    @property
    def _room(self) -> int:
        """Items for which a pipe has room: what is under way, and all of it once more."""
        return 2 * self.capacity

    def _pipe(self, name: str) -> Pipe:
        return Pipe(self._run.key("lidarpool", None) + f"-{name}", self._room, self._run.client)

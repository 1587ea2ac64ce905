"""The jobs of a run: one that is there, or those of a campaign, made a few ahead."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import NamedTuple

from lidarsim.base.errors import LidarError
from lidarsim.sweeps.sweeps import Sweeps

from ..base.fingerprint import fingerprint
from ..base.shard import ALL, Shard
from ..datasets.job_table import JobRow, Value
from ..scenario.build import Job
from ..scenario.campaign import CampaignSpec
from ..scenario.static_scene import SceneCache
from .pipeline.failures import JobError

READY = 16  # jobs that are made ahead: small ones are cast several at a time,
SCENES = 2  # and they have so many scenes at most
STOP_S = 10.0  # for a job that is being made when the run ends
CONTENT = ("scene", "survey", "planning")  # the fields of a job that its result depends on


def identity_of(job: Job) -> dict[str, str]:
    """Fingerprints of the inputs of a job: those with the same ones give the same bytes.

    JobError if a sensor, column or trajectory has a field without a fingerprint.
    """
    try:
        return {name: fingerprint(getattr(job, name)) for name in CONTENT}
    except LidarError as error:
        raise JobError(str(error)) from error


@dataclass(frozen=True, eq=False)
class OneJob:
    """A survey, as the only job of its run, which does the scans of a shard."""

    job: Job
    shard: Shard = ALL
    numbers: range = range(1)
    title: str = ""
    names: tuple[str, ...] = ()

    @cached_property
    def only(self) -> Job:
        """The job as this shard does it: the first one alone plans the path."""
        return self.job if self.shard.number == 1 else replace(self.job, planning=None)

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Fingerprints of scene, survey and planning."""
        return identity_of(self.job)


Jobs = OneJob | CampaignSpec  # what a run does


def failed_row(campaign: CampaignSpec, number: int, error: object) -> JobRow:
    """Row of a job that has failed, perhaps because it cannot be made."""
    values: Mapping[str, Value] = {}
    with suppress(Exception):  # which is what has failed
        values = campaign.values(number)
    name, split = campaign.name(number), campaign.split(number)
    return JobRow(number, name, split, dict(values), str(error))


class MadeJob(NamedTuple):
    """A job that was made, and its sweeps if it is for a data set: they take a while."""

    job: Job
    sweeps: Sweeps | None = None


class JobMaker:
    """Makes jobs of a campaign in a thread, a few ahead; `numbers` are those that are left.

    The data set wants clouds to have these `columns`.
    """

    def __init__(
        self, campaign: CampaignSpec, numbers: Iterable[int], columns: Sequence[str]
    ) -> None:
        self._campaign, self._numbers, self._columns = campaign, numbers, columns
        self._cache = SceneCache()
        self._ready: Queue[MadeJob | JobRow | BaseException | None] = Queue(READY)
        self._stopped = Event()
        self._full = False  # whether it waits because of the memory of scenes
        self.ended = False  # whether the last was taken
        self._thread = Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def take(self, *, wait: bool = False) -> MadeJob | JobRow | None:
        """Return the next job, or the row of one that cannot be made.

        None if there is none yet, unless it is to `wait`, and after the last.
        """
        try:
            found = None if self.ended else self._ready.get(block=wait)
        except Empty:
            return None
        self.ended |= found is None
        if isinstance(found, BaseException):
            raise found
        return found

    def has(self, jobs: int) -> bool:
        """Whether so many are ready, or as many as will be until some are taken."""
        most = self._full or not self._thread.is_alive()
        return most or self._ready.qsize() >= min(jobs, READY)

    def _work(self) -> None:
        last: BaseException | None = None
        try:
            for number in self._numbers:
                if not self._put(self._made(number)):
                    return
        except BaseException as error:
            last = error
        self._put(last)

    def _made(self, number: int) -> MadeJob | JobRow:
        try:
            job = self._campaign.job(number, self._cache, self._columns)
            return MadeJob(job, Sweeps.of(job.survey, job.scene))
        except MemoryError:
            raise
        except Exception as error:
            # A class of the user's own may raise anything: the other jobs go on.
            told = str(error) if isinstance(error, LidarError) else repr(error)
            return failed_row(self._campaign, number, told)

    def _put(self, found: MadeJob | JobRow | BaseException | None) -> bool:
        while not self._stopped.is_set():
            waiting = [one.job.scene for one in [*self._ready.queue] if isinstance(one, MadeJob)]
            self._full = len({id(scene.vertices) for scene in waiting}) > SCENES
            if self._full:
                time.sleep(0.05)
                continue
            with suppress(Full):
                self._ready.put(found, timeout=0.1)
                return True
        return False

    def close(self) -> None:
        """Make no more jobs."""
        self._stopped.set()
        self._thread.join(STOP_S)

"""The jobs of a run: one that is there, or those of a campaign, made a few ahead."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import NamedTuple, Protocol

from ..base.errors import LidarpoolError
from ..export.jobs import JobRow, Value
from ..export.sweeps import Sweeps
from ..scenario.job import Job
from ..scenario.static_scene import SceneCache
from .identity import identity_of

READY = 16  # jobs that are made ahead: small ones are cast several at a time,
SCENES = 2  # and they have so many scenes at most
STOP_S = 10.0  # for a job that is being made when the run ends


class Jobs(Protocol):
    """What a run does: a campaign, or `OneJob`."""

    @property
    def count(self) -> int:
        """How many."""

    @property
    def title(self) -> str:
        """Title of all; may be empty."""

    @property
    def names(self) -> Sequence[str]:
        """Names of what differs from job to job."""

    @property
    def identity(self) -> Mapping[str, str]:
        """Hashes of what all results depend on."""

    def job(self, number: int, cache: SceneCache | None = None, columns: Sequence[str] = ()) -> Job:
        """Make a job; LidarpoolError if it cannot be made."""

    def values(self, number: int) -> Mapping[str, Value]:
        """Values of a job; LidarpoolError if it cannot be made."""

    def name(self, number: int) -> str:
        """Name of a job in files."""

    def split(self, number: int) -> str:
        """Name of its split."""


@dataclass(frozen=True, eq=False)
class OneJob:
    """A survey, as the only job of its run."""

    only: Job
    count: int = 1
    title: str = ""
    names: tuple[str, ...] = ()

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Fingerprints of scene, survey and planning."""
        return identity_of(self.only)

    def job(self, number: int, cache: SceneCache | None = None, columns: Sequence[str] = ()) -> Job:
        """Return it."""
        return self.only

    def values(self, number: int) -> Mapping[str, Value]:
        """None."""
        return {}

    def name(self, number: int) -> str:
        """Its name."""
        return self.only.name

    def split(self, number: int) -> str:
        """None."""
        return ""


def failed_row(jobs: Jobs, number: int, error: object) -> JobRow:
    """Row of a job that has failed, perhaps because it cannot be made."""
    values: Mapping[str, Value] = {}
    with suppress(Exception):  # which is what has failed
        values = jobs.values(number)
    return JobRow(number, jobs.name(number), jobs.split(number), dict(values), str(error))


class Made(NamedTuple):
    """A job that was made, and its sweeps, which take a while."""

    job: Job
    sweeps: Sweeps | None


class JobMaker:
    """Makes jobs in a thread, a few ahead; `numbers` are those that are left.

    The data set wants clouds to have these `columns`, None where there is no data set.
    """

    def __init__(self, jobs: Jobs, numbers: Iterable[int], columns: Sequence[str] | None) -> None:
        self._jobs, self._numbers, self._columns = jobs, numbers, columns
        self._cache = SceneCache()
        self._ready: Queue[Made | JobRow | BaseException | None] = Queue(READY)
        self._put_back: deque[Made] = deque()
        self._stopped = Event()
        self._thread = Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def take(self, *, wait: bool = False) -> Made | JobRow | None:
        """Return the next job, or the row of one that cannot be made; None if none is ready.

        EOFError after the last. With `wait` it waits for one.
        """
        if self._put_back:
            return self._put_back.popleft()
        try:
            found = self._ready.get(block=wait)
        except Empty:
            return None
        if found is None:
            self._ready.put(None)
            raise EOFError
        if isinstance(found, BaseException):
            raise found
        return found

    def put_back(self, made: Made) -> None:
        """Let a job be taken again."""
        self._put_back.append(made)

    def _work(self) -> None:
        last: BaseException | None = None
        try:
            for number in self._numbers:
                if not self._put(self._made(number)):
                    return
        except BaseException as error:
            last = error
        self._put(last)

    def _made(self, number: int) -> Made | JobRow:
        try:
            if self._columns is None:
                return Made(self._jobs.job(number), None)
            job = self._jobs.job(number, self._cache, self._columns)
            return Made(job, Sweeps.of(job.survey, job.scene))
        except MemoryError:
            raise
        except Exception as error:
            # A class of the user's own may raise anything: the other jobs go on.
            told = str(error) if isinstance(error, LidarpoolError) else repr(error)
            return failed_row(self._jobs, number, told)

    def _put(self, found: Made | JobRow | BaseException | None) -> bool:
        while not self._stopped.is_set():
            waiting = [one.job.scene for one in [*self._ready.queue] if isinstance(one, Made)]
            if len({id(scene.vertices) for scene in waiting}) > SCENES:
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

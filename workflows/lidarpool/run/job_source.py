"""The jobs of a run: the single job of a survey, or the jobs of a campaign, made a few ahead."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Any

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.media.weather import Weather
from lidarsim.scene.scene import Scene
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import CloudOptions, Mounted, Survey

from ..datasets.job_table import JobRow, Value
from ..identity.field_words import describe_fields
from ..identity.fingerprint import fingerprint
from ..identity.shard import ALL, Shard
from ..plan import Planning
from ..scenario.campaign import CampaignSpec
from ..scenario.job import Job
from ..scenario.static_scene import SceneCache
from .pipeline.failures import JobError

MAX_READY = 16  # jobs that are made ahead, since small jobs are cast several at a time
MAX_SCENES = 2  # scenes of the jobs that are made ahead
STOP_S = 10.0  # wait for a job that is being made when the run ends
CONTENT = ("scene", "survey", "planning")  # the fields of a job that its result depends on


def identity_of(job: Job) -> dict[str, str]:
    """Return fingerprints of the inputs of a job.

    Equal fingerprints give equal bytes.

    JobError if a sensor, column or trajectory has a field without a fingerprint.
    """
    try:
        return {name: fingerprint(getattr(job, name)) for name in CONTENT}
    except LidarError as error:
        raise JobError(str(error)) from error


def fields_of(scene: Scene, survey: Survey, planning: Planning | None) -> dict[str, str]:
    """Return the fields that a result depends on, in words, named as in a scenario.

    Positions are in the scene's local coordinates.
    """
    size_m = np.ptp(scene.bounds, axis=0)
    values: dict[str, Any] = {
        "scene": {
            "objects": len(scene.object_names),
            "triangles": scene.triangles,
            "size": " x ".join(f"{side:.6g}" for side in size_m) + " m",
        }
    }
    for carried in survey.carried:
        path = f"sensors.{carried.name}" if carried.name else "sensor"
        values[path] = declared_values(carried, Mounted) | declared_values(carried.sensor, Sensor)
        values[path] |= {"model": carried.sensor.name or "grid", "name": None, "sensor": None}
    for section, kind in (("cloud", CloudOptions), ("weather", Weather)):
        values[section] = declared_values(survey, kind)
    values["cloud"]["columns"] = [getattr(column, "name", column) for column in survey.columns]
    for name in ("poses", "trajectory", "steps", "materials", "returns", "noise", "navigation"):
        values[name] = getattr(survey, name)
    values |= {"faults": survey.faults, "planning": planning}
    return dict(describe_fields(values))


@dataclass(frozen=True, eq=False)
class OneJob:
    """A survey as the only job of its run, which does the scans of a shard."""

    survey_job: Job
    shard: Shard = ALL
    numbers: range = range(1)
    title: str = ""
    names: tuple[str, ...] = ()
    changeable: str = "Only `pool` and output formats without additional columns may change."

    @cached_property
    def only_job(self) -> Job:
        """The job as this shard does it: only the first shard plans the path."""
        job = self.survey_job
        return job if self.shard.number == 1 else job.with_fields(planning=None)

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Fingerprints of scene, survey and planning."""
        return identity_of(self.survey_job)

    @cached_property
    def fields(self) -> Mapping[str, str]:
        """Fields of scene, survey and planning, in words."""
        job = self.survey_job
        return fields_of(job.scene, job.survey, job.planning)


Jobs = OneJob | CampaignSpec  # the jobs of a run


def failed_row(jobs: Jobs, number: int, error: object) -> JobRow:
    """Return the row of a job of a campaign that has failed, and perhaps cannot be made."""
    assert isinstance(jobs, CampaignSpec), "surveys end with their job"
    values: Mapping[str, Value | None] = {}
    with suppress(Exception):  # the values themselves may be the cause
        values = jobs.values(number)
    message = jobs.without_folders(str(error))
    return JobRow(number, jobs.name(number), jobs.split(number), dict(values), message)


class JobMaker:
    """Makes the jobs of a campaign with their sweeps in a thread, a few ahead.

    `numbers` are the numbers of the remaining jobs, and `columns` names of the columns that the
    data set needs.
    """

    def __init__(self, jobs: Jobs, numbers: Iterable[int], columns: Sequence[str]) -> None:
        assert isinstance(jobs, CampaignSpec), "surveys have their job"
        self._campaign = jobs
        self._numbers = numbers
        self._columns = columns
        self._cache = SceneCache()
        self._ready: Queue[Job | JobRow | BaseException | None] = Queue(MAX_READY)
        self._stopped = Event()
        self._full = False  # True while the thread waits because of the memory of scenes
        self.ended = False  # True after the last job was taken
        self._thread = Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def take(self, *, wait: bool = False) -> Job | JobRow | None:
        """Return the next job, or the row of a job that cannot be made.

        None after the last job, or without `wait` while no job is ready.
        """
        try:
            entry = None if self.ended else self._ready.get(block=wait)
        except Empty:
            return None
        self.ended |= entry is None
        if isinstance(entry, BaseException):
            raise entry
        return entry

    def has(self, jobs: int) -> bool:
        """Return True if `jobs` jobs are ready, or the thread waits until jobs are taken."""
        waits = self._full or not self._thread.is_alive()
        return waits or self._ready.qsize() >= min(jobs, MAX_READY)

    def _work(self) -> None:
        end_marker: BaseException | None = None
        try:
            for number in self._numbers:
                if not self._put(self._make(number)):
                    return
        except BaseException as error:
            end_marker = error
        self._put(end_marker)

    def _make(self, number: int) -> Job | JobRow:
        try:
            job = self._campaign.job(number, self._cache, self._columns)
            _ = job.sweeps  # computed in this thread, for they take a while
            return job
        except MemoryError:
            raise
        except Exception as error:
            # A class of the user's own may raise anything: the other jobs go on.
            reason = str(error) if isinstance(error, LidarError) else repr(error)
            return failed_row(self._campaign, number, reason)

    def _put(self, entry: Job | JobRow | BaseException | None) -> bool:
        """Put an entry into the queue, and return False if the maker was stopped before."""
        while not self._stopped.is_set():
            scenes = [ready.scene for ready in [*self._ready.queue] if isinstance(ready, Job)]
            self._full = len({id(scene.vertices) for scene in scenes}) > MAX_SCENES
            if self._full:
                time.sleep(0.05)
                continue
            with suppress(Full):
                self._ready.put(entry, timeout=0.1)
                return True
        return False

    def close(self) -> None:
        """Stop making jobs."""
        self._stopped.set()
        self._thread.join(STOP_S)

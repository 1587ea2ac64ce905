"""Sources of a run's jobs, which are either the single job of a survey or a campaign."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from lidarfiles.datasets.job_table import JobRow, Value
from lidarfiles.identity.field_words import describe_fields
from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario.job import Job
from lidarscenario.plan import Planning
from lidarscenario.shard import ALL, Shard
from lidarscenario.static_scene import SceneCache
from lidarsim.errors import LidarError
from lidarsim.media.weather import Weather
from lidarsim.scene.scene import Scene
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import CloudOptions, Mounted, Survey

from .pipeline.failures import JobError

if TYPE_CHECKING:
    from lidarscenario.campaign.campaign import CampaignSpec

MAX_READY = 16  # jobs that are created in advance, because small jobs are cast together
MAX_SCENES = 2  # maximum number of scenes in the jobs that are created in advance
STOP_S = 10.0  # time limit for a job that is still being created when the run ends
CONTENT = ("scene", "survey", "planning")  # fields of a job that determine its result


def input_fingerprints(job: Job) -> dict[str, str]:
    """Return the fingerprints of a job's scene, survey and planning.

    Jobs with the same fingerprints produce the same bytes.

    Raises
    ------
    JobError
        If a sensor, column or trajectory has a field that cannot be hashed.
    """
    try:
        return {name: fingerprint(getattr(job, name)) for name in CONTENT}
    except LidarError as error:
        raise JobError(str(error)) from error


def describe_inputs(scene: Scene, survey: Survey, planning: Planning | None) -> dict[str, str]:
    """Describe the fields that determine a result, keyed by their path in a scenario.

    Positions are in the local coordinates of the scene.
    """
    size_m = np.ptp(scene.bounds, axis=0)
    values: dict[str, Any] = {
        "scene": {
            "objects": len(scene.object_names),
            "triangles": scene.triangles,
            "size": " x ".join(f"{side:.6g}" for side in size_m) + " m",
        }
    }
    for carried in survey.mounted_sensors:
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
class SingleJob:
    """Source whose only job is a survey or one of its shards."""

    survey_job: Job
    shard: Shard = ALL
    numbers: range = range(1)
    title: str = ""
    names: tuple[str, ...] = ()
    changeable: str = "Only `pool` and output formats without additional columns may change."

    @cached_property
    def only_job(self) -> Job:
        """Job of this shard, which includes path planning only in the first shard."""
        job = self.survey_job
        return job if self.shard.number == 1 else job.with_fields(planning=None)

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Fingerprints of the scene, survey and planning."""
        return input_fingerprints(self.survey_job)

    @cached_property
    def fields(self) -> Mapping[str, str]:
        """Descriptions of the fields in the scene, survey and planning."""
        job = self.survey_job
        return describe_inputs(job.scene, job.survey, job.planning)


Jobs: TypeAlias = "SingleJob | CampaignSpec"  # source of the jobs in a run


def failed_row(jobs: Jobs, number: int, error: object) -> JobRow:
    """Return the table row of a campaign job that has failed."""
    assert not isinstance(jobs, SingleJob), "a survey fails together with its job"
    values: Mapping[str, Value | None] = {}
    with suppress(Exception):  # the values may be the cause of the error
        values = jobs.values(number)
    message = jobs.strip_folders(str(error))
    return JobRow(number, jobs.name(number), jobs.split(number), dict(values), message)


class JobProducer:
    """Thread that prepares the jobs of a campaign and their sweeps in advance.

    Parameters
    ----------
    jobs
        The campaign.
    numbers
        Numbers of the remaining jobs.
    columns
        Names of the columns that the data set requires.
    """

    def __init__(self, jobs: Jobs, numbers: Iterable[int], columns: Sequence[str]) -> None:
        assert not isinstance(jobs, SingleJob), "the job of a survey already exists"
        self._campaign = jobs
        self._numbers = numbers
        self._columns = columns
        self._cache = SceneCache()
        self._ready: Queue[Job | JobRow | BaseException | None] = Queue(MAX_READY)
        self._stopped = Event()
        self._full = False  # True while the thread waits to limit the memory of scenes
        self.ended = False  # True after the last job has been taken
        self._thread = Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def pop(self, *, wait: bool = False) -> Job | JobRow | None:
        """Remove and return the next job, or the table row of a job that cannot be created.

        Return None after the last job or, unless `wait` is True, if no job is ready.
        """
        try:
            entry = None if self.ended else self._ready.get(block=wait)
        except Empty:
            return None
        self.ended |= entry is None
        if isinstance(entry, BaseException):
            raise entry
        return entry

    def has_ready(self, jobs: int) -> bool:
        """Return True if this number of jobs is ready, or if no further jobs will be ready."""
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
            _ = job.sweeps  # computed here, because it takes some time
            return job
        except MemoryError:
            raise
        except Exception as error:
            # User-defined classes may raise any error, which must not affect the other jobs.
            reason = str(error) if isinstance(error, LidarError) else repr(error)
            return failed_row(self._campaign, number, reason)

    def _put(self, entry: Job | JobRow | BaseException | None) -> bool:
        """Put an entry into the queue, and return False if the thread was stopped meanwhile."""
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
        """Stop the thread."""
        self._stopped.set()
        self._thread.join(STOP_S)

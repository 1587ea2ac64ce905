"""What a campaign keeps: which jobs have ended, and the stores of those that are under way."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..base.errors import LidarpoolError
from ..base.software import software
from ..base.storage import Storage
from ..export.jobs import JobRow
from ..pipeline.database import mark_of_folder, parts_folder
from .identity import OF_CAMPAIGN
from .job import Job
from .store import JOBS, KeptRun, RunStore, drop_run, jobs_of

SENSORS_TOLD = 8  # kinds of a sensor that are named


class CampaignStore(KeptRun):
    """The database of a campaign, and the place of its parts.

    `identity` is the campaign's, `count` how many jobs it has; others as of `KeptRun`.
    """

    def __init__(
        self,
        identity: Mapping[str, str],
        count: int,
        backend: str,
        place: Storage,
        parts: str | Path | None = None,
        *,
        resume: bool = False,
    ) -> None:
        self.count = count
        whole = software() | {OF_CAMPAIGN + name: value for name, value in identity.items()}
        super().__init__(whole, 0, backend, place, parts, resume=resume)
        self.resumed = len(self.db.jobs)  # jobs of an earlier run

    @property
    def kept(self) -> str:
        """Jobs that have ended, in words; empty if none was begun."""
        begun = self.db.used or jobs_of(self.place)
        return f"{len(self.db.jobs):,} of {self.count:,} jobs" if begun else ""

    @property
    def left(self) -> list[int]:
        """Numbers of the jobs that have not ended."""
        return [number for number in range(self.count) if number not in self.db.jobs]

    def forget(self, numbers: Iterable[int]) -> None:
        """Let some jobs be done again."""
        if forgotten := [*numbers]:
            self.db.forget_jobs(forgotten)
            self.resumed = len(self.db.jobs)

    def take_over(self, made: Mapping[str, Any], rows: Iterable[JobRow]) -> None:
        """Begin with the jobs of a finished data set, whose record is given."""
        kept = {name: json.dumps(made[name]) for name in ("casting", "sensors")}
        self.db.set(backend=made["backend"], **kept)
        self.db.end_jobs((row.number, bool(row.error), asdict(row)) for row in rows)
        self._go_on(self.identity, True, {})
        self.resumed = len(self.db.jobs)

    def rows(self) -> Iterator[JobRow]:
        """Yield the rows of the jobs that have ended, by number."""
        for row in self.db.job_rows():
            classes = {int(number): count for number, count in row.pop("classes").items()}
            yield JobRow(classes=classes, **row)

    def end(self, row: JobRow) -> None:
        """Commit that a job has ended."""
        self.db.end_jobs([(row.number, bool(row.error), asdict(row))])

    @property
    def sensors(self) -> dict[str, str]:
        """Sensors of the jobs that are done, {name: models and rates}."""
        found: dict[str, str] = json.loads(self.db.meta.get("sensors", "{}"))
        return found

    def name_sensors(self, sensors: Iterable[tuple[str, str]]) -> None:
        """Keep names of sensors with model and rate, for the card of the data set."""
        kept = self.sensors
        for name, words in sensors:
            told = kept.setdefault(name, words).split("; ")
            if words not in told and len(told) <= SENSORS_TOLD:
                more = words if len(told) < SENSORS_TOLD else "and others"
                kept[name] = "; ".join([*told, more])
        if kept != self.sensors:
            self.db.set(sensors=json.dumps(kept))

    # -- jobs under way --------------------------------------------------------------------

    def store_of(self, name: str, job: Job) -> RunStore:
        """Open the store of a job, with what an earlier run has left of it."""
        self.place.prepare(JOBS)
        # The campaign keeps with which backend and software all of its jobs are cast.
        place = self.place.below(f"{JOBS}/{name}")
        with suppress(LidarpoolError):  # damaged, or files that the description names have changed
            return RunStore(job, place, self.storage, resume=True, backend="auto")
        drop_run(place)
        return RunStore(job, place, self.storage, resume=True, backend="auto")

    def remove(self) -> None:
        """Remove the store, and parts of jobs that were written late: their jobs had them twice."""
        for name in self.storage.entries():
            if mark := mark_of_folder(name):
                with suppress(OSError):
                    own = [file for file in self.storage.tree(name) if f"{mark}-" in file]
                    self.storage.prune(own)
        super().remove()

    def folder_of(self, store: RunStore) -> str:
        """Folder of a job's parts in the storage of the campaign."""
        return f"{parts_folder(store.db.meta['mark'])}/"

"""Stores of runs, from which runs can be resumed. A store has a database and parts."""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from lidarfiles.datasets.job_table import JobRow
from lidarfiles.identity.field_words import describe_changes
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.identity.versions import software
from lidarfiles.parts.parts import deletable_files, mark_name, parse_part_name
from lidarscenario.job import Job
from lidarscenario.shard import ALL, describe_shard
from lidarsim.casting.scene_caster import AUTO_ADVICE
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage
from lidarsim.sensor import Sensor
from lidarsim.words import format_rounded

from ..job_source import CONTENT, Jobs, input_fingerprints
from ..pipeline.committed_results import CommittedResults
from ..pipeline.failures import convert_storage_errors
from .database import (
    FILE,
    PARTS_FOLDER,
    DamagedError,
    RunDatabase,
    parts_folder,
    read_parts_location,
)
from .part_check import check_parts
from .remote import OWNER, RemoteRun, fetch_database
from .stored_job import StoredJob

PARTS = "parts"  # subfolder of the run folder that contains the parts
RUN_FOLDER = "run"  # subfolder of the output folder that contains the run until it is complete
MAX_SENSOR_KINDS = 8  # maximum number of sensor models that are listed
_AND_OTHERS = "and others"

# Options for the command line and for Python.
_RESUME = "`--resume` (`resume=True` in Python)"
_DROP = "`--restart` (`remove_run` in Python)"


class _EarlierDatabase(NamedTuple):
    """Database of an earlier run in the same location."""

    db: RunDatabase | None = None  # open database, or None if no result is committed
    mark: str = ""  # mark of a run without committed results
    parts_location: str = ""  # location of its parts, or empty for the run folder
    damage: DamagedError | None = None  # error if the database cannot be read


class RunStore:
    """Database of a run, and folder with the parts of the run's jobs.

    If the database is missing or damaged, it is rebuilt. The mark file in the parts folder contains
    the initial values of the database, and each part contains the data of its receipt.

    Parameters
    ----------
    jobs
        Jobs of the run. A run can only be resumed if their identity is unchanged.
    backend
        Requested ray-casting backend.
    location
        Folder or URL of the run, or None for a temporary folder, which is deleted when its points
        are no longer in use.
    parts_location
        Path or URL of a different location for the parts, in which they get a separate folder. A
        resumed run continues to use the previous location of its parts.
    resume
        Whether to continue an existing run. If False, the location must not contain a run.
    warnings
        Warnings about the scenario, which precede the notes of the run.

    Raises
    ------
    LidarError
        If `location` contains an unfinished run and `resume` is False, if the run cannot be resumed
        because it has different jobs, a different backend or is in use, or if `parts_location` is
        given without `location`.
    """

    def __init__(
        self,
        jobs: Jobs,
        backend: str = "auto",
        location: str | Path | Storage | None = None,
        parts_location: str | Path | Storage | None = None,
        *,
        resume: bool = False,
        warnings: Sequence[str] = (),
    ) -> None:
        self.opened_at = time.monotonic()
        if parts_location is not None and location is None:
            raise LidarError(
                "`scratch_dir` requires `folder`, because the database in that folder lists the "
                "parts."
            )
        self.jobs = jobs
        self._requested_backend = backend
        self.lasting = location is not None
        self.warnings = (*warnings,)
        self.notes: list[str] = []  # notes for the user
        self.begun = False  # True if this run continues an earlier run
        self._removed = False
        self.identity = software() | dict(jobs.identity)
        self._run_identity = self.identity | {"shard": str(jobs.shard)}
        self._remote = None
        self.location = Storage.at(
            tempfile.mkdtemp(prefix="lidarpool-") if location is None else location
        )
        self._folder = self.location  # folder of the database
        if not self.location.is_local:
            self._remote = RemoteRun(self.location)
            self._folder = Storage.at(tempfile.mkdtemp(prefix="lidarpool-"))
        folder = self._folder.local()
        if location is None or self._remote:
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        advice = "Create its parent folder first, or choose a different folder"
        with explain_os_errors(f"The run folder {folder} cannot be created", advice):
            folder.mkdir(exist_ok=True)
        self.in_flight: dict[int, StoredJob] = {}  # {number: job that has not ended}
        # Jobs in flight whose input hashes are stored, so that a later run can recognize them.
        self._identified: set[int] = set()
        self.only_job: StoredJob | None = None  # job of a survey, or None for a campaign
        with ExitStack() as undo:
            undo.callback(self._folder.remove, [], folder=True)
            self.db = self._open(parts_location, resume)
            undo.callback(self.close)
            self._claim(resume)
            undo.pop_all()
        self.resumed = self.db.ended_count  # number of jobs from an earlier run

    def _open(self, parts_location: str | Path | Storage | None, resume: bool) -> RunDatabase:
        """Open the run's database, or create it if it is missing or has no results."""
        path = _database_path(self._folder)
        durable = self.lasting and self._remote is None
        earlier = self._open_earlier(path, durable)
        if earlier.db is not None:
            self.begun = True
            return earlier.db
        meta = self._recover_meta(path, earlier.mark, parts_location) if resume else None
        if meta is None:
            self._discard(earlier)
        path.unlink(missing_ok=True)
        self._folder.prepare()
        if meta is None:
            mark = secrets.token_hex(8)
            shared = (
                Storage.at(parts_location).path(parts_folder(mark))
                if parts_location is not None
                else ""
            )
            meta = {"mark": mark, "identity": json.dumps(self._run_identity), "parts": shared}
            meta["fields"] = json.dumps(dict(self.jobs.fields))
        try:
            return RunDatabase(path, durable=durable, **meta)
        except LidarError:
            if path.exists() and not path.stat().st_size:  # the disk is full
                path.unlink()
                path.with_name(f"{FILE}-journal").unlink(missing_ok=True)  # SQLite 3.37 leaves it
            raise

    def _open_earlier(self, path: Path, durable: bool) -> _EarlierDatabase:
        """Open the database of an earlier run, if there is one."""
        try:
            if self._remote:
                fetch_database(self._remote.storage, path)
            if not path.exists():
                return _EarlierDatabase()
            db = RunDatabase(path, durable=durable)
            if db.has_results:
                return _EarlierDatabase(db)
            db.close()
            return _EarlierDatabase(mark=db.meta["mark"], parts_location=db.meta.get("parts", ""))
        except DamagedError as error:
            return _EarlierDatabase(damage=error)
        except LidarError as error:  # the local copy of the database is unknown to the user
            raise LidarError(str(error).replace(self._folder.url, self.location.url)) from error

    def _recover_meta(
        self, path: Path, earlier_mark: str, parts_location: str | Path | Storage | None
    ) -> dict[str, str] | None:
        """Restore the initial values of a lost database.

        They are read from the mark file in the parts folder. Return None if there is no mark file.
        `earlier_mark` is the mark of an existing database without results, or an empty string.
        Raise LidarError if the database belongs to a different program, or if the earlier run
        differs from this run.
        """
        meta = self._read_mark(parts_location)
        if meta is None or (earlier_mark and self._difference(meta)):
            return None
        read_parts_location(path)  # raises if the database belongs to a different program
        self._check_same(meta)
        self.begun = True
        if not earlier_mark:
            self.notes.append(f"{FILE} was missing or damaged and was rebuilt from the parts")
        return meta

    def _discard(self, earlier: _EarlierDatabase) -> None:
        """Remove an earlier run without results, or raise LidarError if its database is damaged."""
        if earlier.damage is not None:
            reason = str(earlier.damage).replace(self._folder.url, self.location.url)
            raise LidarError(reason) from earlier.damage
        if self.lasting:
            _remove(self.location, parts_of(self.location, earlier.parts_location), earlier.mark)

    def _read_mark(self, parts_location: str | Path | Storage | None) -> dict[str, str] | None:
        """Read the initial values of this run's database from the mark file."""
        locations = [self.location.below(PARTS)]
        if parts_location is not None:
            shared = Storage.at(parts_location)
            folders = filter(PARTS_FOLDER.fullmatch, shared.entries())
            locations = [shared.below(name) for name in folders]
        for location in locations:
            for name in location.sizes():
                with suppress(ValueError, LookupError, TypeError, AttributeError, OSError):
                    values = json.loads(location.read(name)) if name.endswith("-mark") else {}
                    if values.pop("place") == self.location.url and name == mark_name(
                        values["mark"]
                    ):
                        return {key: str(value) for key, value in values.items()}
        return None

    def _claim(self, resume: bool) -> None:
        """Find existing parts, check the earlier run, and write the mark file."""
        self.storage = replace(parts_of(self.location, self.db.meta["parts"]), durable=self.lasting)
        with explain_os_errors(f"{self.storage.url} cannot be listed"):
            self._sizes = self.storage.sizes()  # fails if the location is not accessible
        self._strays: dict[int, list[str]] = {}  # {job: names of existing parts}
        for name in self._sizes:
            if resume and (scans := parse_part_name(name, self.db.meta["mark"])) is not None:
                self._strays.setdefault(scans[0], []).append(name)
        if self.db.has_results:
            self._check_same(self.db.meta)
        if (only_job := self.jobs.only_job) is not None:
            self.only_job = self._load(only_job)
            self._identified.add(only_job.number)  # the identity of the run identifies it
        if self.db.has_results:
            self._check_resumable(resume)
        if self._remote:
            self._remote.claim(self.db)
        if mark_name(self.db.meta["mark"]) not in self._sizes:
            with convert_storage_errors(self.storage):
                self.storage.prepare()
                self._write_mark()
        if self.only_job is not None:  # after it is certain that the run is the same
            strays = self._strays.get(self.only_job.job.number, ())
            self.only_job = self._check(self.only_job, strays)

    def _write_mark(self) -> None:
        names = ("mark", "identity", "fields", "parts", "backend", "casting")
        values = {name: self.db.meta[name] for name in names if name in self.db.meta}
        values["place"] = self.location.url
        self.storage.write(mark_name(values["mark"]), json.dumps(values).encode())

    def _check_resumable(self, resume: bool) -> None:
        """Raise LidarError if the options do not allow continuing the existing run."""
        if not resume:
            raise LidarError(
                f"{self.location} contains an unfinished run with {self.committed_text}. "
                f"Continue it with {_RESUME}, or remove it with {_DROP}."
            )
        if self.backend and self._requested_backend not in ("auto", self.backend):
            raise LidarError(
                f"The scans in {self.location} were cast with the backend {self.backend!r}, so "
                f"the run cannot continue with {self._requested_backend!r}. Use "
                f"{self.backend!r}, or remove the scans with {_DROP}."
            )

    def _difference(self, meta: Mapping[str, str]) -> str:
        """Describe in a sentence how the run in a database differs from this run.

        Return an empty string if it does not differ.
        """
        earlier = json.loads(meta["identity"])
        for name, value in self._run_identity.items():
            if earlier.get(name) != value:
                if name == "shard":
                    shards = str(earlier.get(name)), str(value)
                    earlier_shard, requested_shard = map(describe_shard, shards)
                    return f"it is {earlier_shard} rather than {requested_shard}."
                if name != "lidarpool":
                    changed = describe_changes(
                        json.loads(meta.get("fields", "{}")), self.jobs.fields
                    )
                    kind = name if name in CONTENT else "campaign"
                    differs = f"the {kind} has changed{f': {changed}' if changed else ''}"
                    return f"{differs}. {self.jobs.changeable}"
                return (
                    f"it was started with {name} {earlier.get(name, '(unknown version)')}, but "
                    f"this is {name} {value}."
                )
        return ""

    def _check_same(self, meta: Mapping[str, str]) -> None:
        """Raise LidarError if the earlier run in this location differs from this run."""
        if difference := self._difference(meta):
            raise LidarError(
                f"The run in {self.location} cannot be continued because {difference} Remove it "
                f"with {_DROP}, or choose a different folder."
            )

    # -- reading ---------------------------------------------------------------------------

    @property
    def backend(self) -> str:
        """Backend with which scans are cast, or an empty string if it is not known yet."""
        return self.db.meta.get("backend", "")

    @property
    def casting(self) -> dict[str, str]:
        """Software of the workers that cast scans, or an empty dictionary if not known yet."""
        return dict(json.loads(self.db.meta.get("casting", "{}")))

    def cast_with(self, backend: str, casting: Mapping[str, str]) -> None:
        """Store the backend and software with which all scans are cast."""
        if backend != self.backend or casting != self.casting:
            self.db.set(backend=backend, casting=json.dumps(casting))
            with convert_storage_errors(self.storage):
                self._write_mark()

    @property
    def fields(self) -> Mapping[str, str]:
        """Descriptions of the fields that determine the results, keyed by field path."""
        return dict(json.loads(self.db.meta.get("fields", "{}")))

    @property
    def made_with(self) -> dict[str, Any]:
        """Identity, backend and software of the run, as recorded in manifests."""
        identity = fingerprint(dict(self.identity))
        return {"identity": identity, "backend": self.backend, "casting": self.casting}

    @property
    def committed_text(self) -> str:
        """Description of what has been committed, such as "3 of 10 jobs", or an empty string."""
        if self.only_job is not None:
            return self.only_job.committed_text
        return (
            f"{self.db.ended_count:,} of {len(self.jobs.numbers):,} jobs"
            if self.db.has_results
            else ""
        )

    @property
    def advice(self) -> str:
        """Advice at the end of the error message about an unavailable backend."""
        if not self.committed_text:
            return AUTO_ADVICE
        return (
            f"The scans in {self.location} were cast with this backend. Continue the run where "
            f"this backend is available, or remove the scans with {_DROP}."
        )

    def rows(self) -> Iterator[JobRow]:
        """Yield the table rows of all ended jobs, sorted by job number."""
        for row in self.db.job_rows():
            yield JobRow.from_json(row)

    @property
    def sensors(self) -> dict[str, str]:
        """Models and rates of the sensors in finished jobs, keyed by sensor name."""
        return dict(json.loads(self.db.meta.get("sensors", "{}")))

    def note_nothing_to_resume(self, target: object) -> None:
        """Add a note if the user asked to resume a survey that has no unfinished run.

        The note names `target`, the location of the result.
        """
        # Tasks in a job array resume their shards even if the shards have not been started yet.
        is_explained = self.committed_text or self.notes or self.jobs.shard != ALL
        if self.only_job is not None and not is_explained:
            self.notes.append(f"{target} contained no unfinished run to resume")

    # -- jobs --------------------------------------------------------------------------------

    def open_job(self, job: Job) -> StoredJob:
        """Open a job, and check any parts that an earlier run has stored for it."""
        number = job.number
        if number in self.in_flight:
            return self.in_flight[number]
        stored = self._load(job)
        strays = self._strays.pop(number, ())
        if number not in self.db.begun and not strays:
            return stored
        earlier_hash = self.db.input_hash(number)
        if earlier_hash and earlier_hash == _hash_inputs(job):
            self._identified.add(number)
            return self._check(stored, strays)
        # The input files have changed, or the earlier run died before it stored the hash.
        self.db.restart(stored.committed)
        self.storage.remove(strays)
        return self._add(replace(stored, resumed=0))

    def _load(self, job: Job) -> StoredJob:
        """Add a job in flight, and read its committed results from the database."""
        is_only = self.jobs.only_job is not None
        count = job.survey.scan_count
        scans = self.jobs.shard.scans(count) if is_only else range(count)
        committed = CommittedResults(job.number, scans, has_frames=is_only)
        self.db.read(committed)
        resumed = committed.parts.scans_done
        return self._add(StoredJob(job, committed, self.storage, self.db, resumed, keeper=self))

    def _check(self, stored: StoredJob, strays: Sequence[str]) -> StoredJob:
        self.notes += check_parts(stored, self.db, self._sizes, strays)
        return self._add(replace(stored, resumed=stored.parts.scans_done))

    def _add(self, stored: StoredJob) -> StoredJob:
        self.in_flight[stored.job.number] = stored
        return stored

    def reassign_points(self, job: Job) -> None:
        """Use all committed points for `job`, as if they had been cast in this run."""
        assert self.only_job is not None, "the run is a survey"
        self.only_job.committed.advance_frames(self.only_job.scans.stop)
        self.only_job = self._add(replace(self.only_job, job=job, resumed=0))

    def commit_jobs(self, rows: Sequence[JobRow]) -> list[tuple[JobRow, StoredJob]]:
        """Commit the rows of ended jobs.

        Returns the rows of the jobs that were in flight, each with its job. The models and rates of
        their sensors are also stored, for the data set card.
        """
        ended = [(row, self.in_flight[row.number]) for row in rows if row.number in self.in_flight]
        named = (
            (mounted.name or "lidar", _describe_model(mounted.sensor))
            for row, stored in ended
            if row.done
            for mounted in stored.job.survey.mounted_sensors
        )
        sensors = add_sensors(self.sensors, named)
        if sensors != self.sensors:
            self.db.set(sensors=json.dumps(sensors))
        self.db.end_jobs((row.number, bool(row.error), asdict(row)) for row in rows)
        for row in rows:
            self.in_flight.pop(row.number, None)
            self._identified.discard(row.number)
        return ended

    def reset_jobs(self, numbers: Iterable[int]) -> None:
        """Reset ended jobs, so that they are cast again."""
        if forgotten := [*numbers]:
            self.db.forget_jobs(forgotten)
            self.resumed = self.db.ended_count

    def add_finished(self, rows: Iterable[JobRow], **meta: str) -> None:
        """Add jobs that the data set already contains, and store values of `meta`."""
        if meta:
            self.db.set(**meta)
        self.commit_jobs([row for row in rows if not self.db.has_ended(row.number)])
        self.resumed = self.db.ended_count

    # -- the end -----------------------------------------------------------------------------

    def save(self, *, force: bool = False) -> None:
        """Store the number of delivered frames, and the input hashes of partially cast jobs.

        If the run is in remote storage, the database is also copied there if a copy is due or if
        `force` is True. Raise LidarError if this fails, or if another run has taken over.
        """
        for number, stored in self.in_flight.items():
            begun = stored.parts.scans_done and not stored.is_complete
            if begun and number not in self._identified:
                self._identified.add(number)
                self.db.set_input_hash(number, _hash_inputs(stored.job))
        self.db.save_frames(stored.committed for stored in self.in_flight.values())
        if self._remote:
            self._remote.save(self.db, force=force)

    def close_with_points(
        self, scenario_source: Mapping[str, Any] | None, notes: Sequence[str]
    ) -> None:
        """Close the store and keep its points.

        If `scenario_source` is given, it is stored together with the notes.
        """
        if scenario_source is not None:
            self.db.set(scenario_source=json.dumps(scenario_source), notes=json.dumps(notes))
            self.save(force=True)
        self.db.close()

    def remove_orphaned_parts(self) -> None:
        """Remove parts of dead or replaced collectors, unless a job in flight needs them."""
        mark = self.db.meta["mark"]
        part_names = [part.name for job in self.in_flight.values() for part in job.parts.ordered]
        needed_names = {mark_name(mark), *part_names}
        with suppress(OSError, LidarError):
            self.storage.remove(
                [n for n in deletable_files(self.storage, mark) if n not in needed_names]
            )

    def remove(self) -> None:
        """Remove the store after the result has been published, but no files of other runs."""
        if self._remote:
            self._remote.check()
        self._removed = True
        self.db.close()
        _remove(self.location, self.storage, self.db.meta["mark"])

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """If the body fails, add a note that explains how to resume, or remove the empty store."""
        try:
            yield
        except BaseException as error:
            if self._removed or not self.lasting:
                raise
            with suppress(LidarError):  # the first error is reported instead
                self.save(force=True)
            if self._remote and self._remote.lost:
                self.db.close()
                raise
            committed = self.committed_text
            self.close()
            if committed and self._folder.local(FILE).exists():
                error.add_note(
                    f"{committed} are stored in {self.location}. Continue with {_RESUME}."
                )
            raise

    def close(self) -> None:
        """Close the database of an unfinished run, and remove the store if it is empty."""
        used = self.db.has_results or self.begun
        self.db.close()
        if not used:
            with suppress(OSError, LidarError):
                _remove(self.location, self.storage, self.db.meta["mark"])
            self._folder.remove([FILE])  # remove it even if the parts storage has failed


def add_sensors(sensors: Mapping[str, str], added: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Add sensors to descriptions of sensor models.

    The result does not depend on the order in which sensors are added.

    Parameters
    ----------
    sensors
        Descriptions of the models by sensor name, separated by semicolons.
    added
        Names of further sensors and descriptions of their models.
    """
    merged = dict(sensors)
    for name, words in added:
        kinds = {*merged.get(name, words).split("; "), *words.split("; ")}
        names = sorted(kinds - {_AND_OTHERS})
        suffix = [_AND_OTHERS] * (_AND_OTHERS in kinds or len(names) > MAX_SENSOR_KINDS)
        merged[name] = "; ".join([*names[:MAX_SENSOR_KINDS], *suffix])
    return dict(sorted(merged.items()))


def _describe_model(sensor: Sensor) -> str:
    return f"{sensor.model}, {format_rounded(1e9 / sensor.revolution_start_ns(1))} Hz"


def _hash_inputs(job: Job) -> str:
    """Return the hash of a job's inputs, or an empty string if they cannot be hashed.

    A job without a hash cannot be resumed.
    """
    try:
        return fingerprint(input_fingerprints(job))
    except LidarError:
        return ""


def _database_path(folder: Storage) -> Path:
    """Return the path of the database in a local folder.

    Raise LidarError if the file is a symbolic link.
    """
    folder.local(f"{FILE}-journal")  # SQLite would follow a link to the journal, too
    return folder.local(FILE)


def parts_of(location: Storage, parts_location: str) -> Storage:
    """Return the storage of a run's parts.

    If `parts_location` is empty, the parts are stored in a subfolder of the run's location.
    """
    folder, _, name = parts_location.rpartition("/")
    return Storage.at(folder or "/").below(name) if parts_location else location.below(PARTS)


def remove_run(folder: str | Path | Storage) -> None:
    """Remove a stored run and its parts, but no other files.

    The parts are removed even if they are stored in a different location. If the database is
    damaged, only the parts in the folder of the run can be found.

    Parameters
    ----------
    folder
        Folder or URL of the run.

    Raises
    ------
    LidarError
        If another run is using the database, if the files cannot be removed, or if a file of the
        run is a symbolic link.
    """
    location = Storage.at(folder)
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        path = _database_path(location if location.is_local else Storage.at(temporary))
        if not location.is_local:
            fetch_database(location, path)
        try:
            parts_location = read_parts_location(path)
        except LidarError as error:
            raise LidarError(str(error).replace(temporary, location.url)) from error
        mark, parts = parts_location or (None, "")
        _remove(location, parts_of(location, parts), mark)


def _remove(location: Storage, part_storage: Storage, mark: str | None) -> None:
    """Remove the database of a run, and the parts with the run's mark.

    If `mark` is None because the database cannot be read, the parts of all mark files in the parts
    folder are removed.
    """
    with explain_os_errors(f"The run in {location} cannot be removed"):
        names = deletable_files(part_storage, mark)  # fails if the folder is a symbolic link
        part_storage.remove(names, folder=True)
        location.remove([FILE, f"{FILE}-journal", OWNER], folder=True)

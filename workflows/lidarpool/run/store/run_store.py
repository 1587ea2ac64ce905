"""What a run keeps, in a folder or storage: database and parts, for a later run to go on from."""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked
from lidarsim.simulator.scene_caster import AUTO_TAKES

from ...base.fingerprint import fingerprint
from ...base.shard import shard_in_words
from ...base.software import software
from ...columns.parts import mark_name, own_files, scans_of
from ...datasets.job_table import JobRow
from ...scenario.build import Job
from ..job_source import CONTENT, Jobs, identity_of
from ..pipeline.failures import storing
from .database import FILE, PARTS_FOLDER, DamagedError, RunDatabase, parts_folder, read_place
from .job_under_way import JobUnderWay
from .part_check import check_parts
from .remote import OWNER, RemoteRun, fetch_database

PARTS = "parts"  # the folder of the parts, in the run's folder
RUN_FOLDER = "run"  # the run's folder in the output folder, until the result is complete
SENSORS_NAMED = 8  # kinds of a sensor that are named
_OTHERS = "and others"

# On the command line, and in Python.
_RESUME = "--resume (in Python resume=True)"
_DROP = "--fresh (in Python remove_run)"


class RunStore:
    """What a run keeps of its jobs, one or many: a database, and the folder of their parts.

    The file in the folder of the parts that says whose they are has what the database begins with,
    and each part has its receipt: where the database is missing or damaged, it is made again.

    Parameters
    ----------
    jobs
        What the run does; what their results depend on must be the same for a run to go on.
    backend
        The one that is asked for.
    place
        Where it is kept, a folder or a URL; None for a temporary folder that goes with the
        last user of the points.
    parts
        Another place for the parts, a path or URL, in which they get their own folder. A resumed
        run uses the place of its parts.
    resume
        Whether to continue an existing run; otherwise there must be none.

    LidarError if it holds an unfinished run and that is not to be resumed, or cannot be: it is
    of other jobs, in use, or cast with another backend than is asked for; or if there are `parts`
    without a `place`, whose database says which parts there are.
    """

    def __init__(
        self,
        jobs: Jobs,
        backend: str = "auto",
        place: str | Path | Storage | None = None,
        parts: str | Path | Storage | None = None,
        *,
        resume: bool = False,
    ) -> None:
        if parts is not None and place is None:
            raise LidarError(
                "parts are given a place, and nothing would know of them afterwards: give a "
                "folder for the run as well."
            )
        self.jobs = jobs
        self._requested_backend = backend
        self.lasting = place is not None
        self.notes: list[str] = []  # remarks for the user
        self.begun = False  # True if it continues an earlier run
        self._removed = False
        self.identity = software() | dict(jobs.identity)
        self._run_identity = self.identity | {"shard": str(jobs.shard)}
        self._remote = None
        self.place = Storage.at(tempfile.mkdtemp(prefix="lidarpool-") if place is None else place)
        self._folder = self.place  # of the database
        if not self.place.is_local:
            self._remote = RemoteRun(self.place)
            self._folder = Storage.at(tempfile.mkdtemp(prefix="lidarpool-"))
        folder = self._folder.local()
        if place is None or self._remote:
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        advice = "make the one that it lies in first, or give another"
        with explained(f"The run's folder {folder} cannot be made", advice):
            folder.mkdir(exist_ok=True)
        self.under_way: dict[int, JobUnderWay] = {}  # {number: job}
        self.only: JobUnderWay | None = None  # the only job, of a survey; None for a campaign
        with ExitStack() as undo:
            undo.callback(self._folder.remove, [], folder=True)
            self.db = self._open(parts, resume)
            undo.callback(self.close)
            self._claim(resume)
            undo.pop_all()
        self.resumed = self.db.ended_count  # jobs of an earlier run

    def _open(self, parts: str | Path | Storage | None, resume: bool) -> RunDatabase:
        """Open the database, or a new one if nothing is committed in it."""
        path = _database(self._folder)
        durable = self.lasting and self._remote is None
        mark = earlier_parts = ""  # of a run that has kept nothing: mark and place of its parts
        damage: DamagedError | None = None
        try:
            if self._remote:
                fetch_database(self._remote.storage, path)
            if path.exists():
                db = RunDatabase(path, durable=durable)
                if db.used:
                    self.begun = True
                    return db
                db.close()
                mark = db.meta["mark"]
                earlier_parts = db.meta.get("parts", "")
        except DamagedError as error:
            damage = error
        except LidarError as error:  # the copy of a database is nobody's business
            raise LidarError(str(error).replace(self._folder.url, self.place.url)) from error
        new = self._marked(parts) if resume else None
        if new is not None and mark and self._difference(new["identity"]):
            new = None  # it has kept nothing
        if new is not None:
            read_place(path)  # an error if it is another program's
            self._check_same(new["identity"])
            self.begun = True
            lost = f"{FILE} was missing or damaged, and is made again from the parts"
            self.notes += [lost] * (not mark)
        elif damage is not None:
            reason = str(damage).replace(self._folder.url, self.place.url)
            raise LidarError(reason) from damage
        elif self.lasting:
            _remove(self.place, parts_of(self.place, earlier_parts), mark)
        path.unlink(missing_ok=True)
        self._folder.prepare()
        if new is None:
            mark = secrets.token_hex(8)
            shared = Storage.at(parts).path(parts_folder(mark)) if parts is not None else ""
            new = {"mark": mark, "identity": json.dumps(self._run_identity), "parts": shared}
        try:
            return RunDatabase(path, durable=durable, **new)
        except LidarError:
            if path.exists() and not path.stat().st_size:  # the disk is full
                path.unlink()
                path.with_name(f"{FILE}-journal").unlink(missing_ok=True)  # SQLite 3.37 leaves it
            raise

    def _marked(self, parts: str | Path | Storage | None) -> dict[str, str] | None:
        """Return the first values of this run's database, from the folder of its parts."""
        places = [self.place.below(PARTS)]
        if parts is not None:
            shared = Storage.at(parts)
            folders = filter(PARTS_FOLDER.fullmatch, shared.entries())
            places = [shared.below(name) for name in folders]
        for place in places:
            for name in place.sizes():
                with suppress(ValueError, LookupError, TypeError, AttributeError, OSError):
                    values = json.loads(place.read(name)) if name.endswith("-mark") else {}
                    if values.pop("place") == self.place.url and name == mark_name(values["mark"]):
                        return {key: str(value) for key, value in values.items()}
        return None

    def _claim(self, resume: bool) -> None:
        """Find the parts, and mark their folder as this run's."""
        self.storage = replace(parts_of(self.place, self.db.meta["parts"]), durable=self.lasting)
        with explained(f"{self.storage.url} cannot be looked at"):
            self._sizes = self.storage.sizes()  # also an error if the place cannot be opened
        self._strays: dict[int, list[str]] = {}  # {number: parts that an earlier run has left}
        for name in self._sizes if resume else ():
            if (scans := scans_of(name, self.db.meta["mark"])) is not None:
                self._strays.setdefault(scans[0], []).append(name)
        if self.db.used:
            self._check_same(self.db.meta["identity"])
        if (only_job := self.jobs.only_job) is not None:
            self.only = self._take_on(only_job)
        if self.db.used:
            self._go_on(resume)
        if self._remote:
            self._remote.claim(self.db)
        if mark_name(self.db.meta["mark"]) not in self._sizes:
            with storing(self.storage):
                self.storage.prepare()
                self._write_mark()
        if self.only is not None:  # now that the run itself is known to be the same
            strays = self._strays.get(self.only.number, ())
            self.notes += check_parts(self.only, self.db, self._sizes, strays)

    def _write_mark(self) -> None:
        names = ("mark", "identity", "parts", "backend", "casting")
        values = {name: self.db.meta[name] for name in names if name in self.db.meta}
        values["place"] = self.place.url
        self.storage.write(mark_name(values["mark"]), json.dumps(values).encode())

    def _go_on(self, resume: bool) -> None:
        """Check that this run may continue the existing one, which is the same."""
        if not resume:
            raise LidarError(
                f"{self.place} holds an unfinished run, {self.kept}: continue it with "
                f"{_RESUME}, or drop it with {_DROP}."
            )
        if self.backend and self._requested_backend not in ("auto", self.backend):
            raise LidarError(
                f"Backend {self._requested_backend!r} is asked for, and the scans in {self.place} "
                f"were cast with {self.backend!r}: continue with that, or drop them with {_DROP}."
            )

    def _difference(self, identity: str) -> str:
        """Return how an earlier run differs, as a clause; empty if it is the same."""
        earlier = json.loads(identity)
        for name, value in self._run_identity.items():
            if earlier.get(name) != value:
                if name == "shard":
                    shards = str(earlier.get(name)), str(value)
                    earlier_shard, requested_shard = map(shard_in_words, shards)
                    return f"it is {earlier_shard}, not {requested_shard}"
                if name in CONTENT:
                    return f"it is of another {name}"
                if name != "lidarpool":
                    return f"it is of another campaign: its {name} differs"
                return f"it was written with {name} {earlier.get(name, 'none')}, here it is {value}"
        return ""

    def _check_same(self, identity: str) -> None:
        """Check that an earlier run in this place is the same."""
        if difference := self._difference(identity):
            raise LidarError(
                f"The run in {self.place} cannot be continued, {difference}. Drop it with {_DROP}, "
                "or give another folder."
            )

    # -- reading ---------------------------------------------------------------------------

    @property
    def backend(self) -> str:
        """Backend of the scans; empty until known."""
        return self.db.meta.get("backend", "")

    @property
    def casting(self) -> dict[str, str]:
        """Software of the workers that cast the scans, see `software`; empty until known."""
        return dict(json.loads(self.db.meta.get("casting", "{}")))

    def cast_with(self, backend: str, casting: Mapping[str, str]) -> None:
        """Keep with which backend and software all scans are cast."""
        if backend != self.backend or casting != self.casting:
            self.db.set(backend=backend, casting=json.dumps(casting))
            with storing(self.storage):
                self._write_mark()

    @property
    def made_with(self) -> dict[str, Any]:
        """What the bytes of all jobs depend on, for the manifests of a data set."""
        identity = fingerprint(dict(self.identity))
        return {"identity": identity, "backend": self.backend, "casting": self.casting}

    @property
    def kept(self) -> str:
        """What is committed, in words; empty for nothing."""
        if self.only is not None:
            return self.only.kept
        return f"{self.db.ended_count:,} of {len(self.jobs.numbers):,} jobs" if self.db.used else ""

    @property
    def advice(self) -> str:
        """Advice if the backend is not available, for the end of a message."""
        if not self.kept:
            return AUTO_TAKES
        return (
            f"The scans in {self.place} were cast with it: continue where it is to be had, or "
            f"drop them with {_DROP}."
        )

    def rows(self) -> Iterator[JobRow]:
        """Yield the rows of the jobs that have ended, by number."""
        for row in self.db.job_rows():
            yield JobRow.of(row)

    @property
    def sensors(self) -> dict[str, str]:
        """Sensors of the jobs that are done, {name: models and rates}."""
        return dict(json.loads(self.db.meta.get("sensors", "{}")))

    # -- jobs --------------------------------------------------------------------------------

    def take_on(self, job: Job) -> JobUnderWay:
        """Return a job under way; parts of an earlier run are checked first."""
        if job.number in self.under_way:
            return self.under_way[job.number]
        under_way = self._take_on(job)
        strays = self._strays.pop(job.number, ())
        if job.number in self.db.begun or strays:
            earlier_hash = self.db.hash_of(job.number)
            under_way.is_identified = bool(earlier_hash) and earlier_hash == _hash_of(job)
            if under_way.is_identified:
                self.notes += check_parts(under_way, self.db, self._sizes, strays)
            else:  # files that it is made of have changed, or a run died before it kept the hash
                self.db.restart(under_way)
                self.storage.remove(strays)
                under_way.resumed = 0
        return under_way

    def _take_on(self, job: Job) -> JobUnderWay:
        """Return a job with what is committed of it, from now on under way."""
        is_only = self.jobs.only_job is not None
        count = job.survey.scan_count
        scans = self.jobs.shard.scans(count) if is_only else range(count)
        under_way = JobUnderWay(
            job, scans, self.storage, self.db.summaries, has_frames=is_only, keeper=self
        )
        self.db.read(under_way)
        under_way.resumed = under_way.parts.scans_done
        under_way.is_identified = is_only  # by the identity of the run
        self.under_way[job.number] = under_way
        return under_way

    def end(self, rows: Sequence[JobRow]) -> None:
        """Commit that jobs have ended."""
        self.db.end_jobs((row.number, bool(row.error), asdict(row)) for row in rows)
        for row in rows:
            self.under_way.pop(row.number, None)

    def forget(self, numbers: Iterable[int]) -> None:
        """Let some jobs be done again."""
        if forgotten := [*numbers]:
            self.db.forget_jobs(forgotten)
            self.resumed = self.db.ended_count

    def adopt(self, rows: Iterable[JobRow], **made: str) -> None:
        """Take over jobs that are done in the data set, and what it was `made` with."""
        if made:
            self.db.set(**made)
        self.end([row for row in rows if not self.db.ended(row.number)])
        self.resumed = self.db.ended_count

    def name_sensors(self, sensors: Iterable[tuple[str, str]]) -> None:
        """Keep names of sensors with model and rate, for the card of the data set."""
        kept = with_sensors(self.sensors, sensors)
        if kept != self.sensors:
            self.db.set(sensors=json.dumps(kept))

    # -- the end -----------------------------------------------------------------------------

    def save(self, *, now: bool = False) -> None:
        """Keep how many frames were handed out, and what jobs are made of that are partly cast.

        Where it is time or `now`, copy the database. LidarError if that fails, or another run
        has taken over.
        """
        for job in self.under_way.values():
            if job.parts.scans_done and not job.complete and not job.is_identified:
                job.is_identified = True
                self.db.set_hash(job.number, _hash_of(job.job))
        self.db.save_frames(self.under_way.values())
        if self._remote:
            self._remote.save(self.db, now=now)

    def tidy(self) -> None:
        """Remove parts that are in no job under way, of dead or superseded collectors."""
        mark = self.db.meta["mark"]
        of_jobs = [part.name for job in self.under_way.values() for part in job.parts.ordered]
        ours = {mark_name(mark), *of_jobs}
        with suppress(OSError, LidarError):
            self.storage.remove([n for n in own_files(self.storage, mark) if n not in ours])

    def remove(self) -> None:
        """Remove the store: the result is in place. Files of others among the parts stay."""
        if self._remote:
            self._remote.check()
        self._removed = True
        self.db.close()
        _remove(self.place, self.storage, self.db.meta["mark"])

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """Add to an error of the body how to resume; remove the store if nothing is committed."""
        try:
            yield
        except BaseException as error:
            if self._removed or not self.lasting:
                raise
            with suppress(LidarError):  # report the first error
                self.save(now=True)
            if self._remote and self._remote.lost:
                self.db.close()
                raise
            kept = self.kept
            self.close()
            if kept and self._folder.local(FILE).exists():
                error.add_note(f"{kept} are kept in {self.place}: continue with {_RESUME}.")
            raise

    def close(self) -> None:
        """Close the database of an unfinished run; remove one that has kept nothing."""
        used = self.db.used or self.begun
        self.db.close()
        if not used:
            with suppress(OSError, LidarError):
                _remove(self.place, self.storage, self.db.meta["mark"])
            self._folder.remove([FILE])  # where the place of the parts failed


def with_sensors(known: Mapping[str, str], more: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return {name of a sensor: its kinds in words} with more: the same in whatever order."""
    sensors = dict(known)
    for name, words in more:
        kinds = {*sensors.get(name, words).split("; "), *words.split("; ")}
        named = sorted(kinds - {_OTHERS})
        others = [_OTHERS] * (_OTHERS in kinds or len(named) > SENSORS_NAMED)
        sensors[name] = "; ".join([*named[:SENSORS_NAMED], *others])
    return dict(sorted(sensors.items()))


def _hash_of(job: Job) -> str:
    """Return the hash of a job's inputs; empty if they have none: then it is not resumed."""
    try:
        return fingerprint(identity_of(job))
    except LidarError:
        return ""


def _database(folder: Storage) -> Path:
    """Path of the database in a folder of this machine; LidarError if it is a link."""
    folder.local(f"{FILE}-journal")  # which SQLite would follow, too
    return folder.local(FILE)


def parts_of(place: Storage, parts: str) -> Storage:
    """Where the parts of a run are: below the run's place, or in a place that was named."""
    named, _, name = parts.rpartition("/")
    return Storage.at(named or "/").below(name) if parts else place.below(PARTS)


@checked
def remove_run(folder: str | Path | Storage) -> None:
    """Remove a stored run and its parts, wherever they are, and nothing else.

    Other files among the parts stay. If its database is damaged, its parts are found only in its
    folder.

    Parameters
    ----------
    folder
        The run's folder, or its URL.

    Raises
    ------
    LidarError
        If another run uses it, it cannot be removed, or there is a link in place of its files.
    """
    place = Storage.at(folder)
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        path = _database(place if place.is_local else Storage.at(temporary))
        if not place.is_local:
            fetch_database(place, path)
        try:
            place_of_parts = read_place(path)
        except LidarError as error:
            raise LidarError(str(error).replace(temporary, place.url)) from error
        mark, parts = place_of_parts or (None, "")
        _remove(place, parts_of(place, parts), mark)


def _remove(place: Storage, parts: Storage, mark: str | None) -> None:
    """Remove a run and what its mark says is its own.

    `mark` is None if the database does not say it: then that in the folder of the parts counts.
    """
    with explained(f"The run in {place} cannot be removed"):
        names = own_files(parts, mark)  # an error if they are behind a link
        parts.remove(names, folder=True)
        place.remove([FILE, f"{FILE}-journal", OWNER], folder=True)

"""What a run keeps, in a folder or storage: database and parts, for a later run to go on from."""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..base.arrays import Floats32, Ints
from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage
from ..base.validation import checked
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud, mark_name, own_files, read_part, read_tally, unpack
from ..export.sweeps import Sweeps
from ..pipeline.database import FILE, RunDatabase, parts_folder, read_place
from ..pipeline.failures import storing
from ..pipeline.messages import Receipt, samples_of_scan, summary_type
from ..simulator.world import AUTO_TAKES
from .identity import difference, identity_of
from .job import Job
from .progress import Progress
from .remote import OWNER, RemoteRun, fetch_database

PARTS = "parts"  # the folder of the parts, in the run's folder
JOBS = "jobs"  # that of what a campaign keeps of each of its jobs
RUN_FOLDER = "run"  # the run's folder in the output folder, until the result is complete
SAMPLE_RAYS = 400  # of the pictures
CHECKERS = 4  # threads that check parts; each holds one in memory, twice
NAMED = 3  # parts, scans or files that a message names

# On the command line, and in Python.
_RESUME = "--resume (in Python resume=True)"
_DROP = "--fresh (in Python remove_run)"


class KeptRun:
    """What a run keeps, of one survey or many: its database, and where parts go.

    Parameters
    ----------
    identity
        What must be the same for a run to go on, see `identity_of`.
    scan_count
        Scans that the database itself is about.
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

    LidarpoolError if it holds an unfinished run and that is not to be resumed, or cannot be: it is
    damaged, of another run, in use, or cast with another backend than is asked for; or if there are
    `parts` without a `place`, whose database says which parts there are.
    """

    def __init__(
        self,
        identity: dict[str, str],
        scan_count: int,
        backend: str,
        place: str | Path | Storage | None = None,
        parts: str | Path | Storage | None = None,
        *,
        resume: bool = False,
    ) -> None:
        if parts is not None and place is None:
            raise LidarpoolError(
                "parts are given a place, and nothing would know of them afterwards: give a "
                "folder for the run as well."
            )
        self._scan_count, self._wanted = scan_count, backend
        self.lasting = place is not None
        self.notes: list[str] = []  # remarks for the user
        self._gone = False
        self.identity = here = identity
        self._remote = None
        kept = Storage.at(tempfile.mkdtemp(prefix="lidarpool-") if place is None else place)
        self.place = self._folder = kept  # that of the run, and that of its database
        if not kept.is_local:
            self._remote = RemoteRun(kept)
            self._folder = Storage.at(tempfile.mkdtemp(prefix="lidarpool-"))
        folder = self._folder.local()
        if place is None or self._remote:
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        advice = "make the one that it lies in first, or give another"
        with explained(f"The run's folder {folder} cannot be made", advice):
            folder.mkdir(exist_ok=True)
        try:
            self.db = self._open(here, parts)
            try:
                self._claim(here, resume)
            except BaseException:
                self.close()
                raise
        except BaseException:
            self._folder.remove([], folder=True)
            raise
        self.resumed = self.db.scans_done  # scans whose points are of an earlier run

    def _open(self, here: dict[str, str], parts: str | Path | Storage | None) -> RunDatabase:
        """Open the database, or a new one if nothing is committed in it."""
        path, count = _database(self._folder), self._scan_count
        durable = self.lasting and self._remote is None
        mark, earlier = "", ""  # of a run that has kept nothing, and the place of its parts
        jobs_of(self.place)  # an error if one is a link
        try:
            if self._remote:
                fetch_database(self._remote.storage, path)
            if path.exists():
                db = RunDatabase(path, count, durable=durable)
                if self._is_used(db):
                    return db
                db.close()
                mark, earlier = db.meta["mark"], db.meta.get("parts", "")
        except LidarpoolError as error:  # the copy of a database is nobody's business
            raise LidarpoolError(str(error).replace(self._folder.url, self.place.url)) from error
        if self.lasting:
            _remove(self.place, _parts_of(self.place, earlier), mark)
        path.unlink(missing_ok=True)
        self._folder.prepare()
        mark = secrets.token_hex(8)
        shared = Storage.at(parts).path(parts_folder(mark)) if parts is not None else ""
        new = {"mark": mark, "identity": json.dumps(here), "parts": shared}
        try:
            return RunDatabase(path, count, durable=durable, **new)
        except LidarpoolError:
            if path.exists() and not path.stat().st_size:  # the disk is full
                path.unlink()
                path.with_name(f"{FILE}-journal").unlink(missing_ok=True)  # SQLite 3.37 leaves it
            raise

    def _is_used(self, db: RunDatabase) -> bool:
        """Whether an earlier run has left something, of one survey or many."""
        return db.used or bool(jobs_of(self.place))

    def _claim(self, here: dict[str, str], resume: bool) -> None:
        """Find the parts, check them if there are any, and mark their folder as this run's."""
        self.storage = replace(_parts_of(self.place, self.db.meta["parts"]), durable=self.lasting)
        with explained(f"{self.storage.url} cannot be looked at"):
            sizes = self.storage.sizes()  # also an error if the place cannot be opened
        if self._is_used(self.db):
            self._go_on(here, resume, sizes)
        if self._remote:
            self._remote.claim(self.db)
        name = mark_name(self.db.meta["mark"])
        if name not in sizes:
            with storing(self.storage):
                self.storage.prepare()
                self.storage.write(name, b"")

    def _go_on(self, here: dict[str, str], resume: bool, sizes: dict[str, int]) -> None:
        """Check that this run may continue the existing one."""
        if other := difference(here, json.loads(self.db.meta["identity"])):
            raise LidarpoolError(
                f"The run in {self.place} cannot be continued, {other}. Drop it with {_DROP}, or "
                "give another folder."
            )
        if not resume:
            raise LidarpoolError(
                f"{self.place} holds an unfinished run, {self.kept or 'a job'}: continue it with "
                f"{_RESUME}, or drop it with {_DROP}."
            )
        if self._wanted not in ("auto", self.backend):
            raise LidarpoolError(
                f"Backend {self._wanted!r} is asked for, and the scans in {self.place} were "
                f"cast with {self.backend!r}: continue with that, or drop them with {_DROP}."
            )
        self._drop(sizes)

    def _drop(self, sizes: dict[str, int]) -> None:
        """Have the scans of missing and damaged parts cast again."""
        lost: dict[str, list[Receipt]] = {"missing": [], "damaged": []}
        pool = ThreadPoolExecutor(min(CHECKERS, os.cpu_count() or 1), "check")
        try:
            states = pool.map(lambda part: self._state(part, sizes), self.db.ordered)
            for part, state in zip(self.db.ordered, states, strict=True):
                if state:
                    lost[state].append(part)
        finally:
            pool.shutdown(cancel_futures=True)
        for what, parts in lost.items():
            if parts:
                self.db.drop(parts)
                names, scans = listed([p.name for p in parts]), listed([*map(_span, parts)])
                verb = "was" if len(parts) == 1 else "were"
                self.notes.append(
                    f"cast again: {scans}; {names} {verb} {what} in {self.storage.url}"
                )

    def _state(self, part: Receipt, sizes: dict[str, int]) -> str:
        """Say whether a part is not what its receipt says, to the checksum of each column."""
        if part.name not in sizes:
            return "missing"
        if sizes[part.name] != part.size:
            return "damaged"
        try:
            found = unpack(self.storage.read(part.name))
        except LidarpoolError:
            return "damaged"
        except OSError as error:
            if error.errno in (errno.EIO, errno.ENOENT):  # a bad disk; just removed
                return "damaged"
            raise LidarpoolError(
                f"The part {self.storage.path(part.name)} cannot be read: "
                f"{error.strerror or error}."
            ) from error
        as_said = (found.first, found.stop, len(found)) == (part.first, part.stop, part.rows)
        return "" if as_said else "damaged"

    # -- reading ---------------------------------------------------------------------------

    @property
    def backend(self) -> str:
        """Backend of the scans; empty until known."""
        return self.db.meta.get("backend", "")

    @backend.setter
    def backend(self, name: str) -> None:
        if name != self.backend:
            self.db.set(backend=name)

    @property
    def casting(self) -> dict[str, str]:
        """Software of the workers that cast the scans, see `software`; empty until known."""
        found: dict[str, str] = json.loads(self.db.meta.get("casting", "{}"))
        return found

    @casting.setter
    def casting(self, software: dict[str, str]) -> None:
        if software != self.casting:
            self.db.set(casting=json.dumps(software))

    @property
    def kept(self) -> str:
        """What is committed, in words; empty for nothing."""
        raise NotImplementedError

    @property
    def advice(self) -> str:
        """Advice if the backend is not available, for the end of a message."""
        if not self.resumed:
            return AUTO_TAKES
        return (
            f"The scans in {self.place} were cast with it: continue where it is to be had, or "
            f"drop them with {_DROP}."
        )

    # -- the end -----------------------------------------------------------------------------

    def save(self, *, now: bool = False) -> None:
        """Keep how many frames were handed out; where it is time or `now`, copy the database.

        LidarpoolError if that fails, or another run has taken over.
        """
        self.db.save_frames()
        if self._remote:
            self._remote.save(self.db, now=now)

    def tidy(self) -> None:
        """Remove parts that are not in the result, of dead or superseded collectors."""
        mark = self.db.meta["mark"]
        ours = {mark_name(mark), *(part.name for part in self.db.parts.values())}
        with suppress(OSError, LidarpoolError):
            self.storage.remove([n for n in own_files(self.storage, mark) if n not in ours])

    def remove(self) -> None:
        """Remove the store: the result is in place. Files of others among the parts stay."""
        if self._remote:
            self._remote.check()
        self._gone = True
        self.db.close()
        _remove(self.place, self.storage, self.db.meta["mark"])

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """Add to an error of the body how to resume; remove the store if nothing is committed."""
        try:
            yield
        except BaseException as error:
            if self._gone or not self.lasting:
                raise
            with suppress(LidarpoolError):  # report the first error
                self.save(now=True)
            if self._remote and self._remote.lost:
                self.db.close()
                raise
            self.close()
            if self.kept and self._folder.local(FILE).exists():
                error.add_note(f"{self.kept} are kept in {self.place}: continue with {_RESUME}.")
            raise

    def close(self) -> None:
        """Close the database of an unfinished run; remove one that has committed nothing."""
        self.db.close()
        if not self._is_used(self.db):
            with suppress(OSError, LidarpoolError):
                _remove(self.place, self.storage, self.db.meta["mark"])
            self._folder.remove([FILE])  # where the place of the parts failed


class RunStore(KeptRun):
    """Database and parts of one job; `backend` is by default the job's, others as of `KeptRun`."""

    def __init__(
        self,
        job: Job,
        place: str | Path | Storage | None = None,
        parts: str | Path | Storage | None = None,
        *,
        resume: bool = False,
        backend: str = "",
    ) -> None:
        self.job = job
        self.on_parts: Callable[[list[Receipt]], None] = lambda parts: None  # called with new ones
        count, wanted = job.survey.scan_count, backend or job.backend
        super().__init__(identity_of(job), count, wanted, place, parts, resume=resume)

    @property
    def kept(self) -> str:
        """Committed scans and trials in words; empty for none."""
        if self.db.scans_done:
            return f"{self.db.scans_done:,} of {self.job.survey.scan_count:,} scans"
        if self.db.trials:
            return f"{len(self.db.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def complete(self) -> bool:
        """Whether everything for a result is committed."""
        return self.db.complete and len(self.db.trials) == self.job.trials

    def progress(self) -> Progress:
        """Progress of a resumed run at its start."""
        db = self.db
        return Progress(
            scans=self.job.survey.scan_count,
            generated=db.frames,
            cast=db.scans_done,
            framed=db.frames,
            collected=db.scans_done,
            points=db.point_count,
            trials=self.job.trials,
            trials_done=len(db.trials),
            seconds=0.0,
        )

    def points(self) -> StoredCloud:
        """Points committed so far."""
        parts, job = self.db.ordered, self.job
        world = job.survey.coordinates == "world"
        return StoredCloud(
            self.storage,
            [part.name for part in parts],
            [part.first for part in parts],
            [part.rows for part in parts],
            job.survey.stored_columns,
            self.db.cells,
            job.survey.precision_m,
            job.scene.origin if world else np.zeros(3),
            keeper=self,
            sweeps=partial(Sweeps.of, job.survey, job.scene),
        )

    def points_of_scan(self, scan: int) -> Cloud:
        """Points of a committed scan."""
        part = self.db.part_of(scan)
        columns = read_part(self.storage, part.name)
        ends = np.cumsum(columns.counts)
        at = scan - part.first
        rows = slice(int(ends[at] - columns.counts[at]), int(ends[at]))
        return self.points().cloud_of(columns, rows)

    def hit_counts(self) -> Ints:
        """Hits by counters of the scene, see `Scene.counters`."""
        counts = np.zeros(self.job.scene.counters, np.int64)
        for part in self.db.ordered:
            triangles, hits = read_tally(self.storage, part.name)
            counts[triangles] += hits
        return counts

    def sample_rays(self) -> Floats32:
        """Return the ends of some rays, (k, 2, 3), metres, local coordinates."""
        survey = self.job.survey
        samples = samples_of_scan(survey.scan_count)
        kind = summary_type(samples)
        every = max(1, samples * survey.scan_count // SAMPLE_RAYS)
        rays = [np.empty((0, 2, 3), np.float32)]
        wanted = dict.fromkeys(range(0, survey.scan_count, every))
        for first, data in self.db.summaries_of(list(wanted)):
            for scan, summary in enumerate(np.frombuffer(data, kind), first):
                ends = summary["samples"][~np.isnan(summary["samples"][:, 0])]
                if scan in wanted and len(ends):
                    start = np.asarray(survey.pose(scan).position, np.float32)
                    starts = np.broadcast_to(start, ends.shape)
                    rays.append(np.stack([starts, ends], axis=1))
        return np.concatenate(rays)


def _database(folder: Storage) -> Path:
    """Path of the database in a folder of this machine; LidarpoolError if it is a link."""
    folder.local(f"{FILE}-journal")  # which SQLite would follow, too
    return folder.local(FILE)


def _parts_of(place: Storage, parts: str) -> Storage:
    """Where the parts of a run are: below the run's place, or in a place that was named."""
    named, _, name = parts.rpartition("/")
    return Storage.at(named or "/").below(name) if parts else place.below(PARTS)


def jobs_of(place: Storage) -> dict[str, Storage]:
    """Where a campaign keeps its jobs, as far as there is something of them: {name: place}."""
    jobs = place.below(JOBS)
    return {name: jobs.below(name) for name in jobs.entries()}


@checked
def remove_run(folder: str | Path) -> None:
    """Remove a stored run and its parts, wherever they are, and nothing else.

    Other files among the parts stay. If its database is damaged, its parts are found only in its
    folder.

    Parameters
    ----------
    folder
        The run's folder, or its URL.

    Raises
    ------
    LidarpoolError
        If another run uses it, it cannot be removed, or there is a link in place of its files.
    """
    drop_run(Storage.at(folder))


def drop_run(place: Storage) -> None:
    """Remove a stored run, see `remove_run`."""
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        path = _database(place if place.is_local else Storage.at(temporary))
        if not place.is_local:
            fetch_database(place, path)
        try:
            found = read_place(path)
        except LidarpoolError as error:
            raise LidarpoolError(str(error).replace(temporary, place.url)) from error
        mark, parts = found or (None, "")
        _remove(place, _parts_of(place, parts), mark)


def _remove(place: Storage, parts: Storage, mark: str | None) -> None:
    """Remove a run and what its mark says is its own.

    `mark` is None if the database does not say it: then that in the folder of the parts counts.
    """
    with explained(f"The run in {place} cannot be removed"):
        own = own_files(parts, mark)  # an error if they are behind a link
        for job in jobs_of(place).values():
            drop_run(job)
        place.below(JOBS).remove([], folder=True)
        parts.remove(own, folder=True)
        place.remove([FILE, f"{FILE}-journal", OWNER], folder=True)


def _span(part: Receipt) -> str:
    """Describe the scans of a part."""
    last = part.stop - 1
    return f"scan {last}" if part.first == last else f"scans {part.first} to {last}"


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more:,} more" if more > 0 else "")

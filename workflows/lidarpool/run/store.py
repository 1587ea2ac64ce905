"""What a run keeps, in a folder or storage: database and parts, for a later run to go on from."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.arguments import checked
from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage, is_url
from ..columns.cloud import Cloud
from ..columns.parts import StoredCloud, mark_name, own_files, read_part, read_tally, unpack
from ..export.sweeps import Sweeps
from ..pipeline.database import FILE, RunDatabase, parts_folder, read_place
from ..pipeline.messages import Receipt, samples_of_scan, summary_type
from ..simulator.world import AUTO_TAKES
from .identity import difference, identity_of
from .job import Job
from .progress import Progress
from .remote import OWNER, RemoteRun, fetch_database

PARTS = "parts"  # the folder of the parts, in the run's folder
RUN_FOLDER = "run"  # the run's folder in the output folder, until the result is complete
SAMPLE_RAYS = 400  # of the pictures
CHECKERS = 4  # threads that check parts; each holds one in memory, twice
NAMED = 3  # parts, scans or files that a message names

# On the command line, and in Python.
_RESUME = "--resume (in Python resume=True)"
_DROP = "--fresh (in Python remove_run)"


class RunStore:
    """Database and parts of one run.

    Parameters
    ----------
    job
        The job of the run.
    place
        Where they are kept, a folder or a URL; None for a temporary folder that goes with the
        last user of the points.
    parts
        Another place for the parts, a path or URL, in which they get their own folder. A resumed
        run uses the place of its parts.
    resume
        Whether to continue an existing run; otherwise there must be none.

    Raises
    ------
    LidarpoolError
        If it holds an unfinished run and that is not to be resumed, or cannot be: it is damaged,
        of another run, in use, or cast with another backend than is asked for; or if there are
        `parts` without a `place`, whose database says which parts there are.
    """

    def __init__(
        self,
        job: Job,
        place: str | Path | None = None,
        parts: str | Path | None = None,
        *,
        resume: bool = False,
    ) -> None:
        if parts is not None and place is None:
            raise LidarpoolError(
                "parts are given a place, and nothing would know of them afterwards: give a "
                "folder for the run as well."
            )
        self.job = job
        self.lasting = place is not None
        self.notes: list[str] = []  # remarks for the user
        self.on_parts: Callable[[list[Receipt]], None] | None = None  # called with new ones
        self._gone = False
        self.identity = here = identity_of(job)
        self._remote = None
        if place is None or is_url(place):
            folder = Path(tempfile.mkdtemp(prefix="lidarpool-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            if place is not None:
                self._remote = RemoteRun(Storage.at(place))
        else:
            folder = Path(place)
        self.place = self._remote.storage.url if self._remote else folder  # for people
        self._folder = folder  # of the database
        made = not folder.exists()
        advice = "make the one that it lies in first, or give another"
        with explained(f"The run's folder {folder} cannot be made", advice):
            folder.mkdir(exist_ok=True)
        try:
            self.db = self._open(here, parts)
            try:
                self._claim(here, resume)
            except BaseException:
                self.db.close()
                if made and not self.kept:
                    with suppress(OSError, LidarpoolError):
                        _remove(Storage.at(folder), self.storage, self.db.meta["mark"])
                    (folder / FILE).unlink(missing_ok=True)  # the place of the parts failed
                raise
        except BaseException:
            if made:
                with suppress(OSError):
                    folder.rmdir()
            raise
        self.resumed = self.db.scans_done  # scans whose points are of an earlier run

    def _open(self, here: dict[str, str], parts: str | Path | None) -> RunDatabase:
        """Open the database, or a new one if nothing is committed in it."""
        path, count = self._folder / FILE, self.job.survey.scan_count
        durable = self.lasting and self._remote is None
        mark, earlier = "", ""  # of a run that has kept nothing, and the place of its parts
        try:
            if self._remote:
                fetch_database(self._remote.storage, self._folder)
            if path.exists():
                db = RunDatabase(path, count, durable=durable)
                if db.scans_done or db.trials:
                    return db
                db.close()
                mark, earlier = db.meta["mark"], db.meta.get("parts", "")
        except LidarpoolError as error:  # the copy of a database is nobody's business
            raise LidarpoolError(str(error).replace(str(self._folder), str(self.place))) from error
        except OSError as error:
            raise LidarpoolError(f"The run in {self.place} cannot be read: {error}.") from error
        if self.lasting:
            with _removing(self.place):
                left = _remove(Storage.at(self.place), _storage(self.place, earlier), mark)
            if left:
                raise LidarpoolError(left)
        path.unlink(missing_ok=True)
        self._folder.mkdir(exist_ok=True)
        shared = None if parts is None else Storage.at(parts)
        try:
            db = RunDatabase(path, count, durable=durable)
            try:
                place = shared.path(parts_folder(db.meta["mark"])) if shared else ""
                db.set(identity=json.dumps(here), parts=place)
            except BaseException:
                path.unlink()  # while its lock is held
                db.close()
                raise
        except LidarpoolError:
            if path.exists() and not path.stat().st_size:  # the disk is full
                path.unlink()
                path.with_name(f"{FILE}-journal").unlink(missing_ok=True)  # SQLite 3.37 leaves it
            raise
        return db

    def _claim(self, here: dict[str, str], resume: bool) -> None:
        """Find the parts, check them if there are any, and mark their folder as this run's."""
        self.storage = _storage(self.place, self.db.meta["parts"], durable=self.lasting)
        if self.storage.is_link:
            raise LidarpoolError(_behind_link(self.storage))
        with explained(f"{self.storage.url} cannot be looked at"):
            sizes = self.storage.sizes()  # also an error if the place cannot be opened
        if self.kept:
            self._go_on(here, resume, sizes)
        if self._remote:
            self._remote.claim(self.db)
        name = mark_name(self.db.meta["mark"])
        if name not in sizes:
            advice = "make room there, or give another place with --parts"
            with explained(f"The points cannot be kept in {self.storage.url}", advice):
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
                f"{self.place} holds an unfinished run, {self.kept}: continue it with {_RESUME}, "
                f"or drop it with {_DROP}."
            )
        if self.job.backend not in ("auto", self.backend):
            raise LidarpoolError(
                f"Backend {self.job.backend!r} is asked for, and the scans in {self.place} were "
                f"cast with {self.backend!r}: continue with that, or drop them with {_DROP}."
            )
        self._drop(sizes)

    def _drop(self, sizes: dict[str, int]) -> None:
        """Have the scans of missing and damaged parts cast again."""
        there = [part for part in self.db.ordered if part.name in sizes]
        missing = [part for part in self.db.ordered if part.name not in sizes]
        pool = ThreadPoolExecutor(min(CHECKERS, os.cpu_count() or 1), "check")
        try:
            whole = pool.map(lambda part: self._is_whole(part, sizes[part.name]), there)
            damaged = [part for part, fine in zip(there, whole, strict=True) if not fine]
        finally:
            pool.shutdown(cancel_futures=True)
        for what, parts in (("missing", missing), ("damaged", damaged)):
            if parts:
                self.db.drop(parts)
                names, scans = _listed([p.name for p in parts]), _listed([*map(_span, parts)])
                verb = "was" if len(parts) == 1 else "were"
                self.notes.append(
                    f"cast again: {scans}; {names} {verb} {what} in {self.storage.url}"
                )

    def _is_whole(self, part: Receipt, size: int) -> bool:
        """Whether a part is what its receipt says, to the checksum of each column."""
        if size != part.size:
            return False
        try:
            found = unpack(self.storage.read(part.name))
        except LidarpoolError:
            return False
        except OSError as error:
            if error.errno in (errno.EIO, errno.ENOENT):  # a bad disk; just removed
                return False
            raise LidarpoolError(
                f"The part {self.storage.path(part.name)} cannot be read: "
                f"{error.strerror or error}."
            ) from error
        return (found.first, found.stop, len(found)) == (part.first, part.stop, part.rows)

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

    @property
    def advice(self) -> str:
        """Advice if the backend is not available, for the end of a message."""
        if not self.resumed:
            return AUTO_TAKES
        return (
            f"The scans in {self.place} were cast with it: continue where it is to be had, or "
            f"drop them with {_DROP}."
        )

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

    @property
    def _cloud_origin(self) -> NDArray[np.float64]:
        """Origin of the points: that of the scene, or none in sensor coordinates."""
        world = self.job.survey.coordinates == "world"
        return self.job.scene.origin if world else np.zeros(3)

    def points(self) -> StoredCloud:
        """Points committed so far."""
        parts = self.db.ordered
        survey = self.job.survey
        return StoredCloud(
            self.storage,
            [part.name for part in parts],
            [part.first for part in parts],
            [part.rows for part in parts],
            survey.stored_columns,
            self.db.cells,
            survey.precision_m,
            self._cloud_origin,
            keeper=self,
            sweeps=partial(Sweeps.of, survey, self.job.scene),
        )

    def points_of_scan(self, scan: int) -> Cloud:
        """Points of a committed scan."""
        part = self.db.part_of(scan)
        columns = read_part(self.storage, part.name)
        ends = np.cumsum(columns.counts)
        at = scan - part.first
        rows = slice(int(ends[at] - columns.counts[at]), int(ends[at]))
        return self.points().cloud_of(columns, rows)

    def hit_counts(self) -> NDArray[np.int64]:
        """Hits of each triangle of the scene, (f,), those of actors after the others."""
        counts = np.zeros(self.job.scene.triangles, np.int64)
        for part in self.db.ordered:
            triangles, hits = read_tally(self.storage, part.name)
            counts[triangles] += hits
        return counts

    def sample_rays(self) -> NDArray[np.float32]:
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

    # -- the end -----------------------------------------------------------------------------

    def save(self, *, now: bool = False) -> None:
        """Keep how many frames were handed out; where it is time or `now`, copy the database.

        Raises
        ------
        LidarpoolError
            If that fails, or another run has taken over.
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

    def remove(self) -> str:
        """Remove the store: the result is in place.

        Returns
        -------
        What is left in the folder of the parts because it is not of this run, and what to do, as
        a sentence; empty if nothing is.
        """
        if self._remote:
            self._remote.check()
        self._gone = True
        self.db.close()
        with _removing(self.place):
            return _remove(Storage.at(self.place), self.storage, self.db.meta["mark"])

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
            self.db.close()
            if self._remote and self._remote.lost:
                raise
            if not self.kept:
                with suppress(OSError):
                    _remove(Storage.at(self.place), self.storage, self.db.meta["mark"])
            elif (self._folder / FILE).exists():
                error.add_note(f"{self.kept} are kept in {self.place}: continue with {_RESUME}.")
            raise


def _storage(place: str | Path, parts: str, *, durable: bool = True) -> Storage:
    """Where the parts of a run are: below the run's place, or in a place of their own."""
    return Storage.at(parts or f"{place}/{PARTS}", durable=durable)


@checked
def remove_run(folder: str | Path) -> None:
    """Remove a stored run and its parts, wherever they are, and nothing else.

    If its database is damaged, its parts are found only in its folder.

    Parameters
    ----------
    folder
        The run's folder, or its URL.

    Raises
    ------
    LidarpoolError
        If another run uses it, it cannot be removed, or the folder of its parts holds other files
        or is a link: these stay, and the message names them.
    """
    kept = Storage.at(folder)
    with _removing(folder), tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        if not kept.is_local:
            fetch_database(kept, Path(temporary))
        try:
            found = read_place(Path(folder if kept.is_local else temporary) / FILE)
        except LidarpoolError as error:
            raise LidarpoolError(str(error).replace(temporary, str(folder))) from error
        mark, parts = found or (None, "")
        left = _remove(kept, _storage(folder, parts), mark)
    if left:
        raise LidarpoolError(left)


def _remove(kept: Storage, parts: Storage, mark: str | None) -> str:
    """Remove a run and what its mark says is its own; a sentence on what else is there.

    `mark` is None if the database does not say it: then that in the folder of the parts counts.
    """
    if parts.is_link:
        return _behind_link(parts)
    parts.remove(own_files(parts, mark))
    parts.remove_folder()
    kept.remove([FILE, f"{FILE}-journal", OWNER])
    kept.remove_folder()
    if not (left := sorted(parts.entries())):
        return ""
    of_runs = len(own_files(parts, None)) == len(left)  # whose databases are gone
    advice = f"drop it with {_DROP}" if of_runs else "move it elsewhere"
    return (
        f"{parts.url} holds what is not of this run and stays there, {_listed(left)}: {advice}, "
        "or give another folder."
    )


def _span(part: Receipt) -> str:
    """Describe the scans of a part."""
    last = part.stop - 1
    return f"scan {last}" if part.first == last else f"scans {part.first} to {last}"


def _behind_link(parts: Storage) -> str:
    return (
        f"{parts.url} is a link, and a run deletes nothing behind a link: put the folder itself "
        "there, or remove the link; --parts gives the points another place."
    )


def _listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more:,} more" if more > 0 else "")


def _removing(place: str | Path) -> AbstractContextManager[None]:
    return explained(f"The run in {place} cannot be removed")

"""What a run keeps, in a folder or storage: database and parts, for a later run to go on from."""

from __future__ import annotations

import json
import secrets
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.arguments import checked
from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.parts import SUFFIX, StoredCloud, read_part, read_tally
from ..columns.storage import Storage, is_url
from ..export.sweeps import Sweeps
from ..scan.database import FILE, RunDatabase, parts_place
from ..scan.messages import Receipt, samples_of_scan, summary_type
from .checks import AUTO_TAKES
from .identity import difference, identity_of
from .job import Job
from .progress import Progress
from .remote import OWNER, RemoteRun, fetch_database

PARTS = "parts"  # the folder of the parts, in the run's folder
RUN_FOLDER = "run"  # the run's folder in the output folder, until the result is complete
SAMPLE_RAYS = 400  # of the pictures

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
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise LidarpoolError(
                f"The run's folder {folder} cannot be made ({error.strerror or error}): make the "
                "one that it lies in first, or give another."
            ) from error
        try:
            self.db = self._open(here, parts)
            try:
                durable = self.lasting
                self.storage = _storage(self.place, self.db.meta["parts"], durable=durable)
                sizes = self._sizes()  # also an error if the place cannot be opened
                if self.kept:
                    self._go_on(here, resume, sizes)
                if self._remote:
                    self._remote.claim(self.db)
            except BaseException:
                self.db.close()
                raise
        except BaseException:
            if made:
                shutil.rmtree(folder, ignore_errors=True)
            raise
        self.resumed = self.db.scans_done  # scans whose points are of an earlier run

    def _open(self, here: dict[str, str], parts: str | Path | None) -> RunDatabase:
        """Open the database, or a new one if nothing is committed in it."""
        path, count = self._folder / FILE, self.job.survey.scan_count
        durable = self.lasting and self._remote is None
        try:
            if self._remote:
                fetch_database(self._remote.storage, self._folder)
            if path.exists():
                db = RunDatabase(path, count, durable=durable)
                if db.scans_done or db.trials:
                    return db
                db.close()
        except LidarpoolError as error:  # the copy of a database is nobody's business
            raise LidarpoolError(str(error).replace(str(self._folder), str(self.place))) from error
        except OSError as error:
            raise LidarpoolError(f"The run in {self.place} cannot be read: {error}.") from error
        if self.lasting:
            remove_run(self.place)
        path.unlink(missing_ok=True)
        self._folder.mkdir(exist_ok=True)
        db = RunDatabase(path, count, durable=durable)
        place = "" if parts is None else f"{Storage.at(parts).url}/run-{secrets.token_hex(4)}"
        db.set(identity=json.dumps(here), parts=place)
        return db

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
        absent = [p for p in self.db.ordered if sizes.get(p.name) != p.size]
        if absent:
            self.db.drop(absent)
            count = sum(part.stop - part.first for part in absent)
            self.notes.append(
                f"{count} scans were made again: their parts were missing or cut short in "
                f"{self.storage.url}"
            )

    def _sizes(self) -> dict[str, int]:
        try:
            return self.storage.sizes()
        except OSError as error:
            raise LidarpoolError(
                f"{self.storage.url} cannot be looked at: {error.strerror or error}."
            ) from error

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
        ours = {part.name for part in self.db.parts.values()}
        with suppress(OSError, LidarpoolError):
            self.storage.remove([n for n in self._sizes() if SUFFIX in n and n not in ours])

    def remove(self) -> None:
        """Remove the store: the result is in place."""
        if self._remote:
            self._remote.check()
        self._gone = True
        self.db.close()
        remove_run(self.place)

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
                with suppress(LidarpoolError):
                    remove_run(self.place)
            elif (self._folder / FILE).exists():
                error.add_note(f"{self.kept} are kept in {self.place}: continue with {_RESUME}.")
            raise


def _storage(place: str | Path, parts: str, *, durable: bool = True) -> Storage:
    """Where the parts of a run are: below the run's place, or in a place of their own."""
    return Storage.at(parts or f"{place}/{PARTS}", durable=durable)


@checked
def remove_run(folder: str | Path) -> None:
    """Remove a stored run and its parts, wherever they are, and nothing else.

    Parameters
    ----------
    folder
        The run's folder, or its URL.

    Raises
    ------
    LidarpoolError
        If it cannot be removed.
    """
    kept = Storage.at(folder)
    try:
        with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
            if not kept.is_local:
                fetch_database(kept, Path(temporary))
            parts = parts_place(Path(folder if kept.is_local else temporary) / FILE)
        storage = _storage(folder, parts)
        storage.remove([name for name in storage.sizes() if SUFFIX in name])
        storage.remove_folder()
        kept.remove([FILE, f"{FILE}-journal", OWNER])
        kept.remove_folder()
    except OSError as error:
        raise LidarpoolError(
            f"The run in {folder} cannot be removed: {error.strerror or error}."
        ) from error

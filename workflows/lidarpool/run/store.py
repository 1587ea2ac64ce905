"""What a run keeps: its database and its parts, in a folder that a later run can go on from."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud
from ..columns.parts import SUFFIX, StoredCloud, read_part, read_tally
from ..columns.storage import Storage
from ..scan.messages import Receipt, samples_of_scan, summary_type
from .checks import AUTO_TAKES
from .database import FILE, RunDatabase, parts_of
from .identity import Identity
from .job import Job
from .progress import Progress

PARTS = "parts"  # the folder of the parts, in the run's folder
SAMPLE_RAYS = 400  # of the pictures
TALLIED_PARTS = 2000  # read for the hits of each triangle; of more, an even choice


@dataclass(frozen=True)
class Terms:
    """How whoever reads the messages is to say it: in Python, or on the command line."""

    resume: str
    discard: str


PYTHON_TERMS = Terms("resume=True", "remove_run()")
COMMAND_TERMS = Terms("--resume", "--fresh")


class RunStore:
    """Database and parts of one run.

    Parameters
    ----------
    job
        What the run does.
    folder
        Where they are kept; None for a temporary folder that goes with the last user of the
        points.
    parts
        Another place for the parts, a path or URL, where they stay when the run is done.
    resume
        Whether to go on from what is there; if not, there must be nothing.
    terms
        How messages name what can be done.

    Raises
    ------
    LidarpoolError
        If it holds an unfinished run and that is not to be resumed, or cannot be: it is damaged,
        of another run, in use, or cast with another backend than is asked for.
    """

    def __init__(
        self,
        job: Job,
        folder: Path | None = None,
        parts: str | Path | None = None,
        *,
        resume: bool = False,
        terms: Terms = PYTHON_TERMS,
    ) -> None:
        self.job, self.terms = job, terms
        self.lasting = folder is not None
        self.keeps_parts = parts is not None
        self.notes: list[str] = []  # what a user should know
        self.on_parts: Callable[[list[Receipt]], None] | None = None  # called with new ones
        self._identity = Identity.of(job)
        self._gone = False
        if folder is None:
            folder = Path(tempfile.mkdtemp(prefix="lidarpool-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.folder = folder
        self._made = not folder.exists()
        self.storage = Storage.at(
            folder / PARTS if parts is None else parts, durable=self.lasting or self.keeps_parts
        )
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise LidarpoolError(
                f"The run's folder {folder} cannot be made ({error.strerror or error}): make the "
                "one that it lies in first, or give another."
            ) from error
        try:
            self.db = RunDatabase(folder / FILE, job.survey.scan_count, durable=self.lasting)
            try:
                self._begin(resume)
            except BaseException:
                self.db.close()
                raise
        except BaseException:
            self._remove_folder_if_new()
            raise
        self.resumed = self.db.scans_done  # scans whose points are of an earlier run

    def _begin(self, resume: bool) -> None:
        db, here = self.db, self._identity.to_text()
        moved = db.meta.get("parts") != self.storage.url
        if moved and not db.parts:  # else what is there may be of this run
            self._refuse_strangers()
        if "identity" not in db.meta:
            db.set(identity=here, parts=self.storage.url)
            return
        difference = self._identity.difference(Identity.from_text(db.meta["identity"]))
        if difference and not self.kept:
            db.set(identity=here, parts=self.storage.url, backend="")
            return
        if difference:
            raise LidarpoolError(
                f"The run in {self.folder} cannot be continued, {difference}. Drop it with "
                f"{self.terms.discard}, or give another folder."
            )
        if moved and db.parts:
            raise LidarpoolError(
                f"The run in {self.folder} has its parts in {db.meta['parts']}: give that place, "
                f"or drop the run with {self.terms.discard}."
            )
        db.set(parts=self.storage.url)
        if self.kept and not resume:
            raise LidarpoolError(
                f"{self.folder} holds an unfinished run, {self.kept}: continue it with "
                f"{self.terms.resume}, or drop it with {self.terms.discard}."
            )
        if self.kept and self.job.backend not in ("auto", self.backend):
            raise LidarpoolError(
                f"Backend {self.job.backend!r} is asked for, and the scans in {self.folder} were "
                f"cast with {self.backend!r}: continue with that, or drop them with "
                f"{self.terms.discard}."
            )
        self._check_parts()

    def _refuse_strangers(self) -> None:
        """Leave parts alone that are of another run."""
        there = [name for name in self._sizes() if name.endswith(SUFFIX)]
        if there and self.keeps_parts:
            raise LidarpoolError(
                f"{self.storage.url} holds the parts of another run ({there[0]}, …): give an empty "
                "place with --parts, or remove them."
            )
        self._remove_parts(there)

    def _check_parts(self) -> None:
        """Look whether the parts are there; those that are not are made again."""
        sizes = self._sizes()
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

    # -- what there is ---------------------------------------------------------------------

    @property
    def backend(self) -> str:
        """Backend that casts the scans; empty until it is known."""
        return self.db.meta.get("backend", "")

    @backend.setter
    def backend(self, name: str) -> None:
        if name != self.backend:
            self.db.set(backend=name)

    @property
    def kept(self) -> str:
        """What is committed, in words; empty if nothing is."""
        if self.db.scans_done:
            return f"{self.db.scans_done:,} of {self.job.survey.scan_count:,} scans"
        if self.db.trials:
            return f"{len(self.db.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def complete(self) -> bool:
        """Whether this is all that a result is made of."""
        return self.db.complete and len(self.db.trials) == self.job.trials

    @property
    def advice(self) -> str:
        """What to do where the backend is not to be had, for the end of a message."""
        if not self.resumed:
            return AUTO_TAKES
        return (
            f"The scans in {self.folder} were cast with it: continue where it is to be had, or "
            f"drop them with {self.terms.discard}."
        )

    def progress(self) -> Progress:
        """How far a run is that goes on from here, before it does."""
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
        """Points that are committed so far."""
        parts = self.db.ordered
        survey, scene = self.job.survey, self.job.scene
        return StoredCloud(
            self.storage,
            [part.name for part in parts],
            [part.rows for part in parts],
            survey.stored_columns,
            self.db.cells,
            survey.precision_m,
            scene.origin,
            keeper=self,
        )

    def points_of_scan(self, scan: int) -> Cloud:
        """Points of a scan that is committed."""
        part = self.db.part_of(scan)
        columns = read_part(self.storage, part.name)
        ends = np.cumsum(columns.counts)
        at = scan - part.first
        rows = slice(int(ends[at] - columns.counts[at]), int(ends[at]))
        return self.points().cloud_of(columns, rows)

    def hit_counts(self) -> NDArray[np.int64]:
        """Hits of each triangle, (f,): of all parts, or scaled up from an even choice of many."""
        counts = np.zeros(len(self.job.scene.faces), np.int64)
        parts = self.db.ordered
        chosen = [parts[i] for i in one_of_each_part(len(parts), TALLIED_PARTS)]
        for part in chosen:
            triangles, hits = read_tally(self.storage, part.name)
            counts[triangles] += hits
        seen = sum(part.hits for part in chosen)
        if seen and len(chosen) < len(parts):
            counts = np.rint(counts * (self.db.hits / seen)).astype(np.int64)
        return counts

    def sample_rays(self) -> NDArray[np.float32]:
        """First and last point of some rays, (k, 2, 3), metres, local coordinates."""
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

    def tidy(self) -> None:
        """Remove parts that are not of the result: their collectors died, or were not needed."""
        ours = {part.name for part in self.db.parts.values()}
        with suppress(OSError, LidarpoolError):
            self._remove_parts([n for n in self._sizes() if SUFFIX in n and n not in ours])

    def _remove_parts(self, names: list[str]) -> None:
        try:
            self.storage.remove(names)
        except OSError as error:
            raise LidarpoolError(
                f"Parts in {self.storage.url} cannot be removed: {error.strerror or error}."
            ) from error

    def remove(self) -> None:
        """Remove all of it but parts that are to stay: the result is where it belongs."""
        self._gone = True
        self.db.close()
        remove_run(self.folder, parts=not self.keeps_parts)

    def _remove_folder_if_new(self) -> None:
        if self._made and self.folder.exists():
            shutil.rmtree(self.folder, ignore_errors=True)

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """Add to an error of the body how to go on; without anything committed all is removed."""
        try:
            yield
        except BaseException as error:
            if self._gone or not self.lasting:
                raise
            with suppress(LidarpoolError):  # the first error is the one to tell of
                self.db.save_frames()
            self.db.close()
            if not self.kept:
                with suppress(LidarpoolError):
                    remove_run(self.folder, parts=not self.keeps_parts)
            elif (self.folder / FILE).exists():
                error.add_note(
                    f"{self.kept} are kept in {self.folder}: continue with {self.terms.resume}."
                )
            raise


def remove_run(folder: str | Path, *, parts: bool = True) -> None:
    """Remove what a run has kept in a folder; nothing else in it is touched.

    Parts that an unfinished run has put elsewhere go as well: nobody knows of them any more.

    Parameters
    ----------
    folder
        The run's folder.
    parts
        Whether to remove its parts too.

    Raises
    ------
    LidarpoolError
        If it cannot be removed.
    """
    folder = Path(folder)
    storage = Storage.at(folder / PARTS)
    try:
        if parts:
            elsewhere, names = parts_of(folder / FILE)
            if elsewhere and elsewhere != storage.url:
                Storage.at(elsewhere).remove(names)
            storage.remove([n for n in storage.sizes() if SUFFIX in n])
        for name in (FILE, f"{FILE}-journal"):
            (folder / name).unlink(missing_ok=True)
        storage.remove_folder()
        Storage.at(folder).remove_folder()
    except OSError as error:
        raise LidarpoolError(
            f"The run in {folder} cannot be removed: {error.strerror or error}."
        ) from error

"""The journal of a run: what has been delivered is on disk, and a later run can go on from it.

A journal is a folder with two files of records, see `records.py`. `records` only grows: a
header first, then the points of some scans, or a planning trial, in the order in which they
came. `frames` holds one record, the totals of the frames so far, and is replaced once in a
while. Everything in them is numbers and JSON; nothing is ever unpickled.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from .deliveries import Deliveries
from .errors import LidarpoolError
from .identity import Identity
from .job import Job
from .journal_folder import (
    RECORDS,
    check_ours,
    remove_journal,
)
from .journal_format import (
    FORMAT,
    HEADER,
    POINTS,
    TRIAL,
    UNREADABLE,
    unpack_header,
    unpack_points,
)
from .journal_store import JournalStore
from .plan import Trial
from .records import DamagedFileError, Record, RecordFile
from .totals_file import TotalsFile
from .trial_record import trial_from_json, trial_to_json


@dataclass(frozen=True)
class Terms:
    """How whoever reads the messages is to say it: in Python, or on the command line."""

    resume: str
    discard: str


PYTHON_TERMS = Terms("resume=True", "remove_journal()")
COMMAND_TERMS = Terms("--resume", "--fresh")


def open_journal(path: Path, job: Job, *, resume: bool, terms: Terms = PYTHON_TERMS) -> Journal:
    """Journal for a run, with what an earlier run has left there, if it is to be resumed.

    Parameters
    ----------
    path
        The folder; the one that it lies in must exist.
    job
        What the run is to do.
    resume
        Whether to go on from what is there; if not, there must be nothing.
    terms
        How messages name what can be done.

    Raises
    ------
    LidarpoolError
        If it holds an unfinished run and that is not to be resumed, or cannot be: it is
        damaged, of another run, in use, or cast with another backend than is asked for.
        Nothing on disk is changed.
    """
    journal = Journal(path, job, terms)
    journal.load()
    if not journal.kept:
        return journal
    try:
        if not resume:
            raise LidarpoolError(
                f"{path} holds an unfinished run, {journal.kept}: continue it with "
                f"{terms.resume}, or drop it with {terms.discard}."
            )
        if job.backend not in ("auto", journal.backend):
            raise LidarpoolError(
                f"Backend {job.backend!r} is asked for, and the scans in the journal {path} were "
                f"cast with {journal.backend!r}: continue with that, or drop them with "
                f"{terms.discard}."
            )
    except LidarpoolError:
        journal.close()
        raise
    return journal


class Journal(Deliveries):
    """The journal of one run; it comes into being with the first delivery.

    Parameters
    ----------
    path
        The folder; the one that it lies in must exist.
    job
        What the run is to do.
    terms
        How messages name what can be done.
    """

    def __init__(self, path: Path, job: Job, terms: Terms = PYTHON_TERMS) -> None:
        self.path, self.terms = path, terms
        self._store = JournalStore(path, Identity.of(job.scene, job.survey, job.planning))
        super().__init__(job, self._store)
        self._gone = False  # removed and not needed any more, or of no use
        self._totals_file = TotalsFile(path, self.totals)

    # -- what is in it -----------------------------------------------------------------

    @property
    def backend(self) -> str:
        """Backend that casts the scans; empty until it is known."""
        return self._store.backend

    @backend.setter
    def backend(self, name: str) -> None:
        self._store.backend = name

    @property
    def kept(self) -> str:
        """What has been delivered, in words; empty if nothing has."""
        if self.cloud.ledger.delivered:
            return f"{self.cloud.ledger.delivered:,} of {self.job.survey.scan_count:,} scans"
        if self.trials:
            return f"{len(self.trials):,} of {self.job.trials:,} planning trials"
        return ""

    @property
    def advice(self) -> str:
        """What to do where the backend is not to be had, for the end of a message."""
        if not self.resumed:
            return super().advice
        return (
            f"The scans in the journal {self.path} were cast with it: continue where it is to be "
            f"had, or drop them with {self.terms.discard}."
        )

    def load(self) -> None:
        """Read what an earlier run has left, if there is any, and go on from it.

        Raises
        ------
        LidarpoolError
            If it is damaged, of another run or in use; nothing on disk is changed.
        """
        if not self._is_there():
            return
        try:
            file = RecordFile(self.path / RECORDS)
            try:
                self._read(file)
            except BaseException:
                file.close()
                raise
        except BlockingIOError as error:
            raise LidarpoolError(f"Another run is using the journal {self.path}.") from error
        except OSError as error:
            raise LidarpoolError(
                f"The journal {self.path} cannot be read: {error.strerror or error}."
            ) from error
        except UNREADABLE as error:
            raise self._refusal(f"is damaged ({error})") from error
        if self.kept:
            self._store.file = file
            self.resumed = self.cloud.ledger.delivered
        else:  # it ended before it began; the first delivery will start it anew
            self.backend = ""
            file.close()

    def _is_there(self) -> bool:
        """Whether there is a file to read; LidarpoolError if others' files are in its place."""
        if not self.path.parent.is_dir():
            raise LidarpoolError(
                f"The folder {self.path.parent} of the journal does not exist: make it first."
            )
        check_ours(self.path)
        return (self.path / RECORDS).exists()

    def _read(self, file: RecordFile) -> None:
        for record in file.records():
            if not self.backend:
                self.backend = self._read_header(record)
            elif record.kind == POINTS:
                scans, counts, begin, points = unpack_points(record.payload)
                self.cloud.restore(scans, counts, record.offset + begin, points)
            elif record.kind == TRIAL:
                self.trials.append(trial_from_json(record.payload))
        if self.kept:
            self._totals_file.load()

    def _read_header(self, record: Record) -> str:
        """Check that the journal is of this run; returns the backend of its scans."""
        if record.kind != HEADER:
            raise ValueError("it does not begin with a header")
        number, backend, theirs = unpack_header(record.payload)
        if theirs is None:
            raise self._refusal(f"is of format {number}, and this version reads {FORMAT}")
        if difference := self._store.identity.difference(theirs):
            raise self._refusal(f"cannot be continued, {difference}")
        return backend

    def _refusal(self, why: str) -> LidarpoolError:
        return LidarpoolError(
            f"The journal {self.path} {why}. Drop it with {self.terms.discard}, or give "
            "another folder."
        )

    # -- writing -----------------------------------------------------------------------

    def add_trial(self, trial: Trial) -> None:
        """Keep a planning trial."""
        self._store.append_record(TRIAL, trial_to_json(trial))
        super().add_trial(trial)

    def look(self) -> None:
        """Sync, and write down the totals of the frames, if it is time; call it often."""
        if (file := self._store.file) is not None:
            with self._store.explained():
                file.sync_if_due()
                self._totals_file.write_if_due()

    def sync(self) -> None:
        """Write everything to the disk that was delivered so far."""
        if (file := self._store.file) is not None:
            with self._store.explained():
                file.sync()
                self._totals_file.write()

    # -- the end -----------------------------------------------------------------------

    def check(self) -> None:
        """See that nobody else has written to the file; on some network disks no lock keeps them.

        Raises
        ------
        LidarpoolError
            If it does not hold any more what was delivered.
        """
        if (file := self._store.file) is not None:
            try:
                file.check()
            except (OSError, DamagedFileError) as error:
                self.close()
                self._gone = True
                raise self._refusal(f"was changed while this run wrote to it ({error})") from error

    def save(self) -> None:
        """Write everything to the disk, with a mark at the end; nothing more will come.

        Raises
        ------
        LidarpoolError
            If the disk is full; what was delivered is there all the same.
        """
        if (file := self._store.file) is not None:
            with self._store.explained():
                self._totals_file.write()
                file.mark()
                file.unlock()

    def remove(self) -> None:
        """Remove the journal and let go of its files."""
        self._gone = True
        self.close()
        remove_journal(self.path)

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """Save the journal if the body raises, and add to the error how to go on.

        Without a delivery it is removed, and its folder is as it was.
        """
        try:
            yield
        except BaseException as error:
            if self._gone:
                raise
            with suppress(LidarpoolError):  # the first error is the one to tell of
                if not self.kept:
                    self._store.discard()
                self.save()
            if self.kept and self._store.is_there:
                error.add_note(
                    f"{self.kept} are kept in {self.path}: continue with {self.terms.resume}."
                )
            self.close()
            raise

    def close(self) -> None:
        """Let go of the files; afterwards the points cannot be read any more."""
        self._store.close()

"""The folder of a journal: which files it holds, and that nothing else is touched in it."""

from __future__ import annotations

import os
from pathlib import Path

from .errors import LidarpoolError
from .records import MAGIC

RECORDS, FRAMES = "records", "frames"
FRESH = f"{FRAMES}.new"  # being written


def remove_journal(path: str | Path) -> None:
    """Remove a journal that `simulate` has written; nothing else in its folder is touched.

    Raises
    ------
    LidarpoolError
        If it cannot be removed, or is no journal.
    """
    path = Path(path)
    check_ours(path)
    try:
        remove_files(path)
        remove_folder(path)
    except OSError as error:
        raise LidarpoolError(
            f"The journal {path} cannot be removed: {error.strerror or error}."
        ) from error


def check_ours(path: Path) -> None:
    """Refuse what is in the place of a journal and is none, since it would be written over.

    Raises
    ------
    LidarpoolError
        If it is that, or cannot be looked at.
    """
    try:
        ours = _is_ours(path)
    except OSError as error:
        raise LidarpoolError(
            f"The journal {path} cannot be read: {error.strerror or error}."
        ) from error
    if not ours:
        raise LidarpoolError(
            f"{path} is in the place of the journal and is none of lidarpool: move it, or give "
            "another folder."
        )


def _is_ours(path: Path) -> bool:
    records = path / RECORDS
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return True
    if records.is_file():
        with records.open("rb") as file:
            begin = file.read(len(MAGIC))
        # A crash in the first moment leaves nothing, zeros, or a part of it.
        return MAGIC.startswith(begin) or not any(begin)
    return path.is_dir() and {entry.name for entry in path.iterdir()} <= {FRAMES, FRESH}


def remove_files(path: Path) -> None:
    """Remove the files of a journal, as far as they are there."""
    remove_totals(path)
    (path / RECORDS).unlink(missing_ok=True)


def remove_totals(path: Path) -> None:
    """Remove the totals of the frames, as far as they are there."""
    for name in (FRESH, FRAMES):
        (path / name).unlink(missing_ok=True)


def remove_folder(path: Path) -> None:
    """Remove the folder of a journal unless others' files are in it."""
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()


def flush_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    if os.name == "nt":
        return  # has no handle of a folder to flush
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

"""The folder that results and exports are written to: one writer at a time, nothing half done."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..base.errors import LidarpoolError

_WRITING = ".writing-"  # folder of what is being made; one of a killed program goes at the next


@contextmanager
def result_folder(folder: Path) -> Iterator[Path]:
    """Claim a folder for a result or export: made if it is not there, writable, ours alone.

    What a killed run or export was writing there is removed; and, if the body ends without
    leaving anything, folders that were made for it.

    Raises
    ------
    LidarpoolError
        If it is a file, cannot be made or written to, or another run or export uses it.
    """
    if folder.exists() and not folder.is_dir():
        raise LidarpoolError(f"{folder} is a file: give a folder with --out.")
    made = [path for path in (folder, *folder.parents) if not path.exists()]  # innermost first
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            lock = _lock(folder)
        for left in folder.glob(f"{_WRITING}*"):
            shutil.rmtree(left)
    except BlockingIOError as error:
        raise LidarpoolError(
            f"Another run or export is using the folder {folder}: wait for it, or give another "
            "with --out."
        ) from error
    except OSError as error:
        raise LidarpoolError(
            f"Cannot write to the folder {folder} ({error.strerror}): give another with --out."
        ) from error
    try:
        yield folder
    finally:
        for path in made:
            if path.exists() and not any(path.iterdir()):
                path.rmdir()
        os.close(lock)


def staging(folder: Path) -> Path:
    """Path of a temporary folder in a folder, for what is moved into place once it is whole."""
    return folder / f"{_WRITING}{secrets.token_hex(4)}"


def _lock(folder: Path) -> int:
    """Lock a folder until the handle that is returned is closed, or this process ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network disk without locks
            os.close(handle)
            raise
    return handle

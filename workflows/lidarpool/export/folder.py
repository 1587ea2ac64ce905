"""The folder of results and exports: one writer at a time, no partial files."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import WRITING, Storage, is_url

LAST_FILE = "report.json"  # a result with this file is complete


def output_place(text: str | Path) -> Path | Storage:
    """Place of a result: a folder, or storage for a URL."""
    return Storage.at(text) if is_url(text) else Path(text)


@contextmanager
def result_folder(place: Path | Storage) -> Iterator[Path]:
    """Lock a folder for a result or export: made if missing, writable, exclusive.

    Leftovers of a killed run or export are removed; and, if the body ends without leaving files,
    folders that were made for it. For storage it is a temporary folder, whose files the caller
    puts into the storage.

    Raises
    ------
    LidarError
        If it is a file, cannot be made or written to, or another run or export uses it.
    """
    if isinstance(place, Storage):
        place.claim()
        with local_folder(place) as folder:
            yield folder
        return
    folder = place
    if folder.exists() and not folder.is_dir():
        raise LidarError(f"{folder} is a file: give a folder with --out.")
    made = [path for path in (folder, *folder.parents) if not path.exists()]  # innermost first
    with explained(f"Cannot write to the folder {folder}", "give another with --out"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                lock = _lock(folder)
            Storage.at(folder).tidy(deep=False)
        except BlockingIOError as error:
            raise LidarError(
                f"Another run or export is using the folder {folder}: wait for it, or give another "
                "with --out."
            ) from error
    try:
        yield folder
    finally:
        for path in made:
            if path.exists() and not any(path.iterdir()):
                path.rmdir()
        os.close(lock)


@contextmanager
def local_result(place: Path | Storage, names: Sequence[str]) -> Iterator[Path]:
    """Yield the folder of a result: from storage, a temporary copy of some of its files.

    LidarError if the storage cannot be read, or has no complete result.
    """
    with local_folder(place) as folder:
        if not isinstance(place, Storage):
            yield folder
            return
        with explained(f"{place.url} cannot be read"):
            there = place.sizes()
            if LAST_FILE not in there:
                raise LidarError(
                    f"{place.url} has no complete result, which has a {LAST_FILE}: give the URL of "
                    "a finished run (its --out); lidarpool run --resume continues an unfinished "
                    "one."
                )
            for name in (*names, LAST_FILE):
                if name in there:
                    place.get(name, folder / name)
        yield folder


def send(path: Path, place: Path | Storage) -> str:
    """Copy a file or folder of `result_folder` into its storage, if the place is one.

    What the storage has of that name is replaced. Returns the path or URL, for messages.
    LidarError if the storage cannot be written to.
    """
    if not isinstance(place, Storage):
        return str(path)
    url = place.path(path.name)
    with explained(f"{url} cannot be written"):
        place.discard(path.name)
        place.put(path, path.name)
    return url


@contextmanager
def local_folder(place: Path | Storage) -> Iterator[Path]:
    """Give a folder itself, and for storage a temporary one with the last name of its URL."""
    if not isinstance(place, Storage):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        folder = Path(temporary, place.url.rpartition("/")[2])
        folder.mkdir()
        yield folder


@contextmanager
def staging(folder: Path, place: object = None) -> Iterator[Path]:
    """Temporary folder in a folder, for what is moved into place once it is whole.

    Errors name `place`, by default `folder`, in its stead.
    """
    staged = folder / f"{WRITING}{secrets.token_hex(4)}"
    try:
        staged.mkdir()
        yield staged
    except LidarError as error:
        raise LidarError(str(error).replace(str(staged), str(place or folder))) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


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

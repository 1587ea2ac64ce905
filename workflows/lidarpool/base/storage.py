"""Storage of runs and results: a folder, or any place that fsspec opens.

Files appear completely or not at all: in a folder they are written under a temporary name and
renamed, and an object store shows only complete objects.
"""

from __future__ import annotations

import io
import os
import re
import secrets
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from .errors import LidarpoolError

_PIECE = 1 << 20  # bytes in memory of a file that is checked
_TEMPORARY = ".lidarpool-tmp-"
_LEFT = re.compile(rf"{re.escape(_TEMPORARY)}(.+)-[0-9a-f]{{8}}")


def target_of(name: str) -> str:
    """Name of the file that a temporary file was written for; other names are their own."""
    found = _LEFT.fullmatch(name)
    return found[1] if found else name


def is_url(place: str | Path) -> bool:
    """Whether a place is a URL, not a path."""
    return "://" in str(place)


@dataclass(frozen=True)
class Storage:
    """A folder of files, by path or URL; small when pickled.

    Its methods raise OSError if the storage fails, and LidarpoolError if it cannot be opened.

    Parameters
    ----------
    url
        A folder's path, or a URL such as ``s3://bucket/folder``. The library of that kind of
        storage finds the credentials.
    durable
        Whether files must survive a power failure: flushing takes milliseconds for each file, and
        is not needed for a temporary folder.
    """

    url: str
    durable: bool = True

    @classmethod
    def at(cls, place: str | Path, *, durable: bool = True) -> Storage:
        """Storage at a path, made absolute, or a URL.

        LidarpoolError if the URL holds a password, which would get into databases and reports, or
        only a scheme.
        """
        text = str(place)
        if not is_url(text):
            return cls(str(Path(text).absolute()), durable)
        if ":" in text.partition("://")[2].partition("/")[0].rpartition("@")[0]:
            raise LidarpoolError(
                f"A URL for {text.partition(':')[0]} has a password: leave it out, and give "
                "it in the environment or the configuration of that storage's library."
            )
        # Else `s3://$BUCKET`, with no such variable, would be a local folder.
        if not is_url(text.rstrip("/")):
            raise LidarpoolError(f"{text} names no folder: give one, such as {text}bucket/run.")
        return cls(text.rstrip("/"), durable)

    def __str__(self) -> str:
        return self.url

    @property
    def is_local(self) -> bool:
        """Whether it is a folder in a local file system."""
        return not is_url(self.url)

    @property
    def is_link(self) -> bool:
        """Whether it is a link to a folder elsewhere; the folders above it may be links."""
        return self.is_local and Path(self.url).is_symlink()

    @contextmanager
    def _remote(self) -> Iterator[tuple[Any, str]]:
        """File system and folder of a URL; any error of its library becomes an OSError."""
        try:
            system, folder = self._opened
            system.invalidate_cache()  # other processes write there, too
            yield system, folder
        except (OSError, LidarpoolError):
            raise
        except Exception as error:
            raise OSError(f"{type(error).__name__}: {error}") from error

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        import fsspec

        try:
            system, folder = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            extra = 'pip install "lidarpool[s3]"' if self.url.startswith("s3://") else ""
            hint = f": {extra}" if extra and isinstance(error, ImportError) else ""
            raise LidarpoolError(f"{self.url} cannot be opened: {error}{hint}.") from error
        return system, folder

    def file_system(self) -> tuple[Any, str]:
        """Return the file system of fsspec and the folder, for libraries that open files."""
        with self._remote() as opened:
            return opened

    def __reduce__(self) -> tuple[Any, ...]:
        return Storage, (self.url, self.durable)

    def path(self, name: str) -> str:
        """Path or URL of a file, for messages."""
        return f"{self.url}/{name}"

    def prepare(self) -> None:
        """Make the folder."""
        if self.is_local:
            Path(self.url).mkdir(parents=True, exist_ok=True)
            return
        with suppress(FileExistsError), self._remote() as (system, folder):
            # An object store has no folders, and s3fs would make a bucket for a mistyped name.
            if folder.startswith("/"):
                system.makedirs(folder, exist_ok=True)

    def claim(self) -> None:
        """Make the folder; LidarpoolError if files cannot be written and removed there."""
        name = f"{_TEMPORARY}{secrets.token_hex(4)}"
        try:
            self.prepare()
            self.write(name, b"")
            self.remove([name])
        except FileNotFoundError as error:
            raise LidarpoolError(
                f"Cannot write to {self.url} ({error}): make the bucket first, or give another."
            ) from error
        except OSError as error:
            raise LidarpoolError(
                f"Cannot write to {self.url} ({error}): check the credentials and rights that "
                "its library finds, and at its address."
            ) from error

    def write(self, name: str, data: Any) -> None:
        """Write bytes, or a list of them, completely or not at all; flush them if durable."""
        pieces = data if isinstance(data, list) else [data]
        if self.is_local:
            self._write_file(name, pieces)
            return
        with self._remote() as (system, folder):
            system.pipe_file(f"{folder}/{name}", b"".join(bytes(piece) for piece in pieces))

    def _write_file(self, name: str, pieces: list[Any]) -> None:
        with self._replacing(Path(self.url, name)) as file:
            for piece in pieces:
                view = memoryview(piece).cast("B")
                while len(view):
                    view = view[file.write(view) :]

    @contextmanager
    def writing(self, name: str) -> Iterator[IO[bytes]]:
        """Write a file bit by bit: it appears once the body has ended without an error.

        Folders in its name are made.
        """
        if self.is_local:
            target = Path(self.url, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._replacing(target, io.DEFAULT_BUFFER_SIZE) as file:
                yield file
            return
        with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
            path = Path(folder, "file")
            with path.open("wb") as file:
                yield file
            self.put(path, name)

    @contextmanager
    def _replacing(self, target: Path, buffering: int = 0) -> Iterator[IO[bytes]]:
        temporary = target.with_name(f"{_TEMPORARY}{target.name}-{secrets.token_hex(4)}")
        try:
            with temporary.open("xb", buffering) as file:
                yield file
                if self.durable:
                    file.flush()
                    os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if self.durable:
            flush(target.parent)

    def read(self, name: str) -> bytes:
        """Read a file."""
        if self.is_local:
            return Path(self.url, name).read_bytes()
        with self._remote() as (system, folder):
            return bytes(system.cat_file(f"{folder}/{name}"))

    def checksum(self, name: str) -> list[int]:
        """Bytes of a file and their CRC-32, read a piece at a time."""
        size = crc = 0
        with self._remote() as (system, folder), system.open(f"{folder}/{name}", "rb") as file:
            while piece := file.read(_PIECE):
                size, crc = size + len(piece), zlib.crc32(piece, crc)
        return [size, crc]

    def put(self, path: Path, name: str) -> None:
        """Copy a file of this machine, or a folder of files, into the storage."""
        with self._remote() as (system, folder):
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file():
                    below = file.relative_to(path).as_posix() if file != path else ""
                    system.put_file(str(file), f"{folder}/{name}/{below}".rstrip("/"))

    def get(self, name: str, path: Path) -> None:
        """Copy a file of the storage to this machine."""
        with self._remote() as (system, folder):
            system.get_file(f"{folder}/{name}", str(path))

    def sees(self, name: str, data: bytes) -> bool:
        """Whether a file has this content, so that this process sees the same place."""
        try:
            return self.read(name) == data
        except Exception:  # any error of a storage or its missing library
            return False

    def sizes(self) -> dict[str, int]:
        """All plain files and their sizes in bytes; none without the folder."""
        return {name: size for name, size in self.entries().items() if size is not None}

    def entries(self) -> dict[str, int | None]:
        """Everything in the folder: {name: bytes of a file, None for a folder or link}.

        A missing folder is empty.
        """
        found: dict[str, int | None] = {}
        if self.is_local:
            with suppress(FileNotFoundError), os.scandir(self.url) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # just renamed or removed
                        plain = entry.is_file(follow_symlinks=False)
                        found[entry.name] = entry.stat().st_size if plain else None
            return found
        with suppress(FileNotFoundError), self._remote() as (system, folder):
            for one in system.ls(folder, detail=True):
                plain = one["type"] == "file" and not one.get("islink")
                found[one["name"].rpartition("/")[2]] = (one["size"] or 0) if plain else None
        return found

    def remove(self, names: list[str]) -> None:
        """Remove files; no error for missing ones."""
        for name in names:
            if self.is_local:
                Path(self.url, name).unlink(missing_ok=True)
            else:
                with suppress(FileNotFoundError), self._remote() as (system, folder):
                    system.rm_file(f"{folder}/{name}")

    def has(self, name: str) -> bool:
        """Whether there is a file or folder of this name."""
        with self._remote() as (system, folder):
            return bool(system.exists(f"{folder}/{name}"))

    def discard(self, name: str) -> None:
        """Remove a file or folder of the storage with its content, if it exists."""
        with suppress(FileNotFoundError), self._remote() as (system, folder):
            system.rm(f"{folder}/{name}", recursive=True)

    def tidy(self) -> None:
        """Remove what killed writers have left of files in a folder of this machine."""
        for folder, _, names in os.walk(self.url) if self.is_local else ():  # follows no links
            for name in names:
                if target_of(name) != name:
                    Path(folder, name).unlink(missing_ok=True)

    def remove_folder(self) -> None:
        """Remove the folder if it is empty."""
        if self.is_local:
            with suppress(OSError):
                Path(self.url).rmdir()


def flush(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

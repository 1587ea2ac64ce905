"""Storage of runs and results: a folder, or any URL that fsspec opens.

Files appear completely or not at all: in a folder they are written under a temporary name and
renamed, and an object store shows only complete objects.
"""

from __future__ import annotations

import errno
import os
import re
import reprlib
import secrets
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from ..environment.extras import install_command
from ..errors import ArgumentError, LidarError
from ..words import printable
from .checksum import crc32
from .input_files import open_input

_BLOCK_BYTES = 1 << 20  # read at a time of a file that is copied or checked
TEMPORARY = ".lidarpool-tmp-"  # prefix of the name of an unfinished file
WRITING = ".lidarpool-writing-"  # prefix of the name of a folder of unfinished files
_LEFTOVER = re.compile(rf"(?:{re.escape(TEMPORARY)}(.+)-|{re.escape(WRITING)})[0-9a-f]{{8}}")


def target_of(name: str) -> str:
    """Return the name of the file for which a temporary file was written, or the name itself."""
    match = _LEFTOVER.fullmatch(name)
    return match[1] or name if match else name


def is_url(location: str | Path) -> bool:
    """Return True if a location is a URL, not a path."""
    return "://" in str(location)


@dataclass(frozen=True)
class Storage:
    """A folder of files, by path or URL, small when pickled.

    Files are not opened, written or removed through a link below the folder that the user named.
    Writing or removing a file that is a link replaces or removes the link, not its target.

    The methods raise OSError if the storage fails, and LidarError if the storage cannot be opened
    or a path leads through such a link.

    Parameters
    ----------
    url
        A folder's path, or a URL such as ``s3://bucket/folder``. The library of the storage finds
        the credentials.
    durable
        Whether files must survive a power failure: flushing takes milliseconds for each file, and
        is not needed for a temporary folder.
    named
        The folder that the user named, this folder or a parent, which may be a link; "" follows all
        links.
    """

    url: str
    durable: bool = True
    named: str = ""

    @classmethod
    def at(cls, location: str | Path | Storage, *, durable: bool = True) -> Storage:
        """Return the storage at a path that the user named, or at a URL, or a given storage.

        LidarError if the URL has a password, which would get into databases and reports, or only
        a scheme.
        """
        if isinstance(location, Storage):
            return location
        if not isinstance(location, (str, Path)):
            raise ArgumentError(
                f"location must be a str or a Path, but is {reprlib.repr(location)}."
            )
        text = str(location)
        if not is_url(text):
            path = str(Path(text).absolute())
            return cls(path, durable, path)
        if ":" in text.partition("://")[2].partition("/")[0].rpartition("@")[0]:
            raise LidarError(
                f"A URL for {text.partition(':')[0]} must not contain a password. Set it in the "
                "environment or in the configuration of the storage library."
            )
        # Else `s3://$BUCKET`, with no such variable, would be a local folder.
        if not is_url(text.rstrip("/")):
            raise LidarError(
                f"{text} does not name a folder. Add one, for example {text}bucket/run."
            )
        return cls(text.rstrip("/"), durable)

    def __str__(self) -> str:
        return self.url

    @property
    def is_local(self) -> bool:
        """True for a folder in a local file system."""
        return not is_url(self.url)

    def below(self, name: str) -> Storage:
        """Return the storage of a folder below, which need not exist."""
        if self.is_local:
            self.local(name)
        return replace(self, url=f"{self.url}/{name}")

    def local(self, name: str | Path = "") -> Path:
        """Return the path of a file or folder in a local folder, or of the folder itself.

        LidarError if the name leads outside of the folder, by `..` or as another absolute path.
        """
        path = Path(self.url, name)
        if ".." in Path(name).parts or not path.is_relative_to(self.url):
            raise LidarError(
                f"{printable(str(name))!r} is not the name of a file in {self.url}. Only files in "
                "that folder are used."
            )
        if not self.named:
            return path
        for ancestor in (path, *path.parents):
            if len(str(ancestor)) <= len(self.named):
                break
            if ancestor.is_symlink():
                raise LidarError(
                    f"{ancestor} is a symbolic link, but links in {self.named} are not followed. "
                    "Replace the link with its target."
                ) from OSError(errno.ELOOP, os.strerror(errno.ELOOP))  # for every caller
        return path

    def _target(self, name: str) -> Path:
        """Return the path of a file or folder to replace or remove."""
        path = Path(name)
        return self.local(path.parent) / path.name

    @contextmanager
    def _remote(self) -> Iterator[tuple[Any, str]]:
        """Return file system and folder of a URL, and turn errors of its library into OSError."""
        try:
            if self._opened[0] != os.getpid():  # a fork cannot use its parent's connections
                self.__dict__.pop("_opened", None)
            _, system, folder = self._opened
            system.invalidate_cache()  # other processes write to the storage, too
            yield system, folder
        except (OSError, LidarError):
            raise
        except Exception as error:
            raise OSError(f"{type(error).__name__}: {error}") from error

    @cached_property
    def _opened(self) -> tuple[int, Any, str]:
        """Process that has opened the storage, file system and folder."""
        try:
            import fsspec
        except ImportError as error:
            command = install_command("fsspec")
            raise LidarError(
                f"{self.url} requires fsspec, which is not installed. Run {command}."
            ) from error
        try:
            system, folder = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            extra = install_command("lidarpool[s3]") if self.url.startswith("s3://") else ""
            hint = f". Run {extra}" if extra and isinstance(error, ImportError) else ""
            raise LidarError(f"{self.url} cannot be opened: {error}{hint}.") from error
        return os.getpid(), system, folder

    def file_system(self) -> tuple[Any, str]:
        """Return the file system of fsspec and the folder, for libraries that open files."""
        with self._remote() as opened:
            return opened

    def __reduce__(self) -> tuple[Any, ...]:
        return Storage, (self.url, self.durable, self.named)

    def path(self, name: str) -> str:
        """Return the path or URL of a file, for messages."""
        return f"{self.url}/{name}"

    def prepare(self, name: str | Path = "") -> None:
        """Make the folder, or a folder below."""
        if self.is_local:
            self.local(name).mkdir(parents=True, exist_ok=True)
            return
        with suppress(FileExistsError), self._remote() as (system, folder):
            # An object store has no folders, and s3fs would make a bucket for a mistyped name.
            if folder.startswith("/"):
                system.makedirs(f"{folder}/{name}".rstrip("/"), exist_ok=True)

    def claim(self) -> None:
        """Make the folder.

        Raises LidarError if files cannot be written and removed.
        """
        name = f"{TEMPORARY}{secrets.token_hex(4)}"
        try:
            self.prepare()
            self.write(name, b"")
            self.remove([name])
        except FileNotFoundError as error:
            raise LidarError(
                f"Cannot write to {self.url}: {error}. Create the bucket first, or use a different "
                "one."
            ) from error
        except OSError as error:
            raise LidarError(
                f"Cannot write to {self.url}: {error}. Check the credentials, the permissions and "
                "the address."
            ) from error

    def write(self, name: str, content: Any) -> None:
        """Write bytes, or a list of pieces, completely or not at all, and flush if durable."""
        pieces = content if isinstance(content, list) else [content]
        if self.is_local:
            with self._replacing(self._target(name)) as file:
                file.writelines(pieces)
            return
        with self._remote() as (system, folder):
            system.pipe_file(f"{folder}/{name}", b"".join(pieces))

    @contextmanager
    def writing(self, name: str) -> Iterator[IO[bytes]]:
        """Open a file for writing, which appears once the body has ended without an error.

        Folders in the name are made.
        """
        if self.is_local:
            target = self._target(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._replacing(target) as file:
                yield file
            return
        with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
            path = Path(folder, "file")
            with path.open("wb") as file:
                yield file
            self.put(path, name)

    @contextmanager
    def _replacing(self, target: Path) -> Iterator[IO[bytes]]:
        """Open a temporary file that replaces a file after the body."""
        temporary = target.with_name(f"{TEMPORARY}{target.name}-{secrets.token_hex(4)}")
        try:
            with temporary.open("xb") as file:
                yield file
                if self.durable:  # before the name: else a power failure may leave an empty file
                    file.flush()
                    os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if self.durable:  # the receipt of a part is committed only once its name lasts, too
            flush(target.parent)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> bytes:
        """Read a file, or its bytes from `first` to `stop`, or to its end."""
        if self.is_local:
            with open_input(self.local(name)) as file:
                file.seek(first)
                return file.read(-1 if stop is None else stop - first)
        with self._remote() as (system, folder):
            return bytes(system.cat_file(f"{folder}/{name}", start=first or None, end=stop))

    @contextmanager
    def _reading(self, name: str) -> Iterator[IO[bytes]]:
        """Open a file for the body."""
        if self.is_local:
            with open_input(self.local(name)) as file:
                yield file
        else:
            with self._remote() as (system, folder), system.open(f"{folder}/{name}", "rb") as file:
                yield file

    def checksum(self, name: str) -> list[int]:
        """Return the size of a file in bytes and its CRC-32."""
        size = crc = 0
        with self._reading(name) as file:
            while piece := file.read(_BLOCK_BYTES):
                size = size + len(piece)
                crc = crc32(piece, crc)
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

    def take(self, source: Storage, name: str, new_name: str) -> None:
        """Copy a file of another storage, completely or not at all, to a name in this storage.

        Where possible, the file is linked (a hard link), or an object store copies it.
        """
        if self.is_local and source.is_local:
            self.remove([new_name])
            with suppress(OSError):  # on another disk, or on a disk without links, copy the file
                os.link(source.local(name), self._target(new_name))
                return
        with source._remote() as (source_system, folder), self._remote() as (system, target_folder):
            if source_system is system and not self.is_local:
                system.cp_file(f"{folder}/{name}", f"{target_folder}/{new_name}")
                return
        with source._reading(name) as source_file, self.writing(new_name) as file:
            shutil.copyfileobj(source_file, file, _BLOCK_BYTES)

    def sees(self, name: str, data: bytes) -> bool:
        """Return True if a file has this content: then this process sees the same storage."""
        try:
            return self.read(name) == data
        except Exception:  # any error of a storage or its missing library
            return False

    def sizes(self) -> dict[str, int]:
        """Return all plain files and their sizes, bytes, or {} if the folder is missing."""
        return {name: size for name, size in self.entries().items() if size is not None}

    def entries(self) -> dict[str, int | None]:
        """Return all entries of the folder: {name: bytes of a file, None for a folder or link}.

        A missing folder has no entries.
        """
        sizes: dict[str, int | None] = {}
        if self.is_local:
            with suppress(FileNotFoundError), os.scandir(self.local()) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # just renamed or removed
                        plain = entry.is_file(follow_symlinks=False)
                        sizes[entry.name] = entry.stat().st_size if plain else None
            return sizes
        with suppress(FileNotFoundError), self._remote() as (system, folder):
            for info in system.ls(folder, detail=True):
                plain = info["type"] == "file" and not info.get("islink")
                sizes[info["name"].rpartition("/")[2]] = (info["size"] or 0) if plain else None
        return sizes

    def remove(self, names: Iterable[str], *, folder: bool = False) -> None:
        """Remove files, some of them missing perhaps, and with `folder` the empty folder."""
        for name in names:
            if self.is_local:
                self._target(name).unlink(missing_ok=True)
            else:
                with suppress(FileNotFoundError), self._remote() as (system, path):
                    system.rm_file(f"{path}/{name}")
        if folder and self.is_local:
            with suppress(OSError):
                self.local().rmdir()

    def tree(self, name: str = "") -> list[str]:
        """Return the names of all files in a folder and below.

        Raises LidarError for a link.
        """
        if self.is_local:
            paths_below: list[Path] = []
            for folder, folders, files in os.walk(self.local(name)):
                paths = [Path(folder, entry) for entry in (*files, *folders)]
                for path in filter(Path.is_symlink, paths):
                    self.local(path)
                paths_below += paths[: len(files)]
            return [path.relative_to(self.url).as_posix() for path in paths_below]
        with self._remote() as (system, folder):
            below = system.find(f"{folder}/{name}".rstrip("/"))
            return [entry.removeprefix(f"{folder}/") for entry in below]

    def prune(self, names: Collection[str]) -> None:
        """Remove files below, in this order, and then the folders without further files."""
        self.remove(names)
        folders = {str(folder) for name in names for folder in Path(name).parents}
        for folder in sorted(folders - {"."}, key=len, reverse=True):
            self.below(folder).remove([], folder=True)

    def discard(self, name: str) -> None:
        """Remove a file or a folder with its content, which may be missing."""
        if self.is_local:
            path = self._target(name)
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        else:
            with suppress(FileNotFoundError), self._remote() as (system, folder):
                system.rm(f"{folder}/{name}", recursive=True)

    def tidy(self, *, deep: bool = True) -> None:
        """Remove the files of killed writers in a local folder, and in folders below if `deep`."""
        if not self.is_local:
            return
        for folder, folders, files in os.walk(self.local()):
            for path in (Path(folder, name) for name in (*folders, *files)):
                if _LEFTOVER.fullmatch(path.name) and not path.is_symlink():
                    self.discard(path.relative_to(self.url).as_posix())
            if not deep:
                break


def flush(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

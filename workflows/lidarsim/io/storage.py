"""Storage for runs and results in a local folder or at any URL that fsspec supports.

Writes are atomic: local files are written under a temporary name and then renamed, and object
stores only make complete objects visible.
"""

from __future__ import annotations

import errno
import os
import re
import reprlib
import secrets
import shutil
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import IO, Any

from ..environment.extras import install_command
from ..errors import ArgumentError, LidarError
from ..words import printable
from .checksum import crc32
from .input_files import open_input

_BLOCK_BYTES = 1 << 20  # bytes to read at a time when a file is copied or its checksum computed
TEMPORARY = ".lidarpool-tmp-"  # name prefix of unfinished files
WRITING = ".lidarpool-writing-"  # name prefix of folders that contain unfinished files
_LEFTOVER = re.compile(
    rf"(?:{re.escape(TEMPORARY)}(.+)-|{re.escape(WRITING)}(?:(.+)-)?)[0-9a-f]{{8}}"
)


def final_name(name: str) -> str:
    """Return the final name of a temporary file, or the name itself if it is not temporary."""
    match = _LEFTOVER.fullmatch(name)
    return match[1] or name if match else name


def is_url(location: str | Path) -> bool:
    """Return whether a location is a URL rather than a path."""
    return "://" in str(location)


@dataclass(frozen=True)
class Storage:
    """A folder, specified by a path or URL, that stores files.

    Storage objects are cheap to pickle. Symbolic links below the folder that the user specified are
    not followed when files are opened, written or removed. Writing or removing a file that is
    itself a link replaces or removes the link, not its target.

    All methods raise OSError if an operation fails, and LidarError if the storage cannot be opened
    or if a path contains a symbolic link that is not followed.

    Parameters
    ----------
    url
        Path of a folder, or a URL such as ``s3://bucket/folder``. The storage library is
        responsible for finding the credentials.
    durable
        Whether files must survive a power failure. Flushing takes a few milliseconds per file and
        is unnecessary in a temporary folder.
    named
        The folder that the user specified, which is this folder or one of its parents and may be a
        link. If it is empty, all links are followed.
    """

    url: str
    durable: bool = True
    named: str = ""

    @classmethod
    def at(cls, location: str | Path | Storage, *, durable: bool = True) -> Storage:
        """Open the storage at a path or URL that the user specified.

        A location that already is a `Storage` is returned unchanged.

        Raises
        ------
        LidarError
            If the URL consists only of a scheme, or if it contains a password, which would end up
            in databases and reports.
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
        # If the variable in `s3://$BUCKET` is undefined, the URL would refer to a local folder.
        if not is_url(text.rstrip("/")):
            raise LidarError(
                f"{text} does not name a folder. Add one, for example {text}bucket/run."
            )
        return cls(text.rstrip("/"), durable)

    def __str__(self) -> str:
        return self.url

    @property
    def is_local(self) -> bool:
        """Whether the folder is in a local file system."""
        return not is_url(self.url)

    def below(self, name: str) -> Storage:
        """Return the storage for a subfolder, which need not exist."""
        if self.is_local:
            self.local(name)
        return replace(self, url=f"{self.url}/{name}")

    def local(self, name: str | Path = "") -> Path:
        """Return the local path of a file or subfolder, or of the folder itself.

        Raises
        ------
        LidarError
            If the name contains `..`, is an absolute path outside the folder, or leads through a
            symbolic link that is not followed.
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
                ) from OSError(
                    errno.ELOOP, os.strerror(errno.ELOOP)
                )  # some callers check the cause
        return path

    def _target(self, name: str) -> Path:
        """Return the local path of a file or folder that will be replaced or removed.

        A link at this path is not followed.
        """
        path = Path(name)
        return self.local(path.parent) / path.name

    @contextmanager
    def _remote(self) -> Iterator[tuple[Any, str]]:
        """Provide the fsspec file system of the storage, and the folder in it.

        Exceptions that the storage library raises in the context are converted to OSError.
        """
        try:
            if self._opened[0] != os.getpid():  # connections do not survive a fork
                self.__dict__.pop("_opened", None)
            _, system, folder = self._opened
            system.invalidate_cache()  # other processes may write to the storage
            yield system, folder
        except (OSError, LidarError):
            raise
        except Exception as error:
            raise OSError(f"{type(error).__name__}: {error}") from error

    @cached_property
    def _opened(self) -> tuple[int, Any, str]:
        """ID of the process that opened the URL, and the URL's file system and folder."""
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
        """Return the fsspec file system and the folder for libraries that open files."""
        with self._remote() as opened:
            return opened

    def __reduce__(self) -> tuple[Any, ...]:
        return Storage, (self.url, self.durable, self.named)

    def path(self, name: str) -> str:
        """Return the path or URL of a file for use in messages."""
        return f"{self.url}/{name}"

    def prepare(self, name: str | Path = "") -> None:
        """Create the folder or a subfolder, if it does not exist."""
        if self.is_local:
            self.local(name).mkdir(parents=True, exist_ok=True)
            return
        with suppress(FileExistsError), self._remote() as (system, folder):
            # Object stores have no folders, and s3fs would create a bucket with a misspelled name.
            if folder.startswith("/"):
                system.makedirs(f"{folder}/{name}".rstrip("/"), exist_ok=True)

    def claim(self) -> None:
        """Create the folder and check that files can be written and removed.

        Raises
        ------
        LidarError
            If files cannot be written or removed.
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
        """Write a file atomically, and flush it to disk if the storage is durable.

        The content is either bytes or a list of pieces to concatenate.
        """
        pieces = content if isinstance(content, list) else [content]
        if self.is_local:
            with self._replacing(self._target(name)) as file:
                file.writelines(pieces)
            return
        with self._remote() as (system, folder):
            system.pipe_file(f"{folder}/{name}", b"".join(pieces))

    @contextmanager
    def writing(self, name: str) -> Iterator[IO[bytes]]:
        """Open a file for atomic writing.

        The file becomes visible when the context exits without an error. Subfolders in its name are
        created.
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
        """Open a temporary file that replaces the target when the context exits."""
        temporary = target.with_name(f"{TEMPORARY}{target.name}-{secrets.token_hex(4)}")
        try:
            with temporary.open("xb") as file:
                yield file
                if self.durable:  # otherwise, a power failure after renaming may leave it empty
                    file.flush()
                    os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if self.durable:  # the receipt of a part may be committed only after the rename is durable
            flush(target.parent)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> bytes:
        """Read the bytes of a file from `first` up to `stop` (default: the entire file)."""
        if self.is_local:
            with open_input(self.local(name)) as file:
                file.seek(first)
                return file.read(-1 if stop is None else stop - first)
        with self._remote() as (system, folder):
            return bytes(system.cat_file(f"{folder}/{name}", start=first or None, end=stop))

    @contextmanager
    def _reading(self, name: str) -> Iterator[IO[bytes]]:
        """Open a file for reading."""
        if self.is_local:
            with open_input(self.local(name)) as file:
                yield file
        else:
            with self._remote() as (system, folder), system.open(f"{folder}/{name}", "rb") as file:
                yield file

    def checksum(self, name: str) -> list[int]:
        """Return the size in bytes and the CRC-32 of a file."""
        size = crc = 0
        with self._reading(name) as file:
            while piece := file.read(_BLOCK_BYTES):
                size = size + len(piece)
                crc = crc32(piece, crc)
        return [size, crc]

    def put(self, path: Path, name: str) -> None:
        """Copy a local file, or all files in a local folder, to the storage."""
        with self._remote() as (system, folder):
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file():
                    below = file.relative_to(path).as_posix() if file != path else ""
                    system.put_file(str(file), f"{folder}/{name}/{below}".rstrip("/"))

    def get(self, name: str, path: Path) -> None:
        """Copy a file from the storage to a local path."""
        with self._remote() as (system, folder):
            system.get_file(f"{folder}/{name}", str(path))

    def copy_from(self, source: Storage, name: str, new_name: str) -> None:
        """Copy a file atomically from another storage.

        If possible, the copy is a hard link or is made by the object store itself.
        """
        if self.is_local and source.is_local:
            self.remove([new_name])
            with suppress(OSError):  # fall back to copying if the disk does not support the link
                os.link(source.local(name), self._target(new_name))
                return
        with source._remote() as (source_system, folder), self._remote() as (system, target_folder):
            if source_system is system and not self.is_local:
                with suppress(NotImplementedError):  # for example, SFTP
                    system.cp_file(f"{folder}/{name}", f"{target_folder}/{new_name}")
                    return
        with source._reading(name) as source_file, self.writing(new_name) as file:
            shutil.copyfileobj(source_file, file, _BLOCK_BYTES)

    def has_content(self, name: str, data: bytes) -> bool:
        """Return whether a file has the given content.

        Use this method to check whether this process has access to the same storage as another
        process, which wrote the file.
        """
        try:
            return self.read(name) == data
        except Exception:  # the storage may fail in any way, or its library may be missing
            return False

    def sizes(self) -> dict[str, int]:
        """Return the names of all regular files in the folder and their sizes in bytes.

        The mapping is empty if the folder does not exist.
        """
        return {name: size for name, size in self.entries().items() if size is not None}

    def entries(self) -> dict[str, int | None]:
        """Return the names of all entries in the folder and their sizes in bytes.

        The size of a subfolder or link is None. The mapping is empty if the folder does not exist.
        """
        sizes: dict[str, int | None] = {}
        if self.is_local:
            with suppress(FileNotFoundError), os.scandir(self.local()) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # the entry may have just been removed
                        plain = entry.is_file(follow_symlinks=False)
                        sizes[entry.name] = entry.stat().st_size if plain else None
            return sizes
        with suppress(FileNotFoundError), self._remote() as (system, folder):
            for info in system.ls(folder, detail=True):
                plain = info["type"] == "file" and not info.get("islink")
                sizes[info["name"].rpartition("/")[2]] = (info["size"] or 0) if plain else None
        return sizes

    def remove(self, names: Iterable[str], *, folder: bool = False) -> None:
        """Remove files, which need not exist.

        If `folder` is true, the folder is removed as well, unless it still contains files.
        """
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
        """Return the names of all files in a folder and its subfolders.

        Raises
        ------
        LidarError
            If the folder contains a symbolic link that is not followed.
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
        """Remove files in the given order, and then the subfolders that have become empty."""
        self.remove(names)
        folders = {str(folder) for name in names for folder in Path(name).parents}
        for folder in sorted(folders - {"."}, key=len, reverse=True):
            self.below(folder).remove([], folder=True)

    def discard(self, name: str) -> None:
        """Remove a file, or a folder and its contents, if it exists."""
        if self.is_local:
            path = self._target(name)
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        else:
            with suppress(FileNotFoundError), self._remote() as (system, folder):
                system.rm(f"{folder}/{name}", recursive=True)

    def remove_unfinished(self, final: str | None = None, *, deep: bool = True) -> None:
        """Remove unfinished files and folders that killed processes left in the folder.

        Files that are locked by a living process (see `lock`) are kept. There are no locks in
        remote storage, so nothing is removed there unless `final` is specified.

        Parameters
        ----------
        final
            Only remove what was written for the file or folder with this name.
        deep
            Whether the subfolders of a local folder are cleaned up as well.
        """
        if not self.is_local:
            if final is not None:
                for name in filter(partial(_is_leftover, final), self.entries()):
                    self.discard(name)
            return
        for folder, folders, files in os.walk(self.local()):
            for path in (Path(folder, name) for name in (*folders, *files)):
                if (
                    _is_leftover(final, path.name)
                    and not path.is_symlink()
                    and not _is_locked(path)
                ):
                    self.discard(path.relative_to(self.url).as_posix())
            if not deep:
                break


def _is_leftover(final: str | None, name: str) -> bool:
    match = _LEFTOVER.fullmatch(name)
    return match is not None and final in (None, *match.groups())


@contextmanager
def lock(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Lock a file or folder until the context exits or this process ends.

    Network disks without locks are supported, but any number of processes can lock their files.

    Raises
    ------
    BlockingIOError
        If `wait` is false and another context has locked the file or folder.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        _flock(handle, wait=wait)
        yield
    finally:
        os.close(handle)


def _is_locked(path: Path) -> bool:
    try:
        with lock(path, wait=False):
            return False
    except OSError as error:
        return isinstance(error, BlockingIOError)


def _flock(handle: int, *, wait: bool) -> None:
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network disk without locks
            raise


@contextmanager
def replacing_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file that replaces the given file when the context exits without an error.

    Temporary files that killed processes have left for the same file are removed.
    """
    path = path.absolute()
    storage = Storage.at(path.parent)
    storage.remove_unfinished(path.name, deep=False)
    with storage._replacing(path) as file, lock(Path(file.name)):
        yield file


def replace_file(path: Path, content: bytes) -> None:
    """Write a file atomically, and flush it to disk."""
    with replacing_file(path) as file:
        file.write(content)


@contextmanager
def staging(folder: Path, shown: object = None, final: str = "") -> Iterator[Path]:
    """Create a temporary subfolder for files that are moved into place once they are complete.

    Parameters
    ----------
    folder
        Folder of the result.
    shown
        What error messages mention instead of the temporary folder (default: `folder`).
    final
        Name of the file or folder of the result. What killed processes have staged for it is
        removed. It is unnecessary if the caller has removed all unfinished files in the folder.
    """
    staged = folder / f"{WRITING}{f'{final}-' * bool(final)}{secrets.token_hex(4)}"
    try:
        if final:
            Storage.at(folder).remove_unfinished(final, deep=False)
        staged.mkdir()
        with lock(staged):
            yield staged
    except LidarError as error:
        raise LidarError(str(error).replace(str(staged), str(shown or folder))) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def flush(path: Path) -> None:
    """Flush a file, or the directory entries of a folder, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

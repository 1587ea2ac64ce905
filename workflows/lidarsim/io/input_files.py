"""Safe access to input files, which must be regular files of known size.

Every reader opens its file with `open_input`, or calls `check_input` before a library opens the
file. Devices, pipes, sockets and folders are rejected.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Collection
from contextlib import suppress
from io import BufferedReader
from pathlib import Path

from ..errors import LidarError
from ..words import did_you_mean, most_similar
from .allowance import bytes_of, memory

# Opening a pipe blocks until there is a writer, and opening a terminal may make it the controlling
# terminal. The flags prevent this if the file is replaced between the check and the call to open.
_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))
_KINDS = {  # {file type bits of the mode: description}
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_LFS_MAX_BYTES = 1024  # maximum size of a pointer file according to the Git LFS specification


class InputFileError(OSError):
    """An error for an input path that is not a regular file with content.

    `strerror` is a single line that states what the path refers to and what to do.
    """

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(errno.EINVAL, reason, str(path))


def open_input(path: str | Path) -> BufferedReader:
    """Open a regular file for reading.

    Parameters
    ----------
    path
        A file or a link to a file.

    Raises
    ------
    InputFileError
        If the path refers to a pipe, socket or device, or if the file is a Git LFS pointer.
    OSError
        If the path refers to a folder or does not exist, or if the file cannot be opened.
    """
    _check_kind(path, Path(path).stat().st_mode)
    handle = os.open(path, _FLAGS)
    try:
        state = os.fstat(handle)
        _check_kind(path, state.st_mode)
        if len(_LFS_POINTER) <= state.st_size <= _LFS_MAX_BYTES:
            if os.read(handle, len(_LFS_POINTER)) == _LFS_POINTER:
                raise InputFileError(
                    path, "it is a Git LFS pointer. Download the file with git lfs pull"
                )
            os.lseek(handle, 0, os.SEEK_SET)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def not_found(path: str | Path, endings: Collection[str] = ()) -> str:
    """Return a message about a missing file that suggests a similar name in its folder.

    Suggested names end with one of `endings` (default: the suffix of the file).
    """
    file = Path(path)
    names: list[str] = []
    with suppress(OSError):
        names = [entry.name for entry in file.parent.iterdir()]
    likely = tuple(endings) or (file.suffix.lower(),)
    # Equal endings alone do not make names similar.
    similar = [
        name
        for name in names
        if name.lower().endswith(likely) and most_similar(file.stem, [Path(name).stem])
    ]
    hint = did_you_mean(file.name, similar)
    return f"{path} does not exist.{hint}"


def _check_kind(path: str | Path, mode: int) -> None:
    """Raise OSError if the mode is not that of a regular file."""
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "not a regular file")
        raise InputFileError(path, f"it is {kind}. Expected a regular file")


def input_size(path: str | Path) -> int:
    """Return the size of a regular file in bytes.

    Raises
    ------
    OSError
        If the file is not a regular file or cannot be opened.
    """
    with open_input(path) as file:
        return os.fstat(file.fileno()).st_size


def check_input(path: str | Path) -> int:
    """Check that a regular file fits into memory, and return its size in bytes.

    Raises
    ------
    LidarError
        If the file is larger than the memory.
    OSError
        If the file is not a regular file or cannot be read.
    """
    size = input_size(path)
    if size > memory():
        raise LidarError(
            f"it has {bytes_of(size)}, which exceeds the memory of this machine "
            f"({bytes_of(memory())}). Use a part of the file, or a machine with more memory."
        )
    return size


def read_input(path: str | Path, max_bytes: int | None = None) -> bytes:
    """Read a file, or only its first `max_bytes` bytes.

    Raises
    ------
    LidarError
        If `max_bytes` is None and the file is larger than the memory.
    OSError
        If the file is not a regular file or cannot be read.
    """
    size = check_input(path) if max_bytes is None else max_bytes
    with open_input(path) as file:
        return file.read(size)


def read_input_text(path: str | Path, errors: str = "strict") -> str:
    """Read a text file in UTF-8.

    A byte order mark is removed, and line endings are converted to newlines. `errors` is passed to
    `bytes.decode`.

    Raises
    ------
    ValueError
        If the file is not encoded in UTF-8.
    LidarError
        If the file is larger than the memory.
    OSError
        If the file cannot be read.
    """
    text = read_input(path).decode("utf-8-sig", errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")

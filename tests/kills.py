"""Kill code at each change on disk, without a process of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_CHANGES = {
    "os.remove",
    "os.rename",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
}


class KilledError(BaseException):
    """Raised instead of a change on disk."""


class _Kills:
    """Audit hook that prevents all changes in a folder after a given number of changes."""

    def __init__(self) -> None:
        self.folder: str | None = None
        self.left = 0

    def __call__(self, event: str, arguments: tuple) -> None:
        if self.folder is None or not self._changes(event, arguments):
            return
        self.left -= 1
        if self.left < 0:
            raise KilledError

    def _changes(self, event: str, arguments: tuple) -> bool:
        if event == "open":
            path, _, flags = arguments
            if not isinstance(path, (str, bytes)) or not flags & (os.O_WRONLY | os.O_RDWR):
                return False
        elif event in _CHANGES:
            path = arguments[0]
        else:
            return False
        name = os.fsdecode(path)
        return not Path(name).is_absolute() or name.startswith(self.folder)


_kills: list[_Kills] = []  # audit hooks cannot be removed


@contextmanager
def killed_after(changes: int, folder: Path) -> Iterator[None]:
    """Prevent all changes below a folder after the given number of changes.

    Nothing that runs afterward changes the disk, such as the removal of temporary files, as if the
    process had been killed.
    """
    if not _kills:
        _kills.append(_Kills())
        sys.addaudithook(_kills[0])
    _kills[0].left = changes
    _kills[0].folder = str(folder)
    try:
        yield
    finally:
        _kills[0].folder = None


def count_changes(folder: Path, call: Callable[[], object]) -> int:
    """Call a function, and return the number of its changes on disk below a folder."""
    most = 1 << 30
    with killed_after(most, folder):
        call()
        return most - _kills[0].left


def is_killed(changes: int, folder: Path, call: Callable[[], object]) -> bool:
    """Call a function, and return whether it was killed after the given number of changes."""
    try:
        with killed_after(changes, folder):
            call()
    except BaseException as error:
        if _is_kill(error):
            return True
        raise
    return False


def _is_kill(error: BaseException | None) -> bool:
    """Return whether an exception, or one that it replaced, comes from a prevented change."""
    while error is not None:
        if isinstance(error, KilledError):
            return True
        error = error.__cause__ or error.__context__
    return False

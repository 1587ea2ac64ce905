"""Move the files of a finished result into place."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.io.storage import Storage, flush


def move_into_place(
    staged: Path,
    folder: Path,
    *,
    last: str,
    remove: Iterable[str] = (),
    on_written: Callable[[], object] = lambda: None,
) -> list[Path]:
    """Move all files and folders in a staging folder to the folder of the result.

    All files are flushed to the disk first. If the process is then killed at any time, the folder
    contains the earlier result, the new result, or a result whose file `last` is missing.

    Parameters
    ----------
    staged
        Folder with the files, in the same file system.
    folder
        Folder of the result, which the caller has locked. Files and folders with the same names
        are replaced.
    last
        File that marks a complete result. It is removed before, and moved after, all others.
    remove
        Further files and folders of an earlier result to remove.
    on_written
        Function that is called when all files are in place, before a pending interrupt is raised.

    Returns
    -------
    The moved files and folders, which end with `last`.
    """
    names = sorted(path.name for path in staged.iterdir() if path.name != last)
    for path in staged.rglob("*"):
        if path.is_file():
            flush(path)
    target = Storage.at(folder)
    with defer_interrupts():
        # A file is replaced in one operation, in contrast to a folder.
        folders = [name for name in names if (folder / name).is_dir() or (staged / name).is_dir()]
        for name in (last, *remove, *folders):
            target.discard(name)
        flush(folder)  # a crash must not leave an earlier `last` beside new files
        for name in names:
            (staged / name).replace(folder / name)
        flush(folder)
        (staged / last).replace(folder / last)
        flush(folder)  # makes the moves durable before anything else is removed
        on_written()
    return [folder / name for name in (*names, last)]

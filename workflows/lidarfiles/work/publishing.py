"""Publish results: their files are staged, and moved into place when all of them are complete."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.io.storage import WRITING, Storage, flush, staging


@contextmanager
def publishing(target: Path, remove: Iterable[str] = ()) -> Iterator[Path]:
    """Yield a folder for the files of a result, and then move them to the folder of `target`.

    Parameters
    ----------
    target
        File or folder that is moved last. See `move_into_place`.
    remove
        Further files and folders of an earlier result to remove.
    """
    folder = target.absolute().parent
    with staging(folder, target.parent, target.name) as staged:
        yield staged
        move_into_place(staged, folder, last=target.name, remove=remove)


def move_into_place(
    staged: Path,
    target: Path | Storage,
    *,
    last: str,
    remove: Iterable[str] = (),
    outdated: Iterable[str] = (),
    merge: bool = False,
    on_written: Callable[[], object] = lambda: None,
) -> None:
    """Move all files and folders in a staging folder to the folder or storage of the result.

    All files are flushed to the disk or uploaded first. If the process is then killed at any time,
    the target contains the earlier result, the new result, or a result whose file `last` is
    missing.

    Parameters
    ----------
    staged
        Folder with the files, which the caller removes afterward. If the target is a folder, it is
        in the same file system.
    target
        Folder or storage of the result, which the caller has locked. Files and folders with the
        same names are replaced.
    last
        File or folder that marks a complete result. It is removed before, and moved after, all
        others. Pages are moved shortly before.
    remove
        Further files and folders of an earlier result to remove.
    outdated
        Further files that mark a complete result, and are removed before it changes.
    merge
        Whether to keep the other files of folders with the same names. Folders that have become
        empty are removed.
    on_written
        Function that is called when all files are in place, before a pending interrupt is raised.
    """
    storage = Storage.at(target)
    paths = filter(Path.is_file, staged.rglob("*")) if merge else staged.iterdir()
    names = sorted(
        {path.relative_to(staged).as_posix() for path in paths} - {last},
        key=lambda name: (name.endswith(".html"), name),
    )
    existing = storage.entries()
    # A file is replaced in one operation, in contrast to a folder.
    folders = [
        name for name in (last, *names) if (staged / name).is_dir() or existing.get(name, 0) is None
    ]
    obsolete = dict.fromkeys(name for name in (*remove, *folders) if name != last)

    def discard(name: str) -> None:
        if existing.get(name, 0) is None:
            _discard_folder(storage, name, staged)
        else:
            storage.discard(name)

    with _prepared(staged, storage, last) as move, defer_interrupts():
        for name in outdated:
            storage.discard(name)
        _flush(storage)
        if names or obsolete or last in folders:
            discard(last)
            _flush(storage)  # a crash must not leave an earlier `last` beside other changes
        for name in obsolete:
            discard(name)
        if merge:
            storage.prune(obsolete)
        for name in names:
            move(name)
        for parent in {parent for name in names for parent in Path(name).parents}:
            _flush(storage, parent)
        move(last)
        _flush(storage)  # makes the moves durable before anything else is removed
        on_written()


def _discard_folder(storage: Storage, name: str, staged: Path) -> None:
    """Remove a folder, so that no part of it remains that looks complete after a kill."""
    if storage.is_local:
        # The caller removes the staging folder.
        (storage.local() / name).rename(staged / f"{WRITING}{secrets.token_hex(4)}")
    else:
        storage.remove(sorted(storage.tree(name))[:1])
        storage.discard(name)


@contextmanager
def _prepared(staged: Path, storage: Storage, last: str) -> Iterator[Callable[[str], object]]:
    """Flush or upload staged files, and yield a function that moves a file or folder into place.

    Object stores cannot rename files, so uploaded files are copied within the storage. What killed
    processes have uploaded for the same result is removed.
    """
    if storage.is_local:
        for path in staged.rglob("*"):
            flush(path)

        def move(name: str) -> None:
            storage.prepare(Path(name).parent)
            (staged / name).replace(storage.local() / name)

        yield move
        return
    uploaded = f"{WRITING}{last}-{secrets.token_hex(4)}"

    def copy(name: str) -> None:
        files = [*(staged / name).rglob("*")] if (staged / name).is_dir() else [staged / name]
        # A folder whose first file is missing is visibly incomplete.
        for file in sorted(filter(Path.is_file, files), reverse=True):
            place = file.relative_to(staged).as_posix()
            storage.copy_from(storage, f"{uploaded}/{place}", place)

    storage.remove_unfinished(last)
    try:
        storage.put(staged, uploaded)
        yield copy
    finally:
        with suppress(OSError):
            storage.discard(uploaded)


def _flush(storage: Storage, folder: str | Path = "") -> None:
    if storage.is_local:
        flush(storage.local(folder))

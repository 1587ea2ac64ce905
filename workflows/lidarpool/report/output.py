"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..base.errors import LidarpoolError
from ..base.interrupts import deferred_interrupts
from ..export.ply import save_cloud
from ..plan import Planning
from ..run.picture_file import PICTURE_FILE, PICTURES, Pictured
from ..run.result import Result
from ..scene.scene import Scene
from ..sensor import Survey
from .cloud_numbers import CountedCloud
from .page import Recipe, write_page
from .pictures import picture_makers
from .report import make_report

if sys.platform != "win32":
    import fcntl

ROOM_BYTES = 32 << 20  # what pictures and report may take; the cloud is checked when it is known

CLOUD, PAGE, REPORT = "cloud.ply", "report.html", "report.json"
_IMAGES = tuple(f"{name}.png" for name in PICTURES)
FILES = (CLOUD, *_IMAGES, PICTURE_FILE, PAGE, REPORT)

# Folders within the output folder: a result being made, and one that is whole and on its way
# into place. A run that was killed leaves one behind; the next run removes or finishes it.
_WRITING, _COMPLETE = ".writing-", ".complete-"


@contextmanager
def result_folder(folder: Path) -> Iterator[None]:
    """Claim a folder for a result: made if it is not there, writable, ours alone.

    If the body ends without a result, folders that were made for it are removed again.

    Raises
    ------
    LidarpoolError
        If it is a file, cannot be made or written to, another run uses it, or its disk is
        nearly full.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]  # innermost first
    try:
        lock = _claim(folder)
    except BaseException as error:
        if not isinstance(error.__cause__, BlockingIOError):  # else another run has made them, too
            _remove_empty(made)
        raise
    try:
        _clear_up(folder)
        _check_room(folder)
        yield
    finally:
        if sys.platform == "win32":  # removes no folder with an open file
            os.close(lock)
            _remove_empty(made)
        else:  # as long as no other run can have begun to use them
            _remove_empty(made)
            os.close(lock)


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, innermost first, up to one that holds something."""
    for path in folders:
        if path.exists():
            if any(path.iterdir()):
                break
            path.rmdir()


def write_result(
    folder: Path,
    result: Result,
    scene: Scene,
    survey: Survey,
    planning: Planning | None,
    recipe: Recipe | None = None,
    then: Callable[[], object] = lambda: None,
    only_cloud: bool = False,
) -> dict[str, Any]:
    """Write cloud, pictures and report, and return the report.

    They are made in a temporary folder within `folder` and moved into place together once
    all are there and on the disk, so that an earlier result stays whole if one cannot be
    written. A picture that an earlier run made and this one does not is removed. `then` is
    called when all are in place, before an interrupt that came meanwhile is let through.
    `only_cloud` leaves pictures and page out.

    Raises
    ------
    LidarpoolError
        If a file cannot be written.
    """
    staged = folder / f"{_WRITING}{secrets.token_hex(4)}"
    counted = CountedCloud(result.points, survey, scene.origin, len(scene.names))
    pictures = {} if only_cloud else _pictures(staged, result, scene, survey, planning)
    files = [CLOUD, *pictures, *([] if only_cloud else [PAGE]), REPORT]
    report: dict[str, Any] = {}

    def write_cloud(path: Path) -> None:
        save_cloud(path, counted, precision_m=survey.precision_m)
        numbers = counted.numbers()
        report.update(make_report(result, scene, survey, planning, files, numbers))

    def write_report(path: Path) -> None:
        text = json.dumps(report, indent=1, allow_nan=False) + "\n"
        path.write_text(text, encoding="utf-8")

    makers: dict[str, Callable[[Path], object]] = {CLOUD: write_cloud, **pictures}
    if not only_cloud:
        makers[PAGE] = lambda path: write_page(
            path, report, result, counted.numbers(), planning, recipe
        )
    makers[REPORT] = write_report
    try:
        try:
            staged.mkdir()
            for name, make in makers.items():
                make(staged / name)
                _flush(staged / name)
            _flush(staged)
            with deferred_interrupts():
                whole = staged.rename(folder / f"{_COMPLETE}{secrets.token_hex(4)}")
                _publish(whole, folder)
                then()
        finally:
            shutil.rmtree(staged, ignore_errors=True)  # it is gone already if all went well
    except LidarpoolError as error:  # names the file; its temporary folder is nobody's business
        raise LidarpoolError(str(error).replace(str(staged), str(folder))) from error
    except OSError as error:
        raise LidarpoolError(
            f"The result cannot be written to {folder} ({error.strerror or error}): make room or "
            "give another folder with --out."
        ) from error
    return report


def _pictures(
    folder: Path, result: Result, scene: Scene, survey: Survey, planning: Planning | None
) -> dict[str, Callable[[Path], object]]:
    """Functions that write each picture, and what they are drawn from, into a folder."""
    shown = Pictured.of(result, scene, survey, planning)
    # The cloud is drawn from its file, as by `lidarpool plot`, so that both draw the same.
    makers = picture_makers(shown, folder / CLOUD)
    return {
        **{f"{name}.png": draw for name, draw in makers.items()},
        PICTURE_FILE: shown.save,
    }


def _publish(whole: Path, folder: Path) -> None:
    """Move a whole result into place; called again after a crash, it does the rest.

    A folder with a report is a result: the earlier one's goes first, and the new one comes
    last. As long as that is in `whole`, it says what belongs to the result.
    """
    files = json.loads((whole / REPORT).read_text(encoding="utf-8"))["files"]
    for name in (REPORT, PAGE):
        if (whole / name).exists():
            (folder / name).unlink(missing_ok=True)
    _flush(folder)
    for name in FILES:
        if name not in files:  # a path of an earlier run would pass for this one's, too
            (folder / name).unlink(missing_ok=True)
        elif (whole / name).exists():
            (whole / name).replace(folder / name)
    whole.rmdir()
    _flush(folder)


def _claim(folder: Path) -> int:
    """Make a folder if need be and lock it; returns the handle that holds the lock."""
    if folder.exists() and not folder.is_dir():
        raise LidarpoolError(f"{folder} is a file: give a folder for the results with --out.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            return _lock(folder, file.fileno())
    except BlockingIOError as error:
        raise LidarpoolError(
            f"Another run is using the folder {folder}: wait for it, or give another with --out."
        ) from error
    except OSError as error:
        raise LidarpoolError(
            f"Cannot write to the folder {folder} ({error.strerror}): give another with --out."
        ) from error


def _lock(folder: Path, spare: int) -> int:
    """Lock a folder until the handle that is returned is closed, or this process ends."""
    if sys.platform == "win32":  # has no locks on folders
        return os.dup(spare)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not (folder.exists() and os.path.samestat(os.fstat(handle), folder.stat())):
            raise BlockingIOError(errno.EAGAIN, "removed by the run that had made it")
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network disk without locks
            os.close(handle)
            raise
    return handle


def folder_in_the_way(folder: Path) -> str:
    """Say which folder has the name of a file of a result, and what to do; empty if none has."""
    taken = next((folder / name for name in FILES if (folder / name).is_dir()), None)
    if taken is None:
        return ""
    return (
        f"{taken} is a folder, and a result has a file of that name: give another folder with "
        "--out."
    )


def _clear_up(folder: Path) -> None:
    """Finish or remove what a killed run left, and refuse folders where files are to go."""
    if obstacle := folder_in_the_way(folder):
        raise LidarpoolError(obstacle)
    try:
        for whole in folder.glob(f"{_COMPLETE}*"):
            if (whole / REPORT).exists():
                _publish(whole, folder)
            else:
                whole.rmdir()
        for staged in folder.glob(f"{_WRITING}*"):
            shutil.rmtree(staged)
    except OSError as error:
        raise LidarpoolError(
            f"{folder} holds what a killed run left, and it cannot be cleared up ({error}): "
            f"remove its {_WRITING}* and {_COMPLETE}*, or give another folder with --out."
        ) from error


def _check_room(folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if free < ROOM_BYTES:
        raise LidarpoolError(
            f"The disk of {folder} has {free / 1e6:.1f} MB free and a result needs at least "
            f"{ROOM_BYTES / 1e6:.0f} MB: make room, or give another folder with --out."
        )


def _flush(path: Path) -> None:
    """Wait until the file or folder is on the disk."""
    if sys.platform == "win32" and path.is_dir():
        return  # Windows has no handle of a folder to flush
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

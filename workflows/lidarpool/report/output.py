"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import LidarpoolError
from ..base.interrupts import deferred_interrupts
from ..base.vocabulary import FORMATS, PICTURES
from ..columns.storage import Storage, flush
from ..export.folder import LAST_FILE, staging
from ..export.formats import Format, remove
from ..export.sweeps import SWEEPS_FILE, Sweeps
from ..run.picture_file import PICTURE_FILE, Pictured
from ..run.ranges import LidarWorkers
from ..run.result import RunResult
from ..scenario.scenario import Scenario
from .cloud_numbers import CountedCloud
from .report import make_report

if TYPE_CHECKING:
    from ..render.page import Page

ROOM_BYTES = 32 << 20  # room for pictures and report

CLOUD, PAGE, REPORT = "cloud.ply", "report.html", LAST_FILE
_OF_CLOUD = ("intensity", "cloud")  # are drawn from the cloud's file
_IMAGES = tuple(f"{name}.png" for name in PICTURES)
FILES = (CLOUD, *_IMAGES, PICTURE_FILE, SWEEPS_FILE, PAGE, REPORT)
_SURVEY = ("scene", "survey")  # what tells one from another
EXPORTS = tuple(file for file, _ in FORMATS.values())


def refuse_to_replace(
    place: Path | Storage,
    identity: Callable[[], Mapping[str, str]],
    formats: Sequence[Format] = (),
) -> None:
    """Refuse a folder that holds the result of another survey, or files of no result.

    Parameters
    ----------
    place
        Place for the new result.
    identity
        Returns that of this result, see `RunResult.identity`; large scenes take a moment.
    formats
        That the cloud will be exported to.

    Raises
    ------
    LidarpoolError
        If there is a result of another scene or survey, or one that cannot be read; or a file that
        this result would replace and that no report there lists.
    """
    storage = place if isinstance(place, Storage) else Storage.at(place)
    advice = "give another folder with --out, or replace it with --overwrite (in Python "
    advice += "overwrite=True)."
    try:
        there = set(storage.entries())
    except NotADirectoryError:
        return
    except OSError as error:
        raise LidarpoolError(f"{place} cannot be read: {error.strerror or error}.") from error
    if REPORT in there:
        try:
            report = json.loads(storage.read(REPORT))
            earlier = {name: report["identity"][name] for name in _SURVEY}
        except (OSError, ValueError, TypeError, LookupError):
            earlier = {}
        here = identity()
        if earlier != {name: here[name] for name in _SURVEY}:
            raise LidarpoolError(f"{place} holds the result of another survey: {advice}")
    listed = _listed(storage)
    names = (*FILES, *(one.file for one in formats))
    if foreign := [name for name in names if name in there and name not in listed]:
        raise LidarpoolError(f"{place} holds {foreign[0]}, which no result there lists: {advice}")


def _listed(storage: Storage) -> frozenset[str]:
    """Names of the files of the result in a folder: only these may be removed there."""
    try:
        return frozenset(json.loads(storage.read(REPORT))["files"])
    except (OSError, ValueError, TypeError, LookupError):
        return frozenset()


def write_result(
    folder: Path,
    place: Path | Storage,
    result: RunResult,
    scenario: Scenario | None = None,
    then: Callable[[], object] = lambda: None,
    only_cloud: bool = False,
    formats: Sequence[Format] = (),
    workers: LidarWorkers | None = None,
) -> dict[str, Any]:
    """Write cloud, pictures and report, and return the report.

    They are made in a temporary folder within `folder` and moved into place once all are on the
    disk, so that an earlier result stays whole if one cannot be written. Pictures of an earlier
    result that this one does not make are removed. `then` is called when all are in place, before
    a pending interrupt is raised. `only_cloud` leaves out pictures and page; `formats` are
    written as well, those of many files by `workers`, if there are any.

    Where `place` is a storage, all is put into it, report.json last; `folder` is a temporary one
    then. Files of workers go there directly, and an earlier result is removed before.

    Raises
    ------
    LidarpoolError
        If a file cannot be written.
    """
    staged = staging(folder)
    scene, survey = result.scene, result.survey
    counted = CountedCloud(result.points, len(scene.all_names))
    makers: dict[str, Callable[[], Page]] = {}
    drawn: dict[str, Future[str]] = {}
    # Pictures are drawn while the cloud is written, which keeps one core busy.
    beside = ThreadPoolExecutor(1, "pictures")
    if not only_cloud:
        # Importing Matplotlib takes as long as all other imports.
        from .page.page import write_page
        from .pictures import picture_makers

        shown = Pictured.of(result)
        # The cloud is drawn from its file, as by `lidarpool plot`, so that both draw the same.
        makers = picture_makers(shown, staged / CLOUD)
    exported = [one.file for one in formats]
    pictures = [] if only_cloud else [*(f"{name}.png" for name in makers), PICTURE_FILE]
    files = [CLOUD, *exported, *pictures, SWEEPS_FILE, *([] if only_cloud else [PAGE]), REPORT]
    storage = place if isinstance(place, Storage) else None
    earlier = _listed(storage or Storage.at(folder))
    direct = [one for one in formats if one.in_pieces] if storage and workers else []

    def draw(name: str) -> str:
        page = makers[name]()
        page.save(staged / f"{name}.png")
        return page.svg()

    try:
        staged.mkdir()
        drawn |= {name: beside.submit(draw, name) for name in makers if name not in _OF_CLOUD}
        sweeps = Sweeps.of(survey, scene)
        sweeps.save(staged / SWEEPS_FILE)
        Format("ply").write(staged / CLOUD, counted, sweeps)
        for one in formats:
            if one not in direct:
                one.write(staged / one.file, result.points, sweeps, workers=workers)
        if storage and direct:
            _remove_earlier(storage, earlier, files)
            for one in direct:
                one.put(storage, result.points, sweeps, workers)
        if workers:
            result = workers.recorded(result)
        report = make_report(result, files, counted)
        report["notes"] += [note for one in formats for note in one.notes(result.points)]
        if not only_cloud:
            drawn |= {name: beside.submit(draw, name) for name in _OF_CLOUD}
            shown.save(staged / PICTURE_FILE)
            images = {name: drawn[name].result() for name in makers}
            write_page(staged / PAGE, report, result, counted, images, scenario)
        text = json.dumps(report, indent=1, allow_nan=False) + "\n"
        (staged / REPORT).write_text(text, encoding="utf-8")
        if storage:
            if not direct:
                _remove_earlier(storage, earlier, files)
            for name in (*EXPORTS, *FILES):
                if (staged / name).exists():
                    storage.put(staged / name, name)
            with deferred_interrupts():
                then()
            return report
        for name in files:
            flush(staged / name)
        with deferred_interrupts():
            _publish(staged, folder, earlier, files)
            then()
    except LidarpoolError as error:  # names the file, without its temporary folder
        raise LidarpoolError(str(error).replace(str(staged), str(place))) from error
    except OSError as error:
        raise LidarpoolError(
            f"The result cannot be written to {place} ({error.strerror or error}): make room or "
            "give another folder with --out."
        ) from error
    finally:
        beside.shutdown(cancel_futures=True)
        shutil.rmtree(staged, ignore_errors=True)
    return report


def _publish(staged: Path, folder: Path, earlier: Collection[str], files: Collection[str]) -> None:
    """Move a whole result into place.

    A folder with a report is a result: the earlier report is removed first, and the new one is
    moved last. If the process is killed in between, --resume continues from the run's folder.
    """
    for name in (REPORT, PAGE):
        (folder / name).unlink(missing_ok=True)
    flush(folder)
    for name in (*EXPORTS, *FILES):
        # A path of an earlier run would look like this one's; and folders are not replaced.
        if _goes(name, earlier, files):
            remove(folder / name)
        if name in files:
            (staged / name).replace(folder / name)
    flush(folder)


def _remove_earlier(storage: Storage, earlier: Collection[str], files: Collection[str]) -> None:
    """Remove what an earlier result has in a storage and this one would not replace."""
    for name in (REPORT, PAGE, *EXPORTS, *FILES):
        if name in (REPORT, PAGE) or _goes(name, earlier, files):
            storage.discard(name)


def _goes(name: str, earlier: Collection[str], files: Collection[str]) -> bool:
    """Whether a file of a folder is removed before a result of these files is moved there.

    Folders and files of formats only if they are replaced, or the earlier result lists them. If a
    killed run has removed the earlier report, they stay.
    """
    if name in EXPORTS:
        return name in files or name in earlier
    return name not in files

"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from ..base.errors import LidarpoolError, explained
from ..base.interrupts import deferred_interrupts
from ..base.open3d_module import load_open3d
from ..base.storage import Storage, flush
from ..base.vocabulary import PICTURES
from ..export.folder import LAST_FILE, result_folder, staging
from ..export.format_table import EXPORTS, FORMATS
from ..export.formats import Format, refuse_strangers
from ..export.navigation_files import FILES as INSTRUMENT_FILES
from ..export.navigation_files import Instruments, write_instruments
from ..export.sweeps import SWEEPS_FILE, Sweeps
from ..run.conductor import Conductor, Output
from ..run.picture_file import PICTURE_FILE, PictureContent
from ..run.run_result import RunResult
from ..run.writer import LidarWorkers
from ..scenario.scenario import Scenario
from ..sensor import Survey
from .report import CountedCloud, make_report

ROOM_BYTES = 32 << 20  # room for pictures and report

CLOUD, PAGE, REPORT = FORMATS["ply"].file, "report.html", LAST_FILE
_OF_CLOUD = ("hits", "intensity", "cloud")  # are drawn from the cloud's file
FILES = (CLOUD, *(f"{name}.png" for name in PICTURES), PICTURE_FILE, SWEEPS_FILE, PAGE, REPORT)
_SURVEY = ("scene", "survey")  # what tells one from another
# What only some results have.
_FURTHER = (*(FORMATS[name].file for name in EXPORTS), *INSTRUMENT_FILES)


@dataclass(eq=False)
class SurveyOutput(Output[tuple[RunResult, dict[str, Any]]]):
    """The result of a survey in its folder or storage, `place`; gives it with its report.

    `formats` are written beside the cloud, `only_cloud` leaves out pictures and page, and `judge`
    returns a note on the result.
    """

    place: Path | Storage
    survey: Survey
    formats: Sequence[Format]
    only_cloud: bool = False
    scenario: Scenario | None = None
    judge: Callable[[RunResult], str] = lambda result: ""

    def __post_init__(self) -> None:
        self.formats = [one for one in self.formats if one.format != "ply"]

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder while the body runs."""
        for one in self.formats:
            one.check_installed()
        load_open3d()  # what writes the cloud in the end
        with result_folder(self.place) as self._folder:
            yield

    def begin(self, conductor: Conductor[tuple[RunResult, dict[str, Any]]]) -> None:
        """Refuse the result of another survey."""
        if not conductor.goes_on:
            self.refuse(lambda: conductor.jobs.identity, overwrite=conductor.options.overwrite)

    def refuse(self, identity: Callable[[], Mapping[str, str]], *, overwrite: bool = False) -> None:
        """Refuse a place that holds the result of another survey, or files of no result.

        `identity` returns that of this result, see `RunResult.identity`: large scenes take a
        moment. LidarpoolError if there is a result of another scene or survey, or one that cannot
        be read, or a file that this result would replace and that no report there lists, each
        unless `overwrite`; or a folder that would be replaced and holds files of others.
        """
        place, storage = self.place, Storage.at(self.place)
        advice = "give another folder with --out, or replace it with --overwrite (in Python "
        advice += "overwrite=True)."
        with explained(f"{place} cannot be read"):
            try:
                there = set(storage.entries())
            except NotADirectoryError:
                return
        earlier, listed = _earlier(storage)
        if REPORT in there and not overwrite:
            here = identity()
            if earlier != {name: here[name] for name in _SURVEY}:
                raise LidarpoolError(f"{place} holds the result of another survey: {advice}")
        further = _further_files(self.survey, self.formats)
        foreign = [name for name in (*FILES, *further) if name in there and name not in listed]
        if foreign and not overwrite:
            lists = f"{place} holds {foreign[0]}, which no result there lists"
            raise LidarpoolError(f"{lists}: {advice}")
        refuse_strangers(storage, {*further, *listed})

    def finish(
        self, conductor: Conductor[tuple[RunResult, dict[str, Any]]]
    ) -> tuple[RunResult, dict[str, Any]]:
        """Write the result, and remove the run."""
        result = conductor.result()
        in_pieces = any(one.row.in_pieces for one in self.formats)
        workers = None
        if not in_pieces:
            conductor.cluster_stack.close()
        elif conductor.cluster is not None:
            workers = LidarWorkers(conductor.cluster)
        conductor.page.finish(result.seconds, result)
        if note := self.judge(result):
            result = replace(result, notes=(*result.notes, note))

        def in_place() -> None:
            conductor.result_is_in(self.place)
            conductor.store.remove()

        what = "the cloud" if self.only_cloud else "the cloud, the pictures and the report"
        with conductor.screen.status(f"writing {what}"):
            return result, self.write(result, in_place, workers)

    def write(
        self,
        result: RunResult,
        then: Callable[[], object] = lambda: None,
        workers: LidarWorkers | None = None,
    ) -> dict[str, Any]:
        """Write cloud, pictures and report into the held place, and return the report.

        They are made in a temporary folder within the folder and moved into place once all are on
        the disk, so that an earlier result stays whole if one cannot be written. Pictures of an
        earlier result that this one does not make are removed. `then` is called when all are in
        place, before a pending interrupt is raised. `workers` write formats of many files.

        Where `place` is a storage, all is put into it, report.json last. Files of workers go there
        directly, and an earlier result is removed before.

        LidarpoolError if a file cannot be written.
        """
        place, folder, formats = self.place, self._folder, self.formats
        storage = place if isinstance(place, Storage) else None
        target = Storage.at(storage or folder)
        _, earlier = _earlier(target)
        points, sweeps = result.points, Sweeps.of(result.survey, result.scene)
        cloud = CountedCloud(points, len(result.scene.all_names))
        advice = "make room or give another folder with --out"
        with (
            explained(f"The result cannot be written to {place}", advice),
            staging(folder, place) as staged,
            nullcontext() if self.only_cloud else _Pictures(result, staged) as pictures,
        ):
            drawn, page = (pictures.files, [PAGE]) if pictures else ([], [])
            further = _further_files(result.survey, formats)
            files = [CLOUD, *further, *drawn, SWEEPS_FILE, *page, REPORT]
            refuse_strangers(target, {*further, *earlier})

            clear = cache(partial(_clear, target, files, earlier))  # once
            sweeps.save(staged / SWEEPS_FILE)
            if (instruments := sweeps.instruments) is not None:
                write_instruments(staged, result.survey, result.scene.origin)
                sweeps = replace(sweeps, instruments=replace(instruments, folder=staged))
            Format("ply").write(staged / CLOUD, cloud, sweeps)
            for one in sorted(formats, key=lambda one: one.row.in_pieces):
                if storage and workers and one.row.in_pieces:
                    clear()
                    one.put(storage, points, sweeps, workers)
                else:
                    one.write(
                        staged / one.row.file, points, sweeps, workers=None if storage else workers
                    )
            if workers:
                result = workers.recorded(result)
            report = make_report(result, files, cloud)
            report["notes"] += [note for one in formats for note in one.notes(points, sweeps)]
            if pictures:
                from .page.rendering import write_page  # as slow to import as the pictures

                images = pictures.finish()
                write_page(staged / PAGE, report, result, cloud, images, self.scenario)
            text = json.dumps(report, indent=1, allow_nan=False) + "\n"
            (staged / REPORT).write_text(text, encoding="utf-8")
            if storage is None:
                _move(staged, folder, files, earlier, then)
            else:
                clear()
                for name in (*_FURTHER, *FILES):
                    if (staged / name).exists():
                        storage.put(staged / name, name)
                with deferred_interrupts():
                    then()
        return report


def _further_files(survey: Survey, formats: Sequence[Format]) -> list[str]:
    """Name the files that a result has besides those that all have."""
    instruments = Instruments.of(survey)
    measured = [] if instruments is None else instruments.files
    return [*(one.row.file for one in formats), *measured]


def _earlier(storage: Storage) -> tuple[dict[str, str], frozenset[str]]:
    """Identity of the result in a folder, and its files, which alone may be removed there.

    Both are empty if there is no result, or none that can be read.
    """
    try:
        report = json.loads(storage.read(REPORT))
        identity = {name: report["identity"][name] for name in _SURVEY}
        return identity, frozenset(report["files"])
    except (OSError, ValueError, TypeError, LookupError):
        return {}, frozenset()


def _move(
    staged: Path,
    folder: Path,
    files: Collection[str],
    earlier: Collection[str],
    then: Callable[[], object],
) -> None:
    """Move a whole result into place, its report last.

    If the process is killed in between, --resume continues from the run's folder.
    """
    for name in files:
        flush(staged / name)
    with deferred_interrupts():
        _clear(Storage.at(folder), files, earlier)
        for name in (*_FURTHER, *FILES):
            if name in files:
                (staged / name).replace(folder / name)
        flush(folder)
        then()


def _clear(target: Storage, files: Collection[str], earlier: Collection[str]) -> None:
    """Remove what is in the place of a result of `files`, its report first: that tells a result.

    Folders and files of formats only if they are replaced, or the earlier result lists them. If a
    killed run has removed the earlier report, they stay.
    """
    further = [name for name in _FURTHER if name in files or name in earlier]
    # A path of an earlier run would look like this one's.
    for name in (REPORT, PAGE, *further, *(name for name in FILES if name not in files)):
        target.discard(name)
        if name == PAGE and target.is_local:
            flush(target.local())


class _Pictures(AbstractContextManager["_Pictures"]):
    """Pictures of a result, drawn in a thread while the cloud is written.

    They are drawn from the file of the cloud, as by `lidarpool plot`, so that both draw the same.
    """

    def __init__(self, result: RunResult, staged: Path) -> None:
        from .result_pictures import picture_makers  # Matplotlib takes as long as all other imports

        self._staged, self._thread = staged, ThreadPoolExecutor(1, "pictures")
        self._pictured = PictureContent.of(result)
        columns = [column.name for column in result.survey.stored_columns]
        self._makers = picture_makers(self._pictured, staged / CLOUD, columns)
        self.files = [*(f"{name}.png" for name in self._makers), PICTURE_FILE]
        self._drawn: dict[str, Future[str]] = {}
        self._begin(name for name in self._makers if name not in _OF_CLOUD)

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def _begin(self, names: Iterable[str]) -> None:
        self._drawn |= {name: self._thread.submit(self._draw, name) for name in names}

    def _draw(self, name: str) -> str:
        page = self._makers[name]()
        page.save(self._staged / f"{name}.png")
        return page.svg()

    def finish(self) -> dict[str, str]:
        """Draw those of the cloud, whose file is there by now; returns all as SVG, by name."""
        self._begin(name for name in _OF_CLOUD if name in self._makers)
        self._pictured.save(self._staged / PICTURE_FILE)
        return {name: self._drawn[name].result() for name in self._makers}

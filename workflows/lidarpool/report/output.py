"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.interrupts import deferred_interrupts
from lidarsim.base.storage import Storage, flush
from lidarsim.base.vocabulary import PICTURES
from lidarsim.base.writing_progress import WritingProgress
from lidarsim.sensor import Survey
from lidarsim.sweeps.instruments import INSTRUMENT_FILES, Instruments
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarview.picture_file import PICTURE_FILE

from ..base import timeline
from ..base.open3d_module import load_open3d
from ..columns.parts import StoredCloud
from ..export.folder import LAST_FILE, result_folder, staging
from ..export.format_table import FORMATS, FormatRow, plugin_rows
from ..export.formats import Format, refuse_strangers
from ..export.navigation_files import write_instruments
from ..run.run_result import RunResult
from ..run.runner import Output, Run
from ..run.writer import LidarWorkers
from ..scenario.scenario import Scenario
from .picture_content import picture_content
from .report import CountedCloud, make_report

CLOUD = FORMATS["ply"].file
PAGE = "report.html"
REPORT = LAST_FILE
_DRAWN = tuple(f"{name}.png" for name in PICTURES)
FILES = (CLOUD, *_DRAWN, PICTURE_FILE, SWEEPS_FILE, PAGE, REPORT)
_SURVEY = ("scene", "survey")  # what tells one from another
_OF_FORMATS = {row.file: row for row in FORMATS.values() if row.file != CLOUD}


@dataclass(eq=False)
class SurveyOutput(Output[tuple[RunResult, dict[str, Any]]]):
    """The result of a survey in its folder or storage, `place`; gives it with its report.

    `formats` are written beside the cloud. `extent` is how much: the "cloud", the "page", too, with
    what pictures are drawn from, or "pictures", too. `judge` returns a note on the result.
    """

    place: Path | Storage
    survey: Survey
    formats: Sequence[Format]
    extent: str = "page"
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

    def begin(self, run: Run[tuple[RunResult, dict[str, Any]]]) -> None:
        """Refuse the result of another survey."""
        if not run.continues_run:
            self.refuse(lambda: run.jobs.identity, overwrite=run.options.overwrite)

    def refuse(self, identity: Callable[[], Mapping[str, str]], *, overwrite: bool = False) -> None:
        """Refuse a place that holds the result of another survey, or files of no result.

        `identity` returns that of this result, see `RunResult.identity`: large scenes take a
        moment. LidarError if there is a result of another scene or survey, or one that cannot
        be read, or a file that this result would replace and that no report there lists, each
        unless `overwrite`; or a folder that would be replaced and holds files of others.
        """
        place = self.place
        storage = Storage.at(self.place)
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
                raise LidarError(f"{place} holds the result of another survey: {advice}")
        further = _further_files(self.survey, self.formats)
        foreign = [name for name in (*FILES, *further) if name in there and name not in listed]
        if foreign and not overwrite:
            lists = f"{place} holds {foreign[0]}, which no result there lists"
            raise LidarError(f"{lists}: {advice}")
        refuse_strangers(storage, _rows({*further, *listed}))

    def finish(
        self, run: Run[tuple[RunResult, dict[str, Any]]]
    ) -> tuple[RunResult, dict[str, Any]]:
        """Write the result, and remove the run."""
        result = run.result()
        in_pieces = any(one.row.in_pieces for one in self.formats)
        workers = None
        if not in_pieces:
            run.cluster_stack.close()
            timeline.mark(timeline.STOPPED)
        elif run.cluster is not None:
            workers = LidarWorkers(run.cluster)
        run.page.finish(result.seconds, result)
        if note := self.judge(result):
            result = replace(result, notes=(*result.notes, note))

        def in_place() -> None:
            run.result_is_in(self.place)
            run.store.remove()

        more = {"cloud": "", "page": " and the report", "pictures": ", the report and the pictures"}
        with run.screen.writing(f"writing the cloud{more[self.extent]}") as show:
            return result, self.write(result, in_place, workers, show)

    def write(
        self,
        result: RunResult,
        then: Callable[[], object] = lambda: None,
        workers: LidarWorkers | None = None,
        show: WritingProgress = lambda *_: None,
    ) -> dict[str, Any]:
        """Write cloud, pictures and report into the held place, and return the report.

        They are made in a temporary folder within the folder and moved into place once all are on
        the disk, so that an earlier result stays whole if one cannot be written. Pictures of an
        earlier result that this one does not make are removed. `then` is called when all are in
        place, before a pending interrupt is raised. `workers` write formats of many files, and
        `show` is told what is being written, and how far it is.

        Where `place` is a storage, all is put into it, report.json last. Files of workers go there
        directly, and an earlier result is removed before.

        LidarError if a file cannot be written.
        """
        place = self.place
        folder = self._folder
        formats = self.formats
        storage = place if isinstance(place, Storage) else None
        target = Storage.at(storage or folder)
        _, earlier = _earlier(target)
        further = _further_files(result.survey, formats)
        sweeps = Sweeps.from_survey(result.survey, result.scene)

        def points(file: str) -> StoredCloud:
            """Return the points, which tell how far a file is while they are read."""
            count = len(result.points)
            done = 0

            def tell(more: int) -> None:
                nonlocal done
                done = min(done + more, count)  # some may be read twice
                show(file, done, count, "points")

            tell(0)
            return replace(result.points, tell=tell)

        advice = "make room or give another folder with --out"
        with (
            explained(f"The result cannot be written to {place}", advice),
            staging(folder, place) as staged,
        ):
            refuse_strangers(target, _rows({*further, *earlier}))
            clear = cache(partial(_clear, target, further, earlier))  # once
            sweeps.save(staged / SWEEPS_FILE)
            if (instruments := sweeps.instruments) is not None:
                write_instruments(staged, result.survey, result.scene.origin)
                sweeps = replace(sweeps, instruments=replace(instruments, folder=staged))
            scene = result.scene
            sizes = len(scene.all_names), len(scene.material_names)
            cloud = CountedCloud(points(CLOUD), *sizes)
            Format("ply").write(staged / CLOUD, cloud, sweeps)
            timeline.mark(timeline.CLOUD_WRITTEN)
            for one in sorted(formats, key=lambda one: one.row.in_pieces):
                file = one.row.file
                if storage and workers and one.row.in_pieces:
                    clear()
                    one.write_to_storage(storage, points(file), sweeps, workers)
                else:
                    there = None if storage else workers
                    one.write(staged / file, points(file), sweeps, workers=there)
            if workers:
                result = workers.recorded(result)
            report = make_report(result, cloud)
            report["notes"] += [n for one in formats for n in one.notes(result.points, sweeps)]
            if self.extent != "cloud":
                self._report(result, report, cloud, staged, show)
            made = [name for name in FILES[1:] if name == REPORT or (staged / name).exists()]
            report["files"] = [CLOUD, *further, *made]
            text = json.dumps(report, indent=1, allow_nan=False) + "\n"
            (staged / REPORT).write_text(text, encoding="utf-8")
            timeline.mark(timeline.REPORT_WRITTEN)
            if storage is None:
                _move(staged, folder, report["files"], earlier, then)
            else:
                clear()
                for name in (*_known_further(further), *FILES):
                    if (staged / name).exists():
                        storage.put(staged / name, name)
                with deferred_interrupts():
                    then()
        timeline.mark(timeline.IN_PLACE)
        return report

    def _report(
        self, result: RunResult, report: dict[str, Any], cloud: CountedCloud, staged: Path,
        show: WritingProgress,
    ) -> None:  # fmt: skip
        """Write the page, what pictures are drawn of, and the pictures if they are wanted."""
        from .page.rendering import write_page  # jinja2

        shown = picture_content(result)
        shown.save(staged / PICTURE_FILE)
        write_page(staged / PAGE, report, result, cloud, self.scenario)
        if self.extent == "pictures":
            from .result_pictures import draw_pictures  # Matplotlib, and seconds for each picture

            list(draw_pictures(shown, staged, staged, show=show))


def _further_files(survey: Survey, formats: Sequence[Format]) -> list[str]:
    """Name the files that a result has besides those that all have."""
    instruments = Instruments.from_survey(survey)
    measured = [] if instruments is None else instruments.files
    return [*(one.row.file for one in formats), *measured]


def _rows(names: Collection[str]) -> list[FormatRow]:
    """Return the rows of the formats whose file or folder is among some names of a result."""
    unknown = {*names} - {*FILES, *INSTRUMENT_FILES, *_OF_FORMATS}
    return [row for file, row in _OF_FORMATS.items() if file in names] + plugin_rows(unknown)


def _known_further(names: Collection[str]) -> list[str]:
    """Return those names that are files or folders of formats or instruments, in order."""
    measured = [name for name in INSTRUMENT_FILES if name in names]
    return [row.file for row in _rows(names)] + measured


def _earlier(storage: Storage) -> tuple[dict[str, str], frozenset[str]]:
    """Identity of the result in a folder, and its files, which alone may be removed there.

    Both are empty if there is no result, or none that can be read.
    """
    try:
        report = json.loads(storage.read(REPORT))
        identity = {name: report["identity"][name] for name in _SURVEY}
        files = frozenset(report["files"])
        return identity, files | {*_DRAWN} if PICTURE_FILE in files else files  # drawn since then
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
        for name in (*_known_further(files), *FILES):
            if name in files:
                (staged / name).replace(folder / name)
        flush(folder)
        then()


def _clear(target: Storage, files: Collection[str], earlier: Collection[str]) -> None:
    """Remove what is in the place of a result of `files`, its report first: that tells a result.

    Folders and files of formats only if they are replaced, or the earlier result lists them. If a
    killed run has removed the earlier report, they stay.
    """
    further = _known_further({*files, *earlier})
    # A path of an earlier run would look like this one's.
    for name in (REPORT, PAGE, *further, *(name for name in FILES if name not in files)):
        target.discard(name)
        if name == PAGE and target.is_local:
            flush(target.local())

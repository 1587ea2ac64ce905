"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from lidarsim.columns.table import optional_columns
from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.errors import LidarError, explained
from lidarsim.io.storage import Storage, flush
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.schema.vocabulary import PICTURES
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.instruments import INSTRUMENT_FILES, Instruments
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarview.picture_file import PICTURE_FILE

from ..clouds.folder import LAST_FILE, result_folder, staging
from ..clouds.format_table import FORMATS, format_row, plugin_formats
from ..clouds.navigation_files import write_instruments
from ..clouds.writing import ExportSpec, check_foreign_files
from ..columns.parts import StoredCloud
from ..identity.field_words import describe_changes
from ..open3d_access.open3d_module import load_open3d
from ..processes import timeline
from ..run.cluster.cluster import Cluster, ClusterConnection
from ..run.job_source import OneJob
from ..run.listener import Listener
from ..run.options import RunOptions
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import RunResult
from ..run.runner import cast, open_store
from ..run.store.run_store import RunStore
from ..run.writer import LidarWorkers
from ..scenario.scenario import Scenario
from .cloud_counts import CloudCounts
from .growing_cloud import GrowingCloud, write_cloud
from .picture_content import picture_content
from .report import make_report

CLOUD = FORMATS["ply"].file
PAGE = "report.html"
REPORT = LAST_FILE
_DRAWN = tuple(f"{name}.png" for name in PICTURES)
FILES = (CLOUD, *_DRAWN, PICTURE_FILE, SWEEPS_FILE, PAGE, REPORT)
_SURVEY = ("scene", "survey")  # entries of the identity that distinguish surveys
_OF_FORMATS = {row.file: name for name, row in FORMATS.items() if row.file != CLOUD}


def run_survey(
    jobs: OneJob,
    options: RunOptions,
    output: SurveyOutput,
    screen: Screen,
    page: RunPage,
    compare: Callable[[RunResult], str] | None = None,
) -> tuple[RunResult, dict[str, Any]]:
    """Cast a survey, write its result, remove the run, and return the result and its report.

    `cloud.ply` grows while the survey is cast. `compare` returns a note on the result, or raises an
    error before the result is written.
    """
    with output.lock() as folder:
        if not options.continues_run:
            output.check_existing(jobs, overwrite=options.overwrite)
        with (
            ClusterConnection(jobs, options, screen) as connection,
            open_store(jobs, options, screen, output.target) as store,
            staging(folder, output.target) as staged,
        ):
            assert store.only_job is not None, "of a survey"
            with GrowingCloud(staged / CLOUD, store.only_job) as cloud:
                load_open3d()  # writes the cloud; a missing library is reported before casting
                committed = cast(
                    store, connection, Listener(page, on_parts=cloud.add, pace=options.pace)
                )
                result = committed.result(screen)
                page.finish(result.seconds, result)
                if compare is not None and (note := compare(result)):
                    result = replace(result, notes=(*result.notes, note))
                if not output.in_pieces:
                    connection.close()
                    timeline.mark(timeline.STOPPED)
                return output.publish(folder, result, store, screen, connection.cluster, cloud)


@dataclass(eq=False)
class SurveyOutput:
    """The result of a survey in a folder or storage.

    `formats` are written beside the cloud. `extent` is "cloud"; "page" for the page and the content
    of pictures, too; or "pictures" for the pictures, too.
    """

    target: Path | Storage
    survey: Survey
    formats: Sequence[ExportSpec]
    extent: str = "page"
    scenario: Scenario | None = None

    def __post_init__(self) -> None:
        self.formats = [
            output_format for output_format in self.formats if output_format.format != "ply"
        ]

    @property
    def in_pieces(self) -> bool:
        """True if a format has many files, which workers can write."""
        return any(output_format.has_many_files for output_format in self.formats)

    @property
    def _requested(self) -> Sequence[str]:
        """Columns that the user asked for, without those that only formats need."""
        columns = self.survey.columns if self.scenario is None else self.scenario.cloud.columns
        return [column.name for column in optional_columns(columns)]

    @contextmanager
    def lock(self) -> Iterator[Path]:
        """Lock the folder while the body runs, and yield the folder that files are written to."""
        for output_format in self.formats:
            output_format.check_installed()
        with result_folder(self.target) as folder:
            yield folder

    def check_existing(self, inputs: OneJob | RunResult, *, overwrite: bool = False) -> None:
        """Refuse a target that holds the result of another survey, or files of no result.

        LidarError if there is a result of another scene or survey, a damaged result, or a file that
        this result would replace and that no report there lists, each unless `overwrite`; or a
        folder that would be replaced and holds foreign files.
        """
        target = self.target
        storage = Storage.at(target)
        advice = (
            "Specify another folder with `--out`, or replace the result with `--overwrite` "
            "(`overwrite=True` in Python)."
        )
        with explained(f"{target} cannot be read"):
            try:
                entries = set(storage.entries())
            except NotADirectoryError:
                return
        earlier, listed, earlier_fields = _earlier(storage)
        if REPORT in entries and not overwrite:
            expected = inputs.identity  # takes a moment for large scenes
            if earlier != {name: expected[name] for name in _SURVEY}:
                changed = describe_changes(earlier_fields, inputs.fields) if earlier_fields else ""
                raise LidarError(
                    f"{target} contains the result of a different "
                    f"survey{f' ({changed})' * bool(changed)}. {advice}"
                )
        further = _further_files(self.survey, self.formats)
        foreign = [name for name in (*FILES, *further) if name in entries and name not in listed]
        if foreign and not overwrite:
            lists = (
                f"{target} contains {foreign[0]}, which would be replaced although it does not "
                "belong to a result."
            )
            raise LidarError(f"{lists} {advice}")
        check_foreign_files(storage, _formats({*further, *listed}))

    def publish(
        self,
        folder: Path,
        result: RunResult,
        store: RunStore,
        screen: Screen,
        cluster: Cluster | None = None,
        growing: GrowingCloud | None = None,
    ) -> tuple[RunResult, dict[str, Any]]:
        """Write the result of a run, remove the run, and return the result and its report.

        LIDAR workers of the cluster write formats in pieces. `growing` may have the points already.
        """
        workers = LidarWorkers(cluster) if cluster is not None and self.in_pieces else None
        is_in_place = False

        def on_written() -> None:
            nonlocal is_in_place
            is_in_place = True
            store.remove()

        extents = {
            "cloud": "",
            "page": " and the report",
            "pictures": ", the report and the pictures",
        }
        try:
            with screen.writing(f"writing the cloud{extents[self.extent]}") as show:
                return result, self.write(folder, result, on_written, workers, growing, show)
        except BaseException as error:
            if is_in_place:
                error.add_note(f"The result in {self.target} is complete.")
            raise

    def write(
        self,
        folder: Path,
        result: RunResult,
        on_written: Callable[[], object] = lambda: None,
        workers: LidarWorkers | None = None,
        growing: GrowingCloud | None = None,
        show: WritingProgress = lambda *_: None,
    ) -> dict[str, Any]:
        """Write cloud, pictures and report into the target, and return the report.

        Files are written to a temporary folder within `folder`, which `lock` yields, and moved into
        place once all are on the disk, so that an earlier result stays intact if a file cannot be
        written. Pictures of an earlier result that this result lacks are removed. `on_written` is
        called when all files are in place, before a pending interrupt is raised. `workers` write
        formats of many files, and `show` shows the progress of each file.

        If `target` is a storage, all files are put into it, report.json last. Files of workers go
        there directly, and an earlier result is removed before.

        LidarError if a file cannot be written.
        """
        target = Storage.at(self.target)
        earlier = _earlier(target).files
        further = _further_files(result.survey, self.formats)
        sweeps = Sweeps.from_survey(result.survey, result.scene)
        sent: list[ExportSpec] = []  # formats that workers write to the storage
        if workers is not None and isinstance(self.target, Storage):
            sent = [entry for entry in self.formats if entry.has_many_files]
        with (
            explained(
                f"The result cannot be written to {self.target}",
                "free some disk space, or specify another folder with `--out`",
            ),
            staging(folder, self.target) as staged,
        ):
            check_foreign_files(target, _formats({*further, *earlier}))
            sweeps = _write_sweeps(staged, result, sweeps)
            points = _shown_points(result, CLOUD, show)
            counts = _write_cloud(staged / CLOUD, points, sweeps, result, growing)
            timeline.mark(timeline.CLOUD_WRITTEN)
            others = [entry for entry in self.formats if entry not in sent]
            full_scales = _write_formats(others, staged, result, sweeps, workers, show)
            if workers and sent:
                _clear(target, further, earlier)
                for output_format in sent:
                    points = _shown_points(result, output_format.row.file, show)
                    output_format.write_to_storage(target, points, sweeps, workers)
            if workers:
                result = workers.recorded(result)
            report = make_report(result, counts)
            for output_format in self.formats:
                report["notes"] += output_format.notes(result.points, sweeps, self._requested)
            if full_scales:
                report["intensity_full_scale"] = full_scales
            if self.extent != "cloud":
                self._report(result, report, counts, staged, show)
            _write_report(staged, report, further)
            timeline.mark(timeline.REPORT_WRITTEN)
            if isinstance(self.target, Storage):
                if not sent:
                    _clear(target, further, earlier)
                _put(staged, target, further)
                with defer_interrupts():
                    on_written()
            else:
                _move(staged, folder, report["files"], earlier, on_written)
        timeline.mark(timeline.IN_PLACE)
        return report

    def _report(
        self,
        result: RunResult,
        report: dict[str, Any],
        counts: CloudCounts,
        staged: Path,
        show: WritingProgress,
    ) -> None:
        """Write the page, the content of pictures, and the pictures if in the extent."""
        from .page.rendering import write_page  # jinja2

        shown = picture_content(result)
        shown.save(staged / PICTURE_FILE)
        write_page(staged / PAGE, report, result, counts, self.scenario)
        if self.extent == "pictures":
            from .result_pictures import draw_pictures  # Matplotlib, and seconds for each picture

            list(draw_pictures(shown, staged, staged, show=show))


def _write_cloud(
    path: Path,
    points: StoredCloud,
    sweeps: Sweeps,
    result: RunResult,
    growing: GrowingCloud | None,
) -> CloudCounts:
    """Write the cloud, or move the file there that has grown, and return the counts of points."""
    with explained(f"{path} cannot be written"):
        counts = None if growing is None else growing.finish(path, points)
        return counts or write_cloud(path, points, sweeps, result.scene)


def _write_formats(
    formats: Sequence[ExportSpec],
    staged: Path,
    result: RunResult,
    sweeps: Sweeps,
    workers: LidarWorkers | None,
    show: WritingProgress,
) -> dict[str, float]:
    """Write formats to a temporary folder, those of many files last.

    Returns the intensity that each format with integer intensities stores as its highest integer.
    """
    full_scales: dict[str, float] = {}
    for output_format in sorted(formats, key=lambda entry: entry.has_many_files):
        full_scale = output_format.write(
            staged / output_format.row.file,
            _shown_points(result, output_format.row.file, show),
            sweeps,
            workers=workers,
            content=partial(picture_content, result),
        )
        if full_scale is not None:
            full_scales[output_format.format] = full_scale
    return full_scales


def _shown_points(result: RunResult, file: str, show: WritingProgress) -> StoredCloud:
    """Return the points of a result, whose reading is shown as the progress of a file."""
    count = len(result.points)
    read_count = 0

    def tell(increment: int) -> None:
        nonlocal read_count
        read_count = min(read_count + increment, count)  # points may be read twice
        show(file, read_count, count, "points")

    tell(0)
    return replace(result.points, report=tell)


def _write_sweeps(staged: Path, result: RunResult, sweeps: Sweeps) -> Sweeps:
    """Write the sweeps, and instruments if any, and return sweeps that refer to these files."""
    sweeps.save(staged / SWEEPS_FILE)
    instruments = sweeps.instruments
    if instruments is None:
        return sweeps
    write_instruments(staged, result.survey, result.scene.origin)
    return replace(sweeps, instruments=replace(instruments, folder=staged))


def _write_report(staged: Path, report: dict[str, Any], further: Sequence[str]) -> None:
    """Add the names of all files to a report, and write the report."""
    present = [name for name in FILES[1:] if name == REPORT or (staged / name).exists()]
    report["files"] = [CLOUD, *further, *present]
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    (staged / REPORT).write_text(text, encoding="utf-8")


def _put(staged: Path, storage: Storage, further: Collection[str]) -> None:
    """Put the files of a result into a storage, the report last."""
    for name in (*_known_further(further), *FILES):
        if (staged / name).exists():
            storage.put(staged / name, name)


def _further_files(survey: Survey, formats: Sequence[ExportSpec]) -> list[str]:
    """Name the files of a result beyond the files that all results have."""
    instruments = Instruments.from_survey(survey)
    measured = [] if instruments is None else instruments.files
    return [*(output_format.row.file for output_format in formats), *measured]


def _formats(names: Collection[str]) -> list[str]:
    """Return the formats whose file or folder is among the names of a result."""
    unknown = {*names} - {*FILES, *INSTRUMENT_FILES, *_OF_FORMATS}
    return [name for file, name in _OF_FORMATS.items() if file in names] + plugin_formats(unknown)


def _known_further(names: Collection[str]) -> list[str]:
    """Return the names that are files or folders of formats or instruments, in order."""
    measured = [name for name in INSTRUMENT_FILES if name in names]
    return [format_row(name).file for name in _formats(names)] + measured


class _Earlier(NamedTuple):
    """The result in a folder."""

    identity: Mapping[str, str] = MappingProxyType({})  # identity of scene and survey
    files: frozenset[str] = frozenset()  # files that may be removed
    fields: Mapping[str, str] = MappingProxyType({})  # fields in words


def _earlier(storage: Storage) -> _Earlier:
    """Return the result in a folder, or an empty one if the result is missing or damaged."""
    try:
        report = json.loads(storage.read(REPORT))
        identity = {name: report["identity"][name] for name in _SURVEY}
        files = frozenset(report["files"])
        files |= {*_DRAWN} if PICTURE_FILE in files else set()  # drawn since then
        return _Earlier(identity, files, dict(report.get("fields", {})))
    except (OSError, ValueError, TypeError, LookupError):
        return _Earlier()


def _move(
    staged: Path,
    folder: Path,
    files: Collection[str],
    earlier: Collection[str],
    on_written: Callable[[], object],
) -> None:
    """Move all files of a result into place, the report last; a killed run can be resumed."""
    for name in files:  # before its name: parts, the other copy of the points, are removed then
        flush(staged / name)
    with defer_interrupts():
        _clear(Storage.at(folder), files, earlier)
        for name in (*_known_further(files), *FILES):
            if name in files:
                (staged / name).replace(folder / name)
        flush(folder)  # the names last before the parts are removed
        on_written()


def _clear(target: Storage, files: Collection[str], earlier: Collection[str]) -> None:
    """Remove the files of an earlier result, before a result of `files` is moved into place.

    The report and the page go first, and a local folder is flushed: a report marks a whole result.
    Then go files and folders of formats that `files` replace, or that the `earlier` result lists.
    If a killed run has removed the earlier report, nothing is listed, and other formats stay. Of
    the remaining `FILES`, those go that are not among `files`.
    """
    further = _known_further({*files, *earlier})
    # The picture of the path of an earlier result would look like a picture of this result.
    missing = [name for name in FILES if name not in files]
    for name in (REPORT, PAGE, *further, *missing):
        target.discard(name)
        if name == PAGE and target.is_local:  # no report lasts beside files of another result
            flush(target.local())

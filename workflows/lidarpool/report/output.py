"""Write the result of a survey to its output folder.

Files are written to a temporary folder first, so that the output folder always contains either a
complete result or none.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from lidarfiles.clouds.folder import result_folder
from lidarfiles.clouds.navigation_files import write_instruments
from lidarfiles.clouds.writing import ExportSpec, check_foreign_files
from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.picture_file import PICTURE_FILE
from lidarfiles.work.publishing import move_into_place
from lidarscenario.scenario import Scenario
from lidarsim.columns.table import optional_columns
from lidarsim.errors import explain_os_errors
from lidarsim.io.storage import Storage, staging
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..processes import timeline
from ..run.cluster.cluster import Cluster, ClusterConnection
from ..run.job_source import SingleJob
from ..run.listener import Listener
from ..run.options import RunOptions
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import RunResult
from ..run.runner import cast, open_store
from ..run.store.run_store import RunStore
from ..run.writer import LidarWorkers
from .cloud_counts import CloudCounts
from .growing_cloud import GrowingCloud, write_cloud
from .picture_content import picture_content
from .report import describe_flight, make_report
from .result_files import (
    CLOUD,
    FILES,
    PAGE,
    REPORT,
    check_existing,
    formats_of_files,
    obsolete_files,
    optional_files,
    read_earlier,
)


def run_survey(
    jobs: SingleJob,
    options: RunOptions,
    output: SurveyOutput,
    screen: Screen,
    page: RunPage,
    compare: Callable[[RunResult], str] | None = None,
) -> tuple[RunResult, dict[str, Any]]:
    """Run a survey, write its result, and remove the run store.

    The point cloud is written while the survey is running.

    Parameters
    ----------
    jobs
        The survey as the only job of the run.
    options
        Options of the run.
    output
        Output folder and formats.
    screen, page
        Objects that show the progress in the terminal and in the browser.
    compare
        Function that checks the result before it is written. It returns a note about the result,
        which may be empty, or raises an error.

    Returns
    -------
    The result and the content of report.json.
    """
    with output.lock() as folder:
        if not options.continues_run:
            output.check_existing(jobs, overwrite=options.overwrite)
        with (
            ClusterConnection(jobs, options, screen) as connection,
            open_store(jobs, options, screen, output.target) as store,
            staging(folder, output.target) as staged,
        ):
            assert store.only_job is not None, "the store of a survey has a single job"
            with GrowingCloud(staged / CLOUD, store.only_job) as cloud:
                load_open3d()  # required for the cloud; a missing library is reported early
                committed = cast(
                    store,
                    connection,
                    Listener(page, on_parts=cloud.append_committed, pace=options.pace),
                )
                result = committed.result(screen)
                page.finish(result.seconds, result)
                if compare is not None and (note := compare(result)):
                    result = replace(result, notes=(*result.notes, note))
                if not output.in_pieces:
                    connection.close()
                    timeline.record_step(timeline.STOPPED)
                return output.publish(folder, result, store, screen, connection.cluster, cloud)


@dataclass(eq=False)
class SurveyOutput:
    """Output folder or storage of a survey.

    `formats` are written in addition to the cloud. `extent` selects the other files:

    - "cloud": only the cloud and report.json
    - "page": also the HTML report and the file from which pictures can be drawn
    - "pictures": also the pictures
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
        """Whether a format consists of many files, which workers can write in parallel."""
        return any(output_format.has_many_files for output_format in self.formats)

    @property
    def _requested(self) -> Sequence[str]:
        columns = self.survey.columns if self.scenario is None else self.scenario.cloud.columns
        return [column.name for column in optional_columns(columns)]

    @contextmanager
    def lock(self) -> Iterator[Path]:
        """Lock the output folder during the body, and yield the local folder for output files."""
        for output_format in self.formats:
            output_format.check_installed()
        with result_folder(self.target) as folder:
            yield folder

    def check_existing(self, inputs: SingleJob | RunResult, *, overwrite: bool = False) -> None:
        """Raise LidarError if the target contains anything that must not be replaced.

        Raises
        ------
        LidarError
            If a folder that would be replaced contains foreign files. Unless `overwrite` is True,
            also if the target contains a damaged result, the result of a different survey, or a
            file that would be replaced but does not belong to a result.
        """
        check_existing(self.target, self.survey, self.formats, inputs, overwrite=overwrite)

    def publish(
        self,
        folder: Path,
        result: RunResult,
        store: RunStore,
        screen: Screen,
        cluster: Cluster | None = None,
        growing: GrowingCloud | None = None,
    ) -> tuple[RunResult, dict[str, Any]]:
        """Write the result of a run, and remove the run store.

        Parameters
        ----------
        folder
            Folder that `lock` yields.
        result, store
            Result and store of the run.
        screen
            Object that shows the progress.
        cluster
            Cluster whose LIDAR workers write the formats that consist of many files. By default,
            this process writes them.
        growing
            Cloud that was written during the run, if there is one.

        Returns
        -------
        The result and the content of report.json.
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
        """Write the cloud, the images and the report to the target.

        All files are first written to a temporary folder within `folder`, and then moved into
        place, with report.json last, so an earlier result stays intact if a file cannot be written.
        Files of the earlier result that the new one does not have are removed.

        In a remote storage, files that workers write are written directly, after report.json and
        the page of an earlier result have been removed.

        Parameters
        ----------
        folder
            Folder that `lock` yields.
        result
            Result of the run.
        on_written
            Function that is called when all files are in place, before a pending interrupt is
            raised.
        workers
            Workers that write the formats that consist of many files.
        growing
            Cloud that was written during the run, if there is one.
        show
            Function that shows the progress of each file.

        Returns
        -------
        The content of report.json.

        Raises
        ------
        LidarError
            If a file cannot be written.
        """
        target = Storage.at(self.target)
        earlier = read_earlier(target).files
        further = optional_files(result.survey, self.formats)
        sweeps = _sweeps_of(result)
        sent: list[ExportSpec] = []  # formats that workers write directly to the storage
        if workers is not None and isinstance(self.target, Storage):
            sent = [entry for entry in self.formats if entry.has_many_files]
        with (
            explain_os_errors(
                f"The result cannot be written to {self.target}",
                "free some disk space, or specify another folder with `--out`",
            ),
            staging(folder, self.target) as staged,
        ):
            check_foreign_files(target, formats_of_files({*further, *earlier}))
            sweeps = _write_sweeps(staged, result, sweeps)
            points = _points_with_progress(result, CLOUD, show)
            counts = _write_cloud(staged / CLOUD, points, sweeps, result, growing)
            timeline.record_step(timeline.CLOUD_WRITTEN)
            others = [entry for entry in self.formats if entry not in sent]
            full_scales = _write_formats(others, staged, result, sweeps, workers, show)
            if workers and sent:
                for name in (REPORT, PAGE, *(entry.row.file for entry in sent)):
                    target.discard(name)
                for output_format in sent:
                    points = _points_with_progress(result, output_format.row.file, show)
                    output_format.write_to_storage(target, points, sweeps, workers)
            if workers:
                result = workers.with_range_tasks(result)
            report = make_report(result, counts)
            report |= describe_flight(self.scenario, result.scene, counts)
            for output_format in self.formats:
                report["notes"] += output_format.notes(
                    result.points, sweeps, self._requested, result.survey
                )
            if full_scales:
                report["intensity_full_scale"] = full_scales
            if self.extent != "cloud":
                self._write_page(result, report, counts, staged, show)
            _write_report(staged, report, further)
            timeline.record_step(timeline.REPORT_WRITTEN)
            move_into_place(
                staged,
                target,
                last=REPORT,
                remove=obsolete_files(report["files"], earlier),
                on_written=on_written,
            )
        timeline.record_step(timeline.IN_PLACE)
        return report

    def _write_page(
        self,
        result: RunResult,
        report: dict[str, Any],
        counts: CloudCounts,
        staged: Path,
        show: WritingProgress,
    ) -> None:
        """Write the HTML report, the data for images and, if requested, the images."""
        from .page.rendering import write_page  # imports jinja2

        shown = picture_content(result)
        shown.save(staged / PICTURE_FILE)
        write_page(staged / PAGE, report, result, counts, self.scenario)
        if self.extent == "pictures":
            from .result_pictures import draw_pictures  # imports Matplotlib

            list(draw_pictures(shown, staged, staged, show=show))


def _sweeps_of(result: RunResult) -> Sweeps:
    """Return the sweeps of a result, including the actor visibility that the run determined."""
    if result.points.sweeps is None:
        return Sweeps.from_survey(result.survey, result.scene)
    sweeps: Sweeps = result.points.sweeps()
    return sweeps


def _write_cloud(
    path: Path,
    points: StoredCloud,
    sweeps: Sweeps,
    result: RunResult,
    growing: GrowingCloud | None,
) -> CloudCounts:
    """Write the cloud, or move it to `path` if it was written during the run.

    Returns the statistics of the cloud.
    """
    with explain_os_errors(f"{path} cannot be written"):
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
    """Write a result to a temporary folder in several formats.

    Formats that consist of many files are written last. Returns {format: intensity} for formats
    with integer intensities. The value is the intensity that is stored as the largest integer.
    """
    full_scales: dict[str, float] = {}
    for output_format in sorted(formats, key=lambda entry: entry.has_many_files):
        full_scale = output_format.write(
            staged / output_format.row.file,
            _points_with_progress(result, output_format.row.file, show),
            sweeps,
            workers=workers,
            content=partial(picture_content, result),
        )
        if full_scale is not None:
            full_scales[output_format.format] = full_scale
    return full_scales


def _points_with_progress(result: RunResult, file: str, show: WritingProgress) -> StoredCloud:
    """Return the points of a result, which report their progress for a file while they are read."""
    count = len(result.points)
    read_count = 0

    def report(increment: int) -> None:
        nonlocal read_count
        read_count = min(read_count + increment, count)  # points may be read twice
        show(file, read_count, count, "points")

    report(0)
    return replace(result.points, report=report)


def _write_sweeps(staged: Path, result: RunResult, sweeps: Sweeps) -> Sweeps:
    """Write the sweeps and any instrument files, and return sweeps that refer to these files."""
    sweeps.save(staged / SWEEPS_FILE)
    instruments = sweeps.instruments
    if instruments is None:
        return sweeps
    write_instruments(staged, result.survey, result.scene.origin)
    return replace(sweeps, instruments=replace(instruments, folder=staged))


def _write_report(staged: Path, report: dict[str, Any], further: Sequence[str]) -> None:
    present = [name for name in FILES[1:] if name == REPORT or (staged / name).exists()]
    report["files"] = [CLOUD, *further, *present]
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    (staged / REPORT).write_text(text, encoding="utf-8")

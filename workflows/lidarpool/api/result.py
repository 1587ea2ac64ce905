"""Result of a survey, with methods that write the same files as `lidarpool run`."""

from __future__ import annotations

import shutil
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import TYPE_CHECKING, Any

from lidarfiles.clouds.writing import save_cloud
from lidarsim.environment.notebook import PICTURE_SIZE, cell_display, html_image, html_table
from lidarsim.schema.checks import check_fits, check_list
from lidarsim.words import format_scan_counts, plural

from ..run.run_result import RunResult

if TYPE_CHECKING:
    from lidarfiles.picture_file import PictureContent

_NOTEBOOK_PICTURES = ("hits", "cloud")


@dataclass(frozen=True, eq=False, repr=False)
class Result(RunResult):
    """Result of a survey, with methods that write, plot and display it.

    Notebooks display the result as a table with two pictures.
    """

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects, indexed by the values of the `object` column."""
        return self.scene.object_names

    def report(
        self,
        folder: str | Path,
        *,
        only_cloud: bool = False,
        pictures: bool = False,
        formats: Sequence[str | Mapping[str, Any]] = (),
        overwrite: bool = False,
    ) -> None:
        """Write the point cloud, the plots and the report, as `lidarpool run` does.

        Either all files are written or none.

        Parameters
        ----------
        folder
            Output folder, which is created if it does not exist, or a URL that fsspec can open. An
            earlier result of the same survey in the folder is replaced.
        only_cloud
            Whether to omit `report.html` and `pictures.npz`.
        pictures
            Whether to draw the pictures as well.
        formats
            Additional formats for the cloud, specified as in `output.write` of a scenario, for
            example "laz" or {"format": "mcap", "layout": "ouster"}.
        overwrite
            Whether to replace even the result of a different survey.

        Raises
        ------
        LidarError
            If a file cannot be written, if the folder contains the result of a different survey, or
            if a format requires a missing package or column.
        """
        from lidarfiles.clouds.folder import output_destination
        from lidarfiles.clouds.writing import ExportSpec

        from ..report.output import SurveyOutput

        check_list("formats", formats)
        further_formats = [ExportSpec.from_entry(entry) for entry in formats]
        extent = "cloud" if only_cloud else "pictures" if pictures else "page"
        output = SurveyOutput(output_destination(folder), self.survey, further_formats, extent)
        with output.lock() as locked:
            output.check_existing(self, overwrite=overwrite)
            output.write(locked, self)

    def pictures(
        self,
        folder: str | Path,
        *,
        only: Sequence[str] = (),
        size: tuple[int, int] = (1600, 1000),
        color: str = "z",
    ) -> list[Path]:
        """Draw plots of the result, as `lidarpool plot` does.

        Parameters
        ----------
        folder
            Output folder, which is created if it does not exist.
        only
            Names of the pictures to draw (scene, hits, intensity, cloud or path). By default, all
            pictures are drawn.
        size
            Width and height in pixels.
        color
            Column that determines the color of the points, or "rgb" for red, green and blue.

        Returns
        -------
        list of Path
            Paths of the picture files.

        Raises
        ------
        LidarError
            If a picture, size or column is unknown, or a file cannot be written.
        """
        from ..report.result_pictures import publish_pictures

        check_list("only", only)
        check_fits("size", size, tuple[int, int])
        target = Path(folder)
        names = publish_pictures(
            self._pictured,
            self._cloud_file.parent,
            target,
            target / "report.html",
            only=only,
            size=size,
            color=color,
        )
        return [target / name for name in names]

    def view(self, *, port: int = 8080, browser: bool = True) -> None:
        """Show the result in the browser until Ctrl-C, as `lidarpool view` does.

        In a notebook, the page is shown in the cell and remains available as long as the result
        exists.

        Parameters
        ----------
        port
            Port on 127.0.0.1. If the port is in use, the next free port is used. 0 selects any free
            port.
        browser
            Whether to open a browser if the machine has a desktop.
        """
        from lidarsim.columns.cloud_file import CloudFile
        from lidarview.viewer.result_views import result_page, wait_for_interrupt
        from lidarview.viewer.view import View

        from ..pages.downloads import downloads

        with ExitStack() as stack:
            file = CloudFile(self._cloud_file, self._pictured.extra_columns)
            sweeps = None if self.points.sweeps is None else self.points.sweeps()
            view = View(file, self._pictured, sweeps, downloads=downloads())
            stack.enter_context(result_page(view, port=port, browser=browser))
            if cell_display() is None:
                wait_for_interrupt()
            else:
                weakref.finalize(self, stack.pop_all().close)

    @cached_property
    def _pictured(self) -> PictureContent:
        from ..report.picture_content import picture_content

        return picture_content(self)

    @cached_property
    def _cloud_file(self) -> Path:
        """Path of a temporary PLY file that contains the cloud.

        The folder is removed when the result is garbage-collected.
        """
        folder = mkdtemp(prefix="lidarpool-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        path = Path(folder) / "cloud.ply"
        save_cloud(self.points, path)
        return path

    def __repr__(self) -> str:
        survey, cloud, *further = (f"{name}: {value}" for name, value in self._summary())
        return "\n".join([survey, cloud, "; ".join(further)]).rstrip()

    def _repr_html_(self) -> str:
        further = {
            "backend": self.backend,
            "seconds": f"{self.seconds:.1f}",
            "folder": self.points.storage.url,
        }
        return html_table([*self._summary(), *further.items()]) + self._images

    @cached_property
    def _images(self) -> str:
        """Plots of the result as HTML image elements."""
        from lidarview.cell_pictures import compress_png

        with TemporaryDirectory(prefix="lidarpool-") as folder:
            drawn = self.pictures(folder, only=_NOTEBOOK_PICTURES, size=PICTURE_SIZE)
            return "".join(html_image(compress_png(path.read_bytes()), path.stem) for path in drawn)

    def _summary(self) -> Iterator[tuple[str, str]]:
        """Yield the labels and texts of the summary table."""
        yield (
            "survey",
            f"{format_scan_counts(self.survey.scan_count, self.survey.sweep_count)}, "
            f"{self.rays:,} rays, {self.hit_count:,} hits, "
            f"{plural(len(self.objects), 'object')} in the scene ({self.backend}, "
            f"{self.survey_seconds:.1f} s)",
        )
        names = ", ".join(("x", "y", "z", *(column.name for column in self.points.table)))
        yield "cloud", f"{plural(len(self.points), 'point')}{self.thinning_note}: {names}"
        if self.plan is not None:
            free = "collision-free" if self.plan.collision_free else "not collision-free"
            yield (
                "path",
                f"{self.plan.length:.2f} m, {free} ({self.plan.trials} trials, "
                f"{self.planning_seconds:.1f} s)",
            )
        for note in self.notes:
            yield "note", note

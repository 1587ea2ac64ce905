"""Result of comparing surveys, with its table, maps and report."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.writing import save_cloud
from lidarsim.columns.cloud import Cloud
from lidarsim.numerics.arrays import Floats
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.page_templates import render_template

from ..comparison_files import write_comparison
from .deviations import STATISTICS

LABELS = {
    "delta_e": "ΔE",
    "delta_n": "ΔN",
    "delta_h": "Δh",
    "horizontal": "horizontal",
    "range": "range",
    "distance": "distance",
}


@dataclass(frozen=True, eq=False, repr=False)
class SurveyComparison:
    """Result of `compare_surveys` and `compare_strips`, whose text representation is a table."""

    figures: dict[str, Any]  # content of compare.json; lengths are in meters
    points: Floats  # (n, 3): world coordinates of the deviations, in meters
    components: dict[str, Floats]  # {name: deviations of shape (n,)} in meters
    # Normals, levels of detection and other values at the positions, of shape (n,).
    columns: dict[str, Floats] = field(default_factory=dict)

    def __repr__(self) -> str:
        text = render_template("survey.txt", __name__, report=self.figures, labels=LABELS)
        return text.rstrip("\n")

    def table(self) -> str:
        """Return the statistics as comma-separated values, one row per component or overlap."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["a", "b", "component", "count", *STATISTICS])
        is_overlap = self.figures["method"] == "strips"
        a, b = ("all", "all") if is_overlap else self.figures["inputs"]
        rows = [(a, b, name, one) for name, one in self.figures["components"].items()]
        rows += [(one["a"], one["b"], "delta_h", one) for one in self.figures.get("overlaps", ())]
        for first, second, name, one in rows:
            values = [f"{one[statistic]:.6f}" for statistic in STATISTICS]
            writer.writerow([first, second, name, one["count"], *values])
        return text.getvalue()

    def save_points(self, path: str | Path) -> None:
        """Write the deviation at each position to a point cloud.

        The file has a column for each component, such as `distance`. It also contains normals and,
        for M3C2, `level_of_detection`.

        Parameters
        ----------
        path
            File to write, in any format of a single file that `save_cloud` supports, such as .laz
            or .ply. An existing file is replaced.

        Raises
        ------
        LidarError
            If the file cannot be written, or if its format is not supported.
        """
        columns = {**self.components, **self.columns}
        values = {name: np.asarray(column, np.float32) for name, column in columns.items()}
        authority, _, code = (self.figures["coordinate_system"] or "").partition(":")
        sweeps = replace(Sweeps.unknown(), epsg=int(code) if authority == "EPSG" else None)
        save_cloud(Cloud(self.points, values, sweeps=lambda: sweeps), path, precision_m=1e-4)

    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.csv, compare.html and the maps, and return their paths.

        The folder is created if it does not exist. An earlier comparison is replaced.

        Raises
        ------
        LidarError
            If the folder cannot be written to.
        """
        from .survey_charts import draw_facades, draw_histograms, draw_maps  # imports Matplotlib

        pages = {
            "map": draw_maps(self.figures, self.points, self.components, LABELS),
            "histogram": draw_histograms(self.figures, self.components, LABELS),
        }
        facades = draw_facades(self.points, self.components, self.columns)
        if facades is not None:
            pages["facades"] = facades
        pictures = {name: page.svg() for name, page in pages.items()}
        report = render_template(
            "survey.html", __name__, report=self.figures, pictures=pictures, labels=LABELS
        )
        return write_comparison(folder, self.figures, report, pages, self.table())

"""Result of comparing surveys, with its table, maps and report."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsim.numerics.arrays import Floats
from lidarview.page_templates import render_template

from ..comparison_files import write_comparison
from .deviations import STATISTICS
from .survey_charts import draw_histograms, draw_maps

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

    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.csv, compare.html and the maps, and return their paths.

        The folder is created if it does not exist. Pictures of an earlier comparison are removed.

        Raises
        ------
        LidarError
            If the folder cannot be written to.
        """
        pages = {
            "map": draw_maps(self.figures, self.points, self.components, LABELS),
            "histogram": draw_histograms(self.figures, self.components, LABELS),
        }
        pictures = {name: page.svg() for name, page in pages.items()}
        report = render_template(
            "survey.html", __name__, report=self.figures, pictures=pictures, labels=LABELS
        )
        texts = {"compare.csv": self.table()}
        return write_comparison(folder, self.figures, report, pages, texts)

"""Result of comparing two clouds or recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lidarview.page_templates import render_template

from .comparison_data import ComparisonData


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(ComparisonData):
    """Result of `compare`, whose text representation is a table."""

    def __repr__(self) -> str:
        return render_template("comparison.txt", __name__, report=self.figures).rstrip("\n")

    def save(self, folder: str | Path) -> list[Path]:
        """Write compare.json, compare.html and the charts, and return their paths.

        The folder is created if it does not exist. An earlier comparison is replaced.

        Raises
        ------
        LidarError
            If the folder cannot be written to.
        """
        # Drawing imports Matplotlib.
        from .comparison_charts import draw_above, draw_distances, draw_ranges, draw_rings
        from .comparison_files import write_comparison

        pages = {"distances": draw_distances(self), "above": draw_above(self)}
        if self.images is not None:
            pages = {"ranges": draw_ranges(self), "rings": draw_rings(self)} | pages
        pictures = {name: page.svg() for name, page in pages.items()}
        report = render_template(
            "comparison.html", __name__, report=self.figures, pictures=pictures
        )
        return write_comparison(folder, self.figures, report, pages)

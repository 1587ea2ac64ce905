"""Write the output folder of a comparison."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfiles.clouds.folder import result_folder
from lidarfiles.work.publishing import publishing
from lidarsim.errors import explain_os_errors

if TYPE_CHECKING:
    from lidarview.render.picture_page import Page

FIGURES = "compare.json"
PAGE = "compare.html"
TABLE = "compare.csv"
# Pictures of all kinds of comparisons.
_PICTURES = ("ranges", "rings", "distances", "above", "map", "facades", "histogram")


def write_comparison(
    folder: str | Path,
    figures: Mapping[str, Any],
    report: str,
    pages: Mapping[str, Page],
    table: str | None = None,
) -> list[Path]:
    """Write the files of a comparison, and return their paths.

    The folder is created if it does not exist. An earlier comparison is replaced.

    Parameters
    ----------
    folder
        Output folder.
    figures
        Content of compare.json.
    report
        Content of compare.html.
    pages
        Pictures by name, such as "map" for compare-map.png.
    table
        Content of compare.csv, if there is one.

    Raises
    ------
    LidarError
        If the folder cannot be written to.
    """
    path = Path(folder)
    texts = {FIGURES: json.dumps(figures, indent=1, allow_nan=False) + "\n", PAGE: report}
    if table is not None:
        texts[TABLE] = table
    files = {name: text.encode() for name, text in texts.items()}
    files |= {f"compare-{name}.png": page.png() for name, page in pages.items()}
    known = [TABLE, *(f"compare-{name}.png" for name in _PICTURES)]
    obsolete = [name for name in known if name not in files]
    with (
        result_folder(path),
        explain_os_errors(f"The comparison cannot be written to {path}", "free some disk space"),
        publishing(path / FIGURES, remove=obsolete) as staged,
    ):
        for name, data in files.items():
            (staged / name).write_bytes(data)
    return [path / name for name in files]

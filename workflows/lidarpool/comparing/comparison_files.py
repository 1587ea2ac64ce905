"""Write the output folder of a comparison."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.errors import explain_os_errors

from ..clouds.folder import result_folder, staging

if TYPE_CHECKING:
    from lidarview.render.picture_page import Page

# Pictures of all kinds of comparisons.
_PICTURES = ("ranges", "rings", "distances", "above", "map", "facades", "histogram")


def write_comparison(
    folder: str | Path,
    figures: Mapping[str, Any],
    report: str,
    pages: Mapping[str, Page],
    texts: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write the files of a comparison, and return their paths.

    The folder is created if it does not exist. Pictures of an earlier comparison are removed.

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
    texts
        Content of further files by file name.

    Raises
    ------
    LidarError
        If the folder cannot be written to.
    """
    path = Path(folder)
    with (
        result_folder(path),
        explain_os_errors(f"The comparison cannot be written to {path}", "free some disk space"),
        staging(path) as staged,
    ):
        content = {
            "compare.json": json.dumps(figures, indent=1, allow_nan=False) + "\n",
            "compare.html": report,
            **(texts or {}),
        }
        files = {name: text.encode() for name, text in content.items()}
        files |= {f"compare-{name}.png": page.png() for name, page in pages.items()}
        for name, data in files.items():
            (staged / name).write_bytes(data)
        for name in _PICTURES:
            if name not in pages:
                (path / f"compare-{name}.png").unlink(missing_ok=True)
        return [(staged / name).replace(path / name) for name in files]

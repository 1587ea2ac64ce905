"""Results that the page shows: unfinished runs are refused, points are offered as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidarsim.base.errors import LidarError
from lidarview.viewer.view import CLOUD, Downloads, View, open_results

from ..export.formats import Format, save_cloud
from ..run.store.database import FILE
from ..run.store.run_store import RUN_FOLDER

DOWNLOADS = ("ply", "las", "parquet")  # formats that a page offers


def downloads() -> Downloads:
    """Return the formats of a download whose packages are installed, and their writer."""
    return Downloads([name for name in DOWNLOADS if Format(name).installed], save_cloud)


def open_finished(paths: Sequence[Path]) -> View:
    """Open results of the same scene as a view whose points can be downloaded.

    LidarError if a folder holds an unfinished run, or `open_results` cannot open it.
    """
    for path in paths:
        refuse_unfinished(path)
    return open_results(paths, downloads())


def refuse_unfinished(path: Path) -> None:
    """Raise a LidarError if a folder holds an unfinished run and no cloud."""
    if not (path / CLOUD).exists() and (path / RUN_FOLDER / FILE).exists():
        raise LidarError(
            f"{path} holds an unfinished run: continue it with lidarpool run --resume, where "
            "--live shows its points."
        )

"""The main figures of a run and where its files are, for programs that called the command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_FIGURES = (
    "backend",
    "notes",
    "scans",
    "rays",
    "hits",
    "points",
    "points_by_object",
    "seconds",
    "placement_violations",
    "replayed",
    "duplicates_dropped",
    "resumed_scans",
)
_PLANNING = ("trials", "best_length", "shortest_possible", "collision_free")


def summary(folder: Path, report: dict[str, Any], log: Path | None) -> dict[str, Any]:
    """Return what `--json` prints, ready for JSON; times in seconds, lengths in metres.

    Parameters
    ----------
    folder
        Where the files are.
    report
        The report of the run, see `make_report`.
    log
        File of the messages of libraries; None for none.
    """
    planning = report["planning"]
    return {
        "folder": str(folder),
        "files": {name: str(folder / name) for name in report["files"]},
        "log": str(log) if log else None,
        **{name: report[name] for name in _FIGURES},
        "planning": planning and {name: planning[name] for name in _PLANNING},
    }

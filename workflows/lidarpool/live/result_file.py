"""A finished cloud on disk, of which any scans are read, thinned to a number of points."""

from __future__ import annotations

import json
import re
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError
from ..columns.table import TABLE, Column
from ..export.ply_format import AXES, layout
from ..run.picture_file import PICTURE_FILE, Pictured
from .display import display_rows, quantities

CLOUD, REPORT = "cloud.ply", "report.json"
OUTSIDE = 0.01  # of the points of a cloud may lie outside of its scene


class ResultFile:
    """A cloud that `lidarpool run` wrote, and what lies beside it: the report, and the scene.

    The points stay on disk; only those that are chosen are read.

    Attributes
    ----------
    quantities
        What the points can be coloured by: the properties of the file, and what follows from them.
    pictured
        The scene, how it was hit, sensors and planning; None where there is nothing of that.
    note
        Why there is not, in a sentence, if one should know; else empty.

    Parameters
    ----------
    path
        The folder of a result, or a cloud. Report and scene are looked for beside the cloud.

    Raises
    ------
    LidarpoolError
        If there is no such cloud, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = _cloud_in(path)
        self._rows = _mapped(self.path)
        report = _report_beside(self.path)
        self.pictured, self.note = _pictured_beside(self.path)
        try:
            self._check_pictured(report)
            self.names = tuple(map(str, report.get("points_by_object", ())))
            self.route = _route(report)  # (n, 2), metres, world coordinates
            self._sensors, self._steps, self._at_stations = _sensors(report, self.pictured)
            self._columns = _columns(self._rows.dtype, report)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise LidarpoolError(
                f"{self.path.with_name(REPORT)} is not the report of a run ({error!r}): remove "
                "it, and the cloud is shown without it."
            ) from error
        if self.pictured is not None:
            self.names = self.pictured.scene.names
            if self.pictured.plan is not None:
                self.route = self.pictured.plan.path + self.pictured.scene.origin[:2]
        self.quantities = quantities(self._columns, self._knows_ranges)
        self._see_scans()

    def _see_scans(self) -> None:
        """Find out which scans there are, and whether they are in order, to choose from."""
        self.in_order, self.scans = False, (0, 0)
        if not self._has_scans or not len(self):
            return
        column = self._rows["scan"]
        some = column[one_of_each_part(len(self), 100_000)]
        self.in_order = bool((np.diff(some) >= 0).all())
        ends = column[[0, -1]] if self.in_order else some  # exact where the scans are in order
        self.scans = (int(ends.min()), int(ends.max()))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def origin(self) -> NDArray[np.float64]:
        """Whole metres near the points, (3,), that displayed positions are relative to."""
        if self.pictured is not None:
            return self.pictured.scene.origin
        if not len(self):
            return np.zeros(3)
        first = np.array([self._rows[axis][0] for axis in "xyz"], np.float64)
        return np.where(np.abs(first) > 10_000, np.round(first), 0.0)

    def choose(self, first: int, last: int, most: int) -> tuple[NDArray[np.void], int]:
        """Choose at most so many points of scans `first` to `last`, evenly.

        Returns
        -------
        rows
            The points with their `quantities`, see `display_rows`, in order. Those without
            finite coordinates are left out.
        count
            How many there are.
        """
        low, high = 0, len(self)
        if self.in_order:
            scans = self._rows["scan"]
            low = bisect_left(scans, first) if first > self.scans[0] else low
            high = bisect_right(scans, last) if last < self.scans[1] else high
        count = max(0, high - low)
        rows = self._rows[low + one_of_each_part(count, most)]
        positions = np.stack([rows[axis] for axis in AXES], axis=1, dtype=np.float64)
        values = {column.name: rows[column.in_files] for column in self._columns}
        sensors = self._sensors_of(values["scan"]) if self._knows_ranges else np.full(3, np.nan)
        out = display_rows(self.quantities, positions, self.origin, values, sensors)
        return out[np.isfinite(positions).all(axis=1)], count

    @property
    def _has_scans(self) -> bool:
        row = self._rows.dtype
        return "scan" in (row.names or ()) and row["scan"].kind in "iu"

    @property
    def _knows_ranges(self) -> bool:
        return self._at_stations and len(self._sensors) > 0 and self._has_scans

    def sensor_at(self, scan: int) -> NDArray[np.float64] | None:
        """Where the sensor stood in a scan, (3,), displayed position; None if it is not known."""
        if not len(self._sensors):
            return None
        return np.asarray(self._sensors_of(np.array([scan]))[0] - self.origin)

    def _sensors_of(self, scans: NDArray[Any]) -> NDArray[np.float64]:
        """Where the sensor was in scans (n,), (n, 3), world coordinates."""
        last = len(self._sensors) - 1
        if self._at_stations:
            rows = scans // self._steps
        else:  # places on its way, evenly spread over all scans
            rows = scans * last // max(1, self._steps - 1)
        return self._sensors[np.clip(rows, 0, last).astype(np.int64)]

    def _check_pictured(self, report: Mapping[str, Any]) -> None:
        """Do without the scene if it is not that of this cloud."""
        if self.pictured is None:
            return
        told, scene = report.get("parameters", {}), self.pictured.scene
        fits = told.get("triangles", len(scene.faces)) == len(scene.faces)
        # There are more places than stations where the sensor moves.
        fits &= told.get("poses", 1) <= len(self.pictured.poses)
        if fits and len(self):
            some = self._rows[one_of_each_part(len(self), 10_000)]
            points = np.stack([some[axis] for axis in AXES], axis=1, dtype=np.float64)
            low, high = scene.bounds + scene.origin
            room = 0.01 * np.linalg.norm(high - low) + 1.0
            known = np.isfinite(points).all(axis=1)
            outside = ((points < low - room) | (points > high + room)).any(axis=1)
            fits = outside[known].sum() <= OUTSIDE * known.sum()
        if not fits:
            self.pictured = None
            self.note = f"{PICTURE_FILE} is of another run: the cloud is shown without the scene."


def _cloud_in(path: Path) -> Path:
    if not path.is_dir():
        return path
    if not (path / CLOUD).exists():
        raise LidarpoolError(
            f"{path} holds no {CLOUD}: give the folder of a finished run (its --out), or a cloud."
        )
    return path / CLOUD


def _mapped(path: Path) -> NDArray[np.void]:
    """Rows of a cloud, read from disk as they are used."""
    try:
        start, count, dtype = layout(path)
        if not count:  # nothing cannot be mapped
            return np.empty(0, dtype)
        return np.memmap(path, dtype, "r", start, (count,))
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise LidarpoolError(f"{path} is not a point cloud of lidarpool: {error}.") from error


def _report_beside(cloud: Path) -> Mapping[str, Any]:
    """Report of a cloud; empty where there is none."""
    path = cloud.with_name(REPORT)
    if cloud.name != CLOUD or not path.exists():
        return {}
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LidarpoolError(
            f"{path} cannot be read ({error}): remove it, and the cloud is shown without it."
        ) from error
    return report if isinstance(report, dict) else {}


def _pictured_beside(cloud: Path) -> tuple[Pictured | None, str]:
    """Read what pictures of a result show; if that fails, return a sentence that says so.

    It is no error: the cloud is what one wants to see, and is all there.
    """
    path = cloud.with_name(PICTURE_FILE)
    if cloud.name != CLOUD or not path.exists():
        return None, ""
    try:
        return Pictured.load(path), ""
    except LidarpoolError as error:
        return None, f"The cloud is shown without the scene. {error}"


def _columns(row: np.dtype[np.void], report: Mapping[str, Any]) -> tuple[Column, ...]:
    """Columns of a file with such rows: those of the table, in its order, and what else it holds.

    What columns of one's own mean, the report may tell.
    """
    known = {column.in_files: column for column in TABLE.values()}
    told = {entry["file_name"]: entry for entry in report.get("columns", ())}
    found: dict[str, Column] = {}
    fields = row.names or ()
    for name in (*(name for name in known if name in fields), *fields):
        if name in AXES:
            continue
        dtype = row[name].str
        if name in known:
            column = replace(known[name], dtype=dtype, file_name=name)
        else:
            entry = told.get(name, {})
            column = Column(
                re.sub(r"\W|^(?=\d)", "_", str(entry.get("name", name))),
                dtype,
                str(entry.get("unit", "")),
                str(entry.get("meaning", "")),
                kind="label" if entry.get("kind") == "label" else "number",
                file_name=name,
            )
        found.setdefault(column.name, column)
    return tuple(found.values())


def _sensors(
    report: Mapping[str, Any], pictured: Pictured | None
) -> tuple[NDArray[np.float64], int, bool]:
    """Where the sensor was, (p, 3), world coordinates; empty where not all places are told.

    Beside it either the scans from each place, and True; or, where it moved and these are places
    on its way, the number of all scans, and False.
    """
    told = report.get("parameters", {})
    if pictured is not None and "steps" in told:
        steps, stations = int(told["steps"]), int(told.get("poses", len(pictured.poses)))
        moved = stations < len(pictured.poses)
        return pictured.poses, steps * stations if moved else steps, not moved
    poses = told.get("first_poses", ())
    if not poses or len(poses) != told.get("poses"):
        return np.empty((0, 3)), 1, True
    local = np.array([pose["position"] for pose in poses], np.float64)
    return local + np.asarray(told["origin"], np.float64), int(told["steps"]), True


def _route(report: Mapping[str, Any]) -> NDArray[np.float64]:
    """Planned path, (n, 2), world coordinates; empty where there is none."""
    planning = report.get("planning") or {}
    local = np.asarray(planning.get("path", ()), np.float64).reshape(-1, 2)
    origin = report.get("parameters", {}).get("origin", (0.0, 0.0))
    return local + np.asarray(origin, np.float64)[:2]

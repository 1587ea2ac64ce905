"""A finished cloud on disk, of which any scans are read, thinned to a number of points."""

from __future__ import annotations

import json
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..choice import one_of_each_part
from ..errors import LidarpoolError
from ..picture_file import PICTURE_FILE, Pictured
from ..ply_format import layout
from .display import DISPLAY

CLOUD, REPORT = "cloud.ply", "report.json"
OUTSIDE = 0.01  # of the points of a cloud may lie outside of its scene


class ResultFile:
    """A cloud that `lidarpool run` wrote, and what lies beside it: the report, and the scene.

    The points stay on disk; only those that are chosen are read.

    Attributes
    ----------
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
            self._sensors, self._steps = _sensors(report, self.pictured)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise LidarpoolError(
                f"{self.path.with_name(REPORT)} is not the report of a run ({error!r}): remove "
                "it, and the cloud is shown without it."
            ) from error
        if self.pictured is not None:
            self.names = self.pictured.scene.names
            if self.pictured.plan is not None:
                self.route = self.pictured.plan.path + self.pictured.scene.origin[:2]
        whole = self.choose(0, 2**31 - 1, 100_000)[0]
        scans = whole["scan"]
        self.in_order = bool((np.diff(scans) >= 0).all())
        # Exact where the scans are in order.
        ends = self._rows["scan"][[0, -1]] if self.in_order and len(self) else scans
        self.scans = (int(ends.min(initial=2**31 - 1)), int(ends.max(initial=0)))
        if not len(self):
            self.scans = (0, 0)
        self.has_ranges = bool(np.isfinite(whole["range"]).any())

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
            The points (DISPLAY), in order. Those without finite coordinates are left out.
        count
            How many there are.
        """
        scans = self._rows["scan"]
        low = bisect_left(scans, first) if first > 0 else 0
        high = bisect_right(scans, last) if last < 2**31 - 1 else len(scans)
        count = max(0, high - low)
        rows = self._rows[low + one_of_each_part(count, most)]
        positions = np.stack([rows[axis] for axis in "xyz"], axis=1, dtype=np.float64)
        out = np.empty(len(rows), DISPLAY)
        out["position"] = positions - self.origin
        out["range"] = self._ranges(positions, rows["scan"])
        for name in ("scan", "ring", "object"):
            out[name] = rows[name]
        return out[np.isfinite(positions).all(axis=1)], count

    def sensor_at(self, scan: int) -> NDArray[np.float64] | None:
        """Where the sensor stood in a scan, (3,), displayed position; None if it is not known."""
        if not len(self._sensors):
            return None
        row = min(max(scan // self._steps, 0), len(self._sensors) - 1)
        return np.asarray(self._sensors[row] - self.origin)

    def _check_pictured(self, report: Mapping[str, Any]) -> None:
        """Do without the scene if it is not that of this cloud."""
        if self.pictured is None:
            return
        told, scene = report.get("parameters", {}), self.pictured.scene
        found = {"poses": len(self.pictured.poses), "triangles": len(scene.faces)}
        fits = all(told.get(name, count) == count for name, count in found.items())
        if fits and len(self):
            some = self._rows[one_of_each_part(len(self), 10_000)]
            points = np.stack([some[axis] for axis in "xyz"], axis=1, dtype=np.float64)
            low, high = scene.bounds + scene.origin
            room = 0.01 * np.linalg.norm(high - low) + 1.0
            known = np.isfinite(points).all(axis=1)
            outside = ((points < low - room) | (points > high + room)).any(axis=1)
            fits = outside[known].sum() <= OUTSIDE * known.sum()
        if not fits:
            self.pictured = None
            self.note = f"{PICTURE_FILE} is of another run: the cloud is shown without the scene."

    def _ranges(
        self, positions: NDArray[np.float64], scans: NDArray[np.int32]
    ) -> NDArray[np.float64]:
        if not len(self._sensors):
            return np.full(len(positions), np.nan)
        sensor = self._sensors[(scans // self._steps).clip(0, len(self._sensors) - 1)]
        return np.asarray(np.linalg.norm(positions - sensor, axis=1))


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


def _sensors(
    report: Mapping[str, Any], pictured: Pictured | None
) -> tuple[NDArray[np.float64], int]:
    """World position of each pose, (p, 3), and scans from each; none where not all are told."""
    told = report.get("parameters", {})
    if pictured is not None and "steps" in told:
        return pictured.poses, int(told["steps"])
    poses = told.get("first_poses", ())
    if not poses or len(poses) != told.get("poses"):
        return np.empty((0, 3)), 1
    local = np.array([pose["position"] for pose in poses], np.float64)
    return local + np.asarray(told["origin"], np.float64), int(told["steps"])


def _route(report: Mapping[str, Any]) -> NDArray[np.float64]:
    """Planned path, (n, 2), world coordinates; empty where there is none."""
    planning = report.get("planning") or {}
    local = np.asarray(planning.get("path", ()), np.float64).reshape(-1, 2)
    origin = report.get("parameters", {}).get("origin", (0.0, 0.0))
    return local + np.asarray(origin, np.float64)[:2]

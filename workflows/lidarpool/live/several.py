"""Several results in one view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..base.errors import LidarpoolError
from ..export.sweeps import Placed, Sweeps
from .point_selection import JoinedPoints
from .view import IN_SENSOR_AXES, View, open_result


def open_results(paths: Sequence[Path]) -> View:
    """Open results of one place as one view, with the scene and the actors of the first.

    Sensors have the names of their results before their own.

    Raises
    ------
    LidarpoolError
        As of `open_result`, or if points are in the axes of their sensors.
    """
    first, *others = views = [open_result(path) for path in paths]
    if not others:
        return first
    for path, view in zip(paths, views, strict=True):
        if view.note == IN_SENSOR_AXES:
            raise LidarpoolError(
                f"{path} has points in the axes of its sensors, which fit no other result: show it "
                "alone, or run it again with cloud.coordinates: world."
            )
    names = [path.resolve().name for path in paths]
    if len({*names}) < len(names):
        names = [str(path) for path in paths]
    scans = [0 if view.sweeps is None else int(view.sweeps.scans[-1]) for view in views]
    sensors = [len(view.sensors) for view in views]
    firsts = {"scan": np.cumsum([0, *scans]).tolist(), "sensor": np.cumsum([0, *sensors]).tolist()}
    ways = [
        replace(
            way,
            positions=way.positions + (view.origin - first.origin),
            name=f"{name} {way.name}".rstrip(),
        )
        for name, view in zip(names, views, strict=True)
        for way in view.sensors
    ]
    return View(
        JoinedPoints([view.points for view in views], firsts),
        first.pictured and replace(first.pictured, sensors=ways),
        _joined(views, firsts, tuple(way.name for way in ways)),
        " ".join(view.note for view in views).strip(),
        f"{' and '.join(names)} - lidarpool",
        names,
    )


def _joined(
    views: Sequence[View], firsts: Mapping[str, Sequence[int]], sensors: tuple[str, ...]
) -> Sweeps | None:
    """Sweeps of all results, with what the first knows of objects and actors; None if of none."""
    timed = [(number, view.sweeps) for number, view in enumerate(views) if view.sweeps is not None]
    if not timed:
        return None
    known = [sweeps for _, sweeps in timed]
    scans = [sweeps.scans[:-1] + firsts["scan"][number] for number, sweeps in timed]
    placed = [
        Placed(
            np.concatenate([of.positions for of in each]),
            np.concatenate([of.quaternions for of in each]),
        )
        for each in ([sweeps.pose for sweeps in known], [sweeps.mounts for sweeps in known])
    ]
    return replace(
        known[0],
        scans=np.append(np.concatenate(scans), firsts["scan"][-1]),
        begins_ns=np.concatenate([sweeps.begins_ns for sweeps in known]),
        ends_ns=np.concatenate([sweeps.ends_ns for sweeps in known]),
        sensor=np.concatenate([of.sensor + firsts["sensor"][k] for k, of in timed]),
        pose=placed[0],
        mounts=placed[1],
        sensors=sensors,
    )

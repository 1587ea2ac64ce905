"""E57, a scan for each sweep, through pye57."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pye57
from pye57 import libe57

from ..base.fingerprint import fingerprint
from ..columns.cloud import Cloud, CloudLike
from ..columns.table import COLOURS
from .sweeps import Sweeps


def write_e57(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write each sweep that has points, in the sensor's axes: pose, intensity, colours."""
    content = fingerprint(sweeps, len(cloud), np.asarray(cloud.bounds))
    with _named_by(content), pye57.E57(str(path), mode="w") as file:
        try:
            for sweep, points in enumerate(sweeps.points(cloud)):
                if len(points):
                    _write_scan(file, sweeps, sweep, points)
            file.close()
        except libe57.E57Exception as error:
            del file.image_file  # closing it would fail again
            raise OSError(f"{str(error).splitlines()[0]}; the disk may be full") from error


def _write_scan(file: Any, sweeps: Sweeps, sweep: int, points: Cloud) -> None:
    x, y, z = sweeps.compensated(sweep, points).T.copy()
    data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    if "intensity" in points.columns:
        data["intensity"] = points["intensity"]
    if {*COLOURS} <= {*points.columns}:
        data |= {f"color{name.capitalize()}": points[name] for name in COLOURS}
    turn = np.roll(sweeps.pose.quaternions[sweep], 1)  # w first
    place = sweeps.pose.positions[sweep]
    file.write_scan_raw(
        data, name=f"sweep {sweep}, motion compensated", rotation=turn, translation=place
    )


@contextmanager
def _named_by(content: str) -> Iterator[None]:
    """Derive the GUIDs of a file and its scans from a text: pye57 draws random ones."""
    numbers, drawn = count(), pye57.e57.uuid
    pye57.e57.uuid = SimpleNamespace(
        uuid4=lambda: uuid.uuid5(uuid.NAMESPACE_OID, f"{content} {next(numbers)}")
    )
    try:
        yield
    finally:
        pye57.e57.uuid = drawn

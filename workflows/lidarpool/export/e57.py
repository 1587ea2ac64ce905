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
from ..columns.cloud import CloudLike
from .sweeps import Sweeps


def write_e57(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write each sweep that has points, in the sensor's axes, with its pose and intensity."""
    content = fingerprint(sweeps, len(cloud), np.asarray(cloud.bounds))
    with _named_by(content), pye57.E57(str(path), mode="w") as file:
        try:
            _write(file, cloud, sweeps)
            file.close()
        except libe57.E57Exception as error:
            del file.image_file  # closing it would fail again
            raise OSError(f"{str(error).splitlines()[0]}; the disk may be full") from error


def _write(file: Any, cloud: CloudLike, sweeps: Sweeps) -> None:
    for sweep, points in enumerate(sweeps.points(cloud)):
        if not len(points):
            continue
        inside = sweeps.in_sensor(sweep, points.positions)
        data = {
            f"cartesian{axis}": column for axis, column in zip("XYZ", inside.T.copy(), strict=True)
        }
        if "intensity" in points.columns:
            data["intensity"] = points["intensity"]
        x, y, z, w = sweeps.pose.quaternions[sweep]
        file.write_scan_raw(
            data,
            name=f"sweep {sweep}",
            rotation=np.array([w, x, y, z]),
            translation=sweeps.pose.positions[sweep],
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

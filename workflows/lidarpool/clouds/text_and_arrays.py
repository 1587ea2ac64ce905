"""Clouds in text and in arrays, which are read at once: .xyz .txt .asc .csv .pts .ptx .npy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsim.base.extras import reading
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.ptx import read_ptx

from .cloud_format import CloudFormat
from .file_points import FilePoints, of_scans
from .recording import METERS, NoiseFilter, Read, Recording, RecordingSource


class TextFormats(CloudFormat):
    """Text files and NumPy arrays of points, which can only be read."""


def open_file(source: RecordingSource) -> Recording:
    """Open the scans of a .ptx, each in the frame of its scanner, or a cloud that is read at once.

    A chosen unit replaces the units that the header of a cloud names. Of several clouds in a file,
    the columns that all have are read.
    """
    if source.path.suffix.lower() == ".ptx":
        return _open_ptx(source)

    def read(_: int) -> Read:
        scans = SCAN_READERS[source.path.suffix.lower()](source.path)
        # Clouds without points have no columns.
        scans = [scan for scan in scans if len(scan.positions)] or scans
        units_m = METERS if source.unit is not None else scans[0].units_m or METERS
        shared = set.intersection(*(set(scan.columns) for scan in scans))
        columns = {
            column: np.concatenate([scan.columns[column] for scan in scans])
            for column in scans[0].columns
            if column in shared
        }
        return np.concatenate([scan.positions for scan in scans]) * units_m, columns, None

    return source.recording(
        1, read, is_cloud=True, meters=source.chosen_meters(), noise_filter=NoiseFilter()
    )


def _open_ptx(source: RecordingSource) -> Recording:
    with reading(source.name):
        scans = read_ptx(source.path)

    def read(number: int) -> Read:
        scan = scans[number]
        return scan.positions, scan.columns, scan.pose

    stations = [""] * len(scans)
    return source.recording(len(scans), read, meters=source.chosen_meters(), stations=stations)


def read_points(path: Path) -> FilePoints:
    """Read the points of a file, with the scanners' positions if it has them."""
    return of_scans(SCAN_READERS[path.suffix.lower()](path))

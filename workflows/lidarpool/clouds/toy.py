"""Toy: lines of x, y, z and intensity."""

from pathlib import Path

import numpy as np

from lidarsim.columns.cloud import CloudLike
from lidarsim.sweeps.sweeps import Sweeps

from .file_points import FilePoints
from .recording import Read, Recording, RecordingSource


def write_toy(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write a line for each point."""
    with path.open("wb") as file:
        for chunk in cloud.chunks():
            np.savetxt(file, np.column_stack([chunk.positions, chunk["intensity"]]))


def open_file(source: RecordingSource) -> Recording:
    """Open the points as a cloud."""

    def read(_: int) -> Read:
        x, y, z, intensity = np.loadtxt(source.path, ndmin=2).T
        return np.stack([x, y, z], axis=1), {"intensity": intensity}, None

    return source.recording(1, read, is_cloud=True, metres=source.chosen_metres())


def read_points(path: Path) -> FilePoints:
    """Read the points for a scene."""
    x, y, z, intensity = np.loadtxt(path, ndmin=2).T
    return FilePoints(np.stack([x, y, z], axis=1), {"intensity": intensity})

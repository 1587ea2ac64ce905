"""Writes and reads a cloud as a folder of NumPy files, one for each sweep."""

import io

import numpy as np

from lidarpool.plugins import Cloud, FormatRow, Pieces, Recording, RecordingSource

ROW = FormatRow(
    "npy",  # folder in a result
    "lidar_example.clouds",
    "SweepFiles",
    in_pieces=True,
    needs=("scan",),
    holds=(),
    inside=r"\d+\.npy",
    folders=("[0-9]*.npy",),  # that open_folder reads
)


class SweepFiles(Pieces):
    """The file of each sweep; workers of a cluster write them."""

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return {name: content} of a sweep: its positions, float32 (n, 3), metres."""
        file = io.BytesIO()
        np.save(file, points.positions.astype(np.float32))
        return {f"{number:06}.npy": file.getvalue()}, None


def open_folder(source: RecordingSource) -> Recording:
    """Open the files of a folder as sweeps, whose positions are in the world."""
    files = sorted(source.path.glob("[0-9]*.npy"))
    return source.recording(len(files), lambda number: (np.load(files[number]), {}, np.eye(4)))

"""Writer and reader for point clouds as folders of NumPy files, one per sweep."""

import io

import numpy as np

from lidarpool.plugins import Cloud, FormatRow, Pieces, Recording, RecordingSource

ROW = FormatRow(
    "npy",  # name of the folder in a result
    "lidar_example.clouds",
    "SweepFiles",
    in_pieces=True,
    needs=("scan",),
    holds=(),
    inside=r"\d+\.npy",
    folders=("[0-9]*.npy",),  # files that open_folder reads
)


class SweepFiles(Pieces):
    """Write one file per sweep, on the workers of a cluster."""

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return {name: content} for a sweep: its positions in meters, float32 (n, 3)."""
        file = io.BytesIO()
        np.save(file, points.positions.astype(np.float32))
        return {f"{number:06}.npy": file.getvalue()}, None


def open_folder(source: RecordingSource) -> Recording:
    """Open the files in a folder as sweeps, with positions in world coordinates."""
    files = sorted(source.path.glob("[0-9]*.npy"))
    return source.recording(len(files), lambda number: (np.load(files[number]), {}, np.eye(4)))

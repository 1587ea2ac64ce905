"""Point clouds as folders of NumPy files, one per sweep."""

import io

import numpy as np

from lidarpool.plugins import Cloud, FormatRow, MultiFileFormat, Recording, RecordingSource, Sweep


class SweepFolder(MultiFileFormat):
    """A folder with one file per sweep, which the workers of a cluster write."""

    row = FormatRow(
        "npy",  # name of the folder in a result
        folders=("[0-9]*.npy",),  # files in folders that the format opens
    )
    by_sweep = True
    other_columns = False
    file_pattern = r"\d+\.npy"

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return {name: content} for a sweep: its positions in meters, float32 (n, 3)."""
        file = io.BytesIO()
        np.save(file, points.positions.astype(np.float32))
        return {f"{number:06}.npy": file.getvalue()}, None

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open the files in a folder as sweeps, with positions in world coordinates."""
        files = sorted(source.path.glob("[0-9]*.npy"))
        return source.recording(
            len(files), lambda number: Sweep(np.load(files[number]), pose=np.eye(4))
        )

"""Point clouds as folders of NumPy files, one per sweep."""

import io

import numpy as np

from lidarpool.plugins import Cloud, FileRecording, FormatRow, MultiFileFormat, RecordingRef, Sweep


class SweepFolder(MultiFileFormat):
    """A folder with one file per sweep, which the workers of a cluster write."""

    row = FormatRow("npy", folders=("[0-9]*.npy",))  # folder in a result, and files to open
    by_sweep = True
    other_columns = False
    file_pattern = r"\d+\.npy"

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return {name: content} for a sweep: its positions in meters, float32 (n, 3)."""
        file = io.BytesIO()
        np.save(file, points.positions.astype(np.float32))
        return {f"{number:06}.npy": file.getvalue()}, None

    @classmethod
    def open(cls, ref: RecordingRef) -> FileRecording:
        """Open the files in a folder as sweeps."""
        return FolderRecording(ref.info(), sorted(ref.path.glob("[0-9]*.npy")))


class FolderRecording(FileRecording):
    """Sweeps with positions in world coordinates, each in a file."""

    def load(self, number: int) -> Sweep:
        """Read a sweep."""
        return Sweep(np.load(self.paths[number]), pose=np.eye(4))

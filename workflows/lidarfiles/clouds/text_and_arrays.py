"""Read text files (.xyz, .txt, .asc, .csv, .pts and .ptx) and NumPy arrays (.npy)."""

from __future__ import annotations

from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.ptx import read_ptx

from .cloud_format import CloudFormat
from .recording import Recording, RecordingSource


class TextFormats(CloudFormat):
    """Text files and NumPy arrays of points, which can be read but not written."""

    title = "text"
    for_scenes = True

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open the scans in a .ptx file, or a cloud in another format.

        A cloud is read as a whole. Scans are in their scanner frames. If the user chose a unit, it
        overrides the units in the header of a cloud. If a file contains several clouds, only their
        common columns are read.
        """
        read_scans = SCAN_READERS[source.path.suffix.lower()]
        if read_scans is read_ptx or source.as_stored:
            with reading(source.name):
                scans = read_scans(source.path)
            return source.recording(
                len(scans),
                scans.__getitem__,
                point_count=sum(map(len, scans)) if source.as_stored else None,
                meters=source.chosen_meters(),
                stations=[""] * len(scans),
            )

        def read(_: int) -> Sweep:
            scans = read_scans(source.path)
            # Clouds without points have no columns.
            scans = [scan for scan in scans if len(scan)] or scans
            sweep = Sweep.concatenate(scans, only_shared=True)
            if source.unit is None and scans[0].units_m is not None:
                sweep = sweep.replace(points=sweep.points * scans[0].units_m)
            return sweep

        return source.recording(1, read, is_cloud=True, meters=source.chosen_meters())

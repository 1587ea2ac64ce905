"""Clouds in text and in arrays, which are read at once: .xyz .txt .asc .csv .pts .ptx .npy."""

from __future__ import annotations

from lidarsim.base.extras import reading
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.ptx import read_ptx

from .cloud_format import CloudFormat
from .recording import Recording, RecordingSource


class TextFormats(CloudFormat):
    """Text files and NumPy arrays of points, which can only be read."""

    title = "text"
    for_scenes = True

    @classmethod
    def open(cls, source: RecordingSource) -> Recording:
        """Open the scans of a .ptx, each in its scanner frame, or a cloud that is read at once.

        A chosen unit replaces the units that the header of a cloud states. If a file contains
        several clouds, the columns that they share are read.
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
            sweep = Sweep.joined(scans, only_shared=True)
            if source.unit is None and scans[0].units_m is not None:
                sweep = sweep.replace(points=sweep.points * scans[0].units_m)
            return sweep

        return source.recording(1, read, is_cloud=True, meters=source.chosen_meters())

"""Read text files (.xyz, .txt, .asc, .csv, .pts and .ptx) and NumPy arrays (.npy)."""

from __future__ import annotations

from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.ptx import read_ptx

from .cloud_format import CloudFormat
from .recording import PointCloud, Recording, SweepsInMemory
from .recording_ref import RecordingRef


class TextFormats(CloudFormat):
    """Text files and NumPy arrays of points, which can be read but not written."""

    title = "text"
    for_scenes = True

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording | PointCloud:
        """Open the scans in a .ptx file, or a cloud in another format.

        A cloud is read as a whole. Scans are in their scanner frames. If the user chose a unit, it
        overrides the units in the header of a cloud. If a file contains several clouds, only their
        common columns are read.
        """
        read_scans = SCAN_READERS[ref.path.suffix.lower()]
        if read_scans is not read_ptx and not ref.as_stored:
            return _TextCloud(ref)
        with reading(ref.name):
            scans = read_scans(ref.path)
        info = ref.info(
            point_count=sum(map(len, scans)) if ref.as_stored else None,
            meters=ref.chosen_meters(),
            stations=("",) * len(scans),
        )
        return SweepsInMemory(info, scans)


class _TextCloud(PointCloud):
    """A file that is read as a whole."""

    def __init__(self, ref: RecordingRef) -> None:
        super().__init__(ref.info(meters=ref.chosen_meters()))
        self._ref = ref

    def __len__(self) -> int:
        return 1

    def load(self, number: int) -> Sweep:
        path = self._ref.path
        scans = SCAN_READERS[path.suffix.lower()](path)
        # Clouds without points have no columns.
        scans = [scan for scan in scans if len(scan)] or scans
        sweep = Sweep.concatenate(scans, only_shared=True)
        if self._ref.unit is None and scans[0].units_m is not None:
            sweep = sweep.replace(points=sweep.points * scans[0].units_m)
        return sweep

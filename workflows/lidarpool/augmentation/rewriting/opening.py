"""Select the rewriter for the format of a recording."""

from __future__ import annotations

from pathlib import Path

from lidarsim.errors import LidarError

from ...clouds.format_table import format_of_path
from ...clouds.kitti import KITTI
from ...clouds.nuscenes import NuScenes
from ...clouds.pcd import PCD
from ...clouds.recording import Recording, RecordingSource
from ...clouds.ros.bags import Rosbag2
from ...datasets.dataset import INDEX_FILE
from .bag_rewriter import BagRewriter
from .kitti_rewriter import KittiRewriter
from .nuscenes_rewriter import NuScenesRewriter
from .pcd_rewriter import PCDRewriter
from .rewriter import Rewriter

_FORMATS = "KITTI, nuScenes, PCD, MCAP and rosbag2"
_REMEDY = "Choose another format with `--format`, for example `--format mcap`."


def open_rewriter(source: str | Path, recording: Recording, sensor: str | None = None) -> Rewriter:
    """Return the rewriter that writes an augmented copy of a recording in its own format.

    Parameters
    ----------
    source
        File or folder of the recording.
    recording
        The recording, opened with `keep_noise=True`.
    sensor
        Sensor or topic that the user chose, or None if there is only one.

    Raises
    ------
    LidarError
        If recordings in this format cannot be rewritten.
    """
    path = Path(source)
    opened = RecordingSource(path, str(source), sensor, recording.intensity_column)
    if (path / INDEX_FILE).exists():
        raise LidarError(
            f"{source} is a data set of lidarpool, whose jobs cannot be rewritten. {_REMEDY}"
        )
    cloud_format = format_of_path(path, str(source))
    if cloud_format is KITTI:
        return KittiRewriter(opened, recording)
    if cloud_format is PCD:
        return PCDRewriter(opened, recording)
    if cloud_format is NuScenes:
        return NuScenesRewriter(opened, recording)
    if cloud_format is not None and issubclass(cloud_format, Rosbag2):
        return BagRewriter(opened, recording)
    kind = cloud_format.title if cloud_format is not None and cloud_format.title else "this format"
    raise LidarError(
        f"{source} cannot be augmented in its own format. Recordings can be rewritten in the "
        f"formats {_FORMATS}, but not in {kind}. {_REMEDY}"
    )

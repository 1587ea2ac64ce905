"""Select the rewriter for the format of a recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from lidarfiles.clouds.format_table import format_of_path
from lidarfiles.clouds.kitti import KITTI
from lidarfiles.clouds.nuscenes import NuScenes
from lidarfiles.clouds.pcd import PCD
from lidarfiles.clouds.recording import PointCloud, Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.ros.bags import Rosbag2
from lidarfiles.datasets.dataset import INDEX_FILE
from lidarsim.errors import LidarError
from lidarsim.words import join_alternatives

from .bag_rewriter import BagRewriter
from .kitti_rewriter import KittiRewriter
from .nuscenes_rewriter import NuScenesRewriter
from .pcd_rewriter import PCDRewriter
from .rewriter import Rewriter

_MAX_LISTED = 3  # recordings in a folder that messages list
_FORMATS = "KITTI, nuScenes, PCD, MCAP and rosbag2"
_REMEDY = "Choose another format with `--format`, for example `--format mcap`."


def open_rewriter(ref: RecordingRef, recording: Recording) -> Rewriter:
    """Return the rewriter that writes an augmented copy of a recording in its own format.

    Parameters
    ----------
    ref
        Reference to the recording, whose path is valid in this process.
    recording
        The recording, opened with `keep_noise=True`.

    Raises
    ------
    LidarError
        If recordings in this format cannot be rewritten.
    """
    path = ref.path
    if (path / INDEX_FILE).exists():
        raise LidarError(
            f"{ref.name} is a data set of lidarpool, whose jobs cannot be rewritten. {_REMEDY}"
        )
    cloud_format = format_of_path(path, ref.name)
    if cloud_format is KITTI:
        return KittiRewriter(ref, recording)
    if cloud_format is PCD:
        return PCDRewriter(ref, recording)
    if cloud_format is NuScenes:
        return NuScenesRewriter(ref, recording)
    if cloud_format is not None and issubclass(cloud_format, Rosbag2):
        return BagRewriter(ref, recording)
    kind = cloud_format.title if cloud_format is not None and cloud_format.title else "this format"
    if contained := _rewritable_entries(path):
        raise LidarError(f"{ref.name} cannot be rewritten in {kind}. {_pass_one_of(contained)}")
    raise LidarError(
        f"{ref.name} cannot be augmented in its own format. Recordings can be rewritten in the "
        f"formats {_FORMATS}, but not in {kind}. {_REMEDY}"
    )


def check_sweeps(source: str | Path, recording: Recording | PointCloud) -> None:
    """Raise LidarError if a recording contains no sweeps.

    The message names recordings in the folder `source` that may contain some.
    """
    if not isinstance(recording, PointCloud) and len(recording):
        return
    contained = _rewritable_entries(Path(source))
    remedy = _pass_one_of(contained) if contained else "Use a recording that consists of sweeps."
    raise LidarError(f"{source} contains no sweeps. {remedy}")


def _rewritable_entries(folder: Path) -> list[Path]:
    """Return the files and folders in a folder that can be augmented in their own format."""
    if not folder.is_dir():
        return []
    return [path for path in sorted(folder.iterdir()) if _is_rewritable(path)]


def _is_rewritable(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    with suppress(LidarError, OSError):  # a package is missing, or the folder cannot be read
        cloud_format = format_of_path(path, str(path))
        return cloud_format is not None and issubclass(
            cloud_format, KITTI | PCD | NuScenes | Rosbag2
        )
    return False


def _pass_one_of(paths: list[Path]) -> str:
    return f"Pass {join_alternatives([str(path) for path in paths[:_MAX_LISTED]])} instead."

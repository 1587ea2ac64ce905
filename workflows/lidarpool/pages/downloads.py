"""Point cloud formats that can be downloaded from the pages of results."""

from __future__ import annotations

from lidarfiles.clouds.writing import ExportSpec, save_cloud
from lidarview.viewer.view import DownloadFormats

DOWNLOADS = ("ply", "las", "parquet")  # formats that a page offers


def downloads() -> DownloadFormats:
    """Return the download formats whose required packages are installed, with their writer."""
    return DownloadFormats(
        [name for name in DOWNLOADS if ExportSpec(name).is_installed], save_cloud
    )

"""Files of the points that a page shows, for its browser to keep."""

from __future__ import annotations

import zipfile
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..base.arrays import Bytes, Ints
from ..columns.cloud import Cloud
from ..columns.ply_format import AXES
from ..columns.table import TABLE
from ..export.formats import save_cloud
from ..export.sweeps import Sweeps
from .point_selection import Points

FORMATS = ("ply", "las", "parquet")


def written(points: Points, rows: Ints, sweeps: Sweeps | None, format: str) -> tuple[str, Bytes]:  # noqa: A002
    """Write some rows of points in one of `FORMATS`.

    Returns
    -------
    Name of a file, and its content, (bytes,). Several files come as a ZIP archive.

    Raises
    ------
    KeyError
        If there is no such format.
    LidarpoolError
        If a package for it is missing, or it cannot be written.
    """
    if format not in FORMATS:
        raise KeyError(format)
    columns = {column.name: points.values(column.name, rows) for column in points.table}
    places = np.stack([points.values(axis, rows) for axis in AXES], axis=1)
    own = tuple(column for column in points.table if column.name not in TABLE)
    cloud = Cloud(places, columns, own, None if sweeps is None else lambda: sweeps)
    with TemporaryDirectory(prefix="lidarpool-") as folder:
        made = Path(folder) / f"cloud.{format}"
        save_cloud(cloud, made)
        files = sorted(made.iterdir()) if made.is_dir() else [made]
        if len(files) == 1:
            return made.name, np.fromfile(files[0], np.uint8)
        packed = BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for file in files:
                archive.write(file, file.relative_to(folder))
        return f"{made.name}.zip", np.frombuffer(packed.getbuffer(), np.uint8)

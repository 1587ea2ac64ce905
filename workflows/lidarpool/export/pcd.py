"""PCD, a file for each sweep, through pypcd4."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pypcd4.pypcd4 import Encoding, PointCloud

from ..columns.cloud import Cloud, CloudLike
from .sweeps import Sweeps
from .threads import write_each


def write_pcd(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write one file for each sweep, with all columns.

    Points are in the sensor's axes as they were when the sweep began; VIEWPOINT says where those
    were in the world. Times are seconds since the sweep began, as float32.
    """
    path.mkdir()

    def write(sweep: int, points: Cloud) -> None:
        inside = sweeps.in_sensor(sweep, points.positions)
        names, arrays = ["x", "y", "z"], list(inside.T.astype(np.float32))
        for column in cloud.table:
            values = points[column.name]
            if column.name == "time":
                values = ((values - sweeps.begins_ns[sweep]) / 1e9).astype(np.float32)
            elif values.dtype.kind in "iu" and values.dtype.itemsize == 8:
                values = values.astype(np.float64)
            names.append(column.in_files)
            arrays.append(values)
        file = PointCloud.from_points(arrays, names, [array.dtype for array in arrays])
        x, y, z, w = sweeps.pose.quaternions[sweep].tolist()
        place = sweeps.pose.positions[sweep].tolist()
        file.metadata.viewpoint = (*place, w, x, y, z)
        file.save(path / f"{sweep:06}.pcd", Encoding.BINARY)

    write_each(write, sweeps.points(cloud))

"""PCD, a file for each sweep, through pypcd4."""

from __future__ import annotations

import io

import numpy as np
from pypcd4.pypcd4 import Encoding, PointCloud

from ..columns.cloud import Cloud
from ..columns.table import COLOURS, NORMAL
from ..scene.colours import as_float
from . import pieces


class Pieces(pieces.Pieces):
    """One file for each sweep, with all columns; red, green and blue are one field `rgb`.

    Normals and origins of rays are in the axes of the points; normals have PCL's names.

    Points are in the sensor's axes as they were when the sweep began; VIEWPOINT says where those
    were in the world. Times are seconds since the sweep began, as float32.
    """

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return the file of a sweep."""
        sweeps = self.sweeps
        inside = sweeps.in_sensor(number, points.positions)
        names, arrays = ["x", "y", "z"], list(inside.T.astype(np.float32))
        columns = sweeps.columns_in_sensor(number, points)
        coloured = {*COLOURS} <= {*columns}
        if coloured:
            names.append("rgb")
            arrays.append(as_float(*(points[name] for name in COLOURS)))
        for column in self.cloud.table:
            if coloured and column.name in COLOURS:
                continue
            values = columns[column.name]
            if column.name == "time":
                values = ((values - sweeps.begins_ns[number]) / 1e9).astype(np.float32)
            elif values.dtype.kind in "iu" and values.dtype.itemsize == 8:
                values = values.astype(np.float64)
            names.append(column.name if column.name in NORMAL else column.in_files)
            arrays.append(values)
        file = PointCloud.from_points(arrays, names, [array.dtype for array in arrays])
        x, y, z, w = sweeps.pose.quaternions[number].tolist()
        place = sweeps.pose.positions[number].tolist()
        file.metadata.viewpoint = (*place, w, x, y, z)
        memory = io.BytesIO()
        file.save(memory, Encoding.BINARY)
        return {f"{number:06}.pcd": memory.getvalue()}, None

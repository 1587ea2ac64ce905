"""PCD, a file for each sweep, through pypcd4."""

from __future__ import annotations

import io

import numpy as np
from pypcd4.pypcd4 import Encoding, PointCloud

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import COLOURS, NORMAL
from lidarsim.scene.colours import as_float
from lidarsim.sweeps.sweeps import AS_FIRED, COMPENSATED

from . import pieces


class Pieces(pieces.Pieces):
    """One file for each sweep, with all columns; red, green and blue are one field `rgb`.

    With times, points are in the sensor's axes at their own firing, and times are seconds since the
    sweep began, as float32. Compensated points, and those of a cloud without times, are in the
    sensor's axes at the start of the sweep, and have no times. A comment says which. VIEWPOINT is
    the pose of the sensor in the world at the start of the sweep. Normals and origins of rays are
    in the axes of the points; normals have PCL's names.
    """

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return the file of a sweep."""
        sweeps = self.sweeps
        as_fired = "time" in points.columns and not self.compensated
        place_points = sweeps.as_fired if as_fired else sweeps.compensated
        inside = place_points(number, points)
        names = ["x", "y", "z"]
        arrays = list(inside.T.astype(np.float32))
        columns_of = sweeps.columns_as_fired if as_fired else sweeps.columns_compensated
        columns = columns_of(number, points)
        coloured = {*COLOURS} <= {*columns}
        if coloured:
            names.append("rgb")
            arrays.append(as_float(*(points[name] for name in COLOURS)))
        for column in self.cloud.table:
            if (coloured and column.name in COLOURS) or (column.name == "time" and not as_fired):
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
        comment = f"# {AS_FIRED if as_fired else COMPENSATED}\n".encode()
        return {f"{number:06}.pcd": comment + memory.getvalue()}, None

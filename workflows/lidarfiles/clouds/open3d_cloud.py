"""Conversion of clouds to Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud

from ..open3d_access.open3d_module import load_open3d


def to_open3d(cloud: Cloud) -> Any:
    """Convert a cloud to an `open3d.t.geometry.PointCloud` with all columns.

    Attributes have the names that the columns have in files.

    Raises
    ------
    LidarError
        If Open3D is not installed, or if a system library that it requires is missing.
    """
    o3d = load_open3d()
    positions = np.ascontiguousarray(cloud.positions)
    point_cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(positions))
    for column in cloud.table:
        values = np.ascontiguousarray(cloud[column.name])[:, None]
        point_cloud.point[column.in_files] = o3d.core.Tensor(values)
    return point_cloud

"""Conversion of stored points to Dask DataFrames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lidarfiles.parts.parts import StoredCloud, read_part
from lidarsim.columns.cloud import require_packages
from lidarsim.schema.checks import check_type


def to_dask(points: StoredCloud) -> Any:
    """Return the stored points as a Dask DataFrame with all columns and one partition per part.

    The workers that compute the DataFrame must be able to read the parts. Keep a reference to the
    result until the DataFrame has been computed.

    Parameters
    ----------
    points
        Stored points of a result, such as `Result.points`.

    Returns
    -------
    dask.dataframe.DataFrame
        DataFrame with one row per point.

    Raises
    ------
    LidarError
        If pandas or pyarrow is not installed.
    """
    check_type("points", points, StoredCloud)
    require_packages("pandas", "pyarrow")
    import dask.dataframe as dd

    # The template omits the scene, which would be sent to all workers, and the list of parts.
    template = replace(points, names=(), firsts=(), rows=(), cells=None, keeper=None, sweeps=None)
    filled = [name for name, rows in zip(points.names, points.rows, strict=True) if rows]
    empty = template.load().to_dataframe()
    if not filled:
        return dd.from_pandas(empty, npartitions=1)
    return dd.from_map(_read_frame, filled, points=template, meta=empty)


def _read_frame(name: str, points: StoredCloud) -> Any:
    return points.cloud_of(read_part(points.storage, name)).to_dataframe()

"""Points of a result as Dask's dataframes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lidarsim.columns.cloud import require_packages
from lidarsim.schema.checks import check_type

from ..columns.parts import StoredCloud, read_part


def to_dask(points: StoredCloud) -> Any:
    """Return a Dask DataFrame with all columns of the stored points, and one partition per part.

    The workers that compute the DataFrame must be able to read the parts. Keep a reference to the
    result until the DataFrame has been computed.

    Parameters
    ----------
    points
        Stored points of a result, `Result.points`.

    Returns
    -------
    The Dask DataFrame.

    Raises
    ------
    LidarError
        If pandas or pyarrow is not installed.
    """
    check_type("points", points, StoredCloud)
    require_packages("pandas", "pyarrow")
    import dask.dataframe as dd

    # Without the scene, which would go to all workers, and without parts.
    template = replace(points, names=(), firsts=(), rows=(), cells=None, keeper=None, sweeps=None)
    filled = [name for name, rows in zip(points.names, points.rows, strict=True) if rows]
    empty = template.load().to_dataframe()
    if not filled:
        return dd.from_pandas(empty, npartitions=1)
    return dd.from_map(_frame_of_part, filled, points=template, meta=empty)


def _frame_of_part(name: str, points: StoredCloud) -> Any:
    """Return a pandas DataFrame of a part."""
    return points.cloud_of(read_part(points.storage, name)).to_dataframe()

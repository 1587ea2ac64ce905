"""Point clouds in memory."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from html import escape
from importlib import import_module
from importlib.util import find_spec
from textwrap import shorten
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from ..environment.extras import install_command
from ..environment.notebook import html_picture
from ..errors import LidarError
from ..numerics.arrays import AnyArray, AnyFloats
from ..schema.checks import as_array, check_choice, check_fields
from ..schema.value_texts import format_value
from .table import TABLE, Column
from .waveforms import WAVEFORM, Waveforms

CHUNK_POINTS = 1_000_000  # points in memory at a time while a cloud is read sequentially
SHOWN_POINTS = 5


class CloudLike(Protocol):
    """Interface of clouds whose points can be read sequentially in chunks.

    The points can be in memory or in parts.
    """

    def __len__(self) -> int: ...

    @property
    def bounds(self) -> AnyFloats:
        """Minimum and maximum coordinates in meters, with the dtype of the positions.

        The shape is (2, 3).
        """

    @property
    def table(self) -> tuple[Column, ...]:
        """Columns other than the positions, in file order."""

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield clouds of at most `points` consecutive points, starting at row `first`."""

    def row_of(self, scan: int) -> int:
        """Return the row of the first point in a scan.

        The points must be ordered by scan.
        """


class CloudDisplay:
    """Mixin that displays a cloud at the Python prompt and in notebooks."""

    def __repr__(self: CloudLike) -> str:
        names = ", ".join(("x", "y", "z", *(column.name for column in self.table)))
        shown_names = shorten(names, 80, placeholder=" …")
        return f"<{type(self).__name__} of {len(self):,} points: {shown_names}>"

    def _repr_html_(self: CloudLike) -> str:
        """Return an HTML table of the columns and first points, followed by a plot."""
        first = next(self.chunks(SHOWN_POINTS), None)
        values = {} if first is None else first.by_name
        kinds = [array.dtype for array in values.values()]
        rows = (values, kinds, *zip(*values.values(), strict=True))
        cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
        body = "".join(f"<tr>{row}</tr>" for row in cells)
        sides = " × ".join(f"{side:,.2f}" for side in np.ptp(self.bounds, axis=0).tolist())
        caption = f"<caption>{len(self):,} points, {sides} m</caption>"
        return f"<table>{caption}{body}</table>{html_picture(self)}"


@dataclass(frozen=True, eq=False, repr=False)
class Cloud(CloudDisplay):
    """Point cloud of a survey, ordered by scan and ray.

    Read a column with ``cloud["channel"]``, or as an attribute such as ``cloud.scan`` if the class
    has no attribute with that name. Select points with ``cloud[:100]``, ``cloud[mask]`` or
    ``cloud[indices]``. ``np.asarray(cloud)`` returns the positions as a float64 array.

    Parameters
    ----------
    positions
        World coordinates in meters. Shape (n, 3), float32 or float64.
    columns
        Mapping from column names to values of shape (n,). The names are those in
        `lidarsim.columns.table`, or names of custom columns.
    custom_columns
        Descriptions of the columns that are not in `lidarsim.columns.table`.
    sweeps
        Function without arguments that returns the times, poses and sensors of the sweeps, which
        `save_cloud` requires for some formats. Clouds of a `Result`, and clouds that `read_cloud`
        read from a result folder, provide this function. To read the points of single sweeps, use
        `lidarpool.sweeps`.

    Raises
    ------
    LidarError
        If a column and the positions differ in length, a position is not finite, or a value does
        not fit the type of its column.
    """

    positions: AnyFloats
    columns: Mapping[str, AnyArray]
    custom_columns: tuple[Column, ...] = ()
    sweeps: Callable[[], Any] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        positions = np.asarray(self.positions)
        if positions.dtype not in (np.float32, np.float64):
            positions = as_array("positions", self.positions)
        if positions.ndim != 2 or positions.shape[1:] != (3,):
            raise LidarError(
                f"The positions of a cloud must have the shape (n, 3), but have {positions.shape}."
            )
        if not np.isfinite(positions).all():
            raise LidarError("A point of the cloud is NaN or infinite.")
        known_columns = TABLE | {column.name: column for column in self.custom_columns}
        columns = {}
        for name, values in self.columns.items():
            array = np.asarray(values)
            if array.shape != (len(positions),):
                raise LidarError(
                    f"Column {name!r} must have one value for each of the {len(positions)} points, "
                    f"but has the shape {array.shape}."
                )
            columns[name] = _fitting(known_columns[name], array) if name in known_columns else array
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(self.positions)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> AnyArray:
        return np.array(self.positions, np.float64 if dtype is None else dtype, copy=copy)

    def __getitem__(self, key: str | slice | ArrayLike) -> Any:
        if isinstance(key, str):
            try:
                return self.columns[key]
            except KeyError:
                raise KeyError(
                    f"Unknown column {key!r}. The columns are {list(self.columns)}, and x, y and z "
                    "are in `positions`"
                ) from None
        rows = key if isinstance(key, slice) else np.asarray(key, None if np.size(key) else int)
        try:
            positions = self.positions[rows]
        except (IndexError, TypeError):
            positions = np.empty(0)
        if positions.ndim != 2:
            raise LidarError(
                f"A cloud cannot be indexed with {format_value(key)}. Select points with a slice "
                "such as cloud[:100], a mask or a list of row numbers, and a column with its name, "
                "such as cloud['range']."
            )
        columns = {name: array[rows] for name, array in self.columns.items()}
        return Cloud(positions, columns, self.custom_columns, self.sweeps)

    def __getattr__(self, name: str) -> AnyArray:
        columns: Mapping[str, AnyArray] = self.__dict__.get("columns", {})
        if name in columns:
            return columns[name]
        raise AttributeError(f"a cloud has no attribute or column {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"sweeps": None}  # the function would pickle the scene as well

    @property
    def table(self) -> tuple[Column, ...]:
        """Descriptions of all columns except positions and waveforms, in file order."""
        known_columns = TABLE | {column.name: column for column in self.custom_columns}
        return tuple(
            known_columns.get(name) or Column(name, array.dtype.str, "", "")
            for name, array in self.columns.items()
            if name != WAVEFORM
        )

    @property
    def by_name(self) -> dict[str, AnyArray]:
        """Mapping from names to coordinates and columns, without waveforms."""
        axes = dict(zip("xyz", self.positions.T, strict=True))
        return axes | {column.name: self[column.name] for column in self.table}

    @property
    def has_waveforms(self) -> bool:
        """Whether the points have waveforms."""
        return WAVEFORM in self.columns

    @property
    def waveforms(self) -> Waveforms:
        """Recorded waveforms of the points.

        Raises
        ------
        LidarError
            If the survey recorded no waveforms (see `waveform_samples`).
        """
        if not self.has_waveforms:
            raise LidarError(
                "The cloud has no waveforms. Set cloud.waveform_samples in the survey and read "
                "the cloud from its result. Only LAS and LAZ files can store waveforms."
            )
        return Waveforms.from_records(self.columns[WAVEFORM])

    @property
    def bounds(self) -> AnyFloats:
        """Minimum and maximum coordinates in meters.

        The shape is (2, 3). All values are zero if the cloud is empty.
        """
        if not len(self):
            return np.zeros((2, 3), self.positions.dtype)
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    def to_dataframe(self, library: Literal["pandas", "polars"] = "pandas") -> Any:
        """Convert the cloud to a pandas or polars DataFrame.

        The DataFrame contains the coordinates and all columns except waveforms.

        Parameters
        ----------
        library
            Library of the DataFrame.

        Raises
        ------
        LidarError
            If the library is not installed.
        """
        check_choice("library", library, ("pandas", "polars"))
        require_packages(library)
        return import_module(library).DataFrame(self.by_name)

    def head(self, points: int = SHOWN_POINTS) -> Cloud:
        """Return the first points, or the entire cloud if it has fewer points."""
        return self[:points]

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield consecutive slices of the cloud, starting at row `first`.

        Each slice has at most `points` points and is a view of the cloud.
        """
        for start in range(first, len(self), points):
            yield self[start : start + points]

    def row_of(self, scan: int) -> int:
        """Return the row of the first point in a scan.

        The points must be ordered by scan.
        """
        return int(np.searchsorted(self["scan"], scan))

    @classmethod
    def concatenate(cls, clouds: list[Cloud]) -> Cloud:
        """Concatenate one or more clouds with the same columns."""
        first = clouds[0]
        if len(clouds) == 1:
            return first
        columns = {
            name: np.concatenate([part.columns[name] for part in clouds]) for name in first.columns
        }
        positions = np.concatenate([part.positions for part in clouds])
        return cls(positions, columns, first.custom_columns, first.sweeps)


def require_packages(*packages: str) -> None:
    """Raise a LidarError if any of the given packages is not installed."""
    # `find_spec` fails for modules without a spec, such as modules that a program creates itself.
    missing = [
        name for name in packages if sys.modules.get(name) is None and find_spec(name) is None
    ]
    if missing:
        raise LidarError(
            f"Dataframes require {' and '.join(missing)}. Run {install_command(*missing)}."
        )


def _fitting(column: Column, values: ArrayLike) -> AnyArray:
    """Convert values to the dtype of the column.

    Raise LidarError if an integer dtype cannot represent the values.
    """
    array = np.asarray(values)
    dtype = np.dtype(column.dtype)
    converted = array.astype(dtype, copy=False)
    if converted is not array and dtype.kind in "iu" and not np.array_equal(converted, array):
        limits = np.iinfo(dtype)
        raise LidarError(
            f"Column {column.name!r} must contain whole numbers from {limits.min} to {limits.max}, "
            f"but contains {array.min()} to {array.max()}."
        )
    return converted

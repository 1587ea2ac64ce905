"""The point cloud."""

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

from ..base.arrays import AnyArray, AnyFloats
from ..base.errors import LidarError
from ..base.validation import as_array, checked, checked_fields, shown
from .table import TABLE, Column
from .waveforms import WAVEFORM, Waveforms

CHUNK_POINTS = 1_000_000  # points in memory at a time while a cloud is read in order
SHOWN_POINTS = 5


class CloudLike(Protocol):
    """A cloud in memory or in parts, which is read in order, a piece at a time."""

    def __len__(self) -> int: ...

    @property
    def bounds(self) -> AnyFloats:
        """Lowest and highest coordinates, (2, 3), metres, in the positions' type."""

    @property
    def table(self) -> tuple[Column, ...]:
        """The columns beside the positions, in the order of files."""

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, from row `first` on, at most so many at a time."""

    def row_of(self, scan: int) -> int:
        """Row of the first point of a scan, if the points are in the order of scans."""


class Shown:
    """How prompts and notebooks show a cloud."""

    def __repr__(self: CloudLike) -> str:
        names = ", ".join(("x", "y", "z", *(column.name for column in self.table)))
        kept = shorten(names, 80, placeholder=" …")
        return f"<{type(self).__name__} of {len(self):,} points: {kept}>"

    def _repr_html_(self: CloudLike) -> str:
        """Table that notebooks show: columns, their types, the first points."""
        first = next(self.chunks(SHOWN_POINTS), None)
        values = {} if first is None else first.by_name
        kinds = [array.dtype for array in values.values()]
        rows = (values, kinds, *zip(*values.values(), strict=True))
        cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
        body = "".join(f"<tr>{row}</tr>" for row in cells)
        return f"<table><caption>{len(self):,} points</caption>{body}</table>"


@dataclass(frozen=True, eq=False, repr=False)
@checked_fields
class Cloud(Shown):
    """Points of a survey, ordered by scan and ray.

    Read a column as ``cloud["channel"]``, or as ``cloud.scan`` unless an attribute has its name.
    Select points as ``cloud[:100]``, ``cloud[mask]`` or ``cloud[indices]``; ``np.asarray(cloud)``
    is their positions, float64 (n, 3).

    Parameters
    ----------
    positions
        float32 or float64 (n, 3), metres, world coordinates.
    columns
        {name: (n,)}: the other columns, of `lidarsim.columns.table` or your own.
    own
        Descriptions of the columns that are not in the table.
    sweeps
        Returns the sweeps of the survey for `save_cloud`; clouds of a `Result` have it.

    Raises
    ------
    LidarError
        If the lengths differ, a position is not finite, or a value does not fit its column.
    """

    positions: AnyFloats
    columns: Mapping[str, AnyArray]
    own: tuple[Column, ...] = ()
    sweeps: Callable[[], Any] | None = None

    __repr__ = Shown.__repr__  # which `checked_fields` would replace

    def __post_init__(self) -> None:
        positions = np.asarray(self.positions)
        if positions.dtype not in (np.float32, np.float64):
            positions = as_array("positions", self.positions)
        if positions.ndim != 2 or positions.shape[1:] != (3,):
            raise LidarError(f"A cloud needs positions of (n, 3), not {positions.shape}.")
        if not np.isfinite(positions).all():
            raise LidarError("A point of the cloud is NaN or infinite; it cannot be stored.")
        known = TABLE | {column.name: column for column in self.own}
        columns = {}
        for name, values in self.columns.items():
            array = np.asarray(values)
            if array.shape != (len(positions),):
                raise LidarError(
                    f"Column {name!r} has the shape {array.shape}, but there are {len(positions)} "
                    "points: give one value for each point."
                )
            columns[name] = _fitting(known[name], array) if name in known else array
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
                    f"the cloud has no column {key!r}; it has {list(self.columns)}, and x, y and "
                    "z in `positions`"
                ) from None
        rows = key if isinstance(key, slice) else np.asarray(key, None if np.size(key) else int)
        try:
            positions = self.positions[rows]
        except (IndexError, TypeError):
            positions = np.empty(0)
        if positions.ndim != 2:
            raise LidarError(
                f"Points of a cloud of {len(self):,} are a slice, as cloud[:100], a mask, or a "
                f"list of their rows, not {shown(key)}; a column is its name, as cloud['range']."
            )
        columns = {name: array[rows] for name, array in self.columns.items()}
        return Cloud(positions, columns, self.own, self.sweeps)

    def __getattr__(self, name: str) -> AnyArray:
        columns: Mapping[str, AnyArray] = self.__dict__.get("columns", {})
        if name in columns:
            return columns[name]
        raise AttributeError(f"a cloud has no attribute or column {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"sweeps": None}  # the scene would be pickled as well

    @property
    def table(self) -> tuple[Column, ...]:
        """The columns beside the positions, in the order of files."""
        known = TABLE | {column.name: column for column in self.own}
        return tuple(
            known.get(name) or Column(name, array.dtype.str, "", "")
            for name, array in self.columns.items()
            if name != WAVEFORM
        )

    @property
    def by_name(self) -> dict[str, AnyArray]:
        """Coordinates and columns, {name: (n,)}, without waveforms."""
        axes = dict(zip("xyz", self.positions.T, strict=True))
        return axes | {column.name: self[column.name] for column in self.table}

    @property
    def recorded(self) -> bool:
        """Whether its points have waveforms."""
        return WAVEFORM in self.columns

    @property
    def waveforms(self) -> Waveforms:
        """Recorded waveforms of the points.

        LidarError if the survey recorded none: it needs `waveform_samples`.
        """
        if not self.recorded:
            raise LidarError(
                "The cloud has no waveforms: give the survey cloud.waveform_samples, and take the "
                "cloud of its result; of files only LAS and LAZ hold them."
            )
        return Waveforms.of(self.columns[WAVEFORM])

    @property
    def bounds(self) -> AnyFloats:
        """Lowest and highest coordinates, (2, 3), metres; zeros where there are no points."""
        if not len(self):
            return np.zeros((2, 3), self.positions.dtype)
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    @checked
    def to_dataframe(self, library: Literal["pandas", "polars"] = "pandas") -> Any:
        """Return a DataFrame of pandas or polars with all columns.

        Raises
        ------
        LidarError
            If the library is not installed.
        """
        need_packages(library)
        return import_module(library).DataFrame(self.by_name)

    def head(self, points: int = SHOWN_POINTS) -> Cloud:
        """Select the first points, or all if there are fewer."""
        return self[:points]

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, from row `first` on, at most so many at a time, as views."""
        for start in range(first, len(self), points):
            yield self[start : start + points]

    def row_of(self, scan: int) -> int:
        """Row of the first point of a scan, if the points are in the order of scans."""
        return int(np.searchsorted(self["scan"], scan))

    @classmethod
    def joined(cls, parts: list[Cloud]) -> Cloud:
        """Concatenate clouds of the same columns; at least one."""
        first = parts[0]
        if len(parts) == 1:
            return first
        columns = {
            name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns
        }
        positions = np.concatenate([part.positions for part in parts])
        return cls(positions, columns, first.own, first.sweeps)


def need_packages(*packages: str) -> None:
    """Refuse with LidarError what needs packages that are not installed."""
    # A module that a program made itself has no spec.
    missing = [
        name for name in packages if sys.modules.get(name) is None and find_spec(name) is None
    ]
    if missing:
        raise LidarError(
            f"Dataframes need {' and '.join(missing)}: pip install {' '.join(missing)}."
        )


def _fitting(column: Column, values: ArrayLike) -> AnyArray:
    """Convert `values` to the column's type; LidarError if a cast would wrap around."""
    given = np.asarray(values)
    wanted = np.dtype(column.dtype)
    cast = given.astype(wanted, copy=False)
    if cast is not given and wanted.kind in "iu" and not np.array_equal(cast, given):
        limits = np.iinfo(wanted)
        raise LidarError(
            f"{column.name} holds {given.min()} to {given.max()}; it must be whole numbers of "
            f"{limits.min} to {limits.max}."
        )
    return cast

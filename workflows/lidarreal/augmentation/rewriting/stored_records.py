"""Records of a stored sweep, and their values after augmentation.

A record is a structured row that contains all values of a point as the file stores them. Values
that the simulation did not change keep their bytes, because conversions to other units and types
are not always reversible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.columns.column_names import AXES, STRENGTHS, standard_names
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints, Records
from lidarsim.scene.files.stated_system import Meters

from ..augmented_sweep import AugmentedSweep
from .organized_cells import assign_cells

# Fields with the strength of a return or of the ambient light, in lower case.
_STRENGTH_FIELDS = {
    *STRENGTHS, "ambient", "ambient_light", "amplitude", "energy", "i", "near_ir", "noise",
    "reflectance", "signal",
}  # fmt: skip
_RANGE_FIELDS = {"range", "distance"}  # fields with ranges in any unit, in lower case
_MAX_UNIT_ERROR = 0.05  # relative deviation of a range unit from a power of ten


@dataclass(frozen=True, eq=False)
class StoredRecords:
    """Records of a stored sweep, with the same points as read from the recording.

    Attributes
    ----------
    records
        (n,): structured array with one field per value, in the order of the file.
    recorded
        The n points of the same sweep with standard column names, in meters.
    meters
        Units of x, y and z in meters.
    intensity_column
        Column that was chosen as intensity, or None.
    """

    records: Records
    recorded: Sweep
    meters: Meters = (1.0, 1.0, 1.0)
    intensity_column: str | None = None

    def __post_init__(self) -> None:
        if len(self.records) != len(self.recorded):
            raise LidarError(
                f"The sweep has {len(self.records):,} stored points, but {len(self.recorded):,} "
                "points were read. Open the recording with `keep_noise=True`."
            )

    def augment(self, augmented: AugmentedSweep) -> Records:
        """Return the records of the augmented points.

        Each point starts with the record of its template. Positions and columns that differ from
        the recording are overwritten. Ranges of moved and added points are recomputed. Strengths of
        added points that were not simulated are 0.
        """
        template = np.asarray(augmented.template, np.intp)
        rows = _take(self.records, template)
        points = np.asarray(augmented.sweep.points, np.float64)
        before = np.asarray(self.recorded.points, np.float64)[template]
        is_added = ~np.asarray(augmented.is_recorded, bool)
        is_moved = _differs(points, before).any(axis=1) | is_added
        axes, columns = self._field_names()
        if "intensity" not in columns and "intensity" in augmented.sweep.columns:
            # Without an intensity, the reflectivity takes its place (see `Sweep.intensity`).
            columns = {STRENGTHS[0] if c == STRENGTHS[1] else c: n for c, n in columns.items()}
        for axis, unit in enumerate(self.meters):
            _store(rows, axes[AXES[axis]], is_moved, points[:, axis] / unit)
        for column, name in columns.items():
            self._store_column(rows, column, name, augmented, is_added)
        for name in columns.values():
            if name.lower() in _RANGE_FIELDS:
                # A simulated range can have another unit than the file.
                ranges = _ranges(self.records[name][template], before, points)
                if ranges is not None:
                    _store(rows, name, is_moved, ranges)
        return rows

    def _store_column(
        self, rows: Records, column: str, name: str, augmented: AugmentedSweep, is_added: Bools
    ) -> None:
        """Overwrite the values of a column that differ from the recording."""
        is_strength = name.lower() in _STRENGTH_FIELDS
        values = augmented.sweep.columns.get(column)
        recorded = self.recorded.columns.get(column)
        if values is None:
            is_computed = False
        elif recorded is None:  # such as an intensity that was derived from the reflectivity
            _store(rows, name, np.ones(len(rows), bool), values)
            is_computed = True
        else:
            differs = _differs(np.asarray(values), np.asarray(recorded)[augmented.template])
            _store(rows, name, differs, values)
            is_computed = bool(differs[is_added].any())
        if is_strength and not is_computed and (column != "intensity" or values is None):
            rows[name][is_added] = 0

    @property
    def axes(self) -> dict[str, str]:
        """Fields of the coordinates x, y and z."""
        return self._field_names()[0]

    def _field_names(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return the fields of the coordinates and of the other columns, keyed by column name."""
        names = list(self.records.dtype.names or ())
        axes = dict(zip(standard_names(names, AXES), names, strict=True))
        axes = {axis: axes[axis] for axis in AXES}
        others = [name for name in names if name not in axes.values()]
        columns = dict(zip(standard_names(others), others, strict=True))
        chosen = self.intensity_column
        if chosen is not None:
            field = chosen if chosen in others else columns.get(chosen)
            if field is not None:
                columns = {column: name for column, name in columns.items() if name != field}
                stored = columns.pop("intensity", None)
                columns |= {} if stored is None else {"stored intensity": stored}
                columns["intensity"] = field
        return axes, columns

    def organize(self, rows: Records, augmented: AugmentedSweep) -> Records | None:
        """Arrange augmented records in the grid of the recorded sweep.

        Cells whose return was lost are marked like the other cells without a return.

        Parameters
        ----------
        rows
            Records that `augment` returned.
        augmented
            The augmented points.

        Returns
        -------
        Records of shape (n,), or None if a point has no free cell (see `assign_cells`).
        """
        places = assign_cells(self.recorded, augmented)
        if places is None:
            return None
        cells = self.records.copy()
        returned = self.recorded.has_return
        is_lost = returned.copy()
        is_lost[places] = False
        axes, columns = self._field_names()
        zeros = ~returned & ~self.recorded.points.any(axis=1)
        marker = 0 if 2 * zeros.sum() > (~returned).sum() else np.nan
        for name in axes.values():
            is_float = cells.dtype[name].kind == "f"
            cells[name][is_lost] = marker if is_float else 0
        for name in columns.values():
            if name.lower() in _STRENGTH_FIELDS | _RANGE_FIELDS:
                cells[name][is_lost] = 0
        raw = np.dtype((np.void, cells.dtype.itemsize))
        cells.view(raw)[places] = rows.view(raw)
        return cells


def _take(records: Records, rows: Ints) -> Records:
    """Return copies of records, including bytes that belong to no field."""
    raw = np.ascontiguousarray(records).view(np.dtype((np.void, records.dtype.itemsize)))
    return raw[rows].view(records.dtype)


def _differs(values: AnyArray, others: AnyArray) -> Bools:
    """Return where two arrays differ, treating NaN values as equal."""
    equal = values == others
    if values.dtype.kind == "f" and others.dtype.kind == "f":
        equal |= np.isnan(values) & np.isnan(others)
    return np.asarray(~equal)


def _store(rows: Records, name: str, mask: Bools, values: Any) -> None:
    """Store the values of the selected points in a field."""
    if mask.any():
        rows[name][mask] = convert_values(np.asarray(values)[mask], rows.dtype[name])


def convert_values(values: AnyArray, dtype: np.dtype[Any]) -> AnyArray:
    """Convert values to a dtype. Integers are rounded and clipped to the limits of the dtype.

    Examples
    --------
    >>> convert_values(np.array([1.6, 300.0, np.nan]), np.dtype("u1"))
    array([  2, 255,   0], dtype=uint8)
    """
    if dtype.kind not in "iu":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    if values.dtype.kind in "iu":
        own = np.iinfo(values.dtype)
        clipped = values.clip(max(limits.min, own.min), min(limits.max, own.max))
        return np.asarray(clipped.astype(dtype))
    numbers = np.rint(np.nan_to_num(values.astype(np.float64)))
    highest = np.nextafter(float(limits.max), 0) if dtype.itemsize == 8 else limits.max
    return np.asarray(numbers.clip(limits.min, highest).astype(dtype))


def _ranges(stored: AnyArray, before: Floats, points: Floats) -> Floats | None:
    """Return the stored ranges of points that were moved.

    Returns None if the unit of the stored ranges cannot be determined.

    Parameters
    ----------
    stored
        (n,): stored ranges of the templates, in an unknown unit.
    before, points
        (n, 3): positions of the templates and of the points in meters.
    """
    ranges_m = np.sqrt((before**2).sum(axis=1))
    known = np.isfinite(ranges_m) & (ranges_m > 0) & (stored > 0)
    if not known.any():
        return None
    ratio = float(np.median(stored[known] / ranges_m[known]))
    unit = 10.0 ** round(np.log10(ratio))
    if abs(ratio / unit - 1) > _MAX_UNIT_ERROR:
        unit = ratio
    # Ranges can start at the beam origin, which is a few millimeters away from the sensor origin.
    offsets = np.where(known, stored - unit * np.where(known, ranges_m, 0.0), 0.0)
    moved: Floats = np.sqrt((points**2).sum(axis=1)) * unit + offsets
    return moved


def unchanged(rows: Records, records: Records, template: Ints) -> bool:
    """Return whether augmented records equal the stored records."""
    return (
        len(rows) == len(records)
        and rows.tobytes() == records.tobytes()
        and bool((np.asarray(template) == np.arange(len(records))).all())
    )

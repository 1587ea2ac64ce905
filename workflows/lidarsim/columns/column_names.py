"""Names of point columns in other programs' files, and their standard names.

This is the only list of such names. A new alias is one more word in `ALIASES`. Names are compared
without case and without the prefix `scalar_` that CloudCompare adds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache

from ..base.arrays import AnyArray
from ..base.words import distinct

AXES = ("x", "y", "z")
COLORS = ("red", "green", "blue")
NORMALS = ("normal_x", "normal_y", "normal_z")
ORIGINS = ("origin_x", "origin_y", "origin_z")
# {standard name: other names for the same quantity, the most specific name first}
ALIASES: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(AXES, ()),
    "channel": ("ring", "laser_id", "laser_number", "laser", "line", "beam"),
    "intensity": ("i", "energy"),
    "reflectivity": (),
    "class": ("classification", "label"),
    "object": ("instance",),
    "return_number": (),
    "returns": ("number_of_returns",),
    "red": ("r", "rf", "colorred"),
    "green": ("g", "gf", "colorgreen"),
    "blue": ("b", "bf", "colorblue"),
    "normal_x": ("nx", "normalx"),
    "normal_y": ("ny", "normaly"),
    "normal_z": ("nz", "normalz"),
    **dict.fromkeys(ORIGINS, ()),
    "rgb": (),
    "rgba": (),
}
# Times keep their names, because their unit and zero follow from their values
# (`lidarpool/clouds/point_times.py`). The first column present is used.
TIMES = ("t", "time", "time_s", "timestamp", "offset_time", "time_offset", "time_stamp")
# Columns that contain the strength of a return; the first column present is used.
STRENGTHS = ("intensity", "reflectivity")

_STANDARD = {name: (name, 0) for name in ALIASES}
for _name, _aliases in ALIASES.items():
    _STANDARD |= {alias: (_name, rank) for rank, alias in enumerate(_aliases, 1)}


def standard_names(names: Iterable[str], among: Collection[str] | None = None) -> list[str]:
    """Return distinct column names, with the standard name for each known alias.

    A standard name is given to one column: to the column that already has the name, otherwise to
    the first of its aliases in `ALIASES`. The other columns keep their names, and a repeated name
    gets a number.

    Parameters
    ----------
    names
        Names in the order of the file.
    among
        Standard names that may be assigned. By default, all standard names are assigned.

    Examples
    --------
    >>> standard_names(["X", "Y", "Z", "R", "Intensity", "intensity", "intensity"])
    ['x', 'y', 'z', 'red', 'Intensity', 'intensity', 'intensity_2']
    >>> standard_names(["x", "y", "z", "scalar_Classification", "ring"])
    ['x', 'y', 'z', 'class', 'channel']
    """
    return list(_standard_names(tuple(names), None if among is None else frozenset(among)))


@lru_cache(maxsize=256)
def _standard_names(names: tuple[str, ...], among: frozenset[str] | None) -> tuple[str, ...]:
    present = set(names)
    best: dict[str, tuple[int, int]] = {}  # {standard name: (rank of the alias, index)}
    for index, name in enumerate(names):
        standard, rank = _STANDARD.get(name.lower().removeprefix("scalar_"), ("", 0))
        if not standard or standard in present or (among is not None and standard not in among):
            continue
        best[standard] = min(best.get(standard, (rank, index)), (rank, index))
    renamed = {index: standard for standard, (_, index) in best.items()}
    return tuple(distinct(renamed.get(index, name) for index, name in enumerate(names)))


def with_standard_names(
    columns: Mapping[str, AnyArray], among: Collection[str] | None = None
) -> dict[str, AnyArray]:
    """Return columns under their standard names, as in `standard_names`."""
    return dict(zip(standard_names(columns, among), columns.values(), strict=True))


def columns_for(columns: Mapping[str, AnyArray], name: str) -> dict[str, AnyArray]:
    """Return the columns that contain a quantity, the column with its standard name first.

    Several columns are possible because only one of them gets the standard name.
    """
    found = sorted(columns, key=lambda other: other != name)
    return {other: columns[other] for other in found if standard_names([other]) == [name]}

"""Names of point columns in other programs' files, and their standard names.

This is the only list of such names. To support another name, add it to `ALIASES`. The case of
names and the prefix `scalar_`, which CloudCompare adds, are ignored.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache

from ..numerics.arrays import AnyArray
from ..words import make_distinct

AXES = ("x", "y", "z")
COLORS = ("red", "green", "blue")
NORMALS = ("normal_x", "normal_y", "normal_z")
ORIGINS = ("origin_x", "origin_y", "origin_z")
# {standard name: other names for the same quantity, in order of preference}
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
# Names of point times, in order of preference. They have no standard name, because their unit and
# clock depend on the values (`lidarfiles/clouds/point_times.py`).
TIMES = ("t", "time", "time_s", "timestamp", "offset_time", "time_offset", "time_stamp")
# Columns that contain the strength of a return, in order of preference.
STRENGTHS = ("intensity", "reflectivity")

_STANDARD = {name: (name, 0) for name in ALIASES}
for _name, _aliases in ALIASES.items():
    _STANDARD |= {alias: (_name, rank) for rank, alias in enumerate(_aliases, 1)}


def standard_names(names: Iterable[str], among: Collection[str] | None = None) -> list[str]:
    """Replace column names with standard names, and make them distinct.

    Only one column gets a standard name: the column that already has it, or else the column whose
    name comes first in `ALIASES`. All other columns keep their names. A number is appended to names
    that occur repeatedly.

    Parameters
    ----------
    names
        Names in the order of the file.
    among
        Standard names that may be assigned (default: all).

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
    best: dict[str, tuple[int, int]] = {}  # {standard name: (rank of the alias, column index)}
    for index, name in enumerate(names):
        standard, rank = _known(name)
        if not standard or standard in present or (among is not None and standard not in among):
            continue
        best[standard] = min(best.get(standard, (rank, index)), (rank, index))
    renamed = {index: standard for standard, (_, index) in best.items()}
    return tuple(make_distinct(renamed.get(index, name) for index, name in enumerate(names)))


def with_standard_names(
    columns: Mapping[str, AnyArray], among: Collection[str] | None = None
) -> dict[str, AnyArray]:
    """Rename columns to the names that `standard_names` returns for them."""
    return dict(zip(standard_names(columns, among), columns.values(), strict=True))


def columns_for(columns: Mapping[str, AnyArray], name: str) -> dict[str, AnyArray]:
    """Return the columns whose name is a standard name or one of its aliases.

    The standard name is first, and its aliases follow in the order of `ALIASES`.
    """
    ranks = {other: _known(other) for other in columns}
    found = [other for other, (standard, _) in ranks.items() if standard == name]
    found.sort(key=lambda other: (other != name, ranks[other]))
    return {other: columns[other] for other in found}


def _known(name: str) -> tuple[str, int]:
    """Return a column's standard name and the rank of its alias in `ALIASES`.

    The standard name is empty if the column has none.
    """
    return _STANDARD.get(name.lower().removeprefix("scalar_"), ("", 0))

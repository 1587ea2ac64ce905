"""Points of cloud files: positions, columns by the usual names, and where they were measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from ...base.arrays import AnyArray, Floats
from ...base.words import distinct

# Names of columns that programs write in upper case or in short, by their usual names.
_USUAL_NAMES = {
    **{name: name for name in ("x", "y", "z", "nx", "ny", "nz", "rgb", "rgba")},
    **{name: name for name in ("red", "green", "blue", "intensity", "reflectivity")},
    **{name: name for name in ("class", "classification", "label", "ring", "channel", "time")},
    "i": "i",
    "r": "red",
    "g": "green",
    "b": "blue",
    # Real numbers from 0 to 1, as CloudCompare writes them.
    "rf": "red",
    "gf": "green",
    "bf": "blue",
}


class CloudScan(NamedTuple):
    """Points of a file that share a frame, and the pose of that frame."""

    positions: Floats  # (n, 3): in the units of the file, in the frame of `pose`
    columns: dict[str, AnyArray]  # {name: (n,)}: further numbers of the points
    pose: Floats | None = None  # (4, 4): from the frame of the points to the frame of the file
    scanner: Floats | None = None  # (3,): position in the frame of the file; None if unknown
    units_m: tuple[float, float, float] | None = None  # one for each axis, if the file states them
    unread: tuple[str, ...] = ()  # columns without numbers or names
    notes: tuple[str, ...] = ()  # clauses that follow the name of the file


def usual_names(names: Iterable[str]) -> list[str]:
    """Return distinct names of columns, with the usual name for each spelling.

    A name that is there already gets a number: the second `intensity` is `intensity_2`.

    Examples
    --------
    >>> usual_names(["X", "Y", "Z", "R", "Intensity", "intensity", "intensity"])
    ['x', 'y', 'z', 'red', 'Intensity', 'intensity', 'intensity_2']
    """
    exact = list(names)
    usual: list[str] = []
    for name in exact:
        candidate = _USUAL_NAMES.get(name.lower(), name)
        is_taken = candidate != name and (candidate in exact or candidate in usual)
        usual.append(name if is_taken else candidate)
    return distinct(usual)


def with_usual_names(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return columns by their usual names."""
    return dict(zip(usual_names(columns), columns.values(), strict=True))

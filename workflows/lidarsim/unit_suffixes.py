"""Unit suffixes of names, as in `visibility_km`, and conversions between units."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

# {dimension: {unit suffix: size in base units}}
_UNITS: dict[str, dict[str, float]] = {
    "length": {
        "nm": 1e-9,
        "um": 1e-6,
        "mm": 1e-3,
        "cm": 1e-2,
        "dm": 0.1,
        "m": 1.0,
        "km": 1e3,
        "in": 0.0254,
        "ft": 0.3048,
        "yd": 0.9144,
        "mi": 1609.344,
    },
    "time": {"ps": 1e-12, "ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    "angle": {"deg": math.pi / 180, "rad": 1.0, "mrad": 1e-3, "urad": 1e-6},
    "frequency": {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9, "rpm": 1 / 60},
    "speed": {
        "m_s": 1.0,
        "mps": 1.0,
        "mm_s": 1e-3,
        "cm_s": 1e-2,
        "km_s": 1e3,
        "km_h": 1 / 3.6,
        "kmh": 1 / 3.6,
        "kph": 1 / 3.6,
        "mph": 0.44704,
        "kn": 1852 / 3600,
        "mm_h": 1e-3 / 3600,
        "cm_h": 1e-2 / 3600,
        "m_h": 1 / 3600,
        "in_h": 0.0254 / 3600,
    },
    "angular rate": {"deg_s": math.pi / 180, "rad_s": 1.0},
    "acceleration": {"m_s2": 1.0, "g": 9.80665},
    "density": {"ug_m3": 1e-6, "mg_m3": 1e-3, "g_m3": 1.0, "kg_m3": 1e3},
    "energy": {"pj": 1e-12, "nj": 1e-9, "uj": 1e-6, "mj": 1e-3, "j": 1.0},
    "data": {"kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30},
}
_WORDS = {  # {spelled-out unit: unit suffix}
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("feet", "foot"), "ft"),
    **dict.fromkeys(("sec", "second", "seconds"), "s"),
    **dict.fromkeys(("minute", "minutes"), "min"),
    **dict.fromkeys(("hour", "hours"), "h"),
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
}
_SIZES = {unit: (kind, size) for kind, units in _UNITS.items() for unit, size in units.items()}
_SIZES |= {word: _SIZES[unit] for word, unit in _WORDS.items()}


class UnitName(NamedTuple):
    """A name that ends with a unit."""

    stem: str
    unit: str
    dimension: str
    size: float

    @classmethod
    def parse(cls, name: str) -> UnitName | None:
        """Split a name into its stem and unit, or return None if it does not end with a unit."""
        parts = name.lower().split("_")
        for count in (2, 1):  # m_s is a speed, not a time
            unit = "_".join(parts[-count:])
            if len(parts) > count and unit in _SIZES:
                return cls("_".join(parts[:-count]), unit, *_SIZES[unit])
        return None


def unit_of(name: str) -> str | None:
    """Return the unit at the end of a name, or None if the name has no unit."""
    parsed = UnitName.parse(name)
    return None if parsed is None else parsed.unit


def find_other_unit(name: str, candidates: Iterable[str]) -> str | None:
    """Return the candidate that differs from a name only in its unit, or None if there is none.

    Examples
    --------
    >>> find_other_unit("visibility_m", ["rain_mm_h", "visibility_km"])
    'visibility_km'
    """
    given = UnitName.parse(name)
    if given is None:
        return None
    parsed = {candidate: UnitName.parse(candidate) for candidate in candidates}
    return next(
        (
            candidate
            for candidate, found in parsed.items()
            if found is not None
            and (found.stem, found.dimension) == (given.stem, given.dimension)
            and found.unit != given.unit
        ),
        None,
    )


def factor_between(name: str, candidate: str) -> float | None:
    """Return the factor that converts values from the unit of `name` to that of `candidate`.

    Returns None unless both names end with units that have the same dimension and different sizes.

    Examples
    --------
    >>> factor_between("visibility_m", "visibility_km")
    0.001
    """
    given = UnitName.parse(name)
    wanted = UnitName.parse(candidate)
    if given is None or wanted is None or given.dimension != wanted.dimension:
        return None
    return None if given.size == wanted.size else given.size / wanted.size


def convert_value(value: Any, factor: float) -> Any:
    """Multiply a number, or all numbers in a list or mapping, by a factor.

    Returns None for values of other types.

    Examples
    --------
    >>> convert_value([60, 1500], 0.001)
    [0.06, 1.5]
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        number = float(f"{value * factor:.12g}")
        return int(number) if number.is_integer() and abs(number) < 1e15 else number
    if isinstance(value, (list, tuple)):
        entries = [convert_value(entry, factor) for entry in value]
        return None if None in entries else entries
    if isinstance(value, dict):
        changed = {key: convert_value(entry, factor) for key, entry in value.items()}
        return None if None in changed.values() else changed
    return None

"""Categories, attributes and visibility levels of inserted objects in nuScenes data sets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..object_classes import find_class

# Category of all other objects in nuScenes-lidarseg, whose devkit accepts no new categories.
OTHER_CATEGORY = "static.other"
_LEVELS = {"v0-40": 0.4, "v40-60": 0.6, "v60-80": 0.8, "v80-100": 1.0}  # {level: upper limit}
_MIN_SPEED = 0.2  # m/s; slower objects are stationary
# {prefix of a category: attributes of a stationary and of a moving object}
_ATTRIBUTES = {
    "vehicle.bicycle": ("cycle.with_rider", "cycle.with_rider"),
    "vehicle.motorcycle": ("cycle.with_rider", "cycle.with_rider"),
    "vehicle": ("vehicle.parked", "vehicle.moving"),
    "human.pedestrian": ("pedestrian.standing", "pedestrian.moving"),
}


def find_category(kind: str, names: Iterable[str]) -> str | None:
    """Return the category of an object type, or None if there is none.

    Examples
    --------
    >>> [find_category("Boat", names) for names in (["none"], ["none", "static.other"])]
    [None, 'static.other']
    """
    listed = [*names]
    found = find_class(kind, listed)
    return OTHER_CATEGORY if found is None and OTHER_CATEGORY in listed else found


def visibility_token(rows: Iterable[Mapping[str, Any]], visibility: float | None) -> str:
    """Return the token of a visibility level, or an empty string if it is unknown."""
    if visibility is None:
        return ""
    share = min(max(visibility, 0.0), 1.0)
    level = next(name for name, limit in _LEVELS.items() if share <= limit)
    return next((row["token"] for row in rows if row["level"] == level), "")


def attribute_tokens(
    rows: Sequence[Mapping[str, Any]], category: str, speed: float | None
) -> list[str]:
    """Return the tokens of the attributes of an object.

    `speed` is in m/s, or None if it is unknown. Categories without attributes have no tokens.
    """
    for prefix, (stationary, moving) in _ATTRIBUTES.items():
        if category.startswith(prefix):
            name = moving if speed is not None and speed >= _MIN_SPEED else stationary
            return [row["token"] for row in rows if row["name"] == name]
    return []

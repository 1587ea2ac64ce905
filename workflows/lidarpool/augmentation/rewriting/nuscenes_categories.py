"""Categories, attributes and visibility levels of inserted objects in nuScenes data sets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# {type of an object, in lower case: category in nuScenes}
_OFFICIAL = {
    "barrier": "movable_object.barrier",
    "bicycle": "vehicle.bicycle",
    "bus": "vehicle.bus.rigid",
    "car": "vehicle.car",
    "child": "human.pedestrian.child",
    "construction vehicle": "vehicle.construction",
    "cyclist": "vehicle.bicycle",
    "human": "human.pedestrian.adult",
    "motorcycle": "vehicle.motorcycle",
    "pedestrian": "human.pedestrian.adult",
    "person": "human.pedestrian.adult",
    "traffic cone": "movable_object.trafficcone",
    "trailer": "vehicle.trailer",
    "truck": "vehicle.truck",
    "van": "vehicle.car",
    "walker": "human.pedestrian.adult",
}
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


def _plain(name: str) -> str:
    return name.casefold().replace("_", " ")


def find_category(kind: str, names: Iterable[str]) -> str | None:
    """Return the category of an object type, or None if there is none.

    Examples
    --------
    >>> names = ["none", "Bus", "vehicle.car", "vehicle.emergency.police"]
    >>> [find_category(kind, names) for kind in ("Car", "bus", "police", "Boat")]
    ['vehicle.car', 'Bus', 'vehicle.emergency.police', None]
    """
    known = {_plain(name): name for name in names}
    last_words = {plain.rpartition(".")[2]: name for plain, name in known.items()}
    plain = _plain(kind)
    official = _OFFICIAL.get(plain, "")
    found = known.get(plain) or known.get(official) or last_words.get(plain)
    return found or known.get(OTHER_CATEGORY)


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

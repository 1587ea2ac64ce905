"""Names of the same object class in different data sets."""

from __future__ import annotations

from collections.abc import Iterable

# {class: names of this class in SemanticKITTI, KITTI, Cityscapes, nuScenes and CARLA, and classes
# that include it}. The first name that a data set contains is used.
_SYNONYMS = {
    "barrier": ("movable object.barrier",),
    "bicycle": ("bike", "vehicle.bicycle"),
    "bus": ("vehicle.bus.rigid", "vehicle.bus.bendy"),
    "car": ("vehicle.car",),
    "child": ("human.pedestrian.child", "pedestrian", "person", "human.pedestrian.adult"),
    "construction vehicle": ("vehicle.construction",),
    "cyclist": ("bicyclist", "rider", "vehicle.bicycle"),
    "motorcycle": ("motorbike", "vehicle.motorcycle"),
    "pedestrian": ("person", "human", "walker", "human.pedestrian.adult"),
    "traffic cone": ("cone", "movable object.trafficcone"),
    "trailer": ("vehicle.trailer",),
    "truck": ("lorry", "vehicle.truck"),
    "van": ("car", "vehicle.car"),
}
_CLASSES = {synonym: name for name in reversed(_SYNONYMS) for synonym in _SYNONYMS[name]}


def _plain(name: str) -> str:
    return name.casefold().replace("_", " ").replace("-", " ")


def find_class(kind: str, names: Iterable[str]) -> str | None:
    """Return the class of a data set that corresponds to an object type, or None.

    The exact name is preferred to other spellings, synonyms, and the last words of dotted names.

    Parameters
    ----------
    kind
        Type of the object, such as "pedestrian".
    names
        Class names of the data set.

    Examples
    --------
    >>> find_class("pedestrian", ["road", "bicyclist", "person", "moving-person"])
    'person'
    >>> names = ["Bus", "vehicle.car", "vehicle.emergency.police"]
    >>> [find_class(kind, names) for kind in ("Car", "bus", "police", "Boat")]
    ['vehicle.car', 'Bus', 'vehicle.emergency.police', None]
    """
    listed = [*names]
    if kind in listed:
        return kind
    known = {_plain(name): name for name in reversed(listed)}
    last_words = {plain.rpartition(".")[2]: name for plain, name in known.items()}
    plain = _plain(kind)
    name = plain if plain in _SYNONYMS else _CLASSES.get(plain, plain)
    candidates = (plain, name, *_SYNONYMS.get(name, ()))
    return next((known[word] for word in candidates if word in known), last_words.get(plain))

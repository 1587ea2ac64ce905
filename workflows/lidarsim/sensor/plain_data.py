"""Sensors as plain data, so that a file says where each of its rays points."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import fields
from typing import Any

import numpy as np

from ..base.arrays import AnyArray
from .beams import Beams, Mirror, Spin
from .ray_sensors import ListedSensor, Prism, PrismSensor, TurningMirror
from .sensor import LineSensor, Sensor

# What directions and times of rays depend on; nothing else is made from a file.
_KINDS = {
    kind.__name__: kind
    for kind in (
        Sensor,
        LineSensor,
        PrismSensor,
        ListedSensor,
        Beams,
        Spin,
        Mirror,
        Prism,
        TurningMirror,
    )
}
_LEFT_OUT = ("optics", "noise", "returns")


def described(thing: Any, arrays: MutableMapping[str, AnyArray]) -> Any:
    """Return sensors as data for JSON, their arrays in `arrays`; None with classes of a user."""
    try:
        return _described(thing, arrays)
    except TypeError:
        return None


def _described(thing: Any, arrays: MutableMapping[str, AnyArray]) -> Any:
    if isinstance(thing, np.ndarray):
        name = f"rays{len(arrays)}"
        arrays[name] = thing
        return {"array": name}
    if isinstance(thing, (tuple, list)):
        return [_described(one, arrays) for one in thing]
    if isinstance(thing, np.generic):
        return thing.item()
    if _KINDS.get(type(thing).__name__) is type(thing):
        names = [field.name for field in fields(thing) if field.name not in _LEFT_OUT]
        of_fields = {name: _described(getattr(thing, name), arrays) for name in names}
        return {"kind": type(thing).__name__, **of_fields}
    if not isinstance(thing, (str, int, float, type(None))):
        raise TypeError("a class of a user's own, which no file describes")
    return thing


def remade(told: Any, arrays: Mapping[str, AnyArray]) -> Any:
    """Return what `described` was given; any exception if the data are not such."""
    if isinstance(told, list):
        return tuple(remade(one, arrays) for one in told)
    if not isinstance(told, dict):
        return told
    if "array" in told:
        return arrays[told["array"]]
    return _KINDS[told.pop("kind")](**{name: remade(one, arrays) for name, one in told.items()})

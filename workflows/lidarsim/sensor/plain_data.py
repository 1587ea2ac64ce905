"""Conversion of sensors to JSON data and arrays, which files use to store ray patterns."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import fields
from typing import Any

import numpy as np

from ..numerics.arrays import AnyArray
from .beams import Beams, Mirror, Spin
from .packet_settings import PacketSettings
from .ray_sensors import ListedSensor, Prism, PrismSensor, TurningMirror
from .sensor import LineSensor, Sensor

# Classes that determine ray directions and times. Files cannot create objects of other classes.
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
        PacketSettings,
    )
}
# not part of the ray pattern
_LEFT_OUT = ("optics", "noise", "returns", "intensity_factor", "intensity_range_m")


def to_plain_data(value: Any, arrays: MutableMapping[str, AnyArray]) -> Any:
    """Convert sensors to JSON data, and add their arrays to `arrays`, keyed by name.

    The result is None if a sensor or one of its parts has a user-defined class.
    """
    try:
        return _to_plain_data(value, arrays)
    except TypeError:
        return None


def _to_plain_data(value: Any, arrays: MutableMapping[str, AnyArray]) -> Any:
    if isinstance(value, np.ndarray):
        name = f"rays{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, (tuple, list)):
        return [_to_plain_data(item, arrays) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {"mapping": {key: _to_plain_data(item, arrays) for key, item in value.items()}}
    if _KINDS.get(type(value).__name__) is type(value):
        stored = {field.name: getattr(value, field.name) for field in fields(value)}
        of_fields = {
            name: _to_plain_data(part, arrays)
            for name, part in stored.items()
            if name not in _LEFT_OUT and not _is_empty(part)
        }
        return {"kind": type(value).__name__, **of_fields}
    if not isinstance(value, (str, int, float, type(None))):
        raise TypeError("user-defined classes cannot be written to a file")
    return value


def _is_empty(value: Any) -> bool:
    """Return whether a value is an empty array, which is the default of its field."""
    return isinstance(value, np.ndarray) and not value.size


def from_plain_data(data: Any, arrays: Mapping[str, AnyArray]) -> Any:
    """Create sensors from the JSON data and arrays that `to_plain_data` produced.

    Raises
    ------
    Exception
        If the data were not produced by `to_plain_data`. The type of the exception is unspecified.
    """
    if isinstance(data, list):
        return tuple(from_plain_data(item, arrays) for item in data)
    if not isinstance(data, dict):
        return data
    if "array" in data:
        return arrays[data["array"]]
    if "mapping" in data:
        return {key: from_plain_data(item, arrays) for key, item in data["mapping"].items()}
    return _KINDS[data.pop("kind")](
        **{name: from_plain_data(item, arrays) for name, item in data.items()}
    )

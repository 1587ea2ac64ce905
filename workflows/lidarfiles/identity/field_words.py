"""Readable descriptions of field values, which show how the settings of two runs differ.

Fingerprints only show that two runs differ. A run therefore also stores a dictionary that maps the
path of each field to its value as text. Long lists are represented by their length and a short
fingerprint. The fingerprint of a list with more than about 1,000 entries covers only a sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from lidarsim.errors import LidarError

from .fingerprint import fingerprint

_PLAIN = (bool, int, float, str)
_MAX_ENTRIES = 8  # longest nested list whose entries are described as separate fields
_MAX_NUMBERS = 16  # longest list of plain values that is written in full
_MAX_LOOKED_AT = 1000  # number of entries that are sampled from a longer list
_MAX_LETTERS = 80  # longest text that is written in full
_MARK = " #"  # separates a description from the fingerprint of its content


def describe_fields(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path of each field in a value, with a readable description of the field.

    Fields that are None are skipped.

    Parameters
    ----------
    value
        A dataclass, mapping, list, array, number or text.
    path
        Path of the value itself, for example ``noise``.

    Examples
    --------
    >>> dict(describe_fields({"noise": {"range_m": 0.02}, "poses": [[0, 0, 1]], "steps": None}))
    {'noise.range_m': '0.02', 'poses[0]': '[0, 0, 1]'}
    """
    value = value.tolist() if isinstance(value, np.generic) else value
    if value is None:
        return
    if isinstance(value, _PLAIN):
        yield path, _format_value(value)
    elif isinstance(value, Mapping) and len(value) <= _MAX_LOOKED_AT:
        for key, inner in value.items():
            yield from describe_fields(inner, f"{path}.{key}".removeprefix("."))
    elif is_dataclass(value):
        inner_fields = {f.name: getattr(value, f.name) for f in fields(value) if f.compare}
        yield from describe_fields(inner_fields, path)
    elif isinstance(value, (list, tuple)) and all(isinstance(entry, _PLAIN) for entry in value):
        is_short = len(value) <= _MAX_NUMBERS
        yield path, f"[{', '.join(map(_format_value, value))}]" if is_short else _summarize(value)
    elif isinstance(value, (list, tuple)) and len(value) <= _MAX_ENTRIES:
        for number, entry in enumerate(value):
            yield from describe_fields(entry, f"{path}[{number}]")
    elif isinstance(value, np.ndarray) and value.size <= _MAX_NUMBERS:
        yield path, _format_value(str(value.tolist()))
    else:
        yield path, _summarize(value)


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _MAX_LETTERS else f"{text[:_MAX_LETTERS]}… #{fingerprint(text)[:8]}"


def _summarize(value: Any) -> str:
    """Describe a value by its length or type, followed by a short fingerprint of its content."""
    size = f"{len(value):,} entries" if hasattr(value, "__len__") else type(value).__name__
    if isinstance(value, Sequence):
        value = value[:: 1 + len(value) // _MAX_LOOKED_AT]
    try:
        return f"{size}{_MARK}{fingerprint(value)[:8]}"
    except LidarError:  # an object from user code that has no fingerprint
        return size


def describe_changes(
    earlier: Mapping[str, str], now: Mapping[str, str], max_fields: int = 4
) -> str:
    """Describe which fields differ between two descriptions of a run.

    Parameters
    ----------
    earlier, now
        Descriptions by field path, as returned by `describe_fields`.
    max_fields
        Number of changed fields to describe. Further changes are only counted.

    Returns
    -------
    Clauses separated by semicolons, or an empty string if no described field changed.

    Examples
    --------
    >>> describe_changes({"steps": "3", "noise.range_m": "0.02"}, {"steps": "4"})
    'steps changed from 3 to 4; noise.range_m was removed (it was 0.02)'
    """
    clauses = [
        _describe_change(name, earlier.get(name), now.get(name))
        for name in dict.fromkeys([*now, *earlier])
        if earlier.get(name) != now.get(name)
    ]
    further = len(clauses) - max_fields
    return "; ".join(clauses[:max_fields]) + (f"; and {further:,} more" if further > 0 else "")


def _describe_change(name: str, earlier_text: str | None, text: str | None) -> str:
    """Describe how a field has changed.

    A text is None if the field is not set.
    """
    earlier_value = earlier_text and earlier_text.partition(_MARK)[0]
    value = text and text.partition(_MARK)[0]
    if earlier_value is None:
        return f"{name} was set to {value}"
    if value is None:
        return f"{name} was removed (it was {earlier_value})"
    if value == earlier_value:
        return f"the content of {name} changed"
    return f"{name} changed from {earlier_value} to {value}"

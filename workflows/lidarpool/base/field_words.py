"""Fields of content in words: which fields of two runs differ, where fingerprints tell only that.

The words are stored with a run, {path of a field: its value}. A long list is its length and a mark
of its content. Every value counts, except in longer lists: a thousand entries of a list count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from lidarsim.base.errors import LidarError

from .fingerprint import fingerprint

_PLAIN = (bool, int, float, str)
_MAX_ENTRIES = 8  # entries of a list or mapping whose entries are separate fields
_MAX_NUMBERS = 16  # numbers of a list that is written out
_MAX_LOOKED_AT = 1000  # entries of a longer list
_MAX_LETTERS = 80
_MARK = " #"  # before the mark of content that words do not show
_NOT_GIVEN = "not given"


def fields_in_words(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the value in words of each field in a value that is not None.

    Parameters
    ----------
    value
        A dataclass, mapping, list, array, number or text.
    path
        Path of the value itself: noise.

    Examples
    --------
    >>> dict(fields_in_words({"noise": {"range_m": 0.02}, "poses": [[0, 0, 1]], "steps": None}))
    {'noise.range_m': '0.02', 'poses[0]': '[0, 0, 1]'}
    """
    value = value.tolist() if isinstance(value, np.generic) else value
    if value is None:
        return
    if isinstance(value, _PLAIN):
        yield path, _text(value)
    elif isinstance(value, Mapping) and len(value) <= _MAX_LOOKED_AT:
        for key, inner in value.items():
            yield from fields_in_words(inner, f"{path}.{key}".removeprefix("."))
    elif is_dataclass(value):
        inner_fields = {f.name: getattr(value, f.name) for f in fields(value) if f.compare}
        yield from fields_in_words(inner_fields, path)
    elif isinstance(value, (list, tuple)) and all(isinstance(entry, _PLAIN) for entry in value):
        is_short = len(value) <= _MAX_NUMBERS
        yield path, f"[{', '.join(map(_text, value))}]" if is_short else _marked(value)
    elif isinstance(value, (list, tuple)) and len(value) <= _MAX_ENTRIES:
        for number, entry in enumerate(value):
            yield from fields_in_words(entry, f"{path}[{number}]")
    elif isinstance(value, np.ndarray) and value.size <= _MAX_NUMBERS:
        yield path, _text(str(value.tolist()))
    else:
        yield path, _marked(value)


def _text(value: Any) -> str:
    """Return a plain value as in a scenario."""
    if isinstance(value, bool):
        return str(value).lower()
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _MAX_LETTERS else f"{text[:_MAX_LETTERS]}… #{fingerprint(text)[:8]}"


def _marked(value: Any) -> str:
    """Return the length of a value, and a mark of its content."""
    size = f"{len(value):,} entries" if hasattr(value, "__len__") else type(value).__name__
    if isinstance(value, Sequence):
        value = value[:: 1 + len(value) // _MAX_LOOKED_AT]
    try:
        return f"{size}{_MARK}{fingerprint(value)[:8]}"
    except LidarError:  # an object of the user without a fingerprint
        return size


def differences(earlier: Mapping[str, str], now: Mapping[str, str], max_fields: int = 4) -> str:
    """Return the fields that differ, with both values, or an empty string if none is known.

    Examples
    --------
    >>> differences({"steps": "3", "noise.range_m": "0.02"}, {"steps": "4"})
    'steps is 4, was 3; noise.range_m is not given, was 0.02'
    """
    clauses = []
    for name in dict.fromkeys([*now, *earlier]):
        values = [words.get(name, _NOT_GIVEN) for words in (now, earlier)]
        if values[0] == values[1]:
            continue
        value, earlier_value = (text.partition(_MARK)[0] for text in values)
        is_shown = value != earlier_value
        clauses.append(
            f"{name} is {value}, was {earlier_value}" if is_shown else f"{name} has other content"
        )
    further = len(clauses) - max_fields
    return "; ".join(clauses[:max_fields]) + (f"; and {further:,} more" if further > 0 else "")

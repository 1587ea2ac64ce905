"""Dataclasses as one line, for prompts, notebooks and logs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np

_LINE, _VALUE = 119, 64  # most characters of all, and of the value of a field


def one_line(thing: Any) -> str:
    """`repr` of a dataclass: the fields that differ from their defaults, as far as a line holds.

    Arrays are shown by type and shape, long lists by their length, dataclasses by their name.
    """
    in_order = sorted(fields(thing), key=lambda one: (one.name != "name", bool(one.kw_only)))
    values = ((field, getattr(thing, field.name)) for field in in_order if field.repr)
    shown = [f"{field.name}={_short(value)}" for field, value in values if _given(field, value)]
    name, kept = type(thing).__name__, list[str]()
    for text in shown:
        if len(f"{name}({', '.join([*kept, text, '…'])})") <= _LINE:
            kept.append(text)
    return f"{name}({', '.join([*kept, '…'] if len(kept) < len(shown) else kept)})"


def _given(field: Field[Any], value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return True
    make = field.default_factory
    default = field.default if make is MISSING else make()
    return value is not default and (value == default) is not True


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}"
    if is_dataclass(value) and (name := getattr(value, "name", "")):
        return f"{type(value).__name__}({name!r})"
    if len(text := repr(value)) <= _VALUE and "\n" not in text:
        return text
    if isinstance(value, Collection) and not isinstance(value, (str, bytes)):
        kinds = {type(one).__name__ for one in value}
        return f"[{len(value)} {kinds.pop() if len(kinds) == 1 else 'items'}]"
    return f"{type(value).__name__}(…)" if is_dataclass(value) else f"{text[: _VALUE - 1]}…"

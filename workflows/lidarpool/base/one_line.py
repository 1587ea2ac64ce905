"""Dataclasses as one line, for prompts, notebooks and logs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import numpy as np

_LINE, _VALUE = 119, 64  # most characters of all, and of the value of a field


def one_line(thing: Any) -> str:
    """`repr` of a dataclass: the fields that differ from their defaults, as far as a line holds."""
    name, kept, left_out = type(thing).__name__, list[str](), False
    for field in sorted(fields(thing), key=lambda one: (one.name != "name", bool(one.kw_only))):
        value, make = getattr(thing, field.name), field.default_factory
        default = field.default if make is MISSING else make()
        array = isinstance(value, np.ndarray)
        if not field.repr or value is default or (not array and (value == default) is True):
            continue
        text = f"{field.name}={_short(value)}"
        if fits := len(f"{name}({', '.join([*kept, text, '…'])})") <= _LINE:
            kept.append(text)
        left_out |= not fits
    return f"{name}({', '.join(kept + ['…'] * left_out)})"


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

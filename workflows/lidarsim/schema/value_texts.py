"""Text representations of values for messages and for the `repr` of dataclasses."""

from __future__ import annotations

import reprlib
from collections.abc import Collection
from dataclasses import MISSING, is_dataclass
from dataclasses import fields as dataclass_fields
from types import NoneType
from typing import Any

import numpy as np

_PLAIN = (bool, int, float, str, bytes, NoneType, list, tuple, dict)
_MAX_LETTERS = 160  # maximum length of a value in a message
_MAX_LINE = 119  # maximum length of a `repr`
_MAX_VALUE = 64  # maximum length of a field value in a `repr`


def format_value(value: object) -> str:
    """Format a value for a message, shortened to a readable length.

    Objects other than plain Python values are represented by their type.
    """
    if not isinstance(value, _PLAIN):
        return "an array" if isinstance(value, np.ndarray) else with_article(type(value).__name__)
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    short.maxlevel = 3  # with YAML aliases, a few characters can expand to deeply nested lists
    text = " ".join(short.repr(value).split())  # nested arrays have several lines
    return text if len(text) <= _MAX_LETTERS else f"{text[:_MAX_LETTERS]}…"


def with_article(name: str) -> str:
    """Prefix the name of a class with the indefinite article."""
    return f"{'an' if name[0].lower() in 'aeio' else 'a'} {name}"


def one_line(instance: Any) -> str:
    """Return a `repr` of a dataclass that fits on one line.

    Only fields that differ from their defaults are shown.
    """
    name = type(instance).__name__
    texts = list[str]()
    left_out = False
    fields = sorted(dataclass_fields(instance), key=lambda f: (f.name != "name", bool(f.kw_only)))
    for field in fields:
        value = getattr(instance, field.name)
        make = field.default_factory
        default = field.default if make is MISSING else make()
        if not field.repr or (not isinstance(value, np.ndarray) and (value == default) is True):
            continue
        text = f"{field.name}={_short(value)}"
        if fits := len(f"{name}({', '.join([*texts, text, '…'])})") <= _MAX_LINE:
            texts.append(text)
        left_out |= not fits
    return f"{name}({', '.join(texts + ['…'] * left_out)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}"
    if is_dataclass(value) and (name := getattr(value, "name", "")):
        return f"{type(value).__name__}({name!r})"
    if len(text := repr(value)) <= _MAX_VALUE and "\n" not in text:
        return text
    if isinstance(value, Collection) and not isinstance(value, (str, bytes)):
        kinds = {type(item).__name__ for item in value}
        return f"[{len(value)} {kinds.pop() if len(kinds) == 1 else 'items'}]"
    return f"{type(value).__name__}(…)" if is_dataclass(value) else f"{text[: _MAX_VALUE - 1]}…"

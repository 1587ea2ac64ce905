"""Errors of pydantic as lines for the author of a scenario."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from ..base.words import counted, did_you_mean

_GIVEN_LETTERS = 160  # letters of the value given


def validation_errors(error: ValidationError, fields: Iterable[str]) -> Iterator[str]:
    """Yield a line for each error: field, value given, values allowed.

    Parameters
    ----------
    error
        What a model raised.
    fields
        Names of all fields, to suggest one for a misspelt name.
    """
    fields = list(fields)
    alike: dict[Any, list[ErrorDetails]] = {}  # {field and kind of mistake: where it was made}
    places = [detail["loc"] for detail in error.errors()]
    for detail in error.errors():
        at = detail["loc"]
        # Of a list in which all entries are wrong pydantic says that it has none.
        if detail["type"] == "too_short" and any(p[: len(at)] == at != p for p in places):
            continue
        field = tuple(step for step in at if not isinstance(step, int))
        alike.setdefault((field, detail["type"]), []).append(detail)
    for first, *others in alike.values():
        more = f" {counted(len(others), 'more entry', 'more entries')} like it." if others else ""
        yield _line(first, fields) + more


def _line(detail: ErrorDetails, fields: Iterable[str]) -> str:
    place, kind, message = _dotted(detail["loc"]), detail["type"], detail["msg"]
    if kind == "value_error":
        message = str(detail["ctx"]["error"])
        return f"{place}: {message}" if place else message
    if kind in ("extra_forbidden", "invalid_key"):
        return f"{place} is not a field.{did_you_mean(str(detail['loc'][-1]), fields)}"
    if kind == "missing":
        return f"{place} is missing; it must be given."
    given = detail["input"]
    hint = ""
    if kind == "literal_error" and isinstance(given, str):
        hint = did_you_mean(given, re.findall(r"'([^']*)'", detail["ctx"]["expected"]))
    return f"{place} is {_shown(given)}; {message[:1].lower()}{message[1:]}.{hint}"


def _dotted(place: Sequence[int | str]) -> str:
    """Location as poses[0].position."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return "".join(steps).removeprefix(".")


def _shown(value: Any) -> str:
    """Return the value given as YAML, cut to a readable length."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 40
    short.maxlevel = 3  # YAML aliases make deeply nested lists of a few letters
    text = short.repr(value)
    return text if len(text) <= _GIVEN_LETTERS else f"{text[:_GIVEN_LETTERS]}…"

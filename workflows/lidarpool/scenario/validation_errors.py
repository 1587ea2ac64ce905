"""What pydantic finds wrong with a scenario, in a line for whoever wrote it."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from ..base.words import did_you_mean

_GIVEN_LETTERS = 160  # of what was given


def validation_error(error: ValidationError, fields: Iterable[str], source: str) -> str:
    """Return a line with the first fault: where, what was given, what is allowed.

    Parameters
    ----------
    error
        What a model raised.
    fields
        Names of all fields that there are, for those that are misspelt.
    source
        What was validated, for the beginning of the line; a file's name.
    """
    first, *others = error.errors()
    more = f" ({len(others)} more to follow.)" if others else ""
    return f"{source}: {_line(first, fields)}{more}"


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
    """Show what was given, cut to a readable length, as YAML would say it."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 40
    short.maxlevel = 3  # lists of lists of lists, which YAML's aliases make of a few letters
    text = short.repr(value)
    return text if len(text) <= _GIVEN_LETTERS else f"{text[:_GIVEN_LETTERS]}…"

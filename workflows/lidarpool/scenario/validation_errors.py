"""Errors of pydantic as lines for the author of a scenario."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ..base.words import counted, did_you_mean

_ALIKE = {"position": "translation", "translation": "position"}  # too unlike for `did_you_mean`
_GIVEN_LETTERS = 160  # letters of the value given


def validation_errors(error: ValidationError, model: type[BaseModel]) -> Iterator[str]:
    """Yield a line for each error that a model raised: field, value given, values allowed.

    For a misspelt name, a field of the same section is suggested.
    """
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
        yield _line(first, model) + more


def _line(detail: ErrorDetails, model: type[BaseModel]) -> str:
    place, kind, message = dotted(detail["loc"]), detail["type"], detail["msg"]
    if kind == "value_error":
        message = str(detail["ctx"]["error"])
        return f"{place}: {message}" if place else message
    if kind in ("extra_forbidden", "invalid_key"):
        *section, name = detail["loc"]
        fields = _fields(model, section)
        if (other := _ALIKE.get(str(name), "")) in fields:
            return f"{place} is not a field. Did you mean {other!r}?"
        return f"{place} is not a field.{did_you_mean(str(name), fields)}"
    if kind == "missing":
        return f"{place} is missing; it must be given."
    given = detail["input"]
    hint = ""
    if kind == "literal_error" and isinstance(given, str):
        hint = did_you_mean(given, re.findall(r"'([^']*)'", detail["ctx"]["expected"]))
    return f"{place} is {_shown(given)}; {message[:1].lower()}{message[1:]}.{hint}"


def _fields(model: type[BaseModel], place: Iterable[int | str]) -> set[str]:
    """Names of the fields at a place, such as ("scene", "files", 0)."""
    found = [model]
    for step in place:
        inner = [
            deeper
            for one in found
            for name, field in one.model_fields.items()
            if step in (name, field.alias)
            for deeper in models_in(field.annotation)
        ]
        found = inner or found  # it may be the number of an entry, or a key
    return {field.alias or name for one in found for name, field in one.model_fields.items()}


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models in an annotation, such as `tuple[Model, ...] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from models_in(inner)


def dotted(place: Sequence[int | str]) -> str:
    """Location as poses[0].position."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return "".join(steps).removeprefix(".")


def _shown(value: Any) -> str:
    """Return the value given as YAML, cut to a readable length."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 40
    short.maxlevel = 3  # YAML aliases make deeply nested lists of a few letters
    text = short.repr(value)
    return text if len(text) <= _GIVEN_LETTERS else f"{text[:_GIVEN_LETTERS]}…"

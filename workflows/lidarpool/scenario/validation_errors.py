"""What pydantic finds wrong with a scenario, in words for whoever wrote it."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from ..base.words import did_you_mean

_GIVEN_LETTERS = 160  # of what was given
_LINES = 2  # messages shown; a reader puts them right one by one anyway

_CHOICE = re.compile(r"'([^']*)'")  # in pydantic's words for those that there are

_EXPECTED = {
    "int": "a whole number",
    "float": "a number",
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "tuple": "a list",
    "list": "a list",
    "model": "a section of fields (name: value)",
    "dict": "a section of fields (name: value)",
}


def validation_errors(error: ValidationError, model: type[BaseModel], source: str) -> str:
    """Word a validation error.

    Parameters
    ----------
    error
        What `model` raised.
    model
        The outermost model.
    source
        What was validated, for the beginning of each line; a file's name.

    Returns
    -------
    One or two lines: where, what was given, what is allowed, what may have been meant.
    """
    lines = list(dict.fromkeys(_line(detail, model) for detail in filter(_real, error.errors())))
    shown = [f"{source}: {line}" for line in lines[:_LINES]]
    if len(lines) > _LINES:
        shown[-1] += f" ({len(lines) - _LINES} more to follow.)"
    return "\n".join(shown)


def _real(detail: ErrorDetails) -> bool:
    """Whether it is a fault of its own: a list with bad entries is also said to be too short."""
    if detail["type"] != "too_short":
        return True
    return len(detail["input"]) < detail["ctx"]["min_length"]


def _line(detail: ErrorDetails, model: type[BaseModel]) -> str:
    """One complaint, without the file's name."""
    place, kind = detail["loc"], detail["type"]
    if kind == "value_error":
        message = str(detail["ctx"]["error"])
        return f"{_dotted(place)}: {message}" if place else message
    if kind in ("extra_forbidden", "invalid_key"):
        known = list(_fields_at(model, place[:-1]))
        hint = did_you_mean(str(place[-1]), known) or f" There are: {', '.join(known)}."
        return f"{_dotted(place)} is not a field.{hint}"
    if kind == "missing" and isinstance(place[-1], str):
        return f"{_dotted(place)} is missing; it must be given."
    if kind == "missing":
        # One number of several: what was given is the list.
        field = _field_at(model, place[:-1])
        entries = get_args(field.annotation) if field else ()
        allowed = _list_of(len(entries), detail["input"]) if entries else "a longer list"
        return f"{_dotted(place[:-1])} is {_given(detail['input'])}; it must be {allowed}."
    text = f"{_dotted(place)} is {_given(detail['input'])}; it must be {_allowed(detail, model)}."
    if kind == "literal_error" and isinstance(detail["input"], str):
        text += did_you_mean(detail["input"], _CHOICE.findall(detail["ctx"]["expected"]))
    return text


def _allowed(detail: ErrorDetails, model: type[BaseModel]) -> str:
    """Say what would have been right."""
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "literal_error":
        return f"one of {context['expected'].replace(' or ', ', ')}"
    if kind in ("too_short", "too_long"):
        least, most = context.get("min_length"), context.get("max_length")
        return f"a list of at least {least}" if least else _list_of(most, detail["input"])
    if kind in ("string_too_short", "string_too_long"):
        return "text that is not empty" if "min_length" in context else "shorter text"
    field = _field_at(model, detail["loc"])
    limits = _limits(field.metadata if field else []) or _limits_of(kind, context)
    expected = _EXPECTED.get(kind.partition("_")[0], "")
    if kind.startswith(("greater", "less")):
        return limits or detail["msg"]
    if expected:
        return f"{expected}, {limits}" if limits else expected
    return detail["msg"].removeprefix("Input should be ")


def _list_of(length: object, given: object) -> str:
    """Name the list that should be there, its entries as those that were given."""
    numbers = isinstance(given, list | tuple) and all(isinstance(e, int | float) for e in given)
    return f"a list of {length} numbers" if numbers and given else f"a list of {length}"


def _limits(metadata: Sequence[Any]) -> str:
    """Bounds of a field in words: '1 to 65535', 'above 0, at most 180'."""
    bounds = {
        name: getattr(entry, name)
        for entry in metadata
        for name in ("gt", "ge", "lt", "le")
        if getattr(entry, name, None) is not None
    }
    if "ge" in bounds and "le" in bounds:
        return f"{bounds['ge']} to {bounds['le']}"
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    return ", ".join(f"{words[name]} {bounds[name]}" for name in words if name in bounds)


def _limits_of(kind: str, context: dict[str, Any]) -> str:
    """Bound that was broken, from the error itself; for numbers inside lists."""
    words = {
        "greater_than": "above",
        "greater_than_equal": "at least",
        "less_than": "below",
        "less_than_equal": "at most",
    }
    bounds = [context[name] for name in ("gt", "ge", "lt", "le") if name in context]
    return f"{words[kind]} {bounds[0]}" if kind in words and bounds else ""


def _field_at(model: type[BaseModel], place: Sequence[int | str]) -> FieldInfo | None:
    """Field that a location names; None where it names an entry of a list."""
    if not place or not isinstance(place[-1], str):
        return None
    return _fields_at(model, place[:-1]).get(place[-1])


def _fields_at(model: type[BaseModel], place: Sequence[int | str]) -> dict[str, FieldInfo]:
    """Fields of the section that a location names."""
    section: type[BaseModel] | None = model
    for step in place:
        if section is None or isinstance(step, int):
            continue  # an entry of a list has the same section as the list
        field = section.model_fields.get(step)
        section = _section_of(field.annotation) if field else None
    return section.model_fields if section else {}


def _section_of(annotation: Any) -> type[BaseModel] | None:
    """Model within an annotation such as tuple[Model, ...] | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_section_of, get_args(annotation))), None)


def _dotted(place: Sequence[int | str]) -> str:
    """Location as poses[0].position."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return "".join(steps).removeprefix(".")


def _given(value: Any) -> str:
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

"""Translation of pydantic errors into sentences.

A sentence states the field, its value, the allowed values, and advice.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pydantic_core import ErrorDetails, ValidationError

from ..errors import Mistakes
from ..words import did_you_mean, list_names, plural
from .field_advice import Contradictory, list_advice, name_advice, place_advice
from .section_fields import (
    LIMITS,
    FieldPath,
    Fields,
    classes_in,
    fields_by_name,
    format_path,
    limits_of,
    range_words,
)
from .value_texts import format_value

# {pydantic error type: allowed values}
_ALLOWED = {
    "bool_type": "true or false",
    "dataclass_type": "a mapping",
    "dict_type": "a mapping",
    "float_type": "a number",
    "int_from_float": "a whole number",
    "int_type": "a whole number",
    "model_type": "a mapping",
    "string_type": "text",
}
_ITEMS = {float: "numbers", int: "whole numbers", str: "text"}  # {type of list items: noun}
_UNKNOWN_FIELD = ("extra_forbidden", "invalid_key", "unexpected_keyword_argument")


@contextmanager
def convert_validation_errors(
    section: Any,
    source: object = "",
    content: Any = None,
    contradictory: Contradictory = lambda content: False,
) -> Iterator[None]:
    """Convert a pydantic ValidationError raised in the context into a LidarError.

    The message has one line per mistake, prefixed with `source`. `content` is the content of the
    file, if known, which enables advice on unknown fields. `contradictory` returns whether the
    fields in a content contradict each other.
    """
    try:
        yield
    except ValidationError as error:
        mistakes = Mistakes()
        for details in _alike(error):
            line = _line(details, section, content, contradictory)
            mistakes.lines.append(f"{source}: {line}" if source else line)
        mistakes.raise_if_any()


def _alike(error: ValidationError) -> Iterable[Sequence[ErrorDetails]]:
    """Group the errors in a file by field and type. The entries of a list form one field."""
    details_by_path = {detail["loc"]: detail for detail in error.errors(include_url=False)}
    groups: dict[Any, list[ErrorDetails]] = {}  # {field and kind of error: errors}
    for path, detail in details_by_path.items():
        # If all entries of a list are invalid, pydantic also reports the list as too short.
        deeper = (other_path[: len(path)] == path != other_path for other_path in details_by_path)
        if detail["type"] == "too_short" and any(deeper):
            continue
        field = tuple(step for step in path if not isinstance(step, int))
        groups.setdefault((field, detail["type"]), []).append(detail)
    return groups.values()


def _line(
    details: Sequence[ErrorDetails], section: Any, content: Any, contradictory: Contradictory
) -> str:
    """Return a line about a group of errors.

    The line describes the first error, gives advice, and states how many errors follow.
    """
    detail, *further_details = details
    kind = detail["type"]
    path = detail["loc"]
    value = detail["input"]
    hint, fields = _annotation_at(path, section)
    advice = ""
    if kind in _UNKNOWN_FIELD and path:
        advice = place_advice(path, value, fields, section, content, contradictory)
    elif kind in ("list_type", "tuple_type"):
        advice = list_advice(hint, value)
    elif kind in ("model_type", "dataclass_type", "dict_type"):
        advice = name_advice(path, section)
    line = _sentence(path, detail, hint, advice)
    if not further_details:
        return line
    values = ""
    if kind == "literal_error":
        values = f": {list_names([*dict.fromkeys(_in_file(d['input']) for d in further_details)])}"
    others = plural(len(further_details), "other entry", "other entries")
    return f"{line} The same applies to {others}{values}."


def _in_file(value: Any) -> str:
    plain = str(value).lower() if isinstance(value, bool) else format_value(value)
    return "empty" if value is None else plain


def _sentence(path: FieldPath, detail: ErrorDetails, hint: Any, advice: str) -> str:
    """Compose a sentence from the location, the value, the allowed values and the advice."""
    location = format_path(path)
    kind = detail["type"]
    value = detail["input"]
    if kind == "value_error":
        message = str(detail["ctx"]["error"])
        return f"{location}: {message}" if location else message
    if kind in _UNKNOWN_FIELD:
        return f"Unknown field {location!r}.{advice}"
    if kind == "missing":
        return f"{location} is required."
    required = f"must {_requirement(detail, hint)}"
    if kind == "literal_error" and isinstance(value, str):
        suggestion = did_you_mean(value, re.findall(r"'([^']*)'", detail["ctx"]["expected"]))
        if suggestion:  # precedes the allowed values, because their list may be long
            return f"{location} cannot be {_in_file(value)}.{suggestion} It {required}."
    return f"{location} {required}, but is {_in_file(value)}.{advice}"


def _requirement(detail: ErrorDetails, hint: Any) -> str:
    """Return the requirement that a value violates, for example "be from 1 to 10"."""
    kind = detail["type"]
    context = detail.get("ctx", {})
    if kind in ("list_type", "tuple_type"):
        items = next((f" of {_ITEMS[kind]}" for kind in classes_in(hint) if kind in _ITEMS), "")
        return f"be a list{items}"
    if not context.keys().isdisjoint(LIMITS):
        limits = limits_of(hint)
        return f"be {range_words(limits if context.items() <= limits.items() else context)}"
    words = detail["msg"].partition(" should ")[2].partition(" after validation")[0]
    return f"be {_ALLOWED[kind]}" if kind in _ALLOWED else words or f"be valid ({detail['msg']})"


def _annotation_at(path: FieldPath, hint: Any) -> tuple[Any, Fields]:
    """Return the annotation at a path in a file and the fields of the enclosing section."""
    fields: Fields = {}
    inner = fields_by_name(hint)
    for step in path:
        fields = inner
        if step in fields:
            hint = fields[str(step)].rebuild_annotation()
            inner = fields_by_name(hint)
    return hint, fields

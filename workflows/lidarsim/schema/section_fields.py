"""Introspection of file sections, which are pydantic models or dataclasses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from pydantic.fields import FieldInfo

Fields = Mapping[str, FieldInfo]
FieldPath = tuple[int | str, ...]

_LIMIT_WORDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
LIMITS = tuple(_LIMIT_WORDS)  # limits of numbers, with the names used by `pydantic.Field`


def fields_by_name(hint: Any) -> Fields:
    """Return the fields of all sections in an annotation and of the kinds of these sections.

    The result maps names in files to fields.
    """
    kinds = (kind for section in sections_in(hint) for kind in (section, *kinds_of(section)))
    fields = (pair for kind in kinds for pair in fields_of(kind).items())
    return {field.alias or name: field for name, field in fields}


def kinds_of(section: Any) -> Sequence[Any]:
    """Return the more specific sections that a section may be, depending on its content.

    For example, the section for a file has one kind for each format with options. A section
    declares its kinds in a function `kinds`. This function is called only for messages and schemas
    because it imports the modules that declare the fields of the kinds.
    """
    return section.kinds() if "kinds" in vars(section) else ()


def fields_of(section: Any) -> Fields:
    """Return a mapping from the attributes of a section to its fields."""
    return getattr(section, "model_fields", None) or _dataclass_fields(section)


@cache
def _dataclass_fields(section: Any) -> Fields:
    hints = get_type_hints(section, include_extras=True)
    make_field = FieldInfo.from_annotated_attribute
    return {field.name: make_field(hints[field.name], field) for field in dataclass_fields(section)}


def is_section(kind: Any) -> bool:
    """Return whether a class is a section, which is a pydantic model or a dataclass."""
    return hasattr(kind, "model_fields") or is_dataclass(kind)


def sections_in(annotation: Any) -> Iterator[Any]:
    """Yield the sections in an annotation, such as `tuple[Section, ...] | None`."""
    return filter(is_section, classes_in(annotation))


def classes_in(annotation: Any) -> Iterator[type]:
    """Yield the classes in an annotation, such as `tuple[Class, ...] | None`."""
    if isinstance(annotation, type) and not get_args(annotation):
        yield annotation
    for inner in get_args(annotation):
        yield from classes_in(inner)


def own_limits(notes: Iterable[Any]) -> dict[str, Any]:
    """Return the limits in an annotation's metadata, keyed by their names in `pydantic.Field`.

    Nested annotations are not searched.
    """
    return {
        name: getattr(limit, name)
        for note in notes
        for limit in (note, *getattr(note, "metadata", ()))
        for name in (*LIMITS, "min_length", "max_length", "allow_inf_nan")
        if hasattr(limit, name)
    }


def limits_of(hint: Any) -> dict[str, Any]:
    """Return the limits for the numbers in an annotation, keyed by name."""
    inner = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    limits = {name: limit for arg in inner for name, limit in limits_of(arg).items()}
    own = own_limits(getattr(hint, "__metadata__", ()))
    return limits | {name: limit for name, limit in own.items() if name in LIMITS}


def range_words(limits: Mapping[str, Any]) -> str:
    """Format limits as text, for example "from 1 to 10" or "at least 1 and below 10"."""
    bounds = {name: limits[name] for name in _LIMIT_WORDS if name in limits}
    numbers = {name: limit if limit % 1 else int(limit) for name, limit in bounds.items()}
    if numbers.keys() == {"ge", "le"}:
        return f"from {numbers['ge']} to {numbers['le']}"
    return " and ".join(f"{_LIMIT_WORDS[name]} {number}" for name, number in numbers.items())


def format_path(path: Sequence[int | str]) -> str:
    """Format a path as text, for example "poses[0].position"."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return "".join(steps).removeprefix(".")

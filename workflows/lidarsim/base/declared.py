"""Declarations of quantities that users set: what a scenario file needs beyond Python's types.

A quantity is a field of a dataclass: `Annotated[type, told(description, limits)] = default`.
`checked_fields` lets the dataclass refuse values outside the limits, and be a section of a
scenario; other sections inherit its fields (`lidarpool.scenario.sections`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from math import inf
from typing import Annotated, Any, TypeVar

from pydantic import (
    BeforeValidator,
    Field,
    GetPydanticSchema,
    Strict,
    ValidationError,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

UnitShare = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Text = Annotated[str, Field(min_length=1)]
# Nothing on Earth is farther from the origin of its map.
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
AngleDeg = Annotated[float, Field(ge=-36_000, le=36_000)]

T = TypeVar("T")
# YAML has only lists, which strict validation does not accept as tuples.
Several = Annotated[tuple[T, ...], Strict(False)]
Two = Annotated[tuple[T, T], Strict(False)]
Three = Annotated[tuple[T, T, T], Strict(False)]
Four = Annotated[tuple[T, T, T, T], Strict(False)]
Triple = Three[Coordinate]


def _in_order(value: Any, handler: Callable[[Any], Any]) -> Any:
    ends = handler(value)
    if not 0 <= ends[1] - ends[0] < inf:
        raise must_be("[least, largest]")
    return ends


Ends = Annotated[Two[T], WrapValidator(_in_order)]  # least and largest number

# A field that may be empty in a scenario, because lidarpool then fills it in.
FILLED_IN = GetPydanticSchema(lambda kind, handler: handler(kind | None))


def about(description: str, *examples: Any, **limits: Any) -> Any:
    """Describe a field; one whose default is computed has examples."""
    return Field(description=description, examples=[*examples] or None, **limits)


def declared(thing: Any, by: type) -> dict[str, Any]:
    """Values that a thing has for the fields of one of its bases: {name: value}."""
    return {field.name: getattr(thing, field.name) for field in fields(by)}


def written_as(kind: Any) -> GetPydanticSchema:
    """Let a scenario have another type for a field than Python."""
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(kind))


def short(is_short: Callable[[Any], bool], long: Callable[[Any], Any], allowed: Any) -> Any:
    """Expand a short form in a scenario; `allowed` is its type, for the schema."""
    return BeforeValidator(
        lambda value: long(value) if is_short(value) else value, json_schema_input_type=allowed
    )


def by_text(field: str, kind: Any) -> Any:
    """Let a scenario give just the text of one field of a section: «hall.glb»."""
    return short(is_text, lambda value: {field: value}, Text | kind)


def one_of(*fields: str) -> Any:
    """Let a section have exactly one of some fields."""
    *others, last = fields
    words = f"one of {', '.join(others)} and" if others[1:] else f"either {others[0]} or"

    def one(section: Any) -> Any:
        if sum(bool(getattr(section, field)) for field in fields) != 1:
            raise ValueError(f"give {words} {last}.")
        return section

    return model_validator(mode="after")(one)


def allowed(words: str) -> WrapValidator:
    """Say what a field of several kinds takes, in one line instead of pydantic's for each."""

    def validated(value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise must_be(words) from None

    return WrapValidator(validated)


def must_be(words: str) -> PydanticCustomError:
    """Return an error of a validator that says what is allowed; the value is said before it."""
    return PydanticCustomError("allowed", "Input should be {words}", {"words": words})


def is_text(value: Any) -> bool:
    """Whether a value is text."""
    return isinstance(value, str)


# A list of texts, or one of them without the list.
Texts = Several[Text]
TextOrTexts = Annotated[Texts, short(is_text, lambda v: [v], Text | Texts)]

"""Declarations of quantities that users set, with descriptions and limits for scenario files.

A quantity is a field of a dataclass: `Annotated[type, about(description, limits)] = default`. The
dataclass checks the limits itself (`lidarsim.schema.checks.check_fields`). In scenario files it is
a section if it derives from `FileSection`; other sections inherit its fields
(`lidarpool.scenario.sections`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from math import inf
from typing import Annotated, Any, TypeVar

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetPydanticSchema,
    Strict,
    ValidationError,
    WrapValidator,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from ..errors import LidarError
from ..words import joined

UnitShare = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Text = Annotated[str, Field(min_length=1)]
# No point on Earth is farther from the origin of its map.
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
AngleDeg = Annotated[float, Field(ge=-36_000, le=36_000)]

# No further fields, finite numbers, no conversion of text to numbers.
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

T = TypeVar("T")
# YAML has only lists, which strict validation does not accept as tuples.
Several = Annotated[tuple[T, ...], Strict(False)]
Two = Annotated[tuple[T, T], Strict(False)]
Three = Annotated[tuple[T, T, T], Strict(False)]
Four = Annotated[tuple[T, T, T, T], Strict(False)]
Triple = Three[Coordinate]


def _in_order(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Validate two finite numbers in ascending order."""
    limits = handler(value)
    if not 0 <= limits[1] - limits[0] < inf:
        raise must_be("[least, largest]")
    return limits


MinMax = Annotated[Two[T], WrapValidator(_in_order)]  # least and largest number


def _upright(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Validate a rectangle, whose lowest x and y come first."""
    sides = handler(value)
    if sides[0] >= sides[2] or sides[1] >= sides[3]:
        raise must_be("[x0, y0, x1, y1] with the lower corner first")
    return sides


# Lowest x and y, highest x and y.
Rectangle = Annotated[Four[Coordinate], WrapValidator(_upright)]

# A field that may be empty in a scenario, because lidarpool then fills it in.
FILLED_IN = GetPydanticSchema(lambda kind, handler: handler(kind | None))


class FileSection:
    """Base class of dataclasses that are sections of files, as a mapping of their fields."""

    __pydantic_config__ = STRICT

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        inner_schema: Any = handler.resolve_ref_schema(schema)
        inner_schema["strict"] = False  # a strict schema accepts only instances

        def validated(value: Any, validate: Callable[[Any], Any]) -> Any:
            try:
                return validate(value)
            except LidarError as error:  # raised in `__post_init__`
                raise ValueError(str(error)) from error

        return core_schema.no_info_wrap_validator_function(validated, schema)


def about(description: str, *examples: Any, **limits: Any) -> Any:
    """Describe a field, with examples if its default is computed."""
    return Field(description=description, examples=[*examples] or None, **limits)


def declared(instance: Any, base: type) -> dict[str, Any]:
    """Return the values of an instance for the fields of a base class: {name: value}."""
    return {field.name: getattr(instance, field.name) for field in fields(base)}


def written_as(kind: Any) -> GetPydanticSchema:
    """Give a field a type in scenarios that differs from its type in Python."""
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(kind))


def short(is_short: Callable[[Any], bool], long: Callable[[Any], Any], allowed: Any) -> Any:
    """Expand the short form of a value in scenarios, of type `allowed` in the schema."""
    return BeforeValidator(
        lambda value: long(value) if is_short(value) else value, json_schema_input_type=allowed
    )


def by_text(field: str, kind: Any) -> Any:
    """Accept the text of a single field in place of a section: «hall.glb»."""
    return short(is_text, lambda value: {field: value}, Text | kind)


def one_of(*fields: str) -> Any:
    """Check that a section has exactly a single value among given fields."""

    def check(section: Any) -> Any:
        if sum(bool(getattr(section, field)) for field in fields) != 1:
            raise ValueError(f"Set exactly one of {joined(fields)}.")
        return section

    return model_validator(mode="after")(check)


def allowed(words: str) -> WrapValidator:
    """Replace pydantic's errors for a field of several types by a line: «be a number or text»."""

    def validated(value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise must_be(words) from None

    return WrapValidator(validated)


def must_be(words: str) -> PydanticCustomError:
    """Return a validator's error on the allowed values.

    Messages name the value before.
    """
    return PydanticCustomError("allowed", "Input should be {words}", {"words": words})


def is_text(value: Any) -> bool:
    """Return True if a value is text."""
    return isinstance(value, str)


# A list of texts, or a single text.
Texts = Several[Text]
TextOrTexts = Annotated[Texts, short(is_text, lambda v: [v], Text | Texts)]
# The same as an argument in Python.
Names = Annotated[str | Sequence[Text], written_as(TextOrTexts)]

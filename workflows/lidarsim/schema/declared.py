"""Declarations of user settings, with descriptions and limits for scenario files.

A setting is a dataclass field that is declared as
`Annotated[type, about(description, limits)] = default`. The dataclass validates the limits with
`lidarsim.schema.checks.check_fields`. A dataclass that derives from `FileSection` is a section in
scenario files. Other sections inherit its fields (`lidarscenario.sections`).
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
from ..words import join_names

UnitShare = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Text = Annotated[str, Field(min_length=1)]
# No coordinate in a map projection of the Earth exceeds this limit.
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
AngleDeg = Annotated[float, Field(ge=-36_000, le=36_000)]

# Rejects unknown fields and nonfinite numbers, and does not convert text to numbers.
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

T = TypeVar("T")
# YAML sequences are loaded as lists, which strict validation would not accept as tuples.
Several = Annotated[tuple[T, ...], Strict(False)]
Two = Annotated[tuple[T, T], Strict(False)]
Three = Annotated[tuple[T, T, T], Strict(False)]
Four = Annotated[tuple[T, T, T, T], Strict(False)]
Triple = Three[Coordinate]


def _in_order(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Check that a pair of finite numbers is in ascending order."""
    limits = handler(value)
    if not 0 <= limits[1] - limits[0] < inf:
        raise not_allowed_error("[least, largest]")
    return limits


MinMax = Annotated[Two[T], WrapValidator(_in_order)]  # minimum and maximum


def _upright(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Check that a rectangle states its minimum x and y first."""
    sides = handler(value)
    if sides[0] >= sides[2] or sides[1] >= sides[3]:
        raise not_allowed_error("[x0, y0, x1, y1] with the lower corner first")
    return sides


# Minimum x, minimum y, maximum x, maximum y.
Rectangle = Annotated[Four[Coordinate], WrapValidator(_upright)]

# A field that may be null in a scenario, in which case lidarpool computes its value.
FILLED_IN = GetPydanticSchema(lambda kind, handler: handler(kind | None))


class FileSection:
    """Base class for dataclasses that scenario files represent as a mapping of their fields."""

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
    """Declare the description, examples and limits of a field.

    Examples are useful if the default is computed.
    """
    return Field(description=description, examples=[*examples] or None, **limits)


def declared_values(instance: Any, base: type) -> dict[str, Any]:
    """Return the values of an instance in the fields that a base class declares.

    The result maps field names to values.
    """
    return {field.name: getattr(instance, field.name) for field in fields(base)}


def scenario_type(kind: Any) -> GetPydanticSchema:
    """Declare that a field has a different type in scenarios than in Python."""
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(kind))


def accept_short_form(
    is_short: Callable[[Any], bool], long: Callable[[Any], Any], allowed: Any
) -> Any:
    """Accept a short form of a value in scenarios, and expand it.

    `allowed` is the type of the input in the JSON schema, including the short form.
    """
    return BeforeValidator(
        lambda value: long(value) if is_short(value) else value,
        json_schema_input_type=allowed,
    )


def accept_text(field: str, kind: Any) -> Any:
    """Accept a string such as "hall.glb" as a short form of a section with one field."""
    return accept_short_form(is_text, lambda value: {field: value}, Text | kind)


def require_one_of(*fields: str) -> Any:
    """Check that exactly one of the given fields is set in a section."""

    def check(section: Any) -> Any:
        if sum(bool(getattr(section, field)) for field in fields) != 1:
            raise ValueError(f"Set exactly one of {join_names(fields)}.")
        return section

    return model_validator(mode="after")(check)


def describe_allowed(words: str) -> WrapValidator:
    """Replace the pydantic errors for a field of several types with a single line.

    `words` describes the allowed values, for example "from 0 to 1, or texture".
    """

    def validated(value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise not_allowed_error(words) from None

    return WrapValidator(validated)


def not_allowed_error(words: str) -> PydanticCustomError:
    """Return the error that a validator raises for a value that is not allowed.

    `words` describes the allowed values. In the message for the user, it follows the location of
    the value and "must be".
    """
    return PydanticCustomError("allowed", "Input should be {words}", {"words": words})


def is_text(value: Any) -> bool:
    """Return whether a value is a string."""
    return isinstance(value, str)


# A list of strings, or a single string.
Texts = Several[Text]
TextOrTexts = Annotated[Texts, accept_short_form(is_text, lambda v: [v], Text | Texts)]
# The corresponding type of arguments in Python.
Names = Annotated[str | Sequence[Text], scenario_type(TextOrTexts)]

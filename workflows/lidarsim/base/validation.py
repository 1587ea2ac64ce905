"""Validation of arguments and of the fields of dataclasses by pydantic's core.

pydantic's `validate_call` and `pydantic.dataclasses` (2.14) replace none of this: they pass on
copies of lists and tuples, read iterators before the function does, make 1.0 of 1, and refuse whole
numbers of NumPy, arrays of numbers, a default such as None that a caller passes on, protocols, and
most classes of this package, since these are sections of files with arrays. Declaring a function
takes them 1.1 ms, a class 10 ms (0.1 and 2.6 ms here), a call 6.3 µs instead of 7.6 µs.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from datetime import datetime
from functools import cache, partial, reduce, wraps
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike, DTypeLike
from pydantic import ConfigDict, GetCoreSchemaHandler, WrapValidator
from pydantic_core import PydanticKnownError, SchemaValidator, ValidationError, core_schema

from .arrays import AnyArray
from .error_sentences import argument_error
from .errors import ArgumentError, LidarError
from .section_fields import LIMITS, limits_of
from .signatures import ReadableSignature, readable
from .value_texts import one_line, shown
from .words import did_you_mean

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)

_OF_MATERIALS = " Classes belong to materials, such as Material('Car', semantic_class=1)."
_OF_HEADINGS = " Did you mean 'yaw_deg'? It is 90 minus a compass heading."
# {name that is tried: {an argument of the function or class: advice}}, where `did_you_mean` does
# not help.
_ADVICE = {
    "class_": {"semantic_class": " Did you mean 'semantic_class'?", "mesh": _OF_MATERIALS},
    "semantic_class": {"mesh": _OF_MATERIALS},
    "heading_deg": {"yaw_deg": _OF_HEADINGS},
    "heading": {"yaw_deg": _OF_HEADINGS},
}

# No further fields, finite numbers, no conversion of text to numbers.
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

_LENGTHS = ("min_length", "max_length")
# {class: function that makes its schema, and the limits that the function takes}
_SCALARS: dict[Any, tuple[Callable[..., Any], Collection[str]]] = {
    bool: (core_schema.bool_schema, ()),
    int: (core_schema.int_schema, LIMITS),
    float: (core_schema.float_schema, (*LIMITS, "allow_inf_nan")),
    str: (core_schema.str_schema, _LENGTHS),
    datetime: (core_schema.datetime_schema, ()),
    NoneType: (core_schema.none_schema, ()),
}


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that do not fit their annotations, without changing values.

    Raises
    ------
    LidarError
        From the function: the argument, its value, and the allowed values.
    """

    @wraps(function)
    def checked_function(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_unknown(function, kwargs)
        # Python reports too many and too few arguments.
        _check(function, {**dict(zip(_defaults(function), args, strict=False)), **kwargs})
        return function(*args, **kwargs)

    checked_function.__signature__ = readable(  # type: ignore[attr-defined]
        inspect.signature(function), function.__globals__
    )
    return checked_function


def checked_fields(cls: C) -> C:
    """Let a dataclass refuse values that do not fit their annotations, in subclasses too.

    In a section of a file the dataclass is a section itself, of the same fields. Its `repr` is one
    line, and its signature has types without limits.

    Apply the decorator before `dataclass`, which calls `__post_init__` only if the class has one.
    """
    post_init: Callable[[Any], None] = getattr(cls, "__post_init__", lambda self: None)

    def __post_init__(self: Any, *init_vars: Any) -> None:  # noqa: N807
        _check(cls, vars(self))
        post_init(self, *init_vars)

    def __new__(kind: type, /, *args: Any, **kwargs: Any) -> Any:  # noqa: N807
        refuse_unknown(kind, kwargs)
        return object.__new__(kind)

    cls.__new__ = __new__  # type: ignore[method-assign]
    cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
    cls.__signature__ = ReadableSignature()  # type: ignore[attr-defined]
    cls.__pydantic_config__ = STRICT  # type: ignore[attr-defined]
    cls.__get_pydantic_core_schema__ = classmethod(_section)  # type: ignore[attr-defined]
    if "__repr__" not in vars(cls):
        cls.__repr__ = one_line  # type: ignore[method-assign, assignment]
        # Else `dataclass` gives a subclass, another kind of sensor, a repr of all fields.
        cls.__init_subclass__ = classmethod(  # type: ignore[assignment]
            lambda kind: setattr(kind, "__repr__", vars(kind).get("__repr__", one_line))
        )
    return cls


def _section(_: type, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
    """Return the schema of a dataclass as a section: a mapping of its fields, or an instance."""
    schema = handler(source)
    inner_schema: Any = handler.resolve_ref_schema(schema)
    inner_schema["strict"] = False  # a strict schema takes only instances

    def converted(value: Any, validate: Callable[[Any], Any]) -> Any:
        try:
            return validate(value)
        except LidarError as error:  # raised in `__post_init__`
            raise ValueError(str(error)) from error

    return core_schema.no_info_wrap_validator_function(converted, schema)


def _check(target: Any, values: Mapping[str, Any]) -> None:
    """Check that values, except defaults, fit the annotations of a function or dataclass."""
    defaults = _defaults(target)
    values = {
        # pydantic takes NumPy's truth values for numbers.
        name: bool(value) if isinstance(value, np.bool_) else value
        for name, value in values.items()
        if value is not defaults.get(name, defaults)
    }
    if not values:
        return
    validator, hints = _validator(target)
    try:
        validator.validate_python(values)
    except ValidationError:
        try:
            validator.validate_python(without_numpy(values))
        except ValidationError as error:
            raise ArgumentError(argument_error(error, hints)) from None


def refuse_unknown(target: Any, arguments: Collection[str]) -> None:
    """Raise TypeError for names that are no arguments of a function or class, with a hint."""
    if not arguments:
        return
    known = _keywords(target)
    if known is None:
        return
    for name in arguments:
        if name in known:
            continue
        advice = _ADVICE.get(name, {})
        hints = (advice[argument] for argument in advice if argument in known)
        place = target.__qualname__.removesuffix(".__init__")
        hint = next(hints, "") or did_you_mean(name, known)
        raise TypeError(f"{place}() got an unexpected keyword argument {name!r}.{hint}")


@cache
def _keywords(target: Any) -> frozenset[str] | None:
    """Return the names of the arguments of a function or class, or None if it takes any name."""
    function = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    parameters = inspect.signature(function).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return None
    return frozenset(parameters)


def without_numpy(value: Any) -> Any:
    """Return a value with NumPy's numbers and arrays replaced by Python's numbers and lists."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim < 2:
        return value.tolist()
    if isinstance(value, dict):
        return {key: without_numpy(item) for key, item in value.items()}
    return type(value)(map(without_numpy, value)) if type(value) in (list, tuple) else value


@cache
def _defaults(target: Any) -> dict[str, Any]:
    """Return the defaults of the parameters of a function, or of the fields of a dataclass."""
    if isinstance(target, type):
        return {field.name: field.default for field in dataclass_fields(target)}
    return {
        name: parameter.default for name, parameter in inspect.signature(target).parameters.items()
    }


@cache
def _validator(target: Any) -> tuple[SchemaValidator, dict[str, Any]]:
    """Return the validator and annotations of the arguments or fields of a target."""
    annotations = get_type_hints(target, include_extras=True)
    hints = {name: annotations[name] for name in _defaults(target) if name in annotations}
    field = partial(core_schema.typed_dict_field, required=False)
    config = core_schema.CoreConfig(strict=True, allow_inf_nan=False)
    table = {name: field(_schema(hint)) for name, hint in hints.items()}
    return SchemaValidator(core_schema.typed_dict_schema(table, config=config)), hints


def _schema(hint: Any, limits: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Return pydantic's schema of an annotation in Python.

    A class takes its instances, a protocol all objects with its attributes; arrays are not checked.
    pydantic's `TypeAdapter` would make a class that is a section take mappings, and needs 0.3 ms
    for a number with limits, where this function needs 0.07 ms.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        schema = _schema(args[0], limits_of(hint, (*LIMITS, *_LENGTHS, "allow_inf_nan")))
        functions: list[Any] = [n.func for n in hint.__metadata__ if isinstance(n, WrapValidator)]
        wrapped = core_schema.no_info_wrap_validator_function
        return reduce(lambda inner, function: wrapped(function, inner), functions, schema)
    if origin in (Union, UnionType):
        return core_schema.union_schema([_schema(arg, limits) for arg in args])
    if origin in (Sequence, Collection, Iterable, tuple):
        return _list_schema(args, limits, is_tuple=origin is tuple)
    if origin is Literal:
        return core_schema.literal_schema([*args])
    if hint in _SCALARS:
        make, limit_names = _SCALARS[hint]
        return make(**{name: limit for name, limit in limits.items() if name in limit_names})
    if origin is Callable:
        return core_schema.callable_schema()
    if hint is Any or not isinstance(origin or hint, type) or origin is np.ndarray:
        return core_schema.any_schema()
    if getattr(hint, "_is_protocol", False):
        return core_schema.no_info_plain_validator_function(_attribute_check(hint))
    return core_schema.is_instance_schema(os.PathLike if hint is Path else origin or hint)


def _list_schema(types: tuple[Any, ...], limits: Mapping[str, Any], is_tuple: bool) -> Any:
    """Return pydantic's schema of a list, or of a tuple.

    An iterator is not checked.
    """
    items = [_schema(kind) for kind in types if kind is not ...]
    if core_schema.any_schema() in items:
        return items[0]
    lengths = {name: limit for name, limit in limits.items() if name in _LENGTHS}
    index = None if is_tuple and ... not in types else 0
    schema = core_schema.tuple_schema(items, variadic_item_index=index, strict=False, **lengths)
    return core_schema.no_info_wrap_validator_function(_unless_iterator, schema)


def _unless_iterator(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Validate a value, except an iterator, which only the function may read."""
    return value if isinstance(value, Iterator) else handler(value)


def _attribute_check(protocol: type) -> Callable[[Any], Any]:
    """Return a validator that refuses values without the attributes of a protocol."""
    names = [name for name in vars(protocol) if not name.startswith("_")]

    def with_attributes(value: Any) -> Any:
        # The class first, since a property of the instance may take long.
        if not all(hasattr(type(value), name) or hasattr(value, name) for name in names):
            raise PydanticKnownError("is_instance_of", {"class": protocol.__name__})
        return value

    return with_attributes


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Return values as an array of numbers.

    Raises LidarError for values that are not numbers.
    """
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise LidarError(f"{name} must be an array of numbers, but is {shown(values)}.") from error

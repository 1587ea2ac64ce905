"""Checks of arguments and of the fields of dataclasses, which raise ArgumentError.

A dataclass whose fields users set calls `check_fields` in its `__post_init__`. The limits are
those that `Field` or `about` state in the annotations, which scenario files use as well.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields as dataclass_fields
from functools import cache
from math import isfinite
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, Protocol, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from .arrays import AnyArray
from .errors import ArgumentError
from .section_fields import LIMITS, own_limits, range_words
from .value_texts import shown, with_article
from .words import alternatives, did_you_mean

_NO_LIMITS: Mapping[str, Any] = MappingProxyType({})
_WITHIN = {"ge": operator.ge, "gt": operator.gt, "le": operator.le, "lt": operator.lt}
_WHOLE = (int, np.integer)
_REAL = (float, np.floating)
_LISTS = (tuple, list, Sequence, Collection, Iterable)
_NUMBERS = {float: "number", int: "whole number"}
_SCALARS = {bool: "true or false", str: "text", NoneType: "None"}


def check_type(name: str, value: object, *kinds: type, advice: str = "") -> None:
    """Check that an argument is an instance of one of several classes."""
    if not isinstance(value, kinds):
        words = ["None" if kind is NoneType else with_article(kind.__name__) for kind in kinds]
        raise _wrong(name, value, alternatives(words), advice)


def check_items(name: str, values: object, *kinds: type, advice: str = "") -> None:
    """Check that an argument is a list of instances of one of several classes."""
    check_list(name, values)
    for index, item in enumerate(values):  # type: ignore[arg-type, var-annotated]
        check_type(f"{name}[{index}]", item, *kinds, advice=advice)


def check_list(name: str, value: object) -> None:
    """Check that an argument can be iterated over, and is not a single text."""
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
        raise _wrong(name, value, "a list")


def check_order(name: str, limits: Sequence[float]) -> None:
    """Check that the second of two numbers is not less than the first."""
    if not limits[0] <= limits[1]:
        raise _wrong(name, limits, "[least, largest]")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Check that an argument is one of several names."""
    if value not in choices:
        hint = did_you_mean(value, choices) if isinstance(value, str) else ""
        raise _wrong(name, value, alternatives([*map(repr, choices)]), hint)


def check_number(name: str, value: object, *, whole: bool = False, **limits: float) -> None:
    """Check that an argument is a finite number within limits: ge, gt, le and lt."""
    if not _number_test(whole, limits)(value):
        raise _wrong(name, value, _number_words(int if whole else float, limits))


def check_fits(name: str, value: object, hint: Any) -> None:
    """Check that an argument has the type, the choices and the limits of an annotation."""
    if not _cached_test_of(hint)(value):
        raise _wrong(name, value, _words(hint))


def check_fields(instance: Any) -> None:
    """Check the fields of a dataclass against the types, choices and limits in its annotations.

    Defaults are always valid. Arrays, mappings and protocols are not checked.
    """
    values = vars(instance)
    for name, default, hint, fits in _checked_fields(type(instance)):  # type: ignore[arg-type]
        value = values[name]
        if value is not default and not fits(value):
            raise _wrong(name, value, _words(hint))


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Return values as an array of numbers.

    Raises ArgumentError for values that are not numbers.
    """
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise _wrong(name, values, "an array of numbers") from error


def _wrong(name: str, value: object, allowed: str, advice: str = "") -> ArgumentError:
    """Return the error of an argument."""
    return ArgumentError(f"{name} must be {allowed}, but is {shown(value)}.{advice}")


@cache
def _checked_fields(kind: type) -> Sequence[tuple[str, Any, Any, Callable[[Any], bool]]]:
    """Return the fields of a dataclass: name, default, annotation, and a test of the value."""
    hints = get_type_hints(kind, include_extras=True)
    return [
        (field.name, field.default, hints[field.name], _test_of(hints[field.name]))
        for field in dataclass_fields(kind)
    ]


def _test_of(hint: Any, limits: Mapping[str, Any] = _NO_LIMITS) -> Callable[[Any], bool]:
    """Return a function that tests whether a value has the type and limits of an annotation."""
    origin = get_origin(hint)
    args = get_args(hint)
    if notes := getattr(hint, "__metadata__", ()):
        return _test_of(args[0], own_limits(notes))
    if origin in (Union, UnionType):
        tests = [_test_of(arg, limits) for arg in args]
        return lambda value: any(test(value) for test in tests)
    if origin is Literal:
        return lambda value: isinstance(value, (str, *_WHOLE)) and value in args
    if origin in _LISTS:
        return _list_test(origin, args, limits)
    if hint in _NUMBERS:
        return _number_test(hint is int, limits)
    if hint is str:
        return lambda value: isinstance(value, str) and _has_length(value, limits)
    if hint is bool:
        return lambda value: isinstance(value, (bool, np.bool_))
    if hint is Any or origin or not isinstance(hint, type) or Protocol in hint.__bases__:
        return lambda value: True  # such as functions, mappings and arrays
    return lambda value: isinstance(value, hint)


_cached_test_of = cache(_test_of)


def _list_test(
    origin: Any, args: tuple[Any, ...], limits: Mapping[str, Any]
) -> Callable[[Any], bool]:
    """Return `_test_of` an annotation of a list, whose iterators are not read."""
    tests = [_test_of(arg) for arg in args if arg is not ...]
    is_fixed = origin is tuple and ... not in args

    def fits(value: Any) -> bool:
        if isinstance(value, (str, bytes)) or not isinstance(value, Collection):
            return isinstance(value, Iterator)
        if isinstance(value, np.ndarray) and not value.ndim:
            return False
        if is_fixed:
            return len(value) == len(tests) and all(
                test(item) for test, item in zip(tests, value, strict=True)
            )
        return _has_length(value, limits) and all(map(tests[0], value))

    return fits


def _number_test(whole: bool, limits: Mapping[str, Any]) -> Callable[[Any], bool]:
    """Return a function that tests for a number within limits, which is finite by default."""
    kinds = _WHOLE if whole else _WHOLE + _REAL
    bounds = [(_WITHIN[name], limits[name]) for name in LIMITS if name in limits]
    may_be_infinite = limits.get("allow_inf_nan", False)

    def fits(value: Any) -> bool:
        if isinstance(value, np.ndarray) and not value.ndim:
            value = value[()]
        return (
            isinstance(value, kinds)
            and not isinstance(value, bool)
            and (may_be_infinite or isinstance(value, _WHOLE) or isfinite(value))
            and all(within(value, limit) for within, limit in bounds)
        )

    return fits


def _has_length(value: Any, limits: Mapping[str, Any]) -> bool:
    """Return whether a list or text is neither too short nor too long."""
    return limits.get("min_length", 0) <= len(value) <= limits.get("max_length", len(value))


def _words(hint: Any, limits: Mapping[str, Any] = _NO_LIMITS) -> str:
    """Return the values that an annotation allows: «a number from 1 to 10 or None»."""
    args = get_args(hint)
    if hint in _NUMBERS:
        return _number_words(hint, limits)
    if hint in _SCALARS:
        return "a text that is not empty" if limits.get("min_length") == 1 else _SCALARS[hint]
    if notes := getattr(hint, "__metadata__", ()):
        return _words(args[0], own_limits(notes))
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return alternatives([*dict.fromkeys(_words(arg, limits) for arg in args)])
    if origin is Literal:
        return alternatives([*map(repr, args)])
    if origin in _LISTS:
        return _list_words(args, limits)
    return with_article(getattr(origin or hint, "__name__", str(hint)))


def _number_words(kind: Any, limits: Mapping[str, Any]) -> str:
    bounds = range_words(limits)
    is_finite = kind is float and not bounds and not limits.get("allow_inf_nan")
    return f"a {'finite ' * is_finite}{_NUMBERS[kind]} {bounds}".rstrip()


def _list_words(kinds: Sequence[Any], limits: Mapping[str, Any]) -> str:
    """Return the lists that are allowed: «a list of 3 numbers from 0 to 1»."""
    item, *others = dict.fromkeys(_words(kind) for kind in kinds if kind is not ...)
    if others:
        return f"[{', '.join([item, *others])}]"
    item = re.sub("^an? ", "", item).replace("number", "numbers", 1)
    count = len(kinds) if len(kinds) > 1 and ... not in kinds else limits.get("max_length")
    return f"a list of {item}" if count is None else f"a list of {count} {item}"

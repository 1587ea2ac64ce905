"""Validation of arguments and dataclass fields, which raises ArgumentError.

Dataclasses with fields that users set call `check_fields` in `__post_init__`. The limits are
declared in the annotations with `Field` or `about`, and also apply to scenario files.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cache
from math import isfinite
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from ..errors import ArgumentError
from ..numerics.arrays import AnyArray
from ..words import did_you_mean, join_alternatives
from .section_fields import LIMITS, own_limits, range_words
from .value_texts import format_value, with_article

_NO_LIMITS: Mapping[str, Any] = MappingProxyType({})
_WITHIN = {"ge": operator.ge, "gt": operator.gt, "le": operator.le, "lt": operator.lt}
_WHOLE = (int, np.integer)
_LISTS = (tuple, list, Sequence, Collection, Iterable)


def check_type(name: str, value: object, *kinds: type, advice: str = "") -> None:
    """Check that an argument is an instance of one of the given classes."""
    if not isinstance(value, kinds):
        words = ["None" if kind is NoneType else with_article(kind.__name__) for kind in kinds]
        raise _wrong(name, value, join_alternatives(words), advice)


def check_items(name: str, values: object, *kinds: type, advice: str = "") -> None:
    """Check that an argument is a list whose items are instances of the given classes."""
    check_list(name, values)
    for index, item in enumerate(values):  # type: ignore[arg-type, var-annotated]
        check_type(f"{name}[{index}]", item, *kinds, advice=advice)


def check_list(name: str, value: object) -> None:
    """Check that an argument is iterable but not a string."""
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
        raise _wrong(name, value, "a list")


def check_order(name: str, limits: Sequence[float]) -> None:
    """Check that a pair of numbers is in ascending order."""
    if not limits[0] <= limits[1]:
        raise _wrong(name, limits, "[least, largest]")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Check that an argument is one of the given names."""
    if value not in choices:
        hint = did_you_mean(value, choices) if isinstance(value, str) else ""
        raise _wrong(name, value, join_alternatives([*map(repr, choices)]), hint)


def check_number(name: str, value: object, *, whole: bool = False, **limits: float) -> None:
    """Check that an argument is a finite number within limits.

    The limits are the keyword arguments `ge`, `gt`, `le` and `lt`, with the same meaning as in
    pydantic.
    """
    rule = _number_rule(whole, limits)
    if not rule.fits(value):
        raise _wrong(name, value, rule.allowed)


def check_fits(name: str, value: object, hint: Any) -> None:
    """Check an argument against the type, choices and limits in an annotation."""
    rule = _cached_rule(hint)
    if not rule.fits(value):
        raise _wrong(name, value, rule.allowed)


def check_fields(instance: Any) -> None:
    """Check the fields of a dataclass against the types, choices and limits in its annotations.

    Defaults are always valid. Arrays, mappings and protocols are not checked.
    """
    values = vars(instance)
    for name, default, rule in _field_rules(type(instance)):  # type: ignore[arg-type]
        value = values[name]
        if value is not default and not rule.fits(value):
            raise _wrong(name, value, rule.allowed)


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Convert values to a numeric array.

    Raises
    ------
    ArgumentError
        If the values are not numbers.
    """
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise _wrong(name, values, "an array of numbers") from error


def _wrong(name: str, value: object, allowed: str, advice: str = "") -> ArgumentError:
    return ArgumentError(f"{name} must be {allowed}, but is {format_value(value)}.{advice}")


class _Rule(NamedTuple):
    """Validation rule that follows from an annotation."""

    fits: Callable[[Any], bool]
    allowed: str  # description of the valid values, such as "a number from 1 to 10 or None"


@cache
def _field_rules(kind: type) -> Sequence[tuple[str, Any, _Rule]]:
    """Return the name, default and validation rule of each field of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return [(field.name, field.default, _rule(hints[field.name])) for field in fields(kind)]


def _rule(hint: Any, limits: Mapping[str, Any] = _NO_LIMITS) -> _Rule:
    """Return the validation rule for an annotation.

    `limits` are those of the enclosing `Annotated`.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if notes := getattr(hint, "__metadata__", ()):
        return _rule(args[0], own_limits(notes))
    if origin in (Union, UnionType):
        rules = [_rule(arg, limits) for arg in args]
        words = join_alternatives([*dict.fromkeys(rule.allowed for rule in rules)])
        return _Rule(lambda value: any(rule.fits(value) for rule in rules), words)
    if origin is Literal:
        words = join_alternatives([*map(repr, args)])
        return _Rule(lambda value: isinstance(value, (str, *_WHOLE)) and value in args, words)
    if origin in _LISTS:
        return _list_rule([_rule(arg) for arg in args if arg is not ...], limits)
    if hint in (int, float):
        return _number_rule(hint is int, limits)
    if hint is str:
        return _Rule(lambda value: isinstance(value, str) and _has_length(value, limits), "text")
    if hint is bool:
        return _Rule(lambda value: isinstance(value, (bool, np.bool_)), "true or false")
    if hint is Any or origin or not isinstance(hint, type) or Protocol in hint.__bases__:
        name = getattr(origin or hint, "__name__", str(hint))
        # Functions, mappings and arrays are not checked.
        return _Rule(lambda value: True, with_article(name))
    words = "None" if hint is NoneType else with_article(hint.__name__)
    return _Rule(lambda value: isinstance(value, hint), words)


_cached_rule = cache(_rule)


def _list_rule(items: Sequence[_Rule], limits: Mapping[str, Any]) -> _Rule:
    """Return the rule for a list whose items share a rule, or for a tuple with one rule per item.

    Iterators are accepted without being consumed.
    """
    count = limits.get("max_length") if len(items) == 1 else len(items)

    def fits(values: Any) -> bool:
        if isinstance(values, (str, bytes)) or not isinstance(values, Collection):
            return isinstance(values, Iterator)
        if isinstance(values, np.ndarray) and not values.ndim:
            return False
        if len(items) == 1:
            return _has_length(values, limits) and all(map(items[0].fits, values))
        return len(values) == len(items) and all(
            item.fits(value) for item, value in zip(items, values, strict=True)
        )

    words = list(dict.fromkeys(item.allowed for item in items))
    if len(words) > 1:
        return _Rule(fits, f"[{', '.join(words)}]")
    item = re.sub("^an? ", "", words[0]).replace("number", "numbers", 1)
    return _Rule(fits, f"a list of {item}" if count is None else f"a list of {count} {item}")


def _number_rule(whole: bool, limits: Mapping[str, Any]) -> _Rule:
    """Return the rule for a number, which must be finite unless the limits allow infinity."""
    kinds = _WHOLE if whole else (float, np.floating, *_WHOLE)
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

    noun = "whole number" if whole else "number" if bounds or may_be_infinite else "finite number"
    return _Rule(fits, f"a {noun} {range_words(limits)}".rstrip())


def _has_length(value: Any, limits: Mapping[str, Any]) -> bool:
    return limits.get("min_length", 0) <= len(value) <= limits.get("max_length", len(value))

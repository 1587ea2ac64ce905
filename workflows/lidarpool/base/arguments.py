"""Checks arguments of Python calls: errors name the value given and the values allowed."""

from __future__ import annotations

import inspect
import operator
import os
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
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

from ..base.arrays import AnyArray
from .errors import LidarpoolError

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)
Kind = tuple[Callable[[Any], bool], str]  # whether a value fits, and what fits in words

# {annotation: description of allowed values}
_KINDS: dict[Any, tuple[tuple[type, ...], str]] = {
    int: ((Integral,), "a whole number"),
    float: ((Real,), "a number"),
    bool: ((bool, np.bool_), "True or False"),
    str: ((str,), "text"),
    Path: ((os.PathLike,), "a path"),
    NoneType: ((NoneType,), "None"),
}
# {class: an example}
_EXAMPLES = {
    "Beams": "Beams.even(32, 40)",
    "Gnss": "Gnss(horizontal_m=0.02)",
    "Imu": "Imu(gyroscope_noise_density=1e-4)",
    "Material": "Material('Window*', reflectance=0.1)",
    "Mesh": "Mesh('hall', vertices, faces)",
    "Mounted": "Mounted(sensor, Pose((1, 0, 2)), 'roof')",
    "Navigation": "Navigation(imu=Imu(), gnss=Gnss())",
    "Noise": "Noise(range_m=0.01)",
    "Planning": "Planning((0, 0), (10, 0), centres=[(5, 0)], radii=2)",
    "Pose": "Pose((0, 0, 1), yaw_deg=90)",
    "Returns": "Returns('dual')",
    "Scene": "Scene.load('hall.glb')",
    "Sensor": "load_sensor('velodyne/vlp16')",
    "Survey": "Survey(poses=[(0, 0, 1)])",
    "Trajectory": "load_trajectory('drive.tum')",
}
# Limits of a field: {as pydantic's `Field` has it: (whether a value fits, in words)}
_LIMITS: dict[str, tuple[Callable[[Any, Any], bool], str]] = {
    "ge": (operator.ge, "at least"),
    "gt": (operator.gt, "above"),
    "le": (operator.le, "at most"),
    "lt": (operator.lt, "below"),
    "min_length": (lambda value, least: len(value) >= least, "of length at least"),
}
_PLAIN = (*(kind for kind in _KINDS if kind is not Path), list, tuple, dict, bytes)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that do not fit their annotations.

    Raises
    ------
    LidarpoolError
        From the function: the argument, its value, and what it must be.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def refusing(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # Python reports too many, too few and unknown ones
        kinds = _kinds(function)
        for name, value in given.items():
            if name in kinds and value is not signature.parameters[name].default:
                _check(name, value, *kinds[name])
        return function(*args, **kwargs)

    return refusing


def checked_fields(cls: C) -> C:
    """Let a dataclass refuse values that do not fit their annotations, also in subclasses.

    Apply it before `dataclass`, which calls `__post_init__` only if the class has one.
    """
    after: Callable[[Any], None] = getattr(cls, "__post_init__", lambda self: None)

    def __post_init__(self: Any) -> None:  # noqa: N807
        for name, kind in _kinds(cls).items():
            value = getattr(self, name)
            if value is not getattr(cls, name, inspect.Parameter.empty):
                _check(name, value, *kind)
        after(self)

    cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
    return cls


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Return values as an array of numbers; LidarpoolError if they are not numbers."""
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise LidarpoolError(
            f"{name} is {shown(values)}; it must be an array of numbers, or lists of them."
        ) from error


def shown(value: object) -> str:
    """Show a value: plain values cut to a readable length, others by their type."""
    if isinstance(value, _PLAIN):
        short = reprlib.Repr()
        short.maxstring = short.maxother = 60
        return short.repr(value)[:160]
    return "an array" if isinstance(value, np.ndarray) else _with_article(type(value).__name__)


def _with_article(name: str) -> str:
    return f"{'an' if name[0].lower() in 'aeio' else 'a'} {name}"


@cache
def _kinds(thing: Any) -> dict[str, tuple[Kind, dict[str, Any]]]:
    """Return what arguments or fields must be, if that can be checked, with their limits."""
    if isinstance(thing, type):
        names = set(thing.__dict__["__dataclass_fields__"])
    else:
        names = {*thing.__annotations__} - {"return"}
    hints, declared = get_type_hints(thing), get_type_hints(thing, include_extras=True)
    kinds = {name: (_kind(hints[name]), _limits(declared[name])) for name in names}
    return {name: (kind, limits) for name, (kind, limits) in kinds.items() if kind[1]}


def _check(name: str, value: object, kind: Kind, limits: dict[str, Any]) -> None:
    fits, words = kind
    if not fits(value):
        such = [_EXAMPLES[word] for word in words.split() if word in _EXAMPLES]
        example = f"[{such[0]}]" if such and words.startswith("a list") else "".join(such[:1])
        words += f", such as {example}" if example else ""
        raise LidarpoolError(f"{name} is {shown(value)}; it must be {words}.")
    for limit in limits if value is not None else ():
        if isinstance(value, str) and limit != "min_length":
            continue  # of the numbers that are also allowed
        each = value if isinstance(value, (list, tuple)) and limit != "min_length" else [value]
        if not all(_LIMITS[limit][0](one, limits[limit]) for one in each):  # nor NaN
            raise LidarpoolError(f"{name} is {shown(value)}; it must be {_range(limits)}.")


def _limits(hint: Any) -> dict[str, Any]:
    """Limits in an annotation, as pydantic's `Field` has them: {name: limit}."""
    args = get_args(hint)
    inner = args[:1] if get_origin(hint) is Annotated else args
    if get_origin(hint) not in (Annotated, Union, UnionType):
        return {}
    limits = {name: limit for one in inner for name, limit in _limits(one).items()}
    for note in getattr(hint, "__metadata__", ()):
        for limit in getattr(note, "metadata", ()):
            limits |= {name: getattr(limit, name) for name in _LIMITS if hasattr(limit, name)}
    return limits


def _range(limits: Mapping[str, Any]) -> str:
    numbers = {name: limit if limit % 1 else int(limit) for name, limit in limits.items()}
    if numbers.keys() == {"ge", "le"}:
        return f"{numbers['ge']} to {numbers['le']}"
    return ", ".join(f"{_LIMITS[name][1]} {number}" for name, number in numbers.items())


def _kind(hint: Any) -> Kind:
    """Whether a value fits an annotation, and what fits in words.

    Without words it is not checked here: arrays, for example.
    """
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        kinds = [_kind(one) for one in args]
        words = [of for _, of in kinds]
        told = " or ".join(words) if all(words) else ""
        return lambda value: any(fits(value) for fits, _ in kinds), told
    if origin is Literal:
        return lambda value: value in args, f"one of {', '.join(map(str, args))}"
    if origin in (Sequence, Iterable, tuple):
        inner, of = _kind(args[0])
        of = of.removeprefix("a ").replace("number", "numbers")

        def all_fit(value: Any) -> bool:
            if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, Iterable):
                return False
            # An iterator can be read only once: leave it to the function.
            return origin is Iterable or all(map(inner, value))

        return all_fit, f"a list of {of}" if of else ""
    if origin is Callable:
        return callable, "a function"
    if origin is Mapping:
        return lambda value: isinstance(value, Mapping), "a dict"
    if hint in _KINDS:
        kinds_of, words_of = _KINDS[hint]
        refused = () if hint is bool else bool
        return lambda v: isinstance(v, kinds_of) and not isinstance(v, refused), words_of
    if not isinstance(hint, type) or hint is Any:
        return lambda value: True, ""
    if getattr(hint, "_is_protocol", False):
        names = [name for name in vars(hint) if not name.startswith("_")]
        # Of the class first: a property may take its time.
        return lambda value: all(
            hasattr(type(value), name) or hasattr(value, name) for name in names
        ), _with_article(hint.__name__)
    return lambda value: isinstance(value, hint), _with_article(hint.__name__)

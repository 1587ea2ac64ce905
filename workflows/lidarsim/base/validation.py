"""Validation of what users give, in Python and in files, by pydantic; its errors as sentences."""

from __future__ import annotations

import inspect
import os
import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, is_dataclass
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
from pydantic import ConfigDict, GetCoreSchemaHandler, GetPydanticSchema, WrapValidator
from pydantic.fields import FieldInfo
from pydantic_core import (
    ErrorDetails,
    PydanticKnownError,
    SchemaValidator,
    ValidationError,
    core_schema,
)

from .arrays import AnyArray
from .errors import LidarError, Mistakes
from .signatures import ReadableSignature, annotated, readable
from .words import did_you_mean, plural

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)
Fields = Mapping[str, FieldInfo]
FieldPath = tuple[int | str, ...]

# No others, finite numbers, no conversion of text to numbers.
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

# {class: an example}
_EXAMPLES = {
    "Beams": "Beams.even(32, 40)",
    "Gnss": "Gnss(horizontal_m=0.02)",
    "Imu": "Imu(gyroscope_noise_density=1e-4)",
    "Material": "Material('Window*', reflectance=0.1)",
    "SceneMesh": "SceneMesh('hall', vertices, faces)",
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
# {kind of pydantic's error, or class: what is allowed}
_ALLOWED = {
    "bool_type": "true or false",
    "callable_type": "a function",
    "dataclass_type": "a mapping",
    "dict_type": "a mapping",
    "float_type": "a number",
    "int_from_float": "a whole number",
    "int_type": "a whole number",
    "model_type": "a mapping",
    "none_required": "None",
    "string_type": "text",
    "Mapping": "a dict",
    "PathLike": "a path",
}
_ITEMS = {float: "numbers", int: "whole numbers", str: "text"}  # of lists
_LENGTHS = ("min_length", "max_length")
_LIMITS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
_ALIKE = {"position": "translation", "translation": "position"}  # too unlike for `did_you_mean`
_PLAIN = (bool, int, float, str, bytes, NoneType, list, tuple, dict)
# {class: what makes its schema, and the limits that it takes}
_SCALARS: dict[Any, tuple[Callable[..., Any], Collection[str]]] = {
    bool: (core_schema.bool_schema, ()),
    int: (core_schema.int_schema, _LIMITS),
    float: (core_schema.float_schema, (*_LIMITS, "allow_inf_nan")),
    str: (core_schema.str_schema, _LENGTHS),
    datetime: (core_schema.datetime_schema, ()),
    NoneType: (core_schema.none_schema, ()),
}
_LETTERS = 160  # of a value that is shown
# most characters of all, and of the value of a field
_LINE = 119
_VALUE = 64


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that do not fit their annotations; they stay as they are.

    Raises
    ------
    LidarError
        From the function: the argument, its value, and what it must be.
    """

    @wraps(function)
    def refusing(*args: P.args, **kwargs: P.kwargs) -> R:
        # Python reports too many, too few and unknown ones.
        _check(function, {**dict(zip(_usual(function), args, strict=False)), **kwargs})
        return function(*args, **kwargs)

    if annotated(function):
        refusing.__signature__ = readable(inspect.signature(function))  # type: ignore[attr-defined]
    return refusing


def checked_fields(cls: C) -> C:
    """Let a dataclass refuse values that do not fit their annotations, also in subclasses.

    In a section of a file it is a section itself, of the same fields. Its `repr` is one line, and
    its signature has types without limits.

    Apply it before `dataclass`, which calls `__post_init__` only if the class has one.
    """
    after: Callable[[Any], None] = getattr(cls, "__post_init__", lambda self: None)

    def __post_init__(self: Any) -> None:  # noqa: N807
        _check(cls, vars(self))
        after(self)

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
    """Make a dataclass a section of files: of its fields as a mapping, or an instance."""
    schema = handler(source)
    own: Any = handler.resolve_ref_schema(schema)
    own["strict"] = False  # strict ones take only instances

    def made(value: Any, inner: Callable[[Any], Any]) -> Any:
        try:
            return inner(value)
        except LidarError as error:  # of `__post_init__`
            raise ValueError(str(error)) from error

    return core_schema.no_info_wrap_validator_function(made, schema)


def _check(thing: Any, given: Mapping[str, Any]) -> None:
    """Refuse values, other than defaults, that do not fit the annotations of a thing."""
    usual = _usual(thing)
    given = {
        name: bool(value) if isinstance(value, np.bool_) else value  # to pydantic, else a number
        for name, value in given.items()
        if value is not usual.get(name, usual)
    }
    if not given:
        return
    validator, hints = _python(thing)
    try:
        validator.validate_python(given)
    except ValidationError:
        try:
            validator.validate_python(without_numpy(given))
        except ValidationError as error:
            raise LidarError(_argument_error(error, hints)) from None


def without_numpy(value: Any) -> Any:
    """Return numbers and lists of Python in place of those of NumPy, which will do as well."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim < 2:
        return value.tolist()
    if isinstance(value, dict):
        return {key: without_numpy(one) for key, one in value.items()}
    return type(value)(map(without_numpy, value)) if type(value) in (list, tuple) else value


@cache
def _usual(thing: Any) -> dict[str, Any]:
    """Defaults of the parameters of a function, or the fields of a dataclass."""
    if isinstance(thing, type):
        return {field.name: field.default for field in dataclass_fields(thing)}
    return {name: one.default for name, one in inspect.signature(thing).parameters.items()}


@cache
def _python(thing: Any) -> tuple[SchemaValidator, dict[str, Any]]:
    """Return what validates the arguments of a function, or the fields of a dataclass."""
    known = get_type_hints(thing, include_extras=True)
    hints = {name: known[name] for name in _usual(thing) if name in known}
    # Without `TypeAdapter`, whose import takes longer than all else of the first `Scanner`.
    field = partial(core_schema.typed_dict_field, required=False)
    config = core_schema.CoreConfig(strict=True, allow_inf_nan=False)
    table = {name: field(_schema(hint)) for name, hint in hints.items()}
    return SchemaValidator(core_schema.typed_dict_schema(table, config=config)), hints


def _schema(hint: Any, limits: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Make pydantic's schema of an annotation in Python.

    Of a class there must be an instance, of a protocol its attributes; arrays are not checked here.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        schema = _schema(args[0], _limits(hint, (*_LIMITS, *_LENGTHS, "allow_inf_nan")))
        wraps: list[Any] = [n.func for n in hint.__metadata__ if isinstance(n, WrapValidator)]
        return reduce(lambda s, w: core_schema.no_info_wrap_validator_function(w, s), wraps, schema)
    if origin in (Union, UnionType):
        return core_schema.union_schema([_schema(one, limits) for one in args])
    if origin in (Sequence, Collection, Iterable, tuple):
        items = [_schema(one) for one in args if one is not ...]
        if core_schema.any_schema() in items:
            return items[0]
        more = None if origin is tuple and ... not in args else 0
        lengths = {name: limit for name, limit in limits.items() if name in _LENGTHS}
        listed = core_schema.tuple_schema(items, variadic_item_index=more, strict=False, **lengths)
        return core_schema.no_info_wrap_validator_function(_once, listed)
    if origin is Literal:
        return core_schema.literal_schema([*args])
    if hint in _SCALARS:
        make, takes = _SCALARS[hint]
        return make(**{name: limit for name, limit in limits.items() if name in takes})
    if origin is Callable:
        return core_schema.callable_schema()
    if hint is Any or not isinstance(origin or hint, type) or origin is np.ndarray:
        return core_schema.any_schema()
    if getattr(hint, "_is_protocol", False):
        return core_schema.no_info_plain_validator_function(_having(hint))
    return core_schema.is_instance_schema(os.PathLike if hint is Path else origin or hint)


def _once(value: Any, handler: Callable[[Any], Any]) -> Any:
    # An iterator can be read only once: leave it to the function.
    return value if isinstance(value, Iterator) else handler(value)


def _having(protocol: type) -> Callable[[Any], Any]:
    """Return what refuses values without the attributes of a protocol."""
    names = [name for name in vars(protocol) if not name.startswith("_")]

    def having(value: Any) -> Any:
        # Of the class first: a property may take its time.
        if not all(hasattr(type(value), name) or hasattr(value, name) for name in names):
            raise PydanticKnownError("is_instance_of", {"class": protocol.__name__})
        return value

    return having


@contextmanager
def sentences(section: Any, source: object = "") -> Iterator[None]:
    """Turn pydantic's error of the body into a LidarError with a line for each mistake."""
    try:
        yield
    except ValidationError as error:
        mistakes = Mistakes()
        lines = validation_errors(error, section)
        mistakes.lines += [f"{source}: {line}" if source else line for line in lines]
        mistakes.tell()


def validation_errors(error: ValidationError, section: Any) -> Iterator[str]:
    """Yield a line for each error in a file: field, value given, values allowed.

    For a name that is no field, one like it is suggested, and the sections that have it are named.
    """
    found = {detail["loc"]: detail for detail in error.errors(include_url=False)}
    alike: dict[Any, list[FieldPath]] = {}  # {field and kind of mistake: where it was made}
    for place, detail in found.items():
        # Of a list in which all entries are wrong pydantic says that it has none.
        within = (other[: len(place)] == place != other for other in found)
        if detail["type"] == "too_short" and any(within):
            continue
        field = tuple(step for step in place if not isinstance(step, int))
        alike.setdefault((field, detail["type"]), []).append(place)
    for first, *others in alike.values():
        more = f" {plural(len(others), 'more entry', 'more entries')} like it." if others else ""
        hint, known = _at(first, section)
        near = field_hint(str(first[-1]), known, section) if first else ""
        yield _sentence(first, [found[first]], hint, near, _in_file) + more


def _in_file(value: Any) -> str:
    plain = str(value).lower() if isinstance(value, bool) else shown(value)
    return "empty" if value is None else plain


def _argument_error(error: ValidationError, hints: Mapping[str, Any]) -> str:
    """Return what is wrong with the first wrong argument; of a union, with all of its kinds."""
    places: dict[FieldPath, list[ErrorDetails]] = {}
    for detail in error.errors(include_url=False):
        name, *steps = detail["loc"]
        entry = (name, *(step for step in steps if isinstance(step, int)))
        places.setdefault(entry, []).append(detail)
    place, details = next(iter(places.items()))
    return _sentence(place, details, hints[str(place[0])], "", shown)


def _sentence(
    place: FieldPath,
    details: Sequence[ErrorDetails],
    hint: Any,
    near: str,
    show: Callable[[Any], str],
) -> str:
    at = dotted(place)
    kind = details[0]["type"]
    given = details[0]["input"]
    if kind == "value_error":
        message = str(details[0]["ctx"]["error"])
        return f"{at}: {message}" if at else message
    if kind in ("extra_forbidden", "invalid_key", "unexpected_keyword_argument"):
        return f"{at} is not a field.{near}"
    if kind == "missing":
        return f"{at} is missing; it must be given."
    allowed = dict.fromkeys(_allowed(detail, hint, show is not _in_file) for detail in details)
    near = ""
    if kind == "literal_error" and isinstance(given, str):
        near = did_you_mean(given, re.findall(r"'([^']*)'", details[0]["ctx"]["expected"]))
    return f"{at} is {show(given)}; it must {' or '.join(allowed)}.{near}".replace(
        " or be ", " or "
    )


def _allowed(detail: ErrorDetails, hint: Any, in_python: bool) -> str:
    """Return what a value must do: «be 1 to 10»; examples are Python."""
    kind = detail["type"]
    context = detail.get("ctx", {})
    if kind == "is_instance_of":
        name = str(context["class"]).rpartition(".")[2]
        such = f", such as {_EXAMPLES[name]}" if name in _EXAMPLES else ""
        return f"be {_ALLOWED.get(name) or _with_article(name)}{such}"
    if kind in ("list_type", "tuple_type"):
        inner = [*classes_in(hint)]
        of = next((f" of {_ITEMS[one]}" for one in inner if one in _ITEMS), "")
        examples = [_EXAMPLES[one.__name__] for one in inner if one.__name__ in _EXAMPLES]
        such = f", such as [{examples[0]}]" if examples and not of and in_python else ""
        return f"be a list{of}{such}"
    if not _LIMITS.keys().isdisjoint(context):
        limits = _limits(hint)
        return f"be {_range(limits if context.items() <= limits.items() else context)}"
    words = detail["msg"].replace(" after validation", "").partition(" should ")[2]
    return f"be {_ALLOWED[kind]}" if kind in _ALLOWED else words or f"be valid ({detail['msg']})"


def _limits(hint: Any, names: Iterable[str] = _LIMITS) -> dict[str, Any]:
    """Limits in an annotation, as pydantic's `Field` has them: {name: limit}."""
    inner = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    limits = {name: limit for one in inner for name, limit in _limits(one, names).items()}
    for note in getattr(hint, "__metadata__", ()):
        for limit in (note, *getattr(note, "metadata", ())):
            limits |= {name: getattr(limit, name) for name in names if hasattr(limit, name)}
    return limits


def _range(limits: Mapping[str, Any]) -> str:
    numbers = {name: limit if limit % 1 else int(limit) for name, limit in limits.items()}
    if numbers.keys() == {"ge", "le"}:
        return f"{numbers['ge']} to {numbers['le']}"
    return ", ".join(f"{_LIMITS[name]} {number}" for name, number in numbers.items())


def field_hint(name: str, known: Collection[str], root: Any) -> str:
    """Advise on a name that a section lacks: one like it of the `known`, and where it is a field.

    `root` is the section of the whole file. Of the sections with such a field, the outermost are
    named, and none that is derived from another of them.
    """
    if (other := _ALIKE.get(name)) in known:
        return f" Did you mean {other!r}?"
    level = [("", root)]
    owners = list[tuple[str, Any]]()
    while level and not owners:
        level = [
            (f"{place}.{inner}", kind)
            for place, outer in level
            for inner, field in _named(outer).items()
            if not any(isinstance(note, GetPydanticSchema) for note in field.metadata)  # of Python
            for kind in sections_in(field.annotation)
        ]
        owners = [(place[1:], kind) for place, kind in level if name in _named(kind)]
    kinds = {kind for _, kind in owners}
    places = [place for place, kind in owners if kinds.isdisjoint(kind.__mro__[1:])]
    listed = " and ".join(filter(None, [", ".join(places[:-1]), *places[-1:]]))
    near = did_you_mean(name, known)
    if not places:
        return near
    return (
        f"{near} Or {name} of {listed}?" if near else f" It is a field of {listed}: write it there."
    )


def _at(place: FieldPath, hint: Any) -> tuple[Any, Fields]:
    """Return the annotation at a place in a file, and the fields of the section around it."""
    known: Fields = {}
    inner = _named(hint)
    for step in place:
        known = inner
        if step in known:
            hint = known[str(step)].rebuild_annotation()
            inner = _named(hint)
    return hint, known


def _named(hint: Any) -> Fields:
    """Fields of the sections in an annotation, by their names in a file."""
    fields = (pair for kind in sections_in(hint) for pair in fields_of(kind).items())
    return {field.alias or name: field for name, field in fields}


def fields_of(section: Any) -> Fields:
    """Fields of a section of files: {attribute: field}."""
    return getattr(section, "model_fields", None) or _of_dataclass(section)


@cache
def _of_dataclass(section: Any) -> Fields:
    hints = get_type_hints(section, include_extras=True)
    made = FieldInfo.from_annotated_attribute
    return {one.name: made(hints[one.name], one) for one in dataclass_fields(section)}


def is_section(kind: Any) -> bool:
    """Whether a class is a section of files: a model, or a dataclass with `checked_fields`."""
    return hasattr(kind, "model_fields") or hasattr(kind, "__pydantic_config__")


def sections_in(annotation: Any) -> Iterator[Any]:
    """Sections in an annotation, such as `tuple[Section, ...] | None`."""
    return filter(is_section, classes_in(annotation))


def classes_in(annotation: Any) -> Iterator[type]:
    """Classes in an annotation, such as `tuple[Class, ...] | None`."""
    if isinstance(annotation, type) and not get_args(annotation):
        yield annotation
    for inner in get_args(annotation):
        yield from classes_in(inner)


def dotted(place: Sequence[int | str]) -> str:
    """Location as poses[0].position."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return "".join(steps).removeprefix(".")


def shown(value: object) -> str:
    """Show a value: plain values cut to a readable length, others by their type."""
    if not isinstance(value, _PLAIN):
        return "an array" if isinstance(value, np.ndarray) else _with_article(type(value).__name__)
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    short.maxlevel = 3  # YAML aliases make deeply nested lists of a few letters
    text = " ".join(short.repr(value).split())  # arrays in it have lines
    return text if len(text) <= _LETTERS else f"{text[:_LETTERS]}…"


def one_line(thing: Any) -> str:
    """`repr` of a dataclass: the fields that differ from their defaults, as far as a line holds."""
    name = type(thing).__name__
    kept = list[str]()
    left_out = False
    fields = sorted(dataclass_fields(thing), key=lambda f: (f.name != "name", bool(f.kw_only)))
    for field in fields:
        value = getattr(thing, field.name)
        make = field.default_factory
        default = field.default if make is MISSING else make()
        if not field.repr or (not isinstance(value, np.ndarray) and (value == default) is True):
            continue
        text = f"{field.name}={_short(value)}"
        if fits := len(f"{name}({', '.join([*kept, text, '…'])})") <= _LINE:
            kept.append(text)
        left_out |= not fits
    return f"{name}({', '.join(kept + ['…'] * left_out)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}"
    if is_dataclass(value) and (name := getattr(value, "name", "")):
        return f"{type(value).__name__}({name!r})"
    if len(text := repr(value)) <= _VALUE and "\n" not in text:
        return text
    if isinstance(value, Collection) and not isinstance(value, (str, bytes)):
        kinds = {type(one).__name__ for one in value}
        return f"[{len(value)} {kinds.pop() if len(kinds) == 1 else 'items'}]"
    return f"{type(value).__name__}(…)" if is_dataclass(value) else f"{text[: _VALUE - 1]}…"


def _with_article(name: str) -> str:
    return f"{'an' if name[0].lower() in 'aeio' else 'a'} {name}"


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Return values as an array of numbers; LidarError if they are not numbers."""
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise LidarError(
            f"{name} is {shown(values)}; it must be an array of numbers, or lists of them."
        ) from error

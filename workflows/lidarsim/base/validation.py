"""Validation of arguments and files by pydantic, whose errors become sentences."""

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
from pydantic import ConfigDict, GetCoreSchemaHandler, WrapValidator
from pydantic_core import (
    ErrorDetails,
    PydanticKnownError,
    SchemaValidator,
    ValidationError,
    core_schema,
)

from .arrays import AnyArray
from .errors import LidarError, Mistakes
from .field_advice import Contradictory, list_advice, name_advice, place_advice
from .sections import FieldPath, Fields, classes_in, dotted, fields_by_name
from .signatures import ReadableSignature, readable
from .words import did_you_mean, listed, plural

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)

# No further fields, finite numbers, no conversion of text to numbers.
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
# {kind of pydantic's error, or class: allowed values}
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
_PLAIN = (bool, int, float, str, bytes, NoneType, list, tuple, dict)
# {class: function that makes its schema, and the limits that the function takes}
_SCALARS: dict[Any, tuple[Callable[..., Any], Collection[str]]] = {
    bool: (core_schema.bool_schema, ()),
    int: (core_schema.int_schema, _LIMITS),
    float: (core_schema.float_schema, (*_LIMITS, "allow_inf_nan")),
    str: (core_schema.str_schema, _LENGTHS),
    datetime: (core_schema.datetime_schema, ()),
    NoneType: (core_schema.none_schema, ()),
}
_UNKNOWN_FIELD = ("extra_forbidden", "invalid_key", "unexpected_keyword_argument")
_MAX_LETTERS = 160  # of a value in a message
_MAX_LINE = 119  # letters of a `repr`
_MAX_VALUE = 64  # letters of the value of a field


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments that do not fit their annotations; values are not changed.

    Raises
    ------
    LidarError
        From the function: the argument, its value, and the allowed values.
    """

    @wraps(function)
    def checked_function(*args: P.args, **kwargs: P.kwargs) -> R:
        # Python reports too many, too few and unknown arguments.
        _check(function, {**dict(zip(_defaults(function), args, strict=False)), **kwargs})
        return function(*args, **kwargs)

    checked_function.__signature__ = readable(  # type: ignore[attr-defined]
        inspect.signature(function), function.__globals__
    )
    return checked_function


def checked_fields(cls: C) -> C:
    """Let a dataclass refuse values that do not fit their annotations, also in subclasses.

    In a section of a file the dataclass is a section itself, of the same fields. Its `repr` is one
    line, and its signature has types without limits.

    Apply the decorator before `dataclass`, which calls `__post_init__` only if the class has one.
    """
    post_init: Callable[[Any], None] = getattr(cls, "__post_init__", lambda self: None)

    def __post_init__(self: Any) -> None:  # noqa: N807
        _check(cls, vars(self))
        post_init(self)

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
        except LidarError as error:  # from `__post_init__`
            raise ValueError(str(error)) from error

    return core_schema.no_info_wrap_validator_function(converted, schema)


def _check(target: Any, values: Mapping[str, Any]) -> None:
    """Check that values, except defaults, fit the annotations of a function or dataclass."""
    defaults = _defaults(target)
    values = {
        name: bool(value)
        if isinstance(value, np.bool_)
        else value  # pydantic takes NumPy's for a number
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
            raise LidarError(_argument_error(error, hints)) from None


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
    # Without `TypeAdapter`, whose import takes longer than all else of the first `Scanner`.
    field = partial(core_schema.typed_dict_field, required=False)
    config = core_schema.CoreConfig(strict=True, allow_inf_nan=False)
    table = {name: field(_schema(hint)) for name, hint in hints.items()}
    return SchemaValidator(core_schema.typed_dict_schema(table, config=config)), hints


def _schema(hint: Any, limits: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Return pydantic's schema of an annotation in Python.

    A class takes its instances, a protocol all objects with its attributes; arrays are not checked.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        schema = _schema(args[0], _limits(hint, (*_LIMITS, *_LENGTHS, "allow_inf_nan")))
        wraps: list[Any] = [n.func for n in hint.__metadata__ if isinstance(n, WrapValidator)]
        return reduce(lambda s, w: core_schema.no_info_wrap_validator_function(w, s), wraps, schema)
    if origin in (Union, UnionType):
        return core_schema.union_schema([_schema(arg, limits) for arg in args])
    if origin in (Sequence, Collection, Iterable, tuple):
        items = [_schema(arg) for arg in args if arg is not ...]
        if core_schema.any_schema() in items:
            return items[0]
        variadic_index = None if origin is tuple and ... not in args else 0
        lengths = {name: limit for name, limit in limits.items() if name in _LENGTHS}
        items_schema = core_schema.tuple_schema(
            items, variadic_item_index=variadic_index, strict=False, **lengths
        )
        return core_schema.no_info_wrap_validator_function(_unless_iterator, items_schema)
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


@contextmanager
def sentences(
    section: Any,
    source: object = "",
    content: Any = None,
    contradictory: Contradictory = lambda content: False,
) -> Iterator[None]:
    """Turn pydantic's error of the body into a LidarError with a line for each mistake.

    `content` is the content of the file, if it is known, for advice on unknown fields;
    `contradictory` returns True for a content whose fields contradict each other.
    """
    try:
        yield
    except ValidationError as error:
        mistakes = Mistakes()
        lines = validation_errors(error, section, content, contradictory)
        mistakes.lines += [f"{source}: {line}" if source else line for line in lines]
        mistakes.tell()


def validation_errors(
    error: ValidationError,
    section: Any,
    content: Any = None,
    contradictory: Contradictory = lambda content: False,
) -> Iterator[str]:
    """Yield a line for each error in a file: field, value given, values allowed, and advice."""
    details_by_path = {detail["loc"]: detail for detail in error.errors(include_url=False)}
    groups: dict[Any, list[FieldPath]] = {}  # {field and kind of mistake: paths}
    for path, detail in details_by_path.items():
        # pydantic reports a list in which all entries are wrong as empty, too.
        deeper = (other_path[: len(path)] == path != other_path for other_path in details_by_path)
        if detail["type"] == "too_short" and any(deeper):
            continue
        field = tuple(step for step in path if not isinstance(step, int))
        groups.setdefault((field, detail["type"]), []).append(path)
    for first, *further_paths in groups.values():
        count_note = ""
        if further_paths:
            like_it = "like it"
            if details_by_path[first]["type"] == "literal_error":
                values = [_in_file(details_by_path[path]["input"]) for path in further_paths]
                like_it += f": {listed([*dict.fromkeys(values)])}"
            count = plural(len(further_paths), "more entry", "more entries")
            count_note = f" {count} {like_it}."
        hint, fields = _annotation_at(first, section)
        detail = details_by_path[first]
        advice = ""
        if detail["type"] in _UNKNOWN_FIELD and first:
            advice = place_advice(first, detail["input"], fields, section, content, contradictory)
        elif detail["type"] in ("list_type", "tuple_type"):
            advice = list_advice(hint, detail["input"])
        elif detail["type"] in ("model_type", "dataclass_type", "dict_type"):
            advice = name_advice(first, section)
        yield _sentence(first, [detail], hint, advice, _in_file) + count_note


def _in_file(value: Any) -> str:
    """Return a value as in a YAML file, for messages."""
    plain = str(value).lower() if isinstance(value, bool) else shown(value)
    return "empty" if value is None else plain


def _argument_error(error: ValidationError, hints: Mapping[str, Any]) -> str:
    """Return a sentence on the first wrong argument, with all alternatives of a union."""
    details_by_entry: dict[FieldPath, list[ErrorDetails]] = {}
    for detail in error.errors(include_url=False):
        name, *steps = detail["loc"]
        entry = (name, *(step for step in steps if isinstance(step, int)))
        details_by_entry.setdefault(entry, []).append(detail)
    path, details = next(iter(details_by_entry.items()))
    return _sentence(path, details, hints[str(path[0])], "", shown)


def _sentence(
    path: FieldPath,
    details: Sequence[ErrorDetails],
    hint: Any,
    advice: str,
    show: Callable[[Any], str],
) -> str:
    """Return a sentence on the errors of a value: location, value and allowed values.

    `advice` follows. `show` formats the value.
    """
    location = dotted(path)
    kind = details[0]["type"]
    value = details[0]["input"]
    if kind == "value_error":
        message = str(details[0]["ctx"]["error"])
        return f"{location}: {message}" if location else message
    if kind in _UNKNOWN_FIELD:
        return f"{location} is not a field.{advice}"
    if kind == "missing":
        return f"{location} is missing; it must be given."
    in_python = show is not _in_file
    requirements = dict.fromkeys(_requirement(detail, hint, in_python) for detail in details)
    allowed = f"must {' or '.join(requirements)}.".replace(" or be ", " or ")
    if kind == "literal_error" and isinstance(value, str):
        suggestion = did_you_mean(value, re.findall(r"'([^']*)'", details[0]["ctx"]["expected"]))
        if suggestion:  # before the allowed values, which may be many
            return f"{location} is {show(value)}.{suggestion} It {allowed}"
    return f"{location} is {show(value)}; it {allowed}{advice}"


def _requirement(detail: ErrorDetails, hint: Any, in_python: bool) -> str:
    """Return the requirement on a value: «be 1 to 10»; examples only `in_python`."""
    kind = detail["type"]
    context = detail.get("ctx", {})
    if kind == "is_instance_of":
        name = str(context["class"]).rpartition(".")[2]
        example = f", such as {_EXAMPLES[name]}" if name in _EXAMPLES else ""
        return f"be {_ALLOWED.get(name) or _with_article(name)}{example}"
    if kind in ("list_type", "tuple_type"):
        inner = [*classes_in(hint)]
        items = next((f" of {_ITEMS[kind]}" for kind in inner if kind in _ITEMS), "")
        examples = [_EXAMPLES[kind.__name__] for kind in inner if kind.__name__ in _EXAMPLES]
        example = f", such as [{examples[0]}]" if examples and not items and in_python else ""
        return f"be a list{items}{example}"
    if not _LIMITS.keys().isdisjoint(context):
        limits = _limits(hint)
        return f"be {_range(limits if context.items() <= limits.items() else context)}"
    words = detail["msg"].replace(" after validation", "").partition(" should ")[2]
    return f"be {_ALLOWED[kind]}" if kind in _ALLOWED else words or f"be valid ({detail['msg']})"


def _limits(hint: Any, names: Iterable[str] = _LIMITS) -> dict[str, Any]:
    """Return the limits in an annotation, named as in pydantic's `Field`: {name: limit}."""
    inner = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    limits = {name: limit for arg in inner for name, limit in _limits(arg, names).items()}
    for note in getattr(hint, "__metadata__", ()):
        for limit in (note, *getattr(note, "metadata", ())):
            limits |= {name: getattr(limit, name) for name in names if hasattr(limit, name)}
    return limits


def _range(limits: Mapping[str, Any]) -> str:
    """Return limits as text: «1 to 10», «at least 1, below 10»."""
    numbers = {name: limit if limit % 1 else int(limit) for name, limit in limits.items()}
    if numbers.keys() == {"ge", "le"}:
        return f"{numbers['ge']} to {numbers['le']}"
    return ", ".join(f"{_LIMITS[name]} {number}" for name, number in numbers.items())


def _annotation_at(path: FieldPath, hint: Any) -> tuple[Any, Fields]:
    """Return the annotation at a path in a file, and the fields of the section around."""
    fields: Fields = {}
    inner = fields_by_name(hint)
    for step in path:
        fields = inner
        if step in fields:
            hint = fields[str(step)].rebuild_annotation()
            inner = fields_by_name(hint)
    return hint, fields


def shown(value: object) -> str:
    """Return a value as text: a plain value, cut to a readable length, else its type."""
    if not isinstance(value, _PLAIN):
        return "an array" if isinstance(value, np.ndarray) else _with_article(type(value).__name__)
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    short.maxlevel = 3  # YAML aliases make deeply nested lists of a few letters
    text = " ".join(short.repr(value).split())  # arrays within have several lines
    return text if len(text) <= _MAX_LETTERS else f"{text[:_MAX_LETTERS]}…"


def one_line(instance: Any) -> str:
    """Return the `repr` of a dataclass: fields that differ from their defaults, within a line."""
    name = type(instance).__name__
    texts = list[str]()
    left_out = False
    fields = sorted(dataclass_fields(instance), key=lambda f: (f.name != "name", bool(f.kw_only)))
    for field in fields:
        value = getattr(instance, field.name)
        make = field.default_factory
        default = field.default if make is MISSING else make()
        if not field.repr or (not isinstance(value, np.ndarray) and (value == default) is True):
            continue
        text = f"{field.name}={_short(value)}"
        if fits := len(f"{name}({', '.join([*texts, text, '…'])})") <= _MAX_LINE:
            texts.append(text)
        left_out |= not fits
    return f"{name}({', '.join(texts + ['…'] * left_out)})"


def _short(value: Any) -> str:
    """Return the value of a field as short text."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}"
    if is_dataclass(value) and (name := getattr(value, "name", "")):
        return f"{type(value).__name__}({name!r})"
    if len(text := repr(value)) <= _MAX_VALUE and "\n" not in text:
        return text
    if isinstance(value, Collection) and not isinstance(value, (str, bytes)):
        kinds = {type(item).__name__ for item in value}
        return f"[{len(value)} {kinds.pop() if len(kinds) == 1 else 'items'}]"
    return f"{type(value).__name__}(…)" if is_dataclass(value) else f"{text[: _MAX_VALUE - 1]}…"


def _with_article(name: str) -> str:
    """Return a name of a class with the indefinite article."""
    return f"{'an' if name[0].lower() in 'aeio' else 'a'} {name}"


def as_array(name: str, values: ArrayLike, dtype: DTypeLike = np.float64) -> AnyArray:
    """Return values as an array of numbers; LidarError for values that are not numbers."""
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise LidarError(
            f"{name} is {shown(values)}; it must be an array of numbers, or lists of them."
        ) from error

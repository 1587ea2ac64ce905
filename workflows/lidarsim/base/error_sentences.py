"""Sentences on pydantic's errors: the field or argument, its value, what is allowed, and advice."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from pydantic_core import ErrorDetails, ValidationError

from .errors import Mistakes
from .field_advice import Contradictory, list_advice, name_advice, place_advice
from .section_fields import FieldPath, Fields, classes_in, dotted, fields_by_name, limits_of
from .value_texts import shown, with_article
from .words import alternatives, did_you_mean, listed, plural

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
    "Planning": "Planning((0, 0), (10, 0), centers=[(5, 0)], radii=2)",
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
_ITEMS = {float: "numbers", int: "whole numbers", str: "text"}  # items of lists
_LIMIT_WORDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
_UNKNOWN_FIELD = ("extra_forbidden", "invalid_key", "unexpected_keyword_argument")


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
        for details in _alike(error):
            line = _line(details, section, content, contradictory)
            mistakes.lines.append(f"{source}: {line}" if source else line)
        mistakes.tell()


def _alike(error: ValidationError) -> Iterable[Sequence[ErrorDetails]]:
    """Return the errors in a file, in groups of the same kind in the entries of the same list."""
    details_by_path = {detail["loc"]: detail for detail in error.errors(include_url=False)}
    groups: dict[Any, list[ErrorDetails]] = {}  # {field and kind of error: errors}
    for path, detail in details_by_path.items():
        # pydantic reports a list whose entries are all wrong as empty, too.
        deeper = (other_path[: len(path)] == path != other_path for other_path in details_by_path)
        if detail["type"] == "too_short" and any(deeper):
            continue
        field = tuple(step for step in path if not isinstance(step, int))
        groups.setdefault((field, detail["type"]), []).append(detail)
    return groups.values()


def _line(
    details: Sequence[ErrorDetails], section: Any, content: Any, contradictory: Contradictory
) -> str:
    """Return a line on errors of the same kind: the first error, advice, and how many follow."""
    detail, *further_details = details
    kind = detail["type"]
    path = detail["loc"]
    value = detail["input"]
    hint, fields = _annotation_at(path, section)
    advice = ""
    if kind in _UNKNOWN_FIELD and path:
        advice = place_advice(path, value, fields, section, content, contradictory)
    elif kind in ("list_type", "tuple_type"):
        advice = list_advice(hint, value)
    elif kind in ("model_type", "dataclass_type", "dict_type"):
        advice = name_advice(path, section)
    line = _sentence(path, [detail], hint, advice, _in_file)
    if not further_details:
        return line
    values = ""
    if kind == "literal_error":
        values = f": {listed([*dict.fromkeys(_in_file(d['input']) for d in further_details)])}"
    others = plural(len(further_details), "other entry", "other entries")
    return f"{line} The same applies to {others}{values}."


def _in_file(value: Any) -> str:
    """Return a value as in a YAML file, for messages."""
    plain = str(value).lower() if isinstance(value, bool) else shown(value)
    return "empty" if value is None else plain


def argument_error(error: ValidationError, hints: Mapping[str, Any]) -> str:
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
        return f"Unknown field {location!r}.{advice}"
    if kind == "missing":
        return f"{location} is required."
    requirements = [*dict.fromkeys(_requirement(detail, hint) for detail in details)]
    if all(words.startswith("be ") for words in requirements):
        allowed = f"must be {alternatives([words.removeprefix('be ') for words in requirements])}"
    else:
        allowed = f"must {' or '.join(requirements)}"
    if kind == "literal_error" and isinstance(value, str):
        suggestion = did_you_mean(value, re.findall(r"'([^']*)'", details[0]["ctx"]["expected"]))
        if suggestion:  # before the allowed values, which may be many
            return f"{location} cannot be {show(value)}.{suggestion} It {allowed}."
    if not advice and show is not _in_file:
        examples = (_example(detail, hint) for detail in details)
        advice = next((f" For example, pass {example}." for example in examples if example), "")
    return f"{location} {allowed}, but is {show(value)}.{advice}"


def _requirement(detail: ErrorDetails, hint: Any) -> str:
    """Return the requirement on a value: «be from 1 to 10»."""
    kind = detail["type"]
    context = detail.get("ctx", {})
    if kind == "is_instance_of":
        name = _class_name(context)
        return f"be {_ALLOWED.get(name) or with_article(name)}"
    if kind in ("list_type", "tuple_type"):
        items = next((f" of {_ITEMS[kind]}" for kind in classes_in(hint) if kind in _ITEMS), "")
        return f"be a list{items}"
    if not _LIMIT_WORDS.keys().isdisjoint(context):
        limits = limits_of(hint)
        return f"be {_range(limits if context.items() <= limits.items() else context)}"
    words = detail["msg"].partition(" should ")[2].partition(" after validation")[0]
    return f"be {_ALLOWED[kind]}" if kind in _ALLOWED else words or f"be valid ({detail['msg']})"


def _example(detail: ErrorDetails, hint: Any) -> str:
    """Return an allowed value in Python, or "" without an example."""
    if detail["type"] == "is_instance_of":
        return _EXAMPLES.get(_class_name(detail.get("ctx", {})), "")
    if detail["type"] in ("list_type", "tuple_type"):
        inner = [*classes_in(hint)]
        names = [kind.__name__ for kind in inner if kind.__name__ in _EXAMPLES]
        if names and not any(kind in _ITEMS for kind in inner):
            return f"[{_EXAMPLES[names[0]]}]"
    return ""


def _class_name(context: Mapping[str, Any]) -> str:
    """Return the name of the class in an error's context, without its module."""
    return str(context["class"]).rpartition(".")[2]


def _range(limits: Mapping[str, Any]) -> str:
    """Return limits as text: «from 1 to 10», «at least 1 and below 10»."""
    numbers = {name: limit if limit % 1 else int(limit) for name, limit in limits.items()}
    if numbers.keys() == {"ge", "le"}:
        return f"from {numbers['ge']} to {numbers['le']}"
    return " and ".join(f"{_LIMIT_WORDS[name]} {number}" for name, number in numbers.items())


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

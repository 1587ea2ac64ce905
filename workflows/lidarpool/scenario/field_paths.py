"""Paths such as ``sensors.roof.model`` to fields of a scenario."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import BaseModel

from lidarsim.base.errors import LidarError
from lidarsim.base.validation import field_hint, fields_of, is_section, sections_in
from lidarsim.base.words import did_you_mean, plural

from .scenario import Scenario

# Keys of fields and numbers of entries, each with its value. A section that is left out
# has defaults as its value.
FieldSteps = tuple[tuple[str | int, Any], ...]


def find_field(scenario: Scenario, text: str) -> tuple[FieldSteps, Any]:
    """Find the field of a scenario that a path such as ``sensors.roof.model`` leads to.

    Returns
    -------
    The steps to the field, and its annotation.

    Raises
    ------
    LidarError
        If the path leads to no field; the message has the nearest name.
    """
    node: Any = scenario
    kind: Any = type(scenario)
    parts = text.split(".")  # that are left
    steps: list[tuple[str | int, Any]] = []
    key: str | int
    while parts:
        path = ".".join(text.split(".")[: -len(parts)])  # of the node
        if node is None and not parts[0].isdecimal() and (sections := list(sections_in(kind))):
            model = issubclass(sections[0], BaseModel)  # of defaults
            node = sections[0].model_construct() if model else object.__new__(sections[0])
            steps[-1] = (steps[-1][0], node)
        if is_section(type(node)):
            key, node, kind = _field(node, parts[0], path)
            used = 1
        elif isinstance(node, dict):
            keys = {str(key): key for key in node}  # of classes, numbers
            name, used = _named([*keys], parts, path)
            node = node[key := keys[name]]
        elif isinstance(node, (tuple, list)):
            key, used = _entry(node, parts, path)
            node = node[key]
        else:
            reason = f"{path} has no fields of its own"
            if node is None:
                reason = f"the base has no {path}"
            raise LidarError(f"{text} leads to no field: {reason}.")
        steps.append((key, node))
        parts = parts[used:]
    return tuple(steps), kind


def _field(node: BaseModel, name: str, path: str) -> tuple[str, Any, Any]:
    """Return a field of the section at a path by its name in YAML: name, value, annotation."""
    attributes = {
        field.alias or attribute: attribute for attribute, field in fields_of(type(node)).items()
    }
    if name not in attributes:
        kind = f"a field of {path}" if path else "a section of a scenario"
        raise LidarError(f"{name!r} is not {kind}.{field_hint(name, attributes, Scenario)}")
    attribute = attributes[name]
    return name, getattr(node, attribute, None), fields_of(type(node))[attribute].annotation


def _named(names: Sequence[str], parts: Sequence[str], path: str) -> tuple[str, int]:
    """Return the longest of some names that parts of a path begin with, and its number of parts.

    Names may have dots.
    """
    for used in range(len(parts), 0, -1):
        if (name := ".".join(parts[:used])) in names:
            return name, used
    hint = did_you_mean(parts[0], names) or (f" It has {', '.join(names[:5])}." if names else "")
    raise LidarError(f"{path} of the base has no {parts[0]!r}.{hint}")


def _entry(entries: Sequence[Any], parts: Sequence[str], path: str) -> tuple[int, int]:
    """Return the index of the entry that parts of a path name, and the number of these parts."""
    if parts[0].isdecimal():
        if (index := int(parts[0])) < len(entries):
            return index, 1
        raise LidarError(
            f"{path} of the base has {plural(len(entries), 'entry', 'entries')}, counted from 0, "
            f"and no entry {index}."
        )
    names = [getattr(entry, "name", None) for entry in entries]
    name, used = _named([name for name in names if isinstance(name, str)], parts, path)
    return names.index(name), used


def put(node: Any, steps: FieldSteps, change: Callable[[Any], Any]) -> Any:
    """Return a section in which `change` has replaced the value that the steps lead to.

    The section itself is not changed. Sections along the steps become mappings of their fields, to
    be checked again; other sections stay as they are.
    """
    if not steps:
        return change(node)
    (key, base), *following = steps
    values: Any
    if is_section(type(node)):
        set_fields = getattr(node, "model_fields_set", vars(node))
        values = {
            field.alias or name: getattr(node, name)
            for name, field in fields_of(type(node)).items()
            if name in set_fields
        }
    else:
        values = list(node) if isinstance(node, (tuple, list)) else dict(node)
    below = values[key] if isinstance(values, list) else values.get(key, base)  # type: ignore[index]
    values[key] = put(base if below is None else below, tuple(following), change)
    return values

"""Paths of fields in a scenario, such as ``sensors.roof.model``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import BaseModel

from lidarsim.errors import LidarError
from lidarsim.schema.field_advice import owner_of_file, owners_by_level
from lidarsim.schema.section_fields import fields_by_name, fields_of, is_section, sections_in
from lidarsim.words import did_you_mean, list_names, plural, shorten_name

from .scenario import Scenario

# Steps from a scenario to a field. Each step is a key or a list index, with the value at that point
# of the path. For an omitted section, the value is a section with the default values.
FieldSteps = tuple[tuple[str | int, Any], ...]


def find_field(scenario: Scenario, text: str) -> tuple[FieldSteps, Any]:
    """Find a field of a scenario by its path, such as ``sensors.roof.model``.

    Returns
    -------
    steps
        Steps to the field.
    kind
        Type annotation of the field.

    Raises
    ------
    LidarError
        If the path does not refer to a field. The message suggests a similar name.
    """
    node: Any = scenario
    kind: Any = type(scenario)
    remaining = text.split(".")
    steps: list[tuple[str | int, Any]] = []
    key: str | int
    while remaining:
        path = ".".join(text.split(".")[: -len(remaining)])  # path of the node
        if node is None and not remaining[0].isdecimal() and (sections := list(sections_in(kind))):
            model = issubclass(sections[0], BaseModel)  # models have the default values
            node = sections[0].model_construct() if model else object.__new__(sections[0])
            steps[-1] = (steps[-1][0], node)
        if is_section(type(node)):
            key, node, kind = _find_in_section(scenario, node, remaining, path)
            part_count = 1
        elif isinstance(node, dict):
            keys = {str(key): key for key in node}  # the keys of `classes` are integers
            name, part_count = _match_name([*keys], remaining, path)
            node = node[key := keys[name]]
        elif isinstance(node, (tuple, list)):
            key, part_count = _match_entry(node, remaining, path)
            node = node[key]
        else:
            reason = f"{path} has no fields"
            if node is None:
                reason = f"the base has no {path}"
            raise LidarError(f"{text} does not refer to a field, because {reason}.")
        steps.append((key, node))
        remaining = remaining[part_count:]
    return tuple(steps), kind


def _find_in_section(
    scenario: Scenario, node: BaseModel, remaining: Sequence[str], path: str
) -> tuple[str, Any, Any]:
    """Return the name, value and annotation of a field.

    `node` is the section at `path`. The first of the `remaining` parts of a path is the name of the
    field in YAML. Raise LidarError if there is no such field.
    """
    name, *inner = remaining
    section = type(node)
    fields = fields_of(section)
    attributes = {field.alias or attribute: attribute for attribute, field in fields.items()}
    if name not in attributes and name in (further := fields_by_name(section)):
        return name, None, further[name].annotation
    if name not in attributes:
        kind = f"a field of {path}" if path else "a section of a scenario"
        hint = did_you_mean(name, attributes) or _path_hint(scenario, name, inner)
        if name.isdecimal() and "position" in attributes:  # the pose is in the short form [x, y, z]
            hint = f" Did you mean {f'{path}.position.{name}'!r}?"
        raise LidarError(f"{name!r} is not {kind}.{hint}")
    attribute = attributes[name]
    return name, getattr(node, attribute, None), fields[attribute].annotation


def _path_hint(scenario: Scenario, name: str, inner: Sequence[str]) -> str:
    """Return a hint with the paths of all fields that have the given name, or an empty string.

    `inner` contains the parts of the path that follow the name. For example, return " Did you mean
    'mount.position.2'?" for the name "mount".
    """
    levels = [
        [path for owner in owners if (path := _path_in(scenario, owner.names, name))]
        for owners in owners_by_level(name, owner_of_file(Scenario))
    ]
    # Prefer sections that are set, because a scenario has either `sensor` or `sensors`.
    fields_set = scenario.model_fields_set
    given = [[path for path in paths if path.split(".")[0] in fields_set] for paths in levels]
    shown = next(filter(None, [*given, *levels]), [])
    if not shown:
        return ""
    texts = [repr(".".join([path, *inner])) for path in shown[:3]]
    return f" Did you mean {' or '.join(texts)}?"


def _path_in(scenario: Scenario, names: Sequence[str], name: str) -> str:
    """Return the path of a field in a scenario, or an empty string if its section is not set.

    `names` are the names of the sections around the field. In lists and mappings, the path leads to
    the first entry.
    """
    node: Any = scenario
    keys: list[str] = []
    for section in names:
        if node is None:
            return ""
        node = getattr(node, section, None)
        keys.append(section)
        if isinstance(node, (tuple, list, dict)):
            if not node:
                return ""
            key: Any = next(iter(node)) if isinstance(node, dict) else 0
            node = node[key]
            keys.append(str(key))
    is_absent = node is None and len(keys) > 1  # for example, the file of an actor that is a box
    return "" if is_absent else ".".join([*keys, name])


def _match_name(names: Sequence[str], path_parts: Sequence[str], path: str) -> tuple[str, int]:
    """Return the longest name that is at the start of a path, and its number of parts.

    Names may contain dots, and therefore consist of several parts. Raise LidarError if no name
    matches.
    """
    for part_count in range(len(path_parts), 0, -1):
        if (name := ".".join(path_parts[:part_count])) in names:
            return name, part_count
    hint = did_you_mean(path_parts[0], names) or (
        f" Available names: {list_names(names, 5)}." if names else ""
    )
    raise LidarError(f"{path} of the base has no entry {path_parts[0]!r}.{hint}")


def _match_entry(entries: Sequence[Any], path_parts: Sequence[str], path: str) -> tuple[int, int]:
    """Find the list entry to which the start of a path refers.

    Returns the index of the entry, and the number of parts that refer to it. The path contains the
    index or the name of the entry. Raise LidarError if there is no such entry.
    """
    if path_parts[0].isdecimal():
        digits = path_parts[0].lstrip("0") or "0"  # Python does not convert thousands of digits
        index = int(digits) if len(digits) <= len(f"{len(entries)}") else len(entries)
        if index < len(entries):
            return index, 1
        raise LidarError(
            f"{path} of the base has {plural(len(entries), 'entry', 'entries')}, so entry "
            f"{shorten_name(path_parts[0])} does not exist. Entries are numbered from 0."
        )
    names = [getattr(entry, "name", None) for entry in entries]
    name, part_count = _match_name(
        [name for name in names if isinstance(name, str)], path_parts, path
    )
    return names.index(name), part_count


def replace_value(node: Any, steps: FieldSteps, change: Callable[[Any], Any]) -> Any:
    """Return a copy of a section in which the value at the end of `steps` is changed.

    The new value is `change(value)`. The section itself is not modified. In the result, sections
    along the steps are mappings from field names to values, which have to be validated again. Other
    sections are unchanged.
    """
    if not steps:
        return change(node)
    (key, base), *inner_steps = steps
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
    value = values[key] if isinstance(values, list) else values.get(key, base)  # type: ignore[index]
    values[key] = replace_value(base if value is None else value, tuple(inner_steps), change)
    return values

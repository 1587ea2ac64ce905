"""Paths into a scenario: keys joined by dots, numbers of entries, and names of entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from ..base.errors import LidarpoolError
from ..base.validation import attributes_of, dotted, fields_of, is_section, sections_in
from ..base.words import counted, did_you_mean
from .scenario import Scenario


@dataclass(frozen=True)
class FieldPath:
    """Where a path leads in one scenario.

    Parameters
    ----------
    text
        As it was written: ``sensors.roof.model``.
    steps
        Keys, and numbers of entries, with the value of each in the scenario; of a section that is
        left out there, one of defaults.
    """

    text: str
    steps: tuple[tuple[str | int, Any], ...]

    @property
    def keys(self) -> tuple[str | int, ...]:
        """Keys and numbers of the steps."""
        return tuple(key for key, _ in self.steps)

    @property
    def place(self) -> str:
        """As errors of a scenario write it: ``scene.files[0].file``."""
        return dotted(self.keys)


def find_field(scenario: Scenario, text: str) -> tuple[FieldPath, Any]:
    """Find out where a path leads, and the annotation of the field there.

    Raises
    ------
    LidarpoolError
        If it leads to no field; the message has the nearest name.
    """
    node: Any = scenario
    kind: Any = type(scenario)
    rest = text.split(".")
    steps: list[tuple[str | int, Any]] = []
    key: str | int
    while rest:
        at = ".".join(text.split(".")[: -len(rest)])
        if node is None and not rest[0].isdecimal() and (sections := list(sections_in(kind))):
            model = issubclass(sections[0], BaseModel)  # of defaults
            node = sections[0].model_construct() if model else object.__new__(sections[0])
            steps[-1] = (steps[-1][0], node)
        if is_section(type(node)):
            key, node, kind = _field(node, rest[0], at)
            used = 1
        elif isinstance(node, dict):
            key, used = _named(list(node), rest, at)
            node = node[key]
        elif isinstance(node, (tuple, list)):
            number, used = _entry(node, rest, at)
            key, node = number, node[number]
        else:
            what = f"the base has no {at}" if node is None else f"{at} has no fields of its own"
            raise LidarpoolError(f"{text} leads to no field: {what}.")
        steps.append((key, node))
        rest = rest[used:]
    return FieldPath(text, tuple(steps)), kind


def _field(node: BaseModel, name: str, at: str) -> tuple[str, Any, Any]:
    fields = fields_of(type(node))
    if name not in fields:
        place = f"a field of {at}" if at else "a section of a scenario"
        raise LidarpoolError(f"{name!r} is not {place}.{did_you_mean(name, fields)}")
    return name, getattr(node, attributes_of(type(node))[name], None), fields[name].annotation


def _named(names: Sequence[str], rest: Sequence[str], at: str) -> tuple[str, int]:
    """Return the longest of the names that a path goes on with, for a name may have dots."""
    for used in range(len(rest), 0, -1):
        if (name := ".".join(rest[:used])) in names:
            return name, used
    hint = did_you_mean(rest[0], names) or (f" It has {', '.join(names[:5])}." if names else "")
    raise LidarpoolError(f"{at} of the base has no {rest[0]!r}.{hint}")


def _entry(entries: Sequence[Any], rest: Sequence[str], at: str) -> tuple[int, int]:
    if rest[0].isdecimal():
        if (number := int(rest[0])) < len(entries):
            return number, 1
        raise LidarpoolError(
            f"{at} of the base has {counted(len(entries), 'entry', 'entries')}, counted from 0, "
            f"and no entry {number}."
        )
    names = [name for one in entries if isinstance(name := getattr(one, "name", None), str)]
    name, used = _named(names, rest, at)
    return next(i for i, one in enumerate(entries) if getattr(one, "name", None) == name), used


def opened(node: Any) -> Any:
    """Return a section's own fields as a dict, a list of entries as a list: to be changed.

    What is within stays as it is: sections that were checked are not checked again.
    """
    if is_section(type(node)):
        names = attributes_of(type(node))
        given = getattr(node, "model_fields_set", names.values())
        return {n: getattr(node, a) for n, a in names.items() if a in given and hasattr(node, a)}
    return list(node) if isinstance(node, (tuple, list)) else dict(node)


def put(node: Any, steps: Sequence[tuple[str | int, Any]], value: Any) -> Any:
    """Return a section with a value where the steps lead; the original stays as it is."""
    if not steps:
        return value
    (key, base), *rest = steps
    own = opened(node)
    if isinstance(own, list):
        assert isinstance(key, int), "a number of an entry"
        below = own[key] if key < len(own) else base
    else:
        below = own.get(key, base)
    own[key] = put(base if below is None else below, rest, value)
    return own


def held(node: Any, steps: Sequence[tuple[str | int, Any]]) -> Any:
    """Return what a section, some of whose parts may be opened, has where the steps lead."""
    for key, base in steps:
        own = opened(node)
        node = own.get(key, base) if isinstance(own, dict) else own[key]
        node = base if node is None else node
    return node

"""Paths into a scenario: keys joined by dots, numbers of entries, and names of entries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import BaseModel

from ..base.errors import LidarpoolError
from ..base.validation import fields_of, is_section, sections_in
from ..base.words import counted, did_you_mean
from .scenario import Scenario

# Keys and numbers of entries, each with the value there; of a section that is left out, one of
# defaults.
Steps = tuple[tuple[str | int, Any], ...]


def find_field(scenario: Scenario, text: str) -> tuple[Steps, Any]:
    """Find out where a path such as ``sensors.roof.model`` leads in a scenario.

    Returns
    -------
    The steps to the field, and its annotation.

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
    return tuple(steps), kind


def _field(node: BaseModel, name: str, at: str) -> tuple[str, Any, Any]:
    fields = {field.alias or own: own for own, field in fields_of(type(node)).items()}
    if name not in fields:
        place = f"a field of {at}" if at else "a section of a scenario"
        raise LidarpoolError(f"{name!r} is not {place}.{did_you_mean(name, fields)}")
    own = fields[name]
    return name, getattr(node, own, None), fields_of(type(node))[own].annotation


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


def put(node: Any, steps: Steps, change: Callable[[Any], Any]) -> Any:
    """Return a section with what `change` makes of the value where the steps lead.

    The original stays as it is. Sections on the way become mappings of their own fields, to be
    checked again; those beside it stay as they are.
    """
    if not steps:
        return change(node)
    (key, base), *rest = steps
    own: Any = list(node) if isinstance(node, (tuple, list)) else _own_fields(node)
    below = own[key] if isinstance(own, list) else own.get(key, base)  # type: ignore[index]
    own[key] = put(base if below is None else below, tuple(rest), change)
    return own


def _own_fields(node: Any) -> dict[Any, Any]:
    if is_section(type(node)):
        fields, given = fields_of(type(node)), getattr(node, "model_fields_set", vars(node))
        return {f.alias or n: getattr(node, n) for n, f in fields.items() if n in given}
    return dict(node)

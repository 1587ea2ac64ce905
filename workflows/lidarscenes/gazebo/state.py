"""The <state> of a world of Gazebo classic: poses that replace those of the models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import prefixed
from lidarsim.base.words import printable

from .bodies import scoped
from .frames import matrix_of, numbers_of

NO_SCALE = (1.0, 1.0, 1.0)


@dataclass
class State:
    """Poses in world coordinates by the names of models and links, MODEL::LINK."""

    poses: dict[str, Floats] = field(default_factory=dict)  # (4, 4)
    scales: dict[str, tuple[float, ...]] = field(default_factory=dict)  # of models
    inserted: list[Element] = field(default_factory=list)  # models
    deleted: set[str] = field(default_factory=set)  # names of models


def state_of(world: Element) -> State:
    """Return the last state of a world; an empty state without <state>."""
    state = State()
    elements = world.findall("state")
    if not elements:
        return state
    element = elements[-1]
    state.inserted = element.findall("insertions/model")
    state.deleted = {printable(name.text or "") for name in element.findall("deletions/name")}
    for path, entry in _entries(element, ()):
        name = scoped(path)
        with prefixed(f"state of {name[:80]!r}"):
            pose = entry.find("pose")
            if pose is not None and (pose.text or "").strip():
                state.poses[name] = matrix_of(pose)
            if entry.tag == "model":
                scale = tuple(numbers_of(entry, "scale", 3, "1 1 1").tolist())
                if scale != NO_SCALE:
                    state.scales[name] = scale
    return state


def _entries(element: Element, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Element]]:
    """Yield the models and links in a state, with their names."""
    for child in element:
        if child.tag in ("model", "link"):
            inner = (*path, printable(child.get("name", "")))
            yield inner, child
            yield from _entries(child, inner)

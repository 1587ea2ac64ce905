"""Elements of OpenDRIVE files: checked numbers, and a count of the elements that are not read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from math import isfinite
from xml.etree.ElementTree import Element

from lidarsim.base.words import plural
from lidarsim.scene.files.scene_graph import MeshFileError

MAX_SHOWN = 40  # letters of a value that an error shows
# Elements that carry no geometry, in any element.
_WITHOUT_GEOMETRY = {"userData", "dataQuality", "link", "validity", "vectorScene", "vectorRoad"}


def read_number(element: Element, name: str, default: float | None = None) -> float:
    """Return a number of an element.

    Raises MeshFileError if it is missing without a default, or broken.

    An empty text is missing.
    """
    text = element.get(name)
    if not text:
        if default is None:
            raise MeshFileError(
                f"contains <{element.tag}> without the attribute {name}. Add the attribute"
            )
        return default
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise MeshFileError(
            f"contains <{element.tag}> with {name} {text[:MAX_SHOWN]!r}, which is not a number. "
            "Correct the value"
        )
    return value


def read_non_negative(element: Element, name: str, default: float | None = None) -> float:
    """Return a number of 0 or more of an element.

    Raises MeshFileError if it is negative.
    """
    value = read_number(element, name, default)
    if value < 0:
        raise MeshFileError(
            f"contains <{element.tag}> with {name} {value:g}, which must not be negative. "
            "Correct the value"
        )
    return value


class UnreadElements:
    """Count of the elements that are not read, by their tags."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, tag: str, count: int = 1) -> None:
        """Count elements of a tag, or other content that is described by words."""
        self._counts[tag[:MAX_SHOWN]] += count

    def check(self, element: Element, known: Collection[str]) -> None:
        """Count the children of an element whose tags are not known."""
        for child in element:
            if child.tag not in known and child.tag not in _WITHOUT_GEOMETRY:
                self.add(child.tag)

    def __str__(self) -> str:
        """Return counts and tags, or words: «2 bridge, 3 objects without a size».

        The text may be empty.
        """
        return ", ".join(_counted(count, tag) for tag, count in self._counts.items())


def _counted(count: int, tag: str) -> str:
    """Return a count and a tag, or words whose first is in the plural for several."""
    noun, space, rest = tag.partition(" ")
    return f"{plural(count, noun)} {rest}" if space else f"{count} {tag}"

"""Read validated numbers from OpenDRIVE elements, and count unread elements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from math import isfinite
from xml.etree.ElementTree import Element

from lidarsim.scene.files.scene_graph import MeshFileError
from lidarsim.words import plural

MAX_SHOWN = 40  # maximum number of characters of a value in an error message
# Elements without geometry, which may occur anywhere.
_WITHOUT_GEOMETRY = {"userData", "dataQuality", "link", "validity", "vectorScene", "vectorRoad"}


def read_number(element: Element, name: str, default: float | None = None) -> float:
    """Return an attribute as a number.

    An empty attribute counts as missing. Raises MeshFileError if the attribute is missing and there
    is no default, or if it is invalid.
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
    """Return an attribute as a number that is not negative.

    Raises MeshFileError if it is negative, or as `read_number` does.
    """
    value = read_number(element, name, default)
    if value < 0:
        raise MeshFileError(
            f"contains <{element.tag}> with {name} {value:g}, which must not be negative. "
            "Correct the value"
        )
    return value


class UnreadElements:
    """Counts elements that are not read, by tag."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, tag: str, count: int = 1) -> None:
        """Count an unread element by its tag, or other content by a phrase that describes it."""
        self._counts[tag[:MAX_SHOWN]] += count

    def check(self, element: Element, known: Collection[str]) -> None:
        """Count those children of an element whose tags are unknown."""
        for child in element:
            if child.tag not in known and child.tag not in _WITHOUT_GEOMETRY:
                self.add(child.tag)

    def __str__(self) -> str:
        """Format the counts and tags, for example as "2 bridge, 3 objects without a size".

        The text is empty if everything was read.
        """
        return ", ".join(_counted(count, tag) for tag, count in self._counts.items())


def _counted(count: int, tag: str) -> str:
    """Format a count with a tag, or with a phrase whose first word is pluralized."""
    noun, space, rest = tag.partition(" ")
    return f"{plural(count, noun)} {rest}" if space else f"{count} {tag}"

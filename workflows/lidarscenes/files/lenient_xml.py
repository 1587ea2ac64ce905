"""Parse SDFormat and MJCF files as leniently as Gazebo and MuJoCo do.

Public files have comments that contain "--" and prefixes without a namespace, which expat, and
therefore ElementTree, rejects. Entities are rejected, except predefined entities and character
references.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

from lidarsim.errors import CutShortError

MAX_ELEMENTS = 1_000_000  # public Gazebo worlds have up to 60,000
_MAX_DEPTH = 200

_TAG = re.compile(
    r"<(?P<end>/?)(?P<name>[^\s<>/!?\"'=]+)"
    r"(?P<attributes>(?:\s+[^\s=<>/\"']+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)\s*(?P<empty>/?)>"
)
_ATTRIBUTE = re.compile(r"([^\s=<>/\"']+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_REFERENCE = re.compile(r"&(#x[0-9a-fA-F]{1,8}|#[0-9]{1,8}|\w{1,40});")
_CHARACTERS = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}
_SKIPPED = {"<!--": "-->", "<?": "?>"}  # {start of a part without elements: end}
_CDATA = ("<![CDATA[", "]]>")


def parse_lenient_xml(data: bytes) -> Element:
    """Parse an XML file, and return its root element.

    Prefixes remain in tags, and comments are skipped.

    Raises
    ------
    ValueError
        If the file is not XML, declares entities, or has too many elements.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return _Parser(text).root()


class _Parser:
    """A parser that builds elements from a text."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._open: list[Element] = []  # elements that are not complete
        self._texts: list[list[str]] = []  # parts of the text of each open element
        self._root: Element | None = None
        self._count = 0

    def root(self) -> Element:
        text = self._text
        position = 0
        while (start := text.find("<", position)) >= 0:
            self._add_text(text[position:start])
            position = self._after_markup(start)
        if self._open:
            raise CutShortError(f"its last element, <{self._open[-1].tag[:40]}>, is not closed")
        if self._root is None:
            raise ValueError("it contains no elements")
        return self._root

    def _after_markup(self, start: int) -> int:
        """Parse the markup at a position, and return the position where it ends."""
        text = self._text
        for first, last in _SKIPPED.items():
            if text.startswith(first, start):
                return self._end_of(start, last)
        first, last = _CDATA
        if text.startswith(first, start):
            stop = self._end_of(start, last)
            self._add_text(text[start + len(first) : stop - len(last)], is_literal=True)
            return stop
        if text.startswith("<!", start):
            return self._after_declaration(start)
        tag = _TAG.match(text, start)
        if tag is None:
            if ">" not in text[start:]:
                raise CutShortError(f"it ends inside a tag on line {self._line(start)}")
            raise ValueError(f"line {self._line(start)} contains an invalid tag")
        if tag["end"]:
            self._end_element(tag["name"], start)
        else:
            self._start_element(tag, start)
        return tag.end()

    def _end_of(self, start: int, mark: str) -> int:
        """Return the position after the next occurrence of an end mark."""
        stop = self._text.find(mark, start)
        if stop < 0:
            raise ValueError(
                f"the section that starts on line {self._line(start)} is not closed with {mark}"
            )
        return stop + len(mark)

    def _after_declaration(self, start: int) -> int:
        """Return the position after a <!DOCTYPE …>.

        Raises ValueError if it declares entities.
        """
        stop = self._end_of(start, ">")
        declaration = self._text[start:stop]
        if "[" in declaration or not declaration.upper().startswith("<!DOCTYPE"):
            raise ValueError("it declares XML entities, which are not supported")
        return stop

    def _start_element(self, tag: re.Match[str], start: int) -> None:
        """Start an element. If its tag is empty, like <a/>, this also completes the element."""
        self._count += 1
        if self._count > MAX_ELEMENTS:
            raise ValueError(f"it contains more than {MAX_ELEMENTS:,} elements")
        element = Element(tag["name"])
        for name, double, single in _ATTRIBUTE.findall(tag["attributes"]):
            element.attrib.setdefault(name, self._resolved(double or single))
        if self._open:
            self._open[-1].append(element)
        elif self._root is not None:
            raise ValueError(f"line {self._line(start)} starts a second root element")
        else:
            self._root = element
        if not tag["empty"]:
            self._open.append(element)
            self._texts.append([])
            if len(self._open) > _MAX_DEPTH:
                raise ValueError(f"its elements are nested more than {_MAX_DEPTH} levels deep")

    def _end_element(self, name: str, start: int) -> None:
        """Complete the innermost element."""
        if not self._open or self._open[-1].tag != name:
            raise ValueError(
                f"line {self._line(start)} contains </{name[:40]}> without a matching start tag"
            )
        element = self._open.pop()
        element.text = "".join(self._texts.pop()) or None

    def _add_text(self, text: str, *, is_literal: bool = False) -> None:
        if self._open and not text.isspace() and text:
            self._texts[-1].append(text if is_literal else self._resolved(text))

    def _resolved(self, text: str) -> str:
        """Replace the character references in a text."""
        return _REFERENCE.sub(_character, text) if "&" in text else text

    def _line(self, position: int) -> int:
        """Return the line number at a position, starting from 1."""
        return self._text.count("\n", 0, position) + 1


def _character(reference: re.Match[str]) -> str:
    """Return the character for an XML reference such as ``&amp;``.

    Raises ValueError if it is an entity that is not predefined.
    """
    name = reference[1]
    if name in _CHARACTERS:
        return _CHARACTERS[name]
    if not name.startswith("#"):
        raise ValueError(
            f"it uses the XML entity {name[:20]!r}, but only predefined entities are supported"
        )
    code = int(name[2:], 16) if name[1] == "x" else int(name[1:])
    return chr(code) if code < 0x110000 else "\ufffd"

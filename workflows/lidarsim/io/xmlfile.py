"""XML parsing that rejects entity declarations, because a few entities can expand to any size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from ..errors import CutShortError
from .allowance import bytes_of

PIECE_BYTES = 2**20  # piece size for incremental parsing
# Maximum length of a tag or comment in incremental parsing. Expat buffers unfinished tokens, and
# versions before 2.6 parse them again with each piece. Text is not buffered and has no limit.
MAX_TAG_BYTES = 16 * 2**20
# Codes of the errors that expat reports for a truncated document.
AT_END = tuple(
    expat.errors.codes[message]
    for message in (
        expat.errors.XML_ERROR_NO_ELEMENTS,
        expat.errors.XML_ERROR_UNCLOSED_TOKEN,
        expat.errors.XML_ERROR_UNCLOSED_CDATA_SECTION,
    )
)


class _RootFoundError(Exception):
    """Signal that parsing has reached the root element, which follows all entity declarations."""


def xml_root(data: bytes) -> Element:
    """Parse an XML file and return its root element without comments.

    Raises
    ------
    ValueError
        If the file declares entities, or if a tag up to and including the root tag is longer than
        `MAX_TAG_BYTES`. Later tags have no limit, because they are parsed in linear time.
    CutShortError
        If the file is truncated.
    ElementTree.ParseError
        If the file is not valid XML.
    """
    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = _stop
    pieces = (data[start : start + PIECE_BYTES] for start in range(0, len(data), PIECE_BYTES))
    with suppress(expat.ExpatError, _RootFoundError):  # ElementTree reports syntax errors below
        for _ in parse_pieces(parser, pieces):
            pass
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        if error.code not in AT_END:
            raise
        raise CutShortError(
            f"its XML ends inside an element in line {error.position[0]}"
        ) from error


def _stop(tag: str, attributes: object) -> NoReturn:
    raise _RootFoundError


def parse_pieces(parser: expat.XMLParserType, pieces: Iterable[bytes]) -> Iterator[None]:
    """Parse a file incrementally, and yield after each piece.

    Raises
    ------
    ValueError
        If a tag or comment is longer than `MAX_TAG_BYTES`.
    expat.ExpatError
        If the file is not valid XML.
    """
    count = 0
    for piece in pieces:
        parser.Parse(piece)
        count += len(piece)
        if count - parser.CurrentByteIndex > MAX_TAG_BYTES:
            raise ValueError(f"it contains a tag or comment longer than {bytes_of(MAX_TAG_BYTES)}")
        yield
    parser.Parse(b"", True)
    yield


def refuse_entity(name: str, *details: object) -> NoReturn:
    """Handle an entity declaration by raising ValueError.

    The protection in expat is not sufficient. It stops the expansion only when the text has grown
    to a hundred times the file size, and elements take thirty times as much memory as their text.
    """
    raise ValueError(f"it declares the XML entity {name[:20]!r}, which may expand without limit")

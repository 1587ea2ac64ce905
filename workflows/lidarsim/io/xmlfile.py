"""XML files without entities: a few entities expand to any length."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from ..errors import CutShortError
from .allowance import bytes_of

PIECE_BYTES = 2**20  # size of a piece of files that are parsed piece by piece
# Length of a tag or remark in files that are parsed piece by piece. Expat keeps what is unfinished,
# and before version 2.6 begins again with each piece. Text of any length does no harm.
MAX_TAG_BYTES = 16 * 2**20
# Codes of the errors of a text that ends too early.
AT_END = tuple(
    expat.errors.codes[message]
    for message in (
        expat.errors.XML_ERROR_NO_ELEMENTS,
        expat.errors.XML_ERROR_UNCLOSED_TOKEN,
        expat.errors.XML_ERROR_UNCLOSED_CDATA_SECTION,
    )
)


class _RootFoundError(Exception):
    """The first element has begun, before which all entities are declared."""


def xml_root(data: bytes) -> Element:
    """Return the root element of a file, without comments.

    Raises
    ------
    ValueError
        If the file declares entities, or a tag up to the root's is longer than
        `MAX_TAG_BYTES`. Tags after the root take a time that is proportional to their length.
    CutShortError
        If the file ends before its root element does.
    ElementTree.ParseError
        If the file is not XML.
    """
    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = _stop
    pieces = (data[start : start + PIECE_BYTES] for start in range(0, len(data), PIECE_BYTES))
    with suppress(expat.ExpatError, _RootFoundError):  # ElementTree raises errors of the file below
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
    """Handle the start of the first element."""
    raise _RootFoundError


def parse_pieces(parser: expat.XMLParserType, pieces: Iterable[bytes]) -> Iterator[None]:
    """Parse the pieces of a file, and yield after each piece.

    Raises
    ------
    ValueError
        If a tag is longer than `MAX_TAG_BYTES`, which are all that expat keeps.
    expat.ExpatError
        If the file is not XML.
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
    """Handle the declaration of an entity: raise ValueError.

    Expat itself stops an expansion only at a hundred times the file, of text; elements take thirty
    times their text.
    """
    raise ValueError(f"it declares the XML entity {name[:20]!r}, which may expand without limit")

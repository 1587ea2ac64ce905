"""XML files without entities: a few entities expand to any length."""

from __future__ import annotations

from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from .errors import CutShortError

_BLOCK_BYTES = 1 << 16
# Codes of the errors of a text that ends too early.
AT_END = tuple(
    expat.errors.codes[message]
    for message in (
        expat.errors.XML_ERROR_NO_ELEMENTS,
        expat.errors.XML_ERROR_UNCLOSED_TOKEN,
        expat.errors.XML_ERROR_UNCLOSED_CDATA_SECTION,
    )
)


def xml_root(data: bytes) -> Element:
    """Return the root element of a file, without comments.

    Raises
    ------
    ValueError
        If the file declares entities.
    CutShortError
        If the file ends before its root element does.
    ElementTree.ParseError
        If the file is not XML.
    """
    parser = expat.ParserCreate()
    tags: list[str] = []
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = lambda tag, attributes: tags.append(tag)
    try:
        for start in range(0, len(data), _BLOCK_BYTES):
            parser.Parse(data[start : start + _BLOCK_BYTES])
            if tags:  # declarations come before the first element
                break
    except expat.ExpatError:
        pass  # ElementTree raises the error below
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        if error.code not in AT_END:
            raise
        raise CutShortError(
            f"its XML ends within an element, in line {error.position[0]}"
        ) from error


def refuse_entity(name: str, *details: object) -> NoReturn:
    """Handle the declaration of an entity: raise ValueError.

    Expat itself stops an expansion only at a hundred times the file, of text; elements take thirty
    times their text.
    """
    raise ValueError(f"it declares an XML entity, {name[:20]!r}, which may expand to any length")

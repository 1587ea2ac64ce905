"""XML files without entities: a few entities expand to any length."""

from __future__ import annotations

from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

_BLOCK_BYTES = 1 << 16


def xml_root(data: bytes) -> Element:
    """Return the root element of a file, without comments.

    Raises
    ------
    ValueError
        If the file declares entities.
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
    return ElementTree.fromstring(data)


def refuse_entity(name: str, *details: object) -> NoReturn:
    """Handle the declaration of an entity: raise ValueError.

    Expat itself stops an expansion only at a hundred times the file, of text; elements take thirty
    times their text.
    """
    raise ValueError(f"it declares an XML entity, {name[:20]!r}, which may expand to any length")

"""XML files, without entities: a few of them expand to any length."""

from __future__ import annotations

from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

_PIECE = 1 << 16


def xml_root(data: bytes) -> Element:
    """Root element of a file, without comments.

    Raises
    ------
    ValueError
        If it declares entities; `ElementTree.ParseError` if it is not XML.
    """
    parser = expat.ParserCreate()
    begun: list[str] = []
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = lambda tag, attributes: begun.append(tag)
    try:
        for start in range(0, len(data), _PIECE):
            parser.Parse(data[start : start + _PIECE])
            if begun:  # declarations come before it
                break
    except expat.ExpatError:
        pass  # told below
    return ElementTree.fromstring(data)


def refuse_entity(name: str, *rest: object) -> NoReturn:
    """Handle the declaration of an entity: raise ValueError.

    Expat itself stops an expansion only at a hundred times the file, of text; elements take thirty
    times their text.
    """
    raise ValueError(f"it declares an XML entity, {name[:20]!r}, which may expand to any length")

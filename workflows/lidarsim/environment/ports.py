"""Parsing of TCP and UDP port numbers."""

from __future__ import annotations

_MAX_DIGITS = 5


def port_number(text: str) -> int | None:
    """Parse a port number from 0 to 65,535, or return None if the text is not a port number."""
    if not (text.isascii() and text.isdecimal() and len(text) <= _MAX_DIGITS):
        return None
    number = int(text)
    return number if number < 1 << 16 else None

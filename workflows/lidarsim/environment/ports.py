"""Ports of TCP and UDP as text."""

from __future__ import annotations

_MAX_DIGITS = 5


def port_number(text: str) -> int | None:
    """Return the number from 0 to 65,535 that a text is, or None for other text, however long."""
    if not (text.isascii() and text.isdecimal() and len(text) <= _MAX_DIGITS):
        return None
    number = int(text)
    return number if number < 1 << 16 else None

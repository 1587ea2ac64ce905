"""Words for messages; a leaf module."""

from __future__ import annotations


def counted(number: float, what: str, several: str = "") -> str:
    """Return number and noun: «1 worker», «1,200 workers»."""
    return f"{number:,} {what if number == 1 else several or what + 's'}"

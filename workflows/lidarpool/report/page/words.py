"""Formats numbers and names for readers; a leaf module."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

MINUS, NARROW = "\N{MINUS SIGN}", "\N{NARROW NO-BREAK SPACE}"
_SPACES = f"\n\t\N{NO-BREAK SPACE}{NARROW}"  # not printable to Python, and harmless


def printable(text: str) -> str:
    """Replace unprintable characters; names in files may contain ones that reverse a line."""
    return "".join(
        c if c.isprintable() or c in _SPACES else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def markdown(text: str) -> str:
    """Text of a user as one line of Markdown that shows it as it is."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return re.sub(r"([\\`*{}\[\]<>|#&~]|(?<!\w)_|_(?!\w))", r"\\\1", line)


def code(text: str) -> Markup:
    """Name as code of Markdown; with letters that end code or a cell, as text."""
    is_plain = text.isprintable() and not re.search(r"[`|\\]", text)
    return Markup(f"`{text}`" if is_plain else markdown(text))


def grouped(count: int) -> str:
    """Return a whole number with thousands separated."""
    return f"{count:,}"


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if seconds < 0.001:
        return f"{1e6 * seconds:.0f} µs"
    if seconds < 0.9995:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 99.95:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600:,} h {whole % 3600 // 60:02d} min"


def rate(number: float, seconds: float) -> str:
    """Return a rate per second; a dash if the time is unknown."""
    return f"{large(number / seconds)}/s" if seconds > 0 else "–"


def large(number: float) -> str:
    """Return a number with three digits, and k, M or G if it is large."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= size:
            scaled = number / (1e3 if letter == "k" else size)
            return f"{scaled:.{max(0, 2 - int(math.log10(scaled)))}f}{NARROW}{letter}"
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def share(part: float, whole: float) -> str:
    """Return a part in per cent."""
    return f"{100 * part / whole:.1f}%" if whole else "–"


def excess(fraction: float) -> str:
    """Return an excess in per cent: «+0.12%»."""
    if 0 < fraction < 1e-4:
        return "< 0.01%"
    return f"{fraction:+.2%}".replace("-", MINUS)


def told(value: Any, digits: int = 6) -> str:
    """Return a number, whole ones with all their digits; text, true or false, or several."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " × ".join(told(one, digits) for one in value)
    if isinstance(value, float):
        return f"{value:,.{digits}g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def numbers(values: Sequence[float]) -> str:
    """Coordinates, short."""
    return ", ".join(f"{value:,.10g}" for value in values).replace("-", MINUS)


def millimetres(value: float | None) -> str:
    """Length in the unit that suits it, or words for none."""
    if value is None:
        return "unknown"
    text = f"{value:.3f} m" if abs(value) >= 0.9995 else f"{1000 * value:.3g} mm"
    return text.replace("-", MINUS)


def ratio(value: float | None) -> str:
    """Return a share from 0 to 1, or words for none."""
    return "undefined" if value is None else f"{value:.3f}"

"""Render pages and texts from templates.

A package keeps its templates in its folder `templates`. All packages share the frame of pages,
their style sheet, and macros for tables and pictures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from lidarsim.words import distinct_names, plural, remove_common_prefix, shorten_name

if TYPE_CHECKING:
    from jinja2 import Template

MINUS = "\N{MINUS SIGN}"
NARROW = "\N{NARROW NO-BREAK SPACE}"
_SPACES = f"\n\t\N{NO-BREAK SPACE}{NARROW}"  # harmless, although `str.isprintable` rejects them


def render_template(
    template: str, *modules: str, pictures: Mapping[str, str] | None = None, **values: Any
) -> str:
    """Render an HTML, Markdown or text template.

    Parameters
    ----------
    template
        File name of the template, whose extension selects the kind of escaping.
    *modules
        Names of modules (`__name__`) next to whose folder `templates` the template, and those that
        it includes, are found. The templates that all packages share are found in any case.
    pictures
        {name: HTML element}. Pictures are not escaped.
    **values
        Other values of the template, which are escaped. It is an error if the template uses a value
        that is not passed.
    """
    images = {name: Markup(image) for name, image in (pictures or {}).items()}
    return _template(template, modules).render(pictures=images, **values)


@cache  # compiling a template takes longer than rendering it
def _template(name: str, modules: tuple[str, ...]) -> Template:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined  # takes long

    escaped = escape_markdown if name.endswith(".md") else printable
    environment = Environment(
        loader=ChoiceLoader(
            [PackageLoader(one.rpartition(".")[0]) for one in (*modules, __name__)]
        ),
        autoescape=name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: escaped(value) if type(value) is str else value,  # skips Markup
    )
    for filter_ in (
        duration,
        rate,
        large,
        share,
        excess,
        numbers,
        format_value,
        code,
        code_spans,
        escape_markdown,
        millimeters,
        ratio,
        sentence,
        plural,
    ):
        environment.filters[filter_.__name__] = filter_
    environment.filters["distinct_names"] = distinct_names
    environment.filters["with_names"] = _with_names
    environment.filters["shortened"] = lambda name, length=60: shorten_name(name, length)
    environment.filters["one_line"] = lambda text: type(text)(re.sub("[ \n]+", " ", text).strip())
    environment.filters["labels"] = lambda names: dict(
        zip(names, remove_common_prefix([*names]), strict=True)
    )
    return environment.get_template(name)


def _with_names(row: str, head: Sequence[str]) -> Markup:
    """Add the name of its column to each cell of a table row, for the style sheet.

    The first column, which contains the name of the row (th), is skipped.
    """
    names = iter(head[1:])
    return Markup(re.sub("<td", lambda _: f'<td data-name="{escape(next(names, ""))}"', row))


def sentence(note: str, names: Iterable[str] = ()) -> str:
    """Capitalize the first letter of a note unless the note begins with a name.

    A first word that is not entirely lowercase letters, such as ``wall.obj``, is considered a name.
    `names` lists names that look like ordinary words.

    Examples
    --------
    >>> sentence("all points are in rain"), sentence("wall.obj has no faces")
    ('All points are in rain', 'wall.obj has no faces')
    """
    first = note.partition(" ")[0].rstrip(",:;")
    is_name = not (first.isalpha() and first.islower()) or note.startswith((*filter(None, names),))
    return note if is_name else f"{note[:1].upper()}{note[1:]}"


def code_spans(text: str) -> Markup:
    """Format text between backticks in a message as code.

    Examples
    --------
    >>> code_spans("set `a: 1`, if x < 2")
    Markup('set <code>a: 1</code>, if x &lt; 2')
    """
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(printable(text)))))


def printable(text: str) -> str:
    """Replace unprintable characters, including those that reverse the text direction."""
    return "".join(
        c if c.isprintable() or c in _SPACES else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def escape_markdown(text: str) -> str:
    """Escape text for Markdown, and join its lines."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return re.sub(r"([\\`*{}\[\]<>|#&~]|(?<!\w)_|_(?!\w))", r"\\\1", line)


def code(text: str) -> Markup:
    """Format a name as a Markdown code span.

    Names that contain characters with a special meaning in code spans or tables are escaped
    instead.
    """
    is_plain = text.isprintable() and not re.search(r"[`|\\]", text)
    return Markup(f"`{text}`" if is_plain else escape_markdown(text))


def duration(seconds: float) -> str:
    """Format a duration with an appropriate unit."""
    if 0 < seconds < 0.001:
        return f"{1e6 * seconds:.0f} µs"
    if 0 < seconds < 0.9995:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 99.95:
        return f"{seconds:.3g} s"
    total_s = round(seconds)
    if total_s < 3600:
        return f"{total_s // 60} min {total_s % 60:02d} s"
    return f"{total_s // 3600:,} h {total_s % 3600 // 60:02d} min"


def rate(number: float, seconds: float) -> str:
    """Format a rate per second, or return a dash if the duration is unknown."""
    return f"{large(number / seconds)}/s" if seconds > 0 else "–"


def large(number: float) -> str:
    """Format a number with three significant digits, using the suffixes k, M and G."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= size:
            scaled = number / (1e3 if letter == "k" else size)
            return f"{scaled:.{max(0, 2 - int(math.log10(scaled)))}f}{NARROW}{letter}"
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def share(part: float, total: float) -> str:
    """Format the ratio of a part to a total as a percentage."""
    return f"{100 * part / total:.1f}%" if total else "–"


def excess(fraction: float) -> str:
    """Format a relative excess as a signed percentage, for example "+0.12%"."""
    if 0 < fraction < 1e-4:
        return "< 0.01%"
    return f"{fraction:+.2%}".replace("-", MINUS)


def format_value(value: Any) -> str:
    """Format a value for display.

    Floating-point numbers are rounded to four significant digits, or to one decimal place if they
    are large. Integers keep all digits, and text is unchanged.
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " × ".join(map(format_value, value))
    if isinstance(value, float):
        digits = ".1f" if 1000 <= abs(value) < 1e9 else ".4g"
        return f"{value:,{digits}}".removesuffix(".0")
    return f"{value:,}" if isinstance(value, int) else str(value)


def numbers(values: Sequence[float]) -> str:
    """Format coordinates in meters, rounded to millimeters."""
    return ", ".join(f"{round(value, 3) + 0.0:,.10g}" for value in values).replace("-", MINUS)


def millimeters(value: float | None) -> str:
    """Format a length in meters or millimeters, or return "unknown" for None."""
    if value is None:
        return "unknown"
    text = f"{value:.3f} m" if abs(value) >= 0.9995 else f"{1000 * value:.3g} mm"
    return text.replace("-", MINUS)


def ratio(value: float | None) -> str:
    """Format a ratio between 0 and 1, or return "undefined" for None."""
    return "undefined" if value is None else f"{value:.3f}"

"""Tables as text, and as the HTML that notebooks show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tornado.template import Template

# tornado escapes all that is written into a template: names come from users.
_TABLE = Template("""<table>
<caption style="text-align: left">{{ title }}</caption>
<thead><tr>{% for name in head %}<th style="text-align: {{ sides[name] }}">{{ name }}</th>{% end %}\
</tr></thead>
<tbody>{% for row in rows %}
<tr>{% for name, cell in zip(head, row) %}\
<td style="text-align: {{ sides[name] }}">{{ cell }}</td>{% end %}</tr>{% end %}
</tbody>
</table>
""")
_PARAGRAPH = Template("<p>{{ text }}</p>\n")
# Columns of words, which begin at the left; numbers end at the right.
TEXT_COLUMNS = frozenset({"", "partition", "stage", "worker", "pipe", "state", "status", "address"})


def html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table with a title, the names of the columns and rows of cells."""
    sides = {name: "left" if name in TEXT_COLUMNS else "right" for name in head}
    return _TABLE.generate(title=title, head=head, rows=rows, sides=sides).decode()


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as lines of text, with columns of equal width."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    )


def html_paragraph(text: str) -> str:
    """Return a text as a paragraph."""
    return _PARAGRAPH.generate(text=text).decode()


def format_seconds(seconds: float) -> str:
    """Return a running time with three digits, or a dash if nothing has run."""
    if not seconds:
        return "–"
    return f"{seconds:,.0f}" if seconds >= 100 else f"{seconds:.3g}"

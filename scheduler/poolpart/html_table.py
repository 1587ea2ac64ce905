"""Format tables as plain text, and as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tornado.template import Template

# Names come from users, and tornado escapes everything that is inserted into a template.
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
# Columns that contain text and are left-aligned. Numbers are right-aligned.
TEXT_COLUMNS = frozenset(
    {
        *("", "partition", "stage", "client", "worker", "pipe", "state", "status", "address"),
        *("time", "from", "to", "reason"),  # columns of moves
    }
)


def html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return an HTML table with a title, column names and rows of cells."""
    sides = {name: "left" if name in TEXT_COLUMNS else "right" for name in head}
    return _TABLE.generate(title=title, head=head, rows=rows, sides=sides).decode()


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a plain-text table whose columns have a fixed width."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    )


def html_paragraph(text: str) -> str:
    """Format a text as an HTML paragraph."""
    return _PARAGRAPH.generate(text=text).decode()


def format_seconds(seconds: float) -> str:
    """Format a duration with three significant digits, or as a dash if it is zero."""
    if not seconds:
        return "–"
    return f"{seconds:,.0f}" if seconds >= 100 else f"{seconds:.3g}"

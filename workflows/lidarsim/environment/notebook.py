"""Display of objects in notebooks as HTML tables and images."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

PICTURE_SIZE = (800, 500)  # pixels; text would be illegible in smaller pictures

# {class name: "module:function" that draws an instance as a PNG}
_drawers: dict[str, str] = {}


def cell_display() -> Any:
    """Return the `IPython.display` module in a notebook, or None elsewhere."""
    if "ipykernel" not in sys.modules:
        return None
    from IPython import display, get_ipython

    shell: Any = get_ipython()
    return display if type(shell).__name__ == "ZMQInteractiveShell" else None


def register_drawers(drawers: Mapping[str, str]) -> None:
    """Register functions that draw objects in notebooks.

    `drawers` maps class names to functions, which are specified as "module:function". A function
    receives an instance of the class and returns a PNG, or None if there is nothing to draw. Its
    module is imported when a notebook displays such an instance for the first time.
    """
    _drawers.update(drawers)


def html_table(rows: Iterable[tuple[str, str]]) -> str:
    """Return an HTML table of names and values that follows the notebook's color theme."""
    from html import escape

    left = " style='text-align:left'"
    lines = (
        f"<tr><th{left}>{escape(name)}</th><td{left}>{escape(value)}</td></tr>"
        for name, value in rows
    )
    return f"<table>{''.join(lines)}</table>"


def html_picture(instance: object) -> str:
    """Return an image of an instance as HTML, or an empty string if no function draws its class."""
    from importlib import import_module

    from ..errors import LidarError

    names = (kind.__name__ for kind in type(instance).__mro__)
    drawer = next((_drawers[name] for name in names if name in _drawers), None)
    if drawer is None:
        return ""
    module, _, function = drawer.partition(":")
    try:
        png: bytes | None = getattr(import_module(module), function)(instance)
    except LidarError:  # if the scene cannot be rendered, only the table is shown
        return ""
    return "" if png is None else html_image(png, type(instance).__name__)


def html_image(png: bytes, name: str) -> str:
    """Return a PNG as an HTML image that is displayed at most at its original width."""
    from base64 import b64encode
    from html import escape

    data = b64encode(png).decode()
    style = f"display:block;width:100%;max-width:{PICTURE_SIZE[0]}px"
    return f'<img alt="{escape(name)}" src="data:image/png;base64,{data}" style="{style}">'

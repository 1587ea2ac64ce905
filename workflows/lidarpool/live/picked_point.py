"""Clicked points: all columns of a point, and its distance to another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns.cloud import Cloud
from ..columns.table import Column
from .labels import Labels
from .page import LivePage

HINT = "Click a point; Shift and click another to measure."
_MARK, _SIZE = (255, 0, 160), 0.006  # of its distance from the camera
_BOX = (
    '<div style="padding:0 0.8em 0.4em;font-size:0.75em;display:grid;line-height:1.35;'
    'grid-template-columns:1fr 1fr;gap:0 0.8em;font-variant-numeric:tabular-nums">'
)


class PickedPoints:
    """The last clicked point, and a second one for measuring.

    `columns` are shown of a point; `names` are those of the values 0, 1, 2, … of a label; `origin`
    is the world position of the local origin, (3,).
    """

    def __init__(
        self,
        page: LivePage,
        labels: Labels,
        columns: Mapping[str, Column],
        names: Mapping[str, Sequence[str]],
        origin: NDArray[np.float64],
    ) -> None:
        self._page, self._labels = page, labels
        self._columns, self._names, self._origin = columns, names, origin
        self._points: list[Cloud] = []  # one each; two at most
        self._nodes: list[Any] = []
        self._length = ""  # label
        self._text = page.gui.add_html("")
        self._tell()

    def take(self, point: Cloud | None, measure: bool, eye: Sequence[float]) -> None:
        """Take a point clicked from `eye`, (3,) local, or None."""
        before = self._points[:1] if measure else []
        self._points = [] if point is None else [*before, point]
        self._tell()
        for node in self._nodes:
            node.remove()
        self._nodes = []
        self._labels.put(self._length, None)
        if not self._points:
            return
        places = np.concatenate([p.positions for p in self._points]) - self._origin
        size = _SIZE * float(np.linalg.norm(places[-1] - np.array(eye)))
        scene = self._page.scene
        self._nodes = [
            scene.add_icosphere(f"/picked/{number}", size, _MARK, position=place, cast_shadow=False)
            for number, place in enumerate(places)
        ]
        if len(places) == 2:
            line = places[None].astype(np.float32)
            way = scene.add_line_segments(
                "/picked/way", line, _MARK, thickness=3.0, thickness_units="screen"
            )
            self._nodes.append(way)
            self._length = f"{np.linalg.norm(places[1] - places[0]):,.3f} m"
            self._labels.put(self._length, places.mean(axis=0), first=True)

    def _tell(self) -> None:
        if not self._points:
            self._text.content = f'<div style="padding:0 0.8em 0.4em;font-size:0.75em">{HINT}</div>'
            return
        point = self._points[-1]
        entries = []
        if len(self._points) == 2:
            entries = measured(*(point.positions[0] for point in self._points))
        at = zip("xyz", point.positions[0].tolist(), strict=True)
        entries += [(axis, f"{metres:,.3f} m") for axis, metres in at]
        for name, column in self._columns.items():
            entries += [(name, self._value(column, value)) for value in point.columns.get(name, ())]
        cells = (f"<div>{escape(name)} <b>{escape(value)}</b></div>" for name, value in entries)
        self._text.content = f"{_BOX}{''.join(cells)}</div>"

    def _value(self, column: Column, value: Any) -> str:
        names = self._names.get(column.name, ())
        if column.kind == "label" and 0 <= value < len(names):
            return names[int(value)] or str(value)
        if column.unit == "ns":
            return f"{int(value) / 1e9:.9f} s"
        number = f"{value:.6g}" if np.issubdtype(type(value), np.floating) else f"{value}"
        return f"{number} {column.unit}".rstrip()


def measured(start: NDArray[Any], end: NDArray[Any]) -> list[tuple[str, str]]:
    """(name, metres) of the distances from one point (3,) to another."""
    way = end.astype(np.float64) - start
    return [
        ("distance", f"{np.linalg.norm(way):,.3f} m"),
        ("horizontal", f"{np.hypot(way[0], way[1]):,.3f} m"),
        *(
            (f"Δ{axis}", f"{metres:+,.3f} m")
            for axis, metres in zip("xyz", way.tolist(), strict=True)
        ),
        ("", ""),
    ]

"""Labels on a page; each browser hides overlapping ones."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .looking import Eye
from .page import LivePage

MOST_LABELS = 100
_LETTER, _ROUND, _HEIGHT = 7.5, 12.0, 22.0  # pixels: of a letter, around all, of a line


class Labels:
    """Labels on a page; of two that overlap, the first one is shown."""

    def __init__(self, page: LivePage) -> None:
        self._page = page
        self._places: dict[str, tuple[float, ...]] = {}  # {text: where it is}
        # {client: (what was drawn, {text: node})}
        self._shown: dict[int, tuple[Hashable, dict[str, Any]]] = {}

    def put(self, text: str, place: NDArray[np.floating] | None, *, first: bool = False) -> None:
        """Place a label, (3,) local, `first` of all; or move or remove the one with this text."""
        if place is None:
            self._places.pop(text, None)
        elif first:
            self._places = {text: tuple(place.tolist()), **self._places}
        elif text in self._places or len(self._places) < MOST_LABELS:
            self._places[text] = tuple(place.tolist())

    def draw(self) -> None:
        """Update the visible labels of each browser, if anything has moved."""
        clients = self._page.get_clients()
        self._shown = {client: self._shown.get(client, (None, {})) for client in clients}
        for client, (before, nodes) in self._shown.items():
            handle = clients[client]
            eye, height = Eye.of(handle.camera), handle.camera.image_height
            state = (eye, height, tuple(self._places.items()))
            if state == before:
                continue
            self._shown[client] = state, nodes
            texts = list(self._places)
            places = np.array(list(self._places.values())).reshape(-1, 3)
            free = without_overlap(texts, places, eye, height)
            visible = {text: places[at] for at, text in enumerate(texts) if free[at]}
            for text in visible.keys() - nodes.keys():
                name = f"/labels/{len(nodes)}"
                nodes[text] = handle.scene.add_label(name, text, anchor="bottom-left")
            for text, node in nodes.items():
                node.visible = text in visible
                node.position = visible.get(text, node.position)


def without_overlap(
    texts: list[str], places: NDArray[np.float64], eye: Eye, height: int
) -> NDArray[np.bool_]:
    """Whether to show labels (n,), so that none covers an earlier one.

    Each has its lower left corner at a place, (n, 3) local; the picture is `height` pixels high.
    """
    at, inside = eye.seen(places)
    corner = at * [height * eye.aspect / 2, height / 2]
    size = np.array([[_ROUND + _LETTER * len(text), _HEIGHT] for text in texts]).reshape(-1, 2)
    shown = np.zeros(len(texts), np.bool_)
    for number in np.flatnonzero(inside):
        right, down = (corner[number] - corner[shown]).T
        wide, tall = size[number], size[shown]
        covers = (right < tall[:, 0]) & (-right < wide[0]) & (np.abs(down) < _HEIGHT)
        shown[number] = not covers.any()
    return shown

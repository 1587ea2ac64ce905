"""Labels on a page; each browser hides overlapping ones."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .looking import Eye
from .page import LivePage

MOST_LABELS = 100
_LETTER, _ROUND, _HEIGHT = 7.5, 12.0, 22.0  # pixels: of a letter, around all, of a line


@dataclass(eq=False)
class _Shown:
    """What one browser shows."""

    state: Hashable = None
    nodes: dict[str, Any] = field(default_factory=dict)  # {text: node}


class Labels:
    """Labels on a page; of two that overlap, the first one is shown."""

    def __init__(self, page: LivePage) -> None:
        self._page = page
        self._places: dict[str, tuple[float, float, float]] = {}  # {text: where it is}
        self._shown: dict[int, _Shown] = {}  # {client: what it shows}

    def put(self, text: str, place: NDArray[np.floating]) -> None:
        """Place a label, (3,) local, or move the one with the same text."""
        if text in self._places or len(self._places) < MOST_LABELS:
            x, y, z = place.tolist()
            self._places[text] = x, y, z

    def draw(self) -> None:
        """Update the visible labels of each browser, if anything has moved."""
        clients = self._page.get_clients()
        self._shown = {client: shown for client, shown in self._shown.items() if client in clients}
        texts = list(self._places)
        places = np.array(list(self._places.values())).reshape(-1, 3)
        for client, handle in clients.items():
            shown = self._shown.setdefault(client, _Shown())
            eye = Eye.of(handle.camera)
            state = (eye, handle.camera.image_height, tuple(self._places.items()))
            if shown.state == state:
                continue
            shown.state = state
            free = without_overlap(texts, places, eye, handle.camera.image_height)
            for text, place, visible in zip(texts, places, free, strict=True):
                node = shown.nodes.get(text)
                if visible and node is None:
                    name = f"/labels/{len(shown.nodes)}"
                    node = handle.scene.add_label(name, text, anchor="bottom-left")
                    shown.nodes[text] = node
                if node is not None:
                    node.visible, node.position = bool(visible), place


def without_overlap(
    texts: list[str], places: NDArray[np.float64], eye: Eye, height: int
) -> NDArray[np.bool_]:
    """Whether to show labels (n,), so that none covers an earlier one.

    Parameters
    ----------
    places
        (n, 3): where each has its lower left corner, metres, local.
    height
        Of the picture, pixels.
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

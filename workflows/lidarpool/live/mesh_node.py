"""A mesh on a page that is exchanged for another without ever being gone."""

from __future__ import annotations

import time
from collections.abc import Hashable
from typing import Any

from .page import LivePage

# A browser needs a moment to load a mesh, longer over a slow connection. What has the same
# shape may stay that long: of two surfaces in one place a browser shows the one it loaded last.
SAME_SHAPE_S, NEW_SHAPE_S = 3.0, 0.7


class MeshNode:
    """Shows the latest of several meshes, each as binary glTF.

    viser's page drops a mesh when it is told of a new one, and has nothing to show until that
    one is loaded; it does not say when that is. So two nodes take turns: the new mesh goes over
    the last but one, the last stays where it is, and is removed when no other has come for a
    while. A browser that is behind never has fewer than one of the two.

    Parameters
    ----------
    page
        Where they are shown.
    name
        Name of the node that holds both, such as "/scene".
    """

    def __init__(self, page: LivePage, name: str) -> None:
        self._page = page
        self._names = [f"{name}/one", f"{name}/other"]  # the latest is the first
        self._nodes: dict[str, Any] = {}
        self._shape: Hashable = None
        self._alone_at = 0.0  # when the last but one may go
        self._visible = True

    @property
    def visible(self) -> bool:
        """Whether they are shown."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        for node in self._nodes.values():
            node.visible = visible

    def show(self, data: bytes, shape: Hashable) -> None:
        """Show a mesh; `shape` is what differs where its triangles lie elsewhere."""
        stays = SAME_SHAPE_S if shape == self._shape else NEW_SHAPE_S
        self._shape = shape
        self._names.reverse()
        latest = self._names[0]
        self._nodes[latest] = self._page.scene.add_glb(
            latest, data, cast_shadow=False, receive_shadow=False, visible=self._visible
        )
        self._alone_at = time.monotonic() + stays

    def clear(self) -> None:
        """Show nothing."""
        for name in tuple(self._nodes):
            self._nodes.pop(name).remove()
        self._shape = None

    def settle(self) -> bool:
        """Remove the last but one if it is time; returns whether it is still there."""
        if len(self._nodes) < 2:
            return False
        if time.monotonic() < self._alone_at:
            return True
        self._nodes.pop(self._names[1]).remove()
        return False

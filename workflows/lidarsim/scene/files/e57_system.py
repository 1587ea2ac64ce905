"""The coordinate system that an E57 states, by its coordinateMetadata (ASTM E2807, 8.4.2)."""

from __future__ import annotations

from typing import Any

from .stated_system import StatedSystem


def e57_system(file: Any) -> StatedSystem | None:
    """Return the coordinate system of an open `pye57.E57`, or None if the file states none."""
    root = file.root
    if not root.isDefined("coordinateMetadata"):
        return None
    text = str(root["coordinateMetadata"].value()).strip()
    return StatedSystem(text) if text else None

"""Folders whose files are damaged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Reader = Callable[[Path], str]  # reads what is in a folder; returns a digest of what it read


@dataclass
class Target:
    """A folder, who reads it, and which of its files are damaged."""

    whole: Path
    readers: dict[str, Reader]
    chosen: Callable[[Path], bool] = lambda file: True

"""Folders with files to damage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Reader = Callable[[Path], str]  # reads what is in a folder; returns a digest of what it read


@dataclass
class Target:
    """Folder with its readers and a function that selects the files to damage."""

    whole: Path
    readers: dict[str, Reader]
    chosen: Callable[[Path], bool] = lambda file: True

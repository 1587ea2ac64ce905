"""Distributions with plug-ins, as an installer would leave them in a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path

BEFORE_ANY_PROCESS_S = time.time() - 86_400.0


def write_distribution(
    folder: Path,
    name: str,
    entry_points: Mapping[str, Mapping[str, str]],
    modules: Mapping[str, str],
    version: str = "0.1",
) -> Path:
    """Write a distribution of some modules, {path: text}; return the folder, for ``sys.path``."""
    about = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = []
    for group, entries in entry_points.items():
        lines += [f"[{group}]", *(f"{entry} = {value}" for entry, value in entries.items())]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
    for path, text in modules.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        # A process that started before its sources changed does not know which of them it runs.
        os.utime(file, (BEFORE_ANY_PROCESS_S, BEFORE_ANY_PROCESS_S))
    return folder

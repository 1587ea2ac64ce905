"""Scenes for which `lidarpool stations` and `lidarpool flight` plan surveys."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..scenario.prepare import PreparedScenario
    from ..scenario.scenario import Scenario
    from .terminal import Terminal


def prepared_with_notes(
    scenario: Scenario, terminal: Terminal
) -> tuple[PreparedScenario, list[str]]:
    """Prepare a scenario, and print its notes and warnings.

    Notes about default poses are omitted. Returns the prepared scenario with the notes and
    warnings.
    """
    from ..scenario.advice import advice
    from ..scenario.default_poses import SensorPlacement
    from ..scenario.prepare import prepare

    with terminal.status("reading the scene", logged=False):
        prepared = prepare(scenario, plans=False)
    notes = advice(replace(prepared, placement=SensorPlacement(())))
    for note in notes:
        terminal.report(note)
    if problem := prepared.job.location_warning:
        terminal.warn(problem)
    return prepared, [*notes, *terminal.warnings]


def relative_file(file: Path, folder: Path) -> str:
    """Return the path of a file relative to the folder of a scenario."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()


def scene_sections(scenario: Scenario, folder: Path) -> dict[str, Any]:
    """Return the sections `scene` and `world` of a scenario, for a new scenario in a folder."""
    entry = scenario.scene.model_dump(exclude_unset=True, mode="json", by_alias=True)
    copies = entry.get("copies", [])
    named = [*entry.get("files", []), *(c.get(kind) for c in copies for kind in ("file", "table"))]
    for file_entry in filter(None, named):
        file_entry["file"] = relative_file(scenario.path(file_entry["file"]), folder)
    world = scenario.world.model_dump(exclude_unset=True, mode="json")
    return {**({"scene": entry} if entry else {}), **({"world": world} if world else {})}


def sensor_entry(model: str, folder: Path) -> str:
    """Return a sensor model, or the path of its file relative to the folder of a scenario."""
    is_file = model.endswith((".yaml", ".yml"))
    return relative_file(Path(model), folder) if is_file else model


def comment_lines(texts: Sequence[str]) -> str:
    """Format texts as wrapped comments of a YAML file."""
    lines = (textwrap.wrap(text, 96, break_on_hyphens=False) for text in texts)
    return "".join(f"# {line}\n" for wrapped in lines for line in wrapped)

"""Scenes for which `lidarpool stations` and `lidarpool flight` plan surveys."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.schema.vocabulary import ALWAYS_COLUMNS
from lidarsim.words import join_names

if TYPE_CHECKING:
    from lidarscenario.prepare import PreparedScenario
    from lidarscenario.scenario import Scenario
    from lidarsim.media.materials import Material

    from .terminal import Terminal

# Sections of a scenario that a plan replaces.
_REPLACED = {
    *("sensor", "sensors", "faults", "mount"),
    *("poses", "trajectory", "steps", "flight"),
}


def prepared_with_notes(
    scenario: Scenario, terminal: Terminal
) -> tuple[PreparedScenario, list[str]]:
    """Prepare a scenario, and print its notes and warnings.

    Notes about default poses are omitted. Returns the prepared scenario with the notes and
    warnings.
    """
    from lidarscenario.advice import advice
    from lidarscenario.default_poses import SensorPlacement
    from lidarscenario.prepare import prepare

    with terminal.status("reading the scene", logged=False):
        prepared = prepare(scenario, plans=False)
    notes = advice(replace(prepared, placement=SensorPlacement(())))
    for note in notes:
        terminal.report(note)
    if problem := prepared.job.location_warning:
        terminal.warn(problem)
    return prepared, [*notes, *terminal.warnings]


def carried_sections(
    scenario: Scenario, folder: Path, columns: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the sections of a scenario that a plan does not replace, for a scenario in a folder.

    `columns` are added to those of the scenario. Returns the sections with notes about actors and
    faults that are omitted.
    """
    content = scenario.content(folder)
    sections = {name: value for name, value in content.items() if name not in _REPLACED}
    notes = []
    platforms = [entry.name for entry in scenario.actors if entry.is_platform]
    if platforms:
        actors = [entry for entry in sections["actors"] if entry["name"] not in platforms]
        sections["actors"] = actors
        notes.append(
            f"The actor {join_names(platforms)} is omitted, because the plan replaces the platform"
        )
    if scenario.faults:
        notes.append(
            "`faults` is omitted, because the plan replaces the sensors and the times of the faults"
        )
    cloud = sections.get("cloud", {})
    sections["cloud"] = cloud | {"columns": [*dict.fromkeys([*cloud.get("columns", ()), *columns])]}
    return {name: value for name, value in sections.items() if value}, notes


def planned_columns(formats: Sequence[str], materials: Iterable[Material] = ()) -> list[str]:
    """Return the columns of a planned survey, so that its result can be exported to formats.

    They are the range and the columns of all fields of the formats. The class is only included if a
    material has a class.
    """
    from lidarfiles.clouds.writing import ExportSpec

    has_classes = any(material.semantic_class for material in materials)
    names = dict.fromkeys(name for each in formats for name in ExportSpec(each).added)
    unknown = set(ALWAYS_COLUMNS) | (set() if has_classes else {"class"})
    return ["range", *(name for name in names if name not in unknown)]


def sensor_entry(model: str, folder: Path) -> str:
    """Return a sensor model, or the path of its file relative to the folder of a scenario."""
    from lidarscenario.scenario import relative_file

    is_file = model.endswith((".yaml", ".yml"))
    return relative_file(Path(model), folder) if is_file else model


def comment_lines(texts: Sequence[str]) -> str:
    """Format texts as wrapped comments of a YAML file."""
    lines = (textwrap.wrap(text, 96, break_on_hyphens=False) for text in texts)
    return "".join(f"# {line}\n" for wrapped in lines for line in wrapped)

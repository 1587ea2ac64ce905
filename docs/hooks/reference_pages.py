"""Generate the pages of the reference from the packages."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Set
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any, get_type_hints

import click
import numpy as np
from pydantic import TypeAdapter
from pydantic.warnings import UnsupportedFieldAttributeWarning

from lidarpool.cli.commands import cli
from lidarscenario.schema import campaign_schema, scenario_schema, vehicle_schema
from lidarsim.columns.ply_format import file_type
from lidarsim.columns.table import ALWAYS, AXES, OPTIONAL, SCAN, Column

# Sections in the order of a scenario file, and what stands in the sections of another.
_SECTIONS = {
    "scene": "SceneSection",
    "scene: files": "MeshFile",
    "scene: copies": "CopiesSection",
    "scene: copies: at": "CopySection",
    "scene: copies: table": "CopyTable",
    "scene: copies: scatter": "Scatter",
    "scene: ground": "Ground",
    "world": "WorldSection",
    "sensor": "SensorSection",
    "sensor: packets": "PacketSection",
    "poses": "Pose",
    "trajectory": "TrajectorySection",
    "trajectory: points": "TimedPose",
    "sensors": "MountedSensorSection",
    "mount": "MountSection",
    "actors": "ActorSection",
    "actors: animation": "AnimationSection",
    "actors: joints": "JointTable",
    "traffic": "TrafficSection",
    "traffic: vehicles": "VehicleSection",
    "materials": "Material",
    "returns": "ReturnsSection",
    "noise": "NoiseSection",
    "weather": "Weather",
    "navigation": "Navigation",
    "navigation: imu": "Imu",
    "navigation: gnss": "Gnss",
    "navigation: mount": "InstrumentPose",
    "navigation: mount_error": "InstrumentPose",
    "flight": "FlightSection",
    "faults": "Fault",
    "cloud": "CloudOptions",
    "output": "OutputSection",
    "output: write": "ExportSpec",
    "planning": "PlanningSection",
    "planning: obstacles": "Obstacle",
    "pool": "PoolSection",
}

_OF_CAMPAIGNS = {
    "vary": "ValueRule",
    "vary: normal": "NormalDistribution",
    "vary: sample": "RowSample",
    "keep": "DatasetFormat",
}

# Sections of vehicle files. Those of scenarios have their tables on the page of scenario files.
_OF_VEHICLES = {
    "body": "BodyPart",
    "sensors": "CandidateSensor",
    "sensors: ranges": "MountRanges",
    "targets": "TargetSection",
    "region": "RegionSection",
    "traffic": "TrafficTargets",
    "map": "MapSection",
    "rank": "RankSection",
    "search": "MountSearch",
}

# What a reader of a package looks for first; the rest follows by the alphabet.
_FIRST = {
    "lidarpool": (
        "Scanner",
        *("simulate", "remove_run", "Scene", "Sensor", "Beams", "Spin", "Pose", "Survey"),
        *("Planning", "Result", "ScanFrame", "Cloud", "Column", "read_cloud", "save_cloud"),
        *("to_open3d", "to_dask"),
    ),
    "poolpart": (
        *("Pool", "Partition", "Rule", "per_gpu", "per_host", "n_workers", "named", "rest"),
        *("Results", "PartitionStats", "StageStats", "Pipe", "PipeListener"),
        *("after_all", "cancelled"),
    ),
    "poolpart.deploy": ("local_cluster", "start_partitions"),
    "raybeam": ("RayCaster", "Pattern", "Hits", "ScanReturns"),
}


def members_page(package: str) -> str:
    """Generate a page with the public names of a package and their docstrings."""
    module = import_module(package)
    names = {name for name in module.__all__ if not name.startswith("__")}
    first = _FIRST[package]
    if not names.issuperset(first):
        raise ValueError(f"{package} has none of these names: {set(first) - names}")
    parts = [f"# `{package}`\n\n{module.__doc__}\n"]
    for name in (*first, *sorted(names - {*first})):
        parts += [f"::: {package}.{name}\n", *_declared(getattr(module, name))]
    return "\n".join(parts)


def _declared(member: Any) -> Iterator[str]:
    """Yield a table of a dataclass's fields with descriptions, or nothing if there are none."""
    hints = get_type_hints(member, include_extras=True) if is_dataclass(member) else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedFieldAttributeWarning)  # an alias in scenarios
        fields = {
            name: {"default": getattr(member, name, None), **TypeAdapter(hint).json_schema()}
            for name, hint in hints.items()
            if any(getattr(note, "description", "") for note in getattr(hint, "__metadata__", ()))
        }
    if fields:
        yield _table(fields).replace("](#", "](scenario.md#")  # where sections have their tables


def command_page() -> str:
    """Generate a page with the `--help` output of the command and its subcommands."""
    parts = ["# The command\n\nWhat `--help` prints.\n"]
    for path, command in _commands(cli, "lidarpool"):
        context = click.Context(command, info_name=path, max_content_width=88)
        parts.append(f"## `{path}`\n\n```text\n{command.get_help(context)}\n```\n")
    return "\n".join(parts)


def _commands(command: click.Command, path: str) -> Iterator[tuple[str, click.Command]]:
    yield path, command
    if isinstance(command, click.Group):
        for name in sorted(command.commands):
            yield from _commands(command.commands[name], f"{path} {name}")


def scenario_page() -> str:
    """Generate tables of the fields of a scenario file from its JSON schema."""
    schema = scenario_schema()
    head = (
        "# Scenario files\n\n"
        f"{schema['description']} All of it but the scene may be left out. "
        "Fields that are not in these tables are rejected. `lidarpool init --all` writes a file "
        "with all of them, and `lidarpool schema` prints this as JSON Schema.\n"
    )
    return _schema_page(head, schema, _SECTIONS)


def campaign_page() -> str:
    """Generate tables of the fields of a campaign file from its JSON schema."""
    schema = campaign_schema()
    head = (
        f"# Campaign files\n\n{schema['description']}\n\nHow to write one: "
        "[Campaigns](../how-to/campaign.md). `lidarpool schema --campaign` prints this as JSON "
        "Schema.\n"
    )
    return _schema_page(head, schema, _OF_CAMPAIGNS)


def vehicle_page() -> str:
    """Generate tables of the fields of a vehicle file from its JSON schema."""
    schema = vehicle_schema()
    summary, _, _ = schema["description"].partition("\n\n")
    head = (
        f"# Vehicle files\n\n{summary} `lidarpool mount` reads this file; see "
        "[Mounting positions](../how-to/mount.md). Fields that are not in these tables are "
        "rejected. `lidarpool schema --vehicle` prints this as JSON Schema.\n"
    )
    shared = set(schema["$defs"]) & set(_SECTIONS.values())
    page = _schema_page(head, schema, _OF_VEHICLES, shared)
    for heading, name in _SECTIONS.items():
        anchor = heading.replace(": ", "-")
        if name in shared:
            page = page.replace(f"](#{anchor})", f"](scenario.md#{anchor})")
    return page


def _schema_page(
    head: str, schema: dict[str, Any], sections: dict[str, str], elsewhere: Set[str] = frozenset()
) -> str:
    """Generate a page with a table for each section, except for sections on other pages."""
    parts = [head, "## The file\n", _table(schema["properties"], schema.get("required", []))]
    for heading, name in sections.items():
        section = schema["$defs"][name]
        # Of a section with short forms, the one with fields.
        fields = next(c for c in section.get("anyOf", [section]) if "properties" in c)
        required = fields.get("required", [])
        words = f"{section['description']}\n".replace("`Sensor`", "[Sensor][lidarpool.Sensor]")
        parts += [f"## `{heading}`\n", words, _table(fields["properties"], required)]
    missing = set(schema["$defs"]) - set(sections.values()) - elsewhere
    if missing:
        raise ValueError(f"sections that the page of their file does not show: {missing}")
    return "\n".join(parts)


def columns_page() -> str:
    """Generate tables of all columns of a cloud from the column definitions in the package."""
    return "\n".join(
        [
            "# Columns of a cloud\n",
            "What a point can have. How to ask for a column and how to add one of your own: "
            "[Columns](../how-to/columns.md). Open3D writes five types to PLY, so "
            "that some columns have another one there.\n",
            "## In every cloud\n",
            "Positions are `cloud.positions`, (n, 3). In a part they are whole multiples of "
            "`precision_m` from the scene's local origin, as int32.\n",
            _columns_table((*AXES, SCAN, *(column for column in ALWAYS if column not in AXES))),
            "## On request\n",
            "`columns: [time, range]` in the section `cloud` of a scenario, or "
            '`Survey(columns=["time", "range"])`.\n',
            _columns_table(OPTIONAL),
        ]
    )


def _columns_table(columns: tuple[Column, ...]) -> str:
    heads = ("column", "in files", "type", "in PLY", "unit", "coordinates", "")
    rows = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for column in columns:
        kind = np.dtype(column.dtype).name
        held = file_type(column).name
        if column in AXES:
            kind = "float64"
            held = "float32; float64 where needed"
        cells = (column.in_files, kind, held, column.unit, column.coordinates, column.meaning)
        rows.append(f"| `{column.name}` | " + " | ".join(cell or "–" for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def _table(fields: dict[str, Any], required: tuple[str, ...] | list[str] = ()) -> str:
    rows = ["| field | takes | default | |", "|---|---|---|---|"]
    for name, content in fields.items():
        default = "must be given" if name in required else _default(content)
        words = content.get("description", "see below")
        cells = (f"`{name}`", _kinds(content), default, words)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def _default(content: dict[str, Any]) -> str:
    value = content.get("default")
    return "" if value is None or value == "" else f"`{value}`"


def _kinds(content: dict[str, Any]) -> str:
    """Describe the values that a field accepts."""
    if "anyOf" in content:
        choices = [_kinds(choice) for choice in content["anyOf"] if choice.get("type") != "null"]
        # A list of things, or one of them without the list.
        choices = [c for c in choices if f"list: {c}" not in choices]
        return " or ".join(dict.fromkeys(choices))
    if "enum" in content:
        return ", ".join(f"`{value}`" for value in content["enum"])
    if "const" in content:
        return f"`{content['const']}`"
    if "$ref" in content:
        return _section(content["$ref"].rpartition("/")[2])
    if "type" not in content:
        return "anything"
    kind = content["type"]
    if kind == "array":
        return _list(content)
    if kind == "object":
        inner = content.get("additionalProperties")
        return f"mapping: {_kinds(inner)}" if isinstance(inner, dict) else "mapping"
    words = {"integer": "whole number", "string": "text", "boolean": "true or false"}
    return words.get(kind, kind) + _limits(content)


def _section(name: str) -> str:
    """Return a link to the table of a section on this page, given its name in the schema."""
    tables = (_SECTIONS, _OF_CAMPAIGNS, _OF_VEHICLES)
    pairs = (pair for table in tables for pair in table.items())
    heading = next(heading for heading, section in pairs if section == name)
    return f"[{heading}](#{heading.replace(': ', '-')})"


def _list(content: dict[str, Any]) -> str:
    prefix = content.get("prefixItems")
    if prefix:
        return f"list of {len(prefix)}: {_kinds(prefix[0])}"
    return f"list: {_kinds(content['items'])}" if content["items"] else "list"


def _limits(content: dict[str, Any]) -> str:
    if "minimum" in content and "maximum" in content:
        return f", {_number(content['minimum'])} to {_number(content['maximum'])}"
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {_number(content[key])}" for key, sign in signs.items() if key in content]
    return " " + ", ".join(limits) if limits else ""


def _number(value: float) -> str:
    return f"{value:,.6f}".rstrip("0").rstrip(".")

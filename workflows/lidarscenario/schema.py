"""JSON Schemas of scenarios, campaigns and vehicle files, and files for `lidarpool init`."""

from __future__ import annotations

import inspect
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema, JsonRef

from lidarsim.schema.section_fields import fields_of, is_section, kinds_of

from .campaign.campaign_sections import CampaignSection
from .default_poses import as_yaml_line
from .mount_sections import VehicleFile
from .scenario import Scenario
from .sections import Section

SCHEMA_FILE = "scenario.schema.json"  # written next to the scenario


class _CompactGenerator(GenerateJsonSchema):
    """Schema generator that omits redundant titles and some defaults.

    Titles would repeat the names of fields. Defaults are omitted if they would repeat a whole
    section or are infinite.
    """

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def model_schema(self, schema: Any) -> dict[str, Any]:
        # pydantic 2.12 omits the docstrings of models that are also dataclasses.
        result: dict[str, Any] = {
            "description": inspect.getdoc(schema["cls"])
        } | super().model_schema(schema)
        for kind in kinds_of(schema["cls"]):
            reference = self.generate_inner(kind.__pydantic_core_schema__)["$ref"]
            further = self.get_schema_from_definitions(JsonRef(reference)) or {}
            for name, content in further["properties"].items():
                other = result["properties"].setdefault(name, content)
                if other != content:  # two formats have different options with the same name
                    choice = {"anyOf": [other, content], "description": content["description"]}
                    result["properties"][name] = choice
        return result

    def dataclass_schema(self, schema: Any) -> dict[str, Any]:
        summary, _, _ = (inspect.getdoc(schema["cls"]) or "").partition("\n\n")
        return super().dataclass_schema(schema) | {"description": summary}

    def default_schema(self, schema: Any) -> dict[str, Any]:
        result = super().default_schema(schema)
        if isinstance(result.get("default"), dict) or result.get("default") == float("inf"):
            del result["default"]
        return result


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files, which allows short forms and empty sections.

    The schema does not check combinations of fields, such as a range that stops before its start.
    `Scenario.load` checks them.
    """
    schema = _section_schema(Scenario, "lidarpool scenario")
    return schema | {"description": "A lidar survey of a scene, with optional path planning."}


def campaign_schema() -> dict[str, Any]:
    """Return the JSON Schema of campaign files.

    The schema does not check that paths refer to fields, or that values are valid for these fields.
    `Campaign.load` checks both.
    """
    return _section_schema(CampaignSection, "lidarpool campaign")


def vehicle_schema() -> dict[str, Any]:
    """Return the JSON Schema of vehicle files, which `lidarpool mount` reads.

    The schema does not check combinations of fields. `VehicleFile.load` checks them.
    """
    return _section_schema(VehicleFile, "lidarpool vehicle")


def _section_schema(section: type[Section], title: str) -> dict[str, Any]:
    schema = section.model_json_schema(schema_generator=_CompactGenerator)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": title}


def schema_text(schema: dict[str, Any]) -> str:
    """Format a schema as JSON with a final newline."""
    return json.dumps(schema, indent=2, allow_nan=False) + "\n"


SCENARIO_FILE = "scenario.yaml"

_WIDTH = 100
_COMMENT_COLUMN = 30  # column where comments beside fields start

_HEAD = f"# yaml-language-server: $schema={SCHEMA_FILE}"
_FULL_HEAD = f"""\
{_HEAD}
# A lidar survey for lidarpool, with path planning. All fields have their default values and may be
# omitted. Fields that are commented out are examples, because lidarpool determines their default
# values. Lengths are in meters and angles in degrees, and z is up.
#
#     lidarpool check {SCENARIO_FILE}
#     lidarpool run {SCENARIO_FILE}"""
_SHORT_HEAD = f"""\
{_HEAD}
# A lidar survey for lidarpool. Lengths are in meters, and z is up. Omitted fields have their
# default values. To write all fields with their default values, run `lidarpool init DIR --all`."""
# {section of a short scenario: (example, comment)}
_SECTIONS = {
    "scene": ("seed", "mesh files relative to this folder, or seed for the demo"),
    "sensor": ("ouster/os1-64", "model from `lidarpool sensors`, or a .yaml file"),
    "poses": ("[[0, 0, 1], {position: [0, 0, 2], yaw_deg: 90}]", "poses of the sensor"),
    "cloud": ("{columns: [range, intensity]}", "precision and additional columns of the points"),
    "output": ("{write: [las]}", "additional formats of the cloud"),
}


def short_scenario(data: Mapping[str, Any], note: str) -> str:
    """Return a short scenario in YAML with comments.

    Parameters
    ----------
    data
        Content of the scenario, from `mesh_data`. Other sections are written as commented-out
        examples.
    note
        Note about the poses.
    """
    lines = [_SHORT_HEAD, ""]
    data = {"scene": "seed"} | dict(data)
    for name, (example, words) in _SECTIONS.items():
        has_data = name in data
        code = f"{name}: {as_yaml_line(data[name])}" if has_data else f"# {name}: {example}"
        placed = name == "poses" and has_data
        lines += _pose_lines(data[name], note) if placed else _commented(code, words, "")
    return "\n".join([*lines, ""])


def scenario_template(data: Mapping[str, Any], note: str) -> str:
    """Return a scenario in YAML with all fields and comments.

    Parameters
    ----------
    data
        Sections of the scenario as {name: {field: value}}, for example from `mesh_data`, which
        replace the default values. The section `sensor` can be the name of a model, and `poses` is
        a list.
    note
        Note about the poses.
    """
    lines = [_FULL_HEAD]
    values = {"scene": {"preset": "seed"}} | dict(data)
    if isinstance(values.get("sensor"), str):
        values["sensor"] = {"model": values["sensor"]}
    for name, field in Scenario.model_fields.items():
        lines.append("")
        placed = name == "poses" and name in values
        lines += (
            _pose_lines(values[name], note)
            if placed
            else _section_lines(name, field, values.get(name, {}))
        )
    return "\n".join([*lines, ""])


def _section_lines(name: str, field: FieldInfo, values: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a section or top-level field. `values` replaces default values."""
    section = field.annotation
    if not (isinstance(section, type) and is_section(section)):
        yield from _field_lines(name, field, "", values)
        return
    summary = (section.__doc__ or "").partition("\n")[0].partition(";")[0].rstrip(".")
    yield from _commented(f"{name}:", summary, "")
    for inner, content in fields_of(section).items():
        yield from _field_lines(inner, content, "  ", values)


def _pose_lines(poses: Sequence[Any], note: str) -> Iterator[str]:
    """Yield the note as a comment, followed by one line for each pose."""
    if note:
        note = f"{note[:1].upper()}{note[1:]}."
        # Poses in the note are kept on a single line, so that they can be copied.
        text, mark, poses_text = note.partition("poses: ")
        yield from textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        if mark:
            yield f"# poses: {poses_text.removesuffix('.')}"
    yield from _commented("poses:", _SECTIONS["poses"][1], "")
    yield from (f"  - {as_yaml_line(pose)}" for pose in poses)


def _field_lines(name: str, field: FieldInfo, indent: str, values: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a field with its value or default.

    If the field has examples instead of a fixed default, they are commented out.
    """
    text = field.description or ""
    if name in values or not field.examples:
        value = as_yaml_line(values.get(name, field.default))
        yield from _commented(f"{name}: {value}", text, indent)
        return
    first, *further_examples = field.examples
    yield from _commented(f"# {name}: {as_yaml_line(first)}", text, indent)
    for example in further_examples:
        yield f"{indent}# {name}: {as_yaml_line(example)}"


def _commented(code: str, comment: str, indent: str) -> Iterator[str]:
    """Yield code with a comment, placed on the right if it fits and otherwise above the code."""
    line = f"{indent}{code}".ljust(_COMMENT_COLUMN - 1) + f" # {comment}"
    if len(line) <= _WIDTH and len(indent + code) < _COMMENT_COLUMN:
        yield line
        return
    mark = f"{indent}# "
    sentence = f"{comment[:1].upper()}{comment[1:]}."  # prose, not a disabled field
    yield from textwrap.wrap(sentence, _WIDTH, initial_indent=mark, subsequent_indent=mark)
    yield f"{indent}{code}"

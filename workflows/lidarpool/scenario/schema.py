"""What users and editors start from: JSON Schemas, and the scenario of `lidarpool init`."""

from __future__ import annotations

import inspect
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema

from lidarsim.base.validation import fields_of, is_section

from .campaign_sections import CampaignSection
from .placing import on_one_line
from .scenario import Scenario
from .sections import Section

SCHEMA_FILE = "scenario.schema.json"  # in the folder of a scenario


class _Plain(GenerateJsonSchema):
    """Omits titles, which repeat names, and defaults that repeat a section or are infinite."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def model_schema(self, schema: Any) -> dict[str, Any]:
        # pydantic 2.12 leaves out the docstrings of models that are dataclasses as well.
        return {"description": inspect.getdoc(schema["cls"])} | super().model_schema(schema)

    def dataclass_schema(self, schema: Any) -> dict[str, Any]:
        summary, _, _ = (inspect.getdoc(schema["cls"]) or "").partition("\n\n")
        return super().dataclass_schema(schema) | {"description": summary}

    def default_schema(self, schema: Any) -> dict[str, Any]:
        made = super().default_schema(schema)
        if isinstance(made.get("default"), dict) or made.get("default") == float("inf"):
            del made["default"]
        return made


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files, short forms and empty sections included.

    It does not check combinations of fields (a range that ends before it begins):
    `Scenario.load` does.
    """
    made = _schema_of(Scenario, "lidarpool scenario")
    return made | {"description": "A lidar survey of a scene, and path planning."}


def campaign_schema() -> dict[str, Any]:
    """Return the JSON Schema of campaign files.

    `Campaign.load` also checks that paths lead to fields, and that these take the values.
    """
    return _schema_of(CampaignSection, "lidarpool campaign")


def _schema_of(section: type[Section], title: str) -> dict[str, Any]:
    made = section.model_json_schema(schema_generator=_Plain)
    return {"$schema": GenerateJsonSchema.schema_dialect, **made, "title": title}


def schema_text(schema: dict[str, Any]) -> str:
    """Return a schema as JSON, with a line break at its end."""
    return json.dumps(schema, indent=2, allow_nan=False) + "\n"


SCENARIO_FILE = "scenario.yaml"

_WIDTH = 100
_COMMENT_AT = 30  # column of the comments that stand beside a field

_HEAD = f"# yaml-language-server: $schema={SCHEMA_FILE}"
_EVERY = f"""\
{_HEAD}
# A lidar survey for lidarpool, with path planning. Every field has its default here, and may be
# left out. A name after "# " is an example for a field whose default lidarpool chooses. Lengths
# are in metres, angles in degrees, Z is up.
#
#     lidarpool check {SCENARIO_FILE}
#     lidarpool run {SCENARIO_FILE}"""
_FEW = f"""\
{_HEAD}
# A lidar survey for lidarpool; lengths are in metres, Z is up. Fields that are left out have their
# defaults; lidarpool init DIR --all writes all of them."""
# {section of a short scenario: (an example, what it is)}
_SECTIONS = {
    "scene": ("seed", "mesh files, named from this folder; seed is six objects"),
    "sensor": ("ouster/os1-64", "a model of `lidarpool sensors`, or your own .yaml"),
    "poses": ("[[0, 0, 1], {position: [0, 0, 2], yaw_deg: 90}]", "where the sensor stands"),
    "cloud": ("{columns: [range, intensity]}", "precision and further columns of the points"),
    "output": ("{write: [las]}", "further formats of the cloud"),
}


def short_scenario(data: Mapping[str, Any], note: str) -> str:
    """Return a commented scenario in YAML of a few sections, those not in `data` as examples.

    `data` is what `mesh_data` returns, `note` a remark on its poses.
    """
    lines = [_FEW, ""]
    data = {"scene": "seed"} | dict(data)
    for name, (example, words) in _SECTIONS.items():
        given = name in data
        code = f"{name}: {on_one_line(data[name])}" if given else f"# {name}: {example}"
        placed = name == "poses" and given
        lines += _poses(data[name], note) if placed else _beside(code, words, "")
    return "\n".join([*lines, ""])


def scenario_template(data: Mapping[str, Any], note: str) -> str:
    """Return a commented scenario in YAML that holds all defaults.

    `data` is what `mesh_data` returns, in place of some of them, `note` a remark on its poses.
    """
    lines = [_EVERY]
    given = dict(data)
    if isinstance(given.get("sensor"), str):
        given["sensor"] = {"model": given["sensor"]}
    for name, field in Scenario.model_fields.items():
        lines.append("")
        placed = name == "poses" and name in given
        lines += _poses(given[name], note) if placed else _top(name, field, given.get(name, {}))
    return "\n".join([*lines, ""])


def _top(name: str, field: FieldInfo, given: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a section or a top-level field, `given` in place of some defaults."""
    section = field.annotation
    if not (isinstance(section, type) and is_section(section)):
        yield from _lines(name, field, "", given)
        return
    summary = (section.__doc__ or "").partition("\n")[0].partition(";")[0].rstrip(".")
    yield from _beside(f"{name}:", summary, "")
    for inner, content in fields_of(section).items():
        yield from _lines(inner, content, "  ", given)


def _poses(poses: Sequence[Any], note: str) -> Iterator[str]:
    """Yield poses, a line each, below a remark on where the sensor is."""
    if note:
        note = f"{note[:1].upper()}{note[1:]}."
        # A pose stays on one line, to be copied.
        text, mark, others = note.partition("poses: ")
        yield from textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        if mark:
            yield f"# poses: {others.removesuffix('.')}"
    yield from _beside("poses:", _SECTIONS["poses"][1], "")
    yield from (f"  - {on_one_line(pose)}" for pose in poses)


def _lines(name: str, field: FieldInfo, indent: str, given: dict[str, Any]) -> Iterator[str]:
    """Yield a field with what is given or its default, or with examples if that is computed."""
    text = field.description or ""
    if name in given or not field.examples:
        value = on_one_line(given.get(name, field.default))
        yield from _beside(f"{name}: {value}", text, indent)
        return
    first, *others = field.examples
    yield from _beside(f"# {name}: {on_one_line(first)}", text, indent)
    for other in others:
        yield f"{indent}# {name}: {on_one_line(other)}"


def _beside(code: str, comment: str, indent: str) -> Iterator[str]:
    """Return code with its comment to the right, or above it where there is no room."""
    line = f"{indent}{code}".ljust(_COMMENT_AT - 1) + f" # {comment}"
    if len(line) <= _WIDTH and len(indent + code) < _COMMENT_AT:
        yield line
        return
    mark = f"{indent}# "
    sentence = f"{comment[:1].upper()}{comment[1:]}."  # prose, not a field to be uncommented
    yield from textwrap.wrap(sentence, _WIDTH, initial_indent=mark, subsequent_indent=mark)
    yield f"{indent}{code}"

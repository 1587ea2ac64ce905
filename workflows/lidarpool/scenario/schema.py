"""The JSON Schema of scenario files, for editors that complete and check them."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from .scenario import Scenario
from .sections import MeshFile, Obstacle, PlanningSection, PoseSection, SceneSection

SCHEMA_FILE = "scenario.schema.json"  # beside a scenario that names it
DIALECT = "https://json-schema.org/draft/2020-12/schema"

_TEXT = {"type": "string", "minLength": 1}
_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}

# What sections take in YAML besides their fields: validators turn it into fields, and pydantic's
# schema does not know of it. {section: its short forms}
_SHORT_SECTIONS: dict[type[BaseModel], list[dict[str, Any]]] = {
    MeshFile: [_TEXT],
    PoseSection: [_NUMBERS],
    Obstacle: [_TEXT],
    SceneSection: [_TEXT, {"type": "array", "items": {"$ref": "#/$defs/MeshFile"}}],
}
# The same of fields. {(section, field): its short forms}
_SHORT_FIELDS: dict[tuple[type[BaseModel], str], list[dict[str, Any]]] = {
    (MeshFile, "scale"): [{"type": "number"}],
    (SceneSection, "files"): [{"$ref": "#/$defs/MeshFile"}],
    (PlanningSection, "obstacles"): [{"const": "auto"}],
}


class _Plain(GenerateJsonSchema):
    """Leaves out titles, which repeat names, and defaults that repeat a section or are infinite."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def default_schema(self, schema: Any) -> dict[str, Any]:
        made = super().default_schema(schema)
        if isinstance(made.get("default"), dict) or made.get("default") == float("inf"):
            del made["default"]
        return made


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files, short forms and empty sections included.

    What takes several fields to see (a range that ends before it begins) it does not say:
    `Scenario.load` does.
    """
    schema = Scenario.model_json_schema(schema_generator=_Plain)
    sections = schema["$defs"]
    for (section, field), short in _SHORT_FIELDS.items():
        properties = sections[section.__name__]["properties"]
        properties[field] = _or(properties[field], short)
    for section, short in _SHORT_SECTIONS.items():
        sections[section.__name__] = _or(sections[section.__name__], short)
    for name, content in schema["properties"].items():
        if "$ref" in content:  # a section of which all fields are commented out
            schema["properties"][name] = _or(content, [{"type": "null"}])
    schema["title"] = "lidarpool scenario"
    schema["description"] = "A survey of a scene with a lidar, and a path planned beside it."
    return {"$schema": DIALECT, **schema}


def schema_text() -> str:
    """Return the schema as JSON, with a line break at its end."""
    return json.dumps(scenario_schema(), indent=2, allow_nan=False) + "\n"


def _or(content: dict[str, Any], short: list[dict[str, Any]]) -> dict[str, Any]:
    """Allow short forms beside what a schema allows; words for people stay outermost."""
    outer = {key: content[key] for key in ("description", "default", "examples") if key in content}
    inner = {key: value for key, value in content.items() if key not in outer}
    choices = inner["anyOf"] if set(inner) == {"anyOf"} else [inner]
    return outer | {"anyOf": [*choices, *short]}

"""The JSON Schema of scenario files, for editors that complete and check them."""

from __future__ import annotations

import json
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from .scenario import Scenario

SCHEMA_FILE = "scenario.schema.json"  # beside a scenario that names it


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
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        **Scenario.model_json_schema(schema_generator=_Plain),
        "title": "lidarpool scenario",
        "description": "A survey of a scene with a lidar, and a path planned beside it.",
    }


def schema_text() -> str:
    """Return the schema as JSON, with a line break at its end."""
    return json.dumps(scenario_schema(), indent=2, allow_nan=False) + "\n"

"""The JSON Schemas of scenario and campaign files, for editors that complete and check them."""

from __future__ import annotations

import inspect
import json
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from .choices import CampaignSection
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

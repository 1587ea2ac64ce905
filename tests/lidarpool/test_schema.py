"""The schema says what `Scenario` takes: what one accepts or refuses, the other does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from lidarpool import LidarpoolError
from lidarpool.scenario.scenario import Scenario
from lidarpool.scenario.schema import campaign_schema, scenario_schema, schema_text
from lidarpool.scenario.template import scenario_template

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.yaml"))

GOOD: list[dict[str, Any]] = [
    {},
    {"scene": "hall.glb"},
    {"scene": "seed"},
    {"scene": ["hall.glb", {"file": "part.stl", "scale": 0.001}]},
    {"scene": {"files": "hall.glb", "ground": {}}},
    {"scene": {"files": [{"file": "a.ply", "scale": [1, 2, 3], "up_axis": "y"}]}},
    {"scene": None, "sensor": None, "cloud": None, "planning": None, "pool": None},
    {"scene": {"files": [{"file": "a.ply", "matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0],
                                                       [0, 0, 0, 1]]}]}},
    {"scene": {"copies": [{"name": "A", "box": [1, 2, 3], "at": [[1, 2], [1, 2, 3]], "class": 4}]}},
    {"scene": {"copies": [{"name": "A", "file": {"file": "a.stl", "unit": "mm"},
                           "at": [{"position": [1, 2], "yaw_deg": 9, "scale": [1, 2, 3]}]}]}},
    {"scene": {"copies": [{"name": "A", "file": "a.glb", "table": "a.csv"},
                          {"name": "B", "file": "a.glb",
                           "table": {"file": "b.csv", "columns": {"x": "east"}}}]}},
    {"scene": {"files": "a.glb", "copies": [{"name": "A", "file": "a.glb", "scatter": {
        "count": 9, "surfaces": ["Ground", "Hill*"], "within": [0, 0, 9, 9], "scale": [0.5, 2]}}]}},
    {"poses": [[0, 0, 1], {"position": [0, 0, 2], "yaw_deg": 90}]},
    {"planning": {"obstacles": "auto"}},
    {"planning": {"obstacles": ["Shelf*", {"centre": [1, 2], "radius_m": 3}], "start": [1, 1]}},
    {"pool": {"gpu": 2, "backend": "numpy"}},
    {"sensor": {"max_range_m": float("inf")}},
]  # fmt: skip
BAD: list[dict[str, Any]] = [
    {"sensor_s": {}},
    {"sensor": {"layer": 4}},
    {"sensor": {"layers": 0}},
    {"sensor": {"layers": "40"}},
    {"scene": {"files": [{"file": "a.stl", "unit": "mile"}]}},
    {"scene": {"copies": [{"name": "A", "box": [1, 2, 3], "at": [[1]]}]}},
    {"scene": {"copies": [{"name": "A", "box": [1, 2, 3], "scatter": {"count": 0}}]}},
    {"scene": {"copies": [{"box": [1, 2, 3], "table": "a.csv"}]}},
    {"poses": []},
    {"poses": [[0, 0]]},
    {"planning": {"obstacles": [{"centre": [1, 2, 3], "radius_m": 1}]}},
    {"pool": {"backend": "embre"}},
    {"cloud": {"keep_every": 2.5}},
]


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = json.loads(
        schema_text(scenario_schema()), parse_constant=pytest.fail
    )  # NaN and Infinity: no JSON
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize("data", GOOD, ids=str)
def test_what_a_scenario_takes_is_valid(validator, data):
    Scenario.from_data(data)
    assert list(validator.iter_errors(data)) == []


@pytest.mark.parametrize("data", BAD, ids=str)
def test_what_a_scenario_refuses_is_not(validator, data):
    with pytest.raises(LidarpoolError):
        Scenario.from_data(data)
    assert not validator.is_valid(data)


def test_the_examples_and_the_template_are_valid(validator):
    texts = [path.read_text() for path in EXAMPLES] + [scenario_template()]
    assert len(texts) >= 3
    for text in texts:
        assert list(validator.iter_errors(yaml.safe_load(text))) == []

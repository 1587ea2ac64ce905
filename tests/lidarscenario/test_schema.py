"""The schemas say what `Scenario` and `Campaign` take: one accepts what the other does."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.schema import (
    campaign_schema,
    scenario_schema,
    scenario_template,
    schema_text,
    short_scenario,
)
from lidarsim import LidarError
from lidarsim.schema.section_fields import fields_of, is_section

FILES = sorted((Path(__file__).parents[2] / "examples").glob("*.yaml"))
CAMPAIGNS = [path for path in FILES if is_campaign(path)]
EXAMPLES = [path for path in FILES if path not in CAMPAIGNS]

TEXT = scenario_template({}, "")
SEED = Scenario.from_data({"scene": "seed"})
GOOD: list[dict[str, Any]] = [
    {},
    {"scene": ["hall.glb", {"file": "part.stl", "scale": 0.001}]},
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
    {"scene": [{"file": "a.tif", "step_m": 2, "window": [0, 0, 9, 9]},
               {"file": "a.xodr", "sag_m": 0.1}, {"file": "a.ifc", "storeys": ["Attic"]},
               {"file": "a.xml", "keyframe": "home", "groups": [0, 5], "exclude": ["robot"]},
               {"file": "a.sdf", "geometry": "collision"}]},
    {"poses": [[0, 0, 1], {"position": [0, 0, 2], "yaw_deg": 90}]},
    {"planning": {"obstacles": ["Shelf*", {"center": [1, 2], "radius_m": 3}], "start": [1, 1],
                  "target": [9, 9]}},
    {"pool": {"gpu": 2, "backend": "numpy"}},
    {"sensor": {"max_range_m": float("inf")}},
    {"sensor": "velodyne/vlp16", "mount": [0, 0, 1.9]},
    {"sensors": {"a": "ouster/os1-64", "b": {"model": "velodyne/vlp16", "mount": [0, 0, 1]}}},
    {"actors": [{"name": "A", "box": [1, 2, 3], "at": [4, 5, 0]},
                {"name": "B", "box": [1, 2, 3], "at": {"position": [4, 5, 0], "yaw_deg": 9}}]},
    {"poses": [[0, 0, 1]], "navigation": {"imu": {"mount": [0, 0, 1]}}},
]  # fmt: skip
BAD: list[dict[str, Any]] = [
    {"sensor_s": {}},
    {"sensor": {"layer": 4}},
    {"sensor": {"layers": "40"}},
    {"scene": {"files": [{"file": "a.stl", "unit": "mile"}]}},
    {"scene": [{"file": "a.tif", "step_m": 0}]},
    {"scene": [{"file": "a.tif", "epsg": 25832}]},
    {"scene": [{"file": "a.glb", "animation": "Walk"}]},
    {"scene": [{"file": "a.ifc", "storeys": []}]},
    {"scene": {"copies": [{"name": "A", "box": [1, 2, 3], "at": [[1]]}]}},
    {"scene": {"copies": [{"name": "A", "box": [1, 2, 3], "scatter": {"count": 0}}]}},
    {"scene": {"copies": [{"box": [1, 2, 3], "table": "a.csv"}]}},
    {"poses": []},
    {"planning": {"obstacles": [{"center": [1, 2, 3], "radius_m": 1}]}},
    {"pool": {"backend": "embre"}},
    {"cloud": {"keep_every": 2.5}},
    {"sensor": 64},
    {"mount": [0, 0]},
    {"actors": [{"name": "A", "box": [1, 2, 3], "at": [4, 5]}]},
]


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = json.loads(
        schema_text(scenario_schema()), parse_constant=pytest.fail
    )  # NaN and Infinity: valid JSON
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize("data", GOOD, ids=str)
def test_what_a_scenario_takes_is_valid(validator, data):
    Scenario.from_data(data)
    assert list(validator.iter_errors(data)) == []


@pytest.mark.parametrize("data", BAD, ids=str)
def test_what_a_scenario_refuses_is_not(validator, data):
    with pytest.raises(LidarError):
        Scenario.from_data(data)
    assert not validator.is_valid(data)


def test_the_examples_and_the_template_are_valid(validator):
    texts = [path.read_text() for path in EXAMPLES] + [TEXT, short_scenario({}, "")]
    assert len(texts) >= 3
    for text in texts:
        assert list(validator.iter_errors(yaml.safe_load(text))) == []


GOOD_CAMPAIGNS: list[dict[str, Any]] = [
    {},
    {"base": ["base.yaml", "base.yaml"], "title": "A", "license": "B"},
    {"vary": None, "keep": None, "splits": None},
    {"count": 3, "vary": {"steps": {"integer": [1, 3]}}},
    {"count": 3, "vary": {"weather.visibility_km": {"normal": {"mean": 9, "std": 1}}}},
    {"count": 3, "vary": {"steps": {"choice": {"few": 1, "many": 2}, "weights": [1, 2]}}},
    {"count": 3, "vary": {"scene.copies": {"sample": {"from": "crates.csv", "count": 1}}}},
    {"vary": {"cloud.columns": {"each": [[], ["time"], ["range", "intensity"]]}}},
    {"keep": {"format": "mcap", "layout": "ouster"}, "splits": {"a": 0.5, "b": 0.5}},
]
BAD_CAMPAIGNS: list[dict[str, Any]] = [
    {"counts": 4},
    {"count": 0},
    {"keep": {"format": "laz"}},
    {"splits": {"a": 2}},
    {"count": 3, "vary": {"steps": {"choice": []}}},
    {"count": 3, "vary": {"steps": {"integer": [1, 2, 3]}}},
    {"count": 3, "vary": {"steps": {"integer": [1, 2], "weight": [1]}}},
    {"count": 3, "vary": {"noise.range_m": {"normal": {"mean": 1, "std": 0}}}},
    {"count": 3, "vary": {"scene.copies": {"sample": {"file": "crates.csv", "count": 1}}}},
]


@pytest.fixture(scope="module")
def of_campaigns() -> Draft202012Validator:
    schema = json.loads(schema_text(campaign_schema()), parse_constant=pytest.fail)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.fixture
def load(tmp_path) -> Any:
    """Return a function that loads a campaign from its content."""
    (tmp_path / "base.yaml").write_text("poses: [[0, 0, 1]]\n")
    (tmp_path / "crates.csv").write_text('name,box,at\nA,"[1, 1, 1]","[[1, 2]]"\n')

    def load(data):
        (tmp_path / "campaign.yaml").write_text(yaml.safe_dump(data))
        return CampaignSpec.load(tmp_path / "campaign.yaml")

    return load


@pytest.mark.parametrize("data", GOOD_CAMPAIGNS, ids=str)
def test_what_a_campaign_takes_is_valid(of_campaigns, load, data):
    data = {"base": "base.yaml"} | data
    load(data)
    assert list(of_campaigns.iter_errors(data)) == []


@pytest.mark.parametrize("data", BAD_CAMPAIGNS, ids=str)
def test_what_a_campaign_refuses_is_not(of_campaigns, load, data):
    data = {"base": "base.yaml"} | data
    with pytest.raises(LidarError):
        load(data)
    assert not of_campaigns.is_valid(data)


def test_the_example_of_a_campaign_is_valid(of_campaigns):
    assert CAMPAIGNS
    for path in CAMPAIGNS:
        assert list(of_campaigns.iter_errors(yaml.safe_load(path.read_text()))) == []


# A field that is commented out: its name, a colon and a value in YAML.
OFF = re.compile(r"^( *)# ([a-z_]+: \S.*)$")


def test_it_is_valid_and_has_the_defaults(tmp_path):
    (tmp_path / "scenario.yaml").write_text(TEXT)
    assert Scenario.load(tmp_path / "scenario.yaml").model_dump() == SEED.model_dump()


def test_every_field_is_in_it_with_a_comment_of_its_own():
    kinds = [field.annotation for field in Scenario.model_fields.values()]
    sections = [kind for kind in kinds if isinstance(kind, type) and is_section(kind)]
    assert len(sections) >= 9
    for section in (Scenario, *sections):
        for name, field in fields_of(section).items():
            assert re.search(rf"^ *(# )?{name}:", TEXT, re.M), name
            if section is not Scenario:
                assert field.description, name
    assert max(map(len, TEXT.splitlines())) <= 100


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    "line", [line for line in TEXT.splitlines() if OFF.match(line) and "$schema" not in line]
)
def test_what_is_commented_out_is_valid_too(line):
    assert TEXT.count(line) == 1
    lines = [line]
    if line.split()[1] in ("enabled:", "start:", "target:", "obstacles:"):  # a path has both ends
        lines = [one for one in TEXT.splitlines() if re.match(" +# (start|target): ", one)]
    text = TEXT
    for one in {line, *lines}:
        text = text.replace(one, OFF.sub(r"\1\2", one))
    data = yaml.safe_load(text)
    scenario = Scenario.from_data(data)
    # The example may be equal to a default that depends on other fields.
    depends = "auto" in line or "subrays:" in line
    assert depends or scenario.model_dump() != SEED.model_dump()


def test_a_short_one_has_the_defaults_and_its_examples_are_valid(tmp_path):
    text = short_scenario({}, "")
    assert len(text.splitlines()) < 15
    (tmp_path / "scenario.yaml").write_text(text)
    made = prepare(Scenario.load(tmp_path / "scenario.yaml"))
    assert fingerprint(made.survey) == fingerprint(prepare(SEED).survey)
    on = [OFF.sub(r"\1\2", line) for line in text.splitlines() if "$schema" not in line]
    scenario = Scenario.from_data(yaml.safe_load("\n".join(on)))
    given = {"scene", "sensor", "poses", "cloud", "output"}
    assert scenario.model_fields_set == given

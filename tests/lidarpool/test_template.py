from __future__ import annotations

import re

import pytest
import yaml

from lidarpool.base.validation import fields_of, is_section
from lidarpool.scenario.scenario import Scenario
from lidarpool.scenario.schema import scenario_template

TEXT = scenario_template()
# A field that is commented out: its name, a colon and a value in YAML.
OFF = re.compile(r"^( *)# ([a-z_]+: \S.*)$")


def test_it_is_valid_and_is_the_default_survey(tmp_path):
    (tmp_path / "scenario.yaml").write_text(TEXT)
    assert Scenario.load(tmp_path / "scenario.yaml").model_dump() == Scenario().model_dump()


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


@pytest.mark.parametrize(
    "line", [line for line in TEXT.splitlines() if OFF.match(line) and "$schema" not in line]
)
def test_what_is_commented_out_is_valid_too(line):
    assert TEXT.count(line) == 1
    data = yaml.safe_load(TEXT.replace(line, OFF.sub(r"\1\2", line)))
    scenario = Scenario.from_data(data)
    # What cannot be told from a default that follows from other things says it in words.
    assert "auto" in line or scenario.model_dump() != Scenario().model_dump()

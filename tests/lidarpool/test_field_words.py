"""Fields in words, by which messages name what differs between two runs."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfiles.identity.field_words import describe_changes, describe_fields
from lidarpool.run.job_source import describe_inputs
from lidarscenario import Planning
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim.words import format_rounded

POSES = [[x, 0, 1] for x in range(30)]


def words(**sections):
    """Return the fields of the survey of a scenario."""
    built = prepare(Scenario.from_data({"scene": "seed", "poses": [[0, 0, 1]]} | sections))
    return describe_inputs(built.scene, built.survey, built.job.planning)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("sections", "differs"),
    [
        ({"noise": {"range_m": 0.02}}, "noise.range_m changed from 0 to 0.02"),
        ({"steps": 7}, " to 7"),
        ({"weather": {"visibility_km": 2}}, "weather.visibility_km was set to 2"),
        ({"cloud": {"columns": ["range"]}}, "cloud.columns changed from [] to [range]"),
        ({"poses": [[0, 0, 2]]}, "poses[0].position changed from [0, 0, 1] to [0, 0, 2]"),
        ({"sensor": "velodyne/vlp16"}, "sensor.model changed from grid to Velodyne VLP-16"),
        ({"mount": [0, 0, 0.5]}, "sensor.mount.position changed from [0, 0, 0] to [0, 0, 0.5]"),
        ({"scene": {"preset": "seed", "ground": {}}}, "scene.objects changed from 6 to 7"),
    ],
)
def test_fields_that_differ_are_named_as_in_a_scenario(sections, differs):
    assert differs in describe_changes(words(), words(**sections), max_fields=20)


def test_of_many_fields_some_are_named_and_the_others_counted():
    earlier = {f"field{number}": "1" for number in range(9)}
    now = dict.fromkeys(earlier, "2")
    said = describe_changes(earlier, now)
    assert said.startswith("field0 changed from 1 to 2; field1 changed") and said.endswith(
        "; and 5 more"
    )
    assert describe_changes(now, now) == ""


def test_a_long_list_that_differs_has_other_content():
    lists = [dict(describe_fields({"poses": np.add(POSES, shift)})) for shift in (0, 1)]
    assert describe_changes(*lists) == "the content of poses changed"
    poses = dict(describe_fields({"poses": POSES[:-1]})), dict(describe_fields({"poses": POSES}))
    assert describe_changes(*poses) == "poses changed from 29 entries to 30 entries"


def test_a_plan_is_of_the_fields():
    plans = [Planning((0, 0), (10, 0), centers=[(5, 0)], radii=r) for r in (1, 2)]
    fields = [dict(describe_fields(plan, "planning")) for plan in plans]
    assert describe_changes(*fields) == "planning.radii changed from [1.0] to [2.0]"


@pytest.mark.parametrize(
    ("number", "digits", "text"),
    [
        (99.96, 2, "100"),
        (99.96, 3, "100"),
        (99.94, 3, "99.9"),
        (-99.96, 2, "-100"),
        (5.0, 3, "5"),
        (1234.5, 3, "1,230"),
        (12_345_678.0, 4, "12,350,000"),
        (0.00123456, 3, "0.00123"),
        (0.0, 2, "0"),
        (float("inf"), 3, "inf"),
        (1e30, 3, "1e+30"),
    ],
)
def test_large_numbers_in_messages_have_no_exponent(number, digits, text):
    assert format_rounded(number, digits) == text

"""Options of mesh files in scenarios: which there are follows from the format of the file."""

import pickle
from inspect import signature
from typing import get_args

import pytest

from lidarscenario.campaign.campaign_jobs import ScenarioJobs
from lidarscenario.field_paths import find_field, replace_value
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Scene
from lidarsim.scene.files.mesh_formats import known_formats
from lidarsim.scene.files.mesh_options import LengthUnit, MeshOptions
from lidarsim.schema.vocabulary import UNITS_M


def scenario(**entry):
    return Scenario.from_data({"scene": [entry]})


def refused(**entry):
    with pytest.raises(LidarError) as caught:
        scenario(**entry)
    return str(caught.value)


def test_options_are_named_with_the_formats_that_have_them():
    entry = {"file": "a.obj", "sag_m": 0.1, "storeys": ["Attic"], "keyframe": "home"}
    assert refused(**entry, groups=[0]) == (
        "scenario: scene.files[0]: a.obj does not support sag_m (an option of .xodr), storeys (an "
        "option of .ifc .ifczip), keyframe and groups (options of .xml). Remove sag_m, storeys, "
        "keyframe and groups."
    )
    assert refused(file="a.urdf", geometry="visual") == (
        "scenario: scene.files[0]: a.urdf does not support geometry (an option of .sdf .world). "
        "Remove geometry."
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            {"file": "a.tif", "step_mm": 2},
            "Unknown field 'scene.files[0].step_mm'. Write step_m: 0.002.",
        ),
        ({"file": "a.tif", "step_m": -2}, "step_m must be above 0 and at most 1000000, but is -2."),
        ({"file": "a.tif", "epsg": 25832}, "It is a field of world. Move it there."),
        ({"file": "a.glb", "animation": "Walk"}, "Unknown field 'scene.files[0].animation'."),
        (
            {"file": "a.xml", "groups": [7]},
            "scene.files[0].groups[0] must be from 0 to 5, but is 7.",
        ),
        ({"step_m": 2}, "scene.files[0].file is required."),
    ],
)
def test_faults_of_options(entry, message):
    assert message in refused(**entry)


def test_a_misspelt_option_in_python(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(LidarError, match=r"Remove opactiy. Did you mean 'opacity'"):
        Scene.load(tmp_path / "a.obj", opactiy="mask")
    with pytest.raises(LidarError, match=r"unit must be 'um', .* but is 'mile'"):
        Scene.load(tmp_path / "a.obj", unit="mile")
    with pytest.raises(LidarError, match="animation cannot be used in a scene"):
        Scene.load(tmp_path / "a.glb", animation="Walk")
    listed = {line.strip() for line in Scene.load.__doc__.splitlines()}
    assert {*signature(MeshOptions).parameters} - {"animation"} < listed


def test_scenarios_with_options_are_compared_and_stored(tmp_path):
    with_step = scenario(file="a.tif", step_m=2, window=[0, 0, 9, 9])
    assert pickle.loads(pickle.dumps(with_step)) == with_step
    data = with_step.model_dump(mode="json", exclude_unset=True)
    assert data == {"scene": {"files": [{"file": "a.tif", "step_m": 2, "window": [0, 0, 9, 9]}]}}
    assert with_step != scenario(file="a.tif", step_m=3, window=[0, 0, 9, 9])
    path = tmp_path / "a.yaml"  # what --resume compares
    path.write_text("scene: [{file: a.tif, step_m: 2}]")
    jobs = ScenarioJobs([path])
    assert "2" in next(text for name, text in jobs.fields.items() if name.endswith("step_m"))
    path.write_text("scene: [{file: a.tif, step_m: 3}]")
    assert ScenarioJobs([path]).identity != jobs.identity


def test_a_campaign_varies_an_option_that_the_base_leaves_out():
    base = scenario(file="a.tif")
    steps, _ = find_field(base, "scene.files.0.step_m")
    changed = Scenario.model_validate(replace_value(base, steps, lambda _: 5.0))
    assert changed.scene == scenario(file="a.tif", step_m=5.0).scene
    with pytest.raises(LidarError, match="'step_mm' is not a field"):
        find_field(base, "scene.files.0.step_mm")


def test_each_option_of_a_format_has_a_default_and_a_name_of_its_own():
    shared = {*signature(MeshOptions).parameters}
    with_options = [row for row in known_formats() if row.own_options is not None]
    assert with_options
    for row in with_options:
        assert row.own_options() is not None
        assert not shared & {*signature(row.own_options).parameters}


def test_units_of_files_are_those_of_the_vocabulary():
    assert get_args(get_args(get_args(LengthUnit)[0])[0]) == tuple(UNITS_M)

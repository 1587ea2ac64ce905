"""--unit and --up-axis, wherever the command takes a mesh, and notes before long computations."""

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from tests.lidarscenario.test_scenario import mesh_file

from lidarlive.playback.sources import open_source, scenario_job
from lidarpool.cli.commands import cli
from lidarpool.pages.opened import open_view
from lidarsim import LidarError


@pytest.mark.parametrize("name", ["init", "check", "run", "stations", "view", "play"])
def test_each_command_that_takes_a_mesh_says_how_it_is_read(name):
    options = {option for param in cli.commands[name].params for option in param.opts}
    assert {"--unit", "--up-axis"} <= options


@pytest.mark.extended
def test_stations_of_a_mesh_that_lies_on_its_side(tmp_path):
    """A glTF that was written with z up; the note comes before the places are looked from."""
    mesh_file(tmp_path / "house.glb", (8, 6, 3), 2, generator="scan2mesh", version="2.0")
    command = ["stations", str(tmp_path / "house.glb"), "--sensor", "riegl-vz400"]
    command += ["--count", "1", "--spacing", "2"]
    aside = CliRunner().invoke(cli, [*command, "--out", str(tmp_path / "a")])
    lines = aside.stderr.splitlines()
    (note,) = [number for number, line in enumerate(lines) if "--up-axis" in line]
    (looking,) = [number for number, line in enumerate(lines) if "computing the visibility" in line]
    assert note < looking and "set `--up-axis z`" in lines[note]
    told = [*command, "--up-axis", "z", "--json", "--out", str(tmp_path / "b")]
    upright = json.loads(CliRunner().invoke(cli, told).stdout)
    (station,) = upright["stations"]
    assert station["position"][2] < 3 and not [n for n in upright["notes"] if "--up-axis" in n]
    assert "up_axis: z" in (tmp_path / "b" / "stations.yaml").read_text()


def test_a_view_and_a_played_mesh_have_its_unit_and_axis(tmp_path):
    part = tmp_path / "part.stl"
    part.write_bytes(trimesh.creation.box((8000, 3000, 6000)).export(file_type="stl"))
    of_mesh = {"unit": "mm", "up_axis": "y"}
    notes = []
    for scene in (
        open_view(part, of_mesh=of_mesh, report=notes.append).pictured.scene,
        scenario_job(part, None, of_mesh, notes.append).scene,
    ):
        np.testing.assert_allclose(np.ptp(scene.bounds, axis=0), (8, 6, 3))
    assert len({*notes}) == len(notes) / 2  # each tells the same


def test_options_of_a_mesh_are_refused_for_what_is_none(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,z\n1,2,3\n4,5,6\n")
    (tmp_path / "s.yaml").write_text("scene: seed\n")
    with pytest.raises(LidarError, match=r"points\.csv is not a mesh\. Remove `--up-axis`"):
        open_view(tmp_path / "points.csv", of_mesh={"up_axis": "z"})
    for opened in (open_view, lambda path, of_mesh: scenario_job(path, None, of_mesh)):
        with pytest.raises(LidarError, match=r"`--unit` requires a mesh file"):
            opened(tmp_path / "s.yaml", of_mesh={"unit": "mm"})
    with (
        pytest.raises(LidarError, match=r"is a result\. Omit them"),
        open_source(tmp_path, None, {"unit": "mm"}),
    ):
        pass

"""Names of sensors and formats are checked before scenes and recordings, which may take minutes."""

import pytest
from click.testing import CliRunner

from lidarfiles.clouds.writing import ExportSpec
from lidarpool.cli.commands import cli
from lidarreal import fit, twin
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Scene, box


@pytest.fixture
def unread(monkeypatch):
    """Let reading a scene or recording fail the test."""

    def read(*_, **__):
        raise AssertionError("read before names were checked")

    for place in (
        "lidarscenario.prepare.read_static_scene",
        "lidarreal.comparing.fit.fitting.as_recording",
        "lidarreal.reconstruction.building.RecordedSweeps.open",
    ):
        monkeypatch.setattr(place, read)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (
            {"sensor": {"model": "velodyne/vlp61"}},
            "Unknown sensor model .* Did you mean 'velodyne/vlp1",
        ),
        ({"sensors": {"a": {"model": "velodyne/vlp61"}}}, "Unknown sensor model"),
        ({"sensor": {"calibration": "none.yaml"}}, "none.yaml.* does not exist"),
        ({"output": {"write": ["lza"]}}, r"Unknown cloud format 'lza'\. Did you mean 'laz'"),
    ],
)
def test_a_scenario(unread, sections, message):
    with pytest.raises(LidarError, match=message):
        prepare(Scenario.from_data({"scene": "seed", **sections}), plans=False)


def test_models_of_fits_and_twins(unread, tmp_path):
    for call in (fit, twin):
        with pytest.raises(LidarError, match="Unknown sensor model 'velodyne/vlp61'"):
            call(tmp_path / "drive.mcap", model="velodyne/vlp61")


def test_packages_of_formats(unread, tmp_path, monkeypatch):
    """In a run; `check` reports them among the other needs."""
    write_scene(tmp_path / "room.glb", Scene.from_meshes([box("Room", (8, 6, 3))]))

    def check_installed(self):
        raise LidarError(f"The format {self.format} needs something")

    monkeypatch.setattr(ExportSpec, "check_installed", check_installed)
    arguments = ["run", str(tmp_path / "room.glb"), "--format", "laz", "--out", f"{tmp_path}/out"]
    outcome = CliRunner().invoke(cli, arguments)
    assert "The format laz needs something" in outcome.output + str(outcome.exception)

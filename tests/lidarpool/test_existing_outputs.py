"""Existing output files are reported before the inputs are read, which may take long."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lidarfiles.work import work
from lidarpool.cli.commands import cli
from lidarsim import LidarError

VOXELS = "sequences/00/voxels/000000.bin"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The working directory, with a scenario and a campaign whose scene file is missing."""
    monkeypatch.chdir(tmp_path)
    Path("site.yaml").write_text("scene: missing.glb\nmount: [0, 0, 1]\n")
    Path("campaign.yaml").write_text(
        "base: site.yaml\ncount: 2\nkeep: kitti\nvary: {mount.position.2: {each: [1, 2]}}\n"
    )


def message(command):
    outcome = CliRunner().invoke(cli, command.split())
    assert isinstance(outcome.exception, LidarError), outcome.output
    return str(outcome.exception)


@pytest.mark.parametrize(
    ("command", "existing"),
    [
        ("stations site.yaml --sensor riegl-vz400 --out out", "stations.yaml"),
        ("stations missing.yaml --out out", "stations.png"),
        ("flight missing.glb --sensor riegl-vq780i --agl 100 --out out", "flight.png"),
        ("flight 0,0,9,9 --terrain site.yaml --sensor riegl-vq780i --agl 9 --out out", "path.csv"),
        ("mount missing.yaml --out out", "vehicle.glb"),
        ("fit missing.pcap --model velodyne/vlp16 --out out/mine.yaml", "mine.html"),
        ("fit --pattern missing.pcap --out out/mine.csv", "mine.csv"),
        ("export missing --format las --format laz --out out", "cloud.laz"),
        ("import missing.xml --out out", ""),
        ("import missing.sdf --out out", ""),
        ("twin missing.mcap --out out", "scenario.yaml"),
        ("scene points missing.ply out/place.glb", "place.glb"),
        ("sensors missing/vlp16 --out out/vlp16.png", "vlp16.png"),
        ("sensors --calibration missing.json --out out/vlp16.csv", "vlp16.csv"),
        ("occupancy site.yaml --layout semantickitti --out out", VOXELS),
        ("occupancy campaign.yaml --layout semantickitti --out out", VOXELS.replace("00", "01", 1)),
        ("occupancy campaign.yaml --layout semantickitti --job 0 --out out", VOXELS),
    ],
)  # fmt: skip
def test_existing_outputs_are_reported_before_inputs_are_read(command, existing):
    file = Path("out", existing)
    file.parent.mkdir(parents=True, exist_ok=True)
    if existing:
        file.write_text("kept")
    else:
        file.mkdir()
    assert message(command).startswith(f"{file} already exists.")
    # Without the existing file, the input is missing.
    if existing:
        assert file.read_text() == "kept"
        file.unlink()
    else:
        file.rmdir()
    assert "missing" in message(command)


def test_an_existing_augmentation_is_reported_before_the_recording_is_hashed(monkeypatch):
    hashed = []
    monkeypatch.setattr(work, "fingerprint_files", lambda path: hashed.append(path) or "hash")
    Path("drive").mkdir()
    np.ones((40, 4), "<f4").tofile("drive/000000.bin")
    command = "augment drive --out wet --rain 5 --workers 1 --quiet"
    Path("wet").mkdir()
    assert message(command) == "wet already exists. Use another path, or pass `--overwrite`."
    assert not hashed and [*Path("wet").iterdir()] == []
    assert "All intensities of drive are 1" in message(f"{command} --overwrite") and hashed


@pytest.mark.parametrize("options", ["", "--sensor roof", "--voxel-size 0.8"])
def test_a_description_of_another_grid_is_reported_before_the_scene_is_read(options):
    Path("out").mkdir()
    Path("out/occupancy.json").write_text("{}")
    command = f"occupancy site.yaml --layout occ3d --out out {options}"
    assert "occupancy.json already exists and describes another grid" in message(command)
    assert "missing.glb" in message(f"{command} --overwrite")

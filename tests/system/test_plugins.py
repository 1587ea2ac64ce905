"""A package with a plug-in of each kind, as the documentation shows it, installed and used."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.plugin_files import write_distribution

from lidarpool import LidarError, load_sensor, read_cloud
from lidarpool.identity.software import call_with_plugins
from lidarsim.environment.plugins import Plugin, plugins_of

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "tests" / "plugin_package"
PAGE = ROOT / "docs" / "how-to" / "plugins.md"

BOXES = "Floor 0 0 -0.1 40 40 0.1\nCrate 5 0 0 2 2 2\n"
TOUR = '<tour sensor="acme/x1"><stop x="0" y="0" z="1.8"/><music/></tour>'


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return the folder that the package is installed into."""
    folder = tmp_path_factory.mktemp("installed")
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    install += ["--no-build-isolation", "--target", str(folder), str(PACKAGE)]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_page_shows_the_package():
    shown = dict(
        re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```$', PAGE.read_text("utf-8"), re.M | re.S)
    )
    files = [
        path for path in sorted(PACKAGE.rglob("*.*"))
        if path.is_file() and path.name != "__init__.py" and "__pycache__" not in path.parts
    ]  # fmt: skip
    assert shown == {
        path.relative_to(PACKAGE).as_posix(): path.read_text("utf-8") for path in files
    }
    assert max(text.count("\n") for text in shown.values()) <= 35


@pytest.mark.slow
def test_a_survey_by_plugins_of_each_kind(tmp_path, installed):
    """Mesh, sensor, importer, cloud format and command; processes of a cluster write the cloud."""
    environment = os.environ | {"PYTHONPATH": f"{installed}:{os.environ['PYTHONPATH']}"}

    def lidarpool(*words):
        command = [sys.executable, "-m", "lidarpool", *words]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    (tmp_path / "hall.boxes").write_text(BOXES)
    (tmp_path / "walk.xml").write_text(TOUR)
    assert "not supported: <music>" in lidarpool("import", "walk.xml")

    file = tmp_path / "walk" / "scenario.yaml"
    scenario = yaml.safe_load(file.read_text())
    scenario |= {
        "scene": {"files": {"file": "../hall.boxes", "grow_m": 0.01}},
        "output": {"write": ["npy", "pcap"]},
        "steps": 36,
    }
    file.write_text(yaml.safe_dump(scenario))
    mesh_file = json.loads(lidarpool("schema"))["$defs"]["MeshFile"]
    assert mesh_file["properties"]["grow_m"]["maximum"] == 10
    lidarpool("run", "walk/scenario.yaml", "--out", "result", "--cloud-only", "--quiet")

    cloud = read_cloud(tmp_path / "result" / "cloud.ply")
    [sweep] = sorted((tmp_path / "result" / "npy").iterdir())
    np.testing.assert_array_equal(np.load(sweep), cloud.positions.astype(np.float32))
    packets = (tmp_path / "result" / "packets" / "lidar.pcap").read_bytes()
    assert len(packets) == 24 + 1000 * (16 + 42 + 2 * 16)  # a datagram a firing
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    assert "export" in report["stages"]
    assert lidarpool("highest", "result") == f"{cloud.bounds[1, 2]:.2f} m\n"


@pytest.mark.slow
def test_a_worker_without_the_plugin_is_named(tmp_path, monkeypatch, installed, client, lidarpool):
    monkeypatch.syspath_prepend(installed)
    assert "lidar-example" in str(plugins_of("lidarpool.clouds")["npy"])
    assert load_sensor("acme/x1").channels == 16
    assert "\nacme/x1  " in lidarpool("sensors").out
    (tmp_path / "hall.boxes").write_text(BOXES)
    scenario = {"scene": {"files": "hall.boxes"}, "sensor": "acme/x1", "poses": [[0, 0, 1.8]]}
    text = yaml.safe_dump({**scenario, "output": {"write": ["npy"]}})
    (tmp_path / "scenario.yaml").write_text(text)
    options = "--cloud-only", "--quiet", "--scheduler", client.scheduler.address
    outcome = lidarpool("run", "scenario.yaml", *options)
    assert outcome.code == 2
    [line] = outcome.err.splitlines()
    assert "has no plug-in lidar-example, but the run requires plug-in lidar-example 0.1" in line
    # Meshes and sensors are read by the driver alone.
    (tmp_path / "scenario.yaml").write_text(yaml.safe_dump(scenario))
    outcome = lidarpool("run", "scenario.yaml", *options)
    assert outcome.code == 0


def test_a_worker_that_joins_with_another_version_does_no_task(cluster_client):
    plugin = Plugin("lidarpool.clouds", "gone", "gone:Gone", "lidar-gone", "0.2")
    task = cluster_client.submit(call_with_plugins, {plugin: "0.2 (sources 12345678)"}, int)
    with pytest.raises(LidarError, match=r"no plug-in lidar-gone, but the run requires .* 0\.2"):
        task.result()
    task.release()  # the error has frames that hold it


# A format that only the process of the tests can import.
HERE_ALONE = """
from multiprocessing import parent_process
from lidarpool.plugins import FormatRow, MultiFileFormat

if parent_process() is not None:
    raise ImportError("no library")

class Files(MultiFileFormat):
    row = FormatRow("alone")
"""


@pytest.mark.extended
def test_a_worker_that_cannot_import_the_plugin_is_named(tmp_path, monkeypatch, client, lidarpool):
    folder = write_distribution(
        tmp_path / "installed",
        "alone-cloud",
        {"lidarpool.clouds": {"alone": "alone_cloud:Files"}},
        {"alone_cloud.py": HERE_ALONE},
    )
    monkeypatch.syspath_prepend(folder)
    client.run(sys_path_with, str(folder))
    try:
        (tmp_path / "scenario.yaml").write_text("scene: seed\noutput: {write: [alone]}")
        options = "--cloud-only", "--quiet", "--scheduler", client.scheduler.address
        outcome = lidarpool("run", "scenario.yaml", *options)
    finally:
        client.run(sys_path_without, str(folder))
    assert outcome.code == 2
    [line] = outcome.err.splitlines()
    told = "'alone' of the plug-in alone-cloud 0.1 cannot be imported: no library"
    assert "The worker at " in line and told in line


def sys_path_with(folder):
    sys.path.insert(0, folder)


def sys_path_without(folder):
    sys.path.remove(folder)

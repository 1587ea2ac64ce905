"""Evaluated candidates compared with runs of the whole pipeline, and with a cluster."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from distributed import Client

import poolpart.deploy
from lidarfiles import read_cloud
from lidarpool.cli.commands import cli
from lidarscenario.mount_sections import VehicleFile
from lidarscenario.mounting.study import MountStudy
from lidarscenario.mounting.study_files import rank_mounts, write_study

VEHICLE = {
    "body": "saloon",
    "sensors": {
        "left": {
            "model": "velodyne/vlp16",
            "performance": "ideal",
            "mounts": {
                "roof": [0.3, 0.3, 1.9],
                "nose": {"position": [2.5, 0.6, 0.8], "yaw_deg": 30},
            },
        },
        "right": {
            "model": "velodyne/vlp16",
            "performance": "ideal",
            "mounts": {
                "roof": [0.3, -0.3, 1.9],
                "nose": {"position": [2.5, -0.6, 0.8], "yaw_deg": -30},
            },
        },
    },
    "combine": "names",
    "targets": ["pedestrian", "car", "cyclist", "cone"],
    "region": {"distances_m": [5, 9], "bearings": 6, "headings_deg": [20]},
    "map": {"margin_m": 5, "cell_m": 0.5},
}


@pytest.mark.extended
def test_points_are_those_of_a_run(tmp_path, monkeypatch):
    """Winner and loser: each target has the points that it has in `lidarpool run`."""
    monkeypatch.chdir(tmp_path)
    study = MountStudy.from_file(VehicleFile.from_data(VEHICLE))
    result = study.run(workers=1)
    assert [one.candidate.name for one in result.ranked] == ["nose", "roof"]
    write_study(result, Path(), Path())
    best = yaml.safe_load(Path("best.yaml").read_text())
    placements = study.placements
    for place, one in enumerate(result.ranked):
        chosen = np.arange(place, len(placements), 11)  # far apart, none behind another
        actors = [
            {
                "name": f"Target {row}",
                "file": best["actors"][int(placements.mesh[row])]["file"],
                "at": {
                    "position": placements.positions[row].tolist(),
                    "yaw_deg": float(placements.headings_deg[row]),
                },
            }
            for row in chosen.tolist()
        ]
        for name, pose in one.candidate.mounts.items():
            sensor = best["sensors"][name]
            sensor["mount"] = {"position": [*pose.position], "yaw_deg": pose.yaw_deg}
            sensor["min_range_m"] = 0.001  # the vehicle blocks beams within the minimum range
        scenario = best | {"actors": actors, "materials": []}
        Path("full.yaml").write_text(yaml.safe_dump(scenario))
        command = ["run", "full.yaml", "--out", f"out{place}", "--cloud-only", "-q"]
        outcome = CliRunner().invoke(cli, command)
        assert outcome.exit_code == 0, outcome.output
        cloud = read_cloud(Path(f"out{place}/cloud.ply"))
        limit = study.vehicle.mounted_sensor("left", pose).sensor.min_range_m
        objects = cloud["object"][cloud["range"] >= limit]
        counted = np.bincount(objects, minlength=2 + len(chosen))[2:]
        evaluated = one.points[chosen]
        assert evaluated.sum() > 200
        np.testing.assert_array_equal(counted, evaluated)


@pytest.mark.extended
def test_processes_and_clusters_write_the_same_bytes(tmp_path):
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text(yaml.safe_dump(VEHICLE))
    for workers in (1, 2):
        rank_mounts(vehicle, tmp_path / f"by-{workers}", workers=workers)
    with poolpart.deploy.local_cluster({"OTHER": (2, 1)}) as cluster, Client(cluster) as client:
        rank_mounts(vehicle, tmp_path / "cluster", client=client)
    alone, *others = (
        {
            path.relative_to(tmp_path / name).as_posix(): path.read_bytes()
            for path in (tmp_path / name).rglob("*")
            if path.is_file()
        }
        for name in ("by-1", "by-2", "cluster")
    )
    assert len(alone) == 8
    assert others == [alone, alone]

"""Bags of a straight drive through a small city."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lidarpool import Mounted, Pose, Sensor, Survey, Track, save_cloud
from lidarscenes.procedural.city import city
from lidarsim.columns.table import SCAN
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

SPEED_M_S = 4.0


def write_city_drive(path: Path, sensor: Sensor, sweep_count: int, start_x_m: float) -> Path:
    """Write a bag of sweeps at 10 Hz from a sensor that moves along x at `SPEED_M_S`."""
    scene = city(5_000)
    end_s = 0.1 * (sweep_count + 1)
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, 1.9)), "lidar")],
        trajectory=Track([0, end_s], [[start_x_m, -3, 0], [SPEED_M_S * end_s + start_x_m, -3, 0]]),
        steps=36 * sweep_count,
        columns=["time", "intensity", "class", "ray", "range"],
        precision_m=1e-3,
    )
    part = columns_of(list(Rig(scene, survey, "auto").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    save_cloud(replace(cloud, sweeps=lambda: sweeps), path)
    return path

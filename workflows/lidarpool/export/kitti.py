"""Folders of plain binary files: KITTI with the labels of SemanticKITTI, and nuScenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..base.errors import LidarpoolError
from ..columns.cloud import CloudLike
from ..sensor.trajectory import matrices
from .sweeps import Sweeps, plain_names

INSTANCES_MOST = 65_535


def write_kitti(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write a sequence for each sensor: `sequences/00`, `01`, ...

    In each are `velodyne/000000.bin` (float32 x, y, z in the sensor's axes when the sweep began,
    intensity), `labels/000000.label` (uint32: instance << 16 | class; the instance is the object's
    number + 1), `poses.txt` (the sensor's, 3 x 4, from its first), `times.txt` in seconds and
    `calib.txt`, in which camera and lidar have the same axes. KITTI's own tools look for the poses
    in `poses/00.txt`.

    Behley et al., SemanticKITTI, 2019; Geiger et al., 2012.
    """
    if len(sweeps.objects) + len(sweeps.actors) > INSTANCES_MOST:
        raise LidarpoolError(f"KITTI labels hold {INSTANCES_MOST:,} objects at most.")
    numbers = [0] * len(sweeps.sensors)
    for sweep, points in enumerate(sweeps.points(cloud)):
        sensor = int(sweeps.sensor[sweep])
        folder = path / "sequences" / f"{sensor:02}"
        if not numbers[sensor]:
            for name in ("velodyne", "labels"):
                (folder / name).mkdir(parents=True)
        number = numbers[sensor]
        numbers[sensor] += 1
        inside = sweeps.in_sensor(sweep, points.positions)
        rows = np.column_stack([inside, points["intensity"]]).astype("<f4")
        (folder / "velodyne" / f"{number:06}.bin").write_bytes(rows.tobytes())
        labels = (points["object"].astype("<u4") + 1) << 16 | points["class"]
        (folder / "labels" / f"{number:06}.label").write_bytes(labels.tobytes())
    for sensor in range(len(sweeps.sensors)):
        folder, own = path / "sequences" / f"{sensor:02}", sweeps.sensor == sensor
        turns, places = matrices(sweeps.pose.quaternions[own]), sweeps.pose.positions[own]
        first = turns[0].T
        rows = np.concatenate([first @ turns, ((places - places[0]) @ first.T)[..., None]], axis=2)
        (path / "poses").mkdir(exist_ok=True)
        for file in (folder / "poses.txt", path / "poses" / f"{sensor:02}.txt"):
            np.savetxt(file, rows.reshape(-1, 12), "%.9e")
        np.savetxt(folder / "times.txt", sweeps.begins_ns[own] / 1e9, "%.9e")
        unit = " ".join(f"{value:.9e}" for value in np.eye(4)[:3].ravel())
        (folder / "calib.txt").write_text(
            "".join(f"{name}: {unit}\n" for name in ("P0", "P1", "P2", "P3", "Tr"))
        )


def write_nuscenes(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write `NAME/000000.pcd.bin` for each sweep: float32 x, y, z, intensity (0 to 255), ring.

    NAME is that of the sensor, LIDAR_TOP where it has none. Caesar et al., nuScenes, 2020.
    """
    folders = plain_names(name or "LIDAR_TOP" for name in sweeps.sensors)
    numbers = [0] * len(sweeps.sensors)
    for sweep, points in enumerate(sweeps.points(cloud)):
        sensor = int(sweeps.sensor[sweep])
        folder = path / folders[sensor]
        folder.mkdir(parents=True, exist_ok=True)
        inside = sweeps.in_sensor(sweep, points.positions)
        light = np.clip(points["intensity"], 0, 1) * 255
        rows = np.column_stack([inside, light, points["channel"]]).astype("<f4")
        (folder / f"{numbers[sensor]:06}.pcd.bin").write_bytes(rows.tobytes())
        numbers[sensor] += 1

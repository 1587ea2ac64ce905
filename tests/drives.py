"""A drive with two sensors past two cars, and points for each job of a data set of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarsim import Actor, Cloud, Mounted, Pose, Scene, Sensor, Survey, Track, box
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps

# of a sensor, of a turn
TURNS = 3
SCANS = 36
SPLITS = ["train"] * 4 + ["val", "test"]


def the_scene() -> Scene:
    """Two cars far from the origin of the world; the second comes later."""
    far = replace(Scene.seed(), origin=np.array([300_000.0, 5_600_000.0, 40.0]))
    track = Track([0, 2], [[5, 5, 0], [9, 5, 0]])
    later = Track([0.15, 2], [[0, 5, 0], [0, 9, 0]])
    cars = Actor(box("Car 1", (4, 2, 1.5)), track), Actor(box("Van 1", (5, 2, 2.5)), later)
    return replace(far, actors=cars)


def the_survey() -> Survey:
    """Three turns of each sensor, on a carrier that moves and turns."""
    half = np.sqrt(0.5)
    track = Track([0, 1], [[0, 0, 1], [10, 5, 1]], [[0, 0, 0, 1], [0, 0, half, half]])
    lidar = Sensor.grid(360, 4)
    sensors = [Mounted(lidar, Pose((1, 0, 0.5), 30.0), "front"), Mounted(lidar, name="rear/left")]
    return Survey(sensors=sensors, trajectory=track, steps=TURNS * SCANS, columns=["ray"])


def the_sweeps(scene: Scene) -> Sweeps:
    """Return the sweeps of `the_survey`."""
    return Sweeps.from_survey(the_survey(), scene)


def points_of(scene: Scene, number: int) -> Cloud:
    """Return the points of a job, none in its second sweep."""
    rng = np.random.default_rng(number)
    scan = np.sort(rng.integers(0, 2 * TURNS * SCANS, 900))
    scan = scan[scan // SCANS != 1]
    count = len(scan)
    ray = rng.integers(0, 40, count)
    ray = ray[np.lexsort((ray, scan))]
    columns = {
        "scan": scan,
        "ray": ray,
        "channel": ray % 4,
        "object": rng.integers(0, len(scene.names) + 2, count),
        "intensity": rng.uniform(0, 1, count).astype(np.float32),
        "class": rng.integers(0, 30, count),
        # Up to the last firing of the scan; each sensor has `TURNS` turns from 0 s on.
        "time": np.rint((scan % (TURNS * SCANS) + rng.uniform(0, 0.9, count)) * 1e8 / SCANS),
        **dict.fromkeys(("range", "azimuth", "elevation"), np.ones(count)),
        **dict.fromkeys(("return_number", "returns"), np.ones(count, np.uint8)),
    }
    columns["reflectivity"] = np.rint(255 * columns["intensity"]).astype(np.uint8)
    columns["signal"] = np.rint(10_000 * columns["intensity"]).astype(np.uint16)
    places = scene.origin + rng.uniform(-60, 60, (count, 3))
    return Cloud(np.round(places, 3), columns)


def write_set(
    place: Path | str,
    format: str,  # noqa: A002
    scene: Scene,
    sweeps: Sweeps,
    layout: str = "velodyne",
) -> DataSet:
    """Write a data set of six jobs, of which the fourth failed."""
    data = DataSet(Storage.at(place), format, layout)
    rows = [
        JobRow(n, f"{n:02}", split, {"rain": n / 2}, "failed" if n == 3 else "")
        for n, split in enumerate(SPLITS)
    ]
    for row in rows:
        if row.done:
            data.write_job(row, points_of(scene, row.number), sweeps)
    write_table(data.storage, ["rain"], lambda: rows)
    data.finish(rows)
    return data

"""A result on a page: a spiral of points that a moving sensor scans, beside a van that drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarfiles.picture_file import PictureContent, sensor_positions
from lidarsim import Actor, Column, Scene, Sensor, Survey, Track, box
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import header, row_type
from lidarsim.columns.table import SCAN
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.viewer.view import View

COUNT = 30_000
SCANS = 360
WET = Column("wetness", "float32", "%", "how wet it is", source="wetness")


def spiral(path: Path, column: Column) -> Path:
    """Write a file with a spiral of 30,000 points in 360 scans, and a column from 0 to 100."""
    turn = np.linspace(0, 20 * np.pi, COUNT)
    rows = np.zeros(COUNT, row_type(np.dtype(np.float32), (SCAN, column)))
    rows[column.name] = np.linspace(0, 100, COUNT)
    rows["x"] = 9 * np.cos(turn)
    rows["y"] = 9 * np.sin(turn)
    rows["z"] = turn / 8
    rows["scan"] = np.arange(COUNT) * SCANS // COUNT
    path.write_bytes(header(rows.dtype, COUNT) + rows.tobytes())
    return path


def spiral_view(cloud: Path) -> View:
    """Return the view of a spiral that a sensor scans in ten turns, while a box drives along x."""
    track = Track([0, 1], [[-9, 0, 8], [9, 0, 8]])
    scene = Scene.from_meshes([box("Floor", (20, 20, 0.1))])  # few triangles: browsers are slow
    scene = replace(scene, actors=(Actor(box("Van", (4, 2, 2)), track),))
    poses = Track([0, 2], [[0, -9, 4], [0, 9, 4.0]])
    survey = Survey(Sensor.grid(layers=4), steps=SCANS, trajectory=poses)
    hits = np.zeros(scene.triangles, np.int64)
    rays = np.zeros((0, 2, 3), np.float32)
    pictured = PictureContent(
        scene, sensor_positions(survey), hits, rays, duration_ns=survey.duration_ns
    )
    sweeps = Sweeps.from_survey(survey, scene)
    assert (len(sweeps), sweeps.scans[-1]) == (10, SCANS)
    return View(CloudFile(cloud, [WET]), pictured, sweeps, title="a spiral")

"""Small recordings for tests of augmentations: .pcd files of a sensor between walls."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsim import Pose, Scanner, Scene, load_sensor
from lidarsim.scene.scene_mesh import SceneMesh

HEIGHT_M = 1.9
_FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")]
_HEADER = (
    "VERSION 0.7\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
    "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
)


def street():
    """Return a floor and two walls. About half of the pulses have no return."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    floor = np.array([[-80, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0.0]])
    wall = np.array([[30, -40, 0], [30, 40, 0], [30, 40, 8], [30, -40, 8.0]])
    near = np.array([[-20, 6, 0], [10, 6, 0], [10, 6, 4], [-20, 6, 4.0]])
    meshes = zip(("floor", "wall", "near"), (floor, wall, near), strict=True)
    return Scene.from_meshes([SceneMesh(name, corners, faces) for name, corners in meshes])


def recorded_points(count, model="velodyne/vlp16"):
    """Return the points of sweeps as structured arrays with intensities from 0 to 255."""
    sensor = load_sensor(model, performance="datasheet")
    columns = ["range", "reflectivity", "channel"]
    scanner = Scanner(street(), sensor, columns=columns, coordinates="sensor")
    sweeps = []
    for number in range(count):
        cloud = scanner.sweep(Pose((0.1 * number, 0, HEIGHT_M)))
        rows = np.zeros(len(cloud), _FIELDS)
        for axis, values in zip("xyz", np.asarray(cloud.positions).T, strict=True):
            rows[axis] = values
        rows["intensity"] = cloud["reflectivity"]
        rows["ring"] = cloud["channel"]
        sweeps.append(rows)
    return sweeps


def write_pcd_drive(folder: Path, sweeps) -> Path:
    """Write each sweep to a .pcd file."""
    folder.mkdir(parents=True)
    for number, rows in enumerate(sweeps):
        header = _HEADER.format(count=len(rows)).encode()
        (folder / f"{number:06}.pcd").write_bytes(header + rows.tobytes())
    return folder

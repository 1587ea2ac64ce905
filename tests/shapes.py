"""Shapes that tests scan, a carrier that moves, and the points of scans."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh

from lidarsim import Beams, Optics, Pose, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.scene.colors import Colors
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

CPU = [name for name in ("numpy", "tiles") if not available_backends()[name]]
BALL = trimesh.creation.icosphere(4, 60.0)  # around the sensor: all rays hit
COLORS = Colors.from_face_colors(np.arange(3 * len(BALL.faces), dtype=np.uint8).reshape(-1, 3))
PLATE = SceneMesh("Sign", np.array([[20.0, 0, 0], [20, 1, 0], [20, 0, 1]]), np.array([[0, 1, 2]]))
BALL_AROUND = Scene.from_meshes(
    [SceneMesh("Ball", np.array(BALL.vertices), np.array(BALL.faces), colors=COLORS), PLATE]
)
DELAYS = 300.0 * np.arange(128)
SPIN_OF_128_BEAMS = Sensor(Beams(np.radians(np.linspace(-22, 22, 128)), time_ns=DELAYS), Spin(2048))
COLUMNS = ("ray", "range", "intensity", "reflectance", "return_number", "returns", "class")


def quad(name, *corners):
    """A quadrangle of two triangles, by its corners."""
    return SceneMesh(name, np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))


def wall(name, x, y=(-50, 50), z=(-50, 50)):
    """A rectangle across the x axis."""
    return quad(name, (x, y[0], z[0]), (x, y[1], z[0]), (x, y[1], z[1]), (x, y[0], z[1]))


def level(name, z=0, half=30, middle=(0, 0)):
    """A level square, whose front looks up."""
    (x, y), h = middle, half
    corners = (x - h, y - h, z), (x + h, y - h, z), (x + h, y + h, z), (x - h, y + h, z)
    return quad(name, *corners)


def solid(name, made, by=(0, 0, 0)):
    """A mesh of trimesh, moved."""
    return SceneMesh(name, np.array(made.vertices) + by, np.array(made.faces))


def box(name, low, high):
    """A box between two corners."""
    return solid(name, trimesh.creation.box(bounds=[low, high]))


def block(name, size, middle=(0, 0, 0)):
    """A box of a size around its middle."""
    return solid(name, trimesh.creation.box(size), middle)


def ball(name, radius, center=(0, 0, 0), fineness=4):
    return solid(name, trimesh.creation.icosphere(fineness, radius), center)


def room(offset=(0, 0, 0)):
    """A closed room of 10 by 8 by 6 meters around the offset, each side an object."""
    low = np.array([-5.0, -4.0, -3.0])
    high = np.array([5.0, 4.0, 3.0])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners = low + corners * (high - low) + offset
    quads = {
        "west": (0, 1, 3, 2),
        "east": (4, 6, 7, 5),
        "south": (0, 4, 5, 1),
        "north": (2, 3, 7, 6),
        "floor": (0, 2, 6, 4),
        "ceiling": (1, 5, 7, 3),
    }
    return Scene.from_meshes(
        SceneMesh(name, corners, np.array([[a, b, c], [a, c, d]]))
        for name, (a, b, c, d) in quads.items()
    )


def beam_along_x(rays=1, max_range_m=float("inf"), **optics):
    """A sensor that fires once, so many beams along x."""
    return Sensor(Beams(np.zeros(rays)), Spin(1, 360), 0, max_range_m, optics=Optics(**optics))


def made(survey, scene, backend="numpy"):
    """Columns of all points that a survey gives: {name: (n,)}."""
    batches = list(Rig(scene, survey, backend).cast(0, survey.scan_count))
    return {
        column.name: np.concatenate([column.make(batch) for batch in batches])
        for column in survey.stored_columns
    }


def cast(meshes, sensor=None, at=(0, 0, 0), backend="numpy", *, steps=1, **options):
    """Points of scans of some meshes from one place, by column, and their batch."""
    options = {"keep_every": 1, "columns": COLUMNS, **options}
    survey = Survey(sensor or beam_along_x(), poses=[at], steps=steps, **options)
    (batch,) = Rig(Scene.from_meshes(meshes), survey, backend).cast(0, steps)
    return {c.name: c.make(batch) for c in survey.stored_columns} | {"batch": batch}


@dataclass(frozen=True)
class Cart:
    """Drives along x while it turns about z, in lanes that lie side by side."""

    speed: float = 5.0  # meters a second
    yaw_rate_deg: float = 90.0  # a second
    stations: int = 2
    moves: bool = True
    duration_ns: float = np.inf
    height: float = 1.0

    def pose(self, station, time_ns=0.0):
        seconds = time_ns / 1e9
        return Pose(
            (self.speed * seconds, 10.0 * station, self.height), self.yaw_rate_deg * seconds
        )

    def poses(self, station, times_ns):
        poses = [self.pose(station, time) for time in times_ns]
        rotations = [np.eye(3) if p.rotation is None else p.rotation for p in poses]
        return np.array([p.position for p in poses]), np.array(rotations)


def cast_between(rig, survey, cuts):
    """Columns as bytes, and {counter: hits}, of scans that are cast from cut to cut."""
    batches = [batch for span in itertools.pairwise(cuts) for batch in rig.cast(*span)]
    columns = {
        column.name: np.concatenate([batch.column(column) for batch in batches]).tobytes()
        for column in survey.stored_columns
    }
    return columns, tally_of(batches).tolist()


def tally_of(batches):
    """Hits of each triangle in all of these batches."""
    tally = np.zeros(batches[0].scene.counters, np.int64)
    for batch in batches:
        triangles, hits = batch.tally
        tally[triangles] += hits
    return tally

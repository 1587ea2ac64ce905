"""A twin of a simulated drive past everything that is difficult, compared with the true scene.

The street has a hedge, a fence, a house with windows, posts and two moving cars.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.shapes import wall
from tests.simulated_drives import simulated_drive

from lidarreal import twin
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Actor, Material, Mounted, Pose, Scene, SceneMesh, Sensor, Survey, Track, box

pytest.importorskip("scipy")
pytestmark = pytest.mark.extended

SWEEPS = 16
END_S = 0.1 * SWEEPS + 0.2
HEDGE_Y, FENCE_Y, HOUSE_Y = 5.0, -4.0, 8.0
HEDGE_GAPS, FENCE_GAPS = 0.4, 0.6
WINDOWS_X = (-6.0, 8.0)
CARS = {"ahead": (-2.0, 6.0, 1.5), "oncoming": (16.0, -8.0, 3.0)}  # x, speed along x, y
CAR = (4.2, 1.8, 1.5)


def upright(name, x, y, z):
    """A rectangle along x, given the intervals in x and z."""
    corners = [(a, y, b) for a, b in ((x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1]))]
    return SceneMesh(name, np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))


def standing_box(name, size, position):
    mesh = box(name, size)
    return SceneMesh(name, mesh.vertices + np.array([*position, 0.0]), mesh.faces)


@pytest.fixture(scope="module")
def street():
    ground = np.array([[-40, -10, 0], [40, -10, 0], [40, 10, 0], [-40, 10, 0]], float)
    scene = Scene.from_meshes(
        [
            SceneMesh("ground", ground, np.array([[0, 1, 2], [0, 2, 3]])),
            upright("hedge", (-10, 0), HEDGE_Y, (0, 2)),
            upright("fence", (-12, 14), FENCE_Y, (0, 1.6)),
            upright("house", (-40, 40), HOUSE_Y, (0, 6)),
            *(upright(f"window {x}", (x, x + 3), HOUSE_Y - 0.05, (2.6, 4.4)) for x in WINDOWS_X),
            upright("house opposite", (-40, 40), -9.0, (0, 6)),
            wall("end", 40, (-10, 10), (0, 6)),
            *(standing_box(f"post {x}", (0.3, 0.3, 3.0), (x, -3.0)) for x in (-9.0, 0.0, 9.0)),
            *(standing_box(f"shed {x}", (1.5, 1.5, 2.4), (x, 6.5)) for x in (4.0, 14.0)),
        ]
    )
    return scene.with_actors(
        Actor(box(name, CAR), Track([0, END_S], [[x, y, 0], [x + speed * END_S, y, 0]]))
        for name, (x, speed, y) in CARS.items()
    )


@pytest.fixture(scope="module")
def recorded(street):
    survey = Survey(
        sensors=[Mounted(Sensor.grid(480, 28, vertical_fov_deg=50), Pose((0, 0, 1.8)))],
        trajectory=Track([0, END_S], [[-4, 0, 0], [4 * END_S - 4, 0, 0]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity"],
        materials=[
            Material("hedge", 0.4, gap_fraction=HEDGE_GAPS, range_spread_m=0.05),
            Material("fence", 0.4, gap_fraction=FENCE_GAPS),
            Material("window*", 0.0),
            Material("*", 0.5),
        ],
        precision_m=1e-3,
    )
    return simulated_drive(street, survey)


@pytest.fixture(scope="module")
def found(recorded):
    return twin(recorded)


def in_box(points, *bounds):
    """Mask of the points whose x, y and z are in the given intervals."""
    low, high = np.array(bounds, float).T
    return ((points >= low) & (points <= high)).all(axis=1)


def counts(points):
    """Number of points on the parts of the scene, and behind its gaps."""
    z = points[:, 2]
    height_behind = 1.8 + 0.2 * 9.0 / -FENCE_Y  # of rays that pass the upper edge of the fence
    return {
        "hedge": int(in_box(points, (-9, -1), (HEDGE_Y - 0.3, HEDGE_Y + 0.3), (0.2, 1.9)).sum()),
        "fence": int(in_box(points, (-8, 8), (FENCE_Y - 0.3, FENCE_Y + 0.3), (0.2, 1.5)).sum()),
        "behind the fence": int(
            in_box(points, (-8, 8), (-9.3, -8.7), (0.2, 1.8 - height_behind / 8)).sum()
        ),
        "posts": int(in_box(points, (-9.4, 9.4), (-3.3, -2.7), (0.2, 3)).sum()),
        "walls": int((in_box(points, (-15, 15), (7.7, 8.3), (0.2, 6)) & (z < 2.4)).sum()),
        "windows": sum(
            int(in_box(points, (left + 0.3, left + 2.7), (7.7, 8.3), (2.9, 4.1)).sum())
            for left in WINDOWS_X
        ),
    }


def test_held_out_sweeps_of_the_street(found):
    held = found.figures["held_out"]
    assert held["stationary"]["median_abs_difference_m"] < 0.003
    assert held["stationary"]["no_surface"] < 0.01
    assert held["stationary"]["rank_correlation"] > 0.75
    assert held["points"] == pytest.approx(1, abs=0.03)
    assert held["no_return"]["f1"] > 0.5
    assert held["moving"]["median_abs_difference_m"] < 0.006
    assert held["moving"]["no_surface"] < 0.02
    assert held["moving"]["ghosts"] < 0.004


def test_both_cars_are_actors_on_their_paths(found):
    cars = {actor["length_m"]: actor for actor in found.figures["actors"]}
    lengths_m = [abs(speed) * 0.1 * SWEEPS for _, speed, _ in CARS.values()]
    assert sorted(cars) == pytest.approx(sorted(lengths_m), abs=0.3)
    for actor in cars.values():
        assert actor["size_m"] == pytest.approx(CAR, abs=0.15)


def test_each_part_of_the_street_has_as_many_points_as_recorded(found, recorded, tmp_path):
    found.save(tmp_path)
    job = prepare(Scenario.load(tmp_path / "scenario.yaml"))
    simulated = counts(simulated_drive(job.scene, job.survey).positions)
    expected = counts(recorded.positions)
    assert min(expected[name] for name in expected.keys() - {"windows"}) > 1000
    for name in ("hedge", "behind the fence", "walls"):
        assert simulated[name] == pytest.approx(expected[name], rel=0.12), name
    assert simulated["fence"] == pytest.approx(expected["fence"], rel=0.15)
    assert simulated["posts"] == pytest.approx(expected["posts"], rel=0.15)
    assert expected["windows"] == 0 and simulated["windows"] < 50

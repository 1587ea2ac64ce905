"""Gaps of hedges and fences in reconstructed scenes."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from tests.shapes import wall
from tests.simulated_drives import simulated_drive, simulated_points

from lidarreal import twin
from lidarreal.reconstruction.porosity import Crossings, Porosity
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Material, Mounted, Pose, Scene, SceneMesh, Sensor, Survey, Track

pytest.importorskip("scipy")

SWEEPS = 12
GAPS = 0.4
SPREAD_M = 0.05
REFLECTANCE_SPREAD = 0.4
HEDGE_Y = 5.0
HOUSE_Y = 9.0


def test_gap_fractions_are_the_share_of_the_rays_that_pass():
    """40 rays meet two surfels: 10 end on the first, 24 on the second, and 6 pass through both."""
    surfel = np.tile(np.array([[0, 1, -1]], np.int32), (40, 1))
    distance_m = np.tile([[5.0, 8.0, np.inf]], (40, 1))
    range_m = np.repeat([5.02, 7.98, 12.0], [10, 24, 6])
    cell = np.zeros(surfel.shape, np.uint8)
    crossings = Crossings(surfel, distance_m, cell, range_m)
    opaque = np.zeros(2, bool)
    centers = np.array([[5.0, 0, 0], [8.0, 0, 0]])
    porosity = Porosity.from_crossings([crossings], centers, opaque, 0.15)
    assert porosity.gap_fraction == pytest.approx([0.6, 0.2])  # 30/40 and 6/30, rounded
    assert porosity.range_spread_m == pytest.approx([0, 0])
    layers = porosity.likely_crossings(crossings, opaque)
    assert (layers == 1).all(), "most rays return from the second surfel"
    layers = porosity.likely_crossings(crossings, np.array([True, False]))
    assert (layers == 0).all(), "nothing is visible behind a dark surfel"


@pytest.mark.parametrize("passing", [0, 24, 45])
def test_few_rays_have_the_gaps_of_the_surfels_around(passing):
    """A surfel with two rays gets the gaps of its eight neighbors, which have 60 rays each."""
    places, many = 20, 8
    surfel = np.repeat(np.arange(places * many, dtype=np.int32), 60)
    surfel = np.append(surfel, np.repeat(np.arange(places, dtype=np.int32), 2) + places * many)
    ranges = np.tile(np.repeat([5.0, 12.0], [60 - passing, passing]), places * many)
    range_m = np.append(ranges, np.full(2 * places, 5.0))
    shape = (len(surfel), 1)
    crossings = Crossings(surfel[:, None], np.full(shape, 5.0), np.zeros(shape, np.uint8), range_m)
    y = np.add.outer(10.0 * np.arange(places), 0.1 * np.arange(many + 1))
    y = np.append(y[:, :many].ravel(), y[:, many])
    centers = np.column_stack([np.full(len(y), 5.0), y, 0 * y])
    dark = np.zeros(len(y), bool)
    found = Porosity.from_crossings([crossings], centers, dark, 0.15).gap_fraction
    # The gaps of all surfels in a place, and 0.2 of 2.2 rays in addition, count as 2.2 rays.
    nearby = (many * passing + 0.2) / (many * 60 + 2 + 2.2)
    expected = (passing + 2.2 * nearby) / (60 + 2.2)
    assert found[:-places].mean() == pytest.approx(expected, abs=0.005)
    assert found[-places:].mean() == pytest.approx(2.2 * nearby / (2 + 2.2), abs=0.01)
    dark[[3, -1]] = True
    found = Porosity.from_crossings([crossings], centers, dark, 0.15).gap_fraction
    assert not found[[3, -1]].any()


def upright(name, y, height):
    """A wall along x."""
    corners = [(x, y, z) for x, z in ((-40, 0), (40, 0), (40, height), (-40, height))]
    return SceneMesh(name, np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))


def ground():
    corners = np.array([[-40, -12, 0], [40, -12, 0], [40, 12, 0], [-40, 12, 0]], float)
    return SceneMesh("ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.fixture(scope="module")
def recorded():
    """A drive along a hedge with a house behind it."""
    scene = Scene.from_meshes(
        [
            ground(),
            upright("hedge", HEDGE_Y, 2.0),
            upright("house", HOUSE_Y, 6.0),
            upright("house opposite", -7.0, 6.0),
            wall("end", 40, (-12, 12), (0, 6)),
            *(wall(f"side {x}", x, (-7, -6), (0, 3)) for x in range(-30, 31, 10)),
        ]
    )
    end_s = 0.1 * SWEEPS + 0.2
    survey = Survey(
        sensors=[Mounted(Sensor.grid(400, 24, vertical_fov_deg=40), Pose((0, 0, 1.8)))],
        trajectory=Track([0, end_s], [[-4, 0, 0], [4 * end_s - 4, 0, 0]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity"],
        materials=[
            Material(
                "hedge",
                0.5,
                gap_fraction=GAPS,
                range_spread_m=SPREAD_M,
                reflectance_spread=REFLECTANCE_SPREAD,
            ),
            Material("*", 0.5),
        ],
        precision_m=1e-3,
    )
    return simulated_drive(scene, survey)


def shares(world):
    """Shares of the points on the hedge, on the house behind it, and spread on the hedge."""
    x, y, z = world.T
    # Rays to the house below this height pass through the hedge.
    behind = 1.8 + (2.0 - 1.8) * HOUSE_Y / HEDGE_Y - 0.1
    along = np.abs(x) < 10
    hedge = along & (np.abs(y - HEDGE_Y) < 0.3) & (z > 0.3) & (z < 1.9)
    house = along & (np.abs(y - HOUSE_Y) < 0.3) & (z > 0.3) & (z < behind)
    return house.sum() / hedge.sum(), float(y[hedge].std())


def contrast(cloud, wall_y):
    """Relative standard deviation of the reflectances of a wall along x."""
    x, y, z = cloud.positions.T
    on_wall = (np.abs(x) < 10) & (np.abs(y - wall_y) < 0.3) & (z > 0.3) & (z < 1.9)
    sensor_x = 4e-9 * cloud.columns["time"] - 4
    range_m = np.sqrt((x - sensor_x) ** 2 + y**2 + (z - 1.8) ** 2)
    # Energies decrease with the square of the range, and with the cosine y / range_m.
    brightness = (cloud.columns["intensity"] * range_m**3)[on_wall]
    return float(brightness.std() / brightness.mean())


@pytest.mark.extended
def test_hedges_have_the_gaps_and_depths_of_the_recording(recorded, tmp_path):
    place = twin(recorded)
    place.save(tmp_path)
    scenario = yaml.safe_load((tmp_path / "scenario.yaml").read_text())
    fractions = {entry.get("gap_fraction", 0) for entry in scenario["materials"]}
    assert {0, 0.4} <= fractions
    job = prepare(Scenario.load(tmp_path / "scenario.yaml"))
    simulated = simulated_points(job.scene, job.survey)
    recorded_share, recorded_spread_m = shares(recorded.positions)
    share, spread_m = shares(simulated.positions)
    assert recorded_share > 0.2
    assert share == pytest.approx(recorded_share, rel=0.15)
    assert spread_m == pytest.approx(recorded_spread_m, rel=0.3)
    assert contrast(recorded, HEDGE_Y) == pytest.approx(REFLECTANCE_SPREAD, rel=0.1)
    assert contrast(simulated, HEDGE_Y) == pytest.approx(REFLECTANCE_SPREAD, rel=0.2)
    assert contrast(simulated, -7.0) == pytest.approx(contrast(recorded, -7.0), abs=0.05)
    opposite = (np.abs(recorded.positions[:, 1] + 7) < 0.3).mean()
    assert (np.abs(simulated.positions[:, 1] + 7) < 0.3).mean() == pytest.approx(opposite, rel=0.03)

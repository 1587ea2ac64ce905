"""Outlines of poles and hedges in reconstructed scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.shapes import wall
from tests.simulated_drives import simulated_points

from lidarreal import twin
from lidarreal.reconstruction.outlines import Extents, crossed_cells
from lidarreal.reconstruction.porosity import Crossings
from lidarreal.reconstruction.surfels import Surfels, surfel_mesh
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Mounted, Noise, Pose, Returns, Scene, SceneMesh, Survey, Track, load_sensor
from lidarsim.sweeps.sweeps import Sweeps

pytest.importorskip("scipy")

SWEEPS = 12
POLE_Y = 5.0
HOUSE_Y = 12.0
POLES = {-1.5: 0.2, 1.5: 0.4}  # diameters in meters by position along the drive
HEIGHT_M = 3.0


def square():
    """A surfel of 1 m × 1 m in the plane y = 0."""
    corners = [(-0.5, 0, -0.5), (0.5, 0, -0.5), (0.5, 0, 0.5), (-0.5, 0, 0.5)]
    return Surfels(surfel_mesh("square", np.array([corners], float)), np.zeros(1, bool))


def crossings(surfels, is_end):
    """Rays that cross the surfel on a grid and end there, or 1 m behind it.

    `is_end` is called with x and z.
    """
    step = (np.arange(40) + 0.5) / 40 - 0.5
    x, z = (part.ravel() for part in np.meshgrid(step, step))
    points = np.column_stack([x, np.zeros(len(x)), z])
    surfel = np.zeros(len(x), np.int64)
    cell = crossed_cells(surfels, surfel, points)
    ends = is_end(x, z)
    return Crossings(
        surfel[:, None].astype(np.int32),
        np.full((len(x), 1), 5.0, np.float32),
        cell[:, None],
        np.where(ends, 5.0, 6.0),
    )


def test_surfels_are_trimmed_to_the_rays_that_end_on_them():
    surfels = square()
    rays = crossings(surfels, lambda x, z: (np.abs(x) < 0.125) & (z < 0.25))
    extents = Extents.from_crossings([rays], np.zeros(1, bool), 0.15)
    corners = extents.trim(surfels, np.zeros(1)).mesh.vertices
    assert corners.min(axis=0) == pytest.approx([-0.125, 0, -0.5])
    assert corners.max(axis=0) == pytest.approx([0.125, 0, 0.25])
    kept = extents.crossings(rays)
    assert kept.present.sum() == 300, "only the rays that end on the surfel still cross it"
    assert (kept.range_m[kept.present[:, 0]] == 5).all()
    narrower = extents.trim(surfels, np.full(1, 0.02)).mesh.vertices
    assert narrower.min(axis=0) == pytest.approx([-0.105, 0, -0.5]), "only cuts move inward"
    assert narrower.max(axis=0) == pytest.approx([0.105, 0, 0.23])


def test_cuts_are_in_the_middle_of_cells_without_rays():
    surfels = square()
    rays = crossings(surfels, lambda x, z: x < 0)
    x = np.tile((np.arange(40) + 0.5) / 40 - 0.5, 40)
    observed = Crossings(*(part[np.abs(x) > 0.25] for part in rays))
    extents = Extents.from_crossings([observed], np.zeros(1, bool), 0.15)
    assert extents.stop.tolist() == [[4, 8]]


def test_hedges_are_not_trimmed():
    surfels = square()
    random = np.random.default_rng(0)
    rays = crossings(surfels, lambda x, z: random.random(len(x)) < 0.5)
    extents = Extents.from_crossings([rays], np.zeros(1, bool), 0.15)
    assert extents.start.tolist() == [[0, 0]]
    assert extents.stop.tolist() == [[8, 8]]
    assert extents.crossings(rays).present.all()


def test_lost_pulses_pass_through_surfels_but_dark_surfels_are_not_trimmed():
    surfels = square()
    rays = crossings(surfels, lambda x, z: x < 0)
    ends = rays.range_m < 5.5
    returned = Crossings(*(part[ends] for part in rays))
    lost = Crossings(*(part[~ends] for part in rays)).as_lost()
    extents = Extents.from_crossings([returned, lost], np.zeros(1, bool), 0.15)
    assert extents.stop.tolist() == [[4, 8]]
    extents = Extents.from_crossings([returned, lost], np.ones(1, bool), 0.15)
    assert extents.stop.tolist() == [[8, 8]]


def pole(x, diameter):
    """An upright cylinder."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.column_stack(
        [x + diameter / 2 * np.cos(angle), POLE_Y + diameter / 2 * np.sin(angle)]
    )
    vertices = np.concatenate(
        [np.column_stack([circle, np.full(len(circle), z)]) for z in (0.0, HEIGHT_M)]
    )
    first = np.arange(24)
    second = (first + 1) % 24
    faces = np.concatenate(
        [
            np.column_stack([first, second, second + 24]),
            np.column_stack([first, second + 24, first + 24]),
        ]
    )
    return SceneMesh(f"pole {x}", vertices, faces)


def street():
    corners = np.array([[-40, -12, 0], [40, -12, 0], [40, 14, 0], [-40, 14, 0]], float)
    house = [(x, HOUSE_Y, z) for x, z in ((-40, 0), (40, 0), (40, 6), (-40, 6))]
    opposite = [(x, -7.0, z) for x, z in ((-40, 0), (40, 0), (40, 6), (-40, 6))]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Scene.from_meshes(
        [
            SceneMesh("ground", corners, faces),
            SceneMesh("house", np.array(house), faces),
            SceneMesh("house opposite", np.array(opposite), faces),
            wall("end", 40, (-12, 14), (0, 6)),
            *(wall(f"side {x}", x, (-7, -6), (0, 3)) for x in range(-30, 31, 10)),
            *(pole(x, diameter) for x, diameter in POLES.items()),
        ]
    )


def write_model(path, divergence_mrad):
    model = {
        "name": "Test sensor",
        "firings_per_turn": 1000,
        "rate_hz": 10,
        "range_m": [0.5, 100],
        "beams": {"elevation_deg": np.linspace(-20, 8, 24).round(3).tolist()},
        "performance": {"range_m": 0.005},
    }
    if divergence_mrad:
        model["optics"] = {"divergence_mrad": divergence_mrad}
    path.write_text(yaml.safe_dump(model))
    return path


def on_poles(world):
    """Numbers of the points on the poles and in their surroundings."""
    x, y, z = world.T
    near = (np.abs(y - POLE_Y) < 0.6) & (z > 0.4) & (z < 2.4)
    return np.array([(near & (np.abs(x - at) < 0.6)).sum() for at in POLES])


@pytest.mark.slow
@pytest.mark.parametrize(("divergence_mrad", "tolerance"), [(None, 0.06), (6.0, 0.2)])
def test_poles_keep_their_width_with_and_without_beam_width(divergence_mrad, tolerance, tmp_path):
    model = write_model(tmp_path / "sensor.yaml", divergence_mrad)
    scene = street()
    end_s = 0.1 * SWEEPS + 0.2
    survey = Survey(
        sensors=[Mounted(load_sensor(model), Pose((0, 0, 1.8)))],
        trajectory=Track([0, end_s], [[-4, 0, 0], [5 * end_s - 4, 0, 0]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity", "ray"],
        noise=Noise(range_m=0.005),
        returns=Returns(subrays=7) if divergence_mrad else None,
        precision_m=1e-3,
    )
    recorded = simulated_points(scene, survey)
    sweeps = Sweeps.from_survey(survey, scene)
    place = twin(replace(recorded, sweeps=lambda: sweeps), model=model, actors="none")
    place.save(tmp_path / "twin")
    job = prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))
    assert job.survey.sensors[0].returns.subrays == (7 if divergence_mrad else 1)
    widths = on_poles(simulated_points(job.scene, job.survey).positions) / on_poles(
        recorded.positions
    )
    assert widths == pytest.approx(1, abs=tolerance)

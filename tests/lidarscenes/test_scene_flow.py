"""Scene flow: closed forms, deforming meshes, points without flow, and frames of files."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.shapes import block, level, made, wall

from lidarscenes.robots.robot import Hinge, LinkPath
from lidarsim import (
    Actor,
    LidarError,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    SceneInstance,
    Sensor,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.columns.table import FLOW, FLOW_EGO, SCAN
from lidarsim.motion.rotations import quaternions_of, rotations_of
from lidarsim.motion.trajectory import full_poses
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.survey.faults import Fault
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("time", "range", *FLOW, *FLOW_EGO)
PERIOD_S = 0.1
SENSOR = Sensor.grid(360, 12, 30.0, step_deg=90)  # four scans per revolution at 10 Hz
PERSON = Path(__file__).parents[2] / "examples" / "pedestrian.glb"


def survey_of(sensor=SENSOR, steps=12, **options):
    return Survey(sensor, steps=steps, precision_m=1e-6, columns=COLUMNS, **options)


def vectors(columns, names):
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)


def points_of(columns, survey):
    return vectors(columns, "xyz") * survey.precision_m


def cloud_of(scene, survey):
    """The cloud of a survey, and its sweeps."""
    part = columns_of(list(Rig(scene, survey, "numpy").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    return replace(cloud, sweeps=lambda: sweeps)


def straight(start, velocity, seconds=1.0, **options):
    ends = [start, np.add(start, np.multiply(velocity, seconds))]
    return Track([0, seconds], ends, [[0, 0, 0, 1]] * 2, **options)


def turning(radius, rate, seconds=1.0):
    """A circle about the z axis, with axes that turn along."""
    times = np.linspace(0, seconds, 2001)
    angle = rate * times
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    turns = np.stack([np.degrees(angle), 0 * angle, 0 * angle], axis=1)
    return Track(times, places, quaternions_of(rotations_of(turns)))


def test_a_car_passes_a_moving_sensor():
    # The car drives north at 10 m/s, the sensor east at 3 m/s.
    car = Actor(box("Car", (2.0, 4.5, 1.5)), straight((8, -4, -1), (0, 10, 0)))
    scene = Scene.from_meshes([level("Ground", -1)]).with_actors([car])
    survey = survey_of(trajectory=straight((0, 0, 0), (3, 0, 0)))
    found = made(survey, scene)
    on_car = found["object"] == 1
    last = found["time"] >= 2e8
    assert (on_car & ~last).sum() > 30 and (~on_car & ~last).sum() > 300
    expected = np.where(on_car[:, None], [0.0, 10 * PERIOD_S, 0], 0.0)
    expected[last] = np.nan
    np.testing.assert_allclose(vectors(found, FLOW_EGO), expected, atol=1e-7)
    np.testing.assert_allclose(vectors(found, FLOW), expected - [3 * PERIOD_S, 0, 0], atol=1e-7)


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_everything_turns(coordinates):
    # A turntable, a sensor that drives in a circle, and a room.
    table = Actor(block("Table", (3, 2, 1.5), (5, 0, 0)), turning(0.0, 2.0))
    scene = Scene.from_meshes([block("Room", (40, 40, 12))]).with_actors([table])
    path = turning(9.0, 1.5)
    mount = Pose((0.5, 0.2, 0.3), 30.0, 8.0)
    survey = Survey(
        sensors=[Mounted(SENSOR, mount)], trajectory=path, steps=12, precision_m=1e-6,
        columns=COLUMNS, coordinates=coordinates,
    )  # fmt: skip
    found = made(survey, scene)
    points = points_of(found, survey)
    times = found["time"] / 1e9

    def sensor_at(seconds):
        positions, rotations = full_poses(path, 0, np.minimum(seconds, 0.99) * 1e9)
        return positions + rotations @ mount.position, rotations @ mount.rotation_matrix

    place, turn = sensor_at(times)
    if coordinates == "sensor":
        points = np.einsum("nij,nj->ni", turn, points) + place
    # Each point on the table turns by 0.2 rad until the next sweep.
    about = rotations_of(np.array([np.degrees(2.0 * PERIOD_S), 0, 0]))
    on_table = found["object"] == 1
    assert on_table.sum() > 50
    later = np.where(on_table[:, None], points @ about.T, points)
    if coordinates == "sensor":
        first = (place, turn)
        second = sensor_at(times + PERIOD_S)
    else:
        sweep = np.floor(times / PERIOD_S)
        first = sensor_at(sweep * PERIOD_S)
        second = sensor_at((sweep + 1) * PERIOD_S)

    def inside(frame, positions):
        return np.einsum("nji,nj->ni", frame[1], positions - frame[0])

    relative = inside(second, later) - inside(first, points)
    in_world = later - points
    if coordinates == "world":
        relative = np.einsum("nij,nj->ni", first[1], relative)
    else:
        in_world = np.einsum("nji,nj->ni", turn, in_world)
    known = times < 0.2
    assert known.sum() > 1000
    np.testing.assert_allclose(vectors(found, FLOW)[known], relative[known], atol=3e-6)
    np.testing.assert_allclose(vectors(found, FLOW_EGO)[known], in_world[known], atol=3e-6)
    assert np.isnan(vectors(found, FLOW)[~known]).all()
    assert np.abs(relative[known]).max() > 1


def test_points_on_a_walking_person_keep_their_place_in_their_triangles():
    mesh = join_meshes("Walker", load_objects(PERSON, animation="Walk").static)
    mesh = replace(mesh, animation=replace(mesh.animation, speed_m_s=1.4))
    walker = Actor(mesh, straight((3, -0.5, -1), (0, 1.4, 0)))
    scene = Scene.from_meshes([level("Ground", -1)]).with_actors([walker])
    sensor = Sensor.grid(720, 40, 40.0, step_deg=90)
    survey = replace(survey_of(sensor, poses=[(0, 0, 0)], steps=8), columns=(*COLUMNS, "triangle"))
    found = made(survey, scene)
    rows = np.flatnonzero((found["object"] == 1) & (found["time"] < 1e8))
    assert len(rows) > 150
    flow = vectors(found, FLOW_EGO)
    points = points_of(found, survey)
    faces = mesh.faces[found["triangle"] - len(scene.faces)]
    for row in rows[::5]:
        time_ns = float(found["time"][row])
        before, after = (walker.mesh_at(at).vertices[faces[row]] for at in (time_ns, time_ns + 1e8))
        weights = np.linalg.lstsq(
            np.vstack([before.T, np.ones(3)]), np.append(points[row], 1.0), rcond=None
        )[0]
        np.testing.assert_allclose(flow[row], weights @ after - points[row], atol=2e-5)
    # The person walks sideways by 0.14 m, and the limbs swing across.
    assert np.ptp(flow[rows, 0]) > 0.25
    assert 0.13 < np.median(flow[rows, 1]) < 0.15


def test_links_of_a_robot_and_instances():
    before = np.eye(4)
    before[:3, 3] = 0.3, 0, 0
    hinge = Hinge(before, np.array([0.0, 0, 1]), False, np.array([0.0, 2.0]))
    link = LinkPath(straight((4, 0, 0), (1, 0, 0)), (hinge,), np.eye(4), np.arange(2.0), 0.0)
    arm = Actor(block("Arm", (2.0, 0.3, 1.0), (1.2, 0, 0)), link)
    shelf = SceneInstance(block("Part", (1, 4, 2)), Pose((-6, 0, 0)), "Shelf")
    scene = Scene.from_meshes([shelf]).with_actors([arm])
    survey = survey_of(poses=[(0, 0, 0)], steps=8)
    found = made(survey, scene)
    flow = vectors(found, FLOW_EGO)
    known = found["time"] < 1e8
    still = (found["object"] == 0) & known
    assert still.sum() > 20 and not flow[still].any()
    on_arm = (found["object"] == 1) & known
    assert on_arm.sum() > 10
    points = points_of(found, survey)[on_arm]
    times = found["time"][on_arm] / 1e9
    pivot = np.stack([4.3 + times, 0 * times, 0 * times], axis=1)
    about = rotations_of(np.array([np.degrees(2.0 * PERIOD_S), 0, 0]))
    later = (points - pivot) @ about.T + pivot + [PERIOD_S, 0, 0]
    np.testing.assert_allclose(flow[on_arm], later - points, atol=3e-6)


def test_returns_without_a_surface_or_a_next_sweep_have_no_flow():
    # An actor leaves at 0.25 s, rain returns light, and a mirror shows ghosts.
    leaving = straight((6, -1, 0), (0, 4, 0), 0.25, beyond="absent")
    car = Actor(block("Car", (1, 4, 2)), leaving)
    scene = Scene.from_meshes([level("Ground", -2), wall("Mirror", -8)]).with_actors([car])
    survey = replace(
        survey_of(poses=[(0, 0, 0)], steps=16), rain_mm_h=60.0, noise=Noise(detection_range_m=60),
        returns=Returns("all", subrays=7, divergence_mrad=3), columns=(*COLUMNS, "cause"),
        materials=[Material("Mirror", 0.2, specular_reflectance=0.6), Material("*")],
    )  # fmt: skip
    found = made(survey, scene)
    flow = vectors(found, FLOW_EGO)
    finite = np.isfinite(flow).all(axis=1)
    assert (finite == np.isfinite(flow).any(axis=1)).all()
    seconds = found["time"] / 1e9
    on_surface = found["cause"] == 0
    assert {*found["cause"].tolist()} >= {0, 1, 5}
    on_car = found["object"] == 2
    expected = on_surface & (seconds < 0.3) & ~(on_car & (seconds > 0.15))
    np.testing.assert_array_equal(finite, expected)
    np.testing.assert_allclose(flow[on_car & expected], [[0, 0.4, 0]] * (on_car & expected).sum(),
                               atol=1e-6)  # fmt: skip
    assert (on_car & ~expected & (seconds < 0.25)).sum() > 5


def test_the_longer_of_two_complete_sweeps_has_flow_to_its_end():
    sensor = load_sensor("velodyne/vlp16")
    firings = [len(sensor.firings_of_revolution(number)) for number in range(3)]
    assert len({*firings}) == 2
    steps = sensor.steps_of_revolution(2).stop
    cloud = cloud_of(
        Scene.from_meshes([block("Room", (40, 40, 12))]),
        survey_of(sensor, steps, poses=[(0, 0, 0)]),
    )
    finite = [np.isfinite(points["flow_x"]).mean() for points in cloud.sweeps().points(cloud)]
    assert finite == [1, 1, 0]


def test_a_frozen_sensor_has_no_flow():
    scene = Scene.from_meshes([level("Ground", -2)])
    fault = Fault("frozen", from_s=0.15, to_s=0.25)
    survey = replace(survey_of(poses=[(0, 0, 0)], steps=16), faults=[fault])
    cloud = cloud_of(scene, survey)
    sweeps = [np.isfinite(points["flow_x"]).mean() for points in cloud.sweeps().points(cloud)]
    assert sweeps == [1, 1, 0, 0]


def test_flow_does_not_depend_on_batches_or_backends():
    table = Actor(block("Table", (3, 2, 1.5), (5, 0, 0)), turning(0.0, 2.0))
    scene = Scene.from_meshes([block("Room", (40, 40, 12))]).with_actors([table])
    survey = survey_of(trajectory=turning(9.0, 1.5), sensor=load_sensor("velodyne/vlp16"),
                       steps=72)  # fmt: skip
    whole = made(survey, scene)
    rig = Rig(scene, survey, "tiles")
    cuts = [0, 1, 30, 41, 72]
    batches = [batch for span in itertools.pairwise(cuts) for batch in rig.cast(*span)]
    for column in survey.stored_columns:
        parts = np.concatenate([batch.column(column) for batch in batches])
        assert parts.tobytes() == whole[column.name].tobytes(), column.name


def test_two_stations_and_two_sensors():
    scene = Scene.from_meshes([level("Ground", -2)])
    sensors = [Mounted(SENSOR, name="one"), Mounted(SENSOR, Pose((1, 0, 0)), name="two")]
    survey = Survey(
        sensors=sensors, poses=[(0, 0, 0), (5, 0, 0)], steps=8, columns=COLUMNS, precision_m=1e-6
    )
    cloud = cloud_of(scene, survey)
    finite = [np.isfinite(points["flow_x"]).mean() for points in cloud.sweeps().points(cloud)]
    assert finite == [1, 0] * 4


def test_a_scanner_does_not_know_its_next_sweep():
    with pytest.raises(LidarError, match="'flow_x' depends on the next sweep"):
        Scanner(Scene.from_meshes([level("Ground")]), SENSOR, columns=FLOW)


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
@pytest.mark.parametrize("at_start", [False, True])
def test_flow_leads_from_a_sweep_to_the_next_in_all_frames(coordinates, at_start):
    # A closed form for each frame: the same point of the surface in both sweeps.
    path = turning(9.0, 1.5)
    spin = turning(0.0, 2.0)
    table = Actor(block("Table", (3, 2, 1.5), (5, 0, 0)), spin)
    scene = Scene.from_meshes([block("Room", (40, 40, 12))]).with_actors([table])
    survey = survey_of(trajectory=path, steps=12, coordinates=coordinates)
    cloud = cloud_of(scene, survey)
    sweeps = replace(cloud.sweeps(), actors_at_start=at_start)
    points = next(iter(sweeps.points(cloud)))
    seconds = points["time"] / 1e9
    on_table = points["object"] == 1
    assert on_table.sum() > 20

    def to_world(frame, positions):
        place, turn = full_poses(path, 0, frame * 1e9)
        return np.einsum("nij,nj->ni", turn, positions) + place

    def advanced(positions, by_s):
        about = rotations_of(np.stack([np.degrees(2.0 * by_s), 0 * by_s, 0 * by_s], axis=1))
        turned = np.einsum("nij,nj->ni", about, positions)
        return np.where(on_table[:, None], turned, positions)

    zero = np.zeros(len(points))
    frames = {
        "compensated": (sweeps.compensate_motion, sweeps.columns_compensated, zero),
        "as fired": (sweeps.as_fired, sweeps.columns_as_fired, seconds),
    }
    for name, (positions_in, columns_in, frame) in frames.items():
        start = positions_in(0, points)
        columns = columns_in(0, points)
        end = start + vectors(columns, FLOW)
        expected = advanced(to_world(frame, start), zero + PERIOD_S)
        np.testing.assert_allclose(
            to_world(frame + PERIOD_S, end), expected, atol=2e-4, err_msg=name
        )
        ego = start + vectors(columns, FLOW_EGO)
        np.testing.assert_allclose(to_world(frame, ego), expected, atol=2e-4, err_msg=name)

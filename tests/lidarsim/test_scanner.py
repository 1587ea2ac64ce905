"""A scanner gives what a survey gives, sweep by sweep, and images of ranges."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import cloudpickle
import numpy as np
import pytest
from tests.shapes import level

from lidarsim import (
    Actor,
    Beams,
    Cloud,
    Column,
    LidarError,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.columns.table import OPTIONAL, SCAN
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator import rig as rig_module
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = [column.name for column in OPTIONAL if not column.name.startswith("flow")]
VLP16 = load_sensor("velodyne/vlp16")
FEW = Sensor.grid(300, layers=4)
GRID = Sensor.grid(rays_per_revolution=120, layers=8, step_deg=30, max_range_m=40)
DRIVE = Track([0, 0.5], [[-3, 0.1, 1.2], [3, 0.4, 1.2]])
BEND = Track([0, 1], [[0, 0, 1], [5, 0, 1]], [[0, 0, 0, 1], [0, 0, np.sin(0.5), np.cos(0.5)]])
CAR = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 1], [[6, -3, 0], [6, 7, 0]]))
HERE = Pose((0.5, -0.3, 1.1), 20, 3, -2)
MOUNT = Pose((0.4, -0.2, 0.3), 30, -8, 3)
PHYSICS = {
    "materials": [Material("Bowl", specular_reflectance=1), Material("*", 0.5)],
    "returns": Returns("dual", 7, 3.0),
    "noise": Noise(0.02, angle_deg=0.05, dropout=0.1, detection_range_m=150, seed=5),
    "visibility_km": 0.1,
    "fog_lidar_ratio_sr": 18.8,
    "rain_mm_h": 20.0,
    "snow_mm_h": 1.0,
    "dust_mg_m3": 10.0,
}
LATE = Sensor(
    Beams(
        np.radians([-20, 0, 12]),
        time_ns=[0, 5e4, 1e5],
        origin=[[0.1, 0, 0], [0, 0, 0.1], [0.1, 0.02, 0]],
    ),
    Spin(90.449, step_deg=50),
    max_range_m=40,
    start_ns=2e7,
)
SENSORS = {
    "turns of no whole number": VLP16,
    "one pattern for all turns": GRID,
    "frames": load_sensor("livox/mid40", step_deg=90),
    "scans across turns, beams apart": LATE,
    "mounted": Mounted(GRID, MOUNT),
}


@pytest.fixture(scope="module")
def scene():
    meshes = [*seed_objects(rings=8, segments=12), level("Ground")]
    return Scene.from_meshes(meshes).with_actors([CAR])


def surveyed(scene, survey):
    """Cloud of a survey as its workers make it."""
    part = columns_of(list(Rig(scene, survey, "numpy").cast(0, survey.scan_count)))
    table = (SCAN, *(c for c in survey.stored_columns if c.name not in "xyz"))
    return part.cloud(table, survey.precision_m, scene.origin)


def same(one: Cloud, other: Cloud):
    assert one.columns.keys() == other.columns.keys()
    assert one.positions.tobytes() == other.positions.tobytes()
    for name, values in other.columns.items():
        assert one[name].dtype == values.dtype and one[name].tobytes() == values.tobytes(), name
    return True


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("physics", [{}, PHYSICS], ids=["", "physics"])
@pytest.mark.parametrize("moves", [False, True], ids=["standing", "moving"])
@pytest.mark.parametrize("name", SENSORS)
def test_a_sweep_has_the_bytes_of_a_survey(scene, name, moves, physics):
    given = SENSORS[name]
    carried = given if isinstance(given, Mounted) else Mounted(given)
    options = {"columns": COLUMNS, "precision_m": 1e-3, **physics}
    where = {"trajectory": DRIVE} if moves else {"poses": [HERE]}
    steps = carried.sensor.steps_of_revolution(2).stop
    whole = surveyed(scene, Survey(sensors=[carried], steps=steps, **where, **options))
    scanner = Scanner(scene, given, backend="numpy", **options)
    sweeps = [scanner.sweep(DRIVE if moves else HERE, number=number) for number in (2, 0, 1)]
    same(Cloud.concatenate([sweeps[1], sweeps[2], sweeps[0]]), whole)
    assert all(len(sweep) > 20 for sweep in sweeps)
    assert (whole["object"] == len(scene.names)).any(), "the actor is seen"


def test_sweeps_are_those_that_exporters_find():
    for sensor in (VLP16, GRID, LATE, replace(GRID, head=Spin(120, step_deg=77))):
        survey = Survey(sensor, [(0, 0, 1)], steps=sensor.steps_of_revolution(40).stop)
        firsts = [sensor.steps_of_revolution(number).start for number in range(42)]
        assert Sweeps.from_survey(survey, Scene.seed()).scans.tolist() == firsts


def test_another_start_is_another_time_on_the_same_trajectory(scene):
    scanner = Scanner(scene.with_actors([]), VLP16, columns=["time"], backend="numpy")
    later = replace(BEND, start_s=0.25, duration_s=None)
    one = scanner.sweep(later, start_s=0.5, number=3)
    other = scanner.sweep(BEND, start_s=0.75)
    assert len(one) > 1000 and not np.array_equal(one.scan, other.scan)
    other = scanner.sweep(BEND, start_s=0.75, number=3)
    assert np.array_equal(one.positions, other.positions)
    assert np.array_equal(other.time - one.time, np.full(len(one), 250_000_000))
    default = scanner.sweep(BEND, number=3)
    assert same(scanner.sweep(BEND, number=3, start_s=0.3), default)
    assert not np.array_equal(default.positions[:100], other.positions[:100])


SEEN = ["ray", "range", "return_number"]
IMAGES = {
    "plain": {},
    "noise of ranges": {"noise": Noise(0.02, 0.001, seed=3)},
    "all effects": PHYSICS,
    "lost returns": {"noise": Noise(dropout=0.3)},
}


def assert_image(image, sweep, sensor, number):
    """The nearest ranges of a sweep, firing by firing."""
    steps = sensor.steps_of_revolution(number)
    begins = np.array([sensor.firings(step)[0] for step in steps]) * sensor.channels
    sweep = sweep[sweep.return_number == 1]
    expected = np.full(image.size, np.inf, np.float32)
    expected[(begins - begins[0])[sweep.scan - steps.start] + sweep.ray] = sweep.range
    assert np.isfinite(expected).sum() > 20
    np.testing.assert_allclose(image.reshape(-1), expected, rtol=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("sensor", [VLP16, LATE, replace(GRID, head=Spin(120, step_deg=77))])
def test_an_image_has_the_firings_of_its_turn(scene, sensor):
    scanner = Scanner(scene, sensor, columns=SEEN, backend="numpy")
    for number in range(4):
        [image] = scanner.ranges(HERE, number=number)
        assert_image(image, scanner.sweep(HERE, number=number), sensor, number)


@pytest.mark.extended
@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("given", [GRID, Mounted(GRID, MOUNT)], ids=["sensor", "mounted"])
def test_an_image_has_the_ranges_of_sweeps(scene, name, given, monkeypatch):
    scanner = Scanner(scene, given, columns=SEEN, backend="numpy", **IMAGES[name])
    poses = [HERE, Pose((1, 0, 1)), Pose((0, 1, 2), 100)]
    images = scanner.ranges(poses, number=4, start_s=0.2)
    assert images.shape == (3, 120, 8) and images.dtype == np.float32
    for number, (image, pose) in enumerate(zip(images, poses, strict=True), 4):
        assert_image(image, scanner.sweep(pose, number=number, start_s=0.2), GRID, number)
    monkeypatch.setattr(rig_module, "IMAGE_RAYS", 1000)
    assert np.array_equal(scanner.ranges(poses, number=4, start_s=0.2), images)


def correlations(*rows):
    """Greatest correlation of two rows."""
    return np.abs(np.corrcoef(rows) - np.eye(len(rows))).max()


@pytest.mark.extended
def test_each_name_has_random_numbers_of_its_own(scene):
    given = {"columns": COLUMNS, "backend": "numpy"}
    plain = Scanner(scene, GRID, **given).sweep(HERE)
    noise = Noise(0.1, velocity_m_s=1)
    named = [
        Scanner(scene, GRID, name=name, noise=noise, **given) for name in ("", "left", "right")
    ]
    clouds = [scanner.sweep(HERE) for scanner in named]
    for name in ("range", "radial_velocity"):
        assert correlations(*(cloud[name] - plain[name] for cloud in clouds)) < 0.15
    # Lost rays, drops and flakes; a Mounted's name is its own, and a survey has the same bytes.
    options = {**PHYSICS, "noise": replace(PHYSICS["noise"], false_alarm_hz=1e5)}
    given["columns"] = ["ray", "range", "cause"]
    names = ("left", "right")
    clouds = [Scanner(scene, GRID, name=name, **given, **options).sweep(HERE) for name in names]
    for cause in (0, 1, 2):
        some = [cloud[cloud.cause == cause] for cloud in clouds]
        rays = [{*zip(cloud.scan.tolist(), cloud.ray.tolist(), strict=True)} for cloud in some]
        assert len(rays[0]) > 10 and len(rays[0] - rays[1]) > 0.02 * len(rays[0]), cause
    mounted = Mounted(GRID, name="left")
    assert same(Scanner(scene, mounted, **given, **options).sweep(HERE), clouds[0])
    options |= {
        "columns": given["columns"],
        "steps": GRID.steps_of_revolution(0).stop,
        "poses": [HERE],
    }
    assert same(surveyed(scene, Survey(sensors=[mounted], **options)), clouds[0])


@pytest.mark.parametrize("sensor", [GRID, LATE])
def test_without_a_number_only_the_random_numbers_advance(scene, sensor):
    given = {"columns": COLUMNS, "backend": "numpy"}
    plain = Scanner(scene, sensor, **given)
    before = plain.sweep(BEND)
    assert same(plain.sweep(BEND), before), "firings, times and numbers of scans stay"
    scanner = Scanner(scene, sensor, noise=Noise(0.1, velocity_m_s=1), **given)
    clouds = [scanner.sweep(BEND) for _ in range(3)]
    assert same(clouds[0], scanner.sweep(BEND, number=0))
    for name in ("scan", "ray", "time"):
        assert all(np.array_equal(cloud[name], before[name]) for cloud in clouds)
    for name in ("range", "radial_velocity"):
        errors = [cloud[name] - before[name] for cloud in clouds]
        assert correlations(*errors) < 5 / np.sqrt(len(before)), "5 standard deviations"
    images = [*scanner.ranges([HERE, HERE]), *scanner.ranges(HERE), *scanner.ranges(HERE, number=0)]
    assert len({image.tobytes() for image in images}) == 4


@pytest.mark.parametrize("threads", [1, 2])
def test_images_from_several_poses_are_those_from_each(threads):
    """Also where the rays of two images, far apart, would share a tile."""
    scanner = Scanner(Scene.seed(), VLP16, backend="tiles", threads=threads)
    poses = [Pose((0, 0, 1)), Pose((30, -25, 2), 180), Pose((-15, 20, 0.5), 77, 3)]
    images = scanner.ranges(poses)
    assert np.isfinite(images).mean(axis=(1, 2)).min() > 0.02
    for pose, image in zip(poses, images, strict=True):
        assert np.array_equal(scanner.ranges(pose)[0], image)


def test_streams_are_independent(scene):
    given = {"columns": COLUMNS, "backend": "numpy"}
    before = Scanner(scene, GRID, **given).sweep(BEND, number=3)
    scanner = Scanner(scene, GRID, noise=Noise(0.1, velocity_m_s=1), **given)
    clouds = [scanner.sweep(BEND, number=3, stream=stream) for stream in (0, 1, 2**31 - 1)]
    assert same(clouds[0], scanner.sweep(BEND, number=3))
    assert all(np.array_equal(cloud["time"], before["time"]) for cloud in clouds)
    for name in ("range", "radial_velocity"):
        errors = [cloud[name] - before[name] for cloud in clouds]
        assert correlations(*errors) < 5 / np.sqrt(len(before)), "5 standard deviations"
    images = [scanner.ranges(HERE, number=3, stream=stream) for stream in (0, 0, 1)]
    assert np.array_equal(*images[:2]) and not np.array_equal(*images[1:])


def test_poses_can_be_given_in_several_forms(scene):
    scanner = Scanner(scene, GRID, backend="numpy")
    places = np.array([[0, 0, 1], [1, -1, 2.0]])
    images = scanner.ranges(places)
    assert np.array_equal(scanner.ranges(places.tolist()), images)
    assert np.array_equal(scanner.ranges([Pose((0, 0, 1)), (1, -1, 2)]), images)
    matrix = np.eye(4)
    matrix[:3, :3] = HERE.rotation
    matrix[:3, 3] = HERE.position
    assert np.array_equal(scanner.ranges(matrix[None]), scanner.ranges(HERE))
    assert same(scanner.sweep((0, 0, 1)), scanner.sweep(Pose((0, 0, 1))))
    assert scanner.ranges(np.empty((0, 3))).shape == (0, 120, 8)


def test_an_actor_stands_where_it_was_put(scene):
    scanner = Scanner(scene.with_actors([Actor(CAR.mesh)]), GRID, backend="numpy")
    car = len(scene.names)
    for x in (-6, 6):
        scanner.move("Car", (x, 0, 0))
        for points in (scanner.sweep((0, 0, 1), number=3), scanner.sweep((0, 0, 1), start_s=9)):
            on = points.positions[points.object == car]
            assert len(on) > 10 and (np.abs(on[:, 0] - x) < 2.3).all()
    scanner.move("Car", DRIVE)
    with pytest.raises(LidarError, match=r"Actor 'Car': The trajectory covers 0 to 0\.5 s"):
        scanner.sweep((0, 0, 1), start_s=9)


def test_points_have_the_names_and_classes_of_objects_and_actors():
    scene = Scene.seed().with_actors([Actor(box(name, (2, 2, 2))) for name in ("Car", "Van")])
    assert scene.object_names == (*scene.names, "Car", "Van")
    materials = [Material("Van", semantic_class=9), Material("*", semantic_class=2)]
    scanner = Scanner(scene, load_sensor("velodyne/vlp16"), columns=["class"], materials=materials)
    scanner.move("Car", Pose((5, 0, 0)))
    scanner.move("Van", Pose((-5, 0, 0)))
    cloud = scanner.sweep((0, 0, 1))
    names = np.array(scanner.scene.object_names)[cloud["object"]]
    for name, x in (("Car", 4), ("Van", -4)):
        on_side = (np.abs(cloud.positions[:, 0] - x) < 1e-3) & (
            np.abs(cloud.positions[:, 1]) < 0.99
        )
        assert on_side.sum() > 50 and (names[on_side] == name).all()
    np.testing.assert_array_equal(cloud["class"], np.where(names == "Van", 9, 2))


@pytest.mark.extended
@pytest.mark.parametrize("physics", [{}, PHYSICS], ids=["plain", "all effects"])
def test_a_moved_actor_is_like_one_that_was_there_before(scene, physics):
    """In cast, normals, and energies."""
    clouds = []
    images = []
    way = Track([0, 1], [[4, -3, 0], [5, 3, 0]])
    for first in (CAR.trajectory, way):
        car = Actor(CAR.mesh, first)
        scanner = Scanner(
            scene.with_actors([Actor(box("Van", (5, 2, 2))), car]), GRID, columns=COLUMNS,
            backend="numpy", **physics,
        )  # fmt: skip
        scanner.sweep((0, 0, 1))  # fills what is kept
        scanner.move("Van", (-6, 1, 0))
        scanner.move("Car", way)
        clouds.append(scanner.sweep((0, 0, 1), number=2))
        images.append(scanner.ranges((0, 0, 1), number=2))
    assert {6, 7, 8} <= {*clouds[0].object.tolist()} and same(*clouds)
    assert np.array_equal(*images)


def test_a_sweep_sees_actors_where_they_were_when_it_began(scene):
    """Moved while its columns are made, by one of them."""
    later = []

    def moves(returns):
        for step in later:
            scanner.move("Car", step)
        return returns.cosine

    own = Column("moves", "float32", "", "moves the actor", moves)
    columns = [own, "intensity", "class"]
    scanner = Scanner(scene, GRID, columns=columns, backend="numpy")
    scanner.move("Car", Pose((4, 1, 0), 30))
    before = scanner.sweep((0, 0, 1))
    later.append(Pose((4, 1, 0), 75))
    assert same(scanner.sweep((0, 0, 1)), before)
    assert not np.array_equal(scanner.sweep((0, 0, 1)).moves, before.moves)


def with_copies(scene, crate=None, *grates):
    """A crate and two grates with holes, as instances; poses and scales may be given."""
    uv = np.array([[[0, 0], [2, 0], [2, 2]]], np.float32)
    corners = np.array([[0, -2, 0], [0, 2, 0], [0, 2, 2], [0, -2, 2.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    grate = SceneMesh("Grate", corners, faces, (Cutout(np.array([[True, False]]), uv),))
    meshes = [(box("Crate", (2, 1, 1)), crate or Pose((5, 2, 0), 10), (1.4, 0.7, 2.1))]
    meshes += [(grate, pose, 1.3) for pose in grates or [Pose((-5, y, 0), 5) for y in (-3, 3)]]
    placed = []
    for mesh, pose, scale in meshes:
        matrix = np.eye(4)
        matrix[:3, :3] = (np.eye(3) if pose.rotation is None else pose.rotation) * scale
        matrix[:3, 3] = pose.position
        placed.append(SceneInstance(mesh, matrix))
    return Scene.from_meshes([*scene.meshes(), *placed]).with_actors(scene.actors)


@pytest.mark.extended
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
@pytest.mark.parametrize("physics", [{}, PHYSICS], ids=["plain", "all effects"])
def test_a_moved_copy_is_like_one_that_was_there_before(scene, physics, backend):
    crate = Pose((6, -2, 0.5), 70, 5)
    grates = [Pose((-4, 3, 1), 20), Pose((-5, 3, 0), 5, 0, 30)]
    options = {"columns": COLUMNS, "backend": backend, **physics}
    moved = Scanner(with_copies(scene), GRID, **options)
    before = moved.sweep(HERE, number=2)  # fills what is kept
    for step in ((3, 3, 0), Pose((1, 9, 2), -50, 20, 9), crate):
        moved.move("Crate", step)
    moved.move("Grate", grates[0])
    moved.move("Grate.2", grates[1])
    new = Scanner(with_copies(scene, crate, *grates), GRID, **options)
    cloud = moved.sweep(HERE, number=2)
    assert {7, 8, 9} <= {*cloud.object.tolist()}
    assert not np.array_equal(before.positions, cloud.positions)
    assert same(cloud, new.sweep(HERE, number=2))
    assert np.array_equal(moved.ranges([HERE, (0, 0, 1)]), new.ranges([HERE, (0, 0, 1)]))
    moved.move("Car", (4, 1, 0))  # an actor in the same scene
    new.move("Car", (4, 1, 0))
    assert same(moved.sweep(HERE, number=2), new.sweep(HERE, number=2))


BODIES = ["Crate", "Car", "Grate.2", "Van"]


def matrices_of(*poses):
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3] = [pose.rotation_matrix for pose in poses]
    matrices[:, :3, 3] = [pose.position for pose in poses]
    return matrices


def with_bodies(scene, **options):
    van = Actor(box("Van", (5, 2, 2)), Track([0, 9], [[9, 9, 0], [9, 0, 0]]))
    bodies = with_copies(scene).with_actors([CAR, van])
    return Scanner(bodies, GRID, columns=COLUMNS, **options)


@pytest.mark.extended
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
@pytest.mark.parametrize("physics", [{}, PHYSICS], ids=["plain", "all effects"])
def test_bodies_that_move_together_give_the_bytes_of_bodies_that_move_one_by_one(
    scene, physics, backend
):
    """Instances and actors in one call, as matrices, poses, and positions."""
    steps = [
        [Pose((6, -2, 0.5), 70, 5), Pose((4, 3, 0), 30), Pose((-4, -3, 1), 20), Pose((-7, 1, 0))],
        [Pose((5, -1, 0.2), 170), Pose((4, -2, 0), 10, 3), Pose((-5, 0, 1)), Pose((0, 6, 0), 90)],
    ]
    together, singly, listed = scanners = [
        with_bodies(scene, backend=backend, **physics) for _ in range(3)
    ]
    for poses in steps:
        together.move(BODIES, matrices_of(*poses))
        listed.move(BODIES, poses)
        for name, pose, matrix in zip(BODIES, poses, matrices_of(*poses), strict=True):
            singly.move(name, matrix if name in ("Van", "Crate") else pose)
        clouds = [scanner.sweep(HERE, number=2) for scanner in scanners]
        assert {7, 9, 10, 11} <= {*clouds[0].object.tolist()}
        assert same(clouds[0], clouds[1]) and same(clouds[0], clouds[2])
        images = [scanner.ranges([HERE, (0, 0, 1)], number=2) for scanner in scanners]
        assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])
    together.move(["Van", "Crate"], [(3, 3, 0), (7, 0, 0)])
    singly.move("Van", (3, 3, 0))
    singly.move("Crate", (7, 0, 0))
    assert same(together.sweep(HERE, number=3), singly.sweep(HERE, number=3))


def test_beams_meet_bodies_where_they_are_when_the_beams_are_fired(scene):
    """A wall that flees at 20 m/s, and one that stands; against the poses of a `Track`."""
    walls = [Actor(box(name, (0.1, 60, 40))) for name in ("Ahead", "Behind")]
    scanner = Scanner(scene.with_actors(walls), VLP16, columns=["time", "range"], precision_m=1e-5)
    times_s = [0, 0.05, 0.11]
    matrices = np.tile(np.eye(4), (2, 3, 1, 1))
    matrices[0, :, :3, 3] = [[4, 0, -20], [5, 0, -20], [6.2, 0, -20]]
    matrices[1, :, :3, 3] = [-3, 0, -20]
    scanner.move(["Ahead", "Behind"], matrices, times_s=times_s)
    cloud = scanner.sweep((0, 0, 1))
    x = cloud.positions[:, 0]
    first = len(scene.names)
    on_ahead = (cloud.object == first) & (np.abs(cloud.positions[:, 1]) < 25)
    position = 4 - 0.05 + 20 * cloud.time[on_ahead] / 1e9
    assert on_ahead.sum() > 3000 and np.ptp(position) > 0.5
    assert np.abs(x[on_ahead] - position).max() < 2e-5
    assert np.abs(x[cloud.object == first + 1] + 2.95).max() < 2e-5
    track = Track(times_s, matrices[0, :, :3, 3], np.tile([0, 0, 0, 1.0], (3, 1)))
    scanner.move(["Ahead", "Behind"], [track, (-3, 0, -20)])
    assert same(scanner.sweep((0, 0, 1), number=0), cloud)
    with pytest.raises(LidarError, match=r"Actor 'Ahead': The trajectory covers 0 to 0\.11 s"):
        scanner.sweep((0, 0, 1), number=1)


@pytest.mark.parametrize("dumps", [pickle.dumps, cloudpickle.dumps])
def test_a_pickled_scanner_gives_the_same_bytes(scene, dumps):
    """Also of what was moved, and with the random numbers that are next."""
    options = {"columns": COLUMNS, "backend": "numpy", **PHYSICS}
    scanner = Scanner(with_copies(scene), GRID, **options)
    scanner.move("Crate", Pose((6, -2, 0.5), 70, 5))
    scanner.move("Car", (4, 1, 0))
    scanner.sweep(HERE)
    copy = pickle.loads(dumps(scanner))
    assert repr(copy) == repr(scanner)
    for number in (None, 3):
        assert same(scanner.sweep(HERE, number=number), copy.sweep(HERE, number=number))
        images = [one.ranges([HERE, (0, 0, 1)], number=number) for one in (scanner, copy)]
        assert np.array_equal(*images)
    for one in (scanner, copy):
        one.move("Crate", Pose((5, 2, 0), 10))
    assert same(scanner.sweep(HERE, number=2), copy.sweep(HERE, number=2))


@pytest.mark.extended
def test_a_copy_waits_for_sweeps_before_it_moves(scene):
    """So each of them sees it in one place."""
    scanner = Scanner(with_copies(scene), VLP16, threads=1)
    places = [Pose((5, 2, 0), 10), Pose((4, -1, 0), 50)]
    seen = []
    for place in places:
        scanner.move("Crate", place)
        seen.append(scanner.sweep((0, 0, 1)).positions.tobytes())
    assert seen[0] != seen[1]
    with ThreadPoolExecutor(3) as pool:
        sweeps = [pool.submit(scanner.sweep, (0, 0, 1)) for _ in range(30)]
        for number in range(30):
            scanner.move("Crate", places[number % 2])
        assert {sweep.result().positions.tobytes() for sweep in sweeps} <= {*seen}


@pytest.mark.extended
@pytest.mark.parametrize(("backend", "sensor"), [("numpy", LATE), ("tiles", FEW)])
def test_threads_share_a_scanner(scene, backend, sensor):
    def scan(number):
        cloud = scanner.sweep(BEND, number=number)
        image = scanner.ranges([HERE, (0, 0, 1 + number / 10)], number=number)
        return cloud.positions.tobytes(), cloud["time"].tobytes(), image.tobytes()

    scanner = Scanner(scene, sensor, columns=["time"], backend=backend, **PHYSICS)
    alone = [scan(number) for number in range(4)]
    scanner = Scanner(scene, sensor, columns=["time"], backend=backend, **PHYSICS)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(scan, [*range(4)] * 2)) == alone * 2


@pytest.mark.extended
def test_a_forked_process_scans_with_the_scanner_of_its_parent(scene):
    scanner = Scanner(scene, GRID, backend="tiles", threads=2)
    poses = [HERE] * 2000
    expected = scanner.ranges(poses, number=3).tobytes()  # which starts threads that a fork lacks

    def scan() -> None:
        os._exit(scanner.ranges(poses, number=3).tobytes() != expected)

    other = get_context("fork").Process(target=scan)
    other.start()
    other.join(120)
    other.kill()
    assert other.exitcode == 0


def test_positions_are_those_of_the_world_or_of_the_sensor(scene):
    far = replace(scene.with_actors([]), origin=np.array([5e5, 4e6, 100]))
    world = Scanner(far, GRID, backend="numpy").sweep(HERE).positions
    local = Scanner(scene.with_actors([]), GRID, backend="numpy").sweep(HERE).positions
    assert np.allclose(world - far.origin, local, atol=1e-6)
    own = Scanner(far, GRID, backend="numpy", coordinates="sensor").sweep(HERE).positions
    assert np.allclose(own @ HERE.rotation.T + HERE.position, local, atol=0.02)


class Mirrored:
    """A trajectory of a user, whose rotations mirror."""

    stations = 1
    moves = True
    duration_ns = 1e9

    def pose(self, station, time_ns=0.0):
        return Pose((0, 0, 1))

    def poses(self, station, times_ns):
        mirrored = np.broadcast_to(np.diag([1.0, -1.0, 1.0]), (len(times_ns), 3, 3))
        return np.tile([0.0, 0.0, 1.0], (len(times_ns), 1)), mirrored


FAR = Scene.seed().with_actors([Actor(box("Car", (9, 9, 9)), Track([0, 1], [[3000, 0, 0]] * 2))])
WRONG = {
    "number": (lambda s: s.sweep((0, 0, 1), number=-1), "number must … but is -1"),
    "large": (lambda s: s.sweep((0, 0, 1), number=10**9), "number must be at most"),
    "larger": (
        lambda s: s.ranges((0, 0, 1), number=2**63),
        ("number must … but is 9223372036854775808"),
    ),
    "largest": (lambda s: s.sweep((0, 0, 1), number=2**2000), "below 2147483648"),
    "remote": (lambda s: s.sweep((0, 0, 1), start_s=1e300), "start_s must … but is 1e+300"),
    "lost": (lambda s: s.sweep((0, float("nan"), 1)), "but is (0.0, nan, 1.0)"),
    "start": (lambda s: s.ranges((0, 0, 1), start_s=float("nan")), "start_s must … but is nan"),
    "late": (lambda s: s.sweep(DRIVE, start_s=0.45), "from 0.45 to 0.549167 s"),
    "actor": (
        lambda s: s.move("Cart", (0, 0, 1)),
        "Unknown actor or instance 'Cart'. Did you mean",
    ),
    "object": (lambda s: s.move("Bowl", (0, 0, 1)), "'Bowl'. It is part of the static scene"),
    "some name": (
        lambda s: s.move(["Car", "Cat"], [(0, 0, 1)] * 2),
        "Unknown actor or instance 'Cat'",
    ),
    "twice": (lambda s: s.move(["Car", "Car"], [(0, 0, 1)] * 2), "names contains 'Car' twice"),
    "count": (lambda s: s.move(["Car"], [(0, 0, 1)] * 2), "There are 1 names, but 2 poses"),
    "deformed": (lambda s: s.move("Car", np.diag([1, 2, 1, 1])), "Matrix 0 of a pose deforms"),
    "no matrix": (lambda s: s.move(["Car"], np.ones((1, 4, 4))), "last row of each matrix"),
    "no pose": (lambda s: s.move(["Car"], np.ones((1, 2))), "of the shape (1, 2)"),
    "not finite": (
        lambda s: s.move(["Car"], [(0, np.inf, 1)]),
        ("Pose 0 (counted from 0) is not finite"),
    ),
    "no times": (
        lambda s: s.move("Car", np.eye(4), times_s=[0, 1]),
        "must be matrices (k, samples, 4, 4)",
    ),
    "times": (
        lambda s: s.move("Car", np.tile(np.eye(4), (2, 1, 1)), times_s=[1, 1]),
        "Times must increase",
    ),
    "standing": (
        lambda s: with_bodies(Scene.seed(), backend="numpy").move(
            ["Car", "Crate"], np.tile(np.eye(4), (2, 2, 1, 1)), times_s=[0, 1]
        ),
        "'Crate' is a SceneInstance, which is stationary during a sweep",
    ),
    "pose": (lambda s: s.sweep("here"), "pose must … but is 'here'"),
    "poses": (lambda s: s.ranges([[0, 0]]), "of the shape (1, 2)"),
    "mixed": (lambda s: s.ranges([HERE, "here"]), "a pose must … but is 'here'"),
    "turned": (lambda s: s.ranges(np.full((2, 4, 4), [0, 0, 0, 1])), "orthonormal matrix"),
    "mirrored": (lambda s: s.ranges(np.diag([1, -1, 1, 1])[None]), "contains a reflection"),
    "scaled": (lambda s: s.ranges(np.diag([2, 2, 2, 1])[None]), "orthonormal matrix"),
    "mirrored way": (lambda s: s.sweep(Mirrored()), "contains a reflection"),
    "mirrored actor": (
        lambda s: s.move("Car", Mirrored()),
        "Actor 'Car': Matrix 0 of a pose mirrors",
    ),
    "an actor": (lambda s: replace(CAR, trajectory=Mirrored()), "Matrix 0 of a pose mirrors"),
    "row": (lambda s: s.ranges(np.ones((1, 4, 4))), "last row"),
    "backend": (lambda s: Scanner(Scene.seed(), GRID, backend="tile"), "'tile'. Did you mean"),
    "fine": (
        lambda s: Scanner(FAR, GRID, precision_m=1e-6).sweep((2990, 0, 1)),
        "precision_m is 1e-06, which is too fine for points 2",
    ),
    "stream": (lambda s: s.sweep(HERE, stream=-1), "stream must … but is -1"),
    "threads": (lambda s: Scanner(Scene.seed(), GRID, threads=0), "threads must be at least 1"),
    "names": (
        lambda s: Scanner(Scene.seed(), Mounted(GRID, name="left"), name="right"),
        "name is 'right'. Use Mounted(sensor, name=",
    ),
}


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments(scene, name):
    call, says = WRONG[name]
    with pytest.raises(LidarError) as raised:
        call(Scanner(scene, GRID, backend="numpy"))
    assert (
        all(words in str(raised.value) for words in says.split(" … "))
        and len(str(raised.value).splitlines()) <= 2
    )


@pytest.mark.extended
def test_a_scan_needs_no_cluster_and_imports_none():
    code = (
        "import sys; from lidarpool import Scanner, Scene, Sensor\n"
        "scanner = Scanner(Scene.seed(), Sensor.grid(100, 4))\n"
        "assert len(scanner.sweep((0, 0, 1))) and scanner.ranges((0, 0, 1)).size == 400\n"
        "print({'dask', 'distributed', 'poolpart'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"

"""What a sensor does not see is as if it were not in the scene, for this sensor alone."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from tests.cuda_on_host import source_backend  # noqa: F401 - a fixture
from tests.shapes import CPU, ball, cast_between, level, quad, tally_of, wall

from lidarscenario import Job
from lidarsim import (
    Actor,
    Beams,
    Follower,
    LidarError,
    Material,
    Mounted,
    Noise,
    Optics,
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
)
from lidarsim.casting import static_bodies
from lidarsim.columns.table import CAUSES
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.memory import rig_bytes
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.points.device_columns import DevicePoints
from lidarsim.simulator.rig import Rig
from raybeam import available_backends, registry

GRID = Sensor.grid(rays_per_revolution=120, layers=8, step_deg=30, max_range_m=40)
COLUMNS = ["ray", "range", "time", "intensity", "triangle"]
HERE = Pose((0.5, -0.3, 1.1), 20, 3, -2)
FENCE = Cutout(
    np.array([[True, False], [False, True]]), np.tile([[0, 0], [4, 0], [4, 4.0]], (2, 1, 1))
)
DRIVE = Track([0, 3], [[6, -3, 0], [6, 7, 0]])


def objects(kind):
    """The objects of a scene as faces, as instances, or both, with a mask and copies of a mesh."""
    meshes = [*seed_objects(rings=8, segments=12), level("Ground", -0.5)]
    crate = box("Crate", (2, 1, 1))
    copies = [SceneInstance(crate, Pose((x, -4, 0)), "Crate") for x in (5, -5, 0)]
    fence = replace(quad("Fence", (4, 2, 0), (4, 6, 0), (4, 6, 3), (4, 2, 3)), cutouts=(FENCE,))
    if kind == "faces":
        return meshes
    if kind == "instances":
        return [SceneInstance(mesh, Pose((0, 0, 0))) for mesh in meshes] + copies
    return [*meshes, *copies, fence]


def scene_of(items, actors=("Car", "Van")):
    rows = {"Car": DRIVE, "Van": Track([0, 3], [[-6, 4, 0], [-2, 4, 0]])}
    moving = [Actor(box(name, (4.5, 1.8, 1.5)), rows[name]) for name in actors]
    return Scene.from_meshes(items).with_actors(moving)


@pytest.fixture(params=[*CPU, "source", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request, monkeypatch):
    """Name of a backend; a CUDA device is played by the CPU, or a real one."""
    if request.param == "source":
        played = request.getfixturevalue("source_backend")
        monkeypatch.setattr(registry, "BACKENDS", (*registry.BACKENDS, played))
    elif reason := available_backends()[request.param]:
        pytest.skip(f"{request.param}: {reason}")
    return request.param


def same_points(cloud, scene, other, other_scene):
    """Check that clouds of two scenes have equal points, of objects with equal names."""
    assert cloud.positions.tobytes() == other.positions.tobytes()
    names = np.array(scene.object_names)[cloud.object]
    assert names.tolist() == np.array(other_scene.object_names)[other.object].tolist()
    for name in ("ray", "time"):
        assert cloud[name].tobytes() == other[name].tobytes(), name
    for name in ("range", "intensity"):
        assert np.allclose(cloud[name], other[name], rtol=3e-7, atol=0), name
    assert len(cloud) > 50


@pytest.mark.extended
@pytest.mark.parametrize("actors", [(), ("Car", "Van")], ids=["", "actors"])
@pytest.mark.parametrize("kind", ["faces", "instances", "both"])
def test_a_sensor_sees_the_scene_without_the_unseen_objects(kind, actors, backend):
    items = objects(kind)
    scene = scene_of(items, actors)
    first = items[0].name
    patterns = [first, *(["Crate*"] if kind != "faces" else []), *(["C?r"] if actors else [])]
    kept = [item for item in items if item.name not in (first, "Crate")]
    without = scene_of(kept, actors[1:])
    options = {"columns": COLUMNS, "backend": backend}
    scanner = Scanner(scene, GRID, unseen=patterns, **options)
    expected = Scanner(without, GRID, **options)
    hits_of_all = Scanner(scene, GRID, **options).sweep(HERE, number=1)
    cloud = scanner.sweep(HERE, number=1)
    assert len(cloud) != len(hits_of_all)
    same_points(cloud, scene, expected.sweep(HERE, number=1), without)
    images = [each.ranges([HERE, (0, 0, 1)], number=1) for each in (scanner, expected)]
    assert np.allclose(*images, rtol=1e-7)
    copy = pickle.loads(pickle.dumps(scanner))
    assert copy.sweep(HERE, number=1).positions.tobytes() == cloud.positions.tobytes()


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["faces", "both"])
def test_each_sensor_of_a_survey_has_its_own_unseen_objects(kind, backend):
    items = objects(kind)
    scene = scene_of(items)
    first, second = items[0].name, items[1].name
    unseen = {"front": (first, "Car"), "left": (second,), "right": (second,), "top": ()}
    mounts = {name: Pose((0.1 * k, 0, 1)) for k, name in enumerate(unseen)}

    def survey(names):
        sensors = [Mounted(GRID, mounts[n], n, unseen=unseen[n]) for n in names]
        return Survey(sensors=sensors, poses=[(0, 0, 0)], steps=12, columns=COLUMNS)

    together = survey(unseen)
    rig = Rig(scene, together, backend)
    batches = list(rig.cast(0, together.scan_count))
    assert len({*rig.scene_casters}) == 3
    for number, (name, batch) in enumerate(zip(unseen, batches, strict=True)):
        if backend in ("source", "cuda"):
            assert isinstance(batch, DevicePoints)
        alone = survey([name])
        (expected,) = Rig(scene, alone, backend).cast(0, alone.scan_count)
        made, single = (columns_of([each]).columns for each in (batch, expected))
        assert (made["sensor"] == number).all()
        for column in ("x", "y", "z", "ray", "object", "intensity", "triangle"):
            assert made[column].tobytes() == single[column].tobytes(), (name, column)
        assert np.array_equal(tally_of([batch]), tally_of([expected]))
        assert int(tally_of([batch]).sum()) == int(batch.hit_counts.sum()) > 100
        seen = {scene.object_names[k] for k in np.unique(made["object"])}
        assert not seen & {*unseen[name]}
        assert {first, second, "Car"} - {*unseen[name]} <= seen


@pytest.mark.parametrize("backend_name", CPU)
def test_instances_move_while_others_are_unseen(backend_name):
    items = objects("both")
    scene = scene_of(items, ())
    without = scene_of([item for item in items if item.name != "Fence"][:-1], ())
    options = {"columns": COLUMNS, "backend": backend_name}
    scanner = Scanner(scene, GRID, unseen=["Crate.3", "Fence"], **options)
    expected = Scanner(without, GRID, **options)
    scanner.move("Crate.3", (3, 0, 0))  # before the sensor
    for poses in ([(2, 2, 0), (-3, 1, 0)], [(3, -2, 1), (-4, 0, 0)]):
        scanner.move(["Crate", "Crate.2"], poses)
        expected.move(["Crate", "Crate.2"], poses)
        clouds = [each.sweep(HERE, number=1) for each in (scanner, expected)]
        same_points(clouds[0], scene, clouds[1], without)
        assert {7, 8} <= {*clouds[0].object.tolist()}


def test_unseen_objects_of_a_vast_scene_are_left_out(monkeypatch):
    """Where what is far beyond the range is cut, and comes near again."""
    half = 2e5
    ground = quad(
        "Plain", (-half, -half, -9), (half, -half, -9), (half, half, -9), (-half, half, -9)
    )
    items = [*objects("both"), ground]
    scene = scene_of(items, ())
    unseen = [items[0].name, "Crate"]
    scanner = Scanner(scene, GRID, unseen=unseen, columns=COLUMNS, backend="numpy")
    clouds = [scanner.sweep(pose, number=1) for pose in (HERE, (7e4, 0, 1))]
    monkeypatch.setattr(static_bodies, "MAX_REACH_M", np.inf)
    whole = Scanner(scene, GRID, unseen=unseen, columns=COLUMNS, backend="numpy")
    for pose, cloud in zip((HERE, (7e4, 0, 1)), clouds, strict=True):
        expected = whole.sweep(pose, number=1)
        assert len(cloud) > 50 and cloud.object.tolist() == expected.object.tolist()
        assert np.abs(cloud.positions - expected.positions).max() <= 0.002
        assert not {0, 7} & {*cloud.object.tolist()}


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("kind", ["faces", "instances", "both"])
def test_a_sensor_may_see_nothing_at_all(kind, backend):
    scene = scene_of(objects(kind))
    static = Scanner(scene, GRID, unseen=scene.names, columns=COLUMNS, backend=backend)
    cloud = static.sweep(HERE, number=1)
    assert {scene.object_names[k] for k in np.unique(cloud.object)} <= {"Car", "Van"} and len(cloud)
    blind = Scanner(scene, GRID, unseen="*", columns=COLUMNS, backend=backend)
    assert not len(blind.sweep(HERE, number=1))
    assert np.isinf(blind.ranges([(0, 0, 1)])).all()
    survey = Survey(sensors=[Mounted(GRID, unseen=["*"])], poses=[(0, 0, 1)], steps=12)
    assert not tally_of(list(Rig(scene, survey, backend).cast(0, 12))).any()


PLATE = SceneMesh("Sign", np.array([[8.0, -1, 0], [8, 1, 0], [8, 0, 2]]), np.array([[0, 1, 2]]))
EFFECTS = {
    "sub-rays and a mirror": {
        "materials": [Material("Pane", specular_reflectance=1), Material("*", 0.5)],
        "returns": Returns("dual", 7, 3.0),
    },
    "refraction": {
        "materials": [
            Material(
                "Pane", transparent="pass", refractive_index=1.33, specular_reflectance="fresnel"
            ),
            Material("*", 0.5),
        ],
    },
    "leaves": {
        "materials": [Material("Pane", leaf_area_density=5.0), Material("*", 0.5)],
        "returns": Returns("all", 7, 3.0),
    },
    "blooming": {
        "materials": [Material("Sign", retro=True), Material("*", 0.1)],
        "noise": Noise(detection_range_m=100, stray_light=1e-2, seed=2),
        "returns": Returns("all", divergence_mrad=3),
    },
}  # fmt: skip


@pytest.mark.parametrize("name", EFFECTS)
def test_chunks_of_rays_change_no_byte(name, monkeypatch):
    middle = (0, 0, 1) if name in ("refraction", "leaves") else (4, 5, 1)
    scene = Scene.from_meshes(
        [level("Ground"), wall("Wall", 12), ball("Pane", 2.0, middle, 3), PLATE]
    )
    columns = [*COLUMNS, "cause", "return_number"]
    survey = Survey(GRID, poses=[(0, 0, 1)], steps=2, columns=columns, **EFFECTS[name])
    rig = Rig(scene, survey, "numpy")
    whole = cast_between(rig, survey, [0, 2])
    assert len(whole[0]["x"]) > 500
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 200)
    assert cast_between(rig, survey, [0, 2]) == whole


@pytest.mark.extended
@pytest.mark.parametrize("name", EFFECTS)
def test_effects_do_not_see_unseen_objects_either(name):
    """A mirror, water around the sensor, a crown, and a retro-reflector beside the beams."""
    options = EFFECTS[name]
    middle = (0, 0, 1) if name in ("refraction", "leaves") else (4, 5, 1)
    seen = [level("Ground"), wall("Wall", 12)]
    scene = Scene.from_meshes([*seen, ball("Pane", 2.0, middle, 3), PLATE])
    columns = [*COLUMNS, "cause", "return_number"]
    unseen = [material.objects[0] for material in options["materials"][:1]]
    kept = [
        mesh for mesh in (*seen, ball("Pane", 2.0, middle, 3), PLATE) if mesh.name not in unseen
    ]
    without = Scene.from_meshes(kept)
    materials = [material for material in options["materials"] if material.objects[0] == "*"]
    clouds = [
        Scanner(where, GRID, columns=columns, backend="numpy", **{**options, **more})
        .sweep((0, 0, 1), number=1)
        for where, more in (
            (scene, {}), (scene, {"unseen": unseen}), (without, {"materials": materials}),
        )
    ]  # fmt: skip
    assert len(clouds[0]) != len(clouds[1])
    assert clouds[1].positions.tobytes() == clouds[2].positions.tobytes()
    assert clouds[1].cause.tobytes() == clouds[2].cause.tobytes()
    names = [np.array(where.names)[np.maximum(c.object, 0)] for where, c in
             zip((scene, without), clouds[1:], strict=True)]  # fmt: skip
    assert names[0].tolist() == names[1].tolist() and len(clouds[1]) > 50


def test_spray_of_an_unseen_vehicle_stays():
    way = Track([0, 2], [[4, 0, 0.2], [54, 0, 0.2]])
    car = Actor(box("Car", (4.5, 1.8, 1.5)), way, spray=True)
    scene = Scene.from_meshes([level("Ground", half=60)]).with_actors([car])
    options = {
        "columns": ["cause"], "wet": 0.5, "spray_g_m3": 5.0, "backend": "numpy",
        "noise": Noise(detection_range_m=100), "returns": Returns("all", divergence_mrad=3),
    }  # fmt: skip
    sprays = []
    for unseen in ((), "Car"):
        scanner = Scanner(scene, GRID, unseen=unseen, **options)
        cloud = scanner.sweep((0, 0, 1), number=1, start_s=0.3)
        sprays.append(int((cloud.cause == CAUSES.index("spray")).sum()))
        assert (1 in cloud.object) == (not unseen)
    assert sprays[1] >= sprays[0] > 0  # the car no longer hides spray


def test_crosstalk_is_of_light_that_its_sensor_sends_and_the_receiver_sees():
    """The other sensor fires 200 ns later from the same place: as if 30 m farther away."""
    optics = Optics(divergence_mrad=10.0)
    one = Sensor(Beams(np.zeros(1)), Spin(400, 360, 10), 0.0, 150.0, optics=optics)
    noise = Noise(detection_range_m=200.0, crosstalk=True)
    around = ball("Around", 30.0, fineness=4)
    screen = wall("Screen", 6, (-3, 3), (-1, 1))

    def apparent_ranges(meshes, receiver=(), emitter=()):
        sensors = [
            Mounted(one, name="one", noise=noise, unseen=receiver),
            Mounted(replace(one, start_ns=200.0), name="other", noise=Noise(), unseen=emitter),
        ]
        survey = Survey(
            sensors=sensors, poses=[(0, 0, 0)], steps=1, materials=[Material("*", 1.0)],
            columns=["cause", "range"], returns=Returns("all"),
        )  # fmt: skip
        (points,) = Rig(Scene.from_meshes(meshes), survey, "numpy").cast(0, 1)
        columns = columns_of([points]).columns
        return columns["range"][columns["cause"] == CAUSES.index("crosstalk")]

    ranges = apparent_ranges([around, screen])
    on_screen = int((ranges < 40).sum())
    assert 50 < on_screen < 70 and len(ranges) == 400
    open_ranges = apparent_ranges([around])
    assert len(open_ranges) == 400 and open_ranges.min() > 55
    for receiver, emitter in ((["Screen"], ()), ((), ["Screen"])):
        # Light on the screen, which the receiver does not see, or light behind the screen.
        ranges = apparent_ranges([around, screen], receiver, emitter)
        assert len(ranges) == 400 - on_screen and ranges.min() > 55
    both = apparent_ranges([around, screen], ["Screen"], ["Screen"])
    assert both.tobytes() == open_ranges.tobytes()


def test_followers_do_not_see_their_housing():
    """Neither in a world that stands still, nor in one that moves."""
    housing = box("Housing", (0.4, 0.4, 0.4))
    bodies = [housing, box("Crate", (2, 1, 1))]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 5, 0, 0
    lidar = np.eye(4)
    lidar[2, 3] = poses[0, 2, 3] = 1.2
    options = {"static": [level("Ground")], "columns": COLUMNS, "backend": "numpy"}
    blocked = Follower(bodies, GRID, **options).sweep(lidar, poses, number=1)
    assert {*blocked.object.tolist()} == {1}
    follower = Follower(bodies, GRID, unseen=["Housing"], **options)
    without = Follower(bodies[1:], GRID, **options)
    cloud = follower.sweep(lidar, poses, number=1)
    expected = without.sweep(lidar, poses[1:], number=1)
    assert cloud.positions.tobytes() == expected.positions.tobytes()
    assert {*cloud.object.tolist()} == {0, 2}
    images = follower.ranges([lidar], poses), without.ranges([lidar], poses[1:])
    assert np.array_equal(*images)
    clouds = []
    for each, those in ((follower, poses), (without, poses[1:])):
        steps = [each.step(time_s, lidar, those) for time_s in (0.0, 0.05, 0.1)]
        clouds.append(steps[-1][0])
    assert clouds[0].positions.tobytes() == clouds[1].positions.tobytes()
    assert {*clouds[0].object.tolist()} == {0, 2}


def test_patterns_that_match_nothing_are_refused_with_the_names_of_the_scene():
    scene = scene_of(objects("faces"), ("Car",))
    with pytest.raises(LidarError, match=r"unseen contains 'Cra\*', but no object has that name"):
        Scanner(scene, GRID, unseen=["Cra*"], backend="numpy")
    with pytest.raises(LidarError, match=r"Did you mean 'Car'\?|Car"):
        Scanner(scene, GRID, unseen="Cra", backend="numpy")
    survey = Survey(sensors=[Mounted(GRID, name="roof", unseen=["Cra"])], poses=[(0, 0, 1)])
    with pytest.raises(LidarError, match="unseen of sensor 'roof' contains 'Cra'"):
        Job(scene, survey)
    with pytest.raises(LidarError, match="unseen"):
        Mounted(GRID, unseen=[""])


def test_sensors_that_see_the_same_share_trees_also_with_later_surveys(monkeypatch):
    built = []

    class Counted(static_bodies.RayCaster):
        def __init__(self, *given, **options):
            built.append(1)
            super().__init__(*given, **options)

    monkeypatch.setattr(static_bodies, "RayCaster", Counted)
    scene = scene_of(objects("faces"), ("Car", "Van"))
    names = scene.names

    def survey(*unseen):
        sensors = [Mounted(GRID, name=str(k), unseen=those) for k, those in enumerate(unseen)]
        return Survey(sensors=sensors, poses=[(0, 0, 1)], steps=12)

    everything = Rig(scene, survey(()), "numpy")
    assert len(built) == 1
    rig = Rig(scene, survey([names[0]], [names[0], "Car"], ["Van"]), "numpy")
    assert len(built) == 3, "the actors have no trees of static bodies"
    again = rig.with_survey(scene, survey(["Car"], [names[0]]))
    assert len(built) == 3
    assert again.scene_casters[1].caster is rig.scene_casters[0].caster
    assert len({*everything.scene_casters}) == 1


def test_trees_of_sensors_that_see_different_objects_count_as_memory():
    scene = scene_of(objects("faces"), ())

    def survey(*unseen):
        sensors = [Mounted(GRID, name=str(k), unseen=those) for k, those in enumerate(unseen)]
        return Survey(sensors=sensors, poses=[(0, 0, 1)], steps=12)

    one = rig_bytes(scene, survey((), ()))
    assert rig_bytes(scene, survey(["*"], ["*"])) == one
    two = rig_bytes(scene, survey((), [scene.names[0]]))
    three = rig_bytes(scene, survey((), [scene.names[0]], [scene.names[1]]))
    pattern = rig_bytes(scene, survey((), (), ())) - one
    assert two - one == three - two - pattern > 100 * scene.kept_triangles

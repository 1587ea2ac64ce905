"""`repr` of what a user makes is one line."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import lidarpool
from lidarpool import Campaign, CampaignRun, ScanFrame
from lidarreal import Augment, Effects, Insertion
from lidarscenario import Job, Plan, Planning
from lidarsim import (
    Actor,
    Beams,
    Cloud,
    Column,
    Fault,
    Follower,
    Gnss,
    Imu,
    Material,
    Mounted,
    Navigation,
    Noise,
    Optics,
    Packets,
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
    load_sensor,
)
from lidarsim.columns.table import TABLE
from lidarsim.motion.trajectory import Stations

SENSOR = load_sensor("velodyne/vlp16")
MESH = SceneMesh("hall", np.eye(300, 3), np.arange(300).reshape(100, 3))
TRACK = Track(np.arange(100.0), np.ones((100, 3)))
POSES = [Pose((0, 0, i), yaw_deg=i) for i in range(24)]
SURVEY = Survey(SENSOR, poses=POSES, materials=[Material("hall")] * 9, noise=Noise(range_m=0.01))
SCENE = Scene.from_meshes([MESH])
PLANNING = Planning((0, 0), (10, 0), centers=[(5, 0)] * 100, radii=2.0)
THINGS = [
    Actor(MESH, TRACK),
    Augment(rain_mm_h=25, model=SENSOR),
    Effects(actors=(Actor(MESH, TRACK),) * 9, insertions=(Insertion(MESH, 1, 2),) * 9),
    Insertion(MESH, 12, 3, heading_deg=90, class_name="car"),
    Beams.even(128, 40),
    Campaign(lambda number, rng: Job(SCENE, SURVEY), 3),
    CampaignRun(tuple(range(1000)), 3, 1000, 1000, 1.2, 0, 1.3, sensors={"a": "x" * 99}),
    Cloud(np.zeros((1, 3)), {name: [0] for name in TABLE}),
    Column("own", "float32", "m", "a long description " * 20),
    Follower([MESH], SENSOR),
    Job(SCENE, SURVEY, PLANNING, values={str(n): n for n in range(100)}),
    Mounted(SENSOR, Pose((1, 0, 2)), "roof", noise=Noise(range_m=0.01)),
    Navigation(imu=Imu(gyroscope_noise_density=1e-4), gnss=Gnss(horizontal_m=0.02)),
    Packets(SENSOR),
    Plan(np.zeros((90, 2)), 1.2345, 1.2, 0.3, 3, 100),
    PLANNING,
    ScanFrame(0, "", 1, 1, 1, np.zeros((90, 3), np.float32), 1, SURVEY, lambda scan: None),
    Scanner(Scene.seed(), SENSOR),
    SceneInstance(MESH, np.eye(4)),
    MESH,
    SCENE,
    SENSOR,
    load_sensor("livox/mid40"),
    load_sensor("airborne/riegl-vq780i"),
    SURVEY,
    Survey(sensors=[Mounted(SENSOR, name="a"), Mounted(SENSOR, name="b")], trajectory=TRACK),
    SURVEY.trajectory,
    TRACK,
    load_sensor("ouster/os1-64", performance="datasheet").noise,
]  # fmt: skip
SMALL = [
    Pose((0, 0, 1)),
    Returns("dual"),
    Optics(divergence_mrad=3),
    Spin(),
    Material("x"),
    Noise(),
    Fault("dirt", transmission=0.3),
]


@pytest.mark.parametrize("thing", THINGS + SMALL, ids=lambda thing: type(thing).__name__)
def test_it_is_one_line(thing):
    assert len(repr(thing)) < 120 and "\n" not in repr(thing)


def test_every_public_class_is_among_them():
    # Results, comparisons, fits and twins are printed as tables. Robots, scans, sweeps and
    # recordings have tests of their own. The scanners of MuJoCo and Newton require these programs,
    # and views of scanners require a viewer.
    elsewhere = {"Result", "Comparison", "Fit", "PatternFit", "Twin", "Robot", "ScanSpec", "Sweep"}
    elsewhere |= {
        "SurveyComparison",
        "LidarError",
        "MujocoScanner",
        "NewtonScanner",
        "Foxglove",
        "Rerun",
        "Recording",
        "PointCloud",
        "SweepsInMemory",
        "RecordingInfo",
    }
    public = {n for n in lidarpool.__all__ if isinstance(getattr(lidarpool, n), type)}
    parts = {"Imu", "Gnss"}  # of Navigation
    assert (
        public - elsewhere - parts
        == {kind.__name__ for thing in THINGS + SMALL for kind in type(thing).__mro__} & public
    )


def test_it_says_what_differs_from_the_defaults():
    assert repr(Pose((0, 0, 1))) == "Pose(position=(0.0, 0.0, 1.0))"
    assert repr(Stations(tuple(POSES))) == "Stations(at=[24 Pose])"
    assert repr(PLANNING).endswith("centers=float64(100, 2), radii=float64(100,))")
    assert repr(SURVEY).startswith("Survey(sensor=Sensor('Velodyne VLP-16'), poses=[24 Pose], ")
    assert repr(Mounted(SENSOR, noise=Noise(range_m=0.01))) == (
        "Mounted(sensor=Sensor('Velodyne VLP-16'), noise=Noise(range_m=0.01))"
    )
    assert repr(SENSOR).endswith(", …)")


@dataclass(frozen=True, eq=False, repr=False)
class Turned(Sensor):
    table: tuple = ()


@dataclass(frozen=True, eq=False)
class Named(Sensor):
    def __repr__(self):
        return "mine"


def test_another_kind_of_sensor_has_one_too():
    kept = Turned(table=tuple(np.zeros((1000, 3))))
    assert repr(kept) == "Turned(beams=<Beams: 40, -30 to 30 deg>, table=[1000 ndarray])"
    assert repr(replace(kept, name="x")).startswith("Turned(name='x', ")
    assert repr(Named()) == "mine"

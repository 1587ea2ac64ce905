"""Columns that are made on a device, against those that NumPy makes of its own hits."""

from __future__ import annotations

import importlib.resources
import shutil
import subprocess
import tracemalloc
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from tests.cuda_on_host import HOST, source_backend  # noqa: F401 - a fixture
from tests.lidarfiles.test_rig import CART, SURVEYS, TURNED
from tests.lidarfiles.test_rig import COLUMNS as RIG_COLUMNS
from tests.shapes import BALL_AROUND as SPHERE
from tests.shapes import SPIN_OF_128_BEAMS as MANY
from tests.shapes import cast_between

from lidarsim import (
    Actor,
    Column,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    SceneInstance,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.motion.trajectory import Stations
from lidarsim.scene.colors import Colors
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.memory import cast_bytes
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.points.device_columns import OPTIONS, DevicePoints
from lidarsim.simulator.rig import Rig
from raybeam import available_backends, registry

COLUMNS = (
    "ray", "time", "range", "intensity", "reflectance", "class", "triangle", "sensor", "returns",
    "return_number",
)  # fmt: skip
MATERIALS = (
    Material("copy 2", retro=True, semantic_class=7),
    Material("copy*", reflectance=0.8, semantic_class=300),
    Material("*", reflectance=0.3),
)

# One drives through the other, and both past what stands.
WAYS = [[6, -3, 0.5], [6, 7, 0.5]], [[6, 7, 0.8], [7, -3, 0.8]]
ACTORS = tuple(
    Actor(box(f"Car {k}", (4.5, 1.8, 1.5)), Track([0, 2], way)) for k, way in enumerate(WAYS)
)

NEEDS_NUMBA = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")

MODELS = {
    name: Survey(load_sensor(name, step_deg=step), poses=TURNED, steps=14, columns=RIG_COLUMNS)
    for name, step in (
        ("velodyne/vlp16", 10),
        ("ouster/os0-32", 10),
        ("livox/mid40", 30),
        ("airborne/riegl-vq780i", 90),
    )
}
VLP16 = load_sensor("velodyne/vlp16")
MODELS["on the move, beams of several rays"] = Survey(
    VLP16, trajectory=CART, steps=14, columns=RIG_COLUMNS, returns=Returns("all", 7, 3.0)
)


@pytest.fixture(params=["source", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request, monkeypatch):
    """Name of a backend that makes columns on a device: one that the CPU plays, or a real one."""
    if request.param == "source":
        played = request.getfixturevalue("source_backend")
        monkeypatch.setattr(registry, "BACKENDS", (*registry.BACKENDS, played))
    elif reason := available_backends()["cuda"]:
        pytest.skip(f"cuda: {reason}")
    backends = {backend.name: backend for backend in registry.BACKENDS}
    monkeypatch.setattr(backends[request.param], "chunk", 997)
    return request.param


@pytest.fixture(scope="module")
def scenes():
    """The same objects as parts of the scene, and as instances: all, or beside others."""
    objects = []
    for k, mesh in enumerate(seed_objects(rings=8, segments=12)):
        colors = np.random.default_rng(k).integers(0, 256, (len(mesh.faces), 3), np.uint8)
        objects.append(replace(mesh, colors=Colors.from_face_colors(colors)))
    copies = []
    for k, stretch in enumerate((1, 2, -1, 1, 1, 0.5)):
        matrix = np.diag([stretch, 1, 1, 1.0])
        matrix[:2, 2:] = [[0, 2 * k - 5], [0.3, 0.1]]
        copies.append(SceneInstance(objects[1 + k % 3], matrix, f"copy {k}"))
    return {
        "plain": Scene.from_meshes(objects),
        "instances": Scene.from_meshes(copies),
        "both": Scene.from_meshes([*objects, *copies]),
    }


def surveys():
    """Standing and moving sensors of many kinds, their columns those that a device makes."""
    for name, survey in (SURVEYS | MODELS).items():
        if survey.returns.subrays == 1:
            yield name, replace(survey, columns=COLUMNS, keep_every=1 + len(name) % 3)
    two = [load_sensor(name, step_deg=10) for name in ("velodyne/vlp16", "ouster/os0-32")]
    seats = [Mounted(two[0], Pose((1, 0, 0)), "front"), Mounted(two[1], name="rear")]
    yield "two sensors", Survey(sensors=seats, trajectory=CART, steps=3, columns=COLUMNS)
    yield "few columns", Survey(two[0], poses=TURNED, steps=3)


MADE = dict(surveys())


def same(scene, survey, backend, cuts):
    """Cast a survey on the device and with NumPy; all bytes must be equal."""
    rigs = [Rig(scene, survey, name) for name in (backend, "numpy")]
    (got, tally), (want, counted) = (cast_between(rig, survey, cuts) for rig in rigs)
    for name, column in want.items():
        assert got[name] == column, name
    assert tally == counted
    made, plain = (list(rig.cast(*cuts[:2])) for rig in rigs)
    for mine, other in zip(made, plain, strict=True):
        assert isinstance(mine, DevicePoints)
        assert np.array_equal(mine.counts, other.counts)
        assert np.array_equal(mine.hit_counts, other.hit_counts)
        rows = np.arange(0, len(other), 7)
        assert (
            np.abs(mine.positions_of(rows) - other.positions_of(rows)).max(initial=0)
            <= survey.precision_m
        )


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("name", MADE)
def test_columns_have_the_bits_of_numpy(name, scenes, backend):
    survey = MADE[name]
    same(scenes["plain"], survey, backend, (0, 1, survey.scan_count // 2, survey.scan_count))


@pytest.mark.extended
@pytest.mark.parametrize("scene", ["instances", "both"])
@pytest.mark.parametrize("name", ["beams with offsets", "on the move, mounted", "few columns"])
def test_columns_of_instances(scene, name, scenes, backend):
    survey = replace(MADE[name], materials=MATERIALS)
    same(scenes[scene], survey, backend, (0, survey.scan_count))


@pytest.mark.parametrize("scene", ["instances", "both"])
def test_columns_after_instances_have_moved(scene, scenes, backend):
    survey = replace(MADE["beams with offsets"], materials=MATERIALS)
    rigs = [Rig(scenes[scene], survey, name) for name in (backend, "numpy")]
    cast_between(rigs[0], survey, (0, 1))  # its tables are on the device
    owners = scenes[scene].instances.owner[:1]
    for yaw in (40, 80):
        pose = Pose((1.0, 2.0, 0.1), yaw)
        positions = np.array([pose.position])
        rigs = [
            rig.with_moved_instances(owners, positions, pose.rotation_matrix[None]) for rig in rigs
        ]
        got, want = (cast_between(rig, survey, (0, survey.scan_count)) for rig in rigs)
        assert got == want
    assert isinstance(next(rigs[0].cast(0, 1)), DevicePoints)


def test_a_survey_that_hits_nothing(scenes, backend):
    survey = replace(MADE["few columns"], trajectory=Stations((Pose((0, 0, 500)),)), poses=())
    same(scenes["plain"], survey, backend, (0, survey.scan_count))


_SENSOR = MADE["on the move"].mounted_sensors[0].sensor
WITH_FACTORS = replace(
    _SENSOR,
    beams=replace(_SENSOR.beams, intensity_factor=np.linspace(0.5, 2, len(_SENSOR.beams))),
)
WITH_EXPONENT = replace(_SENSOR, optics=replace(_SENSOR.optics, incidence_exponent=0.3))
OWN = Column("own", "float32", "", "of a user", lambda returns: returns.range)
MORE = {
    "a user's column": {"columns": (*COLUMNS, OWN)},
    "angles": {"columns": ("azimuth", "intensity")},
    "haze": {"visibility_km": 2.0},
    "the sensor's axes": {"coordinates": "sensor"},
    "only angles": {"columns": ("elevation",), "keep_every": 4},
    "colors": {"columns": ("red", "blue", "time")},
    "textures": {"materials": [Material("*", "texture", scale=0.7)]},
    "gloss": {"materials": [Material("*", 0.4, roughness=0.3)]},
    "velocities": {"columns": ("radial_velocity",), "noise": Noise(velocity_m_s=0.1)},
    "normals and origins": {
        "columns": (
            *COLUMNS,
            "normal_x",
            "normal_y",
            "normal_z",
            "incidence_deg",
            "origin_x",
            "origin_y",
            "origin_z",
        ),
    },
    "a measured material": {"materials": [Material("*", spectrum="asphalt, dry")]},
    "intensity factors": {"sensor": WITH_FACTORS, "sensors": ()},
    "incidence exponent": {"sensor": WITH_EXPONENT, "sensors": ()},
}


@pytest.mark.extended(every=12)
@pytest.mark.slow(every=3)
@pytest.mark.parametrize(
    "actors",
    [pytest.param((), id=""), pytest.param(ACTORS, id="actors", marks=NEEDS_NUMBA)],
)
@pytest.mark.parametrize("name", MORE)
def test_numpy_makes_the_other_columns_of_the_hits(name, actors, scenes, backend):
    survey = replace(MADE["on the move"], **MORE[name])
    same(scenes["both"].with_actors(actors), survey, backend, (0, 3, survey.scan_count))


OTHERS = {"sub-rays": {"returns": Returns("all", 7, 3.0)}, "noise": {"noise": Noise(range_m=0.01)}}


@pytest.mark.parametrize("name", OTHERS)
def test_pulses_and_noise_are_made_on_the_host(name, scenes, backend):
    survey = replace(MADE["on the move"], **OTHERS[name])
    rigs = [Rig(scenes["plain"], survey, which) for which in (backend, "numpy")]
    got, want = (cast_between(rig, survey, (0, survey.scan_count)) for rig in rigs)
    assert got == want
    assert not isinstance(next(rigs[0].cast(0, 1)), DevicePoints)


@pytest.mark.extended(every=5)
@NEEDS_NUMBA
@pytest.mark.parametrize("scene", ["plain", "instances", "both"])
@pytest.mark.parametrize("name", ["beams with offsets", "on the move, mounted", "few columns"])
def test_columns_of_actors(scene, name, scenes, backend):
    survey = replace(MADE[name], materials=[Material("Car*", 0.7, 40), *MATERIALS])
    if scene == "plain":
        survey = replace(survey, materials=())
    same(scenes[scene].with_actors(ACTORS), survey, backend, (0, 3, survey.scan_count))


@pytest.mark.extended
def test_a_sweep_keeps_no_page_locked_memory(scenes, backend):
    sensor = MADE["few columns"].sensor
    clouds = [
        Scanner(scenes["both"], sensor, columns=COLUMNS, backend=name).sweep(Pose((0, 0, 1)))
        for name in (backend, "numpy")
    ]
    for name, values in clouds[0].columns.items():
        owner = values if values.base is None else values.base
        assert isinstance(owner, np.ndarray) and owner.flags.owndata, name
        assert np.array_equal(values, clouds[1].columns[name]), name


@pytest.mark.extended
@pytest.mark.parametrize(
    "actors",
    [pytest.param((), id=""), pytest.param(ACTORS, id="actors", marks=NEEDS_NUMBA)],
)
def test_images_of_ranges(actors, scenes, backend):
    scene = scenes["both"].with_actors(actors)
    poses = np.array([[0, 0, 1], [2, -1, 1.5], [0, 0, 900]])
    images = [
        Scanner(scene, MADE["few columns"].sensor, backend=name).ranges(poses, start_s=0.5)
        for name in (backend, "numpy")
    ]
    assert np.array_equal(*images)
    assert np.isfinite(images[0][0]).any()
    assert np.isinf(images[0][2]).all()


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("stations", [1, 20])
@pytest.mark.parametrize("more", [(), ("azimuth",)], ids=["", "hits"])
def test_rounded_and_joined_columns_are_in_the_estimate(more, stations, backend, monkeypatch):
    if backend == "cuda":
        pytest.skip("CuPy's own pool takes page-locked memory")
    taken = []

    def rounded(size):  # as CuPy's pool does
        taken.append(1 << (size - 1).bit_length())
        return bytearray(size)

    monkeypatch.setattr(HOST.cuda, "alloc_pinned_memory", rounded)
    poses = [(0, 0, 1)] * stations
    survey = Survey(MANY, poses, steps=20 // stations, columns=(*COLUMNS, *more))
    rig = Rig(SPHERE, survey, backend)
    tracemalloc.start()
    try:
        found = list(rig.cast(0, 20))
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        columns_of(found)
        joined = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert joined + sum(taken) < cast_bytes(SPHERE, survey, 20, on_device=True)


@pytest.mark.parametrize("card", ["75", "120"])
def test_the_kernel_compiles_without_spills(card, tmp_path):
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("nvcc is not here")
    known = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True).stdout
    if f"compute_{card}" not in known.split():
        pytest.skip(f"this nvcc does not know sm_{card}")
    source = importlib.resources.files("lidarsim.simulator.points") / "columns.cu"
    done = subprocess.run(
        [nvcc, *OPTIONS, f"-arch=sm_{card}", "-cubin", "-Xptxas", "-v", "-o",
         str(tmp_path / "out"), str(source)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    assert "0 bytes spill stores, 0 bytes spill loads" in done.stderr

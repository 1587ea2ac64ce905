"""Planes of hundreds of kilometers: what no sensor can reach is left out, and no point changes."""

from __future__ import annotations

import numpy as np
import pytest
from tests.shapes import level

from lidarfiles.parts.parts import pack
from lidarsim import (
    Actor,
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
    Survey,
    Track,
    box,
)
from lidarsim.casting import static_bodies
from lidarsim.casting.clipping import box_planes, clip_triangles
from lidarsim.columns.table import OPTIONAL
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

COLUMNS = [column.name for column in OPTIONAL if not column.name.startswith("flow")]
GRID = Sensor.grid(rays_per_revolution=120, layers=8, step_deg=30, max_range_m=40)
HERE = Pose((0.5, -0.3, 1.1), 20, 3, -2)
PHYSICS = {
    "materials": [Material("Bowl", specular_reflectance=1), Material("*", 0.5)],
    "returns": Returns("dual", 7, 3.0),
    "noise": Noise(0.02, angle_deg=0.05, dropout=0.1, detection_range_m=150, seed=5),
    "rain_mm_h": 20.0,
}
DRIVE = Track([0, 0.5], [[-3, 0.1, 1.2], [3, 0.4, 1.2]])
CUT = ("Ground", "Wall", "Post")
REMOTE = (70_000.0, -20.0, 1.5)


def plane(name, half, **options):
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) * half
    return SceneMesh(name, corners, np.array([[0, 1, 2], [0, 2, 3]]), **options)


def vast(kind):
    """A scene with a plane of 400 km: faces, instances that stand upright, or with a mask."""
    meshes = [*seed_objects(rings=8, segments=12)]
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, 9], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    if kind == "faces":
        meshes.append(plane("Ground", 2e5))
    elif kind == "instances":
        meshes += [level("Floor"), box("Post", (1, 1, 2e5))]
        meshes += [SceneInstance(plane("Wall", 2e5), upright)]
        meshes += [SceneInstance(box("Crate", (2, 1, 1)), Pose((x, -4, 0))) for x in (5, 3e5)]
    else:
        tiles = np.array([[[0, 0], [1e5, 0], [1e5, 1e5]]], np.float32)
        mask = Cutout(np.array([[True, False], [False, True]]), tiles)
        meshes += [level("Floor"), SceneInstance(plane("Wall", 2e5, cutouts=(mask,)), upright)]
    car = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 9], [[6, -3, 0], [6, 7, 0]]))
    return Scene.from_meshes(meshes).with_actors([car])


@pytest.fixture
def uncut(monkeypatch):
    """Return a function that makes a scanner of whole scenes."""

    def make(scene, **options):
        with monkeypatch.context() as patch:
            patch.setattr(static_bodies, "MAX_REACH_M", np.inf)
            return Scanner(scene, GRID, columns=COLUMNS, **options)

    return make


def same(scene, cloud, whole):
    """Return whether points are equal, and are on cut and other triangles.

    On cut triangles, numbers in single precision may differ in their last bit: distances on large
    triangles are less exact. The same applies to true positions in double precision everywhere,
    because they are not rounded.
    """
    assert cloud.positions.tobytes() == whole.positions.tobytes()
    is_cut = np.isin(cloud.object, [i for i, n in enumerate(scene.names) if n in CUT])
    for name, values in whole.columns.items():
        if name.startswith("true_"):
            assert np.allclose(cloud[name], values, rtol=0, atol=1e-9)
            continue
        assert cloud[name][~is_cut].tobytes() == values[~is_cut].tobytes(), name
        assert np.allclose(cloud[name], values, rtol=3e-7, atol=0, equal_nan=True), name
    return is_cut.sum() > 20 and (~is_cut).sum() > 20


@pytest.mark.extended
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
@pytest.mark.parametrize("physics", [{}, PHYSICS], ids=["plain", "effects"])
@pytest.mark.parametrize("kind", ["faces", "instances", "masks"])
def test_points_are_those_of_the_whole_scene(kind, physics, backend, uncut):
    scene = vast(kind)
    options = {"backend": backend, **physics}
    scanner = Scanner(scene, GRID, columns=COLUMNS, **options)
    whole = uncut(scene, **options)
    assert same(scene, scanner.sweep(HERE, number=1), whole.sweep(HERE, number=1))
    for pose in (REMOTE, DRIVE):
        cloud = scanner.sweep(pose, number=1)
        assert (
            len(cloud)
            and cloud.positions.tobytes() == whole.sweep(pose, number=1).positions.tobytes()
        )
    poses = [HERE, (0, 0, 1), REMOTE]
    images = [each.ranges(poses, number=2) for each in (scanner, whole)]
    assert np.allclose(*images, rtol=1e-7) and np.isfinite(images[0]).any(axis=(1, 2)).all()
    triangles = scanner._rig.scene_casters[0].caster.face_count
    assert triangles < whole._rig.scene_casters[0].caster.face_count + 100


def test_a_survey_is_that_of_the_whole_scene(monkeypatch):
    """Of two stations, and with counts of hits by triangles."""
    scene = vast("faces")
    survey = Survey(sensors=[Mounted(GRID)], poses=[HERE, Pose(REMOTE)], steps=12)

    def scan():
        return pack(columns_of(list(Rig(scene, survey, "numpy").cast(0, survey.scan_count))))

    cut_scene = scan()
    monkeypatch.setattr(static_bodies, "MAX_REACH_M", np.inf)
    assert cut_scene == scan()


def test_instances_that_are_cut_or_left_out_can_move(uncut):
    scene = vast("instances")
    scanner = Scanner(scene, GRID, columns=COLUMNS, backend="numpy")
    whole = uncut(scene, backend="numpy")
    tilted = Pose((0, 6, 0), yaw_deg=10, roll_deg=80)
    for poses in ([tilted, (-4, 3, 0.2)], [(0, 0, -0.4), (9e4, 0, 0)], [tilted, (2, -3, 0)]):
        for each in (scanner, whole):
            each.move(["Wall", "Crate.2"], poses)
        assert same(scene, scanner.sweep(HERE, number=1), whole.sweep(HERE, number=1))


@pytest.mark.extended
def test_bodies_that_fall_for_ever_are_left_out(uncut):
    """And are there again once they are put back."""
    crates = [SceneInstance(box("Crate", (2, 1, 1)), Pose((x, -4, 0))) for x in (5, -5, 0)]
    scene = Scene.from_meshes([*seed_objects(rings=8, segments=12), level("Ground"), *crates])
    names = ["Crate", "Crate.2", "Crate.3"]
    scanner = Scanner(scene, GRID, columns=COLUMNS, backend="numpy")
    whole = uncut(scene, backend="numpy")
    in_trees = []
    for x, depth, height in ((5, 0, 0), (5, -2e5, 1), (4, -3e5, 2), (3, -4e5, -1e6), (6, 0, 0)):
        for each in (scanner, whole):
            each.move(names, [(x, -4, 0), (-5, -4, depth), (0, 5, height)])
        cloud = scanner.sweep(HERE, number=1)
        expected = whole.sweep(HERE, number=1)
        assert len(cloud) > 300 and np.array_equal(cloud.object, expected.object)
        assert np.abs(cloud.positions - expected.positions).max() <= 0.002
        in_trees.append(scanner._rig.scene_casters[0].caster.instance_count - 1)
    assert in_trees == [3, 2, 2, 1, 3]


def test_parts_of_triangles_cover_the_box_and_share_corners():
    ground = plane("Ground", 1e6)
    shifted = ground.vertices + np.array([9.0, 12, 0.5])
    vertices = np.concatenate([shifted, [[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    faces = np.concatenate([ground.faces, [[4, 5, 6]], ground.faces])
    region = np.array([[-100.0, -50, -10], [100, 70, 10]])
    parts = clip_triangles(vertices, faces, box_planes(region))
    assert {*parts.origin.tolist()} == {*range(5)} and (np.diff(parts.origin) >= 0).all()
    corners = parts.vertices[parts.faces]
    assert (corners >= region[0] - 1e-9).all() and (corners <= region[1] + 1e-9).all()
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert np.isclose(areas[parts.origin < 2].sum() / 2, 200 * 120)
    on_diagonal = np.abs(corners[..., 0] - corners[..., 1] + 3) < 1e-6
    first, second = (
        np.unique(corners[on_diagonal & (parts.origin == face)[:, None]], axis=0) for face in (0, 1)
    )
    assert len(first) == 2 and np.array_equal(first, second)
    assert clip_triangles(vertices[4:], faces[:1] * 0 + [0, 1, 2], box_planes(region)) is None


@pytest.mark.extended
def test_a_note_says_what_is_left_out(caplog):
    Scanner(vast("faces"), GRID, backend="numpy")
    (record,) = caplog.records
    assert "the scene is 400 km wide, but the sensor measures up to 40 m" in record.getMessage()
    caplog.clear()
    Scanner(vast("faces"), Sensor.grid(64), backend="numpy")  # of any range
    Scanner(Scene.seed(), GRID, backend="numpy")
    assert not caplog.records

"""A scene of instances, and the same with each instance copied: the same to all that ask."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.shapes import tally_of

from lidarsim import (
    Actor,
    LidarError,
    Material,
    Noise,
    Pose,
    Returns,
    Scene,
    SceneInstance,
    SceneMesh,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.columns.table import SCAN
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

SPHERE = seed_objects(rings=8, segments=12)[0]
SPHERE = SceneMesh(SPHERE.name, SPHERE.vertices + np.array([20, 20, 0]), SPHERE.faces)
GRATE = SceneMesh(
    "Grate",
    np.array([[0, -2, 0], [0, 2, 0], [0, 2, 2], [0, -2, 2.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
    (Cutout(np.array([[True, False]]), np.array([[[0, 0], [2, 0], [2, 2]]], np.float32)),),
)
BUSH = join_meshes("Bush", [box("Stem", (1, 2, 1)), GRATE])  # solid and with holes
MESHES = (SPHERE, box("Crate", (2, 1, 1.5)), BUSH)
CAR = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 1], [[6, -3, 0], [6, 7, 0]]))
PHYSICS = [
    {},
    {"keep_every": 3},
    {"returns": Returns("all", 7, 3.0), "noise": Noise(0.02, angle_deg=0.05, seed=5)},
    {
        "materials": [
            Material(["Crate", "Bush.?"], transparent="pass"),
            Material("Sphere*", specular_reflectance=1),
            Material("*", 0.5, semantic_class=2),
        ],
        "returns": Returns("dual"),
        "visibility_km": 1.0,
    },
]
ALWAYS = [(k, ((5.0, 4 * k - 4, 0.1), (20, 0, 0), (1, 1, 1))) for k in (0, 1, 2, 2)]
COLUMNS = ["ray", "return_number", "range", "triangle", "intensity", "class"]
SENSOR = load_sensor("velodyne/vlp16", max_range_m=60)

factors = st.floats(0.4, 2.0)
angles = st.floats(-180, 180)
places = st.tuples(st.floats(-15, 15), st.floats(-15, 15), st.floats(-1, 2))
transforms = st.builds(
    lambda at, turn, scale, mirrored: (at, turn, (*scale[:2], scale[2] * (-1) ** mirrored)),
    places,
    st.tuples(angles, angles, angles),
    st.tuples(factors, factors, factors),
    st.booleans(),
)


def scenes(placed, far):
    """A ground and instances, and the same without instances."""
    offset = np.array([5e5, 4e6, 100.0]) * far
    ground = box("Ground", (60, 60, 0.2))
    objects = [SceneMesh("Ground", ground.vertices + offset, ground.faces)]
    # Bushes come last, because what has holes is an instance in both.
    for k, (number, (at, turn, scale)) in enumerate(sorted([*ALWAYS, *placed])):
        matrix = np.eye(4)
        turned = Pose((0, 0, 0), *turn).rotation
        matrix[:3, :3] = (np.eye(3) if turned is None else turned) * scale
        # A little apart: of two faces in one place, either may be hit.
        matrix[:3, 3] = at + offset + k * np.array([0.0137, 0.0071, 0.0033])
        objects.append(SceneInstance(MESHES[number], matrix))
    flat = [one.flat() if isinstance(one, SceneInstance) else one for one in objects]
    return Scene.from_meshes(objects), Scene.from_meshes(flat)


def hits_by_object(scene, tally):
    owner = scene.face_object
    if scene.instances is not None:
        owner = np.append(owner, scene.instances.owner)
    moving = np.repeat(len(scene.names), len(tally) - len(owner))
    return np.bincount(np.append(owner, moving), tally, len(scene.names) + 1)


def scanned(scene, physics):
    """Cloud of some scans, its rows by (scan, ray, return), and hits by object."""
    survey = Survey(SENSOR, poses=[(-19.3, 0.4, 2.2)], steps=18, columns=COLUMNS, **physics)
    batches = list(Rig(scene, survey, "tiles").cast(0, survey.scan_count))
    table = (SCAN, *(c for c in survey.stored_columns if c.name not in "xyz"))
    cloud = columns_of(batches).cloud(table, survey.precision_m, scene.origin)
    keys = np.stack([cloud[name] for name in ("scan", "ray", "return_number")], axis=1).tolist()
    hits = hits_by_object(scene, tally_of(batches))
    return {tuple(key): row for row, key in enumerate(keys)}, cloud, hits


@pytest.mark.slow
@settings(max_examples=30)
@given(
    placed=st.lists(st.tuples(st.integers(0, 2), transforms), max_size=6),
    far=st.booleans(),
    actor=st.booleans(),
    physics=st.sampled_from(PHYSICS),
)
def test_instances_and_their_copies_are_scanned_alike(placed, far, actor, physics):
    shared, flat = scenes(placed, far)
    assert shared.names == flat.names and shared.triangles == flat.triangles
    assert np.array_equal(shared.origin, flat.origin)
    for of in ("bounds", "object_bounds", "footprints"):
        np.testing.assert_allclose(getattr(shared, of), getattr(flat, of), atol=1e-7)
    actors = [CAR] if actor else []
    (rows, one, hits), (others, other, more) = (
        scanned(scene.with_actors(actors), physics) for scene in (shared, flat)
    )
    both = [(rows[key], others[key]) for key in rows.keys() & others.keys()]
    # A ray that touches an edge may pass it by in one of them.
    assert len(both) >= 0.995 * max(len(rows), len(others)) > 20
    mine, theirs = np.array(both).T
    alike = one["object"][mine] == other["object"][theirs]
    assert alike.mean() > 0.995
    mine = mine[alike]
    theirs = theirs[alike]
    off = np.abs(one["range"][mine].astype(float) - other["range"][theirs])
    assert (off < 1e-5).mean() > 0.99 if "returns" in physics else (off < 1e-5).all()
    near = np.isclose(one["intensity"][mine], other["intensity"][theirs], rtol=1e-4)
    assert near.mean() > 0.99
    assert np.array_equal(one["class"][mine], other["class"][theirs])
    solid = one["object"][mine] < shared.names.index("Bush")
    assert np.mean((one["triangle"][mine] == other["triangle"][theirs])[solid]) > 0.995
    assert np.abs(hits - more).max() <= 0.005 * hits.sum() + 2


def test_instances_can_be_given_by_a_pose():
    by_pose = SceneInstance(SPHERE, Pose((1, 2, 3), 30, 20, 10), "Other")
    moved = SPHERE.vertices @ Pose((0, 0, 0), 30, 20, 10).rotation.T + (1, 2, 3)
    assert by_pose.name == "Other" and np.allclose(by_pose.flat().vertices, moved)


def test_several_instances_are_refused_as_one_is():
    flat = np.tile(np.eye(4), (3, 1, 1))
    assert [one.name for one in SceneInstance.from_matrices(SPHERE, flat, "V")] == ["V"] * 3
    flat[1, 2, 2] = 0
    with pytest.raises(LidarError, match="flattens the mesh"):
        SceneInstance.from_matrices(SPHERE, flat, "V")

"""Meshes that deform: animations of glTF files, wheels, and how actors play them."""

import json
from base64 import b64encode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.meshes import write
from tests.shapes import made

from lidarfiles import save_cloud
from lidarfiles.clouds.boxes import Boxes
from lidarfiles.picture_file import PictureContent
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import (
    Actor,
    Cloud,
    LidarError,
    Material,
    Scanner,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
)
from lidarsim.motion.rotations import matrices
from lidarsim.scene.actors import distinct_meshes, join_meshes
from lidarsim.scene.animation import MAX_PICTURED_VERTICES, Animation
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.scene.wheels import animate_wheels
from lidarsim.sweeps.sweeps import Sweeps

KINDS = {"f": 5126, "B": 5121, "H": 5123}
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class File:
    """A .gltf in the making."""

    def __init__(self):
        self.body = b""
        self.header = {
            "asset": {"version": "2.0"}, "nodes": [], "meshes": [], "accessors": [],
            "bufferViews": [], "animations": [{"name": "Move", "channels": [], "samplers": []}],
        }  # fmt: skip

    def stored(self, numbers, kind="f", width=1, **more):
        array = np.array(numbers, kind)
        views = self.header["bufferViews"]
        accessors = self.header["accessors"]
        views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": array.nbytes})
        self.body += array.tobytes() + bytes(-array.nbytes % 4)
        accessors.append({"bufferView": len(views) - 1, "componentType": KINDS[kind],
                          "type": SHAPES[width], "count": array.size // width, **more})  # fmt: skip
        return len(accessors) - 1

    def moved(self, node, path, keys, values, how="LINEAR"):
        found = self.header["animations"][0]
        width = {"weights": 1, "rotation": 4}.get(path, 3)
        sampler = {"input": self.stored(keys), "output": self.stored(values, width=width)}
        found["samplers"].append(sampler | {"interpolation": how})
        target = {"node": node, "path": path}
        found["channels"].append({"sampler": len(found["samplers"]) - 1, "target": target})

    def write(self, path):
        self.header["buffers"] = [
            {"byteLength": len(self.body), "uri": "data:;base64," + b64encode(self.body).decode()}
        ]
        return write(path, json.dumps(self.header))


CORNERS = np.array([[0, 0, 0], [1, 0, 0.2], [0, 2, 0], [1, 2.5, 0], [0.5, 4, 1]], "f")
FACES = [0, 1, 2, 1, 3, 2, 2, 3, 4]
JOINTS = [[0, 1, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]]
WEIGHTS = [[1, 0, 0, 0], [0.75, 0.25, 0, 0], [0.5, 0.5, 0, 0], [0.6, 0.6, 0, 0], [1, 0, 0, 0]]
KEYS = [0.25, 0.5, 1.0, 1.25]
TURNS = [[0, 0, 0, 1], [0, 0, 0.6, 0.8], [0.48, 0.6, 0, 0.64], [0, 0, 0, -1]]
MOVES = [[0, 1, 0], [0.5, 1, 0], [0.5, 1, 2], [0, 1, 0]]
TARGET = np.array([[0, 0, 1], [0, 0, 0], [0.5, 0, 0], [0, 0, 0], [0, 1, 0]], "f")


def skinned():
    """A strip with two joints, the second of which turns, moves and is scaled; two targets."""
    made = File()
    header = made.header
    bound = np.tile(np.eye(4), (2, 1, 1))
    bound[1, 3, :3] = 0, -1, 0  # columns
    attributes = {
        "POSITION": made.stored(CORNERS, width=3),
        "JOINTS_0": made.stored(JOINTS, "B", 4),
        "WEIGHTS_0": made.stored(WEIGHTS, width=4),
    }
    primitive = {"attributes": attributes, "indices": made.stored(FACES, "H")}
    primitive["targets"] = [{"POSITION": made.stored(t, width=3)} for t in (TARGET, -2 * TARGET)]
    header["meshes"] = [{"primitives": [primitive], "weights": [0.5, 0]}]
    header["skins"] = [{"joints": [1, 2], "inverseBindMatrices": made.stored(bound, width=16)}]
    header["nodes"] = [
        {"name": "Strip", "mesh": 0, "skin": 0, "translation": [9, 9, 9]},  # does not count
        {"children": [2], "translation": [3, 0, 0], "rotation": [0.6, 0, 0, 0.8]},
        {"translation": [0, 1, 0]},
    ]
    header["scenes"] = [{"nodes": [0, 1]}]
    header["scene"] = 0
    return made


def quaternion(x, y, z, w):
    """Matrix of a unit quaternion, by products of it and a vector."""
    out = np.zeros((3, 3))
    for column, unit in enumerate(np.eye(3)):
        axis = np.array([x, y, z])
        out[:, column] = unit + 2 * np.cross(axis, np.cross(axis, unit) + w * unit)
    return out


def between(keys, values, at, how):
    """Value at a time of the specification's three interpolations, written out for one number."""
    values = np.array(values, float)
    k = max(0, min(len(keys) - 2, sum(key <= at for key in keys) - 1))
    u = min(max((at - keys[k]) / (keys[k + 1] - keys[k]), 0.0), 1.0)
    if how == "STEP":
        return values[k + 1] if u == 1 else values[k]
    if how == "CUBICSPLINE":
        long = keys[k + 1] - keys[k]
        (_, p, out), (into, q, _) = values[3 * k : 3 * k + 3], values[3 * k + 3 : 3 * k + 6]
        return ((2 * u**3 - 3 * u**2 + 1) * p + long * (u**3 - 2 * u**2 + u) * out
                + (3 * u**2 - 2 * u**3) * q + long * (u**3 - u**2) * into)  # fmt: skip
    if values.shape[1] == 4:
        p = values[k]
        q = values[k + 1]
        q = q if p @ q >= 0 else -q
        angle = np.arccos(min(p @ q, 1.0))
        if angle < 1e-6:
            return p
        return (np.sin((1 - u) * angle) * p + np.sin(u * angle) * q) / np.sin(angle)
    return (1 - u) * values[k] + u * values[k + 1]


def expected(at, how, turns, moves, scales, weights):
    """Vertices of `skinned` at a time, one by one."""
    turn = between(KEYS, turns, at, how)
    inner = np.eye(4)
    inner[:3, :3] = quaternion(*turn / np.linalg.norm(turn)) * between(KEYS, scales, at, how)
    inner[:3, 3] = between(KEYS, moves, at, how)
    outer = np.eye(4)
    outer[:3, :3] = quaternion(0.6, 0, 0, 0.8)
    outer[:3, 3] = [3, 0, 0]
    back = np.eye(4)
    back[1, 3] = -1
    joints = outer, outer @ inner @ back
    first, second = between(KEYS, weights, at, how)
    out = []
    for corner, target, own, shares in zip(CORNERS, TARGET, JOINTS, WEIGHTS, strict=True):
        point = np.append(corner + first * target - 2 * second * target, 1)
        moved = sum(share * joints[joint] @ point for joint, share in zip(own, shares, strict=True))
        out.append(moved[:3] / sum(shares))
    return np.array(out)


@pytest.mark.parametrize("how", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_skins_targets_and_nodes_are_where_the_specification_says(tmp_path, how):
    """At five times, by an evaluation of one vertex at a time."""
    made = skinned()
    random = np.random.default_rng(1)
    scales = [[1, 1, 1], [1, 2, 1], [0.5, 1, 1], [1, 1, 1]]
    weights = [[0, 1], [1, 0], [0, 0], [1, 1]]
    given = {"rotation": TURNS, "translation": MOVES, "scale": scales, "weights": weights}
    if how == "CUBICSPLINE":  # with tangents before and after each
        for path, v in given.items():
            before, after = random.normal(0, 0.3, (2, *np.shape(v)))
            given[path] = np.stack([before, v, after], axis=1).reshape(-1, np.shape(v)[1])
        given = {path: values.astype("f") for path, values in given.items()}
    for path, values in given.items():
        made.moved(
            2 if path != "weights" else 0, path, KEYS, np.array(values, "f").reshape(-1), how
        )
    found = load_objects(made.write(tmp_path / "m.gltf"), animation="Move", up_axis="z")
    mesh = join_meshes("Strip", found.static)
    poses = mesh.animation.vertices
    assert poses.shape == (61, 5, 3) and mesh.animation.step_s == pytest.approx(1 / 60)
    for frame in (0, 7, 30, 52, 60):
        at = 0.25 + frame / 60
        own = (given[path] for path in ("rotation", "translation", "scale", "weights"))
        np.testing.assert_allclose(poses[frame], expected(at, how, *own), atol=2e-6)
    np.testing.assert_array_equal(mesh.vertices, poses[0])


def test_a_wheel_of_a_file_turns_as_animated_even_if_it_shrinks_to_nothing(tmp_path):
    made = skinned()
    del made.header["skins"], made.header["nodes"][0]["skin"]
    made.moved(0, "rotation", [0, 1], [0, 0, 0, 1, 0, 0, 1, 0])
    made.moved(0, "scale", [0, 0.5, 1], [1, 1, 1, 0, 0, 0, 1, 1, 1])
    found = load_objects(made.write(tmp_path / "m.gltf"), animation="", up_axis="z")
    poses = found.static[0].animation.vertices
    start = poses[0] - 9
    np.testing.assert_allclose(poses[30], 9 + 0 * start, atol=1e-6)
    np.testing.assert_allclose(poses[60], 9 + start * [-1, -1, 1], atol=1e-5)
    root = 0.5**0.5
    turned = start @ np.array([[-root, root, 0], [-root, -root, 0], [0, 0, 1]])
    np.testing.assert_allclose(poses[45], 9 + turned / 2, atol=1e-5)


@pytest.mark.parametrize(
    ("edit", "name", "message"),
    [
        (lambda h: None, "Moev", r"m.gltf has no animation 'Moev' \(Did you mean 'Move'\?\)\.$"),
        (lambda h: None, "Walk", r"has no animation 'Walk' \(the animations are Move\)"),
        (lambda h: h.pop("animations"), "", "Export it with animations, or remove"),
        (lambda h: h["skins"][0].update(joints=[]), "Move", "has a skin without joints"),
        (lambda h: h["accessors"][h["skins"][0]["inverseBindMatrices"]].update(count=1), "Move",
         "cannot reshape"),
        (lambda h: h["accessors"][-2].update(count=1), "Move", "without a duration"),
        (lambda h: h["nodes"][2].update(matrix=np.eye(4).ravel().tolist()), "Move",
         "node 2 is animated but has a matrix"),
        (lambda h: h["animations"][0]["samplers"][0].update(input=0), "Move",
         "finite and increasing"),
        (lambda h: h["animations"][0]["channels"][0]["target"].update(node=9), "Move",
         "refers to index 9 of its nodes"),
        (lambda h: h["animations"][0].update(channels=[]), "Move", "not move any node"),
        (lambda h: h["animations"][0].update(samplers=[]), "Move", "without a duration"),
        (lambda h: h["animations"][0]["samplers"][0].update(interpolation="EASE"), "", "'EASE'"),
        (lambda h: (h["animations"][0]["samplers"][0].update(interpolation="CUBICSPLINE"),
                    h["accessors"][-1].update(type="SCALAR", count=12)), "Move",
         "keyframes of a translation must have 3 numbers, but have 1"),
        (lambda h: h["animations"][0]["channels"][0]["target"].update(node=0, path="weights"),
         "Move", "node 0 has 3 animated weights"),
    ],
)  # fmt: skip
def test_unusable_animations_are_refused_in_a_line(tmp_path, edit, name, message):
    made = skinned()
    made.moved(2, "translation", KEYS, np.reshape(MOVES, -1))
    edit(made.header)
    path = made.write(tmp_path / "m.gltf")
    with pytest.raises(LidarError, match=message) as told:
        load_objects(path, animation=name)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("keys", "way", "message"),
    [([0, 1e9], 1, "would unpack to .*[.] Shorten its animation"),
     ([0, 1], 1e30, "farther than anything on Earth")],
)  # fmt: skip
def test_endless_animations_and_ways_are_refused(tmp_path, keys, way, message):
    made = skinned()
    made.moved(2, "translation", keys, [0, 1, 0, way, 1, 0])
    with pytest.raises(LidarError, match=message):
        load_objects(made.write(tmp_path / "m.gltf"), animation="Move")


def test_where_the_node_of_a_skin_is_does_not_matter(tmp_path):
    """Even if it has no size meanwhile."""
    poses = []
    for shrinks in (False, True):
        made = skinned()
        made.moved(2, "translation", KEYS, np.reshape(MOVES, -1))
        if shrinks:
            made.moved(0, "scale", [0.25, 0.75, 1.25], [1, 1, 1, 0, 0, 0, 1, 1, 1])
        found = load_objects(made.write(tmp_path / "m.gltf"), animation="Move")
        poses.append(found.static[0].animation.vertices)
    assert np.array_equal(*poses)


@pytest.mark.slow
def test_a_chain_of_many_joints(tmp_path):
    """Each turns by a part of 90°: the last one goes around a circle's quarter."""
    made = skinned()
    count = 200
    first = np.eye(4)[None].repeat(count, axis=0)
    first[:, 3, 1] = -np.arange(count) / count  # columns
    attributes = made.header["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = made.stored([[count - 1, 0, 0, 0]] * 5, "H", 4)
    attributes["WEIGHTS_0"] = made.stored([[1, 0, 0, 0]] * 5, width=4)
    made.header["skins"] = [
        {"joints": list(range(1, count + 1)), "inverseBindMatrices": made.stored(first, width=16)}
    ]
    made.header["nodes"] = [
        {"mesh": 0, "skin": 0, "weights": [0, 0]}, {"children": [2]},
        *({"translation": [0, 1 / count, 0], "children": [k]} for k in range(3, count + 1)),
        {"translation": [0, 1 / count, 0]},
    ]  # fmt: skip
    half = np.pi / 4 / count
    for joint in range(1, count + 1):
        made.moved(joint, "rotation", [0, 1], [0, 0, 0, 1, 0, 0, np.sin(half), np.cos(half)])
    found = load_objects(made.write(tmp_path / "m.gltf"), animation="Move", up_axis="z")
    poses = found.static[0].animation.vertices
    np.testing.assert_allclose(poses[0], CORNERS, atol=1e-4)
    tip = np.array([0, (count - 1) / count, 0])
    x, y, z = (CORNERS - tip).T
    arc = 2 / np.pi * np.array([-1, 1, 0])
    np.testing.assert_allclose(poses[60], np.stack([-y, x, z], axis=1) + arc, atol=3e-3)


def test_only_gltf_has_animations(tmp_path):
    path = write(tmp_path / "m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(LidarError, match=r"support animation \(an option of \.glb \.gltf"):
        load_objects(path, animation="Walk")


PERSON = Path(__file__).parents[2] / "examples" / "pedestrian.glb"
FLOOR = replace(
    box("Floor", (90, 90, 0.1)), vertices=box("Floor", (90, 90, 0.1)).vertices - [0, 0, 0.1]
)


@pytest.fixture(scope="module")
def walker():
    """The example's person, whose animation is made for 1.4 m/s."""
    mesh = join_meshes("Walker", load_objects(PERSON, animation="Walk").static)
    return replace(mesh, animation=replace(mesh.animation, speed_m_s=1.4))


def moving_box(velocity, seconds=1.0):
    """A box of 1 m whose vertices move evenly, by its own axes."""
    mesh = box("Piston", (1, 1, 1))
    poses = np.stack([mesh.vertices, mesh.vertices + np.multiply(velocity, seconds)])
    return replace(mesh, animation=Animation(poses, seconds))


@pytest.mark.parametrize("backend", ["tiles", "numpy"])
def test_radial_velocities_are_of_the_triangle_and_its_actor(backend):
    """2 m/s along the axes of an actor that is turned by a quarter and drives at 3 m/s."""
    way = Track([0, 1], [[6, 0, -0.5], [6, 0, 2.5]], [[0, 0, 0.5**0.5, 0.5**0.5]] * 2)
    scene = Scene.from_meshes([FLOOR]).with_actors([Actor(moving_box((2, 0.5, 0)), way)])
    columns = ["radial_velocity", "object", "time", "range"]
    scanner = Scanner(
        scene, Sensor.grid(720, 40), columns=columns, backend=backend, precision_m=1e-6
    )
    found = scanner.sweep((0, 0, 1), start_s=0.3)
    own = found["object"] == 1
    assert own.sum() > 50
    ways = found.positions[own] - [0, 0, 1]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    expected = ways @ [-0.5, 2, 3]
    # Its side is where it is then.
    np.testing.assert_allclose(found["radial_velocity"][own], expected, atol=1e-5)
    seconds = found["time"][own] / 1e9
    low = 6 - 0.5 - 0.5 * seconds
    assert np.abs(found.positions[own, 0] - low).min() < 1e-3


def test_radial_velocities_on_a_triangle_are_interpolated_between_its_corners():
    """A box of 1 m that grows to twice its height in a second: speeds rise with the height."""
    mesh = box("Lift", (1, 1, 1))
    animation = Animation(np.stack([mesh.vertices, mesh.vertices * [1, 1, 2]]), 1.0)
    actor = Actor(replace(mesh, animation=animation), Track([0, 1], [[6, 0, 0.2]] * 2))
    scanner = Scanner(
        Scene.from_meshes([FLOOR]).with_actors([actor]),
        Sensor.grid(720, 40),
        columns=["radial_velocity", "object", "time"],
        precision_m=1e-6,
    )
    found = scanner.sweep((0, 0, 1), start_s=0.3)
    own = found["object"] == 1
    points = found.positions[own]
    ways = points - [0, 0, 1]
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    speeds = (points[:, 2] - 0.2) / (1 + found["time"][own] / 1e9)
    assert own.sum() > 50 and np.ptp(speeds) > 0.5
    np.testing.assert_allclose(found["radial_velocity"][own], ways[:, 2] * speeds, atol=1e-5)


def test_normals_are_those_of_the_moment():
    """A door that opens: its light fades with the cosine."""
    flat = SceneMesh("Door", np.array([[0, 0, -1], [0, 1, -1], [0, 1, 1.0], [0, 0, 1]]),
                     np.array([[0, 1, 2], [0, 2, 3]]))  # fmt: skip
    angles = np.radians(np.linspace(0, 60, 61))
    poses = np.stack([flat.vertices] * 61)
    poses[:, :, 0], poses[:, :, 1] = (
        f(angles)[:, None] * flat.vertices[:, 1] for f in (np.sin, np.cos)
    )
    actor = Actor(
        replace(flat, animation=Animation(poses, 0.01)),
        Track([0, 9], [[5, 0, 0], [5, 0, 0.0]], [[0, 0, 0, 1]] * 2),
    )
    scene = Scene.from_meshes([FLOOR]).with_actors([actor])
    columns = ["reflectance", "object", "time"]
    gray = Material("*", reflectance=0.5)
    scanner = Scanner(scene, Sensor.grid(720, 3), columns=columns, materials=[gray])
    for start in (0.05, 0.3, 0.55):
        found = scanner.sweep((0, 0, 0), start_s=start)
        own = found["object"] == 1
        assert own.sum() > 5
        ways = found.positions[own] / np.linalg.norm(found.positions[own], axis=1)[:, None]
        angle = np.radians(found["time"][own] / 1e9 * 100)
        cosine = np.abs(ways[:, 0] * np.cos(angle) - ways[:, 1] * np.sin(angle))
        np.testing.assert_allclose(found["reflectance"][own], 0.5 * cosine, atol=1e-3)


def test_the_rate_follows_the_way_and_who_stands_keeps_the_pose(walker):
    """0.7 m/s for a second, then none, then back."""
    way = Track([0, 1, 2, 3], [[0, 0, 0], [0.7, 0, 0], [0.7, 0, 0], [0, 0, 0]],
                [[0, 0, 0, 1]] * 4, beyond="hold")  # fmt: skip
    actor = Actor(walker, way, offset_s=0.1)
    times = np.array([-1, 0, 0.5, 1, 1.5, 2, 2.5, 5]) * 1e9
    seconds, rates = actor.seconds(times)
    np.testing.assert_allclose(seconds, [0.1, 0.1, 0.35, 0.6, 0.6, 0.6, 0.35, 0.1])
    np.testing.assert_allclose(rates, [0, 0.5, 0.5, 0, 0, -0.5, -0.5, 0])
    frames, passing = actor.frames_at(times)
    duration = walker.animation.duration_s
    step = walker.animation.step_s
    np.testing.assert_allclose(frames * step, np.mod(seconds, duration))
    np.testing.assert_allclose(passing * step, rates)
    by_time = replace(walker, animation=replace(walker.animation, speed_m_s=None, repeat=False))
    frames, passing = Actor(by_time, way).frames_at(np.array([-1, 0.5, 2]) * 1e9)
    np.testing.assert_allclose(frames * step, [0, 0.5, duration])
    np.testing.assert_allclose(passing * step, [0, 1, 0])


def test_the_person_of_the_examples_walks_without_sliding(walker):
    """1.75 m tall; where a foot is flat on the ground, it goes back by 1.4 m/s."""
    poses = walker.animation.vertices
    step = walker.animation.step_s
    assert 1_500 < len(walker.faces) < 4_000 and 1.0 < walker.animation.duration_s < 1.2
    assert np.abs(poses[:, :, 2].min(axis=1)).max() < 0.01
    assert (np.abs(poses[:, :, 2].max(axis=1) - 1.71) < 0.03).all()
    np.testing.assert_allclose(poses[0], poses[-1], atol=1e-5)
    speeds = np.diff(poses, axis=0) / step
    low = poses[:-1, :, 2] < 0.012
    assert np.median(speeds[..., 0][low]) == pytest.approx(-1.4, abs=0.05)
    assert np.abs(speeds).max() > 2.8  # a foot in the air


def test_copies_share_their_poses_and_backends_agree(walker):
    ways = [Track([0, 1], [[x, y, 0], [x, y + 1.4, 0]]) for x, y in ((4, 0), (-5, 2), (3, -6))]
    actors = [Actor(replace(walker, name=f"W{k}"), way, k / 3) for k, way in enumerate(ways)]
    meshes, which = distinct_meshes(actor.mesh for actor in actors)
    assert len(meshes) == 1 and which.tolist() == [0, 0, 0]
    scene = Scene.from_meshes([FLOOR]).with_actors(actors)
    survey = Survey(Sensor.grid(500, 24), [(0, 0, 1)], steps=36, keep_every=1,
                    columns=["radial_velocity", "time", "intensity"])  # fmt: skip
    one = made(survey, scene, "tiles")
    other = made(survey, scene, "numpy")
    for name, values in one.items():
        assert np.array_equal(values, other[name]), name
    own = one["object"] > 0
    assert own.sum() > 60 and np.ptp(one["radial_velocity"][own]) > 2
    still = [replace(actor, mesh=replace(actor.mesh, animation=None)) for actor in actors]
    rigid = made(survey, scene.with_actors(still), "tiles")
    assert not np.array_equal(rigid["x"], one["x"])


def points_in(boxes, actor, points, slack):
    """Whether points are within the box of an actor."""
    turn = matrices(boxes.quaternions[[actor]])[0]
    local = (points - boxes.centers[actor]) @ turn
    return (np.abs(local) <= boxes.sizes[actor] / 2 + slack).all(axis=1)


def test_boxes_hold_the_points_of_people_who_walk(walker, tmp_path):
    """By boxes of sweeps, and in the files of three exports."""
    fast = replace(walker, animation=replace(walker.animation, speed_m_s=0.7))  # twice the rate
    way = Track([0, 9], [[3, -1, 0], [3, 8, 0]])
    scene = Scene.from_meshes([FLOOR]).with_actors(
        [Actor(replace(fast, name="Person 1"), way), Actor(box("Car 1", (4, 2, 1.5)), way)]
    )
    scene = scene.with_actors(
        [
            scene.actors[0],
            replace(scene.actors[1], trajectory=Track([0, 9], [[-9, 0, 0], [-9, 1, 0]])),
        ]
    )
    survey = Survey(Sensor.grid(900, 40), [(0, 0, 1)], steps=36 * 4, keep_every=1,
                    columns=["time", "intensity", "reflectivity", "class"],
                    materials=[Material("Person*", semantic_class=7), Material("*")])  # fmt: skip
    sweeps = Sweeps.from_survey(survey, scene)
    found = made(survey, scene, "tiles")
    assert np.array_equal(sweeps.actor_bounds[0], fast.animation.bounds)
    positions = np.stack([found.pop(axis) for axis in "xyz"], axis=1) * survey.precision_m
    begins = [survey.begins_ns(scan) for scan in range(survey.scan_count)]
    found["scan"] = np.searchsorted(begins, found["time"], "right") - 1
    cloud = Cloud(positions, found, sweeps=lambda: sweeps)
    sizes = []
    for number, points in enumerate(sweeps.points(cloud)):
        boxes = Boxes.from_points(sweeps, number, points)
        own = points["object"] == 1
        assert own.sum() > 50 and set(points["class"][own]) == {7}
        # The person walks at 1 m/s while it is scanned, and points are rounded.
        walked_m = (points["time"][own] - sweeps.begins_ns[number]) / 1e9
        at_stamp = points.positions[own] - walked_m[:, None] * [0, 1, 0]
        assert points_in(boxes, 0, at_stamp, 0.001).all()
        sizes.append(boxes.sizes[0])
    assert np.ptp(sizes, axis=0).max() == 0 and sizes[0][0] > 0.6  # of a whole stride
    loaded = Sweeps.load(_saved(sweeps, tmp_path / "sweeps.npz"))
    assert np.array_equal(loaded.actor_bounds, sweeps.actor_bounds)

    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    lines = (tmp_path / "kitti/sequences/00/label_2/000001.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["Person", "Car"]
    height, width, length = map(float, lines[0].split()[8:11])
    np.testing.assert_allclose([length, width, height], sizes[1], atol=0.006)
    save_cloud(cloud, tmp_path / "nu", format="nuscenes")
    (table,) = (tmp_path / "nu").glob("v1.0-*/sample_annotation.json")
    rows = [row for row in json.loads(table.read_text()) if row["size"][2] > 1.6]
    np.testing.assert_allclose([row["size"] for row in rows], np.array(sizes)[:, [1, 0, 2]])

    rosbags = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    save_cloud(cloud, tmp_path / "a.mcap", layout="velodyne")
    store = get_typestore(Stores.ROS2_HUMBLE)
    scales = []
    with rosbags.AnyReader([tmp_path / "a.mcap"], default_typestore=store) as bag:
        for connection, _, data in bag.messages():
            if connection.topic == "/actors":
                scale = bag.deserialize(data, connection.msgtype).markers[0].scale
                scales.append([scale.x, scale.y, scale.z])
    np.testing.assert_allclose(scales, sizes)


def drawn_again(actors, path, seconds=3):
    """Actors of a survey of some seconds, of its file of pictures."""
    scene = Scene.from_meshes([FLOOR]).with_actors(actors)
    stands = Track([0, seconds], [[0, 0, 1], [0, 0, 1.0]])
    pictured, _ = PictureContent.before_casting(scene, Survey(Sensor.grid(), trajectory=stands))
    full = replace(pictured, hit_counts=np.zeros(pictured.scene.triangles, np.int64))
    full.save(path)
    return PictureContent.load(path).scene.actors


def test_pictures_of_a_saved_result_show_people_as_they_walk(walker, tmp_path):
    """By speed or time, with a way before the survey, and who appears, ends or stands."""
    early = Track([-2, 4], [[-2, 3, 0], [3, 3, 0.0]], start_s=0.0)
    passes = Track([-1, 1, 2], [[0, 5, 0], [2, 5, 0], [2, 6, 0.0]], start_s=0.0, beyond="absent")
    appears = Track([1.5, 2.5], [[9, 0, 0], [8, 0, 0.0]], start_s=0.0, beyond="absent")
    timed = replace(walker, animation=replace(walker.animation, speed_m_s=None, repeat=False))
    actors = [
        Actor(walker, early, offset_s=0.4),
        Actor(replace(walker, name="P"), passes),
        Actor(walker, appears, offset_s=0.2),
        Actor(timed, appears, offset_s=-1.2),
        Actor(walker),
        Actor(box("Car", (4, 2, 1)), early),
    ]
    again = drawn_again(actors, tmp_path / "p.npz")
    assert len({id(actor.mesh.animation) for actor in again}) == 3, "copies share their poses"
    for time_ns in (0, 0.7e9, 1.49e9, 1.7e9, 2.4e9, 2.9e9):
        for one, other in zip(actors, again, strict=True):
            want = one.mesh_at(time_ns).vertices
            found = other.mesh_at(time_ns).vertices
            there = np.ptp(want, axis=0).any()
            assert there == np.ptp(found, axis=0).any()
            # The pose is within 1/1024 m; halves of it, and a way between a thousand places.
            assert not there or np.abs(want - found).max() < 2e-3
    assert (tmp_path / "p.npz").stat().st_size < 450_000


@pytest.mark.extended
def test_poses_of_many_vertices_are_fewer_in_pictures(tmp_path):
    around = np.linspace(0, 2 * np.pi, 50_000, endpoint=False)
    points = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    poses = points * (1 + np.linspace(0, 1, 121))[:, None, None]
    faces = np.stack([np.arange(2), np.arange(2) + 1, np.arange(2) + 2], axis=1)
    mesh = SceneMesh("Ring", points, faces, animation=Animation(poses, 1 / 60, repeat=False))
    (ring,) = drawn_again([Actor(mesh)], tmp_path / "p.npz")
    assert ring.mesh.animation.vertices.shape == (MAX_PICTURED_VERTICES // 50_000, 50_000, 3)
    for time_ns in (0, 0.77e9, 2e9, 2.5e9):
        want = points * (1 + min(time_ns / 2e9, 1))
        np.testing.assert_allclose(ring.mesh_at(time_ns).vertices, want, atol=1e-3)


@pytest.mark.extended
def test_damaged_poses_in_a_file_of_pictures_are_told(walker, tmp_path):
    path = tmp_path / "p.npz"
    drawn_again([Actor(walker)], path)
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, value in (("mesh0_steps", arrays["mesh0_steps"][:, 1:]), ("mesh0_played", [0])):
        np.savez_compressed(path, **(arrays | {name: value}))
        with pytest.raises(LidarError, match=r"p\.npz.*(its animation moves|Run the survey)"):
            PictureContent.load(path)


def _saved(sweeps, path):
    sweeps.save(path)
    return path


def ring(name, radius, at):
    """A wheel of 24 corners, 0.2 m wide, about an axle along y."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = [
        np.stack([radius * np.cos(angle), 0 * angle + y, radius * np.sin(angle)], 1)
        for y in (-0.1, 0.1)
    ]
    k = np.arange(24)
    after = (k + 1) % 24
    faces = np.concatenate(
        [np.stack([k, after, k + 24], 1), np.stack([after, after + 24, k + 24], 1)]
    )
    return SceneMesh(name, np.concatenate(rim) + at, faces)


def test_wheels_turn_by_speed_over_radius():
    """Of a car at 5 m/s: the top goes twice as fast, and the ground does not slip."""
    parts = [box("Body", (4, 1.6, 1)), ring("wheel_front", 0.3, [1.2, 0.8, 0.3]),
             ring("wheel_rear", 0.6, [-1.2, 0.8, 0.6])]  # fmt: skip
    notes = []
    mesh = join_meshes("Car", animate_wheels(parts, ["wheel*"], notes.append))
    assert not notes and mesh.animation.duration_s == pytest.approx(2 * np.pi * 0.6)
    actor = Actor(mesh, Track([0, 10], [[0, 0, 0], [50, 0, 0]]))
    frames, rates = actor.frames_at(np.array([0.1, 0.37]) * 1e9)
    places, moves = mesh.animation.vertices_at(frames)
    velocity = moves * rates[:, None, None] + [5, 0, 0]
    assert np.array_equal(velocity[:, :8], np.full((2, 8, 3), [5.0, 0, 0]))
    for wheel, radius, middle in ((slice(8, 56), 0.3, 1.2), (slice(56, 104), 0.6, -1.2)):
        from_axle = places[:, wheel] - [middle, 0.8, radius]
        np.testing.assert_allclose(np.hypot(*from_axle[..., [0, 2]].T), radius, rtol=2.5e-3)
        expected = 5 / radius * np.stack([from_axle[..., 2], -from_axle[..., 0]], axis=-1)
        np.testing.assert_allclose(velocity[:, wheel][..., [0, 2]] - [5, 0], expected, atol=0.3)
    flat = replace(parts[1], name="wheel_flat", vertices=parts[1].vertices * [1, 1, 0.5])
    animate_wheels([*parts, flat], ["wheel*"], notes.append)
    assert notes == [
        "wheel_flat is not round about its y axis (0.6 m long, 0.3 m high) and does not rotate"
    ]
    oval = replace(parts[1], name="wheel_oval", vertices=parts[1].vertices * [1, 1, 0.97])
    animate_wheels([*parts, oval], ["wheel*"], notes.append)
    assert len(notes) == 1, "3 % off round still rotates"
    nut = ring("wheel_nut", 0.01, [1.2, 0.9, 0.3])
    animate_wheels([*parts, nut], ["wheel*"], notes.append)
    assert notes[1:] == ["wheel_nut is 60 times smaller than the largest wheel and does not rotate"]
    with pytest.raises(
        LidarError, match=r"'axle', but no object has that name\. Available names: Bo"
    ):
        animate_wheels(parts, ["wheel*", "axle"], notes.append)
    with pytest.raises(
        LidarError,
        match=(
            r"can rotate: wheel_flat is not round about its y axis .* "
            r"rotate\.$"
        ),
    ):
        animate_wheels([*parts, flat], ["wheel_flat"], notes.append)


def scenario(folder, *actors, **sections):
    (folder / "pedestrian.glb").write_bytes(PERSON.read_bytes())
    post = {"name": "Post", "box": [1, 1, 3], "at": [[0, 9, 0]]}
    data = {"scene": {"ground": {"margin_m": 30}, "copies": [post]},
            "poses": [[0, 0, 1.5]], "sensor": {"model": "velodyne/vlp16"}, "steps": 36 * 9,
            "actors": list(actors), "cloud": {"keep_every": 1}}  # fmt: skip
    return Scenario.from_data(data | sections, folder=folder)


WAY = {"points": [{"time_s": 0, "position": [4, 0, 0]}, {"time_s": 1, "position": [5.4, 0, 0]}]}


@pytest.mark.extended
def test_scenarios_name_animations(tmp_path):
    one = {"name": "A", "file": "pedestrian.glb", "animation": "Walk", "trajectory": WAY}
    walk = {"name": "Walk", "speed_m_s": 1.4, "repeat": False, "offset_s": 0.5}
    other = one | {"name": "B", "animation": walk}
    built = prepare(scenario(tmp_path, one, one | {"name": "C"}, other))
    a, c, b = built.scene.actors
    assert a.mesh.animation is c.mesh.animation and a.mesh.animation.speed_m_s is None
    assert (b.mesh.animation.speed_m_s, b.mesh.animation.repeat, b.offset_s) == (1.4, False, 0.5)
    (told,) = [line for line in advice(built) if "animation" in line]
    assert told.startswith(
        "the animation of B ends after 1.05 s, before the end of the survey, and its last"
    )
    still = prepare(scenario(tmp_path, {k: v for k, v in one.items() if k != "animation"}))
    assert still.scene.actors[0].mesh.animation is None
    assert any("set `animation: NAME` on an actor" in line for line in advice(still))


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"box": [1, 1, 1], "animation": "Walk"}, "`animation` requires a mesh file"),
        (
            {"file": "pedestrian.glb", "animation": "Walk", "wheels": "w"},
            "`animation` and `wheels` cannot be combined",
        ),
        ({"file": "robot.urdf", "animation": "Walk"}, "A robot has joints, so `animation`"),
        (
            {"file": "pedestrian.glb", "animation": "Wlak"},
            r"no animation 'Wlak' .Did you mean 'Walk'",
        ),
        ({"file": "pedestrian.glb", "wheels": "Boby"}, r"has that name\. Did you mean 'Body'"),
    ],
)
def test_what_is_wrong_with_a_scenario_is_a_line(tmp_path, entry, message):
    with pytest.raises(LidarError, match=message):
        prepare(scenario(tmp_path, {"name": "A", "trajectory": WAY} | entry))


@pytest.mark.extended
def test_people_of_traffic_walk_at_their_own_speed_and_out_of_step(tmp_path):
    steps = "".join(
        f"""<timestep time="{t}.00"><person id="p" x="0" y="{t}" angle="0" type="ped"/>
        <person id="q" x="3" y="1" angle="0" type="ped"/></timestep>"""
        for t in range(4)
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    walk = {"name": "Walk", "speed_m_s": 1.4, "offset_s": 50}
    shape = {"file": "pedestrian.glb", "animation": walk}
    traffic = {"file": "fcd.xml", "vehicles": [{"types": "*", **shape}]}
    built = prepare(scenario(tmp_path, traffic=traffic, steps=36 * 20))
    walks, stands = built.scene.actors
    assert walks.mesh.animation is stands.mesh.animation and walks.offset_s != stands.offset_s
    assert min(walks.offset_s, stands.offset_s) >= 50
    times = np.array([0.0, 1.5e9])
    np.testing.assert_allclose(np.diff(walks.seconds(times)[0]), 1.5 / 1.4)
    np.testing.assert_allclose(np.diff(stands.seconds(times)[0]), 0)


def test_bad_animations_are_refused():
    mesh = box("Box", (1, 1, 1))
    poses = np.stack([mesh.vertices] * 2)
    assert np.array_equal(Animation(poses.astype("f").tolist(), 1).vertices, poses)
    with pytest.raises(LidarError, match="step_s must be a finite number, but is inf"):
        Animation(poses, np.inf)
    with pytest.raises(
        LidarError, match=r"vertices of an animation must be an array of numbers, but is 'abc'"
    ):
        Animation("abc", 1)
    with pytest.raises(LidarError, match=r"but has vertices \(1, 8, 3\), a step of 0.1 s"):
        Animation(mesh.vertices[None], 0.1)
    with pytest.raises(LidarError, match=r"positive step and speed, .* of 0 s and"):
        Animation(np.stack([mesh.vertices] * 2), 0)
    with pytest.raises(LidarError, match="has 8 vertices, but its animation moves 7"):
        replace(mesh, animation=Animation(np.stack([mesh.vertices[1:]] * 2), 0.1))

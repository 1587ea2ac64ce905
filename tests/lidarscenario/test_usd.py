"""OpenUSD scenes: what is shown is read, in its colors, and nothing vanishes in silence."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from contextlib import closing
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.fork_server import USD_CORE, ForkServer

from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.files import child_process, usd
from lidarsim import LidarError, Pose, Scanner, Scene, SceneInstance, Sensor
from lidarsim.columns.table import COLORS
from lidarsim.io import allowance
from lidarsim.scene.colors import LINEAR, as_srgb
from lidarsim.scene.files import scene_graph as nodes
from lidarsim.scene.files.meshfile import load_meshes, load_objects
from lidarsim.scene.transform import Transform

pytestmark = pytest.mark.skipif(find_spec("pxr") is None, reason="needs usd-core, an extra")


@pytest.fixture(autouse=True)
def forked(server, monkeypatch):
    """Processes of one that has imported usd-core once."""
    names = {name: getattr(subprocess, name) for name in ("DEVNULL", "PIPE")}
    monkeypatch.setattr(child_process, "subprocess", SimpleNamespace(Popen=server, **names))


@pytest.fixture(scope="module")
def server():
    with closing(ForkServer(USD_CORE)) as server:
        yield server


METERS = 'metersPerUnit = 1\nupAxis = "Z"'
QUAD = """
    uniform token subdivisionScheme = "none"
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]
"""
MOVED = 'double3 xformOp:translate = {}\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'


def prim(name, kind="Mesh", text=QUAD, meta=""):
    return f'def {kind} "{name}" ({meta}\n) {{\n{text}\n}}\n'


def write(path, *prims, stage=METERS):
    path.write_text(f"#usda 1.0\n({stage}\n)\n" + "".join(prims))
    return path


def told(path, **options):
    """Objects, and lines on what was left or turned."""
    lines = []
    objects = load_meshes(path, report=lines.append, axes=lines.append, **options)
    return objects, [line.replace(str(path), path.name) for line in lines]


def bounds(objects):
    return Scene.from_meshes(objects).bounds


def test_polygons_places_and_names(tmp_path):
    text = QUAD.replace("[4]", "[5, 3, 3]").replace(
        "[0, 1, 2, 3]", "[0, 1, 2, 3, 4, 0, 1, 2, 0, 1, 3]"
    )
    text = text.replace("(0, 3, 0)]", "(1, 1, 0), (0, 3, 0)]")  # the first is not convex
    within = prim("Wall", text=text + "int[] holeIndices = [2]\n" + MOVED.format((1, 0, 0)))
    world = prim("World", "Xform", within + MOVED.format((0, 0, 5)))
    objects, lines = told(write(tmp_path / "m.usda", world, prim("Wall")))
    assert [one.name for one in objects] == ["World", "Wall"]
    assert [len(one.faces) for one in objects] == [4, 2] and lines == []
    np.testing.assert_allclose(objects[0].bounds, [[1, 0, 5], [3, 3, 5]])


@pytest.mark.parametrize(
    ("stage", "options", "size", "words"),
    [
        (METERS, {}, [2, 3, 0], []),
        ('metersPerUnit = 1\nupAxis = "Y"', {}, [2, 0, 3], ["to Z-up, as the file states"]),
        ("", {}, [0.02, 0, 0.03], ["Centimeters, the OpenUSD", "to Z-up, the OpenUSD default"]),
        ("", {"unit": "m", "up_axis": "z"}, [2, 3, 0], []),
    ],
)  # fmt: skip
def test_unit_and_axis(tmp_path, stage, options, size, words):
    objects, lines = told(write(tmp_path / "m.usda", prim("Quad"), stage=stage), **options)
    np.testing.assert_allclose(np.ptp(bounds(objects), axis=0), size, atol=1e-9)
    assert len(lines) == len(words) and all(map(str.__contains__, lines, words))


def test_basic_shapes_have_their_sizes(tmp_path):
    round_ = 'double radius = 1\ndouble height = 4\nuniform token axis = "X"'
    prims = [
        prim("Cube", "Cube", "double size = 3"),
        prim("Sphere", "Sphere", "double radius = 2"),
        *(prim(kind, kind, round_) for kind in ("Cylinder", "Cone", "Capsule")),
        prim("Plane", "Plane", 'double width = 2\ndouble length = 5\nuniform token axis = "X"'),
        prim("Nothing", "Sphere", "double radius = 0"),
    ]
    objects, lines = told(write(tmp_path / "m.usda", *prims))
    assert {one.name: np.ptp(one.bounds, axis=0).round(9).tolist() for one in objects} == {
        "Cube": [3, 3, 3], "Sphere": [4, 4, 4], "Cylinder": [4, 2, 2], "Cone": [4, 2, 2],
        "Capsule": [6, 2, 2], "Plane": [0, 5, 2],
    }  # fmt: skip
    cone = next(one for one in objects if one.name == "Cone")
    assert cone.vertices[cone.vertices[:, 0].argmax()] == pytest.approx([2, 0, 0])
    volumes = {
        one.name: np.linalg.det((one.vertices - one.vertices.mean(axis=0))[one.faces]).sum() / 6
        for one in objects
    }
    expected = {"Cube": 27, "Sphere": 33.51, "Cylinder": 12.57, "Cone": 4.19, "Capsule": 16.76}
    assert volumes == pytest.approx(expected | {"Plane": 0}, rel=0.01)  # and point outwards
    assert lines == []


def test_what_is_not_shown_is_left_out_and_counted(tmp_path):
    hidden = prim("Hidden", "Xform", 'token visibility = "invisible"\n' + prim("Quad"))
    guide = prim("Guide", "Xform", 'uniform token purpose = "guide"\n' + prim("Quad") + prim(
        "Drawn", text=QUAD + 'uniform token purpose = "render"'))  # fmt: skip
    path = write(
        tmp_path / "m.usda", hidden, guide, prim("Off", meta="active = false"),
        prim("Curves", "BasisCurves", ""), prim("Shown", text=QUAD.replace('"none"', '"loop"')),
        'class Mesh "Class" {' + QUAD + '}\nover "Over" {' + prim("Quad") + "}\n",
    )  # fmt: skip
    objects, lines = told(path)
    assert [one.name for one in objects] == ["Drawn", "Shown"]
    assert lines == [
        "m.usda contains prims that were skipped: 1 invisible, 1 BasisCurves, "
        "1 with the purpose proxy or guide.",
        "m.usda contains 1 subdivision mesh. Subdivision is not supported, so the coarse mesh is "
        "used.",
    ]


def sampled(op, **samples):
    """An animated xformOp."""
    times = ", ".join(f"{time[1:]}: {value}" for time, value in samples.items())
    kind = {"translate": "double3", "rotateZ": "double", "scale": "float3"}[op]
    return f"{kind} xformOp:{op}.timeSamples = {{{times}}}\n"


def order(*ops):
    return f"uniform token[] xformOpOrder = {['xformOp:' + op for op in ops]}\n".replace("'", '"')


DRIVE = sampled("translate", t2="(1, 0, 0)", t6="(9, 0, 0)") + order("translate")
STAGE = METERS + "\nstartTimeCode = 2\nendTimeCode = 4\ntimeCodesPerSecond = 2"


def vertices(path, seconds, **options):
    """Vertices of the actors at a time, and the lines that were told."""
    scene = Scene.load(path, **options)
    assert scene.names == ("Ground",)
    return {one.name: one.mesh_at(seconds * 1e9).vertices + scene.origin for one in scene.actors}


def test_moving_prims_are_actors(tmp_path):
    quad = np.array([(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)])
    wheel = prim(
        "Wheel", "Xform", sampled("rotateZ", t2=0, t6=720) + order("rotateZ") + prim("Rim")
    )
    still = "float3 xformOp:scale = (1, -2, 3)\n" + order("scale")
    car = prim("Car", "Xform", DRIVE + prim("Body", "Xform", prim("A") + prim("B") + still) + wheel)
    path = write(tmp_path / "m.usda", prim("Ground"), car, stage=STAGE)
    for time, x, turn in ((0, 1, 0), (0.25, 2, 90), (1, 5, 360), (2, 9, 0), (1e6, 9, 0)):
        found = vertices(path, time)
        assert sorted(found) == ["Car", "Wheel"]
        # One actor of all that moves as one; faces of mirrored meshes stay outward.
        body = np.sort(found["Car"].round(9), axis=0)
        want = quad * [1, -2, 3] + [x, 0, 0]
        np.testing.assert_allclose(body, np.sort(np.concatenate([want, want]), axis=0), atol=1e-6)
        c = np.cos(np.radians(turn))
        s = np.sin(np.radians(turn))
        turned = quad @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] + [x, 0, 0]
        np.testing.assert_allclose(found["Wheel"], turned, atol=1e-3)
    # Its axes and its path follow the placement and the unit.
    place = Transform.from_parts((0, 0, 7), (0, 0, 90), 2)
    found = vertices(path, 0.5, unit="ft", transform=place)["Wheel"]
    local = (turned_about_z(quad, 180) + np.array([3, 0, 0])) * 0.3048
    expected = turned_about_z(2 * local, 90) + np.array([0, 0, 7])
    np.testing.assert_allclose(found, expected, atol=1e-3)
    scenario = Scenario.from_data(
        {"scene": {"files": ["m.usda"], "ground": {}},
         "actors": [{"name": "Van", "box": [1, 1, 1], "trajectory": {
             "points": [{"time_s": t, "position": [0, 0, 0], "yaw_deg": 0} for t in (0, 9)]}}]},
        folder=tmp_path,
    )  # fmt: skip
    scene = prepare(scenario).scene
    assert [actor.name for actor in scene.actors] == ["Car", "Wheel", "Van"]


def turned_about_z(points, degrees):
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    return points @ [[c, s, 0], [-s, c, 0], [0, 0, 1]]


def test_what_moves_in_instances_moves_in_each(tmp_path):
    write(tmp_path / "car.usda", prim("Top", "Xform", prim("Car", text=QUAD + DRIVE)),
          stage=STAGE + '\ndefaultPrim = "Top"')  # fmt: skip
    meta = "references = @./car.usda@\ninstanceable = true"
    places = [prim(f"I{y}", "Xform", MOVED.format((0, y, 0)), meta) for y in (0, 10)]
    scene = Scene.load(write(tmp_path / "m.usda", prim("Ground"), *places, stage=STAGE))
    low = [actor.mesh_at(1e9).bounds[0].tolist() for actor in scene.actors]
    assert low == [[5, 0, 0], [5, 10, 0]] and len(scene.names) == 1


@pytest.mark.slow
def test_what_moves_otherwise_stands_and_is_noted(tmp_path):
    grows = sampled("scale", t2="(1, 1, 1)", t6="(2, 1, 1)") + order("scale")
    camera = prim("Rig", "Xform", DRIVE + prim("Camera", "Camera", ""))
    path = write(tmp_path / "m.usda", prim("Ground"), prim("Balloon", text=QUAD + grows), camera)
    _, lines = told(path)
    assert lines == [
        "m.usda contains 1 object with unsupported motion, such as deformation or moving "
        "instances. The first frame is used."
    ]
    # Copies and actors of a scenario are of meshes that stand, and a scene of what moves only.
    path = write(tmp_path / "m.usda", prim("Car", text=QUAD + DRIVE), stage=STAGE)
    objects, lines = told(path)
    assert lines == ["m.usda moves Car, but all objects are treated as static at their first pose"]
    assert bounds(objects)[0, 0] == 1
    built = prepare(Scenario.load(path))
    assert not built.scene.actors and built.scene.bounds[0, 0] == 1
    assert "a scene requires at least one static object" in advice(built)[0]
    uneven = Transform.from_parts(scale=(1, 2, 1))
    with pytest.raises(
        LidarError, match=r"m\.usda: Object 'Car' moves but is scaled non-uniformly"
    ):
        Scene.load(path, transform=uneven)


@pytest.mark.extended
def test_files_elsewhere_are_read_if_their_folder_is_named(tmp_path):
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    (tmp_path / "assets").mkdir()
    write(tmp_path / "assets" / "q.usda", prim("Quad"))
    write(tmp_path / "q.usda", prim("Quad"))
    own = write(scenes / "own.usda", prim("Own"))
    outer = prim("A", "", "", "references = @../assets/q.usda@</Quad>")
    inner = prim("B", "", "", f"references = @./{own.name}@</Own>")
    write(scenes / "m.usda", outer, inner)

    def names(**more):
        files = [{"file": "scenes/m.usda"} | more]
        return prepare(Scenario.from_data({"scene": {"files": files}}, folder=tmp_path)).scene.names

    with pytest.raises(LidarError, match=r"Set assets to the folder"):
        names()
    assert names(assets="assets") == names(assets=".") == ("A", "B")
    write(scenes / "m.usda", outer, prim("C", "", "", "references = @../q.usda@</Quad>"))
    with pytest.raises(LidarError, match=r"'\.\./q\.usda', but only files"):
        names(assets="assets")


def test_skeletons_bend_their_meshes_but_in_instances(tmp_path):
    still = "((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,{},1))".format
    raised = "5"
    bones = f"""uniform token[] joints = ["a"]
    uniform matrix4d[] bindTransforms = [{still(0)}]
    uniform matrix4d[] restTransforms = [{still(raised)}]
    """
    skin = (
        QUAD
        + """rel skel:skeleton = <../Bones>
    int[] primvars:skel:jointIndices = [0] (elementSize = 1
 interpolation = "constant")
    float[] primvars:skel:jointWeights = [1] (elementSize = 1
 interpolation = "constant")
    """
    )
    api = 'prepend apiSchemas = ["SkelBindingAPI"]'
    man = prim(
        "Man", "SkelRoot", prim("Bones", "Skeleton", bones) + prim("Skin", text=skin, meta=api)
    )
    objects, lines = told(write(tmp_path / "man.usda", man, stage=METERS + '\ndefaultPrim = "Man"'))
    assert bounds(objects)[:, 2].tolist() == [5, 5] and lines == []
    placed = prim("A", "", "", "references = @man.usda@\ninstanceable = true")
    objects, [line] = told(write(tmp_path / "m.usda", placed))
    assert bounds(objects)[:, 2].tolist() == [0, 0] and "in instances" in line


STRIP = """
    uniform token subdivisionScheme = "none"
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 3, 2, 2, 3, 5, 4]
    point3f[] points = [(0, -1, 0), (0, 1, 0), (0, -1, 1), (0, 1, 1), (0, -1, 2), (0, 1, 2)]
    rel skel:skeleton = </Man/Bones>
    int[] primvars:skel:jointIndices = [0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1] (
        elementSize = 2
        interpolation = "vertex")
    float[] primvars:skel:jointWeights = [1, 0, 1, 0, 0.5, 0.5, 0.7, 0.3, 0, 1, 0, 1] (
        elementSize = 2
        interpolation = "vertex")
    uniform token[] skel:blendShapes = ["fat"]
    rel skel:blendShapeTargets = </Man/Skin/Fat>
    def BlendShape "Fat"
    {
        uniform vector3f[] offsets = [(1, 0, 0), (1, 1, 0)]
        uniform int[] pointIndices = [3, 5]
    }
"""
BOUND = 'prepend apiSchemas = ["SkelBindingAPI"]'


def clip(name, turn):
    """An animation of two joints, the second of which turns, and of a blend shape."""
    return prim(name, "SkelAnimation", f"""
    uniform token[] joints = ["a", "a/b"]
    float3[] translations.timeSamples = {{
        1: [(0, 0, 0), (0, 0, 1)], 25: [(0, 0, 0), (0, 1, 1)]}}
    quatf[] rotations.timeSamples = {{
        1: [(1, 0, 0, 0), (1, 0, 0, 0)], 13: [(1, 0, 0, 0), {turn}],
        25: [(0.8, 0, 0, 0.6), (1, 0, 0, 0)]}}
    half3[] scales = [(1, 1, 1), (1, 1, 2)]
    uniform token[] blendShapes = ["fat"]
    float[] blendShapeWeights.timeSamples = {{1: [0], 20: [1]}}
    """)  # fmt: skip


def person(path, extra="", stage=METERS + "\ntimeCodesPerSecond = 24", bones="", skin=""):
    still = "((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,{},1))".format
    rest = f"""uniform token[] joints = ["a", "a/b"]
    uniform matrix4d[] bindTransforms = [{still(0)}, {still(1)}]
    uniform matrix4d[] restTransforms = [{still(0)}, {still(1)}]
    """
    clips = clip("Walk", "(0.8, 0.6, 0, 0)") + clip("Run", "(0.6, 0, 0.8, 0)")
    man = "rel skel:animationSource = </Man/Walk>\n" + prim("Bones", "Skeleton", rest + bones)
    man += clips + prim("Skin", text=STRIP + skin, meta=BOUND)
    return write(
        path, prim("Man", "SkelRoot", man, BOUND), extra, stage=stage + '\ndefaultPrim = "Man"'
    )


def evaluated(path, code, animation=None):
    """Points of the skin of a person in the world at a time code, by UsdSkel's own evaluation."""
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(path))
    root, bones, skin = (stage.GetPrimAtPath(f"/Man{at}") for at in ("", "/Bones", "/Skin"))
    if animation:
        source = UsdSkel.BindingAPI(root).GetAnimationSourceRel()
        source.SetTargets([f"/Man/{animation}"])
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(root), Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(bones))
    points = UsdGeom.Mesh(skin).GetPointsAttr().Get()
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(skin))
    weights = skeleton.GetAnimQuery().ComputeBlendShapeWeights(code)
    given = shapes.ComputeSubShapeWeights(weights)
    shapes.ComputeDeformedPoints(*given, shapes.ComputeBlendShapePointIndices(),
                                 shapes.ComputeSubShapePointOffsets(), points)  # fmt: skip
    query = cache.GetSkinningQuery(skin)
    query.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(code), points, code)
    place = UsdGeom.Imageable(bones).ComputeLocalToWorldTransform(code)
    return np.array([place.Transform(point) for point in map(tuple, points)])


def played(path, name, code, first=1, rate_hz=24):
    """Vertices of the first object at a time code of an animation."""
    own = load_objects(path, animation=name).static[0].animation
    return own.vertices_at(np.atleast_1d((code - first) / rate_hz / own.step_s))[0]


@pytest.mark.extended
@pytest.mark.parametrize("name", ["", "Walk", "Run"])
def test_actors_play_animations_as_usdskel_evaluates_them(tmp_path, name):
    """At poses, and at random times between, where they move straight within 2 mm."""
    turns = sampled("rotateZ", t1=0, t40=90) + order("rotateZ")
    moves = sampled("translate", t1="(1, 0, 0)", t30="(0, 2, 0)") + order("translate")
    path = person(tmp_path / "m.usda", bones=moves, skin=turns)
    own = load_objects(path, animation=name).static[0].animation
    assert own.vertices.shape == (99, 6, 3) and own.duration_s == pytest.approx(39 / 24)
    for frame in (0, 1, 47, 98):
        expected = evaluated(path, 1 + 39 * frame / 98, name)
        np.testing.assert_allclose(own.vertices[frame], expected, atol=2e-6)
    assert np.ptp(own.vertices, axis=0).max() > 1
    codes = np.random.default_rng(3).uniform(1, 40, 12)
    found = played(path, name, codes)
    for code, points in zip(codes, found, strict=True):
        np.testing.assert_allclose(points, evaluated(path, code, name), atol=2e-3)


def test_what_moves_too_far_away_is_left_out(tmp_path):
    falls = sampled("translate", t0="(0, 0, 5)", t24="(0, 0, -750000000)") + order("translate")
    path = write(tmp_path / "m.usda", prim("Quad"), prim("Fallen", text=QUAD + falls))
    notes = []
    objects = load_objects(path, report=notes.append)
    assert [mesh.name for mesh in objects.static] == ["Quad"] and not objects.actors
    assert any("(7.5e+08 m from the origin), which were skipped: Fallen" in note for note in notes)


def test_what_stands_is_bent_at_the_first_time_also_between_samples(tmp_path):
    path = person(tmp_path / "m.usda", stage=METERS + "\nstartTimeCode = 7.3\nendTimeCode = 19")
    objects, lines = told(path)
    np.testing.assert_allclose(objects[0].vertices, evaluated(path, 7.3), atol=1e-6)
    assert lines == [
        "m.usda contains animated skeletons, which are treated as static. To animate an actor, set "
        "animation: NAME."
    ]
    text = path.read_text()
    (tmp_path / "blocked.usda").write_text(text.replace("13: [", "6: None, 13: ["))
    blocked, _ = told(tmp_path / "blocked.usda")
    assert not np.allclose(blocked[0].vertices, objects[0].vertices)
    own = load_objects(path, animation="").static[0].animation
    assert own.duration_s == pytest.approx(11.7 / 24)
    np.testing.assert_allclose(own.vertices[-1], evaluated(path, 19), atol=2e-6)


@pytest.mark.extended
def test_instances_prims_and_points_that_move_are_in_animations(tmp_path):
    person(tmp_path / "man.usda")
    meta = "references = @./man.usda@\ninstanceable = true"
    text = QUAD.replace(
        "points = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]",
        "points.timeSamples = {1: [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],"
        "25: [(0, 0, 0), (1, 0, 0), (1, 1, 4), (0, 1, 2)]}",
    )
    wheel = prim("Wheel", text=QUAD + sampled("rotateZ", t1=0, t25=360) + order("rotateZ"))
    men = [prim(f"M{x}", "", MOVED.format((x, 0, 0)), meta) for x in (0, 5)]
    stage = METERS + "\ntimeCodesPerSecond = 24"
    path = write(tmp_path / "m.usda", prim("Flag", text=text), wheel, *men, stage=stage)
    found = load_objects(path, animation="Walk")
    assert not found.actors
    flag, wheel, *both = (one.animation.vertices for one in found.static)
    np.testing.assert_allclose(flag[45], [(0, 0, 0), (1, 0, 0), (1, 1, 3), (0, 1, 1.5)])
    np.testing.assert_allclose(wheel[15, 1], [0, 2, 0], atol=1e-9)
    for x, one in zip((0, 5), both, strict=True):
        want = evaluated(tmp_path / "man.usda", 1 + 24 * 0.4) + np.array([x, 0, 0])
        np.testing.assert_allclose(one[24], want, atol=2e-6)
    # Without skeletons it has no name.
    path = write(tmp_path / "flag.usda", prim("Flag", text=text), stage=stage)
    assert load_objects(path, animation="").static[0].animation.vertices.shape == (61, 4, 3)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("stage", "text", "name", "message"),
    [
        ("", None, "Wlak", r"m.usda has no animation 'Wlak' \(Did you mean 'Walk'\?\)\.$"),
        ("", None, "Fly", r"has no animation 'Fly' \(the animations are Walk, Run\)\.$"),
        ("startTimeCode = 3\nendTimeCode = 3", None, "", "an animation without a duration"),
        ("startTimeCode = 3\nendTimeCode = 3e9", None, "", "Unable to allocate|would unpack to"),
        ("timeCodesPerSecond = 0", None, "", "contains no animations. Export it with"),
        ("", QUAD, "", "contains no animations. Export it with animations, or remove animation"),
        ("", QUAD + 'token visibility.timeSamples = {0: "inherited", 24: "invisible"}', "",
         "m.usda has a different number of vertices in pose 60. Remove animation"),
    ],
)  # fmt: skip
def test_unusable_animations_are_refused_in_a_line(tmp_path, stage, text, name, message):
    path = tmp_path / "m.usda"
    stage = f"{METERS}\n{stage}"
    if text is None:
        person(path, stage=stage)
    else:
        write(path, prim("A", text=QUAD), prim("B", text=text), stage=stage)
    with pytest.raises(LidarError, match=message) as refused:
        load_objects(path, animation=name)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_person_of_a_scenario_moves(tmp_path):
    """Each point is on the surface that UsdSkel gives at its time."""
    path = person(tmp_path / "man.usda")
    man = {"name": "Man", "file": "man.usda", "at": [4, 0, 0], "animation": "Walk"}
    data = {"scene": {"ground": {"margin_m": 30}}, "poses": [[0, 0, 1]], "steps": 36,
            "sensor": {"model": "velodyne/vlp16"}, "actors": [man]}  # fmt: skip
    scene = prepare(Scenario.from_data(data, folder=tmp_path)).scene
    scanner = Scanner(scene, Sensor.grid(720, 60), columns=["object", "time"])
    middles = []
    for start in (0.1, 0.5):
        found = scanner.sweep((0, 0, 1), start_s=start)
        own = np.flatnonzero(found["object"] == len(scene.names))
        assert len(own) > 50
        for row in own[::20]:
            points = evaluated(path, 1 + 24 * found["time"][row] / 1e9) + np.array([4, 0, 0])
            assert distance(found.positions[row], points[scene.actors[0].mesh.faces]) < 0.02
        middles.append(found.positions[own].mean(axis=0))
    assert np.linalg.norm(middles[1] - middles[0]) > 0.1


def distance(point, triangles):
    """How far a point is off the nearest triangle, along its sides or normal."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    u, v, off = np.linalg.solve(np.stack([b - a, c - a, normals], axis=2), -a[..., None]).T[0]
    return np.max([-u, -v, u + v - 1, np.abs(off)], axis=0).min()


def copied(count, extra=""):
    """Two kinds of tree in so many places, below a forest that is moved."""
    places = ", ".join(f"({10 * i}, 0, 0)" for i in range(count))
    text = f"""
    int[] protoIndices = {[i % 2 for i in range(count)]}
    point3f[] positions = [{places}]
    rel prototypes = [</Forest/Kinds/Oak>, </Forest/Kinds/Elm>]
    {extra}
    """
    kinds = 'over "Kinds" {\n' + prim("Oak", text=QUAD + MOVED.format((0, 0, 1))) + prim(
        "Elm", "Xform", prim("Stem") + prim("Crown")) + "}\n"  # fmt: skip
    return prim("Forest", "PointInstancer", text + kinds + MOVED.format((0, 0, 100)))


def test_instancers_place_their_prototypes_only(tmp_path):
    path = write(tmp_path / "m.usda", copied(4, "int64[] invisibleIds = [3]"))
    objects, lines = told(path)
    assert sorted(one.name for one in objects) == ["Crown", "Oak", "Oak", "Stem"] and not lines
    np.testing.assert_allclose(bounds(objects), [[0, 0, 100], [22, 3, 101]])


def test_prims_alike_share_one_mesh(tmp_path, monkeypatch):
    monkeypatch.setattr(nodes, "SHARED_TRIANGLES", 1)
    write(
        tmp_path / "tree.usda",
        prim("Tree", "Xform", prim("Crown")),
        stage=METERS + '\ndefaultPrim = "Tree"',
    )
    tree = "references = @./tree.usda@\ninstanceable = {}"
    grove = prim("Grove", "Xform", "".join(
        prim(f"T{i}", "Xform", MOVED.format((i, 0, 0)), tree.format("true")) for i in range(2)
    ))  # fmt: skip
    write(tmp_path / "grove.usda", grove, stage=METERS + '\ndefaultPrim = "Grove"')
    inner = "references = @grove.usda@\ninstanceable = true"  # instances in instances
    path = write(
        tmp_path / "m.usda",
        *(prim(f"G{i}", "Xform", MOVED.format((0, i, 0)), inner) for i in range(3)),
        prim("Alone", "Xform", MOVED.format((50, 0, 0)), tree.format("false")),
    )
    objects, _ = told(path)
    assert all(isinstance(one, SceneInstance) for one in objects) and len(objects) == 7
    assert len({one.mesh for one in objects}) == 1
    found = sorted(one.matrix[:2, 3].tolist() for one in objects)
    assert found == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2], [50, 0]]


def test_packed_scenes_are_read(tmp_path):
    inner = write(tmp_path / "in.usda", prim("Quad"))
    main = write(tmp_path / "main.usda", prim("A", "", "", "references = @./in.usda@</Quad>"))
    path = tmp_path / "m.usdz"
    with zipfile.ZipFile(path, "w") as archive:
        for file in (main, inner):
            # Content begins at multiples of 64 bytes.
            info = zipfile.ZipInfo(file.name)
            room = 30 + len(file.name) + 4
            info.extra = (
                b"\x99\x99"
                + (pad := -(archive.fp.tell() + room) % 64).to_bytes(2, "little")
                + bytes(pad)
            )
            archive.writestr(info, file.read_bytes())
        main.unlink(), inner.unlink()
    objects, lines = told(path)
    assert len(objects[0].faces) == 2 and not lines


def test_missing_and_foreign_files_are_named(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    write(tmp_path / "outside.usda", prim("Quad"))
    (folder / "bad.usda").write_text("junk")
    missing = [
        prim("A", "Xform", "", "references = @./no.usda@"),
        prim("B", "Xform", "", "payload = @https://example.com/x.usd@"),
        prim("C", "Xform", "", "references = @bad.usda@</Quad>"),
    ]
    _, lines = told(write(folder / "m.usda", prim("Quad"), *missing))
    assert lines == [
        "m.usda refers to content that is missing or cannot be read, which was skipped: "
        "'bad.usda', 'https:/example.com/x.usd', 'no.usda'."
    ]
    with pytest.raises(LidarError, match=r"no triangles. It refers to .*: 'no\.usda'"):
        load_meshes(write(folder / "m.usda", missing[0]))
    with pytest.raises(
        LidarError, match=r"from '\.\./outside\.usda', but only files in its own folder"
    ):
        load_meshes(
            write(
                folder / "m.usda", prim("A", "Xform", "", "references = @../outside.usda@</Quad>")
            )
        )
    with pytest.raises(LidarError, match="only files in its own folder"):
        load_meshes(
            write(
                folder / "m.usda", prim("Quad"), stage=METERS + "\nsubLayers = [@../outside.usda@]"
            )
        )


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#usda 1.0\ndef Mesh {", "m.usd cannot be read: "),
        ("PXR-USDC", "m.usd cannot be read: "),
        (QUAD.replace("[4]", "[5]"), "'Quad' declares polygons with 5 corners but contains 4"),
        (QUAD.replace("3]", "9]"), "'Quad': faces refer to vertices 0 to 9"),
        (QUAD.replace("(2, 0, 0)", "(nan, 0, 0)"), "NaN or infinite"),
        ("", "contains no triangles"),
        ('#usda 1.0\n(upAxis = "up")\n' + prim("Quad"), "upAxis is 'up'"),
        (MOVED.format("(1e300, 0, 0)") + QUAD, "farther than anything on Earth"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_a_line(tmp_path, capfd, text, message):
    path = tmp_path / "m.usd"
    if text[:1] in "#P" and text:
        path.write_text(text)
    else:
        write(path, prim("Quad", text=text))
    with pytest.raises(LidarError) as refused:
        load_meshes(path)
    assert message in str(refused.value) and "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_few_lines_do_not_make_millions_of_objects(tmp_path):
    count = nodes.MAX_NODES + 1
    text = f"int[] protoIndices = [{'0,' * count}]\nrel prototypes = </F/K>\n" + prim("K")
    text += f"point3f[] positions = [{'(0,0,0),' * count}]\n"
    with pytest.raises(LidarError, match="more than 200,000 prims and instances"):
        load_meshes(write(tmp_path / "m.usda", prim("F", "PointInstancer", text)))
    levels = "".join(
        prim(f"L{i}", "Xform", "".join(
            prim(f"C{k}", "Xform", "", f"references = </L{i - 1}>\ninstanceable = true")
            for k in range(10)) if i else prim("Quad"))
        for i in range(8)
    )  # fmt: skip
    with pytest.raises(LidarError, match=r"m\.usda has more than 200,000 nodes and copies"):
        load_meshes(write(tmp_path / "m.usda", levels))


@pytest.mark.extended
@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are Linux's")
def test_a_library_that_dies_or_wants_too_much_ends_itself_only(tmp_path, monkeypatch):
    monkeypatch.setattr(child_process, "subprocess", subprocess)
    monkeypatch.setattr(usd, "USD_CORE_BYTES", 0)
    monkeypatch.setattr(usd, "memory_share", lambda: 60 * 2**20)
    with pytest.raises(LidarError, match=r"m\.usda cannot be read: "):
        load_meshes(
            write(tmp_path / "m.usda", prim("Quad", text=QUAD + f"int[] a = [{'1,' * 10**6}]"))
        )
    monkeypatch.undo()
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 1000)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 0.01)
    with pytest.raises(LidarError, match="would unpack to"):
        load_meshes(
            write(
                tmp_path / "m.usda",
                prim("Quad", text=QUAD.replace("(2, 3, 0)", "(2, 3, 0)" + ", (2, 3, 0)" * 1000)),
            )
        )


@pytest.mark.extended
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)),
        min_size=1,
        max_size=4,
    )
)
def test_garbled_files_give_errors_or_meshes(tmp_path, changes):
    path = write(tmp_path / "m.usda", copied(3), prim("Quad"))
    binary = tmp_path / "m.usdc"
    if not (whole := tmp_path / "whole.usdc").exists():
        code = "import sys; from pxr import Usd; Usd.Stage.Open(sys.argv[1]).Export(sys.argv[2])"
        subprocess.run([sys.executable, "-c", code, path, whole], check=True)
    data = bytearray(whole.read_bytes())
    for at, some in changes:
        begin = int(at * len(data))
        data[begin : begin + len(some)] = some
    binary.write_bytes(data)
    try:
        assert load_meshes(binary)
    except LidarError as error:
        assert str(error).count("\n") < 2


SENSOR = Sensor.grid(rays_per_revolution=4, layers=1, vertical_fov_deg=10, step_deg=90)
# Four places on the quad: lower left, lower right, upper left, upper right.
SPOTS = [(0.5, 0.75), (1.5, 0.75), (0.5, 2.25), (1.5, 2.25)]
RED = [200, 0, 0]
GREEN = [0, 200, 0]
BLUE = [0, 0, 200]
DARK = [90, 90, 90]
GRAY = [188] * 3
PIXELS = np.array([[[*RED, 255], [*GREEN, 0]], [[*BLUE, 255], [*DARK, 0]]], np.uint8)
PICTURE = [BLUE, DARK, RED, GREEN]  # at the spots

BIND = 'prepend apiSchemas = ["MaterialBindingAPI"]'
ST = """texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
rel material:binding = </M>
"""
IMAGE = "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\n"
HOLES = "float inputs:opacity.connect = </M/T.outputs:a>\nfloat inputs:opacityThreshold = 0.5\n"


def material(inputs, image="", place="", name="M", kind="UsdPreviewSurface"):
    """A material whose texture T has coordinates from P, or from X, which takes them from P."""
    shaders = f"""
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "{kind}"
        token outputs:surface
        {inputs}
    }}
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./picture.png@
        float2 inputs:st.connect = </M/{"X" if place else "P"}.outputs:result>
        {image}
        float3 outputs:rgb
        float outputs:a
    }}
    def Shader "P" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}
    def Shader "X" {{
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </M/P.outputs:result>
        {place}
        float2 outputs:result
    }}
    """
    return prim(name, "Material", shaders)


def seen(path, **options):
    """Colors below the spots, None where light passes; and notes."""
    objects, lines = told(path, colors=True, up_axis="z", **options)
    scanner = Scanner(Scene.from_meshes(objects), SENSOR, columns=list(COLORS), backend="numpy")
    found = []
    for x, y in SPOTS:
        cloud = scanner.sweep(Pose((x, y, 5), pitch_deg=90))
        color = np.stack([cloud[name] for name in COLORS], axis=1).tolist()
        found.append(color[0] if color else None)
    return found, lines


@pytest.fixture
def folder(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "picture.png")
    return tmp_path


def shifted(light):
    return as_srgb(np.clip(light, 0, 1)).tolist()


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("image", "place", "expected"),
    [
        ("", "", PICTURE),
        # Half the image to the right: what is beyond repeats, is black, or goes on.
        ('token inputs:wrapS = "repeat"', "float2 inputs:translation = (0.5, 0)",
         [DARK, BLUE, GREEN, RED]),
        ("", "float2 inputs:translation = (0.5, 0)", [DARK, [0] * 3, GREEN, [0] * 3]),
        ('token inputs:wrapS = "clamp"', "float2 inputs:translation = (0.5, 0)",
         [DARK, DARK, GREEN, GREEN]),
        ('token inputs:wrapS = "mirror"', "float2 inputs:translation = (1, 0)",
         [DARK, BLUE, GREEN, RED]),
        ('token inputs:wrapS = "repeat"\ntoken inputs:wrapT = "repeat"',
         "float inputs:rotation = 90", [DARK, GREEN, BLUE, RED]),
        ('token inputs:sourceColorSpace = "raw"', "",
         [shifted(np.array(c) / 255) for c in PICTURE]),
        ("float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (0, 0.1, 0, 0)", "",
         [shifted(LINEAR[c] * [0.5, 1, 1] + [0, 0.1, 0]) for c in PICTURE]),
    ],
)  # fmt: skip
def test_images_are_where_texture_coordinates_put_them(folder, image, place, expected):
    path = write(folder / "m.usda", material(IMAGE, image, place), prim("Q", text=QUAD + ST))
    assert seen(path) == (expected, [])


def test_masks_let_light_pass(folder):
    quad = prim("Q", text=QUAD + ST, meta=BIND)
    path = write(folder / "m.usda", material(IMAGE + HOLES), quad)
    assert seen(path) == ([BLUE, None, RED, None], [])
    assert seen(path, opacity="ignore")[0] == PICTURE
    assert Scene.load(path).masked_objects == ("Q",)  # also where no colors are asked for
    assert not Scene.load(path, opacity="ignore").instances
    glass = write(folder / "m.usda", material("float inputs:opacity = 0.2"), quad)
    assert "without holes, which are treated as opaque: M." in seen(glass)[1][0]


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ('= [(0.2, 0.4, 0.6)] (interpolation = "constant")', [(0.2, 0.4, 0.6)] * 4),
        ('= [(1, 0, 0), (0, 0, 1)] (interpolation = "uniform")',
         [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1)]),
        ('= [(0, 0, 0), (0.8, 0, 0)] (interpolation = "vertex")\n'
         "int[] primvars:displayColor:indices = [0, 1, 1, 0, 1, 0]",
         [(0.2, 0, 0), (0.6, 0, 0)] * 2),
        (f"= [{'(0, 0, 0), ' * 5} (0.8, 0, 0), (0.8, 0, 0), (0, 0, 0)]"
         '(interpolation = "faceVarying")', [(0, 0, 0)] * 2 + [(0.2, 0, 0), (0.6, 0, 0)]),
    ],
)  # fmt: skip
def test_display_colors_are_linear_light(tmp_path, values, expected):
    halves = QUAD.replace("[4]", "[4, 4]").replace("[0, 1, 2, 3]", "[0, 1, 4, 5, 5, 4, 2, 3]")
    halves = halves.replace("(0, 3, 0)]", "(0, 3, 0), (2, 1.5, 0), (0, 1.5, 0)]")
    quad = prim("Q", text=halves + f"color3f[] primvars:displayColor {values}\n")
    found, lines = seen(write(tmp_path / "m.usda", quad))
    np.testing.assert_allclose(found, [shifted(light) for light in expected], atol=1)
    assert lines == []


def test_materials_of_subsets_parents_collections_and_instances(folder):
    plain = "color3f inputs:diffuseColor = (0, 1, 0)"
    halves = QUAD.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
    subset = prim(
        "Part", "GeomSubset",
        "uniform token elementType = \"face\"\nuniform token familyName = \"materialBind\"\n"
        "int[] indices = [1]\nrel material:binding = </G>", BIND,
    )  # fmt: skip
    two = [material(IMAGE), material(plain, name="G")]
    path = write(folder / "m.usda", *two, prim("Q", text=halves + ST + subset, meta=BIND))
    lower = seen(path)[0][1]
    upper = seen(path)[0][2]
    assert (lower, upper) == (DARK, [0, 255, 0])
    world = f"rel material:binding = </G>\n{prim('Q')}"
    assert seen(write(folder / "m.usda", *two, prim("W", "Xform", world, BIND)))[0][0] == upper
    bound = (
        'prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"]\n) {\n'
        "rel collection:some:includes = </W/Q>\n"
        "rel material:binding:collection:some = [</W.collection:some>, </G>]\n"
    )
    text = f'def Xform "W" ({bound}{prim("Q")}}}\n'
    assert seen(write(folder / "m.usda", *two, text))[0][0] == upper
    # Instances share a mesh, and have the colors that are bound outside of them.
    write(folder / "quad.usda", prim("A", "Xform", prim("Q")), stage=METERS + '\ndefaultPrim = "A"')
    place = "double3 xformOp:translate = ({}, 0, 0)\nuniform token[] xformOpOrder = "
    place += '["xformOp:translate"]\n'
    meta = "references = @./quad.usda@\ninstanceable = true\n"
    one = prim("I", "Xform", place.format(0) + "rel material:binding = </G>", meta + BIND)
    other = prim("J", "Xform", place.format(9), meta)
    objects, _ = told(write(folder / "m.usda", *two, one, other), colors=True)
    colors = [one.colors and one.colors.images[0].ravel().tolist() for one in objects]
    assert colors == [upper, None]


def test_packed_images_and_shapes(folder):
    sphere = prim(
        "Ball", "Cube", "double size = 10\nrel material:binding = </M>", BIND
    )  # its color is even
    red = material("color3f inputs:diffuseColor = (1, 0, 0)")
    assert seen(write(folder / "ball.usda", red, sphere))[0] == [[255, 0, 0]] * 4
    main = write(folder / "main.usda", material(IMAGE), prim("Q", text=QUAD + ST, meta=BIND))
    path = folder / "m.usdz"
    with zipfile.ZipFile(path, "w") as archive:
        for file in (main, folder / "picture.png"):
            info = zipfile.ZipInfo(file.name)  # content begins at multiples of 64 bytes
            pad = -(archive.fp.tell() + 34 + len(file.name)) % 64
            info.extra = b"\x99\x99" + pad.to_bytes(2, "little") + bytes(pad)
            archive.writestr(info, file.read_bytes())
    main.unlink(), (folder / "picture.png").unlink()
    assert seen(path) == (PICTURE, [])


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("inputs", "image", "kind", "color", "why"),
    [
        (IMAGE, "asset inputs:file = @no.png@", "UsdPreviewSurface", GRAY, "'no.png' does not"),
        (IMAGE, "asset inputs:file = @m.usda@", "UsdPreviewSurface", GRAY, "is not a PNG"),
        (IMAGE, "asset inputs:file = @no.png@\nfloat4 inputs:fallback = (1, 0, 0, 1)",
         "UsdPreviewSurface", [255, 0, 0], "does not exist"),
        (IMAGE, "asset inputs:file = @../out.png@", "UsdPreviewSurface", GRAY,
         "outside the scene's folder; set assets to a folder that"),
        (IMAGE, "asset inputs:file = @t.<UDIM>.png@", "UsdPreviewSurface", GRAY, "UDIM tiles"),
        ("", "", "MyShader", GRAY, "M (its shader MyShader is not supported)"),
        (IMAGE.replace("T.outputs:rgb", "X.outputs:result"), "", "UsdPreviewSurface", GRAY,
         "computed by UsdTransform2d"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_noted(folder, inputs, image, kind, color, why):
    Image.fromarray(PIXELS).save(folder.parent / "out.png")
    text = material(inputs, image, kind=kind)
    if image:
        text = text.replace("asset inputs:file = @./picture.png@", "")
    path = write(folder / "m.usda", text, prim("Q", text=QUAD + ST, meta=BIND))
    found, lines = seen(path)
    assert found == [color] * 4 and len(lines) == 1 and why in lines[0]
    assert told(path)[1] == []  # colors are not asked for
    if "out.png" in image:
        assert seen(path, assets=folder.parent) == (PICTURE, [])


@pytest.mark.extended
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize(
    "text",
    [
        "#usda 1.0\n(subLayers = [@f.usda@])\n",
        '#usda 1.0\ndef "A" (references = @f.usda@) {}\n',
    ],
)
def test_pipes_that_a_scene_names_are_not_waited_for(tmp_path, text):
    os.mkfifo(tmp_path / "f.usda")
    (tmp_path / "m.usda").write_text(text)
    with pytest.raises(LidarError, match=r"it refers to 'f\.usda', which is not a regular file"):
        load_meshes(tmp_path / "m.usda")

"""Robots from URDF: kinematics, what is seen of links, and sensors that links carry."""

from __future__ import annotations

import pickle
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.lidarpool.test_moving import stored_positions
from tests.shapes import level, made

from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes import load_robot
from lidarsim import LidarError, Mounted, Pose, Scene, Survey, Track, box, load_sensor
from lidarsim.motion.trajectory import presence_ns
from lidarsim.numerics.vectors import rotate_into_frames
from lidarsim.simulator.rig import Rig

EXAMPLES = Path(__file__).parents[2] / "examples"
BOX = '<visual><geometry><box size="0.2 0.2 0.2"/></geometry></visual>'


def robot_of(folder, *elements, name="robot.urdf", **options):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<robot name="r">{"".join(elements)}</robot>')
    return load_robot(path, **options)


def link(name, inside=BOX):
    return f'<link name="{name}">{inside}</link>'


def joint(name, kind, parent, child, inside=""):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


def visual(shape, origin=""):
    return f"<visual>{origin}<geometry>{shape}</geometry></visual>"


def turn(axis, angle):
    """Rotation (4, 4) about x, y or z, written out."""
    c = np.cos(angle)
    s = np.sin(angle)
    out = np.eye(4)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return out


def shift(*by):
    out = np.eye(4)
    out[:3, 3] = by
    return out


ARM = [
    link("base"),
    joint("seat", "fixed", "base", "plate", '<origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/>'),
    link("plate"),
    joint(
        "pan", "revolute", "plate", "upper",
        '<origin xyz="0 0 0.5" rpy="0 0.2 0"/><axis xyz="0 0 2"/><limit lower="-1" upper="3"/>',
    ),
    link("upper"),
    joint("slide", "prismatic", "upper", "rod", '<origin xyz="1 0 0"/><axis xyz="0 3 4"/>'),
    link("rod"),
    joint(
        "tilt", "continuous", "rod", "tip",
        '<axis xyz="0 1 0"/><mimic joint="pan" multiplier="-2" offset="0.5"/>',
    ),
    link("tip"),
]  # fmt: skip


def tip_at(pan, slide):
    rpy = turn("z", 0.6) @ turn("y", -0.5) @ turn("x", 0.4)
    fixed = shift(0.1, 0.2, 0.3) @ rpy @ shift(0, 0, 0.5) @ turn("y", 0.2)
    rod = fixed @ turn("z", pan) @ shift(1, 0, 0) @ shift(0, 0.6 * slide, 0.8 * slide)
    return rod @ turn("y", -2 * pan + 0.5)


def test_a_link_is_where_the_joints_before_it_put_it(tmp_path):
    robot = robot_of(tmp_path, *ARM)
    assert robot.moving == ("pan", "slide", "tilt")
    for pan, slide in ((0.0, 0.0), (0.7, 0.3), (2.9, -1.5)):
        pose = robot.path("tip", joints={"pan": pan, "slide": slide}).pose(0)
        expected = tip_at(pan, slide)
        assert np.allclose(pose.position, expected[:3, 3], atol=1e-14)
        assert np.allclose(pose.rotation, expected[:3, :3], atol=1e-13)
    # On a base that moves, at times between the given values, which are linear in time.
    half = np.sqrt(0.5)
    base = Track([10, 14], [[0, 0, 0], [8, 0, 0]], [[0, 0, half, half]] * 2, start_s=11)
    values = {"time_s": [10, 12, 15], "pan": [0, 1, 2.5], "slide": [0.5, -0.5, 0.7]}
    path = robot.path("tip", base, values)
    assert (path.duration_ns, path.stations, path.moves) == (3e9, 1, True)
    seconds = np.array([0.0, 0.5, 1.7, 2.999])
    positions, rotations = path.poses(0, seconds * 1e9)
    for k, at in enumerate(seconds + 11):
        expected = (
            shift(2 * (at - 10), 0, 0)
            @ turn("z", np.pi / 2)
            @ tip_at(*(np.interp(at, values["time_s"], values[name]) for name in ("pan", "slide")))
        )
        assert np.allclose(positions[k], expected[:3, 3], atol=1e-13)
        assert np.allclose(rotations[k], expected[:3, :3], atol=1e-13)
    # The same bits, however many times there are.
    times = np.linspace(0, 3e9, 1001)
    whole = path.poses(0, times)
    for first, last in pairwise((0, 1, 2, 9, 500, 1001)):
        for one, all_ in zip(path.poses(0, times[first:last]), whole, strict=True):
            assert (one == all_[first:last]).all()
    there = Track([10, 12], [[0, 0, 0], [8, 0, 0]], beyond="absent")
    assert presence_ns(robot.path("tip", there, values)) == (0, 2e9)
    again = pickle.loads(pickle.dumps(path))
    assert (again.poses(0, times)[0] == whole[0]).all()
    assert fingerprint(again) == fingerprint(path)
    other = robot.path("tip", base, values | {"pan": [0, 1, 2.4]})
    assert fingerprint(other) != fingerprint(path)


def test_links_that_are_fixed_to_one_another_are_one_actor(tmp_path):
    notes = []
    robot = robot_of(tmp_path, *ARM)
    actors = robot.actors(joints={"pan": 3.5}, name="Arm", report=notes.append)
    assert [actor.name for actor in actors] == ["Arm/base", "Arm/upper", "Arm/rod", "Arm/tip"]
    assert [len(actor.mesh.faces) for actor in actors] == [24, 12, 12, 12]
    assert notes == ["r: joint pan has values from 3.5 to 3.5, which exceed its limits of -1 to 3."]
    (plate,) = robot.actors(without=["base", "upper", "rod", "tip"])
    corner = shift(0.1, 0.2, 0.3) @ turn("z", 0.6) @ turn("y", -0.5) @ turn("x", 0.4)
    cube = corner[:3, :3] @ (box("", (0.2, 0.2, 0.2)).vertices - [0, 0, 0.1]).T
    assert np.allclose(plate.mesh.vertices - [0.1, 0.2, 0.3], cube.T, atol=1e-15)
    assert plate.name == "r/base", "the same name, whatever is left out"
    again = robot.actors(name="Other", report=notes.append)
    assert all(a.mesh.vertices is b.mesh.vertices for a, b in zip(actors, again, strict=True))
    # A joint without a value is at zero, or at its limit nearest to zero.
    limits = '<limit lower="0.2" upper="0.5"/>'
    near = robot_of(tmp_path, link("a"), link("b"), joint("j", "prismatic", "a", "b", limits))
    assert near.path("b").pose(0) == Pose((0.2, 0.0, 0.0))


def test_shapes_and_their_colors(tmp_path):
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    red = '<material name="red"/>'
    shapes = {
        "box": ('<box size="1 2 3"/>', (1, 2, 3)),
        "ball": ('<sphere radius="0.5"/>', (1, 1, 1)),
        "rod": ('<cylinder radius="0.5" length="4"/>', (1, 1, 4)),
        "pill": ('<capsule radius="0.5" length="4"/>', (1, 1, 5)),
        "mesh": ('<mesh filename="quad.obj" scale="2 -3 1"/>', (2, 3, 0)),
    }
    turned = '<origin xyz="0 0 9" rpy="0 0 1.5707963267948966"/>'
    links = [
        link(name, visual(shape, turned).replace("</visual>", red + "</visual>"))
        for name, (shape, _) in shapes.items()
    ]
    joints = [joint(name, "fixed", "box", name) for name in list(shapes)[1:]]
    color = '<material name="red"><color rgba="1 0.5 0 1"/></material>'
    robot = robot_of(tmp_path, *links, *joints, color, colors=True)
    for name, (_, (x, y, z)) in shapes.items():
        mesh = robot.meshes[name]
        assert np.allclose(np.ptp(mesh.bounds, axis=0), (y, x, z), rtol=2e-3), name
        assert mesh.colors.mean_colors()[0].tolist() == [255, 128, 0]
    assert robot_of(tmp_path, *links, *joints, color).meshes["box"].colors is None
    # Mirrored by a negative scale: faces still look the same way.
    corners = robot.meshes["mesh"].vertices[robot.meshes["mesh"].faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


DAE = """<COLLADA version="1.4.1"><asset><unit meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="f" count="9">
0 0 0 100 0 0 0 0 300</float_array><technique_common><accessor source="#f" count="3" stride="3"/>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="w"><node>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#w"/></scene></COLLADA>"""


def leg_of(folder, name, **options):
    """Return the robot of a file in a folder, whose only link has a mesh."""
    return robot_of(folder, link("leg", visual(f'<mesh filename="{name}"/>')), **options)


@pytest.fixture
def packages(tmp_path):
    """Return a folder of two packages with a mesh each, beside a folder that is no package."""
    folder = tmp_path / "ws"
    for file in ("my_robot/meshes/leg.dae", "other/leg.dae", "private/leg.dae", "../secret.dae"):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(DAE)
    (folder / "my_robot/package.xml").write_text(
        "<package><name>robot_description</name></package>"
    )
    (folder / "other/package.xml").write_text("<package/>")
    return folder


def test_mesh_files_of_packages(tmp_path, packages):
    package = packages / "my_robot"
    (package / "meshes" / "link.dae").symlink_to(tmp_path / "secret.dae")
    for name in (
        "../meshes/leg.dae",
        "package://my_robot/meshes/leg.dae",
        "package://robot_description/meshes/leg.dae",
        "package://other/leg.dae",
        f"file://{package}/meshes/leg.dae",
    ):
        # In meters by its unit; with the axes of the file, as RViz takes it.
        robot = leg_of(package / "urdf", name)
        assert robot.meshes["leg"].bounds[1].tolist() == [1, 0, 3], name
    outside = f"is outside the package, {package}. Set `assets` to a folder that contains the mesh"
    missing = "was not found. Set `assets` to the folder '{}' or a folder that contains it"
    for name, words in (
        ("../../../secret.dae", outside),
        ("../meshes/link.dae", outside),
        ("package://my_robot/../../secret.dae", outside),
        (f"file://{tmp_path}/secret.dae", outside),
        ("package://../secret.dae", "specify a package. Write package://NAME/FILE, or a path"),
        ("package:///leg.dae", "relative to the folder 'urdf' of the .urdf"),
        ("package://", "relative to the folder 'urdf' of the .urdf"),
        (
            "model:///other/meshes/leg.dae",
            "and set `assets` to the folder 'other' or a folder that contains it",
        ),
        ("package:///other//leg.dae", "specify a package. Write package://other/leg.dae, and"),
        ("package://unknown/leg.dae", missing.format("unknown")),
        ("package://private/leg.dae", missing.format("private")),  # no package
        ("../meshes/arm.dae", "does not exist"),
        ("http://example.org/leg.dae", "must be a path"),
    ):
        with pytest.raises(LidarError) as caught:
            leg_of(package / "urdf", name)
        assert words in str(caught.value), name
        assert "link 'leg'" in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_without_a_package_mesh_files_are_in_the_folder_of_the_robot_or_in_assets(packages):
    folder = packages / "private"
    for name in ("leg.dae", "package://private/leg.dae"):
        assert leg_of(folder, name).meshes
    urdf = folder / "urdf"
    for name in ("../leg.dae", "../../my_robot/meshes/leg.dae", f"file://{folder}/leg.dae"):
        with pytest.raises(LidarError) as caught:
            leg_of(urdf, name)
        assert (
            f"is outside the folder of the .urdf file, {urdf}. Set `assets` to a folder that "
            in str(caught.value)
        )
        assert leg_of(urdf, name, assets=packages).meshes
    for assets in (folder, packages):  # the package, and a folder of packages
        assert leg_of(urdf, "package://private/leg.dae", assets=assets).meshes
    assert leg_of(urdf, "../leg.dae", assets=folder).meshes
    with pytest.raises(LidarError, match=r"outside the folder of the \.urdf file"):
        leg_of(urdf, "../../../secret.dae", assets=packages)


def test_a_scenario_names_the_assets_of_a_robot(tmp_path, packages):
    leg_of(packages / "private/urdf", "../leg.dae", assets=packages)
    file = {"file": "ws/private/urdf/robot.urdf"}
    poses = [[0, 0, 1]]
    for entry in ({"files": [file]}, {"files": [file | {"assets": "ws/private"}]}):
        scenario = Scenario.from_data({"scene": entry, "poses": poses}, folder=tmp_path)
        if "assets" in entry["files"][0]:
            assert prepare(scenario).scene.names == ("r/leg",)
        else:
            with pytest.raises(LidarError, match="Set `assets` to"):
                prepare(scenario)
    actor = {"name": "R", "file": file | {"assets": "ws"}, "at": [3, 0, 0]}
    scenario = Scenario.from_data(
        {"scene": "seed", "actors": [actor], "poses": poses}, folder=tmp_path
    )
    assert len(prepare(scenario).scene.actors) == 1


HINGE = joint("j", "revolute", "a", "b")
BROKEN = {
    "it has no link": [],
    "not connected": [link("a"), link("b")],
    "form a cycle": [link("a"), link("b"), HINGE, joint("k", "fixed", "b", "a")],
    "'b' form a cycle": [
        link("a"), link("b"), link("c"),
        joint("j", "fixed", "b", "c"), joint("k", "fixed", "c", "b"),
    ],
    "is the child of two joints": [link("a"), link("b"), HINGE, joint("k", "fixed", "a", "b")],
    "its type is 'ball'": [link("a"), link("b"), joint("j", "ball", "a", "b")],
    "mimics 'x', which does not move": [
        link("a"), link("b"), joint("j", "revolute", "a", "b", '<mimic joint="x"/>'),
    ],
    "xyz of <origin> is 'nan 0 0'": [
        link("a"), link("b"), joint("j", "fixed", "a", "b", '<origin xyz="nan 0 0"/>'),
    ],
    "with xacro first": [link("a", visual('<box size="${w} 1 1"/>'))],
    "must be 3 finite numbers": [link("a", visual('<box size="1 1e300 1"/>'))],
    "its shape is <cone>": [link("a", visual("<cone/>"))],
    "no link has a <visual>": [link("a", "")],
    "the limit is 1,000": [link(f"l{k}") for k in range(1001)],
    "would unpack to": [link("a", visual('<sphere radius="1"/>') * 4000)],
}  # fmt: skip


@pytest.mark.parametrize("words", BROKEN)
def test_broken_robots_are_refused_in_a_line(tmp_path, words):
    with pytest.raises(LidarError) as caught:
        robot_of(tmp_path, *BROKEN[words])
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1 and len(str(caught.value)) < 500


@pytest.mark.extended
def test_xacro_other_files_and_garbled_copies(tmp_path):
    path = tmp_path / "arm.urdf"
    for text, words in (
        (
            "<robot xmlns:xacro='http://ros.org/wiki/xacro'><xacro:arm/></robot>",
            "xacro arm.urdf > arm.exp",
        ),
        ("<robot><xacro:arm/></robot>", "xacro arm.urdf > arm.expanded.urdf"),
        ("<sdf version='1.7'/>", "its extension to .sdf"),
        ("<!DOCTYPE r [<!ENTITY a 'b'>]><robot>&a;</robot>", "XML entity"),
    ):
        path.write_text(text)
        with pytest.raises(LidarError, match=words):
            load_robot(path)
    with pytest.raises(LidarError, match=r"xacro arm.urdf.xacro > arm.urdf"):
        (tmp_path / "arm.urdf.xacro").write_text("<robot/>")
        load_robot(tmp_path / "arm.urdf.xacro")
    with pytest.raises(LidarError, match="cannot be read"):
        load_robot(tmp_path / "none.urdf")
    whole = (EXAMPLES / "rover.urdf").read_bytes()
    rng = np.random.default_rng(0)
    read = 0
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(32, 127)
        path.write_bytes(data[: rng.integers(0, len(data))] if rng.random() < 0.2 else data)
        try:
            read += bool(load_robot(path, colors=True, report=lambda line: None).actors())
        except LidarError as error:
            assert len(str(error).splitlines()) == 1
    assert 5 < read < 140


def test_what_is_left_out_is_told(tmp_path):
    notes = []
    robot = robot_of(
        tmp_path,
        link("a", visual('<box size="1 1 1"/>') + visual('<box size="1 0 1"/>')),
        link("b", "<collision><geometry><box size='1 1 1'/></geometry></collision>"),
        joint("j", "floating", "a", "b"),
        report=notes.append,
    )
    assert list(robot.meshes) == ["a"] and not robot.moving
    held, collide, flat = notes
    assert held.endswith(
        "joint j has the type floating, which is not supported. Its value is always zero."
    )
    assert collide.endswith("collision shapes but no visual shapes and were skipped: b.")
    assert flat.endswith("shapes of size zero and were skipped: a.")


def test_tables_of_joints(tmp_path):
    robot = robot_of(tmp_path, *ARM)
    table = tmp_path / "joints.csv"
    notes = []
    table.write_text("time_ns;pan;effort\n0;0;1\n1000000000;1;1\n")
    (*_, tip) = robot.actors(joints=table, ignore=["effort"], report=notes.append)
    assert np.allclose(tip.trajectory.pose(0, 5e8).position, tip_at(0.5, 0)[:3, 3])
    assert not notes
    table.write_text(f"time [s],Pan [deg]\n0,0\n1,{np.degrees(1)}\n")
    (*_, tip) = robot.actors(joints=table)
    assert np.allclose(tip.trajectory.pose(0, 5e8).position, tip_at(0.5, 0)[:3, 3])
    with pytest.raises(LidarError, match=r"'r/tip': The joints have values from 0 to 1 s"):
        tip.check(0, 2e9)
    for text, words in (
        ("", "it is empty"),
        (
            "time_s,stool\n0,1\n",
            "unknown column 'stool'. .*The known columns are time_s.*, pan.*, slide, tilt",
        ),
        ("time_s,seat\n0,1\n", "no column for a movable joint. Name its columns.*pan, slide, tilt"),
        ("time_s,pan,pan\n0,1,2\n", "its column 'pan' occurs twice"),
        ("pan,slide\n0,1\n", "no column 'time_s'"),
        ("time,pan\n0,1\n", "Rename it to time_s .seconds., time_ms, time_us"),
        ("time_s,pan\n0,nan\n", "contains 'nan' in line 2"),
        ("time_s,pan\n0,0\n50000000,1\n", "probably nanoseconds. Set `time_unit: ns`"),
        ("time_s,pan\n1,0\n0,0\n", "must be finite and strictly increasing"),
    ):
        table.write_text(text)
        with pytest.raises(LidarError, match=words):
            robot.actors(joints=table)
    table.write_text("time_s,pan\n0,0\n1000000000,1\n")
    (*_, tip) = robot.actors(joints=table, time_unit="ns")
    assert np.allclose(tip.trajectory.pose(0, 5e8).position, tip_at(0.5, 0)[:3, 3])
    assert robot.path("tip", joints=table, time_unit="ms").duration_ns == 1e15
    with pytest.raises(LidarError, match="time_unit applies only to a joint file"):
        robot.actors(joints={"pan": 1}, time_unit="ns")
    for given, words in (
        ({"pam": 1}, "no movable joint 'pam'. Did you mean 'pan'"),
        ({"pan": [0, 1]}, "one value for each time_s"),
        ({"time_s": [0, 1], "pan": [0, np.inf]}, "must be finite"),
    ):
        with pytest.raises(LidarError, match=words):
            robot.actors(joints=given)
    with pytest.raises(LidarError, match=r"no link 'tin'\. Did you mean 'tip'"):
        robot.path("tin")


@pytest.fixture(scope="module")
def ground():
    return Scene.from_meshes([level("Ground", 0, 50)])


COLUMNS = ["ray", "time", "range", "triangle", "intensity"]
DRIVE = Track(
    [0, 0.2, 0.4],
    [[0, 0, 0], [2, 0, 0], [4, 1, 0]],
    [[0, 0, np.sin(a), np.cos(a)] for a in (0, 0.1, 0.3)],
    smooth=True,
)
MOTION = {
    "time_s": np.linspace(0, 0.4, 5),
    "front_left": np.linspace(0, 12, 5),
    "turret": np.array([-0.5, 1.0, 0.2, 2.0, -1.0]),
    "shoulder": np.array([0, 0.6, 0.2, -0.3, 0.1]),
    "elbow": np.array([1.5, 0.2, 0.9, 2.0, 1.0]),
}


def rover_at(name, time_ns):
    """Matrix (4, 4) of what a link of the example moves with, written out."""
    at = np.eye(4)
    (at[:3, 3],), (at[:3, :3],) = DRIVE.poses(0, np.array([time_ns]))
    value = {joint: np.interp(time_ns / 1e9, MOTION["time_s"], MOTION[joint]) for joint in MOTION}
    if "wheel" in name:
        right = "right" in name
        rear = "rear" in name
        at = at @ shift(0.34 - 0.68 * rear, 0.34 - 0.68 * right, 0.18)
        return at if right else at @ turn("y", value["front_left"])
    chain = {
        "shoulder_block": shift(0.3, 0, 0.4) @ turn("z", value["turret"]),
        "upper_arm": shift(0, 0, 0.16) @ turn("y", value["shoulder"]),
        "forearm": shift(0, 0, 0.4) @ turn("y", value["elbow"]),
        "finger": shift(0, 0.015 if "left" in name else -0.015, 0.43),
    }
    if name != "base_link":
        for part, step in chain.items():
            at = at @ step
            if part in name:
                break
    return at


@pytest.mark.slow
def test_a_sensor_sees_its_own_robot_where_it_is_at_the_time_of_each_ray(ground):
    robot = load_robot(EXAMPLES / "rover.urdf")
    actors = robot.actors(DRIVE, MOTION, without=["lidar"])
    scene = ground.with_actors(actors)
    mount = robot.path("lidar").pose(0).compose(Pose((0, 0, 0.26), pitch_deg=35))
    assert np.allclose(mount.position, (-0.36, 0, 0.3 + 0.13 + 0.61 + 0.26))
    sensor = load_sensor("velodyne/vlp16", min_range_m=0)
    survey = Survey(
        sensors=[Mounted(sensor, mount)], trajectory=DRIVE, columns=COLUMNS, precision_m=1e-4
    )
    batches = list(Rig(scene, survey, "numpy").cast(0, survey.scan_count))
    hits = dict.fromkeys(scene.object_names, 0)
    for batch in batches:
        # Where the sensor was when the ray was fired, with poses made here.
        place, rotation = DRIVE.poses(0, batch.time.astype(np.float64))
        starts = sensor.beams.origin[batch.channel] @ mount.rotation.T + mount.position
        origins = place + rotate_into_frames(starts, rotation.transpose(0, 2, 1))
        ranges = np.linalg.norm(batch.positions - origins, axis=1)
        assert np.allclose(ranges, batch.range, atol=2e-5)  # straight between firings
        for number, actor in enumerate(actors, 1):
            on = np.flatnonzero(batch.object == number)
            if not len(on):
                continue
            hits[actor.name] += len(on)
            on = on[:: max(1, len(on) // 300)]  # of these
            own = []
            for time, point in zip(batch.time[on], batch.positions[on], strict=True):
                at = rover_at(actor.name.partition("/")[2], float(time))
                own.append((point - at[:3, 3]) @ at[:3, :3])
            first = len(ground.faces) + sum(len(a.mesh.faces) for a in actors[: number - 1])
            corners = actor.mesh.vertices[actor.mesh.faces[batch.triangle[on] - first]]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            off = ((own - corners[:, 0]) * normals).sum(axis=1)
            assert np.abs(off).max() < 1e-6, actor.name
    seen = {name.partition("/")[2] for name, count in hits.items() if count > 5}
    assert {"base_link", "upper_arm", "forearm", "front_left_wheel", "front_right_wheel"} <= seen
    # The same bytes in batches of any size, and on any backend.
    whole = made(survey, scene)
    for backend, each in (("numpy", 7), ("tiles", 50)):
        rig = Rig(scene, survey, backend)
        parts = [
            batch
            for first in range(0, survey.scan_count, each)
            for batch in rig.cast(first, min(first + each, survey.scan_count))
        ]
        for column in survey.stored_columns:
            assert (np.concatenate([column.make(p) for p in parts]) == whole[column.name]).all()
    assert len(stored_positions(whole)) > 5000


def test_a_sensor_on_a_link_that_moves(ground):
    """In Python a survey may follow any link."""
    hand = load_robot(EXAMPLES / "rover.urdf").path("hand", DRIVE, MOTION)
    mounted = [Mounted(load_sensor("velodyne/vlp16"), Pose((0, 0, 0.1), roll_deg=20))]
    survey = Survey(sensors=mounted, trajectory=hand, columns=["time"], precision_m=1e-4)
    found = made(survey, ground)
    heights = stored_positions(found, 1e-4)[:, 2]
    assert len(heights) > 5000 and np.abs(heights).max() <= 1e-4
    assert found["time"].max() > 0.39e9


SCENARIO = {
    "scene": {"copies": [{"name": "Crate", "box": [1, 1, 1], "at": [[3, 3, 0]]}]},
    "trajectory": {
        "points": [{"time_s": 5, "position": [0, 0, 0]}, {"time_s": 7, "position": [2, 0, 0]}]
    },
    "sensor": {"model": "velodyne/vlp16"},
    "planning": {"enabled": False},
}  # fmt: skip
ROVER = {"name": "Rover", "file": "rover.urdf", "joints": "joints.csv"}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rover.urdf").write_bytes((EXAMPLES / "rover.urdf").read_bytes())
    (tmp_path / "joints.csv").write_text("time_s,turret,elbow\n5,0,1\n7,1,2\n")
    return tmp_path


def test_a_scenario_has_its_robot_and_its_sensor_on_a_link(folder):
    data = SCENARIO | {
        "actors": [
            ROVER | {"class": 7},
            {"name": "Box", "box": [1, 1, 1]},
            {"name": "Arm", "file": "rover.urdf",
             "trajectory": {"points": [{"time_s": 4, "position": [9, 0, 0]},
                                       {"time_s": 8, "position": [9, 1, 0]}]}},
        ],
        "mount": {"link": "lidar", "position": [0, 0, 0.036], "yaw_deg": 90},
        "materials": [{"objects": "Rover/*wheel", "reflectance": 0.1}, {"objects": "*"}],
    }  # fmt: skip
    built = prepare(Scenario.from_data(data, folder=folder))
    actors = {actor.name: actor for actor in built.scene.actors}
    assert [name for name in actors if name.startswith("Rover/")][:2] == [
        "Rover/base_link", "Rover/front_left_wheel",
    ]  # fmt: skip
    assert (
        len(actors["Arm/base_link"].mesh.faces) - len(actors["Rover/base_link"].mesh.faces) == 256
    )
    assert actors["Box"].trajectory.pose(0, 1e9) == Pose((1.0, 0.0, 0.0))
    turret = actors["Rover/shoulder_block"].trajectory.pose(0, 1e9)
    assert np.allclose([*turret.position, turret.yaw_deg], [1.3, 0, 0.4, np.degrees(0.5)])
    survey = built.survey
    (carried,) = survey.mounted_sensors
    assert np.allclose(carried.mount.position, (-0.36, 0, 1.076))
    assert carried.mount.yaw_deg == pytest.approx(90)
    kinds = {name: next(m for m in survey.materials if m.applies_to(name)) for name in actors}
    assert kinds["Rover/rear_left_wheel"].reflectance == 0.1
    assert {kinds[name].semantic_class == 7 for name in actors if "Rover/" in name} == {True}
    assert kinds["Arm/base_link"].semantic_class != 7
    notes = advice(built)
    assert (
        "link lidar of Rover is not part of the scene, because a sensor is mounted on it" in notes
    )
    assert built.findings.sources["rover.urdf"].startswith(
        "14 links, 6,720 triangles; 9 movable joints"
    )


def test_a_robot_that_stands_moves_its_joints_by_the_clock_of_the_survey(folder):
    data = SCENARIO | {"actors": [ROVER | {"at": {"position": [9, 0, 0], "yaw_deg": 90}}]}
    actors = {a.name: a for a in prepare(Scenario.from_data(data, folder=folder)).scene.actors}
    assert actors["Rover/base_link"].trajectory.pose(0, 1e9).yaw_deg == pytest.approx(90)
    turret = actors["Rover/shoulder_block"].trajectory.pose(0, 1e9)
    expected = [9, 0.3, 0.4, 90 + np.degrees(0.5)]
    assert np.allclose([*turret.position, turret.yaw_deg], expected)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"trajectory": None, "poses": [[0, 0, 1]]}, "replace `poses` with a `trajectory`"),
        ({"actors": []}, "`mount.link` requires a robot as the platform"),
        ({"actors": [ROVER | {"at": [0, 0, 0]}]}, "`mount.link` requires a robot as the platform"),
        ({"mount": {"link": "lidor"}}, "0 robots have a link 'lidor'.*Did you mean 'lidar'"),
        ({"mount": {"link": "hand"}}, "'hand', which is moved by joints.csv"),
        ({"actors": [ROVER | {"name": name} for name in "AB"]}, "but 2 robots have a link"),
        (
            {"actors": [{"name": "B", "box": [1, 1, 1], "joints": "a.csv"}]},
            "`joints` requires a robot",
        ),
        (
            {"actors": [{"name": "R", "file": {"file": "rover.urdf", "scale": 2}}]},
            "only be combined with `opacity`",
        ),
    ],
)
def test_scenarios_that_do_not_fit_their_robot(folder, change, words):
    data = SCENARIO | {"actors": [ROVER], "mount": {"link": "lidar"}} | change
    data = {key: value for key, value in data.items() if value is not None}
    with pytest.raises(LidarError, match=words):
        scenario = Scenario.from_data(data, folder=folder)
        prepare(scenario)


def test_a_robot_that_leaves_needs_joints_for_its_stay_only(folder):
    table = "time_s,turret\n0.2,0\n0.6,1\n"
    (folder / "joints.csv").write_text(table)
    points = [{"time_s": t, "position": [5, 0, 0]} for t in (0.2, 0.6)]
    scenario = Scenario.from_data(
        {
            "scene": {"ground": {}, "copies": [{"name": "Post", "box": [1, 1, 1], "at": [[9, 9]]}]},
            "poses": [[0, 0, 1]],
            "steps": 360,
            "actors": [ROVER | {"trajectory": {"points": points, "beyond": "absent"}}],
        },
        folder=folder,
    )
    job = prepare(scenario).job
    for actor in job.scene.actors:
        assert actor.trajectory.presence_ns == pytest.approx((0.2e9, 0.6e9))


def test_a_robot_alone_stands_still_with_its_joints_at_zero(folder):
    alone = prepare(Scenario.load(folder / "rover.urdf"))
    robot = load_robot(folder / "rover.urdf")
    assert alone.placement.surrounds_object and not alone.scene.actors
    assert alone.scene.names == tuple(actor.name for actor in robot.actors())
    assert "are at zero. To move them" in advice(alone)[0]
    entry = {"file": "rover.urdf", "rotation_deg": [0, 0, 90], "translation": [5, 0, 0]}
    placed = prepare(Scenario.from_data({"scene": [entry]}, folder=folder)).scene
    at_zero, turned = (scene.bounds + scene.origin for scene in (alone.scene, placed))
    np.testing.assert_allclose(turned[:, 0], 5 - at_zero[::-1, 1], atol=1e-6)
    np.testing.assert_allclose(turned[:, 1:], at_zero[:, [0, 2]], atol=1e-6)
    with pytest.raises(
        LidarError, match=r"is a robot, which is always in meters with z up\. Remove `unit`"
    ):
        prepare(Scenario.from_data({"scene": [entry | {"unit": "mm"}]}, folder=folder))
    with pytest.raises(
        LidarError, match=r"cannot be read\. It describes a robot\. Read it with load_robot"
    ):
        Scene.load(folder / "rover.urdf")


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("a.mjcf", "MuJoCo models must have the extension .xml"),
        ("a.osm", "It is a map"),
    ],
)
def test_other_robots_are_refused_with_what_becomes_of_them(tmp_path, name, way):
    (tmp_path / name).write_text("<mujoco/>")
    for scenario in (
        Scenario.load(tmp_path / name),
        Scenario.from_data({"scene": name}, folder=tmp_path),
    ):
        with pytest.raises(LidarError, match=f"{name} cannot be read. .*{way}"):
            prepare(scenario)


def test_of_a_scale_of_four_numbers_the_first_three_count(tmp_path):
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n")
    shape = '<mesh filename="b.obj" scale="1 2 3 {}"/>'
    four, three = (
        robot_of(tmp_path, link("a", visual(shape.format(more)))).meshes["a"] for more in ("1", "")
    )
    np.testing.assert_array_equal(four.vertices, three.vertices)
    assert three.vertices.max(axis=0).tolist() == [1, 2, 3]

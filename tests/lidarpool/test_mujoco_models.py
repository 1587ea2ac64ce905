"""Models of MuJoCo as scenes: geoms are where MuJoCo has them, rangefinders measure as there."""

from __future__ import annotations

import resource
import subprocess
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from PIL import Image
from tests.fork_server import ForkServer

from lidarpool.cli.scenario_commands import import_
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.files import child_process
from lidarscenes.mujoco import model_file
from lidarsim import LidarError, MujocoScanner, Scanner, Scene, SceneInstance, Sensor
from lidarsim.io import allowance
from lidarsim.scene.files.meshfile import load_objects

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")

ROOM = """
<mujoco>
  <!-- -- as MuJoCo allows -- -->
  <compiler meshdir="meshes" texturedir="images"/>
  <asset>
    <mesh name="wedge" file="wedge.obj"/>
    <texture name="halves" type="2d" file="halves.png"/>
    <material name="paint" texture="halves"/>
    <material name="glass" rgba="1 1 1 .4"/>
    <material name="unused" rgba="1 1 1 .4"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1"/>
    <geom type="box" size=".1 4 2" pos="5 0 1" material="glass"/>
    <geom type="box" size="4 .1 2" pos="0 5 1" euler="0 0 10"/>
    <body name="robot" pos="1 .5 1" euler="0 0 30">
      <freejoint/>
      <geom name="trunk" type="box" size=".2 .1 .1"/>
      <geom name="hull" type="sphere" size=".5" group="3"/>
      <site name="alone" pos="0 0 .3" zaxis="1 0 .2"/>
      <camera name="depth" pos="0 0 .4" euler="80 -60 0" fovy="50" resolution="7 5"/>
      <camera name="lens" pos="0 0 .5" xyaxes="0 -1 0 0 0 1" resolution="4 4" sensorsize=".02 .01"
              focal=".03 .02" principal=".001 -.002"/>
      <body name="arm" pos="0 0 .3">
        <joint name="arm" type="hinge" axis="0 0 1"/>
        <geom type="mesh" mesh="wedge" material="paint"/>
        <replicate count="9" euler="0 0 40" sep="-">
          <site name="ring" pos=".3 .02 .1" zaxis="1 0 -.3"/>
        </replicate>
      </body>
    </body>
    <body name="ball" pos="2 -2 1"><freejoint/><geom type="sphere" size=".4"/></body>
  </worldbody>
  <sensor>
    <rangefinder site="ring" cutoff="4.5"/>
    <rangefinder site="alone"/>
    <rangefinder camera="depth"/>
    <rangefinder camera="lens"/>
  </sensor>
  <keyframe>
    <key name="home" qpos="0 0 1 1 0 0 0 .7 3 0 1 1 0 0 0"/>
  </keyframe>
</mujoco>
"""
WEDGE = "v 0 0 0\nv .3 0 0\nv 0 .4 0\nv 0 0 .5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
BOX = '<geom type="box" size="1 1 1"/>'


@pytest.fixture(scope="module")
def server():
    with closing(ForkServer("import mujoco, numpy")) as server:
        yield server


@pytest.fixture(autouse=True)
def forked(server, monkeypatch):
    """Processes of one that has imported MuJoCo once."""
    names = {name: getattr(subprocess, name) for name in ("DEVNULL", "PIPE")}
    monkeypatch.setattr(child_process, "subprocess", SimpleNamespace(Popen=server, **names))


@pytest.fixture
def room(tmp_path):
    """Path of the model with its files."""
    for folder in ("meshes", "images"):
        (tmp_path / folder).mkdir()
    (tmp_path / "meshes" / "wedge.obj").write_text(WEDGE)
    pixels = np.zeros((4, 8, 3), np.uint8)
    pixels[:, :4] = 255
    Image.fromarray(pixels).save(tmp_path / "images" / "halves.png")
    return write(tmp_path / "room.xml", ROOM)


def write(path, text):
    path.write_text(text)
    return path


def mjcf(*elements):
    return f"<mujoco>{''.join(elements)}</mujoco>"


def world(*elements):
    return mjcf("<worldbody>", *elements, "</worldbody>")


def load(path, **options):
    notes = []
    objects = load_objects(path, report=notes.append, **options)
    return {item.name: item for item in objects.static}, notes


def state(path, keyframe=None):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("keyframe", [None, "home"])
def test_geoms_are_where_they_are_for_the_scanner_of_mujoco(room, keyframe):
    model, data = state(room, None if keyframe is None else 0)
    sensor = Sensor.grid(180, 16, vertical_fov_deg=60, max_range_m=20)
    expected = MujocoScanner(model, sensor, body="robot", groups=(0, 3)).ranges(data)
    scene = Scene.load(room, keyframe=keyframe, groups=[0, 3], exclude=["robot"])
    matrix = np.eye(4)
    matrix[:3, 3] = data.body("robot").xpos - scene.origin
    matrix[:3, :3] = data.body("robot").xmat.reshape(3, 3)
    (ranges,) = Scanner(scene, sensor).ranges(matrix[None])
    assert np.isfinite(ranges).mean() > 0.5
    both = np.isfinite(ranges) & np.isfinite(expected)
    assert (np.isfinite(ranges) != np.isfinite(expected)).mean() < 1e-3
    assert np.quantile(np.abs(ranges[both] - expected[both]), 0.999) < 1e-5


def test_objects_are_bodies_and_named_geoms_of_the_world(room):
    objects, notes = load(room, colors=True, materials=True)
    assert [*objects] == ["floor", "world", "robot", "arm", "ball"]
    assert objects["robot"].bounds.round(3).tolist() == [[0.777, 0.313, 0.9], [1.223, 0.687, 1.1]]
    assert objects["floor"].bounds[1].tolist() == [200, 200, 0]
    assert np.unique(objects["arm"].colors.corners).tolist() == [188]  # the mean of its texture
    assert objects["arm"].materials.names == ("paint",)
    (note,) = notes
    assert "glass" in note and "unused" not in note
    with_hull, _ = load(room, groups=[0, 3], exclude=["floor", "trunk"])
    assert [*with_hull] == ["world", "robot", "arm", "ball"]
    assert np.allclose(with_hull["robot"].bounds[1], [1.5, 1, 1.5], atol=1e-3)
    assert with_hull["robot"].colors is None and with_hull["arm"].materials is None


def test_a_scenario_takes_the_options(room):
    entry = {"file": "room.xml", "keyframe": "home", "groups": [0], "exclude": ["floor"]}
    data = {"scene": {"files": [entry]}, "poses": [[0, 0, 2]]}
    scene = prepare(Scenario.from_data(data, folder=room.parent)).scene
    assert scene.names == ("world", "robot", "arm", "ball")
    for change, message in (
        ({"keyframe": "hom"}, "no keyframe 'hom'. Did you mean 'home'"),
        ({"exclude": ["flor"]}, "no body or geom 'flor'. Did you mean 'floor'"),
        ({"groups": [5]}, r"can detect in the groups \(5,\)"),
        (
            {"file": "meshes/wedge.obj"},
            r"support keyframe, groups and exclude \(options of .xml\)",
        ),
        ({"geometry": "collision"}, r"not support geometry \(an option of .sdf .world\)"),
    ):
        with pytest.raises(LidarError, match=message):
            changed = {**data, "scene": {"files": [{**entry, **change}]}}
            prepare(Scenario.from_data(changed, folder=room.parent))


def test_copies_of_large_meshes_are_instances(tmp_path):
    bodies = [
        f'<body pos="{k} 0 0"><freejoint/><geom type="sphere" size="3"/></body>' for k in range(6)
    ]
    objects, _ = load(write(tmp_path / "m.xml", world(*bodies)))
    assert all(isinstance(item, SceneInstance) for item in objects.values())
    assert len({id(item.mesh) for item in objects.values()}) == 1


def test_many_round_geoms_get_fewer_triangles(tmp_path, monkeypatch):
    monkeypatch.setattr(model_file, "_MAX_ROUND_TRIANGLES", 40_000)
    balls = [f'<geom type="sphere" size="{1 + k / 1e5}" pos="{3 * k} 0 0"/>' for k in range(40)]
    objects, _ = load(write(tmp_path / "m.xml", world(*balls)))
    triangles = len(objects["world"].faces)
    assert 10_000 < triangles <= 40_000


def ranges_of(built, number):
    """Ranges of a sensor of a scenario, (channels,)."""
    survey = built.survey
    scanner = Scanner(built.scene, survey.sensors[number])
    return scanner.ranges(survey.poses[0])[0]


def test_rangefinders_become_sensors_that_measure_as_in_mujoco(room):
    out = room.parent / "out"
    result = CliRunner().invoke(import_, [str(room), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "rangefinder hits on geoms of group 3 (to include them, set groups in" in result.output
    scenario = yaml.safe_load((out / "scenario.yaml").read_text())
    assert [*scenario["sensors"]] == ["robot", "depth", "lens", "arm"]
    assert scenario["sensors"]["arm"]["max_range_m"] == 4.5
    assert scenario["scene"]["files"] == ["../room.xml"]
    own = {name: sensor.get("unseen") for name, sensor in scenario["sensors"].items()}
    assert own == {"robot": ["robot"], "depth": ["robot"], "lens": ["robot"], "arm": ["arm"]}
    # As MuJoCo's rays, which meet all groups, but not the sensor's own body: without the hull.
    _, data = state(
        write(
            room.with_name("bare.xml"),
            ROOM.replace('group="3"', 'rgba="0 0 0 0"'),
        )
    )
    built = prepare(Scenario.load(out / "scenario.yaml"))
    measured = data.sensordata.copy()
    assert len(measured) == 1 + 35 + 16 + 9
    expected = np.split(measured, np.cumsum([1, 35, 16]))
    ring = expected[3]
    sites = yaml.safe_load((out / "arm.yaml").read_text())["sources"]["channels"].split()[2:]
    ring[:] = ring[[int(name.strip(",").removeprefix("ring-")) for name in sites]]
    assert (ring == 4.5).sum() > 1 < (ring < 4.5).sum()  # of MuJoCo, cut off
    ring[ring >= 4.5] = np.inf
    for number, values in enumerate(expected):
        values[values < 0] = np.inf
        ranges = ranges_of(built, number).reshape(-1)
        if number < 3:  # of distinct values
            ranges, values = np.sort(ranges), np.sort(values)
        seen = np.isfinite(values)
        assert seen.any() and (np.isfinite(ranges) == seen).all()
        assert np.allclose(ranges[seen], values[seen], atol=1e-3)


def test_models_without_usable_rangefinders_make_no_scenario(tmp_path):
    path = write(tmp_path / "m.xml", world(BOX))
    large = (
        '<worldbody><camera name="c" resolution="640 480" pos="0 0 5"/>',
        BOX,
        '</worldbody><sensor><rangefinder camera="c"/></sensor>',
    )
    for text, message in (
        (world(BOX), "no rangefinder that can become a sensor.*lidarpool init --mesh m.xml"),
        (mjcf(*large), "'c' .it has 307,200 rays, and the limit is 65,536"),
        (mjcf("<worldbodi/>"), "Schema violation"),
    ):
        write(path, text)
        with pytest.raises(LidarError, match=f"cannot be converted to a scenario: .*{message}"):
            CliRunner().invoke(
                import_, [str(path), "-o", str(tmp_path / "x")], catch_exceptions=False
            )
        assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot/>", "is a URDF robot. Change its extension to .urdf"),
        ("<document/>", "a HELIOS.*lidarpool import"),
        ("<fcd-export/>", "SUMO floating car data"),
        ("<note/>", "not a MuJoCo model. Its root element is <note>"),
        ("v 1 2 3", "cannot be read"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "declares XML entities"),
        (world(BOX, "<geom/>"), "Error"),
        (world(), "nothing that a lidar can detect"),
        (
            world('<geom type="box" size="1 1 1" rgba="1 1 1 0"/>'),
            "nothing that a lidar can detect",
        ),
        (mjcf('<include file="no.xml"/>'), "no.xml"),
        (mjcf('<include file="../other.xml"/>'), r"'\.\./other.xml', but only files in its own"),
        (mjcf('<compiler meshdir=".."/><asset><mesh file="other.xml"/></asset>'), "but only files"),
        (mjcf('<asset><hfield name="h" file="/dev/zero"/></asset>'), "but only files"),
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path, text, message):
    write(tmp_path / "other.xml", "<mujocoinclude/>")
    (tmp_path / "models").mkdir()
    path = write(tmp_path / "models" / "m.xml", text)
    with pytest.raises(LidarError, match=message) as error:
        load(path)
    assert len(str(error.value).splitlines()) == 1
    assert [file.name for file in path.parent.iterdir()] == ["m.xml"]  # and no log of MuJoCo


def test_too_many_geoms_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(model_file, "MAX_NODES", 9)
    with pytest.raises(LidarError, match="has 10 geoms, and the limit is 9"):
        load(write(tmp_path / "m.xml", world(BOX * 10)))


def test_files_of_named_folders_are_read(tmp_path):
    (tmp_path / "models").mkdir()
    write(tmp_path / "other.xml", f"<mujocoinclude><body>{BOX}</body></mujocoinclude>")
    (tmp_path / "models" / "link.xml").symlink_to(tmp_path / "other.xml")
    for name in ("../other.xml", "link.xml", f"{tmp_path}/other.xml"):
        path = write(tmp_path / "models" / "m.xml", world(f'<include file="{name}"/>'))
        with pytest.raises(LidarError, match=r"Set assets to the folder that contains that file"):
            load(path)
        objects, notes = load(path, assets=tmp_path)
        assert [*objects] == ["body 1"] and not notes


def test_soft_bodies_are_noted(tmp_path):
    soft = '<flexcomp name="f" type="grid" count="3 3 3" spacing="1 1 1" dim="3" radius=".1"/>'
    _, notes = load(write(tmp_path / "m.xml", world(BOX, soft)))
    assert notes == [f"{tmp_path / 'm.xml'} contains soft bodies, which were skipped: 1 flex."]


def test_mujoco_is_asked_for(room, monkeypatch):
    monkeypatch.setattr(model_file, "find_spec", lambda name: None)
    with pytest.raises(
        LidarError, match=r"which requires the package mujoco\. Install it with `pip install mujoco"
    ):
        load(room)


@pytest.mark.extended
def test_a_model_that_takes_too_much_ends_its_process_only(tmp_path, monkeypatch):
    monkeypatch.setattr(child_process, "subprocess", subprocess)
    text = '<asset><hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/></asset>'
    path = write(tmp_path / "m.xml", mjcf(text, f"<worldbody>{BOX}</worldbody>"))
    with pytest.raises(LidarError, match=r"cannot be read: |would unpack to"):
        load(path)
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 1000)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 0.01)
    with pytest.raises(LidarError, match="would unpack to"):
        load(write(path, world(BOX * 50)))


@pytest.mark.extended
def test_garbled_models_give_objects_or_a_line(room):
    peak_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    whole = ROOM.encode()
    rng = np.random.default_rng(0)
    read = 0
    path = room.with_name("g.xml")
    for _ in range(100):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 3)):
            data[at] = rng.integers(32, 127)
        path.write_bytes(data[: rng.integers(0, len(data))] if rng.random() < 0.2 else data)
        try:
            read += bool(load(path, colors=True)[0])
        except LidarError as error:
            assert len(str(error).splitlines()) == 1
    assert 2 < read < 95
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_before
    assert grown_kib < 100 * 1024

"""Worlds of Gazebo: shapes, frames, models that are looked for, lidars, and broken files."""

from __future__ import annotations

import resource

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from PIL import Image
from tests.lidarpool.test_robots import DAE

from lidarpool.cli.scenario_commands import import_
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Scene, load_sensor
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

BOX = "<geometry><box><size>1 1 1</size></box></geometry>"
VISUAL = f'<visual name="v">{BOX}</visual>'


def sdf(*elements, version="1.9"):
    return f'<?xml version="1.0"?><sdf version="{version}">{"".join(elements)}</sdf>'


def world(*elements):
    return sdf(f'<world name="w">{"".join(elements)}</world>')


def link(name="link", inside=VISUAL, pose=""):
    return f'<link name="{name}">{pose}{inside}</link>'


def model(name, *elements, attributes=""):
    return f'<model name="{name}" {attributes}>{"".join(elements)}</model>'


def shape(inside, kind="visual", more=""):
    return f'<{kind} name="s"><geometry>{inside}</geometry>{more}</{kind}>'


def include(uri, inside=""):
    return f"<include><uri>{uri}</uri>{inside}</include>"


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def add_model(folder, name, text=None, versions=(("1.9", "model.sdf"),)):
    """A model in a folder of models."""
    for version, file in versions:
        write(folder / name / file, text or sdf(model(name, link()), version=version))
    entries = "".join(f'<sdf version="{version}">{file}</sdf>' for version, file in versions)
    write(folder / name / "model.config", f"<model><name>{name}</name>{entries}</model>")


def load(folder, text, name="w.sdf", **options):
    notes = []
    objects = load_objects(write(folder / name, text), report=notes.append, **options)
    return {item.name: item for item in objects.static}, objects.actors, notes


def bounds(item):
    return item.bounds.round(6).tolist()


def center(item):
    return item.bounds.mean(axis=0)


@pytest.fixture(autouse=True)
def no_folders(monkeypatch, tmp_path):
    """No models of this machine."""
    for name in ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH", "GZ_FUEL_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


SHAPES = {
    "<box><size>1 2 3</size></box>": (1, 2, 3),
    "<sphere><radius>0.5</radius></sphere>": (1, 1, 1),
    "<cylinder><radius>0.5</radius><length>4</length></cylinder>": (1, 1, 4),
    "<cone><radius>0.5</radius><length>4</length></cone>": (1, 1, 4),
    "<capsule><radius>0.5</radius><length>4</length></capsule>": (1, 1, 5),
    "<ellipsoid><radii>1 2 3</radii></ellipsoid>": (2, 4, 6),
    "<plane><normal>0 0 1</normal><size>3 4</size></plane>": (3, 4, 0),
    "<plane><normal>1 0 0</normal><size>3 4</size></plane>": (0, 4, 3),
    "<plane><normal>0 0 -2</normal><size>3 4</size></plane>": (3, 4, 0),
    "<polyline><point>0 0</point><point>2 0</point><point>2 1</point><height>3</height>"
    "</polyline>": (2, 1, 3),
}


def test_shapes_have_their_sizes(tmp_path):
    models = [model(f"m{k}", link(inside=shape(s))) for k, s in enumerate(SHAPES)]
    objects, _, notes = load(tmp_path, world(*models))
    assert not notes
    for k, (text, size) in enumerate(SHAPES.items()):
        item = objects[f"m{k}/link"]
        assert np.allclose(np.ptp(item.bounds, axis=0), size, rtol=2e-3), text
    normals = objects["m7/link"].vertices[objects["m7/link"].faces]
    assert (np.cross(normals[:, 1] - normals[:, 0], normals[:, 2] - normals[:, 0])[:, 0] > 0).all()


def volume(item):
    return np.linalg.det(item.vertices[item.faces]).sum() / 6


def test_polylines_have_holes_and_roads_their_width(tmp_path):
    square = "".join(f"<point>{x} {y}</point>" for x, y in ((0, 0), (4, 0), (4, 4), (0, 4)))
    hole = "".join(f"<point>{x} {y}</point>" for x, y in ((1, 1), (3, 1), (3, 3), (1, 3), (1, 1)))
    lines = f"<polyline>{square}<height>2</height></polyline><polyline>{hole}</polyline>"
    road = "<road name='lane'><width>3</width><point>0 0 1</point><point>9 0 1</point></road>"
    objects, _, notes = load(tmp_path, world(model("m", link(inside=shape(lines))), road))
    assert not notes
    assert volume(objects["m/link"]) == pytest.approx((16 - 4) * 2)
    assert bounds(objects["lane"]) == [[0, -1.5, 1], [9, 1.5, 1]]


def test_height_maps_reach_their_size_with_the_first_row_at_the_greatest_y(tmp_path):
    pixels = np.array([[0, 0, 100], [0, 0, 0], [50, 0, 0]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "hills.png")
    text = "<heightmap><uri>hills.png</uri><size>8 4 10</size><pos>0 0 1</pos></heightmap>"
    objects, _, _ = load(tmp_path, world(model("hill", link(inside=shape(text)))))
    heights = {tuple(v[:2]): v[2] for v in objects["hill/link"].vertices.tolist()}
    assert heights == {
        (x, y): {(4.0, 2.0): 11.0, (-4.0, -2.0): 6.0}.get((x, y), 1.0)
        for x in (-4.0, 0.0, 4.0)
        for y in (-2.0, 0.0, 2.0)
    }
    facing = np.cross(
        *np.diff(objects["hill/link"].vertices[objects["hill/link"].faces], axis=1).swapaxes(0, 1)
    )
    assert (facing[:, 2] > 0).all()


QUARTER = 1.5707963267948966
FRAMES = {
    # pose of a link: relative to its model, a frame, a joint, a nested model, another link
    f"<pose>1 0 0 0 0 {QUARTER}</pose>": (1, 0, 0),
    "<pose relative_to='f'>1 0 0 0 0 0</pose>": (0, 3, 0),  # f is at (0, 2), turned to the left
    "<pose relative_to='j'>1 0 0 0 0 0</pose>": (5, 0, 2),  # j is 2 above link a, which is at x = 4
    "<pose relative_to='n'>1 0 0 0 0 0</pose>": (8, 0, 0),
    "<pose relative_to='n::inner'>1 0 0 0 0 0</pose>": (8, 1, 0),
    "<pose rotation_format='quat_xyzw'>1 2 3  0 0 2 2</pose>": (1, 2, 3),
    "<pose degrees='true'>1 2 3 0 0 90</pose>": (1, 2, 3),
    "<pose/>": (0, 0, 0),
}


@pytest.mark.parametrize("pose", FRAMES)
def test_links_are_where_their_frames_put_them(tmp_path, pose):
    others = [
        f"<frame name='f'><pose>0 2 0 0 0 {QUARTER}</pose></frame>",
        link("a", pose="<pose>4 0 0 0 0 0</pose>"),
        "<joint name='j' type='fixed'><parent>a</parent><child>a</child>"
        "<pose>0 0 2 0 0 0</pose></joint>",
        model("n", "<pose>7 0 0 0 0 0</pose>", link("inner", pose="<pose>0 1 0 0 0 0</pose>")),
    ]
    turned = "<pose>10 0 0 0 0 0</pose>"
    objects, _, _ = load(tmp_path, world(model("m", turned, *others, link("p", pose=pose))))
    assert np.allclose(center(objects["m/p"]) - [10, 0, 0], FRAMES[pose])
    assert np.allclose(center(objects["m/n/inner"]), [17, 1, 0])
    visual = f"<visual name='v'><pose relative_to='f'>1 0 0 0 0 0</pose>{BOX}</visual>"
    objects, _, _ = load(tmp_path, world(model("m", *others, link("p", inside=visual, pose=pose))))
    assert np.allclose(center(objects["m/p"]), (0, 3, 0))


def test_included_models_take_name_pose_and_the_newest_version(tmp_path):
    models = tmp_path / "models"
    old = (("1.4", "old.sdf"), ("1.10", "new.sdf"), ("9.9", "unknown.sdf"))
    add_model(models, "crate", versions=old)
    for file, height in (("old", 1), ("new", 2), ("unknown", 3)):
        text = sdf(model("crate", f"<pose>0 0 {height} 0 0 0</pose>", link(), link("top")))
        write(models / "crate" / f"{file}.sdf", text)
    placed = "<placement_frame>top</placement_frame>"
    text = world(
        include("model://crate"),
        include("model://crate", "<name>second</name><pose>5 0 0 0 0 0</pose>"),
        include("model://crate"),  # another of the same name
        model("outer", "<pose>0 9 0 0 0 0</pose>", include("model://crate", placed)),
        model("merging", include("model://crate").replace("<include>", "<include merge='true'>")),
        include("model://ground_plane"),
        include("model://sun"),
        include("https://fuel.gazebosim.org/1.0/OpenRobotics/models/Sun"),
    )
    objects, _, notes = load(tmp_path / "worlds", text)
    assert not notes
    assert center(objects["crate/link"])[2] == 2  # of the newest version that is known
    assert bounds(objects["second/top"]) == [[4.5, -0.5, -0.5], [5.5, 0.5, 0.5]]
    assert "crate_0/link" in objects and "merging/top" in objects
    assert center(objects["outer/crate/link"]).tolist() == [0, 9, 2]
    assert bounds(objects["ground_plane/link"]) == [[-50, -50, 0], [50, 50, 0]]


def test_merged_models_with_the_same_links_keep_their_positions(tmp_path):
    text = sdf(model("crate", link(), model("lid", "<pose>0 0 3 0 0 0</pose>", link())))
    add_model(tmp_path / "models", "crate", text=text)
    merged = [
        include("model://crate", f"<pose>{x} 0 0 0 0 0</pose>").replace(
            "<include>", "<include merge='true'>"
        )
        for x in (5, 9)
    ]
    objects, _, notes = load(tmp_path / "worlds", world(model("m", link(), *merged)))
    assert not notes
    found = {name: center(mesh).tolist() for name, mesh in objects.items()}
    assert found == {
        "m/link": [0, 0, 0],
        "m/link_0": [5, 0, 0],
        "m/link_1": [9, 0, 0],
        "m/lid/link": [5, 0, 3],
        "m/lid_0/link": [9, 0, 3],
    }


def test_models_are_looked_for_in_variables_and_downloads(tmp_path, monkeypatch):
    add_model(tmp_path / "a", "one")
    add_model(tmp_path / "b", "two")
    cache = tmp_path / "home" / ".gz" / "fuel" / "fuel.gazebosim.org" / "openrobotics" / "models"
    for version in ("2", "10"):
        text = sdf(model("cone", f"<pose>0 0 {version} 0 0 0</pose>", link()))
        add_model(cache / "traffic cone", version, text)
    fuel = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Traffic%20Cone"
    text = world(
        include("model://one"),
        include("model://two"),
        include(fuel),
        include(f"{fuel}/2", "<name>older</name>"),
        include(f"{fuel}/tip", "<name>t</name>"),
    )
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", f"/nowhere:{tmp_path / 'a'}")
    monkeypatch.setenv("GAZEBO_MODEL_PATH", str(tmp_path / "b"))
    objects, _, notes = load(tmp_path / "worlds", text)
    assert not notes
    heights = {name: center(item)[2] for name, item in objects.items()}
    assert heights == {"one/link": 0, "two/link": 0, "cone/link": 10, "older/link": 2, "t/link": 10}
    monkeypatch.delenv("GAZEBO_MODEL_PATH")
    _, _, notes = load(tmp_path / "worlds", text)
    assert len(notes) == 1 and notes[0].endswith("refers to 1 missing model: two. It was skipped.")
    assert load(tmp_path / "worlds", text, assets=tmp_path / "b")[2] == []


def test_above_a_world_only_folders_with_a_configuration_are_models(tmp_path):
    """Otherwise a world that was downloaded could read any folder above, by its name."""
    deep = tmp_path / "downloads" / "city"
    add_model(tmp_path, "tree")
    write(tmp_path / "private" / "model.sdf", sdf(model("p", link())))
    write(tmp_path / "private" / "house.dae", DAE)
    write(tmp_path / "letters" / "a.txt", "private")
    text = world(include("model://tree"), include("model://letters"))
    objects, _, notes = load(deep, text)
    assert list(objects) == ["tree/link"]
    assert notes[0].endswith("refers to 1 missing model: letters. It was skipped.")

    mesh = model("m", link(inside=shape("<mesh><uri>{}</uri></mesh>")))
    for part in (
        include("model://private"),
        mesh.format("model://private/house.dae"),
        mesh.format("package://private/house.dae"),
        mesh.format("private/house.dae"),
    ):
        with pytest.raises(LidarError) as caught:
            load(deep, world(part))
        assert (
            f"is in {tmp_path / 'private'}, which has no model.config. Set `assets` to "
            "the folder that contains it."
        ) in str(caught.value)
        assert load(deep, world(part), assets=tmp_path)[0]
    (deep / "link.dae").symlink_to(tmp_path / "private" / "house.dae")
    for name in ("link.dae", "../../private/house.dae", f"file://{tmp_path}/private/house.dae"):
        with pytest.raises(
            LidarError, match=r"refers to a file outside .*city.* Move the file there"
        ):
            load(deep, world(mesh.format(name)))
        assert load(deep, world(mesh.format(name)), assets=tmp_path)[0]
    write(tmp_path / "private" / "package.xml", "<package/>")
    assert load(deep, world(mesh.format("package://private/house.dae")))[0]
    with pytest.raises(LidarError, match="Set `assets` to"):
        load(deep, world(mesh.format("model://private/house.dae")))


def test_beside_a_folder_of_worlds_models_have_a_configuration_or_are_of_a_package(tmp_path):
    """The folder above `worlds` may be anything, such as the home of a user."""
    write(tmp_path / "private" / "house.dae", DAE)
    write(tmp_path / "worlds" / "own" / "house.dae", DAE)
    mesh = model("m", link(inside=shape("<mesh><uri>{}</uri></mesh>")))
    for uri in ("../private/house.dae", "private/house.dae", "model://own/house.dae"):
        assert load(tmp_path / "worlds", world(mesh.format(uri)))[0]
    text = world(mesh.format("model://private/house.dae"))
    with pytest.raises(LidarError, match=r"which has no model\.config\. Set `assets` to"):
        load(tmp_path / "worlds", text)
    write(tmp_path / "package.xml", "<package/>")
    assert load(tmp_path / "worlds", text)[0]


def test_missing_things_are_named_and_the_rest_is_there(tmp_path):
    parts = [
        include("model://crate"),
        include("model://crate", "<name>again</name>"),
        include("https://fuel.gazebosim.org/1.0/Someone/models/House"),
        model("m", link("a"), link("b", shape("<mesh><uri>model://crate/a.dae</uri></mesh>"))),
        model("n", link("c", shape("<blob/>")), link("d", shape(SHAPE, "collision")), "<wheel/>"),
    ]
    objects, _, notes = load(tmp_path, world(*parts, "<lava/>", "<gz:thing/>", "<lava/>"))
    assert list(objects) == ["m/a"]
    lacking, files, unknown, collisions = notes
    assert lacking.endswith(
        "2 missing models in 3 places: crate, Someone/House. They were skipped."
    )
    assert files.endswith("refers to 1 missing file: model://crate/a.dae. It was skipped.")
    assert unknown.endswith("were skipped: world/lava, model/wheel, geometry/blob.")
    assert collisions.endswith("without visuals, whose collision shapes were skipped: n::d.")
    with pytest.raises(
        LidarError,
        match=r"contains nothing that a lidar can detect\. It refers to missing models or files: "
        "crate",
    ):
        load(tmp_path, world(include("model://crate")))
    objects, _, _ = load(tmp_path, world(*parts), geometry="collision")
    assert list(objects) == ["n/d"]
    with pytest.raises(LidarError, match=r"an option of \.sdf \.world\)\. Remove geometry"):
        Scene.load(write(tmp_path / "m.dae", DAE), geometry="collision")
    with pytest.raises(LidarError, match="geometry: collision"):
        load(tmp_path, world(model("n", link("d", shape(SHAPE, "collision")))))


SHAPE = "<sphere><radius>1</radius></sphere>"


def test_xml_that_gazebo_reads(tmp_path):
    text = world(
        "<!-- a -- b --->",
        "<ignition:clock>1</ignition:clock>",
        "<![CDATA[ <model> ]]>",
        model("m &amp; n&#33;", link(), attributes="unbound:x='1'"),
    )
    assert list(load(tmp_path, "<!DOCTYPE sdf>\n\n" + text)[0]) == ["m & n!/link"]


def test_a_state_of_gazebo_classic_replaces_poses(tmp_path):
    state = """<state world_name='w'>
      <model name='a'><pose>1 0 0 0 0 0</pose><scale>2 2 2</scale>
        <link name='moved'><pose>0 0 9 0 0 0</pose></link></model>
      <model name='outer'><pose>3 0 0 0 0 0</pose>
        <model name='inner'><pose>4 0 0 0 0 0</pose></model></model>
      <insertions><model name='new'><link name='link'><visual name='v'><geometry><box>
        <size>1 1 1</size></box></geometry></visual></link></model></insertions>
      <deletions><name>b</name></deletions></state>"""
    text = world(
        model("a", link("kept"), link("moved")),
        model("b", link()),
        model("outer", link(), model("inner", link())),
        state,
    )
    objects, _, notes = load(tmp_path, text)
    assert not notes
    assert {name: center(item).tolist() for name, item in objects.items()} == {
        "a/kept": [1, 0, 0],
        "a/moved": [0, 0, 9],
        "outer/link": [3, 0, 0],
        "outer/inner/link": [4, 0, 0],
        "new/link": [0, 0, 0],
    }
    assert np.ptp(objects["a/kept"].bounds, axis=0).tolist() == [2, 2, 2]


def test_meshes_keep_the_axes_of_their_file(tmp_path):
    folder = tmp_path / "a" / "b"
    add_model(folder, "leg")
    write(folder / "leg" / "meshes" / "leg.dae", DAE)
    triangle = "o {0}\nv {1} 0 0\nv {2} 0 0\nv {1} 1 0\nf {3}\n"
    parts = triangle.format("left", 0, 1, "1 2 3") + triangle.format("right", 8, 9, "4 5 6")
    write(folder / "two.obj", parts)

    def mesh(uri, more=""):
        text = f"<mesh><uri>{uri}</uri>{more}</mesh>"
        write(folder / "leg" / "model.sdf", sdf(model("leg", link(inside=shape(text)))))
        return load(folder, world(include("model://leg")))[0]["leg/link"]

    names = ("meshes/leg.dae", "model://leg/meshes/leg.dae", "model://leg//meshes/leg.dae")
    for uri in (*names, "file://meshes/leg.dae", "package://leg/meshes/leg.dae"):
        assert bounds(mesh(uri))[1] == [1, 0, 3], uri  # its unit counts, Y_UP does not
    assert bounds(mesh("meshes/leg.dae", "<scale>2 1 -1</scale>"))[0] == [0, 0, -3]
    part = "<submesh><name>right</name><center>true</center></submesh>"
    text = world(model("m", link(inside=shape(f"<mesh><uri>two.obj</uri>{part}</mesh>"))))
    item = load(folder, text)[0]["m/link"]
    assert bounds(item) == [[-0.5, -0.5, 0], [0.5, 0.5, 0]]
    secret = write(tmp_path / "secret.dae", DAE)
    for uri in ("../../../secret.dae", f"file://{secret}", "model://leg/../../../secret.dae"):
        with pytest.raises(LidarError, match="refers to a file outside") as caught:
            mesh(uri)
        assert len(str(caught.value).splitlines()) == 1


def test_colors_materials_and_retro_are_those_of_visuals(tmp_path):
    red = "<material><diffuse>1 0.5 0 1</diffuse></material>"
    named = "<material><script><name>Gazebo/Blue</name></script></material>"
    retro = "<laser_retro>127.5</laser_retro>"
    bright = "<collision name='c'><laser_retro>4000</laser_retro></collision>"
    text = world(
        model("red", link(inside=shape(SHAPE, more=red))),
        model("blue", link(inside=shape(SHAPE, more=named))),
        model("retro", link(inside=shape(SHAPE, more=red + retro))),
        model("bright", link(inside=shape(SHAPE) + bright)),
        model("glass", link(inside=shape(SHAPE, more="<transparency>1</transparency>"))),
    )
    objects, _, notes = load(tmp_path, text, colors=True, materials=True)
    colors = {name: item.colors.mean_colors()[0].tolist() for name, item in objects.items()}
    assert colors["red/link"] == [255, 128, 0] and colors["blue/link"] == [0, 0, 255]
    assert colors["retro/link"] == [188] * 3 and colors["bright/link"] == [255] * 3
    assert objects["blue/link"].materials.names == ("Gazebo/Blue",)
    assert "glass/link" not in objects and len(notes) == 2
    assert load(tmp_path, text)[0]["red/link"].colors is None


def test_images_of_meshes_are_in_the_folder_of_textures(tmp_path):
    mesh = "<mesh><uri>model://chair/meshes/chair.obj</uri></mesh>"
    add_model(tmp_path, "chair", sdf(model("chair", link(inside=shape(mesh)))))
    write(tmp_path / "chair" / "meshes" / "chair.mtl", "newmtl wood\nmap_Kd wood.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    text = f"mtllib chair.mtl\n{corners}usemtl wood\nf 1/1 2/2 3/3\n"
    textures = tmp_path / "chair" / "materials" / "textures"
    write(tmp_path / "chair" / "meshes" / "chair.obj", text)
    textures.mkdir(parents=True)
    Image.new("RGB", (4, 4), (200, 100, 50)).save(textures / "wood.png")
    objects, _, notes = load(tmp_path, world(include("model://chair")), colors=True)
    assert not notes
    assert objects["chair/link"].colors.mean_colors().tolist() == [[200, 100, 50]]


def test_actors_follow_their_waypoints(tmp_path):
    write(tmp_path / "skin.dae", DAE)
    script = """<script><loop>{loop}</loop><delay_start>1</delay_start>
      <trajectory id='0' type='walk'>
        <waypoint><time>0</time><pose>0 0 1 0 0 0</pose></waypoint>
        <waypoint><time>2</time><pose>4 0 1 0 0 0</pose></waypoint></trajectory>
      <trajectory id='1' type='turn'>
        <waypoint><time>4</time><pose>4 4 1 0 0 1.5707963</pose></waypoint></trajectory></script>"""
    skin = "<skin><filename>skin.dae</filename><scale>2</scale></skin>"
    ground = model("g", link())
    for loop, at_5_5 in (("false", (4, 4)), ("true", (1, 0))):
        actor = f"<actor name='walker'>{skin}{script.format(loop=loop)}</actor>"
        _, (walker,), notes = load(tmp_path, world(ground, actor))
        positions, _ = walker.trajectory.poses(0, np.array([0, 2, 5.5]) * 1e9)
        assert walker.name == "walker" and np.ptp(walker.mesh.bounds[:, 2]) == 6
        assert np.allclose(positions[:2], [[0, 0, 1], [2, 0, 1]])
        assert np.allclose(positions[2, :2], at_5_5, atol=0.01), loop
        assert notes[0].endswith("contains actors, whose skins are not animated.")
    objects, actors, _ = load(
        tmp_path, world(f"<actor name='a'><pose>1 2 3 0 0 0</pose>{skin}</actor>")
    )
    assert not actors and bounds(objects["a"])[0] == [1, 2, 3]


def test_a_loop_that_ends_early_is_noted(tmp_path):
    write(tmp_path / "skin.dae", DAE)
    waypoints = "".join(
        f"<waypoint><time>{k / 100}</time><pose>{k} 0 1 0 0 0</pose></waypoint>" for k in range(101)
    )
    script = f"<script><trajectory id='0' type='walk'>{waypoints}</trajectory></script>"
    skin = "<skin><filename>skin.dae</filename></skin>"
    actor = f"<actor name='walker'>{skin}{script}</actor>"
    _, (walker,), notes = load(tmp_path, world(model("g", link()), actor))
    assert walker.trajectory.times_s[-1] == 49  # 5,000 waypoints at most
    assert any(
        "walker with so many waypoints that its loop is repeated for only 49 s" in n for n in notes
    )


def test_skins_of_actors_are_at_rest(tmp_path):
    matrix = "1 0 0 0  0 1 0 0  0 0 1 0.5  0 0 0 1"
    skin = f"<skin source='#g'><bind_shape_matrix>{matrix}</bind_shape_matrix></skin>"
    controllers = f"<library_controllers><controller id='c'>{skin}</controller>"
    text = DAE.replace("<library_visual", f"{controllers}</library_controllers><library_visual")
    text = text.replace("instance_geometry", "instance_controller").replace("'#g'/>", "'#c'/>")
    write(tmp_path / "walk.dae", text.replace('url="#g"', 'url="#c"'))
    actor = "<actor name='a'><skin><filename>walk.dae</filename></skin></actor>"
    objects, _, _ = load(tmp_path, world(actor))
    assert bounds(objects["a"]) == [[0, 0, 0.005], [1, 0, 3.005]]  # its unit is a centimeter
    mesh = model("m", link(inside=shape("<mesh><uri>walk.dae</uri></mesh>")), link("box"))
    _, _, (note,) = load(tmp_path, world(mesh))
    assert "walk.dae, which was skipped: walk.dae deforms vertices with a skin" in note


BROKEN = {
    "model 'a': link 'l': <pose> is '1 2 3'; it must be 6 finite": world(
        model("a", link("l", pose="<pose>1 2 3</pose>"))
    ),
    "whose quaternion has zero length": world(
        model("a", link("l", pose="<pose rotation_format='quat_xyzw'>1 2 3 0 0 0 0</pose>"))
    ),
    "must be 6 finite numbers": world(model("a", link("l", pose="<pose>1 2 3 0 0 x</pose>"))),
    "<visibility_flags> is '-1'; it must be an integer from 0 to 4294967295": world(
        model("a", link(inside=shape("<box/>", more="<visibility_flags>-1</visibility_flags>")))
    ),
    "the frame 'x' is not defined": world(
        model("a", link("l", pose="<pose relative_to='x'>1 2 3 0 0 0</pose>"))
    ),
    "is relative to itself": world(
        model(
            "a",
            link("b", pose="<pose relative_to='c'/>"),
            link("c", pose="<pose relative_to='b'/>"),
        )
    ),
    "the frame 'a' is relative to itself": world(
        model("a", "<pose relative_to='a::l'/>", link("l"))
    ),
    "must not be below 0": world(
        model("a", link(inside=shape("<sphere><radius>-1</radius></sphere>")))
    ),
    "it declares XML entities": "<!DOCTYPE s [<!ENTITY a 'b'>]>" + world(model("a", link())),
    "uses the XML entity 'a'": world(model("&a;", link())),
    "is truncated: its last element, <world>, is not closed": sdf("<world name='w'>").replace(
        "</sdf>", ""
    ),
    "line 1 contains </sdf> without a matching start tag": sdf("<world name='w'>"),
    "line 2 contains an invalid tag": "<sdf>\n<world name=w></world></sdf>",
    "nested more than 200 levels deep": "<sdf>" + "<a>" * 300,
    "root element is <robot>": "<robot/>",
    "uses the file format of Gazebo before version 1.9": "<gazebo version='1.0'/>",
    "it contains no elements": "just text",
}


@pytest.mark.parametrize("words", BROKEN)
def test_broken_worlds_are_refused_in_a_line(tmp_path, words):
    with pytest.raises(LidarError) as caught:
        load(tmp_path, BROKEN[words])
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1 and len(str(caught.value)) < 500


def test_models_without_end_are_refused(tmp_path):
    add_model(tmp_path, "ring", sdf(model("ring", include("model://ring"), link())))
    with pytest.raises(LidarError, match="it includes itself"):
        load(tmp_path, world(include("model://ring")))
    for k in range(8):
        many = [include(f"model://m{k + 1}", f"<name>n{i}</name>") for i in range(10)]
        add_model(tmp_path, f"m{k}", sdf(model(f"m{k}", *many, link())))
    add_model(tmp_path, "m8")
    with pytest.raises(LidarError, match="contains more than 200,000"):
        load(tmp_path, world(include("model://m0")))
    Image.fromarray(np.zeros((3000, 3000), np.uint8)).save(tmp_path / "huge.png")
    text = "<heightmap><uri>huge.png</uri><size>8 4 10</size></heightmap>"
    _, _, (note,) = load(tmp_path, world(model("a", link()), model("b", link(inside=shape(text)))))
    assert note.endswith("huge.png, which was skipped: huge.png has too many pixels.")


ROBOT = """<model name='robot'><pose>2 1 0 0 0 1.5707963267948966</pose>
  <link name='base'><visual name='v'><geometry><box><size>1 1 1</size></box></geometry></visual>
  </link>
  <link name='mast'><pose>0 0 2 0 0 0</pose>
    <sensor name='scan' type='gpu_lidar'><pose>0.5 0 0 0 0.1 0</pose><update_rate>20</update_rate>
      <lidar><scan>
        <horizontal><samples>5</samples><min_angle>-1</min_angle><max_angle>1</max_angle>
        </horizontal>
        <vertical><samples>3</samples><min_angle>-0.2</min_angle><max_angle>0.1</max_angle>
        </vertical>
      </scan><range><min>0.3</min><max>30</max><resolution>0.01</resolution></range>
      <noise><type>gaussian</type><mean>0</mean><stddev>0.02</stddev></noise></lidar></sensor>
  </link></model>"""


def test_lidars_become_sensors_with_the_angles_of_gazebo(tmp_path):
    path = write(tmp_path / "w.sdf", world(ROBOT, include("model://ground_plane")))
    result = CliRunner().invoke(import_, [str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    sensor = load_sensor(tmp_path / "out" / "scan.yaml", step_deg=360, performance="datasheet")
    directions = sensor.directions(np.arange(5))
    azimuths = np.arctan2(directions[..., 1], directions[..., 0])
    assert np.allclose(azimuths, np.linspace(-1, 1, 5)[:, None])
    assert np.allclose(np.arcsin(directions[..., 2]), np.linspace(-0.2, 0.1, 3))
    assert sensor.head.rate_hz == 20 and sensor.noise.range_m == 0.02
    assert sensor.optics.resolution_m == 0.01
    built = prepare(Scenario.load(tmp_path / "out" / "scenario.yaml"))
    (mounted,) = built.survey.sensors
    assert (mounted.sensor.min_range_m, mounted.sensor.max_range_m) == (0.3, 30)
    pose = built.survey.poses[0].compose(mounted.mount)
    position = np.array(pose.position) + built.scene.origin
    assert np.allclose(position, [2, 1.5, 2])
    assert np.allclose([pose.yaw_deg, pose.pitch_deg], [90, np.degrees(0.1)])


def test_a_full_turn_has_no_direction_twice_and_other_lidars_are_told(tmp_path):
    turn = ROBOT.replace("<min_angle>-1<", "<min_angle>-3.14159265358979<")
    turn = turn.replace("<max_angle>1<", "<max_angle>3.14159265358979<").replace("gpu_lidar", "ray")
    turn = turn.replace("lidar>", "ray>").replace("gaussian", "custom")
    second = turn.replace("'robot'", "'other'").replace("<stddev>0.02", "<stddev>0.03")
    path = write(tmp_path / "w.world", world(turn, second))
    result = CliRunner().invoke(import_, [str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "noise of type 'custom'" in result.output
    assert "geometry: collision in scene.files" in result.output
    sensor = load_sensor(tmp_path / "out" / "scan.yaml", step_deg=360)
    assert sensor.period == 4
    data = yaml.safe_load((tmp_path / "out" / "scenario.yaml").read_text())
    assert list(data["sensors"]) == ["robot::mast::scan", "other::mast::scan"]
    result = CliRunner().invoke(import_, [str(path), "--out", str(tmp_path / "out")])
    assert "exists" in str(result.exception)
    for text, words in (
        (world(model("m", link())), "it contains no sensor"),
        ("<sdf>", "is not closed"),
    ):
        arguments = [str(write(path, text)), "-o", str(tmp_path / "x")]
        with pytest.raises(LidarError, match=f"cannot be converted to a scenario: .*{words}"):
            CliRunner().invoke(import_, arguments, catch_exceptions=False)
        assert not (tmp_path / "x").exists()


def visual(name, flags=None, text=BOX):
    more = "" if flags is None else f"<visibility_flags>{flags}</visibility_flags>"
    return f'<visual name="{name}">{text}{more}</visual>'


def lidar(name, mask=None, more=""):
    more += "" if mask is None else f"<visibility_mask>{mask}</visibility_mask>"
    return f"""<sensor name="{name}" type="gpu_lidar"><update_rate>10</update_rate>
        <lidar><scan><horizontal><samples>180</samples><min_angle>-3.14</min_angle><max_angle>3.14</max_angle></horizontal>
        <vertical><samples>9</samples><min_angle>-0.6</min_angle><max_angle>0.2</max_angle>
        </vertical></scan><range><min>0.1</min><max>40</max></range>{more}</lidar></sensor>"""


def imported(folder, text, *options):
    path = write(folder / "w.sdf", text)
    arguments = [str(path), "--out", str(folder / "out"), *options]
    result = CliRunner().invoke(import_, arguments, catch_exceptions=False)
    scenario = folder / "out" / "scenario.yaml"
    return result.output, yaml.safe_load(scenario.read_text()), Scenario.load(scenario)


def test_lidars_see_visuals_by_masks_and_flags(tmp_path):
    """Links are divided where a lidar sees one visual and not another."""
    up = "<pose>0 0 1.5 0 0 0</pose>"
    boat = model(
        "boat",
        "<pose>0 0 2 0 0 0</pose>",
        link(
            "hull",
            visual("deck", 6) + visual("helper", "0x1") + visual("rail", 6) + visual("mark", 0),
        ),
        link(
            "mast", lidar("all") + lidar("top", 0xFFFFFFFE) + lidar("low", 1) + lidar("off", 0), up
        ),
    )
    at = "<pose>{} 0 0 0 0 0</pose>"
    add_model(tmp_path, "buoy", sdf(model("buoy", link(inside=visual("v", 1)))))
    text = world(
        boat,
        model("water", link(inside=visual("w", 1, "<geometry><plane><size>90 90</size></plane>"
                                          "</geometry>"))),
        model("quay [1]", at.format(5), link(inside=visual("v"))),
        model("quay [2]", at.format(-5), link("a", visual("v", 2)), link("b", visual("v", 4))),
        include("model://buoy", at.format(9)),
        model("lost", link(inside=visual("v", 1, shape("<mesh><uri>no.dae</uri></mesh>")))),
    )  # fmt: skip
    _, data, scenario = imported(tmp_path, text)
    assert "Not supported" not in (tmp_path / "out" / "scenario.yaml").read_text()
    sensors = data["sensors"]
    assert "unseen" not in sensors["all"]
    assert sensors["top"]["unseen"] == ["boat/hull/helper", "water/link", "buoy/link"]
    assert sensors["low"]["unseen"] == ["boat/hull", "quay [[]2]/*"]
    assert sensors["off"]["unseen"] == ["*"]
    built = prepare(scenario)
    assert built.scene.names == (
        "boat/hull", "boat/hull/helper", "water/link", "quay [1]/link", "quay [2]/a",
        "quay [2]/b", "buoy/link",
    )  # fmt: skip
    assert any("visibility_flags> are 0, which were skipped: boat::hull" in note
               for note in built.findings.notes)  # fmt: skip
    seen = {}
    for batch in Rig(built.scene, built.survey, "numpy").cast(0, 4):
        numbers = np.unique(columns_of([batch]).columns["object"])
        seen[batch.specs[0].sensor] = {built.scene.names[number] for number in numbers}
    assert list(sensors) == ["all", "top", "low", "off"]
    assert seen[1] and seen[1] <= {"quay [1]/link", "quay [2]/a", "quay [2]/b", "boat/hull"}
    assert seen[2] and seen[2] <= {"water/link", "boat/hull/helper", "buoy/link", "quay [1]/link"}
    assert not seen[3] and "water/link" in seen[2]


def test_links_are_whole_where_no_lidar_tells_their_visuals_apart(tmp_path):
    """And their names stay; collision shapes have no flags."""
    parts = visual("a", 1) + visual("b", 2) + visual("c")
    whole = load(tmp_path, world(model("m", link(inside=parts))))[0]
    assert list(whole) == ["m/link"] and len(whole["m/link"].faces) == 36
    text = world(model("m", link(inside=parts)), model("robot", link(inside=lidar("s", 3))))
    assert list(load(tmp_path, text)[0]) == ["m/link"]
    text = text.replace("<visibility_mask>3<", "<visibility_mask>2<")
    assert list(load(tmp_path, text)[0]) == ["m/link", "m/link/b"]
    text = text.replace("</visual>", "</visual><collision name='c'>" + BOX + "</collision>", 1)
    assert list(load(tmp_path, text, geometry="collision")[0]) == ["m/link"]


def test_actors_and_roads_are_seen_by_all_masks_but_zero(tmp_path):
    road = "<road name='way'><width>2</width><point>0 0 0</point><point>9 0 0</point></road>"
    text = world(
        road, model("m", link(inside=visual("v", 4))), model("r", link("l", lidar("s", 3)))
    )
    _, data, scenario = imported(tmp_path, text)
    assert data["sensors"]["s"]["unseen"] == ["m/link"]
    assert prepare(scenario).scene.names == ("m/link", "way")


def test_elements_of_lidars_that_are_not_read_are_listed(tmp_path):
    """Misspelt or foreign ones, types of sensors, and noise; prefixes and topics are none."""
    robot = ROBOT.replace("<update_rate>20</update_rate>", "<updaterate>20</updaterate><topic/>")
    robot = robot.replace("<vertical>", "<vertcal/><vertical><sample/>").replace(
        "<min>", "<mx/><min>"
    )
    robot = robot.replace("<noise>", "<visibility/><ros:x/><noise><bias_mean>1</bias_mean>")
    robot = robot.replace("</link></model>", "<sensor name='b' type='gpu_lidr'/></link></model>")
    output, _, _ = imported(tmp_path, world(robot, include("model://ground_plane")))
    listed = (
        "robot::mast::scan: elements that SDFormat does not define (sensor/updaterate, "
        "lidar/visibility, scan/vertcal, vertical/sample, range/mx"
    )
    text = (tmp_path / "out" / "scenario.yaml").read_text()
    kind = "sensor 'robot::mast::b' has the unknown type 'gpu_lidr'. Did you mean"
    for words in (listed, "the mean of the noise bias", kind):
        assert words in output and words in text
    text = ROBOT.replace("<lidar>", "<lidr>").replace("</lidar>", "</lidr>")
    with pytest.raises(LidarError, match=r"neither <lidar> nor <ray>\. Did you mean 'lidr'"):
        imported(tmp_path / "x", world(text))
    with pytest.raises(LidarError, match=r"it contains no sensor .* has the unknown type 'lidarr'"):
        imported(tmp_path / "y", world(ROBOT.replace("gpu_lidar", "lidarr")))


FAR = {
    "a model": (model("fallen", "<pose>0 0 -750000000 0 0 0</pose>", link()), ""),
    "1,000 km": (model("fallen", "<pose>0 0 -1.1e6 0 0 0</pose>", link()), ""),
    "infinite": (model("fallen", "<pose>0 0 -1e400 0 0 0</pose>", link()), ""),
    "NaN": (model("fallen", "<pose>0 0 0 nan 0 0</pose>", link()), ""),
    "a link": (model("fallen", link(pose="<pose>2e7 0 0 0 0 0</pose>")), ""),
    "a quaternion": (
        model("fallen", "<pose rotation_format='quat_xyzw'>9e8 0 0 0 0 0 1</pose>", link()), "",
    ),
    "a frame": (
        model("fallen", "<frame name='f'><pose>0 0 -8e8 0 0 0</pose></frame>",
              link(pose="<pose relative_to='f'/>")), "",
    ),
    "a nested model": (
        model("fallen", "<pose>-4e7 0 0 0 0 0</pose>", model("inner", link(), link("second"))), "",
    ),
    "an included model": (
        include("model://crate", "<name>fallen</name><pose>0 -2e9 0 0 0 0</pose>"), "",
    ),
    "a state": (
        model("fallen", link()),
        "<state world_name='w'><model name='fallen'><pose>0 0 -7.5e8 0 0 0</pose></model></state>",
    ),
    "an actor": (
        "<actor name='fallen'><skin><filename>model://crate/skin.dae</filename></skin>"
        "<pose>0 0 -1e10 0 0 0</pose></actor>", "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAR)
def test_what_fell_for_a_long_time_is_left_out_and_named(tmp_path, name):
    """Two public worlds have such a model; a third has NaN."""
    add_model(tmp_path, "crate")
    write(tmp_path / "crate" / "skin.dae", DAE)
    element, state = FAR[name]
    objects, _, notes = load(tmp_path, world(model("kept", link()), element, state))
    assert list(objects) == ["kept/link"]
    notes = [note for note in notes if "skins" not in note]
    assert len(notes) == 1 and "1,000 km away or whose position is not a number (fallen" in notes[0]
    scene = Scene.load(tmp_path / "w.sdf")
    assert np.abs(scene.bounds).max() <= 0.5 and not scene.origin.any()


def test_lidars_of_models_that_fell_are_listed(tmp_path):
    fallen = ROBOT.replace("'robot'", "'fallen'").replace("2 1 0", "2 1 -7.5e8")
    output, data, scenario = imported(tmp_path, world(ROBOT, fallen))
    assert list(data["sensors"]) == ["scan"]
    assert "1,000 km away or whose position is not a number (fallen" in output
    assert prepare(scenario).scene.names == ("robot/base",)
    with pytest.raises(
        LidarError, match=r"it contains no sensor of type gpu_lidar.*not a number \(fallen"
    ):
        imported(tmp_path / "x", world(fallen))


@pytest.mark.extended
def test_garbled_worlds_give_objects_or_a_line(tmp_path):
    peak_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    add_model(tmp_path, "crate")
    shapes = "".join(shape(text) for text in SHAPES)
    nested = model("n", link(inside=shapes), include("model://crate"), "<frame name='f'/>")
    whole = world(
        nested, ROBOT, include("model://sun"), "<state><model name='n'/></state>"
    ).encode()
    rng = np.random.default_rng(0)
    read = 0
    path = tmp_path / "g.world"
    for _ in range(100):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 3)):
            data[at] = rng.integers(32, 127)
        path.write_bytes(data[: rng.integers(0, len(data))] if rng.random() < 0.2 else data)
        try:
            read += bool(load_objects(path, colors=True, report=lambda line: None).static)
        except LidarError as error:
            assert len(str(error).splitlines()) == 1
    assert 2 < read < 95
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_before
    assert grown_kib < 100 * 1024

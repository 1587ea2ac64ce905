"""COLLADA files: nothing vanishes in silence, and what is harmless does no harm."""

import numpy as np
import pytest
import trimesh
from tests.meshes import NESTED

from lidarsim import LidarError, Scene
from lidarsim.scene.files.meshfile import load_meshes

DAE = """<?xml version="1.0"?>{doctype}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
 <asset>{asset}</asset>
 {libraries}
 <library_geometries><geometry id="g" name="shape"><mesh>
  <source id="p"><float_array id="a" count="24">{numbers}</float_array>
   <technique_common><accessor source="#a" {accessor}>
    <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
   </accessor></technique_common></source>
  <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
  {primitive}
 </mesh></geometry></library_geometries>
 <library_nodes>{nodes}</library_nodes>
 <library_visual_scenes><visual_scene id="s">
  <node id="n" name="Wall">{here}</node>
 </visual_scene></library_visual_scenes>
 {scene}
</COLLADA>
"""
V = '<input semantic="VERTEX" source="#v" offset="0"/>'
HERE = '<instance_geometry url="#g"/>'
# Corners of a square of 4 x 4, and of one of 2 x 2 in it.
SQUARES = "0 0 0  4 0 0  4 4 0  0 4 0  1 1 0  3 1 0  3 3 0  1 3 0"
PARTS = {
    "doctype": "",
    "asset": "<up_axis>Z_UP</up_axis>",
    "libraries": "",
    "numbers": SQUARES,
    "accessor": 'count="8" stride="3"',
    "primitive": f'<polylist count="1">{V}<vcount>4</vcount><p>0 1 2 3</p></polylist>',
    "nodes": "",
    "here": HERE,
    "scene": '<scene><instance_visual_scene url="#s"/></scene>',
}


def load(tmp_path, **parts):
    path = tmp_path / "m.dae"
    path.write_text(DAE.format(**(PARTS | parts)))
    return load_meshes(path)


def area(meshes):
    return sum(trimesh.Trimesh(m.vertices, m.faces, process=False).area for m in meshes)


def test_names_unit_axis_and_digits(tmp_path):
    meshes = load(
        tmp_path,
        asset='<unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis>',
        numbers=SQUARES.replace("4 0 0", "50000012.25 0 0"),
        here="<translate>10 0 0</translate>"
        f'<node name="Chair"><rotate>0 0 1 90</rotate>{HERE}</node>'
        f'<node name="Chair"><scale>2 2 -2</scale>{HERE}</node>',
    )
    assert Scene.from_meshes(meshes).names == ("Chair", "Chair.2")
    # 50000012.25 along x, turned by 90 degrees about z to y, moved by 10; then Y-up: y is z.
    np.testing.assert_allclose(meshes[0].vertices[:, 2].max(), 500000.1225, rtol=1e-15)
    np.testing.assert_allclose(meshes[0].vertices[:, 0].max(), 0.1, rtol=1e-7)
    assert meshes[1].vertices[:, 0].max() == pytest.approx(1000000.345, rel=1e-15)


def test_what_states_nothing_is_in_meters_and_stands_by_its_standard(tmp_path):
    # COLLADA 1.4.1: up_axis is Y_UP where it is left out.
    (mesh,) = load(tmp_path, asset="")
    assert np.ptp(mesh.vertices, axis=0).tolist() == [4, 0, 4]


EFFECT = '<technique_common><instance_material symbol="m" target="{}"/></technique_common>'


@pytest.mark.parametrize(
    "parts",
    [
        # As the walls of a hospital were: the material, or what it is made of, is not there.
        {"here": HERE.replace("/>", f">{EFFECT.format('#gone')}</instance_geometry>")},
        {"scene": ""},
        {"libraries": '<library_images><image id="i"/></library_images>'},
        {"primitive": f"<!-- shelf -->{PARTS['primitive']}"},
        {"here": f"<!-- shop -->{HERE}<instance_light url='#gone'/>"},
        {"here": f"<rotate>0 0 0 0</rotate>{HERE}"},
        {"here": f"<lookat>0 0 0  0 0 -1  0 1 0</lookat>{HERE}"},
        {"numbers": f"7 7 {SQUARES}", "accessor": 'count="8" stride="3" offset="2"'},
        {"numbers": SQUARES.replace("  ", " 99 ") + " 99", "accessor": 'count="8" stride="4"'},
        {"primitive": f'<tristrips count="1">{V}<p>0 1 3 2</p></tristrips>'},
        {"primitive": f'<trifans count="1">{V}<p>0 1 2 3</p></trifans>'},
        {"primitive": f'<polygons count="1">{V}<p>0 1 2 3</p></polygons>'},
        {
            "primitive": '<triangles count="2"><input semantic="VERTEX" source="#v" offset="1"/>'
            '<input semantic="NORMAL" source="#gone" offset="0"/>'
            "<p>9 0 9 1 9 2 9 0 9 2 9 3</p></triangles>"
        },
        {
            "primitive": f"{PARTS['primitive']}<lines>{V}<p>4 5</p></lines>",
            "here": f'<node name="">{HERE}</node>',
        },
    ],
    ids=str,
)
def test_what_is_harmless_does_no_harm(tmp_path, parts):
    (mesh,) = load(tmp_path, **parts)
    assert mesh.name == "Wall"
    assert area([mesh]) == pytest.approx(16)
    assert np.ptp(mesh.vertices[:, 0]) == 4
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_polygons_with_holes_and_not_convex(tmp_path):
    holed = "<ph><p>0 1 2 3</p><h>4 7 6 5</h></ph>"
    (frame,) = load(tmp_path, primitive=f'<polygons count="1">{V}{holed}</polygons>')
    assert area([frame]) == pytest.approx(12)
    corners = f'<polylist count="1">{V}<vcount>6</vcount><p>0 1 5 4 7 3</p></polylist>'
    (corner,) = load(tmp_path, primitive=corners)
    assert area([corner]) == pytest.approx(6)


def test_nodes_of_a_library_stand_where_they_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr("lidarsim.scene.files.scene_graph.MAX_NODES", 2_000)
    here = '<instance_node url="#k{}"/>'
    nodes = "".join(f'<node id="k{i + 1}">{here.format(i) * 2}</node>' for i in range(3))
    nodes += f'<node id="k0">{HERE}</node>'
    assert len(load(tmp_path, nodes=nodes, here=here.format(3))) == 8
    with pytest.raises(LidarError, match="contain each other"):
        load(tmp_path, nodes=nodes.replace(HERE, here.format(3)), here=here.format(3))


CONTROLLER = (
    '<library_controllers><controller id="c"><{} source="#g"/></controller></library_controllers>'
)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"here": HERE + '<instance_geometry url="#lost"/>'}, "'#lost', which is not in the file"),
        ({"here": '<instance_geometry url="../other.dae#g"/>'}, "which is not in the file"),
        *[
            ({"here": "<instance_controller url='#c'/>", "libraries": CONTROLLER.format(by)}, by)
            for by in ("skin", "morph")
        ],
        ({"here": f"<skew>45 1 0 0 0 1 0</skew>{HERE}"}, "contains <skew>"),
        ({"here": f"<scale>nan 1 1</scale>{HERE}"}, "with a matrix that is not a valid"),
        ({"primitive": f"<triangles>{V}<p>0 1 9</p></triangles>"}, "refer to vertices 0 to 9"),
        ({"primitive": PARTS["primitive"].replace("<vcount>4", "<vcount>5")}, "with 5 corners but"),
        ({"accessor": 'count="9" stride="3"'}, "id='p'> declares 9 x 3 numbers but contains 24"),
        ({"numbers": "nan " + SQUARES[2:]}, "1 of the 4 vertices .* NaN"),
        *[
            ({"asset": f'<unit meter="{meters}"/>'}, "the unit|could not convert")
            for meters in ("0,01", "0", "nan")
        ],
        ({"doctype": '<!DOCTYPE C [<!ENTITY i SYSTEM "file:///etc/passwd">]>', "numbers": "&i;"},
         "declares the XML entity"),
        ({"doctype": f'<!DOCTYPE C [<!ENTITY a "0 0 0 0 0 0 0 0 0 0">{NESTED}]>', "numbers": "&i;"},
         "declares the XML entity 'a'"),
    ],
    ids=str,
)  # fmt: skip
def test_what_cannot_be_read_says_what_it_is(tmp_path, parts, message):
    with pytest.raises(LidarError, match=message) as caught:
        load(tmp_path, **parts)
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


def test_a_cut_file_never_loses_triangles_in_silence(tmp_path):
    path = tmp_path / "m.dae"
    whole = DAE.format(**PARTS).strip()
    for cut in range(1, len(whole), 40):
        path.write_text(whole[:-cut])
        with pytest.raises(LidarError, match=r"truncated|cannot be read"):
            load_meshes(path)

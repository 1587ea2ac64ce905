"""3MF files: every instance of every part, and what is not read says what it is."""

import io
import zipfile

import numpy as np
import pytest
from tests.meshes import NESTED

from lidarsim import LidarError
from lidarsim.scene.files.meshfile import load_meshes

MODEL = (
    '<?xml version="1.0"?>{doctype}'
    '<model {unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
    ' xmlns:b="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02"'
    ' xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06" {more}>'
    '<resources><object id="1" name="leaf" type="model"><mesh><vertices>'
    '<vertex x="{x}" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>'
    '</vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles>{beams}</mesh></object>'
    "{objects}</resources><build>{items}</build></model>"
)
VERTICES = '<vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>'
PARTS = {"doctype": "", "unit": 'unit="meter"', "more": "", "x": "0", "beams": "", "objects": ""}


def model(items='<item objectid="1"/>', **parts):
    return MODEL.format(**(PARTS | parts), items=items)


def packed(files):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return memory.getvalue()


def load(tmp_path, files=(), **parts):
    path = tmp_path / "m.3mf"
    path.write_bytes(packed({"3D/3dmodel.model": model(**parts), **dict(files)}))
    return load_meshes(path)


def assembly(number, of, count, more=""):
    """An object of several copies of another, side by side."""
    copies = "".join(
        f'<component objectid="{of}" transform="1 0 0 0 1 0 0 0 1 {number}.{i} 0 0"{more}/>'
        for i in range(count)
    )
    return f'<object id="{number}" name="a{number}"><components>{copies}</components></object>'


def test_units_and_names(tmp_path):
    for unit, meters in (('unit="inch"', 0.0254), ("", 0.001)):
        (leaf,) = load(tmp_path, unit=unit)
        assert leaf.name == "leaf"
        np.testing.assert_allclose(np.ptp(leaf.vertices, axis=0), [meters, meters, 0])


def test_nested_components_and_copies_are_all_there(tmp_path):
    nested = assembly(2, 1, 10) + assembly(3, 2, 10)
    assert len(load(tmp_path, objects=nested, items='<item objectid="3"/>')) == 100
    items = '<item objectid="1" partnumber="A"/>' * 2
    assert [mesh.name for mesh in load(tmp_path, items=items)] == ["A", "A"]


def test_colors_of_base_materials_and_color_groups(tmp_path):
    """Of triangles, of the object, of corners; and some that are not there."""
    triangles = "".join(
        f'<triangle v1="0" v2="1" v3="2" {more}/>'
        for more in ("", 'pid="8" p1="1"', 'pid="8" p1="0" p2="1" p3="0"', 'p1="0"',
                     'pid="77" p1="0"', 'pid="8" p1="9"')
    )  # fmt: skip
    objects = (
        '<basematerials id="7"><base name="a" displaycolor="#0A141E"/>'
        '<base name="b" displaycolor="#FF8000FF"/></basematerials>'
        '<m:colorgroup id="8"><m:color color="#010203"/><m:color color="#fffefd80"/>'
        f'</m:colorgroup><object id="2" pid="7" pindex="1"><mesh><vertices>{VERTICES}</vertices>'
        f"<triangles>{triangles}</triangles></mesh></object>"
    )
    path = tmp_path / "m.3mf"
    path.write_bytes(packed({"3D/3dmodel.model": model('<item objectid="2"/>', objects=objects)}))
    notes = []
    (mesh,) = load_meshes(path, colors=True, report=notes.append)
    first = [1, 2, 3]
    last = [255, 254, 253]
    base = [255, 128, 0]
    expected = [[base] * 3, [last] * 3, [first, last, first], [[10, 20, 30]] * 3]
    gray = [[[188] * 3] * 3] * 2
    assert mesh.colors.corners.tolist() == expected + gray
    assert notes == [
        f"{path} contains textures, which are not supported, or lacks colors. As a result, "
        "2 triangles are gray."
    ]
    assert load_meshes(path)[0].colors is None
    (leaf,) = load(tmp_path)
    assert leaf.colors is None


@pytest.mark.parametrize(
    "placed",
    [
        [("a", 7)],
        [("a", 7), ("b", 7)],  # the numbers of a file are its own
        [("a", 1), ("a", 7), ("b", 1)],  # one is that of an object of the model
        [("a", 7), ("a", 7)],
    ],
)
def test_parts_in_other_files_are_told_apart(tmp_path, placed):
    components = "".join(
        f'<component p:path="/3D/Objects/{file}.model" objectid="{number}"/>'
        for file, number in placed
    )
    assembled = f'<object id="2"><components>{components}</components></object>'
    # What slicers write: the prefix is not declared.
    part = "<model><resources>{}</resources><build/></model>"
    own = model().partition("<resources>")[2].partition("</resources>")[0]
    files = {
        f"3D/Objects/{name}.model": part.format(
            "".join(
                own.replace('id="1"', f'id="{number}"').replace("leaf", f"{name}{number}")
                for number in (1, 7)
            )
        )
        for name in "ab"
    }
    meshes = load(
        tmp_path,
        files.items(),
        objects=assembled,
        items='<item objectid="2"/>',
        more='requiredextensions="p"',
    )
    assert [mesh.name for mesh in meshes] == [f"{file}{number}" for file, number in placed]


def test_the_model_that_the_package_names_is_built(tmp_path):
    path = tmp_path / "m.3mf"
    relation = (
        '<Relationships><Relationship Target="/3D/other.model" Id="r" '
        'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
    )
    path.write_bytes(packed({"_rels/.rels": relation, "3D/other.model": model()}))
    assert [mesh.name for mesh in load_meshes(path)] == ["leaf"]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"more": 'requiredextensions="b"'},
            "extension .*beamlattice/2017/02, which is not supported",
        ),
        ({"beams": "<b:beamlattice/>"}, "contains <beamlattice>"),
        ({"items": '<item objectid="9"/>'}, "object '9' is used but not defined"),
        ({"items": '<item objectid="1" transform="1 0 0"/>'}, "line .*: a transform has 3 numbers"),
        ({"unit": 'unit="parsec"'}, "parsec"),
        ({"x": "nan"}, "NaN"),
        (
            {"objects": assembly(2, 3, 1) + assembly(3, 2, 1), "items": '<item objectid="2"/>'},
            "contain each other",
        ),
        (
            {
                "objects": assembly(2, 1, 1, ' p:path="/../../etc/passwd"'),
                "items": '<item objectid="2"/>',
            },
            "archive does not contain '../../etc/passwd'",
        ),
        (
            {"doctype": f'<!DOCTYPE model [<!ENTITY a "0000000000">{NESTED}]>', "x": "&i;"},
            "declares the XML entity",
        ),
    ],
    ids=str,
)
def test_what_cannot_be_read_says_what_it_is(tmp_path, monkeypatch, parts, message):
    monkeypatch.setattr("lidarsim.scene.files.scene_graph.MAX_NODES", 2_000)
    with pytest.raises(LidarError, match=message):
        load(tmp_path, **parts)

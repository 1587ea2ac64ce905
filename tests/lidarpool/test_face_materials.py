"""Faces that know their materials: entries for them, files of all formats, instances, actors."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from textwrap import dedent

import laspy
import numpy as np
import pytest
from tests.cuda_on_host import source_backend  # noqa: F401 - a fixture
from tests.shapes import ball, beam_along_x, block, level, quad, wall

from lidarfiles import read_cloud, save_cloud
from lidarpool import simulate
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes import load_robot
from lidarscenes.writers.scene_file import write_scene
from lidarsim import Actor, LidarError, Material, Noise, Scene, SceneInstance, Sensor, Survey, Track
from lidarsim.columns.table import SCAN
from lidarsim.pulses.steps.stray_light import BLOOMING
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.scene_mesh import Cutout
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import available_backends, registry

CPU = [name for name in ("numpy", "tiles") if not available_backends()[name]]
COLUMNS = ["class", "material", "reflectance", "incidence_deg"]
# A front of 8 x 4 m at y = 0, its western half of brick, its eastern half of glass, on grass.
HOUSE = """
mtllib house.mtl
o House
v 0 0 0
v 4 0 0
v 4 0 4
v 0 0 4
v 8 0 0
v 8 0 4
usemtl Brick
f 1 2 3 4
usemtl Glass
f 2 5 6 3
o Ground
v -9 -9 0
v 9 -9 0
v 9 9 0
v -9 9 0
usemtl Grass
f 7 8 9 10
"""
ENTRIES = [
    Material(material="Gl*", reflectance=0.1, semantic_class=3),
    Material("House", 0.8, semantic_class=2),
    Material("*", 0.4, semantic_class=1),
]
SENSOR = Sensor.grid(900, 16, 40.0)


@pytest.fixture
def house(tmp_path):
    """Write the house as .obj and read it with its materials."""
    path = tmp_path / "house.obj"
    path.write_text(HOUSE)
    (tmp_path / "house.mtl").write_text("newmtl Brick\nnewmtl Glass\nnewmtl Grass\n")
    return path


def front(name="House", materials=("Brick", "Glass"), x=0.0, y=0.0):
    """The front of the house: two triangles of one material, then two of another."""
    west = quad(name, (x, y, 0), (x + 4, y, 0), (x + 4, y, 4), (x, y, 4))
    vertices = np.concatenate([west.vertices, west.vertices + np.array([4, 0, 0])])
    faces = np.concatenate([west.faces, west.faces + 4])
    index = np.array([0, 0, 1, 1], np.int32)
    return replace(west, vertices=vertices, faces=faces, materials=FaceMaterials(materials, index))


def cloud_of(scene, options, backend="auto"):
    """Cast a survey and return its cloud, in one process."""
    part = columns_of(list(Rig(scene, options, backend).cast(0, options.scan_count)))
    table = (SCAN, *(column for column in options.stored_columns if column.name not in "xyz"))
    return part.cloud(table, options.precision_m, scene.origin)


def shares(cloud):
    """Reflectance of each point, without the cosine of incidence."""
    return cloud["reflectance"] / np.cos(np.radians(cloud["incidence_deg"]))


def check_house(cloud, names=("Brick", "Glass", "Grass")):
    """Check that points of a front have classes, materials and reflectances by where they are."""
    x, y, z = np.asarray(cloud).T
    on_front = np.abs(y) < 0.02
    clear = (np.abs(x - 4) > 0.03) & (z > 0.03)
    expected = {
        "Brick": (on_front & clear & (x < 4), 2, 0.8),
        "Glass": (on_front & clear & (x > 4), 3, 0.1),
        "Grass": (~on_front, 1, 0.4),
    }
    for name in names:
        rows, semantic_class, share = expected[name]
        assert rows.sum() > 50, name
        assert set(cloud["class"][rows].tolist()) == {semantic_class}, name
        np.testing.assert_allclose(shares(cloud)[rows], share, rtol=1e-4, err_msg=name)
        assert len(set(cloud["material"][rows].tolist())) == 1
    return expected


# -- what counts ----------------------------------------------------------------------------------


def survey(materials=ENTRIES, **options):
    return Survey(SENSOR, poses=[(4, -5, 1)], columns=COLUMNS, materials=materials, **options)


@pytest.mark.parametrize("backend", CPU)
def test_several_materials_in_one_object_of_an_obj(house, backend):
    scene = Scene.load(house, materials=True)
    assert scene.names == ("House", "Ground")
    assert scene.material_names == ("Brick", "Glass", "Grass")
    cloud = cloud_of(scene, survey(), backend=backend)
    expected = check_house(cloud)
    for number, name in enumerate(scene.material_names):
        assert set(cloud["material"][expected[name][0]].tolist()) == {number}
    assert set(cloud["object"][expected["Glass"][0]].tolist()) == {0}


def test_the_first_entry_that_fits_a_face_counts(house):
    scene = Scene.load(house, materials=True)
    orders = {
        (3, 2): [ENTRIES[0], ENTRIES[1]],
        (2, 2): [ENTRIES[1], ENTRIES[0]],
        (3, 4): [Material("House", material="Brick", semantic_class=4), ENTRIES[0]],
        (3, 1): [ENTRIES[0], Material("*", semantic_class=1)],
    }
    for (glass, brick), entries in orders.items():
        entries = [*entries] if entries[-1].applies_to_all else [*entries, ENTRIES[2]]
        cloud = cloud_of(scene, survey(entries))
        assert set(cloud["class"][cloud["material"] == 1].tolist()) == {glass}
        assert set(cloud["class"][cloud["material"] == 0].tolist()) == {brick}


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([Material("*"), Material("House")], r"entries after number 1, .* Move it to the end"),
        ([Material(material="Gras"), Material("*")], "'Gras', but no face .* mean 'Grass'"),
        ([Material("Ground", material="Glass"), Material("*")], "no face of 'Ground' has the mat"),
        (
            [Material(material="Glass")],
            (
                r"no entry matches the object 'House', material "
                r"'Brick' and"
            ),
        ),
        ([Material("Hause"), Material("*")], "'Hause', but no object has that name.*'House'"),
        (
            [Material("Q"), Material("*")],
            r"no object has that name\. Available names: House, Ground\.$",
        ),
    ],
)
def test_entries_that_fit_nothing_are_refused(house, entries, message):
    scene = Scene.load(house, materials=True)
    with pytest.raises(LidarError, match=message):
        cloud_of(scene, survey(entries))


def test_names_of_materials_are_unknown_without_being_asked_for(house):
    scene = Scene.load(house)
    assert scene.materials is None and scene.material_names == ()
    with pytest.raises(LidarError, match=r"'Glass', but no face .* No face has a named material"):
        cloud_of(scene, survey([Material(material="Glass"), Material("*")]))
    with pytest.raises(LidarError, match=r"must apply to something. Set objects"):
        Material()
    with pytest.raises(LidarError, match=r"material must .* but is ''"):
        Material(material="")


def test_meshes_of_one_material_have_no_array_of_faces(tmp_path):
    parts = "".join(
        f"o Wall{k}\nusemtl Brick{k % 2}\nv 0 {k} 0\nv 1 {k} 0\nv 1 {k} 1\nf {3 * k + 1} "
        f"{3 * k + 2} {3 * k + 3}\n"
        for k in range(4)
    )
    (tmp_path / "walls.obj").write_text(parts)
    scene = Scene.load(tmp_path / "walls.obj", materials=True)
    assert scene.material_names == ("Brick0", "Brick1") and scene.materials.index is None
    assert all(mesh.materials.index is None for mesh in scene.meshes())
    kinds = scene.surface_kinds
    assert len(kinds.object) == 4 and kinds.material == ["Brick0", "Brick1"] * 2


# -- files ----------------------------------------------------------------------------------------


def gltf(folder):
    """Two primitives of two materials in one mesh, a third without a name."""
    mesh = front(materials=("Brick", "Glass"))
    points = mesh.vertices[:, [0, 2, 1]] * (1, 1, -1)
    data = bytearray()
    views = []
    accessors = []
    for rows, kind, target in (
        (points.astype("<f4"), "VEC3", 5126),
        (mesh.faces[:2].astype("<u4").reshape(-1, 1), "SCALAR", 5125),
        (mesh.faces[2:].astype("<u4").reshape(-1, 1), "SCALAR", 5125),
    ):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": rows.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": target,
                          "count": len(rows), "type": kind, "min": rows.min(axis=0).tolist(),
                          "max": rows.max(axis=0).tolist()})  # fmt: skip
        data += rows.tobytes()
    (folder / "house.bin").write_bytes(data)
    tree = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "scene": 0,
        "nodes": [{"mesh": 0, "name": "House"}],
        "meshes": [{"primitives": [
            {"attributes": {"POSITION": 0}, "indices": 1, "material": 0},
            {"attributes": {"POSITION": 0}, "indices": 2, "material": 1},
        ]}],
        "materials": [{"name": "Brick"}, {"name": "Glass"}],
        "accessors": accessors, "bufferViews": views,
        "buffers": [{"uri": "house.bin", "byteLength": len(data)}],
    }  # fmt: skip
    (folder / "house.gltf").write_text(json.dumps(tree))
    return folder / "house.gltf"


def dae(folder):
    """Two lists of triangles, whose symbols are bound to materials with names."""
    numbers = " ".join(str(v) for v in front().vertices.ravel())
    lists = "".join(
        f'<triangles material="{symbol}" count="2"><input semantic="VERTEX" source="#v" '
        f'offset="0"/><p>{" ".join(map(str, faces.ravel()))}</p></triangles>'
        for symbol, faces in (("s0", front().faces[:2]), ("s1", front().faces[2:]))
    )
    bound = "".join(f'<instance_material symbol="s{k}" target="#m{k}"/>' for k in range(2))
    (folder / "house.dae").write_text(
        f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><up_axis>Z_UP</up_axis></asset>
<library_materials><material id="m0" name="Brick"/><material id="m1" name="Glass"/>
</library_materials><library_geometries><geometry id="g" name="House"><mesh>
<source id="p"><float_array id="a" count="24">{numbers}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"><param name="X"/><param name="Y"/><param name="Z"/>
</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>{lists}</mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node name="House">
<instance_geometry url="#g"><bind_material><technique_common>{bound}</technique_common>
</bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
    )
    return folder / "house.dae"


def threemf(folder):
    """Triangles with materials of a group of base materials, that of the object by default."""
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in front().vertices)
    triangles = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}"{more}/>'
        for (a, b, c), more in zip(
            front().faces, ("", "", ' pid="9" p1="1"', ' pid="9" p1="1"'), strict=True
        )
    )
    model = f"""<model unit="meter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<resources><basematerials id="9"><base name="Brick" displaycolor="#FF0000"/>
<base name="Glass" displaycolor="#0000FF"/></basematerials>
<object id="1" name="House" type="model" pid="9" pindex="0"><mesh><vertices>{vertices}</vertices>
<triangles>{triangles}</triangles></mesh></object></resources>
<build><item objectid="1"/></build></model>"""
    with zipfile.ZipFile(folder / "house.3mf", "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
    return folder / "house.3mf"


def cityjson(folder):
    """A surface of each material of a theme."""
    document = {
        "type": "CityJSON", "version": "2.0",
        "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},
        "appearance": {"materials": [{"name": "Brick"}, {"name": "Glass"}]},
        "CityObjects": {"House": {"type": "Building", "geometry": [{
            "type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1, 2, 3]], [[4, 5, 6, 7]]],
            "material": {"visual": {"values": [0, 1]}},
        }]}},
        "vertices": front().vertices.astype(int).tolist(),
    }  # fmt: skip
    (folder / "house.city.json").write_text(json.dumps(document))
    return folder / "house.city.json"


def usd(folder):
    """A mesh with two subsets, one bound to a material that has no shader."""
    pytest.importorskip("pxr")
    points = ", ".join(f"({x:g}, {y:g}, {z:g})" for x, y, z in front().vertices)
    corners = ", ".join(map(str, front().faces.ravel()))
    (folder / "house.usda").write_text(
        dedent(f"""\
        #usda 1.0
        (
            upAxis = "Z"
            metersPerUnit = 1
        )
        def Mesh "House" (prepend apiSchemas = ["MaterialBindingAPI"])
        {{
            point3f[] points = [{points}]
            int[] faceVertexCounts = [3, 3, 3, 3]
            int[] faceVertexIndices = [{corners}]
            uniform token subdivisionScheme = "none"
            rel material:binding = </Looks/Brick>
            def GeomSubset "panes" (prepend apiSchemas = ["MaterialBindingAPI"])
            {{
                uniform token elementType = "face"
                uniform token familyName = "materialBind"
                int[] indices = [2, 3]
                rel material:binding = </Looks/Glass>
            }}
        }}
        def Scope "Looks"
        {{
            def Material "Brick" {{ }}
            def Material "Glass" {{ }}
        }}
        """)
    )
    return folder / "house.usda"


@pytest.mark.extended
@pytest.mark.parametrize("colors", [False, True])
@pytest.mark.parametrize("write", [gltf, dae, threemf, cityjson, usd])
def test_faces_of_files_have_their_materials(write, colors, tmp_path):
    scene = Scene.load(write(tmp_path), materials=True, colors=colors)
    assert sorted(scene.material_names) == ["Brick", "Glass"]
    assert len(scene.names) == 1 and len(scene.surface_kinds.object) == 2
    cloud = cloud_of(scene, survey([ENTRIES[0], Material("*", 0.8, semantic_class=2)]))
    check_house(cloud, ("Brick", "Glass"))
    plain = Scene.load(write(tmp_path), colors=colors)
    assert plain.materials is None and len(plain.faces) == len(scene.faces)


def test_shapes_of_robots_have_the_material_of_their_visual(tmp_path):
    (tmp_path / "r.urdf").write_text(
        '<robot name="r"><link name="body"><visual><geometry><box size="1 1 1"/></geometry>'
        '<material name="Paint"/></visual><visual><origin xyz="2 0 0"/><geometry>'
        '<sphere radius="0.5"/></geometry><material name="Rubber"/></visual></link></robot>'
    )
    mesh = load_robot(tmp_path / "r.urdf", materials=True).meshes["body"]
    assert mesh.materials.names == ("Paint", "Rubber")
    x = mesh.vertices[mesh.faces].mean(axis=1)[:, 0]
    np.testing.assert_array_equal(mesh.materials.index, x > 1)
    assert load_robot(tmp_path / "r.urdf").meshes["body"].materials is None


def test_a_glb_that_we_write_keeps_names_of_materials(tmp_path):
    mask = np.array([[True, False]])
    corners = np.zeros((2, 3, 2), np.float32)
    fence = replace(front("Fence", ("Wood", "Wire"), y=3), cutouts=(Cutout(mask, corners),))
    meshes = [front(), SceneInstance(front("Copy"), np.eye(4)), fence, level("Ground")]
    write_scene(tmp_path / "a.glb", Scene.from_meshes(meshes))
    kinds = Scene.load(tmp_path / "a.glb", materials=True).surface_kinds
    found = {(kinds.names[k], name) for k, name in zip(kinds.object, kinds.material, strict=True)}
    assert {("House", "Brick"), ("House", "Glass"), ("Copy", "Glass"), ("Ground", "")} <= found
    assert [name for name in kinds.material if name.startswith("W")] == ["Wood", "Wire"]


# -- instances, actors, masks ---------------------------------------------------------------------


def test_instances_share_the_materials_of_their_mesh():
    mirrored = np.diag([-1.0, 1, 1, 1])
    mirrored[0, 3] = 8.0
    mesh = front()
    scene = Scene.from_meshes([SceneInstance(mesh, np.eye(4)), level("Ground")])
    check_house(cloud_of(scene, survey()))
    # A mirrored one has its glass in the west.
    scene = Scene.from_meshes([SceneInstance(mesh, mirrored), level("Ground")])
    cloud = cloud_of(scene, survey())
    on_front = (np.abs(np.asarray(cloud)[:, 1]) < 0.02) & (np.asarray(cloud)[:, 2] > 0.03)
    west = on_front & (np.asarray(cloud)[:, 0] < 3.97)
    assert set(cloud["class"][west].tolist()) == {3}
    again = Scene.from_meshes(scene.meshes())
    assert again.surface_kinds.material == scene.surface_kinds.material


def test_actors_have_materials_and_one_mesh_keeps_them():
    wheel = replace(block("Wheel", (0.5, 0.2, 0.5)), materials=FaceMaterials(("Rubber",)))
    body = join_meshes("Car", [front("Body"), wheel])
    assert body.materials.names == ("Brick", "Glass", "Rubber")
    assert np.bincount(body.materials.index).tolist() == [2, 2, len(wheel.faces)]
    actor = Actor(front(), Track([0, 1], [[0, 0, 0], [0, 1e-4, 0]], [[0, 0, 0, 1]] * 2))
    scene = Scene.from_meshes([level("Ground")]).with_actors([actor])
    for backend in CPU:
        check_house(cloud_of(scene, survey(), backend=backend))


def test_masks_and_materials_are_independent():
    # The glass has a hole in its eastern half.
    mask = np.array([[True, False]])
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32)
    mesh = replace(front(), cutouts=(Cutout(mask, corners),))
    scene = Scene.from_meshes([mesh, level("Ground")])
    cloud = cloud_of(scene, survey())
    check_house(cloud)
    glass = np.asarray(cloud)[cloud["class"] == 3]
    assert glass[:, 0].min() >= 4 and glass[:, 0].max() < 6.05


# -- effects --------------------------------------------------------------------------------------


def test_light_passes_through_the_faces_of_glass_alone():
    behind = quad("Behind", (-2, 3, 0), (10, 3, 0), (10, 3, 4), (-2, 3, 4))
    scene = Scene.from_meshes([front(), behind])
    entries = [
        Material(material="Glass", transparent="pass"),
        Material("*", 0.5, semantic_class=1),
    ]
    cloud = cloud_of(scene, survey(entries))
    x, y, _ = np.asarray(cloud).T
    seen_behind = y > 2.9
    assert seen_behind.sum() > 100
    # Rays from (4, -5) that end at y = 3 cross the front in its eastern half.
    crossed = 4 + (x[seen_behind] - 4) * 5 / 8
    assert crossed.min() > 3.98
    assert (np.abs(y) < 0.02).sum() > 100


def test_a_part_of_a_mesh_holds_water_if_its_faces_are_closed():
    pool = block("Pool", (2, 2, 2))
    rim = block("Rim", (0.5, 0.5, 0.5), (0, 5, 0))
    mesh = join_meshes(
        "Pool",
        [
            replace(pool, materials=FaceMaterials(("Water",))),
            replace(rim, materials=FaceMaterials(("Stone",))),
        ],
    )
    water = {"transparent": "pass", "refractive_index": 1.33}
    found = []
    for scene, entry in (
        (Scene.from_meshes([mesh, wall("Wall", 9)]), Material(material="Water", **water)),
        (Scene.from_meshes([pool, wall("Wall", 9), rim]), Material("Pool", **water)),
    ):
        options = Survey(beam_along_x(), poses=[(-5, 0, 0)], columns=["range"],
                         materials=[entry, Material("*")], steps=1)  # fmt: skip
        found.append(cloud_of(scene, options)["range"].tolist())
    assert found[0] == found[1] == [pytest.approx(14 + 2 * 0.33, abs=1e-3)]


def test_materials_of_one_entry_are_one_surface():
    # A crown whose upper half has another name than its lower half is closed all the same.
    crown = ball("Crown", 1.0)
    upper = crown.vertices[crown.faces].mean(axis=1)[:, 2] > 0
    crown = replace(crown, materials=FaceMaterials(("Low", "High"), upper.astype(np.int32)))
    scene = Scene.from_meshes([crown, wall("Wall", 9)])
    leaves = Material("Crown", leaf_area_density=0.5)
    options = Survey(beam_along_x(50), poses=[(-5, 0, 0)], materials=[leaves, Material("*")],
                     columns=["range"], steps=1)  # fmt: skip
    ranges = cloud_of(scene, options)["range"]
    assert ((ranges > 4) & (ranges < 6)).any() and (ranges > 13).any()
    half = [replace(leaves, objects=None, material="High"), Material("*")]
    with pytest.raises(LidarError, match="'Crown', material 'High' has a leaf_area_density"):
        cloud_of(scene, replace(options, materials=half))


@pytest.mark.extended
def test_only_the_faces_of_sheeting_bloom():
    scene = Scene.from_meshes([front(), level("Ground")])
    sign = Material(material="Glass", reflectance=1.0, retro=True)
    noise = Noise(stray_light=1e-3, detection_range_m=200)
    options = survey([sign, Material("*", 0.3)], noise=noise)
    cloud = cloud_of(scene, replace(options, columns=(*COLUMNS, "cause")))
    blooming = cloud["cause"] == BLOOMING
    retro = cloud["reflectance"] > 2
    assert blooming.sum() > 20 and retro.sum() > 20
    assert np.asarray(cloud)[retro, 0].min() > 3.95
    # Light of a sheet that is beside a beam seems to be where the beam goes, as far away.
    assert np.linalg.norm(np.asarray(cloud)[blooming] - (4, -5, 1), axis=1).min() > 4.9


@pytest.mark.slow
def test_a_device_leaves_what_faces_are_made_of_to_numpy(source_backend, monkeypatch):  # noqa: F811
    monkeypatch.setattr(registry, "BACKENDS", (*registry.BACKENDS, source_backend))
    scene = Scene.from_meshes([front(), level("Ground")])
    options = replace(survey(), columns=("class", "material", "intensity", "reflectance", "range"))
    got, want = (
        next(Rig(scene, options, name).cast(0, options.scan_count))
        for name in (source_backend.name, "numpy")
    )
    assert len(want) > 100
    for column in options.stored_columns:
        np.testing.assert_array_equal(got.column(column), want.column(column), column.name)


# -- scenarios, reports and files -----------------------------------------------------------------


def test_a_scenario_reads_names_of_materials_if_an_entry_has_one(house):
    data = {
        "scene": {"files": [{"file": house.name}]},
        "poses": [{"position": [4, -5, 1]}],
        "materials": [{"material": "Glass", "class": 3}, {"objects": "*", "class": 1}],
        "cloud": {"columns": ["class"]},
    }
    built = prepare(Scenario.from_data(data, source=house.parent / "a.yaml"))
    assert built.scene.material_names == ("Brick", "Glass", "Grass")
    cloud = cloud_of(built.scene, built.survey)
    assert set(cloud["class"].tolist()) == {1, 3}
    data["materials"] = [{"objects": "*", "class": 1}]
    assert prepare(Scenario.from_data(data, source=house.parent / "a.yaml")).scene.materials is None
    data["cloud"] = {"columns": ["material"]}
    assert prepare(Scenario.from_data(data, source=house.parent / "a.yaml")).scene.materials


def test_copies_have_their_class_on_all_materials(house):
    data = {
        "scene": {
            "files": [{"file": house.name}],
            "copies": [
                {"name": "Annex", "file": house.name, "class": 9, "at": [[20, 0, 0], [40, 0, 0]]}
            ],
        },
        "poses": [{"position": [4, -5, 1]}],
        "materials": [
            {"objects": "Annex.2", "class": 8},
            {"material": "Glass", "reflectance": 0.1, "class": 3},
            {"objects": "*", "reflectance": 0.6, "class": 1},
        ],
    }
    built = prepare(Scenario.from_data(data, source=house.parent / "a.yaml"))
    table = Rig(built.scene, built.survey, "numpy").surfaces.materials
    kinds = built.scene.surface_kinds
    found = {
        (kinds.names[owner], material): (int(table.semantic_class[k]), table.reflectance[k])
        for k, (owner, material) in enumerate(zip(kinds.object, kinds.material, strict=True))
    }
    assert found["House", "Glass"] == (3, 0.1) and found["House", "Brick"] == (1, 0.6)
    assert found["Annex", "Glass"] == (9, 0.1) and found["Annex", "Brick"] == (9, 0.6)
    assert found["Annex.2", "Glass"] == found["Annex.2", "Brick"] == (8, 0.5)


@pytest.mark.extended
def test_names_of_materials_are_in_reports_and_files(cluster_client, house, tmp_path):
    scene = Scene.load(house, materials=True)
    what = replace(survey(), columns=(*COLUMNS, "time", "intensity"))
    result = simulate(scene, what, client=cluster_client)
    cloud = result.cloud
    result.report(tmp_path / "out")
    report = json.loads((tmp_path / "out/report.json").read_text())
    counts = {name: int((cloud["material"] == k).sum()) for k, name in enumerate(
        ("Brick", "Glass", "Grass"))}  # fmt: skip
    assert report["points_by_material"] == counts
    page = (tmp_path / "out/report.html").read_text()
    assert "Points by material" in page and "Glass" in page
    again = read_cloud(tmp_path / "out/cloud.ply")
    assert again.sweeps().materials == ("Brick", "Glass", "Grass")
    np.testing.assert_array_equal(again["material"], cloud["material"])
    assert b"comment material 1 Glass" in (tmp_path / "out/cloud.ply").read_bytes()[:2000]
    for name in ("c.las", "c.parquet", "c.mcap"):
        assert "material" not in save_cloud(cloud, tmp_path / name)
    las = laspy.read(tmp_path / "c.las")
    np.testing.assert_array_equal(las["material"], cloud["material"])
    (names,) = (
        vlr.record_data for vlr in las.vlrs if (vlr.user_id, vlr.record_id) == ("lidarpool", 1)
    )
    assert json.loads(names) == ["Brick", "Glass", "Grass"]

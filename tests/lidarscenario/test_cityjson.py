"""CityJSON: the finest geometry of each object, once, with its name, place, color and class."""

import json
from importlib.util import find_spec

import numpy as np
import pytest
from tests.meshes import NESTED

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, SceneInstance
from lidarsim.media.materials import MaterialTable
from lidarsim.scene.files import coordinate_systems
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.scene_mesh import triangle_areas

# A cube of 2 units, its rings running outward.
CUBE = [[x, y, z] for z in (0, 2) for y in (0, 2) for x in (0, 2)]
SIDES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
SOLID = [[[ring] for ring in SIDES]]
TRANSFORM = {"scale": [0.5, 0.5, 0.5], "translate": [84000, 447000, 3]}


def geometry(kind="Solid", boundaries=SOLID, lod="2.2", **more):
    return {"type": kind, "lod": lod, "boundaries": boundaries, **more}


def thing(*geometries, kind="Building", **more):
    return {"type": kind, "geometry": list(geometries), **more}


def city(objects, vertices=CUBE, **more):
    head = {"type": "CityJSON", "version": "2.0", "transform": TRANSFORM}
    return {**head, "CityObjects": objects, "vertices": vertices, **more}


def write(path, document):
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def load(tmp_path, document, notes=None, **options):
    path = write(tmp_path / "a.city.json", document)
    return load_meshes(path, report=[].append if notes is None else notes.append, **options)


def area(mesh):
    return triangle_areas(mesh.vertices[mesh.faces]).sum()


def volume(mesh):
    a, b, c = (mesh.vertices - mesh.vertices[0])[mesh.faces].transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum() / 6


@pytest.mark.parametrize(
    ("kind", "boundaries"),
    [
        ("Solid", SOLID),
        ("MultiSurface", SOLID[0]),
        ("CompositeSurface", SOLID[0]),
        ("MultiSolid", [SOLID]),
        ("CompositeSolid", [SOLID]),
    ],
)
def test_each_type_of_geometry(tmp_path, kind, boundaries):
    (cube,) = load(tmp_path, city({"a": thing(geometry(kind, boundaries))}))
    assert cube.name == "Building a"
    np.testing.assert_array_equal(cube.bounds, [[84000, 447000, 3], [84001, 447001, 4]])
    assert area(cube) == pytest.approx(6)
    assert volume(cube) == pytest.approx(1), "its triangles face outward"


def test_holes_and_faces_that_are_not_convex(tmp_path):
    outline = [[0, 0, 0], [8, 0, 0], [8, 0, 8], [0, 0, 8]]
    door = [[2, 0, 2], [2, 0, 6], [6, 0, 6], [6, 0, 2]]
    notched = [[0, 4, 0], [8, 4, 0], [8, 4, 8], [4, 4, 2], [0, 4, 8]]
    surfaces = [[[0, 1, 2, 3], [4, 5, 6, 7]], [[8, 9, 10, 11, 12]]]
    document = city({"a": thing(geometry("MultiSurface", surfaces))}, outline + door + notched)
    (wall,) = load(tmp_path, document)
    assert area(wall) == pytest.approx((64 - 16 + 64 - 24) / 4)


def test_the_highest_lod_of_each_object_and_none_twice(tmp_path):
    footprint = geometry("MultiSurface", [[SIDES[0]]], "0")
    block = geometry(lod=1.3)
    fine = geometry(lod="2.2")
    objects = {
        "whole": thing(footprint, block, children=["part"]),
        "part": thing(block, fine, kind="BuildingPart", parents=["whole"]),
        "house": thing(fine, children=["balcony"]),
        "balcony": thing(block, kind="BuildingInstallation", parents=["house"]),
        "garden": thing(footprint, kind="LandUse"),
        "line": thing(geometry("MultiLineString", [[0, 1]], "3"), footprint, kind="Road"),
        "empty": thing(),
    }
    notes = []
    meshes = load(tmp_path, city(objects), notes)
    assert {mesh.name: area(mesh) for mesh in meshes} == {
        "BuildingPart part": pytest.approx(6),  # without the coarse whole
        "Building house": pytest.approx(6),
        "BuildingInstallation balcony": pytest.approx(6),
        "LandUse garden": pytest.approx(1),
        "Road line": pytest.approx(1),
    }
    assert "2 objects with LoD 2.2, 1 object with LoD 1.3, 2 objects with LoD 0" in notes[0]
    assert "unsupported content, which was skipped: 1 MultiLineString" in notes[1]


def test_templates_are_placed_and_large_ones_shared(tmp_path):
    def placed(x, turn):
        rows = [*turn, 0, 0, 0, 1]
        return geometry("GeometryInstance", [x], template=0, transformationMatrix=rows)

    upright = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 5]
    scaled = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0]
    objects = {
        "t1": thing(placed(1, upright), kind="SolitaryVegetationObject"),
        "t2": thing(placed(2, scaled), kind="SolitaryVegetationObject"),
    }
    templates = {"templates": [geometry()], "vertices-templates": CUBE}
    one, two = load(tmp_path, city(objects, **{"geometry-templates": templates}))
    assert one.name == "SolitaryVegetationObject t1"
    np.testing.assert_array_equal(one.bounds, [[84001, 447000, 8], [84003, 447002, 10]])
    np.testing.assert_array_equal(two.bounds, [[84000, 447001, 3], [84004, 447005, 7]])
    many = {"templates": [geometry("MultiSurface", SOLID[0] * 10_000)], "vertices-templates": CUBE}
    shared = load(tmp_path, city(objects, **{"geometry-templates": many}))
    assert all(isinstance(one, SceneInstance) for one in shared)
    assert shared[0].mesh is shared[1].mesh


def test_a_sequence_is_read_like_a_file(tmp_path):
    feature = {"type": "CityJSONFeature", "id": "b", "vertices": CUBE[::-1]}
    lines = [city({}, []), {**feature, "CityObjects": {"b": thing(geometry())}}]
    path = write(tmp_path / "a.city.jsonl", "\n".join(map(json.dumps, lines)) + "\n\n")
    (cube,) = load_meshes(path)
    assert cube.name == "Building b"
    np.testing.assert_array_equal(cube.bounds, [[84000, 447000, 3], [84001, 447001, 4]])
    write(path, "\n".join(map(json.dumps, lines[1:])))
    with pytest.raises(LidarError, match='is not "CityJSON"'):
        load_meshes(path)


def test_surfaces_that_are_not_there_and_colors(tmp_path):
    semantics = {
        "surfaces": [{"type": "WallSurface"}, {"type": "ClosureSurface"}],
        "values": [[0, 0, None, 0, 0, 1]],
    }
    material = {"": {"values": [[0, 0, 0, 0, None, 1]]}}
    appearance = {"materials": [{"name": "red", "diffuseColor": [1, 0, 0]}, {"name": "plain"}]}
    one = thing(geometry(semantics=semantics, material=material, texture={"": {}}), kind="Tunnel")
    notes = []
    (tube,) = load(tmp_path, city({"a": one}, appearance=appearance), notes, colors=True)
    assert area(tube) == pytest.approx(5)
    assert "1 texture, 1 ClosureSurface" in notes[-1]
    shown = tube.colors.mean_colors()
    assert (shown == [255, 0, 0]).all(axis=1).sum() == 8, "four sides"
    assert (shown == 188).all(axis=1).sum() == 2, "one without a material"


def built_of(tmp_path, objects, **more):
    write(tmp_path / "a.city.json", city(objects))
    data = {"scene": {"files": ["a.city.json"]}, **more}
    return prepare(Scenario.from_data(data, folder=tmp_path))


def table_of(tmp_path, objects, materials=()):
    built = built_of(tmp_path, objects, materials=list(materials))
    table = MaterialTable.build(built.survey.materials, built.scene.surface_kinds)
    found = zip(built.scene.names, table.semantic_class, table.reflectance, strict=True)
    return {name: (number, reflectance) for name, number, reflectance in found}


def test_types_are_classes_unless_a_material_has_one(tmp_path):
    kinds = ("Building", "BuildingPart", "Road", "Bridge", "WaterBody", "TINRelief", "Railway",
             "SolitaryVegetationObject", "CityFurniture", "+Shed")  # fmt: skip
    objects = {f"{kind}{k}": thing(geometry(), kind=kind) for kind in kinds for k in (1, 2)}
    plain = table_of(tmp_path, objects)
    classes = [plain[f"{kind} {kind}1"][0] for kind in kinds]
    assert classes == [6, 6, 11, 17, 9, 2, 10, 5, 1, 1]
    materials = [
        {"objects": ["Road *", "Bridge Bridge1"], "reflectance": 0.1, "class": 99},
        {"objects": "Building Building2", "reflectance": 0.8},
        {"objects": "*", "reflectance": 0.3},
    ]
    own = table_of(tmp_path, objects, materials)
    assert own["Building Building1"] == (6, 0.3)
    assert own["Building Building2"] == (6, 0.8)
    assert own["Road Road1"] == own["Bridge Bridge1"] == (99, 0.1)
    assert own["Bridge Bridge2"] == (17, 0.3)


def test_classes_of_types_have_names_unless_the_scenario_gives_others(tmp_path):
    kinds = ("Building", "Road", "WaterBody")
    objects = {kind: thing(geometry(), kind=kind) for kind in kinds}
    assert built_of(tmp_path, objects).survey.classes == {}, "nobody asked for the column"
    cloud = {"columns": ["class"]}
    plain = built_of(tmp_path, objects, cloud=cloud).survey
    assert plain.classes == {6: "building", 9: "water", 11: "road surface"}
    materials = [{"objects": "WaterBody *", "class": 6}, {"objects": "*"}]
    given = built_of(tmp_path, objects, cloud=cloud, materials=materials).survey
    assert given.classes == {11: "road surface"}, "6 is no building here"
    names = {6: "house", 20: "road surface"}
    assert built_of(tmp_path, objects, classes=names).survey.classes == {9: "water", **names}


def test_reference_systems(tmp_path):
    metadata = {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"}
    notes = []
    load(tmp_path, city({"a": thing(geometry())}, metadata=metadata), notes)
    assert any("uses EPSG:7415" in note for note in notes)
    for more in (
        {"metadata": {"referenceSystem": "urn:ogc:def:crs:EPSG::4979"}},
        {"transform": {"scale": [1e-5, 1e-5, 1], "translate": [4.3, 52, 0]}},
    ):
        with pytest.raises(LidarError, match="in degrees"):
            load(tmp_path, city({"a": thing(geometry())}, **more))


def placed(x, y, reference, scale=(0.001, 0.001, 0.001), **more):
    metadata = {"referenceSystem": reference}
    transform = {"scale": scale, "translate": [x, y, 0]}
    return city({"a": thing(geometry())}, metadata=metadata, transform=transform, **more)


URN = "urn:ogc:def:crs:EPSG::"
URL = "https://www.opengis.net/def/crs/EPSG/0/"


@pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (URN + "3857", r"uses EPSG:3857, whose meter is 0\.678 m long.*crs_reproject 32632 save"),
        (URL + "3857", r"EPSG:3857.*crs_reproject 32632"),
        (URL + "3395", r"EPSG:3395.*crs_reproject 32632"),
        ("https://www.opengis.net/def/crs/ESRI/0/102100", r"ESRI:102100, whose meter.* 32632"),
        ("urn:ogc:def:crs,crs:EPSG::3857,crs:EPSG::5773", r"EPSG:3857, whose meter.* 32632 save"),
        (URN + "4978", r"in degrees \(EPSG:4978\)|geocentric"),
        ("http://www.opengis.net/def/crs/OGC/1.3/CRS84", "in degrees"),
    ],
)
def test_systems_without_true_meters_are_refused(tmp_path, reference, words):
    with pytest.raises(LidarError, match=words):
        load(tmp_path, placed(1e6, 6e6, reference))


@pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
@pytest.mark.parametrize(
    ("code", "x", "y", "words"),
    [
        (32632, 500_000, 5_300_000, None),
        (32632, 2_000_000, 5_300_000, r"whose meter is 0\.973 m long.*crs_reproject 32635 "),
        (2056, 2_600_000, 1_200_000, None),
    ],
)
def test_the_scale_counts_in_the_middle_of_a_city(tmp_path, code, x, y, words):
    document = placed(x, y, URN + str(code), (1, 1, 1))
    if words is not None:
        with pytest.raises(LidarError, match=words):
            load(tmp_path, document)
        return
    notes = []
    (cube,) = load(tmp_path, document, notes)
    np.testing.assert_allclose(cube.bounds[0, :2], [x, y])
    assert any(
        f"uses EPSG:{code}. To write this code to LAS files, use <world.epsg={code}>" in note
        for note in notes
    )


@pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
def test_feet_of_a_system_are_converted(tmp_path):
    notes = []
    (cube,) = load(tmp_path, placed(984_250, 200_000, URN + "2263", (1, 1, 1)), notes)
    foot_m = 1200 / 3937
    np.testing.assert_allclose(np.ptp(cube.bounds, axis=0), 2 * foot_m)
    np.testing.assert_allclose(cube.bounds[0, :2], [984_250 * foot_m, 200_000 * foot_m])
    assert any("uses EPSG:2263" in note and "were converted to meters" in note for note in notes)
    heights_in_meters = "urn:ogc:def:crs,crs:EPSG::2263,crs:EPSG::5703"
    (cube,) = load(tmp_path, placed(984_250, 200_000, heights_in_meters, (1, 1, 1)))
    np.testing.assert_allclose(np.ptp(cube.bounds, axis=0), [2 * foot_m, 2 * foot_m, 2])
    (cube,) = load(tmp_path, placed(984_250, 200_000, URN + "2263", (1, 1, 1)), unit="ft")
    np.testing.assert_allclose(np.ptp(cube.bounds, axis=0), 2 * 0.3048)


def test_without_rasterio_systems_of_the_world_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)
    with pytest.raises(LidarError, match="EPSG:3857, whose meters are not true to scale"):
        load(tmp_path, placed(1e6, 6e6, URN + "3857"))
    notes = []
    load(tmp_path, placed(84_600, 447_000, URN + "7415"), notes)
    assert any("uses EPSG:7415" in note for note in notes)


def test_the_first_version_needs_no_transform(tmp_path):
    document = city({"a": thing(geometry(lod=2))}, version="1.0")
    del document["transform"]
    notes = []
    (cube,) = load(tmp_path, document, notes)
    np.testing.assert_array_equal(cube.bounds, [[0, 0, 0], [2, 2, 2]])
    assert not notes
    load(tmp_path, {**document, "version": "2.0"}, notes)
    assert "has no transform" in notes[0]


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ('{"scene": {"files": ["a.glb"]}}', 'is not "CityJSON"'),
        ("[1, 2]", 'is not "CityJSON"'),
        (
            city({"a": thing(geometry())}, version="0.9"),
            "CityJSON 0.9, but only versions 1.0 to 2.0",
        ),
        (city({"a": thing(geometry("Solid", SOLID[0]))}), "'Building a'.*"),
        (city({"a": thing(geometry("MultiSurface", SOLID))}), "'Building a': .*not nested as"),
        (city({"a": thing(geometry("MultiSurface", [[[0, 1, 8]]]))}), "'Building a': .*0 to 8"),
        (city({"a": thing(geometry("MultiSurface", [[[0, 1, -1]]]))}), "'Building a': .*-1 to 1"),
        (city({"a": thing(geometry("MultiSurface", [[[0, 1, 2**70]]]))}), "'Building a'"),
        (city({"a": thing(geometry("MultiSurface", [[[0, 1, 0.5]]]))}), "'Building a'"),
        (city({"a": thing(geometry())}, [*CUBE[:7], [1, 2]]), "cannot be read: .*vertices"),
        (city({"a": thing(geometry())}, [*CUBE[:7], [1e300, 2, 3]]), "farther than anything"),
        (json.dumps(city({"a": thing(geometry())}))[:-9], "is truncated: its JSON ends in line 1"),
        ('{"type": "CityJSON", "version": "2.0", "x": ' + NESTED, "cannot be read"),
        (city({"a": thing()}), "no triangles"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, document, words):
    with pytest.raises(LidarError, match=words) as caught:
        load(tmp_path, document)
    assert len(str(caught.value).removeprefix(str(tmp_path))) < 400


def test_memory_is_refused_before_it_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr("lidarsim.io.allowance.memory", lambda: 100_000_000)
    with pytest.raises(LidarError, match=r"would unpack to .* CityJSONSeq"):
        load(tmp_path, '{"type": "CityJSON", "x": [' + "[]," * 300_000 + "[]]}")


def block(x, y, side, z0=0):
    """Corners, in units of half a meter, and boundaries of a solid around x, y."""
    corners = (np.array(CUBE) - [1, 1, 0]) * [side, side, 8] + [x, y, z0]
    return corners.tolist()


@pytest.mark.parametrize(("ground", "side"), [(False, 10), (True, 10), (True, 60)])
def test_the_sensor_stands_beside_buildings_or_around_them(tmp_path, ground, side):
    vertices = [*block(0, 0, side), *block(3 * side, 0, side)]
    second = [[[[8 + corner for corner in ring]] for [ring] in SOLID[0]]]
    objects = {"a": thing(geometry()), "b": thing(geometry(boundaries=second))}
    if ground:
        far = 6 * side
        vertices += [[-far, -far, 0], [far, -far, 0], [far, far, 0], [-far, far, 0]]
        flat = geometry("CompositeSurface", [[[16, 17, 18, 19]]], "1")
        objects["g"] = thing(flat, kind="TINRelief")
    write(tmp_path / "a.city.json", city(objects, vertices))
    built = prepare(Scenario.load(tmp_path / "a.city.json"))
    assert built.placement.surrounds_object is not ground
    for pose in built.placement.poses:
        x, y, z = np.subtract(pose.position, TRANSFORM["translate"]) * 2
        inside = [max(abs(x - at), abs(y)) < side and z < 16 for at in (0, 3 * side)]
        assert not any(inside)
        assert not ground or z in (2, 4, 6)


def test_a_scene_without_buildings_has_default_poses(tmp_path):
    flat = [[0, 0, 0], [60, 0, 0], [60, 60, 0], [0, 60, 0]]
    road = thing(geometry("MultiSurface", [[[0, 1, 2, 3]]]), kind="Road")
    write(tmp_path / "a.city.json", city({"a": road}, flat))
    built = prepare(Scenario.from_data({"scene": {"files": ["a.city.json"]}}, folder=tmp_path))
    assert [pose.position[2] for pose in built.survey.poses] == [1, 2, 3]

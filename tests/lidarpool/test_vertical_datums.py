"""Vertical datums that files state: surveys and scenes with different ones are refused."""

import json
import struct
from importlib.util import find_spec

import numpy as np
import pytest

from lidarpool.cli.commands import cli
from lidarreal import compare_strips, compare_surveys
from lidarscenario.points.point_scene import scene_from_points
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError
from lidarsim.scene.files import coordinate_systems
from lidarsim.scene.scene import Scene

laspy = pytest.importorskip("laspy", reason="laspy is an extra")
pytestmark = pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
if find_spec("rasterio") is not None:
    import rasterio
    from rasterio.crs import CRS
    from rasterio.transform import from_origin

X0 = 500_000.0
Y0 = 5_600_000.0
PLANE = np.array([[X0 + x, Y0 + y, 100.0] for x in range(20) for y in range(20)])
UTM = CRS.from_epsg(32632).to_wkt() if find_spec("rasterio") is not None else ""
UP = 'UNIT["metre",1],AXIS["Up",UP]'


def wkt(vertical=""):
    """Return WKT of UTM zone 32 with the WKT of a vertical system."""
    return f'COMPD_CS["UTM with heights",{UTM},{vertical}]' if vertical else UTM


def geotiff(code):
    """Return GeoTIFF keys of UTM zone 32 with the code of a vertical system."""
    rows = [(1024, 1), (3072, 32632), (3076, 9001), *([(4096, code)] if code else [])]
    keys = [(1, 1, 0, len(rows)), *((key, 0, 1, value) for key, value in rows)]
    return b"".join(struct.pack("<4H", *key) for key in keys)


def las(path, system):
    """Write a plane with a system as WKT or as GeoTIFF keys."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [X0, Y0, 0]
    if isinstance(system, str):
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", system.encode() + b"\0"))
        header.global_encoding.wkt = True
    else:
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", system))
    data = laspy.LasData(header)
    data.x, data.y, data.z = PLANE.T
    data.write(path)
    return path


ELLIPSOID = wkt(f'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],{UP}]')
EGM96 = wkt(
    f'VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005,AUTHORITY["EPSG","5171"]],{UP},'
    'AUTHORITY["EPSG","5773"]]'
)
EGM96_OF_ESRI = wkt(
    'VERTCS["EGM96_Geoid",VDATUM["EGM96_Geoid"],PARAMETER["Vertical_Shift",0.0],'
    'PARAMETER["Direction",1.0],UNIT["Meter",1.0]]'
)
NAVD88 = wkt(
    'VERT_CS["NAVD88 - Geoid12B (Meters)",VERT_DATUM["North American Vertical Datum 1988",2005],'
    f"{UP}]"
)
UNKNOWN = wkt(f'VERT_CS["unknown",VERT_DATUM["unknown",2005],{UP}]')
DIFFERENT = [
    (ELLIPSOID, EGM96, "ellipsoidal heights", "heights in the datum EGM96 geoid"),
    (geotiff(5773), geotiff(5030), "heights in the datum EGM96 geoid", "ellipsoidal heights"),
    (
        EGM96_OF_ESRI,
        geotiff(5103),
        "heights in the datum EGM96 geoid",
        "heights in the datum North American Vertical Datum 1988",
    ),
]
SAME = [(EGM96, EGM96_OF_ESRI), (geotiff(5773), EGM96), (geotiff(5103), NAVD88), (wkt(), UNKNOWN)]


@pytest.mark.parametrize(
    ("first", "second", "heights_a", "heights_b"), DIFFERENT, ids=["wkt", "keys", "esri and datum"]
)
def test_surveys_with_different_vertical_datums_are_refused(
    tmp_path, first, second, heights_a, heights_b
):
    a, b = las(tmp_path / "a.las", first), las(tmp_path / "b.las", second)
    for compare in (lambda: compare_surveys(a, b, method="planes"), lambda: compare_strips(a, b)):
        with pytest.raises(LidarError) as refused:
            compare()
        assert f"a.las has {heights_a}, but" in str(refused.value)
        assert f"b.las has {heights_b}." in str(refused.value)


@pytest.mark.parametrize(("first", "second"), SAME, ids=["esri", "keys", "datum", "unknown"])
def test_different_names_of_a_vertical_datum_are_the_same(tmp_path, first, second):
    a, b = las(tmp_path / "a.las", first), las(tmp_path / "b.las", second)
    found = compare_surveys(a, b, method="planes")
    assert not [note for note in found.figures["notes"] if "vertical datum" in note]


@pytest.mark.parametrize("silent", [wkt(), geotiff(0), UNKNOWN], ids=["wkt", "keys", "unknown"])
def test_a_survey_without_a_vertical_datum_is_noted(tmp_path, silent):
    a, b = las(tmp_path / "a.las", silent), las(tmp_path / "b.las", EGM96)
    for found in (compare_surveys(a, b, method="planes"), compare_surveys(b, a, method="planes")):
        (note,) = (note for note in found.figures["notes"] if "vertical datum" in note)
        assert "a.las does not specify a vertical datum" in note
        assert "assumed to be heights in the datum EGM96 geoid" in note


def test_vertical_datums_are_compared_without_rasterio(tmp_path, monkeypatch):
    a, b = las(tmp_path / "a.las", ELLIPSOID), las(tmp_path / "b.las", EGM96)
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r"a\.las has ellipsoidal heights, but \S+b\.las has"):
        compare_surveys(a, b, method="planes")


@pytest.fixture
def ground_scan(tmp_path):
    """The plane as a raster with EGM96 heights, and a station of a scan of it."""
    raster(tmp_path / "ground.tif", "EPSG:32632+5773", height_m=100.0)
    text = (
        "scene: ground.tif\nworld: {epsg: 32632}\nsensor: {layers: 8}\n"
        f"poses: [[{X0 + 10}, {Y0 + 10}, 102]]\n"
    )
    (tmp_path / "stations.yaml").write_text(text)
    return tmp_path


def measure_coverage(folder, cloud):
    arguments = ["stations", str(folder / "stations.yaml"), "--cloud", str(cloud)]
    cli.main(arguments, standalone_mode=False)


UTM33 = geotiff(0).replace(struct.pack("<H", 32632), struct.pack("<H", 32633))


@pytest.mark.parametrize(
    ("system", "cloud", "other"),
    [
        (UTM33, "coordinate system EPSG:32633", "EPSG:32632"),
        (ELLIPSOID, "ellipsoidal heights", "heights in the datum EGM96 geoid"),
    ],
    ids=["horizontal", "vertical"],
)
def test_meshes_and_scenes_in_other_systems_than_the_cloud_are_refused(
    ground_scan, system, cloud, other
):
    a = las(ground_scan / "a.las", system)
    with pytest.raises(LidarError) as refused:
        compare_surveys(a, ground_scan / "ground.tif", method="mesh")
    assert cloud in str(refused.value) and f"ground.tif has {other}" in str(refused.value)
    with pytest.raises(LidarError) as refused:
        measure_coverage(ground_scan, a)
    assert cloud in str(refused.value) and f"stations.yaml has {other}" in str(refused.value)


@pytest.mark.parametrize("silent", [wkt(), UNKNOWN], ids=["wkt", "unknown"])
def test_clouds_that_state_less_than_the_mesh_or_scene_are_noted(ground_scan, capsys, silent):
    a = las(ground_scan / "a.las", silent)
    found = compare_surveys(a, ground_scan / "ground.tif", method="mesh")
    measure_coverage(ground_scan, a)
    for notes in (found.figures["notes"], capsys.readouterr().out.splitlines()):
        (note,) = (note for note in notes if "vertical datum" in note)
        assert "a.las does not specify a vertical datum" in note
        assert "assumed to be heights in the datum EGM96 geoid" in note


def test_a_mesh_and_a_cloud_in_the_same_system_have_no_note(ground_scan):
    a = las(ground_scan / "a.las", geotiff(5773))
    found = compare_surveys(a, ground_scan / "ground.tif", method="mesh")
    assert not [note for note in found.figures["notes"] if "specify" in note]


# -- scenes ---------------------------------------------------------------------------------------


def raster(path, crs, *, height_m=53.0, **options):
    place = from_origin(X0, Y0 + 20, 2, 2)
    size = {"width": 10, "height": 10, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", crs=crs, transform=place, **size, **options) as file:
        file.write(np.full((1, 10, 10), height_m, np.float32))


def city(path, system):
    """Write a building with the code of a system."""
    corners = [[x, y, z] for z in (0, 9) for x, y in ((0, 0), (8, 0), (8, 8), (0, 8))]
    sides = [
        [0, 3, 2, 1],
        [4, 5, 6, 7],
        *([i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4] for i in range(4)),
    ]
    solid = {"type": "Solid", "lod": "1", "boundaries": [[[side] for side in sides]]}
    content = {
        "type": "CityJSON",
        "version": "2.0",
        "metadata": {"referenceSystem": f"https://www.opengis.net/def/crs/{system}"},
        "transform": {"scale": [1, 1, 1], "translate": [X0, Y0, 53]},
        "CityObjects": {"house": {"type": "Building", "geometry": [solid]}},
        "vertices": corners,
    }
    path.write_text(json.dumps(content), "utf-8")


def prepared(folder, *files):
    data = {"scene": {"files": [*files]}, "poses": [[X0 + 9, Y0 + 9, 160]], "steps": 1}
    return prepare(Scenario.from_data(data, folder=folder), plans=False)


@pytest.fixture
def site(tmp_path):
    """Return a folder with a cloud with ellipsoidal heights as a scene, and rasters."""
    las(tmp_path / "cloud.las", ELLIPSOID)
    scene = scene_from_points(tmp_path / "cloud.las", voxel_m=2.0)
    write_scene(tmp_path / "cloud.glb", scene)
    raster(tmp_path / "ground.tif", "EPSG:32632+5773")
    raster(tmp_path / "old.tif", "EPSG:32632+5773", GEOTIFF_VERSION="1.0")
    raster(tmp_path / "silent.tif", "EPSG:32632")
    return tmp_path


@pytest.mark.parametrize("ground", ["ground.tif", "old.tif"])
def test_scenes_with_different_vertical_datums_are_refused(site, ground):
    with pytest.raises(LidarError) as refused:
        prepared(site, "cloud.glb", ground)
    assert "cloud.glb has ellipsoidal heights" in str(refused.value)
    assert f"{ground} has heights in the datum EGM96 geoid" in str(refused.value)
    assert "translation: [0, 0, Z]" in str(refused.value)


def test_a_scene_may_correct_the_heights_of_a_file(site):
    moved = {"file": "cloud.glb", "translation": [0, 0, -47]}
    found = prepared(site, moved, "ground.tif")
    assert np.ptp(found.scene.bounds[:, 2]) < 0.1
    assert not [note for note in found.findings.notes if "vertical datum" in note]


def test_files_of_a_scene_without_a_vertical_datum_are_noted(site):
    found = prepared(site, "silent.tif", {"file": "cloud.glb", "translation": [0, 0, 0]})
    (note,) = (note for note in found.findings.notes if "vertical datum" in note)
    assert note.startswith("silent.tif does not state a vertical datum. Its heights are assumed")
    assert "ellipsoidal heights, as in cloud.glb" in note


def test_the_vertical_datum_of_a_city_is_compared(site):
    city(site / "city.json", "EPSG/0/32632&2=https://www.opengis.net/def/crs/EPSG/0/7837")
    with pytest.raises(LidarError, match=r"ellipsoidal heights.*Deutsches Haupthoehennetz 2016"):
        prepared(site, "cloud.glb", "city.json")


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
@pytest.mark.parametrize(("system", "datum"), [(ELLIPSOID, "ellipsoid"), (EGM96, "EGM96 geoid")])
def test_a_scene_file_keeps_the_vertical_datum_of_a_cloud(tmp_path, suffix, system, datum):
    scene = scene_from_points(las(tmp_path / "cloud.las", system), voxel_m=2.0)
    assert scene.vertical_datum == datum
    file = tmp_path / f"scene{suffix}"
    if suffix == ".ply":  # single precision is not sufficient for projected coordinates
        scene = Scene.from_meshes(scene.with_world_origin(-scene.origin).meshes())
        object.__setattr__(scene, "vertical_datum", datum)
    write_scene(file, scene)
    assert Scene.load(file).vertical_datum == datum
    assert Scene.load(file, unit="mm").vertical_datum == ""

"""Units of LAS and LAZ: what a file's coordinate system states is converted to meters."""

import struct

import numpy as np
import pytest
from click.testing import CliRunner

from lidarpool.cli.scenario_commands import scene as command
from lidarreal import compare
from lidarscenario.points.point_scene import scene_from_points
from lidarsim import LidarError, Scene
from lidarsim.scene.files import coordinate_systems

laspy = pytest.importorskip("laspy", reason="laspy is an extra")

FOOT = 0.3048
US_FOOT = 12 / 39.37
EAST, NORTH = np.mgrid[300:304:40j, 200:203:30j].reshape(2, -1)
PLACE = np.column_stack([EAST, NORTH, (EAST - 300) / 2 + 10])  # meters

GEOGCS = (
    'GEOGCS["NAD83",DATUM["North_American_Datum_1983",SPHEROID["GRS 1980",6378137,298.257222101]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]]]'
)
PROJCS = (
    f'PROJCS["NAD83 / New York Long Island",{GEOGCS},PROJECTION["Lambert_Conformal_Conic_2SP"],'
    'PARAMETER["false_easting",984250],UNIT["%s",%s],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)
VERT_CS = 'VERT_CS["NAVD88",VERT_DATUM["NAVD 1988",2005],UNIT["%s",%s],AXIS["Up",UP]]'
US_UNIT = ("US survey foot", "0.304800609601219")
FOOT_UNIT = ("foot", "0.3048")
METER_UNIT = ("metre", "1")
WKT2 = (
    'COMPOUNDCRS["of two",PROJCRS["plane",BASEGEOGCRS["NAD83",DATUM["NAD83",ELLIPSOID["GRS 1980",'
    '6378137,298.257222101,LENGTHUNIT["metre",1]]],PRIMEM["Greenwich",0,ANGLEUNIT["degree",'
    '0.0174532925199433]]],CONVERSION["c",METHOD["Transverse Mercator"],PARAMETER["FE",0,'
    'LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["easting (E)",east,ORDER[1],LENGTHUNIT['
    '"US survey foot",0.304800609601219]],AXIS["northing (N)",north,ORDER[2],LENGTHUNIT['
    '"US survey foot",0.304800609601219]]],VERTCRS["height",VDATUM["d"],CS[vertical,1],AXIS['
    '"gravity-related height (H)",up,LENGTHUNIT["metre",1]]]]'
)
PLANE3D = (
    'PROJCRS["3D",BASEGEOGCRS["x",DATUM["d",ELLIPSOID["e",6378137,298]]],CONVERSION["c",'
    'METHOD["m"]],CS[Cartesian,3],AXIS["E",east],AXIS["N",north],AXIS["h",up],'
    'LENGTHUNIT["foot",0.3048]]'
)


def wkt(text):
    return [laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0")]


def keys(*pairs, doubles=()):
    """Make the records of GeoTIFF keys: numbers, or floats in a record of their own."""
    rows = [(key, 0, 1, value) for key, value in pairs]
    rows += [(key, 34736, 1, number) for number, (key, _) in enumerate(doubles)]
    data = struct.pack("<4H", 1, 1, 0, len(rows)) + b"".join(struct.pack("<4H", *r) for r in rows)
    records = [laspy.VLR("LASF_Projection", 34735, "", data)]
    if doubles:
        values = struct.pack(f"<{len(doubles)}d", *(value for _, value in doubles))
        records.append(laspy.VLR("LASF_Projection", 34736, "", values))
    return records


def written(path, points, records=(), extended=False, wkt_bit=False):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.scales = [1e-6] * 3
    las.header.offsets = points[0].round()
    las.header.global_encoding.wkt = wkt_bit
    if extended:
        las.evlrs = laspy.vlrs.vlrlist.VLRList(records)
    else:
        las.header.vlrs.extend(records)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path


STATED = {  # {case: (records, meters in the units of x and y, of z)}
    "no system": ([], 1.0, 1.0),
    "WKT 1, US survey foot": (wkt(PROJCS % US_UNIT), US_FOOT, US_FOOT),
    "WKT 1, meter": (wkt(PROJCS % METER_UNIT), 1.0, 1.0),
    "compound WKT 1, meters and feet": (
        wkt(f'COMPD_CS["c",{PROJCS % METER_UNIT},{VERT_CS % FOOT_UNIT}]'), 1.0, FOOT,
    ),
    "compound WKT 1, feet and meters": (
        wkt(f'COMPD_CS["c",{PROJCS % US_UNIT},{VERT_CS % METER_UNIT}]'), US_FOOT, 1.0,
    ),
    "round brackets": (
        wkt((PROJCS % FOOT_UNIT).replace("[", "(").replace("]", ")")), FOOT, FOOT,
    ),
    "compound WKT 2": (wkt(WKT2), US_FOOT, 1.0),
    "WKT 2 of three axes": (wkt(PLANE3D), FOOT, FOOT),
    "bound WKT 2": (wkt(f'BOUNDCRS[SOURCECRS[{PLANE3D}],TARGETCRS[{PLANE3D}]]'), FOOT, FOOT),
    "local system": (wkt('LOCAL_CS["site",UNIT["foot",0.3048]]'), FOOT, FOOT),
    "key of the unit": (keys((1024, 1), (3072, 32767), (3076, 9003)), US_FOOT, US_FOOT),
    "keys of both units": (
        keys((1024, 1), (3072, 32618), (3076, 9001), (4099, 9002)), 1.0, FOOT,
    ),
    "keys of feet and meters": (keys((1024, 1), (3076, 9002), (4099, 9001)), FOOT, 1.0),
    "size of a unit": (
        keys((1024, 1), (3072, 32767), (3076, 32767), doubles=[(3077, 0.5)]), 0.5, 0.5,
    ),
    "UTM by its code": (keys((1024, 1), (3072, 32618)), 1.0, 1.0),
    "a vertical datum": (keys((1024, 1), (3072, 26918), (4096, 5103)), 1.0, 1.0),
}  # fmt: skip
BY_EPSG = {
    "Long Island by its code": (keys((1024, 1), (3072, 2263)), US_FOOT, US_FOOT),
    "heights by their code": (keys((1024, 1), (3072, 2263), (4096, 5703)), US_FOOT, 1.0),
    "heights in feet by their code": (keys((1024, 1), (3072, 26918), (4096, 6360)), 1.0, US_FOOT),
}


def check_conversion(folder, records, meters, height_m, **options):
    factors = np.array([meters, meters, height_m])
    path = written(folder / "a.las", PLACE / factors, records, **options)
    notes = []
    scene = scene_from_points(path, voxel_m=0.01, report=notes.append)
    low, high = scene.bounds
    np.testing.assert_allclose((low + high) / 2, (302, 201.5, 11), atol=0.01)
    assert bool(notes) == ((meters, height_m) != (1.0, 1.0)), notes
    other = written(folder / "meters.laz", PLACE)
    figures = compare(path, other).figures
    assert figures["distances"]["a_to_b"]["mean_m"] < 1e-5
    return notes


@pytest.mark.parametrize("case", STATED)
def test_stated_units_are_converted(tmp_path, monkeypatch, case):
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)  # without the registry
    check_conversion(tmp_path, *STATED[case])


@pytest.mark.parametrize("case", BY_EPSG)
def test_units_of_codes_are_those_of_the_registry(tmp_path, case):
    pytest.importorskip("rasterio", reason="rasterio is an extra")
    check_conversion(tmp_path, *BY_EPSG[case])


def test_a_system_in_an_extended_record(tmp_path):
    records = wkt(f'COMPD_CS["c",{PROJCS % US_UNIT},{VERT_CS % FOOT_UNIT}]')
    check_conversion(tmp_path, records, US_FOOT, FOOT, extended=True, wkt_bit=True)


def test_an_unstated_unit_of_heights_is_noted(tmp_path):
    (note,) = check_conversion(tmp_path, *STATED["WKT 1, US survey foot"])
    assert "US survey foot" in note and "not state a unit for heights" in note and "--unit" in note


@pytest.mark.parametrize("wkt_bit", [False, True])
def test_of_both_the_header_says_which_counts(tmp_path, wkt_bit):
    records = [*wkt(PROJCS % FOOT_UNIT), *keys((1024, 1), (3076, 9001))]
    check_conversion(tmp_path, records, *((FOOT, FOOT) if wkt_bit else (1, 1)), wkt_bit=wkt_bit)


@pytest.mark.parametrize(
    ("records", "message"),
    [
        (keys((1024, 1), (3072, 2263)), r"EPSG:2263 has.*--unit.*\.\[geo\]"),
        (keys((1024, 1), (3076, 9999)), r"unit EPSG:9999 is unknown.*--unit"),
        (keys((1024, 1), (3072, 32767)), r"a unit.*--unit"),
        (keys((1024, 2), (2048, 4326)), r"are angles.*EPSG:4326.*reprojection"),
        (wkt(GEOGCS), r"are angles \(NAD83\)"),
        (wkt('PROJCS["no unit",PROJECTION["x"]]'), r"'no unit' has no unit"),
        (wkt('PROJCS["cut",UNIT["foot"'), r"is truncated: its coordinate system"),
        (wkt("+proj=utm +zone=33"), "its coordinate system begins with 'PROJ', but the WKT"),
    ],
)
def test_what_cannot_be_known_is_refused_unless_the_unit_is_given(
    tmp_path, monkeypatch, records, message
):
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)
    path = written(tmp_path / "a.las", PLACE / FOOT, records)
    with pytest.raises(LidarError, match=message):
        scene_from_points(path)
    with pytest.raises(LidarError, match=message):
        compare(path, path)
    low, _ = scene_from_points(path, voxel_m=0.01, unit="ft").bounds
    np.testing.assert_allclose(low, PLACE.min(axis=0), atol=0.1)
    other = written(tmp_path / "meters.las", PLACE)
    assert compare(path, other, unit_a="ft").figures["distances"]["a_to_b"]["mean_m"] < 1e-5


def test_equal_numbers_of_feet_and_meters_are_apart(tmp_path):
    feet = written(tmp_path / "feet.las", PLACE, wkt(PROJCS % FOOT_UNIT))
    meters = written(tmp_path / "meters.las", PLACE)
    found = compare(feet, meters)
    assert found.figures["distances"]["a_to_b"]["mean_m"] > 100
    notes = found.figures["notes"]
    assert any("feet.las was converted from foot to meters" in note for note in notes)
    same = compare(feet, meters, unit_a="m").figures["distances"]["a_to_b"]
    assert same["mean_m"] < 1e-5


def test_what_is_in_meters_has_no_unit_to_give(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"0")
    with pytest.raises(LidarError, match=r"a\.mcap is always in meters\. Remove the unit 'ft'"):
        compare(tmp_path / "a.mcap", tmp_path / "a.mcap", unit_a="ft")


def test_the_command_takes_the_unit_of_any_cloud(tmp_path):
    np.savetxt(tmp_path / "a.xyz", PLACE * 1000, "%.4f")
    arguments = ["points", f"{tmp_path}/a.xyz", f"{tmp_path}/a.glb", "--unit", "mm"]
    CliRunner().invoke(command, arguments, catch_exceptions=False)
    low, _ = Scene.load(tmp_path / "a.glb").bounds
    np.testing.assert_allclose(low, PLACE.min(axis=0), atol=0.2)

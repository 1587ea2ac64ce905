"""Coordinate systems that clouds state: true meters, a refusal that helps, or another system."""

import contextlib
import struct
from importlib.util import find_spec

import numpy as np
import pytest
from click.testing import CliRunner

from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.scenario_commands import scene as command
from lidarpool.pages.opened import growing_view, open_view
from lidarreal import compare
from lidarscenario.points.point_scene import scene_from_points
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Scene
from lidarsim.scene.files import coordinate_systems

laspy = pytest.importorskip("laspy", reason="laspy is an extra")
pytestmark = pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
if find_spec("rasterio") is not None:
    from rasterio.crs import CRS
    from rasterio.warp import transform

LONGITUDE = 8.98
LATITUDE = 47.35
HEIGHT_M = 400.0
SIDE_M = 29.0  # of the cloud, on the ground
STEPS = np.mgrid[0:30, 0:30].reshape(2, -1).T.astype(float)
VERT_CS = 'VERT_CS["h",VERT_DATUM["d",2005],UNIT["foot",0.3048],AXIS["Up",UP]]'


def ground(target):
    """Return a level grid of 29 x 29 m in a system, with heights in meters."""
    (x,), (y,) = transform("EPSG:4326", "EPSG:32632", [LONGITUDE], [LATITUDE])
    points = np.column_stack([STEPS + np.array([x, y]), np.full(len(STEPS), HEIGHT_M)])
    if target == "EPSG:4978":
        longitude, latitude = transform("EPSG:32632", "EPSG:4979", *points[:, :2].T)
        return np.transpose(
            transform("EPSG:4979", "EPSG:4978", longitude, latitude, points[:, 2].tolist())
        )
    moved = transform("EPSG:32632", target, *points[:, :2].T)
    return np.column_stack([*moved, points[:, 2]])


def wkt(system, version="WKT1_GDAL"):
    text = system if "[" in system else CRS.from_string(system).to_wkt(version=version)
    return [laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0")]


def keys(*pairs, doubles=()):
    rows = [(key, 0, 1, value) for key, value in pairs]
    rows += [(key, 34736, 1, number) for number, (key, _) in enumerate(doubles)]
    data = struct.pack("<4H", 1, 1, 0, len(rows)) + b"".join(struct.pack("<4H", *r) for r in rows)
    values = struct.pack(f"<{len(doubles)}d", *(value for _, value in doubles))
    records = [laspy.VLR("LASF_Projection", 34735, "", data)]
    return [*records, laspy.VLR("LASF_Projection", 34736, "", values)] if doubles else records


def written(path, points, records=(), step_m=1e-4):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.scales = [1e-9, 1e-9, 1e-4] if np.abs(points[:, 0]).max() < 360 else [step_m] * 3
    las.header.offsets = points[0]
    las.header.vlrs.extend(records)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path


def bounds_of(path, **options):
    """Return the bounds of the scene of a cloud in the world, and the notes."""
    notes = []
    scene = scene_from_points(path, report=notes.append, voxel_m=0.3, size=0.01, **options)
    return scene.bounds + scene.origin, [note.removeprefix(f"{path} ") for note in notes]


MERCATOR_KEYS = keys(
    (1024, 1), (2048, 4326), (3072, 32767), (3074, 32767), (3075, 7), (3076, 9001),
    doubles=[(3080, 0.0), (3081, 0.0), (3092, 1.0), (3082, 0.0), (3083, 0.0)],
)  # fmt: skip
STRETCHED = {  # {case: (system of the coordinates, records, what the message says)}
    "Web Mercator": ("EPSG:3857", wkt("EPSG:3857"), r"EPSG:3857 \(WGS 84 / Pseudo-Mercator\)"),
    "WKT 2": ("EPSG:3857", wkt("EPSG:3857", "WKT2_2019"), "EPSG:3857"),
    "of Esri": ("EPSG:3857", wkt("ESRI:102100", "WKT1_ESRI"), "Mercator"),
    "Esri's code": ("EPSG:3395", keys((1024, 1), (3072, 54004)), "World_Mercator"),
    "code, and no type of system": ("EPSG:3857", keys((1024, 0), (3072, 3857)), "EPSG:3857"),
    "by its code": ("EPSG:3857", keys((1024, 1), (3072, 3857)), "EPSG:3857"),
    "code and unit": ("EPSG:3857", keys((1024, 1), (3072, 3857), (3076, 9001)), "EPSG:3857"),
    "World Mercator": ("EPSG:3395", wkt("EPSG:3395"), "EPSG:3395"),
    "Mercator of keys": ("EPSG:3395", MERCATOR_KEYS, "EPSG:3395"),
    "compound": (
        "EPSG:3857",
        wkt(f'COMPD_CS["c",{CRS.from_epsg(3857).to_wkt(version="WKT1_GDAL")},{VERT_CS}]'),
        "EPSG:3857",
    ),
    "equal areas": ("EPSG:6933", wkt("EPSG:6933"), r"meter is 0\.783 to 1\.28 m long"),
} if find_spec("rasterio") else {}  # fmt: skip


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("case", STRETCHED)
def test_stretched_meters_are_refused_with_what_helps(tmp_path, case):
    system, records, message = STRETCHED[case]
    points = ground(system)
    path = written(tmp_path / "a.las", points, records)
    assert np.ptp(points[:, 0]) > 1.2 * SIDE_M or case == "equal areas"
    expected = rf"a\.las: it is in .*{message}.*--epsg 32632 .*reprojection\.out_srs=EPSG:32632"
    for read in (scene_from_points, open_view, growing_view, open_recording):
        with pytest.raises(LidarError, match=expected) as refused:
            read(path)
        assert len(str(refused.value)) < 500 and "\n" not in str(refused.value)
    with pytest.raises(LidarError, match=expected):
        compare(path, path)


@pytest.mark.parametrize("case", ["Web Mercator", "Mercator of keys", "compound"])
def test_clouds_are_brought_to_true_meters(tmp_path, case):
    system, records, _ = STRETCHED[case]
    path = written(tmp_path / "a.las", ground(system), records)
    (lower, upper), notes = bounds_of(path, epsg=32632)
    expected = ground("EPSG:32632")
    np.testing.assert_allclose((lower + upper)[:2] / 2, expected[:, :2].mean(axis=0), atol=0.05)
    np.testing.assert_allclose((upper - lower)[:2], SIDE_M, atol=0.1)
    height_m = HEIGHT_M * 0.3048 if case == "compound" else HEIGHT_M
    assert lower[2] == pytest.approx(height_m, abs=1e-3)
    assert notes[0].startswith("was transformed from ") and notes[0].endswith(" to EPSG:32632")


@pytest.mark.parametrize(
    ("system", "records", "words"),
    [
        ("EPSG:4326", lambda: wkt("EPSG:4326"), "are angles"),
        ("EPSG:4326", lambda: keys((1024, 2), (2048, 4326)), "are angles"),
        ("EPSG:4978", lambda: wkt("EPSG:4978"), "are geocentric"),
        ("EPSG:4978", lambda: wkt("EPSG:4978", "WKT2_2019"), "are geocentric"),
        ("EPSG:4978", lambda: keys((1024, 3), (2048, 4978)), "are geocentric"),
    ],
)
def test_angles_and_geocentric_coordinates(tmp_path, system, records, words):
    path = written(tmp_path / "a.las", ground(system), records())
    with pytest.raises(LidarError, match=f"its coordinates {words}.*--epsg CODE .*pdal translate"):
        scene_from_points(path)
    (lower, upper), notes = bounds_of(path, epsg=32632)
    np.testing.assert_allclose(lower, ground("EPSG:32632").min(axis=0), atol=0.05)
    np.testing.assert_allclose(upper, ground("EPSG:32632").max(axis=0), atol=0.05)
    assert ("does not state a unit for heights" in notes[-1]) == (system == "EPSG:4326")


def test_feet_are_converted_on_the_way(tmp_path):
    (x,), (y,) = transform("EPSG:4326", "EPSG:2263", [-73.9], [40.8])
    points = np.column_stack([STEPS / 0.3048 + (x, y), np.full(len(STEPS), 100.0)])
    text = CRS.from_epsg(2263).to_wkt(version="WKT1_GDAL")
    path = written(tmp_path / "a.las", points, wkt(f'COMPD_CS["c",{text},{VERT_CS}]'))
    (lower, upper), _ = bounds_of(path, epsg=32618)
    true_m = 29 * 1.414  # of the diagonal, which the zone rotates
    corner = np.transpose(transform("EPSG:2263", "EPSG:32618", [x], [y]))[0]
    assert np.hypot(*(upper - lower)[:2]) == pytest.approx(true_m, rel=0.05)
    np.testing.assert_allclose(lower[:2], corner, atol=1)
    assert lower[2] == pytest.approx(30.48, abs=1e-3)


@pytest.mark.parametrize("system", ["EPSG:32632", "EPSG:2056", "EPSG:25832", "EPSG:3035"])
def test_true_meters_stay_as_they_are(tmp_path, system):
    points = ground(system)
    path = written(tmp_path / "a.las", points, wkt(system))
    (lower, upper), notes = bounds_of(path)
    np.testing.assert_allclose(lower, points.min(axis=0), atol=0.05)
    np.testing.assert_allclose(upper, points.max(axis=0), atol=0.05)
    assert notes == []
    assert open_recording(path).notes == ()


def test_what_cannot_be_brought_is_refused(tmp_path):
    path = written(tmp_path / "a.las", ground("EPSG:3857"), wkt("EPSG:3857"))
    for epsg, message in (
        (3857, r"cannot be transformed to EPSG:3857 \(WGS.*, a world map projection"),
        (2263, r"cannot be transformed to EPSG:2263 \(.*, which is not in meters"),
        (32640, r"cannot be transformed to EPSG:32640 .*Use EPSG:32632, which is true"),
        (1025, "EPSG:1025 is unknown to PROJ"),
    ):
        with pytest.raises(LidarError, match=message):
            scene_from_points(path, epsg=epsg)
    with pytest.raises(LidarError, match="`epsg` and `unit` cannot be combined"):
        scene_from_points(path, epsg=32632, unit="m")
    bare = written(tmp_path / "b.las", ground("EPSG:3857"))
    np.savetxt(tmp_path / "b.xyz", ground("EPSG:3857"))
    for file in (bare, tmp_path / "b.xyz"):
        with pytest.raises(
            LidarError, match=r"does not specify a coordinate system.*Remove --epsg"
        ):
            scene_from_points(file, epsg=32632)


def test_a_given_unit_counts_and_is_noted(tmp_path):
    points = ground("EPSG:3857")
    path = written(tmp_path / "a.las", points, wkt("EPSG:3857"))
    (lower, upper), (note,) = bounds_of(path, unit="m")
    np.testing.assert_allclose(upper - lower, np.ptp(points, axis=0), atol=0.1)
    assert "EPSG:3857" in note and "As specified, its coordinates are read in m" in note
    other = written(tmp_path / "other.las", points, wkt("EPSG:3857"))
    notes = compare(path, other, unit_a="m", unit_b="m").figures["notes"]
    assert sum("As specified" in note for note in notes) == 2
    degrees = written(tmp_path / "b.las", ground("EPSG:4326"), wkt("EPSG:4326"))
    assert "has angular coordinates" in open_recording(degrees, unit="m").notes[0]


def test_a_wide_cloud_says_what_is_wrong_at_its_edges(tmp_path):
    points = np.column_stack([STEPS * 70_000 + (-500_000, 4_000_000), np.zeros(len(STEPS))])
    path = written(tmp_path / "a.las", points, wkt("EPSG:32632"), step_m=0.01)
    (note,) = open_recording(path).notes
    assert "so large that lengths in EPSG:32632 (WGS 84 / UTM zone 32N) are wrong by" in note


def test_without_rasterio_names_and_codes_count(tmp_path, monkeypatch):
    mercator = ground("EPSG:3857")
    zone = ground("EPSG:32632")
    files = {
        "wkt": (mercator, wkt("EPSG:3857")),
        "code": (mercator, keys((1024, 1), (3072, 3857))),
        "code and unit": (mercator, keys((1024, 1), (3072, 3395), (3076, 9001))),
        "keys": (mercator, MERCATOR_KEYS),
        "zone": (zone, wkt("EPSG:32632")),
        "zone by code": (zone, keys((1024, 1), (3072, 32632))),
        "grid": (ground("EPSG:2056"), wkt("EPSG:2056")),
        "equal areas": (ground("EPSG:3035"), wkt("EPSG:3035")),
    }
    paths = {name: written(tmp_path / f"{name}.las", *row) for name, row in files.items()}
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)
    for name in ("wkt", "code", "code and unit", "keys"):
        with pytest.raises(LidarError, match=r"whose meters are not true to scale.*--epsg CODE"):
            open_recording(paths[name])
    for name in ("zone", "zone by code", "grid"):
        assert open_recording(paths[name]).notes == ()
    (note,) = open_recording(paths["equal areas"]).notes
    assert "whose scale is assumed to be true" in note and 'pip install -e ".[geo]"' in note
    with pytest.raises(LidarError, match=r"requires rasterio, .*\.\[geo\]"):
        scene_from_points(paths["wkt"], epsg=32632)


def with_comment(path, comment, points):
    lines = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
    head = f"ply\nformat ascii 1.0\ncomment made by hand\n{comment}\nelement vertex {len(points)}\n"
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    path.write_text(f"{head}{properties}end_header\n{lines}")
    return path


@pytest.mark.parametrize("comment", ["comment crs: EPSG:3857", "obj_info EPSG:3857"])
def test_a_ply_may_state_its_system_in_a_comment(tmp_path, comment):
    path = with_comment(tmp_path / "a.ply", comment, ground("EPSG:3857"))
    for read in (scene_from_points, open_recording):
        with pytest.raises(LidarError, match=r"EPSG:3857.*--epsg 32632"):
            read(path)
    (lower, _), _ = bounds_of(path, epsg=32632)
    np.testing.assert_allclose(lower, ground("EPSG:32632").min(axis=0), atol=0.05)
    text = f"comment crs: {CRS.from_epsg(3857).to_wkt()}"
    with pytest.raises(LidarError, match="EPSG:3857"):
        scene_from_points(with_comment(tmp_path / "b.ply", text, ground("EPSG:3857")))
    other = with_comment(tmp_path / "c.ply", "comment from EPSG:3857 tiles", ground("EPSG:3857"))
    assert bounds_of(other)[1] == []


@pytest.mark.parametrize("system", [
    'LOCAL_CS["Site grid",UNIT["US survey foot",0.304800609601219]]',
    'ENGCRS["Site grid",EDATUM["Peg"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],'
    'LENGTHUNIT["US survey foot",0.304800609601219]]',
])  # fmt: skip
def test_a_comment_may_state_a_local_system(tmp_path, system):
    points = np.stack(np.meshgrid(*[np.linspace(0, 40, 21)] * 2, [3.0]), axis=-1).reshape(-1, 3)
    path = with_comment(tmp_path / "a.ply", f"comment crs: {system}", points)
    (lower, upper), _ = bounds_of(path)
    np.testing.assert_allclose((upper - lower)[:2], 40 * 1200 / 3937, atol=0.02)
    assert lower[2] == pytest.approx(3 * 1200 / 3937, abs=1e-3)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_scene_keeps_the_system_of_its_cloud(tmp_path, suffix):
    """In the file, and from there into what a scenario writes."""
    cloud = written(tmp_path / "a.laz", ground("EPSG:25832"), wkt("EPSG:25832"))
    file = tmp_path / f"place{suffix}"
    arguments = ["points", str(cloud), str(file), "--voxel-m", "0.3"]
    noted = CliRunner().invoke(command, arguments, catch_exceptions=False).stderr
    assert f"{file} uses the coordinate system of {cloud}, EPSG:25832" in noted
    scene = Scene.load(file)
    assert scene.epsg == 25832
    assert Scene.load(write_scene(tmp_path / "again.glb", scene)).epsg == 25832

    def built(entry=file.name, **world):
        pose = [*(scene.bounds.mean(axis=0) + scene.origin + (0, 0, 2)).tolist()]
        data = {"scene": {"files": [entry]}, "poses": [pose], "world": world}
        return prepare(Scenario.from_data(data, folder=tmp_path), plans=False)

    assert built().survey.epsg == 25832
    with pytest.raises(LidarError, match=rf"`world.origin` would also be added to {file.name}"):
        built(origin=[500_000, 5_200_000])
    other = built(epsg=32632)
    assert other.survey.epsg == 32632
    assert [
        note
        for note in other.findings.notes
        if "is in EPSG:25832, but the output states EPSG:32632" in note
    ]
    moved = {"file": file.name, "translation": [-500_000, -5_200_000, 0]}
    assert built(moved, origin=[500_000, 5_200_000]).survey.epsg is None
    assert Scene.load(file, unit="ft").epsg is None


def test_scenes_keep_the_chosen_system_and_none_of_converted_coordinates(tmp_path):
    degrees = written(tmp_path / "a.las", ground("EPSG:4326"), wkt("EPSG:4326"))
    assert scene_from_points(degrees, epsg=32632, voxel_m=0.3).epsg == 32632
    utm = written(tmp_path / "b.las", ground("EPSG:25832"), wkt("EPSG:25832"))
    assert scene_from_points(utm, unit="m", voxel_m=0.3).epsg is None
    feet = written(tmp_path / "c.las", ground("EPSG:2263"), wkt("EPSG:2263"))
    with contextlib.suppress(LidarError):
        assert scene_from_points(feet, voxel_m=0.3).epsg is None
    stated = with_comment(tmp_path / "d.ply", "comment crs: EPSG:25832", ground("EPSG:25832"))
    assert scene_from_points(stated, voxel_m=0.3).epsg == 25832
    foreign = tmp_path / "e.obj"
    foreign.write_text("# made by hand\n# crs: EPSG:25832\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert Scene.load(foreign).epsg is None


def e57_with(monkeypatch, path, metadata, points):
    pye57 = pytest.importorskip("pye57", reason="pye57 is an extra")
    text = pye57.libe57.StringNode
    with monkeypatch.context() as patch:
        patch.setattr(pye57.libe57, "StringNode", lambda file, value: text(file, value or metadata))
        with pye57.E57(str(path), mode="w") as file:
            columns = zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True)
            file.write_scan_raw({name: values.copy() for name, values in columns})
    return path


@pytest.mark.extended
def test_an_e57_may_state_its_system(tmp_path, monkeypatch):
    text = CRS.from_epsg(3857).to_wkt(version="WKT2_2019")
    path = e57_with(monkeypatch, tmp_path / "a.e57", text, ground("EPSG:3857"))
    for read in (scene_from_points, open_recording):
        with pytest.raises(LidarError, match=r"EPSG:3857.*--epsg 32632"):
            read(path)
    (lower, _), notes = bounds_of(path, epsg=32632)
    np.testing.assert_allclose(lower, ground("EPSG:32632").min(axis=0), atol=0.05)
    assert "was transformed from EPSG:3857" in notes[0]
    true_one = e57_with(monkeypatch, tmp_path / "b.e57", "EPSG:32632", ground("EPSG:32632"))
    assert bounds_of(true_one)[1] == [] and open_recording(true_one).notes == ()
    assert open_view(true_one).epsg == 32632
    assert scene_from_points(true_one, voxel_m=0.3).epsg == 32632
    definition = "+proj=merc +datum=WGS84"
    by_proj = e57_with(monkeypatch, tmp_path / "d.e57", definition, ground("EPSG:3395"))
    with pytest.raises(LidarError, match=r"whose meter is 0\.67.*--epsg 32632"):
        open_recording(by_proj)
    vague = e57_with(monkeypatch, tmp_path / "c.e57", "site 7", ground("EPSG:32632"))
    note = bounds_of(vague)[1][0]
    assert "states the coordinate system 'site 7', but its coordinates are read in meters" in note


def test_the_command_brings_a_cloud_to_another_system(tmp_path):
    path = written(tmp_path / "a.las", ground("EPSG:3857"), wkt("EPSG:3857"))
    runner = CliRunner()
    refused = runner.invoke(command, ["points", str(path), f"{tmp_path}/a.glb"])
    assert isinstance(refused.exception, LidarError) and "--epsg 32632" in str(refused.exception)
    arguments = ["points", str(path), f"{tmp_path}/a.glb", "--epsg", "32632"]
    done = runner.invoke(command, arguments, catch_exceptions=False)
    assert "note:" in done.output and "to EPSG:32632" in done.output
    lower, upper = Scene.load(tmp_path / "a.glb").bounds
    np.testing.assert_allclose((upper - lower)[:2], SIDE_M, atol=3.5)  # and a surfel's edges


def test_coordinates_of_another_system_are_told(tmp_path):
    points = ground("EPSG:32632")
    lowest = [*points[:, :2].min(axis=0) - 1000, 0]
    local = written(tmp_path / "a.las", points - lowest, wkt("EPSG:25832"))
    _, notes = bounds_of(local)
    assert (
        "has coordinates (x 1,014.5, y 1,014.5) outside the area of use of EPSG:25832" in notes[0]
    )
    swapped = written(tmp_path / "b.las", points, wkt("EPSG:31467"))
    with pytest.raises(LidarError, match=r"EPSG:31467.*area of use \(Germany.*wrong") as refused:
        scene_from_points(swapped)
    assert "326" not in str(refused.value).partition("wrong system")[2]

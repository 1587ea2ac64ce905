"""Rasters of heights: a vertex at the middle of each pixel, in meters, and nothing made up."""

import re
from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lidarpool.cli.commands import cli
from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.files import rasters
from lidarsim import LidarError, Scanner, Sensor
from lidarsim.scene.files.meshfile import load_meshes, load_objects

pytestmark = pytest.mark.skipif(find_spec("rasterio") is None, reason="needs rasterio, an extra")
if find_spec("rasterio") is not None:
    import rasterio
    from rasterio.rio.main import main_group
    from rasterio.transform import Affine, from_origin
    from rasterio.warp import transform

# of the upper left corner
X0 = 500_000
Y0 = 5_500_000
SLOPE = np.arange(48.0).reshape(6, 8)


def write(path, heights=SLOPE, *, crs="EPSG:25832", place=None, mask=None, units=None, **options):
    """Write a raster, by default of pixels of 2 m; `options` are rasterio's, and tags."""
    heights = np.asarray(heights)
    scale = options.pop("scale", None)
    tags = options.pop("tags", {})
    place = from_origin(X0, Y0, 2, 2) if place is None else place or None
    rows, columns = heights.shape
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", width=columns, height=rows, count=options.pop("count", 1),
            dtype=heights.dtype, crs=crs, transform=place, **options,
        ) as file,
    ):  # fmt: skip
        file.write(heights, 1)
        file.update_tags(**tags)
        if mask is not None:
            file.write_mask(mask)
        if units:
            file.units = [units]
        if scale:
            file.scales = [scale[0]]
            file.offsets = [scale[1]]
    return path


def read(path, **options):
    """Return the mesh, what was taken, and the notes."""
    notes = []
    found = load_objects(path, report=notes.append, **options)
    (mesh,) = found.static
    return mesh, found.raster, [note.removeprefix(f"{path} ") for note in notes]


def by_place(mesh):
    return {(x, y): z for x, y, z in mesh.vertices.tolist()}


def upward_area(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    crossed = np.cross(b - a, c - a)[:, 2]
    assert (crossed > 0).all()
    return crossed.sum() / 2


def test_without_the_library_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(rasters, "find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r'pip install -e "\.\[geo\]" in a checkout of lidarpool'):
        load_meshes(write(tmp_path / "m.tif"))


@pytest.mark.parametrize("suffix", [".tif", ".TIFF", ".asc", ".img"])
@pytest.mark.parametrize("meaning", ["Area", "Point"])
def test_vertices_are_at_the_middles_of_pixels(tmp_path, suffix, meaning):
    drivers = {".asc": "AAIGrid", ".img": "HFA"}
    driver = drivers.get(suffix, "GTiff")
    path = write(tmp_path / f"hill{suffix}", driver=driver, tags={"AREA_OR_POINT": meaning})
    mesh, taken, notes = read(path)
    expected = {
        (X0 + 2 * column + 1, Y0 - 2 * row - 1): SLOPE[row, column]
        for row in range(6)
        for column in range(8)
    }
    assert by_place(mesh) == expected and mesh.name == "hill" and notes == []
    assert len(mesh.faces) == 2 * 5 * 7 and upward_area(mesh) == 10 * 14
    assert taken.epsg == 25832 and taken.summary == "8 x 6 pixels of 2 m, EPSG:25832"


@pytest.mark.parametrize("mirrored", [1, -1])
def test_rotated_and_sheared_rasters(tmp_path, mirrored):
    turned = np.array([[1.6, -0.9], [0.7, 1.8]]) @ np.diag([2, -2 * mirrored])
    place = Affine(*turned[0], X0, *turned[1], Y0)
    mesh, *_ = read(write(tmp_path / "m.tif", place=place))
    columns, rows = np.meshgrid(np.arange(8) + 0.5, np.arange(6) + 0.5)
    middles = np.stack([columns.ravel(), rows.ravel()], axis=1) @ turned.T + [X0, Y0]
    np.testing.assert_allclose(mesh.vertices, np.column_stack([middles, SLOPE.ravel()]), rtol=1e-14)
    assert upward_area(mesh) == pytest.approx(35 * abs(place.determinant))


def test_pixels_without_height_are_holes(tmp_path):
    heights = SLOPE.astype(np.float32)
    heights[2, 2] = -9999
    heights[0, 7] = np.nan
    heights[5, 0] = np.inf
    mesh, taken, notes = read(write(tmp_path / "m.tif", heights, nodata=-9999))
    assert len(mesh.faces) == 2 * (35 - 4 - 1 - 1) and len(mesh.vertices) == 48 - 3
    assert mesh.bounds[:, 2].tolist() == [0, 47] and notes == []
    assert taken.summary.endswith(", 3 pixels without height")
    mask = np.full(SLOPE.shape, 255, np.uint8)
    mask[2, 2] = 0
    mesh, *_ = read(write(tmp_path / "mask.tif", SLOPE.astype(np.int16), mask=mask))
    assert len(mesh.faces) == 2 * (35 - 4)
    with pytest.raises(LidarError, match="no 2 x 2 block of pixels with heights"):
        read(write(tmp_path / "none.tif", np.full((4, 4), 7.0), nodata=7))
    for low in (-32768, -9999):
        *_, notes = read(write(tmp_path / "untold.tif", np.where(SLOPE == 3, low, SLOPE)))
        assert f"heights from {low:,} to 47 m" in notes[0]
        assert f"rio edit-info --nodata {low}.0 untold.tif" in notes[0]


@pytest.mark.parametrize(
    ("options", "unit", "meters", "said"),
    [
        ({}, None, 1, ""),
        ({"units": "ft"}, None, 0.3048, ""),
        ({"units": "US survey foot"}, None, 1200 / 3937, ""),
        ({"units": "ells"}, None, 1, "'ells', which is not a known unit"),
        ({"units": "ft"}, "cm", 0.01, ""),
        ({"crs": "EPSG:25832+6360"}, None, 1200 / 3937, ""),
        (
            {"crs": "EPSG:2263"},
            None,
            1200 / 3937,
            "specify a height unit. The unit of its coordinates, US survey foot",
        ),
        ({"crs": "EPSG:2263"}, "m", 1, ""),
        ({"scale": (0.5, 100)}, None, 0.5, ""),
    ],
)
def test_units_of_heights(tmp_path, options, unit, meters, said):
    path = write(tmp_path / "m.tif", np.repeat([[1000.0], [2000.0]], 8, 0).repeat(20, 1), **options)
    mesh, taken, notes = read(path, unit=unit)
    above = 100 if "scale" in options else 0
    z = mesh.vertices[:, 2]
    np.testing.assert_allclose([z.min(), z.max()], np.array([1000, 2000]) * meters + above)
    assert said in "".join(notes) and bool(said) == bool(notes)
    # Feet on the ground become meters, too, in a zone of UTM.
    feet = options.get("crs") == "EPSG:2263"
    assert taken.epsg == (32618 if feet else 25832)
    assert feet == (" from EPSG:2263" in taken.summary)


SITE = 'LOCAL_CS["Site grid",UNIT["US survey foot",0.304800609601219]]'
ENGINEERING = (
    'ENGCRS["Site grid",EDATUM["Peg"],CS[Cartesian,2],AXIS["x",east,ORDER[1]],'
    'AXIS["y",north,ORDER[2]],LENGTHUNIT["foot",0.3048]]'
)
COMPOUND = f'COMPD_CS["Site",{SITE},VERT_CS["h",VERT_DATUM["h",2005],UNIT["metre",1]]]'
METRIC = 'LOCAL_CS["Site grid",UNIT["metre",1]]'


@pytest.mark.parametrize(
    ("crs", "unit_m", "height_m", "noted"),
    [
        (SITE, 1200 / 3937, 1200 / 3937, ["with the unit US survey foot", "specify a height unit"]),
        (ENGINEERING, 0.3048, 0.3048, ["with the unit foot", "specify a height unit"]),
        (COMPOUND, 1200 / 3937, 1, ["with the unit US survey foot"]),
        (METRIC, 1, 1, []),
    ],
)
@pytest.mark.parametrize("suffix", [".tif", ".asc"])
def test_local_systems_have_units(tmp_path, crs, unit_m, height_m, noted, suffix):
    path = tmp_path / f"m{suffix}"
    if suffix == ".tif":
        write(path, 100 + SLOPE, crs=crs, place=from_origin(0, 60, 10, 10))
    else:
        head = "ncols 8\nnrows 6\nxllcorner 0\nyllcorner 0\ncellsize 10\n"
        rows = [" ".join(map(str, row)) for row in (100 + SLOPE).tolist()]
        path.write_text(head + "\n".join(rows))
        path.with_suffix(".prj").write_text(crs)
    mesh, taken, notes = read(path)
    expected = np.array([[5, 5, 100], [75, 55, 147]]) * [unit_m, unit_m, height_m]
    np.testing.assert_allclose(mesh.bounds, expected)
    assert [words in note for words, note in zip(noted, notes, strict=True)] == [True] * len(noted)
    assert taken.crs == "" and "from the local system" in taken.summary
    # Windows and steps are in the coordinates of the scene.
    part, *_ = read(path, window=(0, 0, 41 * unit_m, 100 * unit_m))
    assert part.bounds[:, 0] == pytest.approx([5 * unit_m, 35 * unit_m])
    coarse, *_ = read(path, step_m=20 * unit_m)
    np.testing.assert_allclose(
        coarse.bounds[:, :2], np.array([[10, 10], [70, 50]]) * unit_m, rtol=1e-6
    )


def test_degrees_become_meters_of_the_utm_zone(tmp_path):
    east, south = np.meshgrid(np.arange(40), np.arange(60))
    place = from_origin(-58.5, -34.5, 1 / 1200, 1 / 1200)
    heights = 3.0 * east - 2.0 * south
    mesh, taken, _ = read(write(tmp_path / "m.tif", heights, crs="EPSG:4326", place=place))
    assert taken.epsg == 32721 and " from EPSG:4326" in taken.summary
    x, y, z = mesh.vertices.T
    longitude, latitude = map(np.array, transform("EPSG:32721", "EPSG:4326", x, y))
    column = (longitude + 58.5) * 1200
    row = (-34.5 - latitude) * 1200
    np.testing.assert_allclose(z, 3 * (column - 0.5) - 2 * (row - 0.5), atol=1e-6)
    assert len(mesh.faces) == 2 * 39 * 59
    middle = mesh.bounds.mean(axis=0)
    window = (*(middle[:2] - 500), *(middle[:2] + 500))
    part, *_ = read(tmp_path / "m.tif", window=window)
    assert by_place(part).items() <= by_place(mesh).items() and 11 * 11 < len(part.vertices) < 400
    coarse, *_ = read(tmp_path / "m.tif", step_m=300)
    x, y, z = coarse.vertices[np.abs(coarse.vertices[:, :2] - middle[:2]).max(axis=1) < 1000].T
    longitude, latitude = map(np.array, transform("EPSG:32721", "EPSG:4326", x, y))
    column = (longitude + 58.5) * 1200
    row = (-34.5 - latitude) * 1200
    np.testing.assert_allclose(z, 3 * (column - 0.5) - 2 * (row - 0.5), atol=0.3)
    wide = write(tmp_path / "wide.tif", crs="EPSG:4326", place=from_origin(-10, 50, 5, 1))
    with pytest.raises(LidarError, match=r"spans 40 degrees.*Set world\.epsg"):
        read(wide)
    assert read(wide, epsg=3035)[1].epsg == 3035
    with pytest.raises(LidarError, match="EPSG:1024, which is unknown to rasterio"):
        read(wide, epsg=1024)
    with pytest.raises(LidarError, match=r"EPSG:2263 \(.*not in meters"):
        read(wide, epsg=2263)


def test_what_states_no_place(tmp_path):
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        path = write(tmp_path / "m.tif", crs=None, place=())
    mesh, taken, notes = read(path)
    assert by_place(mesh)[0.5, 5.5] == 0 and by_place(mesh)[7.5, 0.5] == 47 and taken.crs == ""
    assert ["not georeferenced" in notes[0], "specify a coordinate system" in notes[1]] == [
        True,
        True,
    ]
    (tmp_path / "m.tfw").write_text("10\n0\n0\n-10\n1005\n2995\n")
    mesh, _, notes = read(path)
    assert by_place(mesh)[1005, 2995] == 0 and len(notes) == 1


def test_a_coarser_grid_has_means_without_holes_of_the_finer(tmp_path):
    heights = np.full((40, 40), 100, np.int16)
    heights[10:13, 10:13] = -9999
    heights[20:30, 20:30] = 101
    heights[:8, :8] = -9999
    path = write(tmp_path / "m.tif", heights, nodata=-9999)
    mesh, taken, _ = read(path, step_m=8)
    found = by_place(mesh)
    # Of the 16 pixels of this cell 4 are 101.
    assert found[X0 + 60, Y0 - 60] == 100.25 and found[X0 + 20, Y0 - 20] == 100
    assert set(mesh.vertices[:, 2]) == {100, 100.25, 100.5, 101}
    assert len(mesh.faces) == 2 * (81 - 4)  # of the corner without heights
    assert taken.summary.startswith("10 x 10 means of 8 m out of 40 x 40 pixels")
    window = (X0 + 20, Y0 - 60, X0 + 60, Y0 - 20)
    part = {place: z for place, z in by_place(read(path)[0]).items() if inside(place, window)}
    assert by_place(read(path, window=window)[0]) == part and len(part) == 400 - 9
    cut, *_ = read(path, window=window, step_m=5)
    assert cut.bounds[:, :2].tolist() == [[X0 + 22.5, Y0 - 57.5], [X0 + 57.5, Y0 - 22.5]]
    x, _, z = read(write(path, np.tile(np.arange(40.0), (40, 1))), step_m=7)[0].vertices.T
    np.testing.assert_allclose(z, (x - X0 - 1) / 2, atol=0.1)  # at the edge, too
    with pytest.raises(LidarError, match=r"has a pixel size of 2 m\. Set step_m to at least"):
        read(path, step_m=1)
    with pytest.raises(LidarError, match=r"extends from x 500,000 to 500,080 and from y 5,"):
        read(path, window=(0, 0, 10, 10))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_windows_beside_the_raster_are_refused(tmp_path, axis, side):
    path = write(tmp_path / "m.tif")
    window = np.array([X0, Y0 - 12, X0 + 16, Y0], float)
    assert len(read(path, window=tuple(window))[0].vertices) == SLOPE.size
    window[axis::2] += side * [16, 12][axis]
    with pytest.raises(LidarError, match="does not overlap the window"):
        read(path, window=tuple(window))


def inside(place, window):
    return all(window[i] <= place[i] <= window[i + 2] for i in (0, 1))


def test_too_large_ones_are_refused_with_what_fits(tmp_path, monkeypatch):
    path = write(tmp_path / "m.tif", np.zeros((300, 500)))
    monkeypatch.setattr(rasters, "memory_share", lambda: 2_000_000)
    with pytest.raises(LidarError) as refused:
        read(path)
    words = str(refused.value)
    window = [float(side) for side in re.search(r"window: \[(.*?)\]", words)[1].split(",")]
    step = float(re.search(r"step_m: ([\d.]+)", words)[1])
    assert "500 x 300 pixels" in words and len(words) < 300
    for options in ({"window": tuple(window)}, {"step_m": step}):
        mesh, *_ = read(path, **options)
        assert 10_000 < len(mesh.vertices) <= 20_000


def test_many_pixels_are_a_choice(tmp_path, monkeypatch):
    path = write(tmp_path / "m.tif", np.zeros((300, 500)))
    monkeypatch.setattr(rasters, "MAX_UNASKED_PIXELS", 20_000)
    with pytest.raises(
        LidarError, match="500 x 300 pixels, which would produce 0 million triangles"
    ) as refused:
        read(path)
    told = str(refused.value)
    step = yaml.safe_load(re.search(r"scene: (\[\{.*?\}\])", told)[1])[0]
    middle, whole = (yaml.safe_load(one) for one in re.findall(r"window: (\[.*?\])", told))
    assert step.pop("file") == "m.tif" and told.count("\n") == 1
    for options, least, most in (
        (step, 10_000, 20_000),
        ({"window": tuple(middle)}, 10_000, 20_000),
        ({"window": tuple(whole)}, 150_000, 150_000),
    ):
        mesh, *_ = read(path, **options)
        assert least <= len(mesh.vertices) <= most


def test_small_files_that_claim_much(tmp_path):
    options = {"width": 2_000_000, "height": 2_000_000, "count": 1, "dtype": "float32"}
    west = X0 - 1_000_000  # so that the middle of 2,000 km is in the middle of the zone
    options |= {"crs": "EPSG:25832", "transform": from_origin(west, Y0, 1, 1), "tiled": True}
    tiles = {"blockxsize": 4096, "blockysize": 4096, "sparse_ok": True, "bigtiff": "yes"}
    with rasterio.open(tmp_path / "m.tif", "w", **options, **tiles):
        pass
    with pytest.raises(LidarError, match=r"memory. Set window: \S+ \S+ \S+ \S+ in"):
        read(tmp_path / "m.tif")
    with pytest.raises(LidarError, match="has 4,000,000,000,000 pixels to average"):
        read(tmp_path / "m.tif", step_m=1000)
    mesh, *_ = read(tmp_path / "m.tif", window=(X0, Y0 - 50, X0 + 50, Y0))
    assert len(mesh.vertices) == 2500
    tiles |= {"blockxsize": 80_000, "blockysize": 80_000}
    with rasterio.open(tmp_path / "b.tif", "w", **options, **tiles):
        pass
    with pytest.raises(LidarError, match=r"has blocks of 80,000 x 80,000 pixels"):
        read(tmp_path / "b.tif", window=(X0, Y0 - 50, X0 + 50, Y0))


def test_nothing_that_a_file_names_is_opened(tmp_path):
    secret = write(tmp_path / "secret.tif", SLOPE + 1000)
    vrt = (
        '<VRTDataset rasterXSize="8" rasterYSize="6"><VRTRasterBand dataType="Float64" band="1">'
        f"<SimpleSource><SourceFilename>{secret}</SourceFilename></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )
    (tmp_path / "m.tif").write_text(vrt)
    with pytest.raises(LidarError, match="not in the GTiff format that GDAL expects"):
        read(tmp_path / "m.tif")
    path = write(tmp_path / "plain.tif")
    (tmp_path / "plain.tif.msk").write_text(vrt)
    (tmp_path / "plain.tif.aux.xml").write_text("<PAMDataset><Metadata/></PAMDataset>")
    mesh, _, notes = read(path)
    assert mesh.bounds[1, 2] == 47 and notes[0].startswith("was read without plain.tif.msk")


@pytest.mark.extended
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data(), suffix=st.sampled_from([".tif", ".asc", ".img"]))
def test_garbled_files_are_read_or_refused_in_a_line(tmp_path, data, suffix):
    whole = tmp_path / f"whole{suffix}"
    if not whole.exists():
        write(whole, driver={".asc": "AAIGrid", ".img": "HFA"}.get(suffix, "GTiff"))
    content = bytearray(whole.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=6)):
        content[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(1, len(content)))
    path = tmp_path / f"garbled{suffix}"
    path.write_bytes(content[:cut])
    try:
        read(path)
    except LidarError as error:
        assert "\n" not in str(error) and len(str(error)) < 600


def test_options_of_others_are_refused(tmp_path):
    (tmp_path / "m.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(LidarError, match=r"support step_m and window \(options of \.tif .* Remove"):
        load_meshes(tmp_path / "m.off", step_m=2, window=(0, 0, 1, 1))
    with pytest.raises(LidarError, match="is a raster, whose heights are always along z"):
        load_meshes(write(tmp_path / "m.tif"), up_axis="y")
    with pytest.raises(LidarError, match=r"window must be \[x0, y0, x1, y1\]"):
        Scenario.from_data({"scene": {"files": [{"file": "m.tif", "window": [1, 0, 0, 1]}]}})
    with pytest.raises(LidarError, match=r"support epsg \(an option of"):
        load_meshes(tmp_path / "m.off", epsg=25832)
    complex_one = write(tmp_path / "c.tif", SLOPE.astype(np.complex64))
    with pytest.raises(LidarError, match="type complex64, which cannot be read as heights"):
        read(complex_one)


def epsg_of(folder, *files, **world):
    cloud = {"precision_m": 0.001}
    data = {"scene": {"files": [*files]}, "world": world, "cloud": cloud}
    scenario = Scenario.from_data(data, folder=folder)
    return prepare(scenario).survey.epsg


def test_the_scene_has_one_coordinate_system(tmp_path):
    write(tmp_path / "west.tif")
    write(tmp_path / "east.tif", crs="EPSG:25833")
    moved = {"file": "east.tif", "translation": [-X0, 0, 0]}
    assert epsg_of(tmp_path, "west.tif") == 25832
    assert epsg_of(tmp_path, moved) is None and epsg_of(tmp_path, "west.tif", moved) == 25832
    assert epsg_of(tmp_path, {"file": "west.tif", "scale": [1, 1, 2]}) == 25832
    with pytest.raises(LidarError, match=r"west.tif in EPSG:25832, east.tif in EPSG:25833"):
        epsg_of(tmp_path, "west.tif", "east.tif")
    assert epsg_of(tmp_path, "west.tif", "east.tif", epsg=25832) == 25832


STRETCHED = {  # {system: (x and y of its corner, meters on the ground in a meter)}
    "EPSG:3857": ((1e6, 6e6), 0.678, "0.678 m"),  # 47.35 degrees north
    "EPSG:3395": ((1e6, 6e6), 0.676, "0.676 m"),
    "EPSG:5041": ((2e6, -1e6), 0.953, "0.953 m"),  # at 63 degrees north
    "EPSG:6933": ((8e5, 5.36e6), 1.0, "0.788 to 1.27 m"),
}


@pytest.mark.parametrize("crs", STRETCHED)
def test_stretched_meters_become_true_ones(tmp_path, crs):
    corner, scale, words = STRETCHED[crs]
    path = write(tmp_path / "m.tif", crs=crs, place=from_origin(*corner, 2, 2))
    mesh, taken, (note,) = read(path)
    zone = taken.epsg
    assert 32601 <= zone <= 32660
    assert (
        f"in which one meter is {words} on the ground here. It was reprojected to EPSG:{zone}"
        in note
    )
    assert taken.summary.startswith("8 x 6 pixels of ")
    assert f", EPSG:{zone} from {crs}" in taken.summary
    # Vertices are where PROJ has the middles of pixels, with the heights of the file.
    row, column = np.mgrid[:6, :8]
    x, y = corner[0] + 2 * column.ravel() + 1, corner[1] - 2 * row.ravel() - 1
    expected = np.transpose(transform(crs, f"EPSG:{zone}", x, y))
    np.testing.assert_allclose(mesh.vertices[:, :2], expected, atol=1e-4)
    np.testing.assert_array_equal(mesh.vertices[:, 2], SLOPE.ravel())
    assert upward_area(mesh) == pytest.approx(14 * 10 * scale**2, rel=0.01)


def test_true_meters_stay_and_chosen_ones_are_checked(tmp_path):
    for crs, corner in (("EPSG:3857", (1e6, 0)), ("EPSG:5041", (2e6, 2.1e6))):
        mesh, taken, notes = read(
            write(tmp_path / "a.tif", crs=crs, place=from_origin(*corner, 2, 2))
        )
        assert (taken.crs, notes) == (crs, []) and upward_area(mesh) == 140
    path = write(tmp_path / "m.tif", crs="EPSG:3857", place=from_origin(1e6, 6e6, 2, 2))
    assert read(path, epsg=25832)[1].epsg == 25832
    for epsg, message in (
        (3857, r"cannot be reprojected to world\.epsg EPSG:3857 \(.*a world map projection"),
        (3395, "a world map projection"),
        (3994, r"EPSG:3994 \(.*\), whose meter is 0\.898 m long.*Use EPSG:32632, which is true"),
    ):
        with pytest.raises(LidarError, match=message):
            read(path, epsg=epsg)


def test_a_wide_raster_of_stretched_meters_asks_for_a_system(tmp_path):
    place = from_origin(1e6, 6e6, 300_000, 50_000)
    path = write(tmp_path / "m.tif", crs="EPSG:3857", place=place)
    with pytest.raises(LidarError, match=r"spans 21\.\d+ degrees.*Set world\.epsg"):
        read(path)
    _, taken, notes = read(path, epsg=3035)
    assert taken.epsg == 3035 and notes == []
    europe = write(tmp_path / "e.tif", crs="EPSG:3035", place=from_origin(2e6, 5.5e6, 6e5, 8e5))
    (note,) = read(europe)[2]
    assert "is so wide that lengths in EPSG:3035" in note and "% at its edges" in note


def test_what_has_no_place_on_earth_is_refused(tmp_path):
    path = write(tmp_path / "m.tif", crs="IAU_2015:30110", place=from_origin(0, 1e6, 2, 2))
    with pytest.raises(
        LidarError, match=r"cannot be converted to longitude and latitude.*gdalwarp -t_srs"
    ):
        read(path)
    assert read(write(tmp_path / "m.tif", crs="IAU_2015:30110", place=()))[1] is not None


def test_systems_without_axes_along_the_ground_are_refused(tmp_path):
    path = tmp_path / "m.asc"
    head = "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    path.write_text(head + "1 2 3\n4 5 6\n")
    path.with_suffix(".prj").write_text(rasterio.crs.CRS.from_string("EPSG:4978").to_wkt())
    with pytest.raises(LidarError, match="no horizontal axes"):
        read(path)
    path.with_suffix(".prj").write_text("feet, roughly")
    with pytest.raises(LidarError, match=r"in m\.prj that PROJ cannot parse"):
        read(path)


def test_rasters_near_the_poles_are_in_polar_coordinates(tmp_path):
    place = from_origin(10, 86, 1e-4, 1e-5)
    mesh, taken, _ = read(write(tmp_path / "m.tif", crs="EPSG:4326", place=place))
    meters = 1e-4 * 111_320 * np.cos(np.radians(86)), 1e-5 * 111_660
    assert taken.epsg == 5041
    assert upward_area(mesh) == pytest.approx(7 * 5 * meters[0] * meters[1], rel=0.015)


LOWEST = float(np.finfo(np.float32).min)


@pytest.mark.parametrize(
    ("value", "options", "words"),
    [
        (LOWEST, {}, "declare it as nodata with `rio edit-info --nodata "),
        (-LOWEST, {}, "declare it as nodata with"),
        (1e20, {}, "declare it as nodata with"),
        (LOWEST, {"nodata": -9999}, "as nodata instead of -9999.0"),
    ],
)
@pytest.mark.parametrize("step_m", [None, 4.0])
def test_values_that_are_no_heights_are_named(tmp_path, value, options, words, step_m):
    heights = np.tile(np.arange(40.0, dtype=np.float32), (40, 1))
    heights[20, 20] = value
    path = write(tmp_path / "m.tif", heights, **options)
    value = float(np.float32(value))
    with pytest.raises(LidarError) as refused:
        read(path, step_m=step_m)
    told = str(refused.value)
    assert f"{path} contains the value {value!r}, which is not a valid height" in told
    assert "nodata" in told and words in told and "\n" not in told


def test_the_command_that_a_message_names_helps(tmp_path):
    heights = SLOPE.astype(np.float32)
    heights[2, 2] = LOWEST
    path = write(tmp_path / "m.tif", heights)
    with pytest.raises(LidarError) as refused:
        read(path)
    command = re.search(r"rio (edit-info --nodata \S+) m\.tif", str(refused.value))[1]
    done = CliRunner().invoke(main_group, [*command.split(), str(path)])
    assert done.exit_code == 0, done.output
    mesh, _, notes = read(path)
    assert len(mesh.faces) == 2 * (35 - 4) and notes == []
    grid = write(tmp_path / "m.asc", heights.astype(np.float64), driver="AAIGrid")
    with pytest.raises(LidarError, match=r"gdal_translate -a_nodata -3\.4"):
        read(grid)


def test_a_raster_alone_is_a_survey(tmp_path):
    _, columns = np.mgrid[:60, :60]
    heights = 100 + columns / 10.0
    x0, y0 = 2_600_000, 1_200_000
    place = from_origin(x0, y0, 2, 2)
    write(tmp_path / "hill.tif", heights, count=2, crs="EPSG:2056", place=place)
    checked = CliRunner().invoke(cli, ["check", "hill.tif"])
    assert checked.exit_code == 0, checked.output
    assert "file        hill.tif: 60 x 60 pixels of 2 m, EPSG:2056\n" in checked.output
    assert "note: hill.tif has 2 bands. Heights are read from the first band.\n" in checked.output
    built = prepare(Scenario.load(tmp_path / "hill.tif"))
    # In the middle, 1, 2 and 3 m above the ground.
    np.testing.assert_allclose(
        [pose.position for pose in built.placement.poses],
        [(x0 + 60, y0 - 60, 102.95 + above) for above in (1, 2, 3)],
    )
    assert built.survey.epsg == 2056
    assert [note for note in advice(built)[1:] if "default poses" not in note] == []
    at = np.array([x0 + 60, y0 - 60, 110]) - built.scene.origin
    cloud = Scanner(built.scene, Sensor.grid(), precision_m=0.001).sweep(tuple(at))
    x, _, z = cloud.positions.T
    assert len(cloud) > 1000
    np.testing.assert_allclose(z, 100 + ((x - x0) / 2 - 0.5) / 10, atol=0.002)
    heights[20:40, 20:40] = np.nan
    write(tmp_path / "hole.tif", heights)
    built = prepare(Scenario.load(tmp_path / "hole.tif"))
    at = np.array(built.placement.poses[0].position)
    assert np.hypot(*(at[:2] - [X0 + 60, Y0 - 60])) < 23
    assert at[2] == pytest.approx(101 + ((at[0] - X0) / 2 - 0.5) / 10)


def test_a_raster_that_states_the_wrong_system_is_refused(tmp_path):
    path = write(tmp_path / "m.tif", crs="EPSG:31467", place=from_origin(5e5, 5.4e6, 2, 2))
    with pytest.raises(LidarError, match=r"EPSG:31467 \(.*area of use \(Germany.*a_srs EPSG:CODE"):
        read(path)

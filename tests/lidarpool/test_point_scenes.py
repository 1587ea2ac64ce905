"""Point clouds as scenes: scanned again, a place gives the ranges of the real one."""

import numpy as np
import pytest
from click.testing import CliRunner

from lidarfiles import save_cloud
from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.scenario_commands import scene as command
from lidarpool.pages.opened import open_view
from lidarscenario.points.point_scene import scene_from_points
from lidarscenes.writers.scene_file import write_scene
from lidarsim import Cloud, LidarError, Noise, Pose, Scanner, Scene, load_sensor
from lidarsim.scene.files.pcd import pcd_bytes

GRID = np.mgrid[0:4:40j, 0:3:30j].reshape(2, -1).T
FAR = (500_000.0, 5_000_000.0, 100.0)


def plane(at=(0, 0, 0)):
    """Points of a rectangle that leans, in the plane z = x / 2."""
    return np.column_stack([GRID, GRID[:, 0] / 2]) + at


def written(path, points):
    if path.suffix in (".xyz", ".txt", ".asc", ".csv"):
        separator = {".csv": ",", ".asc": ";"}.get(path.suffix, " ")
        rows = np.column_stack([points, np.ones(len(points))])
        header = "" if path.suffix == ".xyz" else "x y z weight".replace(" ", separator)
        np.savetxt(path, rows, "%.9f", separator, header=header, comments="")
    elif path.suffix in (".pts", ".ptx"):
        pose = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
        start = f"{len(points)}\n"
        if path.suffix == ".ptx":
            # A point at zero would be a pulse without a return.
            points = np.maximum(points, 1e-9)
            start += f"1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{pose}"
        lines = (f"{x:.9f} {y:.9f} {z:.9f} 0.5" for x, y, z in points)
        path.write_text(start + "\n".join(lines))
    elif path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".bin":
        columns = [*points.T, np.ones(len(points))] + [np.zeros(len(points))] * ("pcd" in path.name)
        path.write_bytes(np.column_stack(columns).astype("<f4").tobytes())
    elif path.suffix in (".las", ".laz"):
        laspy = pytest.importorskip("laspy", reason="laspy is an extra")
        las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
        las.header.offsets = points[0].round()
        las.header.scales = [1e-6] * 3
        las.x, las.y, las.z = points.T
        las.write(str(path))
    else:
        o3d = load_open3d()
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        o3d.io.write_point_cloud(str(path), cloud, write_ascii="text" in path.name)
    return path


def written_with_columns(path, points, classes, intensities, colors):
    """Write points with classes, intensities and colors, as programs of each format do."""
    red, green, blue = colors.T.copy()
    if path.suffix == ".las":
        laspy = pytest.importorskip("laspy", reason="laspy is an extra")
        las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
        las.header.scales = [1e-6] * 3
        las.x, las.y, las.z = points.T
        las.classification = classes
        las.intensity = intensities
        las.red, las.green, las.blue = 257 * colors.T.astype(np.uint16)
        las.gps_time = np.arange(len(points))
        las.write(str(path))
    elif path.suffix == ".e57":
        pye57 = pytest.importorskip("pye57", reason="pye57 is an extra")
        with pye57.E57(str(path), mode="w") as file:
            x, y, z = points.T.copy()
            columns = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
            columns |= {"intensity": intensities.astype(np.float32)}
            columns |= {"colorRed": red, "colorGreen": green, "colorBlue": blue}
            file.write_scan_raw(columns, name="all")
    else:
        kinds = "f8 f8 f8 f4 u1 u1 u1 u1 f4"
        names = "x y z intensity red green blue classification curvature"
        if path.suffix == ".pcd":
            kinds = "f8 f8 f8 f4 u4 u4 f4"
            names = "x y z intensity rgb label curvature"
            packed = red.astype(np.uint32) << 16 | green.astype(np.uint32) << 8 | blue
            columns = [*points.T, intensities, packed, classes, np.ones(len(points))]
        else:
            columns = [*points.T, intensities, red, green, blue, classes, np.ones(len(points))]
        rows = np.rec.fromarrays(
            columns, np.dtype(list(zip(names.split(), kinds.split(), strict=True)))
        )
        path.write_bytes(header_of(path.suffix, rows) + content_of(path, rows))
    return path


def header_of(suffix, rows):
    kinds = [rows.dtype[name] for name in rows.dtype.names]
    if suffix == ".ply":
        types = {"f8": "double", "f4": "float", "u1": "uchar"}
        lines = [
            f"property {types[k.str[1:]]} {n}" for k, n in zip(kinds, rows.dtype.names, strict=True)
        ]
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        return "\n".join([*head, *lines, "end_header\n"]).encode()
    return "\n".join([
        "VERSION .7",
        f"FIELDS {' '.join(rows.dtype.names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", "DATA ",
    ]).encode()  # fmt: skip


def content_of(path, rows):
    if path.suffix == ".ply":
        return rows.tobytes()
    if "text" not in path.name:
        return b"binary\n" + rows.tobytes()
    lines = [" ".join(repr(value.item()) for value in row) for row in rows]
    return ("ascii\n" + "\n".join(lines) + "\n").encode()


def off_plane(scene, at=(0, 0, 0)):
    x, _, z = (scene.vertices + (scene.origin - at)).T
    return np.abs(z - x / 2).max()


@pytest.mark.extended
@pytest.mark.parametrize(
    "name",
    [
        "a.ply", "a.pcd", "text.pcd", "a.XYZ", "a.las", "a.laz", "a.txt", "a.asc", "a.csv", "a.pts",
        "a.ptx", "a.npy", "a.bin", "a.pcd.bin",
    ],
)  # fmt: skip
def test_all_formats_give_surfels_in_the_plane_of_the_points(tmp_path, name):
    path = written(tmp_path / name.lower(), plane()).rename(tmp_path / name)
    scene = scene_from_points(path, voxel_m=1e-3)
    assert scene.names == (path.stem,)
    assert len(scene.faces) == 2 * len(GRID)
    assert off_plane(scene) < 1e-5
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [4, 3, 2]], atol=0.2)


def test_points_in_one_voxel_become_one_surfel(tmp_path):
    path = written(tmp_path / "a.ply", plane())
    few = scene_from_points(path, voxel_m=0.5)
    many = scene_from_points(path)
    assert 50 <= len(few.faces) / 2 <= 100
    assert 400 < len(many.faces) / 2 < len(GRID), "by default about the spacing of the points"


@pytest.mark.extended
def test_a_place_scanned_again_has_the_ranges_of_the_real_one(tmp_path):
    real = Scene.seed()
    sensor = load_sensor("ouster/os1-64")
    scanner = Scanner(real, sensor, noise=Noise(range_m=0.005))
    sweeps = [scanner.sweep(Pose((x, y, 2))) for x, y in ((0, 0), (3, 2), (-2, 3))]
    points = np.concatenate([sweep.positions for sweep in sweeps])
    save_cloud(Cloud(points.astype(np.float64), {}), tmp_path / "scan.ply")
    write_scene(tmp_path / "place.glb", scene_from_points(tmp_path / "scan.ply"))
    pose = [(1, 2, 1.5)]
    true, again = (
        Scanner(scene, load_sensor("velodyne/vlp16")).ranges(pose)
        for scene in (real, Scene.load(tmp_path / "place.glb"))
    )
    both = np.isfinite(true) & np.isfinite(again)
    assert both.sum() > 0.9 * np.isfinite(true).sum()
    off = np.abs(true[both] - again[both])
    assert np.quantile(off, 0.5) < 0.01
    assert np.quantile(off, 0.9) < 0.1


def test_far_clouds_keep_their_digits(tmp_path):
    scene = scene_from_points(written(tmp_path / "a.ply", plane(FAR)), voxel_m=1e-3)
    assert off_plane(scene, FAR) < 1e-5
    for name in ("b.glb", "b.obj"):
        again = Scene.load(write_scene(tmp_path / name, scene))
        difference = again.vertices + again.origin - (scene.vertices + scene.origin)
        assert np.abs(difference).max() < 1e-6
    with pytest.raises(LidarError, match=r"to 0\.5 m at.* Write a .glb or .obj"):
        write_scene(tmp_path / "b.ply", scene)


def test_stray_points_make_no_large_surfels(tmp_path):
    points = np.concatenate([plane(), [[0, 0, 50], [30, 0, 0], [0, np.nan, 0]]])
    scene = scene_from_points(written(tmp_path / "a.xyz", points), voxel_m=0.1)
    sides = np.ptp(scene.vertices[scene.faces], axis=1)
    assert sides.max() <= 2 * np.sqrt(2) * 0.3 + 1e-9


# Three points in each voxel: two of class 2, and a third that is brighter.
CLASSES = np.tile([2, 2, 5], len(GRID))
INTENSITIES = np.tile([10, 20, 60], len(GRID))
COLORS = np.tile([[100, 0, 0], [100, 0, 50], [100, 0, 100]], (len(GRID), 1)).astype(np.uint8)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "text.pcd", "a.las", "a.e57"])
def test_classes_colors_and_intensities_stay_in_the_scene(tmp_path, name):
    points = plane().repeat(3, axis=0)
    path = written_with_columns(tmp_path / name, points, CLASSES, INTENSITIES, COLORS)
    notes = []
    scene_from_points(path, voxel_m=0.01, report=notes.append)
    for color in ("rgb", "intensity"):
        scene = scene_from_points(path, voxel_m=0.01, color=color, report=notes.append)
        write_scene(tmp_path / "b.glb", scene)
        again = Scene.load(tmp_path / "b.glb", colors=True, materials=True)
        assert again.triangles == 2 * len(GRID)
        (means,) = np.unique(again.colors.mean_colors(), axis=0)
        # Half of a white surface's light, and the mean of 0, 50 and 100 in linear light.
        expected = [100, 0, 64] if color == "rgb" else 3 * [188]
        assert np.abs(means.astype(int) - expected).max() <= 1
        assert scene.material_names == (() if name == "a.e57" else ("class 2",))
        assert name == "a.e57" or again.material_names == ("class 2",)
    assert f"the intensities of {path} are not stored, because a surfel" in notes[0] + notes[1]
    left_out = {"a.las": "gps_time", "a.e57": ""}.get(name, "curvature")
    assert any(note.endswith(f": {left_out}") for note in notes) == bool(left_out)


def test_the_most_frequent_class_of_each_surfel_counts(tmp_path):
    x = GRID[:, 0]
    columns = [*plane().repeat(3, axis=0).T, CLASSES]
    columns[3] = np.where((x < 2).repeat(3), 5, CLASSES)
    path = tmp_path / "a.ply"
    kinds = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("class", "u1")]
    rows = np.rec.fromarrays(columns, np.dtype(kinds))
    path.write_bytes(header_of(".ply", rows) + rows.tobytes())
    scene = scene_from_points(path, voxel_m=1e-3)
    names = np.array(scene.material_names)
    materials = scene.meshes()[0].materials
    centers = scene.vertices[scene.faces].mean(axis=1) + scene.origin
    assert names.tolist() == ["class 2", "class 5"]
    assert ((materials.index == 1) == (centers[:, 0] < 2)).all()


def test_scans_of_an_e57_are_joined_and_face_their_scanners(tmp_path):
    pye57 = pytest.importorskip("pye57", reason="pye57 is an extra")
    corner = np.array([512_345.678, 5_403_210.123, 250.0])
    wall = np.column_stack([np.zeros(len(GRID)), GRID[:, 0], GRID[:, 1]])
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # by 90 degrees, w x y z below
    path = tmp_path / "stations.e57"
    with pye57.E57(str(path), mode="w") as file:
        for side in (-3.0, 3.0):  # a wall seen from both sides, 2 m thick
            scanner = corner + np.array([side, 2, 1.5])
            face = wall + corner + np.array([side / 3, 0, 0])
            x, y, z = ((face - scanner) @ turn).T.copy()
            data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
            file.write_scan_raw(
                data, rotation=np.array([1, 0, 0, 1]) / np.sqrt(2), translation=scanner
            )
    write_scene(tmp_path / "b.glb", scene_from_points(path, voxel_m=1e-3))
    scene = Scene.load(tmp_path / "b.glb")
    quads = scene.vertices.reshape(-1, 4, 3)
    centers = quads.mean(axis=1) + scene.origin - corner
    half_thickness = np.array([1.0, 0, 0])
    expected = np.concatenate([wall - half_thickness, wall + half_thickness])
    order = np.lexsort(np.round(centers, 3).T)
    assert np.abs(centers[order] - expected[np.lexsort(np.round(expected, 3).T)]).max() < 1e-5
    normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    assert (normals[:, 0] * centers[:, 0] > 0).all(), "fronts face the scanners"


def facing(scene, at):
    """Return whether the front of each surfel faces a position."""
    quads = scene.vertices.reshape(-1, 4, 3) + scene.origin
    normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    return (normals * (at - quads.mean(axis=1))).sum(axis=1) > 0


QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # by 90 degrees about z
STATION = np.array([100.0, 200, 5])


def pcd_with_viewpoint(path, columns=()):
    """Write a plane as seen by a scanner at `STATION` that is turned by `QUARTER`."""
    half = np.sqrt(0.5)
    local = plane((2, 1, -1))
    fields = [(name, values.astype("f4")) for name, values in zip("xyz", local.T, strict=True)]
    path.write_bytes(pcd_bytes([*fields, *columns], STATION, (half, 0, 0, half), "a station"))
    return path, local @ QUARTER.T + STATION


def test_the_viewpoint_of_a_pcd_places_and_orients_surfels(tmp_path):
    path, points = pcd_with_viewpoint(tmp_path / "a.pcd")
    scene = scene_from_points(path, voxel_m=1e-3)
    centers = scene.vertices.reshape(-1, 4, 3).mean(axis=1) + scene.origin
    order = np.lexsort(np.round(centers, 3).T)
    expected = points[np.lexsort(np.round(points, 3).T)]
    np.testing.assert_allclose(centers[order], expected, atol=1e-4)
    assert facing(scene, STATION).all()


def test_vectors_of_a_pcd_are_turned_by_its_viewpoint(tmp_path):
    """The origins of rays orient surfels, rather than the position of the scanner."""
    origin = np.tile([0.0, 0, 50], (len(GRID), 1))  # in the scanner's axes
    names = ("origin_x", "origin_y", "origin_z")
    columns = [(name, values.astype("f4")) for name, values in zip(names, origin.T, strict=True)]
    path, _ = pcd_with_viewpoint(tmp_path / "a.pcd", columns)
    assert facing(scene_from_points(path, voxel_m=1e-3), STATION + np.array([0, 0, 50])).all()


@pytest.mark.parametrize("name", ["a.pcd", "a.ptx", "a.npy", "a.csv"])
def test_scenes_comparisons_and_views_have_the_same_points(tmp_path, name):
    path = tmp_path / name
    if name == "a.pcd":
        path, points = pcd_with_viewpoint(path)
    else:
        path = written(path, plane())
        points = plane()
    if name == "a.ptx":
        text = path.read_text().replace("0 0 0 1\n0.0", "100 200 5 1\n0.0")
        path.write_text(text.replace("1 0 0 0\n0 1 0 0\n", "0 1 0 0\n-1 0 0 0\n"))
        points = plane() @ QUARTER.T + STATION
    bounds = [points.min(axis=0), points.max(axis=0)]
    scene = scene_from_points(path, voxel_m=1e-3)
    np.testing.assert_allclose(scene.bounds, bounds, atol=0.2)
    recording = open_recording(path)
    compared = recording[0].returns()
    compared = compared.points if compared.pose is None else compared.in_world()
    np.testing.assert_allclose([compared.min(axis=0), compared.max(axis=0)], bounds, atol=1e-4)
    viewed = open_view(path).points
    for axis, coordinate in enumerate("xyz"):
        values = np.asarray(viewed.values(coordinate, slice(None)))
        np.testing.assert_allclose(
            [values.min(), values.max()], [bounds[0][axis], bounds[1][axis]], atol=1e-3
        )


def test_scans_of_a_ptx_are_joined_and_face_their_scanners(tmp_path):
    wall = np.column_stack([np.zeros(len(GRID)), GRID[:, 0], GRID[:, 1]])
    text = ""
    for side in (-3.0, 3.0):  # a wall seen from both sides, 2 m thick
        scanner = np.array([side, 2, 1.5])
        local = (wall + np.array([side / 3, 0, 0]) - scanner) @ QUARTER
        axes = "0 1 0\n-1 0 0\n0 0 1\n"
        position = " ".join(map(str, scanner))
        transformation = "".join(f"{line} 0\n" for line in axes.split("\n")[:3])
        text += f"40\n30\n{position}\n{axes}{transformation}{position} 1\n"
        text += "".join(f"{x:.9f} {y:.9f} {z:.9f} 0.5\n" for x, y, z in local)
    (tmp_path / "a.ptx").write_text(text)
    scene = scene_from_points(tmp_path / "a.ptx", voxel_m=1e-3)
    centers = scene.vertices.reshape(-1, 4, 3).mean(axis=1) + scene.origin
    assert len(centers) == 2 * len(GRID) and np.abs(np.abs(centers[:, 0]) - 1).max() < 1e-4
    sides = np.where(centers[:, :1] < 0, [[-3.0, 2, 1.5]], [[3.0, 2, 1.5]])
    assert facing(scene, sides).all()


def reds(scene):
    """Return the red of surfels, and their x."""
    centers = scene.vertices[scene.faces].mean(axis=1) + scene.origin
    return scene.meshes()[0].colors.mean_colors()[:, 0].astype(int), centers[:, 0]


def ptx_scan(x, cells):
    """Return the text of a scan of a wall at x whose points end with `cells`."""
    head = "40\n30\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    return head + "".join(f"{x} {y:.6f} {z:.6f} {cells}\n" for y, z in GRID + 1)


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("first", "second", "quantity"),
    [("0.5 200 200 200", "0.5", "color"), ("0.5 200 200 200", "0.5 0 0 0", "color"),
     ("0.5", "0", "intensity")],
)  # fmt: skip
def test_what_one_of_two_scans_lacks_is_gray(tmp_path, first, second, quantity):
    path = tmp_path / "a.ptx"
    path.write_text(ptx_scan(1, first) + ptx_scan(50, second))
    notes = []
    scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
    red, x = reds(scene)
    assert (red[x < 10] == (200 if quantity == "color" else 255)).all()
    assert (red[x > 10] == 188).all()
    assert any(f"1,200 of 2,400 points have no {quantity}. Surfels" in note for note in notes)


def pts_cloud(x, cells):
    """Return the text of a cloud of a wall at x whose points end with `cells`."""
    return f"{len(GRID)}\n" + "".join(f"{x} {y:.6f} {z:.6f} {cells}\n" for y, z in GRID + 1)


@pytest.mark.parametrize("second", ["100", "100 0 0 0"])
def test_clouds_of_a_pts_without_colors_are_gray(tmp_path, second):
    path = tmp_path / "a.pts"
    path.write_text(pts_cloud(1, "100 200 200 200") + pts_cloud(50, second))
    notes = []
    red, x = reds(scene_from_points(path, voxel_m=1e-3, report=notes.append))
    assert (red[x < 10] == 200).all() and (red[x > 10] == 188).all()
    assert any("1,200 of 2,400 points have no color. Surfels" in note for note in notes)


def ply_with(path, **columns):
    """Write a plane with further columns of real numbers."""
    columns = {**dict(zip("xyz", plane().T, strict=True)), **columns}
    kinds = [(name, "f4") for name in columns]
    rows = np.rec.fromarrays([*columns.values()], np.dtype(kinds))
    path.write_bytes(header_of(".ply", rows) + rows.tobytes())
    return path


def test_the_first_column_with_values_is_used_and_others_are_named_as_in_the_file(tmp_path):
    values = np.where(GRID[:, 0] < 2, 50.0, 100.0)
    path = ply_with(
        tmp_path / "a.ply",
        intensity=np.zeros(len(GRID)),
        reflectivity=values,
        Label=np.full(len(GRID), 3.0),
        scalar_Classification=np.full(len(GRID), 2.0),
        Ring=values,
        Empty=np.zeros(len(GRID)),
    )
    notes = []
    scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
    red, x = reds(scene)
    assert (red[x < 1.9] == 188).all() and (red[x > 2.1] == 255).all()
    assert scene.material_names == ("class 2",)
    skipped = f"{path} has data that surfels cannot store, which were skipped: "
    assert notes == [f"{skipped}Label, Ring"]


def test_origins_that_are_zero_are_not_named_as_skipped(tmp_path):
    zeros = dict.fromkeys(["origin_x", "origin_y", "origin_z"], np.zeros(len(GRID)))
    notes = []
    scene_from_points(ply_with(tmp_path / "a.ply", **zeros), voxel_m=1e-3, report=notes.append)
    assert not notes


def test_packed_colors_are_read_in_all_formats(tmp_path):
    rows = np.zeros(len(GRID), [("x", "f8"), ("y", "f8"), ("z", "f8"), ("rgb", "u4")])
    for axis, values in zip("xyz", plane().T, strict=True):
        rows[axis] = values
    rows["rgb"] = 200 << 16 | 100 << 8 | 50
    np.save(tmp_path / "a.npy", rows)
    scene = scene_from_points(tmp_path / "a.npy", voxel_m=1e-3)
    assert np.unique(scene.meshes()[0].colors.mean_colors(), axis=0).tolist() == [[200, 100, 50]]


def test_parts_of_a_las_are_one_cloud(tmp_path, monkeypatch):
    """Zeros in one of the parts are values, and points at zero are points."""
    points = np.concatenate([plane((1, 0, 0)), np.zeros((20, 3))])
    count = len(points)
    intensities = np.where(np.arange(count) < 600, 0, 100)
    classes = np.where(np.arange(count) % 2, 2, 7)
    colors = np.zeros((count, 3), np.uint8)
    path = written_with_columns(tmp_path / "a.las", points, classes, intensities, colors)

    def made():
        notes = []
        scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
        return scene.vertices.tolist(), reds(scene)[0].tolist(), scene.material_names, notes

    whole = made()
    monkeypatch.setattr("lidarfiles.clouds.las.CHUNK_POINTS", 500)
    assert made() == whole
    vertices, red, names, notes = whole
    assert len(vertices) == 4 * (600 + 1), "the points at zero share a voxel"
    assert set(red) == {0, 255} and names == ("class 2",)
    assert notes[0].startswith(f"{path}: 610 noise points") and len(notes) == 2
    assert notes[1].endswith("which were skipped: gps_time")


def test_too_many_points_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = written(tmp_path / "a.las", plane())
    monkeypatch.setattr("lidarscenario.points.point_files.memory", lambda: 100_000)
    monkeypatch.setattr("laspy.LasReader.read_points", None)
    with pytest.raises(LidarError, match=r"a\.las: it has 1,200 points, which require 820\.31 kiB"):
        scene_from_points(path)


def test_a_parquet_file_is_a_scene(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is an extra")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {**dict(zip("xyz", plane().T, strict=True)), "classification": np.full(len(GRID), 5)}
    columns["t"] = np.arange(len(GRID))
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table(columns), path, row_group_size=500)
    notes = []
    scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
    assert scene.triangles == 2 * len(GRID) and off_plane(scene) < 1e-5
    assert scene.material_names == ("class 5",)
    assert len(notes) == 1 and notes[0].endswith("which were skipped: t")


def test_classes_of_semantic_kitti_become_materials(tmp_path):
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "labels").mkdir()
    path = written(tmp_path / "velodyne/000000.bin", plane())
    np.full(len(GRID), 40, "<u4").tofile(tmp_path / "labels/000000.label")
    assert scene_from_points(path, voxel_m=1e-3).material_names == ("class 40",)


def leica_file(path, intensities):
    """Write points with intensities."""
    rows = np.column_stack([plane(), intensities])
    if path.suffix == ".ply":
        kinds = [(name, "f8") for name in ("x", "y", "z", "intensity")]
        records = np.rec.fromarrays(rows.T, np.dtype(kinds))
        path.write_bytes(header_of(".ply", records) + records.tobytes())
    else:
        header = "x y z intensity" if path.suffix == ".txt" else ""
        np.savetxt(path, rows, "%.6f %.6f %.6f %.0f", header=header, comments="")
    return path


@pytest.mark.parametrize("name", ["a.ply", "a.txt", "a.pts"])
def test_intensities_of_leica_begin_at_zero(tmp_path, name):
    intensities = np.where(GRID[:, 0] < 2, 2047, 0)
    intensities[0] = -2048
    notes = []
    scene = scene_from_points(
        leica_file(tmp_path / name, intensities), voxel_m=1e-3, report=notes.append
    )
    red, x = reds(scene)
    assert (red[x > 2] == 188).all() and set(red[x < 2].tolist()) == {0, 255}
    assert notes == []


def test_negative_intensities_of_an_unknown_scale_are_noted(tmp_path):
    """Such as reflectances in decibels."""
    intensities = np.where(GRID[:, 0] < 2, 5, -10)
    intensities[0] = -25
    path = leica_file(tmp_path / "a.ply", intensities)
    notes = []
    red, x = reds(scene_from_points(path, voxel_m=1e-3, report=notes.append))
    assert (red[x > 2] == 188).all() and set(red[x < 2].tolist()) == {0, 255}
    scale = "has intensities from -25 to 5 on an unknown scale"
    assert notes == [f"{path} {scale}. They were shifted so that -25 becomes 0"]


def test_all_clouds_of_a_pts_have_the_same_scale(tmp_path):
    path = tmp_path / "a.pts"
    for side, intensity in ((-1.0, -1024), (1.0, 0)):  # the second has no negative intensity
        with path.open("a") as file:
            points = plane((20 * side, 0, 0))
            file.write(f"{len(points)}\n")
            file.writelines(f"{x:.6f} {y:.6f} {z:.6f} {intensity}\n" for x, y, z in points)
    red, x = reds(scene_from_points(path, voxel_m=1e-3))
    assert (red[x < 0] == 188).all() and (red[x > 0] == 255).all()
    intensities = open_recording(path)[0].intensity
    np.testing.assert_array_equal(np.unique(intensities), [1024, 2048])


def test_empty_cells_are_missing_intensities_and_classes(tmp_path):
    is_known = GRID[:, 0] < 2
    rows = [
        f"{x:.6f},{y:.6f},{z:.6f}," + ("100,2" if known else ",")
        for (x, y, z), known in zip(plane(), is_known, strict=True)
    ]
    path = tmp_path / "a.csv"
    path.write_text("x,y,z,intensity,class\n" + "\n".join(rows))
    notes = []
    scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
    red, x = reds(scene)
    assert (red[x < 2] == 255).all() and (red[x > 2.5] == 188).all()
    names = np.array(scene.meshes()[0].materials.names)[scene.meshes()[0].materials.index]
    assert (names == np.where(x < 2, "class 2", "")).all()
    assert [note.partition(" have no ")[2].split(".")[0] for note in notes] == [
        "class", "intensity",
    ]  # fmt: skip


def test_a_cloud_without_points_takes_no_columns_away(tmp_path):
    path = written(tmp_path / "a.pts", plane())
    path.write_text("0\n" + path.read_text())
    assert (open_recording(path)[0].intensity == 0.5).all()


def test_pulses_without_a_return_are_left_out_with_a_note(tmp_path):
    points = np.concatenate([plane((1, 0, 0)), np.zeros((20, 3))])
    notes = []
    path = written(tmp_path / "a.npy", points)
    scene = scene_from_points(path, voxel_m=1e-3, report=notes.append)
    assert scene.triangles == 2 * len(GRID)
    assert notes == [f"20 points of {path} at the origin were skipped as pulses without a return"]


def test_units_of_a_header_are_converted_with_a_note(tmp_path):
    path = written(tmp_path / "a.csv", plane() * 1000)
    path.write_text(path.read_text().replace("x,y,z", "x_mm,y_mm,z_mm"))
    notes = []
    scene = scene_from_points(path, report=notes.append)
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [4, 3, 2]], atol=0.2)
    assert (
        "was converted to meters, because its header states units of 0.001, 0.001, 0.001 m"
        in notes[0]
    )
    meters = scene_from_points(path, unit="cm", report=notes.append)
    np.testing.assert_allclose(meters.bounds, [[0, 0, 0], [40, 30, 20]], atol=2)
    np.testing.assert_allclose(open_recording(path)[0].points.max(axis=0), [4, 3, 2])
    points = open_recording(path, unit="m")[0].points
    np.testing.assert_allclose(points.max(axis=0), [4000, 3000, 2000])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.ply", "`color` cannot be 'intensity', because .* has no intensities"),
        ("a.xyz", "has no intensities"),
    ],
)
def test_missing_intensities_are_an_error(tmp_path, name, words):
    with pytest.raises(LidarError, match=words):
        scene_from_points(written(tmp_path / name, plane()), color="intensity")


def test_columns_without_names_are_noted(tmp_path):
    notes = []
    scene_from_points(written(tmp_path / "a.xyz", plane()), voxel_m=0.1, report=notes.append)
    assert len(notes) == 1 and notes[0].endswith("which were skipped: column_4")
    rows = "\n".join(f"wall {x} {y} {z} 7" for x, y, z in plane())
    (tmp_path / "b.csv").write_text("kind,x,y,z,gps\n" + rows.replace(" ", ","))
    scene_from_points(tmp_path / "b.csv", voxel_m=0.1, report=notes.append)
    assert len(notes) == 2 and notes[1].endswith("which were skipped: gps, kind")


@pytest.mark.parametrize("name", ["a.ply", "text.ply", "a.pcd", "text.pcd", "a.las", "a.laz"])
def test_cut_files_are_refused(tmp_path, name):
    path = written(tmp_path / name, plane())
    data = path.read_bytes()
    for share in (0, 0.01, 0.5, 0.98):
        path.write_bytes(data[: int(share * len(data))])
        expected = f"is truncated: |{path}: it is empty" if share < 0.001 else "is truncated: "
        with pytest.raises(LidarError, match=expected):
            scene_from_points(path)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.xyz", "", "a.xyz: it is empty"),
        ("a.xyz", "1 2 3\n" * 11, "must have at least 12 points, but has 11.$"),
        ("a.xyz", "1 2 3\n" * 50, "Most points of .* have the same positions"),
        ("a.xyz", "nan 2 3\n" * 50, "but has 0"),
        ("a.xyz", "x y z\n" * 50, "cannot be read: line 2 has 'x' as x, but a number"),
        ("a.asc", "ncols 3\n" * 50, "cannot be read: it is an elevation raster"),
        ("a.pts", "50\n1 2 3\n", "is truncated: line 1 declares 50 points, but 1 follow"),
        ("a.bin", "no floats", r"cannot be read: a\.bin has 9 bytes, but a multiple of 16"),
        ("a.xyz", "1 2 1e30\n" * 50, "farther than anything"),
        ("a.glb", "glTF", "point clouds must have one"),
        ("b.ply", None, "cannot be read"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, name, text, words):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(LidarError, match=words):
        scene_from_points(path)


def test_the_command_says_what_is_not_kept(tmp_path):
    columns = [*plane().T, np.ones(len(GRID))]
    rows = np.rec.fromarrays(
        columns, np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("intensity", "f4")])
    )
    (tmp_path / "a.ply").write_bytes(header_of(".ply", rows) + rows.tobytes())
    arguments = ["points", str(tmp_path / "a.ply"), str(tmp_path / "b.obj")]
    outcome = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert (
        "note: " in outcome.stderr and "b.obj cannot store the colors and classes" in outcome.stderr
    )


def test_too_many_points_are_refused(tmp_path, monkeypatch):
    path = written(tmp_path / "a.ply", plane())
    monkeypatch.setattr("lidarscenario.points.point_scene.memory", lambda: 1_000_000)
    with pytest.raises(LidarError, match=r"1,200 surfels, .* Increase `voxel_m`, which is 0.01"):
        scene_from_points(path, voxel_m=0.01)
    assert len(scene_from_points(path, voxel_m=0.3).faces) < 2 * 500


def test_a_huge_number_of_records_is_refused_at_once(tmp_path):
    path = written(tmp_path / "a.las", plane())
    data = bytearray(path.read_bytes())
    data[100:104] = b"\xff\xff\xff\x7f"
    path.write_bytes(data)
    with pytest.raises(
        LidarError,
        match="header declares 2,147,483,647 variable-length",
    ):
        scene_from_points(path)


def test_the_command(tmp_path):
    path = written(tmp_path / "a.ply", plane())
    out = tmp_path / "b.glb"
    arguments = ["points", str(path), str(out)]
    CliRunner().invoke(command, [*arguments, "--voxel-m", "0.001"], catch_exceptions=False)
    assert Scene.load(out).triangles == 2 * len(GRID)
    with pytest.raises(LidarError, match="exists"):
        CliRunner().invoke(command, arguments, catch_exceptions=False)
    with pytest.raises(LidarError, match=r"size must be a positive number, but is -1.0"):
        arguments += ["--size", "-1", "--overwrite"]
        CliRunner().invoke(command, arguments, catch_exceptions=False)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["room-scan", "building-3", "tree-1", "car-2", "ground", "scan"])
def test_only_generated_scenes_are_painted(tmp_path, name):
    path = written(tmp_path / f"{name}.ply", plane())
    out = tmp_path / "b.glb"
    CliRunner().invoke(command, ["points", str(path), str(out)], catch_exceptions=False)
    scene = Scene.load(out, colors=True)
    assert scene.names == (name,)
    assert not scene.has_colors.any(), "gray, 188"
    city = tmp_path / "city.glb"
    CliRunner().invoke(command, ["city", str(city), "--triangles", "5000"], catch_exceptions=False)
    assert Scene.load(city, colors=True).has_colors.all()

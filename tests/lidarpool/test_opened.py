"""The viewer opens whatever lidarpool reads or writes: exports, recordings, meshes, scenarios."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tests.drives import points_of, the_scene, the_sweeps, write_set
from tests.e57_files import write_scans

from lidarfiles import save_cloud
from lidarfiles.clouds import las
from lidarfiles.clouds.ros import bags
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.result_commands import view as view_command
from lidarpool.pages import recorded
from lidarpool.pages.job_list import JobList
from lidarpool.pages.opened import growing_view, is_data_set, open_view, open_views
from lidarsim import LidarError, Mounted, Noise, Pose, Scene, Sensor, Survey, Track, box
from lidarsim.columns.ply_format import header
from lidarsim.columns.table import SCAN
from lidarsim.io.storage import Storage
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps
from lidarview.viewer.sharing import render_page
from lidarview.viewer.view import IN_SENSOR_AXES, View

FORMATS = (
    "las", "laz", "parquet", "pcd", "images", "e57", "kitti", "nuscenes", "webdataset", "mcap",
    "rosbag2",
)  # fmt: skip
BAGS = ("mcap", "rosbag2")
UNCOMPENSATED = ("pcd",)  # without times of sweeps, points are placed at the start of the sweep
CLOUDS = ("las", "laz", "parquet")  # without sweeps
COLUMNS = ["ray", "range", "intensity", "reflectivity", "class", "time", "normal_x", "normal_y"]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the folder of a survey of two sensors on a carrier in all formats, and its points."""
    folder = tmp_path_factory.mktemp("exported")
    scene = Scene.from_meshes([box("Floor", (30, 30, 0.1)), box("Wall", (1, 20, 6))])
    sensor = Sensor.grid(layers=6)
    sensors = [Mounted(sensor, name="roof"), Mounted(sensor, Pose((1, 0, 0)), name="nose")]
    survey = Survey(
        sensors=sensors,
        trajectory=Track([0, 0.3], [[-9, -9, 3], [-5, -5, 3.0]]),
        columns=[*COLUMNS, "normal_z"],
        noise=Noise(range_m=0.01),
    )
    rig = Rig(scene, survey)
    part = columns_of([*rig.cast(0, survey.scan_count)])
    table = [column for column in survey.stored_columns if column.name not in "xyz"]

    cloud = part.cloud((SCAN, *table), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    cloud = replace(cloud, sweeps=lambda: sweeps)
    for name in FORMATS:
        written = ExportSpec(name)
        written.write(folder / written.row.file, cloud, sweeps)
    return folder, cloud, sweeps


def state_of(view):
    header, _ = view.answer("state", {}, bool)
    return header


@pytest.mark.parametrize("name", FORMATS)
def test_each_format_is_opened_at_its_place_with_its_sweeps(exported, name):
    folder, cloud, sweeps = exported
    view = open_view(folder / ExportSpec(name).row.file)
    state = state_of(view)
    names = {column["name"] for column in state["columns"]}
    sensors = 1 if name == "kitti" else 2
    assert {"x", "y", "z"} <= names
    if name == "kitti":
        assert 0.4 < len(view.points) / len(cloud) < 0.6
        assert "first of 2 sequences" in state["note"]
    else:
        assert len(view.points) == len(cloud)
    assert name in ("kitti", "nuscenes", "e57", *BAGS) or {"intensity", "normal_z"} <= names
    if name in CLOUDS:
        assert view.sweeps is None and not state["note"]
    elif name in UNCOMPENSATED:
        assert "contains points as fired, but not the times of its sweeps." in state["note"]
    else:
        assert len(view.sweeps) == 3 * sensors and len(sweeps) == 6
    if name == "kitti":  # whose poses start at the first of each sequence
        return
    found = np.stack([view.points.values(axis, slice(None)) for axis in "xyz"], axis=1)
    expected = np.asarray(cloud)
    tolerance_m = 2 if name in UNCOMPENSATED else 2e-3
    for axis in range(3):  # the order of sweeps of one time differs
        a, b = np.sort(found[:, axis]), np.sort(expected[:, axis])
        np.testing.assert_allclose(a, b, atol=tolerance_m)


@pytest.mark.parametrize("name", ["nuscenes", "webdataset", "mcap"])
def test_a_recording_is_played_sweep_by_sweep(exported, name):
    folder, cloud, _ = exported
    view = open_view(folder / ExportSpec(name).row.file)
    assert state_of(view)["duration"] == pytest.approx(0.3, abs=0.01)
    assert len(view.sensors) == 2 and view.sweeps.begins_ns.max() == pytest.approx(2e8, rel=0.01)
    counts = [
        view.answer("points", {"color": "z", "most": "100000", "scans": f"{k}-{k}"}, bool)[0][
            "count"
        ]
        for k in range(6)
    ]
    assert sum(counts) == len(cloud) and min(counts) > 100
    image = view.answer("range", {"sweep": "3"}, bool)[1]["image"]
    assert image.shape[0] > 1 and image.any()


def test_a_sweep_alone_and_what_is_too_much_for_memory(exported, monkeypatch):
    folder, cloud, _ = exported
    one = open_view(folder / "kitti" / "sequences" / "00" / "velodyne" / "000001.bin")
    assert 0 < len(one.points) < len(cloud) / 5 and "object" in one.columns
    monkeypatch.setattr(recorded, "MAX_POINTS", len(cloud) // 3)
    assert len(open_view(folder / "cloud.las").points) == pytest.approx(len(cloud) / 3, abs=2)
    note = state_of(open_view(folder / "pcd"))["note"]
    assert "of 6 sweeps are shown" in note


def growth_of(view):
    """Wait until all points of a growing view are read; return its last answer."""
    deadline = time.monotonic() + 60
    while True:
        growth, _ = view.answer("growth", {}, bool)
        if growth["complete"] or growth["error"]:
            return growth
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_a_large_cloud_is_shown_by_a_sample_until_it_is_read(exported, monkeypatch, name, tmp_path):
    folder, cloud, _ = exported
    assert growing_view(folder / name) is None, "it is small"
    assert growing_view(folder / "cloud.e57") is None
    monkeypatch.setattr(recorded, "LARGE_POINTS", 1000)
    monkeypatch.setattr(recorded, "_SAMPLE_POINTS", 4000)
    view = growing_view(folder / name)
    state = state_of(view)
    assert state["growing"] and state["points"] == len(cloud) and not state["exports"]
    asked = {"color": "z", "most": "100000"}
    assert view.answer("points", asked, bool)[0]["count"] == 4000
    growth = growth_of(view)
    assert (growth["complete"], growth["error"], growth["share"]) == (True, "", 1.0)
    grown = state_of(view)
    assert "growing" not in grown and grown["version"] > state["version"]
    assert grown["exports"] and not grown["note"]
    assert view.answer("points", asked, bool)[0]["count"] == len(cloud)
    content = (folder / name).read_bytes()
    (tmp_path / name).write_bytes(content)
    view = growing_view(tmp_path / name)
    (tmp_path / name).write_bytes(content[: len(content) // 2])
    view.answer("points", asked, bool)
    assert "is truncated" in growth_of(view)["error"]


def test_more_points_of_a_large_cloud_are_shown_while_it_is_read(exported, monkeypatch):
    folder, cloud, _ = exported
    monkeypatch.setattr(recorded, "LARGE_POINTS", 1000)
    monkeypatch.setattr(recorded, "_SAMPLE_POINTS", 400)
    monkeypatch.setattr(las, "CHUNK_POINTS", -(-len(cloud) // 2))
    view = growing_view(folder / "cloud.las")
    seen = []
    replace_points = View.replace_points

    def record(self, points, **options):
        replace_points(self, points, **options)
        growth, _ = view.answer("growth", {}, bool)
        seen.append((growth["share"], len(points)))

    monkeypatch.setattr(View, "replace_points", record)
    view.answer("points", {"color": "z", "most": "100000"}, bool)
    assert growth_of(view)["version"] > 1
    half = -(-len(cloud) // 2)
    assert seen[:2] == [(0.5, 400 + half), (1.0, 400 + len(cloud))]


def test_scans_of_stations_are_named_and_do_not_move(tmp_path):
    scene = Scene.from_meshes([box("Floor", (30, 30, 0.1))])
    survey = Survey(Sensor.grid(layers=6), [Pose((k, 0, 2)) for k in (0, 3, 6)])
    rig = Rig(scene, survey)
    part = columns_of([*rig.cast(0, survey.scan_count)])
    table = [column for column in survey.stored_columns if column.name not in "xyz"]
    sweeps = Sweeps.from_survey(survey, scene)
    cloud = part.cloud((SCAN, *table), survey.precision_m, scene.origin)
    cloud = replace(cloud, sweeps=lambda: sweeps)
    save_cloud(cloud, tmp_path / "own.e57")
    points = {f"cartesian{axis}": (np.arange(3.0), "double") for axis in "XYZ"}
    pose = {"translation": {"x": 5.0, "y": 0.0, "z": 0.0}}
    other = [{"fields": points, "name": "Gate"}, {"fields": points, "name": "", "pose": pose}]
    write_scans(tmp_path / "other.e57", other)
    expected = {
        "own.e57": ["", "station 1", "station 2", "station 3"],
        "other.e57": ["", "Gate", "station 2"],
    }
    for name, stations in expected.items():
        view = open_view(tmp_path / name)
        state = state_of(view)
        assert state["stations"] == stations and not state["note"], name
        assert [sensor["moves"] for sensor in state["sensors"]] == [False]
        numbers = view.shown_points.values("station", slice(None))
        assert np.unique(numbers).tolist() == list(range(1, len(stations)))
        assert "station" in state["colors"]


def test_files_of_other_programs(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "my.quality")
    )
    (tmp_path / "text.ply").write_text(text + "end_header\n0 0 0 1\n1 2 3 4\n")
    view = open_view(tmp_path / "text.ply")
    assert len(view.points) == 2 and "my_quality" in view.columns
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = np.arange(12.0).reshape(3, 4)
    las.classification = np.array([2, 2, 6, 5], np.uint8)
    las.write(tmp_path / "flown.las")
    legend = open_view(tmp_path / "flown.las").answer(
        "points", {"color": "class", "most": "9"}, bool
    )[0]["legend"]
    assert [label[0] for label in legend["labels"]] == ["ground", "high vegetation", "building"]


@pytest.mark.parametrize(("comment", "epsg"), [("comment crs: EPSG:25832\n", 25832), ("", None)])
def test_the_coordinate_system_of_a_file_is_told(tmp_path, comment, epsg):
    head = f"ply\nformat ascii 1.0\n{comment}element vertex 1\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"{head}end_header\n500000 5400000 3\n")
    assert state_of(open_view(tmp_path / "a.ply"))["epsg"] == epsg


@pytest.mark.extended
def test_a_mesh_and_a_scenario_are_previews_of_their_run(tmp_path):
    (tmp_path / "wall.obj").write_text("v 5 -5 0\nv 5 5 0\nv 5 5 4\nv 5 -5 4\nf 1 2 3 4\n")
    (tmp_path / "drive.yaml").write_text(
        """scene: wall.obj
sensors:
  roof: {model: velodyne/vlp16, mount: {position: [0, 0, 1]}}
  nose: velodyne/vlp16
trajectory:
  points:
    - {time_s: 0, position: [0, 0, 1]}
    - {time_s: 1, position: [2, 0, 1]}
actors: [{name: Van, box: [1, 1, 1], at: [3, 1, 0.5]}]
"""
    )
    view = open_view(tmp_path / "drive.yaml")
    state = state_of(view)
    assert state["preview"] and "before the run" in state["note"] and not state["exports"]
    assert [sensor["name"] for sensor in state["sensors"]] == ["roof", "nose"]
    assert [actor["name"] for actor in state["actors"]] == ["Van"]
    scans = np.unique(view.points.values("scan", slice(None)))
    first_sweeps = {0, int(view.sweeps.scans[np.flatnonzero(view.sweeps.sensor == 1)[0]])}
    assert first_sweeps <= {*scans.tolist()} and len(view.points) > 100
    assert len(view.sweeps) > 10, "all sweeps can be played"
    mesh = open_view(tmp_path / "wall.obj")
    assert state_of(mesh)["preview"] and len(mesh.pictured.scene.faces) == 2
    assert len(render_page(mesh)) > 10_000  # in all colors, also of hits, of which there are none
    (tmp_path / "campaign.yaml").write_text(
        """base: drive.yaml
count: 3
vary: {sensors.roof.mount.position.2: {uniform: [1, 2]}}
keep: kitti
"""
    )
    assert "of 3 in the campaign" in state_of(open_view(tmp_path / "campaign.yaml"))["note"]


def test_a_mesh_in_a_ply_is_no_cloud(tmp_path, exported):
    text = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "mesh.ply").write_text(text + faces + "0 0 0\n4 0 0\n0 4 0\n3 0 1 2\n")
    assert open_view(tmp_path / "mesh.ply").preview
    save_cloud(exported[1], tmp_path / "cloud.ply")
    assert not open_view(tmp_path / "cloud.ply").preview


def test_text_of_points_is_a_cloud_and_a_raster_of_heights_is_a_scene(tmp_path):
    points = "\n".join(f"{x};{y};0;{x * y}" for x in range(4) for y in range(3))
    (tmp_path / "scan.asc").write_text("X;Y;Z;Intensity\n" + points)
    view = open_view(tmp_path / "scan.asc")
    assert len(view.points) == 12 and not view.preview
    assert view.points.values("intensity", slice(None)).max() == 6
    with pytest.raises(
        LidarError, match=r"If it is a point cloud, convert it to a mesh with lidarpool "
    ):
        Scene.load(tmp_path / "scan.asc")
    pytest.importorskip("rasterio", reason="rasterio is an extra")
    heights = "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n4 5 6\n"
    (tmp_path / "heights.asc").write_text(heights)
    assert open_view(tmp_path / "heights.asc").preview


@pytest.fixture
def nuscenes(exported, tmp_path):
    """A copy of the data set of nuScenes, with its table of sweeps."""
    folder, *_ = exported
    shutil.copytree(folder / "nuscenes", tmp_path / "nuscenes")
    return tmp_path / "nuscenes", tmp_path / "nuscenes" / "v1.0-lidarpool" / "sample_data.json"


def test_one_of_several_versions_of_nuscenes_is_asked_for(nuscenes):
    root, table = nuscenes
    sweeps = len(open_recording(root, "LIDAR_TOP"))
    shutil.copytree(table.parent, root / "v1.0-mini")
    mini = root / "v1.0-mini" / "sample_data.json"
    mini.write_text(json.dumps(json.loads(table.read_text())[:1]))
    for open_it in (open_recording, open_view):
        with pytest.raises(LidarError) as told:
            open_it(root)
        assert str(told.value) == (
            f"{root} contains several versions of nuScenes: v1.0-lidarpool, v1.0-mini. Specify the "
            f"folder of one version, for example {root}/v1.0-lidarpool."
        )
    assert len(open_recording(table.parent, "LIDAR_TOP")) == sweeps
    one = open_recording(mini.parent)
    assert len(one) == 1 and len(one[0].returns()) > 100


@pytest.mark.parametrize("name", ["../secret.bin", "{root}/../secret.bin", "samples/link.bin"])
@pytest.mark.parametrize("table", ["sample_data", "lidarseg"])
def test_tables_of_nuscenes_name_files_of_the_data_set_only(nuscenes, name, table):
    root, sample_data = nuscenes
    rows = json.loads(sample_data.read_text())
    first = min(rows, key=lambda row: row["timestamp"])
    secret = root.parent / "secret.bin"
    shutil.copy(root / first["filename"], secret)
    (root / "samples" / "link.bin").symlink_to(secret)
    name = name.format(root=root)
    if table == "sample_data":
        first["filename"] = name
        sample_data.write_text(json.dumps(rows))
    else:
        row = {"token": "1", "sample_data_token": first["token"], "filename": name}
        (sample_data.parent / "lidarseg.json").write_text(json.dumps([row]))
    with pytest.raises(LidarError) as told:
        open_recording(root, "LIDAR_TOP")[0]
    key = "token" if table == "sample_data" else "sample_data_token"
    assert str(told.value) == (
        f"{root}: v1.0-lidarpool/{table}.json, {key} {first['token']}, refers to {name!r}, which "
        "is outside the data folder. Only files in that folder are read. Copy the file there and "
        "correct the reference."
    )
    if "link" not in name:  # refused before any sweep is read
        with pytest.raises(LidarError, match="is outside the data folder"):
            open_recording(root, "LIDAR_TOP")


def test_a_sweep_of_nuscenes_has_a_label_for_each_point(nuscenes):
    root, sample_data = nuscenes
    first = min(json.loads(sample_data.read_text()), key=lambda row: row["timestamp"])
    row = {"token": "1", "sample_data_token": first["token"], "filename": "samples/labels.bin"}
    (sample_data.parent / "lidarseg.json").write_text(json.dumps([row]))
    (root / "samples" / "labels.bin").write_bytes(bytes(7))
    with pytest.raises(LidarError, match=r"labels\.bin has 7 labels for \d+ points"):
        open_recording(root, "LIDAR_TOP")[0]


def test_labels_are_classes_if_the_classification_is_zero_throughout(tmp_path):
    """LAS has a classification for each point, which many programs do not fill in."""
    kinds = dict.fromkeys("xyz", "f8") | {"classification": "u1", "label": "u1"}
    rows = np.zeros(20, [*kinds.items()])
    rows["x"] = np.arange(20)
    rows["label"] = rows["x"] % 3
    np.save(tmp_path / "a.npy", rows)
    view = open_view(tmp_path / "a.npy")
    np.testing.assert_array_equal(view.points.values("class", slice(None)), np.arange(20) % 3)


def test_single_sweeps_of_kitti_and_nuscenes_have_their_columns(tmp_path):
    rows = np.array([[1, 2, 3, 0.5, 4], [5, 6, 7, 0.25, 31]], "f4")
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "a.bin").write_bytes(rows[:, :4].tobytes())
    (tmp_path / "sweeps" / "a.pcd.bin").write_bytes(rows.tobytes())
    for path in (tmp_path / "a.bin", tmp_path / "sweeps" / "a.pcd.bin", tmp_path / "sweeps"):
        recording = open_recording(path)
        points = recording[0].returns()
        assert len(recording) == 1 and points.points.tolist() == [[1, 2, 3], [5, 6, 7]]
        assert points.intensity.tolist() == [0.5, 0.25]
        assert points.rings is None if path.name == "a.bin" else points.rings.tolist() == [4, 31]


@pytest.mark.extended
@pytest.mark.parametrize("name", BAGS)
def test_sweeps_of_a_bag_are_where_its_frames_say(exported, name, monkeypatch):
    folder, _, sweeps = exported
    view = open_view(folder / ExportSpec(name).row.file)
    assert not state_of(view)["by_sweep"] and not state_of(view)["note"]
    for number, sensor in enumerate(("roof", "nose")):
        assert view.sweeps.sensors[number] == f"/{sensor}/points"
        of_sensor = view.sweeps.sensor == number
        expected = sweeps.pose.positions[sweeps.sensor == sweeps.sensors.index(sensor)]
        np.testing.assert_allclose(view.sweeps.pose.positions[of_sensor], expected, atol=1e-4)
    monkeypatch.setattr(bags, "_MAX_DISTANCE_NS", -1)  # no pose is near enough
    state = state_of(open_view(folder / ExportSpec(name).row.file))
    assert state["by_sweep"] and IN_SENSOR_AXES in state["note"]


def test_several_files_of_different_formats_are_one_view(exported, monkeypatch):
    folder, cloud, _ = exported
    view = open_views([folder / "cloud.las", folder / "nuscenes"])
    assert len(view.points) == 2 * len(cloud) and view.results == ["cloud.las", "nuscenes"]
    monkeypatch.setattr(bags, "_MAX_DISTANCE_NS", -1)
    with pytest.raises(LidarError, match=r"cloud.mcap contains points in sensor coordinates"):
        open_views([folder / "cloud.las", folder / "cloud.mcap"])


def test_several_inputs_are_exported_to_one_page(tmp_path):
    names = [f"{folder}/cloud.xyz" for folder in ("before", "after")]
    for number, name in enumerate(names):
        (tmp_path / name).parent.mkdir()
        np.savetxt(tmp_path / name, np.arange(60.0).reshape(20, 3) + number)
    files = [str(tmp_path / name) for name in names]
    page = tmp_path / "both.html"
    done = CliRunner().invoke(view_command, [*files, "--export", str(page)])
    assert done.exit_code == 0, done.output
    assert open_views([*map(Path, files)]).results == files
    assert page.read_text() == render_page(open_views([*map(Path, files)])).decode()
    done = CliRunner().invoke(view_command, [*files, "--film", str(tmp_path / "both.gif")])
    assert "`--film` requires a single input" in str(done.exception)


def test_a_robot_is_previewed_as_it_is_scanned(tmp_path):
    (tmp_path / "arm.urdf").write_text(
        """<robot name="arm"><link name="base"><visual><geometry><box size="1 1 1"/></geometry>
        </visual></link></robot>"""
    )
    view = open_view(tmp_path / "arm.urdf")
    assert view.preview and view.pictured.scene.names == ("arm/base",) and len(view.points) > 100


def test_what_is_not_read_says_what_to_give(exported, tmp_path, monkeypatch):
    folder, _, _ = exported
    shutil.copytree(folder / "kitti" / "sequences" / "00", tmp_path / "cut")
    (tmp_path / "cut" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    shutil.copytree(folder / "kitti" / "sequences" / "00", tmp_path / "uncalibrated")
    (tmp_path / "uncalibrated" / "calib.txt").write_text("Tr: x 0 0 0 0 1 0 0 0 0 1 0\n")
    shutil.copytree(tmp_path / "cut", tmp_path / "bad")
    (tmp_path / "bad" / "poses.txt").write_text(2 * "1 0 0 0 0 1 0 0 0 0 1\n")
    shutil.copytree(folder / "kitti" / "sequences" / "00", tmp_path / "long")
    (tmp_path / "long" / "times.txt").write_text("0\n100000000\n200000000\n")
    (tmp_path / "cut.bin").write_bytes(b"123")
    (tmp_path / "cut.tar").write_bytes(b"123")
    (tmp_path / "cut.parquet").write_bytes(b"123")
    (tmp_path / "cut.e57").write_bytes(b"123")
    (tmp_path / "notes.txt").write_text("none")
    (tmp_path / "way.tum").write_text("0 1 2 3 0 0 0 1\n")
    (tmp_path / "empty").mkdir()
    for name in ("run.rrd", "gt.osi", "gt.osi.gz"):
        (tmp_path / name).write_bytes(b"RRF2")
    mcap = (folder / "cloud.mcap").read_bytes()
    (tmp_path / "osi.mcap").write_bytes(mcap.replace(b"ros2", b"osi2", 1))
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    (tmp_path / "none.ply").write_bytes(header(np.dtype(kinds), 0))
    (tmp_path / "robot.xacro").write_text("<robot/>")
    shutil.copytree(folder / "nuscenes", tmp_path / "lost")
    next((tmp_path / "lost" / "samples").rglob("*.bin")).unlink()
    for name, words in (
        ("cut", "poses.txt has no row for frames 1 to 2. It has 1 row, and row k"),
        ("bad", r"poses.txt: line 1 has 11 cells, but 12 were expected \(m00, m01"),
        ("uncalibrated", "calib.txt: line 1 has 'x' as m00, but a number was expected"),
        ("long", "They are probably nanoseconds. Specify the times in times.txt in seconds"),
        ("cut.bin", "cut.bin"),
        ("cut.tar", "cut.tar"),
        ("cut.parquet", "cut.parquet"),
        ("cut.e57", "cut.e57"),
        ("notes.txt", r"line 1 is 'none', .* If it is a trajectory, set `trajectory: FILE` "),
        (
            "way.tum",
            r"is not supported\. If it is a trajectory, set `trajectory: FILE` in a scenario",
        ),
        (
            "empty",
            r"is not supported\. Specify a result, data set, cloud, recording, scenario or mesh",
        ),
        (
            "run.rrd",
            r"is not supported\. It is a Rerun recording\. Open it with the `rerun` command",
        ),
        ("gt.osi", r"is not supported\. It is an OSI trace\. Use it as the traffic of a scenario"),
        ("gt.osi.gz", r"gt\.osi\.gz is not supported\. It is an OSI trace\. Use it as the traffic"),
        ("osi.mcap", "osi.mcap: it has no ROS 2 messages. Record PointCloud2, or set an OSI trace"),
        ("none.ply", "none.ply contains no points"),
        ("robot.xacro", "Expand it first"),
        ("lost", r"lost cannot be read: No such file or directory, .*lost/samples/.*bin"),
        ("none.las", "does not exist"),
    ):
        with pytest.raises(LidarError, match=words) as raised:
            open_view(tmp_path / name)
        assert len(str(raised.value).splitlines()) == 1
    monkeypatch.setattr("lidarsim.environment.extras.find_spec", lambda name: None)
    for name, extra in (("cloud.e57", "e57"), ("cloud.parquet", "parquet")):
        with pytest.raises(LidarError, match=rf"\.\[{extra}\]"):
            open_view(folder / name)


@pytest.mark.parametrize("kind", ["folder", "webdataset", "mcap"])
def test_a_job_with_points_as_fired_is_shown_in_world_coordinates(tmp_path, kind):
    tree = pytest.importorskip("scipy.spatial").cKDTree
    scene = the_scene()
    sweeps = the_sweeps(scene)
    truth = points_of(scene, 0)
    parts = [sweeps.as_fired(number, part) for number, part in enumerate(sweeps.points(truth))]
    fired = replace(truth, positions=np.concatenate(parts).round(4))
    data = DataSet(Storage.at(tmp_path), kind)
    row = JobRow(0, "00")
    data.write_job(row, fired, replace(sweeps, coordinates="sensor"))
    write_table(data.storage, [], lambda: [row])
    data.finish([row])
    view = JobList(tmp_path).view_of(0)
    found = np.stack([view.points.values(name, slice(None)) for name in "xyz"], axis=1)
    apart_m = tree(truth.positions).query(found)[0].max()
    assert (apart_m < 2e-3) == (kind != "mcap")
    assert ("The points are as fired" in view.note) == (kind == "mcap")


@pytest.mark.parametrize(
    ("kind", "title"),
    [("folder", "PLY"), ("kitti", "KITTI"), ("mcap", "MCAP"), ("webdataset", "WebDataset")],
)
def test_a_data_set_is_a_list_of_jobs_with_the_points_of_each(tmp_path, kind, title):
    scene = the_scene()
    write_set(tmp_path / "set", kind, scene, the_sweeps(scene))
    assert is_data_set(tmp_path / "set") and not is_data_set(tmp_path)
    jobs = JobList(tmp_path / "set")
    told, _ = jobs.answer("jobs", {}, bool)
    assert (told["count"], told["done"], told["failed"], told["over"]) == (6, 5, 1, True)
    assert told["state"] == f"data set in {title} format"
    assert [job["name"] for job in told["ended"]] == ["00", "01", "02", "04", "05"]
    assert [job["error"] for job in told["failures"]] == ["failed"]
    assert told["ended"][1]["values"] == ["0.5"] and told["names"] == ["rain"]
    for number in (0, 4):
        state, _ = jobs.answer(f"job/{number}/state", {}, bool)
        points = points_of(scene, number)
        assert state["points"] == len(points) and not state["note"]
        view = jobs.view_of(number)
        for axis, name in enumerate("xyz"):  # sweeps of one time may be in another order
            found, expected = view.points.values(name, slice(None)), np.asarray(points)[:, axis]
            np.testing.assert_allclose(np.sort(found), np.sort(expected), atol=2e-3)
        words = dict(jobs.answer(f"job/{number}/point", {"row": "0"}, bool)[0]["columns"])
        assert kind == "mcap" or words["object"] in scene.object_names
    for question in ("job/3/state", "job/9/state", "news"):
        with pytest.raises(KeyError):
            jobs.answer(question, {}, bool)
    result = CliRunner().invoke(view_command, [str(tmp_path / "set"), "--export", "page.html"])
    assert "is a data set with several jobs" in str(result.exception)

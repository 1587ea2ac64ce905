"""The same ten sweeps, read from every format that can hold them, by every feature that reads them.

What a format cannot hold is stated in `FORMATS`; everything else must be the same for all readers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarfiles import PointCloud, Recording, open_recording, save_cloud
from lidarfiles.recordings.opening import open_sensors
from lidarpool.pages.recorded import recorded_view
from lidarreal import compare
from lidarreal.comparing.fit.stack import SweepStack
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarscenario.points.point_files import read_points
from lidarsim import Material, Scene, Survey, Track, box, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import SCAN
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

pytest.importorskip("scipy", reason="the extra fit is not installed")

SWEEPS = 10
# {format: (file, package, what the format cannot hold)}. KITTI has poses relative to the first
# sweep ("origin"). Network captures have no bounds of sweeps; the decoder cuts them at an azimuth.
FORMATS = {
    "mcap": ("cloud.mcap", "rosbags", {"object"}),
    "rosbag2": ("rosbag2", "rosbags", {"object"}),
    "pcd": ("pcd", "numpy", {"stamps"}),
    "kitti": ("kitti", "numpy", {"channel", "times", "origin"}),
    "nuscenes": ("nuscenes", "numpy", {"times", "object"}),
    "webdataset": ("webdataset", "numpy", set()),
    "images": ("images", "numpy", {"stamps"}),
    "e57": ("cloud.e57", "pye57", {"channel", "stamps", "class", "object"}),
    "pcap": ("pcap/lidar.pcap", "numpy", {"poses", "class", "object", "bounds"}),
}
AS_FIRED = ("mcap", "rosbag2", "pcd", "pcap")  # others are compensated for the motion
CLOUDS = {"las": ("cloud.las", "laspy"), "parquet": ("parquet", "pyarrow")}  # without sweeps
COLUMNS = ["time", "ray", "range", "intensity", "reflectivity", "class", "return_number"]
PERIOD_NS = 100_030_464  # of the sweeps of a VLP-16 at 10 Hz
TOLERANCE_M = 0.005  # packets have steps of 2 mm


@pytest.fixture(scope="module", params=["standing", "moving"])
def result(request, tmp_path_factory):
    """Return ten sweeps of a VLP-16 in a hall, their cloud, and a folder for files."""
    ahead = 6.0 if request.param == "moving" else 0.0
    hall = [box("Floor", (40, 30, 0.1)), box("Wall", (1, 20, 6)), box("Block", (2, 3, 1))]
    scene = Scene.from_meshes(hall)
    survey = Survey(
        load_sensor("velodyne/vlp16"),
        trajectory=Track([0, 1.1], [[-9, -6, 2], [-9 + ahead, -6, 2.0]]),
        steps=SWEEPS * 36,
        columns=COLUMNS,
        materials=[
            Material("Floor", semantic_class=40),
            Material("*", semantic_class=50),
        ],
        classes={40: "road", 50: "building"},
    )
    rig = Rig(scene, survey)
    table = [column for column in survey.stored_columns if column.name not in "xyz"]
    part = columns_of([*rig.cast(0, survey.scan_count)])
    cloud = part.cloud((SCAN, *table), survey.precision_m, scene.origin)
    sweeps = Sweeps.from_survey(survey, scene)
    cloud = replace(cloud, sweeps=lambda: sweeps)
    return cloud, tmp_path_factory.mktemp(request.param), request.param == "standing"


def export(result, name):
    """Return the path of the result in a format."""
    file, package, _ = FORMATS[name]
    pytest.importorskip(package)
    cloud, folder, _ = result
    path = folder / name / file
    if not path.exists():
        (folder / name).mkdir()
        save_cloud(cloud, path.parent if name == "pcap" else path, format=name)
    return path


@pytest.fixture(params=FORMATS)
def exported(request, result):
    """Return the name of a format, the result in this format, and what the format cannot hold."""
    return request.param, export(result, request.param), FORMATS[request.param][2]


def values_of(view):
    """Return the columns that a view shows of all points."""
    names = ["x", "y", "z", *(column.name for column in view.points.table)]
    return {name: view.points.values(name, slice(None)) for name in names}


def nearest(points, reference):
    """Return the row of the nearest reference point of each point of as many points."""
    from scipy.spatial import cKDTree

    distances, rows = cKDTree(reference).query(points)
    assert distances.max() < TOLERANCE_M
    assert len(points) == len(reference)
    return rows


def test_sweeps_are_the_same_in_every_format(result, exported):
    cloud, _, stands = result
    name, path, losses = exported
    truth = open_recording(cloud)
    recording = open_recording(path)
    assert len(recording) == SWEEPS and isinstance(recording, Recording)
    if "stamps" not in losses:
        tolerance_ns = 3e6 if "bounds" in losses else 60_000
        np.testing.assert_allclose(np.diff(recording.stamps_ns), PERIOD_NS, atol=tolerance_ns)
    poses = recording.poses(range(SWEEPS))
    if "poses" in losses:
        assert poses is None
    else:
        expected_poses = truth.poses(range(SWEEPS))
        if "origin" in losses:
            expected_poses = np.linalg.inv(expected_poses[0]) @ expected_poses
        np.testing.assert_allclose(poses, expected_poses, atol=1e-4)
    for number, sweep in enumerate(recording):
        returns = sweep.returns()
        if "bounds" in losses:
            continue
        expected = truth.fired(number) if name in AS_FIRED else truth[number].returns()
        rows = nearest(returns.points, expected.points)
        for column in ("class", "object"):
            if column in losses:
                assert column not in returns.columns
            else:
                np.testing.assert_array_equal(
                    returns.columns[column], expected.columns[column][rows]
                )
        rings = returns.rings
        if "channel" in losses and not stands:
            assert rings is None and "motion-compensated" in recording.rings.note
        else:
            assert ("channel" in losses) == ("no ring column" in recording.rings.note)
            np.testing.assert_array_equal(rings, expected.columns["channel"][rows])
        times_s = returns.times_s
        if "times" in losses:
            assert times_s is None
        else:
            fired_s = 1e-9 * expected.columns["time"][rows]
            np.testing.assert_allclose(np.diff(times_s), np.diff(fired_s), atol=2e-6)


def test_a_capture_has_the_same_points_between_other_bounds(result):
    """Every point is in the sweep of the same number, or in the one before or after it."""
    from scipy.spatial import cKDTree

    cloud, _, _ = result
    path = export(result, "pcap")
    truth = [open_recording(cloud).fired(number) for number in range(SWEEPS)]
    for sweep, compensated in zip(truth, open_recording(cloud), strict=True):
        np.testing.assert_array_equal(sweep.times_s, compensated.times_s)
    sweeps = [sweep.returns() for sweep in open_recording(path)]
    assert 0 <= len(cloud) - sum(map(len, sweeps)) < 384  # of the last packet, which is not full
    for number, sweep in enumerate(sweeps):
        around = Sweep.concatenate(truth[max(number - 1, 0) : number + 2])
        distances, rows = cKDTree(around.points).query(sweep.points)
        assert distances.max() < TOLERANCE_M
        np.testing.assert_array_equal(sweep.rings, around.columns["channel"][rows])
        since_s = 1e-9 * around.columns["time"][rows].astype(float)
        np.testing.assert_allclose(np.ptp(sweep.times_s), np.ptp(since_s), atol=0.11)


@pytest.mark.extended(keep=("standing-*",))
def test_views_are_the_same_for_every_format(result, exported):
    cloud, _, stands = result
    _, path, losses = exported
    view = recorded_view(open_sensors(path), "", None)
    shown = values_of(view)
    assert len(view.sweeps) == SWEEPS
    assert len(view.points) == len(cloud) or "bounds" in losses
    assert view.sweeps.coordinates == ("sensor" if "poses" in losses else "world")
    if not losses & {"poses", "origin"} and stands:
        rows = nearest(np.stack([shown[axis] for axis in "xyz"], axis=1), cloud.positions)
        for column in {"channel", "class", "object"} - losses:
            np.testing.assert_array_equal(shown[column], cloud.columns[column][rows])


@pytest.mark.extended(keep=("moving-*",))
def test_comparisons_with_the_result_find_no_difference(result, exported):
    cloud, _, stands = result
    name, path, losses = exported
    found = compare(path, cloud, sweeps=[0, 9])
    figures = found.figures
    assert figures["distances"]["a_to_b"]["points"] > 1000
    if "bounds" in losses or (not stands and name in AS_FIRED):
        return  # the result has other sweeps, or is compensated for the motion
    assert figures["distances"]["a_to_b"]["max_m"] < TOLERANCE_M
    if not stands and "channel" in losses:
        assert figures["ranges"] is None
    else:
        assert abs(figures["ranges"]["residual"]["median_m"]) < TOLERANCE_M
        assert figures["ranges"]["no_return"]["f1"] > 0.999


@pytest.mark.extended(keep=("standing-*",))
def test_fits_and_twins_find_the_same_rings(result, exported):
    cloud, _, stands = result
    name, path, losses = exported
    truth = open_recording(cloud)
    recorded = RecordedSweeps.open(path)
    if "channel" in losses and not stands:
        assert len(recorded.rings) == 0
        return
    elevations = truth.rings.elevation_rad[: recorded.ring_count]
    tolerance = 2e-3 if stands or name in AS_FIRED else 1e-2  # compensation changes elevations
    np.testing.assert_allclose(recorded.elevation_rad, elevations, atol=tolerance)
    if "bounds" in losses:
        return
    sweep = recorded.read(9)
    fired = truth.fired(9) if name in AS_FIRED else truth[9].returns()
    rows = nearest(sweep.points, fired.points)
    channels = fired.columns["channel"][rows].astype(int)
    np.testing.assert_array_equal(sweep.columns["row"], channels.max() - channels)
    if "class" not in losses:
        np.testing.assert_array_equal(sweep.columns["label"] & 0xFFFF, fired.columns["class"][rows])
    if stands:
        stack = SweepStack.read(open_recording(path))
        assert stack.sweep_count == SWEEPS
        np.testing.assert_array_equal(np.sort(stack.rings), np.unique(channels))


@pytest.mark.extended(keep=("moving-*",))
@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_without_sweeps_have_the_same_points(result, name):
    cloud, folder, _ = result
    file, package = CLOUDS[name]
    pytest.importorskip(package)
    path = folder / file
    save_cloud(cloud, path, format=name)
    recording = open_recording(path)
    assert isinstance(recording, PointCloud)
    assert len(recording) == 1 and recording.info.point_count == len(cloud)
    np.testing.assert_allclose(recording[0].points, cloud.positions, atol=1e-9)
    for column in ("channel", "class", "object"):
        np.testing.assert_array_equal(recording[0].columns[column], cloud.columns[column])
    shown = values_of(recorded_view(open_sensors(path), "", None))
    np.testing.assert_array_equal(shown["class"], cloud.columns["class"])
    assert compare(path, cloud).figures["distances"]["a_to_b"]["max_m"] < 1e-6


@pytest.mark.extended(keep=("moving-*",))
@pytest.mark.parametrize("name", ["pcd", "e57", "las", "kitti"])
def test_scenes_are_made_of_the_same_points(result, name):
    """A single file of a format: its first sweep, or all scans in the frame of the file."""
    cloud, folder, _ = result
    file = {"pcd": "000000.pcd", "kitti": "sequences/00/velodyne/000000.bin"}.get(name, "")
    path = folder / {"e57": "all.e57", "las": "all.las"}.get(name, f"all_{name}")
    pytest.importorskip({"e57": "pye57", "las": "laspy"}.get(name, "numpy"))
    save_cloud(cloud, path, format=name, **({"compensated": True} if name == "pcd" else {}))
    points = read_points(path / file if file else path, None, lambda note: None).points
    expected = cloud.positions
    if file:
        first = open_recording(cloud)[0]
        expected = first.points if name == "kitti" else first.in_world()
    nearest(points.points, expected)

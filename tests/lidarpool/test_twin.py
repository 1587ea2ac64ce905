"""A place from a recording: what stands, where, how bright; what moved is left out."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import yaml
from benchmarks import reality
from benchmarks.odometry import left_turn
from click.testing import CliRunner
from scipy.spatial import cKDTree
from tests.made_recordings import changed_recording, made_recording
from tests.simulated_drives import simulated_drive, simulated_points

from lidarfiles import save_cloud
from lidarfiles.clouds.point_times import PointTimes
from lidarfiles.clouds.rings import Rings
from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.commands import cli
from lidarreal import twin
from lidarreal.reconstruction.alignment import Alignment
from lidarreal.reconstruction.lost_pulses import SensorCoverage, lost_pulses
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.scan_patterns.lasers import RingLasers
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.procedural.city import city
from lidarsim import (
    Actor,
    LidarError,
    Material,
    Mounted,
    Pose,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import SCAN
from lidarsim.scene.colors import LINEAR
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

pytest.importorskip("scipy")

SWEEPS = 12
PERIOD_S = 0.1
SPEED_M_S = 5.0
FLOOR = 0.2
WALLS = 0.6
CAR = (4.0, 1.8, 1.5)
CAR_Y = 3.0


def static_box(name, size, middle):
    """A box on the ground around a place."""
    mesh = box(name, size)
    return SceneMesh(name, mesh.vertices + np.array([*middle, 0.0]), mesh.faces)


@pytest.fixture(scope="module")
def street():
    """A street of 40 m between walls, houses and posts, and a car that drives past."""
    corners = np.array([[-30, -8, 0], [30, -8, 0], [30, 8, 0], [-30, 8, 0]], float)
    meshes = [
        SceneMesh("floor", corners, np.array([[0, 1, 2], [0, 2, 3]])),
        static_box("wall left", (60.0, 1.0, 2.5), (0.0, 8.0)),
        *(static_box(f"house {x}", (7.0, 1.0, 9.0), (x, 8.0)) for x in (-24.0, -7.0, 9.0)),
        static_box("wall right", (60.0, 1.0, 6.0), (0.0, -8.0)),
        static_box("wall ahead", (1.0, 16.0, 6.0), (30.0, 0.0)),
        *(static_box(f"shed {x}", (1.7, 2.2, 2.4), (x, 6.5)) for x in (-11.0, -2.0, 5.0, 16.0)),
        *(static_box(f"post {x}", (0.4, 0.4, 3.0), (float(x), -5.0)) for x in range(-12, 15, 6)),
    ]
    car = Actor(box("car", CAR), Track([0, 3], [[-14, CAR_Y, 0], [26, CAR_Y, 0]]))
    return Scene.from_meshes(meshes).with_actors([car])


@pytest.fixture(scope="module")
def survey():
    end_s = SWEEPS * PERIOD_S + 0.2
    return Survey(
        sensors=[Mounted(Sensor.grid(480, 24, vertical_fov_deg=40), Pose((0, 0, 1.8)))],
        trajectory=Track([0, end_s], [[-3, 0, 0], [SPEED_M_S * end_s - 3, 0, 0]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity"],
        materials=[Material("floor", FLOOR), Material("*", WALLS)],
        precision_m=1e-4,
    )


@pytest.fixture(scope="module")
def drive(street, survey):
    """Return the recorded sweeps of the drive: a cloud in memory."""
    return simulated_drive(street, survey)


@pytest.fixture(scope="module")
def place(drive):
    return twin(drive)


def from_standstill(end_s):
    """A car that starts in a street of the city, at 3 m/s²."""
    times_s = np.arange(0, end_s + 0.1, 0.05)
    ahead = 1.5 * np.square(times_s)
    return Track(times_s, np.stack([ahead - 24, ahead * 0 - 3, ahead * 0], axis=1), smooth=True)


def straight_on(end_s):
    """A car at 2 m/s in a street of the city."""
    return Track([0, end_s], [[-24, -3, 0], [2 * end_s - 24, -3, 0]])


def in_a_circle(end_s):
    """A car that turns in a circle of 4 m at a crossing of the city."""
    times_s = np.arange(0, end_s + 0.1, 0.05)
    angle = times_s * 1.2
    zero = np.zeros_like(angle)
    positions = np.stack([4 * np.sin(angle), 4 - 4 * np.cos(angle), zero], axis=1)
    quaternions = np.stack([zero, zero, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    return Track(times_s, positions, quaternions, smooth=True)


def city_drive(model, options, sweeps, trajectory=left_turn, triangles=5_000):
    """Return the recorded sweeps of a drive through a city: a cloud in memory."""
    scene = city(triangles)
    sensor = load_sensor(model, **options) if isinstance(model, str) else model
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, 1.9)), "lidar")],
        trajectory=trajectory((sweeps + 1) * PERIOD_S),
        steps=36 * sweeps,
        columns=["time", "intensity", "class", "reflectivity", "ray", "range"],
        precision_m=1e-4,
    )
    return simulated_drive(scene, survey)


def without_poses(drive, rows=None):
    """Return a recording of the sweeps in the sensor frame, without poses and times."""
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened[number]
        columns = {"intensity": sweep.intensity}
        if rows is None:
            return Sweep(sweep.points, columns | {"ring": sweep.columns["channel"]})
        return Sweep(sweep.points, columns).select(rows(sweep.points, sweep.columns))

    return made_recording("drive", len(opened), read)


@pytest.mark.extended
def test_a_twin_has_the_ranges_of_held_out_sweeps(place):
    held = place.figures["held_out"]["stationary"]
    assert held["median_abs_difference_m"] < 0.01
    assert held["no_surface"] < 0.01
    assert abs(held["mean_intensity_difference"]) < 0.1
    assert "12 sweeps" in repr(place)


@pytest.mark.extended
def test_a_twin_has_the_points_and_the_lost_pulses_of_held_out_sweeps(place):
    held = place.figures["held_out"]
    assert held["points"] == pytest.approx(1, abs=0.03)
    assert held["points_by_ring"] < 0.03
    assert held["no_return"]["recorded"] > 0.02
    assert held["no_return"]["f1"] > 0.8
    assert "points    " in repr(place)


@pytest.mark.extended
def test_a_twin_has_the_metrics_of_lidar4d(place):
    found = place.figures["lidar4d"]
    held = place.figures["held_out"]
    assert [one["sweep"] for one in found["by_frame"]] == [one["sweep"] for one in held["by_sweep"]]
    assert found["frames"] == len(found["by_frame"])
    assert found["chamfer_m2"] < 0.5
    assert found["f_score"] > 0.9
    assert found["depth"]["rmse_m"] < 3
    assert found["ray_drop"]["f1"] > 0.97
    assert found["intensity"]["factor"] == 1
    assert found["intensity"]["rmse"] < 0.1
    assert place.figures["lidar4d_window"] is None
    assert "lidar4d  " in repr(place)


@pytest.mark.slow
def test_a_window_of_lidar4d_holds_out_its_frames(tmp_path):
    drive = city_drive("ouster/os1-32", {"columns": 512}, 51, straight_on)
    save_cloud(drive, tmp_path / "drive.mcap")
    found = twin(tmp_path / "drive.mcap", lidar4d_window=4950).figures
    assert found["lidar4d_window"] == 4950
    assert found["used_sweeps"] == 51
    held_out = [10, 20, 30, 40]
    assert [one["sweep"] for one in found["held_out"]["by_sweep"]] == held_out
    assert [one["sweep"] for one in found["lidar4d"]["by_frame"]] == held_out
    with pytest.raises(LidarError, match="`lidar4d_window` requires the path of a recording"):
        twin(drive, lidar4d_window=4950)
    with pytest.raises(LidarError, match="lidar4d_window"):
        twin(tmp_path / "drive.mcap", lidar4d_window=4951)


def test_lost_pulses_are_steps_of_a_ring_without_a_return():
    elevation = np.radians(np.linspace(15, -15, 16))
    azimuth = np.radians(np.arange(-179.9, 180, 0.4))
    ring, column = (index.ravel() for index in np.indices((16, len(azimuth))))
    level = np.cos(elevation[ring])
    directions = np.stack(
        [
            level * np.cos(azimuth[column]),
            level * np.sin(azimuth[column]),
            np.sin(elevation[ring]),
        ],
        axis=1,
    )
    random = np.random.default_rng(7)
    returned = random.random(len(ring)) < 0.7
    returned[ring == 5] = False  # a ring that sees the sky
    received = (column < 200) | (column >= 300)  # packets of 40 degrees did not come
    rows = returned & received
    points = (random.uniform(2, 50, len(ring))[:, None] * directions)[rows]
    sweep = Sweep(points, {"row": ring[rows]})
    coverage = SensorCoverage(np.ones((16, 720), bool), 50.0)
    lasers = RingLasers.at_origin(elevation)
    lost, _ = lost_pulses(sweep, lasers, coverage, 0.0)
    expected = ~returned & received
    assert len(lost) == pytest.approx(expected.sum(), rel=0.01)
    for number in (0, 5, 9):
        truth = directions[expected & (ring == number)]
        found = lost.points[lost.columns["row"] == number]
        cosines = found @ truth.T
        assert np.mean(cosines.max(axis=1) > np.cos(np.radians(0.25))) > 0.98
    # Second returns of the pulses, whose azimuths are rounded.
    both = Sweep.concatenate([sweep, sweep.replace(points=sweep.points * 1.01 + (1e-6, -1e-6, 0))])
    assert len(lost_pulses(both, lasers, coverage, 0.0)[0]) == pytest.approx(len(lost), rel=0.01)
    unknown, _ = lost_pulses(sweep, RingLasers.at_origin(np.empty(0)), coverage, 0.0)
    assert not len(unknown)


def test_rings_start_where_their_first_pulses_are():
    """Lasers point to either side, and the first pulses of some rings are lost in the sky."""
    rings = np.arange(16)
    staggered = np.radians(np.where(rings % 2, 4.0, -4.0))
    share = np.arange(900) / 900
    ring, column = (index.ravel() for index in np.indices((16, 900)))
    azimuth = 1.0 + staggered[ring] + 2 * np.pi * share[column]
    elevation = np.radians(np.linspace(10, -10, 16))[ring]
    level = 20 * np.cos(elevation)
    points = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), 20 * np.sin(elevation)], axis=1
    )
    returned = (ring >= 5) | (column >= 80)
    order = np.flatnonzero(returned)
    recording = made_recording("drive", 4, lambda _: Sweep(points[order], {"ring": ring[order]}))
    sweep = RecordedSweeps.from_recording(recording).read(1)
    turn = Motion.COUNTERCLOCKWISE.times_s(sweep, 1.0)
    known = ring[order] >= 5
    np.testing.assert_allclose(turn[known], share[column[order]][known], atol=1e-6)
    # Where the first pulses are lost, the start is that of the other rings, to their stagger.
    wrong = np.abs(turn - share[column[order]])
    assert wrong.max() < 8.1 / 360


@pytest.mark.extended
def test_what_moved_is_no_part_of_the_place(place):
    middles = place.scene.vertices[place.scene.faces].mean(axis=1)
    in_lane = np.abs(middles[:, 1] - CAR_Y) < CAR[1] / 2 + 0.1
    ghosts = in_lane & (middles[:, 2] > 0.15) & (middles[:, 2] < CAR[2] + 0.1)
    assert ghosts.mean() < 0.004
    assert (np.abs(middles[:, 1] - CAR_Y) < 1).any()  # the ground stays
    assert place.figures["moved"] > 0


@pytest.mark.extended
def test_moving_objects_are_simulated_in_held_out_sweeps(place):
    moving = place.figures["held_out"]["moving"]
    assert moving["rays"] > 500
    assert moving["median_abs_difference_m"] < 0.03
    assert moving["ghosts"] < 0.002
    (actor,) = place.figures["actors"]
    np.testing.assert_allclose(actor["size_m"], CAR, atol=0.01)
    assert "1 moving object from boxes" in repr(place)
    assert place.figures["vehicle_share"] == 0, "a car that passes at close range moves"


@pytest.mark.extended
def test_surfaces_are_as_bright_as_they_were(place):
    scene = place.scene
    middles = scene.vertices[scene.faces].mean(axis=1)
    (colors,) = scene.all_colors
    light = LINEAR[colors.mean_colors()].mean(axis=1)
    floor = np.median(light[middles[:, 2] < 0.05])
    walls = np.median(light[(np.abs(middles[:, 1]) > 7.3) & (middles[:, 2] > 1)])
    # On level ground, the angle of incidence follows from the range, so the reflectance of the
    # floor and the exponent of the incidence cannot be told apart exactly.
    np.testing.assert_allclose(floor / walls, FLOOR / WALLS, rtol=0.2)


@pytest.mark.extended
def test_a_twin_is_a_scenario_that_runs_with_another_sensor(place, tmp_path):
    files = place.save(tmp_path / "twin")
    assert {file.name for file in files} == {
        "place.glb", "trajectory.csv", "sensor.yaml", "scenario.yaml", "twin.json", "report.html",
        "actors",
    }  # fmt: skip
    assert {file.name for file in (tmp_path / "twin" / "actors").iterdir()} == {
        "car-1.glb", "car-1.csv",
    }  # fmt: skip
    path = tmp_path / "twin" / "scenario.yaml"
    job = prepare(Scenario.load(path))
    middle = 5
    pose = job.survey.path.pose(0, 1e9 * place.times_s[middle])
    np.testing.assert_allclose(pose.position, place.poses[middle, :3, 3], atol=1e-5)
    np.testing.assert_allclose(pose.rotation_matrix, place.poses[middle, :3, :3], atol=1e-5)
    (actor,) = job.scene.actors
    assert actor.name == "car 1"
    position, _ = actor.trajectory.poses(0, np.array([0.6e9]))
    np.testing.assert_allclose(position, [[-6, CAR_Y, 0]], atol=0.05)
    simulated, _ = scanned(path.parent)
    on_car = simulated["object"] == len(job.scene.names)
    assert on_car.sum() > 100
    assert set(simulated["class"][on_car].tolist()) == {1}
    assert job.survey.classes[1] == "car"
    edited = yaml.safe_load(path.read_text())
    edited["actors"][0]["box"] = [4.5, 1.8, 1.5]
    del edited["actors"][0]["file"]
    (path.parent / "edited.yaml").write_text(yaml.safe_dump(edited))
    (replaced,) = prepare(Scenario.load(path.parent / "edited.yaml")).scene.actors
    np.testing.assert_allclose(np.ptp(replaced.bounds, axis=0), (4.5, 1.8, 1.5))
    np.testing.assert_array_equal(replaced.trajectory.positions, actor.trajectory.positions)
    other = prepare(Scenario.load(path, {"sensor": "velodyne/vlp16"}))
    assert other.survey.mounted_sensors[0].sensor.channels == 16
    result = CliRunner().invoke(cli, ["twin", str(tmp_path), "--out", str(path.parent)])
    assert "scenario.yaml already exists. Use another output with `--out`, or pass" in str(
        result.exception
    )


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A bag of a clockwise sensor, with points as fired, and the folder of its twin."""
    folder = tmp_path_factory.mktemp("bag")
    cloud = city_drive("ouster/os1-32", {"columns": 512}, SWEEPS)
    save_cloud(cloud, folder / "drive.mcap")
    found = twin(folder / "drive.mcap")
    found.save(folder / "twin")
    return folder, found


@pytest.mark.extended
def test_the_sensor_of_a_twin_rotates_like_the_recorded_sensor(bag):
    folder, found = bag
    stated = yaml.safe_load((folder / "twin" / "sensor.yaml").read_text())
    assert stated["clockwise"] is True
    assert stated["zero_deg"] == pytest.approx(180 + 4.25, abs=0.1)  # the lasers point sideways
    assert stated["rate_hz"] == pytest.approx(10, abs=1e-4)
    assert stated["firings_per_turn"] == 512
    beams = load_sensor("ouster/os1-32").beams
    elevation_deg = np.degrees(np.sort(beams.elevation))
    np.testing.assert_allclose(stated["beams"]["elevation_deg"], elevation_deg, atol=0.03)
    origins_m = np.array(stated["beams"]["origin_m"])
    # Only what is perpendicular to the beams is visible.
    sin, cos = np.sin(np.sort(beams.elevation)), np.cos(np.sort(beams.elevation))
    upward_m = beams.origin[0, 2] * cos - beams.origin[0, 0] * sin
    np.testing.assert_allclose(origins_m[:, 2] * cos - origins_m[:, 0] * sin, upward_m, atol=5e-3)
    limits = {"detection", "dropout", "false_alarms"}
    assert not limits & {*(stated.get("performance") or {})}, (
        "the scene lacks what was not detected"
    )
    assert not any("direction of rotation" in note for note in found.figures["notes"])


@pytest.mark.extended
def test_a_twin_simulates_all_sweeps_with_energies_as_recorded(bag):
    folder, found = bag
    response = found.figures["response"]
    assert response["model"] == "energies"
    rows = found.figures["held_out"]["by_range"]
    errors = [row["mean_intensity_difference"] for row in rows if row["to_m"]]
    assert max(map(abs, errors)) < 0.2
    job = prepare(Scenario.load(folder / "twin" / "scenario.yaml"))
    assert job.survey.scan_count == 36 * SWEEPS
    names = [getattr(column, "name", column) for column in job.survey.columns]
    assert names == ["time", "intensity", "reflectivity", "class"]
    last = job.survey.path.pose(0, 1e9 * PERIOD_S * SWEEPS)
    step = found.poses[-1, :3, 3] - found.poses[-2, :3, 3]
    np.testing.assert_allclose(last.position, found.poses[-1, :3, 3] + step, atol=0.01)
    simulated, _ = scanned(folder / "twin")
    recording = open_recording(folder / "drive.mcap", name="drive")
    recorded = Sweep.concatenate([recording[number] for number in range(SWEEPS)])
    range_m = np.linalg.norm(recorded.points, axis=1)
    light = recorded.intensity
    poses = job.survey.path.poses(0, simulated["time"].astype(np.float64))[0]
    simulated_m = np.linalg.norm(simulated.positions - poses, axis=1)
    ratios = []
    for low_m, high_m in ((3, 6), (6, 12), (12, 25), (25, 50)):
        parts = [
            values[(distance > low_m) & (distance < high_m)].mean()
            for distance, values in ((range_m, light), (simulated_m, simulated["intensity"]))
        ]
        ratios.append(parts[1] / parts[0])
    assert max(ratios) < 1.25 * min(ratios), ratios


@pytest.mark.extended
def test_intensities_that_are_compensated_for_range_are_found(drive, survey):
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened[number]
        intensity = sweep.intensity * np.square(sweep.points).sum(axis=1)
        return sweep.replace(columns={**sweep.columns, "intensity": intensity})

    found = twin(changed_recording(opened, read=read, energy_unit=None))
    assert found.figures["response"]["model"] == "compensated for range"
    elevation_deg = np.sort(np.degrees(survey.sensor.beams.elevation))
    np.testing.assert_allclose(found.model.beams.elevation_deg, elevation_deg, atol=0.002)
    # Points of results are compensated for motion, and their times show the rotation.
    assert (found.model.clockwise, found.model.rate_hz) == (False, pytest.approx(10))
    assert (found.model.zero_deg + 180) % 360 - 180 == pytest.approx(0, abs=1)


def test_rings_are_found_in_the_order_of_points(drive):
    def ring_by_ring(points, columns):
        azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
        return np.lexsort((azimuth, -columns["channel"].astype(int)))

    recording = without_poses(drive, ring_by_ring)
    sweep = open_recording(drive, name="drive")[3]
    channels = len(np.unique(sweep.rings))
    assert len(recording.rings) == channels
    assert f"{channels} rings were determined" in recording.rings.note
    ordered = np.sort(sweep.rings.astype(int))[::-1]
    np.testing.assert_array_equal(recording[3].rings, ordered - ordered[-1])
    rows = RecordedSweeps.from_recording(recording).read(3).columns["row"]
    np.testing.assert_array_equal(rows, ordered[0] - ordered)


@pytest.mark.extended
def test_times_of_points_have_one_unit_and_tell_the_period(drive):
    opened = open_recording(drive, name="drive")

    def recording(times):
        def read(number):
            sweep = opened[number]
            time = times(sweep.columns["time"] % 100_000_000)
            found = Sweep(sweep.points, {"ring": sweep.columns["channel"], "time": time})
            return found.select(slice({3: 0, 4: 6}.get(number)))

        return made_recording("drive", len(opened), read)

    fired_s = (opened[4].columns["time"][:6] % 100_000_000) * 1e-9
    absolute_s = 1.7e9
    for times, half_s, stamp_s in (
        (lambda ns: ns * 1e-6, 1e-9, 0.0),
        (lambda ns: (ns - 50_000_000).astype(np.int32), 1e-9, 0.05),
        (lambda ns: (ns - 99_000_000).astype(np.int32), 1e-9, 0.099),
        # Without stamps, absolute times count from the first point.
        (lambda ns: absolute_s + ns * 1e-9, 1e-6, fired_s.min()),
        (lambda ns: ns.astype(np.uint64) + np.uint64(1_700_000_000_000_000_000), 1e-9,
         fired_s.min()),
    ):  # fmt: skip
        timed = recording(times)
        np.testing.assert_allclose(timed[4].times_s, fired_s - stamp_s, atol=half_s)
        assert not len(timed[3].times_s)
        sweeps = RecordedSweeps.from_recording(timed)
        for number in (3, 4):
            found_s = sweeps.read(number).columns["time_s"]
            np.testing.assert_array_equal(found_s, timed[number].times_s)
    quick = RecordedSweeps.from_recording(recording(lambda ns: ns // 2))
    np.testing.assert_allclose(np.diff(find_poses(quick, None).times_s), 0.05, rtol=0.01)
    coarse = recording(lambda ns: np.where(ns < 50_000_000, 0, 128).astype(np.float32))
    assert coarse.point_times is None
    short = PointTimes.from_sweeps([{"t": np.arange(-100, 101, dtype=np.int8)}])  # milliseconds
    assert short.sweep_s == pytest.approx(0.2)


def test_kept_sweeps_are_as_they_were_read(drive):
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened[number]
        points = sweep.points.astype(np.float32)
        columns = {"ring": sweep.rings, "intensity": sweep.intensity.astype(np.float32)}
        return Sweep(points, columns | {"label": np.full(len(points), 50)})

    sweeps = RecordedSweeps.from_recording(made_recording("drive", len(opened), read))
    kept = sweeps.with_cached([2, 5])
    for number in (2, 5, 7):
        one, other = sweeps.read(number), kept.read(number)
        assert set(one.columns) == {"row", "intensity", "label", "start_rad"}
        np.testing.assert_array_equal(one.points, other.points)
        assert one.points.dtype == other.points.dtype == np.float64
        for name, values in one.columns.items():
            np.testing.assert_array_equal(values, other.columns[name])
            assert values.dtype == other.columns[name].dtype


def test_kept_sweeps_need_half_the_memory(drive, tmp_path):
    save_cloud(drive, tmp_path / "drive.mcap")
    sweeps = RecordedSweeps.open(tmp_path / "drive.mcap")
    sweep = sweeps.read(3)
    arrays = [sweep.points, *sweep.columns.values()]
    kept_bytes = len(pickle.dumps(sweeps.with_cached([3]))) - len(pickle.dumps(sweeps))
    assert kept_bytes < 0.5 * sum(values.nbytes for values in arrays)


@pytest.mark.extended
def test_other_processes_read_sweeps_without_another_analysis(drive, tmp_path, monkeypatch):
    for name in ("drive.mcap", "another.mcap"):
        save_cloud(drive, tmp_path / name)
    sweeps = RecordedSweeps.open(tmp_path / "drive.mcap")
    expected = sweeps.read(3)
    handle = pickle.dumps(sweeps)
    RecordedSweeps.open(tmp_path / "another.mcap")  # a process keeps one recording open

    def analyze(*_):
        raise AssertionError("analyzed again")

    monkeypatch.setattr(Rings, "from_sweeps", analyze)
    monkeypatch.setattr(PointTimes, "from_sweeps", analyze)
    found = pickle.loads(handle).read(3)
    np.testing.assert_array_equal(found.points, expected.points)
    assert {"row", "time_s"} <= {*found.columns}
    for name, values in expected.columns.items():
        np.testing.assert_array_equal(found.columns[name], values)


def test_a_sweep_has_its_share_of_a_step_with_dropped_sweeps():
    points = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    sweep = Sweep(points, {"row": np.zeros(4, int), "start_rad": np.zeros(4)})
    for motion, expected in (
        (Motion.COUNTERCLOCKWISE, [0, 0.25, 0.5, 0.75]),
        (Motion.CLOCKWISE, [0, 0.75, 0.5, 0.25]),
    ):
        np.testing.assert_allclose(motion.times_s(sweep, 0.1), 0.1 * np.array(expected))
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[1, 0, 3] = 2.0
        for step_s, whole_m in ((0.1, 2.0), (0.2, 1.0)):
            times_s = np.array([0, step_s])
            alignment = Alignment(poses, times_s, 0.1, 0.1, motion, np.zeros((1, 3)))
            moved, origins = alignment.compensate(sweep, 0)
            np.testing.assert_allclose(origins[:, 0], whole_m * np.array(expected))
            np.testing.assert_allclose(moved, points + origins)


@pytest.mark.extended
def test_few_points_and_unknown_intensities_change_no_others(drive):
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened[number]
        if number == 3:
            return Sweep(sweep.points[:0])
        intensity = sweep.intensity.copy()
        intensity[::500] = np.nan
        columns = {"ring": sweep.rings, "intensity": intensity, "class": np.full(len(sweep), 50)}
        found = Sweep(sweep.points, columns)
        # Of a ring alone: the beginning of a sweep, or the rest of one with lost packets.
        return found.select(np.flatnonzero(sweep.rings == 12)[:60]) if number == 5 else found

    found = twin(changed_recording(opened, read=read))
    truth = opened.poses(range(SWEEPS))
    relative = np.linalg.inv(found.poses[4]) @ found.poses[5]
    expected = np.linalg.inv(truth[4]) @ truth[5]
    np.testing.assert_allclose(relative[:3, 3], expected[:3, 3], atol=0.01)
    assert found.scene.has_colors.any()
    assert abs(found.figures["held_out"]["stationary"]["mean_intensity_difference"]) < 0.1
    assert {material.name.split(",")[0] for material in found._materials()} == {"class 50"}


def test_a_recording_without_a_place_is_refused(drive, tmp_path):
    recording = without_poses(drive)
    with pytest.raises(LidarError, match="has 3 sweeps, but a reconstruction requires at least 4"):
        twin(changed_recording(recording, count=3))
    shuffled = without_poses(
        drive, lambda points, _: np.random.default_rng(1).permutation(len(points))
    )
    with pytest.raises(
        LidarError, match=r"cannot be determined from the order .* Specify its sensor"
    ):
        twin(shuffled)
    with pytest.raises(LidarError, match="has no column 'nope' that could be used as intensity"):
        twin(changed_recording(recording, intensity_column="nope"))
    empty = made_recording("drive", 9, lambda _: Sweep(np.zeros((0, 3))))
    with pytest.raises(LidarError, match="drive contains no points"):
        twin(empty)
    unknown = np.tile(np.eye(4), (SWEEPS, 1, 1))
    unknown[7, 0, 3] = np.nan
    with pytest.raises(LidarError, match="the pose of sweep 7 is not finite"):
        twin(changed_recording(recording, read_poses=lambda: unknown))
    trajectory = tmp_path / "poses.csv"
    trajectory.write_text("time_s,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,1,0,0,0,0,0,1\n")
    with pytest.raises(LidarError, match="contains 2 poses, but drive has 12 sweeps without times"):
        twin(recording, trajectory=trajectory)


@pytest.mark.extended
def test_classes_of_the_recording_are_labels_of_the_place(drive, tmp_path):
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened[number]
        level = sweep.points[:, 2] < -1.75  # of the floor, 1.8 m below the sensor
        return Sweep(sweep.points, {"ring": sweep.rings, "class": np.where(level, 11, 50)})

    found = twin(
        changed_recording(opened, read=read, read_classes=lambda: {11: "floor", 50: "house"})
    )
    found.save(tmp_path / "twin")
    job = prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))
    assert job.survey.classes == {0: "unlabeled", 11: "floor", 50: "house"}
    scan = columns_of(list(Rig(job.scene, job.survey, "auto").cast(0, 36)))
    cloud = scan.cloud((SCAN, *job.survey.stored_columns[3:]), 1e-4, job.scene.origin)
    height = cloud.positions[:, 2]
    low = height < np.quantile(height, 0.2)
    high = height > np.median(height) + 0.5
    assert (cloud["class"][low] == 11).mean() > 0.95
    assert (cloud["class"][high] == 50).mean() > 0.95


def scanned(folder):
    """Return the scan of a twin that was saved, and the names of its objects."""
    job = prepare(Scenario.load(folder / "scenario.yaml"))
    return simulated_points(job.scene, job.survey), np.array(job.scene.names)


CLASSES = {10: "car", 11: "floor", 50: "house", 51: "wall", 52: "shed", 80: "post"}


@pytest.mark.extended
@pytest.mark.parametrize("file", ["kitti", "nuscenes"])
def test_labels_of_exports_are_labels_of_simulated_points(street, survey, file, tmp_path):
    materials = [
        Material(f"{name}*", FLOOR if name == "floor" else WALLS, number)
        for number, name in CLASSES.items()
    ]
    columns = ["time", "intensity", "class", "reflectivity"]
    labeled = replace(survey, columns=columns, materials=materials, classes=CLASSES)
    recorded = simulated_drive(street, labeled)
    save_cloud(recorded, tmp_path / file, format=file)
    # Sweeps of KITTI are compensated and have no rings.
    model = tmp_path / "sensor.yaml"
    elevation_deg = np.degrees(survey.sensor.beams.elevation).tolist()
    model.write_text(
        yaml.safe_dump(
            {"name": "Grid", "firings_per_turn": 480, "beams": {"elevation_deg": elevation_deg}}
        )
    )
    found = twin(tmp_path / file, model=model if file == "kitti" else None, actors="none")
    found.save(tmp_path / "twin")
    scan, names = scanned(tmp_path / "twin")
    # The nearest recorded point of what stands has the label of a simulated point. Poses of KITTI
    # are from the first.
    first = open_recording(recorded, name="drive").poses([0])[0]
    static = recorded["object"] < len(street.names)
    stands = recorded.positions[static] + found.poses[0, :3, 3] - first[:3, 3]
    _, nearest = cKDTree(stands).query(scan.positions)
    assert (scan["class"] == recorded["class"][static][nearest]).mean() > 0.97
    if file == "kitti":
        numbers = np.array([int(name.removeprefix("object ")) for name in names])
        same = numbers[scan["object"]] == recorded["object"][static][nearest]
        assert same.mean() > 0.97
    else:
        assert len(names) == 1  # labels of nuScenes-lidarseg are classes alone


def test_rings_are_found_by_elevations_in_any_order(street, survey):
    standing = replace(survey, trajectory=None, poses=[(0, 0, 0)], steps=36 * 4)
    part = columns_of(list(Rig(street, standing, "auto").cast(0, standing.scan_count)))
    order = np.random.default_rng(3).permutation(len(part.columns["channel"]))
    points = part.cloud((SCAN,), 1e-4, street.origin).positions[order] - (0, 0, 1.8)
    channel = part.columns["channel"][order]
    recording = made_recording("drive", 4, lambda number: Sweep(points[number::4]))
    assert "the elevation angles of the points" in recording.rings.note
    np.testing.assert_array_equal(recording[2].rings, channel[2::4] - channel.min())
    moved = points + np.outer(np.linspace(0, 0.5, len(points)), [1, 0, 0])
    compensated = made_recording("drive", 4, lambda number: Sweep(moved[number::4]))
    assert "its rings cannot be determined" in compensated.rings.note
    assert compensated[2].rings is None


@pytest.mark.extended
def test_a_window_returns_nothing_in_the_place(street, survey, tmp_path):
    body = static_box("van", (6.0, 0.6, 3.0), (2.0, 5.2))
    corners = [[0.5, 4.88, 0.6], [3.5, 4.88, 0.6], [3.5, 4.88, 2.4], [0.5, 4.88, 2.4]]
    window = SceneMesh("window", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))
    scene = Scene.from_meshes([*street.meshes(), body, window])
    seen = replace(survey, materials=[Material("window", 0.0), *survey.materials])
    cloud = simulated_points(scene, seen)
    sweeps = Sweeps.from_survey(seen, scene)
    found = twin(replace(cloud, sweeps=lambda: sweeps))
    assert found.figures["dark_surfels"] > 50
    assert found.figures["held_out"]["no_return"]["f1"] > 0.85
    found.save(tmp_path / "twin")
    job = prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))
    again = simulated_points(job.scene, job.survey).positions
    on_van = (np.abs(again[:, 1] - 4.9) < 0.2) & (again[:, 0] > -1) & (again[:, 0] < 5)
    inside = (np.abs(again[:, 0] - 2) < 1.3) & (np.abs(again[:, 2] - 1.5) < 0.7)
    share = job.survey.scan_count / seen.scan_count  # the last pose is at the start of a sweep
    recorded = cloud.positions
    on_recorded = (np.abs(recorded[:, 1] - 4.9) < 0.1) & (np.abs(recorded[:, 0] - 2) < 3)
    assert (on_van & ~inside).sum() == pytest.approx(share * on_recorded.sum(), rel=0.1)
    assert (on_van & inside).sum() < 0.03 * on_recorded.sum()


@pytest.mark.extended
@pytest.mark.parametrize(
    ("model", "options", "file", "choice", "half_m"),
    [
        ("ouster/os1-32", {"columns": 512}, "drive.mcap", None, 0.002),
        ("velodyne/vlp16", {}, "packets", None, 0.02),
        ("livox/mid360", {}, "drive.mcap", "livox/mid360", 0.03),
        ("velodyne/hdl32e", {}, "nuscenes", None, 0.002),
    ],
)
def test_recordings_of_sensors_in_their_formats(model, options, file, choice, half_m, tmp_path):
    cloud = city_drive(model, options, sweeps=12)
    path = tmp_path / file
    formats = {"packets": "pcap", "nuscenes": "nuscenes"}
    save_cloud(cloud, path, format=formats.get(file))
    found = twin(path if file != "packets" else next(path.glob("*.pcap")), model=choice)
    held = found.figures["held_out"]["stationary"]
    assert held["median_abs_difference_m"] < half_m
    assert held["no_surface"] < 0.1
    # Packets have no poses, and their first sweep is a part of one.
    assert found.figures["length_m"] == pytest.approx(6.6, abs=0.8 if file == "packets" else 0.1)
    found.save(tmp_path / "twin")
    prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))


@pytest.mark.extended
def test_poses_are_found_in_a_city(tmp_path):
    cloud = city_drive("ouster/os1-64", {"columns": 512}, 24, from_standstill, 60_000)
    opened = open_recording(cloud, name="drive")
    path = tmp_path / "drive.mcap"
    save_cloud(cloud, path)
    fired = open_recording(path, name="drive")

    def read(number):
        sweep = fired[number]
        return Sweep(sweep.points, sweep.columns)

    truth = opened.poses(range(24))
    found = twin(made_recording("drive", 24, read))
    assert found.figures["poses"] == "from registration"
    assert found.figures["motion"] == "as fired, with point times"
    relative = np.linalg.inv(found.poses[0]) @ found.poses
    expected = np.linalg.inv(truth[0]) @ truth
    assert np.abs(relative[:, :3, 3] - expected[:, :3, 3]).max() < 0.05
    assert found.figures["held_out"]["stationary"]["median_abs_difference_m"] < 0.01


@pytest.mark.extended
def test_a_mirrored_recording_is_refused_and_a_sensor_that_stood_is_noted(drive):
    opened = open_recording(drive, name="drive")
    turned = city_drive("velodyne/vlp16", {}, 16, in_a_circle)
    recording = open_recording(turned, name="drive")

    def mirrored(number):
        sweep = recording[number]
        return sweep.replace(points=sweep.points * (1, -1, 1))

    with pytest.raises(LidarError, match="fit its poses better with y inverted"):
        twin(changed_recording(recording, read=mirrored, fired=None))
    first = opened[0]
    stood = twin(
        changed_recording(opened, read=lambda _: first, count=6, read_stamps=None, read_poses=None)
    )
    assert any("the sensor was stationary" in note for note in stood.figures["notes"])


@pytest.mark.extended
def test_sweeps_that_are_tilted_against_the_sensor_tell_no_noise(drive, tmp_path):
    opened = open_recording(drive, name="drive")
    angle = np.radians(4)
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    poses = opened.poses(range(SWEEPS)) @ np.linalg.inv(tilt)

    def read(number):
        sweep = opened[number]
        return Sweep(sweep.points @ tilt[:3, :3].T, {"ring": sweep.rings})

    found = twin(made_recording("drive", SWEEPS, read, read_poses=lambda: poses))
    performance = found.model.performance
    assert performance.range_m < 0.005 and performance.detection is None
    assert found.model.firings_per_turn == pytest.approx(480, rel=0.02)
    known = "the sensor noise is unknown except for that of the ranges: "
    assert any(known in note for note in found.figures["notes"])
    found.save(tmp_path / "twin")
    prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))


@pytest.mark.extended
def test_a_drive_far_from_zero_with_an_empty_sweep_and_a_trajectory(drive, place, tmp_path):
    opened = open_recording(drive, name="drive")
    far = np.array([400_000.0, 5_600_000.0, 90.0])
    half = np.sqrt(0.5)  # the world is turned by 90 degrees
    rows = ["time_s,x,y,z,qx,qy,qz,qw"]
    for number in range(SWEEPS):
        x, y, z = place.poses[number, :3, 3]
        east, north, up = far + np.array([-y, x, z])
        rows.append(f"{5 + 0.2 * number},{east},{north},{up},0,0,{half},{half}")
    trajectory = tmp_path / "poses.csv"
    trajectory.write_text("\n".join(rows) + "\n")

    def read(number):
        sweep = opened[number]
        found = Sweep(sweep.points, {"ring": sweep.rings})
        return found.select(slice(0)) if number == 3 else found

    found = twin(made_recording("drive", len(opened), read), trajectory=trajectory)
    np.testing.assert_allclose(found.times_s, 0.2 * np.arange(SWEEPS), atol=1e-9)
    steps = np.diff(found.poses[:, :3, 3], axis=0)
    np.testing.assert_allclose(steps[:, 1], SPEED_M_S * PERIOD_S, atol=0.01)
    assert found.figures["held_out"]["stationary"]["median_abs_difference_m"] < 0.01
    assert not found.scene.has_colors.any()
    found.save(tmp_path / "twin")
    scenario = yaml.safe_load((tmp_path / "twin" / "scenario.yaml").read_text())
    np.testing.assert_allclose(scenario["world"]["origin"], far, atol=10)
    prepare(Scenario.load(tmp_path / "twin" / "scenario.yaml"))


def test_another_sensor_is_for_a_scenario_of_one_sensor(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(yaml.safe_dump({"scene": "seed", "sensors": {"a": "velodyne/vlp16"}}))
    with pytest.raises(
        LidarError, match=r"`--sensor` requires a scenario with a single sensor\. Change `sensors`"
    ):
        Scenario.load(path, {"sensor": "velodyne/vlp32c"})


@pytest.mark.extended
def test_the_benchmark_of_recordings_has_a_row_for_each_rule(drive, tmp_path, capsys):
    """Sweeps of the simulated drive in the place of a public recording, ring by ring."""
    folder = tmp_path / "Pointcloud-Segmentation/data/velodyne_points/good_data"
    folder.mkdir(parents=True)
    opened = open_recording(drive, name="drive")
    for number in range(SWEEPS):
        sweep = opened[number]
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) % (2 * np.pi)
        order = np.lexsort((azimuth, -sweep.rings.astype(int)))
        rows = np.column_stack([sweep.points, sweep.intensity])[order]
        rows.astype(np.float32).tofile(folder / f"{number:06}.bin")
    (row,) = reality.main([str(tmp_path), "kitti360", "udacity"])  # too short for blocks of 20
    assert row["rule"] == "easy"
    assert row["twin"]["stationary"]["median_abs_difference_m"] < 0.02
    assert row["interval_m"][0] <= row["interval_m"][1] < 0.03
    assert row["static_share"] > 0.5
    printed = capsys.readouterr().out
    assert "kitti360, drive (easy, 12 sweeps" in printed
    assert "udacity is skipped" in printed

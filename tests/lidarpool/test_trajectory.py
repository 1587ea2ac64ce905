"""Trajectories: what they are between their poses, how they are read, and what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lidarpool import LidarpoolError, Mounted, Pose, Sensor, Survey, Track, load_trajectory
from lidarpool.base.fingerprint import fingerprint
from lidarpool.sensor.trajectory import matrices

RNG = np.random.default_rng(5)
TIMES = np.cumsum(RNG.uniform(0.05, 0.4, 12)) + 1.4e9
PLACES = np.cumsum(RNG.normal(size=(12, 3)), axis=0)
TURNS = RNG.normal(size=(12, 4))
TURNS /= np.linalg.norm(TURNS, axis=1, keepdims=True)
TURNS[1:] += 3 * TURNS[:-1]
TURNS /= np.linalg.norm(TURNS, axis=1, keepdims=True)


def angle(one, other):
    """Between two rotations, radians."""
    return np.arccos(np.clip((np.trace(one.T @ other) - 1) / 2, -1, 1))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_track_is_at_its_poses_and_evenly_turned_between(smooth):
    track = Track(TIMES, PLACES, TURNS, smooth)
    since = (TIMES - TIMES[0]) * 1e9
    places, turns = track.poses(0, since)
    assert np.allclose(places, PLACES, atol=1e-5)  # times since 1970 are no finer
    assert np.allclose(turns, matrices(TURNS), atol=1e-5)
    for part in (0.25, 0.5):
        at = since[:-1] + part * np.diff(since)
        places, turns = track.poses(0, at)
        if not smooth:
            assert np.allclose(places, PLACES[:-1] + part * np.diff(PLACES, axis=0), atol=1e-5)
        for k, turn in enumerate(turns):
            a, b = matrices(TURNS[k : k + 2])
            assert np.isclose(angle(a, turn), part * angle(a, b), atol=1e-5)
            assert np.isclose(angle(turn, b), (1 - part) * angle(a, b), atol=1e-5)
            assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14)


def test_a_smooth_way_has_no_corners_and_follows_a_parabola():
    times = np.array([0, 1, 1.5, 3, 4.0])
    places = np.stack([times, times**2, 0 * times], axis=1)
    track = Track(times, places, smooth=True)
    at = np.linspace(1, 3, 41)
    found, _ = track.poses(0, at * 1e9)
    assert np.allclose(found[:, 1], at**2, atol=1e-9), "tangents of three poses are exact there"
    speeds = np.diff(track.poses(0, np.array([1.5 - 1e-6, 1.5, 1.5 + 1e-6]) * 1e9)[0], axis=0)
    assert np.allclose(speeds[0], speeds[1], rtol=1e-4)


def test_without_angles_a_carrier_faces_its_way():
    track = Track([0, 1, 2, 3], [[0, 0, 0], [0, 0, 1], [0, 2, 1], [0, 2, 2]])
    assert [round(track.pose(0, t * 1e9).yaw_deg, 6) for t in (0, 1, 2, 3)] == [90] * 4
    assert Track([0, 1], [[0, 0, 0], [0, 0, 1]]).pose(0, 5e8).yaw_deg == 0


@pytest.fixture
def files(tmp_path):
    """The same drive in all formats: along x, turning to the left, from second 100 on."""
    times = np.linspace(100, 102, 21)
    yaw = np.radians(30 * (times - 100))
    places = np.stack([5 * (times - 100), 0 * times, 2 + 0 * times], axis=1)
    turns = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    track = Track(times, places, turns)
    np.savetxt(tmp_path / "drive.tum", np.column_stack([times, places, turns]), header="t x y z q")
    camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    poses = camera @ np.concatenate([matrices(turns) @ camera.T, places[..., None]], axis=2)
    np.savetxt(tmp_path / "poses.txt", poses.reshape(-1, 12), fmt="%.6e")
    np.savetxt(tmp_path / "times.txt", times)
    rows = np.column_stack([times * 1e9, places, np.degrees(yaw)])
    head = "time_ns,x,y,z,heading"
    np.savetxt(tmp_path / "drive.csv", rows, delimiter=",", header=head, comments="", fmt="%.9f")
    return SimpleNamespace(folder=tmp_path, track=track)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("drive.tum", {}),
        ("poses.txt", {"times": "times.txt"}),
        ("drive.csv", {"columns": {"yaw_deg": "heading"}}),
    ],
)
def test_files(files, name, options):
    if "times" in options:
        options = {"times": files.folder / options["times"]}
    track = load_trajectory(files.folder / name, **options, start_s=100.5, duration_s=1.2)
    assert np.isclose(track.duration_ns, 1.2e9)
    at = np.linspace(0, 1.2e9, 50)
    for one, other in zip(track.poses(0, at), files.track.poses(0, at + 0.5e9), strict=True):
        assert np.allclose(one, other, atol=1e-5)
    moved = load_trajectory(files.folder / name, **options, offset_s=-100)
    assert np.allclose(moved.times_s, files.track.times_s - 100)
    assert fingerprint(track) == fingerprint(
        load_trajectory(files.folder / name, **options, start_s=100.5, duration_s=1.2)
    )
    assert fingerprint(track) != fingerprint(moved)


@pytest.mark.parametrize(
    "text",
    [
        "time_s,x,y,z\n0,1,2,3\n1,4,5,6\n",
        "# made by hand\n\ntime_s;x;y;z\r\n0;1;2;3\r\n1;4;5;6\r\n",
        '"z"\t"y"\t"x"\t"time_s"\n3\t2\t1\t0\n# a remark\n6\t5\t4\t1\n',
        "time_s,x,y,z,of,\n0,1,2,3,car,\n1,4,5,6,car,\n",
        "#time_ns,x,y,z\n0,1,2,3\n1000000000,4,5,6\n",
    ],
)
def test_tables_as_programs_write_them(tmp_path, text):
    (tmp_path / "way.csv").write_text(text, newline="")
    columns = {"time_ns": "#time_ns"} if text[1:8] == "time_ns" else {}
    track = load_trajectory(tmp_path / "way.csv", columns=columns)
    assert track.times_s.tolist() == [0, 1]
    assert track.positions.tolist() == [[1, 2, 3], [4, 5, 6]]


class TestSurveys:
    track = Track([0, 1.05], [[0, 0, 1], [21, 0, 1]])

    def test_as_many_scans_as_the_trajectory_lasts(self):
        survey = Survey(Sensor.grid(rate_hz=10), trajectory=self.track)
        assert survey.scan_count == 36 * 10 + 18
        assert np.isclose(survey.pose(36).position[0], 2.0)
        assert Survey(Sensor.grid(), steps=5, trajectory=self.track).scan_count == 5

    def test_no_more_than_it_lasts(self):
        with pytest.raises(LidarpoolError, match=r"steps 400 take until 1.111.* s, 0.061.* s less"):
            Survey(Sensor.grid(rate_hz=10), steps=400, trajectory=self.track)
        with pytest.raises(LidarpoolError, match="one time step"):
            Survey(Sensor.grid(rate_hz=0.01), trajectory=self.track)
        with pytest.raises(LidarpoolError, match=r"0 to 1.05 s.* 0.95 s outside"):
            self.track.poses(0, np.array([2e9]))

    def test_sensors_come_one_after_the_other_each_with_its_rate(self):
        slow, fast = Sensor.grid(rate_hz=5), Sensor.grid(layers=16, rate_hz=20, step_deg=90)
        mount = Pose((1, 2, 0.5), yaw_deg=90)
        mounted = [Mounted(slow, name="slow"), Mounted(fast, mount, "fast")]
        survey = Survey(sensors=mounted, trajectory=self.track)
        assert survey.steps_each == (5 * 36 + 9, 84)
        assert survey.scan_count == 189 + 84
        specs = list(survey.scans())
        assert [spec.scan for spec in specs] == list(range(273))
        assert [spec.sensor for spec in specs] == [0] * 189 + [1] * 84
        assert sum(spec.ray_count for spec in specs) == survey.ray_count
        assert survey.pose(189).position == (1, 2, 1.5)
        assert np.isclose(survey.pose(189 + 4).position[0], 2.0)
        assert survey.pose(189).yaw_deg == 90
        assert "sensor" in [column.name for column in survey.stored_columns]

    def test_stations_wait_for_the_slowest(self):
        slow, fast = Sensor.grid(rate_hz=5), Sensor.grid(rate_hz=20)
        mounted = [Mounted(slow, name="slow"), Mounted(fast, name="fast")]
        survey = Survey(sensors=mounted, poses=[(0, 0, 1), (9, 0, 1)])
        starts = [survey.scan(k).start_ns for k in (0, 36, 72, 108)]
        assert starts == [0, 200_000_000, 0, 200_000_000]

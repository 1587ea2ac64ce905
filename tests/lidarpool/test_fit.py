"""Sensors fitted to recordings: figures that were put in, what cannot be told, files and errors."""

from __future__ import annotations

import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from benchmarks.fit_coverage import PLACES, box, place, recorded, street, trial
from tests.captures import IPV4, MACS, ip_packet, pcap, variants
from tests.made_recordings import changed_recording, made_recording

from lidarfiles import save_cloud
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import open_recording
from lidarpool import simulate
from lidarreal import fit
from lidarreal.comparing.fit import search
from lidarreal.comparing.fit.estimates import Estimate
from lidarreal.comparing.fit.fitting import _with_performance
from lidarreal.comparing.fit.measured import SensorMeasurement
from lidarreal.comparing.fit.smooth_surfaces import SmoothRays
from lidarscenes.procedural.city import city
from lidarsim import LidarError, Noise, Pose, Scanner, Scene, Sensor, Survey, Track, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.sensor.models import read_model
from lidarsim.sweeps.sweeps import Sweeps

pytest.importorskip("scipy", reason="the extra fit is not installed")

NOISE = Noise(range_m=0.02, range_per_m=0.0005, angle_deg=0.08, dropout=0.02, seed=3)


@pytest.fixture(scope="module")
def recording():
    return recorded(NOISE)


@pytest.fixture(scope="module")
def fitted(recording):
    return fit(recording)


def measured(*, tilts_deg=(10.0, 20.0, 30.0), **fields):
    """Return a measurement of 60 rays in each of three rings, with values by formulas."""
    row = np.repeat(np.arange(3), 60)
    distance = np.tile(np.linspace(5, 30, 60), 3)
    rays = SmoothRays(
        row=row,
        column=np.tile(np.arange(60), 3),
        distance=distance,
        slope=distance * np.tan(np.radians(tilts_deg))[row],
        intensity=100 / distance,
        return_counts=np.full(180, 7),
        trials=np.full(180, 10),
        variance=0.01**2 * (row + 1) ** 2
        + (np.radians(0.1) * distance * np.tan(np.radians(25))) ** 2,
        freedom=np.where(np.arange(180) % 60 < 10, 0, 6),
    )
    offsets = np.zeros((4, 3, 60), np.float32)
    offsets[:, 1] = np.radians(0.02) * np.arange(60)  # 0.02° from column to column
    stack = SimpleNamespace(
        sweep_count=4, azimuth_offsets=offsets, rings=[5, 3, 8], elevation_deg=[3.0, 1.0, -7.5]
    )
    defaults = {"energy": None, "estimates": {}, "bias": {1: Estimate(0.02, 0.01, 0.03)}}
    return SensorMeasurement(stack, rays, **defaults | fields)


def test_curves_have_the_values_of_the_rays():
    one = measured(tilts_deg=[25.0] * 3, estimates={"angle_deg": Estimate(0.1, 0.0, 0.2)})
    curves = one.curves()
    # Without the contribution of directions, which is greater on steeper surfaces.
    noise_m = [point["value"] for point in curves["noise_by_range"]]
    expected_m = 0.01 * np.sqrt((1 + 4 + 9) / 3)
    assert noise_m == pytest.approx([expected_m] * len(noise_m), rel=0.1)
    assert all(point["low"] < point["value"] < point["high"] for point in curves["noise_by_range"])
    for point in curves["light_by_range"]:
        assert point["value"] == pytest.approx(100 / point["x"], rel=0.08)
    assert all(point["value"] == pytest.approx(0.7) for point in curves["returned_by_light"])
    assert "lost_by_range" not in curves
    lost = [{"x": 9.0, "value": 0.1, "low": 0.0, "high": 0.2}]
    assert replace(one, lost_by_range=lost).curves()["lost_by_range"] == lost
    bright = replace(one, energy=np.linspace(2, 3, 180)).curves()
    assert all(2 <= point["x"] <= 3 for point in bright["noise_by_light"])
    alone = replace(one, stack=SimpleNamespace(sweep_count=1))
    assert "returned_by_light" not in alone.curves()
    for name, expected in (("noise_by_light", expected_m**2), ("noise_by_tilt", None)):
        squares = [point["value"] ** 2 for point in bright[name]]
        expected = expected or one.rays.variance[one.rays.freedom > 0].mean()
        assert np.mean(squares) == pytest.approx(expected, rel=0.05)
    # Single returns have no variance.
    alone = replace(one, rays=one.rays._replace(freedom=np.zeros(180, int)))
    assert alone.curves()["noise_by_tilt"] == []
    tilts = [point["x"] for point in measured().curves()["noise_by_tilt"]]
    assert sorted(tilts) == tilts
    assert min(tilts) == pytest.approx(10) and max(tilts) == pytest.approx(30)


def test_channels_have_the_values_of_their_rays():
    first, second, third = measured().channels()
    assert [one["ring"] for one in (first, second, third)] == [5, 3, 8]
    assert [one["elevation_deg"] for one in (first, second, third)] == [3.0, 1.0, -7.5]
    assert {one["rays"] for one in (first, second, third)} == {50}
    assert first["bias_m"] is third["bias_m"] is None
    assert second["bias_m"] == {"value": 0.02, "low": 0.01, "high": 0.03}
    # The variance of the difference of two azimuths is twice that of one.
    assert second["uneven_deg"]["value"] == pytest.approx(0.02 / np.sqrt(2), rel=1e-3)
    assert first["uneven_deg"]["value"] == 0
    assert [one["uneven_deg"] for one in measured(moves=True).channels()] == [None] * 3
    several = measured()
    alone = SimpleNamespace(**vars(several.stack))
    alone.azimuth_offsets = alone.azimuth_offsets[:1]
    assert replace(several, stack=alone).channels()[1]["uneven_deg"] is None
    steep = measured(
        tilts_deg=[25.0] * 3, estimates={"angle_deg": Estimate(0.1, 0.0, 0.2)}
    ).channels()
    noise_m = [one["noise_m"]["value"] for one in steep]
    assert noise_m == pytest.approx([0.01, 0.02, 0.03], rel=1e-6)


@pytest.mark.slow
def test_intervals_hold_what_was_put_in():
    """Ten trials in a street; figures that are not determined are rare."""
    held = []
    for number in range(10):
        truth, found = trial(number)
        for name, true in truth.items():
            if (one := found.get(name)) is None:
                continue
            held.append(one["low"] <= true <= one["high"])
            assert abs(one["value"] - true) < 5 * max(one["high"] - one["low"], 1e-6) / 2, name
    assert len(held) > 45 and np.mean(held) > 0.85


@pytest.mark.slow
def test_the_file_is_a_sensor_with_these_figures(fitted, tmp_path):
    written = fitted.save(tmp_path / "mine.yaml")
    assert [path.name for path in written] == ["mine.yaml", "mine.html"]
    stated = yaml.safe_load(written[0].read_text())
    noise = read_model(written[0]).datasheet().noise
    figures = fitted.figures["figures"]
    for name in ("range_m", "range_per_m", "angle_deg"):
        assert getattr(noise, name) == pytest.approx(figures[name]["value"], rel=1e-3)
    sensor = load_sensor(written[0])
    assert sensor.channels == 16 and sensor.period == 360
    assert "12 sweeps" in stated["sources"]["performance"]
    again = fitted.save(tmp_path / "again.yaml")
    assert [one.read_bytes() for one in again] == [one.read_bytes() for one in written]
    with pytest.raises(LidarError, match=r"not a sensor file\. Use a file name with"):
        fitted.save(tmp_path / "mine.json")


@pytest.mark.slow
def test_the_page_has_all_figures_and_says_what_is_unknown(fitted, tmp_path):
    page = fitted.save(tmp_path / "mine.yaml")[1].read_text()
    assert page.count("data-figure=") == len(fitted.figures["figures"])
    assert page.count("data-ring=") == 16 and page.count("<svg") == 1
    assert "lose half of its pulses" in page and "<script" not in page
    text = repr(fitted)
    assert "unknown: detection_range_m" in text and "range_per_m" in text


@pytest.mark.extended
def test_noise_by_energy_is_in_the_file(tmp_path):
    truth = {"range_m": 0.015, "range_at_threshold_m": 0.07, "detection_range_m": 10}
    made = fit(recorded(Noise(**truth, dropout=0.01, angle_deg=0.05, seed=1)))
    noise = read_model(made.save(tmp_path / "mine.yaml")[0]).datasheet().noise
    for name, true in {**truth, "dropout": 0.01}.items():
        assert getattr(noise, name) == pytest.approx(true, rel=0.1), name


@pytest.mark.extended
def test_a_model_keeps_what_the_recording_does_not_tell(recording):
    flat = fit(recording, model="ouster/os1-64")
    stated = flat.model.performance
    assert stated.detection.range_m == 90 and stated.precision is None
    assert flat.model.firings_per_turn == 1024
    assert (
        "note: the recorded rings do not match the rings of Livox Mid-40. Check `--model`"
        in repr(fit(recording, model="mid40"))
    )


def test_range_noise_of_a_model_stays_if_none_was_fitted():
    """Private, since no recording of a simulation lacks figures of range noise alone."""
    model = read_model("ouster/os1-64")
    dropout = {"dropout": Estimate(0.1, 0.05, 0.15)}
    fitted = _with_performance(model, dropout, "a recording").performance
    assert fitted.dropout == 0.1
    assert (fitted.range_m, fitted.range_per_m) == (0.0005, 0.000444)
    assert fitted.detection == model.performance.detection


@pytest.mark.slow
def test_bias_of_channels_against_planes_and_against_the_scene():
    bias = 0.005 * (-1.0) ** np.arange(16)
    made = recorded(Noise(range_m=0.01, seed=2), bias)
    for scene in (None, street()):
        rows = fit(made, scene=scene).figures["channels"]
        known = [row for row in rows if row["bias_m"]]
        assert len(known) == (16 if scene else 9)  # seven rings meet a single plane
        middle = 0 if scene else bias[[row["ring"] for row in known]].mean()
        for row in known:
            one = row["bias_m"]
            true = bias[row["ring"]] - middle
            assert abs(one["value"] - true) < max(one["high"] - one["low"], 0.002), row
    found = fit(made, scene=street()).figures["curves"]
    assert len(found["lost_by_range"]) > 3 and found["lost_by_range"][0]["value"] < 0.01
    with pytest.raises(LidarError, match="Less than half of the points in simulated are within"):
        fit(made, scene=street(), pose=(3, 1, 0))


@pytest.mark.extended
def test_beams_that_begin_beside_zero_bias_no_ring():
    sensor = load_sensor("ouster/os1-32", columns=512)
    quiet = {"noise": Noise(range_m=0.003), "precision_m": 1e-4, "coordinates": "sensor"}
    scanner = Scanner(street(), sensor, **quiet)
    made = [scanner.sweep((0, 0, 0), number=k) for k in range(4)]
    found = fit(made_recording("os1", 4, lambda k: Sweep(made[k].positions, made[k].columns)))
    bias = [row["bias_m"]["value"] for row in found.figures["channels"] if row["bias_m"]]
    assert len(bias) > 15 and np.abs(bias).max() < 0.001


def test_a_single_sweep_tells_bias_alone(recording):
    single = fit(changed_recording(recording, count=1))
    assert not single.figures["figures"] and "there is only one sweep" in repr(single)
    assert single.model.performance is None
    known = [row for row in single.figures["channels"] if row["bias_m"]]
    assert len(known) > 8  # the others meet a single plane


def drive(scene, height_m, step_m, yaw_deg=0.0, sweeps=6):
    """Sweeps of a VLP-16 at 20 Hz that goes ahead and turns from sweep to sweep."""
    sensor = load_sensor("velodyne/vlp16", rate_hz=20)
    scanner = Scanner(scene, sensor, coordinates="sensor", noise=Noise(range_m=0.01, seed=1))
    clouds = [
        scanner.sweep(
            Pose((-20 + step_m * number, 0.2, height_m), yaw_deg=yaw_deg * number), number=number
        )
        for number in range(sweeps)
    ]

    def read(number):
        return Sweep(clouds[number].positions, clouds[number].columns)

    return made_recording("drive.pcap", sweeps, read, read_stamps=lambda: 5e7 * np.arange(sweeps))


@pytest.fixture(scope="module")
def block():
    return city(30_000, seed=1)


@pytest.mark.slow
def test_a_sensor_that_moves_is_refused_with_its_speed(block):
    """26 m/s, 0.06 m a sweep, and a turn on the spot; most ranges of a street stay the same."""
    cases = (street(), 0.0, 1.3, 0.0), (block, 1.8, 1.3, 0.0), (block, 1.8, 0.06, 0.0)
    for scene, height_m, step_m, yaw_deg in cases:
        with pytest.raises(LidarError, match="was recorded by a sensor that moves") as raised:
            fit(drive(scene, height_m, step_m, yaw_deg))
        told = str(raised.value)
        speed = float(told.partition("(")[2].partition(" m/s")[0])
        assert speed == pytest.approx(step_m / 0.05, rel=0.1), told
        assert len(told.splitlines()) == 1
    with pytest.raises(LidarError, match=r"moves by .*2(.[01])?° between sweeps"):
        fit(drive(block, 1.8, 0.0, 2.0))


def parked_street():
    """Parked cars and posts before high walls along x: nearly all ranges are those of walls."""
    rng = np.random.default_rng(0)
    boxes = [
        box("ground", (-300, -20, -2), (300, 20, -1.8)),
        box("left", (-300, 8, -1.8), (300, 9, 8)),
        box("right", (-300, -9, -1.8), (300, -8, 8)),
    ]
    for number, x in enumerate(np.cumsum(rng.uniform(5.5, 14, 20)) - 100):
        y = rng.choice([-5, 5])
        boxes.append(box(f"car{number}", (x, y - 0.9, -1.8), (x + 4.4, y + 0.9, -0.35)))
    for number, x in enumerate(np.arange(-100, 100, 6.25)):
        y = 6.8 * (-1) ** number
        boxes.append(box(f"post{number}", (x, y, -1.8), (x + 0.12, y + 0.12, 4)))
    return Scene.from_meshes(boxes)


@pytest.mark.extended
def test_a_drive_along_walls_is_found_by_parked_cars_and_posts():
    """26 m/s, of which most rays know nothing: such a drive looks like standing."""
    scene = parked_street()
    with pytest.raises(LidarError, match="was recorded by a sensor that moves") as raised:
        fit(drive(scene, 0.0, 1.3))
    told = str(raised.value)
    assert float(told.partition("(")[2].partition(" m/s")[0]) == pytest.approx(26, rel=0.05), told
    assert (
        "Pass a mesh of its scene with `--scene` and one `--pose` for each sweep, or use sweeps "
        "from a stationary sensor. `lidarpool twin` reconstructs such a scene" in told
    )


def survey_along(speed_m_s, noise, sweeps=6):
    """Survey of a VLP-16 at 20 Hz along x in a `parked_street`, with the times of points."""
    sensor = load_sensor("velodyne/vlp16", rate_hz=20)
    stop_m = -20 + speed_m_s * 0.4
    return Survey(
        sensor, trajectory=Track([0, 0.4], [[-20, 0.2, 0], [stop_m, 0.2, 0]]), noise=noise,
        steps=sensor.steps_of_revolution(sweeps - 1).stop, columns=["intensity", "time"],
        precision_m=1e-4,
    )  # fmt: skip


@pytest.mark.slow
def test_poses_of_a_result_are_used(cluster_client):
    """The result of a drive at 26 m/s is fitted in its scene, and refused without a scene."""
    scene = parked_street()
    cloud = simulate(scene, survey_along(26, Noise(range_m=0.01)), client=cluster_client).cloud
    with pytest.raises(
        LidarError,
        match=r"by 1.3 m \(26 m/s\) .* Pass a mesh of the scene to which its poses refer",
    ):
        fit(cloud)
    fitted = fit(cloud, scene=scene)
    dropout = fitted.figures["figures"]["dropout"]
    assert dropout["value"] == 0 and dropout["high"] < 0.001
    assert fitted.figures["figures"]["range_m"]["value"] == pytest.approx(0.01, rel=0.1)
    assert "pulses on smooth surfaces of the scene" in repr(fitted)


@pytest.mark.slow
@pytest.mark.parametrize("dropout", [0.0, 0.02])
def test_poses_of_sweeps_are_used(cluster_client, dropout):
    """Points without the motion of the sensor: steps of azimuth differ, and no pulse is lost."""
    scene = parked_street()
    survey = survey_along(26, Noise(range_m=0.01, dropout=dropout, seed=2))
    result = open_recording(simulate(scene, survey, client=cluster_client).cloud)
    located = changed_recording(result, fired=None)
    unlocated = changed_recording(
        located, read_poses=None, read=lambda k: result.load(k).replace(pose=None)
    )
    for recording, pose in ((located, None), (unlocated, result.load_poses())):
        figures = fit(recording, scene=scene, pose=pose).figures["figures"]
        assert figures["dropout"]["value"] == pytest.approx(dropout, rel=0.15, abs=0.001)
        assert figures["range_m"]["value"] == pytest.approx(0.01, rel=0.1)


@pytest.mark.slow
def test_poses_that_are_given_are_one_or_one_for_each_sweep_of_a_scene():
    scene = parked_street()
    made = drive(scene, 0.0, 1.3)
    poses = [(-20 + 1.3 * number, 0.2, 0) for number in range(6)]
    assert fit(made, scene=scene, pose=poses).figures["figures"]["dropout"]["high"] < 0.001
    for pose, where, says in (
        (poses[:2], scene, r"`pose` contains 2 poses, but drive.pcap has 6 sweeps. Pass one pose"),
        (poses, None, "by 1.3 m .* Pass a mesh of the scene to which its poses refer"),
        (poses[0], None, "`pose` requires `scene`"),
        ([(x, y + 1, z + 1) for x, y, z in poses], scene, "Less than half of .* are within 0.3 m"),
        (np.full((6, 4, 4), np.nan), scene, "Matrix 0 of a pose deforms"),
        (poses[0], scene, "by 1.3 m .* Pass a mesh of its scene with `--scene` and one `--pose`"),
    ):
        with pytest.raises(LidarError, match=says) as raised:
            fit(made, scene=where, pose=pose)
        assert len(str(raised.value).splitlines()) == 1


@pytest.mark.extended
def test_a_slow_sensor_is_refused_with_its_speed(block):
    """Steps of 15 mm are not told from noise; nine of these are."""
    with pytest.raises(LidarError, match="was recorded by a sensor that moves") as raised:
        fit(drive(block, 1.8, 0.015, sweeps=10))
    speed = float(str(raised.value).partition("(")[2].partition(" m/s")[0])
    assert speed == pytest.approx(0.3, rel=0.15)


@pytest.mark.extended
def test_a_sensor_that_creeps_is_refused_with_its_speed(block):
    """Steps of 4 mm: no two sweeps are far enough apart, but all of them together show it."""
    with pytest.raises(LidarError, match="was recorded by a sensor that moves") as raised:
        fit(drive(block, 1.8, 0.004, sweeps=12))
    speed = float(str(raised.value).partition("(")[2].partition(" m/s")[0])
    assert speed == pytest.approx(0.08, rel=0.1)


@pytest.mark.slow
def test_a_sensor_that_stands_is_fitted_beside_cars_that_move(block):
    stands = drive(block, 1.8, 0.0)

    def passed(number):
        """Points of a van of 5 by 2 m that comes along the street; what is behind it is hidden."""
        sweep = stands.load(number)
        points = sweep.points
        ahead = np.array([8.0 - 1.3 * number, 3.0])
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        middle = np.arctan2(ahead[1], ahead[0])
        hit = (np.abs(azimuth - middle) < 0.12) & (np.abs(points[:, 2]) < 2)
        flat = np.hypot(points[:, 0], points[:, 1])
        near = np.where(hit, np.minimum(1, np.hypot(*ahead) / np.maximum(flat, 0.1)), 1)
        return sweep.replace(points=points * near[:, None])

    assert fit(changed_recording(stands, read=passed)).figures["sweeps"] == 6


@pytest.mark.extended
def test_points_that_are_not_in_meters_are_refused(recording):
    def scaled(number):
        sweep = recording.load(number)
        return sweep.replace(points=sweep.points * 1000)

    with pytest.raises(LidarError, match=r"The ranges in .* change by .* Use points in meters"):
        fit(changed_recording(recording, read=scaled))


@pytest.mark.extended
def test_gaps_and_sweeps_cut_short_are_no_lost_pulses():
    """Sweeps without lost pulses, in which packets are missing and every third is cut."""
    whole = recorded(replace(NOISE, dropout=0.0))

    def holed(number):
        sweep = whole.load(number)
        points = sweep.points
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
        kept = (azimuth > 110) | (number % 3 > 0)
        for begin in np.random.default_rng(number).uniform(0, 360, 8):
            kept &= (azimuth < begin) | (azimuth > begin + 6)
        return sweep.select(kept)

    fitted = fit(changed_recording(whole, read=holed))
    figures = fitted.figures["figures"]
    lost = figures["dropout"]
    assert lost["value"] < 1e-4
    assert 0 <= lost["low"] <= lost["value"] < lost["high"] < 1e-3  # also of no lost pulse
    assert figures["range_m"]["low"] < NOISE.range_m < figures["range_m"]["high"]
    assert "% of the cells in the sweeps are gaps, which are runs of cells" in repr(fitted)
    lossy = recorded(replace(NOISE, dropout=0.1))
    figures = fit(changed_recording(lossy, read=lossy.load)).figures["figures"]
    assert figures["dropout"]["low"] < 0.1 < figures["dropout"]["high"]


def test_two_sweeps_tell_a_large_share_of_lost_pulses():
    """Rays without any return are unknown: what is lost of the known rays is less."""
    lossy = recorded(replace(NOISE, dropout=0.3), sweeps=2)
    lost = fit(lossy).figures["figures"]["dropout"]
    assert lost["value"] == pytest.approx(0.3, abs=0.02)
    assert lost["low"] < 0.3 < lost["high"]


def with_points(recording, chosen, points_of):
    """Keep the chosen points of each sweep, and add others: points (n, 3) of rings (n,)."""

    def read(number):
        sweep = recording.load(number)
        added, rings, light = points_of(number)
        return Sweep.concatenate(
            [
                sweep.select(chosen(number, sweep.points, sweep.columns["channel"])),
                Sweep(added, {"channel": rings, "intensity": light}),
            ]
        )

    return changed_recording(recording, read=read)


def directions_of(rings, columns):
    """Return unit vectors (n, 3) of the rings and columns of the simulated sensor."""
    azimuth = np.radians(columns)
    elevation = np.radians(np.linspace(-20, 20, 16)[rings])
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


def test_rings_of_false_alarms_alone_are_of_the_same_sensor(recording):
    """The upper half of the rings looks at the sky, and has no return in some sweeps."""
    share = 0.002

    def alarms(number):
        rng = np.random.default_rng(number + 40)
        rings, columns = np.nonzero(rng.random((16, 360)) < share)
        upper = rings >= 8
        rings = rings[upper]
        away = directions_of(rings, columns[upper])
        return away * rng.uniform(1, 120, (len(rings), 1)), rings, np.full(len(rings), 0.001)

    lower = with_points(recording, lambda number, points, rings: rings < 8, alarms)
    of_sweeps = [len(np.unique(lower.load(k).columns["channel"])) for k in range(len(lower))]
    assert max(of_sweeps[:3]) < 14
    fitted = fit(lower)
    assert len(fitted.figures["channels"]) == 16
    estimate = fitted.figures["figures"]["false_alarms"]
    assert estimate["low"] < share < estimate["high"] < 2 * share


@pytest.mark.extended
def test_what_a_single_sweep_covers_tells_no_false_alarms(recording):
    """A third of the turn is in the first sweep only, and few of the returns there repeat."""

    def covered(number, points, rings):
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
        return (azimuth > 120) | (number == 0)

    def nothing(number):
        return np.zeros((0, 3)), np.zeros(0, int), np.zeros(0)

    figures = fit(with_points(recording, covered, nothing)).figures["figures"]
    assert "false_alarms" not in figures


@pytest.mark.extended
def test_points_on_the_sensors_cover_tell_nothing(recording):
    """Half of the pulses of four rings return from 1 cm, and are brighter than all others."""

    def cover(number):
        rng = np.random.default_rng(number)
        rings, columns = np.nonzero(rng.random((4, 360)) < 0.5)
        near = directions_of(rings + 12, columns) * rng.normal(0.01, 0.002, (len(rings), 1))
        return near, rings + 12, np.full(len(rings), 1e5)

    figures = fit(with_points(recording, lambda number, points, rings: rings < 12, cover)).figures[
        "figures"
    ]
    assert figures["dropout"]["low"] < NOISE.dropout < figures["dropout"]["high"]
    assert figures["range_m"]["low"] < NOISE.range_m < figures["range_m"]["high"]


@pytest.mark.extended
def test_ranges_that_drift_are_refused():
    """3 mm a sweep, less than their noise, as of a sensor that warms up; no motion explains it."""
    steady = recorded(Noise(range_m=0.006, angle_deg=0.02, dropout=0.02, seed=3))
    assert fit(steady).figures["figures"]["range_m"]["value"] == pytest.approx(0.006, rel=0.1)

    def longer(number):
        sweep = steady.load(number)
        ranges = np.linalg.norm(sweep.points, axis=1, keepdims=True)
        return sweep.replace(points=sweep.points * (1 + 0.003 * number / ranges))

    with pytest.raises(LidarError, match=r"The ranges in .* drift: .* over 6 sweeps"):
        fit(changed_recording(steady, read=longer))


@pytest.mark.extended
def test_rings_that_meet_surfaces_steeply_have_no_bias(recording):
    """The ground alone, at 70° to 80°."""

    def nothing(number):
        return np.zeros((0, 3)), np.zeros(0, int), np.zeros(0)

    ground = with_points(recording, lambda number, points, rings: points[:, 2] < -1.6, nothing)
    fitted = fit(ground)
    channels = fitted.figures["channels"]
    assert channels and all(row["bias_m"] is None for row in channels)
    assert fitted.figures["figures"]["dropout"]["value"] == pytest.approx(0.02, rel=0.2)


@pytest.mark.extended
def test_bias_of_rings_is_as_uncertain_as_the_planes_are():
    """Things beside the walls of this hall tilt the planes that are found."""
    truth, fitted = trial(30, place_name="hall")
    held = [
        estimate["low"] <= truth[name] <= estimate["high"]
        for name, estimate in fitted.items()
        if name.startswith("bias_m")
    ]
    assert len(held) > 10 and np.mean(held) > 0.85


@pytest.mark.slow
@pytest.mark.slow(keep=("street", "forest"))
@pytest.mark.parametrize("where", PLACES)
def test_intervals_hold_in_rooms_streets_halls_and_forests(where):
    """Two recordings of a place each; fidelity.md has 40."""
    for number in (PLACES.index(where), PLACES.index(where) + 4):
        truth, fitted = trial(number, place_name=where)
        assert "dropout" in fitted
        for name, true in truth.items():
            if name in fitted:
                half = (fitted[name]["high"] - fitted[name]["low"]) / 2
                assert abs(fitted[name]["value"] - true) < 2 * half, (number, name)


@pytest.mark.slow
def test_where_only_the_ground_is_smooth_noise_is_not_determined():
    noise = Noise(range_m=0.02, range_per_m=0.0005, angle_deg=0.1, dropout=0.02, seed=3)
    scene, at = place("forest", 3)
    figures = fit(recorded(noise, scene=scene, position=at, columns=600))
    assert not {"range_m", "range_per_m", "angle_deg"} & set(figures.figures["figures"])
    assert "almost all smooth surfaces are hit at 45° or more" in repr(figures)
    assert figures.figures["figures"]["dropout"]["value"] == pytest.approx(0.02, rel=0.3)


@pytest.mark.extended
def test_intensities_of_unknown_scale_need_the_white_one():
    made = changed_recording(
        recorded(Noise(range_m=0.01, detection_range_m=10, seed=4)), energy_unit=None
    )
    found = fit(made)
    assert "detection_range_m" not in found.figures["figures"]
    assert "--white-intensity" in repr(found)

    def calibrated(number):
        sweep = made.load(number)
        square = (sweep.points**2).sum(axis=1)
        intensity = sweep.columns["intensity"] * square / 100 * 255
        return sweep.replace(columns={**sweep.columns, "intensity": intensity})

    found = fit(changed_recording(made, read=calibrated), white=255)
    assert found.figures["figures"]["detection_range_m"]["value"] == pytest.approx(10, rel=0.03)


@pytest.mark.extended
def test_cut_and_mixed_recordings_are_told_in_a_line(recording, tmp_path):
    def cut(number):
        sweep = recording.load(number)
        return sweep.select(slice(len(sweep) // 3)) if number == 5 else sweep

    assert "5.6 % of the cells in the sweeps are gaps" in repr(
        fit(changed_recording(recording, read=cut))
    )
    other = Scanner(street(), Sensor.grid(360, 40, vertical_fov_deg=80), coordinates="sensor")
    cloud = other.sweep((0, 0, 0))
    foreign = Sweep(cloud.positions, cloud.columns)

    def mixed(number):
        return foreign if number == 5 else recording.load(number)

    nothing = Sweep(np.zeros((0, 3)), {"channel": np.zeros(0, int)})
    scattered = Sweep(np.random.default_rng(0).normal(0, 10, (5000, 3)))
    for made, says in (
        (
            changed_recording(recording, read=mixed),
            "come from different sensors|comes from a different sensor",
        ),
        (
            changed_recording(recording, read=lambda number: nothing),
            "contains no points, so there is nothing to fit",
        ),
        (changed_recording(recording, count=0), "contains no sweeps"),
        (changed_recording(recording, thinned=True, notes=("one of 5 hits",)), "one of 5 hits"),
        (
            changed_recording(recording, read=lambda number: scattered),
            "has no ring column",
        ),
    ):
        with pytest.raises(LidarError, match=says) as raised:
            fit(made)
        assert len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["empty.pcap", "cut.pcap", "text.osf"])
def test_broken_files_are_told_in_a_line(tmp_path, name):
    pytest.importorskip("velodyne_decoder")
    frame = b"\0" * 600
    head = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    record = struct.pack("<IIII", 1, 0, 1248, 1248)
    content = {"empty.pcap": b"", "cut.pcap": head + record + frame, "text.osf": b"no scans"}
    (tmp_path / name).write_bytes(content[name])
    with pytest.raises(LidarError) as raised:
        fit(tmp_path / name)
    assert name in str(raised.value) and len(str(raised.value).splitlines()) == 1


def round_room(first_us=0):
    """Return times and packets of a VLP-16 in the middle of a round room of 5 m.

    The first packet is sent at `first_us` past the hour.
    """
    blocks = 12
    for number in range(76 * 4):
        data = b""
        for block in range(blocks):
            azimuth = round((number * blocks + block) * 39.8133) % 36000
            data += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", 2500, 50) * 32
        micros = round(number * blocks * 110.592)
        stamp_us = (first_us + micros) % 3_600_000_000
        yield 1000 * micros, data + struct.pack("<IBB", stamp_us, 0x37, 0x22)


def test_packets_of_a_velodyne_are_sweeps(tmp_path):
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "room.pcap"
    frames = [(time_ns, MACS + IPV4 + ip_packet(data)) for time_ns, data in round_room()]
    path.write_bytes(pcap(frames))
    opened = open_recording(path)
    sweep = opened[1]
    assert len(opened) >= 3 and opened.info.white == 100 and set(sweep.intensity) == {50.0}
    assert len(np.unique(sweep.rings)) == 16
    assert np.linalg.norm(sweep.points, axis=1) == pytest.approx(5, abs=0.05)
    # A sweep has the time of its first packet, and its points have times since then.
    times_s = sweep.columns["time"]
    assert 0 <= times_s.min() < 0.002 and times_s.max() == pytest.approx(0.1, abs=0.002)
    assert opened.stamps_ns[1] == pytest.approx(1e8, abs=4e6)  # three packets
    # Each packet has 12 blocks of 32 points, those of the unfinished last sweep included.
    sizes = [len(sweep) for sweep in opened]
    assert sum(sizes) == 76 * 4 * 12 * 32 and sizes[-1] > 0
    other = [
        (time_ns, MACS + IPV4 + ip_packet(data, source=(10, 0, 0, 7)))
        for time_ns, data in [*round_room()][:120]
    ]
    path.write_bytes(pcap(sorted([*frames, *other])))
    with pytest.raises(
        LidarError, match=r"sensors 10\.0\.0\.7:2368 and 192\.168\.1\.201:2368\. Choose"
    ):
        open_recording(path)
    counts = [
        len(open_recording(path, sensor=f"{address}:2368"))
        for address in ("192.168.1.201", "10.0.0.7")
    ]
    assert counts == [len(opened), 2]


def rearranged(packets, order):
    """Return packets in another order. Their capture times stay ascending."""
    times = sorted(packets[row][0] for row in order)
    return [(time_ns, packets[row][1]) for time_ns, row in zip(times, order, strict=True)]


def swapped(row):
    """Return the order of packets of which two neighbors, the first of them `row`, are swapped."""
    order = [*range(76 * 4)]
    order[row : row + 2] = row + 1, row
    return order


LATE_BY_10 = [*range(100), *range(101, 111), 100, *range(111, 76 * 4)]
FAR = [*range(100), *range(101, 131), 100, *range(131, 76 * 4)]  # 30 packets late: not sorted


@pytest.mark.parametrize(
    ("order", "first_us", "notes"),
    [
        (swapped(100), 0, ["1 packet out of order"]),
        (swapped(75), 0, ["1 packet out of order"]),  # a sweep begins between them
        (swapped(0), 0, ["1 packet out of order"]),
        (swapped(76 * 4 - 2), 0, ["1 packet out of order"]),
        (swapped(150), 3_599_999_999 - 150 * 1327, ["1 packet out of order"]),  # a new hour
        (LATE_BY_10, 0, ["1 packet out of order"]),
        (np.repeat(range(76 * 4), 2), 0, ["304 duplicate packets"]),
        (np.repeat(swapped(100), 2), 0, ["1 packet out of order", "304 duplicate packets"]),
        (range(76 * 4), 0, []),
        (range(76 * 4), 3_599_999_999 - 150 * 1327, []),
    ],
)
def test_packets_of_a_velodyne_are_sorted(tmp_path, order, first_us, notes):
    pytest.importorskip("velodyne_decoder")
    packets = [*round_room(first_us)]
    path = tmp_path / "room.pcap"

    def read(frames):
        path.write_bytes(pcap((time_ns, MACS + IPV4 + ip_packet(data)) for time_ns, data in frames))
        return open_recording(path)

    plain = read(packets)
    sweeps = [sweep.points for sweep in plain]
    times_s = [sweep.columns["time"] for sweep in plain]
    found = read(rearranged(packets, order))
    assert len(found) == len(sweeps) >= 4
    for number, sweep in enumerate(found):
        np.testing.assert_array_equal(sweep.points, sweeps[number])
        np.testing.assert_allclose(sweep.columns["time"], times_s[number], atol=2e-6)
    np.testing.assert_allclose(found.stamps_ns, plain.stamps_ns, atol=2e6)
    assert len(found.notes) == len(notes)
    assert all(words in note for words, note in zip(notes, found.notes, strict=True))


def test_a_velodyne_whose_clock_is_set_back_keeps_its_packets(tmp_path):
    """A repeated revolution, and packets that are too late, are not duplicates."""
    pytest.importorskip("velodyne_decoder")
    packets = [*round_room()]
    for order in ([*range(200), *range(124, 76 * 4)], FAR):
        frames = [
            (time_ns, MACS + IPV4 + ip_packet(data)) for time_ns, data in rearranged(packets, order)
        ]
        (tmp_path / "room.pcap").write_bytes(pcap(frames))
        recording = open_recording(tmp_path / "room.pcap")
        assert sum(map(len, recording)) == len(order) * 12 * 32
        assert [*recording.notes] == []


def hdl64e(model, lasers=range(64)):
    """Yield times and packets of an HDL-64E in the middle of a round room, with its calibration.

    Each packet ends with a byte of the state: the date and the like, then a table of 1,820 bytes.
    Laser n has an elevation of (n - 40) / 2 degrees, and its ranges are n mm short of 5 m + n mm.
    """
    crc16 = pytest.importorskip("velodyne_decoder.hdl64e").crc16
    rows = [struct.pack("<B9hBB", n, 50 * (n - 40), 0, n, n, n, 0, 0, 0, 0, 0, 255) for n in lasers]
    end = (
        bytes([16, 11, 15, 12, 47, 47, 25]) + struct.pack("<hHHH", 600, 0, 36000, 2685) + bytes(11)
    )
    table = b"UNIT#\x18\x18" + b"".join(row.ljust(28, b"\0") for row in rows)[:-7] + end
    check = crc16(b"".join(row[1:21] for row in rows)) if model == "S3" else 1820
    table += struct.pack("<H", check)
    kinds = "W" if model == "S3" else "1234567"
    state = [*zip(b"HMSDNYGTV", bytes([0, 5, 54, 1, 1, 0, 0, 20, 227]), strict=True)]
    state += [(ord(kinds[k % len(kinds)]), value) for k, value in enumerate(table)]
    for number, (kind, value) in enumerate(state):
        data = b""
        for firing in range(6):
            azimuth = round((number * 6 + firing) * 17.28) % 36000
            for flag in (0xEEFF, 0xDDFF):
                data += struct.pack("<HH", flag, azimuth) + struct.pack("<HB", 2500, 50) * 32
        micros = round(number * 288)
        yield 1000 * micros, data + struct.pack("<IBB", micros, kind, value)


@pytest.mark.extended(keep=("S3",))
@pytest.mark.parametrize("model", ["S2", "S3"])
def test_an_hdl64e_is_read_by_the_calibration_in_its_packets(model, tmp_path):
    decoder = pytest.importorskip("velodyne_decoder")
    path = tmp_path / "room.pcap"

    def read(*lasers):
        frames = [
            (time_ns, MACS + IPV4 + ip_packet(data)) for time_ns, data in hdl64e(model, *lasers)
        ]
        path.write_bytes(pcap(frames))
        return open_recording(path)[1]

    sweep = read()
    points = sweep.points
    columns = sweep.columns
    distances = np.linalg.norm(points, axis=1)
    elevations = np.degrees(np.arcsin(points[:, 2] / distances))
    rings = columns["channel"].astype(int)
    assert np.array_equal(np.unique(rings), np.arange(64))
    np.testing.assert_allclose(distances, 5 + 0.001 * rings, atol=1e-5)
    np.testing.assert_allclose(elevations, (rings - 40) / 2, atol=1e-4)
    config = decoder.Config(timestamp_first_packet=True)
    _, rows = [*decoder.read_pcap(str(path), config)][1]  # which finds the model by itself
    assert np.array_equal(points, rows[:, :3])
    assert np.array_equal(columns["intensity"], rows[:, 3])
    assert np.array_equal(columns["time"], rows[:, 4])
    with pytest.raises(LidarError, match="the calibration in its packets is incomplete"):
        read([0] * 64)


ROOM_CAPTURES = variants(round_room())


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("name", ROOM_CAPTURES)
def test_a_velodyne_is_read_from_any_capture(name, tmp_path):
    pytest.importorskip("velodyne_decoder")
    (tmp_path / "room.pcap").write_bytes(ROOM_CAPTURES[name])
    opened = open_recording(tmp_path / "room.pcap")
    (tmp_path / "plain.pcap").write_bytes(ROOM_CAPTURES["plain"])
    plain = open_recording(tmp_path / "plain.pcap")
    assert len(opened) == len(plain)
    assert np.array_equal(opened[1].points, plain[1].points)
    assert opened.stamps_ns == pytest.approx(plain.stamps_ns, rel=0, abs=2000)


@pytest.mark.extended
def test_a_kitti_sequence_is_fitted_by_the_rings_in_its_points(cluster_client, tmp_path):
    survey = Survey(
        Sensor.grid(360, 16, vertical_fov_deg=40, max_range_m=120), poses=[(0, 0, 0)] * 4,
        steps=36, columns=["intensity", "reflectivity", "class"], noise=NOISE, precision_m=1e-4,
    )  # fmt: skip
    cloud = simulate(street(), survey, client=cluster_client).cloud
    save_cloud(cloud, tmp_path / "kitti", format="kitti")
    found = fit(tmp_path / "kitti", white=1.0).figures
    assert found["notes"] == [
        f"{tmp_path / 'kitti'} has no ring column. Its 16 rings were determined from the "
        "elevation angles of the points"
    ]
    stated = fit(cloud).figures
    assert stated["notes"] == []
    for name in ("range_m", "range_per_m", "angle_deg", "dropout"):
        for key in ("value", "low", "high"):
            expected = stated["figures"][name][key]
            assert found["figures"][name][key] == pytest.approx(expected, rel=0.05), name
    assert found["figures"]["range_m"]["value"] == pytest.approx(NOISE.range_m, rel=0.1)
    assert found["figures"]["dropout"]["value"] == pytest.approx(NOISE.dropout, rel=0.1)
    for row, other in zip(found["channels"], stated["channels"], strict=True):
        assert row["ring"] == other["ring"] and row["rays"] == other["rays"]
        assert row["elevation_deg"] == pytest.approx(other["elevation_deg"], abs=1e-3)


@pytest.mark.extended
def test_a_result_is_fitted_as_a_cloud_and_as_files(cluster_client, tmp_path):
    from lidarpool import simulate
    from lidarsim import Scene, Survey

    survey = Survey(
        Sensor.grid(360, 16, vertical_fov_deg=40, max_range_m=120), poses=[(0, 0, 0)] * 4,
        steps=36, columns=["intensity"], noise=NOISE, precision_m=1e-4,
    )  # fmt: skip
    cloud = simulate(street(), survey, client=cluster_client).cloud
    ExportSpec("pcd").write(tmp_path / "sweeps", cloud, Sweeps.from_survey(survey, Scene.seed()))
    for found in (fit(cloud), fit(tmp_path / "sweeps", white=1.0)):
        one = found.figures["figures"]["range_m"]
        assert one["low"] - 0.001 < 0.02 < one["high"] + 0.001


@pytest.mark.parametrize("count", [1, 2])
def test_motions_are_sought_along_all_free_axes_in_both_directions(count):
    """The axes are oblique. Shifts grow to the maximum, and rotations are without a shift."""
    axes = np.array([[2.0, 1, 2], [-2, 2, 1]])[:count] / 3
    motions = search._coarse_motions(axes, 4.0)
    turns = motions.yaw_rad != 0
    assert not motions.shift[turns].any()
    degrees = np.degrees(motions.yaw_rad[turns])
    assert (degrees.min(), degrees.max()) == (pytest.approx(-44.75), pytest.approx(44.75))
    shifts = motions.shift[~turns]
    lengths = np.linalg.norm(shifts, axis=1)
    assert (lengths.min(), lengths.max()) == (pytest.approx(0.05), pytest.approx(4.0))
    along = shifts @ axes.T
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), lengths)
    steps = np.unique(lengths.round(9))
    assert (steps[1:] / steps[:-1]).max() < 1.06 and (steps[1:] / steps[:-1]).min() > 1.04
    if count == 1:
        assert {*np.sign(along[:, 0])} == {-1, 1}
        return
    angles = np.unique(np.degrees(np.arctan2(along[:, 1], along[:, 0])).round(6) % 360)
    np.testing.assert_allclose(angles, np.arange(0, 360, 5), atol=1e-5)

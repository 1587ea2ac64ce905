"""Scan patterns that are recovered from recordings of known sensors."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.fit_coverage import box
from click.testing import CliRunner
from tests.made_recordings import changed_recording, made_recording

from lidarpool.cli.commands import cli
from lidarreal import fit_pattern
from lidarsim import LidarError, Noise, Scanner, Scene, Sensor, Spin, Track, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.sensor.export import fired_rays

pytest.importorskip("scipy", reason="the extra fit is not installed")

POSE = (0, 0, 4)
MAX_ERROR_DEG = 0.01


@pytest.fixture(scope="module")
def room():
    return Scene.from_meshes(
        [
            box("shell", (-15, -10, 0), (15, 10, 12)),
            box("left", (5, 3, 0), (7, 6, 3)),
            box("back", (-8, -6, 0), (-5, -4, 5)),
            box("right", (3, -7, 0), (4, -5, 8)),
        ]
    )


def record(
    scene,
    sensor,
    sweeps=2,
    *,
    pose=POSE,
    noise=None,
    lost=0.0,
    columns=("channel", "time"),
    time_decimals=9,
    are_stamped=True,
):
    """Record sweeps, without some of the pulses and with only some of the columns."""
    scanner = Scanner(
        scene,
        sensor,
        columns=["time"],
        coordinates="sensor",
        noise=noise or Noise(),
        precision_m=0.001,
    )
    period_ns = 1e9 / sensor.head.rate_hz
    random = np.random.default_rng(1)
    recorded = []
    for number in range(sweeps):
        cloud = scanner.sweep(pose, number=number)
        kept = random.random(len(cloud)) >= lost
        time_s = np.round(1e-9 * (cloud["time"] - period_ns * number), time_decimals)
        values = {"channel": cloud["channel"][kept], "time": time_s[kept]}
        used = {name: values[name] for name in columns}
        recorded.append(Sweep(np.asarray(cloud.positions)[kept], used))
    stamps_ns = period_ns * np.arange(sweeps)
    stamps = (lambda: stamps_ns) if are_stamped else None
    return made_recording("recording", sweeps, recorded.__getitem__, read_stamps=stamps)


def reloaded(fitted, folder):
    return load_sensor(fitted.save(folder / "mine.yaml")[0])


def angles_deg(first, second):
    return np.degrees(2 * np.arcsin(np.linalg.norm(first - second, axis=-1) / 2))


def errors_of(sensor, found):
    """Return the largest errors of directions in degrees and of times in ns, in a revolution."""
    firings = np.arange(int(sensor.head.firings_per_turn))
    apart_deg = angles_deg(sensor.directions(firings), found.directions(firings))
    apart_ns = np.abs(sensor.times_ns(firings) - found.times_ns(firings))
    return apart_deg.max(), apart_ns.max()


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    ("name", "condition"),
    [
        pytest.param("velodyne/vlp16", {}, id="vlp16"),
        pytest.param("velodyne/vlp16", {"lost": 0.3}, id="lost"),
        pytest.param("velodyne/vlp16", {"noise": Noise(range_m=0.03, seed=2)}, id="noise"),
        pytest.param("ouster/os1-64", {}, id="os1-64"),
    ],
)
def test_a_spinning_sensor_is_recovered(room, tmp_path, name, condition):
    sensor = load_sensor(name)
    fitted = fit_pattern(record(room, sensor, **condition))
    found = reloaded(fitted, tmp_path)
    error_deg, error_ns = errors_of(sensor, found)
    assert error_deg < MAX_ERROR_DEG
    assert error_ns < 20
    assert found.head.clockwise
    assert fitted.figures["rate_hz"] == pytest.approx(10, abs=1e-4)
    assert max(fitted.figures["elevation_spread_deg"]) < 0.005


@pytest.mark.extended
def test_the_direction_of_rotation_is_recovered(room, tmp_path):
    beams = load_sensor("velodyne/vlp16").beams
    sensor = Sensor(beams, Spin(900, rate_hz=20, zero_deg=37), max_range_m=100)
    found = reloaded(fit_pattern(record(room, sensor)), tmp_path)
    assert not found.head.clockwise
    assert found.head.rate_hz == 20
    assert found.period == 900
    assert errors_of(sensor, found)[0] < MAX_ERROR_DEG


@pytest.mark.extended
def test_without_times_the_order_of_points_reveals_azimuth_offsets(room, tmp_path):
    sensor = load_sensor("ouster/os1-64", columns=512)
    fitted = fit_pattern(record(room, sensor, columns=["channel"], are_stamped=False))
    assert errors_of(sensor, reloaded(fitted, tmp_path))[0] < MAX_ERROR_DEG
    notes = " ".join(fitted.figures["notes"])
    assert "the firing times within a column are unknown" in notes
    assert "10 Hz are assumed" in notes


@pytest.mark.extended
def test_without_times_a_revolution_need_not_be_a_whole_number_of_firings(room):
    fitted = fit_pattern(record(room, load_sensor("velodyne/vlp16"), columns=["channel"]))
    assert fitted.figures["firings_per_turn"] == pytest.approx(1808.449, abs=0.01)


@pytest.mark.parametrize("columns", [("channel", "time"), ("channel",)])
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_rings_may_return_in_half_a_revolution(tmp_path, columns, lost):
    """A sensor beside a wall: the sector without returns is wider than 180 degrees."""
    boxes = [
        box("wall", (6, -40, 0), (7, 40, 12)),
        box("low", (4, 1, 0), (5, 3, 5)),
        box("high", (3, -4, 3), (4, -2, 8)),
        box("floor", (0.5, -40, -0.1), (7, 40, 0)),
    ]
    sensor = load_sensor("velodyne/vlp16")
    recording = record(Scene.from_meshes(boxes), sensor, columns=columns, lost=lost)
    azimuth = np.sort(np.arctan2(*recording[0].points[:, 1::-1].T))
    assert np.diff(azimuth, append=azimuth[0] + 2 * np.pi).max() > np.pi
    fitted = fit_pattern(recording)
    assert fitted.figures["firings_per_turn"] == pytest.approx(1808.449, abs=0.01)
    found = reloaded(fitted, tmp_path)
    assert found.head.clockwise
    assert errors_of(sensor, found)[0] < MAX_ERROR_DEG


def test_rings_and_times_can_both_be_missing(room, tmp_path):
    sensor = Sensor.grid(720, 16, 30, max_range_m=100)
    fitted = fit_pattern(record(room, sensor, columns=[], are_stamped=False))
    assert errors_of(sensor, reloaded(fitted, tmp_path))[0] < MAX_ERROR_DEG
    assert any("has no ring column" in note for note in fitted.figures["notes"])


def test_points_sorted_by_ring_lack_whole_azimuth_steps(room):
    recording = record(room, load_sensor("ouster/os1-32", columns=512), columns=["channel"])
    by_ring = [
        sweep.select(np.argsort(sweep.columns["channel"], kind="stable"))
        for sweep in map(recording.load, range(2))
    ]
    fitted = fit_pattern(changed_recording(recording, read=by_ring.__getitem__))
    assert any("except for whole azimuth steps" in note for note in fitted.figures["notes"])
    assert fitted.figures["clockwise"]


@pytest.mark.extended
@pytest.mark.parametrize(
    "name", ["livox/mid360", pytest.param("livox/avia", marks=pytest.mark.extended)]
)
@pytest.mark.parametrize("lost", [0.0, pytest.param(0.3, marks=pytest.mark.extended)])
def test_a_pattern_that_does_not_repeat_is_listed(room, tmp_path, name, lost):
    sensor = load_sensor(name)
    recording = record(room, sensor, 3, lost=lost)
    fitted = fit_pattern(recording, as_rays=True)
    found = fired_rays(load_sensor(calibration=fitted.save(tmp_path / "rays.npz")[0]), seconds=0.3)
    true = fired_rays(sensor, seconds=0.3)
    first_ns = round(1e9 * recording.load(0).columns["time"].min())
    key = (fitted.rays.times_ns + first_ns) * 100 + fitted.rays.channels
    all_keys = true.times_ns * 100 + true.channels
    order = np.argsort(all_keys)
    place = order[np.searchsorted(all_keys[order], key)]
    np.testing.assert_array_equal(all_keys[place], key)
    assert angles_deg(found.directions, true.directions[place]).max() < MAX_ERROR_DEG
    assert len(found) == sum(len(recording.load(number)) for number in range(3))
    # Pulses before the first and after the last return of a channel are unknown.
    assert len(true) - len(found) - 60 <= fitted.figures["missing"] <= len(true) - len(found)
    assert fitted.figures["spread_deg"] < 0.003


@pytest.mark.extended
def test_repetitions_are_combined(room, tmp_path):
    sensor = Sensor.grid(512, 32, 40, max_range_m=100)
    fitted = fit_pattern(record(room, sensor, 4, lost=0.3), as_rays=True)
    assert fitted.figures["repetitions"] == 4
    assert fitted.rays.repeats and fitted.rays.cycle_ns == 1e8
    true = fired_rays(sensor)
    assert len(fitted.rays) + fitted.figures["missing"] == len(true)
    assert fitted.figures["missing"] < 10
    assert 20 < fitted.figures["filled"] < 0.02 * len(true)
    channel = 7
    found, expected = (rays.directions[rays.channels == channel] for rays in (fitted.rays, true))
    error_deg = angles_deg(found, expected)
    assert np.quantile(error_deg, 0.95) < MAX_ERROR_DEG
    assert error_deg.max() < 0.03  # of an interpolated ray, which is between rays 1.4° apart


@pytest.mark.extended
def test_times_of_packets_are_spread(room):
    sensor = load_sensor("livox/avia")
    fitted = fit_pattern(record(room, sensor, 3, time_decimals=3), as_rays=True)
    assert any("many points have the same time" in note for note in fitted.figures["notes"])
    assert (np.diff(fitted.rays.times_ns) >= 0).all()
    assert fitted.figures["missing"] is None


@pytest.mark.extended
def test_files_contain_the_accuracy(room, tmp_path):
    recording = record(room, load_sensor("velodyne/vlp16"))
    text = fit_pattern(recording).save(tmp_path / "mine.yaml")[0].read_text()
    assert "# elevation standard deviation 0.00" in text
    rays = fit_pattern(recording, as_rays=True)
    text = rays.save(tmp_path / "mine.csv")[0].read_text()
    assert "standard deviation 0.00" in text.split("\n# notes:")[1].splitlines()[0]
    with pytest.raises(LidarError, match=r"mine\.yaml cannot contain the scan pattern"):
        rays.save(tmp_path / "mine.yaml")


@pytest.mark.extended(keep=("velodyne/vlp16",))
@pytest.mark.parametrize("name", ["velodyne/vlp16", "livox/avia"])
def test_a_moving_sensor_is_refused(room, name):
    track = Track([0, 1], [(-3, 0, 4), (3, 2, 4)])
    recording = record(room, load_sensor(name), 6, pose=track)
    with pytest.raises(LidarError, match=r"sensor that moves by .* Record a few seconds without"):
        fit_pattern(recording, as_rays=name == "livox/avia")


def test_a_single_sweep_cannot_show_motion(room):
    fitted = fit_pattern(record(room, load_sensor("velodyne/vlp16"), 1))
    assert "motion cannot be detected in a single sweep" in repr(fitted)


@pytest.mark.extended(every=2)
@pytest.mark.parametrize(("height_m", "uncertain"), [(1, 15), (8, 0)])
def test_rings_with_a_single_range_are_uncertain(height_m, uncertain):
    """At a height of 1 m, the lower rings only see the floor, and their lasers are 35 mm away."""
    hall = Scene.from_meshes(
        [box("hall", (-20, -15, 0), (20, 15, 20)), box("cabinet", (-1, -1.5, 0), (1, 1.5, 4))]
    )
    sensor = load_sensor("robosense/rs-helios")
    fitted = fit_pattern(record(hall, sensor, 1, pose=(6, 2, height_m)))
    found_deg = np.sort(fitted.figures["elevation_deg"])
    errors_deg = np.abs(found_deg - np.sort(np.degrees(sensor.beams.elevation)))
    notes = [note for note in fitted.figures["notes"] if "almost the same range" in note]
    assert len(notes) == bool(uncertain)
    assert errors_deg[uncertain:].max() < 0.015
    if uncertain:
        assert "15 rings are uncertain (-54.0 to -13.0°)" in notes[0]
        assert "(1.2 to 4.5 m)" in notes[0]
        assert 0.9 < errors_deg[0] < 1.62
        assert "If the laser is 35 mm from the assumed position" in notes[0]
        assert "wrong by up to 1.6" in notes[0]


@pytest.mark.extended
def test_a_pattern_without_rings_is_no_sensor_model(room):
    recording = record(room, load_sensor("livox/mid360"))
    with pytest.raises(LidarError, match=r"rings of recording are unknown.*such as rays\.npz"):
        fit_pattern(recording)


def test_few_returns_are_refused(room):
    recording = record(room, load_sensor("velodyne/vlp16"), lost=0.995)
    with pytest.raises(LidarError, match="not enough to determine a scan pattern"):
        fit_pattern(recording)


def test_the_command_selects_the_form_by_extension(room, tmp_path):
    sweep = record(room, load_sensor("velodyne/vlp16"), 1).load(0)
    columns = [sweep.points, sweep.columns["channel"][:, None], sweep.columns["time"][:, None]]
    table = tmp_path / "scan.csv"
    values = np.concatenate(columns, axis=1)
    np.savetxt(table, values, "%.9g", ",", header="x,y,z,ring,time", comments="")
    runner = CliRunner()
    model, rays, livox = (str(tmp_path / name) for name in ("mine.yaml", "mine.npz", "livox.csv"))
    for arguments, expected in (
        (["fit", "--pattern", str(table), "--out", model], "1808.449 firings per revolution"),
        (["fit", "--pattern", str(table), "--out", rays], "28,944 rays in"),
        (["sensors", model, "--out", livox, "--as", "livox"], "livox.csv"),
    ):
        done = runner.invoke(cli, arguments, catch_exceptions=False)
        assert expected in done.output
    refused = runner.invoke(
        cli, ["fit", "--pattern", str(table), "--out", model, "--pose", "0,0,1"]
    )
    assert "--pose cannot be combined with --pattern" in refused.output
    with pytest.raises(LidarError, match=r"mine\.yaml already exists.*--overwrite"):
        runner.invoke(cli, ["fit", "--pattern", str(table), "--out", model], catch_exceptions=False)
    sweeps = tmp_path / "sweeps"
    sweeps.mkdir()
    (sweeps / "1.ply").write_text("ply")
    for source, out, expected in (
        (table, "mine.xml", r"extension \.yaml.* for a sensor model, or \.npz"),
        (
            sweeps,
            "of-sweeps.yaml",
            r"contains \.ply files, which are not read as the sweeps.*\.pcd",
        ),
    ):
        with pytest.raises(LidarError, match=expected):
            runner.invoke(
                cli,
                ["fit", "--pattern", str(source), "--out", str(tmp_path / out)],
                catch_exceptions=False,
                standalone_mode=False,
            )


@pytest.mark.extended
def test_sweeps_without_timestamps_follow_each_other(room):
    """Their period is a firing longer than their times. The pattern of a Mid-360 repeats late."""
    recording = record(room, load_sensor("livox/mid360"), 3, are_stamped=False)
    fitted = fit_pattern(recording, as_rays=True)
    (note,) = [note for note in fitted.figures["notes"] if "without a return" in note]
    assert "does not repeat within 0.3 s. 0 pulses without a return" in note

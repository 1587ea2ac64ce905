"""IMU and GNSS receiver of a carrier: truth, errors against closed forms, and files."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from lidarfiles.clouds.navigation_files import instrument_bytes, write_instruments
from lidarfiles.clouds.writing import ExportSpec
from lidarscenario import Job
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import (
    Cloud,
    Gnss,
    Imu,
    LidarError,
    Mounted,
    Navigation,
    Pose,
    Scene,
    Sensor,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.motion.navigation import gnss_fixes, imu_samples, to_geodetic
from lidarsim.motion.rotations import matrices
from lidarsim.motion.trajectory import Stations
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, Instruments
from lidarsim.sweeps.sweeps import Sweeps

GRAVITY = 9.80665


@dataclass(frozen=True)
class Moving:
    """What is asked of a survey."""

    navigation: Navigation
    path: object
    duration_ns: float
    platform_name: str = ""


def standing(seconds, **navigation):
    """A carrier that stands."""
    return Moving(Navigation(**navigation), Stations((Pose((0, 0, 0)),)), seconds * 1e9)


def joined(samples, name):
    return np.concatenate([getattr(one, name) for one in samples])


def allan(values, size):
    """Allan variances of the mean of clusters of so many samples, and how many differences.

    Of disjoint clusters, as in IEEE Std 952-1997, annex C; for each axis.
    """
    count = len(values) // size
    means = values[: count * size].reshape(count, size, -1).mean(axis=1)
    return (np.diff(means, axis=0) ** 2).sum(axis=0) / (2 * (count - 1)), count - 1


def agrees(values, rate_hz, expected, spread=1.5):
    """Whether Allan variances agree with a formula of the averaging time, within 4.5 sigmas.

    The variance of a mean of n squared normal deviates is 2 / n; neighboring differences share a
    cluster, which makes that of white noise 1.5 times as large, and for others less than 2.
    """
    for size in (1, 8, 64, 512, 4096):
        found, count = allan(values, size)
        tau = size / rate_hz
        # three axes are independent
        pooled = found.mean()
        terms = found.size * count
        if terms < 30:
            continue
        assert abs(pooled / expected(tau, size) - 1) < 4.5 * np.sqrt(2 * spread / terms), size


RATE = 50.0


def test_allan_variance_of_white_noise():
    density = 2e-3
    survey = standing(4000, imu=Imu(rate_hz=RATE, gyroscope_noise_density=density))
    rates = joined(imu_samples(survey), "rates")
    assert rates.shape == (200_000, 3)
    agrees(rates, RATE, lambda tau, _: density**2 / tau)


def test_allan_variance_of_a_random_walk():
    # Walks of a few long clusters: many seeds, each short.
    walk = 3e-4
    runs = []
    for seed in range(60):
        imu = Imu(rate_hz=RATE, accelerometer_random_walk=walk)
        forces = joined(imu_samples(standing(100, imu=imu, seed=seed)), "forces")
        runs.append(forces - [0, 0, GRAVITY])
    for size in (4, 32, 256, 1024):
        found = np.array([allan(run, size)[0] for run in runs])
        terms = found.size * allan(runs[0], size)[1]
        # K^2 tau / 3, and what single steps add to it.
        expected = walk**2 * (size / RATE) / 3 * (1 + 1 / (2 * size**2))
        assert abs(found.mean() / expected - 1) < 4.5 * np.sqrt(2 * 2 / terms), size


def markov(sigma, time):
    """Allan variance of a Gauss-Markov process, IEEE Std 952-1997, C.1.6."""

    def expected(tau, _=None):
        q2 = 2 * sigma**2 / time
        bracket = 1 - time / (2 * tau) * (3 - 4 * np.exp(-tau / time) + np.exp(-2 * tau / time))
        return q2 * time**2 / tau * bracket

    return expected


@pytest.mark.extended
def test_allan_variance_of_a_bias_that_wanders():
    sigma = 5e-3
    time = 10.0
    imu = Imu(rate_hz=RATE, gyroscope_bias=sigma, gyroscope_bias_time_s=time)
    rates = joined(imu_samples(standing(16_000, imu=imu)), "rates")
    formula = markov(sigma, time)
    for size in (64, 512, 1024, 4096, 16_384):
        found, count = allan(rates, size)
        terms = found.size * count
        # Sums over steps of 0.02 s are not integrals: a thousandth.
        room = 4.5 * np.sqrt(2 * 2 / terms) + 1e-3
        assert abs(found.mean() / formula(size / RATE) - 1) < room, size
    # It begins as it goes on: the first sample has the standard deviation of all.
    firsts = [next(imu_samples(standing(1, imu=imu, seed=seed))).rates[0] for seed in range(300)]
    assert abs(np.std(firsts) / sigma - 1) < 4.5 / np.sqrt(2 * 900)
    assert abs(rates.std() / sigma - 1) < 4.5 * np.sqrt(time / (3 * 16_000))


def test_errors_of_positions():
    gnss = Gnss(
        rate_hz=10, horizontal_m=0.03, vertical_m=0.1, drift_horizontal_m=0.5, drift_vertical_m=1,
        drift_time_s=50,
    )  # fmt: skip
    found = joined(gnss_fixes(standing(20_000, gnss=gnss)), "positions")
    assert found.shape == (200_001, 3)
    drift = markov(0.5, 50)
    for axes, white, drifting in (([0, 1], 0.03, drift), ([2], 0.1, lambda tau: 4 * drift(tau))):
        for size in (10, 100, 500, 2000):
            variances, count = allan(found[:, axes], size)
            tau = size / 10
            expected = white**2 / size + drifting(tau)
            room = 4.5 * np.sqrt(2 * 2 / (len(axes) * count)) + 0.01
            assert abs(variances.mean() / expected - 1) < room, (axes, size)


@pytest.mark.extended
def test_axes_have_constant_scales_and_angles():
    """Of many units: a rotation about z shows the scale of one gyroscope and two angles."""
    half = np.linspace(0, 0.5, 11)
    turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    path = Track(np.linspace(0, 1, 11), np.zeros((11, 3)), turns)
    found = []
    imu = Imu(rate_hz=10, scale=0.01, misalignment_deg=0.3)
    for seed in range(400):
        moving = Moving(Navigation(imu=imu, seed=seed), path, path.duration_ns)
        rates = joined(imu_samples(moving), "rates")
        np.testing.assert_allclose(rates, np.tile(rates[0], (10, 1)), atol=1e-9)
        found.append(rates[0])
    expected = np.array([np.radians(0.3), np.radians(0.3), 0.01])
    errors = np.array(found) - [0, 0, 1]
    assert (np.abs(errors.mean(axis=0)) < 4.5 * expected / np.sqrt(400)).all()
    assert (np.abs(errors.std(axis=0) / expected - 1) < 4.5 / np.sqrt(800)).all()
    assert np.abs(np.corrcoef(errors.T)[np.triu_indices(3, 1)]).max() < 4.5 / np.sqrt(400)


@pytest.mark.extended
def test_positions_drift_during_outages_and_return():
    """By many seeds: a bias alone grows as t^2, a random walk alone as t^1.5."""
    gnss = Gnss(rate_hz=2, outages=[(10, 25)])
    for imu in (
        Imu(accelerometer_bias=0.02),
        Imu(accelerometer_noise_density=0.05),
        Imu(accelerometer_bias=0.02, accelerometer_noise_density=0.05),
    ):
        runs = [standing(40, imu=imu, gnss=gnss, seed=seed) for seed in range(500)]
        errors = np.concatenate([joined(gnss_fixes(run), "positions") for run in runs], axis=1)
        t = np.clip(np.arange(81) / 2 - 10, 0, 15)
        bias = imu.accelerometer_bias
        walk = imu.accelerometer_noise_density
        expected = np.hypot(bias * t**2 / 2, walk * np.sqrt(t**3 / 3))
        expected *= np.exp(-np.clip(np.arange(81) / 2 - 25, 0, None))
        assert not errors[:21].any() and expected[50] > 1
        room = 4.5 / np.sqrt(2 * 1500)
        assert np.abs(errors[21:].std(axis=1) / expected[21:] - 1).max() < room
        assert np.abs(errors[21:].mean(axis=1) / expected[21:]).max() < 4.5 / np.sqrt(1500)
        assert np.abs(np.diff(errors, axis=0)).max() < 6  # it does not jump


def test_without_an_imu_outages_have_no_positions():
    times = joined(
        gnss_fixes(standing(40, gnss=Gnss(rate_hz=2, outages=[(10, 25), (30, 31)]))), "times_ns"
    )
    seconds = np.arange(81) / 2
    out = ((seconds >= 10) & (seconds < 25)) | ((seconds >= 30) & (seconds < 31))
    assert np.array_equal(times, (seconds[~out] * 1e9).astype(int))
    with pytest.raises(LidarError, match="least, largest"):
        Gnss(outages=[(25, 10)])


def tumbling(smooth):
    """A way with turns about all axes."""
    rng = np.random.default_rng(3)
    times = np.linspace(0, 10, 41)
    turns = np.cumsum(rng.normal(size=(41, 4)), axis=0) * 0.3
    places = np.cumsum(rng.normal(size=(41, 3)), axis=0) * 0.3
    return Track(times, places, turns / np.linalg.norm(turns, axis=1)[:, None], smooth=smooth)


def exponential(vector):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle if angle else vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.extended
@pytest.mark.parametrize("smooth", [False, True], ids=["linear", "smooth"])
def test_dead_reckoning_finds_the_way_of_the_imu(smooth):
    path = tumbling(smooth)
    mount = Pose((1.0, -0.5, 0.3), 30, 20, 10)
    rate = 400.0
    survey = Moving(Navigation(imu=Imu(rate_hz=rate, mount=mount)), path, path.duration_ns)
    samples = list(imu_samples(survey))
    times = np.arange(len(joined(samples, "rates")) + 1) / rate * 1e9
    places, turns = path.poses(0, times)
    truth = places + turns @ np.array(mount.position)
    here = turns[0] @ mount.rotation
    place = truth[0]
    early, late = path.poses(0, np.array([0.0, 100.0]))
    speed = (early[1] - early[0] + (late[1] - late[0]) @ np.array(mount.position)) / 1e-7
    worst = 0.0
    for number, (rates, force) in enumerate(
        zip(joined(samples, "rates"), joined(samples, "forces"), strict=True)
    ):
        change = (here @ exponential(rates / rate / 2) @ force - [0, 0, GRAVITY]) / rate
        place = place + (speed + change / 2) / rate
        speed = speed + change
        here = here @ exponential(rates / rate)
        worst = max(worst, np.abs(place - truth[number + 1]).max())
    assert np.abs(here - turns[-1] @ mount.rotation).max() < 1e-10
    # At each of 40 given poses the speed jumps, by up to 5 m/s, and a sample does not say when.
    assert worst < 0.05
    assert path.duration_ns == times[-1]


def test_a_carrier_that_stands_feels_gravity():
    mount = Pose((0, 0, 0), roll_deg=90)
    survey = standing(1, imu=Imu(mount=mount))
    (samples,) = imu_samples(survey)
    assert not samples.rates.any()
    np.testing.assert_allclose(samples.forces, np.tile([0, GRAVITY, 0], (200, 1)), atol=1e-12)
    assert samples.times_ns[[0, -1]].tolist() == [5_000_000, 1_000_000_000]


def test_pieces_do_not_matter():
    imu = Imu(
        rate_hz=100, gyroscope_noise_density=1e-3, gyroscope_bias=1e-3, gyroscope_random_walk=1e-4,
        accelerometer_noise_density=0.01, accelerometer_bias=0.1, accelerometer_random_walk=0.01,
    )  # fmt: skip
    gnss = Gnss(rate_hz=20, horizontal_m=1, drift_vertical_m=2, outages=[(2, 4), (5, 6)])
    path = tumbling(True)
    imu = replace(imu, scale=1e-3, misalignment_deg=0.1)
    survey = Moving(Navigation(imu=imu, gnss=gnss, seed=9), path, path.duration_ns)
    for samples in (imu_samples, gnss_fixes):
        whole = [*samples(survey)]
        pieces = [*samples(survey, 7)]
        assert len(pieces) > 10 * len(whole)
        for name in whole[0]._fields:
            assert joined(whole, name).tobytes() == joined(pieces, name).tobytes()
        for change in (
            {"navigation": replace(survey.navigation, seed=10)},
            {"platform_name": "left"},
        ):
            other = joined(samples(replace(survey, **change)), whole[0]._fields[1])
            assert joined(whole, whole[0]._fields[1]).tobytes() != other.tobytes()


def test_latitudes_of_east_north_and_up():
    origin = (48.7758, 9.1829, 290.0)
    warp = pytest.importorskip("rasterio.warp")
    enu = np.array([[0, 0, 0], [1000, 2000, 50], [-30_000, 40_000, 3000], [5, -5, -200.0]])
    found = to_geodetic(enu, origin)
    np.testing.assert_allclose(found[0], origin, atol=1e-9)
    latitude, longitude, height = (column.tolist() for column in found.T)
    centered = np.array(warp.transform("EPSG:4979", "EPSG:4978", longitude, latitude, height)).T
    centered -= np.array(warp.transform("EPSG:4979", "EPSG:4978", *([v] for v in (
        origin[1], origin[0], origin[2],
    )))).T  # fmt: skip
    (sp, cp), (sl, cl) = ((np.sin(a), np.cos(a)) for a in np.radians(origin[:2]))
    axes = np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    np.testing.assert_allclose(centered @ axes.T, enu, atol=1e-5)


def of_drive(**options):
    """A survey of two seconds, its cloud and its sweeps."""
    lidar = load_sensor("velodyne/vlp16")
    track = Track([0, 1.05], [[0, 0, 1], [5, 0, 1]])
    navigation = Navigation(
        imu=Imu(rate_hz=50, gyroscope_noise_density=1e-3, mount=Pose((1, 0, 0.5), 90)),
        gnss=Gnss(rate_hz=5, horizontal_m=0.02, vertical_m=0.04, **options.pop("gnss", {})),
    )
    survey = Survey(
        sensors=[Mounted(lidar, name="imu")], trajectory=track, navigation=navigation, **options
    )
    columns = {"scan": np.arange(20, dtype=np.int32), "object": np.zeros(20, np.int32)}
    columns |= {"time": np.arange(20) * 50_000_000, "intensity": np.ones(20, np.float32)}
    columns["channel"] = np.zeros(20, np.uint16)
    return survey, Cloud(np.zeros((20, 3)), columns), Sweeps.from_survey(survey, Scene.seed())


def written(folder, survey, sweeps):
    """The sweeps as those of a result in a folder, with the files of its instruments."""
    write_instruments(folder, survey, np.zeros(3))
    sweeps.save(folder / "sweeps.npz")
    return Sweeps.load(folder / "sweeps.npz")


def read_bag(path):
    with AnyReader([path]) as bag:
        return [
            (one.topic, time, bag.deserialize(data, one.msgtype))
            for one, time, data in bag.messages()
        ]


def test_bags_have_the_instruments(tmp_path):
    survey, cloud, sweeps = of_drive(gnss={"origin": (48.7758, 9.1829, 290.0)})
    found = written(tmp_path, survey, sweeps)
    assert found.instruments.folder == tmp_path
    ExportSpec("mcap").write(tmp_path / "cloud.mcap", cloud, found)
    messages = read_bag(tmp_path / "cloud.mcap")
    rows = (tmp_path / IMU_FILE).read_text().splitlines()
    imu = [(time, message) for topic, time, message in messages if topic == "/imu/data_raw"]
    assert len(imu) == len(rows) - 1 == 52
    written_bytes = sum((tmp_path / name).stat().st_size for name in found.instruments.files)
    assert written_bytes < instrument_bytes(survey, 0) < 3 * written_bytes
    time, message = imu[0]
    assert (message.header.frame_id, message.orientation_covariance[0]) == ("imu_2", -1)
    assert message.angular_velocity_covariance[0] == pytest.approx(50 * 1e-6)
    values = [float(value) for value in rows[1].split(",")]
    force = message.linear_acceleration
    assert (force.x, force.y, force.z) == tuple(values[4:])
    assert time - messages[0][1] == values[0] == 20_000_000
    fixes = [message for topic, _, message in messages if topic == "/gnss/fix"]
    assert len(fixes) == 6
    assert abs(fixes[0].latitude - 48.7758) < 1e-6
    assert fixes[0].altitude == pytest.approx(291, abs=0.3)
    assert fixes[0].position_covariance.reshape(3, 3).diagonal().tolist() == pytest.approx(
        [4e-4, 4e-4, 1.6e-3]
    )
    (static,) = (message for topic, _, message in messages if topic == "/tf_static")
    assert [one.child_frame_id for one in static.transforms] == ["imu", "imu_2", "gnss"]
    turn = static.transforms[1].transform
    assert (turn.translation.x, turn.translation.z) == (1, 0.5)
    quaternion = [turn.rotation.x, turn.rotation.y, turn.rotation.z, turn.rotation.w]
    np.testing.assert_allclose(matrices(np.array([quaternion]))[0][:, 0], [0, 1, 0], atol=1e-9)
    times = [time for topic, time, _ in messages if topic != "/actors"]
    assert times == sorted(times)


def test_latitudes_by_epsg(tmp_path):
    pytest.importorskip("rasterio")
    survey, _, _ = of_drive(epsg=25832)
    write_instruments(tmp_path, survey, np.array([500_000.0, 5_400_000.0, 300.0]))
    head, first, *_ = (tmp_path / GNSS_FILE).read_text().splitlines()
    row = dict(zip(head.split(","), map(float, first.split(",")), strict=True))
    assert row["longitude_deg"] == pytest.approx(9, abs=1e-6)
    assert row["latitude_deg"] == pytest.approx(48.753013, abs=1e-5)
    assert row["height_m"] == row["z_m"] == pytest.approx(301, abs=0.3)


def test_a_cloud_by_itself_has_no_instruments(tmp_path):
    survey, cloud, sweeps = of_drive()
    ExportSpec("mcap").write(tmp_path / "cloud.mcap", cloud, sweeps)  # nothing is written yet
    assert not {"/imu/data_raw"} & {topic for topic, *_ in read_bag(tmp_path / "cloud.mcap")}
    plain = replace(survey, navigation=None)
    assert Instruments.from_survey(plain) is None
    assert b"instruments" not in Sweeps.from_survey(plain, Scene.seed()).to_bytes()


def test_scenarios(tmp_path):
    text = """
    scene: seed
    trajectory: {points: [{time_s: 0, position: [0, 0, 1]}, {time_s: 1, position: [1, 0, 1]}]}
    navigation:
      imu: {rate_hz: 100, gyroscope_random_walk: 2.0e-5, mount: {yaw_deg: 10}}
      gnss: {origin: [48.7, 9.1, 290], drift_horizontal_m: 0.5}
      seed: 4
    """
    (tmp_path / "scenario.yaml").write_text(text)
    scenario = Scenario.load(tmp_path / "scenario.yaml")
    navigation = prepare(scenario).survey.navigation
    assert navigation == Navigation(
        imu=Imu(rate_hz=100, gyroscope_random_walk=2e-5, mount=Pose((0, 0, 0), 10)),
        gnss=Gnss(origin=(48.7, 9.1, 290), drift_horizontal_m=0.5),
        seed=4,
    )


def test_what_does_not_fit():
    with pytest.raises(LidarError, match="has 2 separate poses"):
        Survey(Sensor.grid(), poses=[(0, 0, 1), (1, 0, 1)], navigation=Navigation(imu=Imu()))
    survey = Survey(poses=[(0, 0, 1)], navigation=Navigation(imu=Imu()))
    with pytest.raises(LidarError, match="not supported in campaigns"):
        CampaignSpec(lambda number, rng: Job(Scene.seed(), survey), 1).job(0)
    with pytest.raises(
        LidarError, match=r"rate_hz must be a number from 0.001 to 100000, but is 0"
    ):
        Imu(rate_hz=0)
    with pytest.raises(
        LidarError, match=r"origin must be \[a number from -90 to 90, .*but is \(100, 9, 0\)"
    ):
        Gnss(origin=(100, 9, 0))
    with pytest.raises(
        LidarError, match="gyroscope_noise_density must be a number from 0 to 100, but is -1"
    ):
        Imu(gyroscope_noise_density=-1)
    assert not [*imu_samples(SimpleNamespace(navigation=None, path=None, duration_ns=1e9))]
    assert len([*itertools.islice(gnss_fixes(standing(1, imu=Imu())), 1)]) == 0

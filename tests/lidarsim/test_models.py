"""Sensors by model and by calibration: angles, times and places as their makers state them."""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest

from lidarsim import LidarError, Sensor, Spin, load_sensor
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.models import read_model
from lidarsim.sensor.ray_sensors import ListedSensor, Prism, PrismSensor
from raybeam import Pattern

READY = [name for name in model_names() if not read_model(name).needs_calibration]


def angles(directions):
    """Azimuth and elevation of directions (…, 3), degrees."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z))


@pytest.mark.parametrize("name", READY)
def test_every_model_makes_a_sensor(name):
    model = read_model(name)
    sensor = load_sensor(name)
    name = f"{model.name}, typical pattern" if model.typical else model.name
    assert sensor.name == name and all(model.sources.values())
    assert model.range_m == (sensor.min_range_m, sensor.max_range_m)
    firings = np.arange(200_000, 200_500)
    directions = sensor.directions(firings)
    times = sensor.times_ns(firings)
    assert directions.shape == (500, sensor.channels, 3)
    assert np.abs((directions**2).sum(axis=-1) - 1).max() < 1e-14, "rays are not made again"
    assert (np.diff(sensor.beams.elevation) >= 0).all(), "channel 0 is the lowest"
    assert (np.diff(times[:, 0]) > 0).all() and (times >= 0).all()
    assert sensor.firings(35)[1] in (sensor.firings(35)[0] + 1, *range(10, 100_000))


def test_models_with_rings_say_the_rays_from_one_firing_of_a_channel_to_its_next():
    """All but prisms and lines: the same elevation again, a firing later, in the order of rows."""
    ringed = {name: load_sensor(name) for name in READY}
    ringed = {
        name: sensor
        for name, sensor in ringed.items()
        if type(sensor) is Sensor and isinstance(sensor.head, Spin) and sensor.channels < 1_000
    }
    assert len(ringed) == 25
    for name, sensor in ringed.items():
        directions = sensor.directions(np.arange(40)).reshape(-1, 3)
        step = sensor.ring_step
        assert np.array_equal(directions[step:, 2], directions[:-step, 2]), name
        assert min(k for k in range(1, step + 1) if directions[k, 2] == directions[0, 2]) == step
        assert Pattern(directions).step == step, name  # also if it is guessed


# Channels counted from the lowest: elevation, and azimuth offset without the turn in between.
FIGURES = {
    "velodyne/vlp16": {0: (-15, 0), 1: (-13, 0), 15: (15, 0)},  # VLP16db.yaml
    "velodyne/vlp32c": {0: (-25, -1.4), 1: (-15.639, 1.4), 31: (15, 1.4)},  # VLP-32C.yaml
    "velodyne/hdl32e": {0: (-30.67, 0), 31: (10.67, 0)},  # 32db.yaml
    "hesai/pandar40p": {0: (-24.569, 1.042), 39: (15.21, 1.042)},  # Pandar40P
    "hesai/pandarqt": {0: (-52.121, -8.736), 63: (52.133, 7.892)},  # PandarQT
    "ouster/os1-32": {0: (-21.4764, 4.2521), 31: (20.5477, 4.252)},  # 32U0
    "ouster/os2-128": {127: (10.76, -2.07), 0: (-11.09, 2.04)},  # OS-2-128-U1
}


@pytest.mark.parametrize(("name", "channels"), FIGURES.items(), ids=FIGURES)
def test_angles_are_those_of_the_source(name, channels):
    sensor = load_sensor(name)
    azimuth, elevation = angles(sensor.directions(np.array([0]))[0])
    turn = np.degrees(sensor.head.radians_per_ns * sensor.beams.time_ns) + sensor.head.zero_deg
    off = (azimuth - turn + 180) % 360 - 180
    for channel, (up, aside) in channels.items():
        assert elevation[channel] == pytest.approx(up, abs=1e-6)
        assert off[channel] == pytest.approx(aside, abs=1e-6)


def test_an_at128_fires_in_the_directions_of_its_driver():
    """The driver computes azimuths clockwise from y, for each angle of the mirror."""
    sensor = load_sensor("hesai/at128")
    firings = np.array([0, 1, 600, 1199, 1200])
    directions = sensor.directions(firings)
    mirror_deg = 15 + 0.05 * (firings % 1200)  # since the start of a facet
    for channel, elevation_deg, offset_deg in ((127, 12.8834, -2.4), (0, -12.4227, -0.65)):
        azimuth, elevation = np.radians(2 * mirror_deg - offset_deg), np.radians(elevation_deg)
        expected = np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1) * np.cos(elevation)
        assert np.abs(directions[:, channel, :2] - expected).max() < 1e-9
        assert np.abs(directions[:, channel, 2] - np.sin(elevation)).max() < 1e-9
    assert sensor.begins_ns(firings) / 1e6 == pytest.approx([0, 1 / 24, 25, 1199 / 24, 100])
    assert sensor.beams.time_ns.max() == 14_928


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("name", "field", "rate"),
    [
        ("hesai/at128", "124.7°, -12.4° to 12.9°", "10 Hz, 1,536,000 rays/s"),
        ("velodyne/vlp16", "360°, -15° to 15°", "10 Hz, 289,440 rays/s"),
        ("ouster/os1-64", "360°, -21.8° to 20.7°", "10 Hz, 655,360 rays/s"),
        ("robosense/rs-helios", "360°, -55° to 15°", "10 Hz, 576,000 rays/s"),
        # Its data sheet has 70.4° x 77.2°. This is a sample of its rays.
        ("livox/avia", "70.43°, -37.5° to 38.5°", "10 Hz, 240,000 rays/s"),
    ],
)
def test_notebooks_show_the_field_of_view_and_the_rate(name, field, rate):
    shown = load_sensor(name)._repr_html_()
    assert f">{field}<" in shown and f">{rate}<" in shown


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 20.0])
def test_a_vlp16_fires_when_it_does_and_turns_meanwhile(rate_hz):
    sensor = load_sensor("velodyne/vlp16", rate_hz=rate_hz)
    assert sensor.head.firings_per_turn == pytest.approx(float(Fraction("1e6") / 55.296 / rate_hz))
    laser = [0, 2, 4, 6, 8, 10, 12, 14, 1, 3, 5, 7, 9, 11, 13, 15]  # of channels from -15 to 15
    firings = np.array([0, 1, 7, 1_808, 100_000_000])
    expected = firings[:, None] * 55_296 + np.array(laser) * 2_304
    times = sensor.times_ns(firings)
    assert np.array_equal(times, expected)
    azimuth, elevation = angles(sensor.directions(firings))
    turned = -360 * rate_hz * expected / 1e9  # clockwise
    assert np.abs((azimuth - turned + 180) % 360 - 180).max() < 1e-6
    assert np.allclose(elevation, np.arange(-15, 16, 2), atol=1e-9)


def test_an_ouster_gives_the_points_of_its_own_look_up_table():
    """From ouster-sdk 1.0.1: XYZLut of the metadata that the model is taken from, 20 m."""
    table = {  # row, counted from the top, and column
        (0, 0): [-18.67710658794944, -1.3874291852478835, 7.050373499737251],
        (31, 0): [-18.561278537352962, -1.3788501556112154, -7.280392315250768],
        (7, 100): [-7.955338630815104, 17.919830608955156, 3.983091216073701],
        (15, 255): [19.924889276445935, 1.7300827966205, 0.0982296383926407],
        (20, 511): [-19.780940741574582, -1.716115402289985, -2.364450135396444],
    }
    sensor = load_sensor("ouster/os1-32", columns=512)
    for (row, column), point in table.items():
        firing = np.array([column])
        channel = 31 - row
        start = sensor.origins(firing)[0, channel]
        ours = start + sensor.directions(firing)[0, channel] * (20 - 0.015806)
        assert np.abs(ours - point).max() < 1e-9
    assert (np.ptp(sensor.times_ns(np.arange(3)), axis=1) == 0).all(), "a column has one time"
    assert load_sensor("ouster/os1-32").period == 1024


def test_an_hdl64_has_beams_that_leave_beside_the_axis(tmp_path):
    """Points of a laser along the lines that Velodyne's driver computes, at two distances."""
    vert = -0.3966
    rot = 0.0726
    up = 0.16
    left = -0.026
    laser = {
        "laser_id": 0,
        "vert_correction": vert,
        "rot_correction": rot,
        "vert_offset_correction": up,
        "horiz_offset_correction": left,
    }
    file = tmp_path / "unit.yaml"
    file.write_text(json.dumps({"lasers": [laser], "num_lasers": 1}))
    model = tmp_path / "one.yaml"
    model.write_text("{name: One, sources: {all: me}, clockwise: true, firings_per_turn: 360}")
    sensor = load_sensor(model, calibration=file)
    assert sensor.name == "One, unit.yaml"
    firing = np.array([40])
    start = sensor.origins(firing)[0, 0]
    along = sensor.directions(firing)[0, 0]
    turned = np.radians(40) - rot
    for distance in (0.0, 30.0):
        level = distance * np.cos(vert) - up * np.sin(vert)
        right = level * np.sin(turned) - left * np.cos(turned)
        ahead = level * np.cos(turned) + left * np.sin(turned)
        high = distance * np.sin(vert) + up * np.cos(vert)
        assert np.allclose(start + distance * along, [ahead, -right, high], atol=1e-12)


# Azimuth and elevation of rows of Livox's lists, of 400,000.
ROSETTES = {
    "livox/mid40": {
        0: (19.172406, 0.030128),
        999: (3.844053, 18.793108),
        123_456: (17.761174, 6.704029),
        399_999: (7.712127, 13.60002),
    },
    "livox/mid70": {
        0: (-35.214748, -0.024165),
        999: (-7.646574, -34.46787),
        123_456: (-32.965857, -11.11603),
        399_999: (-15.041362, -22.102663),
    },
}


@pytest.mark.parametrize(("name", "rows"), ROSETTES.items(), ids=ROSETTES)
def test_a_livox_fires_where_the_list_of_its_maker_says(name, rows):
    """Row 0 is the ray at 10 µs."""
    sensor = load_sensor(name)
    assert sensor.period is None
    assert sensor.times_ns(np.array([0, 1, 99_999])).tolist() == [[0], [10_000], [999_990_000]]
    found = angles(sensor.directions(np.array(list(rows)) + 1)[:, 0])
    assert np.abs(np.transpose(found) - list(rows.values())).max() < 2e-5


def test_directions_behind_prisms_are_kept_and_the_same():
    sensor = load_sensor("livox/mid360")
    first = sensor.directions(np.arange(700, 1_700))
    assert sensor.directions(np.arange(700, 1_700)) is first
    assert not first.flags.writeable
    shuffled = np.random.default_rng(1).permutation(1_000)
    assert np.array_equal(sensor.directions(700 + shuffled), first[shuffled])
    for start in range(20):  # more sweeps than are kept
        sensor.directions(np.arange(start, start + 1_000))
    again = sensor.directions(np.arange(700, 1_700))
    assert again is not first
    assert np.array_equal(again, first)


def test_a_prism_that_reflects_all_light_is_refused():
    with pytest.raises(LidarError, match="total internal reflection"):
        PrismSensor(prisms=(Prism(60, 1.9, 7),))


def test_an_airborne_scanner_sweeps_across_below(tmp_path):
    mirror = load_sensor("airborne/leica-als50-ii")
    polygon = load_sensor("airborne/riegl-vq780i")
    x, y, z = mirror.directions(np.array([0, 1875, 3750, 937]))[:, 0].T
    assert np.allclose(x, 0) and (z < -0.9).all()
    assert np.allclose(np.degrees(np.arctan2(y, -z)), [-20, 20, -20, 0], atol=0.02)
    x, y, z = polygon.directions(np.arange(3333))[:, 0].T
    across = np.degrees(np.arctan2(y, -z))
    assert np.allclose(np.diff(across), 60 / 3333) and across[0] == pytest.approx(-30)
    times = polygon.times_ns(np.arange(3335))[:, 0]
    assert (np.abs(np.diff(times)[:3332] - 1000) <= 1).all(), "a megahertz while it fires"
    assert times[3333] == 5_000_000, "the next facet comes after a pause"


def test_a_terrestrial_scanner_fires_lines_upwards():
    sensor = load_sensor("terrestrial/riegl-vz400", step_deg=0.4)
    azimuth, elevation = angles(sensor.directions(np.arange(2))[..., :])
    assert np.allclose(elevation[0], np.linspace(-40, 60, 2500))
    assert azimuth[1, 0] - azimuth[0, 0] == pytest.approx(0.04)
    assert 0 < azimuth[0, -1] < 0.02, "the head turns while a line is measured"
    assert np.ptp(sensor.times_ns(np.array([0]))) == 8_330_000


# -- units of one's own ------------------------------------------------------------------------


def write(tmp_path, name, text):
    file = tmp_path / name
    file.write_text(text)
    return file


def hesai(name="hesai/xt32", off=0.1, count=None):
    table = read_model(name).beams
    rows = zip(table.elevation_deg, table.azimuth_deg or [0] * 99, strict=False)
    lines = [f"{i},{up + off:.6f},{-a:.6f}" for i, (up, a) in enumerate(rows, 1)]
    return "\n".join(["Channel,Elevation,Azimuth", *lines[:count]])


@pytest.mark.parametrize("mark", ["", "eeff,1,0\n", "EEFF\n"])
@pytest.mark.parametrize("checksum", ["", "\n" + "0a" * 32, "\n" + "0A" * 32 + ",,\n"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_files_as_hesai_writes_them(mark, checksum, newline, tmp_path):
    """As in HesaiLidar_SDK_2.0: the mark and the checksum are lines around the table."""
    plain = load_sensor(calibration=write(tmp_path, "a.csv", hesai()))
    text = f"{mark}{hesai()}{checksum}".replace("\n", newline)
    sensor = load_sensor(calibration=write(tmp_path, "b.csv", text))
    assert sensor.channels == 32
    assert np.array_equal(sensor.beams.elevation, plain.beams.elevation)
    assert np.array_equal(sensor.beams.azimuth, plain.beams.azimuth)


def test_a_calibration_finds_its_model(tmp_path):
    file = write(tmp_path, "pandar.csv", hesai())
    sensor = load_sensor(calibration=file)
    nominal = load_sensor("hesai/xt32")
    assert sensor.name == "Hesai PandarXT-32, pandar.csv"
    assert np.allclose(np.degrees(sensor.beams.elevation - nominal.beams.elevation), 0.1)
    assert np.array_equal(sensor.beams.time_ns, nominal.beams.time_ns)
    assert load_sensor("hesai/xt32", calibration=file).name == sensor.name
    robosense = write(tmp_path, "angle.csv", "\n".join(f"{-15.2 + 2 * i},{i}" for i in range(16)))
    sensor = load_sensor(calibration=robosense)
    assert sensor.name == "RoboSense RS-LiDAR-16, angle.csv"
    assert np.degrees(sensor.beams.elevation[3]) == pytest.approx(-9.2)
    assert sensor.beams.time_ns[3] == 3 * 2800 and sensor.max_range_m == 230


@pytest.mark.parametrize("new", [False, True])
def test_ousters_metadata_old_and_new(tmp_path, new):
    beams = {"beam_altitude_angles": [10.5, 0.0, -10.25], "beam_azimuth_angles": [4.0, 0.0, -1.5]}
    if new:
        shift = [1, 0, 0, 16.7, 0, 1, 0, 0, 0, 0, 1, 2.0, 0, 0, 0, 1]
        pose = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 38.195, 0, 0, 0, 1]
        data = {
            "beam_intrinsics": {**beams, "beam_to_lidar_transform": shift},
            "lidar_intrinsics": {"lidar_to_sensor_transform": pose},
            "lidar_data_format": {"pixels_per_column": 3},
            "config_params": {"lidar_mode": "512x20"},
        }
        columns = 512
        rate = 20
        origin = [0.0167, 0, 0.040195]
    else:
        data = {**beams, "lidar_mode": "2048x10", "lidar_origin_to_beam_origin_mm": 15.806}
        columns = 2048
        rate = 10
        origin = [0.015806, 0, 0.03618]
    sensor = load_sensor(calibration=write(tmp_path, "os.json", json.dumps(data)))
    assert sensor.channels == 2, "beams that are all zero are not there"
    assert (sensor.head.firings_per_turn, sensor.head.rate_hz) == (columns, rate)
    assert np.allclose(np.degrees(sensor.beams.elevation), [-10.25, 10.5])
    assert np.allclose(np.degrees(sensor.beams.azimuth), [1.5, -4])
    assert np.allclose(sensor.beams.origin, origin)
    quick = load_sensor(calibration=tmp_path / "os.json", columns=1024, rate_hz=5, max_range_m=9)
    assert (quick.period, quick.head.rate_hz, quick.max_range_m) == (1024, 5, 9)


@pytest.mark.parametrize(
    ("product", "origin_mm"),
    [("OS-0-128", 27.67), ("OS-1-16-A0", 15.806), ("OS-2-32-U0", 13.762), ("", 12.163)],
)
def test_ousters_metadata_of_firmware_before_2_has_the_origin_of_its_product(
    tmp_path, product, origin_mm
):
    """Values as in ouster-sdk."""
    data = {"beam_altitude_angles": [10.5, -10.25], "beam_azimuth_angles": [4.0, -1.5]}
    path = write(tmp_path, "os.json", json.dumps({**data, "prod_line": product}))
    origin = load_sensor(calibration=path).beams.origin
    np.testing.assert_allclose(origin, [[origin_mm / 1000, 0, 0.03618]] * 2)


def test_beams_of_ouster_that_are_turned_are_refused(tmp_path):
    mirrored = np.diag([1, -1, 1, 1]).ravel().tolist()
    data = {
        "beam_altitude_angles": [10.5, 1.0],
        "beam_azimuth_angles": [4.0, 0.0],
        "beam_to_lidar_transform": mirrored,
    }
    with pytest.raises(LidarError, match="beam_to_lidar_transform contains a rotation"):
        load_sensor(calibration=write(tmp_path, "os.json", json.dumps(data)))


@pytest.mark.parametrize(
    ("sections", "columns"),
    [
        ({"lidar_data_format": {"column_window": [256, 767]}}, range(256, 768)),
        ({"lidar_data_format": {"column_window": [768, 255]}}, range(768, 1280)),
        ({"data_format": {"column_window": [10, 10]}}, range(10, 11)),
        ({"lidar_data_format": {"column_window": [0, 1023]}}, range(1024)),
        # Counter-clockwise from column 0: the window ahead is 90 to 270 degrees.
        ({"config_params": {"azimuth_window": [90000, 270000]}}, range(256, 768)),
        ({"config_params": {"azimuth_window": [270000, 90000]}}, range(768, 1280)),
        ({"config_params": {"azimuth_window": [0, 360000]}}, range(1024)),
        (
            {
                "config_params": {"azimuth_window": [0, 90000]},
                "lidar_data_format": {"column_window": [768, 1023]},
            },
            range(768, 1024),
        ),
    ],
)
def test_an_ouster_fires_in_its_window(sections, columns, tmp_path):
    beams = {"beam_altitude_angles": [10.5, -10.25], "beam_azimuth_angles": [4.0, -1.5]}
    path = write(tmp_path, "os.json", json.dumps({"beam_intrinsics": beams, **sections}))
    sensor = load_sensor(calibration=path)
    full = load_sensor(calibration=write(tmp_path, "all.json", json.dumps(beams)))
    count = len(columns)
    steps = sensor.steps_of_revolution(0)
    assert sensor.period == count == sensor.firings(steps[-1])[1]
    directions = sensor.directions(np.arange(2 * count))
    assert np.allclose(directions[:count], full.directions(np.array(columns)), atol=1e-12)
    assert np.array_equal(directions[count:], directions[:count])
    times_ns = sensor.begins_ns(np.arange(2 * count))
    expected_ns = full.begins_ns(np.array(columns)) - full.begins_ns(np.array(columns[:1]))
    assert times_ns == pytest.approx([*expected_ns, *(expected_ns + 1e8)], abs=1e-3)
    fewer = load_sensor(calibration=path, columns=512)
    assert fewer.period == max(count // 2, 1)


@pytest.mark.parametrize(
    ("section", "says"),
    [
        (
            {"lidar_mode": "unknown"},
            "its lidar_mode must be the columns and revolutions .* but is 'unknown'",
        ),
        (
            {"lidar_mode": "1024x"},
            "its lidar_mode must be the columns and revolutions .* but is '1024x'",
        ),
        (
            {"lidar_mode": "0x10"},
            "its lidar_mode must be the columns and revolutions .* but is '0x10'",
        ),
        (
            {"azimuth_window": [0, 400000]},
            "its azimuth_window must be .* from 0 to 360,000, but is",
        ),
        ({"azimuth_window": "all"}, "its azimuth_window must be two whole numbers .* but is all"),
        (
            {"data_format": {"column_window": [0, 1024]}},
            "its column_window must be .* 0 to 1,023, but",
        ),
        ({"data_format": {"column_window": [0.5, 9]}}, "its column_window must be two whole"),
    ],
)
def test_modes_and_windows_of_ouster_that_are_not_understood(section, says, tmp_path):
    path = write(tmp_path, "os.json", json.dumps({**OLD, **section}))
    with pytest.raises(LidarError, match=f"os.json is not a valid calibration file: {says}"):
        load_sensor(calibration=path)


OLD = {"beam_altitude_angles": [10.5, 1.0, -10.25], "beam_azimuth_angles": [4.0, 0.0, -1.5]}


def test_a_list_of_rays_of_livox(tmp_path):
    """The list of a Mid-40 gives its rays back; Livox's own number the rows of a Mid-360."""
    prisms = load_sensor("livox/mid40")
    directions = prisms.directions(np.arange(500))[:, 0]
    azimuth, elevation = angles(directions)
    rows = [
        f"{i * 1e-5:.5f},{a:.4f},{90 - e:.4f}"
        for i, (a, e) in enumerate(zip(azimuth, elevation, strict=True))
    ]
    sensor = load_sensor(calibration=write(tmp_path, "mid40.csv", LIVOX + "\n".join(rows)))
    assert isinstance(sensor, ListedSensor) and sensor.period == 500
    assert np.abs(sensor.directions(np.arange(500))[:, 0] - directions).max() < 2e-6
    assert sensor.times_ns(np.array([0, 1, 499, 500]))[:, 0].tolist() == [
        0,
        10_000,
        4_990_000,
        5_000_000,
    ]
    assert sensor.firings(35)[1] == 10_000, "a frame of 0.1 s, which begins the list again"
    assert isinstance(load_sensor("livox/mid40", calibration=tmp_path / "mid40.csv"), ListedSensor)
    numbered = write(tmp_path, "mid360.csv", LIVOX + "1,268.99,37.838\n2,269.99,38\n3,270,39\n")
    sensor = load_sensor("livox/mid360", calibration=numbered)
    assert sensor.times_ns(np.arange(4))[:, 0].tolist() == [0, 5000, 10_000, 15_000]
    assert sensor.name == "Livox Mid-360, mid360.csv" and sensor.max_range_m == 70


# Shares of the field that a sensor covers after 0.1, 0.5 and 1 s. Mid-40, Horizon and Tele-15: the
# curves of Livox's documentation (livox_wiki_en, livox_scanning_pattern.rst). The others, for which
# no curve could be read: rays of a unit, as Livox lists them (livox_laser_simulation, scan_mode).
COVERED = {
    "livox/mid40": (0.195, 0.68, 0.925),
    "livox/horizon": (0.59, 0.985, 1.0),
    "livox/tele15": (0.985, 1.0, 1.0),
    "livox/avia": (0.319, 0.830, 0.970),
    "livox/mid360": (0.079, 0.331, 0.538),
    "livox/hap": (0.682, 0.953, 0.982),
}


@pytest.mark.extended(every=6)
@pytest.mark.parametrize(("name", "shares"), COVERED.items(), ids=COVERED)
def test_livox_sensors_cover_their_field_as_documented(name, shares):
    """Cells are as wide as the beam, 0.28°; the field are those that are met within 4 s."""
    sensor = load_sensor(name)
    assert ("typical pattern" in sensor.name) == (name != "livox/mid40")
    per_second = round(sensor.head.firings_per_turn * sensor.head.rate_hz)
    azimuth, elevation = angles(sensor.directions(np.arange(4 * per_second)))
    cells = (np.floor(azimuth / 0.28) * 4096 + np.floor(elevation / 0.28)).astype(np.int64)
    field = len(np.unique(cells))
    for seconds, share in zip((0.1, 0.5, 1.0), shares, strict=True):
        covered = len(np.unique(cells[: round(seconds * per_second)])) / field
        assert covered == pytest.approx(share, abs=0.05), seconds


# The first rays of Livox's lists: azimuth and elevation, degrees, of the beams from the lowest.
FIRST_RAYS = {
    "livox/avia": [
        (-35.271, -2.243), (-35.236, -1.346), (-35.218, -0.449), (-35.218, 0.449),
        (-35.236, 1.346), (-35.271, 2.243),
    ],
    "livox/horizon": [
        (-40.954, -2.276), (-40.907, -1.379), (-40.881, -0.481), (-40.877, 0.416),
        (-40.895, 1.314), (-40.935, 2.210),
    ],
    "livox/tele15": [
        (-7.323, -0.856), (-7.322, -0.539), (-7.322, -0.222), (-7.322, 0.095), (-7.322, 0.412),
        (-7.323, 0.728),
    ],
}  # fmt: skip


@pytest.mark.parametrize(("name", "listed"), FIRST_RAYS.items(), ids=FIRST_RAYS)
def test_prisms_of_livox_sensors_are_those_of_a_unit(name, listed):
    azimuth, elevation = angles(load_sensor(name).directions(np.array([0]))[0])
    assert np.column_stack([azimuth, elevation]) == pytest.approx(np.array(listed), abs=0.05)


def test_the_mid360_sees_all_around():
    azimuth, elevation = angles(load_sensor("mid360").directions(np.arange(100_000)))
    assert (elevation.min(), elevation.max()) == pytest.approx((-7, 52), abs=0.5)
    assert np.histogram(azimuth, 36)[0].min() > 8_000  # of 11,111 in ten degrees
    assert read_model("mid360").firing_us == 20 and load_sensor("mid360").channels == 4


def test_the_helios_has_the_angles_of_its_manual():
    _, elevation = angles(load_sensor("rs-helios").directions(np.array([0]))[0])
    assert elevation[[0, 15, 22, 26, 31]] == pytest.approx([-55, -10, 0, 5.5, 15], abs=1e-6)


def test_a_table_of_beams(tmp_path):
    file = write(tmp_path, "beams.csv", "azimuth_deg,elevation_deg,time_us\n1,5,2\n0,-5,4\n")
    sensor = load_sensor(calibration=file, columns=100, rate_hz=20)
    assert np.allclose(np.degrees(sensor.beams.elevation), [-5, 5])
    assert sensor.beams.time_ns.tolist() == [4000, 2000]
    assert sensor.period == 100 and sensor.max_range_m == float("inf")


def test_a_sensor_is_added_by_one_file(tmp_path):
    text = """
        name: Mine
        sources: {angles: measured, times: data sheet}
        firing_us: 50
        rate_hz: 20
        range_m: [1, 80]
        beams:
          elevation_deg: {first: -10, last: 10, count: 5}
          time_us: [0, 1, 2, 3, 4]
          origin_m: [0.1, 0, 0.2]
    """
    sensor = load_sensor(write(tmp_path, "mine.yaml", text))
    assert (sensor.name, sensor.channels, sensor.period) == ("Mine", 5, 1000)
    assert sensor.origins(np.array([250]))[0, 0] == pytest.approx([0, 0.1, 0.2])
    line = "clockwise: true\nfirings_per_turn: 40\nmirror: {motion: sawtooth, width_deg: 40}"
    sensor = load_sensor(write(tmp_path, "line.yaml", GOOD + line))
    assert np.degrees(sensor.head.azimuths(np.arange(3))) == pytest.approx([20, 19, 18])


LIVOX = "Time/s,Azimuth/deg,Zenith/deg\n"
GOOD = "name: A\nsources: {}\n"
VELODYNE = "num_lasers: 2\nlasers: [{laser_id: 0, vert_correction: 0.1, rot_correction: 0.2}"
NOISY = GOOD + "firing_us: 5\nperformance: {"
FIRST, SECOND = (f"{{sigma_m: {m}, range_m: 9, reflectance: {m}}}" for m in (0.1, 0.2))
TWICE = f"detection: {{range_m: 9, probability: 0.5}}, precision: [{FIRST}, {SECOND}]"
BAD = {
    "field.yaml": (GOOD + "firing_us: 5\nrage_m: [0, 1]", "Unknown field 'rage_m'"),
    "light.yaml": (GOOD + "firing_us: 5\noptics: {wavelength_nm: 0.9}", "wavelength_nm.*200"),
    "x.yaml": (GOOD + "firing_us: 5\naxis: x\nprisms: [{wedge_deg: 9, index: 2, rpm: 9}]", "axis"),
    "mirror.yaml": (GOOD + ("firing_us: 5\nmirror: {motion: x, "
                            "width_deg: 9}"), "mirror.motion must be"),
    "zero.yaml": (GOOD + "firing_us: 0\nbeams: {elevation_deg: [0]}", "firing_us must be above 0"),
    "short.yaml": (GOOD + "firing_us: 5\nbeams: {elevation_deg: [0, 1], time_us: [0]}", "Beams"),
    "weak.yaml": (NOISY + "range_at_threshold_m: 1}", "range_at_threshold_m requires detection"),
    "both.yaml": (NOISY + TWICE + ", range_per_m: 0.1}", "precision cannot be combined with other"),
    "falls.yaml": (NOISY + TWICE + "}", "must decrease as the energy increases"),
    "even.yaml": (GOOD + "firing_us: 5\nbeams: {elevation_deg: {first: 1}}", "first, last and"),
    "other.json": ('{"format": 3}', "no beam_altitude_angles"),
    "twice.yml": (VELODYNE.replace("2", "1", 1) + ", {laser_id: 0}]", ("must list each of the "
            "lasers 0 to 0")),
    "yaml.yaml": ("name: [", "not a valid sensor model: while parsing"),
    "empty.csv": ("\n", "it is empty"),
    "many.yaml": (GOOD + "beams: {elevation_deg: {first: 0, last: 1, count: 99999999999}}", "most"),
    "prose.csv": ("dear reader\n1,2", "'dear reader', is unknown"),
    "prose.json": ("{", "Expecting property name"),
    "mode.json": (json.dumps({**OLD, "lidar_mode": 7}), "lidar_mode must be .* but is '7'"),
    "missing.yml": (VELODYNE + "]", "must list each of the lasers 0 to 1 exactly once"),
    "key.yml": ("lasers: [{laser_id: 0, vert_correction: 1}]", "'rot_correction' is missing"),
    "mark.csv": ("eeff", "the line after eeff.* but is ''"),
    "eeff.csv": ("eeff\n1,2,3", "the line after eeff.* but is '1,2,3'"),
    "hash.csv": ("Channel,Elevation,Azimuth\n" + "0a" * 32, "it has no lines of 3 numbers"),
    "gap.csv": ("Channel,Elevation,Azimuth\n1,2,3\n3,2,3", "channels must be 1 to 2"),
    "wide.csv": ("Channel,Elevation,Azimuth\n1,2\n", "lines must have 3 numbers"),
    "nan.csv": ("Channel,Elevation,Azimuth\n1,2,3\n2,nan,3", "line 3 contains NaN"),
    "plain.csv": ("elevation_deg\n1", "Set `model` or `columns` .firings per turn."),
    "back.csv": (LIVOX + "0,1,2\n2e-5,1,2\n1e-5,1,2\n", "times decrease in line 4"),
    "count.csv": (LIVOX + "1,1,2\n2,1,2\n", r"has no firing times. Set `model`\."),
    "still.csv": (LIVOX + "0,1,2\n0,1,3\n", r"has no firing times. Set `model`\."),
    "few.csv": (hesai(count=7), "does not match a known model.* Set `model`"),
    "binary.csv": (b"\xff\xfe\x00", "encoded in UTF-16. Save it as UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize(("file", "text", "message"), [(k, *v) for k, v in BAD.items()], ids=BAD)
def test_bad_files_are_refused_in_one_line(tmp_path, file, text, message):
    path = tmp_path / file
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    given = {"model": path} if file.endswith(".yaml") else {"calibration": path}
    with pytest.raises(LidarError, match=message) as caught:
        load_sensor(**given)
    assert file in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "a model, a calibration or both"),
        (
            {"model": "velodyne/vlp61"},
            "Unknown sensor model 'velodyne/vlp61'.* mean 'velodyne/vlp16'",
        ),
        ({"model": "velodyne/vlp16", "columns": 1800}, "55.296 µs.* Remove columns"),
        ({"model": "velodyne/vlp16", "calibration": "xt.csv"}, "32 beams, but Velodyne .* has 16"),
        ({"model": "livox/mid360", "calibration": "xt.csv"}, "does not match Livox Mid-360"),
        ({"model": "hesai/xt32", "calibration": "rays.csv"}, "does not match Hesai PandarXT-32"),
        ({"calibration": "none.csv"}, r"none\.csv does not exist\.$"),
    ],
)
def test_what_does_not_fit_together(tmp_path, options, message):
    write(tmp_path, "xt.csv", hesai())
    write(tmp_path, "rays.csv", LIVOX + "0,1,2\n1e-5,1,2\n")
    if "calibration" in options:
        options = options | {"calibration": tmp_path / options["calibration"]}
    with pytest.raises(LidarError, match=message):
        load_sensor(**options)


def test_rings_match_a_model_if_they_are_most_of_its_beams():
    dense = read_model("hesai/pandar128")
    beams = np.array(dense.beams.elevation_deg)
    assert dense.matches_rings(beams) and dense.matches_rings(beams[:40])
    assert not dense.matches_rings(beams[::8])
    assert not dense.matches_rings(beams + 5)
    assert dense.matches_rings(beams[:0])

"""Sensors as files of other programs, and back: directions, times and conventions of rays."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from lidarsim import LidarError, Sensor, export_sensor, load_sensor
from lidarsim.sensor.export import fired_rays

TABLES = ("npz", "csv", "parquet")


def angle_deg(directions, others):
    """Largest angle between directions (n, 3), degrees."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(directions - others, axis=1).max() / 2))


def test_rays_of_a_revolution_are_in_the_order_of_their_times():
    sensor = load_sensor("velodyne/vlp16")
    rays = fired_rays(sensor)
    assert len(rays) == 1809 * 16 and rays.repeats
    assert rays.times_ns[0] == 0 and (np.diff(rays.times_ns) >= 0).all()
    # The laser of the second time slot, after 2.304 µs, is channel 8, at 1 degree.
    assert rays.times_ns[1] == 2304 and rays.channels[1] == 8
    assert rays.elevations_deg[1] == pytest.approx(1, abs=1e-9)
    assert rays.azimuths_deg[1] == pytest.approx(-360 * 10 * 2304e-9, abs=1e-9), "clockwise"
    assert rays.cycle_ns == 1809 * 55_296, "the last firing ends after 0.1 s"
    assert fired_rays(load_sensor("ouster/os1-64")).cycle_ns == 1e8
    half = fired_rays(Sensor.grid(360, 2, 10), seconds=0.05)
    assert len(half) == 360 and not half.repeats


@pytest.mark.parametrize("ending", TABLES)
def test_tables_of_rays_come_back_as_the_same_rays(ending, tmp_path):
    sensor = load_sensor("velodyne/hdl32e", max_range_m=77)  # its data sheet states no divergence
    file = export_sensor(sensor, tmp_path / f"rays.{ending}", revolutions=2)
    assert file.format == ending and file.left_out == ()
    back = load_sensor(calibration=tmp_path / f"rays.{ending}")
    firings = np.arange(len(file.rays))
    assert np.array_equal(back.directions(firings)[:, 0], file.rays.directions)
    assert np.array_equal(back.times_ns(firings)[:, 0], file.rays.times_ns)
    assert (back.min_range_m, back.max_range_m) == (sensor.min_range_m, 77)
    assert back.name == f"Velodyne HDL-32E, rays.{ending}"
    later = firings + len(firings)
    assert np.array_equal(back.times_ns(later)[:, 0], file.rays.times_ns + round(back.cycle_ns))


def test_starts_beside_the_centre_come_back(tmp_path):
    sensor = load_sensor("velodyne/hdl64e-s2")
    file = export_sensor(sensor, tmp_path / "rays.npz", seconds=0.001)
    assert np.abs(file.rays.origins).max() > 0.01
    back = load_sensor(calibration=tmp_path / "rays.npz")
    firings = np.arange(len(file.rays))
    assert np.array_equal(back.origins(firings)[:, 0], file.rays.origins)


def test_a_table_states_its_conventions_and_what_it_lacks(tmp_path):
    export_sensor(load_sensor("livox/mid40"), tmp_path / "rays.csv")
    lines = (tmp_path / "rays.csv").read_text().splitlines()
    remarks = [line[2:].partition(": ") for line in lines if line.startswith("#")]
    header = {name: json.loads(value) for name, _, value in remarks}
    assert header["axes"] == "x forward, y left, z up"
    assert "counter-clockwise" in header["azimuth"] and not header["repeats"]
    assert "rays after 0.1 s, which do not repeat these" in header["not_in_this_file"]
    rows = [*csv.DictReader(line for line in lines if not line.startswith("#"))]
    assert len(rows) == 10_000 and rows[1]["time_offset_ns"] == "10000"
    azimuth, elevation = np.radians([float(rows[77][f"{n}_deg"]) for n in ("azimuth", "elevation")])
    direction = [float(rows[77][f"direction_{axis}"]) for axis in "xyz"]
    expected = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)]
    assert np.allclose(direction, [*expected, np.sin(elevation)], atol=1e-10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": "rays.xyz"}, r"rays.xyz has no ending of a file of a sensor. Endings are \.npz"),
        ({"path": "rays.npz", "format": "npzz"}, "not written as 'npzz'. Did you mean 'npz'"),
        ({"path": "rays.npz", "format": "csv"}, "rays.npz does not end in .csv"),
        ({"path": "no/rays.npz"}, "folder .*no does not exist"),
        ({"path": "rays.npz", "seconds": 1e5}, "more than 20,000,000 rays in 1e[+]05 s"),
        ({"path": "rays.npz", "seconds": 1, "revolutions": 1}, "give one"),
        ({"path": "rays.npz", "seconds": -1}, "seconds"),
        ({"path": "rays.npz", "sensor": "vlp16"}, "str is no Sensor: load_sensor"),
    ],
)
def test_what_cannot_be_written_is_refused(arguments, message, tmp_path):
    settings = {"sensor": Sensor.grid(), **arguments, "path": tmp_path / arguments["path"]}
    with pytest.raises(LidarError, match=message):
        export_sensor(**settings)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"direction_x": np.zeros(3)}, "direction of ray 1 is zero"),
        ({"time_offset_ns": np.array([0, 2, 1])}, "times go back at ray 3"),
        ({"channel": np.zeros(2)}, "the same length"),
        ({"speed": np.zeros(3)}, "arrays that are not known: speed"),
        ({"azimuth_deg": np.array([0, np.nan, 0])}, "azimuth_deg of ray 2 is not finite"),
        ({"header": np.array('{"rate_hz": -1}')}, "rate_hz of its header is -1"),
        ({"header": np.array('{"cycle_ns": 1}')}, "before the last ray"),
    ],
)
def test_arrays_that_are_no_rays_are_refused(changes, message, tmp_path):
    zero = np.zeros(3)
    arrays = {"direction_x": np.ones(3), "direction_y": zero, "direction_z": zero}
    arrays["time_offset_ns"] = np.arange(3)
    np.savez(tmp_path / "rays.npz", **{**arrays, **changes})
    with pytest.raises(LidarError, match=message):
        load_sensor(calibration=tmp_path / "rays.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "rays.npz").read_bytes()[:200])
    with pytest.raises(LidarError, match=r"cut\.npz is not a usable calibration: it is no \.npz"):
        load_sensor(calibration=tmp_path / "cut.npz")

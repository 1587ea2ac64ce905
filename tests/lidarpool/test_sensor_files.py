"""Sensors as files of other programs, and back: directions, times and conventions of rays."""

from __future__ import annotations

import csv
import json
import os
import re
import runpy
import subprocess
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lidarpool.cli.commands import cli
from lidarpool.cli.import_plugins import import_atomically
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.gazebo.import_world import import_world
from lidarscenes.helios import import_scanner, is_scanner
from lidarscenes.sensors.import_sensor import import_sensor
from lidarscenes.sensors.omnilidar import read_omnilidar
from lidarsim import (
    Beams,
    LidarError,
    MujocoScanner,
    Pose,
    Sensor,
    Spin,
    export_sensor,
    load_sensor,
)
from lidarsim.sensor import LineSensor
from lidarsim.sensor.beams import Mirror
from lidarsim.sensor.export import fired_rays
from lidarsim.sensor.ray_sensors import ListedSensor
from lidarsim.sensor_files.format_table import read_rays
from raybeam import RayCaster

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
    # A beam that leaves after the start of the next firing, every 100 µs.
    overlapping = Beams(np.array([-1.0, 1.0]), time_ns=np.array([0.0, 250_000.0]))
    late = fired_rays(Sensor(overlapping, Spin(firings_per_turn=1000, rate_hz=10)))
    assert late.times_ns[-1] == 99_900_000 + 250_000
    assert late.cycle_ns == late.times_ns[-1] + 1
    half = fired_rays(Sensor.grid(360, 2, 10), seconds=0.05)
    assert len(half) == 360 and not half.repeats


@pytest.mark.extended(every=3)
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


def test_starts_beside_the_center_come_back(tmp_path):
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
    assert "counter-clockwise" in header["azimuth_deg"] and not header["repeats"]
    assert "rays after 0.1 s, where the pattern does not repeat" in header["not_in_this_file"]
    rows = [*csv.DictReader(line for line in lines if not line.startswith("#"))]
    assert len(rows) == 10_000 and rows[1]["time_offset_ns"] == "10000"
    azimuth, elevation = np.radians([float(rows[77][f"{n}_deg"]) for n in ("azimuth", "elevation")])
    direction = [float(rows[77][f"direction_{axis}"]) for axis in "xyz"]
    expected = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)]
    assert np.allclose(direction, [*expected, np.sin(elevation)], atol=1e-10)


def test_a_list_without_a_cycle_repeats_after_another_interval(tmp_path):
    rows = [f"{1000 * k},{10 * k},0" for k in range(4)]
    (tmp_path / "a.csv").write_text("\n".join(["time_offset_ns,azimuth_deg,elevation_deg", *rows]))
    sensor = load_sensor(calibration=tmp_path / "a.csv")
    assert sensor.times_ns(np.arange(9))[:, 0].tolist() == [1000 * k for k in range(9)]


def read_as_the_plug_in_does(path):
    """Times and directions as livox_laser_simulation has them: yaw, and pitch from the zenith."""
    first, *lines = path.read_text().splitlines()
    assert first == "Time/s,Azimuth/deg,Zenith/deg"  # skipped there
    time, azimuth, zenith = np.array(
        [[float(word) for word in line.split(",")] for line in lines]
    ).T
    yaw, pitch = np.radians(azimuth), np.radians(zenith) - np.pi / 2
    up = -np.sin(pitch)  # positive pitch is nose down
    return time, np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), up], axis=1)


def test_livox_lists_have_the_rays_that_the_plug_in_casts(tmp_path):
    file = export_sensor(load_sensor("livox/mid360"), tmp_path / "r.csv", format="livox")
    assert "channels" in file.left_out and "starts of the rays" not in "".join(file.left_out)
    time, directions = read_as_the_plug_in_does(tmp_path / "r.csv")
    assert angle_deg(directions, file.rays.directions) < 1e-5
    assert np.array_equal(np.rint(time * 1e9), file.rays.times_ns)
    back = load_sensor(calibration=tmp_path / "r.csv")
    firings = np.arange(len(file.rays))
    assert angle_deg(back.directions(firings)[:, 0], file.rays.directions) < 1e-5
    assert np.array_equal(back.times_ns(firings)[:, 0], file.rays.times_ns)


def room_with_boxes():
    """Vertices and faces of walls around the sensor, a floor, and boxes in it."""
    boxes = [((0, 0, 1), (30, 20, 6)), ((5, 2, -1), (1, 2, 2)), ((-4, -3, -1), (2, 1, 1.5))]
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))])
    vertices = [np.array(middle) + corners * size for middle, size in boxes]
    return np.concatenate(vertices), np.concatenate([faces + 8 * k for k in range(len(boxes))])


def test_times_of_livox_lists_are_exact_from_the_first_ray_on(tmp_path):
    beams = Beams(np.zeros(2), time_ns=np.array([501.0, 1000.0]))
    file = export_sensor(Sensor(beams), tmp_path / "r.csv", format="livox", seconds=0.3)
    assert file.rays.times_ns[:3].tolist() == [501, 1000, 100_501]
    assert np.array_equal(read_rays(tmp_path / "r.csv").times_ns, file.rays.times_ns)
    rows = ["86400.000000501,0,90", "86400.000001,1,90", "86400.000100501,2,90"]
    (tmp_path / "clock.csv").write_text("\n".join(["Time/s,Azimuth/deg,Zenith/deg", *rows]))
    assert read_rays(tmp_path / "clock.csv").times_ns.tolist() == [0, 499, 100_000]


WORLD = """
<mujoco>
  {}
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1" pos="0 0 -1"/>
    <geom name="wall" type="box" size=".1 5 3" pos="6 0 1" euler="0 5 20"/>
    <geom name="roof" type="box" size="4 4 .1" pos="-2 1 3"/>
    <site name="lidar" pos="0 0 0"/>
  </worldbody>
</mujoco>
"""


def mujoco_world(head=""):
    """MuJoCo, and a model of a world with its data."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    model = mujoco.MjModel.from_xml_string(WORLD.format(head))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco, model, data


def test_mujoco_casts_the_rays_of_angles_as_we_do(tmp_path):
    mujoco, model, data = mujoco_world()
    sensor = load_sensor("livox/mid360", min_range_m=0, max_range_m=80)
    file = export_sensor(sensor, tmp_path / "rays.npz", format="mujoco")
    with np.load(tmp_path / "rays.npz") as arrays:
        theta, phi, times = (arrays[name] for name in ("theta", "phi", "time_offset_ns"))
        assert json.loads(str(arrays["header"]))["theta"].startswith("radians from x, counter-")
    assert len(theta) == 20_000 and np.array_equal(times, file.rays.times_ns)
    # As MuJoCo-LiDAR's processor backend makes directions of theta and phi.
    vectors = np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], 1)
    geoms = np.zeros(len(theta), np.int32)
    distances = np.zeros(len(theta))
    mujoco.mj_multiRay(
        m=model, d=data, pnt=np.zeros(3), vec=vectors.ravel(), geomgroup=None, flg_static=1,
        bodyexclude=-1, geomid=geoms, dist=distances, normal=None, nray=len(theta), cutoff=80,
    )  # fmt: skip
    back = load_sensor(calibration=tmp_path / "rays.npz")
    ranges = MujocoScanner(model, back, site="lidar").ranges(data).ravel()
    hit = (geoms >= 0) & (distances < 79.9)
    assert hit.sum() > 5000 and np.abs(ranges[hit] - distances[hit]).max() < 1e-3
    assert (np.isnan(ranges) | ~np.isfinite(ranges))[geoms < 0].all()
    firings = np.arange(len(theta))
    assert angle_deg(back.directions(firings)[:, 0], file.rays.directions) < 1e-5
    assert np.array_equal(back.times_ns(firings)[:, 0], file.rays.times_ns)
    assert back.max_range_m == 80


def test_a_python_file_returns_the_angles_of_each_frame_for_mujoco(tmp_path):
    path = tmp_path / "mid360.py"
    file = export_sensor(load_sensor("livox/mid360"), path, format="mujoco", revolutions=2)
    module = runpy.run_path(str(path))
    theta, phi = module["angles"](frame=3)  # frame 3 of 2 is frame 1
    rays = slice(20_000, 40_000)
    assert np.array_equal(theta, np.radians(file.rays.azimuths_deg[rays]))
    assert np.array_equal(phi, np.radians(file.rays.elevations_deg[rays]))
    assert np.array_equal(module["times_ns"](1), file.rays.times_ns[rays])
    assert "Not in this file: channels" in module["__doc__"] and module["MAX_RANGE_M"] == 70


def test_rangefinders_measure_what_a_scanner_does(tmp_path):
    sensor = Sensor.grid(36, 8, 40, max_range_m=50)
    file = export_sensor(sensor, tmp_path / "lidar.xml", format="mjcf")
    assert file.left_out == ("times of the rays", "channels", "frame rate")
    _, model, data = mujoco_world(f'<include file="{tmp_path / "lidar.xml"}"/>')
    ranges = MujocoScanner(model, sensor, site="lidar").ranges(data).ravel()
    hit = np.isfinite(ranges)
    assert hit.sum() > 100 and np.abs(data.sensordata[hit] - ranges[hit]).max() < 1e-3
    assert "<!-- Not in this file: channels. -->" in (tmp_path / "lidar.xml").read_text()
    with pytest.raises(LidarError, match="would have 28,944 rangefinder sites"):
        export_sensor(load_sensor("velodyne/vlp16"), tmp_path / "vlp16.xml", format="mjcf")


GRIDS = {
    "round": Sensor.grid(360, 8, 40, max_range_m=50, min_range_m=0.5, rate_hz=20),
    "sector": Sensor.grid(270, 4, 10, horizontal_fov_deg=270),
    "behind": Sensor(Beams.even(3, 4.0), Spin(40, clockwise=True, zero_deg=180)),
    "line": Sensor.grid(720, 1, 0),
}


@pytest.mark.parametrize("name", GRIDS)
def test_grids_come_back_from_gazebo(name, tmp_path):
    sensor = GRIDS[name]
    export_sensor(sensor, tmp_path / "lidar.sdf")
    text = (tmp_path / "lidar.sdf").read_text()
    assert "<!-- Not in this file: times of the rays. -->" in text
    box = "<geometry><box><size>1 1 1</size></box></geometry>"
    floor = f'<model name="m"><link name="l"><visual name="v">{box}</visual></link></model>'
    lidar = text[text.index("<model") : text.index("</sdf>")]
    world = f'<sdf version="1.9"><world name="w">{floor}{lidar}</world></sdf>'
    (tmp_path / "world.sdf").write_text(world)
    (tmp_path / "scenario").mkdir()
    import_world(tmp_path / "world.sdf", tmp_path / "scenario", ())
    [file] = [file for file in (tmp_path / "scenario").iterdir() if file.name != "scenario.yaml"]
    data = yaml.safe_load((tmp_path / "scenario/scenario.yaml").read_text())["sensors"]
    [entry] = data.values()
    assert entry.get("max_range_m", np.inf) == sensor.max_range_m
    assert entry.get("min_range_m", 0) == sensor.min_range_m
    rays, back = fired_rays(sensor), fired_rays(load_sensor(file, step_deg=360))
    assert back.rate_hz == rays.rate_hz and len(back) == len(rays)
    keys = [np.round(r.directions, 9) + 0.0 for r in (rays, back)]
    ordered = [r.directions[np.lexsort(k.T)] for r, k in zip((rays, back), keys, strict=True)]
    assert angle_deg(*ordered) < 1e-5


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        ("velodyne/vlp16", "28,944 rays have .* azimuths and 16 elevations"),
        ("ouster/os1-64", "64 elevations, because channels fire at different azimuths"),
        ("livox/mid360", "the pattern has no rows"),
        (Sensor(Beams(np.radians([-5.0, 0, 1]))), "elevations are 1 to 5 degrees apart"),
    ],
)
def test_what_is_no_grid_is_refused_for_gazebo(sensor, reason, tmp_path):
    sensor = load_sensor(sensor) if isinstance(sensor, str) else sensor
    with pytest.raises(LidarError, match=f"is not a regular grid, .*{reason}"):
        export_sensor(sensor, tmp_path / "lidar.sdf")
    assert list(tmp_path.iterdir()) == []


# Types by omni.sensors.nv.lidar, "Setting Lidar Attributes", and the schemas of omni_sensors.
CORE = "omni:sensor:Core:"
OMNILIDAR_TYPES = {
    "omni:sensor:modelName": "string",
    "omni:sensor:tickRate": "float",
    **{f"{CORE}{name}": "float" for name in ("nearRangeM", "farRangeM", "waveLengthNm")},
    f"{CORE}scanType": "token",
    **{
        f"{CORE}{name}": "uint"
        for name in (
            "scanRateBaseHz", "reportRateBaseHz", "patternFiringRateHz", "numberOfEmitters",
            "numberOfChannels", "emitterStateCount", "stateResolutionStep", "numLines",
        )
    },
    f"{CORE}numRaysPerLine": "uint[]",
}  # fmt: skip
STATE_TYPES = {"azimuthDeg": "float[]", "elevationDeg": "float[]"}
STATE_TYPES |= dict.fromkeys(("fireTimeNs", "channelId", "bank"), "uint[]")


@pytest.mark.extended(keep=("mid360",))
@pytest.mark.parametrize(
    ("model", "frames"), [("livox/mid360", 2), ("ouster/os1-64", 1), ("velodyne/vlp16", 1)]
)
def test_omnilidar_has_attributes_of_the_schema_and_reads_back(model, frames, tmp_path):
    usd = pytest.importorskip("pxr.Usd", reason='needs usd-core: pip install "lidarpool[usd]"')
    path = tmp_path / "lidar.usda"
    file = export_sensor(load_sensor(model), path, revolutions=frames)
    stage = usd.Stage.Open(str(path))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "OmniLidar"
    names = [f"s{number:03d}" for number in range(1, frames + 1)]
    states = [f"OmniSensorGenericLidarCoreEmitterStateAPI:{name}" for name in names]
    schemas = prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems()
    assert list(schemas) == ["OmniSensorGenericLidarCoreAPI", *states]
    types = {a.GetName(): str(a.GetTypeName()) for a in prim.GetAttributes()}
    of_states = {
        f"{CORE}emitterState:{name}:{field}": kind
        for name in names
        for field, kind in STATE_TYPES.items()
    }
    assert types == {**OMNILIDAR_TYPES, **of_states}
    values = {a.GetName(): a.Get() for a in prim.GetAttributes()}
    emitters = values[f"{CORE}numberOfEmitters"]
    assert sum(values[f"{CORE}numRaysPerLine"]) == emitters == len(file.rays) // frames
    assert all(len(values[name]) == emitters for name in of_states)
    azimuth, elevation, times = (
        np.concatenate([np.array(values[f"{CORE}emitterState:{n}:{field}"], float) for n in names])
        for field in ("azimuthDeg", "elevationDeg", "fireTimeNs")
    )
    assert np.abs((azimuth - file.rays.azimuths_deg + 180) % 360 - 180).max() < 1e-5
    assert np.abs(elevation - file.rays.elevations_deg).max() < 1e-5
    starts = np.repeat(np.arange(frames) * 10**8, emitters)
    assert np.array_equal(times + starts, file.rays.times_ns)
    back = read_omnilidar(path)
    assert angle_deg(back.rays.directions, file.rays.directions) < 1e-5
    assert np.array_equal(back.rays.times_ns, file.rays.times_ns)
    assert back.rays.range_m == pytest.approx(file.rays.range_m)
    wavelength = values.get(f"{CORE}waveLengthNm", 905)
    others = [] if wavelength == 905 else [f"waveLengthNm = {wavelength:g}"]  # 905 is the default
    assert back.unsupported == ["channels (a ray list has one channel)", *others]


ROTARY = """#usda 1.0
def Xform "World"
{{
def OmniLidar "Lidar" (
    prepend apiSchemas = ["OmniSensorGenericLidarCoreAPI"]
){{
    token omni:sensor:Core:scanType = "ROTARY"
    uint omni:sensor:Core:scanRateBaseHz = 10
    uint omni:sensor:Core:reportRateBaseHz = 3600
    float omni:sensor:Core:farRangeM = 60
    float[] omni:sensor:Core:emitterState:s001:azimuthDeg = [0, 1]
    float[] omni:sensor:Core:emitterState:s001:elevationDeg = [-5, 5]
    uint[] omni:sensor:Core:emitterState:s001:fireTimeNs = [0, 500]
    {}
}}
}}
"""


@pytest.mark.extended
def test_rotary_omnilidars_fire_in_each_tick(tmp_path):
    pytest.importorskip("pxr", reason='needs usd-core: pip install "lidarpool[usd]"')
    path = tmp_path / "lidar.usda"
    path.write_text(ROTARY.format(f"float[] {CORE}emitterState:s001:vertOffsetM = [0.1, 0.1]"))
    sensor = read_omnilidar(path)
    rays = sensor.rays
    assert len(rays) == 720 and rays.cycle_ns == 1e8 and rays.range_m == (0, 60)
    assert rays.times_ns[:4].tolist() == [0, 500, 277_778, 278_278]
    assert np.allclose(rays.azimuths_deg[:4], [0, 1, -1, 0], atol=1e-5), "clockwise"
    assert sensor.unsupported[0] == "the emitter attributes vertOffsetM"
    path.write_text(ROTARY.format(f"float[] {CORE}emitterState:s002:azimuthDeg = [0, 1]"))
    with pytest.raises(LidarError, match="emitterState:s002 has no elevationDeg, fireTimeNs"):
        read_omnilidar(path)
    path.write_text('#usda 1.0\ndef Xform "World" {}\n')
    with pytest.raises(LidarError, match="it has no OmniLidar prim"):
        read_omnilidar(path)


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    ("window", "lowest_deg", "highest_deg", "rays"),
    [
        ((-135, 135), -135, 135, 542),  # ticks of a degree, with emitters at 0 and 1 degree
        ((0, 180), 0, 180, 362),
        ((300, 60), -60, 60, 242),
        ((-360, 360), -179, 180, 720),
    ],
)
def test_rotary_omnilidars_return_within_a_window(window, lowest_deg, highest_deg, rays, tmp_path):
    pytest.importorskip("pxr", reason='needs usd-core: pip install "lidarpool[usd]"')
    names = ("validStartAzimuthDeg", "validEndAzimuthDeg")
    lines = [f"float {CORE}{name} = {value}" for name, value in zip(names, window, strict=True)]
    path = tmp_path / "lidar.usda"
    path.write_text(ROTARY.format("\n".join(lines)))
    sensor = read_omnilidar(path)
    azimuths_deg = np.round(sensor.rays.azimuths_deg) % 360
    azimuths_deg = np.where(azimuths_deg > 180, azimuths_deg - 360, azimuths_deg)
    assert (azimuths_deg.min(), azimuths_deg.max()) == (lowest_deg, highest_deg)
    assert len(sensor.rays) == rays and sensor.rays.cycle_ns == 1e8
    assert sensor.unsupported == ["channels (a ray list has one channel)"]


@pytest.mark.extended
def test_attributes_of_an_omnilidar_that_are_not_read_are_listed(tmp_path):
    pytest.importorskip("pxr", reason='needs usd-core: pip install "lidarpool[usd]"')
    lines = """
    float omni:sensor:Core:azimuthErrorMean = 0.5
    float omni:sensor:Core:azimuthErrorStd = 0.025
    float omni:sensor:Core:rangeOffset = 0.1
    float omni:sensor:Core:elevationErrorMean = 0
    token omni:sensor:Core:rayType = "IDEALIZED"
    bool omni:sensor:Core:skipDroppingInvalidPoints = true
    float[] omni:sensor:Core:intensityMapping = [0.5, 1]
    string[] omni:sensor:Core:tags = ["a"]
    float omni:sensor:Core:startAzimuthOffsetDeg = 90
    """
    path = tmp_path / "lidar.usda"
    listed = [
        "azimuthErrorMean = 0.5", "azimuthErrorStd = 0.025", "rangeOffset = 0.1",
        "rayType = IDEALIZED", "skipDroppingInvalidPoints = True",
        "intensityMapping = 2 values", "tags = 1 values",
    ]  # fmt: skip
    path.write_text(ROTARY.format(lines))
    sensor = read_omnilidar(path)
    assert sorted(sensor.unsupported[1:]) == sorted(listed)
    assert sensor.rays.azimuths_deg[0] == pytest.approx(90)
    solid = ROTARY.replace('"ROTARY"', '"SOLID_STATE"')
    path.write_text(solid.format(f"{lines} float {CORE}validEndAzimuthDeg = 180"))
    more = ["startAzimuthOffsetDeg = 90", "validEndAzimuthDeg = 180"]
    assert sorted(read_omnilidar(path).unsupported[1:]) == sorted([*listed, *more])
    window = f"float {CORE}validStartAzimuthDeg = 0.2 \n float {CORE}validEndAzimuthDeg = 0.7"
    path.write_text(ROTARY.format(window))
    with pytest.raises(LidarError, match=r"no ray has an azimuth from 0\.2 to 0\.7 degrees"):
        read_omnilidar(path)


def test_an_imported_list_of_rays_counts_as_a_sensor(tmp_path):
    export_sensor(load_sensor("livox/mid360"), tmp_path / "a.csv", format="livox", seconds=0.01)
    arguments = ["import", str(tmp_path / "a.csv"), "-o", str(tmp_path / "out")]
    outcome = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert "scenario.yaml: 1 sensor, 0 mesh files" in outcome.output


def sensor_of_scanner(path, folder):
    """The sensor that a scanner of HELIOS++ is imported as, its mount, and the notes."""
    notes = import_atomically(import_scanner, path, folder, (), lambda scenario: None)
    content = yaml.safe_load((folder / "scenario.yaml").read_text())
    [entry] = content["sensors"].values() if "sensors" in content else [content["sensor"]]
    mount = entry.pop("mount", {})
    pose = Pose(tuple(mount.pop("position", (0, 0, 0))), **mount)
    entry["model"] = str(folder / entry["model"])
    return load_sensor(**entry), pose, notes


STRETCHED = "the exact pulse rate of 18,084.49 Hz (rounded to 18,084 Hz, with the same angles)"
AT_ONCE = "time offsets of the rays in a firing (all channels fire at once)"
NO_WAVELENGTH = "an unknown wavelength (written as 905 nm)"
SWING = Mirror(500, rate_hz=20, motion="triangle", width_deg=50, clockwise=True, zero_deg=12)
HELIOS_SENSORS = {
    "channels": ("velodyne/vlp16", (AT_ONCE, STRETCHED)),
    "beside": ("ouster/os1-64", ("ray origins outside the rotation axis of the head",)),
    "prisms": ("livox/mid40", ()),  # which start at the same angle, half a turn from zero
    "several": ("livox/avia", ()),
    "polygon": ("airborne/riegl-vq780i", ()),
    "line": (Sensor(Beams(np.radians(np.linspace(-20, 50, 70)), time_ns=np.arange(70) * 1e4),
                    Spin(400, rate_hz=1, zero_deg=33)), ()),
    "swing": (LineSensor(Beams(np.zeros(1)), SWING),
              ("the constant speed of the mirror (HELIOS++ slows it down at the ends of lines)",)),
    "grid": (Sensor.grid(360, 8, 40, max_range_m=50, min_range_m=0.5, rate_hz=20), ()),
}  # fmt: skip


@pytest.mark.extended(keep=("channels", "prisms", "polygon", "line"))
@pytest.mark.parametrize("name", HELIOS_SENSORS)
def test_scanners_of_helios_come_back_as_the_same_sensor(name, tmp_path):
    sensor, left_out = HELIOS_SENSORS[name]
    sensor = load_sensor(sensor) if isinstance(sensor, str) else sensor
    if name == "line":
        turning = sensor.beams.with_rotation(sensor.head.radians_per_ns)
        sensor = replace(sensor, beams=turning)
    file = export_sensor(sensor, tmp_path / "lidar.xml", format="helios")
    unknown = (NO_WAVELENGTH,) * (sensor.optics.wavelength_nm is None)
    assert sorted(file.left_out) == sorted((*left_out, *unknown)) and not len(file.rays)
    assert is_scanner(tmp_path / "lidar.xml")
    back, mount, notes = sensor_of_scanner(tmp_path / "lidar.xml", tmp_path / "new")
    swings = name == "swing"
    assert [note.partition(" of ")[0] for note in notes] == ["turning points"] * swings
    firings = np.arange(0, 5000, 7)
    directions = back.directions(firings) @ mount.rotation_matrix.T
    assert angle_deg(directions.reshape(-1, 3), sensor.directions(firings).reshape(-1, 3)) < 1e-5
    times, expected = back.begins_ns(firings), sensor.begins_ns(firings)
    if name == "channels":
        expected *= 1e6 / 55.296 / 18_084
    assert np.abs(times - expected).max() < 500, "a line of the polygon lasts 5,000 pulses"
    assert (back.min_range_m, back.max_range_m) == (sensor.min_range_m, sensor.max_range_m)
    if name == "channels":  # which start on the axis, above and below the center
        heights = back.origins(firings)[..., 2] + mount.position[2]
        assert np.allclose(heights, sensor.origins(firings)[..., 2], atol=1e-9)


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        ("livox/mid360", "a mirror behind its prisms"),
        ("airborne/leica-als50-ii", "its mirror oscillates sinusoidally"),
        (ListedSensor(), "the sensor is a list of rays"),
        (
            Sensor(Beams(np.zeros(1)), Spin(1, rate_hz=0.1, step_deg=360)),
            "fires 0.1 times per second",
        ),
    ],
)
def test_what_is_no_scanner_is_refused_for_helios(sensor, reason, tmp_path):
    sensor = load_sensor(sensor) if isinstance(sensor, str) else sensor
    with pytest.raises(
        LidarError, match=f"cannot be written as a HELIOS.*: .*{reason}.*npz and csv"
    ):
        export_sensor(sensor, tmp_path / "lidar.xml", format="helios")
    assert list(tmp_path.iterdir()) == []


SCANNERS = """<document>
<scanner id="far" name="Far" optics="conic" pulseFreqs_Hz="1000,2000" scanFreqMax_Hz="50"
  scanAngleMax_deg="20" accuracy_m="0.02" rangeMin_m="2" maxNOR="1"><beamOrigin z="0.1"/></scanner>
<scanner id="two" name="Two" optics="rotating" pulseFreqs_Hz="1000" scanAngleMax_deg="1"
  scanAngleEffectiveMax_deg="1" scanFreqMin_Hz="0" headRotatePerSecMax_deg="3600"><channels>
  <channel id="low"><beamOrigin><rot axis="x" angle_deg="-5"/></beamOrigin></channel>
  <channel id="high"><beamOrigin y="0.2"><rot axis="x" angle_deg="5"/></beamOrigin></channel>
</channels></scanner>
</document>"""


def test_a_scanner_of_many_is_named_and_has_its_highest_rates(tmp_path):
    path = tmp_path / "scanners.xml"
    path.write_text(SCANNERS)
    with pytest.raises(
        LidarError,
        match=r"2 scanners. Select one, for example scanners.xml#far. Its scanners are far, ",
    ):
        sensor_of_scanner(path, tmp_path / "new")
    with pytest.raises(LidarError, match=r"the file has no <scanner> 'fur'\. Did you mean 'far'"):
        sensor_of_scanner(tmp_path / "scanners.xml#fur", tmp_path / "new")
    sensor, mount, [note] = sensor_of_scanner(tmp_path / "scanners.xml#far", tmp_path / "new")
    assert note == "scanners without <scannerSettings> (the highest rates are used)"
    assert sensor.times_ns(np.arange(2))[:, 0].tolist() == [0, 500_000] and sensor.min_range_m == 2
    assert np.allclose(np.degrees(np.arcsin(sensor.directions(np.arange(9))[:, 0, 2])), 70)
    assert mount.position == (0, 0, 0.1) and mount.rotation is not None
    content = yaml.safe_load((tmp_path / "new/scenario.yaml").read_text())
    assert content["noise"] == {"range_m": 0.02} and content["returns"]["mode"] == "first"
    notes = import_atomically(
        import_scanner, tmp_path / "scanners.xml#two", tmp_path / "two", (), Scenario.load
    )
    assert notes[-1] == "2 channels in one sensor (they become separate sensors)"
    assert [*Scenario.load(tmp_path / "two/scenario.yaml").sensors] == ["low", "high"]


def test_a_scanner_without_a_leg_has_no_warmup(tmp_path):
    """The warmup precedes the start of a leg, which only surveys have."""
    directions = []
    for number, warmup in enumerate(("", 'opticsWarmupPhase_s="0.003"')):
        settings = f'<scannerSettings id="far" pulseFreq_hz="2000" {warmup}/>'
        text = SCANNERS.replace("</document>", f"{settings}</document>")
        (tmp_path / "scanners.xml").write_text(text)
        sensor, *_ = sensor_of_scanner(tmp_path / "scanners.xml#far", tmp_path / f"{number}")
        directions.append(sensor.directions(np.arange(20)))
    np.testing.assert_array_equal(*directions)


def test_a_python_file_returns_the_rays_of_each_frame(tmp_path):
    """In a process that has NumPy and nothing of ours; vertices of the file are its sensor's."""
    sensor = load_sensor("livox/mid360")
    file = export_sensor(sensor, tmp_path / "mid360.py", revolutions=3)
    assert (tmp_path / "mid360.py").stat().st_size < 1_500_000
    code = """
import sys
import mid360
import numpy as np
assert not {"lidarsim", "lidarpool"} & sys.modules.keys()
origins, directions, times_ns = mid360.rays(frame=4)
np.savez("out.npz", origins=origins, directions=directions, times_ns=times_ns)
print(mid360.NAME, mid360.RATE_HZ, mid360.FRAMES, mid360.MAX_RANGE_M)
"""
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=environment
    )
    assert done.stdout == "Livox Mid-360, typical pattern 10.0 3 70.0\n", done.stderr
    with np.load(tmp_path / "out.npz") as arrays:
        frame = slice(20_000, 40_000)  # frame 4 of 3 is frame 1
        assert arrays["directions"].dtype == np.float32 and not arrays["origins"].any()
        assert angle_deg(arrays["directions"], file.rays.directions[frame]) < 1e-5
        assert np.array_equal(arrays["times_ns"], file.rays.times_ns[frame])


@pytest.mark.parametrize("model", ["livox/mid360", "velodyne/hdl64e-s2"])
def test_warp_casts_the_rays_of_a_python_file_as_we_do(model, tmp_path):
    """On its CPU device, in one mesh; the origins of the second sensor are beside its center."""
    warp = pytest.importorskip("warp", reason="Warp is not installed: pip install warp-lang")
    from tests.warp_kernels import first_distances

    file = export_sensor(load_sensor(model), tmp_path / "lidar.py", seconds=0.02)
    origins, directions, _ = runpy.run_path(str(tmp_path / "lidar.py"))["rays"]()
    vertices, faces = room_with_boxes()
    warp.init()
    mesh = warp.Mesh(
        warp.array(np.float32(vertices), dtype=warp.vec3, device="cpu"),
        warp.array(np.int32(faces.ravel()), dtype=int, device="cpu"),
    )
    starts, rays = (warp.array(a, dtype=warp.vec3, device="cpu") for a in (origins, directions))
    distances = warp.empty(len(origins), dtype=float, device="cpu")
    arguments = [mesh.id, starts, rays, distances]
    warp.launch(first_distances, dim=len(origins), inputs=arguments, device="cpu")
    ours = RayCaster(vertices, faces, backend="numpy").cast(
        file.rays.origins_or_center, file.rays.directions
    )
    assert np.abs(distances.numpy() - ours.distance).max() < 1e-3  # no ray leaves the room


class Tensor(np.ndarray):
    """An array that has a device, as a tensor has."""

    device = "cuda:0"


def stand_ins(monkeypatch):
    """Modules with the documented base classes of Isaac Lab, mjlab and Genesis, and of torch."""

    class Options(SimpleNamespace):
        """Keeps its arguments, as configurations do."""

    class RaycastPattern:
        """As in Genesis: its constructor asks for the shape, and has directions computed."""

        def __init__(self):
            self._ray_dirs = np.empty((*self._get_return_shape(), 3), np.float32).view(Tensor)
            self.compute_ray_dirs()

    def tensor(values, device):
        assert device == "cuda:0"
        return np.array(values).view(Tensor)

    names = {
        "torch": {"tensor": tensor},
        "isaaclab.sensors": {"RayCasterCfg": Options},
        "isaaclab.sensors.ray_caster.patterns": {"PatternBaseCfg": object},
        "isaaclab.utils": {"configclass": dataclass},
        "mjlab.sensor": {"ObjRef": Options, "RayCastSensorCfg": Options},
        "genesis": {"sensors": SimpleNamespace(Lidar=Options)},
        "genesis.options.sensors.raycaster": {"RaycastPattern": RaycastPattern},
    }
    for name, values in names.items():
        parts = name.split(".")
        for count in range(1, len(parts) + 1):
            module = sys.modules.get(".".join(parts[:count]))
            if module is None or not hasattr(module, "stands_in"):
                module = ModuleType(".".join(parts[:count]))
                module.stands_in = True
                monkeypatch.setitem(sys.modules, module.__name__, module)
        vars(module).update(values)


def test_recipes_give_the_rays_to_other_simulators(tmp_path, monkeypatch):
    """Code of the documentation beside stand-ins of the classes that it derives from."""
    file = export_sensor(load_sensor("livox/mid360"), tmp_path / "mid360.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "mid360", raising=False)
    stand_ins(monkeypatch)
    page = Path(__file__).parents[2] / "docs/how-to/other-simulators.md"
    blocks = re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)
    recipes = {
        name: next(b for b in blocks if f"from {name}" in b)
        for name in ("isaaclab", "mjlab", "genesis")
    }
    spaces = {name: {"__name__": name} for name in recipes}
    for name, code in recipes.items():
        exec(compile(code, name, "exec"), spaces[name])
    lab = spaces["isaaclab"]["lidar"].pattern_cfg
    directions = {
        "isaaclab": type(lab).__dataclass_fields__["func"].default(lab, "cuda:0")[1],
        "mjlab": spaces["mjlab"]["lidar"].pattern.generate_rays(None, "cuda:0")[1],
    }
    scene = SimpleNamespace(add_sensor=lambda options: options)
    lidar = spaces["genesis"]["add_lidar"](scene, SimpleNamespace(idx=3))
    directions["genesis"] = lidar.pattern._ray_dirs
    assert lidar.max_range == 70 and spaces["isaaclab"]["lidar"].max_distance == 70
    for name, vectors in directions.items():
        assert angle_deg(np.asarray(vectors), file.rays.directions) < 1e-5, name
    monkeypatch.delitem(sys.modules, "mid360")


def test_a_python_file_has_the_starts_of_the_rays(tmp_path):
    file = export_sensor(load_sensor("velodyne/hdl64e-s2"), tmp_path / "hdl64.py", seconds=0.002)
    module = runpy.run_path(str(tmp_path / "hdl64.py"))
    origins, directions, _ = module["rays"]()
    assert np.allclose(origins, file.rays.origins, atol=1e-7) and len(directions) == len(file.rays)
    assert "Not in this file: channels" in module["__doc__"]


def test_rgl_rays_are_matrices_that_take_z_to_the_ray(tmp_path):
    sensor = load_sensor("velodyne/hdl64e-s2")
    file = export_sensor(sensor, tmp_path / "rays.npz", format="rgl")
    with np.load(tmp_path / "rays.npz") as arrays:
        kinds = {
            name: (arrays[name].dtype, arrays[name].shape) for name in arrays if name != "header"
        }
        matrices = arrays["rays"].astype(np.float64)
        count = len(file.rays)
        assert kinds == {
            "rays": (np.float32, (count, 3, 4)),
            "ring_ids": (np.int32, (count,)),
            "time_offsets": (np.float32, (count,)),
            "ranges": (np.float32, (1, 2)),
        }
        assert np.array_equal(arrays["ring_ids"], file.rays.channels)
        assert np.abs(arrays["time_offsets"] - file.rays.times_ns / 1e6).max() < 1e-5
    ends = matrices @ [0, 0, 5, 1]  # five meters along the z axis
    expected = file.rays.origins + 5 * file.rays.directions
    assert np.abs(ends - expected).max() < 1e-5
    rotations = matrices[:, :, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(rotations), 1, atol=1e-6)
    back = load_sensor(calibration=tmp_path / "rays.npz")
    firings = np.arange(count)
    assert angle_deg(back.directions(firings)[:, 0], file.rays.directions) < 1e-5
    assert np.abs(back.times_ns(firings)[:, 0] - file.rays.times_ns).max() <= 8, "float32 ms"
    assert np.abs(back.origins(firings)[:, 0] - file.rays.origins).max() < 1e-7
    assert np.array_equal(read_rays(tmp_path / "rays.npz").channels, file.rays.channels)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rays": np.zeros((2, 4, 4))}, r"rays must .* but has \(2, 4, 4\)"),
        ({"rays": np.zeros((2, 3, 4))}, "direction of ray 1 is zero"),
        ({"time_offsets": np.array([1.0, 0.5])}, "times decrease at ray 2"),
        ({"ring_ids": np.zeros(3)}, "the same length"),
        ({"intensity": np.zeros(2)}, "unknown arrays: intensity"),
        ({"ranges": np.zeros(2)}, "max_range_m of its header must be greater than 0, but is 0.0"),
        (
            {"header": np.array('{"rate_hz": 0}')},
            "rate_hz of its header must be greater than 0, but is 0",
        ),
    ],
)
def test_arrays_that_are_no_inputs_of_rgl_are_refused(changes, message, tmp_path):
    np.savez(tmp_path / "rays.npz", **{"rays": np.tile(np.eye(3, 4), (2, 1, 1)), **changes})
    with pytest.raises(LidarError, match=message):
        load_sensor(calibration=tmp_path / "rays.npz")


def test_arrays_of_mujoco_lidar_without_times_are_spread_over_a_frame(tmp_path):
    theta, phi = np.meshgrid(np.linspace(-1, 1, 10), np.linspace(0, 0.5, 4))
    np.savez(tmp_path / "rays.npz", theta=theta.ravel(), phi=phi.ravel())
    sensor = load_sensor(calibration=tmp_path / "rays.npz")
    assert np.array_equal(sensor.times_ns(np.arange(41))[:, 0], np.arange(41) * 2_500_000)
    np.savez(tmp_path / "half.npz", theta=theta.ravel())
    with pytest.raises(LidarError, match="no array phi"):
        load_sensor(calibration=tmp_path / "half.npz")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"path": "rays.xyz"},
            r"rays.xyz is not a sensor format. The supported extensions are \.npz",
        ),
        (
            {"path": "rays.npz", "format": "npzz"},
            "Unknown sensor format 'npzz'. Did you mean 'npz'",
        ),
        ({"path": "rays.npz", "format": "csv"}, "rays.npz must end in .csv"),
        ({"path": "no/rays.npz"}, "folder .*no does not exist"),
        ({"path": "rays.npz", "seconds": 1e5}, "more than 20,000,000 rays in 100,000 s"),
        ({"path": "rays.npz", "seconds": 1, "revolutions": 1}, "cannot be combined"),
        ({"path": "rays.npz", "seconds": -1}, "seconds"),
        (
            {"path": "rays.npz", "sensor": "vlp16"},
            "sensor must be a Sensor, but is 'vlp16'. Load one with load_sensor",
        ),
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
        ({"time_offset_ns": np.array([0, 2, 1])}, "times decrease at ray 3"),
        ({"channel": np.zeros(2)}, "the same length"),
        ({"speed": np.zeros(3)}, "unknown arrays: speed"),
        ({"azimuth_deg": np.array([0, np.nan, 0])}, "azimuth_deg of ray 2 is NaN or infinite"),
        (
            {"header": np.array('{"rate_hz": -1}')},
            "rate_hz of its header must be greater than 0, but is -1",
        ),
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
    with pytest.raises(
        LidarError, match=r"cut\.npz is not a valid calibration file: it is not a valid \.npz"
    ):
        load_sensor(calibration=tmp_path / "cut.npz")


@pytest.mark.parametrize(
    ("name", "file_format"),
    [
        ("rays.csv", "livox"),
        ("rays.npz", "mujoco"),
        ("rays.csv", None),
        ("rays.usda", None),
    ],
)
def test_import_makes_a_scenario_of_a_file(name, file_format, tmp_path):
    if name.endswith(".usda"):
        pytest.importorskip("pxr", reason='needs usd-core: pip install "lidarpool[usd]"')
    file = export_sensor(load_sensor("livox/mid360"), tmp_path / name, format=file_format)
    left_out = import_atomically(
        import_sensor, tmp_path / name, tmp_path / "new", (), Scenario.load
    )
    assert len(left_out) == (file_format is None), left_out
    built = prepare(Scenario.load(tmp_path / "new/scenario.yaml"), plans=False)
    [carried] = built.survey.mounted_sensors
    firings = np.arange(len(file.rays))
    assert angle_deg(carried.sensor.directions(firings)[:, 0], file.rays.directions) < 1e-5
    assert np.array_equal(carried.sensor.times_ns(firings)[:, 0], file.rays.times_ns)
    if file_format != "livox":  # its lists have no ranges
        assert carried.sensor.max_range_m == 70 and carried.sensor.min_range_m > 0


def test_import_reads_tables_of_other_programs(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("Time [us],Azimuth [rad],Elevation [deg]\n5,0.5,10\n6,-0.5,-10\n8,0,90\n")
    left_out = import_atomically(import_sensor, path, tmp_path / "new", (), Scenario.load)
    assert left_out == []
    sensor = load_sensor(calibration=tmp_path / "new/rays.npz")
    assert sensor.times_ns(np.arange(3))[:, 0].tolist() == [0, 1000, 3000]
    x, y, z = sensor.directions(np.arange(3))[:, 0].T
    assert np.allclose(np.arctan2(y, x)[:2], [0.5, -0.5])
    assert np.allclose(np.degrees(np.arcsin(z)), [10, -10, 90])
    path.write_text("azimuth_deg,elevation_deg\n0,0\n1,0\n")
    [line] = import_atomically(import_sensor, path, tmp_path / "untimed", (), Scenario.load)
    assert line == "files without firing times (2 rays are fired in 0.1 s)"
    path.write_text("azimuth_deg,speed\n0,0\n")
    with pytest.raises(
        LidarError,
        match=r"mine\.csv cannot be converted to a scenario: it cannot be read as a sensor.*speed",
    ):
        import_atomically(import_sensor, path, tmp_path / "no", (), Scenario.load)
    assert not (tmp_path / "no").exists()

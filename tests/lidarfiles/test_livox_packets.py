"""Packets of Livox, decoded by a plain reader of Livox's protocol."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from tests.packet_surveys import encoded, payloads_to, points_of
from tests.shapes import Cart, box, room, wall

from lidarfiles.clouds.navigation_files import write_instruments
from lidarsim import (
    Fault,
    Imu,
    LidarError,
    Mounted,
    Navigation,
    Noise,
    Pose,
    Returns,
    Scene,
    Survey,
    load_sensor,
)
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.shots import Shots
from lidarsim.sensor.models import read_model

COLUMNS = ("ray", "range", "reflectivity", "time", "azimuth", "elevation")
RATE_HZ = 10


@dataclass(frozen=True)
class Manual:
    """What a reader knows of a model, by Livox's protocols; ports of the sensor and of the host."""

    lines: int
    firing_us: float
    points_ports: tuple[int, int]
    imu_ports: tuple[int, int]


MODELS = {
    "mid360": Manual(4, 20.0, (56_300, 56_301), (56_400, 56_401)),
    "hap": Manual(6, 6000 / 452, (57_000, 57_000), (58_000, 58_000)),
}
UNITS_MM = {1: 1, 2: 10}  # {type of data: unit of coordinates}
CASES = [(model, kind) for model in MODELS for kind in UNITS_MM]


class Row(NamedTuple):
    """A point in a packet."""

    firing: int  # since the first packet
    line: int
    x_mm: int
    y_mm: int
    z_mm: int
    reflectivity: int
    time_us: float  # by the sensor's clock, with points evenly spaced in their packet


class Header(NamedTuple):
    """What comes before the points of a packet."""

    interval: int  # 0.1 µs
    count: int
    number: int
    frame: int
    data_type: int
    time_type: int
    stamp_ns: int


def plain_crc(data: bytes) -> int:
    """CRC-32 bit by bit, as in Livox's protocol."""
    crc = 0xFFFF_FFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB8_8320 if crc & 1 else 0)
    return crc ^ 0xFFFF_FFFF


def header_of(data: bytes) -> Header:
    """Return the header of a packet, after checks of its constant fields."""
    version, length, *fields = struct.unpack_from("<BHHHHBBB", data)
    assert version == 0 and length == len(data) and not any(data[12:24])
    return Header(*fields, struct.unpack_from("<Q", data, 28)[0])


def plain_rows(payloads, model: str, kind: int) -> list[Row]:
    """Return the points of packets that are not zeros, read field by field."""
    lines = MODELS[model].lines
    size, numbers = {1: (14, "<3i2B"), 2: (8, "<3h2B")}[kind]
    rows = []
    for packet, payload in enumerate(payloads):
        data = payload.tobytes()
        header = header_of(data)
        assert (header.data_type, header.count, len(data)) == (kind, 96, 36 + 96 * size)
        for n in range(96):
            x, y, z, reflectivity, tag = struct.unpack_from(numbers, data, 36 + size * n)
            position = [UNITS_MM[kind] * value for value in (x, y, z)]
            is_first = model == "hap" and np.linalg.norm(position) > 1500  # of the returns
            assert tag == (0x10 if is_first else 0)
            if x == y == z == 0:
                assert reflectivity == 0
                continue
            firing, line = divmod(n, lines)
            time_us = header.stamp_ns / 1000 + header.interval / 10 * n / 95
            rows.append(Row(packet * 96 // lines + firing, line, *position, reflectivity, time_us))
    return rows


@cache
def posts_before_walls() -> Scene:
    """Walls around with gaps between, and a row of posts."""
    posts = [box(f"post {n}", (4, n / 2, -2), (4.05, n / 2 + 0.1, 2)) for n in range(-9, 10)]
    walls = [wall("left", 8, (1, 9), (-4, 20)), wall("right", 9, (-12, 0), (-4, 20))]
    beside = [box("beside", (-9, -9, -2), (2, -8, 20)), box("behind", (-7, -3, -2), (-6, 3, 20))]
    return Scene.from_meshes([*walls, *posts, *beside])


def sensor_of(model, kind, **options):
    """Return a sensor that sends a type of data."""
    sensor = load_sensor(f"livox/{model}", **options)
    return sensor if kind == 1 else sensor.with_packets({}, {"data_type": kind})


@cache
def scanned(model: str, kind: int):
    """Return a survey of some milliseconds, its points and its sweeps."""
    survey = Survey(
        sensor=sensor_of(model, kind), poses=[Pose((0.0, 0.0, 0.0), 25.0)], steps=3,
        columns=COLUMNS, keep_every=1, precision_m=1e-6, noise=Noise(range_m=0.02),
    )  # fmt: skip
    return survey, *points_of(survey, posts_before_walls())


@cache
def payloads_of(model, kind):
    _, cloud, sweeps = scanned(model, kind)
    return payloads_to(MODELS[model].points_ports[1], encoded(cloud, sweeps))


def firings_of(survey, cloud):
    """Return the firing of each point."""
    sensor = survey.mounted_sensors[0].sensor
    first = np.array([sensor.firings(step)[0] for step in range(survey.steps)])
    return first[cloud["scan"]] + cloud["ray"] // sensor.channels


def expected_rows(survey, cloud, positions_m, count: int):
    """Return the fields of `Row` of the first firings of a survey's points: (n, 7)."""
    firings = firings_of(survey, cloud)
    rows = np.column_stack(
        [
            firings,
            cloud["channel"],
            1000 * positions_m,
            cloud["reflectivity"],
            cloud["time"] / 1000,
        ]
    )
    return rows[firings < count]


def check_rows(rows, expected, model, kind):
    """Assert that points are those of a survey, in the packets' units."""
    manual = MODELS[model]
    rows = np.array(sorted(rows))
    expected = expected[np.lexsort(expected[:, 1::-1].T)]
    assert len(rows) > 400 and rows.shape == expected.shape
    assert (rows[:, [0, 1, 5]] == expected[:, [0, 1, 5]]).all()
    assert abs(rows[:, 2:5] - expected[:, 2:5]).max() <= UNITS_MM[kind] / 2 + 0.02
    # Lines of a firing fire at once; readers of the protocol space them evenly.
    late_us = rows[:, 1] * manual.firing_us / manual.lines
    assert abs(rows[:, 6] - late_us - expected[:, 6]).max() < 0.2


def check(payloads, model, kind):
    survey, cloud, sweeps = scanned(model, kind)
    in_sensor = sweeps.in_sensor(0, cloud.positions)
    expected = expected_rows(survey, cloud, in_sensor, len(payloads) * 96 // MODELS[model].lines)
    check_rows(plain_rows(payloads, model, kind), expected, model, kind)
    headers = [header_of(payload.tobytes()) for payload in payloads]
    assert [header.number for header in headers] == list(range(len(headers)))
    assert {(header.frame, header.time_type) for header in headers} == {(0, 0)}
    for payload in payloads[:2]:
        data = payload.tobytes()
        assert plain_crc(data[28:]) == struct.unpack_from("<I", data, 24)[0]


@pytest.mark.parametrize(("model", "kind"), CASES)
def test_packets_hold_the_points_of_the_cloud(model, kind):
    check(payloads_of(model, kind), model, kind)


@pytest.mark.parametrize("model", MODELS)
def test_datagrams_have_the_ports_of_the_sensor_and_the_host(model):
    _, cloud, sweeps = scanned(model, 1)
    (group,) = encoded(cloud, sweeps)
    assert (group.source_port, group.port) == MODELS[model].points_ports


def mutated(payloads, field):
    """Return packets with a fault of the smallest size that counts, in the first packet."""
    changed = payloads.copy()
    packet = changed[0]
    point = next(n for n in range(36, len(packet), 14) if packet[n : n + 12].any())
    offset, number, value = {
        "x": (point, "<i4", 1),
        "y": (point + 4, "<i4", -1),
        "reflectivity": (point + 12, "u1", 1),
        "tag": (point + 13, "u1", 1),
        "stamp": (28, "<u8", 4000),  # nanoseconds
        "interval": (3, "<u2", 40),  # 0.1 µs
        "number": (7, "<u2", 1),
        "frame": (9, "u1", 1),
        "type": (10, "u1", 1),
        "checksum": (24, "<u4", 1),
    }[field]
    packet[offset : offset + np.dtype(number).itemsize].view(number)[:] += value
    return changed


FIELDS = [
    "x", "y", "reflectivity", "tag", "stamp", "interval", "number", "frame", "type", "checksum",
]  # fmt: skip


@pytest.mark.parametrize("field", FIELDS)
def test_a_fault_of_a_packet_is_detected(field):
    with pytest.raises(AssertionError):
        check(mutated(payloads_of("mid360", 1), field), "mid360", 1)


def synthetic_shots(model, kind=1):
    """Return shots of 60 firings whose returns follow from their numbers, without casting."""
    sensor = sensor_of(model, kind)
    manual = MODELS[model]
    firings = np.arange(60)
    number = np.arange(60 * manual.lines).reshape(1, 60, manual.lines)
    range_m = (500 + number * 7919 % 14_000) * 0.002
    range_m[0, 2::5] = np.nan  # firings without a return
    starts_ns = np.rint(firings * manual.firing_us * 1000).astype(np.int64)
    return sensor, Shots(
        firings=firings,
        starts_ns=starts_ns,
        stamps_ns=starts_ns,
        azimuths=np.zeros(60),
        dropped=np.zeros(60, bool),
        range_m=range_m.astype(np.float32),
        columns={"reflectivity": (number % 251).astype(np.uint8)},
    )


# What livox_ros_driver2 reads of the synthetic shots: points that are not zeros; sums of
# reflectivity, lines, and x, y and z in millimeters; and the start of the SHA-256 of the packets.
RECORDED = {
    ("mid360", 1): (152, 14356, 228, -741857, -1243000, 1714207, "577f4a59a66befb3"),
    ("mid360", 2): (152, 14356, 228, -741880, -1243060, 1714130, "b3a876832028afe8"),
    ("hap", 1): (228, 26083, 570, 1965837, -2714333, -97912, "62513abd2b592ef2"),
    ("hap", 2): (228, 26083, 570, 1965860, -2714380, -97920, "89b31047fd6a1a6e"),
}


@pytest.mark.parametrize(("model", "kind"), CASES)
def test_packets_are_those_that_livox_ros_driver2_has_read(model, kind):
    sensor, shots = synthetic_shots(model, kind)
    encoder = encoder_of(PacketSource(sensor, "strongest"))
    groups = encoder.encode(shots[:13]) + encoder.encode(shots[13:])
    payloads = payloads_to(MODELS[model].points_ports[1], groups)
    rows = np.array(plain_rows(payloads, model, kind))
    digest = hashlib.sha256(payloads.tobytes()).hexdigest()[:16]
    figures = rows[:, [5, 1, 2, 3, 4]].astype(int).sum(axis=0).tolist()
    assert (len(rows), *figures, digest) == RECORDED[model, kind]


def moving_survey(model="mid360", **options):
    """Return a survey of a sensor that drives for two frames and a half."""
    options = {"steps": 90, "columns": COLUMNS, "keep_every": 1, "precision_m": 1e-6} | options
    sensor = options.pop("sensor", None) or sensor_of(model, 1)
    return Survey(
        sensors=[Mounted(sensor, Pose((0.5, 0.0, 0.0), 20.0, 10.0), "lidar")],
        trajectory=Cart(stations=1, height=0.0), coordinates="sensor", **options,
    )  # fmt: skip


@pytest.mark.extended
def test_packets_continue_from_frame_to_frame_while_the_sensor_moves():
    """A frame of 5,000 firings is not a whole number of packets of 24."""
    survey = moving_survey()
    cloud, sweeps = points_of(survey, room())
    groups = encoded(cloud, sweeps)
    payloads = payloads_to(56_301, groups)
    count = survey.mounted_sensors[0].sensor.firings(89)[1] // 24
    assert len(payloads) == count
    headers = [header_of(payload.tobytes()) for payload in payloads]
    stamps = np.array([header.stamp_ns for header in headers])
    assert (stamps == 480_000 * np.arange(count)).all()
    frames = stamps // 100_000_000
    assert [header.frame for header in headers] == frames.tolist()
    firsts = np.searchsorted(frames, frames)
    assert [header.number for header in headers] == (np.arange(count) - firsts).tolist()
    angles = np.radians([cloud["azimuth"], cloud["elevation"]])
    ahead = np.cos(angles[1]) * [np.cos(angles[0]), np.sin(angles[0])]
    rays = np.vstack([ahead, np.sin(angles[1])[None]])
    some = len(payloads) // 2
    expected = expected_rows(survey, cloud, (rays * cloud["range"]).T, 24 * some)
    expected = expected[expected[:, 0] >= 24 * (some - 20)]
    rows = plain_rows(payloads[some - 20 : some], "mid360", 1)
    shifted = [row._replace(firing=row.firing + 24 * (some - 20)) for row in rows]
    check_rows(shifted, expected, "mid360", 1)


@pytest.mark.extended
def test_dropped_packets_are_left_out_and_counted():
    fault = Fault("dropped_packets", from_s=0.05, share=0.3, packet=24)
    survey = moving_survey(faults=[fault], steps=36)
    cloud, sweeps = points_of(survey, room())
    payloads = payloads_to(56_301, encoded(cloud, sweeps))
    headers = [header_of(payload.tobytes()) for payload in payloads]
    numbers = [header.number for header in headers]
    assert numbers == np.unique(firings_of(survey, cloud) // 24)[: len(numbers)].tolist()
    assert 0.2 < (208 - len(numbers)) / (208 - 104) < 0.5


@pytest.mark.extended
def test_a_jump_of_the_clock_is_in_the_stamps():
    survey = moving_survey(faults=[Fault("time_jump", from_s=0.05, by_s=0.02)], steps=36)
    groups = encoded(*points_of(survey, room()))
    headers = [header_of(payload.tobytes()) for payload in payloads_to(56_301, groups)]
    steps = np.diff([header.stamp_ns for header in headers])
    assert sorted(set(steps.tolist())) == [480_000, 20_480_000]


@pytest.mark.parametrize(("dated", "start_ns", "time_type"), [(False, 0, 0), (True, START_NS, 1)])
def test_times_are_those_of_the_survey_or_since_the_start_of_the_sensor(dated, start_ns, time_type):
    sensor, shots = synthetic_shots("hap")
    source = PacketSource(sensor, "first", start_ns=START_NS, dated=dated)
    (group,) = encoder_of(source).encode(shots)
    first, second, _ = (header_of(payload.tobytes()) for payload in group.payloads)
    assert (first.stamp_ns, first.time_type) == (start_ns, time_type)
    assert second.stamp_ns == start_ns + round(16 * 6e6 / 452)
    assert first.interval == round(95 * 1e7 / 452_000)


def test_positions_that_a_packet_cannot_hold_are_no_returns():
    sensor, shots = synthetic_shots("mid360", 2)
    range_m = np.full_like(shots.range_m, 327.6)
    range_m[0, 1::2] = 3000
    encoder = encoder_of(PacketSource(sensor, "strongest"))
    (group,) = encoder.encode(replace(shots, range_m=range_m))
    rows = plain_rows(group.payloads, "mid360", 2)
    assert {row.firing % 2 for row in rows} == {0} and len(rows) == 48 * 4 // 2


# -- IMU -----------------------------------------------------------------------------------------


def test_imu_packets_hold_the_samples_in_the_sensors_axes(tmp_path):
    imu = Imu(rate_hz=200, mount=Pose((0.1, 0.2, 0.3), 50.0), gyroscope_bias=0.1)
    faults = [Fault("time_jump", from_s=0.042, by_s=0.5)]
    survey = moving_survey(navigation=Navigation(imu=imu), faults=faults, steps=36)
    cloud, sweeps = points_of(survey, room())
    write_instruments(tmp_path, survey, np.zeros(3))
    sweeps = replace(sweeps, instruments=replace(sweeps.instruments, folder=tmp_path))
    groups = [group for group in encoded(cloud, sweeps) if group.port == 56_401]
    assert {group.source_port for group in groups} == {56_400}
    samples = np.loadtxt(tmp_path / "imu.csv", delimiter=",", skiprows=1)
    payloads = np.concatenate([group.payloads for group in groups])
    due_ns = np.concatenate([group.due_ns for group in groups])
    assert payloads.shape == (len(samples), 60) and len(samples) > 15
    assert (due_ns == samples[:, 0]).all()
    to_sensor = (
        Pose((0, 0, 0), 20.0, 10.0).rotation_matrix.T @ Pose((0, 0, 0), 50.0).rotation_matrix
    )
    for payload, (time_ns, *rest) in zip(payloads, samples, strict=True):
        data = payload.tobytes()
        header = header_of(data)
        assert header[:6] == (0, 1, 0, 0, 0, 0)
        assert header.stamp_ns == time_ns + (5e8 if time_ns > 42e6 else 0)
        assert plain_crc(data[28:]) == struct.unpack_from("<I", data, 24)[0]
        rate, force = np.array(struct.unpack_from("<6f", data, 36)).reshape(2, 3)
        np.testing.assert_allclose(rate, to_sensor @ rest[:3], atol=1e-6)
        np.testing.assert_allclose(9.80665 * force, to_sensor @ rest[3:], atol=1e-5)


# -- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("identifiers", "mode", "says"),
    [
        ({"device_type": 9}, "dual", "support the returns strongest, first, last, not dual"),
        ({"device_type": 15}, "first", "support the device types 9, 10, not 15"),
        ({"device_type": 9, "data_type": 3}, "first", "support the data types 1, 2, not 3"),
        ({"device_type": "HAP"}, "first", "have device_type 'HAP', which must be a whole number"),
    ],
)
def test_sensors_and_modes_that_do_not_fit_are_refused(identifiers, mode, says):
    sensor = load_sensor("mid360")
    sensor = replace(sensor, packets=replace(sensor.packets, identifiers=identifiers))
    with pytest.raises(LidarError, match=says) as raised:
        encoder_of(PacketSource(sensor, mode))
    assert len(str(raised.value).splitlines()) == 1


def test_lines_that_fill_no_packet_are_refused():
    sensor = replace(load_sensor("vlp32c"), packets=load_sensor("mid360").packets)
    encoder_of(PacketSource(sensor, "strongest"))
    sensor = replace(load_sensor("hdl64e-s3"), packets=load_sensor("mid360").packets)
    with pytest.raises(
        LidarError, match=("a number of lines that divides 96, but the sensor has 64")
    ):
        encoder_of(PacketSource(sensor, "strongest"))


def test_a_units_list_of_rays_has_the_packets_of_its_model(tmp_path):
    """A list has one ray in a firing: line after line."""
    sensor = load_sensor("mid360")
    rays = sensor.directions(np.arange(500)).reshape(-1, 3)
    azimuth_deg = np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))
    zenith_deg = 90 - np.degrees(np.arcsin(rays[:, 2]))
    lines = ["Time/s,Azimuth/deg,Zenith/deg"] + [
        f"{n * 5e-6:.6f},{azimuth:.6f},{zenith:.6f}"
        for n, (azimuth, zenith) in enumerate(zip(azimuth_deg, zenith_deg, strict=True))
    ]
    (tmp_path / "mid360.csv").write_text("\n".join([*lines, ""]))
    unit = load_sensor("mid360", calibration=tmp_path / "mid360.csv")
    shots = synthetic_shots("mid360")[1]
    one_ray = replace(
        shots, firings=np.arange(240), starts_ns=5000 * np.arange(240),
        stamps_ns=5000 * np.arange(240), azimuths=np.zeros(240), dropped=np.zeros(240, bool),
        range_m=shots.range_m.reshape(1, 240, 1),
        columns={"reflectivity": shots.columns["reflectivity"].reshape(1, 240, 1)},
    )  # fmt: skip
    (group,) = encoder_of(PacketSource(unit, "strongest")).encode(one_ray)
    (by_model,) = encoder_of(PacketSource(sensor, "strongest")).encode(shots)
    rows, expected = (
        np.array(plain_rows(packets.payloads, "mid360", 1)) for packets in (group, by_model)
    )
    assert rows.shape == expected.shape
    assert abs(rows - expected).max() <= 1
    assert read_model("livox/mid360").packets is not None


def test_returns_may_be_the_first():
    survey = replace(scanned("mid360", 1)[0], returns=Returns("first"))
    cloud, sweeps = points_of(survey, posts_before_walls())
    assert len(payloads_to(56_301, encoded(cloud, sweeps))) > 10

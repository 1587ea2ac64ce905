"""Packets of RoboSense, decoded by a plain reader of the manuals."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from tests.packet_surveys import encoded, payloads_to, points_of, posts_before_walls
from tests.shapes import room

from lidarsim import Fault, LidarError, Mounted, Noise, Pose, Returns, Survey, Track, load_sensor
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.shots import Shots
from lidarsim.sensor.models import read_model

COLUMNS = ("ray", "range", "reflectivity", "signal", "time", "azimuth", "return_number", "returns")
RATE_HZ = 10.0
MSOP, DIFOP = 6699, 7788


@dataclass(frozen=True)
class Manual:
    """What a reader knows of a model, by its manual and the maker's driver."""

    lasers: int
    unit_m: float
    firing_us: float
    laser_us: float  # from a laser to the next
    header: str
    type_code: int
    modes: dict[str, int]


MODELS = {
    "rs-lidar-16": Manual(
        16, 0.005, 55.5, 2.8, "55aa050a5aa550a0", 1, {"dual": 0, "strongest": 1, "last": 2}
    ),
    "rs-helios": Manual(
        32, 0.0025, 55.56, 1.73, "55aa055a", 6, {"dual": 0, "strongest": 4, "last": 5, "first": 6}
    ),
}
CASES = [(model, mode) for model, manual in MODELS.items() for mode in manual.modes]


class Row(NamedTuple):
    """A return in a packet."""

    firing: int  # since the first packet
    laser: int
    plane: int  # 0: the first of the firing's returns in the packet
    range_m: float
    reflectivity: int
    azimuth_deg: float  # of the head when the laser fires, clockwise from x
    time_us: float  # since 1970


class DeviceData(NamedTuple):
    """What a packet of device data says."""

    time_us: int  # since 1970
    rpm: int
    return_mode: int
    elevations_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]  # clockwise


def micros_of(date: bytes) -> int:
    """Return the time since 1970 of a date of the RS-16."""
    year, month, day, hour, minute, second, millis, micros = struct.unpack(">6B2H", date)
    whole = datetime(2000 + year, month, day, hour, minute, second, tzinfo=UTC)
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    return (whole - epoch) // timedelta(microseconds=1) + 1000 * millis + micros


def time_of(data: bytes, model: str) -> int:
    """Return the time of 10 bytes, microseconds since 1970."""
    if model == "rs-lidar-16":
        return micros_of(data)
    return int.from_bytes(data[:6], "big") * 1_000_000 + int.from_bytes(data[6:], "big")


def plain_rows(payloads, model: str, mode: str) -> list[Row]:
    """Return the returns of packets of measurements, read field by field."""
    manual = MODELS[model]
    planes = 2 if mode == "dual" else 1
    rows = []
    firings = 0
    for payload in payloads:
        data = payload.tobytes()
        assert len(data) == 1248 and data.startswith(bytes.fromhex(manual.header))
        assert data[30] == manual.type_code and data[1242:] == b"\0\0\0\0\0\xff"
        low, high = data[38:40]
        assert ((high & 0x7F) << 5) + (low >> 3) == 40 / 0.0625
        stamp_us = time_of(data[20:30], model)
        in_packet = set()
        for block in range(12):
            part = data[42 + 100 * block : 142 + 100 * block]
            flag, azimuth = struct.unpack_from(">HH", part)
            assert flag == 0xFFEE
            for slot in range(32):
                # Returns of a firing follow one another, all lasers of the first before the second.
                firing, rest = divmod(32 * block + slot, manual.lasers * planes)
                plane, laser = divmod(rest, manual.lasers)
                in_packet.add(firing)
                units, reflectivity = struct.unpack_from(">HB", part, 4 + 3 * slot)
                if units == 0:
                    assert reflectivity == 0
                    continue
                laser_us = manual.laser_us * laser
                first_of_block = 32 * block // (manual.lasers * planes)
                turned_us = manual.firing_us * (firing - first_of_block) + laser_us
                rows.append(
                    Row(
                        firings + firing,
                        laser,
                        plane,
                        units * manual.unit_m,
                        reflectivity,
                        azimuth / 100 + 360 * RATE_HZ * turned_us / 1e6,
                        stamp_us + manual.firing_us * firing + laser_us,
                    )
                )
        firings += len(in_packet)
    return rows


def device_data(payload, model: str) -> DeviceData:
    """Return what a packet of device data says, read by the manual."""
    data = payload.tobytes()
    assert len(data) == 1248 and data.startswith(bytes.fromhex("a5ff005a11115555"))
    assert data[-2:] == b"\x0f\xf0"
    assert data[10:18] == bytes([192, 168, 1, 200, 192, 168, 1, 102])
    assert struct.unpack_from(">HH", data, 32) == (0, 36_000)
    if model == "rs-lidar-16":
        elevations = [
            int.from_bytes(data[1165 + 3 * n : 1168 + 3 * n], "big") * (-1e-4 if n < 8 else 1e-4)
            for n in range(16)
        ]
        azimuths = [0.0] * 16
    else:
        signed = [struct.unpack_from(">BH", data, 468 + 3 * n) for n in range(64)]
        angles = [(-value if negative else value) / 100 for negative, value in signed]
        elevations, azimuths = angles[:32], angles[32:]
    return DeviceData(
        time_of(data[303:313], model),
        struct.unpack_from(">H", data, 8)[0],
        data[300],
        tuple(elevations),
        tuple(azimuths),
    )


@cache
def scanned(model: str, mode: str):
    """Return a survey of some degrees, its points and its sweeps."""
    survey = Survey(
        sensor=load_sensor(f"robosense/{model}"), poses=[Pose((0.0, 0.0, 0.0), 25.0)], steps=3,
        columns=COLUMNS, keep_every=1, precision_m=1e-6, noise=Noise(range_m=0.02),
        returns=Returns(mode, subrays=7, divergence_mrad=20.0),
    )  # fmt: skip
    return survey, *points_of(survey, posts_before_walls())


@cache
def payloads_of(model, mode):
    _, cloud, sweeps = scanned(model, mode)
    return payloads_to(MSOP, encoded(cloud, sweeps))


def firings_of(survey, cloud):
    """Return the firing and the laser of each point."""
    sensor = survey.mounted_sensors[0].sensor
    channels = sensor.channels
    first = np.array([sensor.firings(step)[0] for step in range(survey.steps)])
    elevations = read_model("/".join(["robosense", model_of(channels)])).beams.elevation_deg
    lasers = np.argsort(elevations)
    return first[cloud["scan"]] + cloud["ray"] // channels, lasers[cloud["channel"]]


def model_of(channels):
    return "rs-lidar-16" if channels == 16 else "rs-helios"


def expected_rows(model: str, mode: str, packets: int) -> list[Row]:
    """Return the returns of a survey's points, of the firings in a number of packets."""
    manual = MODELS[model]
    survey, cloud, _ = scanned(model, mode)
    firings, lasers = firings_of(survey, cloud)
    rows = []
    for n in np.flatnonzero(firings < packets * 384 // manual.lasers // (1 + (mode == "dual"))):
        planes = (0,)
        if mode == "dual" and cloud["returns"][n] == 1:
            planes = (0, 1)  # the only return is the strongest and the last
        elif mode == "dual":
            nearer = n if cloud["return_number"][n] == 1 else n - 1
            farther_is_strongest = cloud["signal"][nearer + 1] > cloud["signal"][nearer]
            planes = (int((n == nearer) == bool(farther_is_strongest)),)
        row = Row(
            int(firings[n]),
            int(lasers[n]),
            0,
            float(cloud["range"][n]),
            int(cloud["reflectivity"][n]),
            -float(cloud["azimuth"][n]) % 360,
            (START_NS + int(cloud["time"][n])) / 1000,
        )
        rows += [row._replace(plane=plane) for plane in planes]
    return rows


def check(payloads, model, mode):
    """Assert that packets hold the points of a survey, in the packets' units."""
    manual = MODELS[model]
    # Whole numbers of microseconds since 1970 have 16 digits: as many as a float.
    start_us = START_NS // 1000
    rows, expected = (
        np.array(sorted(row._replace(time_us=row.time_us - start_us) for row in rows))
        for rows in (
            plain_rows(payloads, model, mode),
            expected_rows(model, mode, len(payloads)),
        )
    )
    assert len(rows) > 400 and rows.shape == expected.shape
    assert (rows[:, [0, 1, 2, 4]] == expected[:, [0, 1, 2, 4]]).all()
    assert abs(rows[:, 3] - expected[:, 3]).max() <= manual.unit_m / 2 + 1e-5
    turned = (rows[:, 5] - expected[:, 5] + 180) % 360 - 180
    assert abs(turned).max() <= 0.005 + 1e-4
    assert abs(rows[:, 6] - expected[:, 6]).max() < 1.1


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(("model", "mode"), CASES)
def test_packets_hold_the_returns_of_the_cloud(model, mode):
    check(payloads_of(model, mode), model, mode)


@pytest.mark.parametrize("model", MODELS)
def test_first_returns_of_dual_packets_are_the_strongest(model):
    """The mode strongest reports the same surfaces: only the noise of the ranges differs."""
    dual = plain_rows(payloads_of(model, "dual"), model, "dual")
    strongest = plain_rows(payloads_of(model, "strongest"), model, "strongest")
    reflectivities, expected = (
        {(row.firing, row.laser): row.reflectivity for row in rows if row.plane == 0}
        for rows in (dual, strongest)
    )
    in_both = reflectivities.keys() & expected.keys()
    assert len(in_both) > 1500
    assert all(reflectivities[shot] == expected[shot] for shot in in_both)


def mutated(payloads, field):
    """Return packets with a fault of the smallest size that counts, in the middle packet."""
    changed = payloads.copy()
    packet = changed[len(changed) // 2]
    if field == "range":  # of the first return, by a unit
        first = next(offset for offset in range(46, 142, 3) if packet[offset : offset + 2].any())
        add(packet, first, 1)
    elif field in ("azimuth + 1", "azimuth - 1"):  # of two firings, by 0.01 degrees
        for offset in (44, 144):
            add(packet, offset, int(field[-3:].replace(" ", "")))
    elif field == "stamp":  # by 4 microseconds
        add(packet, 28, 4)
    elif field == "laser":  # the first two lasers change places
        packet[46:52] = np.roll(packet[46:52], 3)
    elif field == "reflectivity":
        first = next(offset for offset in range(46, 142, 3) if packet[offset : offset + 2].any())
        packet[first + 2] ^= 1
    else:
        packet[30] += 1
    return changed


def add(packet, offset, value):
    """Add to a number of two bytes in a packet."""
    number = packet[offset : offset + 2].view(">u2")
    number[:] = (number.astype(int) + value) % 36_000


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    "field", ["range", "azimuth + 1", "azimuth - 1", "stamp", "laser", "reflectivity", "type"]
)
@pytest.mark.parametrize(("model", "mode"), [("rs-lidar-16", "dual"), ("rs-helios", "strongest")])
def test_a_fault_of_a_packet_is_detected(model, mode, field):
    with pytest.raises(AssertionError):
        check(mutated(payloads_of(model, mode), field), model, mode)


def synthetic_shots(model):
    """Return shots of 40 firings whose returns follow from their numbers, without casting."""
    sensor = load_sensor(f"robosense/{model}")
    manual = MODELS[model]
    firings = np.arange(40)
    number = np.arange(2 * 40 * manual.lasers).reshape(2, 40, manual.lasers)
    range_m = (500 + number * 7919 % 14_000) * manual.unit_m
    range_m[0, 2::5] = np.nan  # firings without a return
    range_m[1, (firings % 3 > 0) | (firings % 5 == 2)] = np.nan
    starts_ns = np.rint(firings * manual.firing_us * 1000).astype(np.int64)
    return sensor, Shots(
        firings=firings,
        starts_ns=starts_ns,
        stamps_ns=starts_ns,
        azimuths=-np.radians(350 + 360 * RATE_HZ * starts_ns / 1e9),
        dropped=np.zeros(40, bool),
        range_m=range_m.astype(np.float32),
        columns={
            "reflectivity": (number % 251).astype(np.uint8),
            "signal": (number * 31 % 977).astype(np.uint16),
        },
    )


# What rs_driver 1.5.19 reads of the synthetic shots: points; sums of intensity, of rings, and of
# distances from the lens in units; and the start of the SHA-256 of the packets that it read.
RECORDED = {
    ("rs-lidar-16", "dual"): (928, 115725, 6960, 6945648, "7f89279f0f9eae02"),
    ("rs-lidar-16", "strongest"): (304, 32225, 2280, 2286344, "de795218cbf57577"),
    ("rs-lidar-16", "last"): (304, 32225, 2280, 2286344, "de795218cbf57577"),
    ("rs-helios", "dual"): (1856, 216593, 28768, 13889424, "a484e8ef87a66673"),
    ("rs-helios", "strongest"): (928, 108689, 14384, 6956512, "61499200efe76c10"),
    ("rs-helios", "last"): (928, 108689, 14384, 6956512, "61499200efe76c10"),
    ("rs-helios", "first"): (928, 108689, 14384, 6956512, "61499200efe76c10"),
}


def figures_of(rows, payloads):
    """Return figures of returns: reflectivity, ring and units of range (n, 3)."""
    digest = hashlib.sha256(payloads.tobytes()).hexdigest()[:16]
    return (len(rows), *(int(total) for total in rows.sum(axis=0)), digest)


@pytest.mark.parametrize(("model", "mode"), CASES)
def test_packets_are_those_that_rs_driver_has_read(model, mode):
    sensor, shots = synthetic_shots(model)
    encoder = encoder_of(PacketSource(sensor, mode))
    payloads = payloads_to(MSOP, encoder.encode(shots[:13]) + encoder.encode(shots[13:]))
    manual = MODELS[model]
    rows = plain_rows(payloads, model, mode)
    rings = np.argsort(np.argsort(read_model(f"robosense/{model}").beams.elevation_deg))
    figures = np.array(
        [(row.reflectivity, rings[row.laser], round(row.range_m / manual.unit_m)) for row in rows]
    )
    assert figures_of(figures, payloads) == RECORDED[model, mode]


@pytest.mark.parametrize("model", MODELS)
def test_device_data_come_first_and_ten_times_a_second(model):
    survey = moving_survey(model)
    groups = encoded(*points_of(survey, room()))
    assert [group.port for group in groups[:2]] == [DIFOP, MSOP]
    due_ns = np.concatenate([group.due_ns for group in groups if group.port == DIFOP])
    assert due_ns.tolist() == [0, 100_000_000]
    first_ns = min(group.due_ns[0] for group in groups if group.port == MSOP)
    assert due_ns[0] < first_ns
    beams = read_model(f"robosense/{model}").beams
    for payload, time_ns in zip(payloads_to(DIFOP, groups), due_ns, strict=True):
        data = device_data(payload, model)
        assert data.time_us == (START_NS + time_ns) // 1000
        assert (data.rpm, data.return_mode) == (600, MODELS[model].modes["strongest"])
        assert data.elevations_deg == pytest.approx(beams.elevation_deg, abs=1e-9)
        assert data.azimuths_deg == pytest.approx([0] * len(data.azimuths_deg), abs=1e-9)


def test_device_data_have_the_angles_of_a_unit(tmp_path):
    angles = [(15.01 - 2.13 * n, 0.5 - 0.04 * n) for n in range(32)]
    file = tmp_path / "angle.csv"
    file.write_text("".join(f"{up:.2f},{left:.2f}\n" for up, left in angles))
    sensor = load_sensor("robosense/rs-helios", calibration=file)
    _, shots = synthetic_shots("rs-helios")
    groups = encoder_of(PacketSource(sensor, "strongest")).encode(shots)
    data = device_data(payloads_to(DIFOP, groups)[0], "rs-helios")
    order = np.argsort([up for up, _ in angles])[::-1]
    assert sorted(data.elevations_deg) == pytest.approx(sorted(up for up, _ in angles), abs=0.006)
    by_elevation = np.argsort(data.elevations_deg)[::-1]
    beams = sensor.beams
    turned = sensor.head.radians_per_ns * beams.time_ns
    clockwise = -np.degrees(beams.azimuth - turned)[::-1]
    assert np.array(data.azimuths_deg)[by_elevation] == pytest.approx(clockwise, abs=0.006)
    assert len(order) == 32 and np.ptp(clockwise) > 1


def moving_survey(model="rs-lidar-16", **options):
    """Return a survey of a sensor that drives and turns for a revolution and a half."""
    times = np.linspace(0, 0.3, 16)
    yaw = 0.8 * times
    positions = np.stack([5 * times - 1, 0.2 * times, 0.1 * np.sin(9 * times)], axis=1)
    turns = np.stack([0 * yaw, 0.03 * np.sin(7 * times), np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    options = {"steps": 54, "columns": COLUMNS, "keep_every": 1, "precision_m": 1e-6} | options
    sensor = load_sensor(f"robosense/{model}")
    return Survey(
        sensors=[Mounted(sensor, Pose((0.5, 0.0, 0.0), 20.0), "lidar")],
        trajectory=Track(times, positions, turns, smooth=True), coordinates="sensor", **options,
    )  # fmt: skip


@pytest.mark.extended
def test_packets_continue_from_sweep_to_sweep_while_the_sensor_moves():
    """A revolution of 1,801.8 firings is not a whole number of packets of 24."""
    survey = moving_survey()
    cloud, sweeps = points_of(survey, room())
    payloads = payloads_to(MSOP, encoded(cloud, sweeps))
    assert len(payloads) == survey.mounted_sensors[0].sensor.firings(53)[1] // 24
    rows = np.array(plain_rows(payloads, "rs-lidar-16", "strongest"))
    assert len(rows) == len(payloads) * 24 * 16  # in a closed room
    stamps = np.array([time_of(payload[20:30].tobytes(), "rs-lidar-16") for payload in payloads])
    assert stamps - stamps[0] == pytest.approx(24 * 55.5 * np.arange(len(stamps)), abs=1)
    firings, lasers = firings_of(survey, cloud)
    order = np.lexsort((lasers, firings))[: len(rows)]
    assert rows[:, 3] == pytest.approx(cloud["range"][order], abs=0.00251)
    assert (rows[:, 1] == lasers[order]).all()


def test_dropped_packets_are_left_out():
    fault = Fault("dropped_packets", from_s=0.05, share=0.3, packet=24)
    survey = moving_survey(faults=[fault])
    cloud, sweeps = points_of(survey, room())
    payloads = payloads_to(MSOP, encoded(cloud, sweeps))
    count = survey.mounted_sensors[0].sensor.firings(53)[1] // 24
    stamps = np.array([time_of(payload[20:30].tobytes(), "rs-lidar-16") for payload in payloads])
    numbers = np.rint((stamps - START_NS // 1000) / (24 * 55.5))
    in_cloud = np.unique(firings_of(survey, cloud)[0] // 24)
    assert numbers.tolist() == in_cloud[in_cloud < count].tolist()
    assert 0.2 < (count - len(numbers)) / (count - 38) < 0.4


def test_a_jump_of_the_clock_is_in_the_stamps():
    survey = moving_survey(faults=[Fault("time_jump", from_s=0.09, by_s=-0.02)])
    groups = encoded(*points_of(survey, room()))
    stamps = [time_of(p[20:30].tobytes(), "rs-lidar-16") for p in payloads_to(MSOP, groups)]
    assert sorted(set(np.diff(stamps).tolist())) == [-18668, 1332]
    times = [device_data(p, "rs-lidar-16").time_us for p in payloads_to(DIFOP, groups)]
    assert np.diff(times).tolist() == [80_000]
    due_ns = np.concatenate([group.due_ns for group in groups if group.port == MSOP])
    assert np.ptp(np.diff(due_ns)) <= 1


@pytest.mark.parametrize("model", MODELS)
def test_times_are_those_of_the_survey(model):
    sensor, shots = synthetic_shots(model)
    start = datetime(2024, 2, 29, 23, 59, 59, 999_800, tzinfo=UTC)
    start_ns = round(start.timestamp()) * 10**9 - 200_000
    source = PacketSource(sensor, "strongest", start_ns=start_ns, dated=True)
    groups = encoder_of(source).encode(shots)
    first, second, *_ = [
        time_of(payload[20:30].tobytes(), model) for payload in payloads_to(MSOP, groups)
    ] + [0]
    assert first == start_ns // 1000
    interval_us = 384 // MODELS[model].lasers * MODELS[model].firing_us
    assert second in (0, pytest.approx(first + interval_us, abs=1))


def test_ranges_that_a_packet_cannot_hold_are_no_returns():
    sensor, shots = synthetic_shots("rs-helios")
    range_m = np.full_like(shots.range_m, np.nan)
    range_m[0, :12] = 65_535 * 0.0025
    range_m[0, 4] = 65_535.6 * 0.0025
    range_m[0, 5] = 0.0012
    encoder = encoder_of(PacketSource(sensor, "strongest"))
    shots = replace(
        shots, range_m=range_m, columns={"reflectivity": np.full(range_m.shape, 7, np.uint8)}
    )
    rows = plain_rows(payloads_to(MSOP, encoder.encode(shots)), "rs-helios", "strongest")
    assert {row.firing for row in rows} == {*range(12)} - {4, 5}
    assert {row.range_m for row in rows} == {65_535 * 0.0025}


def with_identifiers(name, **identifiers):
    sensor = load_sensor(name)
    return replace(sensor, packets=replace(sensor.packets, identifiers=identifiers))


@pytest.mark.parametrize(
    ("sensor", "mode", "start_ns", "says"),
    [
        (load_sensor("rs-lidar-16"), "first", START_NS, "returns strongest, last, dual, not first"),
        (load_sensor("rs-helios"), "all", START_NS, "strongest, last, first, dual, not all"),
        (load_sensor("rs-lidar-16"), "last", -(10**18), "years from 2000 to 2255, not 1938"),
        (with_identifiers("rs-helios", model="RS32"), "last", START_NS, "RS16, RSHELIOS, not RS32"),
        (with_identifiers("rs-helios", model="RS16"), "last", START_NS, "contain 16 lasers, but"),
        (
            with_identifiers("vlp16", model="RS16"), "last", START_NS,
            "unsigned angles, so the first 8 lasers must point down",
        ),
    ],
)  # fmt: skip
def test_sensors_and_modes_that_do_not_fit_are_refused(sensor, mode, start_ns, says):
    sensor = replace(sensor, packets=replace(sensor.packets, format="robosense"))
    with pytest.raises(LidarError, match=says) as raised:
        encoder_of(PacketSource(sensor, mode, start_ns=start_ns))
    assert len(str(raised.value).splitlines()) == 1

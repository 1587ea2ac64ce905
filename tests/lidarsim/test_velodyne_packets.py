"""Packets of Velodyne, decoded by a plain reader of the manuals and by velodyne_decoder."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from tests.packet_surveys import encoded, payloads_to, points_of, posts_before_walls
from tests.shapes import room

from lidarsim import Fault, Mounted, Noise, Pose, Returns, Survey, Track, load_sensor
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.pcap import PcapWriter
from lidarsim.packets.shots import Shots
from lidarsim.sensor.models import read_model

COLUMNS = ("ray", "range", "reflectivity", "time", "azimuth", "return_number", "returns")
MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
FLAGS = {0xEEFF: 0, 0xDDFF: 32, 0xCCFF: 64, 0xBBFF: 96}  # {flag of a block: its first laser}
STRONGEST, LAST, BOTH = 1, 2, 3  # as velodyne_decoder names returns
RATE_HZ = 10.0


@dataclass(frozen=True)
class Manual:
    """What a reader knows of a model, by its manual: times are microseconds."""

    product: int
    channels: int
    unit_m: float
    firing_us: float
    laser_us: tuple[float, ...]  # of each laser after the start of its firing
    stamped_us: float = 0.0  # time within a packet's first firing that its stamp means


MODELS = {
    "vlp16": Manual(0x22, 16, 0.002, 55.296, tuple(2.304 * n for n in range(16))),
    "vlp16-hires": Manual(0x24, 16, 0.002, 55.296, tuple(2.304 * n for n in range(16))),
    "vlp32c": Manual(0x28, 32, 0.004, 55.296, tuple(2.304 * (n // 2) for n in range(32))),
    "hdl32e": Manual(0x21, 32, 0.002, 46.08, tuple(1.152 * n for n in range(32))),
    # As measured on a unit; the eight lasers of a group fire at once, and after 64 is a pause.
    "vls128": Manual(
        0xA1, 128, 0.004, 55.277, tuple(2.665 * (n // 8 + n // 64) for n in range(128)), 7.995
    ),
}
CASES = [(model, mode) for model in MODELS for mode in ("strongest", "dual")] + [("vlp16", "last")]


class Row(NamedTuple):
    """A return in a packet."""

    firing: int  # since the first packet
    laser: int
    kind: int  # STRONGEST, LAST or BOTH
    range_m: float
    reflectivity: int
    azimuth_deg: float  # of the head when the laser fires, clockwise from x
    time_us: float  # past the hour
    point: int = -1  # of the cloud


def plain_rows(payloads, manual: Manual, mode: str) -> list[Row]:
    """Return the returns of data packets, read field by field."""
    dual = mode == "dual"
    rows = []
    first_of_packet = 0
    for payload in payloads:
        data = payload.tobytes()
        assert len(data) == 1206
        stamp, mode_byte, product = struct.unpack("<IBB", data[1200:])
        assert (mode_byte, product) == (MODES[mode], manual.product)
        firings = set()
        for block in range(0, 12, 2 if dual else 1):
            pair = [data[100 * n : 100 * n + 100] for n in (block, block + dual)]
            heads = [struct.unpack_from("<HH", part) for part in pair]
            assert heads[0] == heads[1]
            flag, azimuth = heads[0]
            if flag == 0xFFFF:
                assert manual.channels == 128 and dual and not any(pair[0][4:])
                continue
            for slot in range(32):
                number = (block // (2 if dual else 1)) * 32 + slot
                in_packet, laser = divmod(number, manual.channels)
                assert laser == slot % 16 if manual.channels == 16 else laser == FLAGS[flag] + slot
                firings.add(in_packet)
                since_us = manual.laser_us[laser] + (
                    manual.firing_us * (slot // 16) if manual.channels == 16 else 0.0
                )
                time_us = stamp - manual.stamped_us + manual.laser_us[laser]
                fields = [struct.unpack_from("<HB", part, 4 + 3 * slot) for part in pair]
                kinds = [BOTH] if fields[0] == fields[1] else [LAST, STRONGEST]
                for kind, (units, reflectivity) in zip(kinds, fields, strict=False):
                    if units == 0:
                        assert reflectivity == 0
                        continue
                    rows.append(
                        Row(
                            first_of_packet + in_packet,
                            laser,
                            kind if dual else {"last": LAST, "strongest": STRONGEST}[mode],
                            units * manual.unit_m,
                            reflectivity,
                            azimuth / 100 + 360 * RATE_HZ * since_us / 1e6,
                            time_us + manual.firing_us * in_packet,
                        )
                    )
        first_of_packet += len(firings)
    return rows


@cache
def scanned(model: str, mode: str):
    """Return a survey of some degrees, its points and its sweeps."""
    survey = Survey(
        sensor=load_sensor(f"velodyne/{model}"), poses=[Pose((0.0, 0.0, 0.0), 25.0)],
        steps=1 if model == "vls128" else 3,
        columns=COLUMNS, keep_every=1, precision_m=1e-6, noise=Noise(range_m=0.02),
        returns=Returns(mode, subrays=7, divergence_mrad=20.0),
    )  # fmt: skip
    return survey, *points_of(survey, posts_before_walls())


def data_of(groups):
    return payloads_to(2368, groups)


@cache
def payloads_of(model, mode):
    _, cloud, sweeps = scanned(model, mode)
    return data_of(encoded(cloud, sweeps))


def expected_rows(model: str, mode: str, packets: int) -> list[Row]:
    """Return the returns of a survey's points, of the firings in a number of packets."""
    manual = MODELS[model]
    survey, cloud, _ = scanned(model, mode)
    sensor = survey.mounted_sensors[0].sensor
    elevations = elevations_of(model)
    lasers = sorted(range(manual.channels), key=lambda laser: elevations[laser])
    first_firings = np.array([sensor.firings(step)[0] for step in range(survey.steps)])
    firing = first_firings[cloud["scan"]] + cloud["ray"] // manual.channels
    in_packet = {16: 24, 32: 12, 128: 3}[manual.channels] / (2 if mode == "dual" else 1)
    rows = []
    for n in np.flatnonzero(firing < packets * int(in_packet)):
        kind = {"last": LAST, "strongest": STRONGEST}.get(mode, BOTH)
        if mode == "dual" and cloud["returns"][n] == 2:
            kind = LAST if cloud["return_number"][n] == 2 else STRONGEST
        rows.append(
            Row(
                int(firing[n]),
                lasers[cloud["channel"][n]],
                kind,
                float(cloud["range"][n]),
                int(cloud["reflectivity"][n]),
                -float(cloud["azimuth"][n]) % 360,
                (START_NS + int(cloud["time"][n])) / 1000 % 3.6e9,
                int(n),
            )
        )
    return rows


def check(payloads, model, mode):
    """Assert that packets hold the points of a survey, in the packets' units."""
    manual = MODELS[model]
    rows = np.array(sorted(plain_rows(payloads, manual, mode)))
    expected = np.array(sorted(expected_rows(model, mode, len(payloads))))
    assert len(rows) > 400 and rows.shape == expected.shape
    assert (rows[:, [0, 1, 2, 4]] == expected[:, [0, 1, 2, 4]]).all()
    assert abs(rows[:, 3] - expected[:, 3]).max() <= manual.unit_m / 2 + 1e-5
    offsets = read_offsets(model)[rows[:, 1].astype(int)]
    turned = (rows[:, 5] - offsets - expected[:, 5] + 180) % 360 - 180
    assert abs(turned).max() <= 0.005 + 1e-4
    assert abs(rows[:, 6] - expected[:, 6]).max() < 1.1


def read_offsets(model):
    """Return the azimuths of the lasers, counter-clockwise from the head's."""
    beams = read_model(f"velodyne/{model}").beams
    return np.array(beams.azimuth_deg or [0.0] * len(beams.elevation_deg))


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(("model", "mode"), CASES)
def test_packets_hold_the_returns_of_the_cloud(model, mode):
    check(payloads_of(model, mode), model, mode)


def decoded(groups, tmp_path):
    """Return the points that velodyne_decoder reads of a pcap file, as an array of its fields."""
    decoder = pytest.importorskip("velodyne_decoder")
    with (tmp_path / "lidar.pcap").open("wb") as file:
        writer = PcapWriter(file, "192.168.1.201", start_ns=START_NS)
        for group in groups:
            writer.write([group])
    config = decoder.Config(min_range=0.0, max_range=300.0, timestamp_first_packet=True)
    scans = list(decoder.read_pcap(str(tmp_path / "lidar.pcap"), config))
    stamps = [np.full(len(points), scan.device - START_NS / 1e9) for scan, points in scans]
    points = np.concatenate([points for _, points in scans]).astype(float)
    points[:, 4] += np.concatenate(stamps)
    return points


# Meters from the axis to the point ahead of it where all beams cross, by the makers' drawings.
CROSSING_M = {
    "vlp16": 0.04191, "vlp16-hires": 0.04191, "vlp32c": 0.0424, "hdl32e": 0.02883,
    "vls128": 0.05863,
}  # fmt: skip


def reader_us(firing, laser):
    """Return the time after a packet's stamp that velodyne_decoder assumes in the VLS-128."""
    return 160 / 3 * firing + 8 / 3 * (laser // 8 + 2 * (laser // 64)) - 7.0


@pytest.mark.extended
@pytest.mark.parametrize(("model", "mode"), CASES)
def test_velodyne_decoder_reads_the_returns_of_the_cloud(model, mode, tmp_path):
    """It rounds azimuths again to 0.01 degrees; in the VLS-128 it assumes another period."""
    manual = MODELS[model]
    _, cloud, sweeps = scanned(model, mode)
    groups = encoded(cloud, sweeps)
    points = decoded(groups, tmp_path)
    expected = np.array(expected_rows(model, mode, len(data_of(groups))))
    # Of a firing by laser, the last return first.
    expected = expected[np.lexsort((-expected[:, 2], expected[:, 1], expected[:, 0]))]
    firing, laser = expected[:, :2].astype(int).T
    assert len(points) == len(expected)
    assert (points[:, 7] == expected[:, 2]).all()  # returns
    assert (points[:, 3] == expected[:, 4]).all()  # reflectivity
    elevations = elevations_of(model)
    assert (points[:, 6] == np.argsort(np.argsort(elevations))[laser]).all()  # rings

    from_beams = points[:, :3].copy()
    from_beams[:, 2] += CROSSING_M[model] * np.tan(np.radians(elevations))[laser]
    ranges = np.linalg.norm(from_beams, axis=1)
    assert abs(ranges - expected[:, 3]).max() <= manual.unit_m / 2 + 3e-5
    x, y, z = from_beams.T
    assert np.degrees(np.arcsin(z / ranges)) == pytest.approx(elevations[laser], abs=0.01)
    is_128 = model == "vls128"
    # Its first packets have a time and a rate of rotation that it guesses.
    settled = firing >= (6 if is_128 else 0)
    turned = (-np.degrees(np.arctan2(y, x)) - expected[:, 5] + 180) % 360 - 180
    assert abs(turned[settled]).max() <= (0.025 if is_128 else 0.0125)
    times_us = points[:, 4] * 1e6
    if is_128:
        in_packet = firing % (1 if mode == "dual" else 3)
        since_start_us = np.array(manual.laser_us)[laser] + manual.firing_us * in_packet
        times_us += since_start_us - reader_us(in_packet, laser) - manual.stamped_us
    in_sensor = sweeps.in_sensor(0, cloud.positions)[expected[:, 7].astype(int)]
    assert np.linalg.norm(points[:, :3] - in_sensor, axis=1)[settled].max() <= (
        manual.unit_m / 2 + np.radians(0.025 if is_128 else 0.0125) * ranges.max() + 1e-4
    )
    assert abs(times_us - (expected[:, 6] - START_NS / 1000 % 3.6e9))[settled].max() < 1.5


def elevations_of(model):
    return np.array(read_model(f"velodyne/{model}").beams.elevation_deg)


def mutated(payloads, field):
    """Return packets with a fault of the smallest size that counts, in the middle packet."""
    changed = payloads.copy()
    packet = changed[len(changed) // 2]
    if field == "range":  # of the first return, by a unit
        first = next(offset for offset in range(4, 100, 3) if packet[offset : offset + 2].any())
        add(packet, first, 1)
    elif field in ("azimuth + 1", "azimuth - 1"):  # of the first two blocks, by 0.01 degrees
        for offset in (2, 102):
            add(packet, offset, int(field[-3:].replace(" ", "")))
    elif field == "stamp":  # by 4 microseconds
        add(packet, 1200, 4)
    elif field == "laser":  # the first two lasers change places
        packet[4:10] = np.roll(packet[4:10], 3)
    elif field == "mode":
        packet[1204] = 0x40
    else:
        packet[1205] += 1
    return changed


def add(packet, offset, value):
    """Add to a number of two bytes in a packet."""
    number = packet[offset : offset + 2].view("<u2")
    number[:] = (number.astype(int) + value) % 36_000


FIELDS = ["range", "azimuth + 1", "azimuth - 1", "stamp", "laser", "mode", "product"]


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize(("model", "mode"), [("vlp16", "dual"), ("vls128", "strongest")])
def test_a_fault_of_a_packet_is_detected(model, mode, field):
    with pytest.raises(AssertionError):
        check(mutated(payloads_of(model, mode), field), model, mode)


def synthetic_shots(model):
    """Return shots of 30 firings whose returns follow from their numbers, without casting."""
    sensor = load_sensor(f"velodyne/{model}")
    manual = MODELS[model]
    firings = np.arange(30)
    number = np.arange(2 * 30 * manual.channels).reshape(2, 30, manual.channels)
    range_m = (500 + number * 7919 % 14_000) * manual.unit_m
    range_m[0, 2::5] = np.nan  # firings without a return
    range_m[1, (firings % 3 > 0) | (firings % 5 == 2)] = np.nan
    starts_ns = np.rint(firings * manual.firing_us * 1000).astype(np.int64)
    return sensor, Shots(
        firings=firings,
        starts_ns=starts_ns,
        stamps_ns=starts_ns,
        azimuths=-np.radians(350 + 360 * RATE_HZ * starts_ns / 1e9),
        dropped=np.zeros(30, bool),
        range_m=range_m.astype(np.float32),
        columns={"reflectivity": (number % 251).astype(np.uint8)},
    )


# What velodyne_decoder 3.1 reads of the synthetic shots in the mode dual: points; those that are
# the last, strongest, or both returns; sums of reflectivity, of rings, and of distances from the
# axis in units; and the start of the SHA-256 of the packets that it read.
RECORDED = {
    "vlp16": (416, 112, 112, 192, 45017, 3120, 3126752, "fbf484f806b9c1db"),
    "vlp16-hires": (416, 112, 112, 192, 45017, 3120, 3126752, "8c7d258fedf4044b"),
    "vlp32c": (1024, 256, 256, 512, 124681, 15872, 7654672, "1c20e0fe4775c9eb"),
    "hdl32e": (1024, 256, 256, 512, 124681, 15872, 7654672, "4dbd0bf4cda761f2"),
    "vls128": (4096, 1024, 1024, 2048, 508845, 260096, 30655088, "ebbd9c2b7d96c05c"),
}


def figures_of(rows, unit_m, payloads):
    """Return figures of returns: kind, reflectivity, ring and range (n, 4)."""
    kinds = [int((rows[:, 0] == kind).sum()) for kind in (LAST, STRONGEST, BOTH)]
    units = int(np.rint(rows[:, 3] / unit_m).sum())
    digest = hashlib.sha256(payloads.tobytes()).hexdigest()[:16]
    return (len(rows), *kinds, int(rows[:, 1].sum()), int(rows[:, 2].sum()), units, digest)


@pytest.mark.parametrize("model", MODELS)
def test_packets_are_those_that_velodyne_decoder_has_read(model, tmp_path):
    sensor, shots = synthetic_shots(model)
    encoder = encoder_of(PacketSource(sensor, "dual"))
    groups = encoder.encode(shots[:13]) + encoder.encode(shots[13:])
    payloads = data_of(groups)
    manual = MODELS[model]
    plain = np.array(plain_rows(payloads, manual, "dual"))
    rings = np.argsort(np.argsort(elevations_of(model)))
    rows = np.stack([plain[:, 2], plain[:, 4], rings[plain[:, 1].astype(int)], plain[:, 3]], axis=1)
    assert figures_of(rows, manual.unit_m, payloads) == RECORDED[model]

    points = decoded(groups, tmp_path)
    laser = np.argsort(rings)[points[:, 6].astype(int)]
    points[:, 2] += CROSSING_M[model] * np.tan(np.radians(elevations_of(model)))[laser]
    ranges = np.linalg.norm(points[:, :3], axis=1)
    read = np.column_stack([points[:, [7, 3, 6]], ranges])
    assert figures_of(read, manual.unit_m, payloads) == RECORDED[model]


def moving_survey(**options):
    """Return a survey of a VLP-16 that drives and turns for two revolutions and a half."""
    times = np.linspace(0, 0.3, 16)
    yaw = 0.8 * times
    positions = np.stack([5 * times - 1, 0.2 * times, 0.1 * np.sin(9 * times)], axis=1)
    turns = np.stack([0 * yaw, 0.03 * np.sin(7 * times), np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    options = {"steps": 90, "columns": COLUMNS, "keep_every": 1, "precision_m": 1e-6} | options
    return Survey(
        sensors=[Mounted(load_sensor("velodyne/vlp16"), Pose((0.5, 0.0, 0.0), 20.0), "lidar")],
        trajectory=Track(times, positions, turns, smooth=True), coordinates="sensor", **options,
    )  # fmt: skip


@pytest.mark.extended
def test_packets_continue_from_sweep_to_sweep_while_the_sensor_moves():
    """A revolution of 1,808.4 firings is not a whole number of packets of 24."""
    survey = moving_survey()
    cloud, sweeps = points_of(survey, room())
    payloads = data_of(encoded(cloud, sweeps))
    assert len(payloads) == survey.mounted_sensors[0].sensor.firings(89)[1] // 24
    rows = np.array(plain_rows(payloads, MODELS["vlp16"], "strongest"))
    assert len(rows) == len(payloads) * 24 * 16  # in a closed room
    stamps = np.array(
        [struct.unpack_from("<I", payload.tobytes(), 1200)[0] for payload in payloads]
    )
    assert stamps - stamps[0] == pytest.approx(24 * 55.296 * np.arange(len(stamps)), abs=1)
    in_packets = cloud[: len(rows)]
    order = np.lexsort((rows[:, 1], rows[:, 0]))
    by_laser = in_packets["channel"] % 8 * 2 + in_packets["channel"] // 8
    expected = in_packets["range"][np.lexsort((by_laser, in_packets["time"] // 55_296))]
    assert rows[order, 3] == pytest.approx(expected, abs=0.00101)


def test_dropped_packets_are_left_out():
    fault = Fault("dropped_packets", from_s=0.05, share=0.3, packet=24)
    survey = moving_survey(faults=[fault])
    cloud, sweeps = points_of(survey, room())
    payloads = data_of(encoded(cloud, sweeps))
    count = survey.mounted_sensors[0].sensor.firings(89)[1] // 24
    numbers = [
        round((struct.unpack_from("<I", payload.tobytes(), 1200)[0] - 2_800_000_000) / 1327.104)
        for payload in payloads
    ]
    in_cloud = np.unique(cloud["time"] // (24 * 55_296))
    assert numbers == in_cloud[in_cloud < count].tolist()
    assert 0.2 < (count - len(numbers)) / (count - 38) < 0.4 and numbers[:37] == list(range(37))


def test_packets_start_anew_at_each_station():
    """Else dropped packets, which count from the start of a station, were parts of two."""
    poses = [Pose((0.0, 0.0, 0.0)), Pose((1.0, 0.0, 0.0))]
    fault = Fault("dropped_packets", share=0.2, packet=24)
    survey = Survey(
        load_sensor("velodyne/vlp16"), poses, steps=36, columns=COLUMNS, keep_every=1,
        faults=[fault],
    )  # fmt: skip
    cloud, sweeps = points_of(survey, room())
    payloads = data_of(encoded(cloud, sweeps))
    firings = cloud["time"] % sweeps.station_ns // 55_296
    kept = np.unique(cloud["scan"] // 36 * 1000 + firings // 24)
    assert len(payloads) == (kept % 1000 < 75).sum() < 130


def test_a_jump_of_the_clock_is_in_the_stamps():
    survey = moving_survey(faults=[Fault("time_jump", from_s=0.1, by_s=0.02)])
    cloud, sweeps = points_of(survey, room())
    groups = encoded(cloud, sweeps)
    stamps = [struct.unpack_from("<I", p.tobytes(), 1200)[0] for p in data_of(groups)]
    steps = np.diff(stamps)
    assert sorted(set(steps.tolist())) == [1327, 1328, 21327] or 21328 in steps
    due_ns = np.concatenate([group.due_ns for group in groups if group.port == 2368])
    assert np.ptp(np.diff(due_ns)) <= 1


def test_ranges_that_a_packet_cannot_hold_are_no_returns():
    sensor, shots = synthetic_shots("vlp16")
    range_m = np.full_like(shots.range_m, np.nan)
    range_m[0, :24] = 65_535 * 0.002
    range_m[0, 4] = 65_535.6 * 0.002
    range_m[0, 5] = 0.0009
    encoder = encoder_of(PacketSource(sensor, "strongest"))
    shots = replace(shots, range_m=range_m, columns={"reflectivity": np.uint8(7) + 0 * range_m})
    rows = plain_rows(data_of(encoder.encode(shots)), MODELS["vlp16"], "strongest")
    assert {row.firing for row in rows} == {*range(24)} - {4, 5}
    assert {row.range_m for row in rows} == {65_535 * 0.002}

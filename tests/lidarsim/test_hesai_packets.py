"""Packets of Hesai, decoded by a plain reader of the manuals; figures seen with the maker's SDK."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from tests.packet_surveys import encoded, points_of
from tests.shapes import box, room, wall

from lidarsim import (
    Fault,
    LidarError,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.shots import Shots
from lidarsim.sensor.models import read_model

COLUMNS = ("ray", "range", "reflectivity", "time", "azimuth", "return_number", "returns")
MODES = {"first": 0x33, "strongest": 0x37, "last": 0x38, "dual": 0x39}
LAST, STRONGEST, BOTH, ONLY = 1, 2, 3, 4  # blocks that a return is in
RATE_HZ = 10.0
UNIT_M = 0.004


@dataclass(frozen=True)
class Manual:
    """What a reader knows of a model, by its manual and the maker's SDK: times are microseconds."""

    size: int
    header: bytes  # in a mode of a single return
    blocks: int
    channels: int
    firing_us: float
    first_us: float  # firing time of the first laser after the reference of its block
    reference_us: float  # of the stamped block after the stamp
    mode_at: int  # positions of fields in a packet
    stamp_at: int
    date_at: int
    sequence_at: int
    epoch: int = 1900
    block_head: int = 2  # bytes before the returns of a block
    return_bytes: int = 3
    first_block: bool = False  # whether the stamp is of the first block, not of the last
    dual_at: tuple[int, ...] = (8, 10)  # header bytes that are 1 and 2 in the mode dual

    @property
    def block_bytes(self):
        return self.block_head + self.return_bytes * self.channels


NUMBERED_128 = {
    "size": 861, "blocks": 2, "channels": 128, "firing_us": 500 / 9, "mode_at": 817,
    "stamp_at": 826, "date_at": 820, "sequence_at": 831,
}  # fmt: skip
MODELS = {
    "xt32": Manual(
        1080, bytes.fromhex("eeff06010000200800040101"), 8, 32, 50.0, 6.0, 0.0,
        mode_at=1062, stamp_at=1071, date_at=1065, sequence_at=1076, return_bytes=4,
    ),
    "pandar40p": Manual(
        1266, b"", 10, 40, 500 / 9, -54.67, -28.58, mode_at=1254, stamp_at=1250, date_at=1256,
        sequence_at=1262, epoch=2000, block_head=4, dual_at=(),
    ),
    "pandar64": Manual(
        1198, bytes.fromhex("eeff400600040000"), 6, 64, 500 / 9, -54.668, -42.58, mode_at=1186,
        stamp_at=1182, date_at=1188, sequence_at=1194, epoch=2000,
        dual_at=(),
    ),
    "pandarqt": Manual(
        1072, bytes.fromhex("eeff03010000400400040101"), 4, 64, 500 / 3, 2.31, 25.71,
        mode_at=1060, stamp_at=1056, date_at=1062, sequence_at=1068,
        return_bytes=4, first_block=True,
    ),
    "pandar128": Manual(
        header=bytes.fromhex("eeff01040000800200040107"), first_us=0.776, reference_us=3.148,
        **NUMBERED_128,
    ),
    "ot128": Manual(
        header=bytes.fromhex("eeff01048000800200040107"), first_us=0.0, reference_us=0.0,
        **NUMBERED_128,
    ),
}  # fmt: skip
CASES = [
    *[(model, "dual") for model in MODELS if model != "pandarqt"],
    *[("xt32", mode) for mode in ("strongest", "first")],
    *[(model, "last") for model in ("xt32", "pandar40p", "pandar64", "pandarqt", "ot128")],
    *[("pandarqt", "first"), ("pandar128", "first")],
]


def laser_us(model):
    """Return the firing times of the lasers after the reference of their block."""
    return MODELS[model].first_us + np.array(read_model(f"hesai/{model}").beams.time_us)


def lasers_deg(model):
    """Return elevations, and azimuths clockwise from the head, of the maker's lasers."""
    beams = read_model(f"hesai/{model}").beams
    elevations = np.array(beams.elevation_deg)
    return elevations, -np.array(beams.azimuth_deg or [0.0] * len(elevations))


class Row(NamedTuple):
    """A return in a packet."""

    firing: int  # since the first packet
    laser: int
    kind: int
    range_m: float
    reflectivity: int
    azimuth_deg: float  # of the ray, clockwise from y
    time_us: float  # since START_NS


def stamp_us(data, manual):
    """Return the stamp of a packet, since START_NS."""
    year, *rest = data[manual.date_at : manual.date_at + 6]
    date = datetime(manual.epoch + year, *rest, tzinfo=UTC)
    micros = struct.unpack_from("<I", data, manual.stamp_at)[0]
    assert 0 <= micros < 1_000_000
    return round(date.timestamp()) * 1_000_000 + micros - START_NS // 1000


def crc_of(data):
    """Return the CRC-32 of bytes, bit by bit: polynomial 0x04C11DB7, the highest bit first."""
    crc = 0xFFFF_FFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc >> 31 else 0)) & 0xFFFF_FFFF
    return crc


def check_packet(data, manual, mode, number, rate_hz):
    """Assert the fields of a packet that hold no returns."""
    assert len(data) == manual.size
    header = bytearray(manual.header)
    for position, byte in zip(manual.dual_at if mode == "dual" else (), (1, 2), strict=False):
        header[position] = byte
    assert data[: len(header)] == header
    assert data[manual.mode_at] == MODES[mode]
    assert struct.unpack_from("<I", data, manual.sequence_at)[0] == number
    assert 0x42 in data[manual.mode_at :]  # factory
    assert (
        struct.pack("<H", round(60 * rate_hz)) in data[manual.size - 60 :]
    )  # revolutions a minute
    if manual.channels == 128:
        state = data[788:805]
        assert state[1] >> 5 == 1 and not any(state[2:5])
        for covered, position in ((data[12:784], 784), (state[1:5], 801), (data[805:857], 857)):
            assert struct.unpack_from("<I", data, position)[0] == crc_of(covered)
        assert data[816] == 2 and data[814:816] == b"\0\0"  # all lasers fire in each block


def plain_rows(
    payloads, model: str, mode: str, first_number: int = 1, rate_hz: float = RATE_HZ
) -> list[Row]:
    """Return the returns of data packets, read field by field."""
    manual = MODELS[model]
    times_us = laser_us(model)
    azimuths_deg = lasers_deg(model)[1]
    planes = 2 if mode == "dual" else 1
    firings = manual.blocks // planes
    rows = []
    for number, payload in enumerate(payloads):
        data = payload.tobytes()
        check_packet(data, manual, mode, first_number + number, rate_hz)
        reference_us = stamp_us(data, manual) + manual.reference_us
        for firing in range(firings):
            starts = [
                len(manual.header) + manual.block_bytes * (planes * firing + plane)
                for plane in range(planes)
            ]
            heads = {data[start : start + manual.block_head] for start in starts}
            assert len(heads) == 1  # both blocks of a firing have the same azimuth
            *marks, azimuth = struct.unpack(f"<{manual.block_head // 2}H", heads.pop())
            assert marks in ([], [0xEEFF]) and azimuth < 36_000
            periods = firing if manual.first_block else firing - firings + 1
            for laser in range(manual.channels):
                offset = manual.block_head + manual.return_bytes * laser
                fields = [struct.unpack_from("<HB", data, start + offset) for start in starts]
                kinds = [ONLY] if planes == 1 else [LAST, STRONGEST]
                kinds = [BOTH] if len(set(fields)) < planes else kinds
                for kind, (units, reflectivity) in zip(kinds, fields, strict=False):
                    if units == 0:
                        assert reflectivity == 0
                        continue
                    rows.append(
                        Row(
                            number * firings + firing,
                            laser,
                            kind,
                            units * UNIT_M,
                            reflectivity,
                            azimuth / 100 + azimuths_deg[laser]
                            + 360 * rate_hz * times_us[laser] / 1e6,
                            reference_us + periods * manual.firing_us + times_us[laser],
                        )
                    )  # fmt: skip
    return rows


@cache
def posts_before_walls() -> Scene:
    """Two walls with a gap between, and a row of posts that beams meet in part."""
    posts = [box(f"post {n}", (n / 2, 4, -2), (n / 2 + 0.1, 4.05, 2)) for n in range(-9, 10)]
    return Scene.from_meshes(
        [wall("left", 8, (1, 9), (-4, 4)), wall("right", 9, (-12, 0), (-4, 4)), *posts]
    )


@cache
def scanned(model: str, mode: str):
    """Return a survey of some degrees, its points and its sweeps."""
    survey = Survey(
        sensor=load_sensor(f"hesai/{model}"), poses=[Pose((0.0, 0.0, 0.0), -40.0)],
        steps={32: 3, 40: 2}.get(MODELS[model].channels, 1) if model != "pandarqt" else 3,
        columns=COLUMNS, keep_every=1, precision_m=1e-6, noise=Noise(range_m=0.02),
        returns=Returns(mode, subrays=7, divergence_mrad=20.0),
    )  # fmt: skip
    return survey, *points_of(survey, posts_before_walls())


def data_of(groups):
    assert {group.port for group in groups} == {2368}
    return np.concatenate([group.payloads for group in groups])


@cache
def payloads_of(model, mode):
    _, cloud, sweeps = scanned(model, mode)
    return data_of(encoded(cloud, sweeps))


@cache
def expected_rows(model: str, mode: str, packets: int) -> list[Row]:
    """Return the returns of a survey's points, of the firings in a number of packets."""
    manual = MODELS[model]
    survey, cloud, _ = scanned(model, mode)
    sensor = survey.mounted_sensors[0].sensor
    lasers = np.argsort(lasers_deg(model)[0], kind="stable")
    first_firings = np.array([sensor.firings(step)[0] for step in range(survey.steps)])
    firing = first_firings[cloud["scan"]] + cloud["ray"] // manual.channels
    kind = np.full(len(cloud), BOTH if mode == "dual" else ONLY)
    if mode == "dual":
        several = cloud["returns"] == 2
        kind[several] = np.where(cloud["return_number"] == 2, LAST, STRONGEST)[several]
    rows = np.stack(
        [firing, lasers[cloud["channel"]], kind, cloud["range"], cloud["reflectivity"],
         90 - cloud["azimuth"], cloud["time"] / 1000], axis=1
    )  # fmt: skip
    firings = manual.blocks // (2 if mode == "dual" else 1)
    return rows[firing < packets * firings]


def check(payloads, model, mode):
    """Assert that packets hold the points of a survey, in the packets' units."""
    rows = np.array(sorted(plain_rows(payloads, model, mode)))
    expected = expected_rows(model, mode, len(payloads))
    expected = expected[np.lexsort(expected[:, 2::-1].T)]
    assert len(rows) > 400 and rows.shape == expected.shape
    assert (rows[:, [0, 1, 2, 4]] == expected[:, [0, 1, 2, 4]]).all()
    assert abs(rows[:, 3] - expected[:, 3]).max() <= UNIT_M / 2 + 1e-5
    assert abs((rows[:, 5] - expected[:, 5] + 180) % 360 - 180).max() <= 0.005 + 1e-4
    assert abs(rows[:, 6] - expected[:, 6]).max() <= 0.505


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(("model", "mode"), CASES)
def test_packets_hold_the_returns_of_the_cloud(model, mode):
    check(payloads_of(model, mode), model, mode)
    if mode == "dual":
        kinds = expected_rows(model, mode, len(payloads_of(model, mode)))[:, 2]
        assert set(kinds) == {LAST, STRONGEST, BOTH}


def mutated(payloads, model, field):
    """Return packets with a fault of the smallest size that counts, in the middle packet."""
    manual = MODELS[model]
    changed = payloads.copy()
    packet = changed[len(changed) // 2]
    start = len(manual.header)
    first_return = start + manual.block_head
    if field == "range":  # of the first return, by a unit
        offsets = range(first_return, start + manual.block_bytes, manual.return_bytes)
        first = next(offset for offset in offsets if packet[offset : offset + 2].any())
        add(packet, first, 1, "<u2")
    elif field in ("azimuth + 1", "azimuth - 1"):  # of the first two blocks, by 0.01 degrees
        for block in range(2):
            position = first_return - 2 + block * manual.block_bytes
            add(packet, position, int(field[-3:].replace(" ", "")), "<u2")
    elif field == "stamp":  # by 4 microseconds
        add(packet, manual.stamp_at, 4, "<u4")
    elif field == "laser":  # the first lasers change places
        lasers = slice(first_return, start + manual.block_bytes)
        packet[lasers] = np.roll(packet[lasers], manual.return_bytes)
    elif field == "date":
        packet[manual.date_at + 5] += 1
    elif field == "sequence":
        add(packet, manual.sequence_at, 1, "<u4")
    else:
        packet[manual.mode_at] = 0x40
    return with_checksums(changed, manual) if field != "mode" else changed


def with_checksums(payloads, manual):
    """Return packets whose checksums are right again."""
    if manual.channels == 128:
        packet = payloads[len(payloads) // 2]
        for first, position in ((12, 784), (805, 857)):
            crc = struct.pack("<I", crc_of(packet[first:position].tobytes()))
            packet[position : position + 4] = np.frombuffer(crc, np.uint8)
    return payloads


def add(packet, position, value, kind):
    """Add to a number in a packet."""
    number = packet[position : position + int(kind[-1])].view(kind)
    number[:] = number.astype(int) + value


FIELDS = [
    "range", "azimuth + 1", "azimuth - 1", "stamp", "laser", "date", "sequence", "mode",
]  # fmt: skip


@pytest.mark.extended
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize(("model", "mode"), [("xt32", "dual"), ("pandar40p", "last")])
def test_a_fault_of_a_packet_is_detected(model, mode, field):
    with pytest.raises(AssertionError):
        check(mutated(payloads_of(model, mode), model, field), model, mode)


def synthetic_shots(model, count=60):
    """Return shots whose returns follow from their numbers, without casting."""
    manual = MODELS[model]
    firings = np.arange(count)
    number = np.arange(2 * count * manual.channels).reshape(2, count, manual.channels)
    range_m = (100 + number * 7919 % 14_000) * UNIT_M
    range_m[0, 2::5] = np.nan  # firings without a return
    range_m[1, (firings % 3 > 0) | (firings % 5 == 2)] = np.nan
    starts_ns = np.rint(firings * manual.firing_us * 1000).astype(np.int64)
    return load_sensor(f"hesai/{model}"), Shots(
        firings=firings,
        starts_ns=starts_ns,
        stamps_ns=starts_ns,
        azimuths=np.radians(90 - 350 - 360 * RATE_HZ * starts_ns / 1e9),
        dropped=np.zeros(count, bool),
        range_m=range_m.astype(np.float32),
        columns={"reflectivity": (number % 251).astype(np.uint8)},
    )


# What HesaiLidar_SDK_2.0 (November 2025) reads of the synthetic shots, in the mode dual, of
# PandarQT in the mode last: packets, points with a range, sums of reflectivity, of lasers, and of
# ranges in units; and the start of the SHA-256 of the packets that it read.
RECORDED = {
    "xt32": (15, 3072, 380982, 47616, 21760656, "a45ed8f173568d08"),
    "pandar40p": (12, 3840, 470986, 74880, 27245520, "882f1598e2a7ab32"),
    "pandar64": (20, 6144, 753920, 193536, 43681392, "c20b8f4fdd641a7b"),
    "pandarqt": (15, 3072, 374955, 96768, 21818176, "a520f7a2a819dc1d"),
    "pandar128": (60, 12288, 1539920, 780288, 87177104, "6d83500786a7d5e4"),
    "ot128": (60, 12288, 1539920, 780288, 87177104, "4a77bf6a7de17381"),
}


@pytest.mark.extended
@pytest.mark.parametrize("model", MODELS)
def test_packets_are_those_that_the_sdk_has_read(model):
    sensor, shots = synthetic_shots(model)
    mode = "last" if model == "pandarqt" else "dual"
    encoder = encoder_of(PacketSource(sensor, mode))
    payloads = data_of(encoder.encode(shots[:13]) + encoder.encode(shots[13:]))
    rows = np.array(plain_rows(payloads, model, mode))
    rows = np.concatenate([rows, rows[rows[:, 2] == BOTH]])  # the SDK keeps both
    sums = rows[:, 4].sum(), rows[:, 1].sum(), np.rint(rows[:, 3] / UNIT_M).sum()
    digest = hashlib.sha256(payloads.tobytes()).hexdigest()[:16]
    assert (len(payloads), len(rows), *map(int, sums), digest) == RECORDED[model]


def moving_survey(rate_hz=10, **options):
    """Return a survey of a sensor that drives and turns for two revolutions and a half."""
    times = np.linspace(0, 0.3, 16)
    yaw = 0.8 * times
    positions = np.stack([5 * times - 1, 0.2 * times, 0.1 * np.sin(9 * times)], axis=1)
    turns = np.stack([0 * yaw, 0.03 * np.sin(7 * times), np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    options = {"steps": 90, "columns": COLUMNS, "keep_every": 1, "precision_m": 1e-6} | options
    sensor = load_sensor("hesai/xt32", rate_hz=rate_hz)
    return Survey(
        sensors=[Mounted(sensor, Pose((0.5, 0.0, 0.0), 20.0), "lidar")],
        trajectory=Track(times, positions, turns, smooth=True), coordinates="sensor", **options,
    )  # fmt: skip


def fields_of(payloads, position, kind="<u4"):
    size = int(kind[-1])
    return payloads[:, position : position + size].copy().view(kind)[:, 0].astype(int)


def test_packets_continue_from_sweep_to_sweep_while_the_sensor_moves():
    """At 7 Hz, a revolution of 2,857.1 firings is not a whole number of packets of 8."""
    survey = moving_survey(rate_hz=7, steps=40)
    cloud, sweeps = points_of(survey, room())
    payloads = data_of(encoded(cloud, sweeps))
    assert len(payloads) == survey.mounted_sensors[0].sensor.firings(39)[1] // 8
    rows = np.array(plain_rows(payloads[350:365], "xt32", "strongest", 351, rate_hz=7))
    assert len(rows) == 15 * 8 * 32  # in a closed room
    firing = cloud["time"] // 50_000
    expected = cloud[(firing >= 350 * 8) & (firing < 365 * 8)]
    expected = expected[np.lexsort((31 - expected["channel"], expected["time"] // 50_000))]
    assert rows[:, 3] == pytest.approx(expected["range"], abs=UNIT_M / 2 + 1e-5)
    assert rows[:, 6] == pytest.approx(expected["time"] / 1000, abs=0.505)
    turned = rows[:, 5] - (90 - expected["azimuth"]) + 180
    assert turned % 360 - 180 == pytest.approx(0, abs=0.0051)


def test_dropped_packets_are_gaps_in_the_sequence():
    fault = Fault("dropped_packets", from_s=0.05, share=0.3, packet=8)
    survey = moving_survey(faults=[fault])
    cloud, sweeps = points_of(survey, room())
    payloads = data_of(encoded(cloud, sweeps))
    numbers = fields_of(payloads, 1076)
    in_cloud = np.unique(cloud["time"] // (8 * 50_000))
    assert (numbers - 1).tolist() == in_cloud[in_cloud < 625].tolist()
    assert 0.2 < (625 - len(numbers)) / 500 < 0.4 and numbers[:125].tolist() == [*range(1, 126)]


def test_a_jump_of_the_clock_is_in_the_stamps():
    survey = moving_survey(faults=[Fault("time_jump", from_s=0.1, by_s=0.02)])
    cloud, sweeps = points_of(survey, room())
    groups = encoded(cloud, sweeps)
    stamps = [stamp_us(payload.tobytes(), MODELS["xt32"]) for payload in data_of(groups)]
    assert sorted(set(np.diff(stamps).tolist())) == [400, 20_400]
    due_ns = np.concatenate([group.due_ns for group in groups])
    assert set(np.diff(due_ns)) == {400_000}


def test_ranges_that_a_packet_cannot_hold_are_no_returns():
    sensor, shots = synthetic_shots("xt32", 8)
    range_m = np.full_like(shots.range_m, np.nan)
    range_m[0] = 65_535 * UNIT_M
    range_m[0, 4] = 65_535.6 * UNIT_M
    range_m[0, 5] = 0.0019
    encoder = encoder_of(PacketSource(sensor, "strongest"))
    shots = replace(shots, range_m=range_m, columns={"reflectivity": np.uint8(7) + 0 * range_m})
    rows = plain_rows(data_of(encoder.encode(shots)), "xt32", "strongest")
    assert {row.firing for row in rows} == {*range(8)} - {4, 5}
    assert {row.range_m for row in rows} == {65_535 * UNIT_M}


@pytest.mark.parametrize("model", ["xt32", "pandar40p", "ot128"])
def test_dates_are_those_of_the_survey(model):
    """The leap day, and the second in which the packet's last block is stamped."""
    sensor, shots = synthetic_shots(model, 40)
    start = datetime(2028, 2, 29, 23, 59, 59, 999_100, tzinfo=UTC)
    start_ns = round(start.timestamp() * 1e6) * 1000
    encoder = encoder_of(PacketSource(sensor, "last", start_ns=start_ns, dated=True))
    payloads = data_of(encoder.encode(shots))
    manual = MODELS[model]
    stamps = [stamp_us(payload.tobytes(), manual) for payload in payloads]
    periods = manual.blocks * np.arange(1, len(payloads) + 1) - 1
    since_start = periods * manual.firing_us - manual.first_us - manual.reference_us
    assert stamps == pytest.approx((start_ns - START_NS) / 1000 + since_start, abs=0.501)
    dates = {tuple(payload[manual.date_at : manual.date_at + 6].tolist()) for payload in payloads}
    year = 2028 - manual.epoch
    assert dates == {(year, 2, 29, 23, 59, 59), (year, 3, 1, 0, 0, 0)}


def with_identifiers(sensor, **identifiers):
    packets = replace(sensor.packets, identifiers={**sensor.packets.identifiers, **identifiers})
    return replace(sensor, packets=packets)


def test_a_ptp_clock_counts_seconds():
    sensor, shots = synthetic_shots("xt32")
    sensor = with_identifiers(sensor, clock="ptp")
    payloads = data_of(encoder_of(PacketSource(sensor, "last")).encode(shots))
    seconds = START_NS // 10**9
    assert payloads[:, 1065:1071].tolist() == [[0, 0, *seconds.to_bytes(4, "big")]] * len(payloads)


def test_files_beside_the_packets_hold_angles_and_firing_times():
    files = {model: encoder_of(PacketSource(load_sensor(f"hesai/{model}"), "last")).files()
             for model in MODELS}  # fmt: skip
    for model, contents in files.items():
        head, *rows = contents[".angles.csv"].decode().splitlines()
        assert head == "Channel,Elevation,Azimuth"
        numbers = np.array([row.split(",") for row in rows], float)
        expected = np.column_stack([np.arange(len(rows)) + 1, *lasers_deg(model)])
        assert numbers == pytest.approx(expected, abs=1e-6)
    rows = files["pandar40p"][".firetimes.csv"].decode().splitlines()
    assert rows[0] == "Channel,fire time(us)"
    assert [rows[1], rows[8], rows[40]] == ["1,-42.22", "8,-54.67", "40,-3.62"]
    rows = files["ot128"][".firetimes.csv"].decode().splitlines()
    assert rows[:3] == [
        "Operational State,0,0,0,0,2,2", "Azimuth State,0,1,2,3,0,1", "1" + 6 * ",46.645"
    ]  # fmt: skip
    rows = files["pandar128"][".firetimes.csv"].decode().splitlines()
    assert rows[1] == "operation mode,0,0,0,0,0,0,0,0,2,2,2,2,3,3,3,3"
    assert rows[2] == "angle state,0,0,1,1,2,2,3,3,0,0,1,1,0,0,1,1"
    assert rows[3] == "1" + 16 * ",4436" and rows[4] == "2" + 16 * ",28554"


def test_the_file_of_angles_is_a_calibration(tmp_path):
    sensor = load_sensor("hesai/pandar64")
    angles = encoder_of(PacketSource(sensor, "last")).files()[".angles.csv"]
    (tmp_path / "lidar.angles.csv").write_bytes(angles)
    calibrated = load_sensor("hesai/pandar64", calibration=tmp_path / "lidar.angles.csv")
    for name in ("elevation", "azimuth", "time_ns"):
        values = getattr(calibrated.beams, name)
        assert values == pytest.approx(getattr(sensor.beams, name), abs=1e-9)
    assert encoder_of(PacketSource(calibrated, "last")).files()[".angles.csv"] == angles


@pytest.mark.parametrize(
    ("sensor", "mode", "message"),
    [
        (load_sensor("hesai/xt32"), "two_strongest", "returns strongest, last, dual, first, not"),
        (load_sensor("hesai/pandar64"), "first", "returns strongest, last, dual, not first. Set"),
        (load_sensor("hesai/pandarqt"), "dual", "returns last, first, not dual. Set returns"),
        (with_identifiers(load_sensor("hesai/xt32"), model="PandarXT"), "last",
         "support the models PandarXT-32, Pandar40P, Pandar64, PandarQT, Pandar128, OT128, not"),
        (with_identifiers(load_sensor("hesai/xt32"), model="Pandar64"), "last",
         "contain 64 lasers, but the sensor has 32"),
        (with_identifiers(load_sensor("hesai/pandarqt"), model="Pandar64"), "last",
         "firing interval of 55.56 µs, .* the sensor has 166.67"),
        (with_identifiers(load_sensor("hesai/xt32"), clock="tai"), "last", "clock gps or ptp, not"),
        (with_identifiers(load_sensor("hesai/pandar64"), clock="ptp"), "last", "the clock gps, no"),
    ],
)  # fmt: skip
def test_packets_that_cannot_be_made_are_refused(sensor, mode, message):
    with pytest.raises(LidarError, match=message):
        encoder_of(PacketSource(sensor, mode))

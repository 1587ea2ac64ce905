"""Packets of Ouster, decoded by a plain reader of the manual and by ouster-sdk."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, lru_cache
from itertools import pairwise
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from tests.captures import variants
from tests.shapes import Cart, box, room, wall

from lidarfiles.clouds.navigation_files import write_instruments
from lidarfiles.recordings.opening import open_recording
from lidarsim import (
    Fault,
    Imu,
    LidarError,
    Mounted,
    Navigation,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    Sensor,
    Survey,
    load_sensor,
)
from lidarsim.columns.table import SCAN
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.ouster import LIDAR_PORT, PROFILES, OusterDecoder
from lidarsim.packets.pcap import PcapWriter
from lidarsim.packets.shots import Shots
from lidarsim.schema.model_names import model_names
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

COLUMNS = ("ray", "range", "reflectivity", "signal", "time")
MODELS = [name for name in model_names() if name.startswith("ouster/")]
LEGACY = "LEGACY"
SINGLE = "RNG19_RFL8_SIG16_NIR16"
DUAL = "RNG19_RFL8_SIG16_NIR16_DUAL"
LOW_RATE = "RNG15_RFL8_NIR8"
# {profile: bytes of a pixel}, and what the manual says of ranges: millimeters
PIXEL_BYTES = {LEGACY: 12, SINGLE: 12, DUAL: 16, LOW_RATE: 4}
UNIT_MM = {LEGACY: 1, SINGLE: 1, DUAL: 1, LOW_RATE: 8}
MAX_MM = {LEGACY: 1_048_575, SINGLE: 524_287, DUAL: 524_287, LOW_RATE: 262_136}
# A unit of each product line in a recording of ouster-sdk: distance from axis to beams.
ORIGIN_MM = {"0": 27.67, "1": 15.806, "2": 13.762}
FIELDS = ("range", "reflectivity", "signal")


class Frames(NamedTuple):
    """What packets say of f frames of w columns and h rows; NaN or 0 where they say nothing."""

    valid: np.ndarray  # (f, w)
    time_ns: np.ndarray  # (f, w)
    range_mm: np.ndarray  # (f, 2, h, w)
    reflectivity: np.ndarray
    signal: np.ndarray
    near_infrared: np.ndarray  # (f, h, w)


def plain_crc(data: bytes) -> int:
    """CRC-64 of ECMA-182 in its reflected form, bit by bit."""
    crc = 2**64 - 1
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xC96C5795D7870F42 if crc & 1 else 0)
    return crc ^ (2**64 - 1)


def uint(data, first, size):
    """Whole numbers of `size` bytes, the lowest first, at a byte of each row."""
    return sum(data[..., first + n].astype(np.int64) << 8 * n for n in range(size))


def plain_frames(payloads, metadata) -> Frames:
    """Read lidar packets by the layout in the firmware user manual."""
    layout = metadata["lidar_data_format"]
    profile, rows, width = (
        layout[name] for name in ("udp_profile_lidar", "pixels_per_column", "columns_per_frame")
    )
    legacy = profile == LEGACY
    header, column_header, footer = (0, 16, 0) if legacy else (32, 12, 32)
    column_bytes = column_header + rows * PIXEL_BYTES[profile] + 4 * legacy
    assert payloads.shape[1] == header + 16 * column_bytes + footer
    columns = payloads[:, header : header + 16 * column_bytes].reshape(-1, column_bytes)
    number = uint(columns, 8, 2)
    if legacy:
        frame = uint(columns, 10, 2)
        assert (uint(columns, 12, 4) * width == number * 90_112).all()
        status = uint(columns, column_bytes - 4, 4)
        valid = status == 0xFFFF_FFFF
    else:
        info = metadata["sensor_info"]
        assert (uint(payloads, 0, 2) == 1).all()
        assert (uint(payloads, 4, 3) == info["initialization_id"]).all()
        assert (uint(payloads, 7, 5) == int(info["prod_sn"])).all()
        assert not payloads[:, 12:32].any() and not payloads[:, -32:-8].any()
        frame = uint(payloads, 2, 2).repeat(16)
        status = uint(columns, 10, 2)
        valid = status == 1
    assert (valid | (status == 0)).all()
    assert (number.reshape(-1, 16) % 16 == np.arange(16)).all()
    pixels = columns[:, column_header : column_bytes - 4 * legacy].reshape(len(columns), rows, -1)
    assert not pixels[~valid].any()
    count = int(frame.max()) + 1
    frames = Frames(
        np.zeros((count, width), bool),
        np.zeros((count, width), np.int64),
        *np.zeros((3, count, 2, rows, width), np.int64),
        np.zeros((count, rows, width), np.int64),
    )
    frames.valid[frame, number] = valid
    frames.time_ns[frame, number] = uint(columns, 0, 8)
    if profile in (LEGACY, SINGLE):
        planes = [(uint(pixels, 0, 3), pixels[:, :, 4], uint(pixels, 6, 2))]
        assert not pixels[:, :, [3, 5, 10, 11]].any()
        near_infrared = uint(pixels, 8, 2)
    elif profile == DUAL:
        planes = [
            (uint(pixels, 4 * n, 3), pixels[:, :, 4 * n + 3], uint(pixels, 8 + 2 * n, 2))
            for n in range(2)
        ]
        assert not pixels[:, :, 14:].any()
        near_infrared = uint(pixels, 12, 2)
    else:
        planes = [(uint(pixels, 0, 2) * 8, pixels[:, :, 2], np.zeros(pixels.shape[:2]))]
        near_infrared = pixels[:, :, 3]
    for plane, values in enumerate(planes):
        for field, image in zip(frames[2:5], values, strict=True):
            field[frame, plane, :, number] = image
    frames.near_infrared[frame, :, number] = near_infrared
    return frames


def plain_xyz(range_mm, metadata):
    """Points (…, h, w, 3), meters in the sensor frame, by the formulas of the sensor manual."""
    beams = metadata["beam_intrinsics"]
    width = metadata["lidar_data_format"]["columns_per_frame"]
    offset = beams["lidar_origin_to_beam_origin_mm"]
    encoder = 2 * np.pi * (1 - np.arange(width) / width)
    azimuth = encoder - np.radians(beams["beam_azimuth_angles"])[:, None]
    altitude = np.radians(beams["beam_altitude_angles"])[:, None]
    level = (range_mm - offset) * np.cos(altitude)
    x = level * np.cos(azimuth) + offset * np.cos(encoder)
    y = level * np.sin(azimuth) + offset * np.sin(encoder)
    z = (range_mm - offset) * np.sin(altitude)
    to_sensor = np.reshape(metadata["lidar_intrinsics"]["lidar_to_sensor_transform"], (4, 4))
    return (np.stack([x, y, z], -1) @ to_sensor[:3, :3].T + to_sensor[:3, 3]) / 1000


@cache
def posts_before_walls() -> Scene:
    """Two walls, and a row of posts that beams meet in part."""
    posts = [box(f"post {n}", (4, n / 2, -2), (4.05, n / 2 + 0.1, 2)) for n in range(-9, 10)]
    walls = [wall("left", 8, (1, 9), (-4, 4)), wall("right", 9, (-12, 0), (-4, 4))]
    return Scene.from_meshes([*walls, *posts, wall("far", 400, (-300, 300), (-200, 200))])


def with_profile(sensor: Sensor, profile: str) -> Sensor:
    identifiers = {**sensor.packets.identifiers, "profile": profile}
    return replace(sensor, packets=replace(sensor.packets, identifiers=identifiers))


def case_of(model: str, profile: str, columns: int = 512, **options):
    """A survey of two and a half revolutions, its points, packets and metadata."""
    sensor = with_profile(load_sensor(f"ouster/{model}", columns=columns), profile)
    survey = Survey(
        sensors=[Mounted(sensor, Pose((1.0, 0.2, 0.5), 20.0, 4.0), "lidar")],
        **{
            "steps": 90, "columns": COLUMNS, "precision_m": 1e-6, "coordinates": "sensor",
            "returns": Returns("two_strongest", subrays=7, divergence_mrad=20.0)
            if profile == DUAL
            else Returns(),
        }
        | ({} if "trajectory" in options else {"poses": [Pose((0.0, 0.0, 0.0), 25.0)]})
        | options,
    )  # fmt: skip
    scene = posts_before_walls()
    part = columns_of(list(Rig(scene, survey, "tiles").cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    return survey, cloud, Sweeps.from_survey(survey, scene)


@lru_cache(maxsize=8)
def still(model, profile, columns=512):
    return case_of(
        model,
        profile,
        columns,
        noise=Noise(range_m=0.01, detection_range_m=500, false_alarm_hz=3000),
    )


def encoded(cloud, sweeps):
    """Groups of datagrams, and the metadata."""
    encoder = encoder_of(PacketSource.for_sensor(sweeps, 0))
    groups = []
    for sweep, points in enumerate(sweeps.points(cloud)):
        groups += encoder.encode(Shots.from_points(sweeps, sweep, points, encoder.columns))
    groups += encoder.finish()
    ((suffix, content),) = encoder.files().items()
    assert suffix == ".json"
    return groups, json.loads(content)


def lidar_of(groups):
    return np.concatenate([group.payloads for group in groups if group.port == 7502])


def expected_frames(survey, cloud, profile, start_ns=START_NS) -> tuple[Frames, np.ndarray]:
    """What packets must say of a survey's points, by the points alone; and their positions."""
    sensor = survey.mounted_sensors[0].sensor
    width = int(sensor.head.firings_per_turn)
    rows = sensor.channels
    first_firings = np.array([sensor.firings(step)[0] for step in range(survey.steps + 1)])
    firing, channel = np.divmod(cloud["ray"].astype(int), rows)
    frame, column = np.divmod(firing + first_firings[cloud["scan"]], width)
    row = rows - 1 - channel
    assert (channel == cloud["channel"]).all()
    count = -(-int(first_firings[-1]) // width)
    plane = np.zeros(len(cloud), int)
    plane[1:] = (np.diff(cloud["ray"].astype(int)) == 0) & (np.diff(cloud["scan"]) == 0)
    offset = ORIGIN_MM[sensor.packets.identifiers["product_line"][3]]
    values = np.zeros((4, count, 2, rows, width))
    positions = np.full((count, 2, rows, width, 3), np.nan)
    pixel = frame, plane, row, column
    values[0][pixel] = cloud["range"].astype(float) * 1000 + offset
    values[1][pixel] = cloud["reflectivity"]
    values[2][pixel] = cloud["signal"]
    positions[pixel] = cloud.positions
    swapped = values[2, :, 1] > values[2, :, 0]
    for images in (*values[:3], positions):
        images[:, 0][swapped], images[:, 1][swapped] = (
            images[:, 1][swapped], images[:, 0][swapped],
        )  # fmt: skip
    lost = values[0] > MAX_MM[profile] + UNIT_MM[profile] / 2
    values[:, lost] = 0
    positions[values[0] == 0] = np.nan
    fired = np.arange(count * width) < first_firings[-1]
    period_ns = 1e9 / sensor.head.rate_hz / width
    times = np.rint(np.arange(count * width) * period_ns).astype(np.int64) + start_ns
    frames = Frames(
        fired.reshape(count, width), np.where(fired, times, 0).reshape(count, width),
        *values[:3], np.zeros((count, rows, width)),
    )  # fmt: skip
    return frames, positions


def check(payloads, metadata, case, profile, start_ns=START_NS):
    """Assert that packets hold the points of a survey, in the packets' units."""
    survey, cloud, _ = case
    frames = plain_frames(payloads, metadata)
    expected, positions = expected_frames(survey, cloud, profile, start_ns)
    assert (frames.valid == expected.valid).all()
    assert (frames.time_ns == expected.time_ns).all()
    returned = expected.range_mm > 0
    assert returned.sum() > 800
    assert ((frames.range_mm > 0) == returned).all()
    assert abs(frames.range_mm - expected.range_mm).max() <= UNIT_MM[profile] / 2 + 1e-3
    assert (frames.reflectivity == expected.reflectivity).all()
    assert profile == LOW_RATE or (frames.signal == expected.signal).all()
    assert not frames.near_infrared.any()
    errors = np.linalg.norm(plain_xyz(frames.range_mm, metadata) - positions, axis=-1)
    assert np.nanmax(errors) < UNIT_MM[profile] / 2000 + 2e-5
    if profile == DUAL:
        assert returned[:, 1].sum() > 40 and (frames.signal[:, 0] >= frames.signal[:, 1]).all()


@pytest.mark.parametrize(
    ("model", "profile"), [*(("os1-32", profile) for profile in PROFILES), ("os0-32", SINGLE)]
)
def test_packets_hold_the_returns_of_the_cloud(model, profile):
    case = still(model, profile)
    groups, metadata = encoded(*case[1:])
    check(lidar_of(groups), metadata, case, profile)


@pytest.mark.slow  # all models and columns: a minute
@pytest.mark.parametrize("columns", [512, 1024, 2048])
@pytest.mark.parametrize("model", MODELS)
def test_packets_of_all_models_hold_the_returns_of_the_cloud(model, columns):
    for profile in PROFILES:
        case = still(model.partition("/")[2], profile, columns)
        groups, metadata = encoded(*case[1:])
        check(lidar_of(groups), metadata, case, profile)


@pytest.mark.extended
@pytest.mark.parametrize("profile", [SINGLE, LOW_RATE])
def test_packets_of_a_moving_sensor_hold_the_returns_of_the_cloud(profile):
    start = datetime(2025, 3, 1, 12, 0, 1, 123_456, tzinfo=UTC)
    case = case_of("os1-32", profile, trajectory=Cart(stations=1, height=0.0), start=start)
    groups, metadata = encoded(*case[1:])
    check(lidar_of(groups), metadata, case, profile, 1_740_830_401_123_456_000)
    first_ns = min(int(group.due_ns[0]) for group in groups)
    assert first_ns == round(16 * 1e8 / 512)  # at the end of the sixteenth column


# SHA-256 of the lidar packets of `random_shots`, which ouster-sdk 1.0.1 decoded to the same values.
RECORDED = {
    LEGACY: "69fc4d42e5e7323795a5440fd744073639d2529a2578210f3f67d80f5badd2d2",
    SINGLE: "2db929104d3ce6024ba790472ff8df03dac87f7a45fe79f5c607b64c9389431d",
    DUAL: "622a9710e2ea7eef849f4687eb8612fe332f99bb83f47d4450f2f9de74f1d85b",
    LOW_RATE: "d4a9f050fcbc98708fa9347a2d639de714f53225753d1e294351cd2842369b94",
}


def random_shots(profile, numbers=range(512), seed=1) -> Shots:
    """Shots of an OS1-32 with random returns, without a simulator."""
    rng = np.random.default_rng(seed)
    count = len(numbers)
    shape = (1 + (profile == DUAL), count, 32)
    range_m = rng.integers(300, 600_000, shape).astype(np.float32) / 1000
    range_m[rng.random(shape) < 0.3] = np.nan
    firings = np.arange(numbers.start, numbers.stop)
    return Shots(
        firings,
        firings * 195_313,
        firings * 195_313,
        np.zeros(count),
        rng.random(count) < 0.01,
        range_m,
        {
            "reflectivity": rng.integers(0, 256, shape, np.uint8),
            "signal": rng.integers(0, 65_536, shape, np.uint16),
        },
    )


def random_source(profile, **fields):
    sensor = with_profile(load_sensor("ouster/os1-32", columns=512), profile)
    mode = "two_strongest" if profile == DUAL else "strongest"
    return PacketSource(sensor, mode, "lidar", **fields)


@pytest.mark.parametrize("profile", PROFILES)
def test_packets_hold_random_returns(profile):
    """What fits into no packet, and all of lost columns, are zeros."""
    shots = random_shots(profile)
    encoder = encoder_of(random_source(profile))
    payloads = lidar_of(encoder.encode(shots))
    frames = plain_frames(payloads, encoder.metadata())
    unit_mm = UNIT_MM[profile]
    range_mm = np.rint((shots.range_m.astype(float) * 1000 + 15.806) / unit_mm) * unit_mm
    returned = (range_mm <= MAX_MM[profile]) & ~shots.dropped[:, None]
    signal = np.where(returned, shots.columns["signal"], 0)
    stronger = np.argsort(-np.where(returned, signal, -1.0), axis=0, kind="stable")
    for images, values in (
        (frames.range_mm, range_mm),
        (frames.reflectivity, shots.columns["reflectivity"]),
        (frames.signal, signal * (profile != LOW_RATE)),
    ):
        expected = np.take_along_axis(np.where(returned, values, 0), stronger, axis=0)
        np.testing.assert_array_equal(images[0, : len(expected)], expected.transpose(0, 2, 1))
    assert returned.mean() > 0.25 and (~shots.dropped).sum() == frames.valid.sum() < 512
    assert hashlib.sha256(payloads.tobytes()).hexdigest() == RECORDED[profile]


def test_checksums_are_those_of_the_standard():
    assert plain_crc(b"123456789") == 0x995DC9BBDF1939FA  # the check value of CRC-64/XZ
    groups = encoder_of(random_source(LOW_RATE)).encode(random_shots(LOW_RATE))
    for payload in lidar_of(groups)[[0, -1]]:
        assert plain_crc(payload[:-8].tobytes()) == int.from_bytes(payload[-8:].tobytes(), "little")


# -- faults of the encoder are noticed -----------------------------------------------------------


@cache
def packets_of(profile):
    groups, metadata = encoded(*still("os1-32", profile)[1:])
    return lidar_of(groups), metadata


def first_pixel(payloads, profile):
    """Packet and byte of the first pixel with a return, and of its column."""
    header, column_header = (0, 16) if profile == LEGACY else (32, 12)
    column_bytes = column_header + 32 * PIXEL_BYTES[profile] + 4 * (profile == LEGACY)
    for packet, column, row in np.ndindex(len(payloads), 16, 32):
        start = header + column * column_bytes
        pixel = start + column_header + row * PIXEL_BYTES[profile]
        if payloads[packet, pixel : pixel + 2].any():
            return packet, start, pixel
    raise AssertionError("there are no returns")


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("fault", ["range", "stamp", "column", "reflectivity"])
def test_a_wrong_packet_is_noticed(profile, fault):
    payloads, metadata = packets_of(profile)
    wrong = payloads.copy()
    packet, column, pixel = first_pixel(payloads, profile)
    first = {"range": pixel, "stamp": column, "column": column + 8}.get(fault)
    if fault == "reflectivity":
        first = pixel + {DUAL: 3, LOW_RATE: 2}.get(profile, 4)
    change = 4000 if fault == "stamp" else 1
    value = uint(wrong[packet], first, 2) + change
    wrong[packet, first : first + 2] = np.frombuffer(
        int(value % 65_536).to_bytes(2, "little"), "u1"
    )
    check(payloads, metadata, still("os1-32", profile), profile)
    with pytest.raises(AssertionError):
        check(wrong, metadata, still("os1-32", profile), profile)


@pytest.mark.parametrize("section", ["azimuth", "altitude", "origin", "height"])
def test_wrong_metadata_are_noticed(section):
    payloads, metadata = packets_of(SINGLE)
    wrong = json.loads(json.dumps(metadata))
    beams = wrong["beam_intrinsics"]
    if section in ("azimuth", "altitude"):
        beams[f"beam_{section}_angles"][16] += 0.01
    elif section == "origin":
        beams["lidar_origin_to_beam_origin_mm"] += 1.0
    else:
        wrong["lidar_intrinsics"]["lidar_to_sensor_transform"][11] += 1.0
    with pytest.raises(AssertionError):
        check(payloads, wrong, still("os1-32", SINGLE), SINGLE)


# -- faults of the sensor, packets that are not full ---------------------------------------------


def test_lost_packets_are_not_sent_and_lost_columns_are_not_valid():
    faults = [
        Fault("dropped_packets", share=0.4, packet=16),
        Fault("dropped_packets", share=0.1, packet=5, from_s=0.1),
    ]
    _, cloud, sweeps = case_of("os1-32", SINGLE, faults=faults)
    groups, metadata = encoded(cloud, sweeps)
    payloads = lidar_of(groups)
    frames = plain_frames(payloads, metadata)
    seed = sweeps.fired.seeds[0]
    firings = np.arange(1280)
    lost = faults[0].find_dropped(firings, seed, 0, 0)
    lost |= faults[1].find_dropped(firings, seed, 0, 1) & (firings >= 512)
    np.testing.assert_array_equal(frames.valid.ravel()[:1280], ~lost)
    sent = (~lost).reshape(-1, 16).any(axis=1)
    assert len(payloads) == sent.sum() < 60
    assert lost.reshape(-1, 16).any(axis=1).sum() > (~sent).sum() > 20
    assert (frames.range_mm > 0).sum() == len(cloud)


def test_stamps_jump_and_frozen_sweeps_are_new_frames():
    faults = [Fault("frozen", from_s=0.1, to_s=0.25), Fault("time_jump", by_s=0.5, from_s=0.05)]
    _, cloud, sweeps = case_of("os1-32", LEGACY, steps=144, faults=faults)
    groups, metadata = encoded(cloud, sweeps)
    frames = plain_frames(lidar_of(groups), metadata)
    assert frames.valid.shape == (4, 512) and frames.valid.all()
    np.testing.assert_array_equal(frames.range_mm[0], frames.range_mm[1])
    times = frames.time_ns.ravel() - START_NS - np.rint(np.arange(2048) * 1e8 / 512)
    assert (times == np.where(np.arange(2048) * 1e8 / 512 < 5e7, 0, 5e8)).all()
    due_ns = np.concatenate([group.due_ns for group in groups])
    assert (np.diff(due_ns) > 0).all()


@pytest.mark.extended
def test_frames_of_stations_follow_each_other():
    _, cloud, sweeps = case_of(
        "os1-32", DUAL, steps=53, poses=[Pose((0.0, 0.0, 0.0), 25.0 * n) for n in range(2)]
    )
    groups, metadata = encoded(cloud, sweeps)
    payloads = lidar_of(groups)
    frames = plain_frames(payloads, metadata)
    fired = -(-53 * 512 // 36)  # firings at a station
    assert len(payloads) == 2 * -(-fired // 16)
    assert frames.valid.sum(axis=1).tolist() == [512, fired - 512] * 2


def test_a_packet_waits_for_its_last_column():
    whole = encoder_of(random_source(SINGLE)).encode(random_shots(SINGLE))
    encoder = encoder_of(random_source(SINGLE))
    shots = random_shots(SINGLE)
    bounds = [0, 5, 16, 100, 101, 512]
    parts = [encoder.encode(shots[slice(*part)]) for part in pairwise(bounds)]
    assert [sum(map(len, part)) for part in parts] == [0, 1, 5, 0, 26]
    assert encoder.finish() == []
    np.testing.assert_array_equal(
        lidar_of([group for part in parts for group in part]), lidar_of(whole)
    )


def test_frame_numbers_start_again_after_65_535():
    encoder = encoder_of(random_source(SINGLE))
    frames = []
    for revolution in (0, 65_535, 65_536):
        start = revolution * 512
        shots = random_shots(SINGLE, range(start, start + 16))
        encoder._frame_offset = 0
        encoder._next_firing = start
        frames += uint(lidar_of(encoder.encode(shots)), 2, 2).tolist()
    assert frames == [0, 65_535, 0]


# -- IMU -----------------------------------------------------------------------------------------


def imu_case(tmp_path, **options):
    imu = Imu(rate_hz=100, mount=Pose((0.1, 0.2, 0.3), 30.0), gyroscope_bias=0.1)
    case = case_of(
        "os1-32", LOW_RATE, trajectory=Cart(stations=1, height=0.0),
        navigation=Navigation(imu=imu), **options,
    )  # fmt: skip
    survey, cloud, sweeps = case
    write_instruments(tmp_path, survey, np.zeros(3))
    return cloud, replace(sweeps, instruments=replace(sweeps.instruments, folder=tmp_path))


def test_imu_packets_hold_the_samples_of_the_imu(tmp_path):
    groups, metadata = encoded(*imu_case(tmp_path))
    samples = np.loadtxt(tmp_path / "imu.csv", delimiter=",", skiprows=1)
    imu_groups = [group for group in groups if group.port == 7503]
    payloads = np.concatenate([group.payloads for group in imu_groups])
    assert payloads.shape == (len(samples), 48) and len(samples) > 20
    for first in (0, 8, 16):
        np.testing.assert_array_equal(uint(payloads, first, 8), samples[:, 0] + START_NS)
    values = payloads[:, 24:].copy().view("<f4").astype(float)
    np.testing.assert_allclose(values[:, :3] * 9.80665, samples[:, 4:], atol=1e-5)
    np.testing.assert_allclose(np.radians(values[:, 3:]), samples[:, 1:4], atol=1e-7)
    due_ns = np.concatenate([group.due_ns for group in imu_groups])
    np.testing.assert_array_equal(due_ns, samples[:, 0])
    # A point of the IMU's frame, in the carrier's frame by both ways.
    to_sensor = np.reshape(metadata["imu_intrinsics"]["imu_to_sensor_transform"], (4, 4))
    point = to_sensor @ [100, 50, 20, 1]
    lidar = Pose((1.0, 0.2, 0.5), 20.0, 4.0)
    imu = Pose((0.1, 0.2, 0.3), 30.0)
    by_lidar = lidar.rotation_matrix @ (point[:3] / 1000) + lidar.position
    by_imu = imu.rotation_matrix @ [0.1, 0.05, 0.02] + imu.position
    np.testing.assert_allclose(by_lidar, by_imu, atol=1e-9)


def test_imu_samples_have_the_jumps_of_the_sensors_clock(tmp_path):
    faults = [Fault("time_jump", by_s=0.5, from_s=0.105)]
    groups, _ = encoded(*imu_case(tmp_path, faults=faults))
    payloads = np.concatenate([group.payloads for group in groups if group.port == 7503])
    times_ms = (uint(payloads, 0, 8) - START_NS) // 1_000_000
    assert times_ms.tolist()[8:12] == [90, 100, 610, 620]


def test_sensors_have_serial_numbers_of_their_own():
    left, right = (
        encoder_of(replace(random_source(SINGLE), name=name)).metadata()["sensor_info"]["prod_sn"]
        for name in ("left", "right")
    )
    assert left != right and len(left) == len(right) == 12


# -- refusals ------------------------------------------------------------------------------------


def test_metadata_of_a_unit_are_written_as_read(tmp_path):
    _, metadata = encoded(*still("os0-32", SINGLE)[1:])
    file = tmp_path / "unit.json"
    file.write_text(json.dumps(metadata))
    sensor = load_sensor("ouster/os0-32", calibration=file)
    again = encoder_of(PacketSource(sensor, "strongest", "lidar")).metadata()
    assert again == metadata


@pytest.mark.parametrize(
    ("model", "mode", "profile", "message"),
    [
        (
            "os1-32",
            "dual",
            None,
            "support the returns strongest, first, last, two_strongest, not dual",
        ),
        (
            "os1-32",
            "two_strongest",
            LEGACY,
            "require the returns strongest, first or last, not two_",
        ),
        ("os1-32", "strongest", DUAL, "require the returns two_strongest, not strongest"),
        ("os1-32", "strongest", "RNG", "support the profiles LEGACY, .*, not RNG"),
    ],
)
def test_modes_and_profiles_that_do_not_fit_are_refused(model, mode, profile, message):
    sensor = load_sensor(f"ouster/{model}")
    if profile:
        sensor = with_profile(sensor, profile)
    with pytest.raises(LidarError, match=message):
        encoder_of(PacketSource(sensor, mode))


@pytest.mark.parametrize("options", [{"columns": 500}, {"rate_hz": 10.5}])
def test_heads_that_no_ouster_has_are_refused(options):
    with pytest.raises(LidarError, match=r"512, 1024, 2048, 4096 columns per turn at a whole"):
        encoder_of(PacketSource(load_sensor("ouster/os1-32", **options), "strongest"))


def test_packets_of_a_window_are_refused_and_its_sweeps_are_whole(tmp_path):
    source = PacketSource(load_sensor("ouster/os1-32"), "strongest")
    metadata = encoder_of(source).metadata()
    metadata["lidar_data_format"]["column_window"] = [256, 767]
    (tmp_path / "os.json").write_text(json.dumps(metadata))
    sensor = load_sensor(calibration=tmp_path / "os.json")
    with pytest.raises(
        LidarError,
        match=(
            r"require a head that fires in all directions. "
            r"Remove azimuth_"
        ),
    ):
        encoder_of(PacketSource(sensor, "strongest"))
    cloud = Scanner(room(), sensor, coordinates="sensor").sweep(Pose((0, 0, 1)), number=3)
    azimuths_deg = np.degrees(np.arctan2(*cloud.positions[:, 1::-1].T))
    assert len(cloud) == 512 * 32 and np.abs(azimuths_deg).max() < 95  # beams differ by 4 degrees


# -- ouster-sdk ----------------------------------------------------------------------------------


def sdk():
    core = pytest.importorskip("ouster.sdk.core")
    return SimpleNamespace(core=core, pcap=pytest.importorskip("ouster.sdk.pcap"))


def sdk_frames(groups, metadata, tmp_path) -> tuple[Frames, np.ndarray]:
    """Frames and points as ouster-sdk reads them of a pcap file."""
    ouster = sdk()
    (tmp_path / "lidar.json").write_text(json.dumps(metadata))
    with (tmp_path / "lidar.pcap").open("wb") as file:
        PcapWriter(file, "192.168.1.200", "192.168.1.100", START_NS).write(groups)
    source = ouster.pcap.PcapFrameSetSource(str(tmp_path / "lidar.pcap"))
    (info,) = source.sensor_info
    packet_source = ouster.pcap.PcapPacketSource(str(tmp_path / "lidar.pcap"))
    for _, packet in packet_source:
        if isinstance(packet, ouster.core.LidarPacket):
            assert packet.crc() in (None, packet.calculate_crc())
    assert packet_source.id_error_count == packet_source.size_error_count == 0
    frames = [frame_set[0] for frame_set in source]
    lookup = ouster.core.XYZLut(info)

    def images(name):
        planes = [name, f"{name}2"]
        return np.array(
            [
                [
                    frame.field(plane) if plane in frame.fields else np.zeros((frame.h, frame.w))
                    for plane in planes
                ]
                for frame in frames
            ]
        ).astype(np.int64)

    positions = [[lookup(plane.astype(np.uint32)) for plane in pair] for pair in images("RANGE")]
    return Frames(
        np.array([frame.status.astype(bool) for frame in frames]),
        np.array([np.where(frame.status, frame.timestamp, 0) for frame in frames], np.int64),
        images("RANGE"), images("REFLECTIVITY"), images("SIGNAL"), images("NEAR_IR")[:, 0],
    ), np.array(positions)  # fmt: skip


def check_by_sdk(groups, metadata, tmp_path):
    """Assert that ouster-sdk and the plain reader agree on all values."""
    frames, positions = sdk_frames(groups, metadata, tmp_path)
    expected = plain_frames(lidar_of(groups), metadata)
    for values, wanted in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(values, wanted)
    by_manual = plain_xyz(expected.range_mm, metadata)
    errors = np.linalg.norm(positions - by_manual, axis=-1)[expected.range_mm > 0]
    assert errors.max() < 1e-9


@pytest.mark.parametrize("profile", PROFILES)
def test_ouster_sdk_reads_what_the_plain_reader_reads(profile, tmp_path):
    check_by_sdk(*encoded(*still("os1-32", profile)[1:]), tmp_path)
    encoder = encoder_of(random_source(profile))
    check_by_sdk(encoder.encode(random_shots(profile)), encoder.metadata(), tmp_path)


def test_ouster_sdk_reads_imu_packets(tmp_path):
    ouster = sdk()
    groups, metadata = encoded(*imu_case(tmp_path))
    sdk_frames(groups, metadata, tmp_path)
    source = ouster.pcap.PcapPacketSource(str(tmp_path / "lidar.pcap"))
    packets = [packet for _, packet in source if isinstance(packet, ouster.core.ImuPacket)]
    samples = np.loadtxt(tmp_path / "imu.csv", delimiter=",", skiprows=1)
    assert [packet.sys_ts() for packet in packets] == (samples[:, 0] + START_NS).tolist()
    gyro = np.concatenate([packet.gyro() for packet in packets])
    np.testing.assert_allclose(gyro, samples[:, 1:4], atol=1e-6)
    accel = np.concatenate([packet.accel() for packet in packets])
    np.testing.assert_allclose(accel, samples[:, 4:], atol=1e-5)


def test_a_recording_has_the_times_of_the_sweeps(tmp_path):
    case = still("os1-32", SINGLE)
    sdk_frames(*encoded(*case[1:]), tmp_path)
    recording = open_recording(tmp_path / "lidar.pcap")
    assert recording.stamps_ns.tolist() == [START_NS + n * 1e8 for n in range(3)]


@pytest.mark.parametrize("name", ["vlan", "cooked", "cooked 2", "pcapng", "mdns first"])
def test_ouster_sdk_reads_any_capture(name, tmp_path):
    sdk()
    groups, metadata = encoded(*still("os1-32", SINGLE)[1:])
    packets = [
        (START_NS + int(time_ns), payload.tobytes())
        for group in groups
        if group.port == LIDAR_PORT
        for time_ns, payload in zip(group.due_ns, group.payloads, strict=True)
    ]
    content = variants(packets, LIDAR_PORT)[name]
    (tmp_path / "lidar.json").write_text(json.dumps(metadata))
    (tmp_path / "lidar.pcap").write_bytes(content)
    recording = open_recording(tmp_path / "lidar.pcap")
    assert recording.stamps_ns.tolist() == [START_NS + n * 1e8 for n in range(3)]


@pytest.mark.slow  # all models and columns: a minute
@pytest.mark.parametrize("columns", [512, 1024, 2048])
@pytest.mark.parametrize("model", MODELS)
def test_ouster_sdk_reads_all_models(model, columns, tmp_path):
    for profile in PROFILES:
        case = still(model.partition("/")[2], profile, columns)
        check_by_sdk(*encoded(*case[1:]), tmp_path)


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
def test_legacy_packets_are_recognized_by_their_size(beams):
    """16 columns with a header of 16 bytes, 12 bytes a beam and a status, as the manual has it."""
    size = 16 * (16 + 12 * beams + 4)
    assert OusterDecoder.recognizes(bytes(size))
    assert not OusterDecoder.recognizes(bytes(size + 1))

"""Packets of Velodyne, decoded by a plain reader of the manuals and by velodyne_decoder."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from typing import NamedTuple

import numpy as np
import pytest
from tests.shapes import box, wall

from lidarpool import Fault, LidarError, Noise, Pose, Returns, Scene, Survey, load_sensor
from lidarsim.columns.table import SCAN
from lidarsim.packets.encoders import START_NS, PacketSource, encoder_of
from lidarsim.packets.pcap import PcapWriter
from lidarsim.packets.shots import Shots
from lidarsim.simulator.batch import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps

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
CASES = [(model, mode) for model in MODELS for mode in MODES]


class Row(NamedTuple):
    """A return in a packet."""

    firing: int  # since the first packet
    laser: int
    kind: int  # STRONGEST, LAST or BOTH
    range_m: float
    reflectivity: int
    azimuth_deg: float  # of the head when the laser fires, clockwise from x
    time_us: float  # past the hour


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
def posts_before_walls() -> Scene:
    """Two walls with a gap between, and a row of posts that beams meet in part."""
    posts = [box(f"post {n}", (4, n / 2, -2), (4.05, n / 2 + 0.1, 2)) for n in range(-9, 10)]
    return Scene.from_meshes([wall("left", 8, (1, 9), (-4, 4)), wall("right", 9, (-12, 0), (-4, 4)), *posts])


@cache
def scanned(model: str, mode: str):
    """Return a survey of a sixth of a revolution, its points and its sweeps."""
    survey = Survey(
        sensor=load_sensor(f"velodyne/{model}"), poses=[Pose((0.0, 0.0, 0.0), 25.0)], steps=6,
        columns=COLUMNS, keep_every=1, precision_m=1e-6, noise=Noise(range_m=0.02),
        returns=Returns(mode, subrays=7, divergence_mrad=20.0),
    )  # fmt: skip
    return survey, *points_of(survey, posts_before_walls())


def points_of(survey, scene):
    rig = Rig(scene, survey, "embree")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    return cloud, Sweeps.from_survey(survey, scene)


def encoded(cloud, sweeps):
    """Return the groups of datagrams of all sweeps of a survey with one sensor."""
    encoder = encoder_of(PacketSource.of_sensor(sweeps, 0))
    groups = []
    for sweep, points in enumerate(sweeps.points(cloud)):
        groups += encoder.encode(Shots.from_points(sweeps, sweep, points, encoder.columns))
    return groups + encoder.finish()


def data_of(groups):
    return np.concatenate([group.payloads for group in groups if group.port == 2368])


@cache
def payloads_of(model, mode):
    _, cloud, sweeps = scanned(model, mode)
    return data_of(encoded(cloud, sweeps))


def expected_rows(model: str, mode: str, packets: int) -> list[Row]:
    """Return the returns of a survey's points, of the firings in a number of packets."""
    manual = MODELS[model]
    survey, cloud, _ = scanned(model, mode)
    sensor = survey.carried[0].sensor
    from lidarsim.sensor.models import read_model

    elevations = read_model(f"velodyne/{model}").beams.elevation_deg
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
    from lidarsim.sensor.models import read_model

    beams = read_model(f"velodyne/{model}").beams
    return np.array(beams.azimuth_deg or [0.0] * len(beams.elevation_deg))


@pytest.mark.parametrize(("model", "mode"), CASES)
def test_packets_hold_the_returns_of_the_cloud(model, mode):
    check(payloads_of(model, mode), model, mode)

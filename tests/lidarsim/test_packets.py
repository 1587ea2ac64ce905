"""Packets in general: shots in laser order, pcap files, refusals, plug-ins; positions as NMEA."""

from __future__ import annotations

import struct
from dataclasses import replace
from datetime import UTC
from io import BytesIO
from textwrap import dedent

import numpy as np
import pytest
from tests.plugin_files import write_distribution
from tests.shapes import room

from lidarsim import LidarError, Pose, Returns, Sensor, Survey, load_sensor
from lidarsim.columns.table import SCAN
from lidarsim.packets.encoders import (
    Datagrams,
    PacketEncoder,
    PacketSource,
    encoder_class,
    encoder_of,
)
from lidarsim.packets.pcap import PcapWriter
from lidarsim.packets.shots import CarryOver, Shots
from lidarsim.packets.velodyne_position import PositionPackets
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.models import read_model
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.instruments import Instrument, Instruments
from lidarsim.sweeps.sweeps import Sweeps

START_NS = 1_700_000_000_123_456_789


def points_of(survey, scene):
    rig = Rig(scene, survey, "tiles")
    part = columns_of(list(rig.cast(0, survey.scan_count)))
    cloud = part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)
    return cloud, Sweeps.from_survey(survey, scene)


def vlp16_survey(**options):
    options = {"columns": ("ray", "range", "reflectivity"), "keep_every": 1, "steps": 2} | options
    return Survey(sensor=load_sensor("vlp16"), poses=[Pose((0, 0, 0))], **options)


def frames_of(content):
    """Return the frames of a pcap file, with their times in microseconds."""
    assert struct.unpack_from("<IHHiII", content) == (0xA1B2C3D4, 2, 4, 0, 0, 262_144)
    assert struct.unpack_from("<I", content, 20) == (1,)
    frames = []
    offset = 24
    while offset < len(content):
        seconds, micros, size, full_size = struct.unpack_from("<IIII", content, offset)
        assert size == full_size and micros < 1_000_000
        frames.append((seconds * 1_000_000 + micros, content[offset + 16 : offset + 16 + size]))
        offset += 16 + size
    assert offset == len(content)
    return frames


def ones_complement(data):
    """Return the checksum of bytes by RFC 1071."""
    data += b"\0" * (len(data) % 2)
    total = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF


def test_pcap_has_frames_in_order_with_right_checksums():
    rng = np.random.default_rng(3)
    payloads = [rng.integers(0, 256, (count, size), np.uint8) for count, size in ((5, 33), (3, 8))]
    due_ns = [np.array([0, 10, 20, 30, 40]) * 1_000_000, np.array([10, 25, 60]) * 1_000_000]
    groups = [
        Datagrams(payload, due, port)
        for payload, due, port in zip(payloads, due_ns, (7502, 8308), strict=True)
    ]
    file = BytesIO()
    writer = PcapWriter(file, "192.168.1.201", "10.0.0.7", START_NS)
    writer.write(groups)
    writer.write([])
    frames = frames_of(file.getvalue())
    expected = sorted(
        [(due, n, payload) for n, group in enumerate(groups) for due, payload in zip(
            group.due_ns.tolist(), group.payloads, strict=True)],
        key=lambda entry: entry[:2],
    )  # fmt: skip
    assert [time for time, _ in frames] == [(START_NS + due) // 1000 for due, _, _ in expected]
    for (_, frame), (_, number, payload) in zip(frames, expected, strict=True):
        assert frame[12:14] == b"\x08\x00" and frame[14] == 0x45
        ip, udp = frame[14:34], frame[34:]
        assert struct.unpack(">H", ip[2:4])[0] == len(frame) - 14
        assert ones_complement(ip) == 0 and ip[9] == 17
        assert ip[12:16] == bytes([192, 168, 1, 201]) and ip[16:] == bytes([10, 0, 0, 7])
        port = groups[number].port
        assert struct.unpack(">HHH", udp[:6]) == (port, port, len(udp))
        assert ones_complement(ip[12:] + struct.pack(">HH", 17, len(udp)) + udp) == 0
        assert udp[8:] == payload.tobytes()


def test_shots_are_in_the_makers_order_with_rays_without_return():
    survey = vlp16_survey(returns=Returns("dual", subrays=7))
    cloud, sweeps = points_of(survey, room())
    (points,) = sweeps.points(cloud)
    shots = Shots.from_points(sweeps, 0, points[points["channel"] != 3], ["reflectivity"])
    assert shots.range_m.shape == shots.columns["reflectivity"].shape == (2, 101, 16)
    # Lasers 0, 2, 4, … of a VLP-16 are channels 0, 1, 2, …
    assert not shots.return_mask[:, :, 6].any() and shots.return_mask[0].sum() == 101 * 15
    assert (shots.columns["reflectivity"][0, :, 6] == 0).all()
    first = points[(points["scan"] == 0) & (points["ray"] == 8)]
    assert shots.range_m[0, 0, 1] == first["range"][0]
    assert shots.starts_ns.tolist() == [round(55_296 * n) for n in range(101)]
    turned = np.diff(np.unwrap(shots.azimuths))
    assert turned == pytest.approx(-2 * np.pi * 55.296e-5, rel=1e-9)  # clockwise


def test_firings_that_fill_no_packet_are_carried_over():
    survey = vlp16_survey()
    cloud, sweeps = points_of(survey, room())
    (points,) = sweeps.points(cloud)
    shots = Shots.from_points(sweeps, 0, points)
    carry = CarryOver(24)
    parts = [carry.whole_packets(part) for part in (shots[:10], shots[10:80], shots[80:])]
    assert [len(part) for part in parts] == [0, 72, 24]
    joined = Shots.concatenate(parts)
    assert (joined.firings == np.arange(96)).all()
    assert np.array_equal(joined.range_m, shots.range_m[:, :96], equal_nan=True)
    assert carry.rest().firings.tolist() == [96, 97, 98, 99, 100] and carry.rest() is None


def one_line(raised):
    return len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("sensor", "mode", "says"),
    [
        (Sensor.grid(), "strongest", "Sensor with 40 channels has no packet.* vlp16"),
        (load_sensor("hdl64e-s3"), "strongest", "Use one of these models: ot128"),
        (load_sensor("vlp16"), "first", "support the returns strongest, last, dual, not first"),
        (load_sensor("vlp16"), "all", "support the returns strongest, last, dual, not all"),
    ],
)
def test_sensors_without_packets_are_refused(sensor, mode, says):
    with pytest.raises(LidarError, match=says) as raised:
        encoder_of(PacketSource(sensor, mode))
    assert one_line(raised)


@pytest.mark.parametrize(
    ("identifiers", "says"),
    [
        ({"unit_m": 0.002}, "lack the identifier product"),
        ({"product": 34, "unit_m": 0.002, "units_m": 1}, r"unknown identifier 'units_m'.*unit_m"),
        (
            {"product": "VLP-16", "unit_m": 0.002},
            ("have product 'VLP-16', which must be a whole number"),
        ),
        ({"product": 34, "unit_m": "2 mm"}, "have unit_m '2 mm', which must be a number"),
    ],
)
def test_wrong_identifiers_are_refused(identifiers, says):
    sensor = load_sensor("vlp16")
    sensor = replace(sensor, packets=replace(sensor.packets, identifiers=identifiers))
    with pytest.raises(LidarError, match=says) as raised:
        encoder_of(PacketSource(sensor, "strongest"))
    assert one_line(raised)


def test_results_without_all_rays_are_refused():
    thinned = vlp16_survey(keep_every=2)
    cloud, sweeps = points_of(thinned, room())
    with pytest.raises(LidarError, match=r"all rays and returns .* keep_every 1") as raised:
        PacketSource.for_sensor(sweeps, 0)
    assert one_line(raised)
    cloud, sweeps = points_of(vlp16_survey(columns=("ray", "range")), room())
    (points,) = sweeps.points(cloud)
    with pytest.raises(LidarError, match="require reflectivity, but the cloud does") as raised:
        Shots.from_points(sweeps, 0, points, ["reflectivity"])
    assert one_line(raised)


def test_every_model_with_packets_can_be_encoded():
    for name in model_names():
        if read_model(name).packets is not None:
            mode = "last" if name == "hesai/pandarqt" else "strongest"
            encoder_of(PacketSource(load_sensor(name), mode))


def test_sweeps_in_a_file_keep_the_packets_of_their_sensors(tmp_path):
    _, sweeps = points_of(vlp16_survey(), room())
    sweeps.save(tmp_path / "sweeps.npz")
    loaded = Sweeps.load(tmp_path / "sweeps.npz").fired
    packets = loaded.sensors[0].packets
    assert packets.format == "velodyne" and packets.ports == {"data": 2368, "position": 8308}
    assert packets.identifiers == {"product": 0x22, "unit_m": 0.002}
    assert (packets.lasers == sweeps.fired.sensors[0].packets.lasers).all()
    assert loaded.seeds == sweeps.fired.seeds


def test_a_package_adds_a_format_of_packets(tmp_path, monkeypatch):
    module = """
    from lidarsim.packets.encoders import PacketEncoder

    class Mine(PacketEncoder):
        def encode(self, shots):
            return []

        def finish(self):
            return []

    WRONG = dict
    """
    groups = {"lidarpool.packets": {"mine": "mine_packets:Mine", "wrong": "mine_packets:WRONG"}}
    folder = write_distribution(
        tmp_path, "mine-packets", groups, {"mine_packets.py": dedent(module)}
    )
    monkeypatch.syspath_prepend(folder)
    assert issubclass(encoder_class("mine"), PacketEncoder)
    with pytest.raises(LidarError, match=r"lacks a subclass of .*PacketEncoder"):
        encoder_class("wrong")
    with pytest.raises(LidarError, match=r"Unknown packet format 'velo'.*'velodyne'"):
        encoder_class("velo")


def sentence(payload):
    """Return the NMEA sentence of a position packet after checking its checksum."""
    text = payload[206:].tobytes().rstrip(b"\0").decode()
    body, checksum = text[1:].removesuffix("\r\n").split("*")
    assert text.startswith("$GPRMC,") and text.endswith("\r\n")
    assert int(checksum, 16) == np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8))
    return body.split(",")


def test_position_packets_state_the_time_and_the_last_fix(tmp_path):
    rows = ["0,0,0,0,48.000000000,-11.500000000,500", "1000000000,0,9,0,48.0001,-11.5,500"]
    (tmp_path / "gnss.csv").write_text("\n".join(["time_ns,x_m", *rows, ""]))
    still = Instrument([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    source = PacketSource(
        load_sensor("vlp16"), "strongest", "", START_NS, dated=True,
        instruments=Instruments(None, still, tmp_path),
    )  # fmt: skip
    packets = PositionPackets(source, 8308)
    due_ns = np.arange(1, 2000) * 1_327_104
    groups = [packets.following(part, part + 5_000) for part in np.split(due_ns, [10, 900])]
    payloads = np.concatenate([group.payloads for group in groups])
    assert payloads.shape == (1999 // 14, 512)  # a packet for every 14 data packets
    assert (np.concatenate([group.due_ns for group in groups]) == due_ns[13::14]).all()
    stamps = payloads[:, 198:202].copy().view("<u4")[:, 0]
    assert (stamps == (START_NS + due_ns[13::14] + 5_000) // 1000 % 3_600_000_000).all()
    assert set(payloads[:, 202]) == {2} and not payloads[:, :198].any()
    # 2023-11-14 22:13:20 UTC: before the first fix, then north at 11.1 m/s, 21.6 knots.
    assert sentence(payloads[0])[1:3] == ["221320", "V"]
    assert sentence(payloads[80])[1:7] == ["221321", "A", "4800.00000", "N", "01130.00000", "W"]
    assert sentence(payloads[-1])[1:] == [
        "221322", "A", "4800.00600", "N", "01130.00000", "W", "021.6", "000.0", "141123", "", "",
        "A",
    ]  # fmt: skip
    undated = PositionPackets(replace(source, dated=False), 8308).following(due_ns, due_ns).payloads
    assert not undated[:, 202:].any()


def test_velodyne_decoder_reads_position_packets():
    decoder = pytest.importorskip("velodyne_decoder")
    source = PacketSource(load_sensor("vlp16"), "strongest", "", START_NS, dated=True)
    due_ns = np.arange(14) * 1_327_104
    (payload,) = PositionPackets(source, 8308).following(due_ns, due_ns).payloads
    packet = decoder.TelemetryPacket(payload.tolist())
    time = packet.parse_nmea()
    assert packet.pps_status == decoder.TelemetryPacket.PpsStatus.LOCKED
    assert (time.utc_year, time.utc_month, time.utc_day) == (2023, 11, 14)
    assert (time.utc_hours, time.utc_minutes, time.utc_seconds) == (22, 13, 20)
    micros = packet.pps_time.replace(tzinfo=UTC).timestamp() * 1e6
    assert micros == pytest.approx((START_NS + due_ns[13]) / 1000, abs=2)

"""Live packets of the command `play` and of Python: what arrives, what is refused, how it ends."""

from __future__ import annotations

import http.client
import json
import os
import random
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tests.shapes import room

from lidarfiles import save_cloud
from lidarfiles.clouds.writing import ExportSpec
from lidarlive import play
from lidarlive.playback.live_sensor import RepeatedInstruments
from lidarlive.playback.pcap_recording import PcapRecording
from lidarlive.playback.sources import open_source, scenario_job
from lidarlive.playback.transmitter import Transmitter, sensor_streams
from lidarpool.cli.commands import cli
from lidarsim import (
    Cloud,
    LidarError,
    Mounted,
    Packets,
    Pose,
    Returns,
    Scanner,
    Scene,
    Track,
    load_sensor,
)
from lidarsim.packets.encoders import Datagrams, PacketSource, encoder_of
from lidarsim.packets.pcap import PcapWriter
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.sweeps.instruments import IMU_FILE, Instrument
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

# Position packets go to the port after that of the data.
VLP16 = """
sensor: {model: velodyne/vlp16, rate_hz: 20, packets: {ports: {data: 2368, position: 2369}}}
scene: {preset: seed}
poses: [[0, 0, 1]]
steps: 108
output: {write: [pcap]}
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder with the scenario s.yaml of a VLP-16, and its result out."""
    folder = tmp_path_factory.mktemp("played")
    (folder / "s.yaml").write_text(VLP16)
    (folder / "out").mkdir()
    with open_source(folder / "s.yaml", ExportSpec("pcap")) as source:
        cloud = replace(
            Cloud.concatenate([points for _, points in source]), sweeps=lambda: source.sweeps
        )
        save_cloud(cloud, folder / "out" / "cloud.ply")
        save_cloud(cloud, folder / "out" / "packets", format="pcap")
        source.sweeps.save(folder / "out" / SWEEPS_FILE)
    return folder


def bound():
    """Return a socket at a port that leaves room for those of other packets."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    opened.settimeout(200)  # the command may compile its loops before the first packet
    for port in random.sample(range(20_000, 30_000), 100):
        with suppress(OSError):
            opened.bind(("127.0.0.1", port))
            return opened
    raise AssertionError("no port is free")


@pytest.fixture
def receiver():
    """A socket on the loopback interface that holds the packets of seconds."""
    with bound() as opened:
        yield opened


def port_of(receiver):
    return receiver.getsockname()[1]


def received(receiver, count):
    """Return the payloads of the next datagrams."""
    return [receiver.recv(65_535) for _ in range(count)]


def command(*arguments):
    return CliRunner().invoke(cli, [*map(str, arguments)])


def payloads_of(path, size):
    """Return the payloads of a size in a pcap file of this package."""
    content = path.read_bytes()
    offset = 24
    payloads = []
    while offset < len(content):
        (bytes_of_frame,) = struct.unpack_from("<I", content, offset + 8)
        payloads.append(content[offset + 16 + 42 : offset + 16 + bytes_of_frame])
        offset += 16 + bytes_of_frame
    return [payload for payload in payloads if len(payload) == size]


def test_live_packets_are_those_of_the_file(receiver, played, tmp_path):
    recording = played / "out" / "packets" / "lidar.pcap"
    packets = payloads_of(recording, 1206)
    assert len(packets) > 100
    port = port_of(receiver)
    for source in (played / "s.yaml", played / "out", recording):
        file = tmp_path / "late.json"
        to = f"127.0.0.1:{port}"
        outcome = command("play", source, "--as", "packets", "--to", to, "--lateness", file)
        assert outcome.exit_code == 0, outcome.output
        assert f"sends to 127.0.0.1, port {port} and {port + 1}" in outcome.stdout
        assert received(receiver, len(packets)) == packets
        summary = json.loads(file.read_text())
        assert summary["sent"] == len(packets) + len(packets) // 14
        assert sum(summary["lateness"].values()) == summary["sent"]


@pytest.mark.extended
def test_velodyne_decoder_reads_live_packets_as_the_points_of_the_sweeps(receiver, tmp_path):
    decoder = pytest.importorskip("velodyne_decoder")
    sensor = load_sensor("velodyne/vlp16")
    packets = Packets(sensor)
    scanner = Scanner(room(), sensor, columns=packets.columns)
    lateness = play(scanner, Pose((0, 0, 1)), to=f"127.0.0.1:{port_of(receiver)}", duration_s=0.3)
    content = received(receiver, lateness.sent - lateness.sent // 15)
    with (tmp_path / "live.pcap").open("wb") as file:
        writer = PcapWriter(file, "192.168.1.201")
        for number, payload in enumerate(content):
            array = np.frombuffer(payload, np.uint8)[None]
            due_ns = np.array([number * 1_327_104])
            writer.write([Datagrams(array, due_ns, 2368)])
    arrays = decoder.read_pcap(str(tmp_path / "live.pcap"), as_pcl_structs=True)
    decoded = np.concatenate([points for _, points in arrays])
    cast = [scanner.sweep(Pose((0, 0, 1)), number=number) for number in range(3)]
    for ring in range(16):
        returns = decoded[decoded["ring"] == ring]
        read = np.stack([returns[axis] for axis in "xyz"], axis=1)
        cloud = np.concatenate([points.positions[points["channel"] == ring] for points in cast])
        # Shots after the last whole packet, 24 firings, are not sent.
        assert len(cloud) - 24 < len(read) <= len(cloud)
        assert np.allclose(read, cloud[: len(read)] - [0, 0, 1], atol=0.01)


@pytest.mark.slow
def test_a_loop_goes_on_in_time_until_ctrl_c_and_leaves_no_process(receiver, tmp_path):
    (tmp_path / "s.yaml").write_text(VLP16)
    with playing(tmp_path / "s.yaml", "--loop", "--to", f"127.0.0.1:{port_of(receiver)}") as run:
        per_lap = 3 * 904 // 24
        packets = received(receiver, 2 * per_lap)
        children = children_of(run.pid)
        run.send_signal(signal.SIGINT)
        output = run.communicate(timeout=60)
        assert run.returncode == 130, output
    stamps = [struct.unpack_from("<I", packet, 1200)[0] for packet in packets]
    steps = np.diff(stamps)
    assert (steps > 1000).all()
    assert np.abs(steps - 1327).max() < 1500  # at the start of a lap, a packet is not full
    assert re.fullmatch(
        r"lidarpool: Interrupted. All processes were stopped\. [\d,]+ packets sent, [\d.]+ % "
        r"of them "
        r"within 5 ms of their scheduled time, with a maximum delay of [\d.]+ ms\.\n",
        output[1].splitlines(keepends=True)[-1],
    )
    assert children
    assert not [child for child in children if is_running(child)]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP])
def test_no_process_is_left_when_the_command_is_killed_or_its_terminal_is_closed(
    number, receiver, tmp_path
):
    (tmp_path / "s.yaml").write_text(VLP16)
    with playing(tmp_path / "s.yaml", "--loop", "--to", f"127.0.0.1:{port_of(receiver)}") as run:
        received(receiver, 1)
        children = children_of(run.pid)
        run.send_signal(number)
        run.communicate(timeout=60)
    assert children
    stop = time.monotonic() + 10
    while any(map(is_running, children)):
        assert time.monotonic() < stop
        time.sleep(0.01)


@pytest.mark.slow
def test_a_killed_sender_ends_the_command_in_a_line(receiver, tmp_path):
    (tmp_path / "s.yaml").write_text(VLP16)
    with playing(tmp_path / "s.yaml", "--loop", "--to", f"127.0.0.1:{port_of(receiver)}") as run:
        received(receiver, 1)
        for child in children_of(run.pid):
            os.kill(child, signal.SIGKILL)
        _, errors = run.communicate(timeout=60)
    assert run.returncode == 2
    assert (
        "lidarpool: The process that sends packets has stopped. Start the playback again." in errors
    )
    assert "Traceback" not in errors


@contextmanager
def playing(source, *options):
    """Run the command in a process of its own, which does not outlive the block."""
    code = "from lidarpool.__main__ import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, "play", str(source), "--as", "packets", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as run:
        try:
            yield run
        finally:
            run.kill()


def children_of(pid):
    """Return the processes that a process has started."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in text.split()]


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False


TWO = """
sensors:
  roof: {model: velodyne/vlp16}
  rear: {model: velodyne/vlp16, mount: [-1, 0, 0]}
scene: {preset: seed}
poses: [[0, 0, 1]]
steps: 36
"""


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        (TWO, [], "roof and rear would both send to 127.0.0.1:2368. Specify a port for each"),
        (
            TWO,
            ["--to", "front=127.0.0.1"],
            "'front', which does not exist. The sensors are roof and rear.",
        ),
        (VLP16, ["--to", "::1"], "is an IPv6"),
        (VLP16, ["--to", "lidar=239.1.1.1"], "a multicast address"),
        (VLP16, ["--to", "255.255.255.255"], "not the address of a receiver"),
        (VLP16, ["--to", "127.255.255.255"], "not the address of a receiver"),
        (VLP16, ["--to", f"127.0.0.1:{'9' * 5000}"], "is not a valid address"),
        (VLP16, ["--api", f"127.0.0.1:{'9' * 5000}"], "is not a valid address"),
        (VLP16, ["--to", "127.0.0.1:65535"], "would be sent to port 65536, which is out of range"),
        (VLP16, ["--api", "203.0.113.1"], "cannot listen at 203.0.113.1:80"),
        (VLP16, ["--as", "radar"], "'radar' is not a bridge. Use packets"),
        (
            "scene: seed\nsensor: velodyne/hdl64e-s3\nposes: [[0, 0, 1]]\nsteps: 9\n",
            [],
            "has no packet",
        ),
        (f"{VLP16}cloud: {{keep_every: 2}}\n", [], "`keep_every` is 2"),
        (
            f"{VLP16}returns: {{mode: all}}\n",
            [],
            "support the returns strongest, last, dual, not all",
        ),
    ],
)
def test_what_cannot_be_sent_is_refused_in_a_line(scenario, options, words, tmp_path):
    (tmp_path / "s.yaml").write_text(scenario)
    outcome = command("play", tmp_path / "s.yaml", "--as", "packets", *options)
    assert isinstance(outcome.exception, LidarError)
    assert words in str(outcome.exception)
    assert "\n" not in str(outcome.exception).strip()


def test_a_result_without_rays_is_refused_in_a_line(played, tmp_path):
    shutil.copy(played / "out" / "cloud.ply", tmp_path)
    sweeps = Sweeps.load(played / "out" / SWEEPS_FILE)
    replace(sweeps, fired=None).save(tmp_path / SWEEPS_FILE)
    outcome = command("play", tmp_path, "--as", "packets")
    assert "Packets require all rays and returns of a survey" in str(outcome.exception)


def test_a_port_of_the_interface_that_is_in_use_is_refused(tmp_path):
    (tmp_path / "s.yaml").write_text(VLP16)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        outcome = command("play", tmp_path / "s.yaml", "--as", "packets", "--api", address)
    assert f"cannot listen at {address} (Address already in use)" in str(outcome.exception)


def test_the_name_given_for_the_interface_is_one_of_its_names(monkeypatch):
    resolve = socket.getaddrinfo

    def getaddrinfo(host, *arguments):
        return resolve("127.0.0.1" if host == "Lab.example" else host, *arguments)

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    encoder = encoder_of(PacketSource(load_sensor("velodyne/vlp16"), "strongest", "roof"))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    (stream,) = sensor_streams([encoder], [], [f"Lab.example:{port}"])
    with Transmitter([stream], print):
        for host, status in (("lab.example", 200), ("lab.example.site.example", 403)):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
            connection.request("GET", "/cgi/info.json", headers={"Host": host})
            assert connection.getresponse().status == status
            connection.close()


def test_casting_that_falls_behind_is_said_once_and_loses_no_packet(
    receiver, tmp_path, monkeypatch
):
    def columns_of_slow_cast(batches):
        time.sleep(0.2)
        return columns_of(batches)

    monkeypatch.setattr("lidarlive.playback.sources.columns_of", columns_of_slow_cast)
    monkeypatch.setattr("lidarlive.playback.sources.casting_threads", lambda: 1)
    (tmp_path / "s.yaml").write_text(VLP16)
    to = f"127.0.0.1:{port_of(receiver)}"
    outcome = command("play", tmp_path / "s.yaml", "--as", "packets", "--to", to, "--rate", "1000")
    assert outcome.exit_code == 0, outcome.output
    assert (
        outcome.stderr.count("The simulation is slower than the sensor, so sweeps are sent late")
        == 1
    )
    assert re.search(r"\d sweeps? (was|were) sent late", outcome.stderr)
    assert len(received(receiver, 3 * 904 // 24)) == 113


def test_a_pose_from_outside_is_asked_for_a_sweep_before_and_may_jump(receiver):
    sensor = load_sensor("ouster/os0-32")
    packets = Packets(sensor)
    scanner = Scanner(room(), sensor, columns=packets.columns)
    asked = []

    def pose(start_s):
        asked.append((start_s, time.monotonic()))
        return Pose((5 * (len(asked) % 2), 0, 1), yaw_deg=90 * len(asked))

    told = []
    to = f"127.0.0.1:{port_of(receiver)}"
    lateness = play(scanner, pose, to=to, duration_s=0.4, ready=told.append)
    assert lateness.sent == 4 * 64
    starts_s = np.array([start_s for start_s, _ in asked])
    assert starts_s == pytest.approx([0, 0.1, 0.2, 0.3], abs=1e-3)
    called_s = np.array([called_s for _, called_s in asked])
    assert (np.diff(called_s)[1:] > 0.05).all()
    assert told[0].startswith("ready: Ouster OS0-32 sends to 127.0.0.1, port ")
    content = received(receiver, 4 * 64)
    assert [struct.unpack_from("<H", packet, 2)[0] for packet in content[::64]] == [0, 1, 2, 3]


def test_a_trajectory_is_played_to_its_end(receiver):
    sensor = load_sensor("velodyne/vlp16")
    packets = Packets(sensor)
    scanner = Scanner(room(), sensor, columns=packets.columns)
    track = Track([0, 0.25], [(0, 0, 1), (0.1, 0, 1)])
    lateness = play(scanner, track, to=f"127.0.0.1:{port_of(receiver)}", rate=4)
    assert lateness.sent == 150 + 150 // 14


def test_what_a_scanner_cannot_send_is_refused_in_a_line():
    sensor = load_sensor("velodyne/vlp16")
    with pytest.raises(LidarError, match="Packets require the columns ray, range and reflectivity"):
        play(Scanner(room(), sensor), Pose((0, 0, 1)))
    with pytest.raises(LidarError, match="support the returns strongest, last, dual, not all"):
        Packets(sensor, returns=Returns("all"))
    with pytest.raises(LidarError, match="set in Mounted, but name is 'a'"):
        Packets(Mounted(sensor, name="b"), name="a")
    packets = Packets(sensor)
    scanner = Scanner(room(), sensor, columns=packets.columns)
    sweep = scanner.sweep(Pose((0, 0, 1)), number=0)
    packets.encode(sweep)
    with pytest.raises(LidarError, match="not belong to sweep 1"):
        packets.encode(sweep)


def test_packets_of_a_scanner_are_those_of_a_survey(played):
    job = scenario_job(played / "s.yaml")
    sensor = job.survey.mounted_sensors[0].sensor
    packets = Packets(sensor)
    scanner = Scanner(job.scene, sensor, columns=packets.columns, precision_m=0.002)
    payloads = []
    for number in range(3):
        sweep = scanner.sweep(job.survey.path.pose(0), number=number)
        data, _ = packets.encode(sweep, number=number)
        payloads += [payload.tobytes() for payload in data.payloads]
    assert payloads == payloads_of(played / "out" / "packets" / "lidar.pcap", 1206)


def test_samples_of_an_imu_are_repeated_with_later_times(tmp_path):
    (tmp_path / IMU_FILE).write_text("header\n0,1\n5,2\n")
    imu = Instrument([0, 0, 0], [0, 0, 0, 1], [0, 0])
    rows = RepeatedInstruments(imu, None, tmp_path, 10).rows(IMU_FILE)
    assert [next(rows) for _ in range(4)] == [["0", "1"], ["5", "2"], ["10", "1"], ["15", "2"]]


def frame(payload, *, flags=0, protocol=17, link=b"", offset_bytes=0, identifier=7):
    """Return a frame of Ethernet; a payload begins with the UDP header unless it is a fragment."""
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(payload), identifier,
                       flags << 13 | offset_bytes // 8, 64, protocol, 0)  # fmt: skip
    addresses = bytes([192, 168, 1, 201, 255, 255, 255, 255])
    return b"\xff" * 12 + link + b"\x08\x00" + head + addresses + payload


def pcap(frames, magic=0xA1B2C3D4, link=1):
    content = struct.pack("<IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for number, data in enumerate(frames):
        content += struct.pack("<IIII", 5, 1000 * number, len(data), len(data)) + data
    return content


def udp(payload, port=2368):
    return struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload


def test_a_recording_is_read_with_fragments_and_tags_and_without_other_frames(tmp_path):
    whole = udp(bytes(range(200)) * 10, 7502)
    frames_of_file = [
        frame(udp(b"first")),
        frame(b"tcp", protocol=6),
        b"\xff" * 12 + b"\x86\xdd" + b"ipv6",
        frame(udp(b"tagged", 9), link=b"\x81\x00\x00\x05"),
        frame(whole[1480:], offset_bytes=1480),
        frame(whole[:1480], flags=1),
        frame(udp(b"")),
        b"\xff",
    ]
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap(frames_of_file)[:-1])  # cut off
    recording = PcapRecording(path)
    assert recording.ports == {"192.168.1.201": [2368, 9, 7502]}
    datagrams = [
        (group.due_ns[0], group.port, group.payloads[0].tobytes())
        for _, groups in recording.batches(10**9)
        for group in groups["192.168.1.201"]
    ]
    assert datagrams == [
        (0, 2368, b"first"), (3_000_000, 9, b"tagged"), (5_000_000, 7502, whole[8:]),
        (6_000_000, 2368, b""),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not a pcap or pcapng file"),
        (b"x" * 100, "is not a pcap or pcapng file"),
        (pcap([]), "has no UDP datagrams over IPv4"),
        (pcap([b"\xff" * 60]), "has no UDP datagrams over IPv4"),
        (pcap([frame(udp(b"a"))], link=105), "link type 105, which is not supported"),
    ],
)
def test_a_recording_that_cannot_be_played_is_refused_in_a_line(content, words, tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    outcome = command("play", path, "--as", "packets")
    assert words in str(outcome.exception)
    assert isinstance(outcome.exception, LidarError)


def test_the_interface_of_an_ouster_answers_for_a_recording(tmp_path):
    encoder = encoder_of(PacketSource(load_sensor("ouster/os0-32"), "strongest"))
    with (tmp_path / "a.pcap").open("wb") as file:
        writer = PcapWriter(file, encoder.address)
        writer.write([Datagrams(np.zeros((2, 9), np.uint8), np.arange(2), 7502)])
    (tmp_path / "a.json").write_bytes(encoder.files()[".json"])
    outcome = command("play", tmp_path / "a.pcap", "--as", "packets")
    assert outcome.exit_code == 0, outcome.output
    assert "a.pcap of 192.168.1.200 sends to 127.0.0.1, port 7502; Ouster's HTTP" in outcome.stdout
    (tmp_path / "a.json").write_text("[" * 100_000)
    outcome = command("play", tmp_path / "a.pcap", "--as", "packets")
    assert outcome.exit_code == 0, outcome.output
    assert "HTTP" not in outcome.stdout


@pytest.mark.extended
def test_several_sensors_send_to_a_port_each(receiver, tmp_path):
    (tmp_path / "s.yaml").write_text(TWO)
    with bound() as other:
        options = []
        for name, opened in (("roof", receiver), ("rear", other)):
            options += ["--to", f"{name}=127.0.0.1:{port_of(opened)}"]
        outcome = command("play", tmp_path / "s.yaml", "--as", "packets", *options)
        assert outcome.exit_code == 0, outcome.output
        roof = received(receiver, 75)
        rear = received(other, 75)
    assert roof != rear  # from other positions
    assert [packet[1200:] for packet in roof] == [packet[1200:] for packet in rear]


@pytest.mark.extended
def test_stamps_are_those_of_the_clock_of_this_machine(receiver, tmp_path):
    (tmp_path / "s.yaml").write_text(VLP16)
    to = f"127.0.0.1:{port_of(receiver)}"
    outcome = command("play", tmp_path / "s.yaml", "--as", "packets", "--to", to, "--now")
    now_s = time.time() % 3600
    assert outcome.exit_code == 0, outcome.output
    (stamp_us,) = struct.unpack_from("<I", received(receiver, 1)[0], 1200)
    assert (now_s - stamp_us / 1e6) % 3600 < 10


@pytest.mark.parametrize("name", ["s.yaml", "a.pcap", "out"])
def test_a_source_that_does_not_exist_is_refused(name, tmp_path):
    outcome = command("play", tmp_path / name, "--as", "packets")
    assert re.search(r"does not exist|cannot be read", str(outcome.exception))
    assert isinstance(outcome.exception, LidarError)


def test_a_file_for_lateness_that_cannot_be_written_is_refused_at_the_start(played, tmp_path):
    file = tmp_path / "nowhere" / "late.json"
    outcome = command("play", played / "out", "--as", "packets", "--lateness", file)
    assert f"{file} cannot be written" in str(outcome.exception)
    assert outcome.stdout == ""


def test_ouster_sdk_connects_and_reads_the_sweeps(tmp_path, monkeypatch):
    pytest.importorskip("ouster.sdk.core", reason="ouster-sdk needs an environment of its own")
    from ouster.sdk import open_source as open_sensor

    (tmp_path / "s.yaml").write_text(OUSTER)
    with playing(tmp_path / "s.yaml", "--loop", "--rate", "0.5") as run:
        ready = run.stdout.readline()
        url = re.search(r"at (http://[\d.:]+)", ready)[1]
        monkeypatch.setenv("http_proxy", url)
        sensor = open_sensor("127.0.0.1", lidar_port=17_702)
        assert sensor.sensor_info[0].config.udp_port_lidar == 17_702
        scans = iter(sensor)
        next(scans)  # from the middle of a sweep
        frames = [next(scans)[0] for _ in range(3)]
        sensor.close()
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=60)
    assert np.diff([frame.frame_id for frame in frames]).tolist() == [1, 1]
    assert all(frame.complete() for frame in frames)
    scanner = Scanner(Scene.seed(), load_sensor("ouster/os0-32"), columns=["range"])
    cloud = scanner.sweep(Pose((0, 0, 1)), number=0)
    for frame in frames:
        assert np.count_nonzero(frame.field("RANGE")) == len(cloud)


OUSTER = """
sensor: ouster/os0-32
scene: {preset: seed}
poses: [[0, 0, 1]]
steps: 180
"""


def test_samples_of_an_imu_leave_beside_the_returns(receiver, tmp_path):
    (tmp_path / "s.yaml").write_text(
        f"{OUSTER.replace('180', '36').replace('poses: [[0, 0, 1]]', DRIVE)}"
    )
    port = port_of(receiver) - 1  # of the returns; the IMU's is one more
    to = f"127.0.0.1:{port}"
    outcome = command("play", tmp_path / "s.yaml", "--as", "packets", "--to", to)
    assert outcome.exit_code == 0, outcome.output
    receiver.settimeout(1)
    samples = received(receiver, 9)
    stamps = np.array([struct.unpack_from("<Q", sample)[0] for sample in samples])
    assert {len(sample) for sample in samples} == {48}
    assert np.diff(stamps).tolist() == [10_000_000] * 8


DRIVE = """
trajectory:
  points:
    - {time_s: 0, position: [0, 0, 1]}
    - {time_s: 1, position: [1, 0, 1]}
navigation: {imu: {rate_hz: 100}}
"""

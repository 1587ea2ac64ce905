"""Sweeps as topics of ROS 2, read by cyclonedds; tests skip without it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from tests import simulators
from tests.shapes import room

from lidarfiles.clouds.ros.messages import RosMessage, message_store
from lidarlive.playback.bridge import BridgeOptions, bridge_class
from lidarlive.playback.schedule import Schedule
from lidarpool.cli.play_command import play
from lidarscenes.writers.scene_file import write_scene
from lidarsim import Cloud, LidarError, Sensor, Survey
from lidarsim.sweeps.sweeps import Sweeps

DOMAIN = 100 + os.getpid() % 100  # so that tests at the same time do not meet

SCENARIO: dict[str, Any] = {
    "scene": "room.ply",
    "trajectory": {
        "points": [{"time_s": k, "position": [k / 2, 0, 0]} for k in range(3)],
        "duration_s": 1,
    },
    "sensors": {
        "roof": {"model": "velodyne/vlp16", "max_range_m": 5.5},
        "nose": {"rays_per_revolution": 90, "layers": 1, "vertical_fov_deg": 0, "rate_hz": 10},
    },
    "navigation": {"imu": {"rate_hz": 100}},
    "planning": {"enabled": False},
}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    write_scene(tmp_path / "room.ply", room())
    (tmp_path / "scan.yaml").write_text(yaml.safe_dump(SCENARIO, sort_keys=False))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def dds() -> Any:
    """The module that publishes; tests skip without cyclonedds."""
    pytest.importorskip("cyclonedds.core")
    from lidarlive.playback import dds

    return dds


class Nodes:
    """Readers of topics, as nodes of ROS 2 have them."""

    def __init__(self, dds: Any, domain: int) -> None:
        from cyclonedds.domain import Domain, DomainParticipant

        self._dds = dds
        self._domain = Domain(domain, dds.Network(domain=domain).configuration)
        self._participant = DomainParticipant(domain)

    def subscribe(self, topic: str, kind: str, *, reliable: bool, latched: bool = False) -> Any:
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        qos = Qos(
            Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(50),
        )
        dds_topic = Topic(self._participant, f"rt{topic}", self._dds.message_class(kind))
        return DataReader(self._participant, dds_topic, qos=qos)

    def close(self) -> None:
        for entity in (self._participant, self._domain):
            entity._delete(entity._ref)


def messages_of(reader: Any, count: int, limit_s: float = 20.0) -> list[Any]:
    """Return at least `count` messages of a reader; fails after the limit."""
    messages: list[Any] = []
    stop = time.monotonic() + limit_s
    while len(messages) < count:
        messages += [sample for sample in reader.take(50) if sample.sample_info.valid_data]
        assert time.monotonic() < stop, f"only {len(messages)} messages"
        time.sleep(0.01)
    return messages


def nanoseconds(time_of_message: Any) -> int:
    return time_of_message.sec_ * 10**9 + time_of_message.nanosec_


@pytest.fixture
def playing(folder, dds) -> Iterator[subprocess.Popen[str]]:
    """Play the scenario in another process, until the test ends."""
    command = [sys.executable, "-m", "lidarpool", "play", "scan.yaml", "--as", "ros2", "--loop",
               "--layout", "velodyne", "--organized"]  # fmt: skip
    environment = os.environ | {"ROS_DOMAIN_ID": str(DOMAIN)}
    process = subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    yield process
    process.kill()
    process.communicate()


def test_nodes_read_what_is_played(playing, dds):
    nodes = Nodes(dds, DOMAIN)
    points = nodes.subscribe("/roof/points", "sensor_msgs/msg/PointCloud2", reliable=True)
    scans = nodes.subscribe("/nose/scan", "sensor_msgs/msg/LaserScan", reliable=False)
    imu = nodes.subscribe("/imu/data_raw", "sensor_msgs/msg/Imu", reliable=False)
    frames = nodes.subscribe("/tf", "tf2_msgs/msg/TFMessage", reliable=True)
    clock = nodes.subscribe("/clock", "rosgraph_msgs/msg/Clock", reliable=False)
    assert playing.stdout.readline() == (
        f"ready: ROS 2 topics in domain {DOMAIN} on 127.0.0.1. Press Ctrl-C to stop.\n"
    )
    clouds = messages_of(points, 3)
    # A node that starts later gets the frames of the sensors.
    fixed = nodes.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", reliable=True, latched=True)
    names = [transform.child_frame_id_ for transform in messages_of(fixed, 1)[0].transforms_]
    assert names == ["roof", "nose", "imu"]
    for cloud in clouds:
        assert (cloud.header_.frame_id_, cloud.width_, cloud.is_dense_) == ("roof", 16, False)
        assert cloud.height_ in (1808, 1809) and cloud.point_step_ == 22
        rows = np.frombuffer(bytes(cloud.data_), np.uint8).reshape(-1, 22)
        x, z = rows[:, 0:4].copy().view("<f4"), rows[:, 8:12].copy().view("<f4")
        returned = ~np.isnan(x)
        assert 10_000 < returned.sum() < len(x)
        assert np.abs(z[returned]).max() < 3.01  # the room's height is 6 m
    starts = [nanoseconds(cloud.header_.stamp_) for cloud in clouds]
    assert (np.diff(starts) > 0.99e8).all() and starts[0] >= 10**18
    assert len(messages_of(scans, 2)[0].ranges_) == 90
    force = messages_of(imu, 2)[0].linear_acceleration_
    assert np.isclose(force.z_, 9.80665, atol=0.1)
    parents = {
        (transform.header_.frame_id_, transform.child_frame_id_)
        for message in messages_of(frames, 2)
        for transform in message.transforms_
    }
    assert parents == {("map", "base_link")}
    times = [nanoseconds(message.clock_) for message in messages_of(clock, 5)]
    assert (np.diff(times) > 0).all() and times[-1] > starts[0]
    nodes.close()
    playing.send_signal(signal.SIGINT)
    playing.wait(20)
    assert "Traceback" not in playing.stderr.read()


def test_messages_of_all_types_are_read(dds):
    """Messages of the publisher, as bags have them, are those that a reader takes apart."""
    store = message_store()
    kinds = store.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](5, 6), "lidar")
    status = kinds["sensor_msgs/msg/NavSatStatus"](-1, 1)
    fix = kinds["sensor_msgs/msg/NavSatFix"](header, status, 52.5, 13.4, 34.0, np.arange(9.0), 2)
    point = kinds["livox_ros_driver2/msg/CustomPoint"](7, 1.5, 2.5, 3.5, 255, 16, 3)
    reserved = np.zeros(3, np.uint8)
    custom = kinds["livox_ros_driver2/msg/CustomMsg"](header, 10**18, 2, 0, reserved, [point] * 2)
    sent = {"/gnss/fix": fix, "/livox": custom}
    with dds.RosPublisher(dds.Network(domain=DOMAIN + 1)) as publisher:
        nodes = Nodes.__new__(Nodes)
        nodes._dds = dds
        nodes._participant = publisher._participant
        for topic, content in sent.items():
            kind = content.__msgtype__
            reader = nodes.subscribe(topic, kind, reliable=True)
            publisher.publish(RosMessage(topic, kind, 0, store.serialize_cdr(content, kind)))
            (read,) = messages_of(reader, 1)
            assert (read.header_.frame_id_, read.header_.stamp_.nanosec_) == ("lidar", 6)
            if topic == "/livox":
                assert [point.offset_time_ for point in read.points_] == [7, 7]
                assert (read.timebase_, read.points_[1].reflectivity_) == (10**18, 255)
            else:
                assert (read.latitude_, read.status_.status_) == (52.5, -1)
                assert read.position_covariance_ == [*range(9)]


def test_a_subscriber_reads_what_publishers_offer(dds):
    """Reliable or not, and messages of the past if they are kept."""
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.topic import Topic

    kind = "rosgraph_msgs/msg/Clock"
    sent = simulators.clock(7.5)
    with dds.RosPublisher(dds.Network(domain=DOMAIN + 4)) as publisher:
        topic = Topic(publisher._participant, "rt/clock", dds.message_class(kind))
        qos = Qos(
            Policy.Reliability.BestEffort,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        writer = DataWriter(publisher._participant, topic, qos=qos)
        publisher.publish(simulators.transforms(3, [("a", "b", (1, 2, 3), 0)], "/tf_static"))
        subscriber = dds.RosSubscriber(publisher, lambda topic, _: topic != "/tf", pytest.fail)
        received: dict[str, RosMessage] = {}
        stop = time.monotonic() + 60
        while {*received} != {"/clock", "/tf_static"}:
            publisher.publish(simulators.transforms(3, [("a", "b", (1, 2, 3), 0)]))
            writer.write(topic.data_type.deserialize(bytes(sent.cdr)))
            received |= {message.topic: message for message in subscriber.receive(0.05)}
            assert time.monotonic() < stop, received
        assert received["/clock"].kind == kind
        assert bytes(received["/clock"].cdr) == bytes(sent.cdr)
        assert subscriber.publishers("/clock") == 1 and subscriber.publishers("/tf") == 0


def test_a_topic_with_reliable_and_other_publishers_is_read_once(dds):
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.topic import Topic

    with dds.RosPublisher(dds.Network(domain=DOMAIN + 5)) as publisher:
        subscriber = dds.RosSubscriber(publisher, lambda *_: True, pytest.fail)
        received: list[bytes] = []

        def publish_until_received(publish, time_s: float) -> None:
            """Publish a time, again and again until it arrives, which takes discovery."""
            sent = simulators.clock(time_s)
            stop = time.monotonic() + 60
            while bytes(sent.cdr) not in received:
                publish(sent)
                received.extend(bytes(message.cdr) for message in subscriber.receive(0.05))
                assert time.monotonic() < stop

        publish_until_received(publisher.publish, 1)
        kind = dds.message_class("rosgraph_msgs/msg/Clock")
        topic = Topic(publisher._participant, "rt/clock", kind)
        qos = Qos(
            Policy.Reliability.BestEffort,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        writer = DataWriter(publisher._participant, topic, qos=qos)
        publish_until_received(lambda sent: writer.write(kind.deserialize(bytes(sent.cdr))), 2)
        received.clear()
        publish_until_received(publisher.publish, 3)  # until the new reader has been discovered
        received.clear()
        for number in range(5):
            publisher.publish(simulators.clock(4 + number))
        publish_until_received(publisher.publish, 9)
        last = [bytes(simulators.clock(4 + number).cdr) for number in range(5)]
        assert [cdr for cdr in received if cdr in last] == last
        assert subscriber.publishers("/clock") == 2


def test_a_program_that_is_restarted_does_not_share_its_topics(dds):
    """A program that was killed remains announced for ten seconds, but it is silent."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    kind = dds.message_class("rosgraph_msgs/msg/Clock")
    with dds.RosPublisher(dds.Network(domain=DOMAIN + 7)) as connection:
        subscriber = dds.RosSubscriber(connection, lambda *_: True, pytest.fail)
        participant = DomainParticipant(DOMAIN + 7)
        topic = Topic(participant, "rt/clock", kind)
        first, second, third = (DataWriter(participant, topic) for _ in range(3))

        def publish(writer, time_s: float) -> None:
            """Publish a time, again and again until it arrives, which takes discovery."""
            stop = time.monotonic() + 60
            cdr = bytes(simulators.clock(time_s).cdr)
            while cdr not in [bytes(message.cdr) for message in subscriber.receive(0.05)]:
                writer.write(kind.deserialize(cdr))
                assert time.monotonic() < stop

        for number, writer in enumerate((first, first, second, second, third, third)):
            publish(writer, number)
        assert subscriber.publishers("/clock") == 3 and not subscriber.is_shared("/clock")
        publish(first, 6)
        assert subscriber.is_shared("/clock") and not subscriber.is_shared("/tf")


def clock_classes(*, suffix: str = "_", name: str = "dds_.Clock_") -> tuple[Any, Any]:
    """Return the classes Time and Clock, as a program without ROS may define them."""
    from cyclonedds.idl import make_idl_struct, types

    fields = {f"sec{suffix}": types.int32, f"nanosec{suffix}": types.uint32}
    time_class = make_idl_struct("Time_", "builtin_interfaces.msg.dds_.Time_", fields)
    typename = f"rosgraph_msgs.msg.{name}"
    return time_class, make_idl_struct("Clock_", typename, {f"clock{suffix}": time_class})


@pytest.mark.parametrize("change", ["no suffix", "appendable", "type name", "XCDR2"])
def test_programs_whose_definitions_of_a_type_differ_are_connected(dds, change):
    """As with ROS 2. What cannot be connected is stated."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import annotations
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    time_class, kind = clock_classes(
        suffix="" if change == "no suffix" else "_",
        name="Clock" if change == "type name" else "dds_.Clock_",
    )
    if change in ("appendable", "XCDR2"):
        annotations.appendable(time_class)
        annotations.appendable(kind)
    notes: list[str] = []
    (clock_field,) = kind.__annotations__
    is_stated = change in ("type name", "XCDR2")
    with dds.RosPublisher(dds.Network(domain=DOMAIN + 6)) as publisher:
        participant = DomainParticipant(DOMAIN + 6)
        topic = Topic(participant, "rt/clock", kind)
        reader = DataReader(participant, topic, qos=Qos(Policy.Reliability.Reliable(0)))
        formats = Policy.DataRepresentation(
            use_cdrv0_representation=change != "XCDR2", use_xcdrv2_representation=change == "XCDR2"
        )
        writer = DataWriter(participant, topic, qos=Qos(Policy.Reliability.Reliable(0), formats))
        subscriber = dds.RosSubscriber(publisher, lambda *_: True, notes.append)
        received: list[Any] = []
        read: list[Any] = []
        stop = time.monotonic() + 60
        while not (notes if is_stated else received and read):
            writer.write(kind(time_class(7, 8)))
            publisher.publish(simulators.clock(9.5))
            received += [m for m in subscriber.receive(0.02) if m.kind.endswith("Clock")]
            read += [getattr(sample, clock_field) for sample in reader.take(9)]
            assert time.monotonic() < stop
    if is_stated:
        difference = {
            "type name": "with the type name rosgraph_msgs::msg::Clock instead of "
            "rosgraph_msgs::msg::dds_::Clock_",
            "XCDR2": "in the format XCDR2 instead of XCDR1",
        }[change]
        assert notes == [
            f"A program publishes /clock {difference}, so its messages are not received."
        ]
    else:
        assert notes == []
        clocks = {bytes(message.cdr) for message in received}
        assert bytes(simulators.clock(7.000000008).cdr) in clocks
        assert time_class(9, 500_000_000) in read


@pytest.mark.parametrize(
    ("hosts", "environment", "message"),
    [
        ((), {"ROS_DOMAIN_ID": "233"}, "ROS_DOMAIN_ID is '233'; it must be a number from 0 to 232"),
        ((), {"ROS_DOMAIN_ID": "one"}, "ROS_DOMAIN_ID is 'one'"),
        ((), {"ROS_DOMAIN_ID": "9" * 5000}, "ROS_DOMAIN_ID is '9999.*; it must be a number"),
        (("127.0.0.1:7400",), {}, "The host 127.0.0.1:7400 of `--to` cannot be resolved"),
        (("239.255.0.1",), {}, "239.255.0.1 of `--to` is a multicast address"),
        (("::1",), {}, "The host ::1 of `--to` cannot be resolved"),
    ],
)
def test_a_network_that_cannot_be_is_one_line(dds, hosts, environment, message):
    with pytest.raises(LidarError, match=message):
        dds.Network.for_hosts(hosts, environment)


def test_networks_are_on_loopback_unless_told_otherwise(dds):
    assert dds.Network.for_hosts((), {}) == dds.Network("127.0.0.1", (), 0)
    local = dds.Network.for_hosts(("localhost",), {"ROS_DOMAIN_ID": "7"})
    assert (local.address, local.peers, local.domain) == ("127.0.0.1", ("127.0.0.1",), 7)
    assert local.configuration.count("<Peer ") == 1


def test_a_domain_whose_ports_are_taken_is_one_line(dds):
    domain = DOMAIN + 2
    sockets = []
    try:
        for participant in range(dds._PARTICIPANTS + 1):
            taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sockets.append(taken)
            taken.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
        with pytest.raises(
            LidarError, match=rf"in domain {domain} on 127.0.0.1\. Its ports are in use"
        ):
            dds.RosPublisher(dds.Network(domain=domain))
    finally:
        for taken in sockets:
            taken.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--as", "ros2", "--layout", "sick"], "'sick' is not one of"),
        (
            ["--as", "ros2", "--layout", "hesai", "--organized"],
            "does not support `organized`",
        ),
        (["--as", "packets", "--layout", "hesai"], "`--layout` cannot be used with `--as packets`"),
    ],
)
def test_options_that_do_not_fit_are_one_line(folder, dds, arguments, message):
    result = CliRunner().invoke(play, ["scan.yaml", *arguments])
    assert message in f"{result.output}{result.exception}"


def test_a_cloud_without_the_columns_of_a_layout_is_one_line(dds, monkeypatch):
    from lidarlive.playback.ros2 import Ros2Bridge

    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN + 3))
    sweeps = Sweeps.from_survey(Survey(Sensor.grid(90, 4), poses=[(0, 0, 0)], steps=4), room())
    columns = {name: np.zeros(0, int) for name in ("scan", "object", "channel", "time")}
    points = Cloud(np.zeros((0, 3)), columns)
    options = BridgeOptions(settings={"layout": "livox"})
    with (
        Ros2Bridge(sweeps, Schedule(), options, print) as bridge,
        pytest.raises(LidarError, match="the layout livox requires the column reflectivity"),
    ):
        bridge.prepare(0, points)


def test_without_the_extra_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    for name in list(sys.modules):
        if name.startswith("cyclonedds."):
            monkeypatch.setitem(sys.modules, name, None)
        elif name.startswith("lidarlive.playback."):
            monkeypatch.delitem(sys.modules, name)
    with pytest.raises(
        LidarError, match=r'`--as ros2` requires cyclonedds.*pip install -e "\.\[ros'
    ):
        bridge_class("ros2")

"""`lidarpool follow` beside a stand-in for a simulator.

Most tests pass messages to the node directly. Tests of the command skip without cyclonedds."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests import simulators
from tests.simulators import clock, joint_states, transforms

from lidarfiles.clouds.ros.messages import RosMessage, message_store
from lidarlive.following.node import FollowOptions
from lidarlive.following.notices import Notices
from lidarlive.following.opening import FollowSources, create_node
from lidarlive.following.pose_input import is_wanted
from lidarpool.cli.follow_command import follow
from lidarscenario.sensors_file import SensorsFile
from lidarsim import LidarError, Material, Mounted, Pose, Scanner, Scene, Sensor, load_sensor
from lidarsim.motion.rotations import matrices

DOMAIN = 100 + os.getpid() % 100  # so that tests at the same time do not meet
ROOM = """
<sdf version="1.9"><world name="room">
  <include><uri>model://ground_plane</uri></include>
  <model name="crate"><pose>3 0 0.5 0 0 0</pose>
    <link name="link"><visual name="visual"><geometry><box><size>1 2 1</size></box></geometry>
    </visual></link></model>
  <model name="robot"><pose>0 0 0.2 0 0 0</pose>
    <link name="base"><visual name="visual"><geometry><box><size>.4 .4 .2</size></box></geometry>
    </visual></link>
    <link name="lidar"><pose>0 0 0.3 0 0 0</pose></link></model>
</world></sdf>
"""
SENSORS = """
sensors:
  roof:
    model: velodyne/vlp16
    mount: {link: robot/lidar}
"""
STILL = [("robot", "room", (0, 0, 0.2), 0.0), ("crate", "room", (3, 0, 0.5), 0.0)]


@pytest.fixture
def dds(monkeypatch) -> Any:
    """The module that publishes; tests skip without cyclonedds."""
    pytest.importorskip("cyclonedds.core")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    from lidarlive.playback import dds

    return dds


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    (tmp_path / "room.sdf").write_text(ROOM)
    (tmp_path / "sensors.yaml").write_text(SENSORS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Loop:
    """A node and the connections through which it receives and publishes messages."""

    def __init__(self, world: str, sensors: str | None = "sensors.yaml", **settings: Any) -> None:
        options = {name: settings.pop(name) for name in [*settings] if name in FOLLOW_OPTIONS}
        files = {name: Path(settings.pop(name)) for name in ("models",) if name in settings}
        sources = FollowSources(
            Path(world), None if sensors is None else Path(sensors), **files, **settings
        )
        self.notes: list[str] = []
        self.sweeps: list[Sweep] = []
        self.frames: list[Any] = []
        self.programs = 1
        self.clock_is_shared = False
        self._arrived: list[RosMessage] = []
        self.node = create_node(sources, (self, self), FollowOptions(**options), self.notes.append)
        self.node.start()

    def __enter__(self) -> Loop:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def publish(self, message: RosMessage) -> None:
        content = message_store().deserialize_cdr(message.cdr, message.kind)
        if message.topic == "/tf_static":
            self.frames += content.transforms
        else:
            self.sweeps.append(Sweep(message.topic, content, self.node._poses.clock_ns))

    def receive(self, wait_s: float) -> Iterator[RosMessage]:
        del wait_s
        arrived = sorted(self._arrived, key=lambda message: message.topic != "/clock")
        self._arrived = []
        yield from arrived

    def publishers(self, topic: str) -> int:
        assert topic == "/clock"
        return self.programs

    def is_shared(self, topic: str) -> bool:
        assert topic == "/clock"
        return self.clock_is_shared

    def send(self, *messages: RosMessage) -> None:
        assert all(is_wanted(message.topic, message.kind) for message in messages)
        self._arrived += messages

    def play(self, frames: Any, start_s: float, stop_s: float, rate_hz: float = 50) -> None:
        """Publish poses and the clock, and let the node do what is due after each step."""
        for number in range(round((stop_s - start_s) * rate_hz) + 1):
            time_s = start_s + number / rate_hz
            self.send(transforms(time_s, frames(time_s)), clock(time_s))
            self.do_what_is_due()

    def do_what_is_due(self) -> None:
        """Let the node read the messages, and publish what is due."""
        self.node.step()
        count = -1
        while count != self.node.published:
            count = self.node.published
            self.node.step()

    def clouds(self, topic: str = "/roof/points") -> list[Sweep]:
        return [sweep for sweep in self.sweeps if sweep.topic == topic]


FOLLOW_OPTIONS = ("world_frames", "vanish_after_s")


class Sweep:
    """A received message of a sensor."""

    def __init__(self, topic: str, content: Any, clock_ns: int) -> None:
        self.topic = topic
        self.content = content
        self.clock_s = clock_ns / 1e9
        stamp = content.header.stamp
        self.stamp_s = stamp.sec + stamp.nanosec / 1e9

    def column(self, name: str) -> Any:
        (field,) = (field for field in self.content.fields if field.name == name)
        rows = np.frombuffer(self.content.data, np.uint8).reshape(-1, self.content.point_step)
        kind = {4: "<u2", 6: "<u4", 7: "<f4", 8: "<f8"}[field.datatype]
        size = np.dtype(kind).itemsize
        return rows[:, field.offset : field.offset + size].copy().view(kind)[:, 0]

    @property
    def points(self) -> Any:
        return np.stack([self.column(name) for name in "xyz"], axis=1)


def test_a_still_world_is_that_of_a_scanner_bit_for_bit(folder):
    with Loop("room.sdf") as loop:
        loop.play(lambda _: STILL, 20, 20.5)
        notes = loop.notes
    clouds = loop.clouds()
    assert len(clouds) == 4 and notes == []
    (frame,) = loop.frames
    assert (frame.header.frame_id, frame.child_frame_id) == ("robot/lidar", "roof")
    scanner = Scanner(
        Scene.load("room.sdf"),
        load_sensor("velodyne/vlp16"),
        name="roof",
        coordinates="sensor",
        columns=["intensity", "time"],
    )
    for number, cloud in enumerate(clouds):
        expected = scanner.sweep(Pose((0, 0, 0.5)), number=number)
        assert len(expected) > 10_000
        assert cloud.points.tobytes() == expected.positions.astype("<f4").tobytes()
        assert cloud.column("intensity").tobytes() == expected["intensity"].tobytes()
        assert cloud.column("ring").tolist() == expected["channel"].tolist()
        assert cloud.content.header.frame_id == "roof"
        start_s, end_s = scanner.span_s(number)
        assert abs(cloud.stamp_s - (20 + start_s)) < 1e-6
        assert cloud.clock_s - (20 + end_s) < 0.1  # at most one sweep late


def test_a_simulation_in_which_all_is_right_has_no_notes(folder):
    """Also after the time for which missing poses are tolerated at the start."""

    def frames(time_s):
        return [*STILL[:1], ("crate", "room", (3 + (time_s - 10), 0, 0.5), 0.0)]

    loop = Loop("room.sdf")
    loop.play(frames, 10, 12.5)
    assert loop.notes == [] and len(loop.clouds()) >= 24


def test_points_are_on_a_moving_body_where_it_is_when_they_are_measured(folder):
    def frames(time_s):
        return [*STILL[:1], ("crate", "room", (3 + 2 * (time_s - 10), 0, 0.5), 0.0)]

    with Loop("room.sdf") as loop:
        loop.play(frames, 10, 10.5)
    assert len(loop.clouds()) == 4
    for cloud in loop.clouds():
        x, y, z = cloud.points.T.astype(float)
        since_s = cloud.stamp_s - 10 + cloud.column("time")
        front = (np.abs(y) < 0.95) & (x > 1) & (np.abs(z) < 0.45)
        front &= x < 2.5 + 2 * since_s + 0.5
        assert front.sum() > 200
        assert np.abs(x[front] - (2.5 + 2 * since_s[front])).max() < 0.002


def test_points_are_in_the_frame_of_the_sensor_at_their_firing_times(folder):
    (folder / "room.sdf").write_text(
        ROOM.replace(
            '<model name="crate">',
            '<model name="wall"><static>true</static><pose>8 0 0 0 0 0</pose><link name="link">'
            '<visual name="visual"><geometry><box><size>0.2 60 20</size></box></geometry></visual>'
            '</link></model><model name="crate">',
        )
    )

    def frames(time_s):
        moved = ("robot", "room", (3 * (time_s - 5), 0, 0.2), 60 * (time_s - 5))
        return [moved, ("crate", "room", (0, 50, 0.5), 0.0)]

    with Loop("room.sdf") as loop:
        loop.play(frames, 5, 5.5)
    assert len(loop.clouds()) == 4
    for cloud in loop.clouds():
        since_s = cloud.stamp_s - 5 + cloud.column("time").astype(float)
        yaw = np.radians(60 * since_s)
        x, y, z = cloud.points.T.astype(float)
        world_x = np.cos(yaw) * x - np.sin(yaw) * y + 3 * since_s
        world_y = np.sin(yaw) * x + np.cos(yaw) * y
        on_wall = (np.abs(world_y) < 20) & (world_x > 4) & (z > -0.3)
        assert on_wall.sum() > 1000
        assert np.abs(world_x[on_wall] - 7.9).max() < 0.003


def test_pause_reset_and_jumps_of_time(folder):
    with Loop("room.sdf") as loop:
        loop.play(lambda _: STILL, 30, 30.3)
        for _ in range(20):  # a pause: nothing is due
            loop.node.step()
        assert len(loop.clouds()) == 2
        loop.play(lambda _: STILL, 30.32, 30.5)
        assert len(loop.clouds()) == 4
        moved = [STILL[0], ("crate", "room", (2, 0, 0.5), 0.0)]
        loop.play(lambda _: moved, 0.1, 0.4)  # the world is reset
        assert len(loop.clouds()) == 6
        loop.play(lambda _: moved, 50, 50.3)  # and jumps ahead
        clouds = loop.clouds()
    assert [round(cloud.stamp_s, 1) for cloud in clouds[4:]] == [0.1, 0.2, 50.0, 50.1]
    for cloud in clouds[4:]:
        x, y, z = cloud.points.T
        front = (np.abs(y) < 0.9) & (x > 1) & (np.abs(z) < 0.4)
        assert np.allclose(x[front], 1.5, atol=0.002) and front.sum() > 200
    assert sum("jumped back from 30.500 to 0.100 s" in note for note in loop.notes) == 1


def test_the_node_does_not_wait_for_messages_while_a_sweep_is_due(folder):
    mount = "{model: velodyne/vlp16, mount: {link: robot/lidar}}"
    (folder / "sensors.yaml").write_text(f"sensors: {{left: {mount}, right: {mount}}}")
    waits = []
    with Loop("room.sdf") as loop:
        receive = loop.receive

        def receive_and_record(wait_s: float) -> Iterator[RosMessage]:
            waits.append(wait_s)
            if len(waits) == 4:
                raise KeyboardInterrupt
            return receive(wait_s)

        loop.send(transforms(1, STILL), clock(1))
        loop.node.step()
        loop.send(transforms(1.15, STILL), clock(1.15))
        loop.receive = receive_and_record
        with pytest.raises(KeyboardInterrupt):
            loop.node.run()
    assert len(loop.clouds("/left/points")) == len(loop.clouds("/right/points")) == 1
    assert waits[0] == waits[3] > 0 and waits[1:3] == [0, 0]


def test_static_poses_of_a_model_apply_until_they_are_replaced(folder):
    with Loop("room.sdf") as loop:
        loop.send(transforms(1, [("crate", "room", (2, 0, 0.5), 0.0)], "/model/crate/pose_static"))
        loop.play(lambda _: STILL[:1], 1, 2.5)
    assert not notes_of(loop, "vanished") and not notes_of(loop, "Poses of")
    x, y, z = loop.clouds()[-1].points.T
    front = (np.abs(y) < 0.9) & (x > 1) & (np.abs(z) < 0.4)
    assert np.allclose(x[front], 1.5, atol=0.002) and front.sum() > 200


def test_bodies_stay_if_no_poses_are_received_after_a_reset(folder):
    with Loop("room.sdf") as loop:
        loop.play(lambda _: STILL, 30, 30.3)
        for number in range(60):
            loop.send(clock(number / 20))
            loop.do_what_is_due()
    assert not notes_of(loop, "vanished")
    x, y, z = loop.clouds()[-1].points.T
    front = (np.abs(y) < 0.9) & (x > 1) & (np.abs(z) < 0.4)
    assert loop.clouds()[-1].stamp_s > 2.7 and front.sum() > 200


def crate_model(folder: Path) -> None:
    (folder / "models" / "box").mkdir(parents=True)
    (folder / "models" / "box" / "model.sdf").write_text(
        '<sdf version="1.9"><model name="box"><link name="link"><pose>0 0 0.5 0 0 0</pose>'
        '<visual name="visual"><geometry><box><size>1 1 1</size></box></geometry></visual>'
        "</link></model></sdf>"
    )


def test_models_that_are_spawned_and_deleted(folder):
    crate_model(folder)

    def frames(time_s):
        spawned = [("box_7", "room", (0, 4, 0), 0.0), ("pallet", "room", (0, -4, 0), 0.0)]
        return STILL + spawned * (12 <= time_s < 14 or time_s >= 16)

    with Loop("room.sdf", models="models") as loop:
        loop.play(frames, 11, 17)
        notes = loop.notes
    hits = {}
    for cloud in loop.clouds():
        x, y, z = cloud.points.T
        face = (np.abs(x) < 0.45) & (y > 3) & (y < 4) & (z > -0.4)
        assert np.allclose(y[face], 3.5, atol=0.002)
        hits[round(cloud.stamp_s, 1)] = face.sum()
    assert len(hits) >= 55
    assert all(count == 0 for stamp, count in hits.items() if stamp < 11.9 or 15.1 < stamp < 15.9)
    assert all(count > 50 for stamp, count in hits.items() if 12.1 < stamp < 14 or stamp > 16.1)
    assert "box_7 was added to the world." in notes
    assert any(note.startswith("box_7/link vanished, because") for note in notes)
    assert "box_7/link is back." in notes
    assert any("no objects for these frames" in note and "pallet" in note for note in notes)


ROBOT = """
<robot name="arm">
  <link name="base"/>
  <link name="plate"><visual><origin xyz="2 0 0"/><geometry><box size="0.1 1 1"/></geometry>
  </visual></link>
  <link name="mast"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="plate"/>
    <origin xyz="0 0 1"/><axis xyz="0 0 1"/></joint>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="mast"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="2" effort="1" velocity="1"/></joint>
</robot>
"""


def test_joint_states_move_the_links_of_a_robot(folder):
    (folder / "arm.urdf").write_text(ROBOT)
    (folder / "sensors.yaml").write_text(SENSORS.replace("robot/lidar", "mast"))
    with Loop("arm.urdf") as loop:
        loop.send(joint_states(3, {"turn": np.nan}), clock(3))
        for number in range(26):
            time_s = 3 + number / 50
            joints = {"turn": 0.8 * (time_s - 3), "lift": 1.0, "wheel": 3.0}
            loop.send(joint_states(time_s, joints), clock(time_s))
            loop.do_what_is_due()
    assert len(loop.clouds()) == 4
    for cloud in loop.clouds():
        angle = 0.8 * (cloud.stamp_s - 3 + cloud.column("time").astype(float))
        x, y, z = cloud.points.T.astype(float)
        assert len(x) > 100
        depth = np.cos(angle) * x + np.sin(angle) * y
        assert np.abs(depth - 1.95).max() < 0.003
        assert np.abs(z).max() < 0.51
    assert "A value of the joint turn is ignored, because it is nan." in loop.notes
    assert any("belong to no robot in a .urdf file" in note and "wheel" in note
               for note in loop.notes)  # fmt: skip


MIMICS = """
<robot name="gripper">
  <link name="base"/><link name="eye"/>
  <link name="left"><visual><origin xyz="0.2 0 0"/><geometry><box size="0.1 1 1"/></geometry>
  </visual></link>
  <link name="right"><visual><origin xyz="0 0.3 0"/><geometry><box size="1 0.1 1"/></geometry>
  </visual></link>
  <link name="back"><visual><origin xyz="-2 0 0"/><geometry><box size="0.1 1 1"/></geometry>
  </visual></link>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="left"/>
    <origin xyz="1 0 1"/><axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
  </joint>
  <joint name="copy" type="prismatic"><parent link="base"/><child link="right"/>
    <origin xyz="0 1 1"/><axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="slide" multiplier="-2" offset="3"/></joint>
  <joint name="turn" type="continuous"><parent link="base"/><child link="back"/>
    <origin xyz="0 0 1"/><axis xyz="0 0 1"/><mimic joint="copy" multiplier="0.1" offset="-0.2"/>
  </joint>
  <joint name="pole" type="fixed"><parent link="base"/><child link="eye"/><origin xyz="0 0 1"/>
  </joint>
</robot>
"""


@pytest.mark.parametrize("slide", [0.5, -0.5])
def test_joints_that_mimic_others_follow_their_values(folder, slide):
    """A joint may mimic a joint that mimics a third. Its own value takes precedence."""
    (folder / "gripper.urdf").write_text(MIMICS)
    (folder / "sensors.yaml").write_text(SENSORS.replace("robot/lidar", "eye"))
    with Loop("gripper.urdf") as loop:
        for number in range(16):
            time_s = 3 + number / 50
            loop.send(joint_states(time_s, {"slide": slide}), clock(time_s))
            loop.do_what_is_due()
        points = loop.clouds()[-1].points
        loop.send(joint_states(3.4, {"slide": slide, "copy": 4.0}), clock(3.4))
        for number in range(16):
            time_s = 3.4 + number / 50
            loop.send(joint_states(time_s, {"slide": slide, "copy": 4.0}), clock(time_s))
            loop.do_what_is_due()
        later = loop.clouds()[-1].points
    assert loop.notes == []
    for cloud, copied in ((points, 3 - 2 * slide), (later, 4.0)):
        turned = 0.1 * copied - 0.2
        depth = cloud @ [-np.cos(turned), -np.sin(turned), 0]
        left = (np.abs(cloud[:, 1]) < 0.4) & (cloud[:, 0] > 0.5)
        right = (np.abs(cloud[:, 0]) < 0.1) & (cloud[:, 1] > 0)
        assert min(left.sum(), right.sum(), (depth > 1.9).sum()) > 50
        assert np.allclose(cloud[left, 0], 1.15 + slide, atol=0.002)
        assert np.allclose(cloud[right, 1], 1.25 + copied, atol=0.002)
        assert np.allclose(depth[depth > 1.9], 1.95, atol=0.003)


@pytest.mark.parametrize("late_s", [0.06, 0.0, -0.06])
def test_sweeps_wait_for_poses_that_arrive_later_than_the_clock(folder, late_s):
    """Poses may also arrive earlier than the clock, which does not move points either."""

    def frames(time_s):
        return [*STILL[:1], ("crate", "room", (3 + 2 * (time_s - 10), 0, 0.5), 0.0)]

    with Loop("room.sdf") as loop:
        for number in range(31):
            time_s = 10 + number / 50
            for sent_s in (10.0, time_s - late_s) if number == 0 else (time_s - late_s,):
                if sent_s >= 10:
                    loop.send(transforms(sent_s, frames(sent_s)))
            loop.send(clock(time_s))
            loop.do_what_is_due()
        assert loop.notes == []
    clouds = loop.clouds()
    assert len(clouds) == (5 if late_s > 0 else 6)
    for cloud in clouds:
        x, y, z = cloud.points.T.astype(float)
        since_s = cloud.stamp_s - 10 + cloud.column("time")
        front = (np.abs(y) < 0.95) & (x > 1) & (np.abs(z) < 0.45) & (x < 3 + 2 * since_s)
        assert front.sum() > 200
        assert np.abs(x[front] - (2.5 + 2 * since_s[front])).max() < 0.002
        wait_s = cloud.clock_s - cloud.stamp_s - 0.1
        assert max(late_s, 0) - 0.001 < wait_s < max(late_s, 0) + 0.021


@pytest.mark.parametrize(
    ("offset_s", "is_used"), [(0.9, True), (1.1, False), (-9.9, True), (-10.1, False)]
)
def test_poses_are_used_if_their_times_are_close_to_the_clock(folder, offset_s, is_used):
    loop = Loop("room.sdf")
    loop.send(clock(50))
    loop.do_what_is_due()
    for _ in range(2):  # the clocks of two programs may differ at first
        loop.send(transforms(50 + offset_s, [("crate", "room", (2, 0, 0.5), 0.0)]), clock(50))
        loop.do_what_is_due()
    assert ("crate" in loop.node._tree.received) == is_used
    loop.send(clock(50.02))
    loop.do_what_is_due()
    loop.send(clock(50.04))
    loop.do_what_is_due()
    differs = notes_of(loop, f"differs from /clock by {offset_s:g} s. Set use_sim_time")
    assert len(differs) == (not is_used)


@pytest.mark.parametrize(("step_s", "jumps"), [(0.93, False), (1.03, True), (-0.07, True)])
def test_steps_of_the_clock_that_are_jumps(folder, step_s, jumps):
    loop = Loop("room.sdf")
    loop.play(lambda _: STILL, 20, 20.3)
    loop.play(lambda _: STILL, 20.3 + step_s, 20.5 + step_s)
    stamps = [round(cloud.stamp_s - 20.3 - step_s, 3) for cloud in loop.clouds()]
    assert (0.0 in stamps) == jumps
    assert bool(notes_of(loop, "The simulation time jumped")) == jumps


def test_sweeps_that_are_too_late_are_skipped_and_counted(folder):
    """Of a sensor with 20 sweeps per second and of one with 10, beside a fast simulator."""
    (folder / "sensors.yaml").write_text(
        "sensors:\n  slow: {model: velodyne/vlp16, mount: {link: robot/lidar}}\n"
        "  fast: {model: velodyne/vlp16, rate_hz: 20, mount: {link: robot/lidar}}\n"
    )
    loop = Loop("room.sdf")
    for time_s in (5.0, 5.42, 5.84):
        loop.send(transforms(time_s, STILL), clock(time_s))
        loop.do_what_is_due()
    stamps = {
        name: [round(cloud.stamp_s, 2) for cloud in loop.clouds(f"/{name}/points")]
        for name in ("slow", "fast")
    }
    assert stamps == {"slow": [5.2, 5.3, 5.6, 5.7], "fast": [5.3, 5.35, 5.7, 5.75]}
    for name in ("slow", "fast"):
        assert len(notes_of(loop, f"A sweep of {name} was skipped, because it could not")) == 1
    assert re.fullmatch(
        r"8 sweeps were published and 16 skipped\. The delay after the end of a sweep was "
        r"\d+ ms \(median\) and \d+ ms \(99th percentile\)\.",
        loop.node.summary,
    )
    delays = [int(text) for text in re.findall(r"(\d+) ms", loop.node.summary)]
    assert delays[0] <= delays[1] < 60_000


@pytest.mark.parametrize(("vanish_after_s", "gone_s"), [(0.5, 0.5), (0, None), (2, None)])
def test_the_time_after_which_a_body_vanishes_can_be_set(folder, vanish_after_s, gone_s):
    def frames(time_s):
        return STILL if time_s <= 21 else STILL[:1]

    loop = Loop("room.sdf", vanish_after_s=vanish_after_s)
    loop.play(frames, 20, 22.5)
    seen = {}
    for cloud in loop.clouds():
        x, y, z = cloud.points.T
        seen[cloud.stamp_s] = bool(((np.abs(y) < 0.9) & (x > 2) & (np.abs(z) < 0.4)).sum())
    if gone_s is None:
        assert all(seen.values()) and not notes_of(loop, "vanished")
    else:
        last = max(stamp for stamp, is_seen in seen.items() if is_seen)
        assert last == pytest.approx(21 + gone_s, abs=0.16)
        assert notes_of(loop, "crate/link vanished, because no poses were received for 0.5 s.")


def test_a_sensor_is_at_its_mount_on_the_frame_and_has_its_own_materials(folder):
    """The mount is tilted and off center, and the frame turns and climbs."""
    (folder / "sensors.yaml").write_text(
        "sensors:\n  roof:\n    model: velodyne/vlp16\n"
        "    mount: {link: robot/lidar, position: [0.5, -0.2, 1.2], yaw_deg: 40, pitch_deg: 15}\n"
        "materials: [{objects: crate*, reflectance: 0.9}, {objects: '*', reflectance: 0.1}]\n"
    )
    frames = [("robot", "room", (1, 2, 3), 70.0), ("crate", "room", (3, 0, 0.5), 0.0)]
    loop = Loop("room.sdf")
    loop.play(lambda _: frames, 20, 20.3)
    (frame,) = loop.frames
    mount = Pose((0.5, -0.2, 1.2), yaw_deg=40, pitch_deg=15)
    place, turn = frame.transform.translation, frame.transform.rotation
    assert np.allclose([place.x, place.y, place.z], mount.position)
    (matrix,) = matrices(np.array([[turn.x, turn.y, turn.z, turn.w]]))
    assert np.allclose(matrix, mount.rotation_matrix)
    carrier = Pose((1, 2, 3.3), yaw_deg=70)  # the lidar is 0.3 m above the robot
    scanner = Scanner(
        Scene.load("room.sdf"),
        Mounted(load_sensor("velodyne/vlp16"), name="roof", unseen=("robot/base",)),
        coordinates="sensor",
        columns=["intensity", "time"],
        materials=[Material("crate*", reflectance=0.9), Material("*", reflectance=0.1)],
    )
    expected = scanner.sweep(carrier.compose(mount), number=1)
    cloud = loop.clouds()[1]
    assert len(expected) > 5_000 and abs(len(cloud.points) - len(expected)) < 5
    assert np.quantile(np.linalg.norm(cloud.points - expected.positions, axis=1), 0.99) < 1e-3
    assert np.quantile(np.abs(cloud.column("intensity") - expected["intensity"]), 0.99) < 1e-3


def test_the_actors_of_a_scenario_follow_their_frames(folder):
    (folder / "scan.yaml").write_text("""
scene: {ground: {}, files: [room.sdf]}
actors: [{name: van, box: [4, 2, 2], at: [10, 0, 0]}]
sensor: velodyne/vlp16
mount: [0, 0, 1]
trajectory: {points: [{time_s: 0, position: [0, 0, 0]}, {time_s: 9, position: [9, 0, 0]}]}
cloud: {keep_every: 2, columns: [time]}
faults: [{kind: dirt, transmission: 0.3}]
""")

    def frames(time_s):
        return [("van", "map", (10 + time_s, 8, 0), 90.0)]

    with Loop("scan.yaml", sensors=None) as loop:
        loop.play(frames, 0, 0.3)
    (unused,) = notes_of(loop, "not used")
    assert "trajectory, faults, cloud.keep_every. To move" in unused
    clouds = loop.clouds("/points")
    assert len(clouds) == 2
    x, y, z = clouds[1].points.T
    face = (np.abs(x - 10.2) < 0.5) & (y > 5) & (np.abs(z) < 0.5)
    assert face.sum() > 10 and np.allclose(y[face], 6, atol=0.002)


def test_materials_of_a_sensor_file_come_before_those_of_the_scenario(folder):
    (folder / "scan.yaml").write_text("""
scene: {files: [room.sdf]}
actors: [{name: van, box: [4, 2, 2], at: [10, 8, 0]}, {name: bus, box: [9, 2, 3], at: [0, -8, 0]}]
sensor: velodyne/vlp16
poses: [[0, 0, 1]]
materials: [{objects: van, reflectance: 0.8}, {objects: "*", reflectance: 0.2}]
""")
    own = "materials: [{objects: bus, reflectance: 0.4}]\n"
    energies = {}
    for materials in ("", own):
        text = "sensors: {roof: {model: velodyne/vlp16, mount: [0, 0, 1]}}\n"
        (folder / "sensors.yaml").write_text(text + materials)
        loop = Loop("scan.yaml")
        loop.play(lambda _: [("crate", "map", (3, 0, 0.5), 0.0)], 0, 0.3)
        cloud = loop.clouds()[0]
        x, y, _z = cloud.points.T
        intensity = cloud.column("intensity").astype(float)
        van = (np.abs(y - 7) < 0.01) & (x > 8)
        bus = (np.abs(y + 7) < 0.01) & (np.abs(x) < 4)
        crate = (np.abs(x - 2.5) < 0.01) & (np.abs(y) < 0.9)
        assert min(van.sum(), bus.sum(), crate.sum()) > 20
        energies[materials] = [intensity[part].sum() for part in (van, bus, crate)]
    ratios = np.divide(energies[own], energies[""])
    assert np.allclose(ratios, [1, 2, 1], rtol=0.01)


def test_organized_clouds_have_one_point_per_ray(folder):
    clouds = []
    for organized in (True, False):
        loop = Loop("room.sdf", organized=organized)
        loop.play(lambda _: STILL, 20, 20.3)
        clouds.append(loop.clouds()[1])
    organized, compact = clouds
    assert (organized.content.width, organized.content.is_dense) == (16, False)
    assert organized.content.height in (1808, 1809) and compact.content.height == 1
    returned = ~np.isnan(organized.points[:, 0])
    assert len(returned) == 16 * organized.content.height
    assert 10_000 < returned.sum() == len(compact.points)
    assert {*map(bytes, organized.points[returned])} == {*map(bytes, compact.points)}
    assert organized.stamp_s == compact.stamp_s


def test_planar_and_livox_sensors_have_their_messages(folder):
    (folder / "sensors.yaml").write_text("""
sensors:
  nose: {rays_per_revolution: 90, layers: 1, vertical_fov_deg: 0, rate_hz: 10, max_range_m: 30}
  top: {model: livox/mid360, mount: [0, 0, 1]}
""")
    with Loop("room.sdf", layout="livox") as loop:
        loop.play(lambda _: STILL, 0, 0.3)
    scans = [sweep.content for sweep in loop.sweeps if sweep.topic == "/nose/scan"]
    custom = [sweep.content for sweep in loop.sweeps if sweep.topic == "/top/livox"]
    assert len(scans[0].ranges) == 90 and 2.4 < min(scans[0].ranges) < 2.6
    assert custom[0].point_num == len(custom[0].points) > 1000
    assert custom[0].__msgtype__ == "livox_ros_driver2/msg/CustomMsg"


def test_a_sensor_without_a_name_has_the_topic_points(folder):
    (folder / "sensors.yaml").write_text("sensor: velodyne/vlp16\nmount: [0, 0, 1]\n")
    with Loop("room.sdf") as loop:
        (one,) = loop.node._sensors
        assert (one.name, one.topic) == (one.published_frame, "/points")
    (folder / "sensors.yaml").write_text(
        "sensors: {roof: {model: velodyne/vlp16, mount: [0, 0, 1]}, 'the nose': velodyne/vlp16}"
    )
    with Loop("room.sdf") as loop:
        names = [one.name for one in loop.node._sensors]
        topics = [one.topic for one in loop.node._sensors]
    assert names == ["roof", "the nose"]
    assert topics == [f"/{one.published_frame}/points" for one in loop.node._sensors]
    assert topics[0] == "/roof/points"


def notes_of(loop: Loop, part: str) -> list[str]:
    return [note for note in loop.notes if part in note]


def test_what_is_missing_or_wrong_is_stated_once_and_the_node_goes_on(folder):
    def frames(time_s):
        far = 500.0 if time_s > 41 else 0.0
        return [
            ("robot", "room", (far, 0, 0.2), 0.0),
            ("base_link", "odom", (1, 0, 0), 0.0),
            ("", "room", (1, 0, 0), 0.0),
        ]

    with Loop("room.sdf") as loop:
        damaged = RosMessage("/tf", "tf2_msgs/msg/TFMessage", 0, b"\0\1\0\0\xff\0\0\0")
        loop.send(damaged)
        loop.send(transforms(1.7e9, [("wheel", "robot", (1, 0, 0), 0.0)]))
        loop.send(transforms(0, [("plate", "robot", (np.nan, 0, 0), 0.0)]))
        loop.play(frames, 40, 43)
        ignored = notes_of(loop, "is damaged and was ignored")
        still = notes_of(loop, "No poses were received for crate/link")
        loose = notes_of(loop, "not connected to the world: base_link")
        jumps = notes_of(loop, "robot jumped by 500 m within 0.02 s")
        unnamed = notes_of(loop, "no child_frame_id")
        invalid = notes_of(loop, "A pose of plate is ignored")
    assert [len(x) for x in (ignored, still, loose, jumps, unnamed, invalid)] == [1] * 6, loop.notes
    assert "`--world-frame odom`" in loose[0]
    assert len(loop.clouds()) >= 28
    lengths = [len(cloud.points) for cloud in loop.clouds()]
    assert lengths[0] > 10_000 and lengths[-1] == 0  # the ground ends after 50 m


def test_poses_of_another_clock_are_stated(folder):
    with Loop("room.sdf") as loop:
        loop.play(lambda _: STILL, 0, 0.1)
        loop.send(transforms(1.7e9, [("crate", "room", (2, 0, 0.5), 0.0)]))
        loop.play(lambda _: STILL, 0.12, 0.3)
    assert notes_of(loop, "Poses of crate are ignored, because their time differs from /clock by")


def test_poses_of_a_restarted_simulator_may_arrive_before_its_clock(folder, monkeypatch):
    with Loop("room.sdf") as loop:
        loop.play(lambda _: STILL, 35, 35.3)
        loop.send(transforms(0.1, STILL))  # the clock of the killed simulator still applies
        loop.do_what_is_due()
        loop.play(lambda _: STILL, 0.12, 0.5)
    assert len(loop.notes) == 1 and "jumped back from 35.300 to 0.120 s" in loop.notes[0]


def test_the_clock_is_stated_after_waiting(folder, monkeypatch):
    monkeypatch.setattr("lidarlive.following.node._QUIET_S", 0)
    with Loop("room.sdf") as loop:
        loop.do_what_is_due()
        monkeypatch.setattr("lidarlive.following.node._QUIET_S", 60)
        loop.play(lambda _: STILL, 0, 0.3)
    waiting, received = loop.notes
    assert waiting.endswith("Waiting.") and received == "Messages on /clock are arriving."


def test_a_clock_that_is_missing_or_shared_is_stated(folder, monkeypatch):
    with Loop("room.sdf") as loop:
        monkeypatch.setattr("lidarlive.following.node._QUIET_S", 0)
        loop.node.step()
        loop.programs = 0
        loop.node.step()
        monkeypatch.undo()
        loop.clock_is_shared = True
        loop.play(lambda _: STILL, 0, 0.3)
    paused, absent, received, shared = loop.notes
    assert "seems to be paused" in paused and "No program publishes it" in absent
    assert shared.startswith("Several programs publish /clock. Stop all simulators but one")
    assert received == "Messages on /clock are arriving."


def test_repeated_events_are_counted(monkeypatch):
    shown: list[str] = []
    notices = Notices(shown.append)
    for count in (1, 2):
        for _ in range(count):
            notices.show_event("key", "An event.")
        monkeypatch.setattr("lidarlive.following.notices._PERIOD_S", -1)
        notices.show_event("key", "An event.")
        monkeypatch.undo()
    assert shown == ["An event.", "An event.", "An event. (2 more such events were not shown.)"]


def test_poses_that_are_rare_are_stated_and_held(folder):
    with Loop("room.sdf") as loop:
        for number in range(60):
            time_s = 5 + number / 50
            if number % 14 == 0:
                loop.send(transforms(time_s, STILL))
            loop.send(clock(time_s))
            loop.do_what_is_due()
    assert notes_of(loop, "Poses of")
    assert "arrive later than the end of the next sweep" in notes_of(loop, "Poses of")[0]
    assert len(loop.clouds()) >= 9


def test_a_sensor_whose_frame_is_not_known_waits(folder):
    (folder / "sensors.yaml").write_text(SENSORS.replace("robot/lidar", "drone/lidar"))
    with Loop("room.sdf") as loop:
        assert loop.notes == [
            "No pose is known for drone/lidar, the frame of the sensor roof. The sensor publishes "
            "nothing until its pose is received. Did you mean 'robot/lidar'?"
        ]
        loop.play(lambda _: STILL, 0, 0.3)
        assert not loop.clouds() and not loop.notes[1:]
        loop.play(lambda _: [*STILL, ("drone/lidar", "room", (0, 0, 2), 0.0)], 0.32, 0.7)
        assert loop.clouds()


def test_a_model_topic_and_a_flood_of_poses(folder):
    types = message_store().types
    with Loop("room.sdf") as loop:
        for number in range(16):
            time_s = 1 + number / 50
            point = types["geometry_msgs/msg/Point"](2.0, 0.0, 0.5)
            pose = types["geometry_msgs/msg/Pose"](point, simulators.quaternion(0))
            loop.send(simulators.message("/model/crate/pose", pose))
            for k in range(300):
                loop.send(transforms(time_s + k * 5e-5, STILL[:1]))
            loop.send(clock(time_s))
            loop.do_what_is_due()
    assert len(loop.clouds()) >= 2
    x, y, z = loop.clouds()[-1].points.T
    front = (np.abs(y) < 0.9) & (x > 1) & (np.abs(z) < 0.4)
    assert np.allclose(x[front], 1.5, atol=0.002) and front.sum() > 200


def test_poses_that_arrive_too_fast_are_skipped(folder):
    """The last message of a topic is read, and so are all static poses."""
    flood = [("robot", "room", (0, 0, 0.2), 0.0)] + [
        (f"camera {k}", "robot", (0, 0, 0.01 * k), 0.0) for k in range(400)
    ]
    with Loop("room.sdf") as loop:
        loop.send(*[transforms(1 + k / 1000, flood) for k in range(60)], clock(1.1))
        loop.send(transforms(0, [("mast", "robot", (0, 0, 1), 0.0)], "/tf_static"))
        loop.node.step()
        assert loop.node._poses.last_ns == 1_059_000_000
        assert "mast" in loop.node._tree.received
        (note,) = notes_of(loop, "faster than they can be read")
    assert re.search(r"so \d+ messages on /tf were skipped", note)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sensors: {roof: {model: velodyne/vlp16, steps: 3}}", "sensors.roof.steps` cannot be"),
        ("sensor: velodyne/vlp17", "velodyne/vlp16"),
        ("scene: seed", "scene"),
        ("sensor: velodyne/vlp16\ncloud: {keep_every: 2}", "`cloud.keep_every` cannot be used"),
        ("sensor: velodyne/vlp16\nsensors: {a: velodyne/vlp16}", "cannot be combined"),
    ],
)
def test_sensor_files_that_cannot_be_used(tmp_path, text, message):
    (tmp_path / "sensors.yaml").write_text(text)
    with pytest.raises(LidarError) as caught:
        SensorsFile.load(tmp_path / "sensors.yaml").sensors_on_frames()
    assert message in str(caught.value) and "sensors.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["room.sdf"], "contains no sensors of lidarpool"),
        (["hall.sdf", "--sensors", "sensors.yaml"], "hall.sdf"),
        (["room.sdf", "--sensors", "none.yaml"], "none.yaml"),
        (["room.sdf", "--sensors", "sensors.yaml", "--models", "none"], "none is not a folder"),
        (["room.sdf", "--sensors", "sensors.yaml", "--to", "::1"], "--to"),
    ],
)
def test_options_that_cannot_be_used_are_one_line(folder, dds, arguments, message):
    result = CliRunner().invoke(follow, [*arguments, "--as", "ros2"])
    assert isinstance(result.exception, LidarError) and message in str(result.exception)


@pytest.mark.extended
def test_the_node_outlives_a_simulator_that_is_killed_and_paused(folder, dds):
    """The command in a process of its own, and the simulator in another one."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "lidarpool", "follow", "room.sdf", "--as", "ros2",
               "--sensors", "sensors.yaml"]  # fmt: skip
    node = subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    started = []

    def simulator(start_s: float) -> subprocess.Popen[bytes]:
        arguments = ["-m", "tests.simulators", str(DOMAIN), str(start_s), "50"]
        started.append(subprocess.Popen([sys.executable, *arguments], env=environment))
        return started[-1]

    try:
        assert node.stdout.readline().startswith("ready: /roof/points in ROS 2 domain")
        with dds.RosPublisher(dds.Network(domain=DOMAIN)) as publisher:
            subscriber = dds.RosSubscriber(
                publisher, lambda topic, _: topic == "/roof/points", pytest.fail
            )

            def wait_for(after_s: float, before_s: float) -> None:
                """Wait for a cloud with a stamp within limits."""
                stop = time.monotonic() + 120
                while time.monotonic() < stop:
                    for message in subscriber.receive(0.1):
                        cloud = message_store().deserialize_cdr(message.cdr, message.kind)
                        if after_s < cloud.header.stamp.sec < before_s:
                            return
                raise AssertionError("no cloud arrived")

            first = simulator(100)
            wait_for(100, 1e5)
            first.kill()
            second = simulator(10)
            wait_for(9, 99)
            second.send_signal(signal.SIGSTOP)
            time.sleep(1)
            second.send_signal(signal.SIGCONT)
            wait_for(11, 99)
    finally:
        for process in started:
            process.kill()
            process.wait()
        node.send_signal(signal.SIGINT)
        _, errors = node.communicate(timeout=60)
    assert "Traceback" not in errors
    assert "jumped back" in errors and "were published" in errors


def test_a_grid_sensor_in_a_sensor_file_is_that_of_python(tmp_path):
    (tmp_path / "sensors.yaml").write_text("sensor: {layers: 4, rays_per_revolution: 90}")
    ((mounted, frame, options),) = SensorsFile.load(tmp_path / "sensors.yaml").sensors_on_frames()
    assert mounted.sensor.channels == Sensor.grid(90, 4).channels and frame == ""
    assert options["precision_m"] == 0.001


def test_a_sensor_on_a_model_that_was_deleted_publishes_nothing(folder):
    def frames(time_s):
        return STILL[1:] if 2 < time_s < 4.5 else STILL

    with Loop("room.sdf") as loop:
        loop.play(frames, 1, 6)
    stamps = [cloud.stamp_s for cloud in loop.clouds()]
    assert not [stamp for stamp in stamps if 3.2 < stamp < 4.3]
    assert [stamp for stamp in stamps if 2 < stamp < 3] and stamps[-1] > 5.7
    assert notes_of(loop, "No pose is known for robot/lidar, the frame of the sensor roof")


def test_a_sensor_that_fires_all_rays_at_once(folder):
    (folder / "flash.yaml").write_text(
        "name: flash\nsources: {all: none}\nrate_hz: 10\nfirings_per_turn: 1\n"
        "mirror: {motion: sawtooth, width_deg: 1}\nbeams: {elevation_deg: [-5, 0, 5]}\n"
    )
    (folder / "sensors.yaml").write_text(
        "sensor: {model: flash.yaml, step_deg: 360}\nmount: [0, 0, 0.5]\n"
    )
    with Loop("room.sdf") as loop:
        loop.play(lambda t: [("crate", "room", (3 + t, 0, 0.5), 0.0)], 0, 0.5)
    clouds = loop.clouds("/points")
    assert len(clouds) >= 3
    expected = [2.5 + cloud.stamp_s for cloud in clouds]
    assert np.allclose([cloud.points[:, 0].min() for cloud in clouds], expected, atol=0.002)


def test_a_model_that_a_sensor_file_does_not_cover_is_not_added(folder):
    crate_model(folder)
    (folder / "models" / "ball.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    names = "[ground_plane*, robot*, crate*]"
    (folder / "sensors.yaml").write_text(f"{SENSORS}materials: [{{objects: {names}}}]\n")
    spawned = [("box_1", "room", (0, 4, 0), 0.0), ("ball_3", "room", (0, 4, 0), 0.0)]
    with Loop("room.sdf", models="models") as loop:
        loop.play(lambda _: STILL + spawned, 0, 0.5)
    assert len(loop.clouds()) == 4
    assert len(notes_of(loop, "box_1 was not added to the world. materials: no entry")) == 1
    assert len(notes_of(loop, "The model of ball_3 cannot be read.")) == 1
